"""Logs cut into maneuvers for calibration: seconds of wheel motion, each with the motion that a reference measured in the same seconds."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from localization.bounded_settings import Count, Positive, Settings
from localization.calibration.motion_references import HOLD_S, MotionReference, Span, Wheels
from localization.events import CgSample, Event, WheelSample
from localization.inputs.wheel_buffer import WheelBuffer
from localization.messages import Message, message
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import ForeignWindows, Maneuver
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_NS = 1e-9
_NOTHING = np.zeros((0,))
_LEAST_STEP_RAD = 1e-6
"""Smaller differences of angles are rounding [rad]."""
_FEWEST_STEPS, _MERGED_S = 16.0, 0.25
"""Intervals of fewer steps of the encoders are merged until a side has gone so many, or so long [s]: rates are then right to a sixteenth.

By 512 counts a turn, of which a VaultBot's wheel goes 5 in a sample of 20 ms, predicted turns of 2 s were off by 4.8 mrad; merged to 8
steps by 3.2, to 16 by 1.8, to 32 by 1.7, and by 4096 counts by 2.3 mrad."""


@dataclass(frozen=True)
class WindowConfig(Settings):
    """How a log is cut into maneuvers."""

    window_s: Positive = 2.0
    """Length of a maneuver [s]: long enough for the wheels to stand out of the reference's noise, short enough not to drift."""
    around_s: float = 0.3
    """Wheel motion kept before and after each, in which a shift between the clocks is looked for [s]."""
    least_m: float = 0.02
    """A window in which no wheel rolls as far as this has too little motion and is left out [m]."""
    per_group: Count = 3
    """Neighbouring windows that share their errors, and are held out together."""


@dataclass(frozen=True)
class Windows:
    """What a log gave for calibration."""

    maneuvers: tuple[Maneuver, ...]
    standing: int
    """Windows that were left out because the robot stood still in them, or hardly moved."""
    unmeasured: int
    """Windows that were left out because wheels or reference had no data, or no valid measurement."""
    warnings: tuple[Message, ...]
    """Limits of the motion reference, in sentences for the user."""
    step_rad: float = 0.0
    """Step of the encoders [rad]; 0 where none was seen."""

    @property
    def counts(self) -> dict[str, int]:
        """Windows, and those left out by reason, as messages have them."""
        return {"count": len(self.maneuvers), "standing": self.standing, "unmeasured": self.unmeasured}


def cut(
    events: Iterable[Event],
    reference: MotionReference,
    model: MotionModel,
    robot: Robot,
    config: WindowConfig | None = None,
    name: str = "log",
) -> Windows:
    """Cut a log's ``events`` into maneuvers as long as ``reference`` measures them; ``name`` begins the names of their groups.

    The ``model``'s nominal parameters start the matching of scans and give turns their sign; what is measured does not depend on them.
    """
    config = config or WindowConfig()
    history = WheelBuffer(robot.center_of_gravity, keep_s=2.0 * config.window_s + 10.0)
    wheels = Wheels(history, model, robot.wheel_noise)
    around = round(config.around_s / _NS)
    waiting: list[Span] = []
    found: list[tuple[Span, Maneuver]] = []
    first_wheel_ns: int | None = None
    last_wheels: WheelSample | None = None
    step_rad = math.inf
    short = unmeasured = 0

    def take(until_ns: int | None) -> Iterator[Span]:
        while waiting and (until_ns is None or waiting[0].end_ns + around <= until_ns):
            yield waiting.pop(0)

    def use(span: Span) -> int:
        """1 if the span was not measured."""
        nonlocal short
        window = _window(history, span, around, step_rad)
        if window is None:
            return 1
        dt, rates, cg, lead, middle, n = window
        rolled = robot.geometry.wheel_radius_m * np.abs(rates[lead : lead + n]).T @ dt[lead : lead + n]
        if np.max(rolled) < config.least_m:
            short += 1
        elif span.is_valid:
            end = np.array([n], dtype=np.int64)
            found.append((span, Maneuver(dt, rates, span.measured[None], end, cg, span.cov, lead=lead, middle=middle)))
        else:
            return 1
        return 0

    for event in events:
        if isinstance(event, WheelSample):
            history.insert(event)
            step_rad, last_wheels = _least_step(step_rad, event, last_wheels), event
            first_wheel_ns = event.stamp_ns if first_wheel_ns is None else first_wheel_ns
        elif isinstance(event, CgSample):
            history.set_cg(event)
        waiting.extend(reference.spans(event, wheels))
        if history.newest_ns is not None:
            for span in take(history.newest_ns):
                unmeasured += use(span)
    for span in take(None):
        unmeasured += use(span)
    corrected = reference.correct([span for span, _ in found])
    maneuvers = _grouped([maneuver for _, maneuver in found], corrected, first_wheel_ns or 0, config.window_s * config.per_group, name)
    return Windows(tuple(maneuvers), short, unmeasured, tuple(reference.warnings()), step_rad if math.isfinite(step_rad) else 0.0)


def _grouped(maneuvers: Sequence[Maneuver], spans: Sequence[Span], begin_ns: int, group_s: float, name: str) -> list[Maneuver]:
    """The ``maneuvers`` with the measurements of their ``spans``, in groups of ``group_s`` [s] that begin with ``name``."""
    found = []
    for maneuver, span in zip(maneuvers, spans, strict=True):
        number = int((span.start_ns - spans[0].start_ns) * _NS / group_s)
        group, start_s = f"{name}, {number * group_s:g} s", (span.start_ns - begin_ns) * _NS
        found.append(dataclasses.replace(maneuver, measured=span.measured[None], cov=span.cov, group=group, start_s=start_s))
    return found


def _least_step(step_rad: float, sample: WheelSample, before: WheelSample | None) -> float:
    """Smallest difference of angles so far, which is the encoders' step where these are coarse [rad]."""
    ways = [] if before is None else np.abs(sample.position - before.position).tolist()
    return float(min([step_rad, *(way for way in ways if way > _LEAST_STEP_RAD)]))


def _window(
    history: WheelBuffer, span: Span, around: int, step_rad: float
) -> tuple[FloatArray, FloatArray, FloatArray, int, int, int] | None:
    """Intervals (n,), rates (n, 2) and CG (n, 2) around a span, by encoders of this step; how many lie before it, in it before its middle,
    and in it. None where some are missing."""
    middle_ns = span.start_ns if span.middle_ns is None else span.middle_ns
    edges = (span.start_ns - around, span.start_ns, middle_ns, span.end_ns, span.end_ns + around)
    parts = []
    for begin, end in itertools.pairwise(edges):
        dt, rates, cg, _, missing = history.window(begin, end, HOLD_S)
        if missing and begin < end:
            if span.start_ns <= begin < span.end_ns:
                return None
            dt, rates, cg = _NOTHING, np.zeros((0, 2)), np.zeros((0, 2))  # at the log's ends, no clock is looked for
        parts.append(merge_counts(dt, rates, cg, step_rad))
    dt, rates, cg = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    lead, first, second, _ = (len(part[0]) for part in parts)
    return dt, rates, cg, lead, first, first + second


def merge_counts(dt: FloatArray, rates: FloatArray, cg: FloatArray, step_rad: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intervals (n,) [s], rates (n, 2) and CG (n, 2), merged where the encoders' step is not much less than a side's way in one.

    By such encoders a wheel stands in one interval and rolls twice as fast in the next, and so does the other side at another time: no
    robot turns as a model predicts for these rates, but as for their mean.
    """
    ways = np.abs(rates) * dt[:, None]
    moving = ways[ways > 0.0]
    if not moving.size or _FEWEST_STEPS * step_rad < float(np.median(moving)):
        return dt, rates, cg
    index, gone, seconds = np.zeros(len(dt), dtype=np.int64), np.zeros(2), 0.0
    for i in range(1, len(dt)):
        gone, seconds = gone + ways[i - 1], seconds + float(dt[i - 1])
        is_full = gone.max() >= _FEWEST_STEPS * step_rad or seconds + float(dt[i]) > _MERGED_S
        index[i] = index[i - 1] + is_full
        if is_full:
            gone, seconds = np.zeros(2), 0.0
    first = np.flatnonzero(np.diff(index, prepend=-1))
    merged = np.add.reduceat(dt, first)
    means = [np.add.reduceat(values * dt[:, None], first) / merged[:, None] for values in (rates, cg)]
    return merged, means[0], means[1]


def driven(maneuvers: Sequence[Maneuver], wheel_radius_m: float, track_width_m: float) -> tuple[float, float, float]:
    """Seconds, metres that the wheels' mean rolled, and radians by the difference of both sides' ways over the track."""
    seconds = metres = radians = 0.0
    for m in maneuvers:
        inside = slice(m.lead, m.lead + int(m.ends[-1]))
        dt, ways = m.dt[inside], m.wheels[inside] * m.dt[inside, None] * wheel_radius_m
        seconds += float(dt.sum())
        metres += float(np.abs(ways.mean(axis=1)).sum())
        radians += float(np.abs(ways[:, 1] - ways[:, 0]).sum()) / track_width_m
    return seconds, metres, radians


def describe_foreign(found: Sequence[ForeignWindows]) -> list[Message]:
    """Windows of a table that were left out as their positions are in another frame."""
    notes = []
    for each in found:
        counts = {"count": each.left_out, "compared": each.compared}
        if each.kind == "far":
            notes.append(message("foreign_windows.far", groups=each.groups, largest=each.largest, **counts))
        else:
            notes.append(message("foreign_windows.turned", groups=each.groups, largest=math.degrees(each.largest), **counts))
    return notes
