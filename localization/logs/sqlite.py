"""SQLite storage files that rosbags refuses, because they were cut off or hold bad pages: page by page, as far as they go.

A table's rows hang on a tree whose inner pages lie anywhere in the file, so that SQLite finds nothing in many a file that was cut off.
Its leaves, which hold the rows, lie in the order in which they were recorded. Format: https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from localization.errors import LogError
from localization.logs.chunks import Channel, RawMessage, inflate_message

MAGIC = b"SQLite format 3\x00"

_TABLE_LEAF = 13
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}

Row = tuple[int, int, bytes]


class RecoveredSqlite:
    """As many rows of a .db3 file as can be read, in the order in which they were recorded. Raises `LogError` if there are none."""

    is_ros1 = False

    def __init__(self, path: Path, reason: str) -> None:
        self._path = path
        try:
            with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?immutable=1", uri=True)) as database:
                # SQLite refuses a file that is shorter than its header says, unless it is told that the header may be wrong.
                database.execute("PRAGMA writable_schema=ON")
                topics = database.execute("SELECT id, name, type FROM topics").fetchall()
                definitions = _definitions(database)
        except sqlite3.DatabaseError as error:
            raise LogError(f"'{path}' cannot be read: {reason}; not even its list of topics can ({error}).") from error
        self._topics: dict[int, tuple[str, str]] = {
            key: (name, kind) for key, name, kind in topics if isinstance(name, str) and isinstance(kind, str)
        }
        counts: Counter[int] = Counter()
        start, end = 2**63 - 1, 0
        for topic, log_ns, _ in self._rows():
            counts[topic] += 1
            start, end = min(start, log_ns), max(end, log_ns)
        nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self.channels = [Channel(name, kind, definitions.get(kind, nothing), counts[key]) for key, (name, kind) in self._topics.items()]
        self.start_ns, self.end_ns = (start, end) if counts else (0, 0)
        self.notes = [
            f"{path.name} was read page by page ({reason}): {counts.total()} messages of it are used; how many are lost, it does not tell."
        ]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        wanted = {key: topic for key, topic in self._topics.items() if topic[0] in topics}
        for key, log_ns, data in self._rows():
            if key in wanted:
                yield RawMessage(log_ns, *wanted[key], inflate_message(data))

    def _rows(self) -> Iterator[Row]:
        """Messages on the file's leaf pages: those rows that are an id, a known topic's number, a time and bytes."""
        with self._path.open("rb") as file:
            head = file.read(100)
            page_size = int.from_bytes(head[16:18], "big")
            page_size = 65536 if page_size == 1 else page_size
            if page_size < 512:
                return
            number = 1
            while True:
                file.seek(number * page_size)
                page = file.read(page_size)
                number += 1
                if len(page) < page_size:
                    return
                if page[0] == _TABLE_LEAF:
                    for row in _leaf_rows(file, page, page_size - head[20]):
                        if row[0] in self._topics:
                            yield row


def _leaf_rows(file: BinaryIO, page: bytes, usable: int) -> Iterator[Row]:
    count = int.from_bytes(page[3:5], "big")
    for i in range(min(count, len(page) // 4)):
        at = int.from_bytes(page[8 + 2 * i : 10 + 2 * i], "big")
        length, at = _varint(page, at)
        _, at = _varint(page, at)
        payload = _payload(file, page, at, length, usable)
        row = _message_row(payload) if payload is not None else None
        if row is not None:
            yield row


def _payload(file: BinaryIO, page: bytes, at: int, length: int, usable: int) -> bytes | None:
    """A row's bytes, gathered from the pages onto which it overflows; None if one of them is missing."""
    most = usable - 35
    if length <= most:
        return page[at : at + length] if at + length <= len(page) else None
    least = (usable - 12) * 32 // 255 - 23
    local = least + (length - least) % (usable - 4)
    if local > most:
        local = least
    parts, left = [page[at : at + local]], length - local
    following = int.from_bytes(page[at + local : at + local + 4], "big")
    while left > 0:
        if following == 0:
            return None
        file.seek((following - 1) * len(page))
        overflow = file.read(len(page))
        if len(overflow) < len(page):
            return None
        parts.append(overflow[4 : 4 + min(left, usable - 4)])
        left -= len(parts[-1])
        following = int.from_bytes(overflow[:4], "big")
    return b"".join(parts)


def _message_row(payload: bytes) -> Row | None:
    """(topic, time, data) of a row (id, topic_id, timestamp, data) of the table `messages`; None of any other row."""
    head, at = _varint(payload, 0)
    types = []
    while at < head:
        kind, at = _varint(payload, at)
        types.append(kind)
    if len(types) != 4 or types[0] != 0 or types[3] < 12 or types[3] % 2:
        return None
    topic, at = _integer(payload, head, types[1])
    log_ns, at = _integer(payload, at, types[2])
    size = (types[3] - 12) // 2
    if topic is None or log_ns is None or log_ns < 0 or at + size != len(payload):
        return None
    return topic, log_ns, payload[at:]


def _integer(data: bytes, at: int, kind: int) -> tuple[int | None, int]:
    if kind in (8, 9):
        return kind - 8, at
    size = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}.get(kind)
    if size is None or at + size > len(data):
        return None, at
    return int.from_bytes(data[at : at + size], "big", signed=True), at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i, byte in enumerate(data[at : at + 9]):
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    return value, at + 9


def _definitions(database: sqlite3.Connection) -> dict[str, MessageDefinition]:
    try:
        rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions").fetchall()
    except sqlite3.DatabaseError:  # recordings before ROS 2 Iron have no such table
        return {}
    return {
        kind: MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
        for kind, encoding, text in rows
        if isinstance(text, str)
    }
