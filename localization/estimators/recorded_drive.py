"""The keyframes of a drive in a saved map: a map of their own, and what they have found changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from localization.maps import KeyframeMap
from localization.maps.changes import Changes, find_changes
from localization.maps.place_search import PlaceMap
from motion_models.se2 import FloatArray, Points2, Pose2

_LISTED_CHANGES = 5
_LEAST_CHANGED = 0.05
"""Share of the walls that are changed, from which on it is a note: halves of fr079 and MIT-CSAIL differ by 0.005 to 0.03, by doors."""


@dataclass(frozen=True, eq=False)
class DriveKeyframe:
    """A keyframe that was localized in the map."""

    stamp_ns: int
    points: Points2
    """(N, 2) of its scan in the body frame [m]."""
    lidar: FloatArray
    """(2,) where the LiDAR is in the body frame [m]."""
    pose: Pose2
    """(3,) ``map_T_body``."""


class RecordedDrive:
    """`add` keyframe after keyframe, and `compare` all of them with the map at the end."""

    def __init__(self) -> None:
        self._keys: list[DriveKeyframe] = []
        self._changes: Changes | None = None

    def add(self, key: DriveKeyframe) -> None:
        """Keep ``key``."""
        self._keys.append(key)

    def keyframe_map(self) -> KeyframeMap | None:
        """The keyframes as a map in the frame of the saved one; None without such."""
        if not self._keys:
            return None
        n = len(self._keys)
        return KeyframeMap(
            stamps_ns=np.array([key.stamp_ns for key in self._keys], dtype=np.int64),
            poses=np.array([key.pose for key in self._keys]),
            covariances=np.zeros((n, 3, 3)),
            points=np.vstack([key.points for key in self._keys]).astype(np.float32),
            counts=np.array([len(key.points) for key in self._keys], dtype=np.int64),
            sensors=np.array([key.lidar for key in self._keys]),
            edges=np.empty((0, 2), np.int64),
            edge_deltas=np.empty((0, 3)),
            edge_information=np.empty((0, 3, 3)),
            edge_is_loop=np.empty(0, dtype=bool),
        )

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

    def warnings(self) -> list[str]:
        """A sentence on the places where the map no longer fits, where they are more than scattered cells."""
        changes = self._changes
        if changes is None or changes.changed_share < _LEAST_CHANGED:
            return []
        named = [f"{c.kind} at x {c.x:.1f} m, y {c.y:.1f} m ({c.size_m:.1f} m)" for c in changes.places[:_LISTED_CHANGES]]
        rest = len(changes.places) - len(named)
        more = f", and {rest} more" if rest else ""
        return [
            f"the map no longer fits at {len(changes.places)} places, {100 * changes.changed_share:.0f} % of the walls that were measured: "
            f"{'; '.join(named)}{more}. --extend-map writes a map with them."
        ]
