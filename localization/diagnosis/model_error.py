"""Whether the friction model describes a drive: its error by kind of motion, as a random effect beside all causes.

Where tyres follow another law than the model's, its error is the same whenever the wheels turn in the same proportion. As basis serve slips
of the body, as shares of the wheels' way, that depend on the direction of (q_l + q_r, q_r - q_l) alone, piecewise linear around the circle.
With y discrepancies, S signatures times the causes' prior sigmas, E the columns of that basis and R the noise that the richest explanation
leaves, all whitened by R, the drive is tested for tau > 0 by the likelihood ratio of (Kennedy & O'Hagan 2001, Bayesian calibration of
computer models)

    y ~ N(0, S S^T + tau^2 E E^T + R)
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.drive_predictor import DrivePredictor, Unmodelled, slip_columns
from localization.diagnosis.linearization import LEVELS, Linearization
from localization.diagnosis.noise import FLAT, estimate_drive_noise
from localization.messages import Message, message
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_RICHEST_SHARE = 0.05
"""Sigma of the slips while the noise is estimated, over the wheels' way: more than friction models are off."""
_MAX_LOG_ODDS = 7.0
"""Twice the log-likelihood that errors of the model may gain: odds of 33. Of 100 drives by the tyres of the model 4 have more, of 80 by
MuJoCo's contacts 74."""
_SLIP_SHARE = 0.01
"""Sigma of slips that a diagnosis tolerates where the drive shows that the contacts are not the model's, over the wheels' way: the median
of six healthy drives by MuJoCo's contacts. Larger ones are an effect without a name."""
CG_OFFSETS = ("cg_offset_x", "cg_offset_y")
"""Causes that move the centre of gravity, along x and y."""
_RESPONSE_CAUSES = (*CG_OFFSETS, "payload", "split_friction")
"""Causes that move the centre of rotation by the contacts' response to loads and grip."""
_RESPONSE_SHARE = 0.085
"""Error of their sizes where a healthy drive shows how contacts differ from the file's, over the size: it does not show how they respond to
loads. By how much the contact laws and slip stiffnesses that were measured on robots differ in that (`tests.studies.contact_response`); in
MuJoCo errors are 0.08 of the size in root mean square (`tests.studies.mujoco_intervals`)."""
_LEAST_LEVER_M = 0.05
_CG_SIGMA_SHARE, _MODEL_ERROR_SHARE = 0.25, 0.22
COULOMB_LOG_STIFFNESS = 2.0
"""Logarithm of the slip stiffness of contacts that hardly differ from Coulomb's friction over the robot file's. Tyres have 0.5 to 1.3 times
the nominal value; MuJoCo's contacts, which slide from 0.03 m/s on, 8 times and more: slopes about the file's stiffness do not predict how
they move."""
_SHARES = np.geomspace(1e-3, 0.2, 20)
"""Sigmas of the slips that are tried."""


class MissingSlips(NamedTuple):
    """Slips by kind of motion that the model does not have."""

    log_odds: float
    """Twice the log-likelihood that they gain on the drive; 0 where none shows."""
    share: float
    """Their most likely sigma, over the wheels' way."""

    @property
    def is_shown(self) -> bool:
        """Whether the drive shows that the model does not describe it."""
        return self.log_odds > _MAX_LOG_ODDS

    @property
    def notes(self) -> tuple[Message, ...]:
        """That the model does not describe the drive."""
        if not self.is_shown:
            return ()
        return (message("contacts.other", gain=0.5 * self.log_odds),)


def find_model_error(predictor: DrivePredictor, linearization: Linearization) -> MissingSlips:
    """Errors of the model on the drive of ``predictor``: of the contacts' stiffness, where the ``linearization`` has it, and slips by kind
    of motion, of which it has none; beside all causes at any plausible size."""
    y, S, N, E = _columns(predictor, linearization)
    S = S * linearization.problem.scale
    nothing = _twice_log_evidence(y, np.hstack([S, N[:, :LEVELS]]))
    shares = np.r_[0.0, _SHARES] if N.shape[1] > LEVELS else _SHARES
    gains = [_twice_log_evidence(y, np.hstack([S, N, share * E])) - nothing for share in shares]
    best = int(np.argmax(gains))
    return MissingSlips(gains[best], float(shares[best])) if gains[best] > 0.0 else MissingSlips(0.0, 0.0)


def explains_more_than_slips(predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...]) -> bool:
    """Whether each of the causes ``chosen`` explains the drive clearly better, beside the others, than slips of other contacts do in its
    place; causes that are not chosen are within their tolerances."""
    problem, indices = linearization.problem, np.arange(len(linearization.causes))
    y, S, N, E = _columns(predictor, linearization)

    def evidence(causes: tuple[int, ...], share: float) -> float:
        spreads = problem.scale * np.where(np.isin(indices, causes), 1.0, problem.tolerance)
        return _twice_log_evidence(y, np.hstack([S * spreads, N[:, :LEVELS], share * E]))

    by_all = evidence(chosen, 0.0) - _MAX_LOG_ODDS
    rests = [tuple(j for j in chosen if j != i) for i in chosen]
    return all(evidence(rest, _SLIP_SHARE) < by_all for rest in (chosen, *rests))


def _columns(predictor: DrivePredictor, linearization: Linearization) -> tuple[FloatArray, ...]:
    """Whitened discrepancies (n,), and columns (n, .) of causes of unit size, of nuisances and of slips, by the noise that the richest
    explanation leaves."""
    columns = np.where(np.isfinite(linearization.rows)[..., None], slip_columns(predictor), np.nan)
    nuisances = np.concatenate([linearization.nuisances, columns * (_RICHEST_SHARE / FLAT)], axis=-1)
    noise = estimate_drive_noise(predictor, linearization.linear, linearization.signatures, nuisances, linearization.causes)
    y = noise.whiten(linearization.linear).ravel()
    parts = linearization.signatures, linearization.nuisances * FLAT, columns
    return (y, *(noise.whiten(part).reshape(len(y), -1) for part in parts))


def unmodelled_by(predictor: DrivePredictor, error: MissingSlips) -> Unmodelled:
    """What the model's ``error`` adds to the nuisances of a diagnosis: slips as large as other contacts make, and no larger."""
    return dataclasses.replace(predictor.unmodelled, slip_share=_SLIP_SHARE if error.is_shown else 0.0)


def cg_prior_sigmas(robot: Robot) -> FloatArray:
    """(2,) sigma of where the centre of gravity of a loaded robot lies: a third of the way to an axle and to a side [m]."""
    return _CG_SIGMA_SHARE * np.array([robot.geometry.wheelbase_m, robot.geometry.track_width_m])


def cg_error_sigmas(robot: Robot) -> FloatArray:
    """(2,) error of the centre of gravity where the friction model does not describe the drive: 1/18 of wheelbase and track [m].

    By MuJoCo's contacts errors over the prior's sigma have a root mean square of 0.20 and 0.19 in x and y, by brush tyres 0.07 and 0.06
    (`tests.studies.weigh`).
    """
    return _MODEL_ERROR_SHARE * cg_prior_sigmas(robot)


def size_error(predictor: DrivePredictor, cause: Cause) -> float:
    """Error of a size where the friction model does not describe the drive, for loads: how far they move the centre of rotation depends on
    the contacts. In the cause's unit; 0 for others."""
    sigmas = cg_error_sigmas(predictor.drive.robot)
    if cause.id in CG_OFFSETS:
        return float(sigmas[CG_OFFSETS.index(cause.id)])
    arms = predictor.drive.payload_arms
    if cause.id != "payload" or not len(arms):
        return 0.0
    lever = np.mean(arms, axis=0)  # of a load m on a robot of mass M, the centre of gravity moves by m lever / (M + m)
    length = max(float(np.linalg.norm(lever)), _LEAST_LEVER_M)
    along = float(np.linalg.norm(lever / length * sigmas))
    return predictor.drive.robot.geometry.mass_kg * along / length


def response_error(predictor: DrivePredictor, cause: Cause, size: float) -> float:
    """Error of ``size`` beside a healthy drive, for loads and grip, in the cause's unit; 0 for others, and without such a drive."""
    return _RESPONSE_SHARE * abs(size) if predictor.has_baseline and cause.id in _RESPONSE_CAUSES else 0.0


def _twice_log_evidence(y: FloatArray, columns: FloatArray) -> float:
    """Twice the log evidence of ``y`` (n,) ~ N(0, A A^T + 1) with ``columns`` A (n, k), but for what does not depend on A."""
    factor = np.linalg.cholesky(columns.T @ columns + np.eye(columns.shape[1]))
    half = np.linalg.solve(factor, columns.T @ y)
    return float(half @ half) - 2.0 * float(np.log(np.diagonal(factor)).sum())
