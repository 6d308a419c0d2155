"""Kobuki (TurtleBot 2): counters of 16 bits.

Definitions: kobuki_msgs (ROS 1), kobuki_ros_interfaces (ROS 2). Angle of a count: kobuki_core, `DiffDrive::tick_to_rad`.
"""

from __future__ import annotations

from typing import Any

from localization.logs.driver_messages.driver_message import DriverMessage, WheelJoints, sides

_RAD_PER_TICK = 0.002436916871363930187454
_COUNTS = 1 << 16


def _read(message: Any, topic: str) -> WheelJoints:
    return sides(message, (_RAD_PER_TICK * message.left_encoder, _RAD_PER_TICK * message.right_encoder))


KOBUKI = DriverMessage(
    ("kobuki_msgs/msg/SensorState", "kobuki_ros_interfaces/msg/SensorState"),
    _read,
    {
        "PACKAGE/msg/SensorState": (
            "std_msgs/Header header\nuint16 time_stamp\nuint8 bumper\nuint8 wheel_drop\nuint8 cliff\nuint16 left_encoder\n"
            "uint16 right_encoder\nint8 left_pwm\nint8 right_pwm\nuint8 buttons\nuint8 charger\nuint8 battery\nuint16[] bottom\n"
            "uint8[] current\nuint8 over_current\nuint16 digital_input\nuint16[] analog_input\n"
        )
    },
    angle_range_rad=_COUNTS * _RAD_PER_TICK,
)
MESSAGES = (KOBUKI,)
