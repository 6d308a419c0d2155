"""Faults of gyro, encoders and LiDAR, put into the events of a drive."""

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
    return change_wheels(lambda step, part: step * (factor if begin <= part < end else 1.0))


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


def change_wheels(change: Callable[[np.ndarray, float], np.ndarray]) -> EventFault:
    """``change`` of each increment (2,) of the wheels' angles [rad], left and right, by the part of the drive (0 to 1)."""

    def apply(events: list[Event]) -> Iterator[Event]:
        first_ns, last_ns, last, counted = events[0].stamp_ns, events[-1].stamp_ns, None, np.zeros(2)
        for event in events:
            if isinstance(event, WheelSample):
                step = event.position - (event.position if last is None else last)
                last, counted = event.position, counted + change(step, (event.stamp_ns - first_ns) / (last_ns - first_ns))
                event = replace(event, position=counted.copy(), velocity=np.full(2, np.nan))
            yield event

    return apply


def hold_gyro(part: float, rate: float, axis: int = 2) -> EventFault:
    """The gyro repeats ``rate`` [rad/s] from the ``part`` of the drive on."""
    return change_gyro(lambda w, now: rate if now > part else w, axis)


def turn_scans(degrees: float) -> EventFault:
    """Scans of a LiDAR that is mounted with another yaw."""
    a = math.radians(degrees)
    R = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return change_scans(lambda scan, begin_ns: replace(scan, points=scan.points @ R.T))


def _cover(scan: Scan, half_angle: float = 0.5, range_m: float = 0.4) -> Scan:
    """A part of the robot is ahead of its LiDAR."""
    bearings = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    covered = np.column_stack([range_m * np.cos(bearings), range_m * np.sin(bearings), np.zeros(len(bearings))])
    return replace(scan, points=np.where((np.abs(bearings) < half_angle)[:, None], covered, scan.points))


def named_faults(axis: int = 2) -> dict[str, EventFault]:
    """Faults with a check of their own; the gyro's ``axis`` is upright."""
    return {
        "gyro opposite": change_gyro(lambda w, part: -w, axis),
        "gyro in deg/s": change_gyro(lambda w, part: math.degrees(w), axis),
        "gyro in deg/s from half": change_gyro(lambda w, part: math.degrees(w) if part > 0.5 else w, axis),
        "gyro converted to radians twice from half": change_gyro(lambda w, part: math.radians(w) if part > 0.5 else w, axis),
        "gyro glitches": change_gyro(lambda w, part: w + 40.0 * (round(1e6 * part) % 50_000 < 500), axis),
        "gyro stuck at 0": hold_gyro(0.4, 0.0, axis),
        "gyro stuck at 0.3 rad/s": hold_gyro(0.4, 0.3, axis),
        "sides swapped": change_wheels(lambda step, part: step[::-1]),
        "right side spins 20 times": change_wheels(lambda step, part: step * (1.0, 20.0 if 0.4 < part < 0.6 else 1.0)),
        "encoders read zero": change_wheels(lambda step, part: step * (not 0.4 < part < 0.6)),
        "right encoder reads zero": change_wheels(lambda step, part: step * (1.0, not 0.4 < part < 0.6)),
        "LiDAR upside down": change_scans(lambda scan, begin_ns: replace(scan, points=scan.points * (1.0, -1.0, 1.0))),
        "LiDAR yaw 25 deg": turn_scans(25.0),
        "LiDAR yaw 90 deg": turn_scans(90.0),
        "beams on the robot": change_scans(lambda scan, begin_ns: _cover(scan)),
    }


def scale_ranges(factor: float) -> EventFault:
    """Ranges ``factor`` times as long."""
    return change_scans(lambda scan, begin_ns: replace(scan, points=scan.points * factor))


def jitter_scan_stamps(sigma_s: float, seed: int = 0) -> EventFault:
    """Stamps of scans with a normal error of ``sigma_s`` [s] each, as of a driver that takes the time at which it has read a scan."""

    def apply(events: list[Event]) -> Iterable[Event]:
        rng = np.random.default_rng(seed)
        late = change_scans(lambda scan, begin_ns: replace(scan, stamp_ns=scan.stamp_ns + round(1e9 * sigma_s * float(rng.normal()))))
        return late(events)

    return apply


def bump_lidar(degrees: float, part: float = 0.5) -> EventFault:
    """The LiDAR is turned about its axis at the ``part`` of the drive."""

    def apply(events: list[Event]) -> Iterable[Event]:
        first_ns, last_ns = events[0].stamp_ns, events[-1].stamp_ns
        later = [e for e in events if e.stamp_ns >= first_ns + part * (last_ns - first_ns)]
        return [*events[: len(events) - len(later)], *turn_scans(degrees)(later)]

    return apply


def _repeat_scans(events: list[Event], begin: float = 0.4, end: float = 0.6) -> Iterator[Event]:
    """The LiDAR's driver publishes its last scan again and again."""
    first_ns, last_ns, last = events[0].stamp_ns, events[-1].stamp_ns, None
    for event in events:
        if isinstance(event, Scan):
            is_repeated = last is not None and begin <= (event.stamp_ns - first_ns) / (last_ns - first_ns) < end
            last = replace(last, stamp_ns=event.stamp_ns) if is_repeated and last is not None else event
            event = last
        yield event


def faults_on_the_way() -> dict[str, EventFault]:
    """Scales, stamps, and changes during a drive, by name."""
    return {
        "ranges 10 % long": scale_ranges(1.1),
        "ranges 10 % short": scale_ranges(0.9),
        "ranges 3 % long": scale_ranges(1.03),
        "wheels 10 % large": change_wheels(lambda step, part: step * 0.9),
        "scan stamps jitter by 30 ms": jitter_scan_stamps(0.03),
        "scan stamps jitter by 30 ms, drawn again": jitter_scan_stamps(0.03, 7),
        "LiDAR bumped by 30 deg": bump_lidar(30.0),
        "LiDAR bumped by 90 deg": bump_lidar(90.0),
        "scans repeat for 8 s": lambda events: _repeat_scans(events),
        "wheels 10 % large from half on": change_wheels(lambda step, part: step * (0.9 if part > 0.5 else 1.0)),
        "sides swapped from half on": change_wheels(lambda step, part: step[::-1] if part > 0.5 else step),
        "left side counts half from half on": change_wheels(lambda step, part: step * ((0.5, 1.0) if part > 0.5 else (1.0, 1.0))),
        "wheels backwards for 12 s": change_wheels(lambda step, part: step * (-1.0 if 0.3 < part < 0.6 else 1.0)),
    }


def without_gyro(fault: EventFault | None = None) -> EventFault:
    """``fault`` of a robot without an IMU."""
    return lambda events: [e for e in (events if fault is None else fault(events)) if not isinstance(e, ImuSample)]
