"""MCAP files that rosbags refuses: cut off, out of order without an index, or of ROS 1. Read record by record.

Format: https://mcap.dev/spec. The index is made anew by going through the file once; messages outside of chunks are taken together
in runs of a megabyte, which then are chunks like the others.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from localization.errors import LogError
from localization.logs.chunks import Channel, Chunk, DamagedError, RawMessage, decompress, decompress_head, in_log_order, inflate_message

MAGIC = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX = 2, 3, 4, 5, 6, 8
_RUN = 1 << 20
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}


class _Topic(NamedTuple):
    name: str
    type: str
    definition: MessageDefinition
    encoding: str


class RecoveredMcap:
    """As much of an MCAP file as can be read. Raises `LogError` if that is nothing."""

    def __init__(self, path: Path, reason: str) -> None:
        self._path = path
        self._schemas: dict[int, tuple[str, MessageDefinition]] = {}
        self._topics: dict[int, _Topic] = {}
        self._chunks: list[Chunk] = []
        self._run: Chunk | None = None
        self.notes: list[str] = []
        with path.open("rb") as file:
            unread = self._index(file)
        totals: Counter[int] = Counter()
        for chunk in self._chunks:
            totals.update(chunk.counts)
        encodings = Counter({t.encoding: 0 for t in self._topics.values()})
        for key, topic in self._topics.items():
            encodings[topic.encoding] += totals[key]
        if not encodings["cdr"] and not encodings["ros1"]:
            found = (
                f"its messages are encoded as {', '.join(sorted(encodings))}, not as those of ROS" if encodings else "it holds no messages"
            )
            raise LogError(f"'{path}' cannot be read: {reason}; {found}.")
        self.is_ros1 = encodings["ros1"] > encodings["cdr"]
        used = "ros1" if self.is_ros1 else "cdr"
        self._topics = {key: t for key, t in self._topics.items() if t.encoding == used}
        self.channels = [Channel(t.name, t.type, t.definition, totals[key]) for key, t in sorted(self._topics.items())]
        self.start_ns = min((c.start_ns for c in self._chunks), default=0)
        self.end_ns = max((c.end_ns for c in self._chunks), default=0)
        lost = f"; of its last {unread} bytes only what is whole could be read" if unread else ""
        self.notes.insert(0, f"{path.name} was read record by record ({reason}): {totals.total()} messages of it are used{lost}.")

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        wanted = {key: t for key, t in self._topics.items() if t.name in topics}
        with self._path.open("rb") as file:

            def load(chunk: Chunk) -> list[RawMessage]:
                file.seek(chunk.position)
                plain, _ = _plain(file.read(chunk.size))
                return [
                    RawMessage(log_ns, wanted[key].name, wanted[key].type, inflate_message(data))
                    for key, log_ns, data in _messages(plain)
                    if key in wanted
                ]

            yield from in_log_order((c for c in self._chunks if not wanted.keys().isdisjoint(c.counts)), load)

    def _index(self, file: BinaryIO) -> int:
        """Go through the file; the bytes at its end that could not be read."""
        file.seek(0, 2)
        end = file.tell()
        position = len(MAGIC)
        while position + 9 <= end:
            file.seek(position)
            op, size = struct.unpack("<BQ", file.read(9))
            whole = position + 9 + size <= end
            if op == _FOOTER or op == 0:
                break
            if op in (_SCHEMA, _CHANNEL) and whole:
                self._describe(op, file.read(size))
            elif op == _MESSAGE and whole and size >= 22:
                self._add_to_run(position, 9 + size, file.read(22))
            elif op == _CHUNK:
                self._add_chunk(position, min(9 + size, end - position), file)
            if not whole:
                break
            position += 9 + size
        self._end_run()
        return 0 if position + 9 <= end and op == _FOOTER else end - position

    def _add_chunk(self, position: int, size: int, file: BinaryIO) -> None:
        self._end_run()
        file.seek(position)
        try:
            plain, is_whole = _plain(file.read(size))
        except DamagedError as reason:
            self.notes.append(f"A chunk at byte {position} of {self._path.name} was left out: {reason}.")
            return
        left = len(plain)
        for op, record in _records(plain):
            left -= 9 + len(record)
            if op in (_SCHEMA, _CHANNEL):
                self._describe(op, record)
        if is_whole and left:
            self.notes.append(f"A chunk at byte {position} of {self._path.name} is damaged: its last {left} bytes were left out.")
        counts: Counter[int] = Counter()
        start, end = 2**63 - 1, 0
        for key, log_ns, _ in _messages(plain):
            counts[key] += 1
            start, end = min(start, log_ns), max(end, log_ns)
        if counts:
            self._chunks.append(Chunk(position, start, end, dict(counts), size))

    def _add_to_run(self, position: int, size: int, head: bytes) -> None:
        key, _, log_ns, _ = struct.unpack("<HIQQ", head)
        run = self._run
        if run is not None and (run.position + run.size != position or run.size > _RUN):
            self._end_run()
            run = None
        if run is None:
            self._run = Chunk(position, log_ns, log_ns, {key: 1}, size)
        else:
            counts = {**run.counts, key: run.counts.get(key, 0) + 1}
            self._run = Chunk(run.position, min(run.start_ns, log_ns), max(run.end_ns, log_ns), counts, run.size + size)

    def _end_run(self) -> None:
        if self._run is not None:
            self._chunks.append(self._run)
            self._run = None

    def _describe(self, op: int, record: bytes) -> None:
        try:
            if op == _SCHEMA:
                (key,) = struct.unpack_from("<H", record)
                name, at = _string(record, 2)
                encoding, at = _string(record, at)
                text, _ = _string(record, at)
                self._schemas[key] = name, MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
            else:
                key, schema = struct.unpack_from("<HH", record)
                topic, at = _string(record, 4)
                encoding, _ = _string(record, at)
                kind, definition = self._schemas.get(schema, ("", MessageDefinition(MessageDefinitionFormat.NONE, "")))
                self._topics[key] = _Topic(topic, normalize_msgtype(kind) if "/" in kind else kind, definition, encoding)
        except struct.error:
            self.notes.append(f"A description of a topic in {self._path.name} is damaged.")


def has_chunk_index(path: Path) -> bool:
    """Whether rosbags can read the file in order of time: its summary lists the chunks. True where there is no telling."""
    with path.open("rb") as file:
        try:
            file.seek(-37, 2)
            tail = file.read(37)
            if not tail.endswith(MAGIC) or tail[0] != _FOOTER:
                return True
            (position,) = struct.unpack_from("<Q", tail, 9)
            while position:
                file.seek(position)
                op, size = struct.unpack("<BQ", file.read(9))
                if op == _CHUNK_INDEX:
                    return True
                if op == _FOOTER:
                    return False
                position += 9 + size
        except (OSError, struct.error, OverflowError):
            return True
    return False


def _plain(record: bytes) -> tuple[bytes, bool]:
    """Records of a chunk record or of a run of messages; a chunk that is cut off gives what it has."""
    if record[:1] != bytes([_CHUNK]):
        return record, True
    try:
        size, _, _, _, crc = struct.unpack_from("<QQQQI", record, 1)
        compression, at = _string(record, 9 + 28)
        (length,) = struct.unpack_from("<Q", record, at)
    except struct.error as error:
        raise DamagedError("it breaks off in its head") from error
    data = record[at + 8 : at + 8 + length]
    if len(record) < 9 + size:
        return decompress_head(data, compression)
    plain = decompress(data, compression)
    if crc and crc32(plain) != crc:
        raise DamagedError("its checksum is wrong")
    return plain, True


def _records(plain: bytes) -> Iterator[tuple[int, bytes]]:
    position = 0
    while position + 9 <= len(plain):
        op, size = struct.unpack_from("<BQ", plain, position)
        if position + 9 + size > len(plain):
            return
        yield op, plain[position + 9 : position + 9 + size]
        position += 9 + size


def _messages(plain: bytes) -> Iterator[tuple[int, int, bytes]]:
    for op, record in _records(plain):
        if op == _MESSAGE and len(record) >= 22:
            key, _, log_ns, _ = struct.unpack_from("<HIQQ", record)
            yield key, log_ns, record[22:]


def _string(data: bytes, position: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, position)
    start = position + 4
    if start + size > len(data):
        raise struct.error("string breaks off")
    return data[start : start + size].decode(errors="replace"), start + size
