"""Motor drivers of Clearpath's robots: Jackal's two (ROS 1 and 2), and the Lynx drivers of Husky A300 and others, by their joints' names.

Definitions: jackal_msgs and clearpath_msgs (github.com/clearpathrobotics).
"""

from __future__ import annotations

from typing import Any

from localization.logs.driver_messages.driver_message import DriverMessage, WheelJoints, named, sides


def _of_jackal(message: Any, topic: str) -> WheelJoints:
    left, right = message.drivers  # in the order of Drive.LEFT, Drive.RIGHT
    return sides(message, (left.measured_travel, right.measured_travel), (left.measured_velocity, right.measured_velocity))


def _of_lynx(message: Any, topic: str) -> WheelJoints:
    return named(message, message.drivers, "joint_name", "travel", "velocity")


JACKAL = DriverMessage(
    ("jackal_msgs/msg/Feedback", "clearpath_platform_msgs/msg/Feedback"),
    _of_jackal,
    {
        "PACKAGE/msg/Feedback": (
            "std_msgs/Header header\nPACKAGE/DriveFeedback[2] drivers\nfloat32 pcb_temperature\nfloat32 mcu_temperature\n"
            "int8 commanded_mode\nint8 actual_mode\n"
        ),
        "PACKAGE/msg/DriveFeedback": (
            "float32 current\nfloat32 duty_cycle\nfloat32 bridge_temperature\nfloat32 motor_temperature\n"
            "float32 measured_velocity\nfloat32 measured_travel\nbool driver_fault\n"
        ),
    },
)
LYNX = DriverMessage(
    ("clearpath_motor_msgs/msg/LynxMultiFeedback",),
    _of_lynx,
    {
        "PACKAGE/msg/LynxMultiFeedback": "std_msgs/Header header\nPACKAGE/LynxFeedback[] drivers\n",
        "PACKAGE/msg/LynxFeedback": (
            "uint8 can_id\nstring joint_name\nfloat32 current\nfloat32 voltage\nfloat32 velocity\nfloat32 travel\n"
        ),
    },
)
MESSAGES = (JACKAL, LYNX)
