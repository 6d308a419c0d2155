"""Logs as a sceptical user brings them: messages that follow no convention, or another than most drivers'; for `entrance_commands`."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np

from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Publishing, Vehicle, cast, drive, with_times
from tests.studies.entrance_command_cases import JACKAL, NO_IMU, ROSBOT, SCANS, TURTLE, WARTHOG, changed, stamp_of, without
from tests.studies.entrance_commands import Edit, driven

LEVEL = bags.quaternion()


def each(topic: str, change: Callable[[Any, float], Any]) -> Edit:
    """``change`` of each message of ``topic`` by its time of recording since the start [s]; None leaves one out."""

    def edit(records: list[Record]) -> list[Record]:
        found = [(t, change(m, (log - START) / S) if t == topic else m, log) for t, m, log in records]
        return [record for record in found if record[1] is not None]

    return edit


def set_fields(topic: str, **values: Any) -> Edit:
    """Fields of a topic's messages."""

    def change(message: Any, t: float) -> Any:
        for name, value in values.items():
            setattr(message, name, value(message) if callable(value) else value)
        return message

    return each(topic, change)


def mounted_at(*edges: tuple[str, str, tuple[float, float, float], Any]) -> Edit:
    """Other static transforms."""

    def edit(records: list[Record]) -> list[Record]:
        return [("/tf_static", bags.tf(START, edges), START), *(record for record in records if record[0] != "/tf_static")]

    return edit


IMU_MOUNT = ("base_link", "imu_link", (0.0, 0.0, 0.1), LEVEL)
LASER_MOUNT = ("base_link", "laser", (0.15, 0.0, 0.3), LEVEL)


def _second_lidar(vehicle: Vehicle, topic: str, first: str, is_shared: bool = False) -> Edit:
    """A second LiDAR at the rear, turned by 180 degrees, on ``topic``; the first one on ``first``. Both see their half."""
    motion, rng = drive(vehicle), np.random.default_rng(4)

    def half(message: Any) -> Any:
        angles = message.angle_min + message.angle_increment * np.arange(len(message.ranges))
        message.ranges = np.where(np.abs(angles) < math.pi / 2, message.ranges, np.inf).astype(np.float32)
        return message

    def edit(records: list[Record]) -> list[Record]:
        angles = -math.pi + math.tau * np.arange(vehicle.beams) / vehicle.beams
        found = [(first if t == "/scan" else t, half(m) if t == "/scan" else m, log) for t, m, log in records if t != "/tf_static"]
        for t in np.arange(0.05, motion.t[-1], 1.0 / vehicle.scan_hz):
            x, y, yaw = motion.poses[motion.at(t)]
            x, y = x - 0.15 * math.cos(yaw), y - 0.15 * math.sin(yaw)
            ranges = cast(x, y, yaw + math.pi + angles, vehicle.room) + 0.008 * rng.normal(size=len(angles))
            stamp = START + round(t * S)
            scan = bags.laser_scan(stamp, ranges, angle_min=-math.pi, angle_increment=math.tau / vehicle.beams, frame_id="laser_rear")
            found.append((topic, half(scan), stamp + S // 80))
        mounts = (IMU_MOUNT, LASER_MOUNT, ("base_link", "laser_rear", (-0.15, 0.0, 0.3), bags.quaternion(math.pi)))
        return [("/tf_static", bags.tf(START, mounts), START), *found]

    return edit


def _turned_imu(vehicle: Vehicle, yaw: float, pitch: float = 0.0) -> Edit:
    """The accelerometer measures the drive's accelerations too; the IMU is turned, which /tf_static does not have."""
    motion = drive(vehicle)
    forward = np.gradient(motion.twists[:, 0], 0.01)
    side = motion.twists[:, 0] * motion.twists[:, 1]
    c, s = math.cos(yaw), math.sin(yaw)
    rng = np.random.default_rng(8)

    def change(message: Any, t: float) -> Any:
        i = motion.at((stamp_of(message) - START) / S)
        a = np.array([c * forward[i] + s * side[i], -s * forward[i] + c * side[i], 9.81]) + 0.05 * rng.normal(size=3)
        message.linear_acceleration = bags.vector(*a)
        return message

    return each("/imu/data", change)


def _repeated_stamps(message: Any) -> list[tuple[str, Any]]:
    """Four messages of 1 ms each with the stamp of the first."""
    return [("/imu/data", message)] * 4


def _fast_imu(vehicle: Vehicle) -> Edit:
    """1 kHz, stamps rounded to 4 ms."""
    motion, rng = drive(vehicle), np.random.default_rng(6)

    def edit(records: list[Record]) -> list[Record]:
        more = []
        for t in np.arange(0.0, motion.t[-1], 0.001):
            w = motion.twists[motion.at(t), 1] + 0.004 + 0.01 * rng.normal()
            stamp = START + int(t * 250.0) * (S // 250)
            more.append(("/imu/data", bags.imu(stamp, (0.0, 0.0, w)), START + round(t * S) + S // 500))
        return [*(record for record in records if record[0] != "/imu/data"), *more]

    return edit


def _dead(joint: int, since_s: float, value: str = "frozen") -> Callable[[Any, float], Any]:
    """One encoder dies: its angle stays and its rate is zero."""
    last: list[float] = []

    def change(message: Any, t: float) -> Any:
        if t < since_s:
            last[:] = [float(message.position[joint])]
            return message
        position, velocity = message.position.copy(), message.velocity.copy()
        position[joint] = math.nan if value == "nan" else (last or [0.0])[0]
        velocity[joint] = math.nan if value == "nan" else 0.0
        return bags.joint_state(stamp_of(message), message.name, position, velocity)

    return change


def _shuffled(message: Any, t: float) -> Any:
    order = np.random.default_rng(stamp_of(message) % 2**32).permutation(len(message.name))
    return bags.joint_state(stamp_of(message), [message.name[i] for i in order], message.position[order], message.velocity[order])


def _prefixed(message: Any, t: float) -> Any:
    return bags.joint_state(stamp_of(message), [f"robot1/{name}" for name in message.name], message.position, message.velocity)


def _twice(records: list[Record]) -> list[Record]:
    return [(t, m, log + d) for t, m, log in records for d in (0, S // 300)]


def _sim_time(from_s: float) -> Edit:
    """Stamps count from zero after ``from_s`` (use_sim_time was set on the way)."""

    def edit(records: list[Record]) -> list[Record]:
        begin = START + round(from_s * S)
        return [
            (t, with_times(m, lambda ns: ns if ns < begin else ns - begin + 5 * S) if t != "/tf_static" else m, log)
            for t, m, log in records
        ]

    return edit


def _unstamped(records: list[Record]) -> list[Record]:
    """No driver sets its stamps."""
    return [(t, m if t == "/tf_static" else with_times(m, lambda ns: 0), log) for t, m, log in records]


def _backwards_beams(message: Any, t: float) -> Any:
    """From left to right: angle_increment is negative."""
    n = len(message.ranges)
    last = message.angle_min + message.angle_increment * (n - 1)
    message.ranges = message.ranges[::-1].copy()
    message.angle_min, message.angle_max, message.angle_increment = last, message.angle_min, -message.angle_increment
    return message


def _from_zero(message: Any, t: float) -> Any:
    """Beams from 0 to 360 degrees."""
    n = len(message.ranges)
    message.ranges = np.roll(message.ranges, -(n // 2))
    message.angle_min, message.angle_max = 0.0, message.angle_increment * (n - 1)
    return message


def _spoiled(message: Any, t: float) -> Any:
    """NaN, inf, -inf, 0 and negative ranges in one beam of six."""
    ranges = message.ranges.copy()
    for i, value in enumerate((np.nan, np.inf, -np.inf, 0.0, -1.0)):
        ranges[i :: 6 * 5] = value
    message.ranges = ranges
    return message


def _nan_covariances(message: Any, t: float) -> Any:
    for name in ("orientation", "angular_velocity", "linear_acceleration"):
        setattr(message, f"{name}_covariance", np.full(9, np.nan))
    return message


def _orientation_only(vehicle: Vehicle, is_marked: bool) -> Edit:
    """An IMU that measures the heading: rates and forces are zero, by ROS's convention marked by -1 in their covariance."""
    motion = drive(vehicle)

    def change(message: Any, t: float) -> Any:
        message.orientation = bags.quaternion(motion.poses[motion.at((stamp_of(message) - START) / S)][2])
        message.angular_velocity, message.linear_acceleration = bags.vector(), bags.vector()
        if is_marked:
            message.angular_velocity_covariance = message.linear_acceleration_covariance = np.r_[-1.0, np.zeros(8)]
        return message

    return each("/imu/data", change)


def _camera_imu(records: list[Record]) -> list[Record]:
    """A camera publishes gyro and accelerometer on topics of their own, each with zeros for the other."""
    found: list[Record] = []
    for t, m, log in records:
        if t != "/imu/data":
            found.append((t, m, log))
            continue
        gyro = bags.imu(stamp_of(m), (0.0, 0.0, m.angular_velocity.z), (0.0, 0.0, 0.0), "imu_link")
        force = bags.imu(stamp_of(m) + S // 500, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), "imu_link")
        found += [("/camera/accel/sample", force, log + 1000), ("/camera/gyro/sample", gyro, log)]
    return found


def _pushed(vehicle: Vehicle, seconds: float = 5.0) -> tuple[Vehicle, Edit]:
    """Somebody pushes the robot to its start: wheels read zero, gyro and LiDAR measure the motion; then its wheels count from zero."""
    first = np.zeros(4)

    def change(message: Any, t: float) -> Any:
        if t < seconds:
            first[:] = message.position
            return bags.joint_state(stamp_of(message), message.name, np.zeros(4), np.zeros(4))
        return bags.joint_state(stamp_of(message), message.name, message.position - first, message.velocity)

    return vehicle, each("/joint_states", change)


def _reset_encoders(at_s: float) -> Edit:
    """The driver of the wheels starts anew: angles from zero."""
    first: list[np.ndarray] = []

    def change(message: Any, t: float) -> Any:
        if t >= at_s:
            first[:] = first or [message.position.copy()]
            return bags.joint_state(stamp_of(message), message.name, message.position - first[0], message.velocity)
        return message

    return each("/joint_states", change)


def _mounts_on_tf(records: list[Record]) -> list[Record]:
    """A simulator publishes fixed transforms on /tf, ten times a second."""
    static = next(m for t, m, _ in records if t == "/tf_static")
    end = max(log for _, _, log in records)
    repeated = [("/tf", with_times(deepcopy(static), lambda ns, s=stamp: s), stamp) for stamp in range(START, end, S // 10)]
    return [*(record for record in records if record[0] != "/tf_static"), *repeated]


def _to_cloud(vehicle: Vehicle, dtype: list[tuple[str, str]], copies: int = 6) -> Edit:
    """Scans as clouds of some layout."""
    rng = np.random.default_rng(4)

    def change(message: Any) -> list[tuple[str, Any]]:
        angles = message.angle_min + message.angle_increment * np.arange(len(message.ranges))
        table = np.zeros((copies, len(angles)), dtype=dtype)
        table["x"], table["y"] = message.ranges * np.cos(angles), message.ranges * np.sin(angles)
        table["z"] = np.linspace(-0.15, 0.6, copies)[:, None]
        if "ring" in table.dtype.names:
            table["ring"] = np.arange(copies)[:, None]
        if "intensity" in table.dtype.names:
            table["intensity"] = rng.uniform(0.0, 255.0, table.shape)
        return [("/points", bags.cloud(stamp_of(message), table, "laser"))]

    return changed("/scan", change)


def _swapped_frames(message: Any, t: float) -> Any:
    message.header.frame_id, message.child_frame_id = "base_link", "odom"
    return message


def _reset_odometry(at_s: float, vehicle: Vehicle) -> Edit:
    """The driver restarts: its odometry begins again at zero."""
    from motion_models import se2

    first: list[np.ndarray] = []

    def change(message: Any, t: float) -> Any:
        p = message.pose.pose
        pose = np.array([p.position.x, p.position.y, 2.0 * math.atan2(p.orientation.z, p.orientation.w)])
        if t < at_s:
            return message
        first[:] = first or [pose]
        new = se2.between(first[0], pose)
        return bags.odometry(stamp_of(message), *new, message.twist.twist.linear.x, message.twist.twist.angular.z)

    return each("/odom", change)


def _in_batches(records: list[Record]) -> list[Record]:
    """The recorder wrote once a second."""
    return [(t, m, START + (1 + (log - START) // S) * S if t != "/tf_static" else log) for t, m, log in records]


def _pan(vehicle: Vehicle) -> Edit:
    """The LiDAR sits on a pan joint that turns slowly; /tf has its transform."""
    motion = drive(vehicle)

    def angle(t: float) -> float:
        return 0.6 * math.sin(0.3 * t)

    def edit(records: list[Record]) -> list[Record]:
        found = []
        for t, m, log in records:
            if t == "/scan":
                part = (stamp_of(m) - START) / S
                a = angle(part)
                x, y, yaw = motion.poses[motion.at(part)]
                beams = m.angle_min + m.angle_increment * np.arange(len(m.ranges)) + yaw + a
                m.ranges = cast(x + 0.15 * math.cos(yaw), y + 0.15 * math.sin(yaw), beams, vehicle.room).astype(np.float32)
            found.append((t, m, log))
        for t in np.arange(0.0, motion.t[-1], 0.05):
            stamp = START + round(t * S)
            edge = ("base_link", "laser", (0.15, 0.0, 0.3), bags.quaternion(angle(t)))
            found.append(("/tf", bags.tf(stamp, [edge]), stamp))
        return mounted_at(IMU_MOUNT)(found)

    return edit


def _imu_units(rate: float, force: float) -> Edit:
    def change(message: Any, t: float) -> Any:
        w, a = message.angular_velocity, message.linear_acceleration
        return bags.imu(stamp_of(message), (rate * w.x, rate * w.y, rate * w.z), (force * a.x, force * a.y, force * a.z))

    return each("/imu/data", change)


def _two_imus(vehicle: Vehicle) -> Edit:
    """Two IMUs on one topic; the second one is upside down, as its transform has it."""

    def edit(records: list[Record]) -> list[Record]:
        found = list(records)
        for t, m, log in records:
            if t == "/imu/data":
                w = m.angular_velocity.z
                found.append((t, bags.imu(stamp_of(m) + S // 200, (0.0, 0.0, -w), (0.0, 0.0, -9.81), "imu_low"), log + S // 200))
        low = ("base_link", "imu_low", (0.0, 0.0, -0.1), bags.quaternion(0.0, 0.0, math.pi))
        return mounted_at(IMU_MOUNT, LASER_MOUNT, low)(found)

    return edit


def _mid_drive(vehicle: Vehicle, cut_s: float) -> Edit:
    """The recording begins while the robot drives."""
    return lambda records: [r for r in records if r[0] == "/tf_static" or r[2] > START + round(cut_s * S)]


def _scan_times(increment: float) -> Edit:
    """``time_increment`` of a sweep of that length, though all beams are measured at once."""
    return set_fields("/scan", time_increment=lambda m: increment / len(m.ranges))


RATES = ["angular_velocity", "gyro", "/imu/data"]
HOSTILE = (
    driven("hostile", "two LiDARs of other names", SCANS, words=["could each be"], edit=_second_lidar(SCANS, "/scan_r", "/scan_f")),
    driven("hostile", "two LiDARs on one topic", SCANS, edit=_second_lidar(SCANS, "/scan", "/scan")),
    driven("hostile", "IMU turned by 90 deg about z", SCANS, edit=_turned_imu(SCANS, math.pi / 2)),
    driven("hostile", "IMU turned by 90 deg about z, wheels alone", JACKAL, edit=_turned_imu(JACKAL, math.pi / 2)),
    driven("hostile", "odometry whose child is odom", JACKAL, Publishing(forms="odometry"), edit=each("/odom", _swapped_frames)),
    driven("hostile", "IMU of 1 kHz, stamps of 4 ms", SCANS, words=["stamp"], edit=_fast_imu(SCANS)),
    driven("hostile", "LiDAR without a transform", SCANS, words=["laser"], edit=mounted_at(IMU_MOUNT)),
    driven("hostile", "no transforms at all", ROSBOT, words=["laser"], edit=without("/tf_static")),
    driven("hostile", "dead encoder of four", JACKAL, words=["counts nothing"], edit=each("/joint_states", _dead(0, 0.0))),
    driven("hostile", "encoder dies half way", SCANS, words=["wheel"], edit=each("/joint_states", _dead(2, 20.0))),
    driven("hostile", "encoder dies half way, no LiDAR", WARTHOG, words=["wheel"], edit=each("/joint_states", _dead(3, 20.0))),
    driven("hostile", "encoder NaN half way", JACKAL, words=["joint"], edit=each("/joint_states", _dead(1, 20.0, "nan"))),
    driven("hostile", "every message twice", SCANS, words=["repeated"], edit=_twice),
    driven("hostile", "sim time half way", SCANS, words=["jump", "clock"], edit=_sim_time(20.0)),
    driven("hostile", "all stamps zero", SCANS, words=["without a header stamp"], edit=_unstamped),
    driven("hostile", "joints in another order each time", SCANS, edit=each("/joint_states", _shuffled)),
    driven("hostile", "joints with a prefix", JACKAL, words=["joint"], edit=each("/joint_states", _prefixed)),
    driven("hostile", "angle_increment negative", SCANS, edit=each("/scan", _backwards_beams)),
    driven("hostile", "beams from 0 to 360 deg", ROSBOT, edit=each("/scan", _from_zero)),
    driven("hostile", "range_max 0", SCANS, edit=set_fields("/scan", range_max=0.0)),
    driven("hostile", "range_max NaN, range_min NaN", SCANS, edit=set_fields("/scan", range_max=math.nan, range_min=math.nan)),
    driven("hostile", "odd ranges", SCANS, edit=each("/scan", _spoiled)),
    driven("hostile", "IMU covariances NaN", SCANS, edit=each("/imu/data", _nan_covariances)),
    driven("hostile", "IMU of orientation alone", SCANS, words=RATES, edit=_orientation_only(SCANS, False)),
    driven("hostile", "IMU of orientation alone, marked", JACKAL, words=RATES, edit=_orientation_only(JACKAL, True)),
    driven("hostile", "gyro and accelerometer apart", JACKAL, words=["imu"], edit=_camera_imu),
    driven("hostile", "pushed at the start", SCANS, words=["wheels"], edit=_pushed(SCANS, 6.0)[1]),
    driven("hostile", "encoders reset half way", SCANS, words=["reset"], edit=_reset_encoders(20.0)),
    driven("hostile", "mounts on /tf alone", SCANS, edit=_mounts_on_tf),
    driven("hostile", "cloud of doubles", SCANS, edit=_to_cloud(SCANS, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("ring", "u1")])),
    driven("hostile", "cloud, big endian", SCANS, edit=_to_cloud(SCANS, [("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("intensity", ">f4")])),
    driven("hostile", "odometry reset half way", TURTLE, Publishing(forms="odometry"), words=["reset"], edit=_reset_odometry(20.0, TURTLE)),
    driven("hostile", "recorded in batches of 1 s", SCANS, edit=_in_batches),
    driven("hostile", "LiDAR on a pan joint", SCANS, words=["laser"], edit=_pan(SCANS)),
    driven("hostile", "IMU in g and deg/s", SCANS, words=["deg/s"], edit=_imu_units(57.2958, 1.0 / 9.81)),
    driven("hostile", "two IMUs on one topic", JACKAL, edit=_two_imus(JACKAL)),
    driven("hostile", "begins while driving", SCANS, edit=_mid_drive(SCANS, 9.0)),
    driven("hostile", "time_increment in ms", SCANS, words=["time_increment"], edit=_scan_times(100.0)),
    driven("hostile", "time_increment 10 times too long", SCANS, words=["time_increment"], edit=_scan_times(1.0)),
    driven("hostile", "time_increment of beams at once", NO_IMU, words=["time_increment"], edit=_scan_times(0.1)),
)
