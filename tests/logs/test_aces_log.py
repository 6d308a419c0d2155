"""The shipped ACES log matches its source, and its script reproduces it."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

pytestmark = pytest.mark.xdist_group("aces_log")

DATA = Path(__file__).parents[1] / "data"
BAG = DATA / "aces" / "aces.mcap"
EXCERPT = DATA / "aces" / "excerpt.clf"
SCRIPT = DATA / "make_aces_bag.py"

Log = dict[str, list[tuple[int, Any]]]


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def stamps(log: Log, topic: str) -> list[int]:
    return [stamp(message) for _, message in log[topic]]


def yaw(message: Any) -> float:
    q = message.pose.pose.orientation
    return math.atan2(2 * q.w * q.z, 1 - 2 * q.z * q.z)


def read_with_rosbags(path: Path) -> Log:
    """(log time, message) of every topic in the order of reading."""
    found: Log = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, log_time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((log_time, reader.deserialize(raw, connection.msgtype)))
    return found


def read_with_mcap(path: Path) -> Log:
    found: Log = {}
    with path.open("rb") as stream:
        for _, channel, record, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((record.log_time, message))
    return found


def make_bag(source: Path, out: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(SCRIPT), str(source), str(out)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def log() -> Log:
    return read_with_rosbags(BAG)


def test_aces_counts_and_times_match_the_source(log: Log) -> None:
    scans, odometry = stamps(log, "/scan"), stamps(log, "/odom")
    assert len(scans) == 7374
    assert len(odometry) == 7375
    assert len(log["/tf_static"]) == 1
    assert (scans[0], scans[-1]) == (70_289_900_000, 1_435_809_999_000)
    assert (odometry[0], odometry[-1]) == (70_179_699_000, 1_435_900_000_000)
    assert (len(scans) - 1) / ((scans[-1] - scans[0]) * 1e-9) == pytest.approx(5.40, abs=0.005)


def test_aces_stamps_rise_except_one_repeated_pair(log: Log) -> None:
    assert np.diff(stamps(log, "/scan")).min() > 0
    steps = np.diff(stamps(log, "/odom"))
    assert steps.min() == 0
    assert [stamps(log, "/odom")[i] for i in np.flatnonzero(steps == 0)] == [1_380_220_000_000]


def test_aces_path_is_325_m_long(log: Log) -> None:
    positions = np.array([[m.pose.pose.position.x, m.pose.pose.position.y] for _, m in log["/odom"]])
    assert np.hypot(*np.diff(positions, axis=0).T).sum() == pytest.approx(325.0, abs=0.5)


def test_aces_scan_and_frames_match_the_source(log: Log) -> None:
    for _, scan in log["/scan"]:
        assert len(scan.ranges) == 180
        assert scan.header.frame_id == "laser"
    degrees = np.degrees(scan.angle_min + np.arange(180) * scan.angle_increment)
    assert degrees == pytest.approx(np.arange(-90, 90), abs=1e-4)
    assert math.degrees(scan.angle_max) == pytest.approx(89, abs=1e-4)
    assert scan.range_max == 50.0
    ranges = np.array([scan.ranges for _, scan in log["/scan"]])
    assert np.count_nonzero(ranges == 50.0) == 11_139
    assert ranges.max() == 50.0
    assert {(m.header.frame_id, m.child_frame_id) for _, m in log["/odom"]} == {("odom", "base_link")}
    (mount,) = log["/tf_static"][0][1].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "laser")
    t, q = mount.transform.translation, mount.transform.rotation
    assert (t.x, t.y, t.z, q.x, q.y, q.z, q.w) == (0, 0, 0, 0, 0, 0, 1)


@pytest.mark.parametrize(
    ("index", "stamp_ns", "first", "last"),
    [
        (0, 70_289_900_000, [46.56, 47.31, 12.51, 14.71], [6.46, 6.36, 4.46, 6.36]),
        (1999, 400_790_000_000, [5.26, 5.21, 5.21, 5.21], [4.91, 5.21, 5.46, 2.11]),
        (7373, 1_435_809_999_000, [1.52, 1.52, 1.57, 1.57], [1.02, 1.02, 1.02, 1.02]),
    ],
)
def test_aces_ranges_match_the_source_text(log: Log, index: int, stamp_ns: int, first: list[float], last: list[float]) -> None:
    """Literals copied from the text of the source: the first and the last four readings of three lines."""
    scan = log["/scan"][index][1]
    assert stamp(scan) == stamp_ns
    assert scan.ranges[:4].tolist() == np.float32(first).tolist()
    assert scan.ranges[-4:].tolist() == np.float32(last).tolist()


@pytest.mark.parametrize(
    ("index", "stamp_ns", "pose"),
    [
        (0, 70_179_699_000, (-0.000602, 0.012727, -1.570796)),
        (1999, 400_709_999_000, (-37.866398, -28.701500, 2.972926)),
        (7374, 1_435_900_000_000, (-17.805700, -3.180960, 2.478771)),
    ],
)
def test_aces_odometry_matches_the_source_text(log: Log, index: int, stamp_ns: int, pose: tuple[float, float, float]) -> None:
    message = log["/odom"][index][1]
    assert stamp(message) == stamp_ns
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == pose[:2]
    assert yaw(message) == pytest.approx(pose[2], abs=1e-12)
    assert (message.twist.twist.linear.x, message.twist.twist.angular.z) == (0, 0)


def test_aces_relation_times_are_scan_stamps(log: Log) -> None:
    times = np.loadtxt(BAG.with_suffix(".relations"), usecols=(0, 1))
    assert times.shape == (1279, 2)
    wanted = {round(t * 1e6) * 1000 for t in times.ravel()}
    assert wanted <= set(stamps(log, "/scan"))


@pytest.mark.extended
def test_aces_independent_reader_gives_the_same_messages(log: Log) -> None:
    other = read_with_mcap(BAG)
    assert other.keys() == log.keys()
    for topic in ("/scan", "/odom"):
        assert [t for t, _ in other[topic]] == [t for t, _ in log[topic]]
        assert stamps(other, topic) == stamps(log, topic)
    ours = np.array([m.ranges for _, m in log["/scan"]])
    theirs = np.array([m.ranges for _, m in other["/scan"]], dtype=np.float32)
    assert np.array_equal(ours, theirs)
    assert [yaw(m) for _, m in other["/odom"]] == [yaw(m) for _, m in log["/odom"]]


def test_aces_script_reproduces_the_shipped_bytes(log: Log, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first, second = tmp_path / "a" / "aces.mcap", tmp_path / "b" / "aces.mcap"
    for out in (first, second):
        done = make_bag(EXCERPT, out)
        assert done.returncode == 0, done.stderr
    assert first.read_bytes() == second.read_bytes()
    assert [f.name for f in (tmp_path / "a").iterdir()] == ["aces.mcap"]

    made = read_with_rosbags(first)
    shipped_scans = {stamp(m): m.ranges.tolist() for _, m in log["/scan"]}
    shipped_yaws = {stamp(m): yaw(m) for _, m in log["/odom"]}
    lines = [line.split() for line in EXCERPT.read_text().splitlines()]
    scans = [f for f in lines if f[0] == "FLASER"]
    assert len(made["/scan"]) == len(scans) == 8
    for (_, message), fields in zip(made["/scan"], scans, strict=True):
        assert message.ranges.tolist() == [float(np.float32(r)) for r in fields[2:182]] == shipped_scans[stamp(message)]
    assert len(made["/odom"]) == 8
    assert all(shipped_yaws[stamp(m)] == yaw(m) for _, m in made["/odom"])


def test_aces_messages_are_in_file_order(tmp_path: Path) -> None:
    """The excerpt holds places where the next line's time is earlier than the last one's."""
    out = tmp_path / "aces.mcap"
    assert make_bag(EXCERPT, out).returncode == 0
    with AnyReader([out], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        order = [(c.topic, stamp(reader.deserialize(raw, c.msgtype))) for c, _, raw in reader.messages() if c.topic != "/tf_static"]
    lines = [line.split() for line in EXCERPT.read_text().splitlines()]
    topics = {"ODOM": "/odom", "FLASER": "/scan"}
    expected = [(topics[f[0]], round(float(f[-3]) * 1e6) * 1000) for f in lines if f[0] in topics]
    assert order == expected
    assert [t for _, t in order] != sorted(t for _, t in order)


def test_aces_script_existing_output_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "aces.mcap"
    out.write_text("mine")
    done = make_bag(EXCERPT, out)
    assert done.returncode != 0
    assert "exists already" in done.stderr
    assert out.read_text() == "mine"
