"""Symptoms that practice has: one row says how it changes the messages of a healthy log, and which row of an answer is right.

A symptom is hidden in the messages themselves (`Fault.change`), never in channels, so that the readers of the project meet it as users'
logs have it. The right answer (`Fault.truth`) is a row's id with its detail and value, as `localization.evidence` gives them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.studies.set_ups.answers import Truth

Change = Callable[[list[Record]], list[Record]]


@dataclass(frozen=True)
class Setting:
    """What a symptom must know of the log that it is hidden in."""

    topics: Mapping[str, str]
    """Topic of each source that the log has."""
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    radius: float = 0.1
    effective_track: float = 0.5
    """Track over k [m]."""
    driver_track: float = 0.5
    """By which the driver divides [m]."""
    has_angles: bool = True
    has_twists: bool = True
    """Whether the driver publishes twists beside its poses."""
    has_rates: bool = True
    imu_up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """The vertical in the IMU's axes, by its mount."""

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.left, *self.right)


@dataclass(frozen=True)
class Fault:
    """One symptom, drawn: the right answer, and how the messages change."""

    truth: Truth
    change: Change


@dataclass(frozen=True)
class Symptom:
    """A row of the table."""

    id: str
    """Of the row that is the right answer."""
    draw: Callable[[np.random.Generator, Setting], Fault]
    group: str = ""
    """Of symptoms of one group a log has one at most, by default of the same id."""
    weight: float = 1.0
    """How often it is drawn, relative to the others of its source."""
    fits: Callable[[Setting], bool] = field(default=lambda setting: True)

    @property
    def source(self) -> str:
        """The source that it is hidden in."""
        kind, _, name = self.id.partition(".")
        return name if kind == "clock" else kind


# changes of messages


def on_topic(topic: str, change: Callable[[Any], Any]) -> Change:
    """Each message of ``topic`` replaced by what ``change`` makes of a copy of it."""

    def edit(records: list[Record]) -> list[Record]:
        return [(t, change(copy.deepcopy(m)) if t == topic else m, at) for t, m, at in records]

    return edit


def stamp_of(message: Any) -> int:
    """Time of the header [ns]."""
    return int(message.header.stamp.sec * S + message.header.stamp.nanosec)


def wheels_by(setting: Setting, change: Callable[[dict[str, float], str], dict[str, float]]) -> Change:
    """Angles and rates by joint name, both changed; ``change`` has the field's name too. Other joints stay."""

    def edit(message: Any) -> Any:
        names = list(message.name)
        for attribute in ("position", "velocity"):
            values = np.array(getattr(message, attribute), dtype=float)
            if len(values):
                known = {name: values[names.index(name)] for name in setting.names if name in names}
                for name, value in change(known, attribute).items():
                    values[names.index(name)] = value
                setattr(message, attribute, values)
        return message

    return on_topic(setting.topics["wheels"], edit)


def scaled_joints(setting: Setting, factors: Mapping[str, float]) -> Change:
    """Joints that count ``factors`` times what they should."""
    return wheels_by(setting, lambda known, _: {name: factors.get(name, 1.0) * value for name, value in known.items()})


def as_measured_by(setting: Setting, source_of: Mapping[str, str]) -> Change:
    """Joints that publish what others measure."""
    return wheels_by(setting, lambda known, _: {name: known[source_of.get(name, name)] for name in known})


def odometry_by(setting: Setting, of_twist: Callable[[float, float], tuple[float, float]], parts: str = "both") -> Change:
    """The driver's odometry with other speeds and yaw rates: poses are summed up anew. ``parts``: both, pose or twist."""

    def edit(records: list[Record]) -> list[Record]:
        topic, new = setting.topics["driver"], []
        before: tuple[float, float, float] | None = None
        x = y = yaw = 0.0
        for t, m, at in records:
            if t != topic:
                new.append((t, m, at))
                continue
            m = copy.deepcopy(m)
            here = (m.pose.pose.position.x, m.pose.pose.position.y, _yaw(m.pose.pose.orientation))
            if before is not None:
                way, turn = _arc(before, here)
                way, turn = of_twist(way, turn)
                x, y, yaw = x + way * math.cos(yaw + turn / 2), y + way * math.sin(yaw + turn / 2), yaw + turn
            before = here
            v, w = of_twist(m.twist.twist.linear.x, m.twist.twist.angular.z)
            if parts != "twist":
                m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.orientation = x, y, bags.quaternion(yaw)
            if parts != "pose":
                m.twist.twist.linear.x, m.twist.twist.angular.z = v, w
            new.append((t, m, at))
        return new

    return edit


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))


def _arc(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float]:
    """Signed way and turn between two poses."""
    dx, dy, turn = b[0] - a[0], b[1] - a[1], math.remainder(b[2] - a[2], math.tau)
    middle = a[2] + 0.5 * turn
    return dx * math.cos(middle) + dy * math.sin(middle), turn


def imu_by(setting: Setting, of_rates: np.ndarray, of_forces: np.ndarray) -> Change:
    """Angular velocities and accelerations times matrices (3, 3)."""

    def edit(m: Any) -> Any:
        w = of_rates @ np.array([m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z])
        a = of_forces @ np.array([m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z])
        m.angular_velocity, m.linear_acceleration = bags.vector(*w), bags.vector(*a)
        return m

    return on_topic(setting.topics["gyro"], edit)


def scan_by(setting: Setting, change: Callable[[Any], Any]) -> Change:
    """Scans changed."""
    return on_topic(setting.topics["lidar"], change)


def pose_by(setting: Setting, change: Callable[[float, float, float], tuple[float, float, float]]) -> Change:
    """Reference poses (x, y, yaw) changed."""

    def edit(m: Any) -> Any:
        pose = m.pose if hasattr(m.pose, "position") else m.pose.pose
        x, y, yaw = change(pose.position.x, pose.position.y, _yaw(pose.orientation))
        pose.position.x, pose.position.y, pose.orientation = x, y, bags.quaternion(yaw)
        return m

    return on_topic(setting.topics["reference"], edit)


def later(topic: str, seconds: float) -> Change:
    """Header stamps that are late by ``seconds``."""

    def edit(m: Any) -> Any:
        m.header.stamp = bags.header(stamp_of(m) + round(seconds * S)).stamp
        return m

    return on_topic(topic, edit)


# rows: wheels

WHEEL_UNITS = {"rpm": 60.0 / math.tau, "deg/s": 180.0 / math.pi, "rev/s": 1.0 / math.tau}
"""Published over rad/s; m/s and mm/s have the radius in them."""


def _exchanged(rng: np.random.Generator, setting: Setting) -> Fault:
    pairs = dict(zip(setting.left, setting.right, strict=True))
    return Fault(Truth("wheels.sides_exchanged"), as_measured_by(setting, {**pairs, **{r: left for left, r in pairs.items()}}))


def _reversed(row: str, joints: Callable[[Setting], Sequence[str]]) -> Callable[[np.random.Generator, Setting], Fault]:
    def draw(rng: np.random.Generator, setting: Setting) -> Fault:
        return Fault(Truth(row), scaled_joints(setting, dict.fromkeys(joints(setting), -1.0)))

    return draw


def _one_reversed(rng: np.random.Generator, setting: Setting) -> Fault:
    name = str(rng.choice(setting.names))
    return Fault(Truth("wheels.one_reversed", name), scaled_joints(setting, {name: -1.0}))


def _other_side(rng: np.random.Generator, setting: Setting) -> Fault:
    """Two wheels of different sides publish each other's counts, so that other joints than the file's are on the left."""
    a, b = int(rng.integers(2)), int(rng.integers(2))
    left, right = setting.left[a], setting.right[b]
    truly_left = sorted({*setting.left} - {left} | {right})
    return Fault(Truth("wheels.other_side", ",".join(truly_left)), as_measured_by(setting, {left: right, right: left}))


def _wheel_unit(rng: np.random.Generator, setting: Setting) -> Fault:
    unit = str(rng.choice([*WHEEL_UNITS, "m/s", "mm/s"]))
    factor = {**WHEEL_UNITS, "m/s": setting.radius, "mm/s": 1000.0 * setting.radius}[unit]
    return Fault(Truth("wheels.unit", unit), scaled_joints(setting, dict.fromkeys(setting.names, factor)))


def _wheel_factor(row: str, joints: Callable[[Setting], Sequence[str]]) -> Callable[[np.random.Generator, Setting], Fault]:
    def draw(rng: np.random.Generator, setting: Setting) -> Fault:
        """A gear, a radius typed as diameter, an encoder of half or four times the counts."""
        value = float(rng.choice([0.25, 0.5, 2.0, 3.0, 4.0] if row.endswith("factor") else [0.5, 2.0, 4.0]))
        return Fault(Truth(row, value=1.0 / value), scaled_joints(setting, dict.fromkeys(joints(setting), value)))

    return draw


def _counts(rng: np.random.Generator, setting: Setting) -> Fault:
    """Counts of the encoder in place of angles, and no rates."""
    value = float(rng.choice([360.0, 512.0, 1024.0, 1440.0, 2048.0, 4096.0, 65536.0])) / math.tau
    scale = scaled_joints(setting, dict.fromkeys(setting.names, value))

    def edit(m: Any) -> Any:
        m.position, m.velocity = np.round(m.position), np.zeros(0)
        return m

    return Fault(Truth("wheels.factor", value=1.0 / value), lambda records: on_topic(setting.topics["wheels"], edit)(scale(records)))


def _one_field(row: str, field: str) -> Callable[[np.random.Generator, Setting], Fault]:
    """Angles or velocities in another unit than the other field of the same messages."""

    def draw(rng: np.random.Generator, setting: Setting) -> Fault:
        factor = float(rng.choice(list(WHEEL_UNITS.values())))

        def change(known: dict[str, float], name: str) -> dict[str, float]:
            return {joint: factor * value if name == field else value for joint, value in known.items()}

        return Fault(Truth(row, value=1.0 / factor), wheels_by(setting, change))

    return draw


def _has_both(setting: Setting) -> bool:
    return setting.has_angles and setting.has_rates


def _dead(rng: np.random.Generator, setting: Setting) -> Fault:
    name = str(rng.choice(setting.names))
    return Fault(Truth("wheels.dead", name), scaled_joints(setting, {name: 0.0}))


def _factor_since(rng: np.random.Generator, setting: Setting) -> Fault:
    """Counts that double on the way: the driver starts anew with other settings."""
    at, value = rng.uniform(15.0, 30.0), float(rng.choice([0.5, 2.0]))
    kept: dict[str, float] = {}

    def edit(m: Any) -> Any:
        is_later = stamp_of(m) > START + at * S
        for i, name in enumerate(m.name):
            if name in setting.names:
                if len(m.position):
                    kept.setdefault(name, m.position[i])
                    if not is_later:
                        kept[name] = m.position[i]
                    m.position[i] = kept[name] + (value if is_later else 1.0) * (m.position[i] - kept[name])
                if len(m.velocity) and is_later:
                    m.velocity[i] *= value
        return m

    def anew(records: list[Record]) -> list[Record]:
        kept.clear()
        return on_topic(setting.topics["wheels"], edit)(records)

    return Fault(Truth("wheels.factor", value=1.0 / value, since_s=at), anew)


# rows: the driver's odometry


def _driver(row: str, of_twist: Callable[[Setting], Callable[[float, float], tuple[float, float]]]) -> Callable[..., Fault]:
    return lambda rng, setting: Fault(Truth(row), odometry_by(setting, of_twist(setting)))


def _side_reversed(sign: float) -> Callable[[Setting], Callable[[float, float], tuple[float, float]]]:
    """Of the left side (-1) or the right one (1): ways become turns and turns ways, by the driver's own track."""

    def of(setting: Setting) -> Callable[[float, float], tuple[float, float]]:
        half = 0.5 * setting.driver_track
        return lambda v, w: (-sign * w * half, -sign * v / half)

    return of


LENGTHS = {"mm": 1000.0, "cm": 100.0, "inch": 1.0 / 0.0254, "ft": 1.0 / 0.3048}


def _driver_unit(rng: np.random.Generator, setting: Setting) -> Fault:
    unit = str(rng.choice(["mm", "cm", "inch"]))
    return Fault(Truth("driver.unit", unit), odometry_by(setting, lambda v, w: (LENGTHS[unit] * v, w)))


def _pose_against_twist(rng: np.random.Generator, setting: Setting) -> Fault:
    """Poses that sum speeds without the time between messages, or over a wrong one."""
    value = float(rng.choice([0.1, 0.2, 5.0, 10.0, 20.0]))
    return Fault(Truth("driver.pose_against_twist", value=value), odometry_by(setting, lambda v, w: (value * v, value * w), "pose"))


# rows: gyro


def _with_axis(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes z to one of the ``axis`` (3,) of a frame."""
    other = np.roll(np.abs(axis), 1)
    return np.stack([other, np.cross(axis, other), axis], axis=1)


def _gyro_axis(rng: np.random.Generator, setting: Setting) -> Fault:
    up = np.round(setting.imu_up)
    axes = {f"{sign}{name}": size * axis for name, axis in zip("xyz", np.eye(3), strict=True) for sign, size in (("+", 1.0), ("-", -1.0))}
    name = str(rng.choice([name for name, axis in axes.items() if (axis != up).any()]))
    rotation = _with_axis(axes[name]) @ _with_axis(up).T
    return Fault(Truth("gyro.axis", name), imu_by(setting, rotation, rotation))


# rows: LiDAR


def _lidar_yaw(rng: np.random.Generator, setting: Setting) -> Fault:
    yaw = float(rng.choice([math.pi, math.pi / 2, -math.pi / 2, *np.radians(rng.choice([-1, 1]) * rng.uniform(12.0, 170.0, 3))]))

    def edit(m: Any) -> Any:
        m.angle_min, m.angle_max = m.angle_min - yaw, m.angle_max - yaw
        return m

    return Fault(Truth("lidar.yaw", value=math.remainder(yaw, math.tau)), scan_by(setting, edit))


def _upside_down(rng: np.random.Generator, setting: Setting) -> Fault:
    def edit(m: Any) -> Any:
        m.ranges = m.ranges[::-1].copy()
        m.angle_min, m.angle_max = -m.angle_max, -m.angle_min
        return m

    return Fault(Truth("lidar.upside_down"), scan_by(setting, edit))


def _lidar_unit(rng: np.random.Generator, setting: Setting) -> Fault:
    unit = str(rng.choice(["mm", "cm", "ft"], p=[0.6, 0.25, 0.15]))

    def edit(m: Any) -> Any:
        m.ranges = (m.ranges * LENGTHS[unit]).astype(np.float32)
        m.range_min, m.range_max = m.range_min * LENGTHS[unit], m.range_max * LENGTHS[unit]
        return m

    return Fault(Truth("lidar.unit", unit), scan_by(setting, edit))


def _lidar_place(rng: np.random.Generator, setting: Setting) -> Fault:
    """The transform has the LiDAR .4 to .8 m from where it is, along the robot."""
    by = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 0.8))

    def edit(m: Any) -> Any:
        for part in m.transforms:
            if part.child_frame_id == "laser":
                part.transform.translation.x -= by
        return m

    return Fault(Truth("lidar.place", value=by), on_topic("/tf_static", edit))


# rows: reference


def _reference_yaw(rng: np.random.Generator, setting: Setting) -> Fault:
    """The rigid body's axes are turned against the robot's."""
    yaw = float(rng.choice([math.pi, math.pi / 2, -math.pi / 2, float(np.radians(rng.uniform(12.0, 170.0)))]))
    return Fault(Truth("reference.yaw", value=math.remainder(yaw, math.tau)), pose_by(setting, lambda x, y, a: (x, y, a + yaw)))


def _reference_unit(rng: np.random.Generator, setting: Setting) -> Fault:
    unit = str(rng.choice(["mm", "cm", "ft", "inch"]))
    c = LENGTHS[unit]
    return Fault(Truth("reference.unit", unit), pose_by(setting, lambda x, y, a: (c * x, c * y, a)))


def _mirrored(rng: np.random.Generator, setting: Setting) -> Fault:
    """A left-handed frame: y and heading inverted."""
    return Fault(Truth("reference.mirrored"), pose_by(setting, lambda x, y, a: (x, -y, -a)))


def _inverse(rng: np.random.Generator, setting: Setting) -> Fault:
    """Poses of the world in the robot's frame."""

    def edit(x: float, y: float, a: float) -> tuple[float, float, float]:
        c, s = math.cos(a), math.sin(a)
        return -(c * x + s * y), s * x - c * y, -a

    return Fault(Truth("reference.inverse"), pose_by(setting, edit))


def _reference_place(rng: np.random.Generator, setting: Setting) -> Fault:
    """A prism or antenna ahead of the robot's middle, or behind it."""
    by = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 0.9))
    return Fault(Truth("reference.place", value=by), pose_by(setting, lambda x, y, a: (x + by * math.cos(a), y + by * math.sin(a), a)))


# rows: clocks


def _clock(source: str) -> Callable[[np.random.Generator, Setting], Fault]:
    def draw(rng: np.random.Generator, setting: Setting) -> Fault:
        """Queues and drivers, a computer that is not synchronized, GPS time and TAI less UTC."""
        late = float(rng.choice([-1.0, 1.0]) * rng.choice([0.25, 0.4, 0.7, 1.5, 3.0, 18.0, 37.0], p=[0.2, 0.2, 0.2, 0.2, 0.1, 0.05, 0.05]))
        topic = setting.topics["driver" if source == "wheels" and "wheels" not in setting.topics else source]
        return Fault(Truth(f"clock.{source}", value=late), later(topic, late))

    return draw


def _is_four(setting: Setting) -> bool:
    return len(setting.left) == 2


TABLE: tuple[Symptom, ...] = (
    Symptom("wheels.sides_exchanged", _exchanged, "wiring"),
    Symptom("wheels.left_reversed", _reversed("wheels.left_reversed", lambda s: s.left), "wiring"),
    Symptom("wheels.right_reversed", _reversed("wheels.right_reversed", lambda s: s.right), "wiring"),
    Symptom("wheels.all_reversed", _reversed("wheels.all_reversed", lambda s: s.names), "wiring"),
    Symptom("wheels.one_reversed", _one_reversed, "wiring", fits=_is_four),
    Symptom("wheels.other_side", _other_side, "wiring", fits=_is_four),
    Symptom("wheels.unit", _wheel_unit, "scale", weight=2.0),
    Symptom("wheels.factor", _wheel_factor("wheels.factor", lambda s: s.names), "scale"),
    Symptom("wheels.factor", _counts, "scale", fits=lambda s: s.has_angles),
    Symptom("wheels.factor", _factor_since, "scale", weight=0.5),
    Symptom("wheels.factor_left", _wheel_factor("wheels.factor_left", lambda s: s.left), "scale", weight=0.5),
    Symptom("wheels.factor_right", _wheel_factor("wheels.factor_right", lambda s: s.right), "scale", weight=0.5),
    Symptom("wheels.velocity_unit", _one_field("wheels.velocity_unit", "velocity"), "scale", weight=0.5, fits=_has_both),
    Symptom("wheels.angle_unit", _one_field("wheels.angle_unit", "position"), "scale", weight=0.5, fits=_has_both),
    Symptom("wheels.dead", _dead, "wiring", weight=0.5, fits=_is_four),
    Symptom("driver.sides_exchanged", _driver("driver.sides_exchanged", lambda s: lambda v, w: (v, -w)), "wiring"),
    Symptom("driver.reversed", _driver("driver.reversed", lambda s: lambda v, w: (-v, -w)), "wiring"),
    Symptom("driver.left_reversed", _driver("driver.left_reversed", _side_reversed(-1.0)), "wiring"),
    Symptom("driver.right_reversed", _driver("driver.right_reversed", _side_reversed(1.0)), "wiring"),
    Symptom("driver.unit", _driver_unit, "scale"),
    Symptom("driver.no_turns", _driver("driver.no_turns", lambda s: lambda v, w: (v, 0.0)), "wiring"),
    Symptom("driver.pose_against_twist", _pose_against_twist, "scale", weight=0.7, fits=lambda s: s.has_twists),
    Symptom("gyro.reversed", lambda rng, s: Fault(Truth("gyro.reversed"), imu_by(s, -np.eye(3), np.eye(3))), "axis"),
    Symptom("gyro.unit", lambda rng, s: Fault(Truth("gyro.unit", "deg/s"), imu_by(s, np.eye(3) * 180.0 / math.pi, np.eye(3))), "unit"),
    Symptom("gyro.axis", _gyro_axis, "axis", weight=1.5),
    Symptom("lidar.yaw", _lidar_yaw, "yaw", weight=2.0),
    Symptom("lidar.upside_down", _upside_down, "hand"),
    Symptom("lidar.unit", _lidar_unit, "unit"),
    Symptom("lidar.place", _lidar_place, "place", weight=0.7),
    Symptom("reference.mirrored", _mirrored, "hand"),
    Symptom("reference.yaw", _reference_yaw, "yaw", weight=1.5),
    Symptom("reference.unit", _reference_unit, "unit"),
    Symptom("reference.inverse", _inverse, "hand", weight=0.5),
    Symptom("reference.place", _reference_place, "place", weight=0.7),
    Symptom("clock.wheels", _clock("wheels"), "clock", weight=1.5),
    Symptom("clock.gyro", _clock("gyro"), "clock"),
    Symptom("clock.lidar", _clock("lidar"), "clock"),
    Symptom("clock.reference", _clock("reference"), "clock"),
)
"""A symptom is one row. Groups keep apart what would undo each other, or what no robot has twice."""
GROUPS = ("place", "wiring", "axis", "yaw", "hand", "scale", "unit", "clock")
"""In this order symptoms act on the messages, as rows do in `answers.ORDER`."""


def draw_faults(rng: np.random.Generator, setting: Setting, count: int, allowed: Callable[[Symptom], bool] = lambda s: True) -> list[Fault]:
    """``count`` symptoms of the sources that are there, each source as often as another; at most one clock, none twice of a group."""
    sources = sorted(setting.topics)

    def is_in(symptom: Symptom) -> bool:
        is_wheels_clock = symptom.id == "clock.wheels" and "driver" in sources
        return (symptom.source in sources or is_wheels_clock) and symptom.fits(setting) and allowed(symptom)

    rows = [symptom for symptom in TABLE if is_in(symptom)]
    by_source = {s: [r for r in rows if _home(r, sources) == s] for s in sources}
    chosen: list[Symptom] = []
    for _ in range(1000):
        if len(chosen) == count:
            break
        mine = by_source[str(rng.choice(sources))]
        if not mine:
            continue
        weights = np.array([r.weight for r in mine])
        row = mine[int(rng.choice(len(mine), p=weights / weights.sum()))]
        if all(_is_apart(row, other) for other in chosen):
            chosen.append(row)
    chosen.sort(key=lambda row: GROUPS.index(row.group))
    return [row.draw(rng, setting) for row in chosen]


def _home(symptom: Symptom, sources: Sequence[str]) -> str:
    return "driver" if symptom.source == "wheels" and "wheels" not in sources else symptom.source


def _is_apart(a: Symptom, b: Symptom) -> bool:
    if a.id.startswith("clock.") or b.id.startswith("clock."):
        return not (a.id.startswith("clock.") and b.id.startswith("clock."))
    return a.source != b.source or a.group != b.group


def hide(faults: Sequence[Fault], records: list[Record]) -> list[Record]:
    """The messages with all ``faults`` in them; recording times stay."""
    for fault in faults:
        records = fault.change(records)
    return records
