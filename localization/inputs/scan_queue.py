"""Scans that wait for their step, in the order in which they were measured; which of them are used, and what is wrong with some."""

from __future__ import annotations

import bisect
import operator
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from localization.events import Scan
from localization.inputs.lidar_choice import LidarChoice
from localization.lidar.ground_hits import GroundHits
from motion_models.robot import Mount

_UNKNOWN = "no transform or robot file gives the mount of the LiDAR's frame '{}'"
_LATE = "/tf_static gave the mount of the LiDAR's frame '{}' late"
_MEND = " Publish it on /tf_static, or add [mounts.{}] to the robot file."
_CENTRED = "{} taken as if from the body's origin, and positions are off by about as much as it is away from there."
_UNUSED = "{} not used, because scans of another frame are."


class LidarFrames:
    """`admit` every scan. ``mounts`` (by frame) may grow meanwhile: a frame is known from then on."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._has_known = False
        self._newest: str | None = None
        self._centred: dict[str, int] = {}
        self._unused: dict[str, int] = {}

    def admit(self, scan: Scan) -> bool:
        """Whether ``scan`` is to be used. Of an unknown frame it is only where no scan of another one has come: a robot without any
        transforms may carry its LiDAR in the middle, but not two LiDARs."""
        self._newest = frame = scan.frame_id
        if frame in self._mounts:
            self._has_known = True
            return True
        is_used = not self._has_known and (not self._centred or frame in self._centred)
        counts = self._centred if is_used else self._unused
        counts[frame] = counts.get(frame, 0) + 1
        return is_used

    @property
    def problem(self) -> str | None:
        """Message on the frame of the newest scan and the remedy; None where its mount is known."""
        frame = self._newest
        if frame is None or frame in self._mounts:
            return None
        what = "are not used" if self._has_known or frame not in self._centred else "are taken as if from the body's origin"
        return f"{_UNKNOWN.format(frame)}: its scans {what}.{_MEND.format(frame)}"

    def warnings(self) -> list[str]:
        """How many scans of which frames that concerned, and what a person should do about it, in sentences."""
        found = []
        for counts, outcome in ((self._centred, _CENTRED), (self._unused, _UNUSED)):
            for frame, n in counts.items():
                why, mend = (_LATE, "") if frame in self._mounts else (_UNKNOWN, _MEND)
                what = outcome.format(f"{n} scans of it were" if n > 1 else "1 scan of it was")
                found.append(f"{why.format(frame)}: {what}{mend.format(frame)}")
        return found


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
            found.append(f"{scans} without a usable point: the pose is by the other sensors there.")
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
        self.ground = GroundHits(mounts)
        """Points on hills that may be hits of the ground."""
        self.choice = LidarChoice()
        """Choice among several LiDARs."""
        self.waiting: deque[tuple[int, Scan]] = deque()
        """Scans of known frames, each with the middle of its sweep [ns], in the order of these."""

    def insert(self, scan: Scan, used_until_ns: int | None) -> None:
        """Let ``scan`` wait. One that was overtaken goes where it belongs, if that is after ``used_until_ns``, the end of the last step:
        going back would count the motion since then twice."""
        if not self.frames.admit(scan):
            return
        if (scan.frame_id != self.choice.used or self.choice.lidars) and self.frames.problem is None:
            if (admitted := self.choice.admit(scan)) is None:
                return
            scan = admitted
        self.faulty.empty += not len(scan.points)
        middle_ns = scan.middle_ns
        if used_until_ns is not None and middle_ns < used_until_ns:
            self.faulty.late += 1
            return
        self.waiting.insert(bisect.bisect_right(self.waiting, middle_ns, key=operator.itemgetter(0)), (middle_ns, scan))
