"""Measured positions that wait for the step at which the robot was there, in the frame of the saved map."""

from __future__ import annotations

from localization.events import PositionSample
from localization.logs.reference_topics import in_plane
from localization.maps.position_plane import PositionFix, PositionPlane


class MapPositions:
    """`add` positions in the order of their stamps, and `take` the last one that is due."""

    def __init__(self) -> None:
        self._waiting: list[PositionSample] = []
        self._n_unused = 0

    def add(self, sample: PositionSample) -> None:
        """A position of the plane in which the map's drive fused its own, as by GNSS."""
        self._waiting.append(sample)

    def take(self, until_ns: int, plane: PositionPlane | None) -> PositionFix | None:
        """The last position up to ``until_ns``, in the map at ``plane``; None without one, or where the map has no ``plane``."""
        due = [sample for sample in self._waiting if sample.stamp_ns <= until_ns]
        self._waiting = self._waiting[len(due) :]
        position = None if plane is None or not due else in_plane(due[-1], plane.origin)
        if plane is None or position is None:
            self._n_unused += len(due)
            return None
        return plane.to_map(position, due[-1].covariance)

    def warnings(self) -> list[str]:
        """A sentence on positions that could not be used."""
        if not self._n_unused:
            return []
        unused = f"{self._n_unused} positions could not be used: the map was built without such ones"
        return [f"{unused}. Build it with --positions, or leave them out."]
