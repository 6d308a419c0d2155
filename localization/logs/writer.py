"""Writes messages as a new log: a ROS 1 bag (.bag), a bare ROS 2 file (.mcap), or a ROS 2 folder (any name without those endings)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2

from localization.logs.message_templates import STORE, STORE_ROS1, Message, MessageLayout, Template
from localization.output import output_errors, refuse_existing

_LATCHED_TOPIC = "/tf_static"


def write_bag(path: str | Path, messages: Iterable[Message], on_message: Callable[[int], None] | None = None) -> int:
    """Write ``messages``, which come in order of their ``log_ns``, one by one to ``path``; same messages, same bytes.

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
        count = _write(inner, path, messages, on_message)
        refuse_existing(path)
        with output_errors(path):
            (inner / path.name if path.suffix == ".mcap" else inner).replace(path)
    finally:
        folder.cleanup()
    return count


def _write(inner: Path, path: Path, messages: Iterable[Message], on_message: Callable[[int], None] | None) -> int:
    is_ros1 = path.suffix == ".bag"
    writer: Any
    if is_ros1:
        writer = rosbag1.Writer(inner)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(inner, version=9, storage_plugin=plugin)
    # Only the writing is inside `output_errors`: what a simulation raises meanwhile passes as it is.
    with output_errors(path):
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
            with output_errors(path):
                writer.write(topics[layout.topic], message.log_ns, data)
            count += 1
            if on_message is not None:
                on_message(message.log_ns)
        with output_errors(path):
            writer.close()
    except BaseException:
        writer.abort()
        raise
    return count


def _connect(writer: Any, path: Path, layout: MessageLayout, is_ros1: bool) -> Any:
    with output_errors(path):
        if is_ros1:
            latched = 1 if layout.topic == _LATCHED_TOPIC else None
            return writer.add_connection(layout.topic, layout.type, typestore=STORE_ROS1, latching=latched)
        return writer.add_connection(layout.topic, layout.type, typestore=STORE)
