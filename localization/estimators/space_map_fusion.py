"""Localization in a saved map in space: the filter's odometry on SE(3), and where its keyframes are in the map.

As in the plane (`map_fusion`), the filter never depends on the map: ``odom_T_body`` is continuous, and the map moves ``map_T_odom``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.estimator import Estimate
from localization.estimators.space_fusion import FilteredSpaceOdometry, SpaceFusion
from localization.events import Step
from localization.lifting import Pose3, SpaceTable, Trajectory3
from localization.maps.space_localizer import SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlaces
from localization.trajectory import Trajectory
from motion_models import se2, se3
from motion_models.se2 import FloatArray, Points2, Pose2

_KEYFRAME_DISTANCE_M, _KEYFRAME_ANGLE_RAD = 0.5, 0.3
"""A keyframe follows when the robot has moved this far, as in the plane."""


class SpaceMapFusion(FilteredSpaceOdometry):
    """`SpaceFusion` with a `SpaceLocalizer` behind it; estimates are those seen from above, `smoothed_in_space` has all of the pose."""

    def __init__(self, odometry: SpaceFusion, places: SpacePlaces, initial: Pose2 | None, is_recording: bool = False) -> None:
        """``initial`` (3,): about where the drive begins in the map. With ``is_recording``, poses in space are kept until `finish`."""
        self.odometry, self.localizer = odometry, SpaceLocalizer(places, initial)
        self._has_key = False
        self._cloud: FloatArray | None = None  # of a keyframe that is due
        self._seconds = dict.fromkeys(("searching", "localized", "lost"), 0.0)
        self._outside_s, self._n_losses = 0.0, 0
        self._first_s: float | None = None
        self._table = SpaceTable() if is_recording else None

    def step(self, step: Step) -> Estimate:
        """The filter's estimate in the frame of the map, as seen from above. Raises `EstimatorError` for planar scans."""
        self.run_deferred()
        if step.scan is not None and step.scan.is_planar:
            raise EstimatorError(
                "the map holds clouds in space, and the LiDAR's scans are planar: they cannot be localized in it. Name a map of planar "
                "scans by --map, or the cloud's topic by --topic.points."
            )
        estimate = self.odometry.step(step)
        self._count(step.duration)
        motion = self._motion_since_keyframe()
        way, turn = math.hypot(*motion.delta[:3, 3]), math.hypot(*se3.rotation_vector(motion.delta[:3, :3]))
        is_far = way >= _KEYFRAME_DISTANCE_M or turn >= _KEYFRAME_ANGLE_RAD or not self._has_key
        self._cloud = self.odometry.cloud if is_far and self.odometry.has_vertical else None
        in_map = self._in_map(motion)
        if self._table is not None and self.odometry.has_vertical:
            self._table.add(step.end_ns, in_map)
        pose, covariance = in_map.from_above()
        map_T_odom = se2.compose(pose, se2.inverse(estimate.pose))
        return replace(estimate, pose=pose, covariance=covariance, odometry=(estimate.pose, estimate.covariance), map_T_odom=map_T_odom)

    def run_deferred(self) -> bool:
        """Do what was deferred until the estimate was published: update the submap, and localize the keyframe in the map."""
        cloud, self._cloud = self._cloud, None
        if cloud is not None:
            was_localized = self.localizer.state == "localized"
            self.localizer.add(cloud, self._motion_since_keyframe(), self.odometry.state["pose"][:3, :3])
            self._n_losses += was_localized and self.localizer.state == "lost"
            self.odometry.start_key()
            self._has_key = True
        return self.odometry.run_deferred()

    def _motion_since_keyframe(self) -> SpaceMotion:
        return SpaceMotion(*self.odometry.state.between("key", "pose")) if self._has_key else SpaceMotion(np.eye(4), np.zeros((6, 6)))

    def _in_map(self, motion: SpaceMotion) -> Pose3:
        """``map_T_body`` after ``motion`` since the last keyframe."""
        pose, A = self.localizer.pose @ motion.delta, se3.adjoint(se3.inverse(motion.delta))
        world = np.kron(np.eye(2), pose[:3, :3])
        return Pose3(pose[:3, 3], pose[:3, :3], world @ (A @ self.localizer.covariance @ A.T + motion.cov) @ world.T)

    def _count(self, duration_s: float) -> None:
        if self.localizer.state == "localized" and self._first_s is None:
            self._first_s = sum(self._seconds.values())
        self._seconds[self.localizer.state] += duration_s
        self._outside_s += duration_s if self.localizer.is_outside else 0.0

    def finish(self, filtered: Trajectory | None = None) -> None:
        """The trajectory stays as it was published: nothing is smoothed."""
        self.run_deferred()

    @property
    def smoothed_in_space(self) -> Trajectory3 | None:
        """Poses ``map_T_body`` as they were published; None before gravity was measured, or where they were not kept."""
        return None if self._table is None or not len(self._table) else self._table.trajectory()

    def localization(self) -> Mapping[str, Any]:
        """State, probability and places in the saved map so far, as JSON holds them."""
        localizer = self.localizer
        places = [] if localizer.state == "localized" else localizer.hypotheses
        return {
            "state": localizer.state,
            "probability": localizer.probability,
            "pose": _from_above(localizer.pose),
            **{f"{state}_s": seconds for state, seconds in self._seconds.items()},
            "is_outside": localizer.is_outside,
            "outside_s": self._outside_s,
            "first_localized_s": self._first_s,
            "losses": self._n_losses,
            "places": [{"pose": _from_above(place.pose), "probability": place.probability} for place in places],
        }

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name, as the filter counts them."""
        return self.odometry.counts()

    def warnings(self) -> list[str]:
        """Problems of the measurements so far: those of the filter, and for how long the place in the map was not known."""
        found = list(self.odometry.warnings())
        if self._first_s is None and self.odometry.counts()["scans"]:
            found.append(
                "the robot was never localized in the map. It may be of another place, or much may have changed: check --map and "
                "--initial-pose."
            )
        elif self._n_losses:
            times = f"{self._n_losses} times, for {self._seconds['lost']:.0f} s"
            found.append(
                f"the place in the map was lost {times}, and is {self.localizer.state} at the end: poses of that time are by odometry. "
                "The robot was carried, or the map is out of date."
            )
        return found

    def map_points(self) -> Points2:
        """(M, 2) points of the saved map, seen from above [m]."""
        return self.localizer.places.points[:, :2]


def _from_above(pose: FloatArray) -> list[float]:
    """x, y, yaw of a pose (4, 4) [m, m, rad]."""
    return [float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])]
