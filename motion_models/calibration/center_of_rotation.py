"""Where a turning robot's centre of rotation (CoR) lies, from the poses of an arc, with the covariance that those poses leave it.

Ebersole 2016, Sec. 4.2.1.3. A robot that turns about a point keeps that point fixed twice: in its own body (c) and in the world (w),

    p_k + R(theta_k) c = w        for every pose k of the arc.                                   (4.2, at any pair of poses)

The thesis takes the first and the last pose (`center_from_end_poses`); `center_of_arc` takes all. Both divide by the turned
angle, so the covariance grows as 1/angle^2: a CoR from a small turn is returned, but never as if it were certain. A turn of
exactly zero has no CoR and is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from motion_models.errors import CalibrationError
from motion_models.se2 import FloatArray, adjoint, between, inverse, wrap_angle

_MAX_ITERATIONS = 100
_MAX_CONDITION = 1e14


@dataclass(frozen=True)
class CenterOfRotation:
    """Centre of rotation in the body frame, with its covariance."""

    value: FloatArray
    """(2,) x_CR, y_CR in the body frame [m]."""
    cov: FloatArray
    """(2, 2) [m^2]."""
    chi_square: float = 0.0
    """Squared normalized residuals of the poses about this centre; far above ``degrees_of_freedom`` means that the robot did not turn
    about one point, or that the poses are worse than by their covariance."""
    degrees_of_freedom: int = 0


def center_from_end_poses(
    world_T_start: ArrayLike, world_T_end: ArrayLike, cov_start: ArrayLike | None = None, cov_end: ArrayLike | None = None
) -> CenterOfRotation:
    """The thesis's final-point rule, eqs. 4.4 and 4.5, with the covariance propagated from those of the poses.

    Poses (3,); covariances (3, 3) of their right perturbations, independent of each other, zero where not given. Raises
    `CalibrationError` if the heading did not change (whole turns count as none: use `center_of_arc`).

    >>> from motion_models import se2
    >>> turned_about_its_front = se2.exp([0.0, -0.3, 1.0])  # wz = 1 and vy = -wz x_CR
    >>> center_from_end_poses([0.0, 0.0, 0.0], turned_about_its_front).value.round(6).tolist()
    [0.3, 0.0]
    """
    start_T_end = between(world_T_start, world_T_end)
    value, jacobian = _final_point(start_T_end)
    cov = np.zeros((3, 3))
    if cov_start is not None:
        in_end_frame = adjoint(inverse(start_T_end))
        cov = cov + in_end_frame @ np.asarray(cov_start, dtype=float) @ in_end_frame.T
    if cov_end is not None:
        cov = cov + np.asarray(cov_end, dtype=float)
    return CenterOfRotation(value, jacobian @ cov @ jacobian.T)


def _final_point(start_T_end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The CoR (2,) and its derivative (2, 3) by the right perturbation of ``start_T_end`` (3,)."""
    x, y, theta = start_T_end
    if theta == 0.0:
        raise CalibrationError("the heading at the end is the heading at the start: without a turn there is no centre of rotation.")
    # sin(t) / (1 - cos(t)) = cot(t / 2), which loses no digits at small angles.
    cot = 1.0 / math.tan(theta / 2.0)
    value = np.array([x - cot * y, y + cot * x]) / 2.0  # 4.4, 4.5 with (x_s, y_s) = 0
    by_cot = np.array([-y, x]) / 2.0
    cot_by_theta = -0.5 / math.sin(theta / 2.0) ** 2
    by_position = np.array([[1.0, -cot], [cot, 1.0]]) / 2.0
    return value, np.column_stack([by_position @ _rotation(theta), by_cot * cot_by_theta])


def center_of_arc(world_T_body: ArrayLike, cov: ArrayLike) -> CenterOfRotation:
    """The CoR from all poses of an arc: maximum likelihood with positions and headings both noisy.

    ``world_T_body`` (n, 3), n >= 2; ``cov`` (3, 3) or (n, 3, 3) of the poses' right perturbations, independent from pose to pose and
    positive definite. The true headings are unknowns beside c and w: plain least squares with the measured ones would pull c
    towards zero on short arcs. Raises `CalibrationError` for fewer than two poses, for an arc without a turn, or if the
    poses do not agree on any centre.
    """
    poses = np.atleast_2d(np.asarray(world_T_body, dtype=float))
    n = poses.shape[0]
    if n < 2 or poses.shape != (n, 3) or not np.isfinite(poses).all():
        raise CalibrationError(f"a centre of rotation needs at least two finite poses [x, y, theta]; found shape {poses.shape}.")
    if not np.any(wrap_angle(poses[:, 2] - poses[0, 2])):
        raise CalibrationError(f"all {n} poses have the same heading: without a turn there is no centre of rotation.")
    covs = np.broadcast_to(np.asarray(cov, dtype=float), (n, 3, 3))
    try:
        whiten = np.linalg.inv(np.linalg.cholesky(covs))
    except np.linalg.LinAlgError:
        raise CalibrationError("the covariance of a pose is not positive definite; give every pose some uncertainty.") from None

    center, fixed, heading = _centre_by_least_squares(poses)
    cost = math.inf
    for _ in range(_MAX_ITERATIONS):
        error, by_heading, by_point = _residuals(poses, whiten, center, fixed, heading)
        # Each heading appears in one pose only: eliminate it there (Schur complement), leaving (c, w).
        weight = np.sum(by_heading**2, axis=1)
        slope = np.sum(by_heading * error, axis=1)
        coupling = np.einsum("ki,kij->kj", by_heading, by_point)
        information = np.einsum("kij,kil->jl", by_point, by_point) - np.einsum("kj,kl->jl", coupling, coupling / weight[:, None])
        gradient = np.einsum("kij,ki->j", by_point, error) - coupling.T @ (slope / weight)
        if np.linalg.cond(information) > _MAX_CONDITION:
            raise _disagreement(n)
        step = -np.linalg.solve(information, gradient)
        heading = heading - (slope + coupling @ step) / weight
        center, fixed = center + step[:2], fixed + step[2:]
        previous, cost = cost, float(np.sum(error**2))
        if abs(previous - cost) <= 1e-12 * (1.0 + cost) and np.max(np.abs(step)) <= 1e-9 * (1.0 + np.max(np.abs(center))):
            break
    else:
        raise _disagreement(n)
    return CenterOfRotation(center, np.linalg.inv(information)[:2, :2], cost, 2 * n - 4)


def _disagreement(n: int) -> CalibrationError:
    return CalibrationError(f"the {n} poses do not agree on a centre of rotation: their turn is too small for their uncertainty.")


def _centre_by_least_squares(poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Start of the iteration: c and w (2,) from p_k = w - R_k c, linear if the measured headings (n,) were exact."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    one, zero = np.ones_like(c), np.zeros_like(c)
    rows = np.concatenate([np.column_stack([-c, s, one, zero]), np.column_stack([-s, -c, zero, one])])
    solution = np.linalg.lstsq(rows, np.concatenate([poses[:, 0], poses[:, 1]]), rcond=None)[0]
    return solution[:2], solution[2:], poses[:, 2]


def _residuals(
    poses: FloatArray, whiten: FloatArray, center: FloatArray, fixed: FloatArray, heading: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whitened error (n, 3) of the poses, its derivative (n, 3) by the true headings and (n, 3, 4) by c and w."""
    n = poses.shape[0]
    turn = _rotation(heading)  # (n, 2, 2) world_R_body
    body = np.einsum("kji,kj->ki", turn, poses[:, :2] - fixed)  # the fixed point is at -body in the body frame
    error = np.column_stack([body + center, wrap_angle(poses[:, 2] - heading)])
    by_heading = np.column_stack([body[:, 1], -body[:, 0], -np.ones(n)])
    by_point = np.zeros((n, 3, 4))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :2, 2:] = -np.swapaxes(turn, -1, -2)
    return np.einsum("kij,kj->ki", whiten, error), np.einsum("kij,kj->ki", whiten, by_heading), whiten @ by_point


def _rotation(theta: ArrayLike) -> FloatArray:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
