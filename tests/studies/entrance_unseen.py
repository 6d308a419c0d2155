"""A third set of variants of `tests.studies.entrances`, made after the checks were done: nothing was developed with them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

from tests.helpers.bags import START, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, drive
from tests.studies.entrances import (
    Variant,
    clocked,
    counted,
    cylinder,
    described,
    link,
    mounted,
    pointed,
    referenced,
    reordered,
    scaled,
    tum,
    urdf_of,
    wired,
)

SCOUT = Vehicle(0.165, 0.58, 0.5, 0.62, 0.7, 0.7, wheels_hz=50.0, imu_hz=100.0, room=(20.0, 16.0), seed=51)
ROVER = Vehicle(0.06, 0.3, 0.24, 0.5, 0.3, 0.9, wheels_hz=15.0, imu_hz=30.0, scan_hz=7.0, beams=180, room=(9.0, 8.0), seed=52)
DEAF = replace(ROVER, imu_hz=0.0, seed=53)
MOWER = replace(Vehicle(0.2, 0.5, 0.4, 1.0, 0.6, 0.6, room=(22.0, 18.0), seed=54), left=("wheel_left_joint",), right=("wheel_right_joint",))
SLASHED = replace(SCOUT, left=("r1/fl_wheel", "r1/rl_wheel"), right=("r1/fr_wheel", "r1/rr_wheel"), seed=55)
TURRET = link("turret") + (
    '<joint name="turret_joint" type="continuous"><parent link="base_link"/><child link="turret"/><origin xyz="0 0 0.4"/>'
    '<axis xyz="0 0 1"/></joint>'
)
INCH = 39.37
SPHERE = f'<collision><geometry><sphere radius="{SCOUT.radius}"/></geometry></collision>'
GRAVITY = ["gravity", "upside", "mount", "axis"]


Row = Callable[[float, float, float, float], tuple[float | int, ...]]


def rows(motion: Motion, header: str, row: Row, mark: str = ",") -> str:
    """The truth at 10 Hz as a table of the columns that ``row`` makes of seconds since 1970, x, y and heading."""
    found = [row(START / S + t, *pose) for t, pose in zip(motion.t[::10], motion.poses[::10], strict=True)]
    lines = [mark.join(str(v) if isinstance(v, int) else f"{v:.7f}" for v in values) for values in found]
    return "\n".join([header, *lines] if header else lines) + "\n"


def x_inverted(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """TUM columns with x to the other side."""
    return t, -x, y, 0.0, 0.0, 0.0, math.sin((math.pi - a) / 2), math.cos((math.pi - a) / 2)


def y_up(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """TUM columns of the axes x ahead, y up, z to the right."""
    return t, x, 0.3, -y, 0.0, math.sin(a / 2), 0.0, math.cos(a / 2)


def compass(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """Positions to the east and north, headings clockwise from the north."""
    return t, x, y, math.remainder(math.pi / 2 - a, math.tau)


def gpx(motion: Motion, metres_per_degree: float = 111_195.0) -> str:
    """The truth at 1 Hz about 47 N, 8 E."""
    points = []
    for t, (x, y, _) in zip(motion.t[::100], motion.poses[::100], strict=True):
        time = datetime.fromtimestamp(START / S + t, UTC).isoformat().replace("+00:00", "Z")
        longitude = 8.0 + x / (metres_per_degree * math.cos(math.radians(47.0)))
        points.append(f'<trkpt lat="{47.0 + y / metres_per_degree:.9f}" lon="{longitude:.9f}"><time>{time}</time></trkpt>')
    return f'<?xml version="1.0"?><gpx version="1.1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'


UNSEEN: tuple[Variant, ...] = (
    wired("positions in degrees, velocities in rpm", SCOUT, Publishing(scaled(57.2958, 9.5493)), ["degrees", "revolutions"]),
    wired("angles of the motor, gear of 30", ROVER, Publishing(scaled(30.0, 30.0)), ["gear"]),
    wired("13 bits that wrap", MOWER, Publishing(counted(4096.0, 13)), ["angle_range", "angle_unit_rad"]),
    wired("odometry that turns the other way, LiDAR", ROVER, Publishing(forms="odometry", odometry_k=-1.0), ["swapped"]),
    wired(
        "left reversed, a topic per side",
        SCOUT,
        Publishing(lambda a, r: (a * [-1, -1, 1, 1], r * [-1, -1, 1, 1]), forms="side"),
        ["joints.reversed"],
    ),
    wired("rpm and the gyro's sign, LiDAR", ROVER, Publishing(scaled(1.0, 9.5493), gyro=-1.0), ["revolutions", "imu.rate_unit_rad_s"]),
    wired("rear wheels swapped, LiDAR alone", DEAF, Publishing(reordered(0, 3, 2, 1)), ["joints.left", "the left wheels are"]),
    wired("IMU upside down, gravity shows it", ROVER, Publishing(tilt=math.pi), GRAVITY),
    wired("joints of a slashed name", SLASHED, Publishing(), [], kind="forms"),
    wired("IMU 2.2 s ahead, LiDAR", ROVER, Publishing(offsets_s={"/imu/data": 2.2}), ["time_offset_s"], kind="clocks"),
    wired("IMU 1.7 s behind, rpm", SCOUT, Publishing(scaled(0.0, 9.5493), offsets_s={"/imu/data": -1.7}), ["time_offset_s"], kind="clocks"),
    clocked("first joint states a year old", MOWER, Publishing(stale={"/joint_states": [3.15e7, 3.14e7]}), "/joint_states", ["dropped"]),
    clocked("wheels since 1970", SCOUT, Publishing(offsets_s={"/joint_states": -START / S + 2.0}), "/joint_states", ["/joint_states"]),
    clocked(
        "latched GPS pose 40 days old", ROVER, Publishing(reference="/gps/pose", stale={"/gps/pose": [3.456e6]}), "/gps/pose", ["dropped"]
    ),
    mounted("LiDAR at -45 deg", ROVER, Publishing(lidar_yaw=math.radians(-45.0)), ["45 deg"]),
    mounted("LiDAR backwards and sides swapped", ROVER, Publishing(reordered(2, 3, 0, 1), lidar_yaw=math.pi), ["180 deg"]),
    referenced("kilometres", SCOUT, lambda m: tum(m, 0.001), ["scale is 0.001"]),
    referenced("x inverted", MOWER, lambda m: rows(m, "", x_inverted, " "), ["mirrored"]),
    referenced("compass headings", SCOUT, lambda m: rows(m, "time,x,y,yaw", compass), ["clockwise"], "csv"),
    referenced("degrees", SCOUT, lambda m: rows(m, "time,x,y,yaw", lambda t, x, y, a: (t, x, y, math.degrees(a))), [], "csv"),
    referenced("milliseconds", ROVER, lambda m: rows(m, "time_ms;x;y;yaw", lambda t, *p: (round(t * 1e3), *p), ";"), [], "csv"),
    referenced("y up", MOWER, lambda m: rows(m, "", y_up, " "), []),
    referenced("GPX", SCOUT, gpx, [], "gpx", noise=0.1),
    referenced("a run of another drive", MOWER, lambda m: tum(drive(replace(MOWER, seed=154))), ["another run"]),
    pointed("microseconds since the start", SCOUT, "t", "u4", lambda u, period, stamp: u * period * 1e6, []),
    pointed("part of the sweep", MOWER, "time", "f4", lambda u, period, stamp: u, []),
    pointed("Autoware's time_stamp", SCOUT, "time_stamp", "u4", lambda u, period, stamp: u * period * 1e9, []),
    pointed("seconds since 1970", ROVER, "timestamp", "f8", lambda u, period, stamp: stamp * 1e-9 + u * period, []),
    pointed("seconds before the end", MOWER, "time", "f4", lambda u, period, stamp: (u - 1.0) * period, []),
    pointed("all equal", SCOUT, "t", "u4", lambda u, period, stamp: 0.0 * u, ["time"]),
    described("slashed names", SLASHED, urdf_of(SLASHED, (*SLASHED.left, *SLASHED.right), children="{}_link")),
    described(
        "inches in the URDF",
        SCOUT,
        urdf_of(
            replace(SCOUT, track=SCOUT.track * INCH, wheelbase=SCOUT.wheelbase * INCH),
            (*SCOUT.left, *SCOUT.right),
            cylinder(SCOUT.radius * INCH),
        ),
        words=["inches"],
    ),
    described(
        "spheres as wheels",
        SCOUT,
        urdf_of(SCOUT, (*SCOUT.left, *SCOUT.right), SPHERE),
    ),
    described(
        "front left on the right side",
        SCOUT,
        urdf_of(SCOUT, (*SCOUT.left, *SCOUT.right)).replace(
            f'xyz="{SCOUT.wheelbase / 2} {SCOUT.track / 2} 0"', f'xyz="{SCOUT.wheelbase / 2} {-SCOUT.track / 2} 0"'
        ),
        words=["front_left_wheel"],
    ),
    described(
        "turret that turns for ever",
        MOWER,
        urdf_of(
            MOWER,
            (*MOWER.left, *MOWER.right),
            more=TURRET,
        ),
    ),
)
