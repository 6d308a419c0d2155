"""The keyframes of a drive in a saved map: a map of their own, and what they have found changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from localization.maps import KeyframeMap
from localization.maps.changes import Changes, find_changes
from localization.maps.keyframe_map import MappedKeyframe, make_map
from localization.maps.place_search import PlaceMap
from localization.messages import Message, message, phrase

_LISTED_CHANGES = 5
_LEAST_CHANGED = 0.05
"""Share of the walls that are changed, from which on it is a note: halves of fr079 and MIT-CSAIL differ by 0.005 to 0.03, by doors."""


class RecordedDrive:
    """`add` keyframe after keyframe, and `compare` all of them with the map at the end."""

    def __init__(self) -> None:
        self._keys: list[MappedKeyframe] = []
        self._changes: Changes | None = None

    def add(self, key: MappedKeyframe) -> None:
        """Keep ``key``."""
        self._keys.append(key)

    def keyframe_map(self) -> KeyframeMap | None:
        """The keyframes as a map in the frame of the saved one; None without such."""
        return make_map(self._keys) if self._keys else None

    def compare(self, places: PlaceMap) -> None:
        """Find what has changed since the map ``places`` was built."""
        found = self.keyframe_map()
        if found is not None and len(found.points):
            self._changes = find_changes(places, found)

    def as_json(self) -> Mapping[str, Any]:
        """The changes as JSON holds them; nothing before `compare`."""
        changes = self._changes
        if changes is None:
            return {}
        return {"changed_share": changes.changed_share, "changes": [asdict(change) for change in changes.places]}

    def warnings(self) -> list[Message]:
        """A sentence on the places where the map no longer fits, where they are more than scattered cells."""
        changes = self._changes
        if changes is None or changes.changed_share < _LEAST_CHANGED:
            return []
        named = [phrase("saved_map.place", kind=c.kind, x=c.x, y=c.y, size_m=c.size_m) for c in changes.places[:_LISTED_CHANGES]]
        rest, count = len(changes.places) - len(named), len(changes.places)
        listed = "; ".join(named) + (phrase("saved_map.more", count=rest) if rest else "")
        return [message("saved_map.changed", count=count, percent=100.0 * changes.changed_share, places=listed)]
