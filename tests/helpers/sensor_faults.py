"""Faults of sensors, clocks and transforms, put into the messages of a drive."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.helpers import bags
from tests.helpers.bags import Record, S

SCORED_TOPICS = ("/ground_truth/odom", "/fix")
"""Topics that no fault changes."""

Mutation = Callable[[list[Record], np.random.Generator], list[Record]]


def _each(kinds: tuple[str, ...], change: Callable[[Any, float], Any]) -> Mutation:
    """``change`` for each message of ``kinds`` with its part of the drive (0 to 1); None drops it."""

    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        begin, end = records[0][2], records[-1][2]
        found = []
        for topic, message, stamp in records:
            if message.__msgtype__.rsplit("/", 1)[1] in kinds and topic not in SCORED_TOPICS:
                message = change(message, (stamp - begin) / max(end - begin, 1))
            if message is not None:
                found.append((topic, message, stamp))
        return found

    return mutate


def _set(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        holder, parts = message, name.split("__")
        for part in parts[:-1]:
            holder = getattr(holder, part)
        setattr(holder, parts[-1], value)
    return message


def _moved(message: Any, seconds: float) -> Any:
    stamp = message.header.stamp.sec * S + message.header.stamp.nanosec + round(seconds * S)
    return _set(message, header__stamp__sec=stamp // S, header__stamp__nanosec=stamp % S)


def _gyro(message: Any, factor: float) -> Any:
    w = message.angular_velocity
    return _set(message, angular_velocity__x=w.x * factor, angular_velocity__y=w.y * factor, angular_velocity__z=w.z * factor)


def _stopped(message: Any) -> Any:
    """Wheels that read as if they stood at the first reading."""
    if hasattr(message, "position"):
        return _set(message, position=np.zeros_like(message.position), velocity=np.zeros_like(message.velocity))
    return _set(
        message, twist__twist=bags.T["geometry_msgs/msg/Twist"](linear=bags.vector(), angular=bags.vector()), pose__pose=bags.pose()
    )


def _own_beams(message: Any, part: float) -> Any:
    ranges = message.ranges.copy()
    ranges[: int(part * len(ranges))] = 0.3
    return _set(message, ranges=ranges)


def _transform(*edges: tuple) -> Mutation:
    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        frame = next((m.header.frame_id for _, m, _ in records if m.__msgtype__.endswith("LaserScan")), "imu_link")
        first = records[0][2]
        found = [(p.replace("LASER", frame), c.replace("LASER", frame), where, turn) for p, c, where, turn in edges]
        return [*(("/tf_static", bags.tf(first, [edge]), first) for edge in found), *records]

    return mutate


def _second_publisher(records: list[Record], rng: np.random.Generator) -> list[Record]:
    zeros = []
    for topic, message, stamp in records:
        if message.__msgtype__.endswith("JointState"):
            later = stamp + 7_000_000
            n = len(message.name)
            zeros.append((topic, bags.joint_state(later, message.name, np.zeros(n), np.zeros(n)), later))
    return sorted([*records, *zeros], key=lambda record: record[2])


def _silent(seconds: float) -> Mutation:
    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        begin = records[0][2] + int(rng.uniform(2.0, 3.5) * S)
        return [r for r in records if r[0] in SCORED_TOPICS or not begin < r[2] < begin + seconds * S]

    return mutate


def _quaternion(norm: float) -> Any:
    return bags.T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=norm)


def _drawn(make: Callable[[np.random.Generator], Mutation]) -> Mutation:
    """A fault whose size, time or direction is drawn."""
    return lambda records, rng: make(rng)(records, rng)


def _from(begin: float, change: Callable[[Any], Any]) -> Callable[[Any, float], Any]:
    """``change`` from the part ``begin`` of the drive on."""
    return lambda message, at: change(message) if at > begin else message


def _turn_scan(radians: float) -> Callable[[Any], Any]:
    return lambda m: _set(m, angle_min=m.angle_min + radians, angle_max=m.angle_max + radians)


def _bumped(rng: np.random.Generator) -> Mutation:
    """A LiDAR whose mount is hit by something on the way."""
    angle = math.radians(float(rng.choice([-1, 1]) * rng.uniform(20.0, 60.0)))
    return _each(_SCANS, _from(float(rng.uniform(0.2, 0.5)), _turn_scan(angle)))


def _repeated(kinds: tuple[str, ...], fields: tuple[str, ...]) -> Mutation:
    """Drivers that publish their last values again and again, with new stamps, after a third of the drive."""

    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        last: dict[str, Any] = {}

        def repeat(message: Any, at: float) -> Any:
            if at < 1.0 / 3.0 or message.__msgtype__ not in last:
                last[message.__msgtype__] = message
                return message
            return _set(message, **{name: getattr(last[message.__msgtype__], name) for name in fields})

        return _each(kinds, repeat)(records, rng)

    return mutate


def _side(message: Any, factor: float) -> Any:
    """The left wheels' angles and rates times ``factor``; the left side's speed of an odometry with a track of 0.5 m."""
    if hasattr(message, "position"):
        k = np.array([factor if "left" in name else 1.0 for name in message.name])
        return _set(message, position=message.position * k, velocity=message.velocity * k if len(message.velocity) else message.velocity)
    v, w = message.twist.twist.linear.x, message.twist.twist.angular.z
    left, right = factor * (v - 0.25 * w), v + 0.25 * w
    return _set(message, twist__twist__linear__x=0.5 * (left + right), twist__twist__angular__z=(right - left) / 0.5)


def _swap_sides(message: Any) -> Any:
    names = [n.replace("left", "#").replace("right", "left").replace("#", "right") for n in message.name]
    return _set(message, name=names)


def _cover(message: Any, begin: int, share: float) -> Any:
    ranges = message.ranges.copy()
    n = len(ranges)
    ranges[(begin + np.arange(int(share * n))) % n] = np.nan
    return _set(message, ranges=ranges)


def _drop(kinds: tuple[str, ...], share: float) -> Mutation:
    """Messages lost at random, alone and in bursts of five."""

    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        left = 0
        found = []
        for topic, message, stamp in records:
            if message.__msgtype__.rsplit("/", 1)[1] in kinds and topic not in SCORED_TOPICS:
                left = left - 1 if left else (5 if rng.random() < share / 5.0 else 0)
                if left or rng.random() < share / 2.0:
                    continue
            found.append((topic, message, stamp))
        return found

    return mutate


def _stall(kinds: tuple[str, ...], begin: float, end: float) -> Mutation:
    """One sensor is silent from the part ``begin`` to ``end`` of the drive."""
    return _each(kinds, lambda m, at: None if begin < at < end else m)


_WHEELS, _SCANS, _IMU = ("JointState",), ("LaserScan",), ("Imu",)
_ALL_WHEELS = (*_WHEELS, "Odometry")
_LEVEL = bags.quaternion()
SENSOR_FAULTS: dict[str, Mutation] = {
    "none": lambda records, rng: records,
    "all silent 5 s": _silent(5.0),
    "all silent 8 s": _silent(8.0),
    "wheels read zero": _each(_ALL_WHEELS, lambda m, at: _stopped(m)),
    "wheels stop half way": _each(_ALL_WHEELS, lambda m, at: None if at > 0.5 else m),
    "wheels NaN half way": _each(
        _WHEELS, lambda m, at: _set(m, position=m.position * np.nan, velocity=m.velocity * np.nan) if at > 0.5 else m
    ),
    "one wheel frozen": _each(_WHEELS, lambda m, at: _set(m, position=np.where(np.arange(len(m.position)) == 0, 0.0, m.position))),
    "second publisher of joint states": _second_publisher,
    "LiDAR turned 20 deg": _each(_SCANS, lambda m, at: _set(m, angle_min=m.angle_min + math.radians(20.0))),
    "LiDAR turned 180 deg": _each(_SCANS, lambda m, at: _set(m, angle_min=m.angle_min + math.pi)),
    "LiDAR upside down": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges[::-1].copy())),
    "LiDAR stamps jump 0.9 s": _each(_SCANS, lambda m, at: _moved(m, 0.9) if at > 0.5 else m),
    "LiDAR stamps jump back 0.9 s": _each(_SCANS, lambda m, at: _moved(m, -0.9) if at > 0.5 else m),
    "LiDAR stamps jump 100 s": _each(_SCANS, lambda m, at: _moved(m, 100.0) if at > 0.5 else m),
    "LiDAR angle_increment 0": _each(_SCANS, lambda m, at: _set(m, angle_increment=0.0, angle_max=m.angle_min)),
    "LiDAR in degrees": _each(
        _SCANS, lambda m, at: _set(m, angle_min=math.degrees(m.angle_min), angle_increment=math.degrees(m.angle_increment))
    ),
    "LiDAR in millimetres": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges * 1000.0)),
    "LiDAR frozen half way": _each(_SCANS, lambda m, at: _set(m, ranges=np.full_like(m.ranges, 3.0)) if at > 0.5 else m),
    "LiDAR only in the last tenth": _each(_SCANS, lambda m, at: m if at > 0.9 else None),
    "no scan usable": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges * np.nan)),
    "30 % of beams on the robot": _each(_SCANS, lambda m, at: _own_beams(m, 0.3)),
    "LiDAR turned by a drawn angle": _drawn(
        lambda rng: _each(_SCANS, _from(-1.0, _turn_scan(math.radians(float(rng.choice([-1, 1]) * rng.uniform(20.0, 180.0))))))
    ),
    "LiDAR bumped": _drawn(_bumped),
    "LiDAR repeats its last scan": _repeated(_SCANS, ("ranges",)),
    "LiDAR half covered": _drawn(lambda rng: (lambda begin: _each(_SCANS, lambda m, at: _cover(m, begin, 0.5)))(int(rng.integers(360)))),
    "LiDAR stamps jump by a drawn time": _drawn(
        lambda rng: (lambda at, by: _each(_SCANS, _from(at, lambda m: _moved(m, by))))(
            float(rng.uniform(0.2, 0.7)), float(rng.choice([-1, 1]) * rng.uniform(0.3, 3.0))
        )
    ),
    "LiDAR silent for a while": _stall(_SCANS, 0.3, 0.8),
    "wheels silent for a while": _stall(_ALL_WHEELS, 0.3, 0.7),
    "gyro silent for a while": _stall(_IMU, 0.3, 0.8),
    "all silent for a drawn time": _drawn(lambda rng: _silent(float(rng.uniform(3.0, 9.0)))),
    "wheels lost at random": _drop(_ALL_WHEELS, 0.3),
    "scans lost at random": _drop(_SCANS, 0.3),
    "wheels repeat their last angles": _repeated(_WHEELS, ("position", "velocity")),
    "left wheels turned round": _each(_ALL_WHEELS, lambda m, at: _side(m, -1.0)),
    "left wheels read zero": _each(_ALL_WHEELS, lambda m, at: _side(m, 0.0)),
    "left wheels read zero half way": _each(_ALL_WHEELS, lambda m, at: _side(m, 0.0 if at > 0.5 else 1.0)),
    "wheels of left and right swapped": _each(_WHEELS, lambda m, at: _swap_sides(m)),
    "wheels in degrees": _each(_WHEELS, lambda m, at: _set(m, position=np.degrees(m.position), velocity=np.degrees(m.velocity))),
    "wheels a second late": _each(_ALL_WHEELS, lambda m, at: _moved(m, -1.0)),
    "gyro in deg/s half way": _each(_IMU, _from(0.5, lambda m: _gyro(m, 180.0 / math.pi))),
    "gyro stuck at a value": _repeated(_IMU, ("angular_velocity",)),
    "gyro flipped half way": _each(_IMU, _from(0.5, lambda m: _gyro(m, -1.0))),
    "IMU a second late": _each(_IMU, lambda m, at: _moved(m, -1.0)),
    "IMU NaN half way": _each(_IMU, _from(0.5, lambda m: _gyro(m, math.nan))),
    "gyro in deg/s": _each(_IMU, lambda m, at: _gyro(m, 180.0 / math.pi)),
    "gyro stuck": _each(_IMU, lambda m, at: _gyro(m, 0.0)),
    "gyro flipped": _each(_IMU, lambda m, at: _gyro(m, -1.0)),
    "transform twice": _transform(
        ("base_link", "LASER", (0.0, 0.0, 0.0), _LEVEL), ("base_link", "LASER", (-0.5, 0.3, 0.0), bags.quaternion(1.0))
    ),
    "transform of two parents": _transform(("base_link", "mast", (1.0, 0.0, 0.0), _LEVEL), ("mast", "LASER", (0.5, 0.0, 0.0), _LEVEL)),
    "transforms in a circle": _transform(("base_link", "mast", (1.0, 0.0, 0.0), _LEVEL), ("mast", "base_link", (1.0, 0.0, 0.0), _LEVEL)),
    "quaternion of norm 1e-6": _transform(("base_link", "LASER", (0.0, 0.0, 0.0), _quaternion(1e-6))),
    "quaternion of norm 0": _transform(("base_link", "LASER", (0.0, 0.0, 0.0), _quaternion(0.0))),
}
