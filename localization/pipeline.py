"""The pipeline: one event in, the estimates that it completes out. Replay (`log_replay`), online and compare run the same one.

    events -> synchronize -> preintegrate -> predict -> match -> update -> publish

`Pipeline.process` is that line; the filter's predict, match and update are in `estimators.fusion`, in the same order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from localization.estimators import (
    ESTIMATORS_IN_SPACE,
    ESTIMATORS_WITH_CORRECTIONS,
    ESTIMATORS_WITH_MAP,
    Estimate,
    Estimator,
    EstimatorConfig,
    PriorMap,
    SpaceChoice,
    SpaceGraphSettings,
    make_estimator,
    make_localizing,
)
from localization.events import Event, ImuSample, PositionSample, Scan
from localization.inputs.attitude import AttitudeFilter
from localization.inputs.step_config import StepConfig
from localization.inputs.synchronizer import Synchronizer
from localization.lidar.losses import LidarLosses
from localization.messages import Message
from localization.sensor_checks import SensorChecks
from motion_models.base import MotionModel
from motion_models.online_calibration import Form, add_correction_parameters, make_corrections
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of steps and estimators."""

    step: StepConfig = field(default_factory=StepConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)


@dataclass(frozen=True)
class Trial:
    """A motion model and the estimator that uses it."""

    model: MotionModel
    estimator: str
    corrections: Form = "constant"
    """What a fusing estimator corrects of the motion model: a form of `motion_models.online_calibration`."""
    prior: PriorMap | None = None
    """A saved map, for the estimator that localizes in it."""


class Pipeline:
    """Synchronizer and estimator of one trial. No trajectory is stored: memory grows by keyframes of a graph and by smoothing alone."""

    def __init__(
        self,
        trial: Trial,
        robot: Robot,
        mounts: Mapping[str, Mount],
        has_lidar: bool,
        config: ReplayConfig | None = None,
        is_smoothing: bool = False,
    ) -> None:
        """``is_smoothing``: the estimator shall give a smoothed trajectory at the end; it changes no estimate on the way."""
        config = config or ReplayConfig()
        self._name = f"{trial.estimator} ({trial.model.name})"
        self.is_localizing = trial.estimator in ESTIMATORS_WITH_MAP
        self.mounts = dict(mounts)
        """Known mounts by frame, shared with the synchronizer and the estimator."""
        prior = trial.prior
        is_in_space = trial.estimator in ESTIMATORS_IN_SPACE and config.step.planar is False
        is_in_space |= prior is not None and prior.is_in_space
        has_corrections = trial.estimator in ESTIMATORS_WITH_CORRECTIONS and not (is_in_space and trial.estimator != "graph")
        model = add_correction_parameters(trial.model, trial.corrections) if has_corrections else trial.model
        self.synchronizer = Synchronizer(model, robot, self.mounts, has_lidar, config.step)
        if is_in_space:
            self.synchronizer.inertial.measure_in_space()
        graph: SpaceGraphSettings | None = None
        if trial.estimator == "graph":
            corrections = make_corrections(model, trial.corrections)
            of_graph = config.estimator.graph, is_smoothing, config.estimator.lidar.range_noise_m
            graph = SpaceGraphSettings(corrections, robot.geometry.track_width_m, *of_graph)
        choice = SpaceChoice(robot.gyro_noise, self.mounts, config.estimator.lidar, config.estimator.space, graph)
        made = model, trial.corrections, robot, self.mounts
        self.estimator: Estimator
        if prior is not None:
            self.estimator = make_localizing(prior, *made, config.estimator, is_smoothing)
        else:
            self.estimator = (
                choice.begin() if is_in_space else make_estimator(trial.estimator, *made, has_lidar, config.estimator, is_smoothing)
            )
        self._is_in_planar_map = prior is not None and not is_in_space  # whether its ground tilts is to be known
        has_choice = trial.estimator in ESTIMATORS_IN_SPACE and config.step.planar is None and has_lidar
        self.space_choice = choice if has_choice else None
        """The choice between plane and space; None where there is none."""
        self.checks = SensorChecks(self.mounts, config.estimator.lidar, config.step, robot)
        self.wheel_twist: FloatArray | None = None
        """(3,) twist at the end of the last step by the wheels alone; None where wheel data were missing in it."""

    @property
    def attitude(self) -> AttitudeFilter | None:
        """Roll and pitch; None where they are not known."""
        found = self.synchronizer.inertial.attitude
        return found if found is not None and found.has_attitude else None

    def process(self, event: Event) -> list[Estimate]:
        """Take ``event``; the estimates that it completes, none or several. Raises `EstimatorError`.

        Stamps are taken as they are: after a wheel sample stamped an hour ahead, scans of before are late. Logs and topics are freed of
        such jumps as they are read (`logs.clock_sync`); other sources of events must do it themselves.
        """
        return list(self.stream(event))

    def stream(self, event: Event | None) -> Iterator[Estimate]:
        """`process`, one estimate at a time: `attitude` is that of the estimate until the next is taken. None: the events have ended, and
        what still waits for others is done without these."""
        if isinstance(event, PositionSample):
            self.estimator.add_position(event)
            return
        if isinstance(event, ImuSample):
            self.checks.insert_imu(event)
        if isinstance(event, Scan):
            event = self.checks.correct(event)
            if not event.is_planar and (self.space_choice is not None or self._is_in_planar_map):
                self.synchronizer.inertial.measure_in_space()
                if self.space_choice is not None:
                    self.space_choice.has_clouds = True
        if event is not None:
            self.synchronizer.insert(event)
        while (interval := self.synchronizer.next_interval(is_last=event is None)) is not None:  # synchronize
            self.run_deferred()
            step = self.synchronizer.preintegrate(interval)  # wheels through the motion model, gyro, scan
            step = self.checks.apply(step, self.estimator)  # without faulty sensors
            if self.space_choice is not None and self.space_choice.has_clouds:
                self.estimator = self.space_choice.choose(self.estimator, self.attitude, step.start_ns)
            estimate = self.estimator.step(step)  # predict, match, update
            if self.space_choice is not None and self.space_choice.has_clouds:
                self.space_choice.add(estimate, self.attitude)
            estimate = self.checks.inflate(step, estimate, self.estimator)
            is_measured = estimate.nis is not None
            self.synchronizer.feed_back(self.estimator.params, self.estimator.clock_offset_s, is_pose_measured=is_measured)
            if step.duration > 0.0:
                self.wheel_twist = step.twist if step.has_wheels else None
            yield estimate  # publish
        if event is None:
            self.checks.examine(self.estimator, is_last=True)
            self.run_deferred()

    def run_deferred(self) -> None:
        """Do the work that published estimates need not wait for, and predict with what it has corrected. Left out, the next `process`
        does it first."""
        self.checks.examine(self.estimator)
        if self.estimator.run_deferred():
            self.synchronizer.feed_back(self.estimator.params, self.estimator.clock_offset_s)

    def finish(self) -> list[Estimate]:
        """The estimates that still waited for events when these ended."""
        return list(self.stream(None))

    @property
    def lidar(self) -> LidarLosses | None:
        """How long the LiDAR was lost so far; None where no scans are matched."""
        lost = self.estimator.lost
        return None if lost is None else LidarLosses.of(lost)

    def warnings(self) -> list[Message]:
        """Problems of the sensors so far."""
        losses = self.lidar
        found = [*self.estimator.warnings(), *(losses.warnings() if losses is not None and losses.is_event else [])]
        return [*self.synchronizer.warnings(), *self.checks.warnings(), *(problem.of(self._name) for problem in found)]

    def add_mounts(self, mounts: Mapping[str, Mount]) -> bool:
        """Add mounts of new frames; those of known frames are not changed. Returns whether there were any."""
        new = {frame: mount for frame, mount in mounts.items() if frame not in self.mounts}
        self.mounts.update(new)
        return bool(new)
