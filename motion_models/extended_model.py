"""A motion model with learned terms (`motion_models.terms`), which are parameters like its own."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from motion_models.base import FieldPrior, ModelWrapper, MotionModel, prior_sigmas
from motion_models.errors import ModelError
from motion_models.motion import Twist
from motion_models.param import Free, Param, Scale
from motion_models.se2 import FloatArray
from motion_models.term_memory import HORIZON_S, SampleSeries
from motion_models.terms import COMPONENTS, Term, with_memory

_NEWTON_STEPS = 50
"""Most Newton steps of the inverse; commands that have a solution take under ten."""
_CONVERGED = 1e-10
"""Error of the inverse [m/s, rad/s], over 1 + the command: that of the friction model's solve."""
_LAST = 90
"""Rank of terms among what calibration fits: after the model's own parameters."""
_OWN, _SERIES = ("v", "wz"), ("dv", "dwz", "t")


@dataclass(frozen=True)
class ExtendedModel(ModelWrapper):
    """``inner`` with terms: twist_c = inner_c + sum of coefficient times expression over the terms of component c.

    Parameters are the inner model's, then the terms' coefficients. Accelerations and time are inputs: derivatives by wheels and CG hold
    them fixed.
    """

    terms: tuple[Term, ...]
    series: SampleSeries | None = None
    """Time, place and wheel angle of the samples that `twist` gets next, in the same order; None for steady motion at the drive's start."""

    @property
    def params(self) -> tuple[Param, ...]:
        """The inner model's, then those of the terms, which calibration holds first where a drive cannot separate them."""
        return (*self.inner.params, *(_param(t) for t in self.terms))

    @property
    def nominal(self) -> FloatArray:
        """(k + number of terms,)"""
        return np.append(self.inner.nominal, [t.value for t in self.terms])

    @property
    def sigmas(self) -> FloatArray:
        """(k + number of terms,) standard deviations; 0 for what has none."""
        return np.append(prior_sigmas(self.inner), [t.sigma for t in self.terms])

    def with_correction_params(self) -> MotionModel:
        """See `MotionModel.with_correction_params`: those of the inner model."""
        return dataclasses.replace(self, inner=self.inner.with_correction_params())

    def field_prior(self) -> FieldPrior | None:
        """See `MotionModel.field_prior`: that of the inner model, and the terms, which do not drift."""
        inner = self.inner.field_prior()
        if inner is None:
            return None
        added = np.diag([t.sigma**2 for t in self.terms])
        apart = np.zeros((len(inner.cov), len(added)))
        cov, spread = (np.block([[of_inner, apart], [apart.T, own]]) for of_inner, own in ((inner.cov, added), (inner.spread, 0.0 * added)))
        return FieldPrior(cov, spread)

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        k = len(self.inner.param_names)
        found = self.inner.twist(wheels, cg, params[:k])
        lead = found.value.shape[:-1]
        values = self._values(found, wheels, cg)
        value, d_wheels, d_cg = found.value.copy(), found.d_wheels.copy(), found.d_cg.copy()
        d_params = np.concatenate([found.d_params, np.zeros((*lead, 3, len(self.terms)))], axis=-1)
        for i, (term, coefficient) in enumerate(zip(self.terms, params[k:], strict=True)):
            c = COMPONENTS.index(term.component)
            shape, slopes = term.expression.evaluate(values)
            value[..., c] += coefficient * shape
            d_params[..., c, k + i] = shape
            for name, slope in slopes.items():
                by = coefficient * slope[..., None]
                if name in _OWN:
                    source = 0 if name == "v" else 2
                    d_wheels[..., c, :] += by * found.d_wheels[..., source, :]
                    d_cg[..., c, :] += by * found.d_cg[..., source, :]
                    d_params[..., c, :k] += by * found.d_params[..., source, :]
                elif name in ("left", "right"):
                    d_wheels[..., c, ("left", "right").index(name)] += by[..., 0]
                elif name in ("cg_x", "cg_y"):
                    d_cg[..., c, ("cg_x", "cg_y").index(name)] += by[..., 0]
        return Twist(value, d_wheels, d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`; Newton steps from the inner model's, for steady motion. Raises `ModelError` without a solution."""
        steady = dataclasses.replace(self, series=None)
        command, cg = np.broadcast_arrays(command, cg)
        wanted, cgs = command.reshape(-1, 2), cg.reshape(-1, 2)
        rates = np.array(self.inner.wheels(wanted, cgs, params[: len(self.inner.param_names)]))
        for _ in range(_NEWTON_STEPS):
            twist = steady.twist(rates, cgs, params)
            error = twist.value[:, [0, 2]] - wanted
            is_off = np.any(np.abs(error) > _CONVERGED * (1.0 + np.abs(wanted)), axis=1)
            if not is_off.any():
                return np.asarray(rates.reshape(command.shape))
            step = np.einsum("nij,nj->ni", np.linalg.pinv(twist.d_wheels[:, [0, 2], :]), error)
            rates = rates - np.where(is_off[:, None], step, 0.0)  # what a command needs does not depend on the others
        worst = wanted[int(np.argmax(np.abs(error).max(axis=1)))]
        raise ModelError(
            f"{self.name} with its terms: no wheel rates give vx = {worst[0]:.4g} m/s with wz = {worst[1]:.4g} rad/s; "
            "ask for a gentler arc."
        )

    def _values(self, found: Twist, wheels: FloatArray, cg: FloatArray) -> dict[str, FloatArray]:
        """Variables of the terms, each of the samples' leading axes."""
        lead = found.value.shape[:-1]
        v, wz = found.value[..., 0], found.value[..., 2]
        rates, center = np.broadcast_to(wheels, (*lead, 2)), np.broadcast_to(cg, (*lead, 2))
        values = {"v": v, "wz": wz, "left": rates[..., 0], "right": rates[..., 1], "cg_x": center[..., 0], "cg_y": center[..., 1]}
        if not needs_series(self):
            return values
        if self.series is None or self.series.dt.shape != lead:
            return {**values, "dv": np.zeros(lead), "dwz": np.zeros(lead), "t": np.zeros(lead)}
        rate = np.divide(1.0, self.series.dt, out=np.zeros(lead), where=self.series.dt > 0.0)
        values |= {"dv": np.diff(v, prepend=v[:1]) * rate, "dwz": np.diff(wz, prepend=wz[:1]) * rate, "t": self.series.t}
        return with_memory((term.expression for term in self.terms), values, self.series)


def _param(term: Term) -> Param:
    """Entry of the coefficient of ``term`` in the table of parameters."""
    text = f"learned term: {term.component} changes by this times {term.expression}"
    return Param(term.name, term.unit, text, Scale(term.scale), sigma=term.sigma, free=Free(*(_LAST,) * 4))


def terms_of(model: object) -> tuple[Term, ...]:
    """Terms of ``model``, or of the model that it wraps; none for a model without."""
    while model is not None:
        if isinstance(model, ExtendedModel):
            return model.terms
        model = getattr(model, "inner", None)
    return ()


def needs_series(model: object) -> bool:
    """Whether a term of ``model`` depends on accelerations, on time, or on the samples before."""
    return any(f.variable in _SERIES or f.has_memory for term in terms_of(model) for f in term.expression.factors)


def horizon_s(model: object) -> float:
    """Time before a step that the terms of ``model`` depend on [s]; 0 without a memory."""
    return HORIZON_S if any(f.has_memory for term in terms_of(model) for f in term.expression.factors) else 0.0


def in_series(model: Any, series: SampleSeries) -> Any:
    """``model`` for samples taken as ``series`` has it, where its terms depend on such a series; else the same."""
    if isinstance(model, ExtendedModel):
        return dataclasses.replace(model, series=series) if needs_series(model) else model
    inner = getattr(model, "inner", None)
    if inner is None or (changed := in_series(inner, series)) is inner:
        return model
    return dataclasses.replace(model, inner=changed)
