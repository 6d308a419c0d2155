"""A pose in three dimensions with its covariance, and rotations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from motion_models import se2, se3
from motion_models.se2 import Cov3, FloatArray, Pose2

_PLANAR = [0, 1, 5]


@dataclass(frozen=True, eq=False)
class Pose3:
    """A pose ``world_T_body`` in space, z up."""

    position: FloatArray
    """(3,) [m]."""
    rotation: FloatArray
    """(3, 3) from the body's axes into the world's."""
    covariance: FloatArray
    """(6, 6) of x, y, z, roll, pitch, yaw in the world's axes [m, rad], as in nav_msgs/Odometry."""

    def from_above(self) -> tuple[Pose2, Cov3]:
        """The planar pose (3,) below it, and the covariance (3, 3) of its right perturbation."""
        yaw = math.atan2(self.rotation[1, 0], self.rotation[0, 0])
        planar = self.covariance[np.ix_(_PLANAR, _PLANAR)]
        return np.array([self.position[0], self.position[1], yaw]), se2.rotate_covariance(planar, -yaw)

    def moved(self, delta: Pose2, cov: Cov3) -> Pose3:
        """The pose after a planar motion (3,) in the body's plane, whose right perturbation has ``cov`` (3, 3)."""
        way, rotation = self.rotation @ [delta[0], delta[1], 0.0], self.rotation @ yaw_rotation(float(delta[2]))
        lever, world = _lever(way), np.kron(np.eye(2), rotation)
        return Pose3(self.position + way, rotation, lever @ self.covariance @ lever.T + world @ _in_plane(cov) @ world.T)

    def placed(self, start: Pose2, cov: Cov3) -> Pose3:
        """The pose where the world's frame is at ``start`` (3,), whose right perturbation has ``cov`` (3, 3)."""
        R = yaw_rotation(float(start[2]))
        way, world = R @ self.position, np.kron(np.eye(2), R)
        lever = _lever(way)
        covariance = world @ self.covariance @ world.T + lever @ world @ _in_plane(cov) @ world.T @ lever.T
        return Pose3(np.array([start[0], start[1], 0.0]) + way, R @ self.rotation, covariance)


def _in_plane(cov: Cov3) -> FloatArray:
    """(6, 6) of x, y, z, roll, pitch, yaw by the planar ``cov`` (3, 3)."""
    full = np.zeros((6, 6))
    full[np.ix_(_PLANAR, _PLANAR)] = cov
    return full


def _lever(way: FloatArray) -> FloatArray:
    """(6, 6) how an error of the pose before ``way`` (3,) moves the one after it, in the world's axes."""
    lever = np.eye(6)
    lever[:3, 3:] = -se3.cross(way)
    return lever


def yaw_rotation(angle: float) -> FloatArray:
    """(3, 3) turn about the z axis [rad]."""
    return se3.lift(np.array([0.0, 0.0, angle]))[:3, :3]


def aligning(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 3) the smallest rotation that turns the unit vector ``a`` into ``b``, not its opposite (Rodrigues)."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    w = 1.0 / (1.0 + ax * bx + ay * by + az * bz)
    return np.array(
        [
            [1.0 - w * (y * y + z * z), w * x * y - z, w * x * z + y],
            [w * x * y + z, 1.0 - w * (x * x + z * z), w * y * z - x],
            [w * x * z - y, w * y * z + x, 1.0 - w * (x * x + y * y)],
        ]
    )


def quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation (3, 3), w >= 0 (Shepperd 1978)."""
    r = rotation
    squares = [1.0 + r[0, 0] - r[1, 1] - r[2, 2], 1.0 - r[0, 0] + r[1, 1] - r[2, 2], 1.0 - r[0, 0] - r[1, 1] + r[2, 2], 1.0 + np.trace(r)]
    k = int(np.argmax(squares))
    twice = 2.0 * math.sqrt(squares[k])
    rows = (
        (squares[0], r[0, 1] + r[1, 0], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]),
        (r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]),
        (r[2, 0] + r[0, 2], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]),
        (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]),
    )
    found = np.array(rows[k]) / twice * (-1.0 if rows[k][3] < 0.0 else 1.0)
    return float(found[0]), float(found[1]), float(found[2]), float(found[3])
