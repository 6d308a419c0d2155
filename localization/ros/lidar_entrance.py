"""A live LiDAR whose yaw is wrong: found on the first metres, and the drive since its start estimated anew with the right one."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from localization.calibration.lidar_check import LidarCheck, LidarFinding
from localization.events import Event, Scan

_STANDING_NS = 5_000_000_000  # kept of a robot that has not moved: the gyro's bias is learned from it
_MAX_POINTS = 2_000_000  # of the scans that are kept; bounds the memory to 100 MB


class LidarEntrance:
    """Keeps the events of the first metres until the LiDAR's mount is known to agree with the wheels."""

    def __init__(self, check: LidarCheck) -> None:
        self._check = check
        self._events: deque[Event] = deque()
        self._points = 0

    def add(self, event: Event) -> bool:
        """Take ``event``; whether it was the last that is needed."""
        self._check.add(event)
        self._events.append(event)
        self._points += _points(event)
        while not self._check.has_moved and self._events[0].stamp_ns < event.stamp_ns - _STANDING_NS:
            self._points -= _points(self._events.popleft())
        return self._check.is_done or self._points > _MAX_POINTS

    @property
    def largest_error_m(self) -> float:
        """Largest error of the position [m]: twice the way by the wheels, while the LiDAR travels in another direction; else 0."""
        return 2.0 * self._check.contradicted_way_m

    def result(self) -> tuple[LidarFinding | None, Iterable[Event]]:
        """What was found, and the events since the start of the drive."""
        return self._check.result(), self._events


def _points(event: Event) -> int:
    return len(event.points) if isinstance(event, Scan) else 0
