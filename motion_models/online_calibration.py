"""Correction states: their directions in a model's parameters, prior and process noise; models with such parameters.

A form names them: ``none``, ``constant``, ``cg_field``, or names of single corrections joined by ``+`` (``constant`` may be one):
``mu_ratio+warp``, ``constant+cg_offset_x+cg_offset_y``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.errors import ModelError
from motion_models.friction import FrictionModel, check_parameters
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

RADIUS_NAMES = ("wheel_radius_scale", "wheel_radius_difference")
_N = len(FrictionModel.param_names)
_MU_RATIO_INDEX = FrictionModel.param_names.index("mu_ratio")
_MIN_MU_RATIO = 0.05  # -; castors and free rollers
_MAX_CG = 0.98  # -; of half the wheelbase and half the track, where the robot tips over

Form = str
FORMS: tuple[Form, ...] = ("none", "constant", "cg_field")

# Prior sigmas, for robots of one type on different floors and with other loads: relative of the rotation scaling (Clearpath's own
# multipliers for one Husky range from 1.5 to 1.9; terrains differ by a quarter), absolute of the centre of rotation [m].
_TURNING, _CENTRE_X, _CENTRE_Y = 0.15, 0.05, 0.03
PRIOR_RETURNS_AFTER_S = 3600.0
"""Time in which a correction's random walk grows to its prior standard deviation [s]: tyres and loads change within an hour."""
_WARP = 0.15  # VaultBot's chassis, as its rotations show it, moves 13 % of m g / 4 to two opposite wheels
_MU_RATIO = 0.3
_RADIUS_SCALE, _RADIUS_DIFFERENCE = 0.03, 0.01
"""Relative, of all radii and of left against right: pneumatic tyres lose 3 % under load; unequal wheels of up to 1 % are Borenstein's and
Feng's main systematic odometry error ("Measurement and correction of systematic odometry errors", IEEE T-RA 12(6), 1996; from memory)."""
_LATERAL_SLIP_S, _ROTATION_SLIP_S_PER_M = 0.05, 0.01
"""Without the robot's own prior (`motion_models.prior.slip_at_speed`: 0.02 to 0.09 s, and under 0.01 s/m)."""

# `Corrections.min_track_over_radius`. On gentler arcs tyres creep, which regressions of rotations in place do not cover. The friction
# model covers it; but on straight motion the two sides differ by noise alone, which would be taken for information.
_IN_PLACE, _NOT_STRAIGHT = 0.25, 0.02

# The rotations of Ebersole 2016, Ch. 4, to which the coefficients of `SkidSteer` were fitted: positions of the CG [m], and the scatter
# about the fits of k [-], x_CR and y_CR [m] (`regressions.skid_steer_fit`). They give the covariance of the fits.
_GRID_X, _GRID_Y = np.arange(-3, 7) * 0.02, np.arange(-3, 4) * 0.01
_SCATTER_K, _SCATTER_X_CR, _SCATTER_Y_CR = 0.014517, 0.011514, 0.0059057

_SINGLE = (
    *("wheel_separation_multiplier", "k_0", "x_cr_0", "y_cr_0", "y_icr_left", "y_icr_right", "x_icr", "rotation_scale", "x_cr"),
    *("lateral_slip_speed", "rotation_slip_speed", *RADIUS_NAMES),
    *("mu_ratio", "tracked_x", "tracked_y", "warp", "cg_offset_x", "cg_offset_y"),
)
_ONLY_BY_NAME = ("warp", "cg_offset_x", "cg_offset_y", "lateral_slip_speed", "rotation_slip_speed", *RADIUS_NAMES)


@dataclass(frozen=True)
class Correction:
    """One number that is added to the model's parameters along a direction."""

    name: str
    sigma: float
    """Prior standard deviation, in its own unit."""
    along: Mapping[str, float]
    """Change of each parameter per unit of the correction."""


@dataclass(frozen=True)
class Corrections:
    """The corrections of one model: parameters = nominal + directions @ values, the values a random walk from 0."""

    names: tuple[str, ...]
    """(k,)"""
    directions: FloatArray
    """(n, k) by the model's n parameters."""
    cov: FloatArray
    """(k, k) prior."""
    process_noise: FloatArray
    """(k, k) covariance per second of motion; it may be singular."""
    min_track_over_radius: float = 0.0
    """Track over turning radius below which a motion does not excite the corrections."""

    @property
    def sigmas(self) -> FloatArray:
        """(k,) prior standard deviations."""
        return np.asarray(np.sqrt(np.diagonal(self.cov)))


def check_forms(names: Sequence[str]) -> list[Form]:
    """``names`` as forms, each once. Raises `ModelError` for one that does not exist."""
    for name in names:
        parts = name.split("+")
        if name not in FORMS and not all(part in _SINGLE or (part == "constant" and len(parts) > 1) for part in parts):
            raise ModelError(
                f"no form of corrections '{name}'; there are {', '.join(FORMS)}, and names joined by + of {', '.join(_SINGLE)}."
            )
    return list(dict.fromkeys(names))


def add_correction_parameters(model: MotionModel, form: Form) -> MotionModel:
    """``model`` with the parameters that corrections of ``form`` need besides its own: the friction model's CG, the wheels' radii."""
    corrected: MotionModel = CorrectedFriction(model) if isinstance(model, FrictionModel) and form != "none" else model
    return CorrectedWheels(corrected) if set(form.split("+")) & set(RADIUS_NAMES) else corrected


def make_corrections(model: MotionModel, form: Form) -> Corrections:
    """The corrections of ``form`` to ``model``: ``none``, ``constant``, ``cg_field``, or names joined by ``+``.

    ``constant``: rotation scaling and centre of rotation, or the friction model's mu_ratio and tracked point. ``cg_field``: of skid_steer
    all coefficients of the regressions on the CG; of friction, ``constant`` and the warp; of the others, ``constant``. Raises
    `ModelError` for a form that does not exist, or not for this model.

    >>> from motion_models import load_robot, make_model
    >>> found = make_corrections(make_model("skid_steer", load_robot("vaultbot")), "constant")
    >>> dict(zip(found.names, found.sigmas.round(3).tolist()))
    {'k_0': 0.076, 'x_cr_0': 0.05, 'y_cr_0': 0.03}
    """
    check_forms([form])
    if form == "cg_field" and model.name == "skid_steer":
        return _regressions(model)
    found = _named(model, form)
    directions = np.zeros((len(model.param_names), len(found)))
    for column, correction in enumerate(found):
        for name, rate in correction.along.items():
            directions[model.param_names.index(name), column] = rate
    sigmas = np.array([c.sigma for c in found])
    has_radii = any(c.name in RADIUS_NAMES for c in found)  # observed where the robot drives straight
    minimum = 0.0 if has_radii else {"skid_steer": _IN_PLACE, "friction": _NOT_STRAIGHT}.get(model.name, 0.0)
    prior = np.diag(sigmas**2)
    return Corrections(tuple(c.name for c in found), directions, prior, prior / PRIOR_RETURNS_AFTER_S, minimum)


def _named(model: MotionModel, form: Form) -> tuple[Correction, ...]:
    """The single corrections of ``form``."""
    available = {c.name: c for c in _singles(model)}
    constant = [name for name in available if name not in _ONLY_BY_NAME]
    whole = {"none": [], "constant": constant, "cg_field": [*constant, *(["warp"] if "warp" in available else [])]}
    names = whole.get(form, [name for part in form.split("+") for name in (constant if part == "constant" else [part])])
    for name in names:
        if name not in available:
            raise ModelError(f"no correction '{name}' of {model.name}; there are {', '.join(available) or 'none'}.")
        if absent := [p for p in available[name].along if p not in model.param_names]:
            raise ModelError(f"{model.name} has no parameter '{absent[0]}' as it is: pass it through `add_correction_parameters` first.")
    return tuple(available[name] for name in dict.fromkeys(names))


def _regression_cov() -> FloatArray:
    """(11, 11) covariance of the coefficients of `SkidSteer` by the thesis's rotations: s^2 (X^T X)^-1 n / p for each regression.

    A CG position is off its regression by the scatter s systematically, not by noise that more rotations average out. The n samples over
    p coefficients give predictions that variance s^2, on the mean over the grid.
    """
    x, y = (a.ravel() for a in np.meshgrid(_GRID_X, _GRID_Y))
    reached = ~((x > 0.11) & (np.abs(y) > 0.025))  # without the two front corners, which the arms did not reach
    x, y = x[reached], y[reached]
    powers = np.stack([np.ones_like(x), x, x**2], axis=-1)
    designs = (_SCATTER_K, powers), (_SCATTER_X_CR, powers[:, :2]), (_SCATTER_Y_CR, np.hstack([powers, powers * y[:, None]]))
    cov, at = np.zeros((11, 11)), 0
    for scatter, design in designs:
        own = slice(at, at + design.shape[1])
        cov[own, own] = len(x) / design.shape[1] * scatter**2 * np.linalg.inv(design.T @ design)
        at = own.stop
    return cov


def _regressions(model: MotionModel) -> Corrections:
    """Every coefficient on its own. Process noise is that of floors and loads alone: the misfit of the regressions does not change."""
    n = len(model.param_names)
    floor = np.zeros((n, 3))
    sigma_k = float(getattr(model, "sigmas", np.zeros(n))[0])
    turning = sigma_k / model.nominal[0] if sigma_k else _TURNING
    floor[0:3, 0] = turning * model.nominal[0:3]  # another floor scales k at every CG
    floor[3, 1], floor[5, 2] = _CENTRE_X, _CENTRE_Y
    spread = floor @ floor.T
    return Corrections(model.param_names, np.eye(n), _regression_cov() + spread, spread / PRIOR_RETURNS_AFTER_S, _IN_PLACE)


def _singles(model: MotionModel) -> tuple[Correction, ...]:
    """`_own_singles`, and the wheels' radii, which every model has (`CorrectedWheels`)."""
    radii = zip(RADIUS_NAMES, (_RADIUS_SCALE, _RADIUS_DIFFERENCE), strict=True)
    return *_own_singles(model), *(Correction(name, sigma, {name: 1.0}) for name, sigma in radii)


def _own_singles(model: MotionModel) -> tuple[Correction, ...]:
    """Rotation scaling, the centre of rotation where the model has one; for the friction model its physics."""
    of = dict(zip(model.param_names, model.nominal, strict=True))
    uncalibrated = dict(zip(model.param_names, getattr(model, "sigmas", np.zeros(0)), strict=False))

    def own(name: str, sigma: float) -> Correction:
        """Where the robot has no calibration, the prior's standard deviation (`motion_models.prior`) instead of ``sigma``."""
        return Correction(name, float(uncalibrated.get(name, 0.0)) or sigma, {name: 1.0})

    if model.name == "diff_drive":
        return (own("wheel_separation_multiplier", _TURNING * of["wheel_separation_multiplier"]),)
    if model.name == "skid_steer":
        return own("k_0", _TURNING * of["k_0"]), own("x_cr_0", _CENTRE_X), own("y_cr_0", _CENTRE_Y)
    if model.name == "icr":
        return own("y_icr_left", _TURNING * of["y_icr_left"]), own("y_icr_right", _TURNING * of["y_icr_left"]), own("x_icr", _CENTRE_X)
    if model.name == "full_linear":
        # both columns by one factor: separate ones would turn a robot that drives straight, as a gyro bias does
        turning = {name: of[name] for name in ("wz_left", "wz_right")}
        sideways = {name: -of["wz_" + name[3:]] for name in ("vy_left", "vy_right")}
        at_speed = own("lateral_slip_speed", _LATERAL_SLIP_S), own("rotation_slip_speed", _ROTATION_SLIP_S_PER_M)
        return Correction("rotation_scale", _TURNING, turning), Correction("x_cr", _CENTRE_X, sideways), *at_speed
    if model.name == "friction":
        centre = own("tracked_x", _CENTRE_X), own("tracked_y", _CENTRE_Y)
        return own("mu_ratio", _MU_RATIO), *centre, own("warp", _WARP), own("cg_offset_x", _CENTRE_X), own("cg_offset_y", _CENTRE_Y)
    return ()


@dataclass(frozen=True)
class CorrectedWheels:
    """``inner`` with two more parameters [-], 0 for the robot file's radii: wheel_radius_scale s and wheel_radius_difference d.

    Left wheels have the radius r (1 + s + d/2), right ones r (1 + s - d/2), so that the inner model gets the rates
    q_l (1 + s + d/2) and q_r (1 + s - d/2). Straight ahead, d turns the robot by -d k / track per metre.
    """

    inner: MotionModel

    @property
    def name(self) -> str:
        """Name of the inner model."""
        return self.inner.name

    @property
    def param_names(self) -> tuple[str, ...]:
        """The inner model's, then `RADIUS_NAMES`."""
        return (*self.inner.param_names, *RADIUS_NAMES)

    @property
    def nominal(self) -> FloatArray:
        """(k + 2,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    @property
    def sigmas(self) -> FloatArray:
        """(k + 2,) of the inner model's prior, where it has one (`motion_models.prior`)."""
        return np.append(getattr(self.inner, "sigmas", np.zeros(len(self.inner.param_names))), [0.0, 0.0])

    @classmethod
    def from_robot(cls, robot: Robot) -> CorrectedWheels:
        """Raises `NotImplementedError`: it wraps a model, which a robot file does not name."""
        raise NotImplementedError("wrap the model of the robot: CorrectedWheels(make_model(name, robot)).")

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        sides = self._sides(params)
        found = self.inner.twist(wheels * sides, cg, params[:-2])
        rates = np.broadcast_to(wheels, (*found.value.shape[:-1], 2))
        by_rates = found.d_wheels * rates[..., None, :]
        by_scale = by_rates.sum(axis=-1, keepdims=True)
        by_difference = 0.5 * (by_rates[..., :1] - by_rates[..., 1:])
        d_params = np.concatenate([found.d_params, by_scale, by_difference], axis=-1)
        return Twist(found.value, found.d_wheels * sides, found.d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`."""
        return np.asarray(self.inner.wheels(command, cg, params[:-2]) / self._sides(params))

    @staticmethod
    def _sides(params: FloatArray) -> FloatArray:
        scale, difference = params[-2], params[-1]
        return np.array([1.0 + scale + difference / 2.0, 1.0 + scale - difference / 2.0])


@dataclass(frozen=True)
class CorrectedFriction:
    """`FrictionModel` with two more parameters, cg_offset_x and cg_offset_y [m]: the true CG less the given one.

    Values outside the valid range (CG beyond the wheels, mu_ratio < 0.05) are clipped; their derivative is zero.
    """

    inner: FrictionModel
    name: ClassVar[str] = FrictionModel.name
    param_names: ClassVar[tuple[str, ...]] = (*FrictionModel.param_names, "cg_offset_x", "cg_offset_y")

    @classmethod
    def from_robot(cls, robot: Robot) -> CorrectedFriction:
        """`FrictionModel.from_robot` with offsets 0."""
        return cls(FrictionModel.from_robot(robot))

    @property
    def nominal(self) -> FloatArray:
        """(14,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `FrictionModel.twist`."""
        clipped, shifted, is_free = _clip_to_valid(cg, params)
        found = self.inner.twist(wheels, shifted, clipped)
        d_cg = found.d_cg * is_free[..., None, :]
        d_params = np.concatenate([found.d_params, d_cg], axis=-1)
        if clipped[_MU_RATIO_INDEX] != params[_MU_RATIO_INDEX]:
            d_params[..., _MU_RATIO_INDEX] = 0.0
        return Twist(found.value, found.d_wheels, d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `FrictionModel.wheels`."""
        clipped, shifted, _ = _clip_to_valid(cg, params)
        return self.inner.wheels(command, shifted, clipped)


def _clip_to_valid(cg: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters (12,) and CG (..., 2) within their valid ranges, and 1 where the CG (..., 2) is not clipped, else 0."""
    clipped = params[:_N].copy()
    clipped[_MU_RATIO_INDEX] = max(clipped[_MU_RATIO_INDEX], _MIN_MU_RATIO)
    check_parameters(cg, clipped)
    edge = 0.5 * _MAX_CG * clipped[[2, 1]]
    moved = cg + params[_N:]
    return clipped, np.clip(moved, -edge, edge), (np.abs(moved) < edge).astype(float)
