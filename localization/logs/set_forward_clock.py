"""Stamps and times of recording after the clock of the robot's computer was set forward: a drive would have a pause that was none.

Both jump alike, for all topics at once, as after a recorder that was paused. The wheels decide between the two: those that turn before and
after the jump are, after a pause, at angles that the pause has turned them to. Where they go on as within one period, the clock was set,
and all later times are moved back by the step. Wheels that stand show nothing, nor do rates without angles.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from localization.logs.chunks import RawMessage
from localization.logs.decode import JointReading, OdometryReading
from motion_models.se2 import FloatArray

MIN_STEP_NS = 5_000_000_000
"""Shorter pauses are gaps of the messages, over which wheels are interpolated."""
_MAX_OTHER_STEP_NS = 500_000_000
"""Largest difference between the steps of stamps and times of recording."""
_MIN_RATE_RAD_S, _MIN_SPEED_M_S = 0.1, 0.02
"""Least rate of wheels that turn, and speed of a driver's odometry that moves."""
_MAX_PERIODS = 3.0
"""Motion over the jump, of that in a period, of a clock that was set: one or two messages may be missing."""


@dataclass(frozen=True)
class SetForward:
    """The clock was set forward."""

    at_ns: int
    """First time of recording after it."""
    by_ns: int


Reading = JointReading | OdometryReading


def find_set_forwards(messages: Iterable[RawMessage], wheels: str, decode: Callable[[RawMessage], Reading | None]) -> list[SetForward]:
    """Where the clock was set forward among the ``messages`` of all topics in use, in order of recording; ``decode`` reads those of the
    topic ``wheels``."""
    near: deque[RawMessage] = deque(maxlen=2)
    found: list[SetForward] = []
    last_ns, jump_ns, recorded_ns, until = None, 0, 0, 0
    for raw in messages:
        if last_ns is not None and raw.log_ns - last_ns > MIN_STEP_NS:
            jump_ns, recorded_ns, until = raw.log_ns, raw.log_ns - last_ns, len(near) + 2
            near = deque(near, maxlen=until + 1)
        last_ns = raw.log_ns
        if raw.topic != wheels:
            continue
        near.append(raw)
        if not jump_ns or len(near) < until:
            continue
        by_ns = _step(list(near)[-4:], recorded_ns, decode)
        if by_ns:
            found.append(SetForward(jump_ns, by_ns))
        if by_ns or len(near) > until:  # the first message after the jump may be stamped before it
            jump_ns, near = 0, deque(near, maxlen=2)
    return found


def _step(messages: Sequence[RawMessage], recorded_ns: int, decode: Callable[[RawMessage], Reading | None]) -> int:
    """By how much the clock was set in the middle of four ``messages`` [ns], where times of recording jump by ``recorded_ns``; 0 for a
    pause, or where it is not known."""
    readings = [reading for reading in map(decode, messages) if reading is not None]
    if len(readings) != 4:
        return 0
    stamps, places = [reading.stamp_ns for reading in readings], [_place(reading) for reading in readings]
    period_ns = (stamps[1] - stamps[0] + stamps[3] - stamps[2]) // 2
    step_ns = stamps[2] - stamps[1]
    if period_ns <= 0 or abs(step_ns - recorded_ns) > _MAX_OTHER_STEP_NS:
        return 0
    ways = [np.abs(there - here) for here, there in itertools.pairwise(places)]
    least = (_MIN_RATE_RAD_S if isinstance(readings[0], JointReading) else _MIN_SPEED_M_S) * period_ns * 1e-9
    is_moving = min(float(ways[0].max()), float(ways[2].max())) > least
    is_continued = bool((ways[1] <= _MAX_PERIODS * np.maximum(np.maximum(ways[0], ways[2]), least)).all())
    return step_ns - period_ns if is_moving and is_continued else 0


def _place(reading: Reading) -> FloatArray:
    """Angles of the wheels, or position of the odometry; NaN compares as no continuation."""
    return reading.position if isinstance(reading, JointReading) else reading.pose[:2]


def earlier_ns(set_forwards: Sequence[SetForward], log_ns: int) -> int:
    """By how much a message was recorded earlier than its time of recording ``log_ns`` has it [ns]."""
    return sum(step.by_ns for step in set_forwards if log_ns >= step.at_ns)


def describe_set_forwards(set_forwards: Sequence[SetForward], start_ns: int) -> list[str]:
    """A sentence for each time the clock was set forward."""
    return [
        f"the computer's clock was set forward by {step.by_ns * 1e-9:.1f} s, {(step.at_ns - step.by_ns - start_ns) * 1e-9:.1f}"
        " s after the start of the log: all stamps and times of recording jump, and the wheels go on where they were. Later times are moved"
        " back by that, also in what is written."
        for step in set_forwards
    ]
