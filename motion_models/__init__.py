"""Motion models of skid-steer robots whose centre of gravity moves: pure functions of wheels, CG and parameters."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from motion_models.base import MotionModel
    from motion_models.calibration.cross_validation import HeldOut, Interval, cross_validate, root_mean, root_mean_gain
    from motion_models.calibration.fit import Fit, FitConfig, fit
    from motion_models.calibration.maneuvers import Maneuver, read_windows, windows_text
    from motion_models.calibration.prediction import REFERENCE_PARAM_NAMES
    from motion_models.calibration.regressions import (
        CenterOfRotation,
        RotationTable,
        center_from_end_poses,
        center_of_arc,
        read_rotation_table,
        rotations_as_maneuvers,
        skid_steer_fit,
    )
    from motion_models.calibration.ros_export import diff_drive_controller_yaml, multiplier_table, multipliers, robot_localization_yaml
    from motion_models.center_of_gravity.cg_model import CgModel, CgTracker, cg_model, posture_for, static_part_from_weighing
    from motion_models.center_of_gravity.files import arms_model, arms_postures, urdf_cg, weighed_cg
    from motion_models.center_of_gravity.parts import Arms, CgEstimate, Payload, StaticPart, Tolerances, support_margin
    from motion_models.center_of_gravity.weighing import Scales, WeighedCg, cg_from_scales, read_weighings, wheel_contacts
    from motion_models.diff_drive import DiffDrive
    from motion_models.errors import CalibrationError, CgError, ModelError, RobotError, SkidlocError
    from motion_models.friction import FrictionModel
    from motion_models.friction.dynamics import FrictionDynamics
    from motion_models.full_linear import FullLinear
    from motion_models.icr import Icr
    from motion_models.motion import Motion, Twist
    from motion_models.preintegration import preintegrate
    from motion_models.prior import SkidPrior, geometric_scaling, skid_prior
    from motion_models.registry import MODELS, make_model
    from motion_models.robot import Robot
    from motion_models.robot_file import load_robot, parse_robot, robot_toml
    from motion_models.robot_names import robot_names
    from motion_models.skid_steer import SkidSteer, thesis_coefficients
    from motion_models.slope import Slope, SlopeTwist

__all__ = [
    "MODELS",
    "REFERENCE_PARAM_NAMES",
    "Arms",
    "CalibrationError",
    "CenterOfRotation",
    "CgError",
    "CgEstimate",
    "CgModel",
    "CgTracker",
    "DiffDrive",
    "Fit",
    "FitConfig",
    "FrictionDynamics",
    "FrictionModel",
    "FullLinear",
    "HeldOut",
    "Icr",
    "Interval",
    "Maneuver",
    "ModelError",
    "Motion",
    "MotionModel",
    "Payload",
    "Robot",
    "RobotError",
    "RotationTable",
    "Scales",
    "SkidPrior",
    "SkidSteer",
    "SkidlocError",
    "Slope",
    "SlopeTwist",
    "StaticPart",
    "Tolerances",
    "Twist",
    "WeighedCg",
    "arms_model",
    "arms_postures",
    "center_from_end_poses",
    "center_of_arc",
    "cg_from_scales",
    "cg_model",
    "cross_validate",
    "diff_drive_controller_yaml",
    "fit",
    "geometric_scaling",
    "load_robot",
    "make_model",
    "multiplier_table",
    "multipliers",
    "parse_robot",
    "posture_for",
    "preintegrate",
    "read_rotation_table",
    "read_weighings",
    "read_windows",
    "robot_localization_yaml",
    "robot_names",
    "robot_toml",
    "root_mean",
    "root_mean_gain",
    "rotations_as_maneuvers",
    "skid_prior",
    "skid_steer_fit",
    "static_part_from_weighing",
    "support_margin",
    "thesis_coefficients",
    "urdf_cg",
    "weighed_cg",
    "wheel_contacts",
    "windows_text",
]

_MODULES = {
    "motion_models.base": "MotionModel",
    "motion_models.calibration.cross_validation": "HeldOut Interval cross_validate root_mean root_mean_gain",
    "motion_models.calibration.fit": "Fit FitConfig fit",
    "motion_models.calibration.maneuvers": "Maneuver read_windows windows_text",
    "motion_models.calibration.prediction": "REFERENCE_PARAM_NAMES",
    "motion_models.calibration.regressions": "CenterOfRotation RotationTable center_from_end_poses center_of_arc read_rotation_table"
    " rotations_as_maneuvers skid_steer_fit",
    "motion_models.calibration.ros_export": "diff_drive_controller_yaml multiplier_table multipliers robot_localization_yaml",
    "motion_models.center_of_gravity.files": "arms_model arms_postures urdf_cg weighed_cg",
    "motion_models.center_of_gravity.cg_model": "CgModel CgTracker cg_model posture_for static_part_from_weighing",
    "motion_models.center_of_gravity.parts": "Arms CgEstimate Payload StaticPart Tolerances support_margin",
    "motion_models.center_of_gravity.weighing": "Scales WeighedCg cg_from_scales read_weighings wheel_contacts",
    "motion_models.diff_drive": "DiffDrive",
    "motion_models.errors": "CalibrationError CgError ModelError RobotError SkidlocError",
    "motion_models.friction": "FrictionModel",
    "motion_models.friction.dynamics": "FrictionDynamics",
    "motion_models.full_linear": "FullLinear",
    "motion_models.icr": "Icr",
    "motion_models.motion": "Motion Twist",
    "motion_models.preintegration": "preintegrate",
    "motion_models.prior": "SkidPrior geometric_scaling skid_prior",
    "motion_models.registry": "MODELS make_model",
    "motion_models.robot": "Robot",
    "motion_models.robot_file": "load_robot parse_robot robot_toml",
    "motion_models.robot_names": "robot_names",
    "motion_models.skid_steer": "SkidSteer thesis_coefficients",
    "motion_models.slope": "Slope SlopeTwist",
}


def exports(package: str, module_by_name: Mapping[str, str]) -> Callable[[str], Any]:
    """``__getattr__`` of ``package`` (PEP 562): each name from its module on first use; `skidloc --help` needs no numerical library.

    Raises `AttributeError` for other names.
    """

    def get(name: str) -> Any:
        if name not in module_by_name:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(importlib.import_module(module_by_name[name]), name)

    return get


__getattr__ = exports(__name__, {name: module for module, names in _MODULES.items() for name in names.split()})
