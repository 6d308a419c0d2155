"""`map_merge.merge` of maps in space: the second drive's keyframes are localized in the first map, and a graph on SE(3) ties them to it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from localization.estimators.map_merge import MAX_OFF_M, Merged, find_closures, refuse_few
from localization.estimators.space_graph import Between, SpaceGraph
from localization.lidar.cloud_loops import CloudLoop
from localization.maps import SpaceMap
from localization.maps.space_changes import find_gone, without
from localization.maps.space_localizer import SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlaces
from localization.trajectory import IntArray
from motion_models import se3
from motion_models.se2 import FloatArray, Pose2
from motion_models.se3 import Transform3

_FLOOR_COV = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.005]) ** 2
"""Covariance of a motion or closure, at least: maps bend, as in the plane [m^2, rad^2]."""
_START_COV = np.diag([10.0, 10.0, 10.0, 1.0, 1.0, 1.0]) ** 2
"""Covariance of the second map's place in the first beside its ties [m^2, rad^2]."""
_LEAST_ON, _MOST_OFF = 0.5, 0.1
"""Shares of a cloud's points on and off surfaces of the first map, from which on and up to which it ties its keyframe: right places have
0.9 and below 0.01, the best of wrong ones 0.34 and 0.27."""
_LEAST_NEW = 0.1
"""Share of a cloud's points farther than a voxel from all points of the map, from which on the keyframe adds to it."""


def merge_in_space(
    first: SpaceMap, second: SpaceMap, range_noise_m: float, only_new: bool = False, initial: Pose2 | None = None
) -> Merged[SpaceMap]:
    """See `map_merge.merge`. With ``only_new``, keyframes that have what the first map does not have, and that without
    what is gone."""
    places = SpacePlaces(first, range_noise_m)
    closures = _closures(places, second, initial)
    refuse_few(len(closures), len(second.poses))
    poses, covs = _solve(second, closures)
    keys = list(closures)
    measured = np.array([closures[k][0] for k in keys])
    errors = np.linalg.norm(poses[keys, :3, 3] - measured[:, :3, 3], axis=1)
    moved = poses[keys[0]] @ se3.inverse(second.poses[keys[0]]) @ second.poses[keys]
    bent = np.linalg.norm(poses[keys, :3, 3] - moved[:, :3, 3], axis=1)
    kept, n_points = np.arange(len(second.poses)), len(first.points)
    if only_new:
        kept = _new_keyframes(places, second, poses)
        first = without(first, find_gone(first, replace(second, poses=poses), places.cell))
    joined = _join(first, second, kept, (poses, covs), closures)
    return Merged(joined, len(keys), errors, bent, len(kept), n_points - len(first.points))


def _closures(places: SpacePlaces, second: SpaceMap, initial: Pose2 | None) -> dict[int, tuple[Transform3, FloatArray]]:
    """Pose (4, 4) in the first map and covariance (6, 6), by keyframe of the ``second``."""
    clouds = second.clouds()

    def close(localizer: SpaceLocalizer, before: int, k: int) -> tuple[Transform3, FloatArray] | None:
        motion = SpaceMotion(se3.inverse(second.poses[before]) @ second.poses[k], _FLOOR_COV)
        localizer.add(clouds[k], motion, second.poses[k][:3, :3])
        if localizer.state != "localized":
            return None
        place = places.align(clouds[k], localizer.pose, localizer.covariance + _FLOOR_COV)
        is_near = math.hypot(*(place.pose[:3, 3] - localizer.pose[:3, 3])) <= MAX_OFF_M
        is_fitting = place.on_surfaces >= _LEAST_ON and place.off_surfaces <= _MOST_OFF
        return (place.match.measured, place.cov + _FLOOR_COV) if is_fitting and is_near else None

    keys = [k for k, cloud in enumerate(clouds) if len(cloud)]
    return find_closures(keys, lambda near: SpaceLocalizer(places, near), close, initial)


def _solve(second: SpaceMap, closures: dict[int, tuple[Transform3, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Poses (K, 4, 4) of the ``second`` map in the first, and covariances (K, 6, 6). Node 0 of the graph is the first map's frame."""
    k, (pose, _) = next(iter(closures.items()))
    starts = pose @ se3.inverse(second.poses[k]) @ second.poses
    graph = SpaceGraph(np.eye(1), 1.0, poses=[np.eye(4), *starts])
    graph.betweens.append(Between(0, starts[0], np.linalg.inv(_START_COV)))
    for i in range(len(starts) - 1):
        graph.betweens.append(Between(i + 1, se3.inverse(starts[i]) @ starts[i + 1], np.linalg.inv(_FLOOR_COV)))
    graph.loops = [CloudLoop(0, k + 1, pose, cov) for k, (pose, cov) in closures.items()]
    smoothed = graph.smooth()
    covs = np.array([smoothed.relative_cov(0, i + 1) for i in range(len(starts))])
    return se3.inverse(smoothed.poses[0]) @ smoothed.poses[1:], 0.5 * (covs + covs.swapaxes(1, 2))


def _new_keyframes(places: SpacePlaces, second: SpaceMap, poses: FloatArray) -> IntArray:
    """Keyframes of the ``second`` map, at ``poses`` (K, 4, 4) in the first, that have what neither it nor those before them have."""
    known, kept = places.points, []
    for k, cloud in enumerate(second.clouds()):
        if not len(cloud):
            continue
        points = se3.transform(poses[k], cloud)
        distances, _ = cKDTree(known).query(points, distance_upper_bound=places.cell)
        if np.isinf(distances).mean() >= _LEAST_NEW:
            kept.append(k)
            known = np.vstack([known, points])
    return np.array(kept, dtype=np.int64)


def _join(
    first: SpaceMap,
    second: SpaceMap,
    kept: IntArray,
    solved: tuple[FloatArray, FloatArray],
    closures: dict[int, tuple[Transform3, FloatArray]],
) -> SpaceMap:
    """Both as one: of the ``second`` the keyframes ``kept``, at the poses and covariances ``solved``, tied by ``closures`` to the nearest
    keyframes of the ``first``."""
    n, new = len(first.poses), second.select(kept)
    poses, covs = solved[0][kept], solved[1][kept]
    covs = covs + np.array([first.cov_at(pose) for pose in poses]).reshape(-1, 6, 6)
    tied = [(i, *closures[k]) for i, k in enumerate(kept.tolist()) if k in closures]
    nearest = [int(np.argmin(np.linalg.norm(first.poses[:, :3, 3] - pose[:3, 3], axis=1))) for _, pose, _ in tied]
    ties = [se3.inverse(first.poses[j]) @ pose for j, (_, pose, _) in zip(nearest, tied, strict=True)]
    ends = [(j, n + i) for j, (i, _, _) in zip(nearest, tied, strict=True)]
    return SpaceMap(
        stamps_ns=np.r_[first.stamps_ns, new.stamps_ns],
        poses=np.vstack([first.poses, poses]),
        covariances=np.vstack([first.covariances, 0.5 * (covs + covs.swapaxes(1, 2))]),
        points=np.vstack([first.points, new.points]),
        counts=np.r_[first.counts, new.counts],
        sensors=np.vstack([first.sensors, new.sensors]),
        edges=np.vstack([first.edges, new.edges + n, np.array(ends, dtype=np.int64).reshape(-1, 2)]),
        edge_deltas=np.vstack([first.edge_deltas, new.edge_deltas, np.array(ties).reshape(-1, 4, 4)]),
        edge_information=np.vstack(
            [first.edge_information, new.edge_information, np.array([np.linalg.inv(cov) for _, _, cov in tied]).reshape(-1, 6, 6)]
        ),
        edge_is_loop=np.r_[first.edge_is_loop, new.edge_is_loop, np.ones(len(tied), dtype=bool)],
    )
