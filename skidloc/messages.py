"""Messages of ROS, as rclpy and rosbags have them or as plain mappings, to events: by the decoders of logs and live topics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from localization.errors import EventError
from localization.events import Event
from localization.logs.decode import MessageStats, UnusableError, stamp_ns
from localization.logs.driver_messages import LEFT, RIGHT, as_joint_states
from localization.logs.event_decoder import EventDecoder
from localization.logs.topic_roles import OTHER_TYPES, TYPES, Sources, TopicSource, short_type
from localization.logs.wheel_messages import TF_TYPES
from localization.ros.live_stream import WheelAngles
from motion_models.robot import Robot

_KINDS = {kind: role for role in TYPES for kind in (TYPES[role], *OTHER_TYPES.get(role, ())) if kind not in TF_TYPES}
_SLOTS = {"joint_states": "wheels", "odometry": "wheels", "scan": "lidar", "points": "lidar"}


class MessageReader:
    """`events` of each message. The type says which sensor it is of: one topic for each of wheels, LiDAR, IMU and centre of gravity."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._sources = Sources(None, None, None, None)
        self._decoder: EventDecoder | None = None
        self.stats = MessageStats()
        """What was dropped or corrected."""

    def events(self, message: Any, kind: str = "") -> Iterator[Event]:
        """The events that ``message`` makes; ``kind`` (package/msg/Type) is that of a mapping. A message whose content is unusable is
        dropped, and counted. Raises `EventError` for a type that is not read, two types for one sensor, and a message without a stamp."""
        kind = kind or type_of(message)
        message = as_joint_states(_plain(message), kind, kind)
        decoder = self._decoder_of(kind, message)
        stamp = stamp_of(message, kind)
        try:
            reading = decoder.decoders[kind].decode(message, stamp)
        except UnusableError as reason:
            self.stats.count(short_type(kind), reason.oddity)
            return
        except (AttributeError, TypeError, ValueError, IndexError) as error:
            raise EventError(f"{short_type(kind)} at {stamp} ns: its fields are not those of the type ({error}).") from error
        if reading is not None:
            yield from decoder.events(reading)

    def _decoder_of(self, kind: str, message: Any) -> EventDecoder:
        role = _KINDS.get(kind)
        if role is None:
            raise EventError(f"messages of type '{kind}' are not read; there are {', '.join(sorted(map(short_type, _KINDS)))}.")
        slot = _SLOTS.get(role, role)
        present = getattr(self._sources, slot)
        if present is not None and present.topic != kind:
            both = f"{short_type(present.topic)} and {short_type(kind)}"
            raise EventError(f"{both} are both of the {slot}, and one is used. Pass messages of one of them alone.")
        if present is None or self._decoder is None:
            names = {*getattr(message, "name", ())}
            if role == "joint_states" and names and names <= {LEFT, RIGHT}:
                self._robot = replace(self._robot, joints=self._robot.joints.of_sides(LEFT, RIGHT))
            chosen: dict[str, Any] = {slot: TopicSource(kind, role, "option", kind)}
            self._open(replace(self._sources, **chosen), None if slot == "wheels" else self.angles)
        assert self._decoder is not None
        return self._decoder

    def _open(self, sources: Sources, angles: WheelAngles | None) -> None:
        joints = self._robot.joints
        self._sources = sources
        self._decoder = EventDecoder(sources, (joints.left, joints.right), None, self._robot, self.stats, {})
        if angles is not None:
            self._decoder.from_joints, self._decoder.from_odometry = angles.joints, angles.odometry

    @property
    def angles(self) -> WheelAngles | None:
        """Angles of the wheels up to now, which a state holds; None before the first message."""
        return None if self._decoder is None else WheelAngles(self._decoder.from_joints, self._decoder.from_odometry)

    def state(self) -> tuple[Robot, Sources, WheelAngles | None]:
        """What `restore` takes."""
        return replace(self._robot, folder=None), self._sources, self.angles

    def restore(self, robot: Robot, sources: Sources, angles: WheelAngles | None) -> None:
        """Go on from a `state`."""
        self._robot = robot
        self._open(sources, angles)


def type_of(message: Any) -> str:
    """Type of a message of rclpy or rosbags, package/msg/Type. Raises `EventError` for other objects."""
    kind = getattr(message, "__msgtype__", "")
    module = type(message).__module__.split(".")
    if not kind and len(module) > 1 and module[1] == "msg":
        kind = f"{module[0]}/msg/{type(message).__name__}"
    if not kind:
        raise EventError(f"a {type(message).__name__} is neither an event nor a message of ROS. Name the type of a mapping by `kind`.")
    return str(kind)


def stamp_of(message: Any, kind: str) -> int:
    """Header stamp [ns]. Raises `EventError` where there is none, or where it is no number of whole nanoseconds."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    whole = (int, np.integer)
    if not isinstance(getattr(stamp, "sec", None), whole) or not isinstance(getattr(stamp, "nanosec", None), whole):
        raise EventError(f"{short_type(kind)}: its header has no stamp of whole `sec` and `nanosec`.")
    if not (ns := stamp_ns(message)):
        raise EventError(f"{short_type(kind)}: its stamp is 0. Set header.stamp to the time of the measurement.")
    return ns


def _plain(message: Any) -> Any:
    """A mapping, and those in it, with attributes; other messages as they are."""
    if isinstance(message, Mapping):
        return SimpleNamespace(**{name: _plain(value) for name, value in message.items()})
    if isinstance(message, list | tuple):
        return [_plain(value) for value in message]
    return message
