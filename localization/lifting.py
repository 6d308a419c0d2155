"""Poses in three dimensions: planar motions lifted into the body's plane, which the attitude tilts.

An estimator in the plane measures the motion along the ground and the turn about the body's z axis. With roll and pitch by the attitude
filter these are motions in space: each goes along the tilted body, and the next vertical is that of the attitude.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.inputs.attitude import AttitudeFilter
from localization.output import whole_file
from localization.space_pose import Pose3, aligning, quaternion, yaw_rotation
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2

_LASTING_M = 2.0
"""Way over which errors of roll and pitch last, beside those of the mount, which stay."""


class Lifting:
    """`add` each planar estimate, in order of time; the pose in space starts level at the first planar one."""

    def __init__(self) -> None:
        self._planar: Pose2 | None = None
        self._position, self._rotation = np.zeros(3), np.eye(3)
        self._way = 0.0

    def add(self, planar: Pose2, cov: Cov3, ground_up: FloatArray, variances: tuple[float, float]) -> Pose3:
        """The pose in space at the planar pose (3,), whose right perturbation has the covariance ``cov`` (3, 3).

        ``ground_up`` (3,) and ``variances`` as of `AttitudeFilter`: the vertical there, and what is uncertain about it.
        """
        if self._planar is None:
            self._position[:2], self._rotation = planar[:2], yaw_rotation(float(planar[2]))
            self._rotation = self._rotation @ aligning(ground_up, np.array([0.0, 0.0, 1.0]))
        else:
            dx, dy, turn = se2.between(self._planar, planar).tolist()
            before, turned = self._rotation, self._rotation @ yaw_rotation(turn)
            self._rotation = turned @ aligning(ground_up, turned[2])
            along = np.array([dx, dy, 0.0])
            self._position = self._position + 0.5 * (before @ along + self._rotation @ (yaw_rotation(-turn) @ along))
            self._way += math.hypot(dx, dy)
        self._planar = planar
        return Pose3(self._position, self._rotation, self._covariance(cov, *variances))

    def _covariance(self, cov: Cov3, tilt: float, mount: float) -> FloatArray:
        """(6, 6): the planar covariance in the body's plane, and height, roll and pitch by the attitude's."""
        net = float(self._position[:2] @ self._position[:2])
        body = np.zeros((3, 3))
        body[:2, :2], body[2, 2] = cov[:2, :2], mount * net + tilt * self._way * min(self._way, _LASTING_M)
        full = np.zeros((6, 6))
        full[:3, :3] = self._rotation @ body @ self._rotation.T
        full[3, 3] = full[4, 4] = tilt + mount
        full[5, 5] = cov[2, 2]
        full[:2, 5] = full[5, :2] = self._rotation[:2, :2] @ cov[:2, 2]
        return full


@dataclass(frozen=True, eq=False)
class Trajectory3:
    """Poses ``world_T_body`` in space, in order of time."""

    stamps_ns: IntArray
    """(N,)"""
    positions: FloatArray
    """(N, 3) [m]."""
    quaternions: FloatArray
    """(N, 4) x, y, z, w."""
    covariances: FloatArray
    """(N, 6, 6) of x, y, z, roll, pitch, yaw in the world's axes [m, rad]."""
    is_lifted: bool
    """Lifted from planar poses; else of an estimator in space."""

    @property
    def sigmas(self) -> FloatArray:
        """(N, 6) of x, y, z, roll, pitch, yaw [m, rad]."""
        return np.sqrt(np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0))

    def with_end(self, end: Trajectory3) -> Trajectory3:
        """The poses before the first of ``end``, and those."""
        before = self.stamps_ns < end.stamps_ns[0]
        return Trajectory3(
            np.concatenate([self.stamps_ns[before], end.stamps_ns]),
            np.concatenate([self.positions[before], end.positions]),
            np.concatenate([self.quaternions[before], end.quaternions]),
            np.concatenate([self.covariances[before], end.covariances]),
            is_lifted=False,
        )

    def poses(self) -> Iterator[Pose3]:
        """All poses, in order of time."""
        for position, turn, covariance in zip(self.positions, self.quaternions.tolist(), self.covariances, strict=True):
            yield Pose3(position, _rotation(*turn), covariance)


def _rotation(x: float, y: float, z: float, w: float) -> FloatArray:
    """(3, 3) of a unit quaternion."""
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


class AttitudeTable:
    """The ground's verticals in body axes by stamp, 48 bytes each; one that is not later than the last is left out."""

    def __init__(self) -> None:
        self._stamps, self._numbers = array("q"), array("d")

    def __len__(self) -> int:
        """Verticals so far."""
        return len(self._stamps)

    def add(self, stamp_ns: int, attitude: AttitudeFilter) -> None:
        """Append the vertical as it is."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._numbers.extend((*attitude.ground_up.tolist(), *attitude.tilt_variances))

    def lift(self, planar: Trajectory) -> Trajectory3:
        """The poses in space of a ``planar`` trajectory, from the first vertical on."""
        stamps, rows = np.array(self._stamps, dtype=np.int64), np.array(self._numbers).reshape(-1, 5)
        lifting, known, numbers = Lifting(), np.isin(planar.stamps_ns, stamps), []
        at = np.searchsorted(stamps, planar.stamps_ns[known])
        covariances = np.zeros((len(planar), 3, 3)) if planar.covariances is None else planar.covariances
        for pose, cov, row in zip(planar.poses[known], covariances[known], rows[at], strict=True):
            found = lifting.add(pose, cov, row[:3], (float(row[3]), float(row[4])))
            numbers.append(_row_of(found))
        return _trajectory(planar.stamps_ns[known], np.array(numbers), is_lifted=True)


class SpaceTable:
    """Poses in space by stamp; one that is not later than the last is left out."""

    def __init__(self) -> None:
        self._stamps, self._numbers = array("q"), array("d")

    def __len__(self) -> int:
        """Poses so far."""
        return len(self._stamps)

    def add(self, stamp_ns: int, pose: Pose3) -> None:
        """Append a pose."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._numbers.frombytes(_row_of(pose).tobytes())

    def trajectory(self, before: Trajectory3 | None = None) -> Trajectory3:
        """All poses so far, after those of ``before``."""
        own = _trajectory(np.array(self._stamps, dtype=np.int64), np.array(self._numbers), is_lifted=False)
        if before is None:
            return own
        return before.with_end(own)


def _row_of(pose: Pose3) -> FloatArray:
    """(43,) position, quaternion, covariance."""
    return np.concatenate([pose.position, quaternion(pose.rotation), pose.covariance.ravel()])


def _trajectory(stamps_ns: IntArray, numbers: FloatArray, *, is_lifted: bool) -> Trajectory3:
    table = numbers.reshape(-1, 43)
    return Trajectory3(stamps_ns, table[:, :3], table[:, 3:7], table[:, 7:].reshape(-1, 6, 6), is_lifted)


def write_tum3(path: Path, trajectory: Trajectory3 | None) -> None:
    """Write a TUM file of poses in space; none where there is no ``trajectory``. Raises `OutputError` as `trajectory.write_tum`."""
    if trajectory is None:
        return
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for stamp, row in zip(trajectory.stamps_ns.tolist(), np.hstack([trajectory.positions, trajectory.quaternions]).tolist(), strict=True):
        sign, (seconds, nanoseconds) = "-" if stamp < 0 else "", divmod(abs(stamp), 10**9)
        lines.append(f"{sign}{seconds}.{nanoseconds:09d} {' '.join(map(repr, row))}\n")
    with whole_file(path) as file:
        file.write("".join(lines).encode("ascii"))
