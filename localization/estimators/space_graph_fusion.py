"""Smoothed poses in space: the filter on SE(3) live, and at the end a graph of its keyframes on SE(3)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from localization.core.policies.excitation import Excitation
from localization.core.state import clip_eigenvalues
from localization.estimate import Estimate
from localization.estimators.filtered_odometry import FilteredOdometry
from localization.estimators.graph_fusion import GraphConfig, subtract_information
from localization.estimators.graph_in_space import SpaceKeyframes
from localization.estimators.keyframe_motion import MotionPreintegration
from localization.estimators.pose_graph import GraphUpdate, GravityMeasurement, PoseGraph, PositionMeasurement
from localization.estimators.position_queue import PositionQueue, align_map
from localization.estimators.space_fusion import SpaceFusion
from localization.estimators.space_smoothing import SpaceSmoothing
from localization.events import PositionSample, Step
from localization.lidar.cloud_loops import make_map_closures
from localization.lifting import Trajectory3
from localization.maps import KeyframeMap
from localization.maps.keyframe_map import MeasuredMotion
from localization.messages import Message
from localization.trajectory import Trajectory
from motion_models import se2, se3
from motion_models.groups import SE3
from motion_models.online_calibration import Corrections
from motion_models.se2 import FloatArray, Points2, Pose2

_OPEN_M2, _OPEN_RAD2 = 1.0, 1.0
"""Variance of z and of roll and pitch by the wheels, which do not measure them [m^2, rad^2]."""
_NO_SIGMA = 1e-4
"""Prior sigma of the wheels' radius, which the filter in space does not correct [-]."""


@dataclass(frozen=True, eq=False)
class SpaceGraphSettings:
    """Settings of a `SpaceGraphFusion`, without its filter."""

    corrections: Corrections
    track_m: float
    """Track width of the robot [m]."""
    config: GraphConfig
    is_smoothing: bool
    """`finish` is to give the smoothed trajectory; memory then grows with the drive, 424 bytes a step and 40 kB a keyframe."""
    range_noise_m: float
    """Sigma of a range [m]."""

    def __post_init__(self) -> None:
        if self.config.cloud_loops:
            make_map_closures(1.0)  # a missing extra is an error before the drive


class SpaceGraphFusion(FilteredOdometry[SpaceFusion]):
    """`SpaceFusion`, whose keyframes a `PoseGraph` smooths at the end; its live poses are the filter's.

    The filter's submap grows with the drive and is never left, so that a place that is visited again is matched by the filter itself. Where
    drift exceeds what matching bridges, loops by map-closures tie the keyframes (`GraphConfig.cloud_loops`).
    """

    def __init__(self, odometry: SpaceFusion, settings: SpaceGraphSettings, map_T_odom: Pose2) -> None:
        """``odometry``: the filter whose keyframes are smoothed; ``map_T_odom`` (3,): as a graph in the plane has left it."""
        corrections, track_m = settings.corrections, settings.track_m
        self.odometry, self._corrections = odometry, corrections
        self._config = settings.config
        self._smoothing = SpaceSmoothing(settings.range_noise_m, self._config.cloud_loops) if settings.is_smoothing else None
        self._map_T_odom = map_T_odom
        lever = np.array([settings.config.antenna_x_m, settings.config.antenna_y_m, 0.0])
        keyframes = SpaceKeyframes(odometry.accelerometer_sigma)
        self.graph = PoseGraph(keyframes, block_diag(corrections.cov, _NO_SIGMA**2), lever)
        self._placed: list[PositionMeasurement] = []  # in the graph once they show where the map is
        self._queue = PositionQueue()
        self._excitation = Excitation(track_m, corrections.min_track_over_radius)
        self._wheels = MotionPreintegration(len(corrections.names))

    def step(self, step: Step) -> Estimate:
        """The filter's estimate; a keyframe where the robot has gone or turned far enough."""
        estimate = self.odometry.step(step)
        self._excitation.start_step(step.predicted)
        if self.odometry.has_vertical:
            self._record(step)
        odometry, pose = (estimate.pose, estimate.covariance), se2.compose(self._map_T_odom, estimate.pose)
        return replace(estimate, pose=pose, odometry=odometry, map_T_odom=self._map_T_odom)

    def _record(self, step: Step) -> None:
        state, delta, cov = self.odometry.state, np.eye(4), np.zeros((6, 6))
        if self.graph.count:
            self._wheels.add(step.predicted, self._corrections, self._excitation.is_turning, np.zeros(len(self._corrections.names)))
            delta, cov = state.between("key", "pose")
        if self._smoothing is not None:
            self._smoothing.path.add(step.end_ns, state["pose"], cov)
        c, (way, turn) = self._config, (math.hypot(*delta[:3, 3]), math.hypot(*se3.rotation_vector(delta[:3, :3])))
        if not self.graph.count or way > c.keyframe_distance_m or turn > c.keyframe_angle_rad:
            self._add_keyframe(delta, cov)
            delta, cov = np.eye(4), np.zeros((6, 6))
        if step.gravity is not None and self._smoothing is not None:
            k, force, variance = self.graph.count - 1, step.gravity.force, step.gravity.variance
            self.graph.apply(GraphUpdate(gravities=(GravityMeasurement(k, force, delta[:3, :3], variance),)))
        self._place_positions(step, delta, cov)

    def _place_positions(self, step: Step, delta: FloatArray, cov: FloatArray) -> None:
        """Positions up to the end of ``step`` are taken from the newest keyframe, which is ``delta`` with ``cov`` behind the pose."""
        state = self.odometry.state
        back = se3.log(se3.inverse(state["pose"]) @ state["start"])
        moved = np.trace(cov[:3, :3]) / 3.0
        for sample, part in self._queue.take(step, has_keyframe=True):
            offset = se3.compose(delta, se3.exp((1.0 - part) * back))
            position, spread = sample.position, sample.covariance
            if sample.height is not None:
                position, spread = np.append(position, sample.height[0]), block_diag(spread, sample.height[1])
            self._placed.append(PositionMeasurement(self.graph.count - 1, offset, position, spread + moved * np.eye(len(position))))

    def _add_keyframe(self, delta: FloatArray, cov: FloatArray) -> None:
        state, n = self.odometry.state, self.graph.count
        update = GraphUpdate(state["pose"])
        if n:
            wheels = self._wheels.with_corrections(np.zeros(len(self._corrections.names)))
            by_wheels = np.diag([0.0, 0.0, _OPEN_M2, _OPEN_RAD2, _OPEN_RAD2, 0.0])
            by_wheels[np.ix_([0, 1, 5], [0, 1, 5])] = wheels.cov
            motion = subtract_information(SE3, delta, clip_eigenvalues(cov), se3.lift(wheels.delta), by_wheels)
            update = GraphUpdate(state["pose"], wheels, motions=(MeasuredMotion(n - 1, n, *motion),))
        self.graph.apply(update)
        if self._smoothing is not None:
            self._smoothing.add_keyframe(self.odometry.cloud, self.odometry.lidar_position)
        self._wheels = MotionPreintegration(len(self._corrections.names))
        self.odometry.start_key()

    def add_position(self, sample: PositionSample) -> None:
        """A position by GPS, for the smoothed poses; it is placed once the odometry has come to its stamp."""
        if self._smoothing is not None and self.graph.count:
            self._queue.add(sample)

    def run_deferred(self) -> bool:
        """The filter's submap."""
        return self.odometry.run_deferred()

    def finish(self, filtered: Trajectory | None = None) -> Trajectory | None:
        """The smoothed trajectory projected to the plane, at the stamps of ``filtered``; None unless smoothing, or with one keyframe."""
        self.run_deferred()
        if self._smoothing is None or filtered is None:
            return None
        self._align()
        return self._smoothing.finish(self.graph, self._map_T_odom, filtered)

    def keyframe_map(self) -> KeyframeMap | None:
        """Keyframes as they can be saved, once `finish` has smoothed them."""
        return None if self._smoothing is None else self._smoothing.map

    def _align(self) -> None:
        """The map's place and heading among the positions, where these suffice."""
        positions = self._placed
        if not positions:
            return
        ours = np.array([(self.graph.pose(p.k) @ p.offset)[:3, 3] for p in positions])
        theirs = np.array([p.position[:2] for p in positions])
        found = align_map(ours[:, :2], theirs, np.sqrt([0.5 * np.trace(p.cov[:2, :2]) for p in positions]))
        if found is None:
            return
        rises = [p.position[2] - z for p, z in zip(positions, ours[:, 2].tolist(), strict=True) if len(p.position) == 3]
        alignment = np.array([found[0], found[1], np.median(rises) if rises else 0.0, found[2]])
        self.graph.apply(GraphUpdate(positions=tuple(positions), alignment=alignment))

    @property
    def smoothed_in_space(self) -> Trajectory3 | None:
        """Poses in space by all measurements, once `finish` has smoothed them."""
        return None if self._smoothing is None else self._smoothing.trajectory

    def counts(self) -> Mapping[str, int]:
        """Counts of the filter, of keyframes and of positions in the graph."""
        found = {**self.odometry.counts(), "keyframes": self.graph.count}
        if self._config.cloud_loops:
            found["loops"] = len(self.graph.loops)
        return {**found, "positions": self._n_positions} if self._n_positions else found

    @property
    def _n_positions(self) -> int:
        """Positions in the graph."""
        return 0 if self.graph.enu_T_map is None else len(self._placed)

    def warnings(self) -> list[Message]:
        """Warnings of the filter, of a failed smoothing, and of positions that could not be used."""
        failure = None if self._smoothing is None else self._smoothing.failure
        found = [*self.odometry.warnings(), *([] if failure is None else [failure])]
        return found + self._queue.warnings(self._n_positions, len(self._placed) - self._n_positions)

    def map_points(self) -> Points2:
        """See `SpaceFusion.map_points`."""
        return self.odometry.map_points()
