"""Every format of log gives the same events, in constant memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from localization.events import CgSample, Event, ImuSample, Scan, WheelSample
from localization.logs import inspect_log, open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.logs import records_of_every_kind

ROBOT = load_robot("vaultbot")


def check(events: list[Event], steps: int) -> None:
    stamps = [START + i * S // 10 for i in range(steps)]
    by_kind = {kind: [e for e in events if isinstance(e, kind)] for kind in (WheelSample, CgSample, ImuSample, Scan)}
    for found in by_kind.values():
        assert [event.stamp_ns for event in found] == stamps
    assert len(events) == 4 * steps
    # Of equal stamps, what moves the robot comes before what measures it.
    assert [type(event) for event in events[:4]] == [WheelSample, CgSample, ImuSample, Scan]
    i = 7
    wheel, cg, inertial, scan = (by_kind[kind][i] for kind in (WheelSample, CgSample, ImuSample, Scan))
    assert isinstance(wheel, WheelSample)
    assert isinstance(cg, CgSample)
    assert isinstance(inertial, ImuSample)
    assert isinstance(scan, Scan)
    # Joints: front left, front right, rear left, rear right.
    np.testing.assert_allclose(wheel.velocity, [2.0, 3.0])
    np.testing.assert_allclose(wheel.position, [0.2 * i, 0.3 * i])
    np.testing.assert_allclose(cg.position, [0.07, -0.02])
    np.testing.assert_allclose(inertial.angular_velocity, [0.07, 0.0, -0.3])
    np.testing.assert_allclose(inertial.linear_acceleration, [0.0, 0.1, 9.8])
    assert inertial.frame_id == "imu_link"
    np.testing.assert_allclose(scan.points, [[1, 0, 0], [0, 2, 0], [-10, 0, 0]], atol=1e-6)
    assert scan.frame_id == "laser"
    assert scan.is_planar


@pytest.mark.parametrize("name", bags.FORMATS)
def test_log_every_format_gives_the_same_events_twice(tmp_path: Path, name: str) -> None:
    log = open_log(bags.FORMATS[name](tmp_path / "run", records_of_every_kind()), ROBOT)
    check(list(log.events()), 40)
    check(list(log.events()), 40)
    assert log.warnings() == []
    assert log.duration_s == pytest.approx(3.9 + 0.048)
    assert log.start_ns == START + 2_000_000


def test_log_two_iterators_are_independent(tmp_path: Path) -> None:
    for name in ("ros1", "mcap", "sqlite3", "mcap-file"):
        log = open_log(bags.FORMATS[name](tmp_path / name, records_of_every_kind()), ROBOT)
        both = list(zip(log.events(), log.events(), strict=True))
        check([one for one, _ in both], 40)
        check([other for _, other in both], 40)


def test_ros1_bag_written_topic_by_topic_is_read_in_time_order(tmp_path: Path) -> None:
    """As scripts that convert data sets write them; chunks of one topic lie far from those of the same time of another."""
    ordered = sorted(records_of_every_kind(400), key=lambda record: record[0])
    path = bags.write_ros1_bag(tmp_path / "run.bag", ordered, chunk_bytes=4_000)
    log = open_log(path, ROBOT)
    check(list(log.events()), 400)
    assert log.warnings() == []


def test_log_own_message_definitions_are_used(tmp_path: Path) -> None:
    """A later ROS may add a field to a message; its bytes are not to be taken for the next message's."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    text = store.generate_msgdef("geometry_msgs/msg/PointStamped", ros_version=2)[0].replace("float64 x", "float64 confidence\nfloat64 x")
    custom = get_typestore(Stores.EMPTY)
    custom.register(get_types_from_msg(text, "geometry_msgs/msg/PointStamped"))
    types = custom.types
    log_records: list[Record] = []
    for i in range(5):
        stamp = START + i * S
        header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=stamp // S, nanosec=0), frame_id="base_link")
        point = types["geometry_msgs/msg/Point"](confidence=9.0, x=0.25, y=0.125, z=0.75)
        message = types["geometry_msgs/msg/PointStamped"](header=header, point=point)
        data = bytes(custom.serialize_cdr(message, "geometry_msgs/msg/PointStamped"))
        log_records.append(("/center_of_gravity", bags.Unknown("geometry_msgs/msg/PointStamped", text, data), stamp))
    events = list(open_log(bags.write_ros2_bag(tmp_path / "run", log_records), ROBOT).events())
    assert len(events) == 5
    assert isinstance(events[0], CgSample)
    np.testing.assert_allclose(events[0].position, [0.25, 0.125])


def _peak(path: Path) -> tuple[int, int]:
    """Bytes of Python's memory at its most while all events go by, and their number."""
    list(zip(range(10), open_log(path, ROBOT).events(), strict=False))  # fill the caches that any log fills
    tracemalloc.start()
    try:
        log = open_log(path, ROBOT)
        count = sum(1 for _ in log.events())
        inspect_log(log)
        return tracemalloc.get_traced_memory()[1], count
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    "write",
    [
        lambda path, records: bags.write_ros1_bag(path.with_suffix(".bag"), records, chunk_bytes=100_000),
        lambda path, records: bags.write_mcap(path.with_suffix(".mcap"), records),
        lambda path, records: bags.write_ros2_bag(path, records, "sqlite3"),
    ],
    ids=["ros1", "mcap", "sqlite3"],
)
def test_log_ten_times_longer_uses_no_more_memory(tmp_path: Path, write: Callable[[Path, Iterator[Record]], Path]) -> None:
    def long_records(steps: int) -> Iterator[Record]:
        ranges = np.linspace(1.0, 9.0, 2000)
        for i in range(steps):
            stamp = START + i * S // 20
            yield "/joint_states", bags.joint_state(stamp, velocity=[1, 2, 3, 4]), stamp + 5_000_000
            yield "/scan", bags.laser_scan(stamp, ranges, angle_increment=0.003), stamp + 50_000_000

    short, few = _peak(write(tmp_path / "short", long_records(500)))
    long, many = _peak(write(tmp_path / "long", long_records(5000)))
    assert (few, many) == (1000, 10000)  # both fill the buffer in which a log is sorted
    assert long < 1.1 * short
