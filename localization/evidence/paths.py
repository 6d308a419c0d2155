"""A reference's path against the path of an estimate: one rotation and shift a window, one scale, one lever arm, one delay.

In a window of some seconds, positions P_j (complex, x + i y) of a reference of the robot's motion are those of a point of the estimate,

    P_j = c_w + s exp(i phi_w) (p_j + exp(i theta_j) l) + n_j,        j in window w,

with the estimate's positions p_j and headings theta_j at the delayed time. c_w and phi_w are profiled by window, so that the frame of the
reference and the drift of the estimate do not count (Umeyama 1991, in the complex plane); the scale s and the lever arm l are common.
Headings psi_j differ from the estimate's by a constant in each window, which is phi_w where the tracked body points ahead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from localization.evidence.alternatives.alternative import OUTLIER, TEMPER, mixture
from localization.evidence.signals import position_noise
from localization.trajectory import Trajectory
from motion_models.se2 import FloatArray

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_WINDOWS_S = (10.0, 30.0, 60.0)
"""Length of a window [s]: the shortest in which the robot's way stands out of the reference's noise."""
_MIN_SNR = 4.0
"""Standard deviation of the positions in a window over their noise."""
_MIN_STEP_S, _MAX_SAMPLES = 0.25, 800
_MIN_OF_WINDOW = 6
_RELATIVE, _FLOOR_M, _FLOOR_RAD, _RELATIVE_TURN = 0.08, 0.01, 0.01, 0.1
"""Errors of an estimate's path in a window at level 1: part of the distance from its middle, floors, part of the turn from its middle."""
_LEVER_SIGMA_M = 0.5
"""Standard deviation of the place of an antenna or prism on a robot, in each axis."""
_YAW_SIGMA_RAD, _WINDOW_YAW_RAD = math.radians(5.0), math.radians(5.0)
"""Standard deviation of the heading of a tracked body, which is defined by hand, and of its measurement in a window, where wheels slide."""
_ITERATIONS = 4
_LAGS_AT_ONCE = 20_000
"""Samples at all delays that are computed together: they stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Track:
    """Samples of a reference, thinned, in windows."""

    t: FloatArray
    """(n,) [s] after the origin."""
    positions: ComplexArray
    """(n,) x + i y, in its own unit."""
    yaws: FloatArray | None
    """(n,) [rad], continuous."""
    window: IntArray
    """(n,) number of the window, from 0."""
    noise: float
    """Standard deviation of the positions' white noise, in their unit."""
    yaw_noise: float
    wide: float
    """Standard deviation of a coordinate in its window, in the positions' unit."""
    wide_yaw: float

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.window[-1]) + 1

    def mirrored(self) -> Track:
        """Path of an axis with the opposite sign."""
        return replace(self, positions=self.positions.conj(), yaws=None if self.yaws is None else -self.yaws)

    def turned_opposite(self) -> Track:
        """Path of headings that count clockwise."""
        return replace(self, yaws=None if self.yaws is None else -self.yaws)

    def inverted(self) -> Track:
        """Path of each pose's inverse."""
        assert self.yaws is not None
        return replace(self, positions=-self.positions * np.exp(-1j * self.yaws), yaws=-self.yaws)


@dataclass(frozen=True, eq=False)
class Path:
    """An estimate's poses."""

    t: FloatArray
    """(m,) [s] after the origin."""
    positions: ComplexArray
    yaws: FloatArray
    """(m,) [rad], continuous."""

    def at(self, t: FloatArray) -> tuple[ComplexArray, FloatArray, BoolArray]:
        """Positions, headings and whether they are known, at any times."""
        x, y = (np.interp(t, self.t, part) for part in (self.positions.real, self.positions.imag))
        return x + 1j * y, np.interp(t, self.t, self.yaws), (t >= self.t[0]) & (t <= self.t[-1])


@dataclass(frozen=True)
class Fit:
    """What a track and a path have in common at one delay."""

    evidence: float
    """Tempered log likelihood of the track, with the scale at its best."""
    share: float
    """Share of the samples that is independent, by what is left of the positions."""
    scale: float
    """Length of the track's ways over the path's."""
    lever: complex
    """Place of the tracked point in the body [m]."""
    yaw: float | None
    """Headings of the tracked body less those of the path [rad]; None where they show nothing."""
    aligned: float
    """Log likelihood of the headings' offsets with ``yaw``."""


def make_path(trajectory: Trajectory, origin_ns: int) -> Path:
    """Poses of ``trajectory``."""
    x, y, yaw = trajectory.poses.T
    return Path(np.asarray((trajectory.stamps_ns - origin_ns) * 1e-9, dtype=float), x + 1j * y, np.unwrap(yaw))


def make_track(t: FloatArray, positions: FloatArray, yaws: FloatArray | None) -> Track | None:
    """The track of samples at ``t`` (n,) in order; None where its noise hides all motion, or where there are too few samples."""
    if len(t) < 10:
        return None
    noise = position_noise(positions)
    step = max(_MIN_STEP_S, (t[-1] - t[0]) / _MAX_SAMPLES)
    rows = np.flatnonzero(np.diff(np.floor((t - t[0]) / step), prepend=-1.0) > 0.0)
    period = float(np.median(np.diff(t[rows])))
    yaw = None if yaws is None else np.unwrap(yaws)
    yaw_noise = 0.0 if yaw is None else position_noise(yaw[:, None])
    t, place = t[rows], positions[rows, 0] + 1j * positions[rows, 1]
    yaw = None if yaw is None else yaw[rows]
    for length in _WINDOWS_S:
        number = np.floor((t - t[0]) / max(length, 2 * _MIN_OF_WINDOW * period)).astype(int)
        window = np.unique(number, return_inverse=True)[1]
        spread = place - _window_means(place, window)[window]
        wide = math.sqrt(0.5 * float(np.mean(np.abs(spread) ** 2)) + 1e-12)
        if wide > _MIN_SNR * noise:
            wide_yaw = 1.0 if yaw is None else float(np.std(yaw - _window_means(yaw, window)[window])) + 0.05
            return Track(t, place, yaw, window, noise, yaw_noise, wide, wide_yaw)
    return None


def fit_curve(track: Track, path: Path, degree: int) -> Fit:
    """A motion of the track's own: in each window a curve of time of this ``degree``; 1 is straight on at a steady speed.

    Each coefficient beyond those of a path's fit has a price of one (Schwarz 1978, for the few independent samples of a window).
    """
    t = track.t - _window_means(track.t, track.window)[track.window]
    powers = np.stack([(t / max(float(t.max()), 1e-9)) ** k for k in range(degree + 1)], axis=1)

    def left(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rest = np.empty_like(values)
        for number in range(track.count):
            rows = track.window == number
            rest[rows] = values[rows] - powers[rows] @ np.linalg.lstsq(powers[rows], values[rows], rcond=None)[0]
        return rest, values - _window_means(values, track.window)[track.window]

    rest, off = left(track.positions)
    sigma = np.hypot(track.noise, _RELATIVE * np.abs(off) + 1e-3 * track.wide)
    evidence = mixture(np.r_[rest.real, rest.imag], np.r_[sigma, sigma], track.wide)
    p, _, known = path.at(track.t)
    window = np.unique(track.window[known], return_inverse=True)[1]
    scale = _spread(track.positions[known], window) / max(_spread(p[known], window), 1e-9) if known.any() else 1.0
    if track.yaws is not None:
        turned, of_yaw = left(track.yaws)
        sigma = np.sqrt(track.yaw_noise**2 + _FLOOR_RAD**2 + (_RELATIVE_TURN * of_yaw) ** 2)
        evidence += mixture(turned, sigma, track.wide_yaw)
    return Fit(evidence, _independent_share(rest), scale, 0.0, None, 0.0)


def curve_price(track: Track, degree: int) -> float:
    """Price of the coefficients of `fit_curve` beyond a rotation in each window, by coordinate."""
    return track.count * (2.0 * degree - 1.0 + (0 if track.yaws is None else degree))


def wide_evidence(track: Track) -> float:
    """Tempered log likelihood of a track of which nothing is known but its size."""
    return _wide_evidence(track, np.ones(len(track.t), bool))


def _spread(positions: ComplexArray, window: IntArray) -> float:
    return float(np.sqrt(np.mean(np.abs(positions - _window_means(positions, window)[window]) ** 2)))


def _independent_share(rest: ComplexArray) -> float:
    """Share of the samples ``rest`` (n,) that is independent: (1 - r) / (1 + r) with the correlation r of neighbours (Bayley & Hammersley
    1946), at most `TEMPER`. Errors of GPS and of an estimate's heading last for seconds."""
    r = float((rest[1:].conj() * rest[:-1]).real.sum()) / max(float((np.abs(rest) ** 2).sum()), 1e-12)
    return min(TEMPER, max((1.0 - r) / (1.0 + r), 0.01))


def fit(track: Track, path: Path, delay_s: float, rate: float = 0.0) -> Fit:
    """The best fit where the track's stamps are ahead by ``delay_s`` at its begin, and by ``rate`` of the time since more."""
    p, theta, known = path.at(track.t - delay_s - rate * (track.t - track.t[0]))
    enough = np.bincount(track.window[known], minlength=track.count)[track.window] >= _MIN_OF_WINDOW
    known &= enough
    if known.sum() < 2 * _MIN_OF_WINDOW:
        return Fit(_wide_evidence(track, np.ones(len(track.t), bool)), TEMPER, 1.0, 0.0, None, 0.0)
    window = np.unique(track.window[known], return_inverse=True)[1]
    measured, ahead = track.positions[known], np.exp(1j * theta[known])
    of_track, of_path, of_ahead = (values - _window_means(values, window)[window] for values in (measured, p[known], ahead))
    scale, lever, phase = _aligned(track, of_track, of_path, of_ahead, window)
    point = of_path + of_ahead * lever
    rest = of_track - scale * phase[window] * point
    sigma = np.sqrt(track.noise**2 + (scale * _FLOOR_M) ** 2 + (_RELATIVE * np.abs(scale * point)) ** 2)
    evidence = mixture(np.r_[rest.real, rest.imag], np.r_[sigma, sigma], track.wide)
    share = _independent_share(rest)
    evidence += _wide_evidence(track, ~known) - 0.5 * abs(lever / _LEVER_SIGMA_M) ** 2
    if track.yaws is None:
        return Fit(evidence, share, scale, lever, None, 0.0)
    turned, yaw, aligned = _of_headings(track, track.yaws[known] - theta[known], theta[known], window, phase, np.abs(scale * point))
    return Fit(evidence + turned, share, scale, lever, yaw, aligned)


def _of_headings(
    track: Track, difference: FloatArray, theta: FloatArray, window: IntArray, phase: ComplexArray, reach: FloatArray
) -> tuple[float, float | None, float]:
    """Evidence of the turns; the heading of the body and its log likelihood, by windows in which the robot has driven."""
    offset = _unit(_window_means(np.exp(1j * difference), window))
    rest = np.angle(np.exp(1j * difference) * offset[window].conj())
    sigma = np.sqrt(track.yaw_noise**2 + _FLOOR_RAD**2 + (_RELATIVE_TURN * (theta - _window_means(theta, window)[window])) ** 2)
    turned = mixture(rest, sigma, track.wide_yaw)
    driven = _window_means(reach, window) > max(track.wide, 3.0 * track.noise) / 2.0
    if not driven.any():
        return turned, None, 0.0
    off = (offset * phase.conj())[driven]
    yaw = float(np.angle(np.median(off.real) + 1j * np.median(off.imag)))
    inlier = -0.5 * (np.angle(off * np.exp(-1j * yaw)) / _WINDOW_YAW_RAD) ** 2 - math.log(math.sqrt(math.tau) * _WINDOW_YAW_RAD)
    aligned = float(np.logaddexp(math.log(1.0 - OUTLIER) + inlier, math.log(OUTLIER / math.tau)).sum())
    return turned, yaw, aligned


def yaw_log_prior(yaw: float) -> float:
    """Log density of the heading of a body that points ahead, as it is defined by hand."""
    return -0.5 * (yaw / _YAW_SIGMA_RAD) ** 2 - math.log(math.sqrt(math.tau) * _YAW_SIGMA_RAD)


def _aligned(
    track: Track, of_track: ComplexArray, of_path: ComplexArray, of_ahead: ComplexArray, window: IntArray
) -> tuple[float, complex, ComplexArray]:
    """Scale, lever arm and rotation (W,) of each window: weighted least squares by alternation."""
    lever, weight, scale = 0j, np.ones(len(of_track)), 1.0
    phase = np.ones(int(window[-1]) + 1, complex)
    for _ in range(_ITERATIONS):
        point = of_path + of_ahead * lever
        cross = _window_sums(weight * point.conj() * of_track, window)
        phase = _unit(cross)
        scale = max(float(np.abs(cross).sum()), 1e-12) / max(float((weight * np.abs(point) ** 2).sum()), 1e-12)
        back = of_track * phase[window].conj() / scale
        sigma = np.sqrt((track.noise / scale) ** 2 + _FLOOR_M**2 + (_RELATIVE * np.abs(point)) ** 2)
        weight = 1.0 / (sigma**2 * (1.0 + (np.abs(back - point) / (3.0 * sigma)) ** 2))
        information = TEMPER * float((weight * np.abs(of_ahead) ** 2).sum()) + _LEVER_SIGMA_M**-2
        lever = complex(TEMPER * (weight * of_ahead.conj() * (back - of_path)).sum() / information)
    return scale, lever, phase


def lags(track: Track, path: Path, candidates: FloatArray) -> FloatArray:
    """(k,) tempered log likelihood of a track by its path and turns at each of the delays ``candidates`` (k,), up to a constant: one noise
    level, no lever arm."""
    parts = np.array_split(candidates, math.ceil(len(candidates) * len(track.t) / _LAGS_AT_ONCE))
    return np.concatenate([_lags(track, path, part) for part in parts])


def _lags(track: Track, path: Path, candidates: FloatArray) -> FloatArray:
    starts = np.flatnonzero(np.diff(track.window, prepend=-1))
    size, n = np.diff(np.r_[starts, len(track.t)]), len(track.t)

    def sums(values: np.ndarray) -> np.ndarray:  # (k, W) by window, of (k, n)
        return np.add.reduceat(values, starts, axis=1)

    p, theta, known = path.at(track.t - candidates[:, None])
    weight = known.astype(float)
    count = np.maximum(sums(weight), 1.0)
    of_path = (p - np.repeat(sums(weight * p) / count, size, axis=1)) * weight
    of_track = (track.positions - np.repeat(sums(weight * track.positions) / count, size, axis=1)) * weight
    cross = np.abs(sums(of_path.conj() * of_track)).sum(axis=1)
    explained = cross**2 / np.maximum((np.abs(of_path) ** 2).sum(axis=1), 1e-9)
    unknown = (~known).sum(axis=1)
    rest = (np.abs(of_track) ** 2).sum(axis=1) - explained + 2.0 * track.wide**2 * unknown
    found = -TEMPER * n * np.log(rest / n + 2.0 * (track.noise**2 + (_RELATIVE * 0.3 * track.wide) ** 2))
    if track.yaws is None:
        return np.asarray(found)
    mean = np.abs(sums(weight * np.exp(1j * np.where(known, track.yaws - theta, 0.0))))
    off = 2.0 * (sums(weight) - mean).sum(axis=1) + track.wide_yaw**2 * unknown
    least = track.yaw_noise**2 + (_RELATIVE_TURN * 0.3 * track.wide_yaw) ** 2 + _FLOOR_RAD**2
    return np.asarray(found - 0.5 * TEMPER * n * np.log(off / n + least))


def _wide_evidence(track: Track, which: BoolArray) -> float:
    """Evidence of the samples ``which`` (n,), as a motion that is another's, over all levels of the noise alike."""
    spread = (track.positions - _window_means(track.positions, track.window)[track.window])[which]
    found = -0.5 * (np.abs(spread) / track.wide) ** 2 - 2.0 * math.log(track.wide)
    if track.yaws is None:
        return TEMPER * float(found.sum())
    turned = (track.yaws - _window_means(track.yaws, track.window)[track.window])[which]
    return TEMPER * float((found - 0.5 * (turned / track.wide_yaw) ** 2 - math.log(track.wide_yaw)).sum())


def _window_sums(values: np.ndarray, window: IntArray) -> np.ndarray:
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    return np.add.reduceat(values, starts)


def _window_means(values: np.ndarray, window: IntArray) -> np.ndarray:
    return np.asarray(_window_sums(values, window) / np.bincount(window))


def _unit(values: ComplexArray) -> ComplexArray:
    return np.asarray(values / np.maximum(np.abs(values), 1e-12))
