"""Counts of encoders without a unit: RoboClaw's drivers, and one number for each side on topics of their own (left_ticks, right_ticks).

`joints.angle_unit_rad` of the robot file is the angle of a count. Definitions: ros_roboclaw (github.com/DoanNguyenTrong, /wimblerobotics).
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from localization.logs.driver_messages.driver_message import LEFT, RIGHT, DriverMessage, NoHeader, WheelJoints, sides

_OF_A_SIDE = r"(?=.*(?:tick|encoder|count|wheel))(?=.*(?:left|right|lwheel|rwheel))"
_SIDE = re.compile(r"left|lwheel", re.IGNORECASE)


def _of_roboclaw(message: Any, topic: str) -> WheelJoints:
    return sides(message, (message.mot1_enc_steps, message.mot2_enc_steps))


def _of_a_side(message: Any, topic: str) -> WheelJoints:
    return WheelJoints(NoHeader(), (LEFT if _SIDE.search(topic) else RIGHT,), np.array([float(message.data)]), np.zeros(0))


ROBOCLAW = DriverMessage(
    tuple(f"{package}/msg/RoboclawEncoderSteps" for package in ("roboclaw", "ros_roboclaw", "roboclaw_ros2")),
    _of_roboclaw,
    {"PACKAGE/msg/RoboclawEncoderSteps": "int32 index\nint32 mot1_enc_steps\nint32 mot2_enc_steps\n"},
)
SIDES = DriverMessage(tuple(f"std_msgs/msg/{kind}" for kind in ("Int16", "Int32", "Int64")), _of_a_side, topic_words=_OF_A_SIDE)
MESSAGES = (ROBOCLAW, SIDES)
