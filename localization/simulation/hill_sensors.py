"""What sensors measure on hills: an IMU, the true pose and a spinning LiDAR of a robot on the ground of `simulation.terrain`."""

from __future__ import annotations

import numpy as np

from localization.simulation.terrain import cast_at_ground, poses_on
from localization.simulation.vehicle import POSE, TrueMotion
from localization.simulation.world import WallGrid, cast_rays
from motion_models import se3
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

BODY_ABOVE_FLOOR_M = 0.13
"""Height of the body frame, that of the Husky's wheel axles [m]."""


def body_poses(rows: FloatArray, waves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position (n, 3) and rotation (n, 3, 3) of the body at records (n, 13)."""
    return poses_on(rows[:, POSE], waves, BODY_ABOVE_FLOOR_M)


def imu_motion(track: TrueMotion, times: FloatArray, period: float, mount: Mount, waves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rates and specific forces (n, 3) in the body's axes, by differences of the true motion over the IMU's ``period`` [s]."""
    place, places, rotations = np.array([mount.x, mount.y, mount.z]), [], []
    for shift in (0.0, -period, -2.0 * period):
        positions, own = body_poses(track.at(times + shift), waves)
        places.append(positions + own @ place)
        rotations.append(own)
    acceleration = (places[0] - 2.0 * places[1] + places[2]) / period**2
    turns = np.einsum("nji,njk->nik", rotations[1], rotations[0])
    rates = np.array([se3.rotation_vector(turn) for turn in turns]) / period
    return rates, np.einsum("nji,nj->ni", rotations[1], acceleration + np.array([0.0, 0.0, GRAVITY]))


def ring_ranges(
    rows: FloatArray, mount: Mount, angles: tuple[FloatArray, FloatArray], longest_m: float, grid: WallGrid, waves: FloatArray
) -> FloatArray:
    """(rings, columns) true ranges from the body's poses at ``rows`` (columns, 13); inf where nothing is hit.

    ``angles``: azimuths (columns,) and elevations (rings,) in the LiDAR's axes [rad].
    """
    azimuths, elevations = angles
    positions, rotations = body_poses(rows, waves)
    across = np.cos(elevations)[None]
    parts = np.cos(azimuths)[:, None] * across, np.sin(azimuths)[:, None] * across
    local = np.stack([*parts, np.broadcast_to(np.sin(elevations), parts[0].shape)], axis=-1)
    directions = np.ascontiguousarray(np.einsum("nij,nrj->nri", rotations @ mount.rotation, local))
    origins, ranges = positions + rotations @ np.array([mount.x, mount.y, mount.z]), np.empty(directions.shape[:2])
    cast_rays(origins, directions, longest_m, grid, ranges)
    cast_at_ground(origins, directions, longest_m, waves, ranges)
    return ranges.T
