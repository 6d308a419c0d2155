"""Faults of a gyro and of encoders, put into the events of a drive."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from localization.events import Event, ImuSample, Scan, WheelSample

EventFault = Callable[[list[Event]], Iterable[Event]]

_RANGE_RAD_S, _BIAS_RAD_S = math.radians(20.0), math.radians(2.6)


def change_gyro(change: Callable[[float, float], float], axis: int = 2) -> EventFault:
    """``change`` of the rate [rad/s] about ``axis``, which is upright, and the part of the drive (0 to 1)."""

    def apply(events: list[Event]) -> Iterator[Event]:
        begin, end = events[0].stamp_ns, events[-1].stamp_ns
        for event in events:
            if isinstance(event, ImuSample):
                rates = event.angular_velocity.copy()
                rates[axis] = change(float(rates[axis]), (event.stamp_ns - begin) / (end - begin))
                event = replace(event, angular_velocity=rates)
            yield event

    return apply


def lose_ticks(left: float, right: float, seed: int = 0) -> EventFault:
    """Each step of a wheel's angle is lost with this probability."""

    def apply(events: list[Event]) -> Iterator[Event]:
        rng, last, counted = np.random.default_rng(seed), None, np.zeros(2)
        for event in events:
            if isinstance(event, WheelSample):
                step = event.position - (event.position if last is None else last)
                last, counted = event.position, counted + step * (rng.random(2) >= [left, right])
                event = replace(event, position=counted.copy(), velocity=np.full(2, np.nan))
            yield event

    return apply


def multiply_wheels(factor: float, begin: float, end: float) -> EventFault:
    """Angles of the wheels grow ``factor`` times as fast, from the part ``begin`` of the drive to ``end``."""

    def apply(events: list[Event]) -> Iterator[Event]:
        first_ns, last_ns, last, counted = events[0].stamp_ns, events[-1].stamp_ns, None, np.zeros(2)
        for event in events:
            if isinstance(event, WheelSample):
                step = event.position - (event.position if last is None else last)
                is_wrong = begin <= (event.stamp_ns - first_ns) / (last_ns - first_ns) < end
                last, counted = event.position, counted + step * (factor if is_wrong else 1.0)
                event = replace(event, position=counted.copy(), velocity=np.full(2, np.nan))
            yield event

    return apply


def faults_of_turns(axis: int = 2) -> dict[str, EventFault]:
    """By name; the gyro's ``axis`` is upright."""
    return {
        "gyro saturated at 20 deg/s": change_gyro(lambda w, part: min(max(w, -_RANGE_RAD_S), _RANGE_RAD_S), axis),
        "gyro scale 30 % high": change_gyro(lambda w, part: 1.3 * w, axis),
        "gyro scale 30 % low": change_gyro(lambda w, part: 0.7 * w, axis),
        "gyro bias steps by 2.6 deg/s": change_gyro(lambda w, part: w + _BIAS_RAD_S * (part > 0.5), axis),
        "gyro bias rises by 2.6 deg/s": change_gyro(lambda w, part: w + _BIAS_RAD_S * part, axis),
        "left ticks lost": lose_ticks(0.3, 0.0),
        "ticks lost": lose_ticks(0.3, 0.3),
    }


def change_scans(change: Callable[[Scan, int], Scan]) -> EventFault:
    """``change`` of each scan, by the stamp of the first event too."""

    def apply(events: list[Event]) -> list[Event]:
        begin_ns = events[0].stamp_ns
        found = [change(event, begin_ns) if isinstance(event, Scan) else event for event in events]
        return sorted(found, key=lambda event: event.stamp_ns)

    return apply


def faults_of_stamps() -> dict[str, EventFault]:
    """Of a planar LiDAR, by name."""
    return {
        "stamps at the sweep's end": change_scans(lambda s, t: replace(s, stamp_ns=s.stamp_ns + round(1e9 * float(s.offsets.max())))),
        "wrong sign of time_increment": change_scans(lambda s, t: replace(s, offsets=-s.offsets)),
        "LiDAR's clock 1 % fast": change_scans(lambda s, t: replace(s, stamp_ns=t + round(1.01 * (s.stamp_ns - t)))),
        "LiDAR's stamps .2 s late": change_scans(lambda s, t: replace(s, stamp_ns=s.stamp_ns + 200_000_000)),
    }
