"""What every estimator takes and gives: a step in, an estimate out."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from localization.events import PositionSample
from localization.lidar import LostScans
from localization.step import Step
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Where the body is at one moment and how it moves."""

    stamp_ns: int
    pose: FloatArray
    """(3,) ``world_T_body`` [m, m, rad]."""
    covariance: FloatArray | None
    """(3, 3) of its right perturbation; None where the estimator has none."""
    twist: FloatArray
    """(3,) vx, vy, wz in the body frame."""
    twist_covariance: FloatArray | None
    """(3, 3)"""
    nis: float | None = None
    """Normalised innovation squared of this step's LiDAR measurement, 3 degrees of freedom; None where there was none."""
    odometry: tuple[FloatArray, FloatArray | None] | None = None
    """``odom_T_body`` (3,) and its covariance (3, 3), where ``pose`` is ``map_T_body``: it never jumps."""
    map_T_odom: FloatArray | None = None
    """(3,) what loop closures and positions have corrected; None where ``pose`` is in the odometry frame."""


class Estimator(Protocol):
    """State inside; one `step` after the other, then `finish`."""

    def step(self, step: Step) -> Estimate:
        """The estimate at the end of ``step``. What of the work can wait until that is out, waits for `run_deferred`."""

    def run_deferred(self) -> None:
        """Do what waits, if anything does; else `step` and `finish` do it first. What it finds out, the next estimate tells."""

    def add_position(self, sample: PositionSample) -> None:
        """Take a measured position; estimators without a map frame leave it out."""

    def finish(self, moments: Trajectory | None = None) -> Trajectory | None:
        """A trajectory that later measurements have smoothed, or None where the estimates of each moment are all there is.

        ``moments``: those estimates, for whoever does not keep them. Raises `EstimatorError`."""

    @property
    def clock_offset_s(self) -> float:
        """By how much the wheels' stamps are early [s], as far as the estimator knows; steps are cut by it."""

    @property
    def params(self) -> FloatArray | None:
        """(k,) the motion model's parameters as they are now believed to be, or None where nothing corrects them."""

    @property
    def lost(self) -> LostScans | None:
        """Scans that could not be matched to a map; None where the estimator matches none."""

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what was estimated besides the pose, by name."""

    def counts(self) -> Mapping[str, int]:
        """How often what happened: scans matched, not trusted, slips."""

    def map_points(self) -> FloatArray:
        """(M, 2) what the LiDAR saw, in the world [m]."""


def mean_twist(delta: FloatArray, cov: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Twist (3,) that moves by ``delta`` (3,) in ``duration`` [s], and its covariance (3, 3) by that of ``delta``."""
    way = se2.log(delta)
    J = se2.right_jacobian_inverse(way) / duration
    return way / duration, J @ cov @ J.T


NO_POINTS = np.empty((0, 2))


POSE, COV, TWIST, TWIST_COV, NIS = slice(0, 3), slice(3, 12), slice(12, 15), slice(15, 24), 24
COLUMNS = 25


def row_of(estimate: Estimate) -> FloatArray:
    """(25,) pose, covariance, twist, its covariance, NIS; NaN where there is none."""
    row = np.full(COLUMNS, np.nan)
    row[POSE], row[TWIST] = estimate.pose, estimate.twist
    if estimate.covariance is not None:
        row[COV] = estimate.covariance.ravel()
    if estimate.twist_covariance is not None:
        row[TWIST_COV] = estimate.twist_covariance.ravel()
    if estimate.nis is not None:
        row[NIS] = estimate.nis
    return row


class EstimateTable:
    """In memory, 208 bytes each: a day at 12 Hz is 216 MB. Stamps increase; an estimate that is not later than the last is left out."""

    def __init__(self) -> None:
        self._stamps, self._numbers = array("q"), array("d")

    def add(self, estimate: Estimate) -> None:
        if self._stamps and estimate.stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(estimate.stamp_ns)
        self._numbers.frombytes(row_of(estimate).tobytes())

    def stamps(self) -> IntArray:
        """(N,)"""
        return np.array(self._stamps, dtype=np.int64)

    def rows(self) -> FloatArray:
        """(N, 25)"""
        return np.array(self._numbers).reshape(-1, COLUMNS)


def trajectory(stamps_ns: IntArray, table: FloatArray) -> Trajectory:
    """Of stamps (N,) and rows (N, 25), with covariances if all poses have one."""
    covariances = np.array(table[:, COV]).reshape(-1, 3, 3)
    return Trajectory(np.array(stamps_ns), np.array(table[:, POSE]), covariances if np.isfinite(covariances).all() else None)
