"""Messages of drivers that are no sensor_msgs/JointState: a file for each driver, the same for logs and live topics.

A new one: a module with `MESSAGES`, a tuple of `DriverMessage`, and its name in `_MODULES`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.typesys import get_types_from_msg

from localization.logs.driver_messages import clearpath, counters, create3, kobuki
from localization.logs.driver_messages.driver_message import LEFT, RIGHT, DriverMessage, WheelJoints

__all__ = ["DRIVER_MESSAGES", "LEFT", "RIGHT", "DriverMessage", "WheelJoints", "as_joint_states", "definitions", "is_by_driver"]

_MODULES = (clearpath, kobuki, create3, counters)
DRIVER_MESSAGES: Mapping[str, DriverMessage] = {
    kind: message for module in _MODULES for message in module.MESSAGES for kind in message.types
}
"""By type."""


def is_by_driver(topic: str, kind: str) -> bool:
    """Whether messages of type ``kind`` on ``topic`` are a driver's about its wheels."""
    message = DRIVER_MESSAGES.get(kind)
    return message is not None and re.search(message.topic_words, topic, re.IGNORECASE) is not None


def as_joint_states(message: Any, topic: str, kind: str) -> Any:
    """``message`` of ``topic`` as joint states, where it is a driver's about its wheels; else as it is."""
    return DRIVER_MESSAGES[kind].read(message, topic) if is_by_driver(topic, kind) else message


def definitions() -> dict[str, Any]:
    """Fields of all types, as rosbags has them."""
    found: dict[str, Any] = {}
    for kind, message in DRIVER_MESSAGES.items():
        package = kind.split("/", 1)[0]
        for name, text in message.definitions.items():
            found |= get_types_from_msg(text.replace("PACKAGE", package), name.replace("PACKAGE", package))
    return found
