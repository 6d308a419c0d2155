"""Maneuvers: short drives of which the wheels tell one story and another witness (LiDAR, reference) the measured other.

Calibration compares the two. What lies between the witnesses themselves (clocks, lags, where the LiDAR sits) is not the motion model's
business, and is described here too, so that a fit does not push it into the model's parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from motion_models import se2
from motion_models.base import MotionModel
from motion_models.errors import CalibrationError
from motion_models.integrate import _integrate, noise_vector
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]

WITNESS_NAMES = ("wheel_time_offset", "wheel_lag", "lidar_offset_x", "lidar_offset_y", "lidar_yaw")
"""Nuisance terms between the witnesses, in the order of their vector (5,), all 0 by default:

wheel_time_offset [s]: how late the wheels' stamps are; the motion at t is in the wheels' samples at t + offset;
wheel_lag [s]: time constant with which the body follows the wheels (first order);
lidar_offset_x, lidar_offset_y [m], lidar_yaw [rad]: pose of the tracked point in the body frame, as far as it is not known already.
"""


@dataclass(frozen=True)
class Maneuver:
    """One short drive. Its start is the end of interval ``lead``; poses are seen from the body's pose there."""

    dt: FloatArray
    """(n,) lengths of the intervals [s]."""
    wheels: FloatArray
    """(n, 2) left and right wheel rate in each interval [rad/s]."""
    measured: FloatArray
    """(m, 3) measured poses relative to the start [m, m, rad]."""
    ends: IntArray
    """(m,) number of intervals driven since the start when each pose was measured, increasing."""
    cg: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) or (n, 2) centre of gravity [m]."""
    cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) or (m, 3, 3) covariance of the measured poses (right perturbation); inf on the diagonal for what is not measured, as
    the position of a gyro."""
    group: str = ""
    """Maneuvers of one group share their errors (same step, same place): they are resampled and held out together."""
    lead: int = 0
    """First intervals that lie before the start; they feed a lag and a time offset, and are not integrated."""


@dataclass(frozen=True)
class Batch:
    """Many maneuvers end to end, as the compiled loops want them."""

    dt: FloatArray
    """(N,)"""
    wheels: FloatArray
    """(N, 2)"""
    cg: FloatArray
    """(N, 2)"""
    first: IntArray
    """(W + 1,) where each maneuver's intervals begin; the last is N."""
    lead: IntArray
    """(W,)"""
    ends: IntArray
    """(M,) index after the last interval before each measured pose."""
    owner: IntArray
    """(M,) maneuver of each measured pose."""
    measured: FloatArray
    """(M, 3)"""
    cov: FloatArray
    """(M, 3, 3)"""
    group: IntArray
    """(M,) index of the group of each measured pose."""
    groups: tuple[str, ...]
    """Names of the groups, in order of their first maneuver."""


def make_batch(maneuvers: Sequence[Maneuver]) -> Batch:
    """Check and join ``maneuvers``. Raises `CalibrationError`, naming the maneuver that cannot be used and why."""
    if not maneuvers:
        raise CalibrationError("nothing to calibrate on: there is no maneuver.")
    for i, m in enumerate(maneuvers):
        _check(m, i)
    lengths = np.array([len(m.dt) for m in maneuvers])
    first = np.concatenate([[0], np.cumsum(lengths)])
    lead = np.array([m.lead for m in maneuvers])
    counts = [len(m.ends) for m in maneuvers]
    owner = np.repeat(np.arange(len(maneuvers)), counts)
    names = {m.group: i for i, m in reversed(list(enumerate(maneuvers)))}
    groups = tuple(sorted(names, key=lambda name: names[name]))
    index = {name: i for i, name in enumerate(groups)}
    batch = Batch(
        dt=np.concatenate([m.dt for m in maneuvers]),
        wheels=np.ascontiguousarray(np.concatenate([m.wheels for m in maneuvers])),
        cg=np.ascontiguousarray(np.concatenate([np.broadcast_to(m.cg, m.wheels.shape) for m in maneuvers])),
        first=first,
        lead=lead,
        ends=np.concatenate([m.ends for m in maneuvers]) + (first[:-1] + lead)[owner],
        owner=owner,
        measured=np.concatenate([m.measured for m in maneuvers]),
        cov=np.concatenate([np.broadcast_to(m.cov, (n, 3, 3)) for m, n in zip(maneuvers, counts, strict=True)]),
        group=np.array([index[m.group] for m in maneuvers])[owner],
        groups=groups,
    )
    interval_owner = np.repeat(np.arange(len(maneuvers)), lengths)
    for what, array, whose in (
        ("dt", batch.dt, interval_owner),
        ("wheels", batch.wheels, interval_owner),
        ("cg", batch.cg, interval_owner),
        ("measured", batch.measured, owner),
        ("cov", np.where(np.isposinf(batch.cov) & np.eye(3, dtype=bool), 1.0, batch.cov), owner),
    ):
        bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if bad.any():
            i = int(whose[np.argmax(bad)])
            raise CalibrationError(f"{_called(maneuvers[i], i)}: {what} has values that are not finite; leave such samples out.")
    if batch.dt.min() <= 0.0:
        i = int(interval_owner[np.argmin(batch.dt)])
        raise CalibrationError(f"{_called(maneuvers[i], i)}: an interval is {batch.dt.min():g} s long; all must be positive.")
    return batch


def _called(m: Maneuver, index: int) -> str:
    return f"maneuver {index}" + (f" (group '{m.group}')" if m.group else "")


def _check(m: Maneuver, index: int) -> None:
    """Refuse shapes that do not fit together."""
    n, poses = len(m.dt), len(m.ends)
    shapes: list[tuple[str, NDArray[Any], list[tuple[int, ...]]]] = [
        ("dt", m.dt, [(n,)]),
        ("wheels", m.wheels, [(n, 2)]),
        ("cg", m.cg, [(2,), (n, 2)]),
        ("measured", m.measured, [(poses, 3)]),
        ("cov", m.cov, [(3, 3), (poses, 3, 3)]),
    ]
    for what, array, allowed in shapes:
        if array.shape not in allowed:
            wanted = " or ".join(str(shape) for shape in allowed)
            raise CalibrationError(
                f"{_called(m, index)}: {what} has shape {array.shape}; with {n} intervals and {poses} poses it must be {wanted}."
            )
    ends = m.ends.tolist()
    if not ends or not 0 <= m.lead < n or ends != sorted(set(ends)) or ends[0] < 1 or ends[-1] > n - m.lead:
        raise CalibrationError(
            f"{_called(m, index)}: 'ends' must increase from at least 1 to at most the {n - m.lead} intervals after the start."
        )


def predict(
    model: MotionModel,
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
