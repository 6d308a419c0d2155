"""Least squares over a model's and the motion reference's parameters: residuals, robust weights and the solver of `calibrate`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import Batch, IntArray
from motion_models.calibration.prediction import REFERENCE_PARAM_NAMES, predict
from motion_models.errors import CalibrationError, ModelError
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray

Loss = Literal["linear", "huber", "cauchy"]

_STEPS = 60
"""Of Levenberg-Marquardt; fits of real logs take under 20."""
_LEAST_MOTION = (0.05, 0.05)  # m, rad; below, encoders' resolution and the reference's noise are as large
_UNMEASURED = 1e6  # m^2 or rad^2
_SMALL = 0.1  # SI; what counts as large for a parameter whose nominal value is 0
# Median length of vectors of 1, 2 and 3 unit normal numbers. Residual lengths are brought to the last before the knee, beyond
# which 10 % of them lie with Huber's.
_MEDIAN_LENGTH = np.array([0.6745, 1.1774, 1.5382])
KNEE: dict[Loss, float] = {"linear": np.inf, "huber": 2.5, "cauchy": 4.0}


@dataclass(frozen=True)
class FitConfig:
    """How to fit; what to fit are the names given to `fit`."""

    loss: Loss = "huber"
    """How far residuals are weighed down beyond the knee: not at all, to a constant pull, or to none."""
    noise: WheelNoise = field(default_factory=WheelNoise)
    """Slip of the wheels, added to the measurements' own covariance: it sets how much a long maneuver counts against a short one."""
    ties: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    """Parameters that follow another: name -> (free name, factor), as wz_right -> (wz_left, -1) of a robot that is symmetric."""
    prior_sigma: Mapping[str, float] = field(default_factory=dict)
    """How far free parameters may be from where they start, as one sigma; those not named may be anywhere."""
    sizes: Mapping[str, float] = field(default_factory=dict)
    """What counts as large for a parameter, and so as not revealed when its sigma is larger; else its nominal value, or 0.1 (SI)."""
    strict: bool = True
    """Refuse to return numbers that the drive does not reveal."""


def indices(model: MotionModel, names: Sequence[str]) -> IntArray:
    """Where ``names`` are among the model's parameters followed by `REFERENCE_PARAM_NAMES`. Raises `CalibrationError`."""
    known = (*model.param_names, *REFERENCE_PARAM_NAMES)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise CalibrationError(f"{model.name} has no parameter {', '.join(unknown)}; it has {', '.join(known)}.")
    return np.array([known.index(name) for name in names], dtype=np.int64)


class Problem:
    """Residuals, derivatives and robust cost as functions of the free parameters x (c,)."""

    def __init__(self, model: MotionModel, batch: Batch, names: tuple[str, ...], config: FitConfig, start: FloatArray) -> None:
        """``start`` (k,): all of the model's parameters. Raises `CalibrationError` for bad names and too little motion."""
        self.model, self.batch, self.names, self.config = model, batch, names, config
        self.columns = indices(model, names)
        tied = list(config.ties)
        masters = [name for name, _ in config.ties.values()]
        if not names or len(set(names)) != len(names) or set(masters) - set(names) or set(tied) & set(names):
            raise CalibrationError("name each free parameter once; what is tied to another must not be free, and that other must be.")
        indices(model, [*config.prior_sigma, *config.sizes])
        self.all_columns = np.concatenate([self.columns, indices(model, tied)])
        self.combine = np.eye(len(names), len(names) + len(tied))
        for i, (master, factor) in enumerate(config.ties.values()):
            self.combine[names.index(master), len(names) + i] = factor
        self.everything = np.concatenate([start, np.zeros(len(REFERENCE_PARAM_NAMES))])
        self.start = self.everything[self.columns]
        nominal = dict(zip(model.param_names, np.abs(model.nominal), strict=True))
        self.sizes = np.array([config.sizes.get(name) or nominal.get(name) or _SMALL for name in names])
        sigmas = np.array([config.prior_sigma.get(name, np.inf) for name in names])
        self.prior = 1.0 / sigmas**2
        measured = np.isfinite(np.diagonal(batch.cov, axis1=1, axis2=2))
        self.components = int(measured.sum())
        """How many numbers were measured."""
        self.stretch = _MEDIAN_LENGTH[2] / _MEDIAN_LENGTH[np.maximum(measured.sum(axis=1), 1) - 1]
        if self.components < len(names):
            raise CalibrationError(f"{len(batch.ends)} measured poses do not determine {len(names)} parameters; drive more, or fit fewer.")

        full = self._full(self.start)
        k = len(start)
        # Whitened once, at the start: weights that follow the fit would reward parameters that call everything noise.
        _, _, slip = predict(model, batch, full[:k], full[k:], np.empty(0, dtype=np.int64), config.noise)
        twist = model.twist(batch.wheels, batch.cg, full[:k]).value
        driven = float(np.sum(np.hypot(twist[:, 0], twist[:, 1]) * batch.dt))
        turned = float(np.sum(np.abs(twist[:, 2]) * batch.dt))
        if driven < _LEAST_MOTION[0] and turned < _LEAST_MOTION[1]:
            raise CalibrationError(
                f"too little motion to fit: the wheels drove {driven:.3g} m and turned {turned:.3g} rad in {batch.dt.sum():.3g} s; "
                "drive a few metres and some turns."
            )
        both = measured[:, :, None] & measured[:, None, :]
        # The last: a maneuver without motion and without noise, and what was not measured.
        noise = np.where(both, slip + np.where(both, batch.cov, 0.0), 0.0) + np.eye(3) * np.where(measured, 1e-12, 1.0)[:, :, None]
        self.whiten = np.where(both, np.linalg.inv(np.linalg.cholesky(noise)), 0.0)

    def _full(self, x: FloatArray) -> FloatArray:
        full = self.everything.copy()
        full[self.all_columns] = x @ self.combine
        return full

    def params(self, x: FloatArray) -> FloatArray:
        """(k,) all of the model's parameters at ``x`` (c,)."""
        return self._full(x)[: -len(REFERENCE_PARAM_NAMES)]

    def reference_params(self, x: FloatArray) -> FloatArray:
        """(5,) parameters of the motion reference at ``x`` (c,)."""
        return self._full(x)[-len(REFERENCE_PARAM_NAMES) :]

    def derive(self, batch: Batch, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `identifiability.Derive`."""
        _, d, cov = predict(self.model, batch, self.params(x), self.reference_params(x), self.all_columns, self.config.noise)
        usual = self.batch.cov.mean(axis=0)
        return d @ self.combine.T, cov + np.where(np.isfinite(usual), usual, _UNMEASURED)

    def residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (M, 3) and their derivatives (M, 3, c)."""
        poses, d, _ = predict(self.model, self.batch, self.params(x), self.reference_params(x), self.all_columns, self.config.noise)
        off = se2.between(self.batch.measured, poses)
        # `off` moves by its own rotation of what its end moves.
        c, s = np.cos(off[:, 2]), np.sin(off[:, 2])
        d = d @ self.combine.T
        J = np.stack(
            [c[:, None] * d[:, 0] - s[:, None] * d[:, 1], s[:, None] * d[:, 0] + c[:, None] * d[:, 1], d[:, 2]],
            axis=1,
        )
        return np.einsum("nij,nj->ni", self.whiten, off), self.whiten @ J

    def cost(self, r: FloatArray, x: FloatArray, knee: float, scale: float) -> float:
        """Half the robust sum of squares, with the prior's; residuals are ``scale`` times what whitening made 1."""
        length = self.lengths(r)
        prior = scale**2 * float(np.sum(self.prior * (x - self.start) ** 2))
        if not np.isfinite(knee):
            robust = length**2
        elif self.config.loss == "huber":
            robust = np.where(length <= knee, length**2, knee * (2.0 * length - knee))
        else:
            robust = knee**2 * np.log1p((length / knee) ** 2)
        return 0.5 * (float(np.sum(robust / self.stretch**2)) + prior)

    def lengths(self, r: FloatArray) -> FloatArray:
        """(M,) lengths of the whitened residuals (M, 3), as if all three components of each were measured."""
        return np.asarray(np.linalg.norm(r, axis=1) * self.stretch)

    def weights(self, r: FloatArray, knee: float) -> FloatArray:
        """(M,) how much each measured pose counts."""
        length = self.lengths(r)
        if not np.isfinite(knee):
            return np.ones(len(r))
        if self.config.loss == "cauchy":
            return np.asarray(1.0 / (1.0 + (length / knee) ** 2))
        return np.asarray(knee / np.maximum(length, knee))

    def scale(self, r: FloatArray) -> float:
        """Robust size of the whitened residuals, corrected for the parameters that were fitted to them; never 0."""
        spare = max(self.components - len(self.names), 1)
        size = float(np.median(self.lengths(r))) / float(_MEDIAN_LENGTH[2])
        return max(size * math.sqrt(self.components / spare), 1e-9)

    def solve(self, x: FloatArray, knee: float, scale: float) -> FloatArray:
        """Levenberg-Marquardt with Marquardt's scaling and Nielsen's damping."""
        r, J = self.residuals(x)
        cost, damping, grow = self.cost(r, x, knee, scale), 1e-4, 2.0
        prior = scale**2 * self.prior
        for _ in range(_STEPS):
            w = self.weights(r, knee)
            A = np.einsum("n,nri,nrj->ij", w, J, J) + np.diag(prior)
            g = np.einsum("n,nri,nr->i", w, J, r) + prior * (x - self.start)
            diagonal = np.maximum(np.diag(A), 1e-12 * np.max(np.diag(A)) + 1e-300)
            step = -np.linalg.solve(A + np.diag(damping * diagonal), g)
            tried = x + step
            try:
                r_tried, J_tried = self.residuals(tried)
                cost_tried = self.cost(r_tried, tried, knee, scale)
            except ModelError:  # a step to where the model has no motion
                r_tried, J_tried, cost_tried = r, J, np.inf
            cost_tried = cost_tried if np.isfinite(cost_tried) else np.inf
            gained = cost - cost_tried
            expected = 0.5 * float(step @ (damping * diagonal * step - g))
            if gained > 0.0:
                x, r, J, cost = tried, r_tried, J_tried, cost_tried
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gained / max(expected, 1e-300) - 1.0) ** 3)
                grow = 2.0
            else:
                damping *= grow
                grow *= 2.0
            if expected <= 1e-10 * cost + 1e-20 or damping > 1e12:
                break
        return x
