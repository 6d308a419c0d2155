"""The map of a pose graph in space: keyframe poses on SE(3), the cloud of each, and the motions that were measured between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.maps.keyframe_map import edges_among
from localization.trajectory import IntArray
from motion_models import se3
from motion_models.se2 import FloatArray
from motion_models.se3 import Transform3

POINT_UNIT_M = 0.005
"""Unit of a cloud's coordinates: rounding has a sigma of 1.4 mm, a tenth of a LiDAR's range noise [m]."""
_MOST_UNITS = np.iinfo(np.int16).max
"""Points farther than 163 m from the body along an axis are left out."""


@dataclass(frozen=True, eq=False)
class SpaceMap:
    """K keyframes with M points in all, and E measured motions. z of the map is up: gravity levels it; its first keyframe is the origin."""

    stamps_ns: IntArray
    """(K,)"""
    poses: FloatArray
    """(K, 4, 4) ``map_T_body`` [m]."""
    covariances: FloatArray
    """(K, 6, 6) of their right perturbations [m, rad]."""
    points: NDArray[np.int16]
    """(M, 3) points of all keyframes, one after the other, each in the body frame of its keyframe, in units of `POINT_UNIT_M`."""
    counts: IntArray
    """(K,) points of each keyframe; 0 where it has no cloud."""
    sensors: FloatArray
    """(K, 3) where the LiDAR of the cloud is in the body frame [m]."""
    edges: IntArray
    """(E, 2) keyframes a and b of each motion measured by gyro and clouds."""
    edge_deltas: FloatArray
    """(E, 4, 4) ``a_T_b``."""
    edge_information: FloatArray
    """(E, 6, 6) of their right perturbations."""
    edge_is_loop: NDArray[np.bool_]
    """(E,) whether it is a loop closure."""

    def clouds(self) -> list[FloatArray]:
        """The points (n, 3) of each keyframe in its body frame [m]."""
        return np.split(POINT_UNIT_M * self.points.astype(float), np.cumsum(self.counts)[:-1])

    def points_in_map(self) -> FloatArray:
        """(M, 3) all points in the map's frame [m]."""
        moved = [se3.transform(pose, cloud) for pose, cloud in zip(self.poses, self.clouds(), strict=True)]
        return np.vstack([np.empty((0, 3)), *moved])

    def sensors_in_map(self) -> FloatArray:
        """(K, 3) where the LiDAR was at each keyframe, in the map's frame [m]."""
        return np.asarray((self.poses[:, :3, :3] @ self.sensors[:, :, None])[:, :, 0] + self.poses[:, :3, 3])

    def select(self, kept: IntArray) -> SpaceMap:
        """The keyframes ``kept`` (N,) in their order, with the motions between these alone."""
        parts, (edges, is_kept) = np.split(self.points, np.cumsum(self.counts)[:-1]), edges_among(self.edges, kept)
        return SpaceMap(
            stamps_ns=self.stamps_ns[kept],
            poses=self.poses[kept],
            covariances=self.covariances[kept],
            points=np.vstack([np.empty((0, 3), np.int16), *(parts[k] for k in kept)]),
            counts=self.counts[kept],
            sensors=self.sensors[kept],
            edges=edges,
            edge_deltas=self.edge_deltas[is_kept],
            edge_information=self.edge_information[is_kept],
            edge_is_loop=self.edge_is_loop[is_kept],
        )

    def cov_at(self, pose: Transform3) -> FloatArray:
        """(6, 6) the map's own covariance at ``pose`` (4, 4), a right perturbation of it: that of the nearest keyframe."""
        k = int(np.argmin(np.linalg.norm(self.poses[:, :3, 3] - pose[:3, 3], axis=1)))
        A = se3.adjoint(se3.inverse(pose) @ self.poses[k])
        return np.asarray(A @ self.covariances[k] @ A.T)


def in_units(clouds: Sequence[FloatArray]) -> tuple[NDArray[np.int16], IntArray]:
    """``clouds`` (n, 3) [m] as (M, 3) in units of `POINT_UNIT_M`, and how many points each has (K,)."""
    rounded = [np.rint(cloud / POINT_UNIT_M) for cloud in clouds]
    kept = [units[(np.abs(units) <= _MOST_UNITS).all(axis=1)].astype(np.int16) for units in rounded]
    return np.vstack([np.empty((0, 3), np.int16), *kept]), np.array([len(units) for units in kept], dtype=np.int64)
