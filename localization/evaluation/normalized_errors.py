"""Errors measured in their own standard deviations, with a rule for covariances that are singular.

A direction of zero variance is a claim of certainty. Where the error is zero too, the direction has no information and is not counted
(one degree of freedom less); where it does not, the square is infinite, which is what such a claim is worth. A plain pseudo-inverse
would forgive it. Zero is what rounding leaves of it: each component is first scaled to its own variance, so that metres and radians do
not mix, then eigenvalues below 1e-12 of the largest are zero, and an error of three standard deviations of that (3e-6) keeps to the claim.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from localization.errors import EvaluationError
from motion_models.se2 import FloatArray

_SINGULAR = 1e-12


def normalize(errors: ArrayLike, covariances: ArrayLike) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Normalised squares (N,), degrees of freedom (N,) and errors brought to unit covariance (N, d), by this module's rule."""
    e, p = np.asarray(errors, dtype=float), np.asarray(covariances, dtype=float)
    if e.ndim != 2 or p.shape != (*e.shape, e.shape[-1]):
        raise EvaluationError(f"errors must have shape (N, d) and covariances (N, d, d), found {e.shape} and {p.shape}.")
    _check_finite(e, p)
    sigma, values, vectors = _spectrum(p)
    largest = values[:, -1:]
    if not np.all(is_covariance(p)):
        i = int(np.flatnonzero(~is_covariance(p))[0])
        raise EvaluationError(f"covariance number {i} is not symmetric or has a negative eigenvalue; it is no covariance:\n{p[i]}")
    free = (values > _SINGULAR * largest) & (largest > 0.0)
    along = np.einsum("nji,nj->ni", vectors, e / sigma)
    whitened = np.where(free, along / np.sqrt(np.where(free, values, 1.0)), 0.0)
    broken = (~free & (np.abs(along) > 3.0 * math.sqrt(_SINGULAR))).any(axis=1)
    squares = np.where(broken, np.inf, np.sum(whitened**2, axis=1))
    return squares, free.sum(axis=1), np.einsum("nij,nj->ni", vectors, whitened)


def _check_finite(e: FloatArray, p: FloatArray) -> None:
    if not len(p):
        return
    for name, array in (("error", e), ("covariance", p)):
        infinite = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        if infinite.size:
            raise EvaluationError(f"{name} number {infinite[0]} (and {infinite.size - 1} more) is not finite.")


def is_covariance(p: FloatArray) -> NDArray[np.bool_]:
    """(N,) True for matrices (N, d, d) that are symmetric and have no negative eigenvalue, but for rounding."""
    sigma, values, _ = _spectrum(p)
    lopsided = np.abs(p - np.swapaxes(p, 1, 2)) > 1e-6 * sigma[:, :, None] * sigma[:, None, :]
    return np.asarray(~lopsided.any(axis=(1, 2)) & (values >= -1e-9 * np.maximum(values[:, -1:], 0.0)).all(axis=1))


def _spectrum(p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations (N, d), 1 where the variance is zero, and eigenvalues, eigenvectors of the correlations (zero where it is)."""
    variance = np.diagonal(p, axis1=1, axis2=2)
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlations = p / (sigma[:, :, None] * sigma[:, None, :])
    values, vectors = np.linalg.eigh(0.5 * (correlations + np.swapaxes(correlations, 1, 2)))
    return sigma, values, vectors
