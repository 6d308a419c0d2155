"""Frames of LiDARs: whose scans are used, and what is reported of those without a mount."""

from __future__ import annotations

from collections.abc import Mapping

from localization.events import Scan
from motion_models.robot import Mount

_UNKNOWN = "no transform or robot file gives the mount of the LiDAR's frame '{}'"
_LATE = "/tf_static gave the mount of the LiDAR's frame '{}' late"
_MEND = " Publish it on /tf_static, or add [mounts.{}] to the robot file."
_CENTRED = "{} taken as if from the body's origin, and positions are off by about as much as it is away from there."
_UNUSED = "{} not used, because the mounts of other frames are given."


class LidarFrames:
    """`admit` every scan. ``mounts`` (by frame) may grow meanwhile: a frame is known from then on."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._has_known = False
        self._newest: str | None = None
        self._centred: dict[str, int] = {}
        self._unused: dict[str, int] = {}

    def admit(self, scan: Scan) -> bool:
        """Whether ``scan`` is to be used. Of an unknown frame it is only where no scan of a known one has come: a robot without any
        transforms may carry its LiDAR in the middle, but not one LiDAR in two places."""
        self._newest = frame = scan.frame_id
        if frame in self._mounts:
            self._has_known = True
            return True
        counts = self._unused if self._has_known else self._centred
        counts[frame] = counts.get(frame, 0) + 1
        return not self._has_known

    @property
    def problem(self) -> str | None:
        """Message on the frame of the newest scan and the remedy; None where its mount is known."""
        frame = self._newest
        if frame is None or frame in self._mounts:
            return None
        what = "are not used" if self._has_known else "are taken as if from the body's origin"
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
