"""Logs with symptoms hidden in them: simulated robots of every size, and parts of real logs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from motion_models.robot import Mount, Robot
from tests.helpers import bags
from tests.helpers.bags import Record, S
from tests.helpers.cut_logs import RealLog, cut, there
from tests.helpers.set_up_drives import TOPICS, drawn_log
from tests.studies.set_ups.answers import Body, Truth
from tests.studies.set_ups.symptoms import Fault, Setting, Symptom, draw_faults, hide

SENSORS: tuple[tuple[str, ...], ...] = (
    ("wheels", "gyro"),
    ("wheels", "gyro", "lidar"),
    ("driver", "gyro", "lidar"),
    ("wheels", "gyro", "reference"),
    ("wheels", "gyro", "lidar", "reference"),
    ("wheels", "lidar"),
    ("driver", "gyro"),
    ("wheels", "lidar", "reference"),
    ("driver", "gyro", "lidar", "reference"),
)
"""Of practice: two to four sources."""
WINDOW_S = 110.0
"""Of a real log."""
MIN_TURN_RAD, MIN_WAY_M = 2.0 * math.pi, 8.0
"""Of a part of a real log in which a symptom is hidden: what stands or drives straight on shows none."""


@dataclass(frozen=True, eq=False)
class Draw:
    """A log as it will be written, and the right answer."""

    name: str
    sources: tuple[str, ...]
    robot: Robot
    records: list[Record]
    faults: tuple[Fault, ...]
    body: Body
    known: tuple[str, ...] = ()
    """Ids of rows that are true of the log before anything is hidden."""
    reference: str | None = None
    """Topic of the reference."""
    topics: Mapping[str, str] = field(default_factory=dict)
    """Topic of each source."""

    @property
    def truth(self) -> tuple[Truth, ...]:
        return tuple(fault.truth for fault in self.faults)

    def write(self, folder: Path) -> Path:
        """The log, faults and all."""
        records = sorted(hide(self.faults, self.records), key=lambda record: record[2])
        return bags.write_mcap(folder / "log.mcap", records)


def simulated(seed: int, count: int, sources: Sequence[str], allowed: Callable[[Symptom], bool] = lambda s: True) -> Draw:
    """A drawn robot with ``count`` symptoms."""
    rng = np.random.default_rng([seed, 60])
    drawn = drawn_log(rng, sources)
    base = drawn.base
    setting = Setting(
        {s: TOPICS[s] for s in sources},
        base.left,
        base.right,
        base.radius,
        base.track / base.k,
        base.track * base.driver_k,
        has_angles=base.fields != "rates",
        has_rates=base.fields != "angles",
    )
    faults = tuple(draw_faults(rng, setting, count, allowed))
    body = Body(base.left, base.right, base.radius, setting.effective_track, setting.driver_track, tuple(sources))
    reference = TOPICS["reference"] if "reference" in sources else None
    return Draw(
        f"drawn {seed}",
        tuple(sources),
        drawn.robot,
        drawn.records,
        faults,
        body,
        reference=reference,
        topics={s: TOPICS[s] for s in sources},
    )


def real(seed: int, count: int, log: RealLog | None = None, allowed: Callable[[Symptom], bool] = lambda s: True) -> Draw:
    """A part of a real log that moves enough, with ``count`` symptoms. The sources are a choice of its own."""
    rng = np.random.default_rng([seed, 79])
    logs = there()
    log = logs[int(rng.integers(len(logs)))] if log is None else log
    topics = dict(log.topics)
    if {"wheels", "driver"} <= topics.keys():
        del topics[str(rng.choice(["wheels", "driver"]))]
    if len(topics) > 2 and rng.random() < 0.4:
        topics.pop("reference", None)
    left_out = [topic for source, topic in log.topics if source not in topics]
    for _ in range(30):
        begin = rng.uniform(0.0, log.duration_s - WINDOW_S)
        records = cut(log, begin, WINDOW_S, left_out)
        way, turn = moved(records, topics.get("driver") or topics["wheels"], log)
        if way > MIN_WAY_M and turn > MIN_TURN_RAD:
            break
    robot = log.robot()
    geometry = robot.geometry
    effective = geometry.track_width_m * (1.875 if log.name == "test1" else 1.0)
    setting = Setting(
        topics,
        robot.joints.left,
        robot.joints.right,
        geometry.wheel_radius_m,
        effective,
        robot.driver.track_width_m * robot.driver.wheel_separation_multiplier,
        has_twists=_has_twists(records, topics.get("driver")),
        imu_up=_imu_up(records, topics.get("gyro"), robot),
    )
    faults = tuple(draw_faults(rng, setting, count, allowed))
    body = Body(robot.joints.left, robot.joints.right, geometry.wheel_radius_m, effective, setting.driver_track, tuple(sorted(topics)))
    return Draw(f"{log.name} from {begin:.0f} s", tuple(topics), robot, records, faults, body, log.known, topics.get("reference"), topics)


def _imu_up(records: Sequence[Record], topic: str | None, robot: Robot) -> tuple[float, float, float]:
    """The vertical in the IMU's axes, by the robot file's mount of its frame."""
    mount = next((robot.mounts.get(m.header.frame_id, Mount()) for t, m, _ in records if t == topic), Mount())
    x, y, z = mount.rotation[2].tolist()
    return x, y, z


def _has_twists(records: Sequence[Record], topic: str | None) -> bool:
    """Whether a driver's messages have twists."""
    return any(bool(m.twist.twist.linear.x) for t, m, _ in records if t == topic)


def moved(records: Sequence[Record], topic: str, log: RealLog) -> tuple[float, float]:
    """Way [m] and turned angle [rad] of wheels or driver."""
    robot, last, way, turn = log.robot(), None, 0.0, 0.0
    for t, m, at in records:
        if t != topic:
            continue
        dt = 0.0 if last is None else (at - last) / S
        last = at
        if hasattr(m, "twist"):
            v, w = m.twist.twist.linear.x, m.twist.twist.angular.z
        else:
            half = len(m.velocity) // 2
            left, right = (float(np.mean(part)) * robot.geometry.wheel_radius_m for part in (m.velocity[:half], m.velocity[half:]))
            v, w = 0.5 * (left + right), (right - left) / robot.geometry.track_width_m
        way, turn = way + abs(v) * min(dt, 1.0), turn + abs(w) * min(dt, 1.0)
    return way, turn


def seed_of(*parts: object) -> int:
    """A seed that is the same on every machine."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:6], "big")
