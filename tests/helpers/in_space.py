"""Replays in space, and their errors against the true poses of a drive over hills."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from localization.events import Event, Scan
from localization.inputs.step_config import StepConfig
from localization.pipeline import Pipeline, ReplayConfig, Trial
from motion_models import se3
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.hill_scans import MOUNT, SWEEP_NS
from tests.helpers.hills import HillDrive

IN_SPACE = ReplayConfig(step=StepConfig(planar=False))


@dataclass(frozen=True)
class SpaceErrors:
    """Of each estimate."""

    stamps_ns: FloatArray
    """(N,)"""
    poses: FloatArray
    """(N, 4, 4) estimated."""
    true: FloatArray
    """(N, 4, 4)"""
    errors: FloatArray
    """(N, 6) right perturbations [m, rad], in the frame of the first heading and position."""
    covariances: FloatArray
    """(N, 6, 6) of these."""

    @property
    def nees(self) -> FloatArray:
        """(N,) 6 degrees of freedom."""
        return np.array([e @ np.linalg.solve(P, e) for e, P in zip(self.errors, self.covariances, strict=True)])

    @property
    def ate(self) -> float:
        """RMS of the position after rigid alignment [m]."""
        return aligned_rms(self.poses[:, :3, 3], self.true[:, :3, 3])


def aligned_rms(found: FloatArray, true: FloatArray) -> float:
    """RMS distance (N, 3) after the best rigid alignment [m] (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.mean(np.sum((a @ R.T - b) ** 2, axis=1))))


def true_poses(drive: HillDrive, stamps_ns: FloatArray) -> FloatArray:
    """(N, 4, 4) at ``stamps_ns`` (N,), by interpolation."""
    t0 = drive.stamps_ns[0]
    seconds, at = (drive.stamps_ns - t0) * 1e-9, (np.clip(stamps_ns, t0, drive.stamps_ns[-1]) - t0) * 1e-9
    out = np.tile(np.eye(4), (len(at), 1, 1))
    out[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(drive.rotations))(at).as_matrix()
    out[:, :3, 3] = np.column_stack([np.interp(at, seconds, drive.positions[:, i]) for i in range(3)])
    return out


def in_order(drive: HillDrive, scans: list[Scan]) -> list[Event]:
    """Events as they arrive: scans at the end of their sweep."""
    return sorted([*drive.events, *scans], key=lambda e: e.stamp_ns + (SWEEP_NS if isinstance(e, Scan) else 0))


def run_in_space(
    drive: HillDrive, scans: list[Scan], model: str = "skid_steer", config: ReplayConfig = IN_SPACE
) -> tuple[SpaceErrors, Pipeline]:
    """Replay with the filter in space, from where it is in space; the pipeline as it is at the end."""
    trial = Trial(make_model(model, drive.robot), "ekf")
    pipeline = Pipeline(trial, drive.robot, {**drive.mounts, "lidar_link": MOUNT}, bool(scans), config)
    found = [e for event in in_order(drive, scans) for e in pipeline.process(event) if e.in_space is not None]
    poses, spread = np.tile(np.eye(4), (len(found), 1, 1)), []
    for pose, estimate in zip(poses, found, strict=True):
        made = estimate.in_space
        pose[:3, :3], pose[:3, 3] = made.rotation, made.position
        world = np.kron(np.eye(2), made.rotation)
        spread.append(world.T @ made.covariance @ world + 1e-12 * np.eye(6))
    stamps = np.array([e.stamp_ns for e in found])
    true = true_poses(drive, stamps)
    same = _upright(true[0]) @ se3.inverse(_upright(poses[0]))
    errors = np.array([se3.log(se3.inverse(same @ e) @ t) for e, t in zip(poses, true, strict=True)])
    return SpaceErrors(stamps, poses, true, errors, np.array(spread)), pipeline


def _upright(pose: FloatArray) -> FloatArray:
    """``pose`` with its heading alone."""
    out = np.eye(4)
    out[:3, :3] = se3.rotation(np.array([0.0, 0.0, math.atan2(pose[1, 0], pose[0, 0])]))
    out[:3, 3] = pose[:3, 3]
    return out
