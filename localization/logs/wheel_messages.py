"""Wheels as drivers publish them besides a whole JointState or an Odometry: one message for each wheel or side, velocities, /tf."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from localization.logs.decode import (
    JointReading,
    Oddity,
    OdometryReading,
    UnusableError,
    decode_odometry,
    frame_name,
    joint_decoder,
    stamp_ns,
    yaw_of,
)
from localization.logs.driver_messages import DRIVER_MESSAGES
from motion_models.robot import Joints

TWIST_TYPES = (
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/TwistWithCovariance",
    "geometry_msgs/msg/Twist",
)
"""Velocities of the body; a driver's odometry where the topic is no command."""
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_BODIES = ("base_link", "base_footprint")
_COMMAND = re.compile(r"cmd|command|teleop|joy|key|desired|target|set_?point|mux|nav|plan|unstamped|safe|limit|ref(?!lect)", re.IGNORECASE)
"""Names of topics that ask for a velocity; none is measured there."""
_MEASURED = re.compile(r"odom|wheel|encoder|measure|actual|feedback|vehicle|base|twist|status|state|speed|vel", re.IGNORECASE)
_MAX_WAITING = 200
"""Readings of one joint that wait for the others' [messages]; joints of one robot come at like rates."""

Decoder = Callable[[Any, int], JointReading | None]
Sample = tuple[int, float, float]
"""Stamp [ns], angle [rad] and rate [rad/s] of one joint; NaN where absent."""


def is_command(topic: str) -> bool:
    """Whether a topic of velocities asks for them by its name."""
    return bool(_COMMAND.search(topic))


def is_measured_twist(topic: str) -> bool:
    """Whether a topic of velocities may be measured by its name, rather than a command or of another estimator."""
    return bool(_MEASURED.search(topic)) and not is_command(topic)


def angle_period_rad(units: Joints, message_type: str) -> float:
    """After which angles of wheels wrap [rad]: of the robot file, else of the counters of ``message_type``, else a full turn."""
    counter = DRIVER_MESSAGES.get(message_type)
    return units.angle_range * units.angle_unit_rad or (0.0 if counter is None else counter.angle_range_rad) or math.tau


def wheel_decoder(joints: tuple[str, ...], units: Joints = Joints()) -> Decoder:  # noqa: B008 (frozen)
    """Decoder of joint states for all ``joints``, be they in one message or in several; signs and ``units`` are those of a robot file.

    Messages with some of the joints are put together while none has come that has all of them. Messages are decoded in the order of
    recording; the decoder keeps the last readings of each joint.
    """
    whole, parts, has_whole = joint_decoder(joints), PartialJoints(joints), False

    signs = np.array([-1.0 if joint in units.reversed else 1.0 for joint in joints])
    is_scaled = bool(units.reversed) or units.angle_unit_rad != 1.0 or units.rate_unit_rad_s != 1.0

    def decode(message: Any, stamp: int) -> JointReading | None:
        nonlocal has_whole
        reading = whole(message, stamp)
        if reading is not None:
            has_whole = True
        elif not has_whole:
            reading = parts.insert(message, stamp)
        if reading is None or not is_scaled:
            return reading
        return JointReading(
            reading.stamp_ns, signs * units.angle_unit_rad * reading.position, signs * units.rate_unit_rad_s * reading.velocity
        )

    return decode


class PartialJoints:
    """Readings of single joints to readings of all ``joints``: `insert` each message.

    The reading is of the newest time that all joints have reached; each joint's angle and rate are interpolated there between its readings
    before and after. Without stamps it is of the last message of each joint, once all have come again.
    """

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self._samples: dict[str, deque[Sample]] = {joint: deque(maxlen=_MAX_WAITING) for joint in joints}
        self._fresh: set[str] = set()
        """Joints that have come since the last reading."""
        self._last_ns = 0

    def insert(self, message: Any, stamp: int) -> JointReading | None:
        """The reading of all joints that ``message`` completes; None where it completes none. Raises `UnusableError`."""
        for i, name in enumerate(message.name):
            samples = self._samples.get(name)
            if samples is None:
                continue
            angle, rate = (float(values[i]) if len(values) > i else math.nan for values in (message.position, message.velocity))
            if not (math.isfinite(angle) or math.isfinite(rate)):
                raise UnusableError(Oddity.NOT_FINITE)
            if samples and (stamp < samples[-1][0] or stamp <= 0):
                samples.clear()  # recorded out of order, the clock was set back, or there are no stamps
                self._last_ns = min(self._last_ns, stamp)
            samples.append((stamp, angle, rate))
            self._fresh.add(name)
        return self._reading()

    def _reading(self) -> JointReading | None:
        if not all(self._samples.values()):
            return None
        at = min(samples[-1][0] for samples in self._samples.values())
        is_complete = at > self._last_ns if at > 0 else len(self._fresh) == len(self._joints)
        if not is_complete or any(samples[0][0] > at for samples in self._samples.values()):
            return None
        values = np.array([_interpolate(self._samples[joint], at) for joint in self._joints])
        self._last_ns = at
        self._fresh.clear()
        return JointReading(at, values[:, 0], values[:, 1])


def _interpolate(samples: deque[Sample], at: int) -> tuple[float, float]:
    """Angle and rate at a stamp that the samples reach; samples before the last one not later than it are removed."""
    while len(samples) > 1 and samples[1][0] <= at:
        samples.popleft()
    begin, angle, rate = samples[0]
    if begin == at or len(samples) == 1:
        return angle, rate
    end, next_angle, next_rate = samples[1]
    share = (at - begin) / (end - begin)
    if abs(next_angle - angle) > math.pi:  # wrapped, or set anew: there is no angle between
        return (angle, rate) if share < 0.5 else (next_angle, next_rate)
    return angle + share * (next_angle - angle), rate + share * (next_rate - rate)


def decode_twist(message: Any, stamp: int) -> OdometryReading:
    """Any of `TWIST_TYPES`: a velocity without a pose. Raises `UnusableError`."""
    twist = message
    while hasattr(twist, "twist"):
        twist = twist.twist
    rate = np.array([twist.linear.x, twist.linear.y, twist.angular.z], dtype=float)
    if not np.isfinite(rate).all():
        raise UnusableError(Oddity.NOT_FINITE)
    return OdometryReading(stamp, np.full(3, np.nan), rate)


def odometry_edge(messages: Any) -> tuple[str, str] | None:
    """Parent and child of the transform by which a driver publishes its odometry on /tf; None where no message has one."""
    for message in messages:
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            if "odom" in parent.split("/")[-1] and child.split("/")[-1] in _BODIES:
                return parent, child
    return None


def transform_decoder() -> Callable[[Any, int], OdometryReading | None]:
    """Decoder of a TFMessage's transform from an odometry frame to the body; None for a message without it. Raises `UnusableError`."""
    edge: tuple[str, str] | None = None

    def decode(message: Any, late: int) -> OdometryReading | None:
        nonlocal edge
        edge = edge or odometry_edge([message])
        for transform in message.transforms:
            if (frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)) != edge:
                continue
            where, yaw = transform.transform.translation, yaw_of(transform.transform.rotation)
            pose = np.array([where.x, where.y, yaw])
            if not np.isfinite(pose).all():
                raise UnusableError(Oddity.NOT_FINITE)
            return OdometryReading(stamp_ns(transform) + late, pose, np.full(3, np.nan))
        return None

    return decode


ODOMETRY_DECODERS: Mapping[str, Callable[[], Callable[[Any, int], OdometryReading | None]]] = {
    **dict.fromkeys(TWIST_TYPES, lambda: decode_twist),
    **dict.fromkeys(TF_TYPES, transform_decoder),
}
"""By type of message, those of odometry that is no nav_msgs/Odometry."""


def odometry_decoder(kind: str, length_unit_m: float = 1.0) -> Callable[[Any, int], OdometryReading | None]:
    """Decoder of odometry in messages of type ``kind`` ("": nav_msgs/Odometry), whose lengths are in units of ``length_unit_m`` [m]."""
    decode = ODOMETRY_DECODERS[kind]() if kind in ODOMETRY_DECODERS else decode_odometry
    if length_unit_m == 1.0:
        return decode
    units = np.array([length_unit_m, length_unit_m, 1.0])

    def decode_scaled(message: Any, stamp: int) -> OdometryReading | None:
        reading = decode(message, stamp)
        return None if reading is None else replace(reading, pose=units[: len(reading.pose)] * reading.pose, twist=units * reading.twist)

    return decode_scaled
