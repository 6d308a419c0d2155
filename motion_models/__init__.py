"""Motion models of skid-steer robots whose centre of gravity moves: pure functions of wheels, CG and parameters."""

from motion_models.base import Motion, MotionModel, Twist
from motion_models.diff_drive import DiffDrive
from motion_models.errors import ModelError, RobotError, SkidlocError
from motion_models.integrate import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import Robot, load_robot, robot_names
from motion_models.skid_steer import SkidSteer, thesis_coefficients

__all__ = [
    "MODELS",
    "DiffDrive",
    "ModelError",
    "Motion",
    "MotionModel",
    "Robot",
    "RobotError",
    "SkidSteer",
    "SkidlocError",
    "Twist",
    "load_robot",
    "make_model",
    "preintegrate",
    "robot_names",
    "thesis_coefficients",
]
