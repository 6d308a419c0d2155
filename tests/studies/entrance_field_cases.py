"""A tenth set of inputs, for `entrance_commands field`: after threads of GitHub, whose numbers stand beside each input, with more than one
fault in a fifth of them, and some that are healthy and unusual.

Base logs are further parts of the real drives, and experiments of `skidloc simulate` that no other set has. Answers were written down
before the first run, which is scored: 40 of 65 right, 5 named, 17 misnamed, 3 silent. After it one input was changed that was not what was
meant (ways of a driver without turns that went back), and three judges: what the base log has itself is no new warning, the choice of a
topic is no measurement, and `replay` was called without its required options.
"""

from __future__ import annotations

import functools
import json
import math
import re
import tempfile
from collections.abc import Callable, Sequence
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
    MEADOW,
    OFFICE,
    ROBOTS,
    BaseLog,
    based,
    boreal,
    healthy,
    real_building,
    real_log,
    recommended,
    referred,
    simulated,
    written,
)
from tests.studies.entrance_command_cases import both, changed, q, shifted, stamp_of, without
from tests.studies.entrance_commands import Case, Edit, clouded, contradictions, initialized, replayed, run_command, warnings_in
from tests.studies.entrance_edits import (
    NAMES,
    RPM,
    beside,
    driver_odometry,
    in_namespace,
    joints,
    odometry_in,
    odometry_to_tf,
    rotated,
    table,
    upside_down,
)
from tests.studies.entrance_forum_cases import CLEARPATH_IMU, CLEARPATH_JOINTS, stored, zeros_between
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrance_symptom_cases import plugin
from tests.studies.entrances import Found, cylinder, link, urdf_of, wheel


def robot_log(robot: str, experiment: str, seed: int, seconds: float = 75.0, tolerance_m: float = 0.05) -> BaseLog:
    """The first ``seconds`` of an experiment."""
    text = (ROBOTS / f"{robot}.toml").read_text()
    return BaseLog(f"{robot}, {experiment}", text, simulated(robot, experiment, seed, 0.0, seconds), tolerance_m)


WEST = BaseLog("fr079, 400 to 490 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 400.0, 90.0))
PASSAGE = BaseLog("fr079, 205 to 295 s", CORRIDOR.robot, real_building("fr079", "fr079.mcap", 205.0, 90.0))
KITCHEN = BaseLog("MIT-CSAIL, 105 to 185 s", OFFICE.robot, real_building("mit-csail", "csail.mcap", 105.0, 80.0))
PLAZA = BaseLog("ACES, 240 to 325 s", HALL.robot, real_log("aces/aces.mcap", 240.0, 85.0))
LOGGIA = BaseLog("ACES, 930 to 1010 s", HALL.robot, real_log("aces/aces.mcap", 930.0, 80.0))
VERGE = BaseLog("Husky outdoors, 240 to 340 s", MEADOW.robot, real_log("husky-outdoor-gps/test1.bag", 240.0, 100.0), 0.5)
SAND = BaseLog("BorealTC sandy loam, 6 to 50 s", ASPHALT.robot, boreal("SANDY_LOAM", "01", 6.0, 44.0), 0.25)
JACKAL_WET = robot_log("jackal", "slippery_patch", 301)
A300_LOADED = robot_log("husky_a300", "payload_pickup", 302)
WARTHOG_LOADED = robot_log("warthog", "payload_pickup", 303, tolerance_m=0.1)
ROSBOT_WET = robot_log("rosbot", "slippery_patch", 304)
LEO_LOADED = robot_log("leo", "payload_pickup", 305)
MINI_WET = robot_log("scout_mini", "slippery_patch", 306)
P3DX_LOADED = robot_log("pioneer_3dx", "payload_pickup", 307)
P3AT_TOUR = robot_log("pioneer_3at", "controller_evaluation", 308)
PRO_WET = robot_log("rover_pro", "slippery_patch", 309)
XL_LOADED = robot_log("rosbot_xl", "payload_pickup", 310)
SCOUT_TOUR = robot_log("scout_2", "controller_evaluation", 311)
BURGER_WET = robot_log("turtlebot3_burger", "slippery_patch", 312)
VAULT_TOUR = robot_log("vaultbot", "controller_evaluation", 313)


# how inputs are judged


def _kinds(warned: str) -> set[str]:
    """Warnings without their numbers."""
    return {re.sub(r"[\d.]+", "", line) for line in warned.splitlines() if line.strip()}


@functools.cache
def _healthy_kinds(base: BaseLog) -> frozenset[str]:
    with tempfile.TemporaryDirectory() as name:
        log, robot, _ = written(Path(name), base, lambda records: records)
        return frozenset(_kinds(warnings_in(replayed(Path(name), log, robot)[1])))


@functools.cache
def _healthy_check(base: BaseLog) -> frozenset[str]:
    with tempfile.TemporaryDirectory() as name:
        log, robot, _ = written(Path(name), base, lambda records: records)
        return frozenset(_kinds(contradictions(Path(name), log, robot)))


def quiet(kind: str, name: str, base: BaseLog, edit: Edit) -> Case:
    """Unusual, but right: as good as the base log, with none of the warnings and contradictions that it has not."""
    inner = based(kind, name, base, edit)

    def judge(folder: Path) -> Found:
        found = inner.judge(folder)
        if found.outcome != "right":
            return found
        checked = contradictions(folder, folder / "log.mcap", folder / "robot.toml")
        is_quiet = not _kinds(found.text.partition("\n")[2]) - _healthy_kinds(base) and not _kinds(checked) - _healthy_check(base)
        return found if is_quiet else Found("misnamed", f"check: {checked} {found.text}")

    return Case(kind, name, judge)


def double(
    kind: str,
    name: str,
    base: BaseLog,
    edit: Edit,
    *groups: Sequence[str],
    is_open: bool = False,
    robot: Callable[[str], str] = lambda text: text,
) -> Case:
    """Two faults at once: right where each is named (one of the words of its group), named where one is and the errors are right."""
    inner = based(kind, name, base, edit, [word for group in groups for word in group], is_open=is_open, robot=robot)

    def judge(folder: Path) -> Found:
        found = inner.judge(folder)
        warned = found.text.partition("\n")[2]
        if found.outcome in ("silent", "misnamed") or all(any(word in warned for word in group) for group in groups):
            return found
        return Found("named" if found.outcome == "right" else "misnamed", found.text)

    return Case(kind, name, judge)


def readable(
    name: str,
    base: BaseLog,
    content: Callable[[Trajectory], str],
    suffix: str = "tum",
    words: Sequence[str] = (),
    edit: Edit = lambda records: records,
    reference: str = "",
    noise_m: float = 0.0,
) -> Case:
    """A reference of a form of its own: right where it is read as it is, or refused with exit 2 and one of ``words``."""
    inner = referred(name, base, content, suffix, (), edit, reference, noise_m)

    def judge(folder: Path) -> Found:
        found = inner.judge(folder)
        is_refused = found.text.startswith("[exit 2]") and any(word in found.text for word in words)
        return Found("right", found.text) if is_refused else found

    return Case("references", name, judge)


def checked(name: str, base: BaseLog, edit: Edit, absent: Sequence[str], words: Sequence[str] = ()) -> Case:
    """`skidloc check`: nothing is contradicted, nothing ``absent`` is seen to be right, and one of ``words`` is on the page."""

    def judge(folder: Path) -> Found:
        log, robot, _ = written(folder, base, edit)
        code, text = run_command("check", str(log), "--robot", str(robot), "--json", str(folder / "check.json"))
        if code:
            return Found("right" if any(word in text for word in words) else "misnamed", f"[exit {code}] {text}")
        rows = json.loads((folder / "check.json").read_text())["rows"]
        wrong = [r for r in rows if r["verdict"] == "contradiction"]
        seen = [r for r in rows if r["verdict"] == "ok" and not r["quantity"].startswith("topic")]
        wrong += [r for r in seen if any(word.lower() in r["quantity"].lower() for word in absent)]
        is_right = not wrong and (not words or any(word in text for word in words))
        return Found("right" if is_right else "misnamed", f"{wrong}\n{text}")

    return Case("check", name, judge)


def refused(name: str, words: Sequence[str], arguments: Callable[[Path, Path, Path], Sequence[str]]) -> Case:
    """Bad input: exit 2, and one of ``words``; ``arguments`` of the folder, the healthy log and its robot file."""

    def judge(folder: Path) -> Found:
        log, robot, _ = written(folder, SAND, lambda records: records)
        code, text = run_command(*arguments(folder, log, robot))
        is_named = any(word in text for word in words)
        return Found("right" if code == 2 and is_named else "misnamed" if code else "silent", f"[exit {code}] {text}")

    return Case("bad input", name, judge)


# clocks


def of_another_computer(topic: str, ahead_s: float) -> Edit:
    """Files of two computers put together by `mcap merge`: stamps and times of recording of one topic are ahead."""
    by = round(ahead_s * S)
    return lambda records: [(t, with_times(m, lambda ns: ns + by), log + by) if t == topic else (t, m, log) for t, m, log in records]


def played(rate: float) -> Edit:
    """Played at a ``rate`` and recorded anew, a day later: header stamps are as they were."""
    later = 86_400 * S
    return lambda records: [(t, m, START + later + round((log - START) / rate)) for t, m, log in records]


def exchanged_messages(topic: str, every: int) -> Edit:
    """Each so many messages arrive in the other order."""

    def edit(records: list[Record]) -> list[Record]:
        found = list(records)
        places = [i for i, r in enumerate(found) if r[0] == topic]
        for a, b in zip(places[::every], places[1::every], strict=False):
            one, two = found[a], found[b]
            found[a], found[b] = (topic, two[1], one[2]), (topic, one[1], two[2])
        return found

    return edit


def leaps(topic: str, by_s: float, count: int, every: int) -> Edit:
    """Stamps of ``count`` messages in ``every`` leap ahead, and come back."""
    seen: list[int] = []

    def change(message: Any) -> Any:
        seen.append(1)
        by = round(by_s * S) if len(seen) % every < count and len(seen) > every else 0
        return with_times(message, lambda ns: ns + by)

    return changed(topic, change)


CLOCKS = (
    # bno08x_ros2_driver 20: the field of nanoseconds has all nanoseconds since 1970, cut to 32 bits
    based(
        "clocks",
        "nanoseconds since 1970 cut to 32 bits",
        LEO_LOADED,
        changed("/imu/data", lambda m: with_times(m, lambda ns: ns // S * S + ns % 2**32)),
        ["/imu/data"],
    ),
    # rs_driver 75, rslidar_sdk 169: TAI and UTC
    double(
        "clocks",
        "LiDAR 37 s behind and mounted backwards, real",
        KITCHEN,
        both(shifted(("/scan",), lambda t: -37.0), rotated(math.pi)),
        ["/scan"],
        ["180 deg"],
    ),
    # rosbag2 764, mcap merge
    based("clocks", "scans of another computer, 2.4 s ahead", SCOUT_TOUR, of_another_computer("/scan", 2.4), ["/scan"]),
    # rosbag2 1056 and 764, evo 16
    quiet("clocks", "played at .6 of its rate and recorded anew", XL_LOADED, played(0.6)),
    # ros_comm 2336, turtlebot3 597
    based("clocks", "wheel messages in the other order, one in 7", JACKAL_WET, exchanged_messages(CLEARPATH_JOINTS, 7)),
    # sick_scan_xd 54
    based("clocks", "IMU's stamps leap by .8 s for five messages", A300_LOADED, leaps(CLEARPATH_IMU, 0.8, 5, 160), [CLEARPATH_IMU]),
)

# wheels and drivers


def clockwise_gyro(message: Any, t: float) -> Any:
    """fusioncore 88: differences of a compass heading."""
    message.angular_velocity.z = -message.angular_velocity.z
    return message


def faster(factor: float) -> Callable[[Any], Any]:
    """husky 193: other encoders after a repair, so that ways and turns are larger."""

    def change(m: Any) -> Any:
        p, twist = m.pose.pose, m.twist.twist
        yaw = 2.0 * math.atan2(p.orientation.z, p.orientation.w)
        return bags.odometry(
            stamp_of(m), factor * p.position.x, factor * p.position.y, yaw, factor * twist.linear.x, factor * twist.angular.z
        )

    return change


def wrong_way_down(range_rad: float) -> Edit:
    """libcreate 71: a counter that wraps is undone forwards alone; backwards the angle jumps up by its range."""
    last: list[np.ndarray] = []
    jumps = np.zeros(2)

    def change(m: Any) -> Any:
        turns = np.floor((np.array(m.position) + 0.4) / range_rad)
        if last:
            jumps[:] += np.maximum(last[-1] - turns, 0.0)
        last.append(turns)
        return bags.joint_state(stamp_of(m), m.name, np.array(m.position) + range_rad * jumps, [])

    return changed("/joint_states", change)


def far_away(m: Any) -> Any:
    """A driver whose odom frame is UTM's."""
    m.pose.pose.position.x += 448_262.0
    m.pose.pose.position.y += 5_411_932.0
    return m


def without_turns() -> Callable[[Any], Any]:
    """create_robot 42: ways alone, along x."""
    last: list[tuple[float, float]] = []
    way = [0.0]

    def change(m: Any) -> Any:
        p = m.pose.pose
        yaw = 2.0 * math.atan2(p.orientation.z, p.orientation.w)
        if last:
            way[0] += (p.position.x - last[-1][0]) * math.cos(yaw) + (p.position.y - last[-1][1]) * math.sin(yaw)
        last.append((p.position.x, p.position.y))
        return bags.odometry(stamp_of(m), way[0], 0.0, 0.0, 0.0, 0.0)

    return change


def averaged(count: int) -> Edit:
    """ros2_controllers 1841, husky 217: velocities are the mean of the last ``count``; poses are right."""
    last: list[tuple[float, float]] = []

    def change(m: Any) -> Any:
        twist = m.twist.twist
        last.append((twist.linear.x, twist.angular.z))
        v, w = np.mean(last[-count:], axis=0)
        twist.linear.x, twist.angular.z = float(v), float(w)
        return m

    return changed("/skid_steer_controller/odom", change)


def ticks(message: Any) -> list[tuple[str, Any]]:
    """differential_drive, diff_drive 8: a number for each wheel, without stamps."""
    kind = bags.T["std_msgs/msg/Int16"]
    counts = np.round(np.array(message.position) * 300.0).astype(int) % 32_768
    return [("/lwheel", kind(data=int(counts[0]))), ("/rwheel", kind(data=int(counts[1])))]


def topic_each(late_s: float) -> Edit:
    """A topic for each wheel; the rear right controller's stamps are late."""

    def change(m: Any) -> list[tuple[str, Any]]:
        found = []
        for i, name in enumerate(m.name):
            late = round(late_s * S) if name.startswith("rear_right") else i * S // 1000
            found.append((f"/{name}/state", bags.joint_state(stamp_of(m) + late, [name], [m.position[i]], [m.velocity[i]])))
        return found

    return changed(CLEARPATH_JOINTS, change)


def dies(topic: str, wheel_number: int, at_s: float) -> Edit:
    """An encoder counts no more."""
    held: list[float] = []

    def change(m: Any, t: float) -> Any:
        angles, rates = np.array(m.position), np.array(m.velocity)
        if t > at_s:
            held.append(angles[wheel_number])
            angles[wheel_number], rates[wheel_number] = held[0], 0.0
        return bags.joint_state(stamp_of(m), m.name, angles, rates)

    return each(topic, change)


def larger_radius(factor: float) -> Callable[[str], str]:
    """A robot file whose wheels are larger."""

    def change(text: str) -> str:
        return re.sub(r"^(wheel_radius_m = )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) * factor:.5f}", text, flags=re.MULTILINE)

    return change


WHEELS = (
    double(
        "wheels",
        "gyro clockwise, LiDAR backwards",
        P3DX_LOADED,
        both(each("/imu/data", clockwise_gyro), rotated(math.pi)),
        ["rate_unit_rad_s", "gyro's sign"],
        ["180 deg"],
    ),
    based(
        "wheels",
        "driver's ways and turns twice as large, GPS alone, real",
        VERGE,
        changed("/husky_velocity_controller/odom", faster(2.0)),
        ["radius", "length_unit", "ways", "/fix", "GPS"],
        is_open=True,
    ),
    based("wheels", "a counter that wraps, undone forwards alone", BURGER_WET, wrong_way_down(13.0), ["jump", "reset", "counter", "wrap"]),
    # jackal_robot 39: the controller keeps the angles of its life
    quiet(
        "wheels",
        "angles begin at 250,000 rad, 32 bits",
        JACKAL_WET,
        joints(lambda a, r: ((a + 250_000.0).astype(np.float32).astype(float), r), CLEARPATH_JOINTS),
    ),
    # novatel_oem7_driver: odometry in UTM
    quiet("wheels", "driver's odometry 5,000 km away, real", PLAZA, changed("/odom", far_away)),
    based("wheels", "driver's odometry without turns, real", LOGGIA, changed("/odom", without_turns()), ["turn", "heading"], is_open=True),
    # hoverboard-driver: whole revolutions per minute
    quiet("wheels", "rates in steps of one rpm, no angles", MINI_WET, joints(lambda a, r: ([], np.round(r * RPM) / RPM))),
    # linorobot2 197: cheap encoders
    quiet("wheels", "40 counts for a turn, no rates", LEO_LOADED, joints(lambda a, r: (np.floor(a * 40 / math.tau) * math.tau / 40, []))),
    based(
        "wheels",
        "driver's velocities averaged over 1 s",
        PRO_WET,
        both(driver_odometry(0.122, 0.36), averaged(50)),
    ),
    based("wheels", "ticks as Int16 on /lwheel and /rwheel", BURGER_WET, changed("/joint_states", ticks), ["/lwheel"], refused=True),
    based("wheels", "a topic for each wheel, one .3 s late", A300_LOADED, topic_each(0.3), ["rear_right"]),
    double(
        "wheels",
        "rpm, LiDAR upside down",
        XL_LOADED,
        both(joints(lambda a, r: ([], RPM * r)), changed("/scan", upside_down)),
        ["revolutions", "rpm"],
        ["upside"],
    ),
    double(
        "wheels",
        "encoder dies half way, IMU .4 s late",
        WARTHOG_LOADED,
        both(dies(CLEARPATH_JOINTS, 1, 32.0), shifted((CLEARPATH_IMU,), lambda t: 0.4)),
        ["rear_left"],
        [CLEARPATH_IMU],
    ),
    double(
        "wheels",
        "driver's odometry in feet, LiDAR at -90 deg, real",
        WEST,
        both(odometry_in(3.28084), rotated(-math.pi / 2)),
        ["length_unit", "feet", "unit than metres"],
        ["90 deg"],
    ),
    double(
        "wheels",
        "gyro in deg/s, wheels .5 s behind",
        PRO_WET,
        both(
            each("/imu/data", lambda m, t: _scaled_gyro(m, 57.2958)),
            shifted(("/joint_states",), lambda t: -0.5),
        ),
        ["deg/s"],
        ["/joint_states"],
    ),
    double(
        "wheels",
        "left side reversed, radius of the file .4 too large",
        P3AT_TOUR,
        joints(lambda a, r: (a * [-1, -1, 1, 1], r * [-1, -1, 1, 1])),
        ["joints.reversed"],
        ["radius"],
        robot=larger_radius(1.4),
    ),
    double(
        "wheels",
        "a publisher of zeros, sides swapped",
        SCOUT_TOUR,
        both(joints(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]])), changed("/joint_states", zeros_between)),
        ["publish"],
        ["joints.left", "swapped"],
    ),
)


def _scaled_gyro(message: Any, factor: float) -> Any:
    w = message.angular_velocity
    w.x, w.y, w.z = factor * w.x, factor * w.y, factor * w.z
    return message


# mounts


def negative_force(message: Any, t: float) -> Any:
    """ublox 88: accelerations with the other sign; gyro and axes are right."""
    a = message.linear_acceleration
    a.x, a.y, a.z = -a.x, -a.y, -a.z
    return message


OPTICAL = "camera_imu_optical_frame"


def optical_imu(has_transform: bool) -> Edit:
    """realsense-ros 1176: x to the right, y down, z ahead."""

    def turn(message: Any, t: float) -> Any:
        for v in (message.angular_velocity, message.linear_acceleration):
            v.x, v.y, v.z = -v.y, -v.z, v.x
        message.header.frame_id = OPTICAL if has_transform else message.header.frame_id
        return message

    def add(message: Any) -> Any:
        extra = bags.tf(START, [("base_link", OPTICAL, (0.1, 0.0, 0.2), bags.quaternion(-math.pi / 2, 0.0, -math.pi / 2))])
        message.transforms = [*message.transforms, *extra.transforms]
        return message

    return both(each("/imu/data", turn), changed("/tf_static", add if has_transform else lambda m: m))


def rotation_of(x: float, y: float, z: float, w: float, frame: str = "laser") -> Edit:
    """The quaternion of a static transform."""

    def change(message: Any) -> Any:
        for one in message.transforms:
            if one.child_frame_id == frame:
                one.transform.rotation = bags.T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
        return message

    return changed("/tf_static", change)


def parent_and_child_exchanged(message: Any) -> Any:
    """The LiDAR's transform as that of the base in the LiDAR's frame, with the numbers of the other."""
    for one in message.transforms:
        if one.child_frame_id == "laser":
            one.header.frame_id, one.child_frame_id = "laser", "base_link"
    return message


MOUNTS = (
    based("mounts", "accelerations with the other sign, off road", SAND, each("/imu/data", negative_force), ["gravity", "accelerat"]),
    quiet("mounts", "IMU in optical axes, with its transform", LEO_LOADED, optical_imu(True)),
    based("mounts", "IMU in optical axes, without its transform", VAULT_TOUR, optical_imu(False), ["gravity", "mount", "vertical"]),
    # quad-sdk 346, OrbbecSDK_ROS1 49
    based("mounts", "quaternion of four zeros", MINI_WET, rotation_of(0.0, 0.0, 0.0, 0.0), ["quaternion", "rotation"]),
    # imu_tools 67, rtabmap_ros 153
    quiet("mounts", "quaternion of length 1.0003", ROSBOT_WET, rotation_of(0.0, 0.0, 0.0, 1.0003)),
    based(
        "mounts", "parent and child of the LiDAR exchanged", P3AT_TOUR, changed("/tf_static", parent_and_child_exchanged), ["x =", "laser"]
    ),
    double(
        "mounts",
        "LiDAR upside down, sides swapped",
        ROSBOT_WET,
        both(changed("/scan", upside_down), joints(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]]))),
        ["upside"],
        ["joints.left", "swapped"],
    ),
)

# topics


def with_depth_cloud(records: list[Record]) -> list[Record]:
    """A depth camera's cloud at 5 Hz, of a frame without a transform."""
    rng, more = np.random.default_rng(17), []
    for t in np.arange(0.1, 74.0, 0.2):
        points = np.zeros(80, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
        points["x"], points["y"], points["z"] = rng.uniform(-1, 1, 80), rng.uniform(-0.5, 0.5, 80), rng.uniform(0.5, 4.0, 80)
        stamp = START + round(t * S)
        more.append(("/camera/depth/points", bags.cloud(stamp, points, "camera_depth_optical_frame"), stamp + S // 20))
    return [*records, *more]


def second_transform(base: BaseLog) -> Edit:
    """robot_localization 950, rtabmap_ros 645: the driver and a localization both publish odom to base_footprint on /tf, alone."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        more = [
            ("/tf", bags.tf(t, [("odom", "base_footprint", (x + 6.0, y - 3.0, 0.0), bags.quaternion(a + 1.0))]), t + S // 50)
            for t, (x, y, a) in zip(track.stamps_ns[::3].tolist(), track.poses[::3].tolist(), strict=True)
        ]
        return [*changed("/odom", odometry_to_tf)(records), *more]

    return edit


def cut_off(path: Path, records: list[Record]) -> Path:
    """The battery is pulled while recording: the file has no end."""
    log = bags.write_mcap(path.with_suffix(".mcap"), records)
    with log.open("r+b") as file:
        file.truncate(int(0.97 * log.stat().st_size))
    return log


TOPICS = (
    # stage_ros
    based(
        "topics",
        "the simulator's truth alone",
        MINI_WET,
        both(beside(MINI_WET, "/base_pose_ground_truth"), without("/joint_states")),
        ["no wheels"],
        refused=True,
    ),
    quiet("topics", "a depth camera's cloud beside, without a transform", SCOUT_TOUR, with_depth_cloud),
    based("topics", "two publishers of the base's transform, real", PLAZA, second_transform(PLAZA), ["/tf"]),
    based("topics", "file without its end", JACKAL_WET, stored(cut_off)),
    based(
        "topics",
        "namespace beside a filter, LiDAR since it was switched on",
        P3AT_TOUR,
        both(shifted(("/scan",), lambda t: 40.0 - START / S), in_namespace(P3AT_TOUR, "p3at_07")),
        ["/scan"],
    ),
)

# references

LAT, LON = 47.3, 8.5


def geographic(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude [deg]."""
    return LAT + math.degrees(y / 6.3674e6), LON + math.degrees(x / (6.3893e6 * math.cos(math.radians(LAT))))


def sexagesimal(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """Degrees, minutes and seconds in columns of their own."""
    row: list[float] = [t]
    for angle in geographic(x, y):
        minutes = 60.0 * (angle % 1.0)
        row += [int(angle), int(minutes), 60.0 * (minutes % 1.0)]
    return tuple(row)


def of_nmea(t: float, x: float, y: float, a: float) -> tuple[float, ...]:
    """ddmm.mmmm, as a receiver writes them."""
    return t, *(100.0 * int(angle) + 60.0 * (angle % 1.0) for angle in geographic(x, y))


def path_topic(base: BaseLog) -> Edit:
    """evo 614: the whole path so far, each second."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        poses = [
            bags.pose_stamped(t, x, y, a) for t, (x, y, a) in zip(track.stamps_ns[::4].tolist(), track.poses[::4].tolist(), strict=True)
        ]
        more = []
        for n in range(5, len(poses), 25):
            stamp = stamp_of(poses[n])
            more.append(
                ("/slam/path", bags.T["nav_msgs/msg/Path"](header=bags.header(stamp, "map"), poses=poses[: n + 1]), stamp + S // 50)
            )
        more.append(("/slam/path", bags.T["nav_msgs/msg/Path"](header=poses[-1].header, poses=poses), stamp_of(poses[-1]) + S // 50))
        return [*records, *more]

    return edit


def station(base: BaseLog) -> Edit:
    """A total station's prism as PointStamped, 5 Hz."""

    def edit(records: list[Record]) -> list[Record]:
        track = healthy(base).reference
        more = []
        for t, (x, y, _) in zip(track.stamps_ns[::4].tolist(), track.poses[::4].tolist(), strict=True):
            message = bags.point_stamped(t, x + 2.0, y + 1.0, 0.4)
            message.header.frame_id = "leica"
            more.append(("/leica/position", message, t + S // 20))
        return [*records, *more]

    return edit


def of_excel(track: Trajectory) -> str:
    """Saved by a spreadsheet."""
    return "\ufeffsep=;\r\n" + table(track, lambda t, x, y, a: (t, x, y, a), "time;x;y;yaw", ";").replace("\n", "\r\n")


def killed_logger(track: Trajectory) -> str:
    """Two threads write, so that lines are in another order; the last one is cut."""
    lines = table(track, lambda t, x, y, a: (t, x, y, 0.0, *q(a))).splitlines()
    for i in range(10, len(lines) - 2, 20):
        lines[i], lines[i + 1] = lines[i + 1], lines[i]
    return "\n".join(lines)[:-31]


def switching(track: Trajectory) -> str:
    """crazyswarm2 449: a rigid body of symmetric markers, whose heading is now and then the opposite one."""
    rng = np.random.default_rng(23)
    flips = np.repeat(rng.random(len(track.poses) // 20 + 1) < 0.15, 20)[: len(track.poses)]
    turned = track.poses + np.column_stack([np.zeros((len(flips), 2)), math.pi * flips])
    return table(Trajectory(track.stamps_ns, turned), lambda t, x, y, a: (t, x, y, 0.0, *q(a)))


def frozen(track: Trajectory) -> str:
    """crazyswarm 50: markers are hidden for 2 s of 16, in which the last pose is repeated."""
    poses, held = track.poses.copy(), 0
    for i, ns in enumerate(track.stamps_ns):
        held = held if (ns - START) / S % 16.0 > 14.0 else i
        poses[i] = track.poses[held]
    return table(Trajectory(track.stamps_ns, poses), lambda t, x, y, a: (t, x, y, 0.0, *q(a)), every=1)


REFERENCES = (
    # UrbanNavDataset 9, KLTDataset 4
    readable(
        "degrees, minutes and seconds",
        WARTHOG_LOADED,
        lambda r: table(r, sexagesimal, "time,lat_deg,lat_min,lat_sec,lon_deg,lon_min,lon_sec", ","),
        "csv",
        ["lat"],
        noise_m=0.05,
    ),
    referred(
        "seconds of the GPS week",
        A300_LOADED,
        lambda r: table(r, lambda t, x, y, a: ((t - 315_964_800.0 + 18.0) % 604_800.0, x, y, 0.0, *q(a))),
        words=["none lies"],
    ),
    readable("nav_msgs/Path that grows", XL_LOADED, lambda r: "", words=["Path"], edit=path_topic(XL_LOADED), reference="/slam/path"),
    readable(
        "a total station's PointStamped",
        WARTHOG_LOADED,
        lambda r: "",
        words=["PointStamped"],
        edit=station(WARTHOG_LOADED),
        reference="/leica/position",
        noise_m=0.05,
    ),
    referred("a spreadsheet's mark, separator line and line ends", LEO_LOADED, of_excel, "csv"),
    referred("lines in another order, the last one cut, real", WEST, killed_logger),
    referred("headings that switch by 180 deg", SCOUT_TOUR, switching),
    referred("poses that stand while markers are hidden", MINI_WET, frozen, noise_m=0.05),
    readable(
        "ddmm.mmmm as degrees", PRO_WET, lambda r: table(r, of_nmea, "time,latitude,longitude", ","), "csv", ["latitude"], noise_m=0.05
    ),
    referred(
        "north, east, down, and TAI",
        MINI_WET,
        lambda r: table(r, lambda t, x, y, a: (t + 37.0, y, x, 0.0, *q(math.pi / 2 - a))),
        words=["mirrored", "37"],
    ),
    referred(
        "centimetres, body turned by 90 deg",
        ROSBOT_WET,
        lambda r: table(r, lambda t, x, y, a: (t, 100.0 * x, 100.0 * y, 0.0, *q(a - math.pi / 2))),
        words=["100", "90 deg"],
    ),
)

# times of points

DRUM = Vehicle(0.16, 0.6, 0.48, 0.6, 0.5, 0.9, wheels_hz=40.0, imu_hz=0.0, room=(14.0, 11.0), seed=1001)
POINTS = (
    # vbr-devkit 7: the first clouds are put together of packets of different sweeps
    clouded(
        "first clouds of 3.6 s",
        DRUM,
        "time",
        "f4",
        lambda u, period, stamp: u * period * (36.0 if stamp < START + 4 * S // 10 else 1.0),
    ),
    # dimos 3103: offsets before the first packet wrap around
    clouded(
        "nanoseconds below zero wrap in 32 bits",
        DRUM,
        "offset_time",
        "u4",
        lambda u, period, stamp: np.round(1e9 * (u - 0.01) * period) % 2.0**32,
    ),
    clouded("counts of 2.304 us", DRUM, "t", "u4", lambda u, period, stamp: np.round(u * period / 2.304e-6)),
    # velodyne 402: all points of a packet have the time of the packet
    clouded("times of 76 packets", DRUM, "time", "f4", lambda u, period, stamp: np.floor(76.0 * u) / 76.0 * period),
)

# descriptions

BARROW = Vehicle(0.13, 0.52, 0.4, 0.6, 0.5, 0.9, wheels_hz=30.0, imu_hz=60.0, room=(12.0, 10.0), seed=1011)
MIMIC = {"rear_left_wheel": "front_left_wheel", "rear_right_wheel": "front_right_wheel"}


def six_wheels(vehicle: Vehicle) -> str:
    """osr-rover-code: middle wheels, which the log has not."""
    middle = [wheel(f"middle_{s}_wheel", f"middle_{s}", 0.0, y, cylinder(vehicle.radius)) for s, y in (("left", 0.26), ("right", -0.26))]
    return urdf_of(vehicle, NAMES, more="".join(middle))


def mimicking(vehicle: Vehicle) -> str:
    """Rear joints follow the front ones."""
    text = urdf_of(vehicle, NAMES)
    for rear, front in MIMIC.items():
        text = re.sub(f'(<joint name="{rear}".*?)</joint>', rf'\1<mimic joint="{front}" multiplier="1"/></joint>', text)
    return text


def facing_y(vehicle: Vehicle) -> str:
    """ugv_gazebo_sim 2: a CAD export whose front is y, without any frame that has it at x."""
    half, side = vehicle.wheelbase / 2, vehicle.track / 2
    shape = f'<collision><origin rpy="0 1.5707963 0"/><geometry><cylinder radius="{vehicle.radius}" length="0.08"/></geometry></collision>'
    places = ((-side, half), (-side, -half), (side, half), (side, -half))
    parts = [wheel(name, f"{name}_link", x, y, shape, axis="-1 0 0") for name, (x, y) in zip(NAMES, places, strict=True)]
    return f'<robot name="r">{link("base_link")}{"".join(parts)}</robot>'


def with_casters(vehicle: Vehicle) -> str:
    """Two swivelling casters ahead of the wheels, each of two continuous joints."""
    parts = []
    for side, y in (("left", 0.1), ("right", -0.1)):
        parts.append(
            link(f"{side}_fork") + f'<joint name="{side}_caster_swivel" type="continuous"><parent link="base_link"/>'
            f'<child link="{side}_fork"/><origin xyz="0.5 {y} 0"/><axis xyz="0 0 1"/></joint>'
        )
        parts.append(wheel(f"{side}_caster_wheel", f"{side}_caster", -0.03, 0.0, cylinder(0.04, 0.03), parent=f"{side}_fork"))
    return urdf_of(vehicle, NAMES, more="".join(parts))


def small_collision(vehicle: Vehicle) -> str:
    """A small sphere as collision shape, so that Gazebo's wheels slip less; the visual has the radius."""
    shape = (
        f'<collision><geometry><sphere radius="{0.4 * vehicle.radius:.3f}"/></geometry></collision><visual><origin rpy="1.5707963 0 0"/>'
        f'<geometry><cylinder radius="{vehicle.radius}" length="0.08"/></geometry></visual>'
    )
    return urdf_of(vehicle, NAMES, shape)


DESCRIPTIONS = (
    initialized("middle wheels that the log has not", BARROW, six_wheels(BARROW)),
    initialized("rear wheels mimic the front ones", replace(BARROW, seed=1012), mimicking(BARROW)),
    initialized(
        "revolute wheels with limits",
        replace(BARROW, seed=1013),
        urdf_of(BARROW, NAMES)
        .replace('type="continuous"', 'type="revolute"')
        .replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><limit lower="-1e16" upper="1e16" effort="20" velocity="20"/>'),
    ),
    initialized("front along y", replace(BARROW, seed=1014), facing_y(BARROW)),
    initialized("swivelling casters ahead", replace(BARROW, seed=1015), with_casters(BARROW)),
    initialized(
        "collision shape of .4 of the visual's radius",
        replace(BARROW, seed=1016),
        small_collision(BARROW),
        Publishing(has_odometry=True),
        ["radius"],
    ),
    initialized(
        "names of the other sides, half the radius in the plugin",
        replace(BARROW, seed=1017),
        urdf_of(BARROW, (NAMES[2], NAMES[3], NAMES[0], NAMES[1]), more=plugin(0.5 * BARROW.radius, BARROW.track)),
        Publishing(has_odometry=True),
        ["left", "radius"],
    ),
)

# recommendation, check, bad input

RECOMMENDATIONS = (
    recommended("scans missing for 7 s, reference", JACKAL_WET, (30.0, 37.0), True),
    recommended("scans missing for 10 s, real", KITCHEN, (40.0, 50.0), False),
)

CHECKS = (
    checked("wheels alone", SCOUT_TOUR, both(without("/scan"), without("/imu/data"), without("/tf_static")), ["LiDAR", "IMU", "gyro"]),
    checked(
        "a robot that never moves",
        LEO_LOADED,
        lambda records: _standing(records),
        ["LiDAR", "gyro", "radius"],
        ["drive", "moves"],
    ),
)


def _standing(records: list[Record]) -> list[Record]:
    """Messages of the robot at rest, for 20 s."""
    first: dict[str, Any] = {}
    found = []
    for t, m, log in records:
        if log > START + 20 * S:
            continue
        new = m
        if t == "/joint_states":
            new = bags.joint_state(stamp_of(m), m.name, np.zeros(len(m.name)), np.zeros(len(m.name)))
        elif t == "/imu/data":
            new = bags.imu(stamp_of(m), (0.0, 0.0, 0.002), (0.0, 0.0, 9.81), m.header.frame_id)
        elif t == "/scan":
            kept = first.setdefault(t, m)
            m.ranges = np.array(kept.ranges)
        found.append((t, new, log))
    return found


def _file(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


LFS = (
    "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)
PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n0 0 0\n1 1 0\n"
RUN = ("--model", "skid_steer", "--estimator", "odometry,ekf", "--out", "out")
BAD = (
    refused(
        "a URDF as the robot file",
        ["URDF", "--urdf"],
        lambda folder, log, robot: ["replay", str(log), *RUN, "--robot", str(_file(folder / "robot.urdf", urdf_of(BARROW, NAMES)))],
    ),
    refused(
        "a pointer of Git LFS as the log",
        ["LFS", "lfs"],
        lambda folder, log, robot: ["replay", str(_file(folder / "pointer.mcap", LFS)), *RUN, "--robot", str(robot)],
    ),
    refused(
        "a point cloud as the reference",
        ["TUM"],
        lambda folder, log, robot: ["replay", str(log), *RUN, "--robot", str(robot), "--reference", str(_file(folder / "map.pcd", PCD))],
    ),
    refused(
        "a controller's YAML as the URDF",
        ["URDF"],
        lambda folder, log, robot: [
            "init",
            str(log),
            "--urdf",
            str(_file(folder / "control.yaml", "controller_manager:\n  ros__parameters:\n    update_rate: 50\n")),
            "--out",
            str(folder / "new.toml"),
        ],
    ),
)

FIELD: tuple[Case, ...] = (
    *CLOCKS,
    *WHEELS,
    *MOUNTS,
    *TOPICS,
    *REFERENCES,
    *POINTS,
    *DESCRIPTIONS,
    *RECOMMENDATIONS,
    *CHECKS,
    *BAD,
)
