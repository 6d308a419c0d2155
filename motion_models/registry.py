"""The motion models by name. A new model is one file and one line here; the law tests then run for it by themselves."""

from __future__ import annotations

from motion_models.base import MotionModel
from motion_models.diff_drive import DiffDrive
from motion_models.errors import ModelError
from motion_models.friction import FrictionModel
from motion_models.full_linear import FullLinear
from motion_models.icr import Icr
from motion_models.robot import Robot
from motion_models.skid_steer import SkidSteer

MODELS: dict[str, type[MotionModel]] = {
    DiffDrive.name: DiffDrive,
    SkidSteer.name: SkidSteer,
    Icr.name: Icr,
    FullLinear.name: FullLinear,
    FrictionModel.name: FrictionModel,
}


def make_model(name: str, robot: Robot) -> MotionModel:
    """The motion model ``name`` with the coefficients of ``robot``. Raises `ModelError` for a name that does not exist."""
    if name not in MODELS:
        raise ModelError(f"no motion model '{name}'; there are {', '.join(MODELS)}.")
    return MODELS[name].from_robot(robot)
