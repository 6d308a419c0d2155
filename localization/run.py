"""The main job: a log's events, once through, into every asked pair of motion model and estimator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from localization.errors import LogError
from localization.estimators import CORRECTING
from localization.events import Event
from localization.lidar_losses import LidarLosses
from localization.online.core import Core, Pair, ReplayConfig
from localization.online.records import NIS, TWIST, TWIST_COV, Records, trajectory
from localization.trajectory import Trajectory
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

__all__ = ["Pair", "ReplayConfig", "Run", "replay"]


@dataclass(frozen=True, eq=False)
class Run:
    """What one estimator with one motion model made of a log."""

    model: str
    estimator: str
    trajectory: Trajectory
    """Poses as the whole log tells them, with covariances where the estimator has them."""
    twists: FloatArray
    """(N, 3) vx, vy, wz in the body frame at the trajectory's stamps."""
    twist_covariances: FloatArray
    """(N, 3, 3); NaN where nothing is known of it."""
    nis: FloatArray
    """(N,) normalised innovation squared of the LiDAR's measurements, 3 degrees of freedom; NaN where there was none."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and sigma at the end of what was estimated besides the pose."""
    counts: Mapping[str, int]
    """How often what happened: scans, slips, scans that were not trusted..."""
    map_points: FloatArray
    """(M, 2) what the LiDAR saw, in the world [m]; (0, 2) without a LiDAR."""
    notes: Sequence[str]
    """What was found amiss with the sensors on the way."""
    seconds: float
    """Computing time of this pair, without reading the log."""
    corrections: str | None = None
    """Form of the corrections to the motion model, or None where the estimator makes none."""
    moments: Trajectory | None = None
    """Poses as they were estimated at each moment, and would have been published live, where the whole log tells otherwise."""
    lidar: LidarLosses | None = None
    """How long the LiDAR was lost; None where no scans were matched to a map."""


def replay(
    events: Iterable[Event],
    pairs: Sequence[Pair],
    robot: Robot,
    mounts: Mapping[str, Mount],
    has_lidar: bool,
    config: ReplayConfig | None = None,
    on_event: Callable[[int], None] = lambda stamp_ns: None,
) -> list[Run]:
    """Give ``events``, read once, to all ``pairs``; ``on_event`` hears the stamp of each.

    Estimators see the same events in the same order as they would live. What grows with the log is the trajectories alone.
    Raises `LogError` if the events never moved an estimator, and what the log's iterator raises.
    """
    config = config or ReplayConfig()
    lanes = [_Lane(pair, robot, mounts, has_lidar, config) for pair in pairs]
    for event in events:
        for lane in lanes:
            lane.push(event)
        on_event(event.stamp_ns)
    return [lane.finish() for lane in lanes]


class _Lane:
    """One pair at work."""

    def __init__(self, pair: Pair, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: ReplayConfig) -> None:
        self._pair, self._records = pair, Records()
        self._core = Core(pair, robot, mounts, has_lidar, config, is_smoothing=True)
        self._seconds = 0.0

    def push(self, event: Event) -> None:
        begin = time.perf_counter()
        for estimate in self._core.push(event):
            self._records.add(estimate)
        self._seconds += time.perf_counter() - begin

    def finish(self) -> Run:
        begin = time.perf_counter()
        for estimate in self._core.finish():
            self._records.add(estimate)
        stamps, table = self._records.stamps(), self._records.table()
        if not len(stamps):
            raise LogError("there are wheel samples and scans in the log, but no two that motion could be told from.")
        moments = trajectory(stamps, table)
        whole = self._core.estimator.finish(moments)
        self._seconds += time.perf_counter() - begin
        return Run(
            self._pair.model.name,
            self._pair.estimator,
            moments if whole is None else whole,
            table[:, TWIST],
            table[:, TWIST_COV].reshape(-1, 3, 3),
            table[:, NIS],
            self._core.estimator.parameters(),
            self._core.estimator.counts(),
            self._core.estimator.map_points(),
            self._core.notes(),
            self._seconds,
            self._pair.corrections if self._pair.estimator in CORRECTING else None,
            None if whole is None else moments,
            self._core.lidar,
        )
