"""MCAP files, chunk by chunk, of ROS 2 and ROS 1, whole or cut off.

Chunks are taken from the file's index where that is valid; else the index is rebuilt in one pass over the file. Messages outside of chunks
are grouped in runs of a megabyte, which are treated as chunks. Damaged chunks are searched for messages. Format: https://mcap.dev/spec.

The stream reader of the library `mcap` recovers less: of 6 copies each of two files that were cut off, flipped, zeroed or overwritten in
part, it gave 1,458 of the 2,423 and 198,924 of the 240,783 messages that this reader gives, as it ends at the first damage.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from localization.errors import LogError
from localization.logs.chunks import Channel, Chunk, DamagedError, RawMessage, decompress, decompress_head, decompress_message, in_log_order
from localization.logs.set_back_clock import Times, describe_set_backs, find_set_backs, later_ns, move_chunks
from localization.messages import Message, Value, message
from motion_models.input_files import open_input

MAGIC = b"\x89MCAP0\r\n"

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _STATISTICS = 2, 3, 4, 5, 6, 8, 11
_RUN_BYTES = 1 << 20
_READ_BYTES = 1 << 20
_FOOTER_BYTES = 37  # with the magic that ends the file
_MAX_DESCRIPTION_BYTES = 16 << 20  # bytes of a schema, channel or index record; a message's definition has some kB, a chunk's index too
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_MAY_BE_MESSAGE = re.compile(rb"(?=\x05.{5}\0{3})", re.DOTALL)  # of less than 2^40 bytes

Entry = tuple[int, int, bytes]
"""Channel, time of recording [ns] and data of a message."""


class _Topic(NamedTuple):
    name: str
    type: str
    definition: MessageDefinition
    encoding: str


class McapFile:
    """An MCAP file, as far as it can be read. Raises `LogError` if nothing can."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, tuple[str, MessageDefinition]] = {}
        self._described: dict[int, _Topic] = {}
        self._chunks: list[Chunk] = []
        self._run: Chunk | None = None
        self._reported: set[int] = set()
        self.warnings: list[Message] = []
        reason, unread = "", 0
        with open_input(path) as file:
            try:
                self._read_summary(file)
            except (DamagedError, struct.error) as error:
                reason = str(error)
                self._schemas, self._described, self._chunks, self.warnings = {}, {}, [], []
                unread = self._index(file)
        totals: Counter[int] = Counter()
        for chunk in self._chunks:
            totals.update(chunk.counts)
        self.is_ros1 = self._is_ros1(totals, reason)
        used = "ros1" if self.is_ros1 else "cdr"
        self._topics = {key: t for key, t in self._described.items() if t.encoding == used}
        self.channels = [Channel(t.name, t.type, t.definition, totals[key]) for key, t in sorted(self._topics.items())]
        self._set_backs = find_set_backs(path, self._chunks, self._times)
        self._chunks = move_chunks(self._chunks, self._set_backs, self._times)
        self.start_ns = min((c.start_ns for c in self._chunks), default=0)
        self.end_ns = max((c.end_ns for c in self._chunks), default=0)
        if reason:
            counts: dict[str, Value] = {"file": path.name, "reason": reason, "count": totals.total()}
            if unread:
                self.warnings.insert(0, message("damaged_files.read_by_record_to_end", bytes=unread, **counts))
            else:
                self.warnings.insert(0, message("damaged_files.read_by_record", **counts))
        self.warnings += describe_set_backs(self._set_backs, self.start_ns)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time."""
        wanted = {key: t for key, t in self._topics.items() if t.name in topics}
        later = partial(later_ns, self._set_backs)
        with open_input(self._path) as file:

            def load(chunk: Chunk) -> list[RawMessage]:
                file.seek(chunk.position)
                entries, damage = self._entries(file.read(chunk.size))
                if len(entries) < sum(chunk.counts.values()) or damage:
                    self._report(chunk, len(entries), damage or "its index lists more")
                return [
                    RawMessage(log_ns + later(chunk.position, i), wanted[key].name, wanted[key].type, decompress_message(data))
                    for i, (key, log_ns, data) in enumerate(entries)
                    if key in wanted
                ]

            yield from in_log_order((c for c in self._chunks if not wanted.keys().isdisjoint(c.counts)), load)

    def _times(self, chunk: Chunk) -> Times:
        with open_input(self._path) as file:
            file.seek(chunk.position)
            return [(key, log_ns) for key, log_ns, _ in self._entries(file.read(chunk.size))[0]]

    def _is_ros1(self, totals: Counter[int], reason: str) -> bool:
        """Whether most messages are encoded as in ROS 1. Raises `LogError` where none is of ROS 1 or ROS 2."""
        encodings = Counter({t.encoding: 0 for t in self._described.values()})
        for key, topic in self._described.items():
            encodings[topic.encoding] += totals[key]
        if not encodings["cdr"] and not encodings["ros1"] and (reason or encodings.total()):
            names = ", ".join(sorted(name or "nothing" for name, count in encodings.items() if count))
            found = f"its messages are encoded as {names}, not as those of ROS" if names else "it holds no messages"
            raise LogError(" ".join([f"'{self._path}' cannot be read: {reason + '; ' if reason else ''}{found}.", *self.warnings]))
        return encodings["ros1"] > encodings["cdr"]

    def _read_summary(self, file: BinaryIO) -> None:
        """Topics and chunks as the end of the file lists them. Raises `DamagedError` and `struct.error`."""
        end = file.seek(0, 2) - _FOOTER_BYTES
        if end < len(MAGIC):
            raise DamagedError("it breaks off")
        file.seek(end)
        footer = file.read(_FOOTER_BYTES)
        if not footer.endswith(MAGIC) or footer[0] != _FOOTER:
            raise DamagedError("its end is missing")
        first, _, crc = struct.unpack_from("<QQI", footer, 9)
        if first == 0:
            raise DamagedError("it has no index of chunks")
        if not len(MAGIC) <= first <= end:
            raise DamagedError("its footer points outside of it")
        if crc and _checksum(file, first, end + 25) != crc:  # the footer up to the checksum itself is part of it
            raise DamagedError("the checksum of its index is wrong")
        listed = None
        for op, record in _index_records(file, first, end):
            if op in (_SCHEMA, _CHANNEL):
                self._describe(op, record)
            elif op == _CHUNK_INDEX:
                self._chunks.append(_indexed_chunk(record, first))
            elif op == _STATISTICS:
                (listed,) = struct.unpack_from("<Q", record)
        found = sum(sum(chunk.counts.values()) for chunk in self._chunks)
        if listed is None and not self._chunks:
            raise DamagedError("it has no index of chunks")
        if listed is not None and listed != found:
            raise DamagedError(f"its index lists {found} of {listed} messages")
        if not {key for chunk in self._chunks for key in chunk.counts} <= self._described.keys():
            raise DamagedError("its index does not describe all topics")

    def _index(self, file: BinaryIO) -> int:
        """Scan the file for chunks; returns the number of bytes at its end that could not be read."""
        end = file.seek(0, 2)
        position, op = len(MAGIC), 0
        while position + 9 <= end:
            file.seek(position)
            op, size = struct.unpack("<BQ", file.read(9))
            whole = position + 9 + size <= end
            if op == _FOOTER or op == 0:
                break
            if op in (_SCHEMA, _CHANNEL) and whole and size <= _MAX_DESCRIPTION_BYTES:
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
        entries, damage = self._entries(file.read(size))
        counts = Counter(key for key, _, _ in entries)
        stamps = [log_ns for _, log_ns, _ in entries]
        chunk = Chunk(position, min(stamps, default=0), max(stamps, default=0), dict(counts), size)
        if damage:
            self._report(chunk, len(entries), damage)
        if counts:
            self._chunks.append(chunk)

    def _add_to_run(self, position: int, size: int, head: bytes) -> None:
        key, _, log_ns, _ = struct.unpack("<HIQQ", head)
        run = self._run
        if run is not None and (run.position + run.size != position or run.size > _RUN_BYTES):
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

    def _entries(self, record: bytes) -> tuple[list[Entry], str]:
        """Messages of a chunk record or of a run of messages, as far as they are whole, and what is damaged, or nothing.

        Topics that it describes are added. Of a truncated chunk the first part is read. A damaged compressed chunk is
        dropped; a damaged uncompressed one is searched for messages.
        """
        if record[:1] != bytes([_CHUNK]):
            return _whole_messages(record), ""
        try:
            plain, span, damage = _plain(record)
        except DamagedError as error:
            return [], str(error)
        position, entries = 0, []
        while position + 9 <= len(plain):
            op, size = struct.unpack_from("<BQ", plain, position)
            after = position + 9 + size
            entry = _entry(plain, position, after) if op == _MESSAGE else None
            if after > len(plain) or op == 0 or (op == _MESSAGE and (entry is None or entry[0] not in self._described)):
                damage = damage or f"byte {position} of it is not the start of a record"
                position = self._next_message(plain, position + 1, span)
                continue
            if op in (_SCHEMA, _CHANNEL):
                self._describe(op, plain[position + 9 : after])
            elif entry is not None:
                entries.append(entry)
            position = after
        return entries, damage

    def _next_message(self, plain: bytes, position: int, span: tuple[int, int]) -> int:
        """Where the next message of a known topic and of the chunk's time begins; the end if there is none."""
        for found in _MAY_BE_MESSAGE.finditer(plain, position):
            after = found.start() + 9 + int.from_bytes(plain[found.start() + 1 : found.start() + 9], "little")
            entry = _entry(plain, found.start(), after)
            if entry is not None and entry[0] in self._described and span[0] <= entry[1] <= span[1]:
                return found.start()
        return len(plain)

    def _report(self, chunk: Chunk, count: int, damage: str) -> None:
        """Once for each chunk."""
        if chunk.position in self._reported:
            return
        self._reported.add(chunk.position)
        listed = sum(chunk.counts.values())
        where: dict[str, Value] = {"byte": chunk.position, "file": self._path.name, "reason": damage, "count": count}
        if listed > count:
            self.warnings.append(message("damaged_files.chunk", listed=listed, **where))
        else:
            self.warnings.append(message("damaged_files.chunk_whole", **where))

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
                self._described.setdefault(key, _Topic(topic, normalize_msgtype(kind) if "/" in kind else kind, definition, encoding))
        except struct.error:
            self.warnings.append(message("damaged_files.description", file=self._path.name))


def _checksum(file: BinaryIO, first: int, end: int) -> int:
    file.seek(first)
    crc, left = 0, end - first
    while left > 0 and (piece := file.read(min(left, _READ_BYTES))):
        crc, left = crc32(piece, crc), left - len(piece)
    return crc


def _index_records(file: BinaryIO, first: int, end: int) -> Iterator[tuple[int, bytes]]:
    """The records between two places of a file, but for those that describe nothing. Raises `DamagedError` and `struct.error`."""
    position = first
    while position < end:
        file.seek(position)
        op, size = struct.unpack("<BQ", file.read(9))
        position += 9 + size
        if position > end:
            raise DamagedError("its index breaks off")
        if op in (_SCHEMA, _CHANNEL, _CHUNK_INDEX, _STATISTICS):
            if size > _MAX_DESCRIPTION_BYTES:
                raise DamagedError("its index holds a record that is too long")
            yield op, file.read(size)


def _indexed_chunk(record: bytes, end: int) -> Chunk:
    """Content of a chunk's index record, if the chunk lies before ``end``. Raises `DamagedError` and `struct.error`.

    Messages are counted by the lengths of their channels' index records, which follow the chunk: 15 bytes and 16 for each message.
    """
    start_ns, end_ns, position, size, length = struct.unpack_from("<QQQQI", record)
    pairs = sorted((at, key) for key, at in struct.iter_unpack("<HQ", record[36 : 36 + length // 10 * 10]))
    (index_size,) = struct.unpack_from("<Q", record, 36 + length)
    after = position + size + index_size
    places = [*(at for at, _ in pairs), after]
    if after > end or size < 9 or start_ns > end_ns or any(b - a < 15 for a, b in pairwise(places)):
        raise DamagedError("its index of chunks contradicts itself")
    counts = {key: (following - at - 15) // 16 for (at, key), following in zip(pairs, places[1:], strict=True)}
    return Chunk(position, start_ns, end_ns, {key: count for key, count in counts.items() if count}, size)


def _plain(record: bytes) -> tuple[bytes, tuple[int, int], str]:
    """Records of a chunk record, the span of time that it covers, and what is damaged. Raises `DamagedError` where nothing can be read."""
    try:
        size, start_ns, end_ns, _, crc = struct.unpack_from("<QQQQI", record, 1)
        compression, at = _string(record, 9 + 28)
        (length,) = struct.unpack_from("<Q", record, at)
    except struct.error as error:
        raise DamagedError("it breaks off in its head") from error
    data = record[at + 8 : at + 8 + length]
    span = start_ns, end_ns
    if len(record) < 9 + size:
        return decompress_head(data, compression)[0], span, "it breaks off"
    if at + 8 + length != 9 + size:
        raise DamagedError("its sizes contradict each other")
    plain = decompress(data, compression)
    if not crc or crc32(plain) == crc:
        return plain, span, ""
    if compression:
        raise DamagedError("its checksum is wrong")
    return plain, span, "its checksum is wrong"


def _entry(plain: bytes, position: int, after: int) -> Entry | None:
    """The message record between two positions; None if there is none."""
    if after - position < 9 + 22 or after > len(plain):
        return None
    key, _, log_ns, _ = struct.unpack_from("<HIQQ", plain, position + 9)
    return key, log_ns, plain[position + 31 : after]


def _whole_messages(run: bytes) -> list[Entry]:
    """Entries of a run of message records, which were whole when the file was gone through."""
    position, entries = 0, []
    while position + 9 <= len(run):
        after = position + 9 + int(struct.unpack_from("<Q", run, position + 1)[0])
        entry = _entry(run, position, after)
        if entry is not None:
            entries.append(entry)
        position = after
    return entries


def _string(data: bytes, position: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, position)
    start = position + 4
    if start + size > len(data):
        raise struct.error("string breaks off")
    return data[start : start + size].decode(errors="replace"), start + size
