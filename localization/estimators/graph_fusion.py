"""Localization: the filter's odometry, and a graph of its keyframes with loop closures and positions. Poses are ``map_T_body``.

The filter never depends on the graph, but for the corrections of the motion model: ``odom_T_body`` is continuous, and loops move
``map_T_odom`` (REP-105).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from localization.bounded_settings import Positive, Settings, Signed
from localization.core.state import SE2, Group
from localization.errors import EstimatorError
from localization.estimators.estimator import Estimate
from localization.estimators.filtered_odometry import FilteredOdometry
from localization.estimators.fusion import EkfFusion
from localization.estimators.pose_graph import BetweenMeasurement, GraphUpdate, PoseGraph, PositionMeasurement, through_nodes
from localization.estimators.position_queue import PositionQueue, align_map
from localization.events import PositionSample, Step
from localization.lidar import OUTLIER_SIGMAS, LidarConfig
from localization.lidar.loop_detection import Keyframe, LoopDetector
from localization.maps import KeyframeMap
from localization.maps.grid import Grid, GrowingGrid
from localization.maps.position_plane import PositionPlane
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.online_calibration import Corrections
from motion_models.preintegration import MotionPreintegration, PreintegratedMotion
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


class GraphFusion(FilteredOdometry[EkfFusion]):
    """`EkfFusion` with a `PoseGraph` behind it."""

    def __init__(self, odometry: EkfFusion, corrections: Corrections, lidar: LidarConfig, config: GraphConfig, is_smoothing: bool):
        """``is_smoothing``: `finish` is to give the smoothed trajectory; memory then grows with the drive, 104 bytes a step."""
        self.odometry, self._corrections, self._config = odometry, corrections, config
        radius_sigma = max(odometry.wheel_radius_sigma, _NO_SIGMA)
        self.graph = PoseGraph(block_diag(corrections.cov, radius_sigma**2), np.array([config.antenna_x_m, config.antenna_y_m]))
        self._loops = LoopDetector(lidar)
        self._wheels = MotionPreintegration(len(corrections.names))
        self._steps, self._stamps_ns = array("d"), array("q")  # the filter's poses, if they are to be smoothed
        self._nodes, self._covs_since = array("q"), array("d")  # which of them are keyframes; covariances of the motion since the last one
        self._odometry_covs = array("d")  # of the filter's poses at keyframes
        self._is_smoothing = is_smoothing
        self._is_keyframe_due = self._is_matched = False
        self._key, self._moved = 0, (np.zeros(3), np.zeros((3, 3)))  # last keyframe with a matched scan; motion since the last keyframe
        self._lost_variance = 0.0  # of the position in the odometry's frame at the last keyframe, if that had no matched scan [m^2]
        self._map_T_odom, self._key_cov = np.zeros(3), np.zeros((3, 3))
        self._moving_s, self._end_ns = 0.0, 0
        self._smoothed_covs: FloatArray | None = None
        self._grid = GrowingGrid(_CELL_M, _MAX_CELLS)
        self._positions: list[tuple[int, FloatArray, FloatArray, FloatArray]] = []  # keyframe, offset, position, cov: not aligned yet
        self._queue = PositionQueue()
        self._is_aligned, self._failure = False, ""
        self._origin: tuple[float, float, float] | None = None  # of the positions' plane
        self.n_loops = self.n_positions = 0

    def step(self, step: Step) -> Estimate:
        """The filter's estimate in the frame of the map."""
        self.run_deferred()
        estimate, wheels = self.odometry.step(step), self.odometry.wheels
        self._is_matched, self._end_ns = estimate.nis is not None, step.end_ns
        self._wheels.add(wheels.motion, self._corrections, wheels.is_turning, wheels.corrections)
        self._moving_s += 0.0 if step.is_standing else step.duration
        delta, cov = self._moved = self._motion_since_keyframe()
        if self._is_smoothing and (not self._stamps_ns or step.end_ns > self._stamps_ns[-1]):
            self._steps.extend(estimate.pose)
            self._covs_since.extend(cov.ravel())
            self._stamps_ns.append(step.end_ns)
        moved = max(math.hypot(delta[0], delta[1]) / self._config.keyframe_distance_m, abs(delta[2]) / self._config.keyframe_angle_rad)
        waits_for_scan = step.scan is None and self.lost is not None and moved < _LONGEST_WAIT
        self._is_keyframe_due = not self.graph.count or (moved >= 1.0 and not waits_for_scan) or self._is_found_again()
        self._place_positions(step)
        A = se2.adjoint(se2.inverse(delta))
        pose, odometry = se2.compose(self._map_T_odom, estimate.pose), estimate.odometry or (estimate.pose, estimate.covariance)
        covariance = self._bound(A @ self._key_cov @ A.T + cov, self.odometry.state.cov("pose"))
        map_T_odom = se2.compose(pose, se2.inverse(odometry[0]))
        return replace(estimate, pose=pose, covariance=covariance, odometry=odometry, map_T_odom=map_T_odom)

    def _bound(self, cov: Cov3, odometry_cov: Cov3) -> Cov3:
        """Covariance (3, 3) of a pose in the map, of which the graph has ``cov`` and the filter ``odometry_cov``.

        The graph adds the motions from keyframe to keyframe as if their errors were independent. Those of scans in one submap are not:
        they are of the poses, and do not add up, as the filter has it. Loops take away from the filter's errors, so that its covariance
        remains a bound; positions have another frame. Without a LiDAR the filter does not have the wheels' radius, which the graph has.
        """
        is_bound = self.lost is not None and not self._is_aligned
        is_smaller = 0.0 < np.trace(odometry_cov[:2, :2]) < np.trace(cov[:2, :2])
        return odometry_cov.copy() if is_bound and is_smaller else cov

    def run_deferred(self) -> bool:
        """Do what was deferred until the estimate was published: update the submap, add a keyframe, close loops, add positions. Whether a
        keyframe has changed the corrections."""
        self.odometry.run_deferred()
        is_due, self._is_keyframe_due = self._is_keyframe_due, False
        if is_due:
            self._add_keyframe()
        return is_due

    def add_position(self, sample: PositionSample) -> None:
        """A position by GPS. It is placed once the odometry has come to its stamp."""
        self._queue.add(sample)
        self._origin = sample.origin

    def _motion_since_keyframe(self) -> tuple[Pose2, Cov3]:
        """Motion (3,) since the last keyframe, and its covariance (3, 3): by the sum of the steps, where that had no matched scan."""
        state = self.odometry.state
        if self._key >= self.graph.count - 1:
            return state.between("key", "pose")
        step, step_cov = state.between("start", "pose")
        A = se2.adjoint(se2.inverse(step))
        return se2.between(self._loops.keyframes[-1].odometry, state["pose"]), A @ self._moved[1] @ A.T + step_cov

    def _is_found_again(self) -> bool:
        """Whether a scan has shown where the robot is on the map from before its LiDAR was lost."""
        return self._is_matched and self._position_variance() < _FOUND_SHARE * self._lost_variance

    def _position_variance(self) -> float:
        return float(np.trace(self.odometry.state.cov("pose")[:2, :2]))

    def _add_keyframe(self) -> None:
        odometry, pose, k = self.odometry, self.odometry.state["pose"], self.graph.count
        update = GraphUpdate(pose)
        if k:
            wheels = self._wheels.with_corrections(odometry.state["corrections"])
            between = self._between(k, wheels)
            update = GraphUpdate(se2.compose(self.graph.pose(between.a), between.delta), wheels, self._epoch_cov(), (between,))
        self.graph.apply(update)
        self._odometry_covs.extend(odometry.state.cov("pose").ravel())
        if self._is_smoothing:
            self._nodes.append(len(self._stamps_ns) - 1)
        self._lost_variance = self._position_variance()
        if self._is_matched or self.lost is None or not k:
            odometry.start_key()
            self._key, self._lost_variance = k, 0.0
        self._moved = np.zeros(3), np.zeros((3, 3))
        self._wheels = MotionPreintegration(len(self._corrections.names))
        self._close_loop(Keyframe(pose, odometry.scan_points, self._end_ns, odometry.lidar_position))
        self._align_positions()
        if len(self._corrections.names) and k:
            mean, cov = self.graph.corrections()
            odometry.set_corrections(mean[:-1], cov[:-1, :-1])
        self._map_T_odom = se2.compose(self.graph.pose(k), se2.inverse(pose))
        self._key_cov = self.graph.marginal(k)

    def _between(self, k: int, wheels: PreintegratedMotion) -> BetweenMeasurement:
        """Motion by gyro and scans to the next keyframe ``k``, from the one before; from the last with a matched scan, if a scan has shown
        where the robot is after keyframes without: their poses are uncertain, and what it shows is not about them."""
        state = self.odometry.state
        if self._is_found_again():
            delta, cov = state.between("key", "pose")
            return BetweenMeasurement(self._key, k, delta, np.asarray(np.linalg.inv(cov)))
        delta, cov = self._moved
        D, radius = wheels.by_corrections, 1.0 + state.number("radius")
        by_wheels = wheels.delta * [radius, radius, 1.0]
        wheel_cov = wheels.cov + D @ state.cov("corrections", "radius") @ D.T
        if self._is_matched and cov[0, 0] > _OPEN_SHARE * wheel_cov[0, 0]:  # the way is the wheels' alone: it does not show their radius
            return BetweenMeasurement(k - 1, k, delta, block_diag(_NO_INFORMATION, np.linalg.inv(cov[1:, 1:])))
        return BetweenMeasurement(k - 1, k, *subtract_information(SE2, delta, cov, by_wheels, wheel_cov))

    def _epoch_cov(self) -> FloatArray | None:
        """(c, c) by which the corrections may have changed, once a minute; None meanwhile."""
        if self._moving_s < _CORRECTION_EPOCH_S:
            return None
        cov = block_diag(self._corrections.process_noise * self._moving_s, 0.0)
        self._moving_s = 0.0
        return np.asarray(cov + _CONSTANT_SHARE**2 * np.diag(np.diagonal(self.graph.prior_cov)))

    def _close_loop(self, keyframe: Keyframe) -> None:
        self._loops.add(keyframe)
        loop = self._loops.detect(self.odometry.cell, self.graph.poses, self.graph.marginal)
        if loop is not None:
            self.n_loops += 1
            self.graph.apply(
                GraphUpdate(betweens=(BetweenMeasurement(loop.a, loop.b, loop.delta, np.asarray(np.linalg.inv(loop.cov)), is_loop=True),))
            )

    def _place_positions(self, step: Step) -> None:
        """Positions up to the end of ``step`` are taken from the newest keyframe."""
        state = self.odometry.state
        for sample, part in self._queue.take(step, has_keyframe=self.graph.count > 0):
            pose = se2.interpolate(state["start"], state["pose"], np.array(part))
            offset = se2.between(self._loops.keyframes[-1].odometry, pose)
            moved_cov = 0.5 * np.trace(self._moved[1][:2, :2]) * np.eye(2)  # any heading: that of the map may not be known
            self._positions.append((self.graph.count - 1, offset, sample.position, sample.covariance + moved_cov))

    def _align_positions(self) -> None:
        """Positions enter the graph, the first time together with the heading that they give to the map."""
        if not self._positions:
            return
        alignment = None
        if not self._is_aligned:
            ours = np.array([se2.compose(self.graph.pose(k), offset)[:2] for k, offset, _, _ in self._positions])
            theirs = np.array([position for _, _, position, _ in self._positions])
            sigmas = np.sqrt([0.5 * np.trace(cov) for _, _, _, cov in self._positions])
            alignment = align_map(ours, theirs, sigmas)
            if alignment is None:
                return
            self._is_aligned = True
        found = tuple(PositionMeasurement(*row) for row in self._positions)
        self.n_positions += len(found)
        self.graph.apply(GraphUpdate(positions=found, alignment=alignment))
        self._positions = []

    @property
    def enu_T_map(self) -> Pose2 | None:
        """(3,) pose of the map in the plane of the positions; None before these have given it."""
        alignment = self.graph.alignment()
        return None if alignment is None else alignment[0]

    def finish(self, filtered: Trajectory | None = None) -> Trajectory | None:
        """The smoothed trajectory at the stamps of ``filtered``; None unless smoothing, or with fewer than two keyframes."""
        self.run_deferred()
        if not self._is_smoothing or filtered is None or self.graph.count < 2:
            return None
        if self._nodes[-1] < len(self._stamps_ns) - 1:
            self._add_keyframe()
        try:
            poses, covs = self.graph.smooth()
        except EstimatorError as error:
            self._failure = f"the trajectory could not be smoothed, and its poses are the live ones: {error}"
            return None
        by_filter = np.array(self._odometry_covs).reshape(-1, 3, 3)
        covs = self._smoothed_covs = np.array([self._bound(*pair) for pair in zip(covs, by_filter, strict=True)])
        odom, since = np.array(self._steps).reshape(-1, 3), np.array(self._covs_since).reshape(-1, 3, 3)
        return Trajectory(filtered.stamps_ns, *through_nodes(SE2, odom, since, np.array(self._nodes), poses, covs))

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what was estimated besides the pose, by name: by the filter, and radius and lever arm by the graph."""
        found = dict(self.odometry.parameters())
        if self.odometry.wheel_radius_sigma:
            mean, cov = self.graph.corrections()
            found["wheel_radius_scale"] = float(mean[-1]), math.sqrt(float(cov[-1, -1]))
        if self.n_positions:
            lever, cov = self.graph.lever_arm()
            found |= {f"antenna_{axis}_m": (float(lever[i]), math.sqrt(float(cov[i, i]))) for i, axis in enumerate("xy")}
        return found

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: those of the filter, keyframes, loops and positions."""
        found = {**self.odometry.counts(), "keyframes": self.graph.count}
        if self.lost is not None:
            found["loops"] = self.n_loops
        return {**found, "positions": self.n_positions} if self.n_positions else found

    def warnings(self) -> list[str]:
        """Problems of the measurements so far: those of the filter, and positions that could not be used, or contradict the other
        sensors."""
        found = [*self.odometry.warnings(), *([self._failure] if self._failure else [])]
        found += self._queue.warnings(self.n_positions, len(self._positions))
        n = int((self.graph.position_errors() > OUTLIER_SIGMAS).sum()) if self.n_positions else 0
        if n:
            contradicted = f"{n} of {self.n_positions} positions are more than {OUTLIER_SIGMAS:g} sigma off wheels, gyro and LiDAR"
            found.append(f"{contradicted}: they count little. Check the receiver, its covariance and the antenna's lever arm.")
        return found

    def keyframe_map(self) -> KeyframeMap | None:
        """Keyframes as they can be saved; None before the first. Poses are smoothed after `finish`."""
        keys, edges = self._loops.keyframes, [between for update in self.graph.updates for between in update.betweens]
        if not keys:
            return None
        covs, alignment = self._smoothed_covs, self.graph.alignment()
        return KeyframeMap(
            stamps_ns=np.array([key.stamp_ns for key in keys], dtype=np.int64),
            poses=self.graph.poses(),
            covariances=np.array([self.graph.marginal(k) for k in range(len(keys))]) if covs is None else covs,
            points=np.vstack([key.points for key in keys]).astype(np.float32),
            counts=np.array([len(key.points) for key in keys], dtype=np.int64),
            sensors=np.array([key.lidar for key in keys]),
            edges=np.array([(edge.a, edge.b) for edge in edges], dtype=np.int64).reshape(-1, 2),
            edge_deltas=np.array([edge.delta for edge in edges]).reshape(-1, 3),
            edge_information=np.array([edge.information for edge in edges]).reshape(-1, 3, 3),
            edge_is_loop=np.array([edge.is_loop for edge in edges], dtype=bool),
            plane=None if alignment is None else PositionPlane(*alignment, self.graph.lever_arm()[0], self._origin),
        )

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
