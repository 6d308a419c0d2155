"""SQLite storage files that rosbags refuses, because they were cut off: row by row, as far as the rows go."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from localization.errors import LogError
from localization.logs.chunks import Channel, RawMessage, inflate_message

MAGIC = b"SQLite format 3\x00"

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}


class RecoveredSqlite:
    """As many rows of a .db3 file as can be read, in the order in which they were recorded. Raises `LogError` if there are none."""

    is_ros1 = False

    def __init__(self, path: Path, reason: str) -> None:
        self._path = path
        counts: Counter[int] = Counter()
        start, end, stopped = 2**63 - 1, 0, ""
        try:
            with closing(self._connect()) as database:
                topics = database.execute("SELECT id, name, type FROM topics").fetchall()
                definitions = _definitions(database)
                try:
                    for topic, log_ns in database.execute("SELECT topic_id, timestamp FROM messages NOT INDEXED"):
                        counts[topic] += 1
                        start, end = min(start, log_ns), max(end, log_ns)
                except sqlite3.DatabaseError as error:
                    stopped = str(error)
        except sqlite3.DatabaseError as error:
            raise LogError(f"'{path}' cannot be read: {reason}; not even its list of topics ({error}).") from error
        self._topics: dict[int, tuple[str, str]] = {key: (name, kind) for key, name, kind in topics}
        nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self.channels = [Channel(name, kind, definitions.get(kind, nothing), counts[key]) for key, name, kind in topics]
        self.start_ns, self.end_ns = (start, end) if counts else (0, 0)
        lost = f"the rows after them are lost ({stopped})" if stopped else "no row seems to be lost"
        self.notes = [f"{path.name} is damaged ({reason}): {counts.total()} messages of it are used, {lost}."]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        wanted = {key: topic for key, topic in self._topics.items() if topic[0] in topics}
        with closing(self._connect()) as database:
            rows = database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED")
            while True:
                try:
                    row = next(rows, None)
                except sqlite3.DatabaseError:
                    return
                if row is None:
                    return
                if row[0] in wanted:
                    name, kind = wanted[row[0]]
                    yield RawMessage(row[1], name, kind, inflate_message(row[2]))

    def _connect(self) -> sqlite3.Connection:
        database = sqlite3.connect(f"file:{quote(str(self._path.resolve()))}?immutable=1", uri=True)
        # SQLite refuses a file that is shorter than its header says, unless it is told that the header may be wrong.
        database.execute("PRAGMA writable_schema=ON")
        return database


def _definitions(database: sqlite3.Connection) -> dict[str, MessageDefinition]:
    try:
        rows = database.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions").fetchall()
    except sqlite3.DatabaseError:  # recordings before ROS 2 Iron have no such table
        return {}
    return {kind: MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), text) for kind, encoding, text in rows}
