"""Logs of simulated robots for the entrances of a log: any robot, sensors, rates, names, units, signs and clocks, with the truth beside."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import DIFF_DRIVE, Driver, Geometry, Joints, Robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

STEP_S = 0.01
Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Angles and rates (4,) of front left, rear left, front right and rear right wheel to what the driver publishes."""


@dataclass(frozen=True)
class Vehicle:
    """A robot and how it publishes."""

    radius: float = 0.12
    track: float = 0.45
    wheelbase: float = 0.4
    k: float = 0.6
    """Track over effective track."""
    speed: float = 0.5
    turn: float = 0.8
    wheels_hz: float = 25.0
    imu_hz: float = 50.0
    scan_hz: float = 0.0
    """0: no LiDAR."""
    beams: int = 240
    left: tuple[str, ...] = ("front_left_wheel", "rear_left_wheel")
    right: tuple[str, ...] = ("front_right_wheel", "rear_right_wheel")
    room: tuple[float, float] = (12.0, 9.0)
    seed: int = 0

    def robot(self, **changes: Any) -> Robot:
        """Its robot file, as it should be."""
        drive = DIFF_DRIVE if len(self.left) == 1 else "skid_steer"
        geometry = Geometry(self.radius, self.track, self.wheelbase, 40.0)
        return Robot("r", geometry, Driver(self.radius, self.track), drive, joints=Joints(self.left, self.right), **changes)


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a vehicle on a grid of `STEP_S`."""

    t: np.ndarray
    twists: np.ndarray
    """(n, 2) forward speed and yaw rate."""
    poses: np.ndarray
    angles: np.ndarray
    """(n, 4) of the wheels, without noise."""
    rates: np.ndarray

    def at(self, t: float) -> int:
        """Index of a time."""
        return min(round(t / STEP_S), len(self.t) - 1)

    def trajectory(self, offset_s: float = 0.0) -> Trajectory:
        """The true poses at 20 Hz, with stamps late by ``offset_s``."""
        part = slice(None, None, 5)
        stamps = START + np.round((self.t[part] + offset_s) * S).astype(np.int64)
        return Trajectory(stamps, self.poses[part])


def drive(vehicle: Vehicle) -> Motion:
    """Standing, straight on, turns in place both ways, arcs both ways, and backwards; lengths vary with the seed."""
    rng = np.random.default_rng(vehicle.seed)
    v, w = vehicle.speed, vehicle.turn
    legs = [(2.0, 0.0, 0.0), (4.0, v, 0.0), (1.5, 0.0, 0.0), (4.0, 0.0, w), (1.0, 0.0, 0.0), (3.0, 0.6 * v, 0.0), (5.0, 0.0, -w)]
    legs += [(5.0, 0.8 * v, 0.5 * w), (1.0, 0.0, 0.0), (5.0, 0.7 * v, -0.6 * w), (2.0, -0.5 * v, 0.0), (2.0, 0.0, 0.0), (4.0, v, 0.2 * w)]
    wanted = np.concatenate([np.tile([[a, b]], (round(s * rng.uniform(0.8, 1.3) / STEP_S), 1)) for s, a, b in legs])
    smooth = np.ones(40) / 40.0
    twists = np.stack([np.convolve(column, smooth, "same") for column in wanted.T], axis=1)
    wobble = np.convolve(rng.normal(0.0, 1.0, len(twists)), np.ones(60) / 60.0, "same")
    twists[:, 1] += 0.1 * wobble * (np.abs(twists[:, 0]) > 0.05)
    poses = [np.zeros(3)]
    for a, b in twists[:-1]:
        poses.append(se2.compose(poses[-1], se2.exp(np.array([a, 0.0, b]) * STEP_S)))
    half = 0.5 * vehicle.track / vehicle.k * twists[:, 1]
    sides = np.stack([twists[:, 0] - half, twists[:, 0] - half, twists[:, 0] + half, twists[:, 0] + half], axis=1) / vehicle.radius
    rates = sides * (1.0 + 0.01 * rng.normal(size=sides.shape))
    return Motion(np.arange(len(twists)) * STEP_S, twists, np.array(poses), np.cumsum(rates, axis=0) * STEP_S, rates)


def unchanged(angles: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As they are."""
    return angles, rates


@dataclass(frozen=True)
class Publishing:
    """What drivers publish of a motion, and how."""

    wheels: Change = unchanged
    gyro: float = 1.0
    """Factor of the gyro's rates."""
    force: tuple[float, float, float] = (0.0, 0.0, 9.81)
    tilt: float = 0.0
    """Roll of the mounted IMU [rad]; its mount on /tf_static has none."""
    forms: str = "joint_states"
    """joint_states, wheel (a message each), side (a topic each), odometry, twist, twist_covariance, tf, none."""
    has_odometry: bool = False
    """The driver's odometry besides, of its own geometry."""
    odometry_k: float = 1.0
    """The driver's track over the true effective track times k: 1 for a driver that knows nothing of skidding; k for one that does."""
    lidar_yaw: float = 0.0
    """True yaw less that of /tf_static [rad]."""
    lidar_ahead_m: float = 0.15
    """Of the middle of the wheels, as /tf_static has it."""
    lidar_flip: bool = False
    """Mounted upside down, which /tf_static does not have."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Topics by their usual names."""
    frames: tuple[str, str] = ("imu_link", "laser")
    reference: str = ""
    """Topic of PoseStamped of the truth, 2 Hz."""
    offsets_s: Mapping[str, float] = field(default_factory=dict)
    """What is added to the header stamps, by topic."""
    stale: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Ages [s] of old messages with which a topic begins."""


def write(path: Path, vehicle: Vehicle, motion: Motion, how: Publishing) -> Path:
    """The log of a ``motion`` at ``path`` (.mcap)."""
    return bags.write_mcap(path, records_of(vehicle, motion, how))


def records_of(vehicle: Vehicle, motion: Motion, how: Publishing) -> list[Record]:
    """The messages of a ``motion``, by time of recording."""
    found = [*_wheels(vehicle, motion, how), *_imu(vehicle, motion, how), *_scans(vehicle, motion, how), *_reference(motion, how)]
    records: list[Record] = [("/tf_static", _mounts(how), START)]
    for topic, rows in _by_topic(found, how).items():
        offset = how.offsets_s.get(topic, 0.0)
        for age in how.stale.get(topic, ()):
            records.append((topic, rows[0][1](START - round(age * S)), START + S // 1000))
        records += [(topic, make(START + round((t + offset) * S)), START + round((t + 0.012) * S)) for t, make in rows]
    records.sort(key=lambda record: record[2])
    return records


def with_times(message: Any, change: Callable[[int], int]) -> Any:
    """``message`` with the stamp of its header, or of its transforms, changed [ns]."""
    parts = [part.header for part in message.transforms] if hasattr(message, "transforms") else [message.header]
    for header in parts:
        new = change(header.stamp.sec * S + header.stamp.nanosec)
        header.stamp = bags.header(new).stamp
    return message


Row = tuple[str, float, Callable[[int], Any]]
"""Usual topic, time of measurement and the message of a stamp."""


def _by_topic(rows: Sequence[Row], how: Publishing) -> dict[str, list[tuple[float, Callable[[int], Any]]]]:
    found: dict[str, list[tuple[float, Callable[[int], Any]]]] = {}
    for topic, t, make in rows:
        found.setdefault(how.names.get(topic, topic), []).append((t, make))
    return found


def _times(motion: Motion, hz: float, phase: float = 0.0) -> np.ndarray:
    times = np.arange(phase / hz, motion.t[-1], 1.0 / hz)
    return np.asarray(np.round(times / STEP_S) * STEP_S)  # where the motion is known: half a step is 0.4 deg at 1.3 rad/s


def _wheels(vehicle: Vehicle, motion: Motion, how: Publishing) -> Iterator[Row]:
    names = (*vehicle.left, *vehicle.right)
    columns = list(range(4)) if len(names) == 4 else [0, 2]
    driver = _driver_poses(vehicle, motion, how) if how.has_odometry or how.forms in ("odometry", "tf") else None
    for t in _times(motion, vehicle.wheels_hz):
        i = motion.at(t)
        changed = how.wheels(motion.angles[i].copy(), motion.rates[i].copy())
        angles, rates = (values[columns] if len(values) else values for values in changed)
        if how.forms == "joint_states":
            yield "/joint_states", t, lambda s, a=angles, r=rates: bags.joint_state(s, names, a, r)
        elif how.forms == "wheel":
            for j, name in enumerate(names):
                late = t + 0.001 * j
                one = slice(j, j + 1)
                yield "/joint_states", late, lambda s, n=name, a=angles[one], r=rates[one]: bags.joint_state(s, [n], a, r)
        elif how.forms == "side":
            half = len(names) // 2
            for topic, part in (("/left/joint_states", slice(0, half)), ("/right/joint_states", slice(half, None))):
                yield topic, t, lambda s, p=part, a=angles, r=rates: bags.joint_state(s, names[p], a[p], r[p])
        elif how.forms.startswith("twist"):
            v, w = _driver_twist(vehicle, motion, how, i)
            yield "/wheel_twist", t, lambda s, v=v, w=w: _twist(s, v, w, how.forms)
        if driver is not None:
            v, w = _driver_twist(vehicle, motion, how, i)
            p = driver[i]
            if how.forms == "tf":
                yield "/tf", t, lambda s, p=p: bags.tf(s, [("odom", "base_link", (p[0], p[1], 0.0), bags.quaternion(p[2]))])
            else:
                yield "/odom", t, lambda s, p=p, v=v, w=w: bags.odometry(s, *p, v, w)


def _driver_twist(vehicle: Vehicle, motion: Motion, how: Publishing, i: int) -> tuple[float, float]:
    left, right = motion.rates[i, 0] * vehicle.radius, motion.rates[i, 2] * vehicle.radius
    return 0.5 * (left + right), (right - left) / vehicle.track * how.odometry_k


def _driver_poses(vehicle: Vehicle, motion: Motion, how: Publishing) -> np.ndarray:
    poses = [np.zeros(3)]
    for i in range(len(motion.t) - 1):
        v, w = _driver_twist(vehicle, motion, how, i)
        poses.append(se2.compose(poses[-1], se2.exp(np.array([v, 0.0, w]) * STEP_S)))
    return np.array(poses)


def _twist(stamp: int, v: float, w: float, form: str) -> Any:
    twist = bags.T["geometry_msgs/msg/Twist"](linear=bags.vector(v), angular=bags.vector(z=w))
    if form == "twist":
        return bags.T["geometry_msgs/msg/TwistStamped"](header=bags.header(stamp, "base_link"), twist=twist)
    with_covariance = bags.T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return bags.T["geometry_msgs/msg/TwistWithCovarianceStamped"](header=bags.header(stamp, "base_link"), twist=with_covariance)


def _imu(vehicle: Vehicle, motion: Motion, how: Publishing) -> Iterator[Row]:
    if not vehicle.imu_hz:
        return
    rng = np.random.default_rng(vehicle.seed + 1)
    bias = rng.normal(0.0, 0.005)
    c, s = math.cos(how.tilt), math.sin(how.tilt)
    force = (how.force[0], c * how.force[1] + s * how.force[2], -s * how.force[1] + c * how.force[2])
    for t in _times(motion, vehicle.imu_hz):
        w = how.gyro * (motion.twists[motion.at(t), 1] + bias + 0.003 * rng.normal())
        yield "/imu/data", t, lambda st, w=w: bags.imu(st, (0.0, s * w, c * w), force, how.frames[0])


def _scans(vehicle: Vehicle, motion: Motion, how: Publishing) -> Iterator[Row]:
    if not vehicle.scan_hz:
        return
    rng = np.random.default_rng(vehicle.seed + 2)
    angles = -math.pi + math.tau * np.arange(vehicle.beams) / vehicle.beams
    for t in _times(motion, vehicle.scan_hz):
        x, y, yaw = motion.poses[motion.at(t)]
        x, y = x + how.lidar_ahead_m * math.cos(yaw), y + how.lidar_ahead_m * math.sin(yaw)
        beams = yaw + how.lidar_yaw + (-angles if how.lidar_flip else angles)
        ranges = cast(x, y, beams, vehicle.room) + 0.008 * rng.normal(size=len(beams))
        yield (
            "/scan",
            t,
            lambda s, r=ranges: bags.laser_scan(s, r, angle_min=-math.pi, angle_increment=math.tau / vehicle.beams, frame_id=how.frames[1]),
        )


def cast(x: float, y: float, angles: np.ndarray, room: tuple[float, float]) -> np.ndarray:
    """Distances to the walls of a room with two pillars; it reaches from a third of its length behind the origin."""
    low, high = np.array([-0.35 * room[0], -0.45 * room[1]]), np.array([0.65 * room[0], 0.55 * room[1]])
    c, s = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        found = np.minimum((np.where(c > 0, high[0], low[0]) - x) / c, (np.where(s > 0, high[1], low[1]) - y) / s)
    for px, py in ((low[0] + 1.0, high[1] - 1.2), (high[0] - 1.5, low[1] + 0.9)):
        along = (px - x) * c + (py - y) * s
        across = (px - x) * s - (py - y) * c
        hit = (along > 0.0) & (np.abs(across) < 0.4)
        found = np.where(hit, np.minimum(found, along - np.sqrt(np.maximum(0.16 - across**2, 0.0))), found)
    return found


def _reference(motion: Motion, how: Publishing) -> Iterator[Row]:
    if how.reference:
        for t in _times(motion, 4.0):
            x, y, yaw = motion.poses[motion.at(t)]
            yield how.reference, t, lambda s, p=(x + 3.0, y - 2.0, yaw): bags.pose_stamped(s, *p)


def _mounts(how: Publishing) -> Any:
    imu, laser = how.frames
    edges = [("base_link", imu, (0.0, 0.0, 0.1), bags.quaternion()), ("base_link", laser, (how.lidar_ahead_m, 0.0, 0.3), bags.quaternion())]
    return bags.tf(START, edges)
