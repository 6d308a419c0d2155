"""Open any log: ROS 1 bags, ROS 2 folders (sqlite3, mcap) and bare storage files, whole or cut off."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Iterator
from contextlib import closing, nullcontext
from itertools import chain
from pathlib import Path

from rosbags.rosbag2 import Reader

from localization.errors import LogError
from localization.logs import mcap, ros1, sqlite
from localization.logs.chunks import Channel, DamagedError, RawMessage, Source, inflate_file, merge_channels


def open_source(path: Path) -> Source:
    """The log at ``path``. Raises `LogError` if it is not there, not a log, or nothing in it can be read."""
    if not path.exists():
        raise LogError(f"no log '{path}': there is no such file or folder.")
    try:
        return _open_folder(path) if path.is_dir() else _open_file(path)
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error


def _open_folder(path: Path) -> Source:
    try:
        return Ros2Bag(path)
    except FileNotFoundError:
        reason = "metadata.yaml is missing"
    except DamagedError as error:
        reason = str(error)
    return _recover_folder(path, reason)


def _recover_folder(path: Path, reason: str) -> Source:
    files = sorted((f for f in path.iterdir() if f.name.removesuffix(".zstd").endswith((".mcap", ".db3")) and f.is_file()), key=_natural)
    if not files:
        bags = sorted(f.name for f in path.iterdir() if f.suffix == ".bag")
        inside = f" ROS 1 bags in it: {', '.join(bags)}; name one of them." if bags else ""
        raise LogError(f"folder '{path}' is not a ROS 2 bag: {reason}, and it holds no .mcap or .db3 file.{inside}")
    parts: list[Source] = []
    notes = [f"{path.name} is not whole ({reason}): its files {', '.join(f.name for f in files)} are read by themselves."]
    for file in files:
        try:
            parts.append(Inflated(file) if file.suffix == ".zstd" else _open_file(file))
        except LogError as error:
            notes.append(str(error))
    if not parts:
        raise LogError(" ".join(notes))
    return Parts(parts, notes)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts run_2 before run_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]


def _open_file(path: Path) -> Source:
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise LogError(f"log '{path}' is empty.")
    if head.startswith(ros1.MAGIC):
        return ros1.Ros1Bag(path)
    is_mcap, is_sqlite = head.startswith(mcap.MAGIC), head.startswith(sqlite.MAGIC)
    if not is_mcap and not is_sqlite:
        raise LogError(f"'{path}' is not a log: it is neither a ROS 1 bag (.bag), nor an MCAP file (.mcap), nor a ROS 2 bag folder.")
    try:
        return Ros2Bag(path)
    except DamagedError as reason:
        return _recover_file(path, str(reason))


def _recover_file(path: Path, reason: str) -> Source:
    with path.open("rb") as file:
        is_mcap = file.read(16).startswith(mcap.MAGIC)
    return mcap.RecoveredMcap(path, reason) if is_mcap else sqlite.RecoveredSqlite(path, reason)


class Ros2Bag:
    """A whole ROS 2 log, read by rosbags. Raises `DamagedError` for any other.

    Damage in the middle of a file shows only when it is read; the rest is then read as that of a file that was cut off.
    """

    is_ros1 = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._notes = [
            f"{wal.name} holds rows that the recorder had not yet moved into {wal.name.removesuffix('-wal')}; they are not read."
            " Opening that file once with SQLite's own shell moves them."
            for wal in sorted(path.glob("*.db3-wal") if path.is_dir() else path.parent.glob(path.name + "-wal"))
            if wal.stat().st_size > 0
        ]
        self._rest: Source | None = None
        self._held: Reader | None = None
        files = path.glob("*.mcap") if path.is_dir() else [path] if path.suffix == ".mcap" else []
        if any(not mcap.has_chunk_index(file) for file in files):
            raise DamagedError("it has no index of chunks")
        try:
            reader = Reader(path)
            reader.open()
            if reader.compression_mode == "file":
                self._held = reader  # it has inflated the files to a temporary folder, which is not to be done again and again
            with nullcontext(reader) if self._held else closing(reader):
                self.channels = [Channel(c.topic, c.msgtype, c.msgdef, c.msgcount) for c in reader.connections]
                self.start_ns, self.end_ns = (reader.start_time, reader.end_time - 1) if reader.message_count else (0, 0)
        except FileNotFoundError:
            raise
        except Exception as error:  # for damaged files rosbags lets out struct.error, AssertionError, zstd's and SQLite's errors
            raise DamagedError(_reason(error)) from error

    @property
    def notes(self) -> list[str]:
        return self._notes if self._rest is None else [*self._notes, *self._rest.notes]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        last = self.start_ns - 1
        with nullcontext(self._held) if self._held is not None else Reader(self._path) as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            messages = reader.messages(connections) if connections else iter(())
            while True:
                try:
                    connection, last, data = next(messages)
                except StopIteration:
                    return
                except Exception as error:  # as above
                    rest = self._recover(_reason(error))
                    break
                yield RawMessage(last, connection.topic, connection.msgtype, data)
        yield from (message for message in rest.messages(topics) if message.log_ns > last)

    def _recover(self, reason: str) -> Source:
        if self._rest is None:
            self._rest = _recover_folder(self._path, reason) if self._path.is_dir() else _recover_file(self._path, reason)
        return self._rest


def _reason(error: Exception) -> str:
    return str(error).rstrip(".") or "its end is missing"


class Inflated:
    """A storage file that the recorder compressed as a whole, as much of it as can be had."""

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory()  # removed when this object is
        target = Path(self._folder.name) / path.stem
        stopped = inflate_file(path, target)
        self._inner = _open_file(target)
        self.is_ros1, self.channels = self._inner.is_ros1, self._inner.channels
        self.start_ns, self.end_ns = self._inner.start_ns, self._inner.end_ns
        self._notes = [f"{path.name} could not be decompressed to its end ({stopped})."] if stopped else []

    @property
    def notes(self) -> list[str]:
        return [*self._notes, *self._inner.notes]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        return self._inner.messages(topics)


class Parts:
    """Several files one after the other, as a recorder splits a long log."""

    def __init__(self, parts: list[Source], notes: list[str]) -> None:
        self._parts, self._notes = parts, notes
        self.is_ros1 = False
        self.channels = merge_channels(chain.from_iterable(part.channels for part in parts))
        filled = [part for part in parts if any(channel.count for channel in part.channels)]
        self.start_ns = min((part.start_ns for part in filled), default=0)
        self.end_ns = max((part.end_ns for part in filled), default=0)

    @property
    def notes(self) -> list[str]:
        return [*self._notes, *chain.from_iterable(part.notes for part in self._parts)]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        for part in self._parts:
            yield from part.messages(topics)
