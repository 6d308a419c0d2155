"""The main job: a log's events, once through, into every asked pair of motion model and estimator."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localization.errors import LogError
from localization.estimators import CORRECTING, Estimate
from localization.events import Event
from localization.online.core import Core, Pair, ReplayConfig
from localization.trajectory import IntArray, Trajectory
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

__all__ = ["Pair", "ReplayConfig", "Run", "replay"]


@dataclass(frozen=True, eq=False)
class Run:
    """What one estimator with one motion model made of a log."""

    model: str
    estimator: str
    trajectory: Trajectory
    """Poses, with covariances where the estimator has them."""
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
        self._pair, self._records = pair, _Records()
        self._core = Core(pair, robot, mounts, has_lidar, config)
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
        smoothed = self._core.estimator.finish()
        self._seconds += time.perf_counter() - begin
        stamps, table = self._records.stamps(), self._records.table()
        if not len(stamps):
            raise LogError("there are wheel samples and scans in the log, but no two that motion could be told from.")
        covariances = table[:, _COV].reshape(-1, 3, 3)
        found = Trajectory(stamps, table[:, _POSE], covariances if np.isfinite(covariances).all() else None)
        return Run(
            self._pair.model.name,
            self._pair.estimator,
            found if smoothed is None else smoothed,
            table[:, _TWIST],
            table[:, _TWIST_COV].reshape(-1, 3, 3),
            table[:, _NIS],
            self._core.estimator.parameters(),
            self._core.estimator.counts(),
            self._core.estimator.map_points(),
            self._core.stepper.notes(),
            self._seconds,
            self._pair.corrections if self._pair.estimator in CORRECTING else None,
        )


_POSE, _COV, _TWIST, _TWIST_COV, _NIS = slice(0, 3), slice(3, 12), slice(12, 15), slice(15, 24), 24


class _Records:
    """Estimates as plain numbers, 208 bytes each: a day at 12 Hz is 216 MB."""

    def __init__(self) -> None:
        self._stamps, self._numbers = array("q"), array("d")

    def add(self, estimate: Estimate) -> None:
        if self._stamps and estimate.stamp_ns <= self._stamps[-1]:
            return
        row = np.full(25, np.nan)
        row[_POSE], row[_TWIST] = estimate.pose, estimate.twist
        if estimate.covariance is not None:
            row[_COV] = estimate.covariance.ravel()
        if estimate.twist_covariance is not None:
            row[_TWIST_COV] = estimate.twist_covariance.ravel()
        if estimate.nis is not None:
            row[_NIS] = estimate.nis
        self._stamps.append(estimate.stamp_ns)
        self._numbers.frombytes(row.tobytes())

    def stamps(self) -> IntArray:
        """(N,)"""
        return np.array(self._stamps, dtype=np.int64)

    def table(self) -> FloatArray:
        """(N, 25)"""
        return np.array(self._numbers).reshape(-1, 25)
