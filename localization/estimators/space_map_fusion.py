"""Localization in a saved map in space: the filter's odometry on SE(3), and where its keyframes are in the map.

As in the plane (`map_fusion`), the filter never depends on the map: ``odom_T_body`` is continuous, and the map moves ``map_T_odom``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.errors import EstimatorError, MapError
from localization.estimate import Estimate
from localization.estimators.saved_map_fusion import KEYFRAME_ANGLE_RAD, KEYFRAME_DISTANCE_M, PriorMap, SavedMapFusion
from localization.estimators.space_fusion import SpaceFusion
from localization.events import Step
from localization.maps import KeyframeMap
from localization.maps.keyframe_map import MappedKeyframe, make_map
from localization.maps.space_localizer import SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlaces
from localization.space_pose import Pose3
from localization.trajectory import Trajectory
from motion_models import se2, se3
from motion_models.se2 import Cov3, FloatArray, Pose2


class SpaceMapFusion(SavedMapFusion[SpaceFusion]):
    """`SpaceFusion` with a `SpaceLocalizer` behind it; estimates are those seen from above, `Estimate.in_map` has all of the pose."""

    localizer: SpaceLocalizer

    def __init__(self, odometry: SpaceFusion, places: SpacePlaces, initial: Pose2 | None = None, is_recording: bool = False) -> None:
        """``initial`` (3,): about where the drive begins in the map. With ``is_recording``, the keyframes of the drive are kept."""
        super().__init__(odometry)
        self.localizer = SpaceLocalizer(places, initial, is_background=True)
        self._has_key, self._end_ns = False, 0
        self._cloud: FloatArray | None = None  # of a keyframe that is due
        self._drive: list[MappedKeyframe] | None = [] if is_recording else None

    def step(self, step: Step) -> Estimate:
        """The filter's estimate in the frame of the map, as seen from above. Raises `EstimatorError` for planar scans."""
        self.run_deferred()
        if step.scan is not None and step.scan.is_planar:
            raise EstimatorError(
                "the map holds clouds in space, and the LiDAR's scans are planar: they cannot be localized in it. Name a map of planar "
                "scans by --map, or the cloud's topic by --topic.points."
            )
        self._end_ns = step.end_ns
        estimate = self.odometry.step(step)
        self._count(step.duration)
        motion = self._motion_since_keyframe()
        way, turn = math.hypot(*motion.delta[:3, 3]), math.hypot(*se3.rotation_vector(motion.delta[:3, :3]))
        is_far = way >= KEYFRAME_DISTANCE_M or turn >= KEYFRAME_ANGLE_RAD or not self._has_key
        self._cloud = self.odometry.cloud if is_far and self.odometry.has_vertical else None
        in_map = self._in_map(motion)
        pose, covariance = in_map.from_above()
        map_T_odom = se2.compose(pose, se2.inverse(estimate.pose))
        odometry = estimate.pose, estimate.covariance
        return replace(estimate, pose=pose, covariance=covariance, odometry=odometry, map_T_odom=map_T_odom, in_map=in_map)

    def run_deferred(self) -> bool:
        """Do what was deferred until the estimate was published: update the submap, and localize the keyframe in the map."""
        cloud, self._cloud = self._cloud, None
        self._advance_search()
        if cloud is not None:
            before = self.localizer.state
            self.localizer.add(cloud, self._motion_since_keyframe(), self.odometry.state["pose"][:3, :3])
            self._times.add_keyframe(before, self.localizer.state)
            self.odometry.start_key()
            self._has_key = True
            self._record(cloud)
        return self.odometry.run_deferred()

    def _record(self, cloud: FloatArray) -> None:
        if self._drive is not None and self.localizer.state == "localized":
            lidar, pose = self.odometry.lidar_position, self.localizer.pose
            self._drive.append(MappedKeyframe(self._end_ns, pose, cloud, lidar, self.localizer.covariance))

    def _motion_since_keyframe(self) -> SpaceMotion:
        return SpaceMotion(*self.odometry.state.between("key", "pose")) if self._has_key else SpaceMotion(np.eye(4), np.zeros((6, 6)))

    def _in_map(self, motion: SpaceMotion) -> Pose3:
        """``map_T_body`` after ``motion`` since the last keyframe."""
        pose, A = self.localizer.pose @ motion.delta, se3.adjoint(se3.inverse(motion.delta))
        world = np.kron(np.eye(2), pose[:3, :3])
        return Pose3(pose[:3, 3], pose[:3, :3], world @ (A @ self.localizer.covariance @ A.T + motion.cov) @ world.T)

    def set_pose(self, pose: Pose2, cov: Cov3) -> None:
        """See `SavedMapFusion.set_pose`."""
        delta, R = self._motion_since_keyframe().delta, self.odometry.state["pose"][:3, :3]
        level = se3.rotation(np.array([0.0, 0.0, -math.atan2(R[1, 0], R[0, 0])])) @ R
        key = self.localizer.places.on_ground(pose, level) @ se3.inverse(delta)
        self.localizer.set_pose(np.array(self._from_above(key)), cov)

    def replace_map(self, prior: PriorMap) -> None:
        """See `SavedMapFusion.replace_map`."""
        if not isinstance(prior.places, SpacePlaces):
            raise MapError("it holds planar scans, and this estimator localizes clouds in space. Start with it by --map.")
        self.localizer = SpaceLocalizer(prior.places, prior.initial, is_background=True)
        self._drive = None if self._drive is None else []

    @property
    def probability(self) -> float:
        """See `SavedMapFusion.probability`."""
        return self.localizer.probability_after(self._motion_since_keyframe())

    @staticmethod
    def _from_above(pose: FloatArray) -> list[float]:
        return [float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])]

    def finish(self, filtered: Trajectory | None = None) -> None:
        """The trajectory stays as it was published: nothing is smoothed."""
        self.run_deferred()
        self.localizer.finish_search()

    def keyframe_map(self) -> KeyframeMap | None:
        """The drive's keyframes where they were localized in the map; None without such, or where they were not kept."""
        return make_map(self._drive) if self._drive else None
