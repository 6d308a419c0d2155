"""Commands in a log: velocities that its driver was asked for, by the time at which they were recorded."""

from __future__ import annotations

import numpy as np

from localization.logs.decode import UnusableError
from localization.logs.reader import Log
from localization.logs.serialization import LogDeserializer
from localization.logs.wheel_messages import TWIST_TYPES, decode_twist, is_command
from localization.trajectory import IntArray
from motion_models.se2 import FloatArray

_NS = 1e9


def command_topics(log: Log) -> list[str]:
    """Topics of velocities that by their names ask for them."""
    return [topic for topic, kind in log.types.items() if kind in TWIST_TYPES and is_command(topic)]


def read_commands(log: Log, topic: str) -> tuple[IntArray, FloatArray]:
    """Stamps (n,) [ns] on the sensors' clock, and commanded vx, vy and wz (n, 3) of ``topic``.

    Many commands have no stamp, and those of another computer have another clock: the time of recording counts, less the median of what
    the sensors' stamps are behind it. Messages that cannot be read are left out.
    """
    decode = LogDeserializer([c for c in log.channels if c.topic == topic], is_ros1=log.source.is_ros1)
    behind_ns = round(float(np.median(list(log.behind_s.values()) or [0.0])) * _NS)
    found = []
    for raw in log.source.messages([topic]):
        try:
            found.append((raw.log_ns - behind_ns, decode_twist(decode(raw), 0).twist))
        except (UnusableError, AttributeError):
            continue
    found.sort(key=lambda item: item[0])
    return np.array([stamp for stamp, _ in found], dtype=np.int64), np.array([twist for _, twist in found]).reshape(-1, 3)
