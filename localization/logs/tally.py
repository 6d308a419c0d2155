"""Counts of what was lost or mended while a log was read, as sentences."""

from __future__ import annotations

from collections import Counter
from enum import Enum


class Oddity(Enum):
    """What can be odd about a message; the value completes the sentence "N messages of TOPIC ..."."""

    UNDECODABLE = "could not be decoded and were dropped"
    NOT_FINITE = "were not finite (NaN or inf) and were dropped"
    MALFORMED = "were malformed and were dropped"
    NO_STAMP = "have no header stamp; the time of their recording was used"
    OUT_OF_ORDER = "came out of order and were sorted"
    REPEATED = "repeat the stamp of the one before and were dropped"
    LATE = "came too late to be sorted in and were dropped"
    OUTLIER = "have a stamp that fits neither their neighbours nor the time of recording, and were dropped"
    REBASED = "were stamped after a jump of their clock and were moved back by it"
    FOREIGN_CLOCK = "are stamped by another clock than the rest and were moved onto the time of recording"
    POSE_JUMP = "report a pose that the wheels cannot have reached; the increment was taken from their rates"
    NO_POSE = "report no pose change while they report motion; the increment was taken from their rates"
    WHEEL_JUMP = "report a wheel angle that jumped (reset or wrapped); the increment was taken from their rates"
    NO_TWIST = "leave their rates at zero while their pose moves; the rates were taken from the pose"
    NO_FIX = "have no GPS fix and were left out"


class Tally:
    """Counts by topic and oddity."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, Oddity]] = Counter()

    def count(self, topic: str, oddity: Oddity, n: int = 1) -> None:
        self._counts[topic, oddity] += n

    def of(self, topic: str, oddity: Oddity) -> int:
        return self._counts[topic, oddity]

    def sentences(self) -> list[str]:
        ordered = sorted(self._counts.items(), key=lambda entry: (entry[0][0], list(Oddity).index(entry[0][1])))
        return [f"{n} message{'s' if n > 1 else ''} of {topic} {oddity.value}." for (topic, oddity), n in ordered if n]
