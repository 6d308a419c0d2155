"""A driver's message about wheels as joint states: what one file for each driver states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from motion_models.se2 import FloatArray

LEFT, RIGHT = "left", "right"
"""Joints of a message that has one angle for each side of the robot."""


class NoStamp(NamedTuple):
    """Stamp of a message without a header, which is placed by the time of recording."""

    sec: int = 0
    nanosec: int = 0


class NoHeader(NamedTuple):
    """Header of a message without one."""

    stamp: NoStamp = NoStamp()
    frame_id: str = ""


class WheelJoints(NamedTuple):
    """What is used of sensor_msgs/JointState."""

    header: Any
    name: tuple[str, ...]
    position: FloatArray
    """(n,) [rad], or in the unit that the robot file names; (0,) where the message has none."""
    velocity: FloatArray
    """(n,) [rad/s]; (0,) where the message has none."""


@dataclass(frozen=True)
class DriverMessage:
    """Types of one driver, and how a message of them becomes joint states."""

    types: tuple[str, ...]
    """Names (package/msg/Type) of types with the same fields."""
    read: Callable[[Any, str], WheelJoints | None]
    """The joint states of a message on a topic; None where the topic's name has no wheel."""
    definitions: Mapping[str, str] = field(default_factory=dict)
    """Definitions (.msg) by name, of the types and of what they contain. PACKAGE stands for the package of each of ``types``."""
    angle_range_rad: float = 0.0
    """Range after which counters wrap [rad]; 0: they do not."""
    has_angles: bool = True
    """False of velocities alone; angles are preferred, for no motion is lost between messages."""
    topic_words: str = ""
    """Regular expression of the topics' names, for types that carry anything; empty: all topics."""


def sides(message: Any, angles: Sequence[float] = (), rates: Sequence[float] = ()) -> WheelJoints:
    """Joint states of both sides: ``angles`` (2,) [rad] and ``rates`` (2,) [rad/s], left and right, where the message has them."""
    return WheelJoints(getattr(message, "header", NoHeader()), (LEFT, RIGHT), np.array(angles, dtype=float), np.array(rates, dtype=float))


def named(message: Any, drivers: Sequence[Any], name: str, angle: str, rate: str) -> WheelJoints:
    """Joint states of ``drivers`` with these fields."""
    names = tuple(str(getattr(driver, name)) for driver in drivers)
    angles, rates = (np.array([getattr(driver, part) for driver in drivers], dtype=float) for part in (angle, rate))
    return WheelJoints(message.header, names, angles, rates)
