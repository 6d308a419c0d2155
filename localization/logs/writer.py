"""Write logs: `write_bag` any messages, `write_fused` estimates as one bare .mcap with Odometry for each result, and /tf for one.

Content of the messages, and where ROS's conventions differ from this library's:

- `/NAME/odometry`, nav_msgs/Odometry, `odom` -> `base_link`, or `map` -> `base_link` of estimators that localize; the twist is the body's,
  with the true vy.
- The covariance of a pose is, here, that of a perturbation in the body's axes; ROS defines it as that of x, y in the axes of `odom`
  (REP-103, nav_msgs/Odometry). The block of x, y, yaw is therefore turned by the heading. The covariance of a twist stays in
  the body's axes, in both.
- What planar motion does not estimate (z, roll, pitch and their rates) is zero with a variance of `UNKNOWN_VARIANCE`, and so is
  every variance of an estimate without covariance: robot_localization and similar filters then give it no weight.
- `/tf` carries the transform to `base_link` of one result only, for a frame can have only one parent.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import re
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores.ros2_humble import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Point as Point
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Pose as Pose
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__PoseWithCovariance as PoseWithCovariance
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Quaternion as Quaternion
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Transform as Transform
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__TransformStamped as TransformStamped
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Twist as Twist
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__TwistWithCovariance as TwistWithCovariance
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Vector3 as Vector3
from rosbags.typesys.stores.ros2_humble import nav_msgs__msg__Odometry as Odometry
from rosbags.typesys.stores.ros2_humble import std_msgs__msg__Header as Header
from rosbags.typesys.stores.ros2_humble import tf2_msgs__msg__TFMessage as TFMessage

from localization.errors import OutputError
from localization.lifting import Pose3, quaternion
from localization.logs.message_templates import STORE, Message, MessageLayout, Template, store_ros1
from localization.output import output_errors, refuse_existing
from motion_models import se2
from motion_models.se2 import FloatArray

UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated [m^2, rad^2, and per s^2]: ROS drivers' convention for values without information."""

PARENT_FRAME = "odom"
MAP_FRAME = "map"
BODY_FRAME = "base_link"

_ODOMETRY = "nav_msgs/msg/Odometry"
_TF = "tf2_msgs/msg/TFMessage"
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_STAMP_END = 2**31 * 10**9  # seconds of a ROS stamp are an int32
_ROUNDING = 1e-12  # below this a negative variance is that of a filter that has failed, not of its last digit
_UNKNOWN = np.diag(np.full(6, UNKNOWN_VARIANCE)).ravel()
_PLANAR = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]  # x, y, yaw among x, y, z, roll, pitch, yaw
_LATCHED_TOPIC = "/tf_static"


def write_bag(path: str | Path, messages: Iterable[Message], on_message: Callable[[int], None] | None = None) -> int:
    """Write a new log: a ROS 1 bag (.bag), a bare ROS 2 file (.mcap), or a ROS 2 folder (any other name).

    ``messages``, which come in order of their ``log_ns``, are written one by one; same messages, same bytes.

    Messages of one topic share a layout, or differ only in the length of texts. ``on_message`` is called with the time of each.
    Returns their number. Raises `OutputError`, and leaves nothing behind, where ``path`` exists or cannot be written; what ``messages``
    raises passes.
    """
    path = Path(path)
    refuse_existing(path)
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=".writing-")
    try:
        # rosbags names the file in a ROS 2 folder after the folder: the name must be right from the start.
        inner = Path(folder.name) / (path.stem if path.suffix == ".mcap" else path.name)
        count = _write_messages(inner, path, messages, on_message)
        refuse_existing(path)
        with output_errors(path):
            (inner / path.name if path.suffix == ".mcap" else inner).replace(path)
    finally:
        folder.cleanup()
    return count


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Errors of the system and of SQLite inside become `OutputError`."""
    try:
        with output_errors(path):
            yield
    except sqlite3.Error as error:
        raise OutputError(f"output '{path}' cannot be written: SQLite reports '{error}'. Is there room on the disk?") from error


def _write_messages(inner: Path, path: Path, messages: Iterable[Message], on_message: Callable[[int], None] | None) -> int:
    is_ros1 = path.suffix == ".bag"
    writer: Any
    if is_ros1:
        writer = rosbag1.Writer(inner)
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer(inner, version=9, storage_plugin=plugin)
    # Only the writing is inside `_writing`: what a simulation raises meanwhile passes as it is.
    with _writing(path):
        writer.open()
    try:
        topics: dict[str, Any] = {}
        templates: dict[MessageLayout, Template] = {}
        count = 0
        for message in messages:
            layout = message.layout
            if layout not in templates:
                templates[layout] = Template(layout, is_ros1=is_ros1)
                topics[layout.topic] = topics.get(layout.topic) or _connect(writer, path, layout, is_ros1)
            data = templates[layout].fill(message)
            with _writing(path):
                writer.write(topics[layout.topic], message.log_ns, data)
            count += 1
            if on_message is not None:
                on_message(message.log_ns)
        with _writing(path):
            writer.close()
    except BaseException:
        with contextlib.suppress(OSError, sqlite3.Error):  # a full disk fails again
            writer.abort()
        raise
    return count


def _connect(writer: Any, path: Path, layout: MessageLayout, is_ros1: bool) -> Any:
    with _writing(path):
        if is_ros1:
            latched = 1 if layout.topic == _LATCHED_TOPIC else None
            return writer.add_connection(layout.topic, layout.type, typestore=store_ros1(), latching=latched)
        return writer.add_connection(layout.topic, layout.type, typestore=STORE)


@dataclass(frozen=True)
class FusedEstimate:
    """Pose and twist of one estimator at one moment."""

    stamp_ns: int
    pose: FloatArray
    """(3,) x, y, theta of the body in the world [m, m, rad]."""
    twist: FloatArray
    """(3,) vx, vy, wz of the body in its own axes [m/s, m/s, rad/s]."""
    covariance: FloatArray | None = None
    """(3, 3) of the pose's right (body-frame) perturbation, or None where it is unknown."""
    twist_covariance: FloatArray | None = None
    """(3, 3) of the twist, or None where it is unknown."""
    parent: str = PARENT_FRAME
    """Frame that the pose is in."""
    in_space: Pose3 | None = None
    """The pose in space, of which ``pose`` is the one seen from above: it is written with its (6, 6) covariance."""

    def place(self) -> tuple[FloatArray, FloatArray]:
        """Position (3,) [m] and quaternion x, y, z, w (4,); on the plane where there is no pose in space."""
        if self.in_space is not None:
            return self.in_space.position, np.array(quaternion(self.in_space.rotation))
        x, y, theta = self.pose.tolist()
        return np.array([x, y, 0.0]), np.array([0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)])

    def pose_covariance(self) -> FloatArray:
        """(36,) row-major covariance of x, y, z, roll, pitch, yaw in the parent's axes."""
        if self.in_space is not None:
            return self.in_space.covariance.ravel()
        return six_by_six(None if self.covariance is None else odom_axes(self.covariance, float(self.pose[2])))


def write_fused(path: str | Path, results: Mapping[str, Iterable[FusedEstimate]], tf_of: str | None = None) -> None:
    """Write a new bag to ``path`` (.mcap), message by message, in order of stamps; same estimates, same bytes.

    ``results`` holds the estimates of each named result (`skid_steer_ekf` becomes the topic `/skid_steer_ekf/odometry`), in
    strictly rising order of stamps; iterators are consumed in parallel. ``tf_of`` names the result that goes to
    /tf, the first one if None.

    Raises `OutputError`, and leaves nothing behind, where ``path`` exists or cannot be written, where nothing is to be written,
    and for an invalid estimate: values or covariances that are not finite, negative variances, stamps that
    do not rise.
    """
    path = Path(path)
    tf_of = _check_names(results, tf_of)
    if path.suffix != ".mcap":
        raise OutputError(f"output '{path}': the fused log is an MCAP file; give it a name that ends in .mcap.")
    refuse_existing(path)
    with output_errors(path):
        folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=".fused-")
    try:
        bag = Path(folder.name) / path.stem  # rosbags writes folders; the result is the file in it, of the same name
        _write_bag(bag, path, results, tf_of)
        refuse_existing(path)
        with output_errors(path):
            (bag / path.name).replace(path)
    finally:
        folder.cleanup()


def _write_bag(bag: Path, path: Path, results: Mapping[str, Iterable[FusedEstimate]], tf_of: str) -> None:
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    # Only the writing is inside `_writing`: what a lazy result raises while it is computed passes as it is.
    with _writing(path):
        writer.open()
    try:
        connections = {name: writer.add_connection(f"/{name}/odometry", _ODOMETRY, typestore=_STORE) for name in results}
        tf = writer.add_connection("/tf", _TF, typestore=_STORE)
        count = 0
        for name, estimate in heapq.merge(*(_check_estimates(*item) for item in results.items()), key=lambda item: item[1].stamp_ns):
            count += 1
            messages = [(connections[name], _STORE.serialize_cdr(odometry_message(estimate), _ODOMETRY))]
            if name == tf_of:
                messages.append((tf, _STORE.serialize_cdr(transform_message(estimate), _TF)))
            for connection, data in messages:
                _write(writer, path, connection, estimate.stamp_ns, data)
        if not count:
            raise OutputError(f"output '{path}': there is nothing to write: no estimates in {', '.join(results)}.")
        with _writing(path):
            writer.close()
    except BaseException:
        with contextlib.suppress(OSError, sqlite3.Error):  # a full disk fails again
            writer.abort()
        raise


def _write(writer: Writer, path: Path, connection: Connection, stamp_ns: int, data: bytes | memoryview) -> None:
    with _writing(path):
        writer.write(connection, stamp_ns, data)


def odometry_message(estimate: FusedEstimate) -> Odometry:
    """nav_msgs/Odometry."""
    (x, y, z), turn = estimate.place()
    vx, vy, wz = (float(v) for v in estimate.twist)
    return Odometry(
        header=_header(estimate),
        child_frame_id=BODY_FRAME,
        pose=PoseWithCovariance(
            pose=Pose(position=Point(x=float(x), y=float(y), z=float(z)), orientation=_quaternion(turn)),
            covariance=estimate.pose_covariance(),
        ),
        twist=TwistWithCovariance(
            twist=Twist(linear=Vector3(x=vx, y=vy, z=0.0), angular=Vector3(x=0.0, y=0.0, z=wz)),
            covariance=six_by_six(estimate.twist_covariance),
        ),
    )


def transform_message(estimate: FusedEstimate) -> TFMessage:
    """tf2_msgs/TFMessage, from the frame of the pose to `base_link`."""
    (x, y, z), turn = estimate.place()
    transform = Transform(translation=Vector3(x=float(x), y=float(y), z=float(z)), rotation=_quaternion(turn))
    return TFMessage(transforms=[TransformStamped(header=_header(estimate), child_frame_id=BODY_FRAME, transform=transform)])


def odom_axes(covariance: FloatArray, theta: float) -> FloatArray:
    """(3, 3) covariance of x, y, yaw in the parent's axes, from that of the body-frame perturbation at heading ``theta`` [rad].

    To first order, compose(pose, exp(e)) moves x, y by R(theta) e_xy and the yaw by e_theta.
    """
    turned = se2.rotate_covariance(covariance, theta)
    return (turned + turned.T) / 2


def six_by_six(planar: FloatArray | None) -> FloatArray:
    """(36,) row-major covariance of x, y, z, roll, pitch, yaw, from the (3, 3) of x, y, yaw."""
    full = _UNKNOWN.copy()
    if planar is not None:
        full[_PLANAR] = planar.ravel()
    return full


def _header(estimate: FusedEstimate) -> Header:
    stamp_ns = estimate.stamp_ns
    return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=estimate.parent)


def _quaternion(turn: FloatArray) -> Quaternion:
    x, y, z, w = map(float, turn)
    return Quaternion(x=x, y=y, z=z, w=w)


def _check_estimates(name: str, estimates: Iterable[FusedEstimate]) -> Iterator[tuple[str, FusedEstimate]]:
    """The estimates with their result's name. Raises `OutputError` at the first invalid one."""
    last_ns = -1
    for estimate in estimates:
        where = f"result '{name}' at {estimate.stamp_ns * 1e-9:.6f} s"
        if not 0 <= estimate.stamp_ns < _STAMP_END:
            raise OutputError(f"{where}: the stamp does not fit into a ROS message (0 to 2^31 s).")
        if estimate.stamp_ns <= last_ns:
            raise OutputError(
                f"{where}: the stamp does not rise after {last_ns * 1e-9:.6f} s; sort the estimates and drop repeated stamps."
            )
        last_ns = estimate.stamp_ns
        _check_values("pose", estimate.pose, (3,), where)
        _check_values("twist", estimate.twist, (3,), where)
        if estimate.in_space is not None:
            _check_values("pose in space", estimate.in_space.position, (3,), where)
            _check_values("covariance of the pose in space", estimate.in_space.covariance, (6, 6), where)
        for what, covariance in (("covariance", estimate.covariance), ("twist covariance", estimate.twist_covariance)):
            if covariance is None:
                continue
            _check_values(what, covariance, (3, 3), where)
            if min(covariance[0, 0], covariance[1, 1], covariance[2, 2]) < -_ROUNDING:
                raise OutputError(f"{where}: the {what} has a negative variance, {np.diag(covariance).tolist()}: the estimator has failed.")
        yield name, estimate


def _check_values(what: str, values: FloatArray, shape: tuple[int, ...], where: str) -> None:
    if np.shape(values) != shape:
        raise OutputError(f"{where}: the {what} has shape {np.shape(values)}; it must be {shape}.")
    if not np.isfinite(values).all():
        raise OutputError(
            f"{where}: the {what} is not finite, {np.asarray(values).tolist()}: the estimator has failed, nothing was written."
        )


def _check_names(results: Mapping[str, Iterable[FusedEstimate]], tf_of: str | None) -> str:
    """The name of the result that goes to /tf."""
    if not results:
        raise OutputError("there is no result to write; give at least one.")
    for name in results:
        if not _NAME.fullmatch(name):
            raise OutputError(f"result '{name}': its name becomes a topic and may hold only letters, digits and '_', a letter first.")
    if tf_of is None:
        return next(iter(results))
    if tf_of not in results:
        raise OutputError(f"no result '{tf_of}' for /tf; there are {', '.join(results)}.")
    return tf_of
