"""Join the map of a second drive to that of a first one, or what is new in it: its keyframes are localized in the first map, and a graph
ties them to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from localization.errors import MapError
from localization.estimators.pose_graph import BetweenMeasurement, GraphUpdate, PoseGraph
from localization.lidar.loop_detection import FLOOR_COV
from localization.lidar.scan_matcher import OPEN_INFORMATION
from localization.maps import KeyframeMap, SpaceMap
from localization.maps.changes import adds_to, find_changes
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.maps.space_localizer import SpaceLocalizer
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_START_COV = np.diag([10.0, 10.0, 1.0]) ** 2
"""Covariance of the second map's place in the first beside its ties: a room's size and any heading, which they narrow to centimetres [m^2,
m^2, rad^2]."""
MAX_OFF_M = 0.3
"""Distance of an aligned scan from where the localizer has it, up to which it ties [m]: from there on 14 to 31 % of alignments end
elsewhere (`localization.lidar.registration`)."""
_LEAST_SCORE = 0.5
"""Score of a scan in the other map, from which on it ties its keyframe to that."""
LEAST_CLOSURES = 3
"""Tied keyframes that a merge takes, at least."""


Map = TypeVar("Map", KeyframeMap, SpaceMap)
Search = TypeVar("Search", Localizer, SpaceLocalizer)
Closure = TypeVar("Closure")


@dataclass(frozen=True, eq=False)
class Merged(Generic[Map]):
    """Both maps as one, in the frame of the first."""

    map: Map
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


def refuse_few(n_closures: int, n_keyframes: int) -> None:
    """Raises `MapError` where too few of the second map's keyframes were found in the first."""
    if n_closures < LEAST_CLOSURES:
        raise MapError(
            f"the second map could not be joined to the first: {n_closures} of its {n_keyframes} keyframes were found there, and it takes "
            f"{LEAST_CLOSURES}. They are maps of two places, share none, or much has changed."
        )


def merge(
    first: KeyframeMap, second: KeyframeMap, range_noise_m: float, only_new: bool = False, initial: Pose2 | None = None
) -> Merged[KeyframeMap]:
    """``second`` in the frame of ``first``. ``range_noise_m``: sigma of a range [m]. With ``only_new``, of the second its keyframes alone
    that add to the first, with all ties among these. ``initial`` (3,): about where the second begins in the first. Raises `MapError` if
    they share no place."""
    places = PlaceMap(first, range_noise_m)
    closures = _closures(places, second, initial)
    refuse_few(len(closures), len(second.poses))
    poses, covs = _solve(second, closures)
    keys = list(closures)
    measured = np.array([closures[k][0] for k in keys])
    moved = se2.align_points(second.poses[keys, :2], poses[keys, :2])
    errors = np.hypot(*(poses[keys, :2] - measured[:, :2]).T)
    bent = np.hypot(*(se2.transform(moved, second.poses[keys, :2]) - poses[keys, :2]).T)
    kept = _new_keyframes(places, second, poses) if only_new else np.arange(len(second.poses))
    ties = {i: closures[k] for i, k in enumerate(kept.tolist()) if k in closures}
    joined = _join(first, places, second.select(kept), poses[kept], covs[kept], ties)
    return Merged(joined, len(keys), errors, bent, len(kept))


def find_closures(
    keys: Sequence[int],
    start: Callable[[Pose2 | None], Search],
    close: Callable[[Search, int, int], Closure | None],
    initial: Pose2 | None,
) -> dict[int, Closure]:
    """Closures of keyframes ``keys``, in their order: found forwards from ``initial`` (3,) on, and for those before the first one
    backwards. ``start`` makes a localizer about a pose; ``close`` adds keyframe k to it after keyframe j, and gives the closure of k."""
    found: dict[int, Closure] = {}
    for order, near in ((keys, initial), (keys[::-1], None)):
        localizer = start(near)
        for i, k in enumerate(order):
            closure = close(localizer, order[max(i - 1, 0)], k)
            if closure is not None:
                found.setdefault(k, closure)
    return dict(sorted(found.items()))


def _closures(places: PlaceMap, second: KeyframeMap, initial: Pose2 | None) -> dict[int, tuple[Pose2, Cov3]]:
    """Pose (3,) in the first map and covariance (3, 3), by keyframe of the ``second``."""
    scans = second.scans()

    def close(localizer: Localizer, before: int, k: int) -> tuple[Pose2, Cov3] | None:
        localizer.add(scans[k], se2.between(second.poses[before], second.poses[k]), FLOOR_COV)
        return _closure(places, scans[k], localizer) if localizer.state == "localized" else None

    return find_closures(range(len(scans)), lambda near: Localizer(places, near), close, initial)


def _closure(places: PlaceMap, points: Points2, localizer: Localizer) -> tuple[Pose2, Cov3] | None:
    if not len(points):
        return None
    place = places.align(points, localizer.pose)
    if place.score < _LEAST_SCORE or math.hypot(*(place.pose[:2] - localizer.pose[:2])) > MAX_OFF_M:
        return None
    return place.pose, np.asarray(np.linalg.inv(place.fit.information + OPEN_INFORMATION)) + FLOOR_COV


def _solve(second: KeyframeMap, closures: dict[int, tuple[Pose2, Cov3]]) -> tuple[FloatArray, FloatArray]:
    """Poses (K, 3) of the ``second`` map in the first, and covariances (K, 3, 3). Node 0 of the graph is the first map's frame."""
    k, (pose, _) = next(iter(closures.items()))
    first_T_second = se2.compose(pose, se2.inverse(second.poses[k]))
    graph = PoseGraph(np.zeros((0, 0)))
    graph.apply(GraphUpdate(np.zeros(3)))
    for k, own in enumerate(second.poses):
        start = se2.compose(first_T_second, own)
        delta, cov = (start, _START_COV) if k == 0 else (se2.between(second.poses[k - 1], own), FLOOR_COV)
        ties = [BetweenMeasurement(k, k + 1, delta, np.asarray(np.linalg.inv(cov)))]
        if k in closures:
            ties.append(BetweenMeasurement(0, k + 1, closures[k][0], np.asarray(np.linalg.inv(closures[k][1])), is_loop=True))
        graph.apply(GraphUpdate(start, betweens=tuple(ties)))
    poses, covs = graph.smooth()
    return poses[1:], covs[1:]


def _join(
    first: KeyframeMap,
    places: PlaceMap,
    second: KeyframeMap,
    poses: FloatArray,
    covs: FloatArray,
    closures: dict[int, tuple[Pose2, Cov3]],
) -> KeyframeMap:
    """Both as one, tied by ``closures`` to the nearest keyframes of the ``first``, of which ``places`` is made."""
    n = len(first.poses)
    nearest = _nearest(first, [pose for pose, _ in closures.values()])
    ties = np.array([se2.between(first.poses[j], pose) for j, (pose, _) in zip(nearest, closures.values(), strict=True)]).reshape(-1, 3)
    information = np.array([np.linalg.inv(cov) for _, cov in closures.values()]).reshape(-1, 3, 3)
    map_covs = [places.map_cov(pose) for pose in poses]
    return KeyframeMap(
        stamps_ns=np.r_[first.stamps_ns, second.stamps_ns],
        poses=np.vstack([first.poses, poses]),
        covariances=np.vstack([first.covariances, covs + np.array(map_covs).reshape(-1, 3, 3)]),
        points=np.vstack([first.points, second.points]),
        counts=np.r_[first.counts, second.counts],
        sensors=np.vstack([first.sensors, second.sensors]),
        edges=np.vstack(
            [first.edges, second.edges + n, *(np.array([[j, k + n]], dtype=np.int64) for j, k in zip(nearest, closures, strict=True))]
        ),
        edge_deltas=np.vstack([first.edge_deltas, second.edge_deltas, ties]),
        edge_information=np.vstack([first.edge_information, second.edge_information, information]),
        edge_is_loop=np.r_[first.edge_is_loop, second.edge_is_loop, np.ones(len(closures), dtype=bool)],
        plane=first.plane,
    )


def _new_keyframes(places: PlaceMap, second: KeyframeMap, poses: FloatArray) -> IntArray:
    """Keyframes of the ``second`` map, at ``poses`` (K, 3) in the first, that have what the first does not have."""
    changes = find_changes(places, replace(second, poses=poses))
    return np.array([k for k, scan in enumerate(second.scans()) if adds_to(places, changes, poses[k], scan)], dtype=np.int64)


def _nearest(mapped: KeyframeMap, poses: Iterable[Pose2]) -> list[int]:
    """Index of the keyframe of ``mapped`` nearest to each of ``poses`` (3,)."""
    return [int(np.argmin(np.hypot(*(mapped.poses[:, :2] - pose[:2]).T))) for pose in poses]
