"""Logs made to harm: endless structures, decompression bombs, offsets that point nowhere, files that are none."""

from __future__ import annotations

import bz2
import contextlib
import os
import resource
import signal
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

from localization.errors import LogError
from localization.events import Scan, WheelSample
from localization.logs import inspect_log, open_log
from localization.logs.chunks import MAX_DECOMPRESSED_BYTES, DamagedError, decompress, decompress_message, zstd
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, S
from tests.helpers.logs import numbered_records, warnings_of

ROBOT = load_robot("vaultbot")


@contextlib.contextmanager
def limits(seconds: int = 20, extra_bytes: int = 2 << 30) -> Iterator[None]:
    """Inside, what takes longer raises `TimeoutError` and what takes more memory `MemoryError`."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + extra_bytes, before[1]))
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def read_all(path: Path) -> tuple[list, str]:
    """Events and notes, within limits."""
    with limits():
        log = open_log(path, ROBOT)
        events = list(log.events())
        inspect_log(log)
        return events, warnings_of(log)


def test_sqlite_row_with_endless_header_is_skipped(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(60), "sqlite3") / "run.db3"
    data = bytearray(path.read_bytes())
    for i in range(60):
        at = data.find(struct.pack(">Q", START + i * S // 10 + S // 200))
        head = data.rfind(b"\x00\x01\x06", 0, at)  # id, topic's number, stamp: the types of a row
        if i % 2 and head > 0:
            data[head - 1 : head + 8] = b"\xff" * 9  # the header's length, as a varint of nine bytes
    path.write_bytes(data[: len(data) - 5000])  # cut off, so that pages are walked through
    events, notes = read_all(path)
    assert "page by page" in notes
    assert sum(isinstance(e, Scan) for e in events) > 20


def test_sqlite_overflow_pages_in_a_circle_end(tmp_path: Path) -> None:
    """A row of 2^40 bytes whose overflow pages lead back to themselves."""
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    clouds = [("/points", bags.cloud(START + i * S // 10, np.ones(2000, layout)), START + i * S // 10) for i in range(20)]
    path = bags.write_ros2_bag(tmp_path / "run", clouds, "sqlite3") / "run.db3"
    data = bytearray(path.read_bytes())
    pages = len(data) // 4096
    for page in range(pages):  # every page that may be an overflow page leads to itself
        if data[page * 4096] == 0 and page > 2:
            data[page * 4096 : page * 4096 + 4] = (page + 1).to_bytes(4, "big")
    path.write_bytes(data[: len(data) - 5000])
    with contextlib.suppress(LogError):
        read_all(path)


def test_sqlite_with_a_view_instead_of_a_table_is_refused(tmp_path: Path) -> None:
    """A view can compute for ever."""
    path = tmp_path / "run.db3"
    with contextlib.closing(sqlite3.connect(path)) as database:
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 'a' AS name, 'b' AS type FROM n"
        database.execute(f"CREATE VIEW topics AS {endless}")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        database.commit()
    with limits(), pytest.raises(LogError, match="no table of topics"):
        open_log(path, ROBOT)


@pytest.mark.parametrize("offset", [2**64 - 1, 2**63, 10**12, 3])
def test_mcap_footer_that_points_nowhere_costs_the_index_only(tmp_path: Path, offset: int) -> None:
    path = bags.write_mcap(tmp_path / "run.mcap", numbered_records(60))
    data = bytearray(path.read_bytes())
    data[-28:-20] = struct.pack("<Q", offset)
    path.write_bytes(data)
    events, notes = read_all(path)
    assert sum(isinstance(e, Scan) for e in events) == 60
    assert "run.mcap was read record by record" in notes


def test_ros1_chunk_position_past_the_end_loses_that_chunk_only(tmp_path: Path) -> None:
    for position in (2**64 - 1, 2**63 - 1, 10**12):
        path = bags.write_ros1_bag(tmp_path / f"run{position}.bag", numbered_records(200), chunk_bytes=50_000)
        data = bytearray(path.read_bytes())
        at = data.rindex(b"chunk_pos=") + len(b"chunk_pos=")
        data[at : at + 8] = struct.pack("<Q", position)
        path.write_bytes(data)
        events, notes = read_all(path)
        assert sum(isinstance(e, Scan) for e in events) >= 170
        assert "damaged" in notes or "left out" in notes


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_damaged_region_of_an_uncompressed_chunk_costs_its_messages_only(tmp_path: Path, kind: str) -> None:
    """One chunk holds the whole log: 300 spoiled bytes, at some boundary of messages or not, must not cost more than a few of them."""
    for shift in range(0, 2400, 300):
        path = bags.FORMATS[kind](tmp_path / f"{kind}{shift}", numbered_records(150))
        data = bytearray(path.read_bytes())
        data[len(data) // 2 + shift : len(data) // 2 + shift + 300] = bytes(range(1, 101)) * 3
        path.write_bytes(data)
        events, notes = read_all(path)
        assert sum(isinstance(e, Scan) for e in events) >= 146
        assert sum(isinstance(e, WheelSample) for e in events) >= 146
        if sum(isinstance(e, Scan | WheelSample) for e in events) < 300:
            assert "is damaged" in notes or "dropped" in notes


@pytest.mark.parametrize("kind", ["mcap", "mcap-folder"])
def test_fewer_messages_than_the_index_lists_are_reported(tmp_path: Path, kind: str) -> None:
    """A record in the middle of an unknown kind: all else is intact."""
    path = bags.FORMATS[kind](tmp_path / "run", numbered_records(150))
    file = next(path.glob("*.mcap")) if path.is_dir() else path
    data = bytearray(file.read_bytes())
    size = len(bags.STORE.serialize_cdr(next(r[1] for r in numbered_records(1) if r[0] == "/scan"), "sensor_msgs/msg/LaserScan"))
    mark, at = b"\x05" + struct.pack("<Q", size + 22), 0
    for number in range(150):
        at = data.index(mark, at + 1)
        if number % 4 == 0:
            data[at] = 0x77
    file.write_bytes(data)
    events, notes = read_all(path)
    assert sum(isinstance(e, Scan) for e in events) == 150 - 38
    assert "262 of its 300 messages" in notes


BOMB = bytes(64 << 20) * 8  # half a gigabyte


@pytest.mark.parametrize(("name", "pack"), [("lz4", lz4.frame.compress), ("zstd", zstd.compress), ("bz2", bz2.compress)])
def test_decompression_bomb_is_refused_within_bounds(name: str, pack) -> None:
    packed = pack(BOMB) if name != "bz2" else pack(BOMB[: 80 << 20]) + b""
    with limits(extra_bytes=3 * MAX_DECOMPRESSED_BYTES), pytest.raises(DamagedError, match="decompress to more than"):
        decompress(packed, name)


@pytest.mark.extended
def test_large_valid_chunk_passes() -> None:
    """100 MB that compress 4 to 1, and 60 MB of nothing (an empty map) that compress 10,000 to 1."""
    rng = np.random.default_rng(1)
    sensor = np.repeat(rng.integers(0, 256, 25 << 20, dtype=np.uint8), 4).tobytes()
    assert decompress(zstd.compress(sensor), "zstd") == sensor
    assert decompress(zstd.compress(bytes(60 << 20)), "zstd") == bytes(60 << 20)


def test_message_that_is_a_bomb_is_dropped_and_counted(tmp_path: Path) -> None:
    def with_bomb() -> Iterator[bags.Record]:
        for i, record in enumerate(numbered_records(30)):
            yield record
            if i == 20:
                yield "/scan", bags.Unknown("sensor_msgs/msg/LaserScan", text, zstd.compress(BOMB)), record[2] + 1

    text = bags.STORE.generate_msgdef("sensor_msgs/msg/LaserScan", ros_version=2)[0]
    path = bags.write_ros2_bag(tmp_path / "run", with_bomb(), "sqlite3")
    events, notes = read_all(path)
    assert sum(isinstance(e, Scan) for e in events) == 30
    assert "/scan: 1 message dropped (bytes that are not of the type)" in notes
    assert len(decompress_message(zstd.compress(BOMB))) < 1 << 20


def test_storage_file_that_is_a_bomb_is_refused(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(10), "sqlite3", "file")
    file = next(path.glob("*.zstd"))
    plain = zstd.decompress(file.read_bytes())
    file.write_bytes(zstd.compress(plain) + b"".join(zstd.compress(bytes(64 << 20)) for _ in range(30)))
    before = set(Path(os.environ.get("TMPDIR", "/tmp")).iterdir())
    _, notes = read_all(path)
    assert "decompresses to more than" in notes
    grown = sum(f.stat().st_size for d in set(Path("/tmp").iterdir()) - before if d.is_dir() for f in d.glob("*.db3"))
    assert grown <= (300 << 20)


@pytest.mark.parametrize("is_ros1", [True, False])
def test_arrays_of_billions_of_empty_elements_are_dropped(tmp_path: Path, is_ros1: bool) -> None:
    """A definition of the log's own, with a sequence of 2^32 - 1 messages without fields, which take no bytes."""
    kind = "sensor_msgs/msg/Imu"
    store = bags.STORE_ROS1 if is_ros1 else bags.STORE
    text = store.generate_msgdef(kind, ros_version=1 if is_ros1 else 2)[0]
    first, rest = text.split("\n", 1)
    text = f"{first}\nstd_msgs/Empty[] nothing\n{rest}\n{'=' * 80}\nMSG: std_msgs/Empty\n"
    plain = bytes(bags.STORE.serialize_cdr(bags.imu(START), kind))
    data = bytes(bags.STORE.cdr_to_ros1(plain, kind)) if is_ros1 else plain
    for count in (b"\xff\xff\xff\xff", b"\xff\xff\xff\x0f"):
        messages = [("/imu/data", bags.Unknown(kind, text, data[:24] + count + data[24:]), START + i) for i in range(3)]
        write = bags.write_ros1_bag if is_ros1 else bags.write_ros2_bag
        events, notes = read_all(write(tmp_path / f"run{count[-1]}{'.bag' * is_ros1}", [*messages, *numbered_records(5)]))
        assert sum(isinstance(e, Scan) for e in events) == 5
        assert "/imu/data: 3 messages dropped" in notes


@pytest.mark.parametrize("size", [10**9, 5_000_000])
@pytest.mark.parametrize("inner", ["float64", "geometry_msgs/Vector3", "string"])
def test_definition_with_a_huge_fixed_array_is_replaced(tmp_path: Path, size: int, inner: str) -> None:
    """The reader's code is generated from the definition, line by line for each element."""
    kind = "sensor_msgs/msg/LaserScan"
    text = bags.STORE.generate_msgdef(kind, ros_version=2)[0]
    first, rest = text.split("\n", 1)
    parts = f"\n{'=' * 80}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n" if inner.startswith("geometry") else ""
    hostile = f"{first}\n{inner}[{size}] much\n{rest}{parts}"

    def as_bytes(message) -> bags.Unknown:
        return bags.Unknown(kind, hostile, bytes(bags.STORE.serialize_cdr(message, kind)))

    messages = [(topic, as_bytes(m) if topic == "/scan" else m, stamp) for topic, m, stamp in numbered_records(20)]
    events, _ = read_all(bags.write_ros2_bag(tmp_path / "run", messages))
    assert sum(isinstance(e, Scan) for e in events) == 20


@pytest.mark.parametrize("name", ["header", "stamp", "frame_id", "name", "position", "ranges", "angle_increment", "float32"])
def test_damaged_definition_is_replaced_by_the_standard_one(tmp_path: Path, name: str) -> None:
    def spoiled() -> Iterator[bags.Record]:
        for topic, message, stamp in numbered_records(20):
            kind = message.__msgtype__
            text = bags.STORE.generate_msgdef(kind, ros_version=2)[0].replace(name, name[:-1] + "q")
            yield topic, bags.Unknown(kind, text, bytes(bags.STORE.serialize_cdr(message, kind))), stamp

    events, _ = read_all(bags.write_ros2_bag(tmp_path / "run", spoiled()))
    assert sum(isinstance(e, Scan) for e in events) == sum(isinstance(e, WheelSample) for e in events) == 20


def test_fifo_and_device_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.bag")
    for path, what in ((tmp_path / "run.bag", "a FIFO"), (Path("/dev/zero"), "a device")):
        with limits(5), pytest.raises(LogError, match=what):
            open_log(path, ROBOT)
    folder = bags.write_ros2_bag(tmp_path / "run", numbered_records(5), "sqlite3")
    (folder / "run.db3").unlink()
    os.mkfifo(folder / "run.db3")
    with limits(5), pytest.raises(LogError, match="a FIFO"):
        open_log(folder, ROBOT)


@pytest.mark.extended
def test_metadata_of_millions_of_brackets_is_not_parsed(tmp_path: Path) -> None:
    path = bags.write_ros2_bag(tmp_path / "run", numbered_records(20), "mcap")
    for text in ("[" * 20_000, "a: &a [x]\n" * 1000, " " * (8 << 20)):
        (path / "metadata.yaml").write_text(text)
        events, notes = read_all(path)
        assert sum(isinstance(e, Scan) for e in events) == 20
        assert "is not whole" in notes


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_whole_mcap_of_another_writer_is_read_by_its_index(tmp_path: Path, compression: str) -> None:
    """With checksums of chunks and of the index, as rosbag2 writes them; a flipped bit of the index costs the index only."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=50_000, compression=CompressionType[compression])
        writer.start("ros2", "test")
        ids: dict[str, int] = {}
        for topic, message, log_ns in numbered_records(100):
            kind = message.__msgtype__
            if topic not in ids:
                schema = writer.register_schema(kind, "ros2msg", bags.STORE.generate_msgdef(kind, ros_version=2)[0].encode())
                ids[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(ids[topic], log_ns, bytes(bags.STORE.serialize_cdr(message, kind)), log_ns)
        writer.finish()
    events, notes = read_all(path)
    assert len(events) == 200
    assert notes == ""
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    events, notes = read_all(path)
    assert len(events) == 200
    assert "read record by record (the checksum of its index is wrong)" in notes
