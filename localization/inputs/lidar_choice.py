"""Which of several LiDARs gives the steps, as of a front and a rear scanner: one until it is silent, then one that sends; the scans of the
others that belong to each of its scans; and the health of each.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

from localization.events import Scan
from localization.messages import Message, message, phrase

_SILENT = 5.0
"""Periods without a scan, from where on a LiDAR is silent."""
_FIRST_PERIOD_S = 0.2
"""Period of a LiDAR that has sent one scan [s]: those of robots turn at 5 Hz and more."""
_NEWEST = 0.1
"""Weight of the newest period in the mean."""
_REPORTED_SHARE = 0.05
"""Share of the time without one of the LiDARs that is reported."""
_MAX_AGE = 1.5
"""Periods of a LiDAR, before which its last scan is too old for a sweep of several: one is lost."""
_KEPT_SCANS = 4
"""Last scans of a LiDAR that may belong to one of another that comes late."""


@dataclass(eq=False)
class LidarHealth:
    """One of several LiDARs."""

    first_ns: int
    last_ns: int
    """Stamps of its first and of its last scan."""
    period_s: float = _FIRST_PERIOD_S
    scans: int = 1
    silent_s: float = 0.0
    """Time without its scans, so far [s]."""
    newest: deque[Scan] = field(default_factory=lambda: deque(maxlen=_KEPT_SCANS))
    """Its last scans, while another LiDAR gives the steps."""

    def add(self, stamp_ns: int) -> None:
        """Its next scan."""
        gap_s = (stamp_ns - self.last_ns) * 1e-9
        if self.scans > 1 and self.is_silent(stamp_ns):
            self.silent_s += gap_s
        elif gap_s > 0.0:
            self.period_s += (1.0 if self.scans == 1 else _NEWEST) * (gap_s - self.period_s)
        self.last_ns = max(self.last_ns, stamp_ns)
        self.scans += 1

    def is_silent(self, now_ns: int) -> bool:
        """Whether its next scan is overdue at ``now_ns``."""
        return (now_ns - self.last_ns) * 1e-9 > _SILENT * self.period_s

    def before(self, end_ns: int) -> Scan | None:
        """Its last scan that was complete by ``end_ns``; None where one is missing."""
        scan = next((scan for scan in reversed(self.newest) if _end_ns(scan) <= end_ns), None)
        return None if scan is None or (end_ns - _end_ns(scan)) * 1e-9 > _MAX_AGE * self.period_s else scan


def _end_ns(scan: Scan) -> int:
    return scan.stamp_ns + round(2e9 * scan.middle_s)


class LidarChoice:
    """`admit` each scan."""

    def __init__(self) -> None:
        self.used = ""
        """Frame of the LiDAR in use."""
        self.lidars: dict[str, LidarHealth] = {}
        """By frame; empty while there is one."""
        self._newest_ns = 0
        self._changes = 0

    def admit(self, scan: Scan) -> Scan | None:
        """``scan`` with those of the other LiDARs beside it; None where it is not of the LiDAR in use."""
        frame, stamp_ns = scan.frame_id, scan.stamp_ns
        self.used = self.used or frame
        if not self.lidars:
            if frame == self.used:
                return scan
            self.lidars[self.used] = LidarHealth(stamp_ns, stamp_ns)
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if frame not in self.lidars:
            self.lidars[frame] = LidarHealth(stamp_ns, stamp_ns)
        else:
            self.lidars[frame].add(stamp_ns)
        if self.lidars[self.used].is_silent(stamp_ns):
            self.used, self._changes = frame, self._changes + 1
        if frame == self.used:
            return self._with_others(scan)
        self.lidars[frame].newest.append(scan)
        return None

    def _with_others(self, scan: Scan) -> Scan:
        others = [lidar.before(_end_ns(scan)) for frame, lidar in self.lidars.items() if frame != scan.frame_id]
        return replace(scan, beside=tuple(other for other in others if other is not None and other.is_planar)) if scan.is_planar else scan

    def silent(self) -> dict[str, float]:
        """LiDARs that send no scans while another does: for how long, by frame [s]."""
        now_ns = self._newest_ns
        return {frame: (now_ns - one.last_ns) * 1e-9 for frame, one in self.lidars.items() if one.is_silent(now_ns)}

    def warnings(self) -> list[Message]:
        """A sentence for each of several that was missing for long."""
        found, silent = [], self.silent()
        for frame, lidar in self.lidars.items():
            missing_s, lasted_s = lidar.silent_s + silent.get(frame, 0.0), (self._newest_ns - lidar.first_ns) * 1e-9
            if missing_s > _REPORTED_SHARE * lasted_s:
                changed = phrase("silent_lidar.changed", count=self._changes) if self._changes > 1 else ""
                changed = phrase("silent_lidar.changed_once") if self._changes == 1 else changed
                found.append(message("silent_lidar.silent", frame=frame, missing_s=missing_s, lasted_s=lasted_s, changed=changed))
        return found
