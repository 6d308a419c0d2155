"""ROS 1 bags, chunk by chunk.

rosbags keeps 160 bytes of index for every message and refuses bags whose index is missing, as that of any recording that was cut
off is. This reader keeps one entry per chunk instead, from the bag's own index where that is valid, else
rebuilt from the records. Format: http://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from localization.errors import LogError
from localization.logs.chunks import Channel, Chunk, DamagedError, RawMessage, decompress, decompress_head, in_log_order
from localization.logs.set_back_clock import Times, describe_set_backs, find_set_backs, later_ns, move_chunks
from localization.messages import Message, Value, message
from motion_models.input_files import open_input

MAGIC = b"#ROSBAG V"

_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAX_HEADER_BYTES = 1 << 24
_MAX_MESSAGE_HEADER_BYTES = 64  # bytes; conn, op and time take 38
_MESSAGE_OP = re.compile(rb"\x04\0{3}op=\x02")

Fields = dict[bytes, bytes]


class _Connection(NamedTuple):
    topic: str
    type: str
    definition: str


class Ros1Bag:
    """A ROS 1 bag of format 2.0, whole or cut off. Raises `LogError` if nothing in it can be read."""

    is_ros1 = True

    def __init__(self, path: Path) -> None:
        self._path = path
        self._connections: dict[int, _Connection] = {}
        self._chunks: list[Chunk] = []
        self.warnings: list[Message] = []
        self._reported: set[int] = set()
        with open_input(path) as file:
            version = file.readline(32).removeprefix(MAGIC).strip()
            if version != b"2.0":
                raise LogError(f"'{path}' is a ROS bag of version {version.decode(errors='replace')}; only 2.0 can be read.")
            first = file.tell()
            self._size = file.seek(0, 2)
            file.seek(first)
            try:
                self._read_index(file)
            except DamagedError as reason:
                self._rebuild_index(file, first, str(reason))
        totals: Counter[int] = Counter()
        for chunk in self._chunks:
            totals.update(chunk.counts)
        self.channels = [
            Channel(c.topic, c.type, MessageDefinition(MessageDefinitionFormat.MSG, c.definition), totals[key])
            for key, c in sorted(self._connections.items())
        ]
        self._set_backs = find_set_backs(path, [c for c in self._chunks if c.counts], self._times)
        self._chunks = move_chunks(self._chunks, self._set_backs, self._times)
        filled = [c for c in self._chunks if c.counts]
        self.start_ns = min((c.start_ns for c in filled), default=0)
        self.end_ns = max((c.end_ns for c in filled), default=0)
        self.warnings += describe_set_backs(self._set_backs, self.start_ns)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time."""
        wanted = {key: c for key, c in self._connections.items() if c.topic in topics}
        later = partial(later_ns, self._set_backs)
        with open_input(self._path) as file:

            def load(chunk: Chunk) -> list[RawMessage]:
                listed = sum(chunk.counts.values())
                try:
                    entries = [entry for entry in _entries(self._chunk_bytes(file, chunk)) if isinstance(entry, _Message)]
                except DamagedError as reason:
                    self._report(chunk, message("damaged_files.chunk_left_out", listed=listed, byte=chunk.position, reason=str(reason)))
                    return []
                if len(entries) < listed:
                    counts = {"byte": chunk.position, "count": len(entries), "listed": listed}
                    self._report(chunk, message("damaged_files.chunk_short", file=self._path.name, **counts))
                return [
                    RawMessage(e.log_ns + later(chunk.position, i), wanted[e.key].topic, wanted[e.key].type, e.data)
                    for i, e in enumerate(entries)
                    if e.key in wanted
                ]

            yield from in_log_order((c for c in self._chunks if not wanted.keys().isdisjoint(c.counts)), load)

    def _times(self, chunk: Chunk) -> Times:
        try:
            with open_input(self._path) as file:
                return [(e.key, e.log_ns) for e in _entries(self._chunk_bytes(file, chunk)) if isinstance(e, _Message)]
        except DamagedError:
            return []

    def _report(self, chunk: Chunk, note: Message) -> None:
        """Once for each chunk."""
        if chunk.position not in self._reported:
            self._reported.add(chunk.position)
            self.warnings.append(note)

    def _chunk_bytes(self, file: BinaryIO, chunk: Chunk) -> bytes:
        if chunk.position >= self._size:
            raise DamagedError("by the index it lies beyond the end of the file")
        file.seek(chunk.position)
        header, size = _record_start(file)
        if header.get(b"op") != bytes([_CHUNK]):
            raise DamagedError("there is no chunk at its place in the index")
        data = file.read(min(size, self._size - file.tell()))
        compression = header.get(b"compression", b"none").decode(errors="replace")
        # Only the last chunk of a truncated bag may be short; its messages were readable when the index was rebuilt.
        return decompress_head(data, compression)[0] if len(data) < size else decompress(data, compression)

    def _read_index(self, file: BinaryIO) -> None:
        """Connections and chunks as the end of the bag lists them. Raises `DamagedError`."""
        header, size = _record_start(file)
        if header.get(b"op") != bytes([_BAG]):
            raise DamagedError("its first record is not a bag header")
        if header.get(b"encryptor"):
            raise LogError(f"'{self._path}' is encrypted ({header[b'encryptor'].decode(errors='replace')}); decrypt it first.")
        position = _u64(header, b"index_pos")
        if position == 0:
            raise DamagedError("it was never closed, and so has no index")
        if position > self._size:
            raise DamagedError("it ends before its index")
        file.seek(position)
        connections: dict[int, _Connection] = {}
        chunks: list[Chunk] = []
        for _ in range(_u32(header, b"conn_count")):
            record, size = _record_start(file)
            key, connection = _connection(record, _read_exactly(file, size))
            connections[key] = connection
        for _ in range(_u32(header, b"chunk_count")):
            record, size = _record_start(file)
            if record.get(b"op") != bytes([_CHUNK_INFO]):
                raise DamagedError("its index breaks off")
            pairs = struct.iter_unpack("<II", _read_exactly(file, size // 8 * 8))
            start, end = _time(record, b"start_time"), _time(record, b"end_time")
            chunks.append(Chunk(_u64(record, b"chunk_pos"), start, end, {k: n for k, n in pairs if n}))
        self._connections, self._chunks = connections, chunks

    def _rebuild_index(self, file: BinaryIO, first: int, reason: str) -> None:
        """Read all records as far as possible, and report how many were found."""
        end = self._size
        file.seek(first)
        whole = first
        loose = 0
        try:
            while file.tell() < end:
                position = file.tell()
                header, size = _record_start(file)
                body = file.tell()
                data = file.read(min(size, end - body)) if header.get(b"op") in (bytes([_CHUNK]), bytes([_CONNECTION])) else b""
                if header.get(b"op") == bytes([_CHUNK]):
                    self._add_chunk(position, header, data)
                elif header.get(b"op") == bytes([_CONNECTION]) and len(data) == size:
                    key, connection = _connection(header, data)
                    self._connections[key] = connection
                elif header.get(b"op") == bytes([_MESSAGE]):
                    loose += 1
                file.seek(body + size)
                if file.tell() <= end:
                    whole = file.tell()
        except DamagedError as error:
            reason = reason if str(error) == reason else f"{reason}; {error}"
        count = sum(sum(c.counts.values()) for c in self._chunks)
        lost = end - whole
        found: dict[str, Value] = {"file": self._path.name, "reason": reason, "count": count}
        if lost:
            self.warnings.append(message("damaged_files.index", bytes=lost, **found))
        else:
            self.warnings.append(message("damaged_files.index_alone", **found))
        if loose:
            self.warnings.append(message("damaged_files.loose", count=loose, file=self._path.name))

    def _add_chunk(self, position: int, header: Fields, data: bytes) -> None:
        try:
            plain, _ = decompress_head(data, header.get(b"compression", b"none").decode(errors="replace"))
        except DamagedError as reason:
            self.warnings.append(message("damaged_files.chunk_unread", byte=position, file=self._path.name, reason=str(reason)))
            return
        counts: Counter[int] = Counter()
        start, end = 2**63 - 1, 0
        for entry in _entries(plain):
            if isinstance(entry, _Message):
                start, end = min(start, entry.log_ns), max(end, entry.log_ns)
                counts[entry.key] += 1
            else:
                self._connections.setdefault(*entry)
        if counts:
            self._chunks.append(Chunk(position, start, end, dict(counts)))


class _Message(NamedTuple):
    key: int
    """Number of its connection."""
    log_ns: int
    data: bytes


def _entries(plain: bytes) -> Iterator[_Message | tuple[int, _Connection]]:
    """The whole messages and connections of a chunk's bytes. Bytes that are none are skipped up to the next message."""
    position = 0
    while position + 8 <= len(plain):
        try:
            op, fields, body, position = _record(plain, position)
            if op == _MESSAGE:
                yield _Message(_u32(fields, b"conn"), _time(fields, b"time"), body)
            elif op == _CONNECTION:
                yield _connection(fields, body)
        except DamagedError:
            position = _next_message(plain, position + 1)


class _Record(NamedTuple):
    op: int
    """Kind of the record."""
    fields: Fields
    """Fields of its header."""
    body: bytes
    end: int
    """Position of the next record."""


def _record(plain: bytes, position: int) -> _Record:
    """The record of a chunk at ``position``. Raises `DamagedError`."""
    body = position + 8 + int.from_bytes(plain[position : position + 4], "little")
    if body > len(plain):
        raise DamagedError("a record's header breaks off")
    after = body + int.from_bytes(plain[body - 4 : body], "little")
    if after > len(plain):
        raise DamagedError("a record breaks off")
    fields = _fields(plain[position + 4 : body - 4])
    op = fields.get(b"op", b"")
    if len(op) != 1:
        raise DamagedError("a record has no kind")
    return _Record(op[0], fields, plain[body:after], after)


def _next_message(plain: bytes, position: int) -> int:
    """Where a message record begins that has all its fields and lies in ``plain`` wholly; the end if there is none."""
    for found in _MESSAGE_OP.finditer(plain, position):
        for start in range(max(found.start() - _MAX_MESSAGE_HEADER_BYTES, position), found.start() - 3):
            if _is_message(plain, start):
                return start
    return len(plain)


def _is_message(plain: bytes, start: int) -> bool:
    if int.from_bytes(plain[start : start + 4], "little") > _MAX_MESSAGE_HEADER_BYTES:
        return False
    try:
        op, fields, _, _ = _record(plain, start)
    except DamagedError:
        return False
    return op == _MESSAGE and fields.keys() >= {b"conn", b"time"}


def _record_start(file: BinaryIO) -> tuple[Fields, int]:
    """A record's header and the size of its body, with the file standing at the body."""
    size = int.from_bytes(_read_exactly(file, 4), "little")
    if size > _MAX_HEADER_BYTES:
        raise DamagedError(f"byte {file.tell() - 4} is not the start of a record")
    header = _fields(_read_exactly(file, size))
    return header, int.from_bytes(_read_exactly(file, 4), "little")


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    position = 0
    while position + 4 <= len(header):
        size = int.from_bytes(header[position : position + 4], "little")
        name, equals, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not equals or position + 4 + size > len(header):
            raise DamagedError("a record's header is not one")
        fields[name] = value
        position += 4 + size
    return fields


def _connection(header: Fields, body: bytes) -> tuple[int, _Connection]:
    if header.get(b"op") != bytes([_CONNECTION]) or b"topic" not in header:
        raise DamagedError("a connection record is not one")
    fields = _fields(body)
    if not {b"type", b"message_definition"} <= fields.keys():
        raise DamagedError("a connection record has no type")
    topic = "/".join(part for part in header[b"topic"].decode(errors="replace").split("/") if part)
    kind = fields[b"type"].decode(errors="replace")
    return _u32(header, b"conn"), _Connection(f"/{topic}", normalize_msgtype(kind), fields[b"message_definition"].decode(errors="replace"))


def _read_exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) != size:
        raise DamagedError("it breaks off in the middle of a record")
    return data


def _u32(fields: Fields, name: bytes) -> int:
    value = fields.get(name, b"")
    if len(value) != 4:
        raise DamagedError(f"a record's '{name.decode()}' is missing")
    return int.from_bytes(value, "little")


def _u64(fields: Fields, name: bytes) -> int:
    value = fields.get(name, b"")
    if len(value) != 8:
        raise DamagedError(f"a record's '{name.decode()}' is missing")
    return int.from_bytes(value, "little")


def _time(fields: Fields, name: bytes) -> int:
    value = fields.get(name, b"")
    if len(value) != 8:
        raise DamagedError(f"a record's '{name.decode()}' is missing")
    return int.from_bytes(value[:4], "little") * 1_000_000_000 + int.from_bytes(value[4:], "little")
