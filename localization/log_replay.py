"""A whole log through pipelines: every trial processes the same events in the same order, and returns a `Run`."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from localization.errors import LogError
from localization.estimate_table import NIS, TWIST, TWIST_COV, EstimateTable, trajectory
from localization.estimators import ESTIMATORS_WITH_CORRECTIONS, Estimate
from localization.events import Event
from localization.lidar.losses import LidarLosses
from localization.lifting import AttitudeTable, SpaceTable, Trajectory3
from localization.maps import KeyframeMap
from localization.messages import Message
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.trajectory import Trajectory
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True, eq=False)
class Run:
    """Result of one trial on one log."""

    model: str
    estimator: str
    trajectory: Trajectory
    """Poses given the whole log (smoothed where the estimator smooths), with covariances where the estimator has them."""
    twists: FloatArray
    """(N, 3) vx, vy, wz in the body frame at the trajectory's stamps."""
    twist_covariances: FloatArray
    """(N, 3, 3); NaN where it has none."""
    nis: FloatArray
    """(N,) normalised innovation squared of the LiDAR's measurements, 3 degrees of freedom; NaN where there was none."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and sigma at the end of what was estimated besides the pose."""
    counts: Mapping[str, int]
    """Number of occurrences by name: scans, matched, searched, standing..."""
    map_points: FloatArray
    """(M, 2) points of the map, in the world [m]; (0, 2) without a LiDAR."""
    warnings: Sequence[Message]
    """Problems of the sensors."""
    seconds: float
    """Computing time of this trial, without reading the log."""
    corrections: str | None = None
    """Form of the corrections to the motion model, or None where the estimator makes none."""
    hindsight: Literal["smoothing", "gyro bias"] | None = None
    """What poses of ``trajectory`` know that was found after them: smoothing by all of the log, or, without a LiDAR, the gyro's bias."""
    live: Trajectory | None = None
    """Poses as they are published live, where there is hindsight: filtered, and without a LiDAR those that never jump."""
    lidar: LidarLosses | None = None
    """How long the LiDAR was lost; None where no scans were matched to a map."""
    keyframes: KeyframeMap | None = None
    """The map as it can be saved, of an estimator with a map frame."""
    localization: Mapping[str, Any] | None = None
    """State, probability and times of the estimator that localizes in a saved map."""
    in_space: Trajectory3 | None = None
    """``trajectory`` in space, with height, roll and pitch: of an estimator in space, or where an IMU shows that the ground tilts."""
    parameter_history: Mapping[str, FloatArray] = field(default_factory=dict)
    """(K, 3) stamp [s], mean and sigma of each of ``parameters``, every two seconds."""
    left_plane_ns: int | None = None
    """Stamp after which poses are in space because the IMU shows that the ground tilts; None where that was not found, or not asked."""
    inflation_reasons: Sequence[str] = ()
    """Why the covariance has more than the sensors' noise, though no fault is probable enough to be reported."""

    @property
    def published(self) -> Trajectory:
        """Poses as they are published live."""
        return self.trajectory if self.live is None else self.live

    @property
    def driven_m(self) -> float:
        """Distance driven by the published poses, at a resolution above the jitter at standstill: corrected poses jump, which is no way."""
        return self.published.distance(_JITTER_M)

    @property
    def in_space_from_s(self) -> float | None:
        """Time after the first pose from which on poses are in space by choice [s]; None where there was none."""
        return None if self.left_plane_ns is None else float(self.left_plane_ns - self.trajectory.stamps_ns[0]) * 1e-9

    def __repr__(self) -> str:
        return f"<Run {self.model} {self.estimator}: {self.trajectory!r}, {len(self.warnings)} warnings>"


_JITTER_M = 0.05
"""Steps of the path below which an estimate's jitter at standstill would count as distance."""
_PARAMETERS_EVERY_NS = 2_000_000_000
"""Time between two samples of the estimated parameters, in `Run.parameter_history`."""


def warnings_of(runs: Iterable[Run]) -> list[Message]:
    """Problems of the sensors in all ``runs``, each once: what several trials report alike is given with the names of all of them.

    Numbers of the sensor checks depend on the estimate: of one fault at one time in several runs the first message is kept.
    """
    found: dict[tuple[str, str], Message] = {}
    sources: dict[tuple[str, str], list[str]] = {}
    for message in itertools.chain.from_iterable(run.warnings for run in runs):
        is_of_check = not message.source and message.at_s is not None
        key = (message.id, f"{message.at_s:.1f}") if is_of_check else (message.id, message.body)
        found.setdefault(key, message)
        sources.setdefault(key, []).append(message.source)
    return [message.of(", ".join(dict.fromkeys(sources[key]))) if message.source else message for key, message in found.items()]


def replay(
    events: Iterable[Event],
    trials: Sequence[Trial],
    robot: Robot,
    mounts: Mapping[str, Mount],
    has_lidar: bool,
    config: ReplayConfig | None = None,
    on_event: Callable[[int], None] = lambda stamp_ns: None,
) -> list[Run]:
    """Run all ``trials`` over ``events``, which are read once; ``on_event`` is called with the stamp of each.

    Estimators receive the same events in the same order as they would live. Only the trajectories grow with the log.
    Raises `LogError` if the events give no motion, and what the log's iterator raises.
    """
    replays = [_Replay(trial, Pipeline(trial, robot, mounts, has_lidar, config, is_smoothing=True)) for trial in trials]
    for event in events:
        for one in replays:
            one.process(event)
        on_event(event.stamp_ns)
    return [one.finish() for one in replays]


class _Replay:
    """One pipeline, and the table of its estimates."""

    def __init__(self, trial: Trial, pipeline: Pipeline) -> None:
        self._trial, self._pipeline, self._table, self._seconds = trial, pipeline, EstimateTable(), 0.0
        self._continuous = EstimateTable()
        self._attitudes, self._in_space = AttitudeTable(), SpaceTable()
        self._parameters: dict[str, list[tuple[float, float, float]]] = {}
        self._next_ns = 0

    def process(self, event: Event) -> None:
        begin = time.perf_counter()
        self._add(self._pipeline.stream(event))
        self._seconds += time.perf_counter() - begin

    def _add(self, estimates: Iterator[Estimate]) -> None:
        for estimate in estimates:
            self._table.add(estimate)
            if estimate.odometry is not None and estimate.map_T_odom is None:
                self._continuous.add(replace(estimate, pose=estimate.odometry[0], covariance=estimate.odometry[1]))
            if estimate.stamp_ns >= self._next_ns:
                self._next_ns = estimate.stamp_ns + _PARAMETERS_EVERY_NS
                for name, (mean, sigma) in self._pipeline.estimator.parameters().items():
                    self._parameters.setdefault(name, []).append((estimate.stamp_ns * 1e-9, mean, sigma))
            attitude = self._pipeline.attitude
            if estimate.in_space is not None:
                self._in_space.add(estimate.stamp_ns, estimate.in_map or estimate.in_space)
            elif attitude is not None:
                self._attitudes.add(estimate.stamp_ns, attitude)

    def finish(self) -> Run:
        begin = time.perf_counter()
        self._add(self._pipeline.stream(None))
        stamps, table = self._table.stamps(), self._table.rows()
        if not len(stamps):
            raise LogError("no two wheel samples or scans span an interval of time. Check the log's length and options of topics.")
        filtered, estimator = trajectory(stamps, table), self._pipeline.estimator
        continuous = self._continuous.stamps(), self._continuous.rows()
        smoothed = estimator.finish(filtered)
        smoothed = None if smoothed is None else self._pipeline.checks.inflate_trajectory(smoothed)
        attitude, final = self._pipeline.attitude, filtered if smoothed is None else smoothed
        in_space = self._attitudes.lift(final) if attitude is not None and attitude.is_tilting and len(self._attitudes) else None
        in_space = self._in_space.trajectory(in_space) if len(self._in_space) else in_space
        if in_space is not None and estimator.smoothed_in_space is not None:
            in_space = in_space.with_end(estimator.smoothed_in_space)
        choice = self._pipeline.space_choice
        self._seconds += time.perf_counter() - begin
        return Run(
            self._trial.model.name,
            self._trial.estimator,
            final,
            table[:, TWIST],
            table[:, TWIST_COV].reshape(-1, 3, 3),
            table[:, NIS],
            estimator.parameters(),
            {**estimator.counts(), **self._pipeline.checks.counts()},
            estimator.map_points(),
            self._pipeline.warnings(),
            self._seconds,
            self._trial.corrections if self._trial.estimator in ESTIMATORS_WITH_CORRECTIONS else None,
            "smoothing" if smoothed is not None else "gyro bias" if len(continuous[0]) else None,
            filtered if smoothed is not None else trajectory(*continuous) if len(continuous[0]) else None,
            self._pipeline.lidar,
            estimator.keyframe_map(),
            estimator.localization(),
            in_space,
            {name: np.array(rows) for name, rows in self._parameters.items()},
            None if choice is None else choice.left_ns,
            self._pipeline.checks.inflation_reasons(),
        )
