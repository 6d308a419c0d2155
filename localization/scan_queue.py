"""Scans that wait for their step, in the order in which they were measured, and what is wrong with some of them."""

from __future__ import annotations

import bisect
import operator
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from localization.events import Scan
from localization.lidar.frames import LidarFrames
from motion_models.robot import Mount


@dataclass
class FaultyScans:
    """Numbers of scans with missing points or times, or that came too late."""

    empty: int = 0
    """Scans without a usable point."""
    late: int = 0
    """Scans that came after later ones."""
    timeless: int = 0
    """Scans without the times of their points."""
    has_turned: bool = False
    """The robot turned in a step with one of these."""

    def warnings(self) -> list[str]:
        """A sentence each."""
        found = []
        if self.empty:
            scans = f"{self.empty} scan{'s' * (self.empty > 1)}"
            found.append(f"{scans} without a usable point: the pose is by wheels and gyro there.")
        if self.late:
            found.append(f"{self.late} scan{'s' * (self.late > 1)} came after later ones and could not be used.")
        if self.has_turned:
            found.append(
                f"{self.timeless} scan{'s' * (self.timeless > 1)} without the times of their points, taken as measured at one "
                "instant: if the scanner sweeps, turns distort them. Let its driver publish the times (time_increment of a scan, a "
                "field of a cloud)."
            )
        return found


class ScanQueue:
    """`insert` scans as they come, and take them from the left of `waiting`."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self.frames = LidarFrames(mounts)
        """Frames of the scans, with their mounts."""
        self.faulty = FaultyScans()
        self.waiting: deque[tuple[int, Scan]] = deque()
        """Scans of known frames, each with the middle of its sweep [ns], in the order of these."""

    def insert(self, scan: Scan, used_until_ns: int | None) -> None:
        """Let ``scan`` wait. One that was overtaken goes where it belongs, if that is after ``used_until_ns``, the end of the last step:
        going back would count the motion since then twice."""
        if not self.frames.admit(scan):
            return
        self.faulty.empty += not len(scan.points)
        middle_ns = scan.middle_ns
        if used_until_ns is not None and middle_ns < used_until_ns:
            self.faulty.late += 1
            return
        self.waiting.insert(bisect.bisect_right(self.waiting, middle_ns, key=operator.itemgetter(0)), (middle_ns, scan))
