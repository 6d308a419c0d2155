"""Write logs: `write_bag` any messages, `write_fused` estimates as one bare .mcap with Odometry for each result (`/NAME/odometry`), and /tf
for one, for a frame can have only one parent."""

from __future__ import annotations

import contextlib
import heapq
import re
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from localization.errors import OutputError
from localization.logs.fused_messages import FusedEstimate, odometry_message, transform_message
from localization.logs.message_templates import STORE, Message, MessageLayout, Template, store_ros1
from localization.output import output_errors, refuse_existing
from motion_models.se2 import FloatArray

_ODOMETRY = "nav_msgs/msg/Odometry"
_TF = "tf2_msgs/msg/TFMessage"
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_STAMP_END = 2**31 * 10**9  # seconds of a ROS stamp are an int32
_ROUNDING = 1e-12  # below this a negative variance is that of a filter that has failed, not of its last digit
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
