"""Poses that a model predicts from the wheels of many maneuvers, with derivatives, as a motion reference would measure them.

Clock offset, lag and mount of the reference are not part of the motion model. They are parameters here, so that a fit does not push
them into the model's own.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from motion_models import se2
from motion_models.calibration.chords import chord_jacobians, chord_poses
from motion_models.calibration.maneuvers import Batch, IntArray
from motion_models.compiled import kernel
from motion_models.extended_model import in_series
from motion_models.motion import Twist
from motion_models.preintegration import integrate, noise_vector
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray
from motion_models.term_memory import SampleSeries

REFERENCE_PARAM_NAMES = ("wheel_time_offset", "wheel_lag", "lidar_offset_x", "lidar_offset_y", "lidar_yaw")
"""Nuisance parameters between wheels and motion reference, in the order of their vector (5,), all 0 by default:

wheel_time_offset [s]: how late the wheels' stamps are; the motion at t is in the wheels' samples at t + offset;
wheel_lag [s]: time constant with which the body follows the wheels (first order);
lidar_offset_x, lidar_offset_y [m], lidar_yaw [rad]: pose of the tracked point in the body frame, beyond that of its mount.
"""

REFERENCE_SCALES = (0.1, 0.1, 0.1, 0.1, 0.1)
"""Change of each that matters [s, s, m, m, rad], as `motion_models.param.Param.scale`."""


class Spans(NamedTuple):
    """Which intervals of a batch belong to each measured pose."""

    start: IntArray
    """(W,) first integrated interval of each maneuver."""
    ends: IntArray
    """(M,) index after the last interval before each measured pose."""
    owner: IntArray
    """(M,) maneuver of each measured pose."""


class Motions(NamedTuple):
    """Results of `_integrate_all`."""

    poses: FloatArray
    """(M, 3)"""
    covs: FloatArray
    """(M, 3, 3)"""
    derivatives: FloatArray
    """(M, 3, c)"""


class Smoothed(NamedTuple):
    """Low-passed wheel rates of one maneuver."""

    middle: FloatArray
    """(n,) middles of the intervals [s]."""
    value: FloatArray
    """(n, 2) [rad/s]"""
    by_lag: FloatArray
    """(n, 2) derivative by the lag."""


class Delayed(NamedTuple):
    """Wheel rates read at another time, with derivatives."""

    value: FloatArray
    """(n, 2) [rad/s]"""
    by_offset: FloatArray
    """(n, 2)"""
    by_lag: FloatArray
    """(n, 2)"""


class HasTwist(Protocol):
    """The part of a `MotionModel` that a prediction needs."""

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""


def predict(
    model: HasTwist,
    batch: Batch,
    params: FloatArray,
    reference_params: FloatArray,
    columns: IntArray,
    noise: WheelNoise,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Predict every measured pose: poses (M, 3), their derivatives (M, 3, c) and covariances (M, 3, 3).

    Of maneuvers with a `Maneuver.middle` it is the second chord relative to the first.
    ``reference_params`` (5,) as in `REFERENCE_PARAM_NAMES`; ``columns`` (c,) are the derivatives, indices into the model's k
    parameters followed by the reference's five. Derivatives and covariances are right perturbations; ``noise`` is the wheels' slip.
    """
    k = len(params)
    offset, lag = reference_params[0], reference_params[1]
    delayed = offset != 0.0 or lag != 0.0 or bool(np.isin([k, k + 1], columns).any())
    wheels, by_offset, by_lag = batch.wheels, batch.wheels, batch.wheels
    if delayed:
        wheels, by_offset, by_lag = (np.zeros_like(batch.wheels) for _ in range(3))
        for a, b in zip(batch.first[:-1], batch.first[1:], strict=True):
            smooth = _low_pass(batch.dt[a:b], batch.wheels[a:b], lag)
            _interpolate(smooth, offset, Delayed(wheels[a:b], by_offset[a:b], by_lag[a:b]))
    twist = in_series(model, series_of(batch)).twist(wheels, batch.cg, params)

    by = np.zeros((len(batch.dt), 3, len(columns)))
    for c, column in enumerate(columns):
        if column < k:
            by[:, :, c] = twist.d_params[:, :, column]
        elif column < k + 2:
            by[:, :, c] = np.einsum("nij,nj->ni", twist.d_wheels, by_offset if column == k else by_lag)

    chords = np.flatnonzero(batch.middle)
    order = np.argsort(np.r_[batch.ends, batch.middle[chords]], kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    owner = np.r_[batch.owner, batch.owner[chords]][order]
    ends = np.r_[batch.ends, batch.middle[chords]][order]
    poses, cov = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 3))
    d = np.zeros((len(ends), 3, len(columns)))
    spans = Spans(batch.first[:-1] + batch.lead, ends, owner)
    _integrate_all(batch.dt, twist.value, by, noise_vector(noise), spans, Motions(poses, cov, d))
    if np.any(reference_params[2:] != 0.0) or bool(np.any(columns >= k + 2)):
        poses, d = _track(poses, d, reference_params[2:], columns - (k + 2))
    end, middle = place[: len(batch.ends)], place[len(batch.ends) :]
    found = poses[end], d[end], cov[end]
    if len(chords):
        A = se2.adjoint(se2.inverse(reference_params[2:]))  # slip of the body, seen at the tracked point
        of_chords = _chords(Motions(poses, A @ cov @ A.T, d), middle, end[chords])
        for whole, part in zip(found, of_chords, strict=True):
            whole[chords] = part
    return found


def _chords(motions: Motions, middle: IntArray, end: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Second chords relative to the first: poses (C, 3), derivatives (C, 3, c) and covariances (C, 3, 3), of the ``motions`` from the start
    to the positions ``middle`` and ``end`` (C,)."""
    poses, P = motions.poses, motions.covs
    by_middle, by_end = chord_jacobians(poses[middle, :2], poses[end, :2])
    by_middle, by_end = by_middle @ se2.rotation(poses[middle, 2]), by_end @ se2.rotation(poses[end, 2])
    d = by_middle @ motions.derivatives[middle, :2] + by_end @ motions.derivatives[end, :2]
    # the end's perturbation is the middle's, moved there, and that of the way between: Cov(middle, end) = P_middle A^T
    A = se2.adjoint(se2.inverse(se2.between(poses[middle], poses[end])))
    cross = (P[middle] @ np.swapaxes(A, 1, 2))[:, :2, :2]
    mixed = by_middle @ cross @ np.swapaxes(by_end, 1, 2)
    own = [g @ P[i][:, :2, :2] @ np.swapaxes(g, 1, 2) for g, i in ((by_middle, middle), (by_end, end))]
    return chord_poses(poses[middle, :2], poses[end, :2]), d, own[0] + own[1] + mixed + np.swapaxes(mixed, 1, 2)


def series_of(batch: Batch) -> SampleSeries:
    """When the intervals of ``batch`` were driven; nothing accelerates at the first of a maneuver."""
    dt = batch.dt.copy()
    dt[batch.first[:-1]] = 0.0
    return SampleSeries(dt, batch.t)


def _track(poses: FloatArray, d: FloatArray, body_T_lidar: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
    """Motions of a point elsewhere on the body: lidar_T_body * motion * body_T_lidar."""
    of_lidar = se2.compose(se2.compose(se2.inverse(body_T_lidar), poses), body_T_lidar)
    d = se2.adjoint(se2.inverse(body_T_lidar)) @ d
    by_mount = np.eye(3) - se2.adjoint(se2.inverse(of_lidar))  # right perturbation of the mount
    c, s = np.cos(body_T_lidar[2]), np.sin(body_T_lidar[2])
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # offsets are given along the body's axes
    for i, column in enumerate(columns):
        if column >= 0:
            d[:, :, i] += (by_mount @ turned)[:, :, column]
    return of_lidar, d


@kernel
def _integrate_all(dt: FloatArray, twist: FloatArray, by: FloatArray, noise: FloatArray, spans: Spans, found: Motions) -> None:
    """Integrate every maneuver from its start; store pose, covariance and derivatives at each of its ends."""
    delta, cov, d = np.zeros(3), np.zeros((3, 3)), np.zeros((3, by.shape[2]))
    a = 0
    for i in range(spans.ends.shape[0]):
        if i == 0 or spans.owner[i] != spans.owner[i - 1]:
            delta[:], cov[:], d[:] = 0.0, 0.0, 0.0
            a = spans.start[spans.owner[i]]
        else:
            a = spans.ends[i - 1]
        b = spans.ends[i]
        integrate(dt[a:b], twist[a:b], by[a:b], noise, delta, cov, d)
        for j in range(3):  # by element: numba compiles an assignment of slices, with its messages, for seven seconds
            found.poses[i, j] = delta[j]
            for k in range(3):
                found.covs[i, j, k] = cov[j, k]
            for k in range(d.shape[1]):
                found.derivatives[i, j, k] = d[j, k]


@kernel
def _low_pass(dt: FloatArray, wheels: FloatArray, lag: float) -> Smoothed:
    """First-order low-pass of the rates (n, 2) of one maneuver. A rate counts for the middle of its interval.

    Exact for rates that change linearly in between, and so smooth in the lag down to 0 and beyond.
    """
    n = len(dt)
    value, by_lag, middle = np.empty((n, 2)), np.zeros((n, 2)), np.empty(n)
    value[0, 0], value[0, 1] = wheels[0, 0], wheels[0, 1]
    middle[0] = dt[0] / 2.0
    for i in range(1, n):
        h = (dt[i - 1] + dt[i]) / 2.0
        middle[i] = middle[i - 1] + h
        keep = np.exp(-h / lag) if lag > 0.0 else 0.0
        keep_by_lag = keep * h / (lag * lag) if lag > 0.0 else 0.0
        for j in range(2):
            slope = (wheels[i, j] - wheels[i - 1, j]) / h
            behind = value[i - 1, j] - wheels[i - 1, j] + lag * slope
            value[i, j] = wheels[i, j] - lag * slope + keep * behind
            by_lag[i, j] = -slope + keep * (by_lag[i - 1, j] + slope) + keep_by_lag * behind
    return Smoothed(middle, value, by_lag)


@kernel
def _interpolate(smooth: Smoothed, offset: float, found: Delayed) -> None:
    """Read the rates ``offset`` later, linearly between the middles of intervals; at both ends of a maneuver they are held."""
    middle, value, by_lag = smooth.middle, smooth.value, smooth.by_lag
    last = len(middle) - 1
    k = 0
    for i in range(last + 1):
        t = middle[i] + offset
        if t <= middle[0] or t >= middle[last]:
            end = 0 if t <= middle[0] else last
            for j in range(2):
                found.value[i, j], found.by_lag[i, j] = value[end, j], by_lag[end, j]
            continue
        while middle[k + 1] <= t:
            k += 1
        h = middle[k + 1] - middle[k]
        f = (t - middle[k]) / h
        for j in range(2):
            found.value[i, j] = (1.0 - f) * value[k, j] + f * value[k + 1, j]
            found.by_lag[i, j] = (1.0 - f) * by_lag[k, j] + f * by_lag[k + 1, j]
            found.by_offset[i, j] = (value[k + 1, j] - value[k, j]) / h
