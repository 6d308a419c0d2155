"""Which of several LiDARs is used, as of a front and a rear scanner: one until it is silent, then one that sends; and the health of each.

Scans of two scanners in one estimate take mounts that agree to a tenth of a degree. With one degree between them, on a simulated lap, one
submap of both gave an ATE of .078 m (.008 m by the turned scanner alone), and a submap for each false verdicts on wheels and gyro.
"""

from __future__ import annotations

from dataclasses import dataclass

from localization.events import Scan

_SILENT = 5.0
"""Periods without a scan, from where on a LiDAR is silent."""
_FIRST_PERIOD_S = 0.2
"""Period of a LiDAR that has sent one scan [s]: those of robots turn at 5 Hz and more."""
_NEWEST = 0.1
"""Weight of the newest period in the mean."""
_REPORTED_SHARE = 0.05
"""Share of the time without one of the LiDARs that is reported."""


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


class LidarChoice:
    """`admit` each scan."""

    def __init__(self) -> None:
        self.used = ""
        """Frame of the LiDAR in use."""
        self.lidars: dict[str, LidarHealth] = {}
        """By frame; empty while there is one."""
        self._newest_ns = 0
        self._changes = 0

    def admit(self, scan: Scan) -> bool:
        """Whether ``scan`` is of the LiDAR in use."""
        frame, stamp_ns = scan.frame_id, scan.stamp_ns
        self.used = self.used or frame
        if not self.lidars:
            if frame == self.used:
                return True
            self.lidars[self.used] = LidarHealth(stamp_ns, stamp_ns)
        self._newest_ns = max(self._newest_ns, stamp_ns)
        if frame in self.lidars:
            self.lidars[frame].add(stamp_ns)
        else:
            self.lidars[frame] = LidarHealth(stamp_ns, stamp_ns)
        if self.lidars[self.used].is_silent(stamp_ns):
            self.used, self._changes = frame, self._changes + 1
        return frame == self.used

    def silent(self) -> dict[str, float]:
        """LiDARs that send no scans while another does: for how long, by frame [s]."""
        now_ns = self._newest_ns
        return {frame: (now_ns - one.last_ns) * 1e-9 for frame, one in self.lidars.items() if one.is_silent(now_ns)}

    def warnings(self) -> list[str]:
        """A sentence for each of several that was missing for long."""
        found, silent = [], self.silent()
        for frame, lidar in self.lidars.items():
            missing_s, lasted_s = lidar.silent_s + silent.get(frame, 0.0), (self._newest_ns - lidar.first_ns) * 1e-9
            if missing_s > _REPORTED_SHARE * lasted_s:
                changed = f" The LiDAR in use was changed {self._changes} time{'s' * (self._changes > 1)}." * (self._changes > 0)
                found.append(
                    f"the LiDAR '{frame}' sent no scans for {missing_s:.1f} of {lasted_s:.1f} s. Check its driver and its network.{changed}"
                )
        return found
