"""How large discrepancies are that have no cause: estimated from the drive itself, after everything that any cause could explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from motion_models.calibration.maneuvers import Batch
from motion_models.se2 import FloatArray

_ROUNDS = 8
_MOTION = 3  # channels of the motion itself
_MIN_FREE_SHARE = 0.1  # of all numbers, however many causes there are
_CLAIMED_WINDOWS = 4.0  # number of windows that a motion reference's own covariance counts for
_MIN_SIGMA_OVER_CLAIMED = 0.5  # least sigma, as a share of the one that the motion reference gives
_CLIP = 9.0  # squares beyond this many variances are outliers, and count as this much


@dataclass(frozen=True)
class Noise:
    """Whitens rows of discrepancies, channel by channel: by size, by correlation between channels, and from window to window."""

    sigmas: FloatArray
    """(M, 6) standard deviation of each number; 1 where nothing was measured."""
    mixing: FloatArray
    """(6, 6) lower triangular: makes the channels of one window independent."""
    autocorrelation: FloatArray
    """(6,) share of the error of the window before that is still in the next."""
    follows: NDArray[np.bool_]
    """(M,) whether a window begins where the one before ended."""
    weights: FloatArray
    """(M,) below 1 for windows with outliers."""
    freedom: float = 1e6
    """Degrees of freedom that the noise is known with, in that channel of the motion which has fewest."""

    def whiten(self, rows: FloatArray) -> FloatArray:
        """(M, 6, ...) rows as independent numbers of unit variance; 0 where they are NaN."""
        shape = (slice(None), slice(None)) + (None,) * (rows.ndim - 2)
        scaled = np.nan_to_num(rows / self.sigmas[shape], nan=0.0)
        mixed = np.einsum("ij,nj...->ni...", self.mixing, scaled)
        before = np.zeros_like(mixed)
        before[1:] = mixed[:-1] * self.follows[1:].reshape(-1, *(1,) * (rows.ndim - 1))
        autocorrelation = self.autocorrelation.reshape(1, -1, *(1,) * (rows.ndim - 2))
        unmixed = (mixed - autocorrelation * before) / np.sqrt(1.0 - autocorrelation**2)
        return np.asarray(unmixed * self.weights.reshape(-1, *(1,) * (rows.ndim - 1)))


def variance_regressors(batch: Batch, wheel_radius: float, track: float) -> FloatArray:
    """(M, 3) what variances may grow with: constant, metres driven, radians by the wheels' difference."""
    driven, turned = np.zeros(len(batch.ends)), np.zeros(len(batch.ends))
    for i, (end, owner) in enumerate(zip(batch.ends, batch.owner, strict=True)):
        a = batch.first[owner] + batch.lead[owner]
        ways = batch.wheels[a:end] * batch.dt[a:end, None] * wheel_radius
        driven[i] = np.abs(ways.mean(axis=1)).sum()
        turned[i] = np.abs(ways[:, 1] - ways[:, 0]).sum() / track
    return np.column_stack([np.ones(len(driven)), driven, turned])


def given_noise(rows: FloatArray, sigmas: FloatArray, follows: NDArray[np.bool_]) -> Noise:
    """Independent numbers with the given ``sigmas`` (M, 6)."""
    return Noise(np.where(np.isfinite(rows), sigmas, 1.0), np.eye(rows.shape[1]), np.zeros(rows.shape[1]), follows, np.ones(len(rows)))


def estimate_noise(left: FloatArray, features: FloatArray, follows: NDArray[np.bool_], spent: FloatArray, claimed: FloatArray) -> Noise:
    """By ``left`` (M, 6), what the richest explanation leaves, which has used up ``spent`` (6,) degrees of freedom in each channel.

    The sigmas that the motion references give, ``claimed`` (M, 6), count as much as a few windows: short drives show little of their noise.
    The estimate may be smaller than they are, but not by much.
    """
    known = np.isfinite(left)
    counts = known.sum(axis=0)
    free = np.maximum(counts - spent, np.maximum(_MIN_FREE_SHARE * counts, 1.0))
    inflate = np.where(counts > 0, counts / free, 1.0)
    sigmas = np.ones_like(left)
    for channel in range(left.shape[1]):
        use = known[:, channel]
        if use.sum() < 4:
            continue
        squares = left[use, channel] ** 2 * inflate[channel]
        f = features[use]
        variance = np.full(len(squares), max(float(np.median(squares)) / 0.455, 1e-14))
        for _ in range(_ROUNDS):
            clipped = np.minimum(squares, _CLIP * variance)
            found = nnls(f / variance[:, None], clipped / variance)[0]
            variance = np.maximum(f @ found, 0.2 * float(np.median(variance)))
        given = claimed[use, channel]
        pooled = (free[channel] * variance + _CLAIMED_WINDOWS * given**2) / (free[channel] + _CLAIMED_WINDOWS)
        sigmas[use, channel] = np.maximum(np.sqrt(pooled), _MIN_SIGMA_OVER_CLAIMED * given)
    z = np.nan_to_num(left * np.sqrt(inflate) / sigmas, nan=0.0)
    lengths = np.abs(z).max(axis=1)
    weights = np.minimum(1.0, 4.0 / np.maximum(lengths, 1e-9))
    z = z * weights[:, None]
    mixing = _mixing(z, known)
    z = z @ mixing.T
    autocorrelation = np.zeros(left.shape[1])
    for channel in range(left.shape[1]):
        pairs = follows[1:] & known[1:, channel] & known[:-1, channel]
        if pairs.sum() > 20:
            a, b = z[1:, channel][pairs], z[:-1, channel][pairs]
            rho = float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-12))
            autocorrelation[channel] = min(max(rho - 1.0 / np.sqrt(pairs.sum()), 0.0), 0.8)
    motion = [float(free[c]) for c in range(_MOTION) if counts[c]]
    return Noise(sigmas, mixing, autocorrelation, follows, weights, min(motion, default=1.0) + _CLAIMED_WINDOWS)


def _mixing(z: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """Inverse Cholesky factor of the channels' correlation, shrunk to none where little is known."""
    n = known.astype(float).T @ known.astype(float)
    scale = np.sqrt(np.maximum(np.diag(z.T @ z) / np.maximum(np.diag(n), 1.0), 1e-12))
    scale = np.where(np.diag(n) > 0, scale, 1.0)
    correlation = (z.T @ z) / np.maximum(n, 1.0) / np.outer(scale, scale)
    shrink = n / (n + 20.0)
    correlation = np.where(np.eye(len(scale), dtype=bool), 1.0, correlation * shrink)
    values, vectors = np.linalg.eigh(correlation)
    correlation = (vectors * np.maximum(values, 0.05)) @ vectors.T
    return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)))
