"""Localization in a saved map: the filter's odometry, and where its keyframes are in the map. Poses are ``map_T_body``.

As with the graph, the filter never depends on the map: ``odom_T_body`` is continuous, and the map moves ``map_T_odom`` (REP-105).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from localization.errors import MapError
from localization.estimators.estimator import Estimate
from localization.estimators.fusion import EkfFusion
from localization.estimators.saved_map_fusion import KEYFRAME_ANGLE_RAD, KEYFRAME_DISTANCE_M, PriorMap, SavedMapFusion
from localization.events import PositionSample, Step
from localization.lidar.registration import is_narrow
from localization.logs.reference_topics import in_plane
from localization.maps import KeyframeMap
from localization.maps.changes import Changes, find_changes
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.maps.recent_scans import RecentMotion
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_LISTED_CHANGES = 5
_LEAST_CHANGED = 0.05
"""Share of the walls that are changed, from which on it is a note: halves of fr079 and MIT-CSAIL differ by 0.005 to 0.03, by doors."""


@dataclass(frozen=True, eq=False)
class _DriveKeyframe:
    stamp_ns: int
    points: Points2
    lidar: FloatArray
    pose: Pose2 | None
    """(3,) in the map; None while that was not known."""


class MapFusion(SavedMapFusion[EkfFusion]):
    """`EkfFusion` with a `Localizer` behind it."""

    localizer: Localizer

    def __init__(self, odometry: EkfFusion, places: PlaceMap, initial: Pose2 | None = None, is_recording: bool = False) -> None:
        """``odometry``: a filter with a LiDAR. ``initial`` (3,): about where the drive begins in the map; None for anywhere. With
        ``is_recording``, the keyframes of the drive are kept, and `finish` compares them with the map."""
        super().__init__(odometry)
        self.localizer = Localizer(places, initial, is_background=True)
        self._end_ns = 0
        self._is_keyframe_due, self._is_scan_awaited = False, True  # no scan since the robot was carried, or at all
        self._summed = RecentMotion(np.zeros(3), np.zeros((3, 3)))  # step by step, since the last keyframe
        self._map_T_odom, self._key_cov = self.localizer.pose, self.localizer.covariance
        self._positions: list[PositionSample] = []
        self._n_unused = 0
        self._drive: list[_DriveKeyframe] | None = [] if is_recording else None
        self._changes: Changes | None = None

    def step(self, step: Step) -> Estimate:
        """The filter's estimate in the frame of the map."""
        self.run_deferred()
        self._end_ns = step.end_ns
        estimate = self.odometry.step(step)
        self._count(step.duration)
        self._add_step()
        delta, cov = self._motion_since_keyframe()
        if delta is self._summed.delta:
            self._map_T_odom = se2.compose(se2.compose(self.localizer.pose, delta), se2.inverse(estimate.pose))
        is_far = math.hypot(delta[0], delta[1]) >= KEYFRAME_DISTANCE_M or abs(delta[2]) >= KEYFRAME_ANGLE_RAD
        has_scan = len(self.odometry.scan_points) > 0
        self._is_keyframe_due = ((is_far or self._is_scan_awaited) and has_scan) or not is_narrow(cov)  # carried: what was is no longer so
        self._take_positions(step.end_ns, delta)
        A = se2.adjoint(se2.inverse(delta))
        pose, covariance = se2.compose(self._map_T_odom, estimate.pose), A @ self._key_cov @ A.T + cov
        return replace(
            estimate, pose=pose, covariance=covariance, odometry=(estimate.pose, estimate.covariance), map_T_odom=self._map_T_odom
        )

    def run_deferred(self) -> bool:
        """Do what was deferred until the estimate was published: update the submap, and localize the keyframe in the map."""
        self.odometry.run_deferred()
        self._advance_search()
        if self._is_keyframe_due:
            self._is_keyframe_due, self._is_scan_awaited = False, not len(self.odometry.scan_points)
            was_localized = self.localizer.state == "localized"
            self.localizer.add(self.odometry.scan_points, *self._motion_since_keyframe())
            self.odometry.start_key()
            self._summed = RecentMotion(np.zeros(3), np.zeros((3, 3)))
            self._n_losses += was_localized and self.localizer.state == "lost"
            self._take_pose()
            self._record()
        return False

    def add_position(self, sample: PositionSample) -> None:
        """A position of the plane in which the map's drive fused its own, as by GNSS: it narrows where the robot may be."""
        self._positions.append(sample)

    def _take_positions(self, until_ns: int, delta: Pose2) -> None:
        """Pass on the last position up to ``until_ns``, when the robot has moved by ``delta`` (3,) since the last keyframe."""
        due = [sample for sample in self._positions if sample.stamp_ns <= until_ns]
        self._positions = self._positions[len(due) :]
        plane = self.localizer.places.plane
        position = None if plane is None or not due else in_plane(due[-1], plane.origin)
        if plane is None or position is None:
            self._n_unused += len(due)
            return
        fix = plane.to_map(position, due[-1].covariance)
        self.localizer.add_position(fix._replace(way_m=math.hypot(delta[0], delta[1])))

    def _record(self) -> None:
        if self._drive is not None:
            pose = self.localizer.pose if self.localizer.state == "localized" else None
            self._drive.append(_DriveKeyframe(self._end_ns, self.odometry.scan_points, self.odometry.lidar_position, pose))

    def _add_step(self) -> None:
        """Add the motion of the step: the filter's, or that of the wheels where that is narrower."""
        step, wheels = RecentMotion(*self.odometry.state.between("start", "pose")), self.odometry.last.motion
        if np.trace(wheels.cov) < np.trace(step.cov):
            step = RecentMotion(wheels.delta, wheels.cov)
        A = se2.adjoint(se2.inverse(step.delta))
        self._summed = RecentMotion(se2.compose(self._summed.delta, step.delta), A @ self._summed.cov @ A.T + step.cov)

    def _motion_since_keyframe(self) -> RecentMotion:
        """Motion (3,) since the last keyframe and its covariance (3, 3): the sum of the steps where that is narrower. After the filter has
        lost its place, its clones are as uncertain as the place, and where it finds it again, the pose moves and the keyframe does not."""
        by_clones = RecentMotion(*self.odometry.state.between("key", "pose"))
        return by_clones if np.trace(by_clones.cov) <= np.trace(self._summed.cov) else self._summed

    def set_pose(self, pose: Pose2, cov: Cov3) -> None:
        """See `SavedMapFusion.set_pose`."""
        delta, _ = self._motion_since_keyframe()
        self.localizer.set_pose(se2.compose(pose, se2.inverse(delta)), cov)
        self._take_pose()

    def replace_map(self, prior: PriorMap) -> None:
        """See `SavedMapFusion.replace_map`."""
        if not isinstance(prior.places, PlaceMap):
            raise MapError("it holds clouds in space, and this estimator localizes planar scans. Start with it by --map.")
        self.localizer = Localizer(prior.places, prior.initial, is_background=True)
        self._drive = None if self._drive is None else []
        self._take_pose()

    def _take_pose(self) -> None:
        """The map's frame is where the localizer has the last keyframe."""
        self._map_T_odom = se2.compose(self.localizer.pose, se2.inverse(self.odometry.state["key"]))
        self._key_cov = self.localizer.covariance

    @property
    def probability(self) -> float:
        """See `SavedMapFusion.probability`."""
        return self.localizer.probability_after(*self._motion_since_keyframe())

    def finish(self, filtered: Any = None) -> None:
        """The trajectory stays as it was published: nothing is smoothed."""
        self.run_deferred()
        self.localizer.finish_search()
        found = self.keyframe_map()
        if found is not None and len(found.points):
            self._changes = find_changes(self.localizer.places, found)

    def keyframe_map(self) -> KeyframeMap | None:
        """The drive's keyframes where they were localized in the map; None without such, or where they were not kept."""
        keys = [(key, key.pose) for key in self._drive or () if key.pose is not None]
        if not keys:
            return None
        return KeyframeMap(
            stamps_ns=np.array([key.stamp_ns for key, _ in keys], dtype=np.int64),
            poses=np.array([pose for _, pose in keys]),
            covariances=np.zeros((len(keys), 3, 3)),
            points=np.vstack([key.points for key, _ in keys]).astype(np.float32),
            counts=np.array([len(key.points) for key, _ in keys], dtype=np.int64),
            sensors=np.array([key.lidar for key, _ in keys]),
            edges=np.empty((0, 2), np.int64),
            edge_deltas=np.empty((0, 3)),
            edge_information=np.empty((0, 3, 3)),
            edge_is_loop=np.empty(0, dtype=bool),
        )

    def localization(self) -> Mapping[str, Any]:
        """`SavedMapFusion.localization`, and what has changed in the map."""
        return {**super().localization(), **({} if self._changes is None else _as_json(self._changes))}

    def warnings(self) -> list[str]:
        """Those of `SavedMapFusion`, positions that could not be used, and what has changed in the map."""
        found = super().warnings()
        if self._n_unused:
            unused = f"{self._n_unused} positions could not be used: the map was built without such ones"
            found.append(f"{unused}. Build it with --positions, or leave them out.")
        return [*found, *([] if self._changes is None else _describe(self._changes))]


def _as_json(changes: Changes) -> dict[str, Any]:
    return {"changed_share": changes.changed_share, "changes": [asdict(change) for change in changes.places]}


def _describe(changes: Changes) -> list[str]:
    """A sentence on the places where the map no longer fits, where they are more than scattered cells."""
    if changes.changed_share < _LEAST_CHANGED:
        return []
    named = [f"{c.kind} at x {c.x:.1f} m, y {c.y:.1f} m ({c.size_m:.1f} m)" for c in changes.places[:_LISTED_CHANGES]]
    rest = len(changes.places) - len(named)
    more = f", and {rest} more" if rest else ""
    return [
        f"the map no longer fits at {len(changes.places)} places, {100 * changes.changed_share:.0f} % of the walls that were measured: "
        f"{'; '.join(named)}{more}. --extend-map writes a map with them."
    ]
