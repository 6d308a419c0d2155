"""Join the map of a second drive to that of a first one, or what is new in it: its keyframes are localized in the first map, and a graph
ties them to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from localization.errors import MapError
from localization.estimators.graph_in_plane import PlanarKeyframes
from localization.estimators.graph_in_space import SpaceKeyframes
from localization.estimators.pose_graph import GraphUpdate, Keyframes, PoseGraph
from localization.lidar.loop_detection import FLOOR_COV
from localization.lidar.scan_matcher import OPEN_INFORMATION
from localization.maps import KeyframeMap
from localization.maps.changes import adds_to, find_changes
from localization.maps.keyframe_map import MeasuredMotion
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.maps.space_changes import find_gone
from localization.maps.space_localizer import SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlaces
from localization.trajectory import IntArray
from motion_models import se2, se3
from motion_models.groups import SE3, between
from motion_models.se2 import FloatArray, Pose2
from motion_models.se3 import Transform3

_START_SIGMA_M, _START_SIGMA_RAD = 10.0, 1.0
"""Sigma of the second map's place in the first beside its ties: a room's size and any heading, which they narrow to centimetres."""
_MAX_OFF_M = 0.3
"""Distance of an aligned scan from where the localizer has it, up to which it ties [m]: from there on 14 to 31 % of alignments end
elsewhere (`localization.lidar.registration`)."""
_LEAST_SCORE = 0.5
"""Score of a scan in the other map, from which on it ties its keyframe to that."""
_LEAST_CLOSURES = 3
"""Tied keyframes that a merge takes, at least."""
_SPACE_FLOOR_COV = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.005]) ** 2
"""Covariance of a motion or closure in space, at least: maps bend, as in the plane [m^2, rad^2]."""
_LEAST_ON, _MOST_OFF = 0.5, 0.1
"""Shares of a cloud's points on and off surfaces of the first map, from which on and up to which it ties its keyframe: right places have
0.9 and below 0.01, the best of wrong ones 0.34 and 0.27."""
_LEAST_NEW = 0.1
"""Share of a cloud's points farther than a voxel from all points of the map, from which on the keyframe adds to it."""


class Closure(NamedTuple):
    """Where a keyframe of the second map is in the first."""

    pose: FloatArray
    """(3,) or (4, 4)"""
    cov: FloatArray
    """(dim, dim) of its right perturbation."""


@dataclass(frozen=True, eq=False)
class Merged:
    """Both maps as one, in the frame of the first."""

    map: KeyframeMap
    closed: int
    """Keyframes of the second map that are tied to the first."""
    errors: FloatArray
    """(closed,) how far their scans are from the first map, where the merged map has them [m]."""
    bent: FloatArray
    """(closed,) how far the second map, moved as a whole, is from where the merged one has these keyframes [m]."""
    added: int
    """Keyframes of the second map that the merged one has."""
    removed: int = 0
    """Points of the first map that are gone by the second one."""


Search = TypeVar("Search", Localizer, SpaceLocalizer)


class _Registration(Protocol[Search]):
    """How scans or clouds of a second map are localized in a first one."""

    @property
    def keyframes(self) -> Keyframes:
        """Poses of both maps in a graph."""

    @property
    def floor_cov(self) -> FloatArray:
        """(dim, dim) of a motion or closure, at least: maps bend."""

    def start(self, near: Pose2 | None) -> Search:
        """A localizer about ``near`` (3,), or anywhere."""

    def close(self, localizer: Search, scan: FloatArray, before: FloatArray, pose: FloatArray) -> Closure | None:
        """Add a keyframe with ``scan`` to the ``localizer``, at ``pose`` in its own map and after one at ``before``: where it is in the
        first, if that is certain."""

    def new_keyframes(self, second: KeyframeMap) -> IntArray:
        """Keyframes of the ``second`` map, whose poses are in the first, that have what the first does not have."""

    def remaining(self, second: KeyframeMap) -> KeyframeMap:
        """The first map without what is gone by the ``second``."""


def merge_maps(
    first: KeyframeMap, second: KeyframeMap, range_noise_m: float, only_new: bool = False, initial: Pose2 | None = None
) -> Merged:
    """``second`` in the frame of ``first``. ``range_noise_m``: sigma of a range [m]. With ``only_new``, of the second its keyframes alone
    that add to the first, with all ties among these, and in space the first without what is gone. ``initial`` (3,): about where the second
    begins in the first. Raises `MapError` for one map in the plane and one in space, and if they share no place."""
    if first.is_in_space != second.is_in_space:
        raise MapError("one map holds planar scans, the other clouds in space: they cannot be joined. Name two of the same kind.")
    if first.is_in_space:
        return _merge(_CloudRegistration(first, range_noise_m), first, second, only_new, initial)
    return _merge(_ScanRegistration(first, range_noise_m), first, second, only_new, initial)


def _merge(by: _Registration[Search], first: KeyframeMap, second: KeyframeMap, only_new: bool, initial: Pose2 | None) -> Merged:
    closures = _find_closures(by, second, initial)
    if len(closures) < _LEAST_CLOSURES:
        raise MapError(
            f"the second map could not be joined to the first: {len(closures)} of its {len(second.poses)} keyframes were found there, and "
            f"it takes {_LEAST_CLOSURES}. They are maps of two places, share none, or much has changed."
        )
    solved, keys, position = _solve(by, second, closures), list(closures), second.group.position
    at = position(solved.poses[keys])
    errors = np.linalg.norm(at - position(np.array([closures[k].pose for k in keys])), axis=1)
    bent = np.linalg.norm(_moved_onto(at, position(second.poses[keys])) - at, axis=1)
    kept, remaining = np.arange(len(second.poses)), first
    if only_new:
        kept, remaining = by.new_keyframes(solved), by.remaining(solved)
    added = solved.select(kept)
    of_first = [first.cov_at(pose) for pose in added.poses]
    added = replace(added, covariances=added.covariances + np.reshape(of_first, added.covariances.shape))
    ties = [_tie(remaining, i, closures[k]) for i, k in enumerate(kept.tolist()) if k in closures]
    return Merged(remaining.joined(added, ties), len(keys), errors, bent, len(kept), len(first.points) - len(remaining.points))


def _find_closures(by: _Registration[Search], second: KeyframeMap, initial: Pose2 | None) -> dict[int, Closure]:
    """Closures by keyframe of the ``second`` map, in their order: found forwards from ``initial`` (3,) on, and for those before the first
    one backwards."""
    found: dict[int, Closure] = {}
    keys, scans = np.flatnonzero(second.counts).tolist(), second.scans()
    for order, near in ((keys, initial), (keys[::-1], None)):
        localizer = by.start(near)
        for i, k in enumerate(order):
            closure = by.close(localizer, scans[k], second.poses[order[max(i - 1, 0)]], second.poses[k])
            if closure is not None:
                found.setdefault(k, closure)
    return dict(sorted(found.items()))


def _solve(by: _Registration[Search], second: KeyframeMap, closures: dict[int, Closure]) -> KeyframeMap:
    """The ``second`` map at its poses in the first, with covariances. Node 0 of the graph is the first map's frame."""
    group, (k, closure) = second.group, next(iter(closures.items()))
    first_T_second = group.compose(closure.pose, group.inverse(second.poses[k]))
    starts = [group.compose(first_T_second, own) for own in second.poses]
    graph = PoseGraph(by.keyframes, np.zeros((0, 0)))
    graph.apply(GraphUpdate(group.identity()))
    start_sigmas = np.where(np.arange(group.dim) < group.position(starts[0]).size, _START_SIGMA_M, _START_SIGMA_RAD)
    for k, start in enumerate(starts):
        motions = [MeasuredMotion.by_cov(k, k + 1, start, np.diag(start_sigmas**2))]
        if k:
            motions = [MeasuredMotion.by_cov(k, k + 1, between(group, second.poses[k - 1], second.poses[k]), by.floor_cov)]
        if k in closures:
            motions.append(MeasuredMotion.by_cov(0, k + 1, *closures[k], is_loop=True))
        graph.apply(GraphUpdate(start, motions=tuple(motions)))
    smoothed = graph.smooth()
    origin = group.inverse(smoothed.poses[0])
    covs = np.array([smoothed.relative_cov(0, i + 1) for i in range(len(starts))])
    poses = np.array([group.compose(origin, pose) for pose in smoothed.poses[1:]])
    return replace(second, poses=poses, covariances=0.5 * (covs + covs.swapaxes(1, 2)))


def _moved_onto(there: FloatArray, here: FloatArray) -> FloatArray:
    """The points ``here`` (N, D) moved as a whole onto ``there`` (N, D), by least squares (Umeyama 1991)."""
    middle_there, middle_here = there.mean(axis=0), here.mean(axis=0)
    U, _, Vt = np.linalg.svd((there - middle_there).T @ (here - middle_here))
    flip = np.append(np.ones(len(U) - 1), np.sign(np.linalg.det(U @ Vt)))
    return np.asarray((here - middle_here) @ ((U * flip) @ Vt).T + middle_there)


def _tie(first: KeyframeMap, i: int, closure: Closure) -> MeasuredMotion:
    """Keyframe ``i`` of the maps that follow, by its ``closure``, from the nearest keyframe of the ``first``."""
    k = first.nearest(closure.pose)
    delta = between(first.group, first.poses[k], closure.pose)
    return MeasuredMotion.by_cov(k, len(first.poses) + i, delta, closure.cov, is_loop=True)


class _ScanRegistration:
    """Planar scans in a planar map."""

    keyframes, floor_cov = PlanarKeyframes(), FLOOR_COV

    def __init__(self, first: KeyframeMap, range_noise_m: float) -> None:
        self._first, self._places = first, PlaceMap(first, range_noise_m)

    def start(self, near: Pose2 | None) -> Localizer:
        return Localizer(self._places, near)

    def close(self, localizer: Localizer, scan: FloatArray, before: Pose2, pose: Pose2) -> Closure | None:
        localizer.add(scan, se2.between(before, pose), FLOOR_COV)
        if localizer.state != "localized":
            return None
        place = self._places.align(scan, localizer.pose)
        if place.score < _LEAST_SCORE or math.hypot(*(place.pose[:2] - localizer.pose[:2])) > _MAX_OFF_M:
            return None
        return Closure(place.pose, np.asarray(np.linalg.inv(place.fit.information + OPEN_INFORMATION)) + FLOOR_COV)

    def new_keyframes(self, second: KeyframeMap) -> IntArray:
        changes = find_changes(self._places, second)
        is_new = [adds_to(self._places, changes, pose, scan) for pose, scan in zip(second.poses, second.scans(), strict=True)]
        return np.flatnonzero(is_new)

    def remaining(self, second: KeyframeMap) -> KeyframeMap:
        return self._first  # newer scans see through walls that are gone, and draw them free


class _CloudRegistration:
    """Clouds in a map in space."""

    keyframes, floor_cov = SpaceKeyframes(1.0), _SPACE_FLOOR_COV

    def __init__(self, first: KeyframeMap, range_noise_m: float) -> None:
        self._first, self._places = first, SpacePlaces(first, range_noise_m)

    def start(self, near: Pose2 | None) -> SpaceLocalizer:
        return SpaceLocalizer(self._places, near)

    def close(self, localizer: SpaceLocalizer, scan: FloatArray, before: Transform3, pose: Transform3) -> Closure | None:
        localizer.add(scan, SpaceMotion(between(SE3, before, pose), _SPACE_FLOOR_COV), pose[:3, :3])
        if localizer.state != "localized":
            return None
        place = self._places.align(scan, localizer.pose, localizer.covariance + _SPACE_FLOOR_COV)
        is_near = math.hypot(*(place.pose[:3, 3] - localizer.pose[:3, 3])) <= _MAX_OFF_M
        is_fitting = place.on_surfaces >= _LEAST_ON and place.off_surfaces <= _MOST_OFF
        return Closure(place.match.measured, place.cov + _SPACE_FLOOR_COV) if is_fitting and is_near else None

    def new_keyframes(self, second: KeyframeMap) -> IntArray:
        known, kept = self._places.points, []
        for k, cloud in enumerate(second.scans()):
            points = se3.transform(second.poses[k], cloud)
            distances, _ = cKDTree(known).query(points, distance_upper_bound=self._places.cell)
            if len(cloud) and np.isinf(distances).mean() >= _LEAST_NEW:
                kept.append(k)
                known = np.vstack([known, points])
        return np.array(kept, dtype=np.int64)

    def remaining(self, second: KeyframeMap) -> KeyframeMap:
        return self._first.without(find_gone(self._first, second, self._places.cell))
