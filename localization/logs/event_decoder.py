"""Messages to events, by the role of their topic. The same for logs and live topics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

from localization.events import CgSample, Event, WheelSample
from localization.logs.clock_sync import Item
from localization.logs.decode import (
    ArmReading,
    JointReading,
    MessageStats,
    Oddity,
    OdometryReading,
    UnusableError,
    arm_decoder,
    decode_cg,
    decode_cloud,
    decode_imu,
    decode_odometry,
    joint_decoder,
    scan_decoder,
    stamp_ns,
)
from localization.logs.topic_roles import Sources, TopicSource
from localization.logs.wheel_decoder import JointsToWheels, OdometryToWheels
from motion_models.center_of_gravity.model import CgModel, CgTracker
from motion_models.center_of_gravity.parts import support_margin
from motion_models.robot import Clock, Geometry, Robot

_RANKS = {"joint_states": 0, "odometry": 0, "center_of_gravity": 1, "imu": 2, "scan": 3, "points": 3}
_SCAN_WEIGHT = 100

MessageDecoder = Callable[[Any, int], Any]
"""An event, or a reading that becomes one, from a message and its header stamp [ns]; None for a message without content."""


class TopicDecoder(NamedTuple):
    """How the messages of one topic become events or readings."""

    rank: int
    """Order among events of equal stamps."""
    decode: MessageDecoder
    late_ns: int = 0
    """By how much stamps are late, as `motion_models.robot.Clock` has it."""


class EventDecoder:
    """Decodes messages of the topics in use to events. Keeps the last readings of wheels and arms."""

    def __init__(
        self,
        sources: Sources,
        joints: tuple[tuple[str, ...], tuple[str, ...]],
        arms: CgModel | None,
        robot: Robot,
        stats: MessageStats,
    ) -> None:
        """``joints``: names of the left and of the right wheels' joints."""
        self._sources, self._joints, self._arms = sources, joints, arms
        wheels = "" if sources.wheels is None else sources.wheels.topic
        left, right = joints
        self._multipliers = robot.geometry.radius_multipliers
        self._has_multipliers = bool((self._multipliers != 1.0).any())
        self.from_joints = JointsToWheels(left, right, robot.geometry.wheel_radius_m, wheels, stats)
        self.from_odometry = OdometryToWheels(robot.driver, wheels, stats)
        named = " and ".join(source.topic for source in sources.arms)
        self._from_arms = None if arms is None else make_arm_cg_converter(arms, robot.geometry, named, stats)
        cg_topic = "" if sources.center_of_gravity is None else sources.center_of_gravity.topic
        self._check_cg = partial(check_tipping, geometry=robot.geometry, topic=cg_topic, oddity=Oddity.TIPPING_CG, stats=stats)
        self.decoders: Mapping[str, TopicDecoder] = {
            source.topic: TopicDecoder(_RANKS[source.kind], self._decoder(source), _late_ns(source.kind, robot.clock))
            for source in sources.used()
        }
        """By topic."""

    def events(self, payload: Any) -> Iterator[Event]:
        """The events of one decoded message; readings must come in order."""
        if isinstance(payload, JointReading):
            yield from map(self._roll, self.from_joints(payload))
        elif isinstance(payload, ArmReading):
            if (wheels := payload.wheels) is not None:
                yield from map(self._roll, self.from_joints(JointReading(payload.stamp_ns, wheels.position, wheels.velocity)))
            if self._from_arms is not None:
                yield from self._from_arms(payload)
        elif isinstance(payload, OdometryReading):
            yield from map(self._roll, self.from_odometry(payload))
        elif isinstance(payload, CgSample):
            yield from self._check_cg(payload)
        else:
            yield payload

    def _roll(self, sample: WheelSample) -> WheelSample:
        """``sample`` with each side's rate and angle times its wheels' radius multiplier."""
        if not self._has_multipliers:
            return sample
        return dataclasses.replace(sample, velocity=sample.velocity * self._multipliers, position=sample.position * self._multipliers)

    def _decoder(self, source: TopicSource) -> MessageDecoder:
        if source.kind == "joint_states":
            wheels = self._sources.wheels
            is_wheels = wheels is not None and wheels.topic == source.topic
            of_wheels = joint_decoder((*self._joints[0], *self._joints[1])) if is_wheels else None
            if self._arms is not None and any(arm.topic == source.topic for arm in self._sources.arms):
                return arm_decoder(frozenset(self._arms.chain.joint_names), of_wheels)
            assert of_wheels is not None
            return of_wheels
        if source.kind == "scan":
            return scan_decoder()
        decoders: dict[str, MessageDecoder] = {
            "odometry": decode_odometry,
            "imu": decode_imu,
            "center_of_gravity": decode_cg,
            "points": decode_cloud,
        }
        return decoders[source.kind]


def _late_ns(kind: str, clock: Clock) -> int:
    seconds = {
        "joint_states": clock.wheel_time_offset_s,
        "odometry": clock.wheel_time_offset_s,
        "imu": clock.gyro_time_offset_s,
        "scan": clock.lidar_time_offset_s,
        "points": clock.lidar_time_offset_s,
    }
    return round(seconds.get(kind, 0.0) * 1e9)


def decode_item(topic: str, log_ns: int, read: Callable[[], Any], decoder: TopicDecoder, stats: MessageStats) -> Item | None:
    """Decode the message that ``read`` returns, recorded at ``log_ns``, to an item to merge; None, and counted, where it is unusable."""
    rank, decode, late_ns = decoder
    try:
        message = read()
        stamp = stamp_ns(message) - late_ns
        payload = decode(message, stamp)
    except UnusableError as reason:
        stats.count(topic, reason.oddity)
        return None
    except (AttributeError, TypeError, ValueError):  # fields of the type are missing in the log's own definition of it
        stats.count(topic, Oddity.MALFORMED)
        return None
    if payload is None:
        return None
    if isinstance(payload, ArmReading) and payload.wheels is None:
        rank = _RANKS["center_of_gravity"]
    return Item(log_ns, stamp, topic, rank, _SCAN_WEIGHT if rank == 3 else 1, payload)


def make_arm_cg_converter(
    model: CgModel, geometry: Geometry, topic: str, stats: MessageStats
) -> Callable[[ArmReading], Iterator[CgSample]]:
    """Converter of readings in order of time. It yields nothing until each joint of ``model`` was received once."""
    tracker = CgTracker(model)

    def convert(reading: ArmReading) -> Iterator[CgSample]:
        estimate = tracker.update(reading.names, reading.position)
        if estimate is None:
            return
        sample = CgSample(reading.stamp_ns, estimate.position, estimate.covariance)
        yield from check_tipping(sample, geometry, topic, Oddity.TIPPING, stats)

    return convert


def check_tipping(sample: CgSample, geometry: Geometry, topic: str, oddity: Oddity, stats: MessageStats) -> Iterator[CgSample]:
    """``sample``, unless the robot would tip over with it, which is counted as ``oddity``."""
    if support_margin(sample.position, geometry.wheelbase_m, geometry.track_width_m) > 0.0:
        yield sample
    else:
        stats.count(topic, oddity)
