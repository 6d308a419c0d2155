"""The map of a pose graph: keyframe poses, the scan of each, and the motions that were measured between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from localization.maps.position_plane import PositionPlane
from motion_models import se2
from motion_models.se2 import FloatArray, Points2, Pose2

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KeyframeMap:
    """K keyframes with M scan points in all, and E measured motions."""

    stamps_ns: IntArray
    """(K,)"""
    poses: FloatArray
    """(K, 3) ``map_T_body`` [m, m, rad]."""
    covariances: FloatArray
    """(K, 3, 3) of their right perturbations."""
    points: NDArray[np.float32]
    """(M, 2) scan points of all keyframes, one after the other, each in the body frame of its keyframe [m]."""
    counts: IntArray
    """(K,) points of each keyframe; 0 where it has no scan."""
    sensors: FloatArray
    """(K, 2) where the LiDAR of the scan is in the body frame [m]: beams start there."""
    edges: IntArray
    """(E, 2) keyframes a and b of each motion measured by gyro and scans."""
    edge_deltas: FloatArray
    """(E, 3) ``a_T_b``."""
    edge_information: FloatArray
    """(E, 3, 3) of their right perturbations."""
    edge_is_loop: NDArray[np.bool_]
    """(E,) whether it is a loop closure."""
    plane: PositionPlane | None = None
    """Pose of the map in the plane of the fused positions; None without positions."""

    def scans(self) -> list[Points2]:
        """The points (n, 2) of each keyframe in its body frame [m]."""
        return np.split(self.points.astype(float), np.cumsum(self.counts)[:-1])

    def points_in_map(self) -> Points2:
        """(M, 2) all points in the map's frame [m]."""
        moved = [se2.transform(pose, scan) for pose, scan in zip(self.poses, self.scans(), strict=True) if len(scan)]
        return np.vstack(moved) if moved else np.empty((0, 2))

    def moved(self, to_T_map: Pose2) -> KeyframeMap:
        """The map in another frame, where this one is at ``to_T_map`` (3,)."""
        plane = self.plane
        plane = None if plane is None else replace(plane, plane_T_map=se2.compose(plane.plane_T_map, se2.inverse(to_T_map)))
        if plane is not None:
            A = se2.adjoint(to_T_map)
            plane = replace(plane, covariance=np.asarray(A @ plane.covariance @ A.T))
        return replace(self, poses=se2.compose(to_T_map, self.poses), plane=plane)

    def select(self, kept: IntArray) -> KeyframeMap:
        """The keyframes ``kept`` (N,) in their order, with the motions between these alone."""
        scans, (edges, is_kept) = self.scans(), edges_among(self.edges, kept)
        return KeyframeMap(
            stamps_ns=self.stamps_ns[kept],
            poses=self.poses[kept],
            covariances=self.covariances[kept],
            points=np.vstack([np.empty((0, 2)), *(scans[k] for k in kept)]).astype(np.float32),
            counts=self.counts[kept],
            sensors=self.sensors[kept],
            edges=edges,
            edge_deltas=self.edge_deltas[is_kept],
            edge_information=self.edge_information[is_kept],
            edge_is_loop=self.edge_is_loop[is_kept],
            plane=self.plane,
        )


def edges_among(edges: IntArray, kept: IntArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """The ``edges`` (E, 2) that tie two of the keyframes ``kept`` (N,), numbered as these are there, and which of all they are (E,)."""
    number = {int(k): i for i, k in enumerate(kept)}
    is_kept = np.array([a in number and b in number for a, b in edges.tolist()], dtype=bool)
    among = [[number[a], number[b]] for a, b in edges[is_kept].tolist()]
    return np.array(among, dtype=np.int64).reshape(-1, 2), is_kept
