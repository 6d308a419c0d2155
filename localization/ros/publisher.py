"""What is published: odometry, transforms, pose, path, map, what was learned of the robot, diagnostics."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.estimate import Estimate
from localization.logs.fused_messages import FusedEstimate
from localization.logs.serialization import FusedWriter, encode, make
from localization.ros.discovery import TF, TF_TYPE
from localization.ros.node_config import Frames, Names, NodeConfig
from localization.ros.transports.transport import Transport
from localization.space_pose import Pose3
from motion_models import se2
from motion_models.se2 import FloatArray

if TYPE_CHECKING:
    from localization.maps.grid import Grid
    from localization.ros.diagnostics import Status

ODOMETRY, PREDICTED_ODOMETRY, POSE = "~/odometry", "~/odometry_predicted", "~/pose"
CORRECTIONS, DIAGNOSTICS, PATH, MAP = "~/corrections", "/diagnostics", "~/path", "~/map"
LOCALIZATION, FIX = "~/localization_state", "~/fix"

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
    LOCALIZATION: "std_msgs/msg/String",
    FIX: "sensor_msgs/msg/NavSatFix",
}
_LATCHED = (POSE, PATH, MAP, LOCALIZATION)
_MAX_PATH_POSES, _PATH_SPACING_M = 500, 0.05
"""A path is thinned to so many poses: rosbags takes 15 us for each, and no scan shall wait for it for more than 10 ms."""
_STATUS_FIX, _SERVICE_GPS, _COVARIANCE_KNOWN = 0, 1, 3
"""Constants of NavSatStatus and NavSatFix: a fix, of GPS, with a covariance of all axes."""
_UNKNOWN_HEIGHT_VARIANCE = 1e6
"""[m^2]"""
_CELL_M, _MAX_CELLS = 0.1, 4_000_000
"""Edge of the map's cells [m]; it doubles until the map has at most so many."""

_NO_OFFSET = np.zeros(3)


class EstimatePublisher:
    """Publishes on a transport.

    Each estimate has the stamp of its scan, which came some 10 ms ago; predictions have those of the wheels' newest messages. Transforms
    and predicted odometry are one continuous stream of both in order of stamps: an estimate that a prediction has overtaken is left out
    there, and the next prediction starts from it.
    """

    def __init__(
        self,
        transport: Transport,
        names: Names,
        frames: Frames,
        *,
        with_tf: bool,
        has_predictions: bool = False,
        map_topic: str = MAP,
        transform_tolerance_s: float = 0.0,
    ) -> None:
        """``transform_tolerance_s``: by how much `map` -> `odom` is stamped later [s]."""
        self._transport, self._with_tf, self._frames = transport, with_tf, frames
        self._tolerance_ns, self._state = round(transform_tolerance_s * 1e9), ""
        self._odometry = FusedWriter(is_ros1=transport.is_ros1, parent=frames.odom_frame, body=frames.base_link_frame)
        self._map_correction = FusedWriter(is_ros1=transport.is_ros1, parent=frames.map_frame, body=frames.odom_frame)
        self.recent_transforms: deque[bytes] = deque(maxlen=_NEW_KEYFRAMES)
        """Transforms of the body, as they were published."""
        self._topics = {topic: names.resolve(map_topic if topic == MAP else topic) for topic in _TYPES}
        self._advertised: set[str] = set()
        self._has_predictions = has_predictions
        self._unread: frozenset[str] = frozenset()  # topics of predictions that nobody receives
        self._path = Path()
        for topic in (ODOMETRY, CORRECTIONS, DIAGNOSTICS, *((TF,) if with_tf else ()), *((PREDICTED_ODOMETRY,) if has_predictions else ())):
            self._advertise(topic)

    @classmethod
    def of_node(cls, transport: Transport, config: NodeConfig) -> EstimatePublisher:
        """A publisher as ``config`` has it. Subscribers have found its topics by the first estimate, if it is made at the start."""
        return cls(
            transport,
            config.names,
            config.frames,
            with_tf=config.tf,
            has_predictions=config.predict,
            map_topic=config.map_topic,
            transform_tolerance_s=config.transform_tolerance,
        )

    def advertise_optional(self, *, has_map_frame: bool, has_path: bool, has_map: bool, has_fix: bool) -> None:
        """Open the topics that not every node fills."""
        optional = {POSE: has_map_frame, PATH: has_path, MAP: has_map, FIX: has_fix}
        for topic, is_used in optional.items():
            if is_used:
                self._advertise(topic)

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transforms from now on, or no more."""
        if is_on:
            self._advertise(TF)
        self._with_tf = is_on

    def restart(self) -> None:
        """Begin a new path, for the robot was set to another place."""
        self._path = Path()

    def publish_estimate(self, estimate: Estimate, stamp_ns: int) -> None:
        """nav_msgs/Odometry with true vy at ``stamp_ns``; of a graph the pose in `map` too.

        ``stamp_ns`` is the stamp of the estimate in the clock of its sender, which may have been set since the start.
        """
        self._transport.publish(self._topics[ODOMETRY], self._odometry.odometry(_fused(estimate, stamp_ns)))
        self._path.insert(estimate)
        if estimate.map_T_odom is not None:
            self._publish_pose(estimate, stamp_ns)

    def find_readers(self) -> None:
        """Find out who receives predictions: what nobody does is not written from now on. Call it a few times a second."""
        topics = [PREDICTED_ODOMETRY] * self._has_predictions + [TF] * self._with_tf
        self._unread = frozenset(topic for topic in topics if not self._transport.has_readers(self._topics[topic]))

    @property
    def are_predictions_read(self) -> bool:
        """Whether somebody receives predicted odometry or transforms."""
        return (self._has_predictions and PREDICTED_ODOMETRY not in self._unread) or (self._with_tf and TF not in self._unread)

    def publish_continuous(self, estimate: Estimate, stamp_ns: int) -> None:
        """Publish an estimate or prediction that is the newest: predicted odometry, and the transforms."""
        fused = _fused(estimate, stamp_ns)
        if self._with_tf:
            self.recent_transforms.append(self._odometry.transform(fused))
            self._transport.publish(self._topics[TF], self.recent_transforms[-1])
            if estimate.map_T_odom is not None:
                correction = _correction(estimate, stamp_ns + self._tolerance_ns)
                self._transport.publish(self._topics[TF], self._map_correction.transform(correction))
        if self._has_predictions and PREDICTED_ODOMETRY not in self._unread:
            self._transport.publish(self._topics[PREDICTED_ODOMETRY], self._odometry.odometry(fused))

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

    def publish_fix(self, degrees: FloatArray, cov: FloatArray, stamp_ns: int) -> None:
        """sensor_msgs/NavSatFix of the body: latitude and longitude (2,) [deg], covariance (2, 2) east and north [m^2]; the height is not
        known."""
        covariance = np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = cov, _UNKNOWN_HEIGHT_VARIANCE
        fix = make(
            _TYPES[FIX],
            header=self._header(stamp_ns, self._frames.base_link_frame),
            status=make("sensor_msgs/msg/NavSatStatus", status=_STATUS_FIX, service=_SERVICE_GPS),
            latitude=float(degrees[0]),
            longitude=float(degrees[1]),
            altitude=math.nan,
            position_covariance=covariance.ravel(),
            position_covariance_type=_COVARIANCE_KNOWN,
        )
        self._publish(FIX, fix)

    def publish_localization(self, state: str) -> None:
        """std_msgs/String, where ``state`` of the localization in a saved map is another than before."""
        self._advertise(LOCALIZATION)
        if state != self._state:
            self._state = state
            self._publish(LOCALIZATION, make(_TYPES[LOCALIZATION], data=state))

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
        self._publish_cells(cells, np.array([*origin, 0.0]), cell, stamp_ns)

    def publish_grid(self, grid: Grid, stamp_ns: int, map_T_grid: FloatArray = _NO_OFFSET) -> None:
        """nav_msgs/OccupancyGrid with free space; ``map_T_grid`` (3,): of the frame that ``grid`` was drawn in."""
        origin = np.array([*grid.origin, 0.0])
        self._publish_cells(grid.cells, se2.compose(map_T_grid, origin), grid.resolution, stamp_ns)

    def _publish_cells(self, cells: Any, origin: FloatArray, cell_m: float, stamp_ns: int) -> None:
        frame = self._frames.map_frame if self._path.is_in_map else self._frames.odom_frame
        height, width = cells.shape
        info = make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=_time(stamp_ns),
            resolution=cell_m,
            width=width,
            height=height,
            origin=_pose(origin),
        )
        self._publish(MAP, make(_TYPES[MAP], header=self._header(stamp_ns, frame), info=info, data=cells.ravel()))

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
        if topic in self._advertised:
            return
        self._advertised.add(topic)
        self._transport.advertise(self._topics[topic], _TYPES[topic], is_latched=topic in _LATCHED)

    def _publish(self, topic: str, message: object) -> None:
        self._transport.publish(self._topics[topic], encode(message, is_ros1=self._transport.is_ros1))

    def _header(self, stamp_ns: int, frame: str) -> object:
        return make("std_msgs/msg/Header", stamp=_time(stamp_ns), frame_id=frame)


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
