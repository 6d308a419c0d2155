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
from motion_models.se2 import FloatArray

_COMMANDS = ((0.5, 0.0), (0.5, 0.35), (0.0, 0.4), (-0.5, -0.1), (0.3, -0.5), (0.0, -0.4), (0.6, -0.2), (-0.4, 0.3))
"""vx [m/s] and wz [rad/s] of the windows, by turns."""
_STEPS, _DT = 20, 0.1
_WINDOWS = 24
_SIGMAS = np.array([2e-3, 2e-3, 1e-3])


def law_drive(robot_name: str, kind: str = "log", windows: int = _WINDOWS) -> Drive:
    """Windows of constant motion, measured as if the robot had not moved; the CG has two postures where the robot has arms."""
    robot: Robot = load_robot(robot_name)
    model = make_model("friction", robot)
    middle = robot.center_of_gravity
    postures = (middle + np.array([0.05, -0.01]), middle + np.array([-0.02, 0.015])) if robot.arms is not None else (middle, middle)
    maneuvers = []
    for i in range(windows):
        cg = np.tile(postures[i // 4 % 2], (_STEPS, 1))
        command = np.array(_COMMANDS[i % len(_COMMANDS)])
        wheels = np.tile(model.wheels(command, cg[0], model.nominal), (_STEPS, 1))
        dt, ends = np.full(_STEPS, _DT), np.array([_STEPS])
        maneuvers.append(Maneuver(dt, wheels, np.zeros((1, 3)), ends, cg, np.diag(_SIGMAS**2), group=f"{i}"))
    starts = np.arange(windows) * _STEPS * _DT
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
    return measured_with(drive, model, hypothesis, rng.normal(0.0, 1.0, (len(drive.maneuvers), 3)), has_inertia)


def measured_with(drive: Drive, model: MotionModel, hypothesis: Hypothesis, errors: FloatArray, has_inertia: bool = False) -> Drive:
    """``drive`` as it would have been measured with ``errors`` (W, 3) of x, y and yaw, in sigmas of `law_drive`, where ``hypothesis``
    holds."""
    unmoved = tuple(dataclasses.replace(m, measured=np.zeros((1, 3))) for m in drive.maneuvers)
    predictor = DrivePredictor(dataclasses.replace(drive, maneuvers=unmoved), model, has_inertia)
    poses = se2.inverse(predictor.discrepancies(hypothesis)[:, :3])  # of the origin in the predicted frames
    noisy = se2.compose(poses, errors * _SIGMAS)
    maneuvers = tuple(dataclasses.replace(m, measured=pose[None]) for m, pose in zip(drive.maneuvers, noisy, strict=True))
    return dataclasses.replace(drive, maneuvers=maneuvers)


def drawn_errors(windows: int, rng: np.random.Generator, kind: str) -> FloatArray:
    """(W, 3) errors of x, y and yaw with unit variances for `measured_with`: ``kind`` is independent, correlated (y with yaw by 0.6, and
    windows with those before by 0.5) or outlier (one window off by 20 sigmas in all three)."""
    errors = rng.normal(0.0, 1.0, (windows, 3))
    if kind == "correlated":
        for i in range(1, windows):
            errors[i] = 0.5 * errors[i - 1] + np.sqrt(0.75) * errors[i]
        errors[:, 1] = 0.8 * errors[:, 1] + 0.6 * errors[:, 2]
    elif kind == "outlier":
        errors[rng.integers(windows)] = 20.0 * rng.choice([-1.0, 1.0], 3)
    return errors


def expected_noise(windows: int, factor: FloatArray, kind: str) -> FloatArray:
    """Sigma that `estimate_noise` should give over `law_drive`'s, of errors ``factor`` times those of `drawn_errors`.

    The reference's own sigma counts for 4 windows (`Baseline.windows`). An outlier counts as 9 variances v:
    v = ((W - 1) factor^2 + 9 v) / W.
    """
    variance = np.square(factor) * ((windows - 1.0) / (windows - 9.0) if kind == "outlier" else 1.0)
    return np.sqrt((windows * variance + 4.0) / (windows + 4.0))
