"""The streaming core: one event in, the estimates that it completes out. A replay and a robot use the same one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from localization.estimators import CORRECTING, LOCALIZING, Estimate, Estimator, EstimatorConfig, make_estimator
from localization.events import Event, PositionSample
from localization.lidar_losses import LidarLosses
from localization.synchronizer import Step, StepConfig, Synchronizer
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.corrections import Form, correctable
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of steps and estimators."""

    step: StepConfig = field(default_factory=StepConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)


@dataclass(frozen=True)
class Pair:
    """A motion model and an estimator to run it in."""

    model: MotionModel
    estimator: str
    corrections: Form = "constant"
    """What a fusing estimator learns of the motion model: a form of `motion_models.corrections`."""


class Core:
    """Stepper and estimator of one pair. Bounded, unless it smooths: it keeps no trajectory."""

    def __init__(
        self,
        pair: Pair,
        robot: Robot,
        mounts: Mapping[str, Mount],
        has_lidar: bool,
        config: ReplayConfig | None = None,
        is_smoothing: bool = False,
    ) -> None:
        """``is_smoothing``: the estimator is to give a smoothed trajectory at the end; it changes no estimate on the way."""
        config = config or ReplayConfig()
        self._name = f"{pair.estimator} ({pair.model.name})"
        self.is_localizing = pair.estimator in LOCALIZING
        self.mounts = dict(mounts)
        """Where frames are known to sit; shared by all who ask."""
        model = correctable(pair.model, pair.corrections) if pair.estimator in CORRECTING else pair.model
        self.stepper = Synchronizer(model, robot, self.mounts, has_lidar, config.step)
        self.wheel_twist: FloatArray | None = None
        """(3,) mean twist of the last step by the wheels alone; None where they were not heard during all of it."""
        self.estimator: Estimator = make_estimator(
            pair.estimator, model, pair.corrections, robot, self.mounts, has_lidar, config.estimator, is_smoothing
        )

    def push(self, event: Event) -> list[Estimate]:
        """Take ``event``; the estimates that it completes, none or several. Raises `EstimatorError`.

        Stamps are believed: where wheels of an hour ahead have made a step, scans of before are late. Logs and topics are cleared of
        such leaps as they are read (`logs.merge`); whoever makes events has to do it.
        """
        if isinstance(event, PositionSample):
            self.estimator.add_position(event)
            return []
        return self._take(self.stepper.push(event))

    def settle(self) -> None:
        """After `push`, when its estimates are out: the work that they need not wait for. Left out, the next `push` does it first."""
        self.estimator.settle()

    def finish(self) -> list[Estimate]:
        """The estimates that were still waiting for events when these ended."""
        estimates = self._take(self.stepper.finish())
        self.settle()
        return estimates

    @property
    def lidar(self) -> LidarLosses | None:
        """How long the LiDAR was lost so far; None where no scans are matched."""
        lost = self.estimator.lost
        return None if lost is None else LidarLosses.of(lost)

    def notes(self) -> list[str]:
        """What was found amiss with the sensors on the way."""
        losses = self.lidar
        said = "" if losses is None else losses.describe()
        return [*self.stepper.notes(), *([f"{self._name}: {said}"] if said else [])]

    def meet(self, mounts: Mapping[str, Mount]) -> bool:
        """Take in places of frames that are known only now; one that is known already stays. Returns whether there were any."""
        new = {frame: mount for frame, mount in mounts.items() if frame not in self.mounts}
        self.mounts.update(new)
        return bool(new)

    def _take(self, steps: Iterable[Step]) -> list[Estimate]:
        found = []
        for step in steps:
            found.append(self.estimator.step(step))
            if step.duration > 0.0:
                self.wheel_twist = se2.log(step.predicted.delta) / step.duration if step.has_wheels else None
            self.stepper.clock_offset_s = self.estimator.clock_offset_s
            if self.estimator.params is not None:
                self.stepper.params = self.estimator.params
        return found
