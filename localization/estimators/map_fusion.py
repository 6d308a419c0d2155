"""Localization in a saved map: the filter's odometry, and where its keyframes are in the map. Poses are ``map_T_body``.

As with the graph, the filter never depends on the map: ``odom_T_body`` is continuous, and the map moves ``map_T_odom`` (REP-105).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from localization.errors import MapError
from localization.estimate import Estimate
from localization.estimators.fusion import EkfFusion
from localization.estimators.recorded_drive import RecordedDrive
from localization.estimators.saved_map_fusion import KEYFRAME_ANGLE_RAD, KEYFRAME_DISTANCE_M, PriorMap, SavedMapFusion
from localization.events import PositionSample, Step
from localization.lidar.registration import is_narrow
from localization.logs.reference_topics import in_plane
from localization.maps import KeyframeMap
from localization.maps.keyframe_map import MappedKeyframe
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.maps.position_plane import PositionFix, PositionPlane
from localization.maps.recent_scans import RecentMotion
from localization.messages import Message, message
from motion_models import se2
from motion_models.se2 import Cov3, Pose2


class MapPositions:
    """`add` positions in the order of their stamps, and `take` the last one that is due."""

    def __init__(self) -> None:
        self._waiting: list[PositionSample] = []
        self._n_unused = 0

    def add(self, sample: PositionSample) -> None:
        """A position of the plane in which the map's drive fused its own, as by GNSS."""
        self._waiting.append(sample)

    def take(self, until_ns: int, plane: PositionPlane | None) -> PositionFix | None:
        """The last position up to ``until_ns``, in the map at ``plane``; None without one, or where the map has no ``plane``."""
        due = [sample for sample in self._waiting if sample.stamp_ns <= until_ns]
        self._waiting = self._waiting[len(due) :]
        position = None if plane is None or not due else in_plane(due[-1], plane.origin)
        if plane is None or position is None:
            self._n_unused += len(due)
            return None
        return plane.to_map(position, due[-1].covariance)

    def warnings(self) -> list[Message]:
        """A sentence on positions that could not be used."""
        if not self._n_unused:
            return []
        return [message("positions.other_plane", count=self._n_unused)]


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
        self._positions = MapPositions()
        self._drive = RecordedDrive() if is_recording else None

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
            before = self.localizer.state
            self.localizer.add(self.odometry.scan_points, *self._motion_since_keyframe())
            self.odometry.start_key()
            self._summed = RecentMotion(np.zeros(3), np.zeros((3, 3)))
            self._times.add_keyframe(before, self.localizer.state)
            self._take_pose()
            self._record()
        return False

    def add_position(self, sample: PositionSample) -> None:
        """A position of the plane in which the map's drive fused its own, as by GNSS: it narrows where the robot may be."""
        self._positions.add(sample)

    def _take_positions(self, until_ns: int, delta: Pose2) -> None:
        """Pass on the last position up to ``until_ns``, when the robot has moved by ``delta`` (3,) since the last keyframe."""
        fix = self._positions.take(until_ns, self.localizer.places.mapped.plane)
        if fix is not None:
            self.localizer.add_position(fix._replace(way_m=math.hypot(delta[0], delta[1])))

    def _record(self) -> None:
        if self._drive is not None and self.localizer.state == "localized":
            points, lidar = self.odometry.scan_points, self.odometry.lidar_position
            self._drive.add(MappedKeyframe(self._end_ns, self.localizer.pose, points, lidar, self.localizer.covariance))

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
        self._drive = None if self._drive is None else RecordedDrive()
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
        if self._drive is not None:
            self._drive.compare(self.localizer.places)

    def keyframe_map(self) -> KeyframeMap | None:
        """The drive's keyframes where they were localized in the map; None without such, or where they were not kept."""
        return None if self._drive is None else self._drive.keyframe_map()

    def localization(self) -> Mapping[str, Any]:
        """`SavedMapFusion.localization`, and what has changed in the map."""
        return {**super().localization(), **({} if self._drive is None else self._drive.as_json())}

    def warnings(self) -> list[Message]:
        """Those of `SavedMapFusion`, positions that could not be used, and what has changed in the map."""
        return [*super().warnings(), *self._positions.warnings(), *([] if self._drive is None else self._drive.warnings())]
