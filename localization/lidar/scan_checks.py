"""Scans that cannot be used: of unknown frames, of a frozen scanner, unmatched; how long the LiDAR was lost, and that in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from localization.events import Scan
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_MAX_SCAN_GAP_S = 1.0
"""Time without a scan that counts as lost [s]: scanners give 5 to 40 scans a second, and in this time wheels alone err by the few
centimetres of a voxel."""
_MAX_SCAN_GAP_PERIODS = 4.0
"""The same for logs with few scans, in mean times from scan to scan."""
_UNKNOWN = "no transform or robot file gives the mount of the LiDAR's frame '{}'"
_LATE = "/tf_static gave the mount of the LiDAR's frame '{}' late"
_MEND = " Publish it on /tf_static, or add [mounts.{}] to the robot file."
_CENTRED = "{} taken as if from the body's origin, and positions are off by about as much as it is away from there."
_UNUSED = "{} not used, because the mounts of other frames are given."

MAX_LOST_SHARE = 0.05
"""Share of the time without a matched scan, beyond which a run is not recommended: wheels alone err by 0.7 to 0.9 m in 10 m (fr079,
MIT-CSAIL), matched scans by 0.05 to 0.09 m, so that from a twentieth of the way on the wheels' share is the larger one."""
MAX_LOST_S = 5.0
"""The same for one stretch [s]: at 0.4 m/s those wheels err by 0.15 m in it, from where on Gauss-Newton alone may end in a wrong place."""

_CAUSES: Mapping[str, tuple[str, str]] = {
    "lost": (
        "fitted the map nowhere or in several places",
        "Check the LiDAR's mount, its stamps and the wheels; in open or repetitive places take a longer range (lidar.max_range_m).",
    ),
    "sparse": (
        "had too few points on walls",
        "Check what covers the LiDAR, and lidar.min_range_m and lidar.max_range_m.",
    ),
    "stale": (
        "repeated the ranges of the scan before while the robot drove",
        "Check the LiDAR's driver.",
    ),
}
"""What happened and what to do, by cause."""
_SILENCE_ADVICE = "Check the LiDAR's driver, cable and topic."


class StaleScans:
    """Recognizes a scanner that repeats its last scan."""

    def __init__(self) -> None:
        self._points: FloatArray | None = None
        self._is_frozen = False

    def is_stale(self, scan: Scan, is_standing: bool) -> bool:
        """The very same ranges as last time although the wheels turn: noise alone would have changed them.

        A scanner that froze while the robot drove stays stale until its ranges change, also where the robot stands.
        """
        last, self._points = self._points, scan.points
        is_same = last is not None and len(last) > 0 and np.array_equal(last, scan.points)
        self._is_frozen = is_same and (self._is_frozen or not is_standing)
        return self._is_frozen


class LostScans:
    """Counts scans that could not be used, by cause, and the time without a matched scan: also where none come at all."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._matched_ns = self._scan_ns = self._last_ns = 0  # last match, last scan, end of the counted time
        self.scans = 0
        """All scans so far."""
        self.causes: dict[str, int] = {}
        """Scans that were not matched: `lost` (they fit nowhere, or in several places), `sparse`, `stale`."""
        self.silences = 0
        """Gaps between scans that count as lost."""
        self._is_silent = False
        self._lost_ns = 0
        self._longest: tuple[int, int] = (0, 0)  # length and start [ns]

    def add_matched(self, stamp_ns: int) -> None:
        """A scan that was matched."""
        self._count(stamp_ns)
        if self._last_ns > self._matched_ns:
            self._close(stamp_ns)
        self._matched_ns = self._last_ns = stamp_ns

    def add(self, stamp_ns: int, cause: str) -> None:
        """A scan that was not."""
        self._count(stamp_ns)
        self.causes[cause] = self.causes.get(cause, 0) + 1
        self._last_ns = stamp_ns

    def add_no_scan(self, stamp_ns: int) -> None:
        """The time has come to ``stamp_ns`` without a scan. It is lost once no scan has come for `_MAX_SCAN_GAP_S`, or for much longer
        than they are apart."""
        if self._first_ns is None:
            return
        apart_ns = (self._scan_ns - self._first_ns) / max(self.scans - 1, 1)
        if stamp_ns - self._scan_ns <= max(_MAX_SCAN_GAP_S * 1e9, _MAX_SCAN_GAP_PERIODS * apart_ns):
            return
        self.silences += not self._is_silent
        self._is_silent, self._last_ns = True, max(stamp_ns, self._last_ns)

    @property
    def share(self) -> float:
        """Share of the time, from the first scan to the last or to the end of a silence, 0 to 1."""
        if self._first_ns is None or self._last_ns == self._first_ns:
            return 0.0
        return (self._lost_ns + self._last_ns - self._matched_ns) / (self._last_ns - self._first_ns)

    @property
    def longest(self) -> tuple[float, float]:
        """Length [s] of the longest time without a match, and when it began, after the first scan [s]."""
        if self._first_ns is None:
            return 0.0, 0.0
        length, start = max(self._longest, (self._last_ns - self._matched_ns, self._matched_ns))
        return length * 1e-9, (start - self._first_ns) * 1e-9 if length else 0.0

    @property
    def ongoing_s(self) -> float:
        """Time from the last match to the last scan, or until now where scans have ceased [s]."""
        return (self._last_ns - self._matched_ns) * 1e-9

    def _count(self, stamp_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = self._matched_ns = self._last_ns = stamp_ns
        else:
            self.add_no_scan(stamp_ns)
        self.scans += 1
        self._scan_ns, self._is_silent = stamp_ns, False

    def _close(self, stamp_ns: int) -> None:
        length = stamp_ns - self._matched_ns
        self._lost_ns += length
        self._longest = max(self._longest, (length, self._matched_ns))


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


@dataclass(frozen=True)
class LidarLosses:
    """Scans of a run that were not matched, and the time without a match."""

    scans: int
    """All of them."""
    matched: int
    share: float
    """Of the time from the first scan to the last without a matched scan, 0 to 1."""
    longest_s: float
    """The longest time without a match [s]."""
    since_s: float
    """When that began, after the first scan [s]."""
    ongoing_s: float
    """Time since the last match, up to the last scan [s]."""
    causes: Mapping[str, int]
    """Scans that were not matched, by cause: lost, sparse, stale."""
    silences: int = 0
    """Times in which no scan came for a second or more."""

    @classmethod
    def of(cls, lost: LostScans) -> LidarLosses:
        """Up to now."""
        causes = {name: n for name, n in lost.causes.items() if n}
        return cls(lost.scans, lost.scans - sum(causes.values()), lost.share, *lost.longest, lost.ongoing_s, causes, lost.silences)

    @property
    def is_long(self) -> bool:
        """Whether so much is missing that the run is not to be recommended."""
        return is_long(self.share, self.longest_s)

    @property
    def summary(self) -> str:
        """Which part of the drive is without LiDAR, and where most of it."""
        return f"LiDAR lost for {per_cent(self.share)} of the drive, longest {_seconds(self.longest_s)} at t = {self.since_s:.0f} s"

    @property
    def advice(self) -> str:
        """What to do against missing scans, else against the most frequent cause; "" where nothing was lost."""
        if self.silences:
            return _SILENCE_ADVICE
        return _CAUSES[max(self.causes, key=lambda name: self.causes[name])][1] if self.causes else ""

    def describe(self) -> str:
        """What happened, where, why, and what to do; "" where every scan came and was matched."""
        found = []
        if self.causes:
            parts = ", ".join(f"{n} {_CAUSES[name][0]}" for name, n in self.causes.items())
            found.append(f"{sum(self.causes.values())} of {self.scans} scans: {parts}")
        if self.silences:
            found.append("no scans came for a second or more" + (f", {self.silences} times" if self.silences > 1 else ""))
        return f"{self.summary} ({'; '.join(found)}). Wheels carried on alone. {self.advice}" if found else ""

    def numbers(self) -> dict[str, Any]:
        """As in `metrics.json`."""
        return {
            "scans": self.scans,
            "matched": self.matched,
            "lost_share": self.share,
            "longest_lost_s": self.longest_s,
            "longest_lost_since_s": self.since_s,
            "causes": dict(self.causes),
            "silences": self.silences,
        }


def _seconds(value: float) -> str:
    """Two digits, without a power of ten."""
    return f"{value:.0f} s" if value >= 9.95 else f"{value:.2g} s"


def is_long(share: float | None, longest_s: float | None) -> bool:
    """Whether a run that lost the LiDAR for this ``share`` of the time, and ``longest_s`` [s] at once, is not to be recommended."""
    return (share is not None and share > MAX_LOST_SHARE) or (longest_s is not None and longest_s > MAX_LOST_S)


def per_cent(share: float) -> str:
    """Two digits, without a power of ten."""
    value = 100.0 * share
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %" if value >= 0.01 or not value else "less than 0.01 %"
