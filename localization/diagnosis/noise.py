"""Noise of a drive's discrepancies: its size, its correlation between channels and windows, and the whitening of rows by it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from localization.diagnosis.causes import STIFFNESS_EXPONENT
from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor
from motion_models.calibration.maneuvers import Batch, IntArray
from motion_models.robot import DIFF_DRIVE
from motion_models.se2 import FloatArray

FLAT = 1e3
"""Sigma of the size of a nuisance, over the unit of its column: what may have any size has a column of about one."""
_ROUNDS = 8
_MIN_FREE_SHARE = 0.1  # of all numbers, however many causes there are
_MIN_SIGMA_OVER_CLAIMED = 0.5  # least sigma, as a share of the one that the motion reference gives
_MEASURED_SPEED_M_PER_S = 0.05
_TURN_ERROR_OVER_LOG_SPEED = 0.065
"""How far a robot turns for the same way of the wheels, over the logarithm of their speed: DRIVE's Husky, by its gyro, turns 0.42 of the
geometry's angle where the sides' speeds differ from their mean by 0.4 to 0.8 m/s, and 0.49 where by 0.03 to 0.1 m/s; slower, there is
no data of turns in place."""
_SLIP_LEFT_SHARE = 0.03
"""Share of slips by kind of motion that these, linear between eight kinds, do not describe: 0.077 at most for a sine, by h^2 / 8 with h =
pi / 4; MuJoCo's Jackal leaves 0.0002 of the wheels' way of slips of 0.01."""
_FEWEST_FOR_NOISE = 4  # windows; of fewer the noise is the claimed one
_CLIP = 9.0  # squares beyond this many variances are outliers, and count as this much

_MOTION = 3  # channels of the motion itself
_FEWEST_PAIRS = 20  # windows that follow another; by fewer, no correlation from window to window is estimated
_SIGNIFICANT_SIGMAS = 2.0  # of a correlation, whose sigma without any is 1 / sqrt(n) (Bartlett 1946)
_MAX_AUTOCORRELATION = 0.8  # beyond it slow errors of the model, which have causes, would count as noise


@dataclass(frozen=True)
class Noise:
    """Whitens rows of discrepancies: by size, by correlation between the channels of a window, and from window to window."""

    sigmas: FloatArray
    """(M, 6) standard deviation of each number; 1 where nothing was measured."""
    known: NDArray[np.bool_]
    """(M, 6) what was measured."""
    correlation: FloatArray
    """(6, 6) covariance of the channels of one window, in their sigmas."""
    autocorrelation: FloatArray
    """(6,) share of the error of the window before that is still in the next."""
    follows: NDArray[np.bool_]
    """(M,) whether a window begins where the one before ended."""
    weights: FloatArray
    """(M,) below 1 for windows with outliers."""
    freedom: float = 1e6
    """Degrees of freedom of the noise estimate, in that channel of the motion which has fewest."""

    def whiten(self, rows: FloatArray) -> FloatArray:
        """(M, 6, ...) rows as independent numbers of unit variance, of an AR(1) process along the windows that follow each other; 0 where
        nothing was measured.

        A window without a predecessor has the process's whole variance, and is not divided by sqrt(1 - rho^2) (Prais & Winsten 1954).
        """
        columns = np.nan_to_num(rows, nan=0.0).reshape(*rows.shape[:2], -1) / self.sigmas[..., None]
        mixed = self._unmix(np.where(self.known[..., None], columns, 0.0))
        rho = np.zeros(self.sigmas.shape)
        rho[1:] = self.autocorrelation * (self.follows[1:, None] & self.known[1:] & self.known[:-1])
        before = np.roll(mixed, 1, axis=0)
        unmixed = (mixed - rho[..., None] * before) / np.sqrt(1.0 - np.square(rho))[..., None]
        return np.asarray(unmixed * self.weights[:, None, None]).reshape(rows.shape)

    def _unmix(self, scaled: FloatArray) -> FloatArray:
        """(M, 6, n) channels made independent of each other, by the Cholesky factor of the covariance of those that a window has."""
        found = scaled.copy()
        for windows, has, inverse_root in self._patterns:
            found[np.ix_(windows, has)] = np.einsum("ij,njk->nik", inverse_root, scaled[np.ix_(windows, has)])
        return found

    @cached_property
    def _patterns(self) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """Windows (w,) that have the same channels (c,), and the inverse (c, c) of the Cholesky factor of the covariance of these."""
        found = []
        for pattern in np.unique(self.known, axis=0):
            has = np.flatnonzero(pattern)
            windows = np.flatnonzero((self.known == pattern).all(axis=1))
            root = np.linalg.cholesky(self.correlation[np.ix_(has, has)])
            found.append((windows, has, np.linalg.inv(root)))
        return found


def variance_regressors(batch: Batch, wheel_radius: float, track: float) -> FloatArray:
    """(M, 3) what variances may grow with: constant, metres driven, radians by the wheels' difference."""
    driven, turned = np.zeros(len(batch.ends)), np.zeros(len(batch.ends))
    for i, inside in enumerate(batch.intervals()):
        ways = batch.wheels[inside] * batch.dt[inside, None] * wheel_radius
        driven[i] = np.abs(ways.mean(axis=1)).sum()
        turned[i] = np.abs(ways[:, 1] - ways[:, 0]).sum() / track
    return np.column_stack([np.ones(len(driven)), driven, turned])


def slow_turn_sigmas(predictor: DrivePredictor) -> FloatArray:
    """(M,) error of the predicted turn where wheels roll more slowly than the friction model was ever measured, and than the drive does
    else [rad]: by the model a robot turns as far by slow wheels as by fast ones, but contacts creep."""
    batch = predictor.batch
    speeds = predictor.drive.robot.geometry.wheel_radius_m * np.sqrt(np.mean(np.square(batch.wheels), axis=1))
    turned = np.abs(predictor.nominal_twist[:, 2]) * batch.dt
    order = np.argsort(speeds)
    middle = speeds[order][np.searchsorted(np.cumsum(turned[order]), 0.5 * turned.sum())] if turned.any() else 0.0
    slower = np.log(np.maximum(min(_MEASURED_SPEED_M_PER_S, middle) / np.maximum(speeds, 1e-9), 1.0))
    total = np.r_[0.0, np.cumsum(turned * slower)]
    return np.asarray(_TURN_ERROR_OVER_LOG_SPEED * (total[batch.ends] - total[batch.first[batch.owner] + batch.lead[batch.owner]]))


def slip_sigmas(predictor: DrivePredictor) -> FloatArray:
    """(M, 3) error of the predicted motion by contacts that are not the model's, beyond what slips by kind of motion describe [m, m, rad];
    0 where the drive shows no such contacts."""
    batch, g = predictor.batch, predictor.drive.robot.geometry
    rates = np.sqrt(np.mean(np.square(batch.wheels), axis=1)) * g.wheel_radius_m
    ways = np.array([rates[inside] @ batch.dt[inside] for inside in batch.intervals()])
    return np.asarray(_SLIP_LEFT_SHARE * predictor.unmodelled.slip_share * ways[:, None] * np.array([1.0, 1.0, 2.0 / g.track_width_m]))


def count_sigmas(predictor: DrivePredictor) -> FloatArray:
    """(3,) error of a window's predicted motion by the encoders' counts [m, m, rad]: a side's angle at either end is off by up to a step.

    A robot that skids turns by k = 1 / (1 + (wheelbase / track)^2) of the wheels' difference, by contacts alike in all directions.
    """
    g, skids = predictor.drive.robot.geometry, predictor.drive.robot.drive != DIFF_DRIVE
    k = 1.0 / (1.0 + (g.wheelbase_m / g.track_width_m) ** 2) if skids else 1.0
    side_m = g.wheel_radius_m * predictor.drive.encoder_step_rad * math.sqrt(2.0 / 12.0)  # of two ends, each evenly distributed in a step
    return np.array([side_m / math.sqrt(2.0), 0.0, math.sqrt(2.0) * side_m * k / g.track_width_m])


def reference_sigmas(predictor: DrivePredictor) -> FloatArray:
    """(M, 3) noise that a drive has to have: of the motion reference, of the encoders' counts, of turns by wheels so slow that the model
    was never measured, and of contacts that are not the model's."""
    given = np.sqrt(np.diagonal(predictor.batch.cov, axis1=1, axis2=2)) * np.array(predictor.baseline.noise_over_reference)
    given[:, 2] = np.hypot(given[:, 2], slow_turn_sigmas(predictor))
    return np.asarray(np.hypot(np.hypot(given, count_sigmas(predictor)), slip_sigmas(predictor)))


def given_noise(rows: FloatArray, sigmas: FloatArray, follows: NDArray[np.bool_]) -> Noise:
    """Independent numbers with the given ``sigmas`` (M, 6)."""
    known = np.isfinite(rows)
    channels = rows.shape[1]
    return Noise(np.where(known, sigmas, 1.0), known, np.eye(channels), np.zeros(channels), follows, np.ones(len(rows)))


def estimate_noise(
    left: FloatArray,
    features: FloatArray,
    follows: NDArray[np.bool_],
    spent: FloatArray,
    claimed: tuple[FloatArray, float],
    creep: FloatArray,
) -> Noise:
    """By ``left`` (M, 6), what the richest explanation leaves, which has used up ``spent`` (6,) degrees of freedom in each channel; errors
    of the model with the sigmas ``creep`` (M, 6) come on top.

    The sigmas ``claimed`` (M, 6), which the motion references give or a drive without faults had, count for so many windows: short drives
    show little of their noise. The estimate may be smaller than they are, but not by much.
    """
    claimed_sigmas, windows = claimed
    known = np.isfinite(left)
    counts = known.sum(axis=0)
    free = np.maximum(counts - spent, np.maximum(_MIN_FREE_SHARE * counts, 1.0))
    inflate = np.where(counts > 0, counts / free, 1.0)
    sigmas = np.ones_like(left)
    for channel in range(left.shape[1]):
        use = known[:, channel]
        if use.sum() < _FEWEST_FOR_NOISE:
            sigmas[use, channel] = claimed_sigmas[use, channel]
            continue
        squares, by_model = left[use, channel] ** 2 * inflate[channel], creep[use, channel] ** 2
        f = features[use]
        variance = np.full(len(squares), max(float(np.median(squares)) / 0.455, 1e-14))
        for _ in range(_ROUNDS):
            total = variance + by_model
            clipped = np.minimum(squares, _CLIP * total)
            found = nnls(f / total[:, None], (clipped - by_model) / total)[0]
            variance = np.maximum(f @ found, 0.2 * float(np.median(variance)))
        given = claimed_sigmas[use, channel]
        pooled = (free[channel] * variance + windows * given**2) / (free[channel] + windows)
        sigmas[use, channel] = np.hypot(np.maximum(np.sqrt(pooled), _MIN_SIGMA_OVER_CLAIMED * given), creep[use, channel])
    z = np.nan_to_num(left * np.sqrt(inflate) / sigmas, nan=0.0)
    lengths = np.abs(z).max(axis=1)
    weights = np.minimum(1.0, 4.0 / np.maximum(lengths, 1e-9))
    z = z * weights[:, None]
    motion = [float(free[c]) for c in range(_MOTION) if counts[c]]
    freedom = min(motion, default=1.0) + windows
    noise = Noise(sigmas, known, _correlation(z, known), np.zeros(left.shape[1]), follows, np.ones(len(left)), freedom)
    return dataclasses.replace(noise, autocorrelation=_autocorrelation(noise.whiten(z * sigmas), known, follows), weights=weights)


def _autocorrelation(z: FloatArray, known: NDArray[np.bool_], follows: NDArray[np.bool_]) -> FloatArray:
    """(6,) correlation of whitened numbers ``z`` (M, 6) with those of the window before; 0 where it is not significant or few windows
    follow each other.

    It is not made smaller by its own sigma: numbers whitened by a share that is too small have a variance below 1.
    """
    found = np.zeros(z.shape[1])
    for channel in range(z.shape[1]):
        pairs = follows[1:] & known[1:, channel] & known[:-1, channel]
        if pairs.sum() > _FEWEST_PAIRS:
            a, b = z[1:, channel][pairs], z[:-1, channel][pairs]
            rho = float(a @ b) / max(math.sqrt(float((a @ a) * (b @ b))), 1e-12)
            found[channel] = min(rho, _MAX_AUTOCORRELATION) if rho * math.sqrt(len(a)) > _SIGNIFICANT_SIGMAS else 0.0
    return found


def _correlation(z: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """(6, 6) covariance of the channels' noise ``z`` (M, 6) in its sigmas, with variances of 1, shrunk to the identity where few windows
    were measured.

    A channel with less noise than its sigma, which has a lower bound, shares less of it with the others: by its correlation alone, what the
    others measure would be taken for its own.
    """
    n = known.astype(float).T @ known.astype(float)
    scale = np.sqrt(np.maximum(np.diag(z.T @ z) / np.maximum(np.diag(n), 1.0), 1e-12))
    scale = np.where(np.diag(n) > 0, scale, 1.0)
    correlation = (z.T @ z) / np.maximum(n, 1.0) / np.outer(scale, scale)
    size = np.minimum(scale, 1.0)
    cov = np.where(np.eye(len(scale), dtype=bool), 1.0, correlation * n / (n + 20.0) * np.outer(size, size))
    values, vectors = np.linalg.eigh(cov)
    return np.asarray((vectors * np.maximum(values, 0.05)) @ vectors.T)


def reference_noise(predictor: DrivePredictor, linear: FloatArray, causes: tuple[Cause, ...]) -> Noise:
    """Noise of the discrepancies ``linear`` (M, 6) as the motion reference states it, with errors of the model."""
    return given_noise(linear, np.hypot(*_claimed_sigmas(predictor, causes)), _follows(predictor))


def _follows(predictor: DrivePredictor) -> NDArray[np.bool_]:
    """(M,) which windows begin where the one before has ended."""
    batch, drive = predictor.batch, predictor.drive
    if len(drive.spans_ns):
        return np.asarray(np.r_[False, drive.spans_ns[1:, 0] - drive.spans_ns[:-1, 1] < 10_000_000])
    return np.asarray(np.r_[False, batch.owner[1:] == batch.owner[:-1]])


def _claimed_sigmas(predictor: DrivePredictor, causes: tuple[Cause, ...]) -> tuple[FloatArray, FloatArray]:
    """(M, 6) each: sigmas that the motion reference states, or a drive without faults had, and those of errors of the model."""
    variances = np.diagonal(predictor.batch.cov, axis1=1, axis2=2)
    given = np.sqrt(np.where(np.isfinite(variances), variances, 1.0))
    sigmas = np.ones((len(given), len(CHANNELS)))
    sigmas[:, :3] = given * np.array(predictor.baseline.noise_over_reference)
    sigmas[:, 3] = np.hypot(given[:, 2], 1e-3)
    sigmas[:, 4:] = 0.05
    creep = np.zeros_like(sigmas)
    if not any(cause.id == STIFFNESS_EXPONENT for cause in causes):  # else slow turns are part of the model
        creep[:, CHANNELS.index("yaw")] = slow_turn_sigmas(predictor)
    creep[:, :_MOTION] = np.hypot(creep[:, :_MOTION], slip_sigmas(predictor))
    return sigmas, creep


def estimate_drive_noise(
    predictor: DrivePredictor, linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, causes: tuple[Cause, ...]
) -> Noise:
    """Estimated from what all causes together leave, in a few rounds, as sizes and noise depend on each other."""
    batch, g = predictor.batch, predictor.drive.robot.geometry
    features = variance_regressors(batch, g.wheel_radius_m, g.track_width_m)
    sigmas, creep = _claimed_sigmas(predictor, causes)
    noise = given_noise(linear, np.hypot(sigmas, creep), _follows(predictor))
    scale = np.array([e.plausible for e in causes])
    known = np.isfinite(linear)
    for _ in range(3):
        y = noise.whiten(linear).ravel()
        design = np.hstack([noise.whiten(signatures).reshape(len(y), -1) * scale, noise.whiten(nuisances).reshape(len(y), -1) * FLAT])
        inverse = np.linalg.inv(design.T @ design + np.eye(design.shape[1]))
        x = inverse @ (design.T @ y)
        spent = np.sum((design @ inverse) * design, axis=1).reshape(linear.shape).sum(axis=0)
        p = len(causes)
        left = linear - signatures @ (x[:p] * scale) - nuisances @ (x[p:] * FLAT)
        noise = estimate_noise(np.where(known, left, np.nan), features, noise.follows, spent, (sigmas, predictor.baseline.windows), creep)
    return noise
