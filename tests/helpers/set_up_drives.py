"""Healthy logs of drawn robots: size, drive, sensors, rates, encoder steps and noise come from priors; the truth is beside the messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from motion_models import se2
from motion_models.robot import DIFF_DRIVE, Driver, Geometry, Joints, Mount, Robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

STEP_S = 0.01
Leg = tuple[float, float, float]
"""Seconds, forward speed [m/s] and yaw rate [rad/s]."""
Floats = np.ndarray

TOPICS = {
    "wheels": "/joint_states",
    "driver": "/odom",
    "gyro": "/imu/data",
    "lidar": "/scan",
    "reference": "/reference/pose",
}
"""Topic of each source."""
CENTER_OF_GRAVITY = "/center_of_gravity"


@dataclass(frozen=True)
class Base:
    """A skid-steer or differential-drive robot, and how its driver counts."""

    radius: float
    track: float
    wheelbase: float
    k: float
    """Track over effective track: 1 where no wheel slides."""
    counts: int
    """Encoder counts per turn of the wheel."""
    hz: float
    fields: str = "both"
    """Of the joint states: both, angles or rates."""
    has_caster: bool = False
    is_calibrated: bool = False
    """k is in the robot file."""
    left: tuple[str, ...] = ("front_left_wheel", "rear_left_wheel")
    right: tuple[str, ...] = ("front_right_wheel", "rear_right_wheel")
    driver_k: float = 1.0
    """Effective track that the driver divides by, over its wheels' track: 1 without regard to skidding, 1/k with it."""
    driver_jitter: float = 0.0
    """Standard deviation of the published yaw rate [rad/s]."""
    load: tuple[float, ...] = ()
    """How far ahead the centre of gravity is in equal parts of the drive, and the centre of rotation with it [m]."""
    has_load_topic: bool = True
    """Whether the centre of gravity is published."""

    @property
    def names(self) -> tuple[str, ...]:
        """Joints of the left, then of the right side."""
        return (*self.left, *self.right)


@dataclass(frozen=True)
class Sensors:
    """What is on the robot besides wheels, and its noise. A rate of zero leaves a sensor out."""

    gyro_hz: float = 0.0
    gyro_noise: float = 0.003
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_tilt: tuple[float, float] = (0.0, 0.0)
    """Roll and pitch of the mounted IMU that its transform does not have [rad]."""
    vibration: float = 0.1
    """Of the accelerometer [m/s^2]."""
    scan_hz: float = 0.0
    beams: int = 360
    field_of_view: float = math.tau
    range_max: float = 30.0
    range_noise: float = 0.01
    lidar: Mount = field(default_factory=lambda: Mount(x=0.15, z=0.3))
    reference_hz: float = 0.0
    reference_noise: tuple[float, float] = (0.005, 0.003)
    """[m] and [rad]"""
    latency_s: float = 0.012
    """Time of recording less stamp, of all topics."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A drive of a robot with its sensors, as messages and as truth."""

    base: Base
    sensors: Sensors
    names: tuple[str, ...]
    """Sources, of wheels, driver, gyro, lidar, reference."""
    t: Floats
    twists: Floats
    """(n, 2) forward speed and yaw rate on a grid of `STEP_S`."""
    poses: Floats
    robot: Robot
    records: list[Record]
    remarks: Sequence[str] = field(default=())
    """What is unusual and healthy."""


def draw_base(rng: np.random.Generator, has_joints: bool) -> Base:
    """From a robot for a desk to one of a tonne; a third with two driven wheels."""
    radius = math.exp(rng.uniform(math.log(0.03), math.log(0.33)))
    track = radius * rng.uniform(2.6, 6.0)
    is_skid = rng.random() < 0.65
    k = rng.uniform(0.4, 0.95) if is_skid else 1.0
    pairs = (("front_left_wheel", "rear_left_wheel"), ("front_right_wheel", "rear_right_wheel")) if is_skid else (("left",), ("right",))
    return Base(
        radius,
        track,
        track * rng.uniform(0.6, 1.2),
        k,
        counts=round(math.exp(rng.uniform(math.log(90.0), math.log(20000.0)))),
        hz=float(rng.choice([10.0, 20.0, 25.0, 50.0])),
        fields=str(rng.choice(["both", "angles", "rates"], p=[0.6, 0.2, 0.2])) if has_joints else "both",
        left=pairs[0],
        right=pairs[1],
        driver_k=1.0 / k if rng.random() < 0.3 else 1.0,
    )


def draw_sensors(rng: np.random.Generator, names: Sequence[str]) -> Sensors:
    """Of the kinds and prices that are on such robots."""
    lidar = Mount(x=rng.uniform(-0.1, 0.3), y=rng.normal(0.0, 0.03), z=0.3, yaw=float(rng.choice([0.0, 0.0, 0.0, math.pi])))
    return Sensors(
        gyro_hz=float(rng.choice([50.0, 100.0])) if "gyro" in names else 0.0,
        gyro_noise=math.exp(rng.uniform(math.log(0.001), math.log(0.02))),
        gyro_bias=tuple(rng.normal(0.0, math.exp(rng.uniform(math.log(0.0005), math.log(0.015))), 3)),
        gyro_tilt=tuple(rng.normal(0.0, 0.03, 2)),
        vibration=rng.uniform(0.02, 0.6),
        scan_hz=float(rng.choice([4.0, 5.0, 8.0])) if "lidar" in names else 0.0,
        beams=int(rng.choice([180, 240, 360, 540])),
        field_of_view=float(rng.choice([math.tau, math.tau, math.radians(270.0), math.pi])),
        range_max=float(rng.choice([12.0, 30.0])),
        range_noise=rng.uniform(0.005, 0.02),
        lidar=lidar,
        reference_hz=float(rng.choice([5.0, 10.0, 20.0])) if "reference" in names else 0.0,
        reference_noise=(rng.uniform(0.001, 0.01), rng.uniform(0.001, 0.006)),
    )


def draw_legs(rng: np.random.Generator, base: Base) -> list[Leg]:
    """A minute of driving as by hand: straight, turns in place both ways, arcs and a little backwards, in any order."""
    v = min(rng.uniform(2.0, 5.0) * base.track, 1.2)
    w = rng.uniform(0.4, 1.1)
    legs: list[Leg] = [
        (4.0, v, 0.0),
        (3.0, 0.0, w),
        (3.0, 0.0, -w),
        (5.0, 0.8 * v, 0.5 * w),
        (4.0, 0.7 * v, -0.6 * w),
        (3.0, -0.5 * v, 0.0),
    ]
    for _ in range(int(rng.integers(2, 6))):
        legs.append((rng.uniform(2.0, 5.0), v * rng.uniform(0.3, 1.0), w * rng.uniform(-0.8, 0.8)))
    order = rng.permutation(len(legs))
    stops = [(rng.uniform(0.5, 2.0), 0.0, 0.0) for _ in legs]
    return [(2.0, 0.0, 0.0), *(part for i in order for part in ((legs[i][0] * rng.uniform(0.8, 1.3), *legs[i][1:]), stops[i]))]


def drive_legs(rng: np.random.Generator, legs: Sequence[Leg], wobble: float = 0.1) -> tuple[Floats, Floats]:
    """Times and twists (n, 2)."""
    wanted = np.concatenate([np.tile([[v, w]], (max(round(s / STEP_S), 1), 1)) for s, v, w in legs])
    smooth = np.ones(40) / 40.0
    twists = np.stack([np.convolve(column, smooth, "same") for column in wanted.T], axis=1)
    slow = np.convolve(rng.normal(0.0, 1.0, len(twists)), np.ones(60) / 60.0, "same")
    twists[:, 1] += wobble * slow * (np.abs(twists[:, 0]) > 0.05)
    return np.arange(len(twists)) * STEP_S, twists


def turned_about(twists: Floats, ahead: Floats) -> Floats:
    """Poses (n, 3) of a robot that turns about a centre which is ``ahead`` (n,) [m]; ``twists`` (n, 2)."""
    v, w = twists.T
    poses = [np.array([-ahead[0], 0.0, 0.0])]
    for twist in np.stack([v, -ahead * w, w], axis=1)[:-1]:
        poses.append(se2.compose(poses[-1], se2.exp(twist * STEP_S)))
    return np.array(poses)


def drawn_log(
    rng: np.random.Generator,
    names: Sequence[str],
    base: Base | None = None,
    sensors: Sensors | None = None,
    legs: Sequence[Leg] | None = None,
    slip: float = 0.03,
    k_falls: float = 0.0,
    remarks: Sequence[str] = (),
) -> Drawn:
    """A healthy log of the sources ``names``.

    ``slip`` is the standard deviation of a slow relative error of each side; ``k_falls``: by which part k is smaller at full speed.
    """
    base = draw_base(rng, "wheels" in names) if base is None else base
    sensors = draw_sensors(rng, names) if sensors is None else sensors
    t, twists = drive_legs(rng, draw_legs(rng, base) if legs is None else legs)
    ahead = np.array(base.load or (0.0,))[np.arange(len(t)) * max(len(base.load), 1) // len(t)]
    poses = turned_about(twists, ahead)
    fastest = max(float(np.abs(twists[:, 0]).max()), 1e-9)
    k = base.k * (1.0 - k_falls * np.abs(twists[:, 0]) / fastest)
    half = 0.5 * base.track / k * twists[:, 1]
    slow = np.stack([np.convolve(rng.normal(size=len(t) + 199), np.ones(200) / math.sqrt(200.0), "valid") for _ in range(2)], axis=1)
    sides = np.stack([twists[:, 0] - half, twists[:, 0] + half], axis=1) * (1.0 + slip * slow)
    count = len(base.left)
    rates = np.repeat(sides / base.radius, count, axis=1)
    rates = rates * (1.0 + 0.005 * rng.normal(size=(1, 2 * count)) + 0.01 * rng.normal(size=rates.shape))
    rows: list[tuple[str, float, Any]] = []
    if "wheels" in names:
        rows += _wheels(rng, base, t, rates)
    if "driver" in names:
        rows += _driver(rng, base, t, rates)
    if sensors.gyro_hz:
        rows += _imu(rng, sensors, t, twists)
    if sensors.scan_hz:
        rows += _scans(rng, sensors, t, poses)
    if sensors.reference_hz:
        rows += _reference(rng, sensors, t, poses)
    late = round(sensors.latency_s * S)
    records: list[Record] = [("/tf_static", _mounts(sensors), START)]
    records += [(TOPICS[source], message, START + round(at * S) + late) for source, at, message in rows]
    if base.load and base.has_load_topic:
        records += [
            (CENTER_OF_GRAVITY, bags.point_stamped(START + i * S // 100, ahead[i], 0.0), START + i * S // 100) for i in range(0, len(t), 50)
        ]
    return Drawn(base, sensors, tuple(names), t, twists, poses, _robot(base), sorted(records, key=lambda r: r[2]), tuple(remarks))


_LEAST_K_OF_CASTERS = 0.9
"""Two driven wheels beside casters turn the robot by as much as they roll."""


def _robot(base: Base) -> Robot:
    drive = DIFF_DRIVE if len(base.left) == 1 and base.k > _LEAST_K_OF_CASTERS else "skid_steer"  # else tracks
    return Robot(
        "drawn",
        Geometry(base.radius, base.track, base.wheelbase, 30.0),
        Driver(base.radius, base.track, base.driver_k),
        drive,
        joints=Joints(base.left, base.right),
        models={"skid_steer": {"k_0": base.k}} if base.is_calibrated else {},
    )


def _times(t: Floats, hz: float, phase: float) -> Iterator[tuple[float, int]]:
    for at in np.arange(phase / hz, t[-1], 1.0 / hz):
        i = round(at / STEP_S)
        if i < len(t):
            yield float(t[i]), i


def _wheels(rng: np.random.Generator, base: Base, t: Floats, rates: Floats) -> Iterator[tuple[str, float, Any]]:
    step = math.tau / base.counts
    counted = np.round(np.cumsum(rates, axis=0) * STEP_S / step) * step + rng.uniform(-20.0, 20.0, rates.shape[1])
    last, before = counted[0], 0.0
    for at, i in _times(t, base.hz, rng.random()):
        angle = counted[i]
        rate = (angle - last) / max(at - before, STEP_S)  # as drivers do
        last, before = angle, at
        names, fields = list(base.names), [angle, rate]
        if base.has_caster:
            names, fields = (
                [*names, "caster_swivel"],
                [np.append(f, value) for f, value in zip(fields, (1.3 * math.sin(at), 0.4), strict=True)],
            )
        stamp = START + round(at * S)
        yield (
            "wheels",
            at,
            bags.joint_state(stamp, names, [] if base.fields == "rates" else fields[0], [] if base.fields == "angles" else fields[1]),
        )


def _driver(rng: np.random.Generator, base: Base, t: Floats, rates: Floats) -> Iterator[tuple[str, float, Any]]:
    half = rates.shape[1] // 2
    step = math.tau / base.counts
    angles = np.round(np.cumsum(rates, axis=0) * STEP_S / step) * step * base.radius
    sides = np.stack([angles[:, :half].mean(axis=1), angles[:, half:].mean(axis=1)], axis=1)
    pose, last, before = np.zeros(3), sides[0], 0.0
    for at, i in _times(t, base.hz, rng.random()):
        left, right = sides[i] - last
        way, turn = 0.5 * (left + right), (right - left) / (base.track * base.driver_k)
        dt, last, before = max(at - before, STEP_S), sides[i], at
        pose = se2.compose(pose, se2.exp(np.array([way, 0.0, turn])))
        w = turn / dt + base.driver_jitter * rng.normal()
        yield "driver", at, bags.odometry(START + round(at * S), *pose, way / dt, w)


def _imu(rng: np.random.Generator, sensors: Sensors, t: Floats, twists: Floats) -> Iterator[tuple[str, float, Any]]:
    tilt = Mount(roll=sensors.gyro_tilt[0], pitch=sensors.gyro_tilt[1]).rotation.T  # the body's vectors in the IMU's frame
    for at, i in _times(t, sensors.gyro_hz, rng.random()):
        rate = tilt @ np.array([0.0, 0.0, twists[i, 1]]) + sensors.gyro_bias + sensors.gyro_noise * rng.normal(size=3)
        force = tilt @ np.array([0.0, twists[i, 0] * twists[i, 1], 9.81]) + sensors.vibration * rng.normal(size=3)
        yield "gyro", at, bags.imu(START + round(at * S), rate, force)


def _reference(rng: np.random.Generator, sensors: Sensors, t: Floats, poses: Floats) -> Iterator[tuple[str, float, Any]]:
    origin = np.array([*rng.uniform(-20.0, 20.0, 2), rng.uniform(-math.pi, math.pi)])
    for at, i in _times(t, sensors.reference_hz, rng.random()):
        x, y, yaw = se2.compose(origin, poses[i])
        xy, a = sensors.reference_noise
        noisy = (x + xy * rng.normal(), y + xy * rng.normal(), yaw + a * rng.normal())
        yield "reference", at, bags.pose_stamped(START + round(at * S), *noisy)


def _mounts(sensors: Sensors) -> Any:
    m = sensors.lidar
    laser = ("base_link", "laser", (m.x, m.y, m.z), bags.quaternion(m.yaw))
    return bags.tf(START, [("base_link", "imu_link", (0.0, 0.0, 0.1), bags.quaternion()), laser])


# scans of a room


@dataclass(frozen=True)
class Room:
    """Walls of a rectangle [m], and round pillars (x, y, radius)."""

    low: Floats
    high: Floats
    pillars: Floats


def room_around(rng: np.random.Generator, poses: Floats) -> Room:
    """A room that holds the drive, with pillars and boxes that stand aside from the way."""
    low = poses[:, :2].min(axis=0) - rng.uniform(1.0, 4.0, 2)
    high = poses[:, :2].max(axis=0) + rng.uniform(1.0, 4.0, 2)
    pillars: list[tuple[float, float, float]] = []
    for _ in range(200):
        x, y = rng.uniform(low, high)
        size = rng.uniform(0.1, 0.4)
        if np.hypot(poses[::20, 0] - x, poses[::20, 1] - y).min() > size + 0.5:
            pillars.append((x, y, size))
        if len(pillars) == 6:
            break
    return Room(low, high, np.array(pillars).reshape(-1, 3))


def cast(room: Room, x: Floats, y: Floats, bearings: Floats) -> Floats:
    """Distances along the bearings, each from a place of its own."""
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        found = np.minimum((np.where(c > 0, room.high[0], room.low[0]) - x) / c, (np.where(s > 0, room.high[1], room.low[1]) - y) / s)
    for px, py, size in room.pillars:
        along = (px - x) * c + (py - y) * s
        across = (px - x) * s - (py - y) * c
        hit = (along > 0.0) & (np.abs(across) < size)
        found = np.where(hit, np.minimum(found, along - np.sqrt(np.maximum(size**2 - across**2, 0.0))), found)
    return found


def _scans(rng: np.random.Generator, sensors: Sensors, t: Floats, poses: Floats) -> Iterator[tuple[str, float, Any]]:
    room, mount = room_around(rng, poses), sensors.lidar
    step = sensors.field_of_view / sensors.beams
    angles = -0.5 * sensors.field_of_view + step * np.arange(sensors.beams)
    sweep = rng.uniform(0.3, 0.9) / max(sensors.scan_hz, 10.0) / sensors.beams  # from beam to beam [s]
    for at, _ in _times(t, sensors.scan_hz, rng.random()):
        i = np.minimum(np.round((at + sweep * np.arange(sensors.beams)) / STEP_S).astype(int), len(t) - 1)
        x, y, yaw = se2.compose(poses[i], np.array([mount.x, mount.y, mount.yaw])).T
        ranges = cast(room, x, y, yaw + angles) + sensors.range_noise * rng.normal(size=len(angles))
        ranges = np.where(ranges < sensors.range_max, ranges, np.inf)
        beams = {
            "angle_min": -0.5 * sensors.field_of_view,
            "angle_increment": step,
            "time_increment": sweep,
            "range_max": sensors.range_max,
        }
        yield "lidar", at, bags.laser_scan(START + round(at * S), ranges, **beams)
