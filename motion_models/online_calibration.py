"""Correction states: their directions in a model's parameters, prior and process noise; models with such parameters.

A form names them: ``none``, ``constant``, ``cg_field``, or names of single corrections joined by ``+`` (``constant`` may be one):
``mu_ratio+warp``, ``constant+cg_offset_x+cg_offset_y``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.base import ModelWrapper, MotionModel, prior_sigmas
from motion_models.errors import ModelError
from motion_models.motion import Twist
from motion_models.param import Free, Param, Scale
from motion_models.registry import MODELS, params_of, traits_of
from motion_models.se2 import FloatArray

Form = str
FORMS: tuple[Form, ...] = ("none", "constant", "cg_field")
WHEEL_RADIUS_SIGMA = 0.03
"""Prior sigma of the radius of all wheels, relative: wear, pressure, load of tyres."""
PRIOR_RETURNS_AFTER_S = 3600.0
"""Time in which a correction's random walk grows to its prior standard deviation [s]: tyres and loads change within an hour."""
_LAST = 99  # rank of what is held first

RADIUS_PARAMS = (
    Param(
        "wheel_radius_scale",
        *("1", "radius of all wheels over the robot file's, less 1", Scale(0.05)),
        sigma=0.03,  # pneumatic tyres lose 3 % under load
        forms=(),
        free=Free(logs=_LAST, moving_cg=_LAST),
    ),
    Param(
        "wheel_radius_difference",
        *("1", "radius of the left wheels less the right ones', over the mean", Scale(0.05)),
        # unequal wheels of up to 1 % are the main systematic odometry error of Borenstein and Feng ("Measurement and correction of
        # systematic odometry errors", IEEE T-RA 12(6), 1996; from memory)
        sigma=0.01,
        forms=(),
    ),
)
"""Parameters that `CorrectedWheels` adds to any model."""
RADIUS_NAMES = tuple(p.name for p in RADIUS_PARAMS)


@dataclass(frozen=True)
class Correction:
    """One number that is added to the model's parameters along a direction."""

    name: str
    sigma: float
    """Prior standard deviation, in its own unit."""
    along: Mapping[str, float]
    """Change of each parameter per unit of the correction."""
    forms: tuple[Form, ...] = ()
    """Forms that contain it."""


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
        known = _names_of_all_models()
        if name not in FORMS and not all(part in known or (part == "constant" and len(parts) > 1) for part in parts):
            raise ModelError(f"no form of corrections '{name}'; there are {', '.join(FORMS)}, and names joined by + of {', '.join(known)}.")
    return list(dict.fromkeys(names))


def _names_of_all_models() -> tuple[str, ...]:
    """Names of the single corrections of every model, and of the wheels' radii."""
    names: list[str] = []
    for model in MODELS:
        traits = traits_of(model)
        names += [d.name for d in traits.directions] + [p.name for p in (*params_of(model), *traits.correction_params) if p.sigma]
    return tuple(dict.fromkeys([*names, *RADIUS_NAMES]))


def add_correction_parameters(model: MotionModel, form: Form) -> MotionModel:
    """``model`` with the parameters that corrections of ``form`` need besides its own: as of a CG offset, and the wheels' radii."""
    corrected = model.with_correction_params() if form != "none" else model
    return CorrectedWheels(corrected) if set(form.split("+")) & set(RADIUS_NAMES) else corrected


def make_corrections(model: MotionModel, form: Form) -> Corrections:
    """The corrections of ``form`` to ``model``: ``none``, ``constant``, ``cg_field``, or names joined by ``+``.

    ``constant``: those of the model's table that have it among their forms, as rotation scaling and centre of rotation. ``cg_field``: all
    parameters where the model has a `MotionModel.field_prior`, else those that have that form. Raises `ModelError` for a form that does
    not exist, or not for this model.

    >>> from motion_models import load_robot, make_model
    >>> found = make_corrections(make_model("skid_steer", load_robot("vaultbot")), "constant")
    >>> dict(zip(found.names, found.sigmas.round(3).tolist()))
    {'k_0': 0.076, 'x_cr_0': 0.05, 'y_cr_0': 0.03}
    """
    check_forms([form])
    field = model.field_prior() if form == "cg_field" else None
    if field is not None:
        i = np.flatnonzero(np.diagonal(field.cov) > 0.0)
        walk, directions = field.spread / PRIOR_RETURNS_AFTER_S, np.eye(len(model.param_names))[:, i]
        names = tuple(model.param_names[n] for n in i)
        return Corrections(names, directions, field.cov[np.ix_(i, i)], walk[np.ix_(i, i)], model.traits.min_track_over_radius)
    found = _named(model, form)
    directions = np.zeros((len(model.param_names), len(found)))
    for column, correction in enumerate(found):
        for name, rate in correction.along.items():
            directions[model.param_names.index(name), column] = rate
    sigmas = np.array([c.sigma for c in found])
    has_radii = any(c.name in RADIUS_NAMES for c in found)  # observed where the robot drives straight
    minimum = 0.0 if has_radii else model.traits.min_track_over_radius
    prior = np.diag(sigmas**2)
    return Corrections(tuple(c.name for c in found), directions, prior, prior / PRIOR_RETURNS_AFTER_S, minimum)


def _named(model: MotionModel, form: Form) -> tuple[Correction, ...]:
    """The single corrections of ``form``."""
    added = (Correction(p.name, p.sigma, {p.name: 1.0}, p.forms) for p in (*model.traits.correction_params, *RADIUS_PARAMS))
    available = {c.name: c for c in (*_singles(model), *added)}
    constant = [c.name for c in available.values() if "constant" in c.forms]
    whole = {"none": [], "constant": constant, "cg_field": [*constant, *(c.name for c in available.values() if "cg_field" in c.forms)]}
    names = whole.get(form, [name for part in form.split("+") for name in (constant if part == "constant" else [part])])
    for name in names:
        if name not in available:
            raise ModelError(f"no correction '{name}' of {model.name}; there are {', '.join(available) or 'none'}.")
        if absent := [p for p in available[name].along if p not in model.param_names]:
            raise ModelError(f"{model.name} has no parameter '{absent[0]}' as it is: pass it through `add_correction_parameters` first.")
    return tuple(available[name] for name in dict.fromkeys(names))


def _singles(model: MotionModel) -> tuple[Correction, ...]:
    """Every correction of the model's own, by its table and its traits."""
    of = dict(zip(model.param_names, model.nominal, strict=True))
    by_geometry = dict(zip(model.param_names, prior_sigmas(model).tolist(), strict=True))
    found = [
        Correction(d.name, d.sigma, {name: factor * of[other] for name, (other, factor) in d.along.items()}, d.forms)
        for d in model.traits.directions
    ]
    for p in model.params:
        if p.sigma:
            sigma = p.sigma * (of[p.relative_to] if p.relative_to else 1.0)
            found.append(Correction(p.name, by_geometry[p.name] or sigma, {p.name: 1.0}, p.forms))
    return tuple(found)


@dataclass(frozen=True)
class CorrectedWheels(ModelWrapper):
    """``inner`` with two more parameters [-], 0 for the robot file's radii: wheel_radius_scale s and wheel_radius_difference d.

    Left wheels have the radius r (1 + s + d/2), right ones r (1 + s - d/2), so that the inner model gets the rates
    q_l (1 + s + d/2) and q_r (1 + s - d/2). Straight ahead, d turns the robot by -d k / track per metre.
    """

    @property
    def params(self) -> tuple[Param, ...]:
        """The inner model's, then `RADIUS_PARAMS`."""
        return (*self.inner.params, *RADIUS_PARAMS)

    @property
    def nominal(self) -> FloatArray:
        """(k + 2,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    @property
    def sigmas(self) -> FloatArray:
        """(k + 2,) of the inner model's prior, where it has one (`motion_models.prior`)."""
        return np.append(prior_sigmas(self.inner), [0.0, 0.0])

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
