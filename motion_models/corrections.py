"""Which directions in a model's parameters an estimator may correct on the way, and how far they may be off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from motion_models.base import MotionModel
from motion_models.errors import ModelError
from motion_models.se2 import FloatArray

Form = Literal["none", "constant", "cg_field"]
FORMS: tuple[Form, ...] = get_args(Form)

# How differently robots of one type turn on different floors and with other loads: relative for what scales a turn (Clearpath's own
# multipliers for one Husky range from 1.5 to 1.9; terrains differ by a quarter), absolute [m] for where it turns about.
_TURNING, _CENTRE_X, _CENTRE_Y = 0.15, 0.05, 0.03
_FORGOTTEN_AFTER_S = 3600.0
_WARP = 0.15  # VaultBot's chassis, as its rotations show it, moves 13 % of m g / 4 to two opposite wheels

# The rotations of Ebersole 2016, Ch. 4, to which the coefficients of `SkidSteer` were fitted: where the CG was, and the scatter about the
# fits of k, x_CR and y_CR (`regressions.skid_steer_fit`). The covariance of the fits needs no more.
_GRID_X, _GRID_Y = np.arange(-3, 7) * 0.02, np.arange(-3, 4) * 0.01
_SCATTER_K, _SCATTER_X_CR, _SCATTER_Y_CR = 0.014517, 0.011514, 0.0059057


@dataclass(frozen=True)
class Correction:
    """One number that is added to the model's parameters along a direction."""

    name: str
    sigma: float
    """How far it may be off at first, in its own unit."""
    along: Mapping[str, float]
    """Change of each parameter per unit of the correction."""


@dataclass(frozen=True)
class Corrections:
    """The corrections of one model: parameters = nominal + directions @ values, the values a random walk that begins at 0."""

    names: tuple[str, ...]
    """(k,)"""
    directions: FloatArray
    """(n, k) by the model's n parameters."""
    cov: FloatArray
    """(k, k) at first."""
    walk_cov: FloatArray
    """(k, k) growth per second of motion; it may be singular. What does not walk is remembered."""
    of_turns: bool = False
    """The model's turning was measured on turns in place; on gentle arcs tyres creep, and these say nothing of it."""

    @property
    def sigmas(self) -> FloatArray:
        """(k,) at first."""
        return np.asarray(np.sqrt(np.diagonal(self.cov)))


def check_forms(names: Sequence[str]) -> list[Form]:
    """``names`` as forms. Raises `ModelError` for one that does not exist."""
    for name in names:
        if name not in FORMS:
            raise ModelError(f"no form of corrections '{name}'; there are {', '.join(FORMS)}.")
    return [form for name in names for form in FORMS if form == name]


def corrections(model: MotionModel, form: Form) -> Corrections:
    """The corrections of ``form`` to ``model``: none, ``constant``, or ``cg_field``.

    ``constant``: rotation scaling and centre of rotation as numbers that slowly change. ``cg_field``: the coefficients of their regressions
    on the CG; for the friction model, whose field is its physics, the chassis' warp besides; a model without such regressions has nothing
    but its constants. Raises `ModelError` for a form that does not exist.

    >>> from motion_models import load_robot, make_model
    >>> found = corrections(make_model("skid_steer", load_robot("vaultbot")), "constant")
    >>> dict(zip(found.names, found.sigmas.round(3).tolist()))
    {'k_0': 0.076, 'x_cr_0': 0.05, 'y_cr_0': 0.03}
    """
    check_forms([form])
    if form == "cg_field" and model.name == "skid_steer":
        return _regressions(model)
    found = _constants(model) if form != "none" else ()
    if form == "cg_field" and model.name == "friction":
        found += (Correction("warp", _WARP, {"warp": 1.0}),)
    directions = np.zeros((len(model.param_names), len(found)))
    for column, correction in enumerate(found):
        for name, rate in correction.along.items():
            directions[model.param_names.index(name), column] = rate
    sigmas = np.array([c.sigma for c in found])
    walks = sigmas / np.sqrt(_FORGOTTEN_AFTER_S)  # after an hour the first uncertainty has come back once more
    return Corrections(tuple(c.name for c in found), directions, np.diag(sigmas**2), np.diag(walks**2), model.name == "skid_steer")


def regression_cov(with_misfit: bool = False) -> FloatArray:
    """(11, 11) covariance of the coefficients of `SkidSteer` as the thesis's rotations give them: s^2 (X^T X)^-1 for each regression.

    It is `regressions.skid_steer_fit(table).cov` of its table, of which only the grid of CGs and the scatter are needed.

    ``with_misfit``: the scatter is no noise that more rotations would average out. A posture lies off the regression by so much, and
    stays there; so each block grows by samples over coefficients, until on the mean over the grid a posture's value has that scatter.
    """
    x, y = (a.ravel() for a in np.meshgrid(_GRID_X, _GRID_Y))
    reached = ~((x > 0.11) & (np.abs(y) > 0.025))  # the arms did not reach the two outermost corners
    x, y = x[reached], y[reached]
    powers = np.stack([np.ones_like(x), x, x**2], axis=-1)
    designs = (_SCATTER_K, powers), (_SCATTER_X_CR, powers[:, :2]), (_SCATTER_Y_CR, np.hstack([powers, powers * y[:, None]]))
    cov, at = np.zeros((11, 11)), 0
    for scatter, design in designs:
        own = slice(at, at + design.shape[1])
        misfit = len(x) / design.shape[1] if with_misfit else 1.0
        cov[own, own] = misfit * scatter**2 * np.linalg.inv(design.T @ design)
        at = own.stop
    return cov


def _regressions(model: MotionModel) -> Corrections:
    """Every coefficient on its own: what the rotations left open stays learned, what floors and loads change may change again."""
    n = len(model.param_names)
    floor = np.zeros((n, 3))
    floor[0:3, 0] = _TURNING * model.nominal[0:3]  # another floor scales k at every CG
    floor[3, 1], floor[5, 2] = _CENTRE_X, _CENTRE_Y
    spread = floor @ floor.T
    return Corrections(model.param_names, np.eye(n), regression_cov(with_misfit=True) + spread, spread / _FORGOTTEN_AFTER_S, True)


def _constants(model: MotionModel) -> tuple[Correction, ...]:
    """Rotation scaling, and the centre of rotation where the model has one."""
    of = dict(zip(model.param_names, model.nominal, strict=True))

    def own(name: str, sigma: float) -> Correction:
        return Correction(name, sigma, {name: 1.0})

    if model.name == "diff_drive":
        return (own("wheel_separation_multiplier", _TURNING * of["wheel_separation_multiplier"]),)
    if model.name == "skid_steer":
        return own("k_0", _TURNING * of["k_0"]), own("x_cr_0", _CENTRE_X), own("y_cr_0", _CENTRE_Y)
    if model.name == "icr":
        return own("y_icr_left", _TURNING * of["y_icr_left"]), own("y_icr_right", _TURNING * of["y_icr_left"]), own("x_icr", _CENTRE_X)
    if model.name == "full_linear":
        # both columns by one factor: corrected apart they would turn a robot that drives straight, and pass for the gyro's bias
        turning = {name: of[name] for name in ("wz_left", "wz_right")}
        sideways = {name: -of["wz_" + name[3:]] for name in ("vy_left", "vy_right")}
        return Correction("rotation_scale", _TURNING, turning), Correction("x_cr", _CENTRE_X, sideways)
    if model.name == "friction":
        return own("mu_ratio", 0.3), own("tracked_x", _CENTRE_X), own("tracked_y", _CENTRE_Y)
    return ()
