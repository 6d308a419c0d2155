"""Localization: the filter's odometry, and a graph of its keyframes with loop closures and positions. Poses are ``map_T_body``.

The filter never depends on the graph, but for the corrections of the motion model: ``odom_T_body`` is continuous, and loops move
``map_T_odom`` (REP-105).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from localization.bounded_settings import Positive, Settings, Signed
from localization.errors import EstimatorError
from localization.estimate import Estimate
from localization.estimators.filtered_odometry import FilteredOdometry
from localization.estimators.fusion import EkfFusion
from localization.estimators.graph_in_plane import PlanarKeyframes
from localization.estimators.graph_positions import GraphPositions
from localization.estimators.keyframe_motion import MotionPreintegration, PreintegratedMotion
from localization.estimators.pose_graph import GraphUpdate, LivePoseGraph
from localization.estimators.recorded_path import RecordedPath
from localization.events import PositionSample, Step
from localization.lidar import LidarConfig
from localization.lidar.loop_detection import Keyframe, LoopDetector
from localization.maps import KeyframeMap
from localization.maps.grid import Grid, GrowingGrid
from localization.maps.keyframe_map import MappedKeyframe, MeasuredMotion, make_map
from localization.messages import Message, message
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.groups import SE2, Group
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_CONSTANT_SHARE = 1e-3
"""Random walk in a minute of corrections that are constants, over their prior sigma: less than 1 % of it in an hour. With 1e-6
GTSAM's Cholesky factors lose positive definiteness."""
_NO_SIGMA = 1e-4
"""Prior sigma of the wheels' radius where it is not a variable of its own."""
_OPEN_SHARE, _NO_INFORMATION = 0.5, 1e-3
"""Variance of a keyframe's way over that by the wheels, above which scans determine it less than the wheels do: the scene leaves it open.
The information of scans along it then [1/m^2]: a sigma of 30 m."""
_FOUND_SHARE = 0.5
"""Variance of the position over that at the last keyframe, below which a scan has found the place of a robot that was lost."""
_LONGEST_WAIT = 2.0
"""Distances between keyframes after which the next one no longer waits for a scan: the LiDAR is silent."""
_CELL_M, _MAX_CELLS = 0.1, 4_000_000
"""Side of the cells of the grid that is published [m]; it doubles until there are at most so many."""
_CORRECTION_EPOCH_S = 60.0
"""Corrections are constant for this long [s]; as a random walk of an hour they change by an eighth of their prior sigma meanwhile."""


@dataclass(frozen=True)
class GraphConfig(Settings):
    """Keyframes of the graph, and positions."""

    keyframe_distance_m: Positive = 1.0
    """A keyframe follows when the robot has moved this far [m]."""
    keyframe_angle_rad: Positive = 0.5
    """A keyframe follows when the robot has turned this far [rad]."""
    antenna_x_m: Signed = 0.0
    """x of the antenna of `--positions` in base_link, ahead [m]: prior mean of the lever arm, with a sigma of 0.5 m."""
    antenna_y_m: Signed = 0.0
    """y of the antenna of `--positions` in base_link, to the left [m]: prior mean of the lever arm, with a sigma of 0.5 m."""
    cloud_loops: bool = False
    """Clouds of a 3D LiDAR close loops of the smoothed trajectory where the robot has left the plane, by map-closures (extra `loops`)."""


@dataclass(frozen=True, eq=False)
class LastKeyframe:
    """What was known of the newest keyframe when it was added."""

    map_T_odom: Pose2 = field(default_factory=lambda: np.zeros(3))
    """(3,)"""
    cov: Cov3 = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) of its pose, by the graph."""
    matched: int = 0
    """Number of the last keyframe with a matched scan, this one or one before."""
    lost_variance: float = 0.0
    """Variance of the position in the odometry's frame, if it had no matched scan [m^2]."""


@dataclass(eq=False)
class SinceKeyframe:
    """What was measured since the newest keyframe."""

    wheels: MotionPreintegration
    moved: tuple[Pose2, Cov3] = field(default_factory=lambda: (np.zeros(3), np.zeros((3, 3))))
    """Motion (3,) and its covariance (3, 3), by all sensors."""
    due_ns: int | None = None
    """Stamp of the last step, if a keyframe is to follow."""


@dataclass(eq=False)
class Smoothing:
    """What smoothing takes, and has found."""

    path: RecordedPath | None
    """None where the trajectory is not to be smoothed."""
    filter_covs: list[Cov3] = field(default_factory=list)
    """(3, 3) of each keyframe, by the filter."""
    covs: FloatArray | None = None
    """(K, 3, 3) of the smoothed keyframes."""
    failure: Message | None = None
    """Why the trajectory could not be smoothed."""


class GraphFusion(FilteredOdometry[EkfFusion]):
    """`EkfFusion` with a `LivePoseGraph` behind it."""

    def __init__(self, odometry: EkfFusion, lidar: LidarConfig, config: GraphConfig, is_smoothing: bool):
        """``is_smoothing``: `finish` is to give the smoothed trajectory; memory then grows with the drive (`RecordedPath`)."""
        self.odometry, self._config = odometry, config
        corrections = odometry.noise.corrections
        radius_sigma = max(odometry.noise.config.wheel_radius_sigma, _NO_SIGMA)
        lever = np.array([config.antenna_x_m, config.antenna_y_m, 0.0])
        self.graph = LivePoseGraph(PlanarKeyframes(), block_diag(corrections.cov, radius_sigma**2), lever)
        self._loops = LoopDetector(lidar)
        self._positions = GraphPositions(self.graph)
        self._smoothing = Smoothing(RecordedPath(SE2) if is_smoothing else None)
        self._last, self._since = LastKeyframe(), SinceKeyframe(MotionPreintegration(len(corrections.names)))
        self._moving_s = 0.0  # in this epoch of the corrections
        self._grid = GrowingGrid(_CELL_M, _MAX_CELLS)

    def step(self, step: Step) -> Estimate:
        """The filter's estimate in the frame of the map."""
        self.run_deferred()
        estimate, last = self.odometry.step(step), self.odometry.last
        self._since.wheels.add(last.motion, self.odometry.noise.corrections, last.is_turning, last.corrections)
        self._moving_s += 0.0 if step.is_standing else step.duration
        delta, cov = self._since.moved = self._motion_since_keyframe()
        if self._smoothing.path is not None:
            self._smoothing.path.add(step.end_ns, estimate.pose, cov)
        moved = max(math.hypot(delta[0], delta[1]) / self._config.keyframe_distance_m, abs(delta[2]) / self._config.keyframe_angle_rad)
        waits_for_scan = step.scan is None and self.lost is not None and moved < _LONGEST_WAIT
        is_due = not self.graph.count or (moved >= 1.0 and not waits_for_scan) or self._is_found_again()
        self._since.due_ns = step.end_ns if is_due else None
        keyframes = self._loops.keyframes
        self._positions.place(step, self.odometry.state, keyframes[-1].odometry if keyframes else None, cov)
        A = se2.adjoint(se2.inverse(delta))
        pose, odometry = se2.compose(self._last.map_T_odom, estimate.pose), estimate.odometry or (estimate.pose, estimate.covariance)
        covariance = self._bound(A @ self._last.cov @ A.T + cov, self.odometry.state.cov("pose"))
        map_T_odom = se2.compose(pose, se2.inverse(odometry[0]))
        return replace(estimate, pose=pose, covariance=covariance, odometry=odometry, map_T_odom=map_T_odom)

    def _bound(self, cov: Cov3, odometry_cov: Cov3) -> Cov3:
        """Covariance (3, 3) of a pose in the map, of which the graph has ``cov`` and the filter ``odometry_cov``.

        The graph adds the motions from keyframe to keyframe as if their errors were independent. Those of scans in one submap are not:
        they are of the poses, and do not add up, as the filter has it. Loops take away from the filter's errors, so that its covariance
        remains a bound; positions have another frame. Without a LiDAR the filter does not have the wheels' radius, which the graph has.
        """
        is_bound = self.lost is not None and not self._positions.count
        is_smaller = 0.0 < np.trace(odometry_cov[:2, :2]) < np.trace(cov[:2, :2])
        return odometry_cov.copy() if is_bound and is_smaller else cov

    def run_deferred(self) -> bool:
        """Do what was deferred until the estimate was published: update the submap, add a keyframe, close loops, add positions. Whether a
        keyframe has changed the corrections."""
        self.odometry.run_deferred()
        due_ns, self._since.due_ns = self._since.due_ns, None
        if due_ns is not None:
            self._add_keyframe(due_ns)
        return due_ns is not None

    def add_position(self, sample: PositionSample) -> None:
        """A position by GPS. It is placed once the odometry has come to its stamp."""
        self._positions.add(sample)

    def _motion_since_keyframe(self) -> tuple[Pose2, Cov3]:
        """Motion (3,) since the last keyframe, and its covariance (3, 3): by the sum of the steps, where that had no matched scan."""
        state = self.odometry.state
        if self._last.matched >= self.graph.count - 1:
            return state.between("key", "pose")
        step, step_cov = state.between("start", "pose")
        A = se2.adjoint(se2.inverse(step))
        return se2.between(self._loops.keyframes[-1].odometry, state["pose"]), A @ self._since.moved[1] @ A.T + step_cov

    @property
    def _is_matched(self) -> bool:
        """Whether a scan of the last step was matched."""
        return self.odometry.last.scan is not None

    def _is_found_again(self) -> bool:
        """Whether a scan has shown where the robot is on the map from before its LiDAR was lost."""
        return self._is_matched and self._position_variance() < _FOUND_SHARE * self._last.lost_variance

    def _position_variance(self) -> float:
        return float(np.trace(self.odometry.state.cov("pose")[:2, :2]))

    def _add_keyframe(self, stamp_ns: int) -> None:
        odometry, pose, k = self.odometry, self.odometry.state["pose"], self.graph.count
        update = GraphUpdate(pose)
        if k:
            wheels = self._since.wheels.with_corrections(odometry.state["corrections"])
            motion = self._motion(k, wheels)
            update = GraphUpdate(se2.compose(self.graph.pose(motion.a), motion.delta), wheels, self._epoch_cov(), (motion,))
        self.graph.apply(update)
        self._smoothing.filter_covs.append(odometry.state.cov("pose"))
        if self._smoothing.path is not None:
            self._smoothing.path.add_node()
        is_placed, lost_variance = self._is_matched or self.lost is None or not k, self._position_variance()
        if is_placed:
            odometry.start_key()
        n = len(odometry.noise.corrections.names)
        self._since = SinceKeyframe(MotionPreintegration(n))
        self._close_loop(Keyframe(pose, odometry.scan_points, stamp_ns, odometry.lidar_position))
        self._positions.enter()
        if n and k:
            mean, cov = self.graph.corrections()
            odometry.set_corrections(mean[:-1], cov[:-1, :-1])
        map_T_odom, cov = se2.compose(self.graph.pose(k), se2.inverse(pose)), self.graph.marginal(k)
        self._last = LastKeyframe(map_T_odom, cov, *((k, 0.0) if is_placed else (self._last.matched, lost_variance)))

    def _motion(self, k: int, wheels: PreintegratedMotion) -> MeasuredMotion:
        """Motion by gyro and scans to the next keyframe ``k``, from the one before; from the last with a matched scan, if a scan has shown
        where the robot is after keyframes without: their poses are uncertain, and what it shows is not about them."""
        state = self.odometry.state
        if self._is_found_again():
            delta, cov = state.between("key", "pose")
            return MeasuredMotion.by_cov(self._last.matched, k, delta, cov)
        delta, cov = self._since.moved
        D, radius = wheels.by_corrections, 1.0 + state.number("radius")
        by_wheels = wheels.delta * [radius, radius, 1.0]
        wheel_cov = wheels.cov + D @ state.cov("corrections", "radius") @ D.T
        if self._is_matched and cov[0, 0] > _OPEN_SHARE * wheel_cov[0, 0]:  # the way is the wheels' alone: it does not show their radius
            return MeasuredMotion(k - 1, k, delta, block_diag(_NO_INFORMATION, np.linalg.inv(cov[1:, 1:])))
        return MeasuredMotion(k - 1, k, *subtract_information(SE2, delta, cov, by_wheels, wheel_cov))

    def _epoch_cov(self) -> FloatArray | None:
        """(c, c) by which the corrections may have changed, once a minute; None meanwhile."""
        if self._moving_s < _CORRECTION_EPOCH_S:
            return None
        cov = block_diag(self.odometry.noise.corrections.process_noise * self._moving_s, 0.0)
        self._moving_s = 0.0
        return np.asarray(cov + _CONSTANT_SHARE**2 * np.diag(np.diagonal(self.graph.prior_cov)))

    def _close_loop(self, keyframe: Keyframe) -> None:
        self._loops.add(keyframe)
        loop = self._loops.detect(self.odometry.cell, self.graph.poses, self.graph.marginal)
        if loop is not None:
            closed = MeasuredMotion.by_cov(loop.a, loop.b, loop.delta, loop.cov, is_loop=True)
            self.graph.apply(GraphUpdate(motions=(closed,)))

    @property
    def enu_T_map(self) -> Pose2 | None:
        """(3,) pose of the map in the plane of the positions; None before these have given it."""
        return self.graph.enu_T_map

    def finish(self, filtered: Trajectory | None = None) -> Trajectory | None:
        """The smoothed trajectory at the stamps of ``filtered``; None unless smoothing, or with fewer than two keyframes."""
        self.run_deferred()
        if self._smoothing.path is None or filtered is None or self.graph.count < 2:
            return None
        if not self._smoothing.path.ends_at_node:
            self._add_keyframe(int(self._smoothing.path.stamps_ns[-1]))
        try:
            smoothed = self.graph.smooth()
        except EstimatorError as error:
            self._smoothing.failure = message("smoothing.failed", reason=str(error))
            return None
        covs = [self._bound(*pair) for pair in zip(smoothed.covs, self._smoothing.filter_covs, strict=True)]
        self._smoothing.covs = np.array(covs)
        return Trajectory(filtered.stamps_ns, *self._smoothing.path.through(smoothed.poses, self._smoothing.covs))

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what was estimated besides the pose, by name: by the filter, and radius and lever arm by the graph."""
        found = dict(self.odometry.parameters())
        if self.odometry.noise.config.wheel_radius_sigma:
            mean, cov = self.graph.corrections()
            found["wheel_radius_scale"] = float(mean[-1]), math.sqrt(float(cov[-1, -1]))
        if self._positions.count:
            lever, cov = self.graph.lever_arm()
            found |= {f"antenna_{axis}_m": (float(lever[i]), math.sqrt(float(cov[i, i]))) for i, axis in enumerate("xy")}
        return found

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: those of the filter, keyframes, loops and positions."""
        found = {**self.odometry.counts(), "keyframes": self.graph.count}
        if self.lost is not None:
            found["loops"] = len(self.graph.loops)
        return {**found, "positions": self._positions.count} if self._positions.count else found

    def warnings(self) -> list[Message]:
        """Problems of the measurements so far: those of the filter, and positions that could not be used, or contradict the other
        sensors."""
        return [
            *self.odometry.warnings(),
            *([] if self._smoothing.failure is None else [self._smoothing.failure]),
            *self._positions.warnings(),
        ]

    def keyframe_map(self) -> KeyframeMap | None:
        """Keyframes as they can be saved; None before the first. Poses are smoothed after `finish`."""
        keys, covs = self._loops.keyframes, self._smoothing.covs
        if not keys:
            return None
        covs = np.array([self.graph.marginal(k) for k in range(len(keys))]) if covs is None else covs
        mapped = zip(keys, self.graph.poses(), covs, strict=True)
        keyframes = [MappedKeyframe(key.stamp_ns, pose, key.points, key.lidar, cov) for key, pose, cov in mapped]
        return make_map(keyframes, self.graph.motions, self._positions.plane)

    def occupancy(self) -> Grid | None:
        """The map as a grid with free space, in the frame of the poses; None without points."""
        keys = self._loops.keyframes
        if not any(len(key.points) for key in keys):
            return None
        return self._grid.update(self.graph.poses(), [key.points for key in keys], [key.lidar for key in keys])

    def map_points(self) -> Points2:
        """(M, 2) the scans of all keyframes, where the graph has them [m]."""
        poses = self.graph.poses()
        drawn = [se2.transform(pose, key.points) for pose, key in zip(poses, self._loops.keyframes, strict=False) if len(key.points)]
        return np.vstack(drawn) if drawn else np.empty((0, 2))


def subtract_information(
    group: Group, delta: FloatArray, cov: FloatArray, prior: FloatArray, prior_cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Motion and information of gyro and scans alone, where they and the wheels' ``prior`` together give ``delta``, elements of ``group``.

    The wheels have a factor of their own, and each measurement counts once: information C^-1 - C_w^-1, where it is positive. Along
    directions in which gyro and scans have less information than the wheels, their share of the motion is not observable: there it is at
    most as far from ``delta`` as the wheels are.
    """
    root = np.linalg.cholesky(np.linalg.inv(prior_cov))
    whiten = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(whiten @ np.linalg.inv(cov) @ whiten.T)  # information with gyro and scans, over that of the wheels
    gained = np.maximum(ratios - 1.0, 1e-6)
    to_axes = axes.T @ root.T
    off = to_axes @ group.local(prior, delta)
    shift = np.linalg.solve(to_axes, off / np.maximum(gained, 1.0))
    return group.retract(delta, shift), (to_axes.T * gained) @ to_axes
