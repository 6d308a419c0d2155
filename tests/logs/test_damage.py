"""Damaged logs: readable messages are read, lost ones reported, and only `LogError` is raised."""

from __future__ import annotations

import contextlib
import sqlite3
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from localization.errors import LogError
from localization.events import Event, Scan, WheelSample
from localization.logs import Log, inspect_log, open_log
from localization.logs.sqlite import RecoveredSqlite
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, S
from tests.helpers.extended import cases
from tests.helpers.logs import numbered_records, warnings_of

ROBOT = load_robot("vaultbot")
COUNT = 600  # steps of `numbered_records`


def check_is_prefix(log: Log) -> int:
    """The events are those of the whole log, without holes, up to where the log breaks off; how many steps that are."""
    events = list(log.events())
    wheels = [e for e in events if isinstance(e, WheelSample)]
    scans = [e for e in events if isinstance(e, Scan)]
    assert [e.stamp_ns for e in wheels] == [START + i * S // 10 for i in range(len(wheels))]
    assert [e.stamp_ns for e in scans] == [START + i * S // 10 for i in range(len(scans))]
    for i, scan in enumerate(scans):
        assert np.linalg.norm(scan.points[0]) == pytest.approx(1.0 + 0.01 * i, rel=1e-6)
    assert abs(len(wheels) - len(scans)) <= 1
    return min(len(wheels), len(scans))


def cut(path: Path, fraction: float) -> int:
    """Keep the first part of a file; the bytes that were kept."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    return int(len(data) * fraction)


@pytest.mark.parametrize("compression", [None, "lz4", "bz2"])
@pytest.mark.parametrize("fraction", [0.3, 0.75])
def test_ros1_truncated_is_read_to_the_cut(tmp_path: Path, compression: str | None, fraction: float) -> None:
    path = bags.write_ros1_bag(tmp_path / "run.bag", numbered_records(), compression, chunk_bytes=100_000)
    cut(path, fraction)
    log = open_log(path, ROBOT)
    steps = check_is_prefix(log)
    # Uncompressed bytes are readable to the last whole record (the bag's head and its indexes are as long as some three steps);
    # of compressed ones the last chunk, of 100 kB in 1.5 MB, may be lost.
    assert fraction * COUNT - (4 if compression is None else 50) <= steps <= fraction * COUNT + 1
    assert "run.bag is damaged" in warnings_of(log)
    assert f"{2 * steps}" in warnings_of(log) or f"{2 * steps + 1}" in warnings_of(log)


def test_ros1_of_a_killed_recorder_is_read_without_index(tmp_path: Path) -> None:
    """rosbag leaves a file named .bag.active, whose header has no index."""
    path = bags.write_ros1_bag(tmp_path / "run.bag", numbered_records(), chunk_bytes=100_000)
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(data[at : at + 8], "little")
    data[at : at + 8] = bytes(8)
    active = tmp_path / "run.bag.active"
    active.write_bytes(data[:index])
    log = open_log(active, ROBOT)
    assert check_is_prefix(log) == COUNT
    assert "All of its 1200 messages could be read" in warnings_of(log)


def test_ros1_bad_chunk_loses_only_that_chunk(tmp_path: Path) -> None:
    path = bags.write_ros1_bag(tmp_path / "run.bag", numbered_records(), "bz2", chunk_bytes=100_000)
    data = bytearray(path.read_bytes())
    middle = data.index(b"BZh", len(data) // 2)
    data[middle + 2000 : middle + 2100] = bytes(100)
    path.write_bytes(data)
    log = open_log(path, ROBOT)
    scans = [e for e in log.events() if isinstance(e, Scan)]
    assert COUNT - 60 < len(scans) < COUNT
    assert scans[-1].stamp_ns == START + (COUNT - 1) * S // 10
    lost = 2 * (COUNT - len(scans))
    assert any(f"A chunk of {n} messages" in warnings_of(log) for n in (lost - 1, lost, lost + 1))


@pytest.mark.parametrize("compression", [None, "storage"])
@pytest.mark.parametrize("fraction", [0.3, 0.75])
def test_mcap_truncated_is_read_to_the_cut(tmp_path: Path, compression: str | None, fraction: float) -> None:
    path = bags.write_mcap(tmp_path / "run.mcap", numbered_records(2 * COUNT), compression)
    cut(path, fraction)
    log = open_log(path, ROBOT)
    steps = check_is_prefix(log)
    # The file ends with its index, which is about a hundredth of it. zstd gives whole blocks of 128 kB (about 50 steps) only.
    assert fraction * 2 * COUNT - (2 if compression is None else 60) <= steps <= 1.02 * fraction * 2 * COUNT
    assert "run.mcap was read record by record" in warnings_of(log)


def test_mcap_folder_truncated_is_read_to_the_cut(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(), "mcap")
    cut(path / "run.mcap", 0.5)
    log = open_log(path, ROBOT)
    assert 0.49 * COUNT <= check_is_prefix(log) <= 0.52 * COUNT
    assert "run.mcap was read record by record" in warnings_of(log)


@pytest.mark.parametrize(("compression", "bare"), [(None, True), ("message", False)])
@pytest.mark.parametrize("fraction", cases([0.3, 0.9], ("0.9",)))
def test_sqlite_truncated_is_read_to_the_cut(tmp_path: Path, compression: str | None, bare: bool, fraction: float) -> None:
    """Wherever it was cut off: at 0.3, SQLite itself finds no row, for the page that leads to the first ones comes later."""
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(), "sqlite3", compression)
    with contextlib.closing(sqlite3.connect(path / "run.db3")) as database:
        rows = [row[0] for row in database.execute("SELECT data FROM messages ORDER BY id")]
    cut(path / "run.db3", fraction)
    kept = (path / "run.db3").read_bytes()
    whole_pages = kept[: len(kept) // 4096 * 4096]
    log = open_log(path / "run.db3" if bare else path, ROBOT)
    # Rows of 2 kB lie in one piece: those that are in the bytes that were kept, and no others, are to be read.
    assert check_is_prefix(log) == sum(row in whole_pages for row in rows[1::2]) > 0.25 * COUNT
    assert "run.db3 was read page by page" in warnings_of(log)


def test_sqlite_schema_with_names_that_are_not_text_is_read_page_by_page(tmp_path: Path) -> None:
    """SQLite's message quotes the name, and Python's sqlite3 cannot decode it."""
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(20), "sqlite3")
    file = path / "run.db3"
    data = file.read_bytes().replace(b"CREATE TABLE topics", b"CREATE TABL\x81 topics").replace(b"topicstopics", b"\x81opicstopics")
    file.write_bytes(data)
    log = open_log(file, ROBOT)
    assert "page by page (a name in its schema is not text)" in warnings_of(log)
    assert check_is_prefix(log) == 20


@pytest.mark.parametrize("first", [bytes(4096), b"\xff" * 4096], ids=["zeros", "ones"])
def test_sqlite_without_its_first_page_is_read_page_by_page(tmp_path: Path, first: bytes) -> None:
    """It has the size of pages, the schema and where the tables are; a loss of power leaves zeros there."""
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(400), "sqlite3")
    file = path / "run.db3"
    file.write_bytes(first + file.read_bytes()[4096:])
    log = open_log(path, ROBOT)
    assert "page by page (its first page is not that of a database)" in warnings_of(log)
    assert check_is_prefix(log) == 400


def test_sqlite_without_its_topics_is_refused(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(20), "sqlite3")
    file = path / "run.db3"
    data = bytearray(file.read_bytes())
    with contextlib.closing(sqlite3.connect(file)) as database:
        (page,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'topics'").fetchone()
    data[:4096] = bytes(4096)
    data[4096 * (page - 1) : 4096 * page] = bytes(4096)
    file.write_bytes(data)
    with pytest.raises(LogError, match="not even its list of topics"):
        open_log(file, ROBOT)


def test_sqlite_write_ahead_log_beside_the_file_is_reported(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(20), "sqlite3")
    (path / "run.db3-wal").write_bytes(b"x")
    assert "run.db3-wal holds rows" in warnings_of(open_log(path, ROBOT))


def test_sqlite_pages_give_the_rows_of_the_library(tmp_path: Path) -> None:
    """Of every length from a tenth of a page to four pages, for what stays on the page depends on it in three ways."""
    messages = [bags.laser_scan(START + i * S // 10, np.linspace(1.0, 9.0, n)) for i, n in enumerate(range(100, 4000, 13))]
    path = bags.write_ros2_bag(tmp_path / "run", [("/scan", m, START + i * S // 10) for i, m in enumerate(messages)], "sqlite3") / "run.db3"
    with contextlib.closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT timestamp, data FROM messages ORDER BY id").fetchall()
    recovered = RecoveredSqlite(path, "a test")
    assert [(message.log_ns, message.data) for message in recovered.messages(["/scan"])] == rows
    assert recovered.channels[0].count == len(rows) == 300


def test_sqlite_truncated_keeps_rows_longer_than_a_page(tmp_path: Path) -> None:
    """Point clouds overflow onto further pages; one whose last page is missing is left out."""
    rng = np.random.default_rng(5)
    clouds = [np.ascontiguousarray(rng.normal(size=(1500, 3)).astype(np.float32)) for _ in range(40)]
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    path = bags.write_ros2_bag(
        tmp_path / "run",
        [("/points", bags.cloud(START + i * S // 10, c.view(layout)[:, 0]), START + i * S // 10) for i, c in enumerate(clouds)],
        "sqlite3",
    )
    cut(path / "run.db3", 0.6)
    scans = [e for e in open_log(path, ROBOT).events() if isinstance(e, Scan)]
    assert 22 <= len(scans) <= 25
    for scan, cloud in zip(scans, clouds, strict=False):
        np.testing.assert_array_equal(scan.points, cloud.astype(float))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_compressed_storage_file_truncated_is_read_to_the_cut(tmp_path: Path, storage: str) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(2 * COUNT), storage, "file")
    cut(next(path.glob("*.zstd")), 0.5)
    log = open_log(path, ROBOT)
    assert 0.9 * COUNT <= check_is_prefix(log) <= 1.1 * COUNT
    assert "it was cut off" in warnings_of(log)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_folder_without_metadata_is_read_file_by_file(tmp_path: Path, storage: str) -> None:
    """What a crash leaves: the recorder writes metadata.yaml when it stops."""
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(), storage)
    (path / "metadata.yaml").unlink()
    log = open_log(path, ROBOT)
    assert check_is_prefix(log) == COUNT
    assert "metadata.yaml is missing" in warnings_of(log)


def test_folder_split_without_metadata_is_read_in_order(tmp_path: Path) -> None:
    everything = list(numbered_records(120))
    folder = tmp_path / "run"
    folder.mkdir()
    for number, first in enumerate(range(0, 240, 20)):  # run_2 comes before run_10
        bags.write_mcap(folder / f"run_{number}.mcap", everything[first : first + 20])
    assert check_is_prefix(open_log(folder, ROBOT)) == 120


def test_folder_with_one_invalid_file_uses_the_others(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(50), "mcap")
    (path / "run_1.mcap").write_text("not a log")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: 3")
    log = open_log(path, ROBOT)
    assert check_is_prefix(log) == 50
    assert "run_1.mcap' is not a log" in warnings_of(log)


def test_mcap_bad_chunk_loses_only_that_chunk(tmp_path: Path) -> None:
    path = bags.write_mcap(tmp_path / "run.mcap", numbered_records(4 * COUNT), "storage")
    data = bytearray(path.read_bytes())
    middle = data.index(b"\x28\xb5\x2f\xfd", len(data) // 3)
    data[middle + 5000 : middle + 5200] = bytes(200)
    path.write_bytes(data)
    log = open_log(path, ROBOT)
    scans = [e for e in log.events() if isinstance(e, Scan)]
    stamps = [scan.stamp_ns for scan in scans]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == START + (4 * COUNT - 1) * S // 10
    assert 3 * COUNT < len(scans) < 4 * COUNT
    assert "A chunk at byte" in warnings_of(log)


def test_mcap_chunk_with_wrong_checksum_is_used_and_reported(tmp_path: Path) -> None:
    """A flipped bit in a range is a valid range: the message cannot be identified, and the others are right."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=50_000, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        ids: dict[str, int] = {}
        for topic, message, log_ns in numbered_records(100):
            kind = message.__msgtype__
            if topic not in ids:
                schema = writer.register_schema(kind, "ros2msg", bags.STORE.generate_msgdef(kind, ros_version=2)[0].encode())
                ids[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(ids[topic], log_ns, bytes(bags.STORE.serialize_cdr(message, kind)), log_ns)
        writer.finish()
    whole = [e for e in open_log(path, ROBOT).events() if isinstance(e, Scan)]
    assert len(whole) == 100
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    log = open_log(path, ROBOT)
    scans = {e.stamp_ns: e for e in log.events() if isinstance(e, Scan)}
    assert len(scans) >= 99
    assert "is damaged (its checksum is wrong)" in warnings_of(log)
    differing = [s for s in whole if s.stamp_ns not in scans or not np.array_equal(s.points, scans[s.stamp_ns].points)]
    assert len(differing) <= 1


def test_mcap_without_chunks_or_summary_is_read(tmp_path: Path) -> None:
    """As rosbag2's fastest preset writes it; with messages out of order, which rosbags refuses."""
    from mcap.writer import Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, use_summary_offsets=False, use_statistics=False, repeat_channels=False)
        writer.start("ros2", "test")
        ids: dict[str, int] = {}
        everything = list(numbered_records(300))
        everything[10], everything[12] = everything[12], everything[10]
        for topic, message, log_ns in everything:
            kind = message.__msgtype__
            if topic not in ids:
                schema = writer.register_schema(kind, "ros2msg", bags.STORE.generate_msgdef(kind, ros_version=2)[0].encode())
                ids[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(ids[topic], log_ns, bytes(bags.STORE.serialize_cdr(message, kind)), log_ns)
        writer.finish()
    assert check_is_prefix(open_log(path, ROBOT)) == 300


def test_mcap_of_ros1_messages_is_read(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros1", "test")
        ids: dict[str, int] = {}
        for topic, message, log_ns in numbered_records(100):
            kind = message.__msgtype__
            if topic not in ids:
                text = bags.STORE_ROS1.generate_msgdef(kind)[0]
                schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", text.encode())
                ids[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(ids[topic], log_ns, bytes(bags.STORE.cdr_to_ros1(bags.STORE.serialize_cdr(message, kind), kind)), log_ns)
        writer.finish()
    assert check_is_prefix(open_log(path, ROBOT)) == 100


def test_mcap_without_ros_messages_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "test")
        channel = writer.register_channel("/x", "json", writer.register_schema("X", "jsonschema", b"{}"))
        for i in range(10):
            writer.add_message(channel, i, b"{}", i)
        writer.finish()
    with pytest.raises(LogError, match=r"run\.mcap.*json.*not as those of ROS"):
        open_log(path, ROBOT)


def _text(path: Path) -> None:
    path.write_text("Dear diary, today the robot drove into the pond.\n" * 100)


def _zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "a")


def _database(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE cats (name TEXT)")
    database.close()


NOT_LOGS: dict[str, Callable[[Path], object]] = {
    "text.bag": _text,
    "text.mcap": _text,
    "text.db3": _text,
    "archive.zip": _zip,
    "empty.bag": lambda path: path.write_bytes(b""),
    "empty.mcap": lambda path: path.write_bytes(b""),
    "cats.db3": _database,
    "folder": lambda path: path.mkdir(),
    "old.bag": lambda path: path.write_bytes(b"#ROSBAG V1.2\n" + bytes(100)),
    "head.bag": lambda path: path.write_bytes(b"#ROSBAG V2.0\n"),
    "noise.bag": lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + np.random.default_rng(1).bytes(5000)),
    "head.mcap": lambda path: path.write_bytes(b"\x89MCAP0\r\n"),
    "noise.mcap": lambda path: path.write_bytes(b"\x89MCAP0\r\n" + np.random.default_rng(2).bytes(5000)),
    "noise.db3": lambda path: path.write_bytes(b"SQLite format 3\x00" + np.random.default_rng(3).bytes(5000)),
}


@pytest.mark.parametrize("name", NOT_LOGS)
def test_path_that_is_no_log_is_refused_by_name(tmp_path: Path, name: str) -> None:
    NOT_LOGS[name](tmp_path / name)
    with pytest.raises(LogError, match=name.replace(".", r"\.")):
        open_log(tmp_path / name, ROBOT)


def test_path_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"gone\.bag.*no such file"):
        open_log(tmp_path / "gone.bag", ROBOT)


def test_folder_of_ros1_bags_error_lists_them(tmp_path: Path) -> None:
    bags.write_ros1_bag(tmp_path / "run.bag", numbered_records(5))
    with pytest.raises(LogError, match=r"ROS 1 bags in it: run\.bag"):
        open_log(tmp_path, ROBOT)


@pytest.mark.parametrize("name", bags.FORMATS)
@pytest.mark.parametrize("count", [0, 1])
def test_log_of_at_most_one_message_is_refused(tmp_path: Path, name: str, count: int) -> None:
    path = bags.FORMATS[name](tmp_path / "run", list(numbered_records(1))[:count])
    with pytest.raises(LogError, match="no message" if count == 0 else "only one message"):
        open_log(path, ROBOT)


FUZZED = {
    **{name: bags.FORMATS[name] for name in ("ros1", "mcap", "mcap-storage", "sqlite3", "mcap-file")},
    "ros1-bz2": lambda path, records: bags.write_ros1_bag(path.with_suffix(".bag"), records, "bz2", chunk_bytes=10_000),
}


@pytest.mark.parametrize("name", cases(FUZZED, ("ros1", "mcap")))
def test_log_any_cut_or_flipped_byte_gives_events_or_input_error(tmp_path: Path, name: str) -> None:
    """Sixty damages of each format: whatever happens, only `LogError` comes out, and stamps never decrease."""
    original = FUZZED[name](tmp_path / "run", numbered_records(40))
    storage = next(f for f in original.iterdir() if f.name != "metadata.yaml") if original.is_dir() else original
    data = storage.read_bytes()
    rng = np.random.default_rng(11)
    readable = 0
    for trial in range(60):
        broken = bytearray(data)
        if trial % 3 == 0:
            broken = broken[: rng.integers(len(data))]
        else:
            for at in rng.integers(0, len(data), 1 + trial % 5):
                broken[at] = rng.integers(256)
        storage.write_bytes(broken)
        try:
            log = open_log(original, ROBOT)
            events: list[Event] = list(log.events())
            inspect_log(log)
        except LogError:
            continue
        readable += 1
        stamps = [event.stamp_ns for event in events]
        assert stamps == sorted(stamps)
    assert readable >= 10
