"""Steps of Kalman filters of a few states within compiled loops, in place; and for how long statistics are kept."""

from __future__ import annotations

import numpy as np

from motion_models.compiled import subroutine
from motion_models.se2 import FloatArray

FORGETTING = 0.98
"""Factor per measurement of older statistics of residuals, innovations and slip: they are means over the last 50."""


@subroutine
def propagate_in_place(move: FloatArray, cov: FloatArray) -> None:
    """``cov`` = F ``cov`` F^T with F = ``move``, both (n, n)."""
    half, n = np.zeros_like(cov), len(cov)
    for i in range(n):
        for j in range(n):
            for k in range(n):
                half[i, j] += move[i, k] * cov[k, j]
    cov[:] = 0.0
    for i in range(n):
        for j in range(n):
            for k in range(n):
                cov[i, j] += half[i, k] * move[j, k]


@subroutine
def update_in_place(found: FloatArray, cov: FloatArray, row: FloatArray, error: float, variance: float, gain: FloatArray) -> None:
    """One scalar measurement: ``found`` (n,), the estimated error of the states, and ``cov`` (n, n) change.

    H = ``row`` (m,) by the first m states, z = ``error`` where ``found`` was zero, R = ``variance``: the gain is P H^T / (H P H^T + R), of
    which ``gain`` (n,) is the numerator.
    """
    spread, left = variance, error
    for i in range(len(found)):
        gain[i] = 0.0
        for j in range(len(row)):
            gain[i] += cov[i, j] * row[j]
    for j in range(len(row)):
        spread += row[j] * gain[j]
        left -= row[j] * found[j]
    for i in range(len(found)):
        found[i] += gain[i] * left / spread
    for i in range(len(found)):
        for j in range(len(found)):
            cov[i, j] -= gain[i] * gain[j] / spread
