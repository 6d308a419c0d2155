"""Fit of any model's parameters to maneuvers: robust least squares, weighted by the wheels' noise, with a check of observability."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from motion_models import se2
from motion_models.base import MotionModel, scales
from motion_models.calibration.identifiability import Weakness, candidates, weaknesses
from motion_models.calibration.maneuvers import Batch, IntArray, Maneuver, make_batch
from motion_models.calibration.prediction import REFERENCE_PARAM_NAMES, REFERENCE_SCALES, predict
from motion_models.errors import CalibrationError, ModelError
from motion_models.extended_model import terms_of
from motion_models.online_calibration import RADIUS_NAMES
from motion_models.robot import Robot, WheelNoise
from motion_models.se2 import FloatArray

Loss = Literal["linear", "huber", "cauchy"]

_STEPS = 60
"""Most steps of Levenberg-Marquardt; fits of real logs take under 20."""
_LEAST_MOTION = (0.05, 0.05)  # m, rad; below, encoders' resolution and the reference's noise are as large
_CG_STEP = 0.1  # of wheelbase or track; how far a payload or an arm moves the CG in maneuvers that are recommended
_UNMEASURED = 1e6  # m^2 or rad^2
# Median length of vectors of 1, 2 and 3 unit normal numbers. Residual lengths are brought to the last before the knee, beyond
# which 10 % of them lie with Huber's.
_MEDIAN_LENGTH = np.array([0.6745, 1.1774, 1.5382])
KNEE: dict[Loss, float] = {"linear": np.inf, "huber": 2.5, "cauchy": 4.0}


@dataclass(frozen=True)
class Fit:
    """Fitted parameters, with their uncertainty."""

    model: MotionModel
    names: tuple[str, ...]
    """The c free parameters, of the model and of the motion reference."""
    params: FloatArray
    """(k,) all of the model's parameters, fitted or not."""
    reference_params: FloatArray
    """(5,) as `REFERENCE_PARAM_NAMES`; of an antenna its place in the body frame, `FitConfig.reference_at` included."""
    cov: FloatArray
    """(c, c) of the free parameters. With more than ten groups beyond c, the sandwich over groups (CR1), which holds for residuals that
    are correlated within a group and for a wrong noise model, and no sigma below that of independent errors; with fewer, the inverse
    information times the weighted mean square."""
    is_sandwich: bool
    scale: float
    """Robust size of the whitened residuals: how many times larger than by the noise model the errors are."""
    cost: float
    """Half the robust sum of squares over the squared scale, prior included."""
    weaknesses: tuple[Weakness, ...]
    """What the drive does not reveal; empty where all is well."""
    seconds: float
    """Duration of the driving that was fitted."""
    config: FitConfig

    @property
    def values(self) -> FloatArray:
        """(c,) the free parameters."""
        everything = np.concatenate([self.params, self.reference_params])
        return np.asarray(everything[indices(self.model, self.names)])

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation by name of each free parameter, and of those tied to one."""
        sigmas = {name: float(np.sqrt(self.cov[i, i])) for i, name in enumerate(self.names)}
        ties = {name: abs(factor) * sigmas[master] for name, (master, factor) in self.config.ties.items()}
        return sigmas | ties

    def residuals(self, maneuvers: Sequence[Maneuver]) -> FloatArray:
        """(M, 3) predicted poses relative to the measured ones [m, m, rad]; these maneuvers need not be those of the fit."""
        batch = make_batch(maneuvers)
        poses, _, _ = predict(self.model, batch, self.params, self.reference_params, np.empty(0, dtype=np.int64), self.config.noise)
        return se2.between(batch.measured, poses)

    def robot(self, robot: Robot) -> Robot:
        """``robot`` with the fitted parameters in its file's table, beside those that it already has.

        What was neither fitted nor in the file stays out, so that it follows the robot's geometry and not this robot's model.
        """
        fitted = {*self.names, *self.config.ties, *robot.models.get(self.model.name, {})}
        everything = dict(zip(self.model.param_names, (float(p) for p in self.params), strict=True))
        terms = tuple(
            dataclasses.replace(t, value=everything[t.name], sigma=self.sigmas.get(t.name, t.sigma)) for t in terms_of(self.model)
        )
        apart = {*RADIUS_NAMES, *(t.name for t in terms)}
        table = {name: value for name, value in everything.items() if name in fitted and name not in apart}
        found = dataclasses.replace(robot, models={**robot.models, self.model.name: table})
        if terms:
            found = dataclasses.replace(found, terms={**robot.terms, self.model.name: terms})
        found = _with_radius(found, 1.0 + everything.get("wheel_radius_scale", 0.0))
        return _with_difference(found, everything.get("wheel_radius_difference", 0.0))


def _with_radius(robot: Robot, scale: float) -> Robot:
    """``robot`` with wheels ``scale`` times as large; ratios to the old radius in the ICR model's table keep their meaning."""
    if scale == 1.0:
        return robot
    icr = {name: value / scale if name.startswith("alpha") else value for name, value in robot.models.get("icr", {}).items()}
    geometry = dataclasses.replace(robot.geometry, wheel_radius_m=robot.geometry.wheel_radius_m * scale)
    return dataclasses.replace(robot, geometry=geometry, models={**robot.models, **({"icr": icr} if icr else {})})


def _with_difference(robot: Robot, difference: float) -> Robot:
    """``robot`` with left wheels larger than right ones by ``difference`` of their mean, beside what its file has already."""
    if difference == 0.0:
        return robot
    left, right = robot.geometry.radius_multipliers * np.array([1.0 + difference / 2.0, 1.0 - difference / 2.0])
    geometry = dataclasses.replace(robot.geometry, left_wheel_radius_multiplier=float(left), right_wheel_radius_multiplier=float(right))
    return dataclasses.replace(robot, geometry=geometry)


def fit(
    model: MotionModel,
    maneuvers: Sequence[Maneuver],
    free: Sequence[str],
    config: FitConfig | None = None,
    start: FloatArray | None = None,
) -> Fit:
    """Least squares over the parameters ``free`` (of the model or `REFERENCE_PARAM_NAMES`), from ``start`` (k,) or the nominal.

    Levenberg-Marquardt on the exact derivatives, first over the first parameter alone, which brings the others near their minimum; robust
    weights by iterative reweighting, one weight per measured pose, after a
    plain fit has given the residuals' scale. Raises `CalibrationError` for names that do not exist, for too little motion, and
    (``config.strict``) for parameters that these maneuvers do not reveal, saying what to drive.

    >>> from motion_models import load_robot, make_model, read_rotation_table, rotations_as_maneuvers
    >>> robot = load_robot("vaultbot")
    >>> table = read_rotation_table("tests/data/vaultbot/rotation_grid.csv")
    >>> found = fit(make_model("friction", robot), rotations_as_maneuvers(table, robot), ("tracked_x", "warp"))
    >>> {name: (round(float(value), 3), round(found.sigmas[name], 3)) for name, value in zip(found.names, found.values)}
    {'tracked_x': (0.065, 0.001), 'warp': (0.143, 0.007)}
    """
    config = config or FitConfig()
    batch = make_batch(maneuvers)
    problem = Problem(model, batch, tuple(free), config, model.nominal if start is None else start)
    x, scale = problem.solve(problem.start, np.inf, 1.0, count=1), 1.0
    stages: tuple[Loss, ...] = ("linear",) if config.loss == "linear" and not config.prior_sigma else ("linear", config.loss, config.loss)
    for loss in stages:
        x = problem.solve(x, KNEE[loss] * scale, scale)
        scale = problem.scale(problem.residuals(x)[0])

    r, J = problem.residuals(x)
    weights = problem.weights(r, KNEE[config.loss] * scale)
    # Residuals smaller than by the noise model are luck or simulation: the noise model then counts.
    information = np.einsum("nri,nrj->ij", J, J) / max(scale, 1.0) ** 2
    rate = float(np.sqrt(np.mean(batch.wheels**2)))
    maneuvers_to_try = candidates(
        rate,
        batch.cg.mean(axis=0),
        float(np.median([batch.dt[span].sum() for span in batch.intervals()])),
        has_headings=not batch.middle.any(),
        cg_step_m=_CG_STEP * min(model.lengths.wheelbase, model.lengths.track_width),
    )
    has_positions = bool(np.isfinite(batch.cov[:, 0, 0]).any())
    unrevealed = weaknesses(problem.names, problem.scales, information, lambda b: problem.derive(b, x), maneuvers_to_try, has_positions)
    if unrevealed and config.strict:
        raise CalibrationError("\n".join(["this drive does not reveal every parameter:", *(w.text for w in unrevealed)]))

    cov, is_sandwich = _covariance(r, J, weights, problem.components, batch.group, problem.prior, problem.scales)
    return Fit(
        model=model,
        names=problem.names,
        params=problem.params(x),
        reference_params=problem.reference_params(x),
        cov=cov,
        is_sandwich=is_sandwich,
        scale=scale,
        cost=problem.cost(r, x, KNEE[config.loss] * scale, scale) / scale**2,
        weaknesses=unrevealed,
        seconds=float(batch.dt.sum()),
        config=config,
    )


def _covariance(
    r: FloatArray, J: FloatArray, weights: FloatArray, components: int, group: IntArray, prior: FloatArray, scales: FloatArray
) -> tuple[FloatArray, bool]:
    """(c, c), and whether it is the sandwich (see `Fit.cov`)."""
    c, groups = J.shape[2], int(group.max()) + 1
    spare = max(components - c, 1)
    dispersion = max(float(np.einsum("n,ni,ni->", weights, r, r)) / spare, 1e-18)
    information = np.einsum("n,nri,nrj->ij", weights, J, J) / dispersion + np.diag(prior)
    bread = np.linalg.pinv(information * np.outer(scales, scales), hermitian=True) * np.outer(scales, scales)
    if groups <= c + 10:
        return bread, False
    scores = np.zeros((groups, c))
    np.add.at(scores, group, np.einsum("n,nri,nr->ni", weights, J, r) / dispersion)
    correction = groups / (groups - 1) * (components - 1) / spare
    sandwich = correction * bread @ (scores.T @ scores) @ bread
    # Where few groups are informative, their scores may be small by luck; errors that are independent are the least that there are.
    luck = np.sqrt(np.maximum(np.diag(bread) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    return sandwich * np.outer(luck, luck), True


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
    scales: Mapping[str, float] = field(default_factory=dict)
    """Change of a parameter that matters, instead of the one that it declares: it is not revealed where its sigma is larger."""
    reference_at: tuple[float, float] = (0.0, 0.0)
    """Where in the body frame the motion reference measures positions without headings [m]; offsets that are fitted count from there."""
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
        indices(model, [*config.prior_sigma, *config.scales])
        self.all_columns = np.concatenate([self.columns, indices(model, tied)])
        self.combine = np.eye(len(names), len(names) + len(tied))
        for i, (master, factor) in enumerate(config.ties.values()):
            self.combine[names.index(master), len(names) + i] = factor
        self.everything = np.concatenate([start, [0.0, 0.0, *config.reference_at, 0.0]])
        self.start = self.everything[self.columns]
        self._last: tuple[FloatArray, tuple[FloatArray, FloatArray]] = np.zeros(0), (np.zeros(0), np.zeros(0))
        declared = dict(zip((*model.param_names, *REFERENCE_PARAM_NAMES), (*scales(model), *REFERENCE_SCALES), strict=True))
        self.scales = np.array([config.scales.get(name, declared[name]) for name in names])
        sigmas = np.array([config.prior_sigma.get(name, np.inf) for name in names])
        self.prior = 1.0 / sigmas**2
        measured = np.isfinite(np.diagonal(batch.cov, axis1=1, axis2=2))
        self.is_whole = measured.all(axis=1)
        """(M,) whether position and heading of a pose are measured."""
        self.components = int(measured.sum())
        """How many numbers were measured."""
        self.stretch = _MEDIAN_LENGTH[2] / _MEDIAN_LENGTH[np.maximum(measured.sum(axis=1), 1) - 1]
        if self.components < len(names):
            raise CalibrationError(f"{len(batch.ends)} measured poses do not determine {len(names)} parameters; drive more, or fit fewer.")

        full = self._full(self.start)
        k = len(start)
        # Whitened once, at the start: weights that follow the fit would favour parameters with much noise.
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
        # The diagonal is for maneuvers without motion and noise, and for what was not measured.
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
        """Whitened residuals (M, 3) and their derivatives (M, 3, c).

        Those of whole poses are exponential coordinates, log(measured^-1 predicted), in which a covariance of right perturbations holds for
        ways that bend: differences of positions are biased by half the covariance of heading and side (Barfoot and Furgale 2014,
        "Associating uncertainty with three-dimensional poses", sec. III). Without a measured heading there is no such logarithm.
        """
        if not np.array_equal(x, self._last[0]):  # a stage of the fit begins where the one before ended
            self._last = x, self._residuals(x)
        return self._last[1]

    def _residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        poses, d, _ = predict(self.model, self.batch, self.params(x), self.reference_params(x), self.all_columns, self.config.noise)
        off = se2.between(self.batch.measured, poses)
        d = d @ self.combine.T
        # d is in the frame of the predicted pose, the derivative of `off` in that of the measured one.
        c, s = np.cos(off[:, 2]), np.sin(off[:, 2])
        J = np.stack(
            [c[:, None] * d[:, 0] - s[:, None] * d[:, 1], s[:, None] * d[:, 0] + c[:, None] * d[:, 1], d[:, 2]],
            axis=1,
        )
        whole = self.is_whole
        off[whole] = se2.log(off[whole])
        J[whole] = se2.right_jacobian_inverse(off[whole]) @ d[whole]
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

    def solve(self, x: FloatArray, knee: float, scale: float, count: int | None = None) -> FloatArray:
        """Levenberg-Marquardt with Marquardt's scaling and Nielsen's damping, over the first ``count`` parameters; by default all."""
        moved = slice(count)
        r, J = self.residuals(x)
        cost, damping, grow = self.cost(r, x, knee, scale), 1e-4, 2.0
        prior = scale**2 * self.prior
        for _ in range(_STEPS):
            w = self.weights(r, knee)
            A = np.einsum("n,nri,nrj->ij", w, J, J) + np.diag(prior)
            g = np.einsum("n,nri,nr->i", w, J, r) + prior * (x - self.start)
            # No entry is zero: a parameter without information stays where it is.
            diagonal = np.maximum(np.diag(A), 1e-12 * np.max(np.diag(A) * self.scales**2) / self.scales**2 + 1e-300)
            step = np.zeros(len(x))
            step[moved] = -np.linalg.solve((A + np.diag(damping * diagonal))[moved, moved], g[moved])
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
