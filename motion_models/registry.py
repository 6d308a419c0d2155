"""The motion models by name. A new model is one file and one line here; the law tests then run for it by themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

from motion_models.base import MotionModel
from motion_models.diff_drive import DiffDrive
from motion_models.errors import ModelError, no_such
from motion_models.extended_model import ExtendedModel
from motion_models.friction import FrictionModel
from motion_models.full_linear import FullLinear
from motion_models.icr import Icr
from motion_models.param import Lengths, Param, Traits
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.skid_steer import SkidSteer

MODELS: dict[str, type[MotionModel]] = {
    DiffDrive.name: DiffDrive,
    SkidSteer.name: SkidSteer,
    Icr.name: Icr,
    FullLinear.name: FullLinear,
    FrictionModel.name: FrictionModel,
}


def params_of(model: str) -> tuple[Param, ...]:
    """Parameters of the motion model ``model``."""
    return cast(tuple[Param, ...], MODELS[model].params)  # of the class, where the interface has a property


def traits_of(model: str) -> Traits:
    """Traits of the motion model ``model``."""
    return cast(Traits, MODELS[model].traits)


def recommended_model(robot: Robot) -> str:
    """The motion model that describes ``robot`` best (docs/which-model.md): where arms move the centre of gravity, friction."""
    if robot.drive == DIFF_DRIVE:
        return DiffDrive.name
    return SkidSteer.name if robot.arms is None else FrictionModel.name


def usual_models(robots: Sequence[Robot]) -> tuple[str, ...]:
    """The motion models that are compared on logs of ``robots`` unless others are named: the drivers' own, and those that describe the
    robots best."""
    return tuple(dict.fromkeys((DiffDrive.name, SkidSteer.name, *map(recommended_model, robots))))


def advice(robot: Robot, models: Sequence[str]) -> list[str]:
    """A sentence on a model that describes ``robot`` better than ``models``; else none."""
    best = recommended_model(robot)
    if best != FrictionModel.name or best in models:
        return []
    return [
        f"{robot.name} has arms, for which --model friction is better: over 68 measured rotations, each at a centre of gravity that the "
        "fit does not have, its heading is off by 1.6 degrees after 5 s of turning, that of skid_steer by 3.6, that of diff_drive by 19.9."
    ]


def make_model(name: str, robot: Robot) -> MotionModel:
    """The motion model ``name`` with the coefficients and terms of ``robot``. Raises `ModelError` for a name that does not exist.

    >>> import numpy as np
    >>> from motion_models import load_robot
    >>> model = make_model("skid_steer", load_robot("vaultbot"))
    >>> wheels, arms_ahead = np.array([-2.0, 2.0]), np.array([0.1, 0.0])
    >>> vx, vy, wz = model.twist(wheels, arms_ahead, model.nominal).value
    >>> print(f"turns at {wz:.3f} rad/s about a point {-vy / wz:.3f} m ahead")
    turns at 0.896 rad/s about a point 0.154 m ahead
    """
    if name not in MODELS:
        raise ModelError(no_such("motion model", name, [*MODELS]))
    g = robot.geometry
    lengths = Lengths(g.wheel_radius_m, g.track_width_m, g.wheelbase_m)
    model = cast(MotionModel, dataclasses.replace(cast(Any, MODELS[name].from_robot(robot)), lengths=lengths))
    return ExtendedModel(model, robot.terms[name]) if robot.terms.get(name) else model
