"""A drive of every kind of motion without a log, on which the corrections of causes are held to what they claim."""

from __future__ import annotations

import dataclasses

import numpy as np

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.linearization import make_predictor
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot

_COMMANDS = ((0.5, 0.0), (0.5, 0.35), (0.0, 0.4), (-0.5, -0.1), (0.3, -0.5), (0.0, -0.4), (0.6, -0.2), (-0.4, 0.3))
"""vx [m/s] and wz [rad/s] of the windows, by turns."""
_STEPS, _DT = 20, 0.1
_WINDOWS = 24
_SIGMAS = np.array([2e-3, 2e-3, 1e-3])


def law_drive(robot_name: str, kind: str = "log") -> Drive:
    """Windows of constant motion, measured as if the robot had not moved; the CG has two postures where the robot has arms."""
    robot: Robot = load_robot(robot_name)
    model = make_model("friction", robot)
    middle = robot.center_of_gravity
    postures = (middle + np.array([0.05, -0.01]), middle + np.array([-0.02, 0.015])) if robot.arms is not None else (middle, middle)
    maneuvers = []
    for i in range(_WINDOWS):
        cg = np.tile(postures[i // 4 % 2], (_STEPS, 1))
        command = np.array(_COMMANDS[i % len(_COMMANDS)])
        wheels = np.tile(model.wheels(command, cg[0], model.nominal), (_STEPS, 1))
        dt, ends = np.full(_STEPS, _DT), np.array([_STEPS])
        maneuvers.append(Maneuver(dt, wheels, np.zeros((1, 3)), ends, cg, np.diag(_SIGMAS**2), group=f"{i}"))
    starts = np.arange(_WINDOWS) * _STEPS * _DT
    spans = np.stack([starts, starts + _STEPS * _DT], axis=1)
    gripper = np.array([0.5 * robot.geometry.wheelbase_m + 0.1, 0.0])
    arms = np.concatenate([np.tile(gripper - m.cg[0], (_STEPS, 1)) for m in maneuvers])
    return Drive(
        "law",
        robot,
        tuple(maneuvers),
        "scan matching",
        kind=kind,
        starts_s=starts,
        spans_ns=(spans * 1e9).astype(np.int64),
        payload_arms=arms,
        payload_link="gripper" if robot.arms is not None else "",
        lidar_frame="laser",
        lidar_mount=Mount(0.2),
        lidar_at=(0.2, 0.0),
    )


def law_predictor(robot_name: str, model: str) -> DrivePredictor:
    """Predictor of `law_drive` with ``model``, without the inertia of constant motions."""
    drive = law_drive(robot_name)
    return dataclasses.replace(make_predictor(drive, make_model(model, drive.robot)), has_inertia=False)


def measured_under(drive: Drive, model: MotionModel, hypothesis: Hypothesis, rng: np.random.Generator, has_inertia: bool = False) -> Drive:
    """``drive`` as it would have been measured, with the noise of `law_drive`, where ``hypothesis`` holds."""
    unmoved = tuple(dataclasses.replace(m, measured=np.zeros((1, 3))) for m in drive.maneuvers)
    predictor = DrivePredictor(dataclasses.replace(drive, maneuvers=unmoved), model, has_inertia)
    poses = se2.inverse(predictor.discrepancies(hypothesis)[:, :3])  # of the origin in the predicted frames
    noisy = se2.compose(poses, rng.normal(0.0, 1.0, poses.shape) * _SIGMAS)
    maneuvers = tuple(dataclasses.replace(m, measured=pose[None]) for m, pose in zip(drive.maneuvers, noisy, strict=True))
    return dataclasses.replace(drive, maneuvers=maneuvers)
