"""What a model makes of the wheels of many maneuvers, with derivatives, as another witness would see it.

What lies between the witnesses themselves (clocks, lags, where the LiDAR sits) is not the motion model's business, and is described
here, so that a fit does not push it into the model's parameters.
"""

from __future__ import annotations

from typing import Protocol

import numba
import numpy as np

from motion_models import se2
from motion_models.base import Twist
from motion_models.calibration.maneuvers import Batch, IntArray
from motion_models.preintegration import _integrate, noise_vector
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray

WITNESS_NAMES = ("wheel_time_offset", "wheel_lag", "lidar_offset_x", "lidar_offset_y", "lidar_yaw")
"""Nuisance terms between the witnesses, in the order of their vector (5,), all 0 by default:

wheel_time_offset [s]: how late the wheels' stamps are; the motion at t is in the wheels' samples at t + offset;
wheel_lag [s]: time constant with which the body follows the wheels (first order);
lidar_offset_x, lidar_offset_y [m], lidar_yaw [rad]: pose of the tracked point in the body frame, as far as it is not known already.
"""


class HasTwist(Protocol):
    """As much of a `MotionModel` as a prediction asks for."""

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist: ...


def predict(
    model: HasTwist,
    batch: Batch,
    params: FloatArray,
    witness: FloatArray,
    columns: IntArray,
    noise: WheelNoise,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What the wheels say of every measured pose: poses (M, 3), their derivatives (M, 3, c) and covariances (M, 3, 3).

    ``witness`` (5,) as in `WITNESS_NAMES`; ``columns`` (c,) are the wanted derivatives, indices into the model's k parameters
    followed by the witness's five. Derivatives and covariances are right perturbations; ``noise`` is the wheels' slip.
    """
    k = len(params)
    offset, lag = witness[0], witness[1]
    delayed = offset != 0.0 or lag != 0.0 or bool(np.isin([k, k + 1], columns).any())
    wheels, by_offset, by_lag = batch.wheels, batch.wheels, batch.wheels
    if delayed:
        wheels, by_offset, by_lag = (np.zeros_like(batch.wheels) for _ in range(3))
        _delay(batch.dt, batch.wheels, batch.first, offset, lag, wheels, by_offset, by_lag)
    twist = model.twist(wheels, batch.cg, params)

    by = np.zeros((len(batch.dt), 3, len(columns)))
    for c, column in enumerate(columns):
        if column < k:
            by[:, :, c] = twist.d_params[:, :, column]
        elif column < k + 2:
            by[:, :, c] = np.einsum("nij,nj->ni", twist.d_wheels, by_offset if column == k else by_lag)

    poses, cov = np.zeros((len(batch.ends), 3)), np.zeros((len(batch.ends), 3, 3))
    d = np.zeros((len(batch.ends), 3, len(columns)))
    _integrate_all(batch.dt, twist.value, by, noise_vector(noise), batch.first[:-1] + batch.lead, batch.ends, batch.owner, poses, cov, d)
    if np.any(witness[2:] != 0.0) or bool(np.any(columns >= k + 2)):
        poses, d = _track(poses, d, witness[2:], columns - (k + 2))
    return poses, d, cov


def _track(poses: FloatArray, d: FloatArray, body_T_lidar: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
    """The same motions as a point elsewhere on the body sees them: lidar_T_body * motion * body_T_lidar."""
    seen = se2.compose(se2.compose(se2.inverse(body_T_lidar), poses), body_T_lidar)
    d = se2.adjoint(se2.inverse(body_T_lidar)) @ d
    by_mount = np.eye(3) - se2.adjoint(se2.inverse(seen))  # right perturbation of the mount
    c, s = np.cos(body_T_lidar[2]), np.sin(body_T_lidar[2])
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # offsets are given along the body's axes
    for i, column in enumerate(columns):
        if column >= 0:
            d[:, :, i] += (by_mount @ turned)[:, :, column]
    return seen, d


@numba.njit(cache=True)
def _integrate_all(
    dt: FloatArray,
    twist: FloatArray,
    by: FloatArray,
    noise: FloatArray,
    start: IntArray,
    ends: IntArray,
    owner: IntArray,
    poses: FloatArray,
    covs: FloatArray,
    ds: FloatArray,
) -> None:  # pragma: no cover
    """Integrate every maneuver from its start, noting pose, covariance and derivatives at each of its ends."""
    delta, cov, d = np.zeros(3), np.zeros((3, 3)), np.zeros((3, by.shape[2]))
    for i in range(ends.shape[0]):
        if i == 0 or owner[i] != owner[i - 1]:
            delta[:], cov[:], d[:] = 0.0, 0.0, 0.0
            a = start[owner[i]]
        else:
            a = ends[i - 1]
        b = ends[i]
        _integrate(dt[a:b], twist[a:b], by[a:b], noise, delta, cov, d)
        poses[i], covs[i], ds[i] = delta, cov, d


@numba.njit(cache=True)
def _delay(
    dt: FloatArray,
    wheels: FloatArray,
    first: IntArray,
    offset: float,
    lag: float,
    value: FloatArray,
    by_offset: FloatArray,
    by_lag: FloatArray,
) -> None:  # pragma: no cover
    """Low-pass the rates of each maneuver with time constant ``lag``, then read them ``offset`` later; with both derivatives.

    A rate counts for the middle of its interval, between which it is interpolated; at both ends of a maneuver it is held.
    """
    for w in range(first.shape[0] - 1):
        a, b = first[w], first[w + 1]
        smooth, smooth_by_lag, middle = np.empty((b - a, 2)), np.zeros((b - a, 2)), np.empty(b - a)
        smooth[0] = wheels[a]
        middle[0] = dt[a] / 2.0
        for i in range(1, b - a):
            h = (dt[a + i - 1] + dt[a + i]) / 2.0
            middle[i] = middle[i - 1] + h
            # Exact for rates that change linearly in between, and so smooth in the lag down to 0 and beyond.
            keep = np.exp(-h / lag) if lag > 0.0 else 0.0
            keep_by_lag = keep * h / (lag * lag) if lag > 0.0 else 0.0
            for j in range(2):
                slope = (wheels[a + i, j] - wheels[a + i - 1, j]) / h
                behind = smooth[i - 1, j] - wheels[a + i - 1, j] + lag * slope
                smooth[i, j] = wheels[a + i, j] - lag * slope + keep * behind
                smooth_by_lag[i, j] = -slope + keep * (smooth_by_lag[i - 1, j] + slope) + keep_by_lag * behind
        k = 0
        for i in range(b - a):
            t = middle[i] + offset
            if t <= middle[0] or b - a == 1:
                value[a + i], by_lag[a + i] = smooth[0], smooth_by_lag[0]
            elif t >= middle[b - a - 1]:
                value[a + i], by_lag[a + i] = smooth[b - a - 1], smooth_by_lag[b - a - 1]
            else:
                while middle[k + 1] <= t:
                    k += 1
                h = middle[k + 1] - middle[k]
                f = (t - middle[k]) / h
                for j in range(2):
                    value[a + i, j] = (1.0 - f) * smooth[k, j] + f * smooth[k + 1, j]
                    by_lag[a + i, j] = (1.0 - f) * smooth_by_lag[k, j] + f * smooth_by_lag[k + 1, j]
                    by_offset[a + i, j] = (smooth[k + 1, j] - smooth[k, j]) / h
