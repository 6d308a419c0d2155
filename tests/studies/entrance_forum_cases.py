"""A seventh set of inputs, for `entrance_commands forum`, after threads about duplicated messages (OpenLORIS-Scene 2, zed-ros-wrapper 670),
wheels of two publishers (yahboom_rosmaster 4, ros_gz_project_template 36), wheels that wrap (topic_based_ros2_control 12) or have no rates
(ubiquity_motor 59), odometry at half its size or with turns too large (turtlebot3 409, scout_ros 5, ranger_ros2 21), MCAP without an
index (rosbag2_storage_mcap 61), messages at 1970 (mcap 1296) and references in other axes (evo 73, 490).

Answers were written down before the first run, which is scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot_file import robot_toml
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import STEP_S, Motion, Publishing, Vehicle, drive, records_of, with_times
from tests.studies.entrance_base_logs import (
    A300,
    BURGER,
    CORRIDOR,
    HALL,
    LEO,
    MEADOW,
    OFFICE,
    ROBOTS,
    BaseLog,
    based,
    real_building,
    real_log,
    referred,
    simulated,
)
from tests.studies.entrance_command_cases import SCANS, both, changed, q, shifted, stamp_of
from tests.studies.entrance_commands import Case, Edit, clouded, errors_of, initialized, replayed, warnings_in
from tests.studies.entrance_edits import NAMES, driver_odometry, joints, rotated, stretched, table
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import Found, choose_outcome, urdf_of

EAST = BaseLog("fr079, 110 to 200 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 110.0, 90.0))
SEMINAR = BaseLog("MIT-CSAIL, 0 to 80 s", OFFICE.robot, real_building("mit-csail", "csail.mcap", 0.0, 80.0))
RING = BaseLog("ACES, 850 to 930 s", HALL.robot, real_log("aces/aces.mcap", 850.0, 80.0))
START_OF_DAY = BaseLog("Husky outdoors, 0 to 100 s", MEADOW.robot, real_log("husky-outdoor-gps/test1.bag", 0.0, 100.0), 0.5)
SCOUT_ARCS = BaseLog("scout_2, arcs", (ROBOTS / "scout_2.toml").read_text(), simulated("scout_2", "preliminary", 121, 0.0, 80.0))
XL_ARCS = BaseLog("rosbot_xl, arcs", (ROBOTS / "rosbot_xl.toml").read_text(), simulated("rosbot_xl", "preliminary", 122, 0.0, 80.0))
JACKAL_ARCS = BaseLog("jackal, arcs", (ROBOTS / "jackal.toml").read_text(), simulated("jackal", "preliminary", 123, 0.0, 80.0))
BURGER_ARCS = BaseLog("turtlebot3_burger, arcs", BURGER.robot, simulated("turtlebot3_burger", "preliminary", 124, 0.0, 80.0))
LEO_LAPS = BaseLog("leo, laps", LEO.robot, simulated("leo", "laps", 125, 0.0, 75.0))
A300_LAPS = BaseLog("husky_a300, laps", A300.robot, simulated("husky_a300", "laps", 126, 0.0, 75.0))
SCOUT_RADIUS, SCOUT_TRACK = 0.16459, 0.58306
CLEARPATH_JOINTS, CLEARPATH_IMU = "/platform/joint_states", "/sensors/imu_0/data"


def arrival_jitter(topic: str, upto_s: float) -> Edit:
    """Stamped when they came in over a serial line."""
    rng = np.random.default_rng(801)
    return changed(topic, lambda m: with_times(m, lambda ns: ns + round(rng.uniform(0.0, upto_s) * S)))


def doubled(*topics: str) -> Edit:
    """Each message twice."""

    def edit(records: list[Record]) -> list[Record]:
        return [r for t, m, log in records for r in ([(t, m, log), (t, m, log + S // 10_000)] if t in topics else [(t, m, log)])]

    return edit


def first_in_1970(records: list[Record]) -> list[Record]:
    """The static transforms were recorded before the clock had been set."""
    return [(t, m, S if t == "/tf_static" else log) for t, m, log in records]


def clock_set_forward(at_s: float, by_s: float) -> Edit:
    """NTP sets the clock of the one computer: all stamps, and times of recording."""

    def edit(records: list[Record]) -> list[Record]:
        jump = round(by_s * S)
        return [
            (t, m, log) if t == "/tf_static" or log < START + at_s * S else (t, with_times(m, lambda ns: ns + jump), log + jump)
            for t, m, log in records
        ]

    return edit


def zeros_between(message: Any) -> list[tuple[str, Any]]:
    """joint_state_publisher beside the broadcaster: the same joints at zero."""
    zeros = bags.joint_state(stamp_of(message) + S // 125, message.name, np.zeros(len(message.name)), [])
    return [("/joint_states", message), ("/joint_states", zeros)]


def half_turns(message: Any, t: float) -> Any:
    """The driver's turns are half as large for a part of the time."""
    if t % 30.0 > 15.0:
        message.twist.twist.angular.z *= 0.5
    return message


def two_publishers(message: Any) -> list[tuple[str, Any]]:
    """A driver's odometry, and one of another child frame from elsewhere, on one topic."""
    p = message.pose.pose.position
    other = bags.odometry(stamp_of(message) + S // 200, p.x + 4.0, p.y - 2.0, 1.0, message.twist.twist.linear.x, 0.0)
    other.child_frame_id = "chassis"
    return [("/odom", message), ("/odom", other)]


WHEEL_STATES = "builtin_interfaces/Time stamp\nfloat64[4] position\nfloat64[4] velocity\nfloat64[4] torque\n"


def to_unknown_type(message: Any) -> list[tuple[str, Any]]:
    """Leo's firmware: states of wheels as a type of its own."""
    stamp = stamp_of(message)
    data = b"\x00\x01\x00\x00" + np.array([stamp // S, stamp % S], "<u4").tobytes()
    data += np.concatenate([message.position, message.velocity, np.zeros(4)]).astype("<f8").tobytes()
    return [("/firmware/wheel_states", bags.Unknown("leo_msgs/msg/WheelStates", WHEEL_STATES, data))]


def on_its_side(message: Any, t: float) -> Any:
    """The IMU is turned by a quarter about its x axis."""
    for v in (message.angular_velocity, message.linear_acceleration):
        v.y, v.z = v.z, -v.y
    return message


def in_g(message: Any, t: float) -> Any:
    a = message.linear_acceleration
    a.x, a.y, a.z = a.x / 9.80665, a.y / 9.80665, a.z / 9.80665
    return message


def with_other_types(records: list[Record]) -> list[Record]:
    """Topics of a TurtleBot 4 beside."""
    more: list[Record] = []
    for i in range(40):
        unknown = bags.Unknown("irobot_create_msgs/msg/WheelTicks", "int32 ticks_left\nint32 ticks_right\n", b"\0\1\0\0" + bytes([i] * 8))
        more.append(("/wheel_ticks", unknown, START + i * S))
        more.append(
            ("/dock_status", bags.Unknown("irobot_create_msgs/msg/DockStatus", "bool is_docked\n", b"\0\1\0\0\0"), START + i * S + 5)
        )
    return [*records, *more]


# files


def stored(write: Callable[[Path, list[Record]], Path]) -> Edit:
    """The healthy log in another form of file."""

    def edit(records: list[Record]) -> list[Record]:
        return list(records)

    edit.write = write  # type: ignore[attr-defined]
    return edit


def in_ros1(path: Path, records: list[Record]) -> Path:
    return bags.write_ros1_bag(path.with_suffix(".bag"), records, "lz4")


def _foxglove(path: Path, records: list[Record], encoding: str, **options: Any) -> Path:
    """As the Python library of MCAP writes it."""
    path = path.with_suffix(".mcap")
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="", library="foxglove-bridge")
        channels: dict[str, int] = {}
        for topic, message, log in records:
            if topic not in channels:
                kind = message.__msgtype__
                text, _ = bags.STORE.generate_msgdef(kind, ros_version=2)
                form = ("jsonschema", b'{"type": "object"}', "json") if encoding == "json" else ("ros2msg", text.encode(), "cdr")
                channels[topic] = writer.register_channel(topic, form[2], writer.register_schema(kind, form[0], form[1]))
            data = b'{"x": 1}' if encoding == "json" else bytes(bags.STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], log, data, log)
        writer.finish()
    return path


def without_index(path: Path, records: list[Record]) -> Path:
    """Neither chunks nor indexes nor statistics."""
    return _foxglove(path, records, "cdr", use_chunking=False, index_types=IndexType.NONE, use_statistics=False, use_summary_offsets=False)


def without_message_index(path: Path, records: list[Record]) -> Path:
    """Chunks of Zstandard with an index of chunks alone."""
    return _foxglove(path, records, "cdr", compression=CompressionType.ZSTD, chunk_size=200_000, index_types=IndexType.CHUNK)


def in_json(path: Path, records: list[Record]) -> Path:
    return _foxglove(path, records, "json")


def split_without_metadata(path: Path, records: list[Record]) -> Path:
    """A folder of two .mcap files whose metadata.yaml was lost."""
    path.mkdir()
    half = len(records) // 2
    bags.write_mcap(path / "rosbag2_0.mcap", records[:half])
    bags.write_mcap(path / "rosbag2_1.mcap", records[half:])
    return path


# mecanum

MECANUM = replace(SCANS, seed=811)


def strafing(vehicle: Vehicle) -> Motion:
    """Its drive, in which it also moves to the side, 0.25 m/s for 6 s and back: front and rear wheels turn against each other."""
    motion = drive(vehicle)
    side = 0.25 * ((motion.t > 8.0) & (motion.t < 14.0)) - 0.25 * ((motion.t > 25.0) & (motion.t < 31.0))
    poses = [np.zeros(3)]
    for (v, w), u in zip(motion.twists[:-1], side, strict=False):
        poses.append(se2.compose(poses[-1], se2.exp(np.array([v, u, w]) * STEP_S)))
    rates = motion.rates + side[:, None] / vehicle.radius * np.array([-1.0, 1.0, 1.0, -1.0])
    return Motion(motion.t, motion.twists, np.array(poses), np.cumsum(rates, axis=0) * STEP_S, rates)


def judge_mecanum(folder: Path) -> Found:
    """Right where the EKF follows the LiDAR, and a sentence names the motion to the side."""
    motion = strafing(MECANUM)
    log = bags.write_mcap(folder / "log.mcap", records_of(MECANUM, motion, Publishing()))
    (folder / "robot.toml").write_text(robot_toml(MECANUM.robot(), {}, ""))
    code, text = replayed(folder, log, folder / "robot.toml")
    warned = warnings_in(text)
    words = ["mecanum", "sideways", "to the side"]
    if code:
        return Found("misnamed", f"[exit {code}] {text}")
    error = errors_of(folder / "out", motion)[1]
    return Found(choose_outcome(error < 0.1, any(w in warned for w in words), bool(warned), words), f"[EKF {error:.3f} m] {warned}")


# references


def kitti_of_camera(track: Trajectory) -> str:
    """Rows of 3 x 4 in the axes of KITTI's cameras: x to the right, y down, z ahead."""
    lines = []
    stamps = np.arange(track.stamps_ns[0], track.stamps_ns[-1], S // 10)
    for x, y, a in track.at(stamps):
        c, s = math.cos(a), math.sin(a)
        rows = [[c, 0.0, -s, -y], [0.0, 1.0, 0.0, 0.0], [s, 0.0, c, x]]
        lines.append(" ".join(f"{v:.6e}" for row in rows for v in row))
    return "\n".join(lines) + "\n"


def nmea(noise_m: float, bad: float) -> Callable[[Trajectory], str]:
    """GGA at 5 Hz, and RMC with the date each second; a share of lines is damaged."""
    rng = np.random.default_rng(815)

    def content(track: Trajectory) -> str:
        lines = []
        for i, ns in enumerate(range(int(track.stamps_ns[0]), int(track.stamps_ns[-1]), S // 5)):
            x, y, _ = track.at(np.array([ns]))[0]
            x, y = x + noise_m * rng.normal(), y + noise_m * rng.normal()
            latitude, longitude = 47.0 + y / 111_195.0, 8.0 + x / (111_195.0 * math.cos(math.radians(47.0)))
            time = datetime.fromtimestamp(ns / S, UTC)
            at = f"{int(latitude):02d}{latitude % 1 * 60:011.8f},N,{int(longitude):03d}{longitude % 1 * 60:011.8f},E"
            clock = f"{time:%H%M%S}.{time.microsecond // 10_000:02d}"
            bodies = [f"GPGGA,{clock},{at},4,12,0.6,400.0,M,47.0,M,,"]
            if i % 5 == 0:
                bodies.append(f"GPRMC,{clock},A,{at},0.5,0.0,{time:%d%m%y},,,R")
            for body in bodies:
                check = 0
                for char in body.encode():
                    check ^= char
                lines.append(f"${body if rng.random() > bad else body.replace('47', '49', 1)}*{check:02X}")
        return "\r\n".join(lines) + "\r\n"

    return content


def phone(track: Trajectory) -> str:
    """GPX of a phone: 1 Hz, errors of 4 m that wander."""
    rng = np.random.default_rng(816)
    error, points = np.zeros(2), []
    for ns in range(int(track.stamps_ns[0]), int(track.stamps_ns[-1]), S):
        error = 0.97 * error + rng.normal(size=2)
        x, y, _ = track.at(np.array([ns]))[0]
        time = datetime.fromtimestamp(ns // S, UTC).isoformat().replace("+00:00", "Z")
        latitude, longitude = 47.0 + (y + error[1]) / 111_195.0, 8.0 + (x + error[0]) / (111_195.0 * math.cos(math.radians(47.0)))
        points.append(f'<trkpt lat="{latitude:.7f}" lon="{longitude:.7f}"><ele>400</ele><time>{time}</time></trkpt>')
    return f'<?xml version="1.0"?><gpx version="1.1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'


def prism(track: Trajectory) -> str:
    """A total station's positions of a prism 0.4 m ahead of the base."""
    return table(track, lambda t, x, y, a: (t, x + 0.4 * math.cos(a), y + 0.4 * math.sin(a)), "time,x,y", ",")


CLOCKS = (
    based("clocks", "wheels stamped on arrival, jitter of 40 ms, real", SEMINAR, arrival_jitter("/joint_states", 0.04)),
    based("clocks", "each message of wheels and scans twice, real", EAST, doubled("/joint_states", "/scan", "/odom")),
    based("clocks", "each IMU message twice", XL_ARCS, doubled("/imu_broadcaster/imu")),
    based("clocks", "transforms recorded in 1970", SCOUT_ARCS, first_in_1970),
    based("clocks", "LiDAR's stamps since it was switched on, real", EAST, shifted(("/scan",), lambda t: -(START / S) + 73.0), ["/scan"]),
    based(
        "clocks",
        "the computer's clock is set forward by 600 s",
        LEO_LAPS,
        clock_set_forward(40.0, 600.0),
        ["clock was set forward"],
    ),
)

WHEELS = (
    based("wheels", "a second publisher with zeros, no rates", SCOUT_ARCS, changed("/joint_states", zeros_between), ["publish"]),
    based(
        "wheels",
        "wraps at +- 2 pi, no rates",
        XL_ARCS,
        joints(lambda a, r: (np.sign(a) * (np.abs(a) % math.tau), [])),  # angles within a turn are usual, and need no word
    ),
    based("wheels", "rates always zero", A300_LAPS, joints(lambda a, r: (a, 0.0 * r), CLEARPATH_JOINTS)),
    based(
        "wheels", "rates in degrees, angles in radians", JACKAL_ARCS, joints(lambda a, r: (a, np.degrees(r)), CLEARPATH_JOINTS), ["degrees"]
    ),
    based(
        "wheels",
        "driver whose turns are halved now and then, real",
        START_OF_DAY,
        each("/husky_velocity_controller/odom", half_turns),  # rates beside a pose that is right are not used
    ),
    based(
        "wheels",
        "driver's ways at half their size, real",
        RING,
        changed("/odom", stretched(0.5)),
        ["times those of the LiDAR", "times the LiDAR's"],
        is_open=True,
    ),
    based(
        "wheels",
        "driver's turns 1.26 times too large",
        SCOUT_ARCS,
        driver_odometry(SCOUT_RADIUS, SCOUT_TRACK / 1.26),
        ["wheel_separation_multiplier", "1.26"],
        is_open=True,
    ),
    based(
        "wheels",
        "two publishers on the driver's topic",
        SCOUT_ARCS,
        both(
            both(driver_odometry(SCOUT_RADIUS, SCOUT_TRACK), changed("/skid_steer_controller/odom", lambda m: [("/odom", m)])),
            changed("/odom", two_publishers),
        ),
        ["publish"],
        is_open=True,
    ),
    based("wheels", "firmware's own type", LEO_LAPS, changed("/joint_states", to_unknown_type), ["/firmware/wheel_states"], refused=True),
    Case("wheels", "mecanum described as skid-steer", judge_mecanum),
)


MOUNTS = (
    based("mounts", "yaw of 12 deg, real", SEMINAR, rotated(math.radians(12.0)), ["12 deg", "yaw of"]),
    based("mounts", "accelerations in g", A300_LAPS, each(CLEARPATH_IMU, in_g), ["is in g"]),
    based("mounts", "IMU on its side, real", START_OF_DAY, each("/imu/data", on_its_side), ["gravity"]),
)

TOPICS = (
    based("topics", "types of a TurtleBot 4 beside", BURGER_ARCS, with_other_types),
    based("topics", "ROS 1 bag of LZ4", JACKAL_ARCS, stored(in_ros1)),
    based("topics", "MCAP without chunks and indexes", XL_ARCS, stored(without_index)),
    based("topics", "MCAP with chunks, without message indexes", LEO_LAPS, stored(without_message_index)),
    based("topics", "MCAP of JSON", SCOUT_ARCS, stored(in_json), ["json", "JSON"], refused=True),
    based("topics", "two .mcap without metadata.yaml", A300_LAPS, stored(split_without_metadata)),
)

REFERENCES = (
    referred("KITTI in the camera's axes", SCOUT_ARCS, kitti_of_camera, "txt", noise_m=0.1),
    referred(
        "north, east, down, real",
        SEMINAR,
        lambda r: table(r, lambda t, x, y, a: (t, y, x, 0.0, *q(math.pi / 2 - a)), every=1),
        words=["mirrored"],
    ),
    referred("NMEA with damaged lines", XL_ARCS, nmea(0.02, 0.04), "nmea", noise_m=0.03),
    referred("1 Hz", A300_LAPS, lambda r: table(r, lambda t, x, y, a: (t, x, y, 0.0, *q(a)), every=20), noise_m=0.1),
    referred("prism .4 m ahead of the base", JACKAL_ARCS, prism, "csv", noise_m=0.1),
    referred("GPX of a phone", SCOUT_ARCS, phone, "gpx", words=["cannot be seen"]),
)

TANK = Vehicle(0.2, 0.75, 0.55, 0.55, 0.6, 0.8, wheels_hz=40.0, imu_hz=0.0, room=(16.0, 13.0), seed=821)
CRATE = Vehicle(0.09, 0.44, 0.32, 0.58, 0.45, 0.9, wheels_hz=30.0, imu_hz=60.0, room=(12.0, 10.0), seed=822)
POINTS = (
    clouded("absolute seconds of another clock", TANK, "timestamp", "f8", lambda u, period, stamp: stamp * 1e-9 - 86_400.0 + u * period),
    clouded("hundredths of a degree of the sweep", TANK, "t", "u2", lambda u, period, stamp: 36_000.0 * u),
)


def gazebo(kind: str, vehicle: Vehicle) -> str:
    """A system of the new Gazebo with all four joints."""
    named = "".join(
        f"<{side}_joint>{name}</{side}_joint>" for side, names in (("left", vehicle.left), ("right", vehicle.right)) for name in names
    )
    return (
        f'<gazebo><plugin filename="gz-sim-{kind}-system" name="gz::sim::systems::{kind.title().replace("-", "")}">{named}'
        f"<wheel_separation>{vehicle.track}</wheel_separation><wheel_radius>{vehicle.radius}</wheel_radius></plugin></gazebo>"
    )


DESCRIPTIONS = (
    initialized("Gazebo's MecanumDrive", CRATE, urdf_of(CRATE, NAMES, more=gazebo("mecanum-drive", CRATE)), words=["mecanum"]),
    initialized(
        "Gazebo's DiffDrive with four joints",
        replace(CRATE, seed=823),
        urdf_of(CRATE, NAMES, more=gazebo("diff-drive", CRATE)),
        Publishing(has_odometry=True),
    ),
)

FORUM: tuple[Case, ...] = (*CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS)
