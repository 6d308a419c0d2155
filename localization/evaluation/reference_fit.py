"""What errors against a reference without covariances or headings show of the reference: its scatter, and which point it is of."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.evaluation.metrics import ErrorSeries
from localization.evaluation.references import ReferenceTrack
from motion_models import se2
from motion_models.se2 import FloatArray

_MIN_SAMPLES = 20
_MAX_STEP_S = 3.0
"""Longest time between samples [s]: later, what the estimate drifts counts as scatter."""
_MIN_OF_WAY, _MIN_OF_ERROR = 0.3, 0.2
"""Least scatter that is the reference's, of the way from sample to sample (wheels and scans err by 0.01 to 0.1 of it), and of the error."""
_MIN_LEVER_M, _MAX_LEVER_M = 0.05, 2.0
_ITERATIONS = 3
_MAX_REST = 0.5
"""Error that is left with the point known, at most, of that without."""


def find_scatter(errors: ErrorSeries, reference: ReferenceTrack) -> float | None:
    """Root mean square of the noise of the reference's positions [m] by the change of the errors from sample to sample: its slower errors
    are not in it. None where that may be the estimate's."""
    offset = _offsets(errors, reference)
    near = np.diff(errors.stamps_ns) < _MAX_STEP_S * 1e9
    if near.sum() < _MIN_SAMPLES:
        return None
    way = float(np.linalg.norm(np.diff(errors.estimate[:, :2], axis=0)[near], axis=1).mean())
    scatter = math.sqrt(0.5 * float((np.diff(offset, axis=0)[near] ** 2).sum(axis=1).mean()))
    error = math.sqrt(float((offset**2).sum(axis=1).mean()))
    return scatter if scatter > max(_MIN_OF_WAY * way, _MIN_OF_ERROR * error) else None


def find_lever(errors: ErrorSeries, reference: ReferenceTrack) -> tuple[FloatArray, float] | None:
    """(2,) ahead and to the left of base_link [m] of the point that a reference without headings measures, and the error without it [m]:

        reference_i = R(turn) estimate_i + c + R(turn + yaw_i) l

    by Gauss-Newton, as the point's offset turned the alignment. None where that does not explain most of the errors, or nothing turns.
    """
    if reference.yaws is not None or len(errors.stamps_ns) < _MIN_SAMPLES:
        return None
    offset, estimate, rank = _offsets(errors, reference), errors.estimate, 0
    positions = errors.estimate[:, :2] + offset
    found, one, zero = np.zeros(5), np.ones(len(positions)), np.zeros(len(positions))
    for _ in range(_ITERATIONS):
        estimate = se2.compose(np.array([0.0, 0.0, found[2]]), estimate)
        (x, y, _), c, s = estimate.T, np.cos(estimate[:, 2]), np.sin(estimate[:, 2])
        design = np.stack([np.column_stack([one, zero, -y, c, -s]), np.column_stack([zero, one, x, s, c])], axis=1).reshape(-1, 5)
        rest = (positions - estimate[:, :2]).ravel()
        found, _, rank, _ = np.linalg.lstsq(design, rest, rcond=1e-3)
    left = math.sqrt(float(((rest - design @ found) ** 2).sum()) / len(positions))
    lever, error = found[3:], math.sqrt(float((offset**2).sum(axis=1).mean()))
    is_possible = rank == 5 and _MIN_LEVER_M < float(np.hypot(*lever)) < _MAX_LEVER_M
    return (lever, left) if is_possible and left < _MAX_REST * error else None


def errors_at(errors: ErrorSeries, reference: ReferenceTrack, lever: FloatArray) -> ErrorSeries:
    """Errors of the point ``lever`` (2,) ahead and to the left of base_link [m], which the ``reference`` measures, aligned to it anew."""
    positions = reference.positions[np.searchsorted(reference.stamps_ns, errors.stamps_ns)]
    points = se2.compose(errors.estimate, np.array([*lever, 0.0]))
    estimate = se2.compose(se2.align_points(points[:, :2], positions), points)
    return replace(errors, estimate=estimate, position_m=np.linalg.norm(estimate[:, :2] - positions, axis=1))


def _offsets(errors: ErrorSeries, reference: ReferenceTrack) -> FloatArray:
    """(N, 2) of the reference from the aligned estimate [m]."""
    at = np.searchsorted(reference.stamps_ns, errors.stamps_ns)
    return np.asarray(reference.positions[at] - errors.estimate[:, :2])
