"""iRobot's Create 3 (TurtleBot 4): counts, and speeds of the wheels. Definitions: irobot_create_msgs.

508.8 counts are a turn of the wheel: Create 3's documentation of its encoders.
"""

from __future__ import annotations

import math
from typing import Any

from localization.logs.driver_messages.driver_message import DriverMessage, WheelJoints, sides

_RAD_PER_TICK = math.tau / 508.8


def _of_ticks(message: Any, topic: str) -> WheelJoints:
    return sides(message, (_RAD_PER_TICK * message.ticks_left, _RAD_PER_TICK * message.ticks_right))


def _of_speeds(message: Any, topic: str) -> WheelJoints:
    return sides(message, rates=(message.velocity_left, message.velocity_right))


TICKS = DriverMessage(
    ("irobot_create_msgs/msg/WheelTicks",),
    _of_ticks,
    {"PACKAGE/msg/WheelTicks": "std_msgs/Header header\nint32 ticks_left\nint32 ticks_right\n"},
)
SPEEDS = DriverMessage(
    ("irobot_create_msgs/msg/WheelVels",),
    _of_speeds,
    {"PACKAGE/msg/WheelVels": "std_msgs/Header header\nfloat32 velocity_left\nfloat32 velocity_right\n"},
    has_angles=False,
)
MESSAGES = (TICKS, SPEEDS)
