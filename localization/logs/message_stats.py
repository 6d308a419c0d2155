"""Counts of messages that were dropped or corrected while a log was read, and their descriptions."""

from __future__ import annotations

from collections import Counter
from enum import Enum


class Oddity(Enum):
    """What can be odd about messages; the value completes the sentence "TOPIC: N messages ..."."""

    UNDECODABLE = "dropped (bytes that are not of the type)"
    MALFORMED = "dropped (fields that contradict each other)"
    NO_ANGLES = "dropped (angle_increment is zero, or makes more than a full turn: in degrees?); correct the driver's angles"
    NOT_FINITE = "dropped (NaN or inf)"
    BEYOND = "dropped (beyond what such a sensor can measure)"
    NO_FIX = "left out (no GPS fix)"
    NO_STAMP = "without a header stamp, placed by the time of recording"
    FOREIGN_CLOCK = "stamped by another clock than the other topics', moved to the time of recording"
    OUT_OF_ORDER = "recorded out of order, and sorted"
    REPEATED = "dropped (stamp repeated)"
    LATE = "dropped (recorded more than a second after newer ones)"
    OUTLIER = "dropped (stamp that fits neither its neighbours nor the time of recording)"
    REBASED = "stamped after a jump of the clock, moved back by it"
    POSE_JUMP = "with a pose that wheels cannot reach (a reset); the increment was taken from the rates"
    NO_POSE = "with rates but a pose that never moves; the increment was taken from the rates"
    NO_TWIST = "with a moving pose but no rates; these were taken from the pose"
    TIPPING = "with arms at which the robot would tip over (joints in degrees?); their centre of gravity was left out"
    TIPPING_CG = "with a centre of gravity at which the robot would tip over (not in metres, or not from base_link?); it was left out"
    WHEEL_RATE = "with rates that wheels cannot reach; these were left out"
    SECOND_PUBLISHER = "of a second publisher whose wheels turn less, left out; stop one of the two (`ros2 topic info --verbose`)"
    FROZEN_WHEEL = "with an angle that never changes while another wheel of its side turns; it was left out (check its encoder)"
    WHEEL_JUMP = "with a wheel angle that wheels cannot reach (a reset); the increment was taken from the rates"


class UnusableError(Exception):
    """A message without usable content. Raised and caught within this package."""

    def __init__(self, oddity: Oddity) -> None:
        super().__init__(oddity.value)
        self.oddity = oddity


class MessageStats:
    """Counts by topic and oddity."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, Oddity]] = Counter()

    def count(self, topic: str, oddity: Oddity, n: int = 1) -> None:
        self._counts[topic, oddity] += n

    def of(self, topic: str, oddity: Oddity) -> int:
        return self._counts[topic, oddity]

    def describe(self) -> list[str]:
        ordered = sorted(self._counts.items(), key=lambda entry: (entry[0][0], list(Oddity).index(entry[0][1])))
        return [f"{topic}: {n} message{'s' if n > 1 else ''} {oddity.value}." for (topic, oddity), n in ordered if n]
