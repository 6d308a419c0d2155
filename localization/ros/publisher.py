"""What is published: odometry, transforms, pose, path, map, what was learned of the robot, diagnostics; and predictions between scans."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from localization.estimators import Estimate
from localization.estimators.estimator import CHANGE_SHARE, GyroCalibration, fuse_turn, mean_twist, twist_at_end
from localization.events import CgSample, Event, Turn, WheelSample
from localization.lifting import Pose3
from localization.logs.serialization import FusedWriter, encode, make
from localization.logs.writer import FusedEstimate
from localization.maps.grid import Grid
from localization.ros.diagnostics import Status
from localization.ros.discovery import TF, TF_TYPE
from localization.ros.settings import Frames, Names
from localization.ros.transports.transport import Transport
from localization.wheel_buffer import WheelBuffer
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.preintegration import integrate_twists
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

ODOMETRY, PREDICTED_ODOMETRY, POSE = "~/odometry", "~/odometry_predicted", "~/pose"
CORRECTIONS, DIAGNOSTICS, PATH, MAP = "~/corrections", "/diagnostics", "~/path", "~/map"

_NEW_KEYFRAMES = 500  # 10 s at 50 Hz: those of a start's backlog come back only after all of them
_TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    PREDICTED_ODOMETRY: "nav_msgs/msg/Odometry",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    CORRECTIONS: "sensor_msgs/msg/JointState",
    TF: TF_TYPE,
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    PATH: "nav_msgs/msg/Path",
    MAP: "nav_msgs/msg/OccupancyGrid",
}
_LATCHED = (POSE, PATH, MAP)
_MAX_PATH_POSES, _PATH_SPACING_M = 500, 0.05
"""A path is thinned to so many poses: rosbags takes 15 us for each, and no scan shall wait for it for more than 10 ms."""
_CELL_M, _MAX_CELLS = 0.1, 4_000_000
"""Edge of the map's cells [m]; it doubles until the map has at most so many."""

_NO_OFFSET = np.zeros(3)
_NS = 1e-9
_JITTER = 0.25
"""Share of the period by which a wheel message may come early and still be predicted to."""
_KEEP_S = 2.0
"""Wheel samples are stored for this long [s]."""
_MAX_HORIZON_S = 1.0
"""No prediction is published farther ahead of the last estimate [s]: without LiDAR one comes every 0.05 s, with a lost one every 0.3 s."""


class EstimatePublisher:
    """Publishes on a transport.

    Each estimate has the stamp of its scan, which came some 10 ms ago; predictions have those of the wheels' newest messages. Transforms
    and predicted odometry are one stream of both in order of stamps: an estimate that a prediction has overtaken is left out there, and
    the next prediction starts from it.
    """

    def __init__(self, transport: Transport, names: Names, frames: Frames, *, with_tf: bool) -> None:
        self._transport, self._with_tf, self._frames = transport, with_tf, frames
        self._odometry = FusedWriter(is_ros1=transport.is_ros1, parent=frames.odom_frame, body=frames.base_link_frame)
        self._map_correction = FusedWriter(is_ros1=transport.is_ros1, parent=frames.map_frame, body=frames.odom_frame)
        self.recent_transforms: deque[bytes] = deque(maxlen=_NEW_KEYFRAMES)
        """Transforms of the body, as they were published."""
        self._topics = {topic: names.resolve(topic) for topic in _TYPES}
        self._last_ns = -(1 << 63)
        self._has_predictions = False
        self._path = Path()
        for topic in (ODOMETRY, CORRECTIONS, DIAGNOSTICS, *((TF,) if with_tf else ())):
            self._advertise(topic)

    def advertise_optional(self, *, has_predictions: bool, has_map_frame: bool, has_path: bool, has_map: bool) -> None:
        """Open the topics that not every node fills."""
        self._has_predictions = has_predictions
        for topic, is_used in ((PREDICTED_ODOMETRY, has_predictions), (POSE, has_map_frame), (PATH, has_path), (MAP, has_map)):
            if is_used:
                self._advertise(topic)

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transforms from now on, or no more."""
        if is_on and not self._with_tf and not self.recent_transforms:
            self._advertise(TF)
        self._with_tf = is_on

    def restart(self) -> None:
        """Begin a new path, for the robot was set to another place."""
        self._path = Path()

    def publish_estimate(self, estimate: Estimate, stamp_ns: int) -> None:
        """nav_msgs/Odometry with true vy at ``stamp_ns``, and the transforms; of a graph the pose in `map` too.

        ``stamp_ns`` is the stamp of the estimate in the clock of its sender, which may have been set since the start.
        """
        data = self._odometry.odometry(_fused(estimate, stamp_ns))
        self._transport.publish(self._topics[ODOMETRY], data)
        self._publish_in_order(estimate, stamp_ns, data)
        self._path.insert(estimate)
        if estimate.map_T_odom is not None:
            self._publish_pose(estimate, stamp_ns)

    def publish_prediction(self, prediction: Estimate, stamp_ns: int) -> None:
        """Publish a prediction between estimates: odometry on a topic of its own, and the transforms."""
        self._publish_in_order(prediction, stamp_ns)

    def _publish_in_order(self, estimate: Estimate, stamp_ns: int, odometry: bytes | None = None) -> None:
        if estimate.stamp_ns <= self._last_ns:
            return
        self._last_ns, fused = estimate.stamp_ns, _fused(estimate, stamp_ns)
        if self._with_tf:
            self.recent_transforms.append(self._odometry.transform(fused))
            self._transport.publish(self._topics[TF], self.recent_transforms[-1])
            if estimate.map_T_odom is not None:
                self._transport.publish(self._topics[TF], self._map_correction.transform(_correction(estimate, stamp_ns)))
        if self._has_predictions:
            self._transport.publish(self._topics[PREDICTED_ODOMETRY], odometry or self._odometry.odometry(fused))

    def publish_map_frame(self, parent: str, parent_T_map: FloatArray, stamp_ns: int) -> None:
        """Publish the transform ``parent`` -> `map`, (3,)."""
        if self._with_tf:
            writer = FusedWriter(is_ros1=self._transport.is_ros1, parent=parent, body=self._frames.map_frame)
            self._transport.publish(self._topics[TF], writer.transform(FusedEstimate(stamp_ns, parent_T_map, np.zeros(3))))

    def _publish_pose(self, estimate: Estimate, stamp_ns: int) -> None:
        """geometry_msgs/PoseWithCovarianceStamped in `map`; in space where the saved map is."""
        fused = FusedEstimate(stamp_ns, estimate.pose, np.zeros(3), estimate.covariance, in_space=estimate.in_map)
        pose = make("geometry_msgs/msg/PoseWithCovariance", pose=_placed(*fused.place()), covariance=fused.pose_covariance())
        self._publish(POSE, make(_TYPES[POSE], header=self._header(stamp_ns, self._frames.map_frame), pose=pose))

    def publish_path(self, stamp_ns: int) -> None:
        """nav_msgs/Path of the estimates so far, thinned, in `map` where there is one, else in `odom`."""
        frame = self._frames.map_frame if self._path.is_in_map else self._frames.odom_frame
        poses = [
            make("geometry_msgs/msg/PoseStamped", header=self._header(estimate_ns, frame), pose=_pose(pose))
            for estimate_ns, pose in self._path.poses
        ]
        self._publish(PATH, make(_TYPES[PATH], header=self._header(stamp_ns, frame), poses=poses))

    def publish_map(self, points: FloatArray, stamp_ns: int) -> None:
        """nav_msgs/OccupancyGrid of the LiDAR's map ``points`` (N, 2) [m]: 100 where there are points, else -1 (unknown)."""
        if not len(points):
            return
        origin, cell, cells = occupancy_grid(points)
        self.publish_grid(Grid(cells, (float(origin[0]), float(origin[1])), cell), stamp_ns)

    def publish_grid(self, grid: Grid, stamp_ns: int, map_T_grid: FloatArray = _NO_OFFSET) -> None:
        """nav_msgs/OccupancyGrid with free space; ``map_T_grid`` (3,): of the frame that ``grid`` was drawn in."""
        frame = self._frames.map_frame if self._path.is_in_map else self._frames.odom_frame
        height, width = grid.cells.shape
        info = make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=_time(stamp_ns),
            resolution=grid.resolution,
            width=width,
            height=height,
            origin=_pose(se2.compose(map_T_grid, np.array([*grid.origin, 0.0]))),
        )
        self._publish(MAP, make(_TYPES[MAP], header=self._header(stamp_ns, frame), info=info, data=grid.cells.ravel()))

    def publish_corrections(self, parameters: Mapping[str, tuple[float, float]], stamp_ns: int) -> None:
        """Named numbers as sensor_msgs/JointState: ``position`` is the mean, ``effort`` its sigma."""
        means, sigmas = (np.array([value[i] for value in parameters.values()], dtype=float) for i in (0, 1))
        header = self._header(stamp_ns, self._frames.odom_frame)
        message = make(_TYPES[CORRECTIONS], header=header, name=list(parameters), position=means, velocity=np.zeros(0), effort=sigmas)
        self._publish(CORRECTIONS, message)

    def publish_diagnostics(self, statuses: Sequence[Status], hardware: str, stamp_ns: int) -> None:
        """diagnostic_msgs/DiagnosticArray, one status for each of ``statuses``."""
        entries = [
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=status.level,
                name=f"skidloc: {status.name}",
                message=status.message,
                hardware_id=hardware,
                values=[make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in status.values.items()],
            )
            for status in statuses
        ]
        self._publish(DIAGNOSTICS, make(_TYPES[DIAGNOSTICS], header=self._header(stamp_ns, self._frames.odom_frame), status=entries))

    def _advertise(self, topic: str) -> None:
        self._transport.advertise(self._topics[topic], _TYPES[topic], is_latched=topic in _LATCHED)

    def _publish(self, topic: str, message: object) -> None:
        self._transport.publish(self._topics[topic], encode(message, is_ros1=self._transport.is_ros1))

    def _header(self, stamp_ns: int, frame: str) -> object:
        return make("std_msgs/msg/Header", stamp=_time(stamp_ns), frame_id=frame)


class Predictor:
    """``odom_T_body`` at the rate of the wheels, with the turns of the gyro. It holds copies: nothing that it does reaches the estimator,
    so a replay gives the same numbers.

    `insert` each event and `reset` with each estimate; `predict` then gives the pose at the newest wheel sample. At an estimate the
    predicted pose changes by that estimate's correction and by nothing else, for the same motion of wheels and gyro is applied to both.
    """

    def __init__(self, model: MotionModel, robot: Robot, max_hold_s: float, max_rate_hz: float = math.inf) -> None:
        """``max_hold_s``: gaps between wheel samples that are longer end the prediction [s]. ``max_rate_hz``: more are not made [Hz]."""
        self._model, self._noise, self._max_hold_s = model, robot.wheel_noise, max_hold_s
        self._period_ns, self._due_ns = 1.0 / (max_rate_hz * _NS), -math.inf
        self._params = model.nominal
        self._wheels = WheelBuffer(robot.center_of_gravity, _KEEP_S)
        self._last: Estimate | None = None
        self._gyro: GyroCalibration | None = None
        self._clock_offset_ns = 0

    def insert(self, event: Event) -> bool:
        """Store what ``event`` contributes; returns whether a new prediction is possible, and due."""
        if isinstance(event, CgSample):
            self._wheels.set_cg(event)
        if not isinstance(event, WheelSample):
            return False
        self._wheels.insert(event)
        return self._last is not None and self._is_due(event.stamp_ns)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a period has passed, but for the jitter of the wheels' stamps; the mean rate is kept."""
        if stamp_ns < self._due_ns - _JITTER * self._period_ns:
            return False
        self._due_ns = (self._due_ns if stamp_ns - self._due_ns < self._period_ns else stamp_ns) + self._period_ns
        return True

    def reset(self, estimate: Estimate, params: FloatArray | None, clock_offset_s: float, gyro: GyroCalibration | None = None) -> None:
        """Predict from ``estimate`` on, with ``params`` (k,) of the motion model (None: the nominal ones).

        ``clock_offset_s``: the wheels' stamps are late by this much [s]. ``gyro``: None where it is not used.
        """
        self._last, self._gyro = estimate, gyro
        self._params = self._model.nominal if params is None else params
        self._clock_offset_ns = round(clock_offset_s / _NS)

    def begin(self, stamp_ns: int) -> None:
        """Predict from the origin on, where the robot is at ``stamp_ns``, with the nominal parameters."""
        self.reset(Estimate(stamp_ns, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))), None, 0.0)

    def stop(self) -> None:
        """Predict nothing until the next estimate."""
        self._last = None

    def predict(self, measure_turn: Callable[[int, int], Turn | None] = lambda start_ns, end_ns: None) -> Estimate | None:
        """The estimate at the newest wheel sample; None where that is not newer than the last estimate, or the wheels have a gap since.

        ``measure_turn``: the gyro's turn between two stamps [ns].
        """
        if self._last is None or self._wheels.rates_known_until_ns is None:
            return None
        begin_ns, end_ns = self._last.stamp_ns + self._clock_offset_ns, self._wheels.rates_known_until_ns
        if not 0 < end_ns - begin_ns <= _MAX_HORIZON_S / _NS:
            return None
        dt, rates, cg, missing = self._wheels.window(begin_ns, end_ns, self._max_hold_s)
        if missing or not len(dt):
            return None
        by_model = self._model.twist(rates, cg, self._params)
        motion, duration = integrate_twists(dt, by_model, self._noise), (end_ns - begin_ns) * _NS
        mean, cov = mean_twist(motion.delta, motion.cov, duration)
        twist, twist_cov = twist_at_end(mean, cov, by_model.value[-1] - mean, duration)
        turn = None if self._gyro is None or not rates.any() else measure_turn(self._last.stamp_ns, end_ns - self._clock_offset_ns)
        if turn is not None and self._gyro is not None:
            way, way_cov = fuse_turn(se2.log(motion.delta), motion.cov, *self._gyro.correct_angle(turn))
            motion = Motion(se2.exp(way), way_cov)
            if (rate := self._gyro.correct_rate(turn)) is not None:
                change, variance = _change_of_rate(dt, by_model.value[:, 2], turn.rate_age_s)
                twist, twist_cov = fuse_turn(twist, twist_cov, rate[0] + change, rate[1] + variance)
        return _propagated(self._last, motion, twist, twist_cov, end_ns - self._clock_offset_ns)


def _change_of_rate(dt: FloatArray, rates: FloatArray, age_s: float) -> tuple[float, float]:
    """How much turn ``rates`` (n,) [rad/s] of intervals ``dt`` (n,) [s] change in the last ``age_s`` [s], since the gyro's newest sample;
    and its variance, by the second differences of the rates, which are 6 times that of one."""
    at = min(int(np.searchsorted(np.cumsum(dt[::-1]), age_s, side="right")), len(rates) - 1)
    change = float(rates[-1] - rates[-1 - at])
    if at == 0:
        return 0.0, 0.0
    scatter = float(np.mean(np.diff(rates, 2) ** 2)) / 3.0 if len(rates) > 2 else change**2
    return change, scatter + (CHANGE_SHARE * change) ** 2


def _fused(estimate: Estimate, stamp_ns: int) -> FusedEstimate:
    """``estimate`` in `odom`."""
    pose, covariance = estimate.odometry or (estimate.pose, estimate.covariance)
    return FusedEstimate(stamp_ns, pose, estimate.twist, covariance, estimate.twist_covariance, in_space=estimate.in_space)


def _correction(estimate: Estimate, stamp_ns: int) -> FusedEstimate:
    """``map_T_odom``; in space where the saved map is."""
    assert estimate.map_T_odom is not None
    in_map, in_odom, in_space = estimate.in_map, estimate.in_space, None
    if in_map is not None and in_odom is not None:
        R = in_map.rotation @ in_odom.rotation.T
        in_space = Pose3(in_map.position - R @ in_odom.position, R, np.zeros((6, 6)))
    return FusedEstimate(stamp_ns, estimate.map_T_odom, np.zeros(3), in_space=in_space)


class Path:
    """Poses along the way: the spacing doubles whenever there are too many."""

    def __init__(self) -> None:
        self.poses: list[tuple[int, FloatArray]] = []
        self.is_in_map = False
        self._spacing_m = _PATH_SPACING_M

    def insert(self, estimate: Estimate) -> None:
        """Add the pose of ``estimate`` where it is far enough from the last one."""
        self.is_in_map = estimate.map_T_odom is not None
        if self.poses and math.dist(self.poses[-1][1][:2], estimate.pose[:2]) < self._spacing_m:
            return
        self.poses.append((estimate.stamp_ns, estimate.pose))
        if len(self.poses) > _MAX_PATH_POSES:
            del self.poses[1::2]
            self._spacing_m *= 2.0


def occupancy_grid(points: FloatArray) -> tuple[FloatArray, float, Any]:
    """Corner (2,) [m], edge of a cell [m] and cells (rows by y, columns by x) as int8, 100 or -1, of ``points`` (N, 2)."""
    low, high, cell = points.min(axis=0), points.max(axis=0), _CELL_M
    while np.prod(np.floor((high - low) / cell) + 1) > _MAX_CELLS:
        cell *= 2.0
    at = np.floor((points - low) / cell).astype(int)
    columns, rows = at.max(axis=0) + 1
    grid = np.full((rows, columns), -1, np.int8)
    grid[at[:, 1], at[:, 0]] = 100
    return low, cell, grid


def _pose(pose: FloatArray) -> object:
    x, y, yaw = map(float, pose)
    half = 0.5 * math.remainder(yaw, math.tau)
    return _placed(np.array([x, y, 0.0]), np.array([0.0, 0.0, math.sin(half), math.cos(half)]))


def _placed(position: FloatArray, quaternion: FloatArray) -> object:
    at, turn = dict(zip("xyz", position.tolist(), strict=True)), dict(zip("xyzw", quaternion.tolist(), strict=True))
    return make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", **at), orientation=make(_QUATERNION, **turn))


_QUATERNION = "geometry_msgs/msg/Quaternion"


def _time(stamp_ns: int) -> object:
    return make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def _propagated(last: Estimate, motion: Motion, twist: FloatArray, twist_cov: FloatArray, stamp_ns: int) -> Estimate:
    """``last`` moved by ``motion``: right perturbations, P' = Ad(delta^-1) P Ad(delta^-1)^T + Q (Solà et al. 2018, eq. 55)."""
    A = se2.adjoint(se2.inverse(motion.delta))

    def moved(pose: FloatArray, cov: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
        return se2.compose(pose, motion.delta), None if cov is None else A @ cov @ A.T + motion.cov

    pose, cov = moved(last.pose, last.covariance)
    odometry = None if last.odometry is None else moved(*last.odometry)
    in_space, in_map = (None if at is None else at.moved(motion.delta, motion.cov) for at in (last.in_space, last.in_map))
    return Estimate(stamp_ns, pose, cov, twist, twist_cov, None, odometry, last.map_T_odom, in_space, in_map)
