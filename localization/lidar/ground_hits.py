"""Points of a planar scan that may be hits of the ground, which beams on hills reach before they reach a wall.

The beams run along the plane on which the robot stands. Ground of curvature h'' rises over this plane by h'' d^2 / 2 at the distance d
(Taylor), and reaches the beams of a scanner at height z from about d = sqrt(2 z / |h''|) on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from localization.events import Scan
from localization.messages import Message, message
from motion_models.robot import Mount

_SIGMAS = 2.0
"""Curvature, in units of its root mean square, up to which a point counts as one above the ground: 95 % of them."""
_PLANE = 7e-3
"""Curvature up to which the ground counts as a plane [1/m]: a ramp in the simulator shows .0015 to .0029, a plane with bumps of
2e-3 rad/sqrt(m) .0056, hills of 2 deg .008 to .010."""
_REPORTED_SHARE = 0.2
"""Share of the points that is reported."""


class GroundHits:
    """`leave_out` of each scan. ``mounts`` of the LiDARs are by frame."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._points, self._left_out = 0, 0
        self._nearest_m, self._frame = math.inf, ""
        self.held = 0
        """Scans that were left out while it was not certain whether the ground tilts."""

    def leave_out(self, scan: Scan, curvature: float) -> Scan:
        """``scan``, and those beside it, without the points that ground of this root mean square ``curvature`` [1/m] may reach. Clouds stay
        as they are: of them walls are matched."""
        if not scan.is_planar:
            return scan
        self._points += len(scan.points)
        if curvature < _PLANE:
            return scan
        mount, rise = self._mounts.get(scan.frame_id, Mount()), 0.5 * _SIGMAS * curvature
        x, y, z = (scan.points @ mount.rotation.T + (mount.x, mount.y, mount.z)).T
        above = replace(scan.select(z > rise * (x * x + y * y)), beside=tuple(self.leave_out(other, curvature) for other in scan.beside))
        self._left_out += len(scan.points) - len(above.points)
        self._nearest_m, self._frame = min(self._nearest_m, math.sqrt(max(mount.z, 0.0) / rise)), scan.frame_id
        return above

    def warnings(self) -> list[Message]:
        """Sentences where scans, or many points, were left out."""
        found = [message("ground_hits.held", count=self.held)] if self.held else []
        if self._left_out <= _REPORTED_SHARE * self._points:
            return found
        percent = 100.0 * self._left_out / self._points
        return [*found, message("ground_hits.left_out", frame=self._frame, nearest_m=self._nearest_m, percent=percent)]
