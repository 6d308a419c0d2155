"""Fit of any model's parameters to maneuvers: robust, weighted by the wheels' noise, with a check of observability."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.identifiability import Weakness, weaknesses
from motion_models.calibration.least_squares import KNEE, FitConfig, Loss, Problem, indices
from motion_models.calibration.maneuvers import IntArray, Maneuver, make_batch
from motion_models.calibration.prediction import predict
from motion_models.corrected import RADIUS_NAMES
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Fit:
    """Fitted parameters, with their uncertainty."""

    model: MotionModel
    names: tuple[str, ...]
    """The c free parameters, of the model and of the motion reference."""
    params: FloatArray
    """(k,) all of the model's parameters, fitted or not."""
    reference_params: FloatArray
    """(5,) as `REFERENCE_PARAM_NAMES`."""
    cov: FloatArray
    """(c, c) of the free parameters. With more than ten groups beyond c, the sandwich over groups (CR1), which stands residuals that
    are correlated within a group and a noise model that is wrong; with fewer, the inverse information times the weighted mean square."""
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
        table = {name: value for name, value in everything.items() if name in fitted and name not in RADIUS_NAMES}
        found = dataclasses.replace(robot, models={**robot.models, self.model.name: table})
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

    Levenberg-Marquardt on the exact derivatives; robust weights by iterative reweighting, one weight per measured pose, after a
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
    x, scale = problem.start, 1.0
    stages: tuple[Loss, ...] = ("linear",) if config.loss == "linear" and not config.prior_sigma else ("linear", config.loss, config.loss)
    for loss in stages:
        x = problem.solve(x, KNEE[loss] * scale, scale)
        scale = problem.scale(problem.residuals(x)[0])

    r, J = problem.residuals(x)
    weights = problem.weights(r, KNEE[config.loss] * scale)
    # Residuals smaller than by the noise model are luck or simulation: the noise model then counts.
    information = np.einsum("nri,nrj->ij", J, J) / max(scale, 1.0) ** 2
    rate = float(np.sqrt(np.mean(batch.wheels**2)))
    unrevealed = weaknesses(problem.names, problem.sizes, information, lambda b: problem.derive(b, x), rate, batch.cg.mean(axis=0))
    if unrevealed and config.strict:
        raise CalibrationError("\n".join(["this drive does not reveal every parameter:", *(w.text for w in unrevealed)]))

    cov, is_sandwich = _covariance(r, J, weights, problem.components, batch.group, problem.prior)
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
    r: FloatArray, J: FloatArray, weights: FloatArray, components: int, group: IntArray, prior: FloatArray
) -> tuple[FloatArray, bool]:
    """(c, c), and whether it is the sandwich (see `Fit.cov`)."""
    c, groups = J.shape[2], int(group.max()) + 1
    spare = max(components - c, 1)
    dispersion = max(float(np.einsum("n,ni,ni->", weights, r, r)) / spare, 1e-18)
    bread = np.linalg.pinv(np.einsum("n,nri,nrj->ij", weights, J, J) / dispersion + np.diag(prior), hermitian=True)
    if groups <= c + 10:
        return bread, False
    scores = np.zeros((groups, c))
    np.add.at(scores, group, np.einsum("n,nri,nr->ni", weights, J, r) / dispersion)
    correction = groups / (groups - 1) * (components - 1) / spare
    return correction * bread @ (scores.T @ scores) @ bread, True
