"""Which directions in a model's parameters an estimator may correct on the way, and how far they may be off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from motion_models.base import MotionModel
from motion_models.errors import ModelError
from motion_models.se2 import FloatArray

Form = Literal["none", "constant"]
FORMS: tuple[Form, ...] = get_args(Form)

# How differently robots of one type turn on different floors and with other loads: relative for what scales a turn (Clearpath's own
# multipliers for one Husky range from 1.5 to 1.9; terrains differ by a quarter), absolute [m] for where it turns about.
_TURNING, _CENTRE_X, _CENTRE_Y = 0.15, 0.05, 0.03
_FORGOTTEN_AFTER_S = 3600.0


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
    sigmas: FloatArray
    """(k,) at first."""

    @property
    def walks(self) -> FloatArray:
        """(k,) random walk per square root of a second of motion: after an hour the first uncertainty has come back once more."""
        return np.asarray(self.sigmas / np.sqrt(_FORGOTTEN_AFTER_S))


def corrections(model: MotionModel, form: Form) -> Corrections:
    """The corrections of ``form`` to ``model``. Raises `ModelError` for a form that does not exist."""
    if form not in FORMS:
        raise ModelError(f"no form of corrections '{form}'; there are {', '.join(FORMS)}.")
    found = _constants(model) if form == "constant" else ()
    directions = np.zeros((len(model.param_names), len(found)))
    for column, correction in enumerate(found):
        for name, rate in correction.along.items():
            directions[model.param_names.index(name), column] = rate
    return Corrections(tuple(c.name for c in found), directions, np.array([c.sigma for c in found]))


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
