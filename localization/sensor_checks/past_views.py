"""Past scans of each LiDAR, and where they were taken by wheels and estimate."""

from __future__ import annotations

import math
import operator
from collections import deque
from typing import NamedTuple

import numpy as np

from localization.sensor_checks import wheel_agreement
from localization.sensor_checks.scan_motion import Profile
from localization.sensor_checks.wheel_agreement import CALM_S
from motion_models import se2
from motion_models.se2 import FloatArray

_MAX_VIEWS = 17
"""Views of the last four seconds, one for each bin of the window, after which at .05 m/s an object has moved by more than its tolerance."""


class View(NamedTuple):
    """A scan, and where it was taken by two odometries."""

    poses: FloatArray
    """(2, 3) by the wheels, and by the estimate."""
    profile: Profile

    def led_back(self, now: FloatArray) -> View:
        """The view from which the estimate has moved as the wheels have, to the poses ``now`` (2, 3)."""
        by_wheels = se2.between(now[0], self.poses[0])
        return self._replace(poses=np.array([self.poses[0], se2.compose(now[1], by_wheels)]))


class LidarViews:
    """Past views of one LiDAR, and whether objects move in them."""

    def __init__(self) -> None:
        self._views: deque[View] = deque(maxlen=_MAX_VIEWS)
        self._standing: View | None = None
        """First view since the wheels stopped; None while they turn."""
        self._shown, self._last_s = 0, -math.inf  # successive comparisons that showed moving objects, and time of the last one [s]
        self.is_active = False
        """Objects move."""

    def add(self, view: View, *, is_standing: bool) -> None:
        """Keep ``view``, of a robot that ``is_standing``."""
        self._views.append(view)
        if is_standing and self._standing is None:
            self._standing = view

    def references(self, now: FloatArray) -> list[View]:
        """The oldest view from which wheels and estimate have hardly moved to the poses ``now`` (2, 3), and the middle one of those after
        it; the first one of a robot that stands there; none before the first."""
        views = self._views
        if self._standing is not None and not wheel_agreement.compare_motions(self._standing.poses, now)[0]:
            self._standing = None
        if self._standing is not None and not self.is_active:
            return [self._standing]
        while views and not wheel_agreement.compare_motions(views[0].poses, now)[0]:
            views.popleft()
        return [views[0], views[len(views) // 2]] if len(views) > 2 else list(views)[:1]

    def lead_back(self, now: FloatArray) -> None:
        """From all views, the estimate has moved as the wheels have, to the poses ``now`` (2, 3)."""
        self._views = deque((view.led_back(now) for view in self._views), maxlen=_MAX_VIEWS)

    def add_comparison(self, now_s: float, again: int, *, is_moving: bool) -> None:
        """Objects move from the ``again``-th successive comparison on that shows it, until they have not for some time."""
        self._shown = self._shown + 1 if is_moving else 0
        if is_moving:
            self._last_s = now_s
        self.is_active = self._shown >= again or (self.is_active and now_s - self._last_s < CALM_S)


class PastViews:
    """Views of all LiDARs. A scan becomes a view by `keep`, once its pose is known."""

    def __init__(self) -> None:
        self._lidars: dict[str, LidarViews] = {}
        self._next: tuple[LidarViews, Profile, bool] | None = None

    @property
    def is_active(self) -> bool:
        """Objects move in the scans of one of them."""
        return any(map(operator.attrgetter("is_active"), self._lidars.values()))

    def of(self, frame: str) -> LidarViews:
        """Those of the LiDAR ``frame``."""
        lidar = self._lidars[frame] = self._lidars.get(frame) or LidarViews()
        return lidar

    def take(self, lidar: LidarViews, profile: Profile, *, is_standing: bool) -> None:
        """The last scan of ``lidar``, of a robot that ``is_standing``, is a view once the pose at its step's end is known."""
        self._next = lidar, profile, is_standing

    def keep(self, poses: FloatArray) -> None:
        """The last scan was taken at ``poses`` (2, 3)."""
        if self._next is not None:
            (lidar, profile, is_standing), self._next = self._next, None
            lidar.add(View(poses, profile), is_standing=is_standing)

    def lead_back(self, now: FloatArray) -> None:
        """See `LidarViews.lead_back`."""
        for lidar in self._lidars.values():
            lidar.lead_back(now)

    def clear(self) -> None:
        """Compare from here on."""
        self._lidars.clear()
