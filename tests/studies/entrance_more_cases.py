"""A second set of inputs as practitioners bring them, made after all others were read right; for `entrance_commands`."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, with_times
from tests.studies.entrance_command_cases import ALL, JACKAL, ROSBOT, SCANS, TURTLE, WARTHOG, both, changed, nmea, nmea_sentence, stamp_of
from tests.studies.entrance_commands import Edit, driven, initialized, scored
from tests.studies.entrance_hostile_cases import IMU_MOUNT, LASER_MOUNT, LEVEL, each, mounted_at
from tests.studies.entrance_unseen import gpx, rows
from tests.studies.entrances import reordered, scaled, signed, tum, urdf_of

# logs


def in_namespace(name: str, frames: bool = True) -> Edit:
    """All topics in a namespace, and all frames and joints with its name before them."""

    def framed(frame: str) -> str:
        return f"{name}/{frame}" if frames and frame else frame

    def edit(records: list[Record]) -> list[Record]:
        found = []
        for topic, m, log in records:
            for part in (m, *getattr(m, "transforms", ())):
                if hasattr(part, "header"):
                    part.header.frame_id = framed(part.header.frame_id)
                if hasattr(part, "child_frame_id"):
                    part.child_frame_id = framed(part.child_frame_id)
            if topic == "/joint_states":
                m = bags.joint_state(stamp_of(m), [f"{name}/{joint}" for joint in m.name], m.position, m.velocity)
            found.append((topic if topic.startswith("/tf") else f"/{name}{topic}", m, log))
        return found

    return edit


def per_wheel(change: Callable[[float, float], tuple[float, float]]) -> Edit:
    """A message for each wheel with ``change`` of its angle and rate, each on a topic of its own."""

    def split(m: Any) -> list[tuple[str, Any]]:
        found = []
        for i, name in enumerate(m.name):
            angle, rate = change(float(m.position[i]), float(m.velocity[i]))
            found.append((f"/{name}/state", bags.joint_state(stamp_of(m), [name], [angle], [rate])))
        return found

    return changed("/joint_states", split)


def second_imu(vehicle: Vehicle, topic: str, sign: float) -> Edit:
    """Another IMU, whose gyro has this sign, and whose frame has no transform."""

    def more(m: Any) -> list[tuple[str, Any]]:
        other = bags.imu(stamp_of(m) + S // 300, (0.0, 0.0, sign * m.angular_velocity.z), (0.0, 0.0, sign * 9.81), "imu2_link")
        return [("/imu/data", m), (topic, other)]

    return changed("/imu/data", more)


def first_odometry(age_s: float) -> Edit:
    """The driver's first odometry is latched, of an earlier session."""

    def edit(records: list[Record]) -> list[Record]:
        first = next(m for t, m, _ in records if t == "/odom")
        old = with_times(deepcopy(first), lambda ns: ns - round(age_s * S))
        old.pose.pose.position.x, old.pose.pose.position.y = 14.0, -3.0
        return [("/odom", old, START + S // 1000), *records]

    return edit


def time_of_day(m: Any) -> Any:
    """Stamps count from midnight."""
    return with_times(m, lambda ns: ns % (86_400 * S))


def odometry_scaled(scale: float) -> Edit:
    """A driver's odometry in another unit of length."""

    def change(m: Any) -> Any:
        m.pose.pose.position.x *= scale
        m.pose.pose.position.y *= scale
        m.twist.twist.linear.x *= scale
        return m

    return changed("/odom", change)


def clockwise(m: Any) -> Any:
    """Headings and turning rates count clockwise, y is to the right."""
    p, twist = m.pose.pose, m.twist.twist
    yaw = 2.0 * math.atan2(p.orientation.z, p.orientation.w)
    return bags.odometry(stamp_of(m), p.position.x, -p.position.y, -yaw, twist.linear.x, -twist.angular.z)


def two_bases(m: Any) -> Any:
    """Sensors hang on base_link, which stands on base_footprint."""
    (first, *_) = m.transforms
    edges = [("base_footprint", "base_link", (0.0, 0.0, 0.1), LEVEL), IMU_MOUNT, LASER_MOUNT]
    return bags.tf(stamp_of(first), edges)


def optical(vehicle: Vehicle) -> Edit:
    """A depth camera's scan frame: its transform has z ahead and x to the right, as optical frames have it."""
    return mounted_at(IMU_MOUNT, ("base_link", "laser", (0.15, 0.0, 0.3), bags.quaternion(-math.pi / 2, 0.0, -math.pi / 2)))


def from_zero_each(m: Any, t: float) -> Any:
    """Angles of one wheel within a turn, 0 to 2 pi, the others continuous."""
    position = m.position.copy()
    position[0] %= math.tau
    return bags.joint_state(stamp_of(m), m.name, position, m.velocity)


def recorder_set(seconds: int) -> Edit:
    """The recorder's clock alone is set forward half way, by NTP."""
    return lambda records: [(t, m, log + (seconds * S if log > START + 20 * S else 0)) for t, m, log in records]


def clocks_set(seconds: int) -> Edit:
    """The robot's only clock is set forward half way."""

    def later(ns: int) -> int:
        return ns + seconds * S if ns > START + 20 * S else ns

    return lambda records: [(t, m if t == "/tf_static" else with_times(m, later), later(log)) for t, m, log in records]


def doubled(topic: str) -> Edit:
    """A second publisher (a simulator's) of joint states of the same wheels, standing."""

    def more(m: Any) -> list[tuple[str, Any]]:
        still = bags.joint_state(stamp_of(m), m.name, np.zeros(len(m.name)), np.zeros(len(m.name)))
        return [("/joint_states", m), (topic, still)]

    return changed("/joint_states", more)


DEGREES = math.degrees(1.0)
LOGS = (
    driven("more", "everything in a namespace, frames too", SCANS, edit=in_namespace("j100_0000")),
    driven("more", "everything in a namespace, no LiDAR", JACKAL, words=["joint"], edit=in_namespace("robot1")),
    driven(
        "more",
        "a topic per wheel in degrees that wrap",
        JACKAL,
        words=["degrees"],
        edit=per_wheel(lambda a, r: (DEGREES * a % 360, DEGREES * r)),
    ),
    driven(
        "more",
        "a topic per wheel, 16 bits of 4096 ticks",
        WARTHOG,
        words=["angle_"],
        edit=per_wheel(lambda a, r: ((round(a * 4096 / math.tau) + 2**15) % 2**16 - 2**15, math.nan)),
    ),
    driven("more", "two IMUs, the second upside down", SCANS, edit=second_imu(SCANS, "/imu2/data", -1.0)),
    driven(
        "more",
        "IMU under another name, upside down",
        JACKAL,
        words=["gravity"],
        edit=both(second_imu(JACKAL, "/vectornav/imu", -1.0), changed("/imu/data", lambda m: None)),
    ),
    driven(
        "more",
        "latched first odometry of another session",
        TURTLE,
        Publishing(forms="odometry"),
        ["dropped", "old"],
        first_odometry(3600.0),
    ),
    driven("more", "wheels' stamps of the time of day", SCANS, words=["/joint_states"], edit=changed("/joint_states", time_of_day)),
    driven(
        "more",
        "driver's odometry in millimetres",
        ROSBOT,
        Publishing(forms="odometry"),
        ["millimetres"],
        odometry_scaled(1000.0),
    ),
    driven(
        "more", "driver's odometry clockwise", SCANS, Publishing(forms="odometry"), ["swapped", "opposite"], changed("/odom", clockwise)
    ),
    driven("more", "mounts below base_footprint", SCANS, edit=changed("/tf_static", two_bases)),
    driven("more", "scan in an optical frame", SCANS, words=["laser"], edit=optical(SCANS)),
    driven("more", "one wheel's angle within a turn", JACKAL, edit=each("/joint_states", from_zero_each)),
    driven("more", "recorder's clock set forward", SCANS, edit=recorder_set(60)),
    driven("more", "all clocks set forward", SCANS, words=["clock was set forward by 3600"], edit=clocks_set(3600)),
    driven("more", "second joint states that stand", SCANS, edit=doubled("/gazebo/joint_states")),
    driven(
        "more", "right reversed, prefix of the joints", JACKAL, Publishing(signed(1, 1, -1, -1)), ["joints.reversed"], in_namespace("w1")
    ),
    driven("more", "rear wheels swapped and rpm", SCANS, Publishing(lambda a, r: (np.zeros(0), 9.5493 * r[[0, 3, 2, 1]])), ["joints.left"]),
    driven("more", "LiDAR backwards, sides swapped", SCANS, Publishing(reordered(2, 3, 0, 1), lidar_yaw=math.pi), ["swapped"]),
    driven("more", "gyro in millidegrees", JACKAL, Publishing(gyro=57295.8), ["gyro", "imu"]),
    driven("more", "positions in turns, velocities in rad/s", WARTHOG, Publishing(scaled(1.0 / math.tau, 1.0)), ["angle_unit_rad"]),
)

# references


def wxyz(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """Quaternions with their scalar first."""
    return t, x, y, 0.1, math.cos(a / 2), 0.0, 0.0, math.sin(a / 2)


def xyzw(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    return t, x, y, 0.1, 0.0, 0.0, math.sin(a / 2), math.cos(a / 2)


def gpx_with_gaps(motion: Motion) -> str:
    """Without fixes for 8 s, and whole seconds alone."""
    text = gpx(motion)
    points = text.split("<trkpt")
    return "<trkpt".join([*points[:15], *points[23:]]) if len(points) > 30 else text


def nmea_of_day(motion: Motion, days: int) -> str:
    """The date of other ``days``; the time of day is right."""
    found = []
    right = datetime.fromtimestamp(START / S, UTC)
    wrong = right + timedelta(days=days)
    for line in nmea(motion).splitlines():
        body = line[1:].split("*")[0].replace(f"{right:%d%m%y}", f"{wrong:%d%m%y}")
        found.append(nmea_sentence(body))
    return "\n".join(found) + "\n"


def motive(motion: Motion) -> str:
    """OptiTrack's export: y up, millimetres, lines of header, seconds from the start of the take."""
    head = [
        "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,100,Export Frame Rate,10,Length Units,Millimeters,Coordinate Space,Global",
        "",
        ",,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body",
        ",,robot,robot,robot,robot,robot,robot,robot",
        ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z",
    ]
    lines = [
        f"{i},{t:.4f},0.0,{math.sin(a / 2):.6f},0.0,{math.cos(a / 2):.6f},{1000 * x:.3f},300.0,{-1000 * y:.3f}"
        for i, (t, (x, y, a)) in enumerate(zip(motion.t[::10], motion.poses[::10], strict=True))
    ]
    return "\n".join([*head, *lines]) + "\n"


def european(motion: Motion) -> str:
    """Semicolons between columns, commas in numbers."""
    return rows(motion, "time;x;y;yaw", lambda t, x, y, a: (t, x, y, a), ";").replace(".", ",")


EUROC_SECONDS = "#timestamp [s],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
TAKE = ["another run", "start of a run", "1000", "none lies within"]
REFERENCES = (
    scored("scalar first, header", JACKAL, lambda m: rows(m, "time,x,y,z,qw,qx,qy,qz", wxyz), "csv"),
    scored("TUM with commas and header", WARTHOG, lambda m: rows(m, "timestamp,tx,ty,tz,qx,qy,qz,qw", xyzw), "csv"),
    scored("EuRoC in seconds", JACKAL, lambda m: rows(m, EUROC_SECONDS, wxyz), "csv"),
    scored("GPX with a gap", WARTHOG, gpx_with_gaps, "gpx", noise=0.1),
    scored("NMEA of another day", WARTHOG, lambda m: nmea_of_day(m, 3), "nmea", ["none lies within"]),
    scored("semicolons and decimal commas", JACKAL, european, "csv"),
    scored("OptiTrack's export", JACKAL, motive, "csv", ["start of a run"]),
    scored("TUM backwards in time", JACKAL, lambda m: "\n".join(tum(m).splitlines()[::-1]) + "\n"),
    scored("TUM, scalar first", JACKAL, lambda m: rows(m, "", wxyz, " ")),
    scored(
        "degrees without a header", JACKAL, lambda m: rows(m, "", lambda t, x, y, a: (t, x, y, math.degrees(a)), " "), "txt", ["no header"]
    ),
)

# descriptions


def prefixed(prefix: str, base: str = "base_link") -> str:
    """A URDF of xacro whose joints and links have a ``prefix``."""
    return urdf_of(JACKAL, [prefix + n for n in ALL], base=base)


DESCRIPTIONS = (
    initialized("prefix of xacro", JACKAL, prefixed("robot1/")),
    initialized("prefix of xacro, base too", JACKAL, prefixed("robot1/", "robot1/base_link")),
    initialized("prefix with an underscore", WARTHOG, urdf_of(WARTHOG, ["w200_0007_" + n for n in ALL])),
    initialized("joints end in _joint", JACKAL, urdf_of(JACKAL, [n + "_joint" for n in ALL])),
    initialized(
        "prefix, names of the other sides",
        JACKAL,
        urdf_of(JACKAL, ["r1/" + n for n in (*JACKAL.right, *JACKAL.left)]),
        words=["left wheels", "by turns"],
    ),
    initialized(
        "one axle of a robot of two",
        JACKAL,
        urdf_of(JACKAL, ("left_wheel", "right_wheel")),
        words=["may be front_left_wheel or"],
        refused=True,
    ),
)
MORE = (*LOGS, *REFERENCES, *DESCRIPTIONS)
