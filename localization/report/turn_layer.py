"""Turns in place of a replay: what the wheels did and where the centre of gravity was, beside the poses of an estimator with a LiDAR."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from localization.events import CgSample, Event, WheelSample
from localization.report.cg_figure import Turns, turn_of, turns_of
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_WINDOW_NS, _MAX_GAP_S = 2_000_000_000, 0.5
"""Length of a window [ns], as of calibrations; longest time between the poses around its ends [s]."""


@dataclass(frozen=True)
class _Window:
    start_ns: int
    end_ns: int
    ways: FloatArray
    """(2,) turned by the left and the right wheels [rad]."""
    cg: FloatArray
    """(2,) mean centre of gravity [m]."""


class TurnLayer:
    """Windows of a drive, kept while its events pass through `watch`: six numbers each two seconds, however long it is."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._windows = robot, list[_Window]()
        self._cg = np.array(robot.center_of_gravity)
        self._start: WheelSample | None = None
        self._last: WheelSample | None = None
        self._ways, self._centres = np.zeros(2), list[FloatArray]()

    def watch(self, events: Iterable[Event]) -> Iterator[Event]:
        """Pass the events on, and keep what the wheels and the centre of gravity do."""
        for event in events:
            if isinstance(event, CgSample):
                self._cg = event.position
            elif isinstance(event, WheelSample):
                self._add(event)
            yield event

    def _add(self, sample: WheelSample) -> None:
        if self._last is not None:
            self._ways = self._ways + _rolled(self._last, sample)
            self._centres.append(self._cg)
        if self._start is not None and sample.stamp_ns - self._start.stamp_ns >= _WINDOW_NS:
            self._windows.append(_Window(self._start.stamp_ns, sample.stamp_ns, self._ways, np.mean(self._centres, axis=0)))
            self._start = None
        if self._start is None:
            self._start, self._ways, self._centres = sample, np.zeros(2), []
        self._last = sample

    def turns(self, track: Trajectory) -> Turns:
        """Windows that turn in place, by the poses of ``track``."""
        found = []
        for window in self._windows:
            ends = [window.start_ns, window.end_ns]
            if np.isfinite(window.ways).all() and track.covers(ends, _MAX_GAP_S).all():
                turn = turn_of(window.ways, se2.between(*track.at(ends)), window.cg, self._robot)
                found += [] if turn is None else [turn]
        return turns_of(found)


def _rolled(before: WheelSample, after: WheelSample) -> FloatArray:
    """(2,) angles from one sample to the next [rad], by the rates where the log has no angles."""
    by_rates = 0.5e-9 * (after.stamp_ns - before.stamp_ns) * (before.velocity + after.velocity)
    by_angles = after.position - before.position
    return np.asarray(np.where(np.isfinite(by_angles), by_angles, by_rates))
