"""Messages become events with the right numbers, whatever the driver's layout, units and gaps."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags import rosbag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from localization.events import Event, ImuSample, Scan, WheelSample
from localization.logs import Log, inspect_log, open_log
from motion_models import se2
from motion_models.robot import Driver
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, S

ROBOT = load_robot("vaultbot")


def log_of(tmp_path: Path, topic: str, messages: list[Any], period: int = S // 10, robot: Any = ROBOT) -> Log:
    records = [(topic, message, START + i * period) for i, message in enumerate(messages)]
    return open_log(bags.write_mcap(tmp_path / "run.mcap", records), robot)


def scans_of(tmp_path: Path, messages: list[Any], topic: str = "/scan") -> tuple[list[Scan], Log]:
    last = START + len(messages) * S // 10
    padding = bags.laser_scan(last) if topic == "/scan" else bags.cloud(last, table([(1, 1, 1)]))
    log = log_of(tmp_path, topic, [*messages, padding])  # a log needs two messages
    return [e for e in log.events() if isinstance(e, Scan)][:-1], log


def wheels_of(log: Log) -> list[WheelSample]:
    return [e for e in log.events() if isinstance(e, WheelSample)]


def table(rows: Any, extra: list[tuple[str, str]] = [], coordinate: str = "<f4") -> Any:  # noqa: B006
    return np.array([tuple(row) for row in rows], dtype=[("x", coordinate), ("y", coordinate), ("z", coordinate), *extra])


# Laser scans


def test_scan_ranges_without_hit_are_dropped(tmp_path: Path) -> None:
    ranges = [1.0, np.nan, np.inf, -np.inf, 0.05, 0.0, -1.0, 30.0, 31.0, 29.9, 0.1]
    (scan,), log = scans_of(tmp_path, [bags.laser_scan(START, ranges, angle_min=0.0, angle_increment=0.0625, time_increment=0.001)])
    kept = np.array([0, 9, 10])
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1), [1.0, 29.9, 0.1], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(scan.points[:, 1], scan.points[:, 0]), 0.0625 * kept, atol=1e-6)
    np.testing.assert_allclose(scan.offsets, 0.001 * kept, rtol=1e-6)
    assert scan.points.dtype == np.float64
    assert scan.points.flags.c_contiguous
    assert log.warnings() == []  # beams that hit nothing are nothing odd


@pytest.mark.parametrize("ranges", [[], [np.nan] * 5, [40.0] * 5])
def test_scan_without_ranges_is_a_scan(tmp_path: Path, ranges: list[float]) -> None:
    (scan,), _ = scans_of(tmp_path, [bags.laser_scan(START, ranges, time_increment=0.001)])
    assert scan.points.shape == (0, 3)
    assert scan.offsets.shape == (0,)


def test_scan_of_an_upside_down_scanner_turns_the_other_way(tmp_path: Path) -> None:
    (scan,), _ = scans_of(tmp_path, [bags.laser_scan(START, [2.0, 2.0], angle_min=0.5, angle_increment=-0.25)])
    np.testing.assert_allclose(np.arctan2(scan.points[:, 1], scan.points[:, 0]), [0.5, 0.25], rtol=1e-6)
    assert scan.offsets.shape == (0,)  # it has no time_increment


def test_scan_nan_limits_are_unlimited_and_nan_angle_is_malformed(tmp_path: Path) -> None:
    good = bags.laser_scan(START, [2.0, 3.0], range_min=np.nan, range_max=np.nan)
    bad = bags.laser_scan(START + S, [2.0, 3.0], angle_min=np.nan)
    scans, log = scans_of(tmp_path, [good, bad])
    assert [len(scan.points) for scan in scans] == [2]
    assert any("/scan: 1 message dropped" in note for note in log.warnings())


@pytest.mark.parametrize("beam_s", [1e30, -1e30, np.inf])
def test_scan_of_endless_sweep_is_malformed(tmp_path: Path, beam_s: float) -> None:
    scans, log = scans_of(tmp_path, [bags.laser_scan(START, [2.0, 3.0], time_increment=beam_s)])
    assert scans == []
    assert [found.statement for found in log.warnings()] == ["/scan: 1 message dropped (fields that contradict each other)."]


@pytest.mark.parametrize(
    ("sweep_s", "wanted_s", "word"),
    [(0.07, 0.07, ""), (np.nan, 0.0, ""), (-0.1, -0.1, ""), (70.0, 0.07, "scaled"), (-5e4, -0.05, "scaled"), (1.0, 0.0, "left out")],
)
def test_scan_sweep_longer_than_its_period_is_scaled_or_left_out(tmp_path: Path, sweep_s: float, wanted_s: float, word: str) -> None:
    """Milliseconds and microseconds are known by the period, a tenth of a second too many is none; NaN is no time."""
    messages = [bags.laser_scan(START + i * S // 10, np.full(50, 2.0), angle_increment=0.1, time_increment=sweep_s / 50) for i in range(12)]
    scans, log = scans_of(tmp_path, messages)
    assert len(scans) == 12
    assert {round(float(scan.offsets[-1]), 4) if len(scan.offsets) else 0.0 for scan in scans} == {round(wanted_s * 49 / 50, 4)}
    assert [word in note for note in log.warnings()] == [True] * bool(word)


def test_scan_directions_follow_a_changed_angle_increment(tmp_path: Path) -> None:
    messages = [bags.laser_scan(START + i * S // 10, [1.0] * n, angle_min=0.0, angle_increment=0.5) for i, n in enumerate((2, 3, 2))]
    scans, _ = scans_of(tmp_path, messages)
    for scan, n in zip(scans, (2, 3, 2), strict=True):
        np.testing.assert_allclose(scan.points[:, 0], np.cos(0.5 * np.arange(n)), rtol=1e-6)


# Point clouds

ROWS = [(1.0, 2.0, 3.0), (-4.0, 5.0, -6.0), (7.0, -8.0, 9.0)]


@pytest.mark.parametrize("coordinate", ["<f4", ">f4", "<f8", ">f8"])
def test_cloud_any_byte_order_and_width_is_decoded(tmp_path: Path, coordinate: str) -> None:
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(ROWS, coordinate=coordinate))], "/points")
    np.testing.assert_array_equal(scan.points, ROWS)
    assert scan.points.dtype == np.float64
    assert scan.points.dtype.isnative
    assert scan.points.flags.c_contiguous
    assert not scan.is_planar
    assert scan.frame_id == "lidar"


def test_cloud_other_fields_padding_and_order_are_ignored(tmp_path: Path) -> None:
    layout = np.dtype(
        {
            "names": ["intensity", "z", "x", "ring", "y"],
            "formats": ["<f4", "<f4", "<f4", "<u2", "<f4"],
            "offsets": [0, 8, 16, 20, 24],
            "itemsize": 48,
        }
    )
    points = np.zeros((2, 3), dtype=layout)  # organised, with bytes at the end of each row
    points["x"], points["y"], points["z"] = np.arange(6).reshape(2, 3), 10.0, 20.0
    points["intensity"] = np.nan
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, points, row_padding=7)], "/points")
    np.testing.assert_array_equal(scan.points, [(x, 10.0, 20.0) for x in range(6)])


def test_cloud_points_without_hit_are_dropped_with_their_times(tmp_path: Path) -> None:
    rows = [(1, 2, 3, 10e6), (np.nan, 2, 3, 20e6), (0, 0, 0, 30e6), (1, np.inf, 3, 40e6), (4, 5, 6, 50e6)]
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(rows, [("t", "<u4")]))], "/points")
    np.testing.assert_array_equal(scan.points, [(1, 2, 3), (4, 5, 6)])
    np.testing.assert_allclose(scan.offsets, [0.01, 0.05])


SWEEP = np.array([0.0, 0.03, 0.0999])
UPTIME = 512.25


@pytest.mark.parametrize(
    ("field", "kind", "values"),
    [
        ("t", "<u4", SWEEP * 1e9),  # Ouster
        ("offset_time", "<u4", SWEEP * 1e9),  # Livox
        ("time", "<f4", SWEEP),  # Velodyne
        ("timestamp", "<f8", START * 1e-9 + SWEEP),  # Hesai, RoboSense
        ("timestamp", "<f8", START + SWEEP * 1e9),  # Livox, driver 2
        ("stamps", "<f8", SWEEP * 1e6),
        ("time", "<f4", SWEEP * 1e9),
        ("timestamp", "<f8", UPTIME + SWEEP),  # an unknown clock: the scan begins at the header's stamp
        ("t", "<u4", UPTIME * 1e9 % 2**32 + SWEEP * 1e9),
        ("time_stamp", "<u4", SWEEP * 1e9),  # Autoware, PointXYZIRCAEDT
        ("time_stamp", "<f8", START * 1e-9 + SWEEP),  # Autoware, PointXYZIRADRT
        ("t", "<u4", SWEEP * 1e6),
        ("t", "<u2", SWEEP * 1e3),
        ("time", "<f4", SWEEP * 1e3),
        ("timestamp", "<f8", START * 1e-3 + SWEEP * 1e6),
        ("time", "<f4", SWEEP * 10.0),  # the part of the sweep that has passed
    ],
)
def test_cloud_times_of_each_driver_are_seconds_from_the_header(tmp_path: Path, field: str, kind: str, values: Any) -> None:
    rows = [(*row, value) for row, value in zip(ROWS, values, strict=True)]
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(rows, [(field, kind)]))], "/points")
    np.testing.assert_allclose(scan.offsets, SWEEP, atol=1e-3 if kind == "<u2" else 2e-6)


@pytest.mark.parametrize(("kind", "unit_deg"), [("<u2", 0.01), ("<u2", 0.1), ("<f4", 1.0), ("<f8", math.degrees(1.0))])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_cloud_times_that_are_azimuths_are_parts_of_a_turn(tmp_path: Path, kind: str, unit_deg: float, way: float) -> None:
    """As drivers that pass on the angle of the encoder, from an origin of their own, of either sense."""
    part = np.linspace(0.0, 0.99, 100)
    azimuth = 0.7 + way * math.tau * part
    rows = [(3.0 * math.cos(a), 3.0 * math.sin(a), 0.1, 360.0 / unit_deg * u) for a, u in zip(azimuth, part, strict=True)]
    clouds = [bags.cloud(START + i * S // 10, table(rows, [("t", kind)])) for i in range(4)]
    scans, _ = scans_of(tmp_path, clouds, "/points")
    np.testing.assert_allclose(scans[0].offsets, 0.1 * part, atol=1e-4)


@pytest.mark.parametrize("hz", [4, 10, 20, 100])
@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("part", [1.0, 0.1, 0.01])
def test_cloud_times_units_follow_the_scan_period(tmp_path: Path, hz: int, unit: float, part: float) -> None:
    """Also of scans that fill a part of the turn."""
    seconds = [np.array([0.0, 0.5, 1.0]) / hz * share for share in (1.0, part, part, 0.5)]
    rows = [[(*row, value * unit) for row, value in zip(ROWS, times, strict=True)] for times in seconds]
    clouds = [bags.cloud(START + i * S // hz, table(rows[i], [("time", "<f8")])) for i in range(4)]
    for scan, times in zip(log_of(tmp_path, "/points", clouds, period=S // hz).events(), seconds, strict=True):
        np.testing.assert_allclose(scan.offsets, times, rtol=1e-9)


@pytest.mark.parametrize(("kind", "unit_s", "first"), [("<u2", 1e-6, 50_000), ("<i2", 1e-6, 0), ("<u4", 1e-9, 2**32 - 40_000_000)])
@pytest.mark.parametrize("shape", [(1, 200), (3, 200)])
def test_cloud_times_of_a_counter_that_wraps_go_on(tmp_path: Path, kind: str, unit_s: float, first: int, shape: tuple[int, int]) -> None:
    """65 ms of microseconds in 16 bits, or 4.3 s of nanoseconds in 32, within a sweep of 0.1 s."""
    part = np.linspace(0.0, 0.099, shape[1])
    cells = np.zeros(shape, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", kind)])
    cells["x"], cells["y"] = 2.0, 1.0
    counts = (first + np.round(part / unit_s).astype(np.int64)) % 2 ** (8 * cells["t"].dtype.itemsize)
    cells["t"] = counts.astype(kind.replace("i", "u")).view(kind)
    scans, _ = scans_of(tmp_path, [bags.cloud(START + i * S // 10, cells) for i in range(4)], "/points")
    wanted = np.tile(part, shape[0])
    np.testing.assert_allclose(scans[0].offsets - scans[0].offsets.min(), wanted, atol=2e-6)


def test_cloud_times_of_a_clock_of_its_own_near_zero_are_from_the_header(tmp_path: Path) -> None:
    """Nanoseconds of 32 bits: for half a second of 4.3 they are as small as times after the header."""
    clouds = []
    for i in range(45):
        counts = (round(4.25 * S) + i * S // 10 + np.array([0, 30_000_000, 90_000_000])) % 2**32
        clouds.append(bags.cloud(START + i * S // 10, table([(*row, t) for row, t in zip(ROWS, counts, strict=True)], [("t", "<u4")])))
    scans, _ = scans_of(tmp_path, clouds, "/points")
    assert len(scans) == 45
    for scan in scans:
        np.testing.assert_allclose(scan.offsets, [0.0, 0.03, 0.09], atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 0.05, START * 1e-9])
def test_cloud_times_all_equal_are_no_times(tmp_path: Path, value: float) -> None:
    rows = [(*row, value) for row in ROWS]
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(rows, [("time", "<f8")]))], "/points")
    assert scan.points.shape == (3, 3)
    assert scan.offsets.shape == (0,)


def test_cloud_times_before_the_header_are_negative(tmp_path: Path) -> None:
    """Velodyne's stamp is that of the last point in some drivers."""
    rows = [(*row, value) for row, value in zip(ROWS, SWEEP - 0.1, strict=True)]
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(rows, [("time", "<f4")]))], "/points")
    np.testing.assert_allclose(scan.offsets, SWEEP - 0.1, atol=1e-7)


def test_cloud_times_all_nan_are_no_times(tmp_path: Path) -> None:
    rows = [(*row, np.nan) for row in ROWS]
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table(rows, [("time", "<f4")]))], "/points")
    assert scan.points.shape == (3, 3)
    assert scan.offsets.shape == (0,)


@pytest.mark.parametrize(("kind", "last"), [("<f4", 1e30), ("<f8", -1e300), ("<u4", 4e9), ("<i4", -2e9)])
def test_cloud_times_longer_than_one_scan_are_malformed(tmp_path: Path, kind: str, last: float) -> None:
    rows = [(*row, value) for row, value in zip(ROWS, (0.0, 3.0, last), strict=True)]
    scans, log = scans_of(tmp_path, [bags.cloud(START, table(rows, [("t", kind)]))], "/points")
    assert scans == []
    assert [found.statement for found in log.warnings()] == ["/points: 1 message dropped (fields that contradict each other)."]


def _broken_clouds() -> dict[str, Any]:
    def changed(**fields: Any) -> Any:
        return dataclasses.replace(bags.cloud(START, table(ROWS)), **fields)

    whole = bags.cloud(START, table(ROWS))
    return {
        "no z": changed(fields=whole.fields[:2]),
        "short data": changed(data=whole.data[:-1]),
        "field beyond the point": changed(fields=[*whole.fields[:2], dataclasses.replace(whole.fields[2], offset=10)]),
        "unknown number type": changed(fields=[*whole.fields[:2], dataclasses.replace(whole.fields[2], datatype=99)]),
        "no step": changed(point_step=0),
        "huge": changed(width=2**31, height=2**31),
    }


@pytest.mark.parametrize("name", _broken_clouds())
def test_cloud_inconsistent_sizes_are_dropped_and_counted(tmp_path: Path, name: str) -> None:
    scans, log = scans_of(tmp_path, [_broken_clouds()[name]], "/points")
    assert scans == []
    assert [found.statement for found in log.warnings()] == ["/points: 1 message dropped (fields that contradict each other)."]


def test_cloud_without_points_is_a_scan(tmp_path: Path) -> None:
    (scan,), _ = scans_of(tmp_path, [bags.cloud(START, table([]))], "/points")
    assert scan.points.shape == (0, 3)


# IMU and centre of gravity


def test_samples_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    messages = [
        bags.imu(START),
        bags.imu(START + 1000, (np.nan, 0, 0)),
        bags.imu(START + 2000, force=(0, np.inf, 0)),
        bags.imu(START + 3000),
    ]
    log = log_of(tmp_path, "/imu/data", messages)
    assert [e.stamp_ns - START for e in log.events() if isinstance(e, ImuSample)] == [0, 3000]
    assert [found.statement for found in log.warnings()] == ["/imu/data: 2 messages dropped (NaN or inf)."]
    (tmp_path / "cg").mkdir()
    log = log_of(tmp_path / "cg", "/center_of_gravity", [bags.point_stamped(START, np.nan, 0.0), bags.point_stamped(START + S, 0.1, 0.2)])
    assert len(list(log.events())) == 1


def test_samples_beyond_sensor_range_are_dropped_and_counted(tmp_path: Path) -> None:
    messages = [
        bags.imu(START, (0.0, 0.0, 34.0), (0.0, 0.0, 9810.0)),
        bags.imu(START + 1000, (0.0, 0.0, -36.0)),
        bags.imu(START + 2000, (1e160, 0.0, 0.0)),
        bags.imu(START + 3000, force=(0.0, 2e5, 0.0)),
        bags.imu(START + 4000),
    ]
    log = log_of(tmp_path, "/imu/data", messages)
    assert [e.stamp_ns - START for e in log.events() if isinstance(e, ImuSample)] == [0, 4000]
    assert [found.statement for found in log.warnings()] == ["/imu/data: 3 messages dropped (beyond what such a sensor can measure)."]


def test_bytes_of_another_type_are_dropped_and_counted(tmp_path: Path) -> None:
    definition = bags.STORE.generate_msgdef("sensor_msgs/msg/Imu", ros_version=2)[0]
    messages = [
        bags.Unknown("sensor_msgs/msg/Imu", definition, data) for data in (b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00" + bytes(40))
    ]
    log = log_of(tmp_path, "/imu/data", messages)
    assert list(log.events()) == []
    assert [found.statement for found in log.warnings()] == ["/imu/data: 3 messages dropped (bytes that are not of the type)."]


# Joint states


def test_joint_state_missing_positions_or_velocities_are_nan(tmp_path: Path) -> None:
    messages = [
        bags.joint_state(START, velocity=[1, 2, 3, 4]),
        bags.joint_state(START + S, position=[0.1, 0.2, 0.3, 0.4]),
        bags.joint_state(START + 2 * S),
        bags.joint_state(START + 3 * S, velocity=[1, np.nan, 3, 4], position=[0.5, 0.6, 0.7, 0.8]),
    ]
    log = log_of(tmp_path, "/joint_states", messages, S)
    wheels = wheels_of(log)
    np.testing.assert_array_equal([w.velocity for w in wheels], [(2, 3), (np.nan, np.nan), (2, np.nan)])
    np.testing.assert_allclose([w.position for w in wheels], [(np.nan, np.nan), (0.2, 0.3), (0.6, 0.7)])
    assert [found.statement for found in log.warnings()] == ["/joint_states: 1 message dropped (NaN or inf)."]


@pytest.mark.parametrize("wrapped", [lambda a: (a + np.pi) % (2 * np.pi) - np.pi, lambda a: a % (2 * np.pi)])
@pytest.mark.parametrize("with_rates", [True, False])
def test_wheel_angles_that_wrap_are_unwrapped(tmp_path: Path, wrapped: Any, with_rates: bool) -> None:
    """A mean of wrapped angles would be nonsense: the wheels of a side wrap one after the other."""
    rates = np.array([3.0, 4.0, 3.5, 4.5])
    messages = [
        bags.joint_state(START + i * S // 20, position=wrapped(rates * i / 20 + [0, 1, 2, 3]), velocity=1.02 * rates if with_rates else ())
        for i in range(200)
    ]
    log = log_of(tmp_path, "/joint_states", messages, S // 20)
    wheels = wheels_of(log)
    assert log.warnings() == []
    moved = wheels[-1].position - wheels[0].position
    np.testing.assert_allclose(moved, np.array([3.25, 4.25]) * 199 / 20, rtol=1e-9)


def test_wheel_angles_after_encoder_reset_lose_one_increment(tmp_path: Path) -> None:
    messages = []
    for i in range(40):
        angle = 0.2 * i if i < 20 else 0.2 * (i - 20)  # reset to zero at 20, having turned 4 rad
        messages.append(bags.joint_state(START + i * S // 10, position=[angle] * 4, velocity=[2.0] * 4))
    log = log_of(tmp_path, "/joint_states", messages)
    np.testing.assert_allclose([w.position for w in wheels_of(log)], 0.2 * np.arange(40)[:, None] * [1, 1], atol=1e-12)
    assert any("/joint_states: 1 message with a wheel angle" in note for note in log.warnings())


@pytest.mark.parametrize("turns", [1, 2])
def test_wheel_angle_that_jumps_by_more_than_one_turn_is_named(tmp_path: Path, turns: int) -> None:
    """A driver that undoes wraps the wrong way jumps by two; an angle that wraps, by one."""
    angles = 0.05 * np.arange(40)[:, None] + np.where(np.arange(40) < 20, 0.0, turns * math.tau)[:, None]
    messages = [bags.joint_state(START + i * S // 50, position=[*a] * 4) for i, a in enumerate(angles)]
    log = log_of(tmp_path, "/joint_states", messages, S // 50)
    moved = wheels_of(log)[-1].position
    np.testing.assert_allclose(moved, 0.05 * (39 if turns == 1 else 38), atol=1e-9)
    assert any("/joint_states: 1 message with a wheel angle" in note for note in log.warnings()) == (turns > 1)


@pytest.mark.parametrize("value", [0.0, np.nan], ids=["frozen", "NaN"])
def test_wheel_encoder_that_fails_on_the_way_is_left_out(tmp_path: Path, value: float) -> None:
    """Of four, for five of twenty seconds; the wheels of a side turn unlike each other, and where it counts again it begins at zero."""
    i = np.arange(400)
    angle = 0.1 * i[:, None] * [1.0, 1.2, 1.1, 1.3]
    fails, again = (i >= 100) & (i < 200), i >= 200
    angle[:, 0] = np.where(fails, angle[99, 0] if value == 0.0 else value, np.where(again, 0.1 * (i - 200), angle[:, 0]))
    rates = np.where(fails[:, None] & (np.arange(4) == 0), value, 2.0 * np.array([1.0, 1.2, 1.1, 1.3]))
    messages = [bags.joint_state(START + k * S // 20, position=angle[k], velocity=rates[k]) for k in i]
    log = log_of(tmp_path, "/joint_states", messages, S // 20)
    wheels = wheels_of(log)
    left = np.diff([sample.position[0] for sample in wheels])
    lost = round(0.5 / 0.11)
    np.testing.assert_allclose(left[:98], 0.105)
    np.testing.assert_allclose(left[100 + lost + 1 : 199], 0.11)
    np.testing.assert_allclose(left[201:], 0.105)
    assert left[98:201].sum() == pytest.approx(0.11 * 103, abs=0.02)  # what was lost until it was found is made good
    assert wheels[150].velocity[0] == pytest.approx(2.2)
    assert any("joint 'front_left_wheel'" in note and "left out" in note for note in log.warnings())


WILD = "/joint_states: 4 messages with rates that wheels cannot reach; these were left out."


def test_wheel_rates_beyond_any_wheel_are_dropped_and_reported(tmp_path: Path) -> None:
    """Angles are used where the message has them; without, it is dropped."""
    position, velocity = 0.1 * np.arange(30)[:, None] * [1, 1, 1, 1], np.ones((30, 4))
    for i, wild in ((5, 1e300), (10, -1e5), (15, 80.0), (20, np.inf)):
        velocity[i, 2] = wild
    both = [bags.joint_state(START + i * S // 10, position=position[i], velocity=velocity[i]) for i in range(30)]
    log = log_of(tmp_path, "/joint_states", both)
    wheels = wheels_of(log)
    assert len(wheels) == 30
    np.testing.assert_allclose([w.position for w in wheels], position[:, :2])
    rates = np.ones((30, 2))
    rates[[5, 10, 15, 20], 0] = np.nan
    np.testing.assert_array_equal([w.velocity for w in wheels], rates)
    assert [found.statement for found in log.warnings()] == [WILD]

    (tmp_path / "rates").mkdir()
    velocity[20, 2] = 90.0  # of inf alone nothing is decoded
    alone = [bags.joint_state(START + i * S // 10, position=[np.nan] * 4 if i % 2 else (), velocity=velocity[i]) for i in range(30)]
    log = log_of(tmp_path / "rates", "/joint_states", alone)
    wheels = wheels_of(log)
    assert [(w.stamp_ns - START) * 10 // S for w in wheels] == [i for i in range(30) if i not in (5, 10, 15, 20)]
    np.testing.assert_array_equal([w.velocity for w in wheels], np.ones((26, 2)))
    assert [found.statement for found in log.warnings()] == [WILD]


# Odometry


def drive(rates: Any, dt: float, driver: Driver) -> Any:
    """(n + 1, 3) poses and (n, 2) vx, wz of a diff-drive driver whose wheels turn at ``rates`` (n, 2); the exact integral."""
    half_track = driver.wheel_separation_multiplier * driver.track_width_m / 2
    v = driver.wheel_radius_m * (rates[:, 0] + rates[:, 1]) / 2
    w = driver.wheel_radius_m * (rates[:, 1] - rates[:, 0]) / (2 * half_track)
    poses = [np.array([0.3, -0.2, 2.9])]
    for k in range(len(rates)):
        poses.append(se2.compose(poses[-1], se2.exp([v[k] * dt, 0.0, w[k] * dt])))
    return np.array(poses), np.stack([v, w], axis=1)


def odometry_log(tmp_path: Path, poses: Any, twists: Any, dt: float = 0.1, keep: Any = slice(None)) -> Log:
    step = int(dt * S)
    twists = np.concatenate([twists[:1], twists])  # the twist of a message is that of the interval that it ends
    messages = [
        (i, bags.odometry(START + i * step, *pose, vx=twist[0], wz=twist[1]))
        for i, (pose, twist) in enumerate(zip(poses, twists, strict=True))
    ]
    records = [("/odom", message, START + i * step) for i, message in messages]
    return open_log(bags.write_mcap(tmp_path / "run.mcap", records[keep]), ROBOT)


RNG_RATES = 1.0 + np.cumsum(np.random.default_rng(3).uniform(-1.0, 1.0, (60, 2)), axis=0)  # within what a robot can accelerate


def test_odometry_is_converted_to_wheel_rates(tmp_path: Path) -> None:
    poses, twists = drive(RNG_RATES, 0.1, ROBOT.driver)
    wheels = wheels_of(odometry_log(tmp_path, poses, twists))
    np.testing.assert_allclose([w.velocity for w in wheels[1:]], RNG_RATES, atol=1e-9)
    np.testing.assert_allclose(np.diff([w.position for w in wheels], axis=0), RNG_RATES * 0.1, atol=1e-9)


def test_odometry_after_lost_messages_keeps_the_distance(tmp_path: Path) -> None:
    """On a constant arc, two messages give the motion of sixty."""
    rates = np.tile([2.0, 3.0], (60, 1))
    poses, twists = drive(rates, 0.1, ROBOT.driver)
    wheels = wheels_of(odometry_log(tmp_path, poses, twists, keep=slice(None, None, 20)))
    assert len(wheels) == 4
    np.testing.assert_allclose(wheels[-1].position, [12.0, 18.0], rtol=1e-9)


def test_odometry_without_twist_uses_its_poses(tmp_path: Path) -> None:
    poses, twists = drive(RNG_RATES, 0.1, ROBOT.driver)
    log = odometry_log(tmp_path, poses, 0.0 * twists)
    wheels = wheels_of(log)
    np.testing.assert_allclose([w.velocity for w in wheels[1:]], RNG_RATES, atol=1e-9)
    np.testing.assert_allclose(np.diff([w.position for w in wheels], axis=0), RNG_RATES * 0.1, atol=1e-9)
    assert any("60 messages with a moving pose but no rates" in note for note in log.warnings())


def test_odometry_without_pose_uses_its_twists(tmp_path: Path) -> None:
    poses, twists = drive(RNG_RATES, 0.1, ROBOT.driver)
    log = odometry_log(tmp_path, 0.0 * poses, twists)
    np.testing.assert_allclose(np.diff([w.position for w in wheels_of(log)], axis=0), RNG_RATES * 0.1, atol=1e-9)
    assert any("pose that never moves" in note for note in log.warnings())


def test_odometry_whose_twist_jitters_at_rest_has_a_pose(tmp_path: Path) -> None:
    """The sum of its yaw rates is a random walk: beyond 0.1 rad within seconds, which is no turn."""
    rng = np.random.default_rng(5)
    twists = np.column_stack([np.zeros(300), rng.normal(0.0, 0.5, 300)])
    log = odometry_log(tmp_path, np.zeros((301, 3)), twists, dt=0.02)
    list(log.events())
    assert np.abs(np.cumsum(twists[:, 1]) / 50.0).max() > 0.15
    assert log.warnings() == []


def test_odometry_reset_loses_one_increment(tmp_path: Path) -> None:
    rates = np.tile([4.0, 5.0], (60, 1))
    poses, twists = drive(rates, 0.1, ROBOT.driver)
    poses[30:] = se2.compose(se2.inverse(poses[30]), poses[30:])  # back to the origin, 2 m away, where it goes on
    log = odometry_log(tmp_path, poses, twists)
    np.testing.assert_allclose(np.diff([w.position for w in wheels_of(log)], axis=0), rates * 0.1, atol=1e-9)
    assert any("/odom: 1 message with a pose that wheels cannot reach" in note for note in log.warnings())


@pytest.mark.parametrize("wild", [(1e5, 0.0), (0.0, -1e300), (6.0, 11.0)])
def test_odometry_twists_beyond_any_wheel_are_dropped_and_reported(tmp_path: Path, wild: Any) -> None:
    """The pose gives the motion; where it is NaN or never moves, the message is dropped, and the next one covers its time."""
    rates = np.tile([4.0, 5.0], (60, 1))
    poses, twists = drive(rates, 0.1, ROBOT.driver)
    twists[[9, 29]] = wild  # of the messages 10 and 30
    log = odometry_log(tmp_path, poses, twists)
    wheels = wheels_of(log)
    np.testing.assert_allclose(np.diff([w.position for w in wheels], axis=0), rates * 0.1, atol=1e-9)
    np.testing.assert_array_equal(np.isnan([w.velocity for w in wheels]).any(axis=1), [i in (10, 30) for i in range(61)])
    assert [found.statement for found in log.warnings()] == ["/odom: 2 messages with rates that wheels cannot reach; these were left out."]

    for name, spoiled in (("still", 0.0 * poses), ("nan", np.where(np.arange(61)[:, None] % 20 == 10, np.nan, poses))):
        (tmp_path / name).mkdir()
        wheels = wheels_of(odometry_log(tmp_path / name, spoiled, twists))
        assert len(wheels) == 59
        np.testing.assert_allclose(wheels[-1].position - wheels[0].position, [24.0, 30.0], rtol=1e-9)


def test_odometry_reset_without_twist_is_no_motion(tmp_path: Path) -> None:
    poses = np.zeros((20, 3))
    poses[:, 0] = 0.05 * np.arange(20)
    poses[10:, 1] += 40.0
    wheels = wheels_of(odometry_log(tmp_path, poses, np.zeros((19, 2))))
    increments = np.diff([w.position for w in wheels], axis=0) * ROBOT.driver.wheel_radius_m
    expected = np.full((19, 2), 0.05)
    expected[9] = 0.0
    np.testing.assert_allclose(increments, expected, atol=1e-9)


def test_odometry_standing_still_is_no_motion_without_warning(tmp_path: Path) -> None:
    log = odometry_log(tmp_path, np.tile([5.0, 6.0, 1.0], (20, 1)), np.zeros((19, 2)))
    wheels = wheels_of(log)
    assert all((w.position == 0.0).all() and (w.velocity == 0.0).all() for w in wheels)
    assert log.warnings() == []


def test_odometry_nan_poses_are_replaced_by_the_twist(tmp_path: Path) -> None:
    rates = np.tile([2.0, 3.0], (20, 1))
    poses, twists = drive(rates, 0.1, ROBOT.driver)
    poses[7] = np.nan
    wheels = wheels_of(odometry_log(tmp_path, poses, twists))
    np.testing.assert_allclose(wheels[-1].position, [4.0, 6.0], rtol=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.9, 0.9)), min_size=1, max_size=20),
    st.floats(-3.0, 3.0),
)
def test_odometry_arcs_are_converted_exactly(steps: list[tuple[float, float]], heading: float) -> None:
    """An arc's signed length and angle come back from its end points, forwards and backwards, through any heading."""
    from localization.logs.event_decoder import arc

    pose = np.array([1.0, 2.0, heading])
    for length, turn in steps:
        following = se2.compose(pose, se2.exp([length, 0.0, turn]))
        found_length, found_turn = arc(pose, following)
        assert found_length == pytest.approx(length, abs=1e-9)
        assert found_turn == pytest.approx(turn, abs=1e-9)
        pose = following


@pytest.mark.extended
def test_husky_wheel_rates_reproduce_its_odometry() -> None:
    """Real log: the recovered wheels, integrated by the driver's geometry, give back the pose that the driver published."""
    robot = load_robot("husky_a200")
    path = Path(__file__).parents[1] / "data" / "husky-outdoor-gps" / "test1.bag"
    log = open_log(path, robot)
    wheels = wheels_of(log)
    published = list(log.references("/husky_velocity_controller/odom"))
    assert len(wheels) == len(published) == 3952
    q = np.array([w.position for w in wheels])
    step = np.diff(q, axis=0)
    half_track = robot.driver.wheel_separation_multiplier * robot.driver.track_width_m / 2
    forward = robot.driver.wheel_radius_m * step.mean(axis=1)
    turn = robot.driver.wheel_radius_m * (step[:, 1] - step[:, 0]) / (2 * half_track)
    pose = np.array([*published[0].position, published[0].yaw])
    for k in range(len(step)):
        pose = se2.compose(pose, se2.exp([forward[k], 0.0, turn[k]]))
    np.testing.assert_allclose(pose[:2], published[-1].position, atol=1e-3)
    assert np.abs(forward).sum() == pytest.approx(358.8, abs=0.05)
    assert log.warnings() == []


def test_events_arrays_are_not_shared_with_the_reader(tmp_path: Path) -> None:
    """Readings on their way to wheel samples never come out."""
    poses, twists = drive(RNG_RATES, 0.1, ROBOT.driver)
    events: list[Event] = list(odometry_log(tmp_path, poses, twists).events())
    assert {type(event) for event in events} == {WheelSample}


def test_message_type_defined_differently_is_dropped_and_counted(tmp_path: Path) -> None:
    """The bytes are those of the log's definition, but have no field of an IMU."""
    definition = "std_msgs/Header header\nfloat64 temperature\n" + "=" * 80 + "\n"
    definition += "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\n"
    definition += "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, "sensor_msgs/msg/Imu"))
    types = store.types
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=START // S, nanosec=0), frame_id="imu_link")
    data = bytes(store.serialize_cdr(types["sensor_msgs/msg/Imu"](header=header, temperature=20.0), "sensor_msgs/msg/Imu"))
    log = log_of(tmp_path, "/imu/data", [bags.Unknown("sensor_msgs/msg/Imu", definition, data)] * 3)
    assert list(log.events()) == []
    assert [found.statement for found in log.warnings()] == ["/imu/data: 3 messages dropped (bytes that are not of the type)."]


def test_topic_with_two_types_and_two_publishers_is_decoded(tmp_path: Path) -> None:
    """The more frequent type is the topic's; its publishers are one."""
    records: list[Any] = [("/scan", bags.laser_scan(START + i * S // 10), START + i * S // 10) for i in range(10)]
    records.insert(5, ("/scan", bags.imu(START + S // 2), START + S // 2))
    log = open_log(bags.write_ros1_bag(tmp_path / "run.bag", records), ROBOT)
    assert len(list(log.events())) == 10
    assert [(t.topic, t.type, t.count) for t in inspect_log(log).topics] == [
        ("/scan", "sensor_msgs/LaserScan", 10),
        ("/scan", "sensor_msgs/Imu", 1),
    ]
    writer = rosbag1.Writer(tmp_path / "two.bag")
    with writer:
        connections = [
            writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=bags.STORE_ROS1, callerid=name) for name in ("/a", "/b")
        ]
        for i in range(10):
            data = bags.STORE.cdr_to_ros1(bags.STORE.serialize_cdr(records[0][1], "sensor_msgs/msg/LaserScan"), "sensor_msgs/msg/LaserScan")
            writer.write(connections[i % 2], START + i * S // 10, data)
    assert [(t.topic, t.count) for t in inspect_log(open_log(tmp_path / "two.bag", ROBOT)).topics] == [("/scan", 10)]
