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
from localization.messages import Message, message, phrase
from motion_models.robot import Mount


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
    def problem(self) -> Message | None:
        """Message on the frame of the newest scan and the remedy; None where its mount is known."""
        frame = self._newest
        if frame is None or frame in self._mounts:
            return None
        if self._has_known or frame not in self._centred:
            return message("lidar_frames.now_unused", frame=frame)
        return message("lidar_frames.now_centred", frame=frame)

    def warnings(self) -> list[Message]:
        """How many scans of which frames that concerned, and what a person should do about it, in sentences."""
        late = self._mounts
        found = [_centred(frame, _were(n), is_late=frame in late) for frame, n in self._centred.items()]
        return [*found, *(_unused(frame, _were(n), is_late=frame in late) for frame, n in self._unused.items())]


def _centred(frame: str, scans: str, *, is_late: bool) -> Message:
    if is_late:
        return message("lidar_frames.late_centred", frame=frame, scans=scans)
    return message("lidar_frames.centred", frame=frame, scans=scans)


def _unused(frame: str, scans: str, *, is_late: bool) -> Message:
    if is_late:
        return message("lidar_frames.late_unused", frame=frame, scans=scans)
    return message("lidar_frames.unused", frame=frame, scans=scans)


def _were(count: int) -> str:
    return phrase("lidar_frames.many", count=count) if count > 1 else phrase("lidar_frames.one")


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

    def warnings(self) -> list[Message]:
        """A sentence each."""
        found = []
        if self.empty:
            found.append(message("scans.empty", scans=_scans(self.empty)))
        if self.late:
            found.append(message("scans.late", scans=_scans(self.late)))
        if self.has_turned:
            found.append(message("scans.without_times", scans=_scans(self.timeless)))
        return found


def _scans(count: int) -> str:
    return phrase("scans.many", count=count) if count > 1 else phrase("scans.one")


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
