"""The interface of a motion model, and the type of a relative motion with covariance that wheels and LiDAR share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from motion_models.param import Param, Traits
from motion_models.robot import Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Twist:
    """Body twist that a model predicts, with its exact derivatives. Leading axes broadcast."""

    value: FloatArray
    """(..., 3) vx, vy, wz [m/s, m/s, rad/s]."""
    d_wheels: FloatArray
    """(..., 3, 2) by the left and right wheel rate."""
    d_cg: FloatArray
    """(..., 3, 2) by the x and y of the centre of gravity."""
    d_params: FloatArray
    """(..., 3, k) by the model's parameters, in the order of `MotionModel.param_names`."""

    @classmethod
    def from_kernel(
        cls, kernel: Callable[..., None], constants: FloatArray, wheels: FloatArray, cg: FloatArray, params: FloatArray
    ) -> Twist:
        """Run a compiled loop over all samples, whatever their leading axes.

        ``kernel(wheels (n, 2), cg (n, 2), params (k,), constants, value, d_wheels, d_cg, d_params)`` fills the last four, which start
        at zero, for each of n samples.
        """
        lead = wheels.shape[:-1] if wheels.shape == cg.shape else np.broadcast_shapes(wheels.shape[:-1], cg.shape[:-1])
        n, k = math.prod(lead), params.shape[0]
        value, d_params = np.zeros((n, 3)), np.zeros((n, 3, k))
        d_wheels, d_cg = np.zeros((n, 3, 2)), np.zeros((n, 3, 2))
        # Always copies: numba would compile the kernel once more for each kind of view, and round it differently.
        full = [a if a.shape == (*lead, 2) else np.broadcast_to(a, (*lead, 2)) for a in (wheels, cg)]  # broadcast_* take microseconds
        flat = [np.array(a, dtype=np.float64, order="C").reshape(n, 2) for a in full]
        kernel(*flat, np.array(params, dtype=np.float64), constants, value, d_wheels, d_cg, d_params)
        return cls(value.reshape(*lead, 3), d_wheels.reshape(*lead, 3, 2), d_cg.reshape(*lead, 3, 2), d_params.reshape(*lead, 3, k))


@dataclass(frozen=True)
class Motion:
    """A relative motion with its covariance: what wheels predict, and what a LiDAR measures, between two moments."""

    delta: FloatArray
    """(3,) pose of the end relative to the start [m, m, rad]."""
    cov: FloatArray
    """(3, 3) of the right perturbation of ``delta`` by slip."""
    d_params: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    """(3, k) change of ``delta`` (right perturbation) by the model's parameters."""
    d_cg: FloatArray = field(default_factory=lambda: np.zeros((3, 2)))
    """(3, 2) change of ``delta`` (right perturbation) by a CG error that is the same over all of it."""


class FieldPrior(NamedTuple):
    """Corrections of all parameters of a model at once, which another centre of gravity makes necessary."""

    cov: FloatArray
    """(k, k) prior covariance of the parameters."""
    spread: FloatArray
    """(k, k) part of it that drifts with floor and load; what remains is the misfit of the model, which is constant."""


class MotionModel(Protocol):
    """From wheel rates and centre of gravity to a body twist. A frozen dataclass that inherits from `ModelBase`."""

    @property
    def name(self) -> str:
        """Id of the model, as on the command line and in robot files."""

    @property
    def params(self) -> tuple[Param, ...]:
        """The k parameters."""

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the k parameters."""

    @property
    def nominal(self) -> FloatArray:
        """(k,) the robot's own values of the parameters."""

    @property
    def traits(self) -> Traits:
        """What estimators and robot files have to be given about the model beside its parameters."""

    def with_correction_params(self) -> MotionModel:
        """The model with the parameters that its corrections need beside its own."""

    def field_prior(self) -> FieldPrior | None:
        """Prior of the form ``cg_field`` of corrections, where that corrects all parameters; None where it is that of their table."""

    @classmethod
    def from_robot(cls, robot: Robot) -> MotionModel:
        """The model with the coefficients of ``robot``."""

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """Body twist for wheel rates ``wheels`` (..., 2) [rad/s] left, right; ``cg`` (..., 2) [m]; ``params`` (k,)."""

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """Wheel rates (..., 2) [rad/s] for a wanted ``command`` (..., 2): vx [m/s] and wz [rad/s]; vy cannot be commanded."""


class ModelBase:
    """Base of motion models: what follows from the table of parameters, and the defaults of what a model need not have."""

    params: ClassVar[tuple[Param, ...]]
    """The k parameters."""
    param_names: ClassVar[tuple[str, ...]]
    """Names of ``params``, by `__init_subclass__`."""
    traits: ClassVar[Traits] = Traits()

    def __init_subclass__(cls) -> None:
        """Names of the parameters, once for the class."""
        cls.param_names = tuple(p.name for p in cls.params)

    def with_correction_params(self: MotionModel) -> MotionModel:
        """See `MotionModel.with_correction_params`: itself."""
        return self

    def field_prior(self) -> FieldPrior | None:
        """See `MotionModel.field_prior`: none."""
        return None


@dataclass(frozen=True)
class ModelWrapper:
    """A model that is ``inner`` but for what a subclass changes."""

    inner: MotionModel

    @property
    def name(self) -> str:
        """Name of the inner model."""
        return self.inner.name

    @property
    def params(self) -> tuple[Param, ...]:
        """The k parameters."""
        return self.inner.params

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the k parameters."""
        return tuple(p.name for p in self.params)

    @property
    def traits(self) -> Traits:
        """Those of the inner model."""
        return self.inner.traits

    def with_correction_params(self: MotionModel) -> MotionModel:
        """See `MotionModel.with_correction_params`: itself."""
        return self

    def field_prior(self) -> FieldPrior | None:
        """See `MotionModel.field_prior`."""
        return self.inner.field_prior()

    @classmethod
    def from_robot(cls, robot: Robot) -> MotionModel:
        """Raises `NotImplementedError`: it wraps a model, which a robot file does not name."""
        raise NotImplementedError(f"wrap the model of {robot.name}: {cls.__name__}(make_model(name, robot)).")


def prior_sigmas(model: MotionModel) -> FloatArray:
    """(k,) standard deviations of the parameters of a robot without a calibration, by its geometry (`motion_models.prior`); 0 for those
    of a calibration, and where the model has no such prior."""
    own = getattr(model, "sigmas", None)
    return np.zeros(len(model.param_names)) if own is None else np.asarray(own, dtype=np.float64)
