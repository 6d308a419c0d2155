"""Messages of small logs, and the warnings of a log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from localization.logs import Log
from tests.helpers import bags
from tests.helpers.bags import START, Record, S


def records_of_every_kind(steps: int = 40) -> Iterator[Record]:
    """Every kind of event, and two topics that are not decoded: one of an unknown type, one with an invalid definition."""
    for i in range(steps):
        stamp = START + i * S // 10
        yield "/imu/data", bags.imu(stamp, (0.01 * i, 0.0, -0.3), (0.0, 0.1, 9.8)), stamp + 2_000_000
        yield (
            "/joint_states",
            bags.joint_state(stamp, position=[0.1 * i, 0.2 * i, 0.3 * i, 0.4 * i], velocity=[1, 2, 3, 4]),
            stamp + 5_000_000,
        )
        yield "/gizmo", bags.Unknown(), stamp + 6_000_000
        yield "/center_of_gravity", bags.point_stamped(stamp, 0.01 * (i % 20), -0.02), stamp + 7_000_000
        yield "/nonsense", bags.Unknown("acme_msgs/msg/Broken", "this is ( not a definition\n"), stamp + 8_000_000
        yield "/scan", bags.laser_scan(stamp, [1.0, 2.0, 3.0 + i], angle_min=0.0, angle_increment=np.pi / 2), stamp + 50_000_000


def numbered_records(count: int = 600) -> Iterator[Record]:
    """Wheels at 10 Hz that turn 0.1 rad a message and scans whose first range is their number: about 2.5 kB a step."""
    rng = np.random.default_rng(7)
    for i in range(count):
        stamp = START + i * S // 10
        angles = [0.1 * i] * 4
        yield "/joint_states", bags.joint_state(stamp, position=angles, velocity=[1.0] * 4), stamp + S // 200
        ranges = rng.uniform(1.0, 9.0, 500)
        ranges[0] = 1.0 + 0.01 * i
        yield "/scan", bags.laser_scan(stamp, ranges, angle_increment=0.01, time_increment=1e-4), stamp + S // 100


def warnings_of(log: Log) -> str:
    """All warnings of a log in one line."""
    return " ".join(log.warnings())
