"""The interface of a motion model, its base with the defaults, and a wrapper that changes a part of another model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from motion_models.motion import Twist
from motion_models.param import Lengths, Param, Traits
from motion_models.robot import Robot
from motion_models.se2 import FloatArray


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

    @property
    def lengths(self) -> Lengths:
        """Lengths of the robot, in which the scales of the parameters are given."""

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


@dataclass(frozen=True)
class ModelBase:
    """Base of motion models: what follows from the table of parameters, and the defaults of what a model need not have."""

    lengths: Lengths = field(default=Lengths(), kw_only=True)
    """See `MotionModel.lengths`; `motion_models.registry.make_model` sets those of the robot."""
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
    def lengths(self) -> Lengths:
        """Those of the inner model."""
        return self.inner.lengths

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


def scales(model: MotionModel) -> FloatArray:
    """(k,) change of each parameter that matters, in its unit (`motion_models.param.Param.scale`); positive."""
    return np.array([p.scale.of(model.lengths) for p in model.params])


def prior_sigmas(model: MotionModel) -> FloatArray:
    """(k,) standard deviations of the parameters of a robot without a calibration, by its geometry (`motion_models.prior`); 0 for those
    of a calibration, and where the model has no such prior."""
    own = getattr(model, "sigmas", None)
    return np.zeros(len(model.param_names)) if own is None else np.asarray(own, dtype=np.float64)
