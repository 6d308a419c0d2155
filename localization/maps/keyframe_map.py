"""The map of a pose graph: keyframe poses, the scan or cloud of each, and the motions that were measured between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.maps.position_plane import PositionPlane
from localization.trajectory import IntArray
from motion_models.groups import SE2, SE3, PoseGroup, between
from motion_models.se2 import FloatArray

POINT_UNIT_M = 0.005
"""Unit of a cloud's coordinates: rounding has a sigma of 1.4 mm, a tenth of a LiDAR's range noise [m]."""
_MOST_UNITS = np.iinfo(np.int16).max
"""Points farther than 163 m from the body along an axis are left out."""


@dataclass(frozen=True)
class MeasuredMotion:
    """A measured motion from keyframe ``a`` to keyframe ``b``, with the information (dim, dim) of its right perturbation."""

    a: int
    b: int
    delta: FloatArray
    """``a_T_b``: (3,) in the plane, (4, 4) in space."""
    information: FloatArray
    is_loop: bool = False

    @classmethod
    def by_cov(cls, a: int, b: int, delta: FloatArray, cov: FloatArray, *, is_loop: bool = False) -> MeasuredMotion:
        """With the covariance ``cov`` (dim, dim) of the right perturbation."""
        return cls(a, b, delta, np.asarray(np.linalg.inv(cov)), is_loop)


@dataclass(frozen=True, eq=False)
class KeyframeMap:
    """K keyframes with M points in all, and E measured motions.

    In the plane, poses are of SE(2) and have planar scans (dim 3, D 2). In space they are of SE(3) and have clouds (dim 6, D 3): z of the
    map is up, for gravity levels it, and its first keyframe is the origin.
    """

    stamps_ns: IntArray
    """(K,)"""
    poses: FloatArray
    """(K, 3) ``map_T_body`` [m, m, rad], or (K, 4, 4) [m]."""
    covariances: FloatArray
    """(K, dim, dim) of their right perturbations."""
    points: NDArray[np.float32] | NDArray[np.int16]
    """(M, D) points of all keyframes, one after the other, each in the body frame of its keyframe: [m], in space in `POINT_UNIT_M`."""
    counts: IntArray
    """(K,) points of each keyframe; 0 where it has no scan."""
    sensors: FloatArray
    """(K, D) where the LiDAR of the scan is in the body frame [m]: beams start there."""
    edges: IntArray
    """(E, 2) keyframes a and b of each motion measured by gyro and scans."""
    edge_deltas: FloatArray
    """(E, 3) or (E, 4, 4) ``a_T_b``."""
    edge_information: FloatArray
    """(E, dim, dim) of their right perturbations."""
    edge_is_loop: NDArray[np.bool_]
    """(E,) whether it is a loop closure."""
    plane: PositionPlane | None = None
    """Pose of a planar map in the plane of the fused positions; None without positions."""

    @property
    def is_in_space(self) -> bool:
        """Whether it holds clouds in space."""
        return self.poses.ndim == 3

    @property
    def group(self) -> PoseGroup:
        """SE(2) or SE(3)."""
        return SE3 if self.is_in_space else SE2

    def scans(self) -> list[FloatArray]:
        """The points (n, D) of each keyframe in its body frame [m]."""
        unit = POINT_UNIT_M if self.is_in_space else 1.0
        return np.split(unit * self.points.astype(float), np.cumsum(self.counts)[:-1])

    def points_in_map(self) -> FloatArray:
        """(M, D) all points in the map's frame [m]."""
        moved = [self.group.transform(pose, scan) for pose, scan in zip(self.poses, self.scans(), strict=True) if len(scan)]
        return np.vstack([np.empty((0, self.points.shape[1])), *moved])

    def sensors_in_map(self) -> FloatArray:
        """(K, D) where the LiDAR was at each keyframe, in the map's frame [m]."""
        return np.array([self.group.transform(pose, sensor[None])[0] for pose, sensor in zip(self.poses, self.sensors, strict=True)])

    def nearest(self, pose: FloatArray) -> int:
        """The keyframe nearest to ``pose``."""
        return int(np.argmin(np.linalg.norm(self.group.position(self.poses) - self.group.position(pose), axis=1)))

    def cov_at(self, pose: FloatArray) -> FloatArray:
        """(dim, dim) the map's own covariance at ``pose``, a right perturbation of it: that of the nearest keyframe."""
        k = self.nearest(pose)
        A = self.group.adjoint(between(self.group, pose, self.poses[k]))
        return np.asarray(A @ self.covariances[k] @ A.T)

    def moved(self, to_T_map: FloatArray) -> KeyframeMap:
        """The planar map in another frame, where this one is at ``to_T_map`` (3,)."""
        plane = self.plane
        if plane is not None:
            A = SE2.adjoint(to_T_map)
            moved = SE2.compose(plane.plane_T_map, SE2.inverse(to_T_map))
            plane = replace(plane, plane_T_map=moved, covariance=np.asarray(A @ plane.covariance @ A.T))
        return replace(self, poses=SE2.compose(to_T_map, self.poses), plane=plane)

    def select(self, kept: IntArray) -> KeyframeMap:
        """The keyframes ``kept`` (N,) in their order, with the motions between these alone."""
        scans = np.split(self.points, np.cumsum(self.counts)[:-1])
        number = {int(k): i for i, k in enumerate(kept)}
        is_kept = np.array([a in number and b in number for a, b in self.edges.tolist()], dtype=bool)
        return replace(
            self,
            stamps_ns=self.stamps_ns[kept],
            poses=self.poses[kept],
            covariances=self.covariances[kept],
            points=np.concatenate([self.points[:0], *(scans[k] for k in kept)]),
            counts=self.counts[kept],
            sensors=self.sensors[kept],
            edges=np.array([[number[a], number[b]] for a, b in self.edges[is_kept].tolist()], dtype=np.int64).reshape(-1, 2),
            edge_deltas=self.edge_deltas[is_kept],
            edge_information=self.edge_information[is_kept],
            edge_is_loop=self.edge_is_loop[is_kept],
        )

    def joined(self, other: KeyframeMap, ties: Sequence[MeasuredMotion]) -> KeyframeMap:
        """This map and ``other`` of the same kind in its frame as one, whose keyframes follow; ``ties`` are motions between both."""
        tied = _edges(self.group, ties)
        arrays = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _OF_KEYFRAMES}
        arrays |= {name: np.concatenate([getattr(self, name), getattr(other, name), tied[name]]) for name in _OF_EDGES}
        edges = np.concatenate([self.edges, other.edges + len(self.poses), tied["edges"]])
        return KeyframeMap(edges=edges, **arrays, plane=self.plane)

    def without(self, gone: NDArray[np.bool_]) -> KeyframeMap:
        """The map without the points that are ``gone`` (M,)."""
        keys = np.repeat(np.arange(len(self.counts)), self.counts)
        counts = np.bincount(keys[~gone], minlength=len(self.counts))
        return replace(self, points=self.points[~gone], counts=counts)


_OF_KEYFRAMES = ("stamps_ns", "poses", "covariances", "points", "counts", "sensors")
_OF_EDGES = ("edge_deltas", "edge_information", "edge_is_loop")


@dataclass(frozen=True, eq=False)
class MappedKeyframe:
    """A keyframe of a map."""

    stamp_ns: int
    pose: FloatArray
    """``map_T_body``: (3,) in the plane, (4, 4) in space."""
    scan: FloatArray
    """(N, 2) or (N, 3) points in the body frame [m]; none where it has no scan."""
    sensor: FloatArray
    """(2,) or (3,) where the LiDAR is in the body frame [m]."""
    cov: FloatArray
    """(dim, dim) of the pose's right perturbation."""


def make_map(
    keyframes: Sequence[MappedKeyframe], motions: Sequence[MeasuredMotion] = (), plane: PositionPlane | None = None
) -> KeyframeMap:
    """The map of ``keyframes``, one at least, all in the plane or all in space, and of the ``motions`` between them."""
    poses, covs = np.array([key.pose for key in keyframes]), np.array([key.cov for key in keyframes])
    is_in_space = poses.ndim == 3
    points, counts = in_units([key.scan for key in keyframes]) if is_in_space else _in_metres([key.scan for key in keyframes])
    return KeyframeMap(
        stamps_ns=np.array([key.stamp_ns for key in keyframes], dtype=np.int64),
        poses=poses,
        covariances=0.5 * (covs + covs.swapaxes(1, 2)),
        points=points,
        counts=counts,
        sensors=np.array([key.sensor for key in keyframes]),
        **_edges(SE3 if is_in_space else SE2, motions),
        plane=plane,
    )


def in_units(clouds: Sequence[FloatArray]) -> tuple[NDArray[np.int16], IntArray]:
    """``clouds`` (n, 3) [m] as (M, 3) in units of `POINT_UNIT_M`, and how many points each has (K,)."""
    rounded = [np.rint(cloud.reshape(-1, 3).astype(float) / POINT_UNIT_M) for cloud in clouds]
    kept = [units[(np.abs(units) <= _MOST_UNITS).all(axis=1)].astype(np.int16) for units in rounded]
    return np.vstack([np.empty((0, 3), np.int16), *kept]), np.array([len(units) for units in kept], dtype=np.int64)


def _in_metres(scans: Sequence[FloatArray]) -> tuple[NDArray[np.float32], IntArray]:
    points = np.vstack([np.empty((0, 2)), *scans]).astype(np.float32)
    return points, np.array([len(scan) for scan in scans], dtype=np.int64)


def _edges(group: PoseGroup, motions: Sequence[MeasuredMotion]) -> dict[str, NDArray[Any]]:
    """The ``motions`` as arrays of a `KeyframeMap`."""
    return {
        "edges": np.array([(motion.a, motion.b) for motion in motions], dtype=np.int64).reshape(-1, 2),
        "edge_deltas": np.array([motion.delta for motion in motions], dtype=float).reshape(-1, *group.identity().shape),
        "edge_information": np.array([motion.information for motion in motions], dtype=float).reshape(-1, group.dim, group.dim),
        "edge_is_loop": np.array([motion.is_loop for motion in motions], dtype=bool),
    }
