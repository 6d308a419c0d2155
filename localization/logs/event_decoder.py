"""From messages to events: what each topic's messages mean, by the part that the topic plays. Logs and live topics alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from localization.events import CgSample, Event
from localization.logs.arm_cg import arms_to_cg, standing
from localization.logs.clock_sync import Item
from localization.logs.decode import (
    ArmReading,
    JointReading,
    OdometryReading,
    UnusableError,
    arm_decoder,
    decode_cg,
    decode_imu,
    decode_odometry,
    joint_decoder,
    scan_decoder,
    stamp_ns,
)
from localization.logs.message_stats import Oddity, Tally
from localization.logs.point_clouds import decode_cloud
from localization.logs.topics import Sources, TopicSource
from localization.logs.wheel_decoder import JointsToWheels, OdometryToWheels
from motion_models.center_of_gravity.model import CgModel
from motion_models.robot import Robot

_RANKS = {"joint_states": 0, "odometry": 0, "center_of_gravity": 1, "imu": 2, "scan": 3, "points": 3}
_SCAN_WEIGHT = 100

Payload = Callable[[Any, int], Any]
Part = tuple[int, Payload]
"""Rank among equal stamps, and the decoder of a message with its stamp."""


class Intake:
    """Decoders of the topics in use, and what makes events of readings. It remembers the last readings of wheels and arms."""

    def __init__(
        self,
        sources: Sources,
        joints: tuple[tuple[str, ...], tuple[str, ...]],
        arms: CgModel | None,
        robot: Robot,
        tally: Tally,
    ) -> None:
        """``joints``: names of the left and of the right wheels' joints."""
        self._sources, self._joints, self._arms = sources, joints, arms
        wheels = "" if sources.wheels is None else sources.wheels.topic
        left, right = joints
        self.from_joints = JointsToWheels(len(left), len(right), robot.geometry.wheel_radius_m, wheels, tally)
        self.from_odometry = OdometryToWheels(robot.driver, wheels, tally)
        named = " and ".join(source.topic for source in sources.arms)
        self._from_arms = None if arms is None else arms_to_cg(arms, robot.geometry, named, tally)
        told_by = "" if sources.center_of_gravity is None else sources.center_of_gravity.topic
        self._standing = partial(standing, geometry=robot.geometry, topic=told_by, oddity=Oddity.TIPPING_CG, tally=tally)
        self.parts: Mapping[str, Part] = {source.topic: (_RANKS[source.kind], self._decoder(source)) for source in sources.used()}
        """By topic."""

    def events(self, payload: Any) -> Iterator[Event]:
        """The events of one decoded message; readings must come in order."""
        if isinstance(payload, JointReading):
            yield from self.from_joints(payload)
        elif isinstance(payload, ArmReading):
            if (wheels := payload.wheels) is not None:
                yield from self.from_joints(JointReading(payload.stamp_ns, wheels.position, wheels.velocity))
            if self._from_arms is not None:
                yield from self._from_arms(payload)
        elif isinstance(payload, OdometryReading):
            yield from self.from_odometry(payload)
        elif isinstance(payload, CgSample):
            yield from self._standing(payload)
        else:
            yield payload

    def _decoder(self, source: TopicSource) -> Payload:
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
        decoders: dict[str, Payload] = {
            "odometry": decode_odometry,
            "imu": decode_imu,
            "center_of_gravity": decode_cg,
            "points": decode_cloud,
        }
        return decoders[source.kind]


def read_item(topic: str, log_ns: int, read: Callable[[], Any], part: Part, tally: Tally) -> Item | None:
    """The message that ``read`` gives, recorded at ``log_ns``, as an item to merge; None, and counted, where it says nothing."""
    rank, payload_of = part
    try:
        message = read()
        stamp = stamp_ns(message)
        payload = payload_of(message, stamp)
    except UnusableError as reason:
        tally.count(topic, reason.oddity)
        return None
    except (AttributeError, TypeError, ValueError):  # the log's own definition of the type lacks what the type has
        tally.count(topic, Oddity.MALFORMED)
        return None
    if payload is None:
        return None
    if isinstance(payload, ArmReading) and payload.wheels is None:
        rank = _RANKS["center_of_gravity"]
    return Item(log_ns, stamp, topic, rank, _SCAN_WEIGHT if rank == 3 else 1, payload)
