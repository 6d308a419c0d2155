"""An estimator that takes events one at a time, for programs with a middleware of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from localization.estimators import check_estimator
from localization.estimators.estimator import Estimate
from localization.events import Event
from localization.pipeline import Pipeline, ReplayConfig, Trial
from motion_models.errors import ModelError
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot

Callback = Callable[[Estimate], None]


class Online:
    """Estimates from events in SI units as they come: the same as those of a replay of these events, to the last bit.

    ``robot`` is a shipped robot's name, the path of a robot file, or a `Robot`; ``pair`` is MODEL/ESTIMATOR. ``mounts`` are poses of
    sensors by frame (by default the robot file's). Without ``has_lidar`` an estimate comes with the wheels, else with each scan. Stamps
    are integer nanoseconds of one clock. Raises `RobotError`, `ModelError` or `EstimatorError` for names that do not exist.

    >>> import numpy as np
    >>> from localization.events import WheelSample
    >>> online = Online("husky_a200", "skid_steer/odometry", has_lidar=False)
    >>> seen = []
    >>> online.add_callback(lambda estimate: seen.append(estimate.pose[0]))
    >>> for i in range(11):
    ...     _ = online.process(WheelSample(i * 100_000_000, velocity=np.array([2.0, 2.0]), position=np.full(2, np.nan)))
    >>> _ = online.finish()
    >>> print(f"{len(seen)} estimates, {seen[-1]:.2f} m")
    10 estimates, 0.33 m
    """

    def __init__(
        self,
        robot: str | Path | Robot,
        pair: str = "skid_steer/ekf",
        has_lidar: bool = True,
        mounts: Mapping[str, Mount] | None = None,
        config: ReplayConfig | None = None,
    ) -> None:
        self.robot = robot if isinstance(robot, Robot) else load_robot(robot)
        trial = make_trial(pair, self.robot, has_lidar)
        self.pipeline = Pipeline(
            trial, self.robot, {"base_link": Mount(), **self.robot.mounts} if mounts is None else mounts, has_lidar, config
        )
        self._callbacks: list[Callback] = []

    def add_callback(self, callback: Callback) -> None:
        """Call ``callback(estimate)`` with each estimate from now on, before `process` returns."""
        self._callbacks.append(callback)

    def process(self, event: Event) -> list[Estimate]:
        """Take an event (`localization.events`: wheels, IMU, scan, CG, position); returns the estimates that it completes.

        Raises `EstimatorError` where the estimate is no longer finite.
        """
        return self._publish(self.pipeline.process(event))

    def finish(self) -> list[Estimate]:
        """Estimates that still waited for later events when these ended."""
        return self._publish(self.pipeline.finish())

    @property
    def warnings(self) -> list[str]:
        """Problems of the sensors so far, with what to do."""
        return self.pipeline.warnings()

    def _publish(self, estimates: list[Estimate]) -> list[Estimate]:
        for estimate in estimates:
            for callback in self._callbacks:
                callback(estimate)
        return estimates


def make_trial(pair: str, robot: Robot, has_lidar: bool, no_wheels: str = "") -> Trial:
    """The trial of a pair MODEL/ESTIMATOR. Raises `ModelError` or `EstimatorError` for names that do not exist."""
    model, separator, estimator = pair.partition("/")
    if not separator:
        raise ModelError(f"'{pair}' is no pair of motion model and estimator. Write MODEL/ESTIMATOR, as skid_steer/ekf.")
    check_estimator(estimator, has_lidar, no_wheels=no_wheels)
    return Trial(make_model(model, robot), estimator)
