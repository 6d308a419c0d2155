"""How long the LiDAR was lost in a run, in words and numbers for reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from localization.lidar.lost_scans import MIN_LOST_S, LostScans
from localization.messages import Message, Value, message, phrase

MAX_LOST_SHARE = 0.05
"""Share of the time without a matched scan, beyond which a run is not recommended: wheels alone err by 0.7 to 0.9 m in 10 m (fr079,
MIT-CSAIL), matched scans by 0.05 to 0.09 m, so that from a twentieth of the way on the wheels' share is the larger one."""
MAX_LOST_S = 5.0
"""Longest stretch without a matched scan [s], beyond which a run is not recommended, whatever the share: at 0.4 m/s those wheels err by
0.15 m in it, from where on Gauss-Newton alone may end in a wrong place."""

_CAUSES: Mapping[str, tuple[str, str]] = {
    "lost": ("lidar_losses.lost", "lidar_losses.lost_advice"),
    "sparse": ("lidar_losses.sparse", "lidar_losses.sparse_advice"),
    "stale": ("lidar_losses.stale", "lidar_losses.stale_advice"),
    "moved": ("lidar_losses.moved", "lidar_losses.moved_advice"),
    "excluded": ("lidar_losses.excluded", "lidar_losses.excluded_advice"),
}
"""What happened and what to do, by cause, as `phrase` has them."""
_BRIDGED = {"lost", "sparse", "excluded"}
"""Causes that single scans of a healthy LiDAR have."""


@dataclass(frozen=True)
class LidarLosses:
    """Scans of a run that were not matched, and the time without a match."""

    scans: int
    """All of them."""
    matched: int
    share: float
    """Share of the time without a matched scan, from the first scan to the last, 0 to 1; each loss is shorter by one period of the
    scans."""
    longest_s: float
    """The longest time without a match [s]."""
    since_s: float
    """When that began, after the first scan [s]."""
    ongoing_s: float
    """Time since the last match, up to the last scan [s]."""
    causes: Mapping[str, int]
    """Scans that were not matched, by cause: lost, sparse, stale, moved, excluded."""
    silences: int = 0
    """Times in which no scan came for a second or more."""

    @classmethod
    def of(cls, lost: LostScans) -> LidarLosses:
        """Up to now."""
        causes = {name: n for name, n in lost.causes.items() if n}
        return cls(lost.scans, lost.scans - sum(causes.values()), lost.share, *lost.longest, lost.ongoing_s, causes, lost.silences)

    @property
    def is_long(self) -> bool:
        """Whether so much is missing that the run is not to be recommended without a measured error."""
        return is_long(self.share, self.longest_s)

    @property
    def is_event(self) -> bool:
        """Whether something happened to LiDAR or robot, or much is missing. Single scans that fit nowhere, have few points, or
        were left out by a check, which has a sentence of its own, are bridged by the other sensors."""
        is_much = self.share > MAX_LOST_SHARE or self.longest_s > MAX_LOST_S
        return is_much or bool(self.silences) or not set(self.causes) <= _BRIDGED

    @property
    def summary(self) -> str:
        """Which part of the drive is without LiDAR, and where most of it."""
        share, longest = per_cent(self.share), _seconds(self.longest_s)
        return phrase("lidar_losses.summary", share=share, longest=longest, since_s=self.since_s)

    @property
    def advice(self) -> str:
        """What to do against missing scans, else against the most frequent cause; "" where nothing was lost."""
        if self.silences:
            return phrase("lidar_losses.silence_advice")
        if not self.causes:
            return ""
        counts = dict(self.causes)
        if "moved" in counts:  # the scans after that are lost
            counts["moved"] += counts.pop("lost", 0)
        return phrase(_CAUSES[max(counts, key=counts.__getitem__)][1])

    def warnings(self) -> list[Message]:
        """What happened, where, why, and what to do; nothing where every scan came and was matched."""
        found = []
        if self.causes:
            parts = ", ".join(f"{n} {phrase(_CAUSES[name][0])}" for name, n in self.causes.items())
            found.append(phrase("lidar_losses.of_which", count=sum(self.causes.values()), scans=self.scans, parts=parts))
        if self.silences > 1:
            found.append(phrase("lidar_losses.silences", count=self.silences))
        elif self.silences:
            found.append(phrase("lidar_losses.silence"))
        if not found:
            return []
        numbers: dict[str, Value] = {"share": per_cent(self.share), "longest": _seconds(self.longest_s), "since_s": self.since_s}
        return [message("lidar_losses.of_scans", causes="; ".join(found), advice=self.advice, **numbers)]

    def numbers(self) -> dict[str, Any]:
        """Numbers of the losses, as `metrics.json` has them."""
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
    """Whether a run that lost the LiDAR for this ``share`` of the time, and ``longest_s`` [s] at once, is not to be recommended without a
    measured error."""
    is_stretch = longest_s is None or longest_s > MIN_LOST_S
    return (share is not None and share > MAX_LOST_SHARE and is_stretch) or (longest_s is not None and longest_s > MAX_LOST_S)


def per_cent(share: float) -> str:
    """Two digits, without a power of ten."""
    value = 100.0 * share
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %" if value >= 0.01 or not value else "less than 0.01 %"
