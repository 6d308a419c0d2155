"""Open any log: ROS 1 bags, ROS 2 folders (sqlite3, mcap) and bare storage files, whole or cut off."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.rosbag2 import Reader

from localization.errors import LogError
from localization.logs import ros1
from localization.logs.chunks import Channel, DamagedError, RawMessage, Source

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SQLITE_MAGIC = b"SQLite format 3\x00"


def open_source(path: Path) -> Source:
    """The log at ``path``. Raises `LogError` if it is not there, not a log, or nothing in it can be read."""
    if path.is_dir():
        return _open_ros2(path)
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error
    if not head:
        raise LogError(f"log '{path}' is empty.")
    if head.startswith(ros1.MAGIC):
        return ros1.Ros1Bag(path)
    if head.startswith((_MCAP_MAGIC, _SQLITE_MAGIC)):
        return _open_ros2(path)
    raise LogError(f"'{path}' is not a log: it is neither a ROS 1 bag (.bag), nor an MCAP file (.mcap), nor a ROS 2 bag folder.")


def _open_ros2(path: Path) -> Source:
    try:
        return Ros2Bag(path)
    except DamagedError as reason:
        raise LogError(f"'{path}' cannot be read: {reason}.") from reason


class Ros2Bag:
    """A whole ROS 2 log, read by rosbags. Raises `DamagedError` for any other."""

    is_ros1 = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []
        try:
            with Reader(path) as reader:
                self.channels = [Channel(c.topic, c.msgtype, c.msgdef, c.msgcount) for c in reader.connections]
                self.start_ns, self.end_ns = (reader.start_time, reader.end_time - 1) if reader.message_count else (0, 0)
        except Exception as error:  # for damaged files rosbags lets out struct.error, AssertionError, zstd's and SQLite's errors
            raise DamagedError(str(error).strip(".") or type(error).__name__) from error

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        with Reader(self._path) as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            if not connections:
                return
            for connection, log_ns, data in reader.messages(connections):
                yield RawMessage(log_ns, connection.topic, connection.msgtype, data)
