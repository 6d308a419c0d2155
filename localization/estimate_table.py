"""Estimates as rows of numbers: in memory, on disk, and as a trajectory."""

from __future__ import annotations

from array import array

import numpy as np

from localization.estimators import Estimate
from localization.trajectory import IntArray, Trajectory
from motion_models.se2 import FloatArray

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
        """Append an estimate, unless it is not later than the last."""
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
    """Trajectory of stamps (N,) and rows (N, 25), with covariances if all poses have one."""
    covariances = np.array(table[:, COV]).reshape(-1, 3, 3)
    return Trajectory(np.array(stamps_ns), np.array(table[:, POSE]), covariances if np.isfinite(covariances).all() else None)
