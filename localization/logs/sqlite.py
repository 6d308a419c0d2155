"""SQLite storage files of ROS 2: read by SQLite, or, where they were cut off or hold bad pages, page by page.

A table is a tree whose inner pages are anywhere in the file, so that SQLite finds nothing in many truncated files. Its leaf pages, which
hold the rows, are in the order of recording. Format: https://www.sqlite.org/fileformat2.html.
A database can hold code (views, computed columns); only plain tables are read, and with bounds.
"""

from __future__ import annotations

import heapq
import itertools
import sqlite3
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, TypeVar
from urllib.parse import quote

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from localization.errors import LogError
from localization.logs.chunks import MAX_DECOMPRESSED_BYTES, Channel, DamagedError, RawMessage, decompress_message
from localization.logs.set_back_clock import COMPARED, MAX_CANDIDATES, MIN_STEP_NS, SetBack, describe_set_backs, is_of_all, later_ns
from localization.messages import Message, message
from motion_models.input_files import open_input

MAGIC = b"SQLite format 3\x00"

_TABLE_LEAF = 13
_MAX_ROW = 2**63 - 1
_MAX_TOPICS = 100_000  # robots have tens to hundreds
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_ERRORS = (sqlite3.Error, UnicodeDecodeError)  # the latter where SQLite's message quotes a damaged name
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")

_USUAL_PAGE = 4096
"""Size of SQLite's pages [bytes], where the first one, which has it, is lost."""

Row = tuple[int, int, bytes]
T = TypeVar("T")


def _reason(error: Exception) -> str:
    return "a name in its schema is not text" if isinstance(error, UnicodeDecodeError) else str(error)


def _connect(path: Path) -> sqlite3.Connection:
    """Open read-only. Sizes of rows are bounded, and the file's contents cannot call unsafe functions."""
    database = sqlite3.connect(f"file:{quote(bytes(path.resolve()))}?immutable=1", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_DECOMPRESSED_BYTES)
    database.execute("PRAGMA trusted_schema=OFF")
    database.text_factory = lambda data: data.decode(errors="replace")
    return database


def _describe(database: sqlite3.Connection) -> tuple[dict[int, tuple[str, str]], dict[str, MessageDefinition]]:
    """Name and type of each topic by its number, and definitions by type. Raises `DamagedError` and `sqlite3.DatabaseError`."""
    columns = {}
    for table in ("topics", "messages", "message_definitions"):
        found = database.execute("SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)).fetchone()[0]
        columns[table] = {row[1] for row in database.execute(f"PRAGMA table_info({table})")} if found else set()
    if not {"id", "name", "type"} <= columns["topics"]:
        raise DamagedError("it has no table of topics")
    if not {"topic_id", "timestamp", "data"} <= columns["messages"]:
        raise DamagedError("it has no table of messages")
    rows = database.execute("SELECT id, name, type FROM topics ORDER BY id LIMIT ?", (_MAX_TOPICS,)).fetchall()
    topics = {key: (name, kind) for key, name, kind in rows if isinstance(key, int) and isinstance(name, str) and isinstance(kind, str)}
    if not {"topic_type", "encoding", "encoded_message_definition"} <= columns["message_definitions"]:
        return topics, {}  # recordings before ROS 2 Iron have no such table
    wanted = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
    definitions = {
        kind: MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
        for kind, encoding, text in database.execute(wanted, (_MAX_TOPICS,))
        if isinstance(text, str)
    }
    return topics, definitions


def _find_set_backs(database: sqlite3.Connection) -> list[SetBack]:
    """Where the recorder's clock was set back; rows are in the order of recording."""
    steps = (
        "SELECT at, before, timestamp FROM (SELECT rowid AS at, timestamp, lag(timestamp) OVER (ORDER BY rowid) AS before FROM messages)"
        " WHERE before - timestamp > ? LIMIT ?"
    )
    before = "SELECT topic_id, timestamp FROM messages WHERE rowid < ? ORDER BY rowid DESC LIMIT ?"
    after = "SELECT topic_id, timestamp FROM messages WHERE rowid >= ? ORDER BY rowid LIMIT ?"
    found = []
    for at, last_ns, next_ns in database.execute(steps, (MIN_STEP_NS, MAX_CANDIDATES)).fetchall():
        rows = [database.execute(query, (at, COMPARED)).fetchall() for query in (before, after)]
        parts = [[(topic, log_ns) for topic, log_ns in part if isinstance(log_ns, int)] for part in rows]
        if is_of_all(parts[0][::-1], parts[1]):
            found.append(SetBack(0, at, last_ns, last_ns - next_ns))
    return found


def _span(database: sqlite3.Connection, first: int, last: int, later: int) -> tuple[int, int] | None:
    """First and last time of recording [ns] of a part; None without any."""
    query = "SELECT min(timestamp), max(timestamp) FROM messages WHERE rowid BETWEEN ? AND ?"
    begin, end = database.execute(query, (first, last)).fetchone()
    return (begin + later, end + later) if isinstance(begin, int) and isinstance(end, int) else None


def _rows_of(database: sqlite3.Connection, topics: Collection[int], first: int, last: int, later: int) -> Iterator[Row]:
    """Rows of a part of these ``topics`` in order of the time of recording."""
    query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({','.join(map(str, topics))})"
    for key, stamp, data in database.execute(f"{query} AND +rowid BETWEEN ? AND ? ORDER BY timestamp", (first, last)):
        if isinstance(stamp, int) and isinstance(data, bytes):
            yield key, stamp + later, data


def _channels(topics: dict[int, tuple[str, str]], definitions: dict[str, MessageDefinition], counts: Counter[int]) -> list[Channel]:
    return [Channel(name, kind, definitions.get(kind, _NO_DEFINITION), counts[key]) for key, (name, kind) in topics.items()]


class SqliteFile:
    """A whole .db3 file. Raises `DamagedError` for any other; rows that SQLite does not find behind later damage are lost and reported."""

    is_ros1 = False

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with closing(_connect(path)) as database:
                self._topics, definitions = _describe(database)
                count = database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id").fetchall()
                self._set_backs = _find_set_backs(database)
                spans = [span for part in self._parts() if (span := _span(database, *part)) is not None]
        except _ERRORS as error:
            raise DamagedError(_reason(error)) from error
        self._counts = Counter({key: n for key, n in count if key in self._topics})
        self.channels = _channels(self._topics, definitions, self._counts)
        self.start_ns, self.end_ns = min((begin for begin, _ in spans), default=0), max((end for _, end in spans), default=0)
        self.warnings: list[Message] = describe_set_backs(self._set_backs, self.start_ns)
        wal = path.with_name(path.name + "-wal")
        if wal.is_file() and wal.stat().st_size > 0:
            self.warnings.append(message("damaged_files.log_of_rows", rows=wal.name, file=path.name))
        self._rest: RecoveredSqlite | None = None

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time."""
        wanted = {key: topic for key, topic in self._topics.items() if topic[0] in topics}
        last, found = self.start_ns - 1, 0
        with closing(_connect(self._path)) as database:
            rows = heapq.merge(*(_rows_of(database, wanted, *part) for part in self._parts()), key=lambda row: row[1])
            while True:
                try:
                    key, stamp, data = next(rows)
                except StopIteration:
                    self._compare(found, sum(self._counts[key] for key in wanted))
                    return
                except _ERRORS as error:
                    reason = _reason(error)
                    break
                found, last = found + 1, stamp
                yield RawMessage(stamp, *wanted[key], decompress_message(data))
        if self._rest is None:
            self._rest = RecoveredSqlite(self._path, reason, self._set_backs)
            self.warnings += self._rest.warnings
        yield from (message for message in self._rest.messages(topics) if message.log_ns > last)

    def _parts(self) -> list[tuple[int, int, int]]:
        """First and last row, and by how much later it was recorded [ns], of each part between steps of the recorder's clock."""
        edges = [-_MAX_ROW, *(step.index for step in self._set_backs), _MAX_ROW]
        return [(first, end - 1, later_ns(self._set_backs, 0, first)) for first, end in itertools.pairwise(edges)]

    def _compare(self, found: int, listed: int) -> None:
        note = message("damaged_files.rows", file=self._path.name, count=found, listed=listed)
        if found < listed and note not in self.warnings:
            self.warnings.append(note)


class RecoveredSqlite:
    """Rows of a damaged .db3 file, as many as can be read, in the order in which they were recorded. Raises `LogError` if there are none.

    ``reason`` is why SQLite cannot read the file: it is part of the warning or the error. ``set_backs``: of the recorder's clock, by
    which later rows are moved.
    """

    is_ros1 = False

    def __init__(self, path: Path, reason: str, set_backs: Sequence[SetBack] = ()) -> None:
        self._path, self._set_backs = path, set_backs
        try:
            with closing(_connect(path)) as database:
                # SQLite refuses a file that is shorter than its header states, unless the schema is declared writable.
                database.execute("PRAGMA writable_schema=ON")
                self._topics, definitions = _describe(database)
        except (*_ERRORS, DamagedError) as error:
            self._topics, definitions = dict(self._leaves(_topic_row)), {}
            if not self._topics:
                raise LogError(f"'{path}' cannot be read: {reason}; not even its list of topics can ({_reason(error)}).") from error
        counts: Counter[int] = Counter()
        start, end = 2**63 - 1, 0
        for topic, log_ns, _ in self._rows():
            counts[topic] += 1
            start, end = min(start, log_ns), max(end, log_ns)
        self.channels = _channels(self._topics, definitions, counts)
        self.start_ns, self.end_ns = (start, end) if counts else (0, 0)
        self.warnings = [message("damaged_files.pages", file=path.name, reason=reason, count=counts.total())]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in the order in which they were recorded."""
        wanted = {key: topic for key, topic in self._topics.items() if topic[0] in topics}
        for key, log_ns, data in self._rows():
            if key in wanted:
                yield RawMessage(log_ns, *wanted[key], decompress_message(data))

    def _rows(self) -> Iterator[Row]:
        """Messages on the file's leaf pages: those rows that are an id, a known topic's number, a time and bytes."""
        for index, (key, log_ns, data) in self._leaves(_message_row):
            if key in self._topics:
                yield key, log_ns + later_ns(self._set_backs, 0, index), data

    def _leaves(self, read: Callable[[bytes], T | None]) -> Iterator[tuple[int, T]]:
        """Rows on the file's leaf pages, each with its number, of those that ``read`` knows."""
        with open_input(self._path) as file:
            pages = _Pages(file)
            leaves = (page for page in map(pages.read, range(1, pages.count)) if page[:1] == bytes([_TABLE_LEAF]))
            rows = ((index, read(payload)) for page in leaves for index, payload in _leaf_rows(pages, page))
            yield from ((index, row) for index, row in rows if row is not None)


class _Pages:
    """Pages of a file; each can be a part of one row only, so that pages that lead back to themselves end."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        head = file.read(100)
        size = int.from_bytes(head[16:18], "big") if head.startswith(MAGIC) else _USUAL_PAGE
        self.size = 65536 if size == 1 else size
        self.usable = self.size - (head[20] if head.startswith(MAGIC) and len(head) == 100 else 0)
        is_valid = self.size >= 512 and self.size & (self.size - 1) == 0 and self.usable >= 480
        self.count = file.seek(0, 2) // self.size if is_valid else 0
        self._is_taken = bytearray(self.count)

    def read(self, number: int) -> bytes:
        self._file.seek(number * self.size)
        return self._file.read(self.size)

    def take(self, number: int) -> bytes | None:
        """A page that a row overflows onto, by its number from 1; None if it is not there or a part of another row."""
        if not 0 < number <= self.count or self._is_taken[number - 1]:
            return None
        self._is_taken[number - 1] = 1
        return self.read(number - 1)


def _leaf_rows(pages: _Pages, page: bytes) -> Iterator[tuple[int, bytes]]:
    """Rows of a leaf page, each with its number."""
    count = int.from_bytes(page[3:5], "big")
    for i in range(min(count, len(page) // 4)):
        at = int.from_bytes(page[8 + 2 * i : 10 + 2 * i], "big")
        length, at = _varint(page, at)
        index, at = _varint(page, at)
        payload = _payload(pages, page, at, length)
        if payload is not None:
            yield index, payload


def _payload(pages: _Pages, page: bytes, at: int, length: int) -> bytes | None:
    """A row's bytes, gathered from the pages onto which it overflows; None if one of them is missing."""
    usable = pages.usable
    most = usable - 35
    if length <= most:
        return page[at : at + length] if at + length <= len(page) else None
    if length > min(pages.count * pages.size, MAX_DECOMPRESSED_BYTES):
        return None
    least = (usable - 12) * 32 // 255 - 23
    local = least + (length - least) % (usable - 4)
    if local > most:
        local = least
    parts, left = [page[at : at + local]], length - local
    following = int.from_bytes(page[at + local : at + local + 4], "big")
    while left > 0:
        overflow = pages.take(following)
        if overflow is None:
            return None
        parts.append(overflow[4 : 4 + min(left, usable - 4)])
        left -= len(parts[-1])
        following = int.from_bytes(overflow[:4], "big")
    return b"".join(parts)


def _message_row(payload: bytes) -> Row | None:
    """(topic, time, data) of a row (id, topic_id, timestamp, data) of the table `messages`; None of any other row."""
    types, head = _column_types(payload)
    if len(types) != 4 or types[0] != 0 or types[3] < 12 or types[3] % 2:
        return None
    topic, at = _integer(payload, head, types[1])
    log_ns, at = _integer(payload, at, types[2])
    size = (types[3] - 12) // 2
    if topic is None or log_ns is None or log_ns < 0 or at + size != len(payload):
        return None
    return topic, log_ns, payload[at:]


def _topic_row(payload: bytes) -> tuple[str, str] | None:
    """(name, type) of a row (id, name, type, serialization_format, ...) of the table `topics`; None of any other row."""
    types, head = _column_types(payload)
    if len(types) < 4 or types[0] != 0 or any(kind < 13 or kind % 2 == 0 for kind in types[1:4]):
        return None
    first, second, third = ((kind - 13) // 2 for kind in types[1:4])
    texts = payload[head : head + first], payload[head + first : head + first + second], payload[head + first + second :][:third]
    name, kind, form = (text.decode(errors="replace") for text in texts)
    return (name, kind) if name.startswith("/") and kind.count("/") == 2 and form == "cdr" else None


def _column_types(payload: bytes) -> tuple[list[int], int]:
    """Serial types of the columns of a row, and where its values begin; none where it is no row."""
    head, at = _varint(payload, 0)
    types: list[int] = []
    if head > len(payload):
        return types, 0
    while at < head:
        kind, at = _varint(payload, at)
        types.append(kind)
    return types, head


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
