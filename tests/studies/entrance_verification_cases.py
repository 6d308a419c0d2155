"""Inputs for `entrance_commands verification`: kinds that the tenth set showed to be wrong, on other robots and with other amounts, and new
ones beside. Answers were written down after the tenth set was mended, and before the one run that is scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from localization.trajectory import Trajectory
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import with_times
from tests.studies.entrance_base_logs import based, referred
from tests.studies.entrance_command_cases import both, changed, q, shifted
from tests.studies.entrance_commands import Case
from tests.studies.entrance_edits import RPM, driver_odometry, joints, odometry_in, rotated, table
from tests.studies.entrance_field_cases import (
    A300_LOADED,
    BURGER_WET,
    JACKAL_WET,
    KITCHEN,
    LEO_LOADED,
    LFS,
    MINI_WET,
    P3DX_LOADED,
    PASSAGE,
    PRO_WET,
    ROSBOT_WET,
    RUN,
    WARTHOG_LOADED,
    XL_LOADED,
    clockwise_gyro,
    double,
    geographic,
    of_another_computer,
    of_nmea,
    played,
    quiet,
    readable,
    refused,
    rotation_of,
    without_turns,
)
from tests.studies.entrance_forum_cases import CLEARPATH_IMU, stored
from tests.studies.entrance_hostile_cases import each


def decimal_minutes(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """Whole degrees, and minutes with decimals."""
    row: list[float] = [t]
    for angle in geographic(x, y):
        row += [int(angle), 60.0 * (angle % 1.0)]
    return tuple(row)


def rounded(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """TUM, to centimetres."""
    return t, round(x, 2), round(y, 2), 0.0, *q(a)


def lost(every_s: float, for_s: float) -> Callable[[Trajectory], str]:
    """A tracker that repeats its last pose for a part of the time."""

    def content(track: Trajectory) -> str:
        poses, held = track.poses.copy(), 0
        for i, ns in enumerate(track.stamps_ns):
            held = held if (ns - START) / S % every_s > every_s - for_s else i
            poses[i] = track.poses[held]
        return table(Trajectory(track.stamps_ns, poses), lambda t, x, y, a: (t, x, y, 0.0, *q(a)), every=1)

    return content


def cut_database(path: Path, records: list[Record]) -> Path:
    """A .db3 file whose last pages are missing."""
    folder = bags.write_ros2_bag(path, records, "sqlite3")
    (file,) = folder.glob("*.db3")
    with file.open("r+b") as opened:
        opened.truncate(int(0.96 * file.stat().st_size) // 4096 * 4096)
    return folder


VERIFICATION: tuple[Case, ...] = (
    based("clocks", "scans of another computer, 3.1 s behind", JACKAL_WET, of_another_computer("/scan", -3.1), ["/scan"]),
    quiet("clocks", "played at 1.7 of its rate and recorded anew", LEO_LOADED, played(1.7)),
    based(
        "clocks",
        "IMU's nanoseconds since 1970 cut to 32 bits, warthog",
        WARTHOG_LOADED,
        changed(CLEARPATH_IMU, lambda m: with_times(m, lambda ns: ns // S * S + ns % 2**32)),
        ["the gyro", CLEARPATH_IMU],
    ),
    double(
        "wheels",
        "gyro clockwise, LiDAR backwards, four wheels",
        ROSBOT_WET,
        both(each("/imu_broadcaster/imu", clockwise_gyro), rotated(math.pi)),
        ["rate_unit_rad_s"],
        ["180 deg"],
    ),
    double(
        "wheels",
        "rpm, LiDAR at 60 deg",
        MINI_WET,
        both(joints(lambda a, r: ([], RPM * r)), rotated(math.radians(60.0))),
        ["revolutions"],
        ["60 deg", "yaw of"],
    ),
    double(
        "wheels",
        "driver's odometry in centimetres, LiDAR at 120 deg, real",
        PASSAGE,
        both(odometry_in(100.0), rotated(math.radians(120.0))),
        ["length_unit", "centimetres"],
        ["120 deg", "yaw of"],
    ),
    based(
        "wheels",
        "driver's odometry without turns, gyro and LiDAR",
        PRO_WET,
        both(driver_odometry(0.122, 0.36), changed("/skid_steer_controller/odom", without_turns())),
        ["never turns"],
    ),
    based("mounts", "quaternion of four zeros, two wheels", P3DX_LOADED, rotation_of(0.0, 0.0, 0.0, 0.0), ["quaternion"]),
    quiet("mounts", "quaternion of the other sign", ROSBOT_WET, rotation_of(0.0, 0.0, 0.0, -1.0)),
    based("topics", "database without its last pages", BURGER_WET, stored(cut_database)),
    readable(
        "degrees and decimal minutes",
        A300_LOADED,
        lambda r: table(r, decimal_minutes, "Time,Latitude_deg,Latitude_min,Longitude_deg,Longitude_min", ","),
        "csv",
        ["lat"],
        noise_m=0.05,
    ),
    referred("poses that stand for 3 s of 20", XL_LOADED, lost(20.0, 3.0), noise_m=0.05),
    referred(
        "rounded to centimetres, with rests", MINI_WET, lambda r: table(r, lambda t, x, y, a: (t, round(x, 2), round(y, 2), 0.0, *q(a)))
    ),
    referred(
        "table whose last row is cut, real",
        KITCHEN,
        lambda r: table(r, lambda t, x, y, a: (t, x, y, a), "time,x,y,yaw", ",", 1)[:-24],
        "csv",
    ),
    referred(
        "ddmm.mmmm in GPS time",
        WARTHOG_LOADED,
        lambda r: table(r, lambda t, x, y, a: (t + 18.0, *of_nmea(t, x, y, a)[1:]), "time,latitude,longitude", ","),
        "csv",
        ["18"],
    ),
    based(
        "clocks",
        "IMU 37 s ahead, LiDAR 18 s ahead",
        XL_LOADED,
        both(shifted(("/imu_broadcaster/imu",), lambda t: 37.0), shifted(("/scan",), lambda t: 18.0)),
        ["/scan", "/imu_broadcaster/imu"],
    ),
    refused(
        "a pointer of Git LFS as the reference",
        ["Git LFS"],
        lambda folder, log, robot: ["replay", str(log), *RUN, "--robot", str(robot), "--reference", str(_pointer(folder / "truth.tum"))],
    ),
)


def _pointer(path: Path) -> Path:
    path.write_text(LFS)
    return path
