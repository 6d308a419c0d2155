"""A drive linearized about a hypothesis: discrepancies, the signature of every cause, and the noise of both."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from localization.diagnosis.causes import CAUSES, WINDOW_CAUSES, Cause, Hypothesis, friction_change, slope_across
from localization.diagnosis.drive import Drive
from localization.diagnosis.noise import Noise, estimate_noise, given_noise, variance_regressors
from localization.diagnosis.prediction import DrivePredictor, with_sizes
from localization.diagnosis.subset_selection import Regression, regression
from motion_models.base import MotionModel
from motion_models.diff_drive import DiffDrive
from motion_models.friction import FrictionModel
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

SKIDDING = frozenset(
    {"track_width", "payload", "cg_offset_x", "cg_offset_y", "friction_anisotropy", "friction_change", "split_friction", "scrub"}
    | {"lateral_force_law", "diagonal_load", "tread_asymmetry", "rolling_resistance", "slope", "rotation_slip_speed"}
)
"""Causes that act by the friction of wheels that skid: none of a robot with casters, whose track is a scale of its rotation."""


@dataclass(frozen=True)
class Linearization:
    """Discrepancies of a drive about a hypothesis, to first order in the sizes of all causes."""

    causes: tuple[Cause, ...]
    rows: FloatArray
    """(M, 6) at the hypothesis."""
    linear: FloatArray
    """(M, 6) the same, moved back to the robot file by the signatures."""
    signatures: FloatArray
    """(M, 6, p)"""
    nuisances: FloatArray
    """(M, 6, q)"""
    noise: Noise
    tolerance: float
    """Sigma of causes that are not named, over what is negligible."""
    problem: Regression


def is_skid_steer(robot: Robot) -> bool:
    """Whether the robot's wheels skid in turns; a robot with casters turns by its geometry."""
    return robot.drive != DIFF_DRIVE


def default_model(robot: Robot) -> str:
    """Name of the motion model that suits ``robot``."""
    return FrictionModel.name if is_skid_steer(robot) else DiffDrive.name


def make_predictor(drive: Drive, model: MotionModel) -> DrivePredictor:
    """With inertia where that describes the drive better (or is what the friction model leaves out by its nature)."""
    plain = DrivePredictor(drive, model, has_inertia=False)
    if drive.kind != "log" or not is_skid_steer(drive.robot):
        return plain
    with_inertia = DrivePredictor(drive, model, has_inertia=True)
    squares = []
    for predictor in (plain, with_inertia):
        rows = predictor.discrepancies(Hypothesis())[:, :3]
        known = np.isfinite(rows).any(axis=0)
        squares.append(np.nanmedian(np.abs(rows[:, known]), axis=0))
    better = np.sum(np.log(np.maximum(squares[0], 1e-9)) - np.log(np.maximum(squares[1], 1e-9))) > 0.0
    return with_inertia if better or model.name == "friction" else plain


def candidate_causes(predictor: DrivePredictor, moments: int) -> tuple[Cause, ...]:
    """Causes that this drive could show; a change of the floor at so many ``moments``."""
    drive = predictor.drive
    out = set()
    if drive.gyro is None and not drive.is_gyro_reference:
        out |= {"gyro_bias", "gyro_scale", "gyro_time_offset"}
    if drive.range_slopes is None:
        out |= {"range_scale", "range_bias"}
    if drive.kind != "log":
        out.add("wheel_radius_drift")
    if not predictor.has_dropouts:
        out.add("encoder_dropout")
    if drive.is_gyro_reference:
        out |= {"lidar_offset_x", "lidar_offset_y", "lidar_yaw", "lidar_time_offset", "lateral_slip_speed", "longitudinal_slip_turning"}
    if drive.kind in ("rotations", "runs"):
        out |= {"lidar_time_offset", "wheel_time_offset", "slope", "lateral_slip_speed", "rotation_slip_speed", "longitudinal_slip_turning"}
    found = [e for e in CAUSES.values() if e.id not in out]
    if drive.kind == "log" and not drive.is_gyro_reference:
        found.append(slope_across())
        length = float(drive.starts_s[-1])
        if len(drive.maneuvers) >= 24:
            found += [friction_change(length * q) for q in np.linspace(0.1, 0.9, moments)]
    if drive.kind == "runs":
        out = {"wheel_radius_difference", "tread_asymmetry", "lidar_yaw", "gyro_bias", "encoder_dropout"}
        return tuple(e for e in found if e.id not in out)
    if not is_skid_steer(drive.robot):
        found = [e for e in found if e.id not in SKIDDING]
    if drive.kind == "windows":
        found += list(WINDOW_CAUSES.values())
    elif predictor.model.name != "friction" or drive.is_gyro_reference:  # its own number for how far it turns is not the floor's
        found.append(WINDOW_CAUSES["rotation_scale"])
    return tuple(found)


def linearize(predictor: DrivePredictor, causes: tuple[Cause, ...], sizes: dict[Cause, float], tolerance: float) -> Linearization:
    """Everything around the hypothesis that causes have these ``sizes``."""
    hypothesis = with_sizes(sizes)
    rows = predictor.discrepancies(hypothesis)
    signatures = np.stack([predictor.signature(hypothesis, e, rows) for e in causes], axis=-1)
    linear = rows.copy()
    for cause, size in sizes.items():
        linear += signatures[..., [e.key for e in causes].index(cause.key)] * size
    nuisances = _nuisances(rows)
    noise = _estimate_drive_noise(predictor, linear, signatures, nuisances, causes)
    problem = make_regression(linear, signatures, nuisances, noise, causes, tolerance)
    return Linearization(causes, rows, linear, signatures, nuisances, noise, tolerance, problem)


def with_tolerance(linearization: Linearization, tolerance: float) -> Linearization:
    """The same, with unnamed causes held to another ``tolerance``."""
    problem = make_regression(
        linearization.linear, linearization.signatures, linearization.nuisances, linearization.noise, linearization.causes, tolerance
    )
    return dataclasses.replace(linearization, tolerance=tolerance, problem=problem)


def make_regression(
    linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, causes: tuple[Cause, ...], tolerance: float
) -> Regression:
    """Whitened, without nuisances, and with what is not named within ``tolerance``."""
    y = noise.whiten(linear).ravel()
    s = noise.whiten(signatures).reshape(len(y), -1)
    z = noise.whiten(nuisances).reshape(len(y), -1)
    return regression(y, s, z, np.array([e.plausible for e in causes]), tolerance * np.array([e.negligible for e in causes]))


def _nuisances(rows: FloatArray) -> FloatArray:
    """(M, 6, 2) accelerometers and the floor under the IMU are never quite level."""
    level = np.zeros((*rows.shape, 2))
    level[:, 4, 0] = level[:, 5, 1] = 1.0
    return np.where(np.isfinite(rows)[..., None], level, np.nan)


def _estimate_drive_noise(
    predictor: DrivePredictor, linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, causes: tuple[Cause, ...]
) -> Noise:
    """Estimated from what all causes together leave, in a few rounds as sizes and noise hang on each other."""
    batch, drive = predictor.batch, predictor.drive
    g = drive.robot.geometry
    features = variance_regressors(batch, g.wheel_radius_m, g.track_width_m)
    starts = np.r_[True, batch.owner[1:] != batch.owner[:-1]]
    follows = ~starts
    if len(drive.spans_ns):
        follows = np.r_[False, drive.spans_ns[1:, 0] - drive.spans_ns[:-1, 1] < 10_000_000]
    given = np.sqrt(np.where(np.isfinite(np.diagonal(batch.cov, axis1=1, axis2=2)), np.diagonal(batch.cov, axis1=1, axis2=2), 1.0))
    sigmas = np.ones_like(linear)
    sigmas[:, :3] = given
    sigmas[:, 3] = np.hypot(given[:, 2], 1e-3)
    sigmas[:, 4:] = 0.05
    noise = given_noise(linear, sigmas, follows)
    scale = np.array([e.plausible for e in causes])
    known = np.isfinite(linear)
    for _ in range(3):
        y = noise.whiten(linear).ravel()
        design = np.hstack([noise.whiten(signatures).reshape(len(y), -1) * scale, noise.whiten(nuisances).reshape(len(y), -1) * 1e3])
        inverse = np.linalg.inv(design.T @ design + np.eye(design.shape[1]))
        x = inverse @ (design.T @ y)
        spent = np.sum((design @ inverse) * design, axis=1).reshape(linear.shape).sum(axis=0)
        p = len(causes)
        left = linear - signatures @ (x[:p] * scale) - nuisances @ (x[p:] * 1e3)
        noise = estimate_noise(np.where(known, left, np.nan), features, follows, spent, sigmas)
    return noise


def group_of(cause: Cause) -> str:
    """Name of the group of causes of which only one is tried at a time."""
    return cause.id if cause.id != "slope" else cause.key
