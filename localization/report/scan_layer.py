"""Scans as a layer of a map: few of them, few points of each, in the robot's body frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from localization.events import Event, Scan
from localization.lidar.deskew import Sweep
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_MOST_SCANS, _MOST_POINTS = 150, 60
"""Scans of a replay, and points of each: 60 show walls, and all scans together are 150 kB of a page."""


def thin_scan(scan: Scan, mounts: Mapping[str, Mount], most: int) -> FloatArray:
    """(M, 2) points of ``scan`` in the body frame [m], M at most ``most``; of a cloud the upright structure. Motion during the scan is
    left in: at 1 m/s some centimetres."""
    sweep = Sweep.from_scan(scan, mounts.get(scan.frame_id, Mount()))
    points = sweep.project(sweep.points)
    return points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.int64)]


class ScanLayer:
    """Scans at equal times over a drive, kept while its events pass through `watch`."""

    def __init__(self, duration_s: float, mounts: Mapping[str, Mount]) -> None:
        self._period_ns, self._mounts = int(duration_s * 1e9 / _MOST_SCANS), mounts
        self.scans: list[tuple[int, FloatArray]] = []
        """Stamp [ns] of the middle of each scan, and its points (M, 2) in the body frame [m]."""

    def watch(self, events: Iterable[Event]) -> Iterator[Event]:
        """Pass the events on, and keep the scans among them."""
        next_ns = -(1 << 62)
        for event in events:
            if isinstance(event, Scan) and event.stamp_ns >= next_ns:
                next_ns = event.stamp_ns + self._period_ns
                self.scans.append((event.middle_ns, thin_scan(event, self._mounts, _MOST_POINTS)))
            yield event
