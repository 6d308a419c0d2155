"""How long the LiDAR was lost: scans that could not be matched, and times without any."""

from __future__ import annotations

from collections import deque

MIN_LOST_S = 1.0
"""Time without a scan that counts as lost, and from where on a stretch without a matched one is a loss [s]: scanners give 5 to 40 scans a
second, and in this time wheels alone err by the few centimetres of a voxel."""
_MAX_SCAN_GAP_PERIODS = 4.0
"""Time without a scan that counts as lost in logs with few scans, in median times from scan to scan."""
_GAPS = 51
"""Last gaps between scans of which the median is taken: silences among them do not count."""


class LostScans:
    """Counts scans that could not be used, by cause, and the time without a matched scan: also where none come at all."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._matched_ns = self._scan_ns = self._last_ns = 0  # last match, last scan, end of the counted time
        self.scans = 0
        """All scans so far."""
        self.causes: dict[str, int] = {}
        """Scans that were not matched: `lost` (they fit nowhere, or in several places), `sparse`, `stale`, `excluded` (left out by a sensor
        check)."""
        self.silences = 0
        """Gaps between scans that count as lost."""
        self._gaps_ns: deque[int] = deque(maxlen=_GAPS)
        self._lost_ns = 0
        self._longest: tuple[int, int] = (0, 0)  # length and start [ns]

    def add(self, stamp_ns: int, cause: str = "") -> None:
        """A scan, and why it was not matched; "" where it was."""
        if self._first_ns is None:
            self._first_ns = self._matched_ns = self._last_ns = stamp_ns
        else:
            self.add_no_scan(stamp_ns)
            self._gaps_ns.append(stamp_ns - self._scan_ns)
        self.scans += 1
        self._scan_ns = stamp_ns
        if cause:
            self.causes[cause] = self.causes.get(cause, 0) + 1
        else:
            if self._last_ns > self._matched_ns:
                self._close(stamp_ns)
            self._matched_ns = stamp_ns
        self._last_ns = stamp_ns

    def add_no_scan(self, stamp_ns: int) -> None:
        """The time has come to ``stamp_ns`` without a scan. It is lost once no scan has come for `MIN_LOST_S`, or for much longer
        than they are apart."""
        if self._first_ns is None:
            return
        gap_ns = stamp_ns - self._scan_ns
        if gap_ns <= MIN_LOST_S * 1e9 or gap_ns <= _MAX_SCAN_GAP_PERIODS * self._period_ns:
            return
        self.silences += self._last_ns <= self._scan_ns  # else it lasts
        self._last_ns = max(stamp_ns, self._last_ns)

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

    @property
    def _period_ns(self) -> int:
        """Median time from scan to scan; 0 before the second."""
        return sorted(self._gaps_ns)[(len(self._gaps_ns) - 1) // 2] if self._gaps_ns else 0

    def _close(self, stamp_ns: int) -> None:
        """A match ends a loss. The time up to it counts but for one period, which is there between any two matches."""
        length = stamp_ns - self._matched_ns
        length -= self._period_ns if self._period_ns < length else 0
        self._lost_ns += length
        self._longest = max(self._longest, (length, self._matched_ns))
