"""Parts of real logs as records that can be changed and written anew; their stamps begin at `bags.START`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import with_times

DATA = Path("tests/data")
MORE = Path(os.environ.get("SKIDLOC_MORE_DATA", "tests/data"))
"""Folder of logs that are not among the tests' own."""


@dataclass(frozen=True)
class RealLog:
    """A log that is recorded right, but for ``known`` rows of an answer."""

    path: Path
    robot_file: str
    topics: tuple[tuple[str, str], ...]
    """Source and topic."""
    duration_s: float
    known: tuple[str, ...] = ()
    """Ids of rows that are true of the log as it was recorded."""

    @property
    def name(self) -> str:
        return self.path.stem

    def robot(self) -> Robot:
        return load_robot(self.robot_file)


REAL: tuple[RealLog, ...] = (
    RealLog(
        DATA / "fr079/fr079.mcap",
        str(DATA / "fr079/fr079.toml"),
        (("wheels", "/joint_states"), ("driver", "/odom"), ("lidar", "/scan"), ("reference", "/reference/pose")),
        1061.0,
        ("clock.lidar", "clock.wheels"),
    ),
    RealLog(
        DATA / "mit-csail/csail.mcap",
        str(DATA / "mit-csail/csail.toml"),
        (("wheels", "/joint_states"), ("driver", "/odom"), ("lidar", "/scan"), ("reference", "/reference/pose")),
        423.0,
        ("clock.lidar", "clock.wheels"),
    ),
    RealLog(DATA / "aces/aces.mcap", "aces", (("driver", "/odom"), ("lidar", "/scan")), 1365.0),
    RealLog(
        MORE / "fr101-sparse/fr101.mcap",
        str(MORE / "fr101-sparse/fr101.toml"),
        (("wheels", "/joint_states"), ("driver", "/odom"), ("lidar", "/scan"), ("reference", "/reference/pose")),
        923.0,
    ),
    RealLog(
        DATA / "husky-outdoor-gps/test1.bag",
        "husky_a200",
        (("driver", "/husky_velocity_controller/odom"), ("gyro", "/imu/data")),
        395.0,
    ),
)
"""Buildings and a meadow. Freiburg's building 101 is used where its file is below `MORE`."""


def there() -> tuple[RealLog, ...]:
    """Logs whose files are there."""
    return tuple(log for log in REAL if log.path.exists())


@cache
def _messages(path: Path) -> tuple[tuple[str, str, int, bytes], ...]:
    with AnyReader([path], default_typestore=bags.STORE) as reader:
        found = [(c.topic, c.msgtype, at, bytes(raw)) for c, at, raw in reader.messages() if "String" not in c.msgtype]
    return tuple(found)


def cut(log: RealLog, begin_s: float, seconds: float, left_out: Sequence[str] = ()) -> list[Record]:
    """Records of a part of ``log`` without the topics ``left_out``; fixed transforms are at its beginning."""
    with AnyReader([log.path], default_typestore=bags.STORE) as reader:
        first = reader.start_time + round(begin_s * S)
        found: list[Record] = []
        for topic, kind, at, raw in _messages(log.path):
            is_static = topic == "/tf_static"
            if topic in left_out or not (is_static or first <= at < first + seconds * S):
                continue
            message = _writable(reader.deserialize(raw, kind))
            moved = with_times(message, lambda ns, s=is_static: START if s else ns - first + START)
            found.append((topic, moved, START if is_static else at - first + START))
    return found


def _writable(message: Any) -> Any:
    for name, value in vars(message).items():
        if isinstance(value, np.ndarray):
            setattr(message, name, value.copy())
    return message
