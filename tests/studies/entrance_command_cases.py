"""Cases of `tests.studies.entrance_commands`."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from motion_models import se2
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, drive, with_times
from tests.studies.entrance_commands import Edit, clouded, driven, initialized, scored
from tests.studies.entrance_unseen import gpx, rows
from tests.studies.entrances import cylinder, link, reordered, scaled, signed, tum, urdf_of

JACKAL = Vehicle(0.098, 0.376, 0.262, 0.62, 0.5, 0.9, wheels_hz=50.0, imu_hz=75.0, room=(13.0, 10.0), seed=201)
SCANS = replace(JACKAL, scan_hz=10.0, beams=180, seed=202)
NO_IMU = replace(SCANS, imu_hz=0.0, seed=203)
WARTHOG = Vehicle(0.3, 1.14, 0.92, 0.5, 1.2, 0.6, wheels_hz=20.0, imu_hz=100.0, room=(34.0, 26.0), seed=204)
TURTLE = Vehicle(
    0.033, 0.287, 0.2, 1.0, 0.2, 1.1, wheels_hz=30.0, imu_hz=100.0, left=("wheel_left_joint",), right=("wheel_right_joint",), seed=205
)
ROSBOT = Vehicle(0.0425, 0.192, 0.105, 0.7, 0.35, 1.3, wheels_hz=20.0, imu_hz=25.0, scan_hz=8.0, beams=150, room=(8.0, 7.0), seed=206)


def shifted(topics: Sequence[str], seconds: Callable[[float], float]) -> Edit:
    """Header stamps of ``topics`` (all: empty) later by a function of the time of measurement [s]."""

    def edit(records: list[Record]) -> list[Record]:
        return [
            (
                t,
                with_times(m, lambda ns: ns + round(seconds((ns - START) / S) * S))
                if t != "/tf_static" and (not topics or t in topics)
                else m,
                log,
            )
            for t, m, log in records
        ]

    return edit


def changed(topic: str, change: Callable[[Any], Any]) -> Edit:
    """Messages of ``topic`` changed; None leaves one out, a list of (topic, message) puts these in its place."""

    def edit(records: list[Record]) -> list[Record]:
        found: list[Record] = []
        for t, message, log in records:
            if t != topic:
                found.append((t, message, log))
                continue
            new = change(message)
            found += [(a, b, log) for a, b in (new if isinstance(new, list) else [] if new is None else [(t, new)])]
        return found

    return edit


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * S + message.header.stamp.nanosec


def topic_per_wheel(message: Any) -> list[tuple[str, Any]]:
    return [
        (f"/motors/{name}/state", bags.joint_state(stamp_of(message), [name], message.position[i : i + 1], message.velocity[i : i + 1]))
        for i, name in enumerate(message.name)
    ]


def with_arm(message: Any) -> Any:
    n = len(message.name)
    return bags.joint_state(
        stamp_of(message), ["arm_1", *message.name, "pan_joint"], [0.3, *message.position, -0.2], [0.0, *message.velocity, 0.0] if n else []
    )


def between_arms(message: Any) -> list[tuple[str, Any]]:
    arm = bags.joint_state(stamp_of(message) + 3_000_000, ["arm_1", "arm_2"], [0.1, 0.2], [0.0, 0.0])
    return [("/joint_states", message), ("/joint_states", arm)]


def nameless(message: Any) -> Any:
    return bags.joint_state(stamp_of(message), [], message.position, message.velocity)


def nan_velocities(message: Any) -> Any:
    return bags.joint_state(stamp_of(message), message.name, message.position, np.full(len(message.name), np.nan))


def only_effort_of_velocity(message: Any) -> Any:
    return bags.joint_state(stamp_of(message), message.name, np.zeros(len(message.name)), message.velocity)


def unstamped_twist(message: Any) -> Any:
    return message.twist


def without_twist(message: Any) -> Any:
    pose = message.pose.pose
    yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return bags.odometry(stamp_of(message), pose.position.x, pose.position.y, yaw)


def world_twist(message: Any) -> Any:
    pose, twist = message.pose.pose, message.twist.twist
    yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    new = bags.odometry(stamp_of(message), pose.position.x, pose.position.y, yaw, twist.linear.x * math.cos(yaw), twist.angular.z)
    new.twist.twist.linear.y = twist.linear.x * math.sin(yaw)
    return new


def renamed_frames(parent: str, child: str) -> Callable[[Any], Any]:
    def change(message: Any) -> Any:
        (one,) = message.transforms
        return bags.tf(
            stamp_of(one), [(parent, child, (one.transform.translation.x, one.transform.translation.y, 0.0), one.transform.rotation)]
        )

    return change


def also(vehicle: Vehicle, *topics: tuple[str, str, float]) -> Edit:
    """Truth of a ``vehicle`` at 5 Hz on more topics: (topic, form, noise [m])."""
    motion = drive(vehicle)

    def edit(records: list[Record]) -> list[Record]:
        rng, more = np.random.default_rng(9), []
        for topic, form, noise in topics:
            for t in np.arange(0.0, motion.t[-1], 0.2):
                x, y, a = motion.poses[motion.at(t)] + [*(noise * rng.normal(size=2)), 0.0]
                stamp = START + round(t * S)
                if form == "odometry":
                    message = bags.odometry(stamp, x, y, a, *motion.twists[motion.at(t)])
                elif form == "pose":
                    message = bags.pose_stamped(stamp, x, y, a)
                elif form == "covariance":
                    message = bags.pose_with_covariance(stamp, x, y, a, np.diag([0.01, 0.01, 0, 0, 0, 0.01]))
                else:
                    longitude = 9.0 + math.degrees(x / (6.389e6 * math.cos(math.radians(48.0))))
                    message = bags.fix(stamp, 48.0 + math.degrees(y / 6.367e6), longitude, covariance=np.eye(3).ravel() * noise**2)
                more.append((topic, message, stamp + S // 50))
        return [*records, *more]

    return edit


def without(topic: str) -> Edit:
    """Without a topic."""
    return lambda records: [record for record in records if record[0] != topic]


def both(*edits: Edit) -> Edit:
    """One after the other."""

    def edit(records: list[Record]) -> list[Record]:
        for one in edits:
            records = one(records)
        return records

    return edit


CLOCKS = (
    driven(
        "clocks",
        "first message of every topic old",
        SCANS,
        Publishing(stale={"/joint_states": [5.0], "/imu/data": [9.0, 8.99], "/scan": [3.0]}),
        ["dropped"],
    ),
    driven("clocks", "NTP sets all stamps ahead by 3.3 s", JACKAL, words=["clock", "jump"], edit=shifted((), lambda t: 3.3 * (t > 20.0))),
    driven("clocks", "LiDAR's clock jumps back by 1.4 s", SCANS, words=["/scan"], edit=shifted(("/scan",), lambda t: -1.4 * (t > 20.0))),
    driven("clocks", "IMU jumps by 0.6 s", JACKAL, words=["/imu/data"], edit=shifted(("/imu/data",), lambda t: 0.6 * (t > 25.0))),
    driven("clocks", "IMU in GPS time", WARTHOG, Publishing(offsets_s={"/imu/data": 18.0}), ["/imu/data", "time_offset"]),
    driven("clocks", "LiDAR in GPS time", ROSBOT, Publishing(offsets_s={"/scan": 18.0}), ["/scan"]),
    driven("clocks", "wheels' clock 2 % fast", JACKAL, words=["the wheels' stamps"], edit=shifted(("/joint_states",), lambda t: 0.02 * t)),
    driven("clocks", "LiDAR 0.35 s behind", SCANS, Publishing(offsets_s={"/scan": -0.35}), ["/scan"]),
    driven("clocks", "IMU without stamps", JACKAL, words=["/imu/data"], edit=changed("/imu/data", lambda m: with_times(m, lambda ns: 0))),
    driven(
        "clocks",
        "everything since boot but the LiDAR",
        SCANS,
        words=["another clock"],
        edit=shifted(("/joint_states", "/imu/data"), lambda t: 200.0 - START / S),
    ),
)

WHEELS = (
    driven("wheels", "left reversed, LiDAR alone", NO_IMU, Publishing(signed(-1, -1, 1, 1)), ["joints.reversed"]),
    driven("wheels", "swapped, gyro and LiDAR", SCANS, Publishing(reordered(2, 3, 0, 1)), ["joints.left"]),
    driven("wheels", "rpm of the motor, gear of 20", JACKAL, Publishing(scaled(20.0, 20.0 * 9.5493)), ["gear", "revolutions"]),
    driven("wheels", "degrees per second, positions rad", WARTHOG, Publishing(scaled(1.0, 57.2958)), ["deg"]),
    driven(
        "wheels",
        "unsigned ticks of 16 bits",
        JACKAL,
        Publishing(lambda a, r: (np.round(a * 3000.0) % 65536.0, np.zeros(0))),
        ["angle_range"],
    ),
    driven(
        "wheels",
        "ticks that pass 2^31",
        WARTHOG,
        Publishing(lambda a, r: ((np.round(a * 2000.0) + 2.0**31 - 3000.0 + 2.0**31) % 2.0**32 - 2.0**31, np.zeros(0))),
        ["angle_unit_rad"],
    ),
    driven("wheels", "metres", TURTLE, Publishing(scaled(0.033, 0.033)), ["metres"]),
    driven("wheels", "a message per wheel, left reversed", ROSBOT, Publishing(signed(-1, -1, 1, 1), forms="wheel"), ["joints.reversed"]),
    driven("wheels", "a topic per wheel", JACKAL, edit=changed("/joint_states", topic_per_wheel)),
    driven(
        "wheels",
        "/tf of namespaced frames alone",
        TURTLE,
        Publishing(forms="tf"),
        ["/tf"],
        changed("/tf", renamed_frames("robot1/odom", "robot1/base_footprint")),
    ),
    driven("wheels", "Twist without a stamp", JACKAL, Publishing(forms="twist"), edit=changed("/wheel_twist", unstamped_twist)),
    driven(
        "wheels",
        "TwistWithCovarianceStamped in a namespace",
        WARTHOG,
        Publishing(forms="twist_covariance", names={"/wheel_twist": "/w200/vehicle/wheel_odometry"}),
    ),
    driven("wheels", "driver that corrects for skidding", JACKAL, Publishing(forms="odometry", odometry_k=0.62), ["multiplier"]),
    driven("wheels", "driver's odometry without twists", ROSBOT, Publishing(forms="odometry"), edit=changed("/odom", without_twist)),
    driven("wheels", "driver's twists in the axes of odom", JACKAL, Publishing(forms="odometry"), edit=changed("/odom", world_twist)),
    driven("wheels", "arm joints in the same messages", JACKAL, edit=changed("/joint_states", with_arm)),
    driven("wheels", "arm's messages between the wheels'", WARTHOG, edit=changed("/joint_states", between_arms)),
    driven("wheels", "joints without names", JACKAL, words=["name"], edit=changed("/joint_states", nameless)),
    driven("wheels", "velocities NaN", WARTHOG, edit=changed("/joint_states", nan_velocities)),
    driven("wheels", "positions all zero", JACKAL, edit=changed("/joint_states", only_effort_of_velocity)),
    driven("wheels", "one side in rpm", JACKAL, Publishing(lambda a, r: (np.zeros(0), r * [1, 1, 9.5493, 9.5493])), ["/joint_states"]),
)

MOUNTS = (
    driven("mounts", "LiDAR turned by 90 deg", SCANS, Publishing(lidar_yaw=math.pi / 2), ["90 deg"]),
    driven("mounts", "LiDAR turned by 180 deg, no IMU", NO_IMU, Publishing(lidar_yaw=math.pi), ["180 deg"]),
    driven("mounts", "LiDAR turned by 270 deg", ROSBOT, Publishing(lidar_yaw=-math.pi / 2), ["90 deg"]),
    driven("mounts", "LiDAR upside down", SCANS, Publishing(lidar_flip=True), ["upside"]),
    driven("mounts", "LiDAR upside down and backwards", ROSBOT, Publishing(lidar_flip=True, lidar_yaw=math.pi), ["upside"]),
)

FILTERED, TRUTH = ("/j100_0001/platform/odom/filtered", "odometry", 0.0), ("/j100_0001/ground_truth/state", "odometry", 0.0)
BESIDE = {
    "wheels beside filtered, truth and AMCL": (JACKAL, "joint_states", {}, (FILTERED, TRUTH, ("/amcl_pose", "covariance", 0.1))),
    "driver's odometry beside filtered, both namespaced": (
        JACKAL,
        "odometry",
        {"/odom": "/j100_0001/platform/odom"},
        (FILTERED, ("/mocap/pose", "pose", 0.001)),
    ),
    "lidar odometry and wheels' odometry": (
        SCANS,
        "odometry",
        {"/odom": "/wheel_odom"},
        (("/kiss/odometry", "odometry", 0.02), ("/fix", "fix", 0.5)),
    ),
}
"""Vehicle, form and names of its wheels, and other topics."""
ALONE = {
    "filtered odometry alone": (JACKAL, "/odometry/filtered", 0.0),
    "mocap as Odometry alone": (WARTHOG, "/vrpn_client_node/robot/odom", 0.0),
    "GPS odometry alone": (WARTHOG, "/odometry/gps", 0.2),
}
"""Vehicle, topic and noise [m] of odometry that is not of wheels, in a log without these."""
TOPICS = (
    *(
        driven("topics", name, vehicle, Publishing(forms=forms, names=names), edit=also(vehicle, *topics))
        for name, (vehicle, forms, names, topics) in BESIDE.items()
    ),
    *(
        driven(
            "topics",
            name,
            vehicle,
            words=["no wheels"],
            edit=both(without("/joint_states"), also(vehicle, (topic, "odometry", noise))),
            refused=True,
        )
        for name, (vehicle, topic, noise) in ALONE.items()
    ),
)


# references


def nmea_sentence(body: str) -> str:
    """``body`` between the dollar sign and its checksum, the exclusive or of all characters (NMEA 0183)."""
    return f"${body}*{functools.reduce(operator.xor, map(ord, body)):02X}"


def nmea(motion: Motion) -> str:
    """GGA and RMC sentences at 2 Hz."""
    lines = []
    for t, (x, y, _) in zip(motion.t[::50], motion.poses[::50], strict=True):
        time = datetime.fromtimestamp(START / S + t, UTC)
        latitude, longitude = 48.0 + math.degrees(y / 6.3662e6), 9.0 + math.degrees(x / (6.3900e6 * math.cos(math.radians(48.0))))
        clock, angles = time.strftime("%H%M%S.") + f"{time.microsecond // 1000:03d}", []
        for value, digits in ((latitude, 2), (longitude, 3)):
            angles.append(f"{int(value):0{digits}d}{60.0 * (value - int(value)):010.7f}")
        for body in (
            f"GPRMC,{clock},A,{angles[0]},N,{angles[1]},E,0.0,0.0,{time:%d%m%y},,,A",
            f"GPGGA,{clock},{angles[0]},N,{angles[1]},E,4,12,0.6,300.0,M,47.0,M,,",
        ):
            lines.append(nmea_sentence(body))
    return "\n".join(lines) + "\n"


def g2o(motion: Motion) -> str:
    """Vertices of the poses at 2 Hz and edges between them."""
    poses = motion.poses[::50]
    lines = [f"VERTEX_SE2 {i} {x:.6f} {y:.6f} {a:.6f}" for i, (x, y, a) in enumerate(poses)]
    for i in range(len(poses) - 1):
        d = se2.between(poses[i], poses[i + 1])
        lines.append(f"EDGE_SE2 {i} {i + 1} {d[0]:.6f} {d[1]:.6f} {d[2]:.6f} 100 0 0 100 0 100")
    return "\n".join(lines) + "\n"


def y_up_mm(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    return t, 1000.0 * x, 300.0, -1000.0 * y, 0.0, math.sin(a / 2), 0.0, math.cos(a / 2)


def kitti_z_up(motion: Motion) -> str:
    lines = []
    for x, y, a in motion.poses[::10]:
        c, s = math.cos(a), math.sin(a)
        lines.append(" ".join(f"{v:.6e}" for v in (c, -s, 0.0, x, s, c, 0.0, y, 0.0, 0.0, 1.0, 0.2)))
    return "\n".join(lines) + "\n"


def q(a: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, math.sin(a / 2), math.cos(a / 2)


def geodetic(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    return t, 48.0 + math.degrees(y / 6.3662e6), 9.0 + math.degrees(x / (6.39e6 * math.cos(math.radians(48.0))))


def slower(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    return START / S + 1.05 * (t - START / S), x, y, 0.0, *q(a)


EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_x,v_y,v_z,b_w_x,b_w_y,b_w_z,b_a_x,b_a_y,b_a_z"
)
REFERENCES = (
    scored("mm and y up", JACKAL, lambda m: rows(m, "", y_up_mm, " "), words=["scale is 1000"]),
    scored("NED", JACKAL, lambda m: tum(m, swap="ned"), words=["mirrored"]),
    scored("left-handed in mm", WARTHOG, lambda m: tum(m, 1000.0, swap="y"), words=["1000", "mirrored"]),
    scored("another drive of the same day", JACKAL, lambda m: tum(drive(replace(JACKAL, seed=777))), words=["another run"]),
    scored("another day", JACKAL, lambda m: tum(m, offset_s=86400.0), words=["none lies within"]),
    scored("local time, 2 h", WARTHOG, lambda m: tum(m, offset_s=7200.0), words=["none lies within"]),
    scored("seconds from the start", JACKAL, lambda m: tum(m, offset_s=-START / S), words=["from the start of a run"]),
    scored("18 s and clockwise", JACKAL, lambda m: tum(m, offset_s=18.0, swap="yaw"), words=["18.0 s"]),
    scored("GPX", WARTHOG, gpx, "gpx", noise=0.1),
    scored("NMEA", WARTHOG, nmea, "nmea", noise=0.1),
    scored(
        "EuRoC of 17 columns",
        JACKAL,
        lambda m: rows(m, EUROC, lambda t, x, y, a: (round(t * 1e9), x, y, 0.1, math.cos(a / 2), 0.0, 0.0, math.sin(a / 2), *(9 * (0.0,)))),
        "csv",
    ),
    scored("KITTI with z up", JACKAL, kitti_z_up, "txt", noise=0.1),
    scored("comma TUM, nanoseconds", WARTHOG, lambda m: rows(m, "", lambda t, x, y, a: (round(t * 1e9), x, y, 0.0, *q(a))), "csv"),
    scored(
        "header, spaces and units",
        JACKAL,
        lambda m: rows(m, "Time (s), X (m), Y (m), Heading (deg)", lambda t, x, y, a: (t, x, y, math.degrees(a))),
        "csv",
    ),
    scored("header in mm", JACKAL, lambda m: rows(m, "time,x_mm,y_mm,yaw", lambda t, x, y, a: (t, 1000.0 * x, 1000.0 * y, a)), "csv"),
    scored(
        "UTM easting and northing",
        WARTHOG,
        lambda m: rows(m, "timestamp,easting,northing", lambda t, x, y, a: (t, 500123.4 + x, 5316789.1 + y)),
        "csv",
    ),
    scored("g2o", JACKAL, g2o, "g2o", noise=0.1),
)


# points


TURNING = replace(JACKAL, seed=210)
POINTS = (
    clouded("microseconds as float", TURNING, "t", "f4", lambda u, period, stamp: u * period * 1e6),
    clouded("0 to 1", TURNING, "time", "f4", lambda u, period, stamp: u),
    clouded("all equal to the stamp", TURNING, "timestamp", "f8", lambda u, period, stamp: 0.0 * u + stamp * 1e-9, ["time"]),
    clouded("time_stamp in nanoseconds", TURNING, "time_stamp", "u4", lambda u, period, stamp: u * period * 1e9),
    clouded(
        "milliseconds since the LiDAR was switched on",
        TURNING,
        "timestamp",
        "f8",
        lambda u, period, stamp: 5e6 + (stamp - START) * 1e-6 + u * period * 1e3,
    ),
)


# descriptions


def with_mass(urdf: str, offset_y: float) -> str:
    """The base's mass beside the middle."""
    old = '<link name="base_link"><inertial><mass value="1.0"/></inertial></link>'
    return urdf.replace(old, f'<link name="base_link"><inertial><origin xyz="0 {offset_y} 0.05"/><mass value="20.0"/></inertial></link>')


def without_masses(urdf: str) -> str:
    return urdf.replace('<inertial><mass value="1.0"/></inertial>', "")


ALL = (*JACKAL.left, *JACKAL.right)
ROLLERS = "".join(
    link(f"roller_{n}_{i}", cylinder(0.01))
    + f'<joint name="roller_{n}_{i}_joint" type="continuous"><parent link="{n}_link"/><child link="roller_{n}_{i}"/>'
    '<origin xyz="0.09 0 0" rpy="0.785 0 0"/><axis xyz="1 0 0"/></joint>'
    for n in ALL
    for i in range(3)
)
TRACKED = replace(JACKAL, left=("left_track_sprocket_joint",), right=("right_track_sprocket_joint",), k=0.6, seed=207)
CASTERS = "".join(
    link(f"{n}_caster", '<collision><geometry><sphere radius="0.016"/></geometry></collision>')
    + f'<joint name="{n}_caster_joint" type="continuous"><parent link="base_link"/><child link="{n}_caster"/>'
    f'<origin xyz="{x} 0 -0.017"/><axis xyz="0 1 0"/></joint>'
    for n, x in (("front", 0.12), ("rear", -0.12))
)
PLUGIN = (
    '<gazebo><plugin filename="libgazebo_ros_diff_drive.so" name="dd">'
    "<left_joint>front_left_wheel</left_joint><right_joint>front_right_wheel</right_joint>"
    "<wheel_separation>{}</wheel_separation><wheel_diameter>{}</wheel_diameter></plugin></gazebo>"
)
STEERING = "".join(
    link(f"{n}_knuckle") + f'<joint name="{n}_steering_joint" type="revolute"><parent link="base_link"/><child link="{n}_knuckle"/>'
    f'<origin xyz="0.131 {y} 0"/><axis xyz="0 0 1"/><limit lower="-0.5" upper="0.5" effort="1" velocity="1"/></joint>'
    for n, y in (("left", 0.188), ("right", -0.188))
)
DESCRIPTIONS = (
    initialized("mecanum", JACKAL, urdf_of(JACKAL, ALL, more=ROLLERS), words=["omnidirectional"]),
    initialized(
        "sprockets of tracks",
        TRACKED,
        urdf_of(replace(TRACKED, wheelbase=0.0), (*TRACKED.left, *TRACKED.right)),
        words=["track"],
        asked=["wheelbase_m"],
    ),
    initialized("two casters that turn about y", TURTLE, urdf_of(TURTLE, (*TURTLE.left, *TURTLE.right), more=CASTERS)),
    initialized(
        "radius contradicts the plugin's",
        JACKAL,
        urdf_of(JACKAL, ALL, cylinder(0.15), PLUGIN.format(0.376, 0.196)),
        Publishing(has_odometry=True),
        ["wheel_radius_m"],
    ),
    initialized(
        "track contradicts the plugin's",
        JACKAL,
        urdf_of(JACKAL, ALL, track=0.25, more=PLUGIN.format(0.376, 0.196)),
        words=["track_width_m"],
    ),
    initialized("symmetric with its mass aside", JACKAL, with_mass(urdf_of(JACKAL, ALL), 0.06), words=["off the middle"]),
    initialized("without masses", WARTHOG, without_masses(urdf_of(WARTHOG, (*WARTHOG.left, *WARTHOG.right))), asked=["mass_kg"]),
    initialized("Ackermann", JACKAL, urdf_of(JACKAL, ALL, more=STEERING), words=["steer"]),
    initialized(
        "arms at the wheels' joints: names of sides wrong", JACKAL, urdf_of(JACKAL, (*JACKAL.right, *JACKAL.left)), words=["left wheels"]
    ),
    initialized(
        "loop",
        JACKAL,
        urdf_of(JACKAL, ALL).replace(
            "</robot>", '<joint name="loop" type="fixed"><parent link="front_left_wheel_link"/><child link="base_link"/></joint></robot>'
        ),
        words=["loop"],
        refused=True,
    ),
)

LATER = (  # made after what the others showed was corrected
    driven("later", "LiDAR 0.5 s ahead, no IMU", NO_IMU, Publishing(offsets_s={"/scan": 0.5}), ["LiDAR", "/scan"]),
    driven("later", "IMU 0.35 s behind, LiDAR", SCANS, Publishing(offsets_s={"/imu/data": -0.35}), ["/imu/data", "gyro"]),
    driven("later", "IMU 0.35 s behind", WARTHOG, Publishing(offsets_s={"/imu/data": -0.35}), ["/imu/data", "gyro"]),
    driven("later", "left reversed and LiDAR upside down", SCANS, Publishing(signed(-1, -1, 1, 1), lidar_flip=True), ["joints.reversed"]),
    driven("later", "gear of 3", SCANS, Publishing(scaled(3.0, 3.0)), ["gear"]),
    driven("later", "velocities in m/s, positions in rad", WARTHOG, Publishing(scaled(1.0, 0.3)), ["metres"]),
    driven("later", "LiDAR at 120 deg", ROSBOT, Publishing(lidar_yaw=math.radians(120.0)), ["the yaw of 'laser'"]),
    driven("later", "LiDAR upside down at 90 deg", SCANS, Publishing(lidar_flip=True, lidar_yaw=math.pi / 2), ["upside"]),
    driven("later", "LiDAR 1 s late and backwards", SCANS, Publishing(offsets_s={"/scan": 1.0}, lidar_yaw=math.pi), ["180 deg"]),
    driven("later", "rates constant, angles right", JACKAL, Publishing(lambda a, r: (a, 0.0 * r))),
    driven("later", "a message per wheel, angles constant", ROSBOT, Publishing(lambda a, r: (0.0 * a, r), forms="wheel")),
    driven("later", "driver with the gyro's sign reversed, LiDAR", SCANS, Publishing(forms="odometry", gyro=-1.0), ["rate_unit_rad_s"]),
    scored("y up, 18 s", WARTHOG, lambda m: rows(m, "", lambda t, *p: y_up_mm(t + 18.0, *p), " "), words=["18.0 s", "1000"]),
    scored("latitude and longitude", WARTHOG, lambda m: rows(m, "time,latitude,longitude", geodetic), "csv", noise=0.1),
    scored("half of the drive", JACKAL, lambda m: "\n".join(tum(m).splitlines()[:220]) + "\n", noise=0.3),
    scored("the same maneuvers, 5 % slower", JACKAL, lambda m: rows(m, "", slower, " "), words=["clock"]),
)
CASES = (*LATER, *CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS)
