"""Commands of an operator to a running node, by topics and services: poses, payloads, reset, pause and tare, maps to save and to search.

Topics work with every transport, services with rclpy alone.
"""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from localization.errors import MapError, OutputError
from localization.estimators import PriorMap, SavedMapFusion
from localization.logs.decode import UnusableError, frame_name
from localization.logs.fused_messages import odom_axes
from localization.logs.serialization import decoder
from localization.maps import KeyframeMap, SavedMap, load_map, save_map
from localization.maps.space_places import Places, make_places
from localization.output import versions
from localization.ros.gnss import GeodeticMap
from localization.ros.node_config import Names
from localization.ros.payloads import Load, Payloads
from localization.ros.start_pose import StartPose
from localization.ros.transports.transport import Received, ServiceReply, Transport
from motion_models.errors import CgError, RobotError
from motion_models.se2 import FloatArray

SET_POSE = "set_pose"
"""Topic of a given pose, as robot_localization has it."""
INITIAL_POSE = "initialpose"
"""Topic of a given pose, as RViz and nav2 have it."""
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
RESET, PAUSE, TARE_PAYLOAD, PAYLOAD = "~/reset", "~/pause", "~/tare_payload", "~/payload"
RELOCALIZE, SAVE_MAP, LOAD_MAP = "~/relocalize", "~/save_map", "~/load_map"
_GLOBAL_LOCALIZATION, _SERIALIZE_MAP, _DESERIALIZE_MAP = "reinitialize_global_localization", "~/serialize_map", "~/deserialize_map"
"""Services by the names of AMCL and slam_toolbox."""
_FROM_LL, _TO_LL = "fromLL", "toLL"
"""Services by the names of robot_localization."""
_NOT_ON_EARTH = "where the map is on the earth is not known: it takes --node.positions, and a drive that gives the map its heading"
_TOPIC_TYPES = {
    SET_POSE: POSE_TYPE,
    INITIAL_POSE: POSE_TYPE,
    RESET: "std_msgs/msg/Empty",
    PAUSE: "std_msgs/msg/Bool",
    TARE_PAYLOAD: "std_msgs/msg/Empty",
    PAYLOAD: "geometry_msgs/msg/InertiaStamped",
    RELOCALIZE: "std_msgs/msg/Empty",
    SAVE_MAP: "std_msgs/msg/String",
    LOAD_MAP: "std_msgs/msg/String",
}
_SUFFIX = ".skidmap"
_NO_SUCH_MAP, _INVALID_MAP = 1, 2
"""Results of nav2_msgs/LoadMap: RESULT_MAP_DOES_NOT_EXIST, RESULT_INVALID_MAP_DATA."""
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
_MIN_SIGMA = 1e-3
"""Sigmas of a pose without a covariance: RViz sends one, `ros2 topic pub` mostly zeros [m, rad]."""


class CommandedNode(Protocol):
    """What commands need of a `Node`."""

    is_paused: bool

    @property
    def frames(self) -> Any:
        """`settings.Frames` of what is published."""

    @property
    def session(self) -> Any:
        """The `Session` that is running."""

    @property
    def payloads(self) -> Payloads:
        """Loads that the robot holds."""

    def restart(self, start: StartPose, *, is_moved: bool = False) -> None:
        """Begin anew at ``start``. ``is_moved``: `odom` jumps to there."""

    @property
    def outputs(self) -> Any:
        """The `LiveOutputs`."""

    def replace_map(self, prior: PriorMap) -> None:
        """Localize in another saved map from now on. Raises `MapError` for one in space instead of one in the plane, and the reverse."""

    def insert_present_cg(self) -> None:
        """Give the pipeline the centre of gravity with the present payloads."""


class OperatorCommands:
    """Subscribes to the topics and offers the services; ``report`` gets a line on each command that was done or refused."""

    def __init__(self, node: CommandedNode, transport: Transport, names: Names, report: Callable[[str], None]) -> None:
        self._node, self._report = node, report
        self._commands = {names.resolve(topic): topic for topic in _TOPIC_TYPES}
        self._decoders = {topic: decoder(kind, is_ros1=transport.is_ros1) for topic, kind in _TOPIC_TYPES.items()}
        self.topics = list(self._commands)
        self._loaded: queue.SimpleQueue[tuple[str, Places | MapError]] = queue.SimpleQueue()
        for full, topic in self._commands.items():
            transport.subscribe(full, _TOPIC_TYPES[topic], is_latched=False, is_command=True)
        transport.offer_service(names.resolve(RESET), "std_srvs/srv/Empty", self.reset)
        transport.offer_service(names.resolve(PAUSE), "std_srvs/srv/SetBool", self.pause)
        transport.offer_service(names.resolve(TARE_PAYLOAD), "std_srvs/srv/Trigger", self.tare_payload)
        for name in (RELOCALIZE, _GLOBAL_LOCALIZATION):
            transport.offer_service(names.resolve(name), "std_srvs/srv/Empty", self.relocalize)
        transport.offer_service(names.resolve(SAVE_MAP), "nav2_msgs/srv/SaveMap", self.save_map)
        transport.offer_service(names.resolve(_SERIALIZE_MAP), "slam_toolbox/srv/SerializePoseGraph", self.save_map)
        transport.offer_service(names.resolve(LOAD_MAP), "nav2_msgs/srv/LoadMap", self.load_map)
        transport.offer_service(names.resolve(_DESERIALIZE_MAP), "slam_toolbox/srv/DeserializePoseGraph", self.load_map)
        transport.offer_service(names.resolve(_FROM_LL), "robot_localization/srv/FromLL", self.from_ll)
        transport.offer_service(names.resolve(_TO_LL), "robot_localization/srv/ToLL", self.to_ll)

    def execute(self, received: Received) -> bool:
        """Execute the command that ``received`` holds; False where it is of another topic."""
        topic = self._commands.get(received.topic)
        if topic is None:
            return False
        try:
            message = self._decoders[topic](received.data)
            reply = self._execute(topic, message)
        except (UnusableError, ValueError, CgError, RobotError) as error:
            self._report(f"{received.topic}: the message is ignored: {error}")
            return True
        if topic in (SET_POSE, INITIAL_POSE, PAYLOAD):
            self._report(f"{received.topic}: {reply.message}")
        return True

    def _execute(self, topic: str, message: Any) -> ServiceReply:
        """Raises `ValueError`, `CgError` and `RobotError` for content that cannot be used."""
        if topic == RESET:
            return self.reset()
        if topic == PAUSE:
            return self.pause(bool(message.data))
        if topic == TARE_PAYLOAD:
            return self.tare_payload()
        if topic == RELOCALIZE:
            return self.relocalize()
        if topic == SAVE_MAP:
            return self.save_map(message.data)
        if topic == LOAD_MAP:
            return self.load_map(message.data)
        frame = frame_name(message.header.frame_id)
        if topic == PAYLOAD:
            com = message.inertia.com
            return self.set_payload(frame, Load(float(message.inertia.m), (float(com.x), float(com.y), float(com.z))))
        return self.set_pose(*_planar(message.pose), frame)

    def set_payload(self, frame: str, load: Load) -> ServiceReply:
        """Hold ``load`` at ``frame`` from now on. Raises `CgError` and `RobotError`."""
        self._node.payloads.set(frame, load)
        self._node.insert_present_cg()
        return ServiceReply(True, self._node.payloads.summary)

    def set_pose(self, pose: FloatArray, cov: FloatArray, frame: str) -> ServiceReply:
        """Begin anew at ``pose`` (3,) in ``frame``, with covariance ``cov`` (3, 3) of its right perturbation.

        A pose in `map` leaves `odom` as it is, without a jump (REP-105); one in `odom` moves that.
        """
        frames, (odom, odom_cov) = self._node.frames, self._present_odometry()
        has_map, estimator = self._node.session.pipeline.is_localizing, self._node.session.pipeline.estimator
        if frame == frames.map_frame and isinstance(estimator, SavedMapFusion):
            estimator.set_pose(pose, cov)
            return ServiceReply(True, f"the place in the map is searched near x {pose[0]:.3f} m, y {pose[1]:.3f} m.")
        if frame == frames.map_frame and has_map:
            start = StartPose(odom, odom_cov, pose, cov)
        elif frame == frames.odom_frame:
            start = StartPose(pose, cov, pose, cov)
        else:
            known = [frames.map_frame, frames.odom_frame] if has_map else [frames.odom_frame]
            return ServiceReply(False, f"the pose is ignored: its frame is '{frame}', and this estimator has {' and '.join(known)}.")
        self._node.restart(start, is_moved=frame == frames.odom_frame)
        return ServiceReply(True, f"begins anew at x {pose[0]:.3f} m, y {pose[1]:.3f} m, yaw {math.degrees(pose[2]):.1f} deg in '{frame}'.")

    def reset(self, _: bool = True) -> ServiceReply:
        """Begin anew, with a new map and nothing learned; at the origin of `map`, and in `odom` where the robot is (REP-105)."""
        self._node.restart(StartPose(*self._present_odometry()))
        self._report("reset: begins anew; odom goes on without a jump. To move it, publish /set_pose.")
        return ServiceReply(True, "begins anew; odom goes on without a jump")

    def relocalize(self, _: Any = True) -> ServiceReply:
        """Forget the place in the saved map, and search all of it; odometry goes on."""
        estimator = self._node.session.pipeline.estimator
        if not isinstance(estimator, SavedMapFusion):
            self._report(f"relocalize: {(refused := 'there is no saved map to search. Name one by --map.')}")
            return ServiceReply(False, refused)
        estimator.relocalize()
        self._report("relocalize: the whole map is searched.")
        return ServiceReply(True, "the whole map is searched")

    def save_map(self, name: str) -> ServiceReply:
        """Write the map as it is into the new file ``name``, beside the estimates; what comes of it is reported."""
        session = self._node.session
        mapped, estimate = session.pipeline.estimator.keyframe_map(), session.health.estimate
        if mapped is None or mapped.is_in_space or not str(name).strip():
            text = "give the name of a new file." if mapped is not None else "this estimator has no map of its own. Use graph."
            if estimate is not None and estimate.in_space is not None:
                text = "poses are in space, whose map is made from the whole drive: record it, and use `skidloc replay --save-map`."
            self._report(f"save_map: nothing is saved: {text}")
            return ServiceReply(False, text)
        mounts = {frame: asdict(mount) for frame, mount in sorted(session.pipeline.mounts.items())}
        moved = mapped.moved(session.state.start.map_T_start)
        saved = SavedMap(moved, {"log": "live topics", "run": session.name, "mounts": mounts, "versions": dict(versions())})
        path = _map_path(name)
        if path.exists():
            self._report(f"save_map: '{path}' exists already. Give another name.")
            return ServiceReply(False, f"'{path}' exists already")
        threading.Thread(target=self._write, args=(path, saved), name="save map").start()
        return ServiceReply(True, f"'{path}' is being written")

    def _write(self, path: Path, saved: SavedMap) -> None:
        try:
            save_map(path, saved)
        except (MapError, OutputError) as error:
            self._report(f"save_map: {error}")
        else:
            self._report(f"save_map: {len(saved.map.poses)} keyframes are in '{path}'.")

    def load_map(self, name: str) -> ServiceReply:
        """Localize in the map of the file ``name`` instead of the present one, as soon as it is ready; odometry goes on.

        The file is read and checked at once. Until its search images are drawn, in a thread, and where it is refused, all stays as it is.
        """
        pipeline, path = self._node.session.pipeline, _map_path(name)
        if not isinstance(pipeline.estimator, SavedMapFusion):
            self._report(f"load_map: {(refused := 'this estimator uses no saved map. Start with one by --map.')}")
            return ServiceReply(False, refused)
        try:
            mapped = load_map(path).map
        except (MapError, OSError) as error:
            self._report(f"load_map: {error} The present map stays.")
            return ServiceReply(False, str(error), _INVALID_MAP if path.exists() else _NO_SUCH_MAP)
        noise_m = pipeline.estimator.localizer.places.range_noise_m
        threading.Thread(target=self._draw, args=(str(path), mapped, noise_m), name="load map", daemon=True).start()
        return ServiceReply(True, f"'{path}' is being loaded")

    def _draw(self, path: str, mapped: KeyframeMap, range_noise_m: float) -> None:
        try:
            self._loaded.put((path, make_places(mapped, range_noise_m)))
        except MapError as error:
            self._loaded.put((path, error))

    def take_loaded_map(self) -> None:
        """Go over to the map that `load_map` has made ready, if there is one: called between messages."""
        while not self._loaded.empty():
            path, found = self._loaded.get()
            try:
                if isinstance(found, MapError):
                    raise found
                self._node.replace_map(PriorMap(found))
            except MapError as error:
                self._report(f"load_map: '{path}': {error} The present map stays.")
            else:
                self._report(f"load_map: the whole map of '{path}' is searched.")

    def from_ll(self, place: Any) -> ServiceReply:
        """Where in the map latitude and longitude of ``place`` (geographic_msgs/GeoPoint) are; not a number where that is not known."""
        degrees = np.array([place.latitude, place.longitude])
        return self._on_earth(_FROM_LL, ("x", "y", "z"), lambda found: (*found.from_geodetic(degrees).tolist(), 0.0))

    def to_ll(self, point: Any) -> ServiceReply:
        """Latitude and longitude of ``point`` (geometry_msgs/Point) in the map; not a number where that is not known."""
        at, names = np.array([point.x, point.y]), ("latitude", "longitude", "altitude")
        return self._on_earth(_TO_LL, names, lambda found: (*found.to_geodetic(at).tolist(), math.nan))

    def _on_earth(self, service: str, names: Sequence[str], convert: Callable[[GeodeticMap], Sequence[float]]) -> ServiceReply:
        """What ``convert`` gives of the map's place on the earth, by ``names``."""
        found = self._node.outputs.geodetic_map(self._node.session)
        if found is None:
            self._report(f"{service}: {_NOT_ON_EARTH}.")
            return ServiceReply(False, _NOT_ON_EARTH, point=dict.fromkeys(names, math.nan))
        return ServiceReply(True, "", point=dict(zip(names, convert(found), strict=True)))

    def pause(self, is_paused: bool) -> ServiceReply:
        """Use no messages and publish no estimates, or continue. Motion meanwhile is a gap in the wheels' data."""
        self._node.is_paused = is_paused
        text = "paused" if is_paused else "continued"
        self._report(f"pause: {text}.")
        return ServiceReply(True, text)

    def tare_payload(self, _: bool = True) -> ServiceReply:
        """Remove all payloads that were set, and discard what was learned of the motion model with them; pose and covariance stay."""
        if self._node.payloads.loads:
            self._node.payloads.loads.clear()
            self._node.insert_present_cg()
        (odom, odom_cov), estimate = self._present_odometry(), self._node.session.health.estimate
        in_map = (odom, odom_cov) if estimate is None else (estimate.pose, _known(estimate.covariance))
        self._node.restart(StartPose(odom, odom_cov, *in_map))
        self._report("tare_payload: no payload is set; the motion model is learned anew from here on.")
        return ServiceReply(True, "no payload is set; the motion model is learned anew from the present pose on")

    def _present_odometry(self) -> tuple[FloatArray, FloatArray]:
        estimate = self._node.session.health.estimate
        if estimate is None:
            start = self._node.session.state.start
            return start.odom_T_start, start.odom_cov
        pose, cov = self._node.outputs.present_odometry(self._node.session.pipeline, estimate)
        return pose, cov


def _map_path(name: str) -> Path:
    """The file of a map's ``name``, as given with or without its suffix; a name with other dots, as of a date, keeps these."""
    return Path(str(name).strip().removeprefix("file://").removesuffix(_SUFFIX) + _SUFFIX)


def _known(cov: FloatArray | None) -> FloatArray:
    return np.zeros((3, 3)) if cov is None else cov


def _planar(stamped: Any) -> tuple[FloatArray, FloatArray]:
    """Pose (3,) and covariance (3, 3) of its right perturbation, of a PoseWithCovariance. Raises `ValueError`."""
    p, q = stamped.pose.position, stamped.pose.orientation
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not (math.isfinite(norm) and 0.5 < norm < 2.0):
        raise ValueError("its orientation is no unit quaternion.")
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm**2 - 2.0 * (q.y**2 + q.z**2))
    pose = np.array([p.x, p.y, yaw])
    in_parent = np.asarray(stamped.covariance, dtype=float).reshape(6, 6)[_PLANAR]
    if not (np.isfinite(pose).all() and np.isfinite(in_parent).all()):
        raise ValueError("it holds numbers that are not finite.")
    in_parent = (in_parent + in_parent.T) / 2 + _MIN_SIGMA**2 * np.eye(3)
    if np.linalg.eigvalsh(in_parent)[0] < 0.0:
        raise ValueError("its covariance has negative eigenvalues.")
    return pose, odom_axes(in_parent, -yaw)  # the inverse turn: from the axes of the parent to those of the body
