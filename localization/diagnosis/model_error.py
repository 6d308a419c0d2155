"""Whether the friction model describes a drive: its error by kind of motion, as a random effect beside all causes.

Where tyres follow another law than the model's, its error is the same whenever the wheels turn in the same proportion. As basis serve slips
of the body, as shares of the wheels' way, that depend on the direction of (q_l + q_r, q_r - q_l) alone, piecewise linear around the circle.
With y discrepancies, S signatures times the causes' prior sigmas, E the columns of that basis and R the noise that the richest explanation
leaves, all whitened by R, the drive is tested for tau > 0 by the likelihood ratio of (Kennedy & O'Hagan 2001, Bayesian calibration of
computer models)

    y ~ N(0, S S^T + tau^2 E E^T + R)
"""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.linearization import Linearization
from localization.diagnosis.noise import estimate_drive_noise
from localization.diagnosis.prediction import DrivePredictor
from localization.diagnosis.verdict import moved_by
from motion_models.se2 import FloatArray

_KINDS = 8
"""Straight ahead and back, turns in place and arcs, to both sides."""
_RICHEST_SHARE = 0.05
"""Sigma of the slips while the noise is estimated, over the wheels' way: more than friction models are off."""
_SHARES = np.geomspace(1e-3, 0.2, 20)
"""Sigmas of the slips that are tried."""
_FLAT = 1e3
"""Sigma of nuisances, as in the estimate of the noise."""


def model_error_log_odds(predictor: DrivePredictor, linearization: Linearization) -> float:
    """Twice the log-likelihood that errors of the model by kind of motion gain on the drive of ``predictor``; 0 where none shows."""
    columns = _slip_columns(predictor, linearization.rows)
    nuisances = np.concatenate([linearization.nuisances, columns * (_RICHEST_SHARE / _FLAT)], axis=-1)
    noise = estimate_drive_noise(predictor, linearization.linear, linearization.signatures, nuisances, linearization.causes)
    y = noise.whiten(linearization.linear).ravel()
    known = np.concatenate([linearization.signatures * linearization.problem.scale, linearization.nuisances * _FLAT], axis=-1)
    S, E = noise.whiten(known).reshape(len(y), -1), noise.whiten(columns).reshape(len(y), -1)
    nothing = _twice_log_evidence(y, S)
    return max(0.0, *(_twice_log_evidence(y, np.hstack([S, share * E])) - nothing for share in _SHARES))


def _twice_log_evidence(y: FloatArray, columns: FloatArray) -> float:
    """Twice the log evidence of ``y`` (n,) ~ N(0, A A^T + 1) with ``columns`` A (n, k), but for what does not depend on A."""
    factor = np.linalg.cholesky(columns.T @ columns + np.eye(columns.shape[1]))
    half = np.linalg.solve(factor, columns.T @ y)
    return float(half @ half) - 2.0 * float(np.log(np.diagonal(factor)).sum())


def _slip_columns(predictor: DrivePredictor, rows: FloatArray) -> FloatArray:
    """(M, 6, 3 `_KINDS`) motion by a slip of each component of the twist in each kind of motion, as a share of the wheels' way."""
    batch, g = predictor.batch, predictor.drive.robot.geometry
    found = np.zeros((*rows.shape, 3 * _KINDS))
    for i, (end, owner) in enumerate(zip(batch.ends, batch.owner, strict=True)):
        inside = slice(batch.first[owner] + batch.lead[owner], end)
        ways = batch.wheels[inside] * batch.dt[inside, None] * g.wheel_radius_m
        direction = np.arctan2(ways[:, 1] - ways[:, 0], ways[:, 0] + ways[:, 1]) * (_KINDS / (2.0 * math.pi))
        apart = (direction[:, None] - np.arange(_KINDS) + 0.5 * _KINDS) % _KINDS - 0.5 * _KINDS
        slips = np.maximum(1.0 - np.abs(apart), 0.0) * np.sqrt(np.mean(ways**2, axis=1))[:, None]
        moved = moved_by(predictor.nominal_twist[inside], batch.dt[inside], slips)
        moved[:, 2] /= 0.5 * g.track_width_m
        found[i, :3] = moved.reshape(3, -1)
    return np.where(np.isfinite(rows)[..., None], found, np.nan)
