"""A third set of inputs as practitioners bring them, on parts of real drives and simulated robots; for `entrance_commands`.

All answers were written down before the first run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from localization.trajectory import Trajectory
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Publishing, Vehicle, with_times
from tests.studies.entrance_base_logs import (
    ASPHALT,
    CORRIDOR,
    HALL,
    LEO,
    LOAM,
    MEADOW,
    OFFICE,
    PIONEER,
    SCOUT,
    BaseLog,
    based,
    healthy,
    referred,
    written,
)
from tests.studies.entrance_command_cases import both, changed, q, shifted, stamp_of, without
from tests.studies.entrance_commands import Case, Edit, clouded, initialized, run_command
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import Found, cylinder, link, signed, urdf_of, wheel

# clocks and first messages


def latched(topic: str, ages_s: tuple[float, ...]) -> Edit:
    """The topic begins with messages of these ages, one of which is stored again and again."""

    def edit(records: list[Record]) -> list[Record]:
        first = next(m for t, m, _ in records if t == topic)
        old = []
        for i, age in enumerate(ages_s):
            copied = bags.STORE.deserialize_cdr(bags.STORE.serialize_cdr(first, first.__msgtype__), first.__msgtype__)
            old.append((topic, with_times(copied, lambda ns, a=age: ns - round(a * S)), START + (i + 1) * S // 1000))
        return [*records, *old]

    return edit


def delivered_late(records: list[Record]) -> list[Record]:
    """A wireless link delivers all messages up to 0.4 s late, in bursts."""
    rng = np.random.default_rng(41)
    delays = rng.uniform(0.0, 0.4, 4000)
    found = []
    for t, m, log in records:
        delay = 0.0 if t == "/tf_static" else float(delays[int((log - START) / S * 4) % 4000])
        found.append((t, m, log + round(delay * S)))
    return found


def whole_seconds(topic: str) -> Edit:
    """The driver fills in seconds alone."""
    return changed(topic, lambda m: with_times(m, lambda ns: ns // S * S))


def set_back(seconds: int, at_s: float) -> Edit:
    """The recorder's clock is set back on the way; stamps are those of the robot's clock. The file is in order of recording."""

    def edit(records: list[Record]) -> list[Record]:
        return [(t, m, log - (seconds * S if log > START + at_s * S else 0)) for t, m, log in records]

    edit.keeps_order = True  # type: ignore[attr-defined]
    return edit


def jumping(topics: tuple[str, ...], at_s: float, by_s: float) -> Edit:
    return shifted(topics, lambda t: by_s * (t > at_s))


CLOCKS = (
    based("clocks", "LiDAR 0.8 s behind, three sensors", SCOUT, shifted(("/scan",), lambda t: -0.8), ["/scan"]),
    based("clocks", "wheels and odometry jump by 1.1 s", CORRIDOR, jumping(("/odom", "/joint_states"), 45.0, 1.1), ["/joint_states"]),
    based(
        "clocks", "IMU's clock 1 % slow", LEO, shifted(("/imu/data",), lambda t: -0.01 * t), ["/imu/data", "of gyro", "the gyro's stamps"]
    ),
    based("clocks", "three old scans of the last session", OFFICE, latched("/scan", (50.0, 49.7, 49.4)), ["dropped"]),
    based("clocks", "IMU since its start", MEADOW, shifted(("/imu/data",), lambda t: 3107.4 - START / S), ["/imu/data"]),
    based("clocks", "delivered late in bursts", PIONEER, delivered_late),
    based("clocks", "scans stamped in whole seconds", SCOUT, whole_seconds("/scan"), ["/scan"]),
    based("clocks", "recorder's clock set back by 45 s", LEO, set_back(45, 30.0)),
    based(
        "clocks", "wheels 1.6 s behind, off road", ASPHALT, shifted(("/joint_states",), lambda t: -1.6), ["/joint_states", "wheels' stamps"]
    ),
)

# wheels


def joints(change: Callable[[np.ndarray, np.ndarray], tuple[Any, Any]], topic: str = "/joint_states") -> Edit:
    """Angles and rates changed."""
    return changed(topic, lambda m: bags.joint_state(stamp_of(m), m.name, *change(np.array(m.position), np.array(m.velocity))))


def renamed(*order: int, topic: str = "/joint_states") -> Edit:
    """Wheels under the names of others."""
    return joints(lambda a, r: (a[list(order)], r[list(order)]), topic)


def alternating(message: Any, t: float) -> Any:
    """Every second message has positions alone."""
    if stamp_of(message) // (S // 50) % 2:
        return bags.joint_state(stamp_of(message), message.name, message.position, [])
    return message


def axles(message: Any) -> list[tuple[str, Any]]:
    """A controller for each axle; the left wheels count backwards on both."""
    sign = np.array([-1.0, 1.0])
    found = []
    for topic, pair, late in (("/front/joint_states", [0, 2], 0), ("/rear/joint_states", [1, 3], S // 100)):
        names = [message.name[i] for i in pair]
        a, r = sign * np.array(message.position)[pair], sign * np.array(message.velocity)[pair]
        found.append((topic, bags.joint_state(stamp_of(message) + late, names, a, r)))
    return found


def odometry_in(unit: float) -> Edit:
    """The driver's odometry in another unit of length, without joint states."""

    def change(m: Any) -> Any:
        for place in (m.pose.pose.position, m.twist.twist.linear):
            place.x, place.y = unit * place.x, unit * place.y
        return m

    return both(without("/joint_states"), changed("/odom", change))


def odometry_to_tf(m: Any) -> list[tuple[str, Any]]:
    p = m.pose.pose
    return [("/tf", bags.tf(stamp_of(m), [("odom", "base_footprint", (p.position.x, p.position.y, 0.0), p.orientation)]))]


def turned_about(m: Any) -> Any:
    """Turning rate and heading clockwise, y as it should be."""
    p, twist = m.pose.pose, m.twist.twist
    yaw = 2.0 * math.atan2(p.orientation.z, p.orientation.w)
    return bags.odometry(stamp_of(m), p.position.x, p.position.y, -yaw, twist.linear.x, -twist.angular.z)


def to_twist(radius: float, track: float, unit: float) -> Edit:
    """The driver publishes TwistStamped alone, speeds in another unit."""

    def change(m: Any) -> list[tuple[str, Any]]:
        left, right = radius * np.mean(m.velocity[:2]), radius * np.mean(m.velocity[2:])
        twist = bags.T["geometry_msgs/msg/Twist"](
            linear=bags.vector(unit * (left + right) / 2), angular=bags.vector(z=(right - left) / track)
        )
        return [("/base/twist", bags.T["geometry_msgs/msg/TwistStamped"](header=bags.header(stamp_of(m), "base_link"), twist=twist))]

    return changed("/joint_states", change)


RPM = 60.0 / math.tau
TICKS = 64 * 4 * 50 / math.tau
WHEELS = (
    based(
        "wheels",
        "right side reversed, off road",
        ASPHALT,
        joints(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1])),
        ["joints.reversed"],
    ),
    based("wheels", "rpm at 6.5 Hz, no LiDAR", LOAM, joints(lambda a, r: ([], r * RPM)), ["revolutions", "rpm"]),
    based(
        "wheels", "driver's heading clockwise", MEADOW, changed("/husky_velocity_controller/odom", turned_about), ["swapped", "opposite"]
    ),
    based("wheels", "velocities in every second message", LEO, each("/joint_states", alternating)),
    based(
        "wheels",
        "unsigned 32 bits from near the end",
        SCOUT,
        joints(lambda a, r: ((np.round(a * TICKS) + 2.0**32 - 300_000.0) % 2.0**32, [])),
        ["angle_unit_rad"],
    ),
    based("wheels", "a topic for each axle, left reversed", PIONEER, changed("/joint_states", axles), ["joints.reversed"]),
    based("wheels", "driver's odometry in centimetres", OFFICE, odometry_in(100.0), ["centimetres", "unit than metres"]),
    based("wheels", "/tf of base_footprint alone", HALL, changed("/odom", odometry_to_tf), ["/tf"]),
    based("wheels", "front wheels swapped", LEO, renamed(2, 1, 0, 3), ["joints.left"]),
    based("wheels", "Twist in km/h", SCOUT, to_twist(0.165, 0.583, 3.6), ["km/h", "3.6", "times too large"]),
    based(
        "wheels",
        "degrees, left and right swapped",
        CORRIDOR,
        both(without("/odom"), joints(lambda a, r: (np.degrees(a[::-1]), np.degrees(r[::-1])))),
        ["degrees"],
    ),
)

# mounts


def laser_edge(x: float, yaw: float = 0.0, frame: str = "laser") -> Edit:
    """The transform of the LiDAR alone."""
    return changed("/tf_static", lambda m: bags.tf(START, [("base_link", frame, (x, 0.0, 0.3), bags.quaternion(yaw))]))


def upside_down(m: Any) -> Any:
    m.ranges = m.ranges[::-1].copy()
    m.angle_min, m.angle_max = -m.angle_max, -m.angle_min
    return m


def rotated(turn: float) -> Edit:
    """Beams as a LiDAR measures them that is turned by ``turn`` [rad] against its transform."""

    def change(m: Any) -> Any:
        m.angle_min, m.angle_max = m.angle_min - turn, m.angle_max - turn
        return m

    return changed("/scan", change)


MOUNTS = (
    based("mounts", "transform turned by 180 deg, real", CORRIDOR, laser_edge(-0.04, math.pi), ["180 deg"]),
    based("mounts", "upside down, real", OFFICE, changed("/scan", upside_down), ["upside"]),
    based(
        "mounts",
        "-50 deg and an old first odometry",
        HALL,
        both(rotated(math.radians(-50.0)), latched("/odom", (700.0,))),
        ["50 deg", "yaw of"],
    ),
    based(
        "mounts",
        "IMU on its side, no transform",
        MEADOW,
        robot=lambda text: text.split("[mounts.imu_link]")[0] + "[models.skid_steer]\nk_0 = 0.5333\nx_cr_0 = 0.0\ny_cr_0 = 0.0\n",
        words=["gravity", "imu_link"],
    ),
    based(
        "mounts",
        "LiDAR at 25 deg, IMU 0.4 s behind",
        LEO,
        both(rotated(math.radians(25.0)), shifted(("/imu/data",), lambda t: -0.4)),
        ["yaw of", "25 deg"],
    ),
)

# topics


def moved(names: dict[str, str]) -> Edit:
    return lambda records: [(names.get(t, t), m, log) for t, m, log in records]


def driver_odometry(radius: float, track: float) -> Edit:
    """The driver's odometry of its own geometry in place of joint states, beside others."""
    pose = [0.0, 0.0, 0.0, 0]

    def change(m: Any) -> list[tuple[str, Any]]:
        left, right = radius * np.mean(m.velocity[:2]), radius * np.mean(m.velocity[2:])
        v, w, now = (left + right) / 2, (right - left) / track, stamp_of(m)
        dt = (now - pose[3]) / S if pose[3] else 0.0
        pose[0], pose[1], pose[2] = (
            pose[0] + v * dt * math.cos(pose[2] + w * dt / 2),
            pose[1] + v * dt * math.sin(pose[2] + w * dt / 2),
            pose[2] + w * dt,
        )
        pose[3] = now
        return [("/skid_steer_controller/odom", bags.odometry(now, pose[0], pose[1], pose[2], v, w))]

    def edit(records: list[Record]) -> list[Record]:
        pose[:] = [0.0, 0.0, 0.0, 0]
        return changed("/joint_states", change)(records)

    return edit


def beside(base: BaseLog, *topics: str) -> Edit:
    """The truth as Odometry on more topics, 10 Hz."""

    def edit(records: list[Record]) -> list[Record]:
        track, more = healthy(base).reference, []
        for stamp, (x, y, a) in zip(track.stamps_ns[::2], track.poses[::2], strict=True):
            more += [(topic, bags.odometry(int(stamp), x, y, a, 0.3, 0.0), int(stamp) + S // 50) for topic in topics]
        return [*records, *more]

    return edit


def two_robots(records: list[Record]) -> list[Record]:
    return [(f"/{name}{t}", m, log) for t, m, log in records for name in ("r1", "r2")]


def arm_beside(message: Any) -> list[tuple[str, Any]]:
    arm = bags.joint_state(stamp_of(message) + S // 400, ["lift", "gripper"], [0.2, 0.0], [0.0, 0.0])
    return [("/wheel_states", message), ("/joint_states", arm)]


TOPICS = (
    based(
        "topics",
        "controller's odometry beside filtered and truth",
        SCOUT,
        both(driver_odometry(0.165, 0.583), beside(SCOUT, "/odometry/filtered", "/ground_truth/state", "/rtabmap/odom")),
    ),
    based(
        "topics",
        "LiDAR and a reference, no wheels",
        CORRIDOR,
        both(without("/odom"), without("/joint_states"), beside(CORRIDOR, "/reference/odom")),
        ["no wheels"],
        refused=True,
    ),
    based("topics", "two robots in one log", MEADOW, two_robots, ["could each be", "/r1/"], refused=True),
    based(
        "topics", "names of Stage", OFFICE, both(without("/joint_states"), moved({"/odom": "/robot_0/odom", "/scan": "/robot_0/base_scan"}))
    ),
    based("topics", "arm on /joint_states, wheels beside", LEO, changed("/joint_states", arm_beside)),
)

# references


def table(
    track: Trajectory, row: Callable[[float, float, float, float], tuple[float, ...]], header: str = "", mark: str = " ", every: int = 2
) -> str:
    lines = [
        mark.join(repr(v) if isinstance(v, int) else f"{v:.7f}" for v in row(stamp / S, *pose))
        for stamp, pose in zip(track.stamps_ns[::every].tolist(), track.poses[::every].tolist(), strict=True)
    ]
    return "\n".join([header, *lines] if header else lines) + "\n"


def gpx_without_times(track: Trajectory) -> str:
    points = "".join(f'<trkpt lat="{47.0 + y / 111195.0:.9f}" lon="{8.0 + x / 75834.0:.9f}"/>' for x, y, _ in track.poses[::10])
    return f'<?xml version="1.0"?><gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>'


def fixes_late(seconds: float) -> Edit:
    return shifted(("/fix",), lambda t: seconds)


def backwards_in_time(track: Trajectory) -> str:
    """The same way driven back: another run, with the stamps of this one."""
    return table(Trajectory(track.stamps_ns, track.poses[::-1]), lambda t, x, y, a: (t, x, y, 0.0, *q(a + math.pi)))


REFERENCES = (
    referred(
        "inches, real",
        CORRIDOR,
        lambda r: table(r, lambda t, x, y, a: (t, 39.37 * x, 39.37 * y, 0.0, *q(a)), every=1),
        words=["scale is 39"],
    ),
    referred(
        "milliseconds since 1970, real", OFFICE, lambda r: table(r, lambda t, x, y, a: (1e3 * t, x, y, 0.0, *q(a)), every=1), noise_m=0.02
    ),
    referred(
        "headings all zero, real", OFFICE, lambda r: table(r, lambda t, x, y, a: (t, x, y, 0.0, 0.0, 0.0, 0.0, 1.0), every=1), noise_m=0.05
    ),
    referred("fixes 12 s late", MEADOW, lambda r: "", words=["12."], edit=fixes_late(12.0), reference="/fix"),
    referred("GPX without times", LEO, gpx_without_times, "gpx", words=["time"]),
    referred(
        "x and y exchanged, header",
        SCOUT,
        lambda r: table(r, lambda t, x, y, a: (t, y, x, a), "t,x,y,theta", ","),
        "csv",
        words=["mirrored"],
    ),
    referred("the same way driven back", PIONEER, backwards_in_time, words=["another run"]),
    referred(
        "degrees, 0.6 s late",
        PIONEER,
        lambda r: table(r, lambda t, x, y, a: (t + 0.6, x, y, math.degrees(a)), "time,x,y,yaw_deg", ","),
        "csv",
        words=["0.6"],
    ),
    referred(
        "easting, northing, no headings, 2 Hz",
        LEO,
        lambda r: table(r, lambda t, x, y, a: (t, 412_345.6 + x, 5_411_222.3 + y), "stamp;easting;northing", ";", 12),
        "csv",
    ),
)

# times of points

TRUCK = Vehicle(0.2, 0.7, 0.5, 0.55, 0.6, 1.0, wheels_hz=40.0, imu_hz=0.0, room=(18.0, 14.0), seed=301)
POINTS = (
    clouded("offset_time in nanoseconds", TRUCK, "offset_time", "u4", lambda u, period, stamp: u * period * 1e9),
    clouded("nanoseconds before the end", TRUCK, "t", "i4", lambda u, period, stamp: (u - 1.0) * period * 1e9),
    clouded("seconds of the day", TRUCK, "timestamp", "f8", lambda u, period, stamp: stamp % (86_400 * S) * 1e-9 + u * period),
    clouded("tens of microseconds, backwards", TRUCK, "time", "f4", lambda u, period, stamp: (1.0 - u) * period * 1e5, ["time"]),
)

# descriptions

CRATE = Vehicle(0.05, 0.3, 0.2, 0.58, 0.3, 1.0, wheels_hz=30.0, imu_hz=60.0, room=(9.0, 8.0), seed=302)
ROVER = Vehicle(0.2, 1.2, 1.2, 0.5, 0.7, 0.6, wheels_hz=25.0, imu_hz=80.0, room=(25.0, 20.0), seed=303)
NAMES = (*CRATE.left, *CRATE.right)
SKID = (
    '<gazebo><plugin filename="libgazebo_ros_skid_steer_drive.so" name="s"><left_front_joint>front_left_wheel</left_front_joint>'
    "<right_front_joint>front_right_wheel</right_front_joint><left_rear_joint>rear_left_wheel</left_rear_joint>"
    "<right_rear_joint>rear_right_wheel</right_rear_joint><wheel_separation>1.2</wheel_separation><wheel_diameter>0.4</wheel_diameter>"
    "</plugin></gazebo>"
)


def by_axes(vehicle: Vehicle, left_roll: float, right_roll: float, more: str = "") -> str:
    """Wheels whose joint frames are rolled so that their z axes lie across: cylinders need no rotation."""
    half, side = vehicle.wheelbase / 2, vehicle.track / 2
    shape = f'<collision><geometry><cylinder radius="{vehicle.radius}" length="0.03"/></geometry></collision>'
    parts = [
        wheel(n, f"{n}_link", x, y, shape, "0 0 1", rpy=f"{left_roll if y > 0 else right_roll} 0 0")
        for n, x, y in zip(NAMES, (half, -half, half, -half), (side, side, -side, -side), strict=True)
    ]
    return f'<robot name="r">{link("base_link")}{"".join(parts)}{more}</robot>'


def visual(radius: float) -> str:
    return f'<visual><origin rpy="1.5708 0 0"/><geometry><cylinder radius="{radius}" length="0.06"/></geometry></visual>'


FOOTPRINT = (
    '<link name="base_footprint"/><joint name="foot" type="fixed"><parent link="base_footprint"/><child link="base_link"/>'
    '<origin xyz="0 0 0.05"/></joint>'
)
PANNED = (
    link("pan")
    + link("tilt")
    + '<joint name="pan_joint" type="continuous"><parent link="base_link"/><child link="pan"/><origin xyz="0.1 0 0.3"/>'
    '<axis xyz="0 0 1"/></joint><joint name="tilt_joint" type="continuous"><parent link="pan"/><child link="tilt"/>'
    '<origin xyz="0 0 0.05"/><axis xyz="0 1 0"/></joint>'
)
DESCRIPTIONS = (
    initialized(
        "axes across by rolled frames, right ones mirrored",
        CRATE,
        by_axes(CRATE, -1.5708, 1.5708),
        Publishing(signed(1, 1, -1, -1)),
    ),
    initialized("all axes to the right, driver's signs usual", ROVER, by_axes(ROVER, 1.5708, 1.5708, SKID), words=["sign"]),
    initialized(
        "radius of the visual alone, base_footprint",
        CRATE,
        urdf_of(CRATE, NAMES, visual(CRATE.radius)).replace("</robot>", FOOTPRINT + "</robot>"),
    ),
    initialized(
        "front at -x",
        replace(CRATE, seed=304),
        urdf_of(CRATE, ("rear_left_wheel", "front_left_wheel", "rear_right_wheel", "front_right_wheel")),
    ),
    initialized("pan and tilt that turn for ever", ROVER, urdf_of(ROVER, NAMES, more=PANNED)),
    initialized("plugin of another size", CRATE, urdf_of(CRATE, NAMES, more=SKID), Publishing(has_odometry=True), ["track_width_m"]),
    initialized("radii in centimetres", CRATE, urdf_of(CRATE, NAMES, cylinder(5.0)), Publishing(has_odometry=True), ["wheel_radius_m"]),
)

# recommendation


def recommended(name: str, base: BaseLog, cut: tuple[float, float], has_reference: bool) -> Case:
    """Scans are missing for a while.

    Right where, by a reference, the run of the smallest error is called best; without one, no run that lost its LiDAR.
    """

    def drop(records: list[Record]) -> list[Record]:
        return [r for r in records if r[0] != "/scan" or not START + cut[0] * S < r[2] < START + cut[1] * S]

    def judge(folder: Path) -> Found:
        log, robot, _ = written(folder, base, drop)
        (folder / "reference.tum").write_text(table(healthy(base).reference, lambda t, x, y, a: (t, x, y, 0.0, *q(a)), every=1))
        model = "diff_drive" if 'drive = "diff_drive"' in base.robot else "skid_steer"
        options = ["--reference", str(folder / "reference.tum")] if has_reference else []
        given = ["--model", model, "--estimator", "odometry,lidar,ekf,graph", "--json", str(folder / "m.json")]
        code, text = run_command("replay", str(log), "--robot", str(robot), "--out", str(folder / "out"), *given, *options)
        flat = " ".join(text.split())
        if code:
            return Found("misnamed", f"[exit {code}] {text}")
        if not has_reference:
            is_right = "is best" not in flat and "Not recommended" in flat and "ekf" in flat.split("Not recommended")[1].lower()
            return Found("right" if is_right else "misnamed", text)
        found = {r["estimator"]: r["ate_rmse_m"] for r in json.loads((folder / "m.json").read_text())["results"]}
        sentence = next((s for s in flat.split(". ") if "is best" in s or "has the smallest error" in s), "")
        best = min(found, key=lambda k: found[k])
        words = {"ekf": "EKF", "graph": "graph", "lidar": "LiDAR", "odometry": "dead reckoning"}
        is_right = words[best].lower() in sentence.split(" is best")[0].split(" has the")[0].lower() and "Not recommended" not in flat
        return Found("right" if is_right else "misnamed", f"[{found}] {text}")

    return Case("recommendation", name, judge)


RECOMMENDATION = (
    recommended("scans lost for 7 s, a reference", OFFICE, (40.0, 47.0), True),
    recommended("scans lost for 12 s, a reference", SCOUT, (30.0, 42.0), True),
    recommended("scans lost for 12 s, no reference", LEO, (30.0, 42.0), False),
)

OTHER = (*CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS, *RECOMMENDATION)
