"""Which variables a step does not excite: they are considered in its updates, not estimated."""

from __future__ import annotations

import math
from collections.abc import Collection

from localization.core.state import State
from motion_models.motion import Motion
from motion_models.se2 import Cov3


class Excitation:
    """`start_step` with the wheels' motion, `start_scan` with each scan; `considered` for every update.

    Errors of the submap and of the last keyframe are never estimated: the submap stays where it is drawn, and motions from keyframe to
    keyframe add up to the filter's own trajectory. Motion that is nearly straight does not excite the corrections of the motion model. The
    wheels' radius is not excited while scans leave the way open, as along a bare corridor, where noise of normals would be taken for a
    measurement of it.
    """

    def __init__(self, track_m: float, min_track_over_radius: float, never: Collection[str] = ()) -> None:
        """``min_track_over_radius``: track over turning radius from which a motion excites the corrections; ``never``: variables besides
        submap and keyframe that are not estimated."""
        self._never = never
        self._track_m, self._min_track_over_radius = track_m, min_track_over_radius
        self.is_turning = True
        """Whether the motion of the step excites the corrections."""
        self._is_way_open = False

    def start_step(self, motion: Motion) -> None:
        """The wheels predict ``motion``."""
        d = motion.delta
        self.is_turning = bool(abs(d[2]) * self._track_m >= self._min_track_over_radius * math.hypot(d[0], d[1]))

    def considered_by_scan(self, state: State, R: Cov3) -> set[str]:
        """Names of the variables that have no gain by a scan with covariance ``R`` (3, 3). The way is open where the scan determines it
        less than ``state``, until the next scan."""
        P, pose, submap = state.P, state.layout.rows["pose"].start, state.layout.rows["map"].start
        self._is_way_open = bool(R[0, 0] > P[pose, pose] + P[submap, submap] - 2.0 * P[pose, submap])
        return self.considered()

    def considered(self) -> set[str]:
        """Names of the variables that have no gain."""
        names = {"map", "key", *self._never}
        if not self.is_turning:
            names.add("corrections")
        if self._is_way_open:
            names.add("radius")
        return names
