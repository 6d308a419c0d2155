"""An estimator that takes events one at a time, for programs with a middleware of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from localization.errors import CheckpointError, EventError
from localization.estimate import Estimate
from localization.estimators import check_estimator
from localization.events import CgSample, Event, ImuSample, PositionSample, Reference, Scan, WheelSample
from localization.messages import Message
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.predictor import Predictor, extrapolate
from localization.ros.start_pose import StartPose
from localization.ros.state_serialization import deserialize, serialize
from motion_models.errors import ModelError
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import Cov3, Pose2
from skidloc.messages import MessageReader

_EVENTS = (WheelSample, CgSample, Scan, ImuSample, PositionSample, Reference)
_MAX_AHEAD_NS = 1_000_000_000
"""From the newest wheel sample to the farthest prediction [ns]: beyond, nothing is known of the motion."""

Callback = Callable[[Estimate], None]


class Online:
    """Estimates from messages of ROS, or from events in SI units, as they come: the same as those of a replay of these events, to the last
    bit.

    ``robot`` is a shipped robot's name, the path of a robot file, or a `Robot`; ``pair`` is MODEL/ESTIMATOR. ``mounts`` are poses of
    sensors by frame (by default the robot file's). Without ``has_lidar`` an estimate comes with the wheels, else with each scan. Stamps
    are integer nanoseconds of one clock. Raises `RobotError`, `ModelError` or `EstimatorError` for names that do not exist.

    >>> import numpy as np
    >>> from skidloc import Online, WheelSample
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
        self._trial, self._has_lidar, self._config = make_trial(pair, self.robot, has_lidar), has_lidar, config or ReplayConfig()
        self._mounts = {"base_link": Mount(), **self.robot.mounts} if mounts is None else dict(mounts)
        self._start: StartPose | None = None
        self._begin()
        self._callbacks: list[Callback] = []

    def add_callback(self, callback: Callback) -> None:
        """Call ``callback(estimate)`` with each estimate from now on, before `process` returns."""
        self._callbacks.append(callback)

    def process(self, given: Any, kind: str = "") -> list[Estimate]:
        """Take an event (`WheelSample`, `ImuSample`, `Scan`, `CgSample`, `PositionSample`), or a message about wheels, IMU, LiDAR or centre
        of gravity: of rclpy, of rosbags, or a mapping with its type as ``kind`` (sensor_msgs/msg/JointState). Returns the estimates that
        it completes.

        What is wrong in a message's data is dropped, and in `warnings`. Raises `EventError` for other objects, types that are not read, and
        stamps that are no whole nanoseconds; `EstimatorError` where the estimate is no longer finite.
        """
        if isinstance(given, _EVENTS):
            return self._process(given)
        return [estimate for event in self._messages.events(given, kind) for estimate in self._process(event)]

    def _process(self, event: Event) -> list[Estimate]:
        if not isinstance(event.stamp_ns, int | np.integer):
            raise EventError(f"{type(event).__name__}: stamp_ns is {event.stamp_ns!r}; it must be whole nanoseconds.")
        found = self.pipeline.process(event)
        for estimate in found[-1:]:
            self._go_on_from(estimate)
        return self._publish(found)

    def predict(self, stamp_ns: int) -> Estimate:
        """The estimate at ``stamp_ns``: the last one, moved as wheels and gyro have since, and by its twist from their newest sample on.

        The estimator is not touched. Raises `EventError` before the first estimate, for a stamp before the last one, and for one more than
        a second after the newest wheel sample.
        """
        last, synchronizer = self._predictor.last, self.pipeline.synchronizer
        if last is None:
            raise EventError("there is no estimate yet to predict from.")
        newest = self._predictor.predict(synchronizer.wheels.buffer, synchronizer.turn) or last
        if not last.stamp_ns <= stamp_ns <= newest.stamp_ns + _MAX_AHEAD_NS:
            span = f"{last.stamp_ns} to {newest.stamp_ns + _MAX_AHEAD_NS} ns"
            raise EventError(f"no prediction to {stamp_ns} ns: they are from {span}, a second after the newest wheel sample.")
        return self._placed(extrapolate(newest, stamp_ns))

    def set_pose(self, pose: Pose2, covariance: Cov3 | None = None) -> None:
        """Begin anew at ``pose`` (3,) with ``covariance`` (3, 3) of its right perturbation: with a new map, and nothing learned."""
        cov = np.zeros((3, 3)) if covariance is None else np.asarray(covariance, dtype=float)
        pose = np.asarray(pose, dtype=float)
        if pose.shape != (3,) or cov.shape != (3, 3) or not (np.isfinite(pose).all() and np.isfinite(cov).all()):
            raise EventError("a pose must be (3,) x, y, yaw with a covariance (3, 3), all finite.")
        self._start = StartPose(pose, cov, pose, cov)
        self._begin()

    def reset(self) -> None:
        """Begin anew at the origin: with a new map, and nothing learned."""
        self._start = None
        self._begin()

    def state(self) -> bytes:
        """All that `restore` needs to go on to the last bit, in this version of skidloc."""
        parts = self.pipeline, self._start, self._predictor.last, *self._messages.state()
        text, blob = serialize(parts, {"stats": self._messages.stats})
        return len(text).to_bytes(8, "big") + text + blob

    def restore(self, state: bytes) -> None:
        """Go on from the `state` of an object that was made by the same arguments. Raises `CheckpointError` for other bytes."""
        size = int.from_bytes(state[:8], "big")
        is_whole, shared = 0 < size <= len(state) - 8, {"stats": self._messages.stats}
        found = deserialize(state[8 : 8 + size], state[8 + size :], shared) if is_whole else None
        if not isinstance(found, tuple) or len(found) != 6 or not isinstance(found[0], Pipeline):
            raise CheckpointError("these bytes are no state of skidloc.Online.")
        self.pipeline, self._start, last, *messages = found
        self._messages.restore(*messages)
        self._predictor = self._make_predictor()
        if last is not None:
            self._go_on_from(last)

    def _go_on_from(self, estimate: Estimate) -> None:
        estimator = self.pipeline.estimator
        self._predictor.reset(estimate, estimator.wheel_calibration, estimator.clock_offset_s, estimator.gyro_calibration)

    def _begin(self) -> None:
        self.pipeline = Pipeline(self._trial, self.robot, self._mounts, self._has_lidar, self._config)
        self._predictor = self._make_predictor()
        self._messages: MessageReader = MessageReader(self.robot)

    def _make_predictor(self) -> Predictor:
        return Predictor(self._trial.model, self.robot, self._config.step)

    def _placed(self, estimate: Estimate) -> Estimate:
        return estimate if self._start is None else self._start.apply(estimate)

    def finish(self) -> list[Estimate]:
        """Estimates that still waited for later events when these ended."""
        return self._publish(self.pipeline.finish())

    @property
    def warnings(self) -> list[Message]:
        """Problems of the sensors so far, with what to do."""
        return [*self._messages.stats.describe(), *self.pipeline.warnings()]

    @property
    def inflation_reasons(self) -> list[str]:
        """Why the covariance has more than the sensors' noise, where no sensor is certainly at fault."""
        return [*self.pipeline.checks.inflation_reasons()]

    def _publish(self, found: list[Estimate]) -> list[Estimate]:
        estimates = [self._placed(estimate) for estimate in found]
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
