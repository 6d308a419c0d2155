"""The DRIVE data set's real Husky (tests/data/drive-husky) as maneuvers, one a two-second window."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver
from motion_models.robot import Driver, Geometry, Robot
from motion_models.se2 import FloatArray

DATA = Path(__file__).parent.parent / "data" / "drive-husky"
STEP = 0.05  # s between samples
WINDOWS_PER_STEP = 3
# Scatter of the stored ICP poses between neighbouring samples.
ICP_COV = np.diag([0.02**2, 0.02**2, 0.01**2])


def robot() -> Robot:
    """The Husky of the data set: wheel radius from its configuration, track and wheelbase from the Husky's URDF, no multiplier."""
    geometry = Geometry(wheel_radius_m=0.165, track_width_m=0.5708, wheelbase_m=0.512, mass_kg=46.034)
    return Robot("drive_husky", geometry, Driver(geometry.wheel_radius_m, geometry.track_width_m, 1.0))


def columns() -> dict[str, FloatArray]:
    """The stored arrays, (603, 40) or (603,)."""
    with np.load(DATA / "husky_windows.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def frame_turn(data: dict[str, FloatArray]) -> FloatArray:
    """(603,) by how much the frame of each window's positions is turned against that of its yaws [rad].

    The data set's parser turned positions into the mean heading of the first five samples, but yaws into the first one's; and it
    took that mean of wrapped angles, which is off by up to 2 pi * 4/5 in the 11 windows that start where the heading wraps. The
    stored yaws are plain differences to the first, so the mean of five of them is exactly that turn.
    """
    return np.asarray(data["icp_yaw"][:, :5].mean(axis=1))


def maneuvers(mended: bool, reference: str = "last", ends: tuple[int, ...] = (39,)) -> list[Maneuver]:
    """The 603 windows in order; groups are the calibration steps of three windows.

    ``mended`` undoes `frame_turn`. ``reference``: "last", the ICP poses at samples ``ends``, whose instants are known; or "gt", the
    stored gt_icp, taken at the end of the next sampling gap (sample 39 to 41, not stored which).
    """
    data = columns()
    wheels = np.stack([data["left_wheel_vel"], data["right_wheel_vel"]], axis=-1)
    if reference == "gt":
        ends = (39,)
        poses = np.stack([data["gt_icp_x"], data["gt_icp_y"], data["gt_icp_yaw"]], axis=-1)[:, None]
    else:
        poses = np.stack([data["icp_x"], data["icp_y"], data["icp_yaw"]], axis=-1)[:, list(ends)]
    if mended:
        turn = np.zeros((len(poses), 1, 3))
        turn[:, 0, 2] = frame_turn(data)
        yaw = poses[..., 2].copy()
        poses = se2.compose(turn, poses)
        poses[..., 2] = yaw
    poses[..., 2] = se2.wrap_angle(poses[..., 2])
    # calib_step's labels change up to a window too late; the transitory mask starts a step exactly every third window.
    starts = data["transitory_state_mask"].reshape(-1, WINDOWS_PER_STEP)
    assert np.array_equal(starts, np.tile([1.0, 0.0, 0.0], (len(starts), 1)))
    n = max(ends)
    return [
        Maneuver(np.full(n, STEP), wheels[i, :n], poses[i], np.array(ends), cov=ICP_COV, group=f"step {i // WINDOWS_PER_STEP:03d}")
        for i in range(len(poses))
    ]
