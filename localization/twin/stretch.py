"""The end of a whole stretch of a drive: motions of windows that follow each other, one after another, in the simulator and as measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from localization.twin.engine import Played
from localization.twin.windows import Window, motion_of_point
from motion_models import se2
from motion_models.se2 import FloatArray

_GAP_S = 0.3
"""Time between two windows beyond which the drive has a gap: scans end a window up to this late."""
_MOST, _FEWEST = 40, 5
"""Most windows that are played [80 s], and fewest that make a stretch."""


@dataclass(frozen=True)
class Stretch:
    """Where a stretch ends in one simulator."""

    name: str
    duration_s: float
    way_m: float
    position_error_m: float
    heading_error_rad: float

    def describe(self) -> str:
        """One sentence.

        >>> Stretch("file", 60.0, 31.0, 4.2, 1.1).describe()
        'file: after 60 s and 31.0 m it is 4.20 m and 63 deg off'
        """
        ends = f"{self.position_error_m:.2f} m and {math.degrees(self.heading_error_rad):.0f} deg off"
        return f"{self.name}: after {self.duration_s:.0f} s and {self.way_m:.1f} m it is {ends}"


def longest_stretch(windows: Sequence[Window]) -> list[Window]:
    """The windows of the longest stretch without a gap in which all positions were measured, at most `_MOST`; empty for less than five."""
    runs: list[list[Window]] = [[]]
    for w in windows:
        if not math.isfinite(w.cov[0, 0]):
            runs.append([])
            continue
        if runs[-1] and abs(w.start_s - runs[-1][-1].start_s - runs[-1][-1].duration_s) > _GAP_S:
            runs.append([])
        runs[-1].append(w)
    best = max(runs, key=len)[:_MOST]
    return best if len(best) >= _FEWEST else []


def end_of(name: str, windows: Sequence[Window], played: Played, frame: FloatArray) -> Stretch:
    """Where ``windows``, as ``played``, end; ``frame`` (2,) is the point of the body that was measured [m]."""
    moved = motion_of_point(played.poses, frame)
    measured = np.array([w.measured for w in windows])
    off = se2.between(reduce(se2.compose, measured), reduce(se2.compose, moved))
    way = float(np.hypot(*measured[:, :2].T).sum())
    return Stretch(name, sum(w.duration_s for w in windows), way, float(np.hypot(off[0], off[1])), abs(float(off[2])))
