"""Odometry with a localizer in a saved map behind it: what maps in the plane and in space share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from localization.errors import MapError
from localization.estimators.filtered_odometry import Filter, FilteredOdometry
from localization.maps.grid import Grid
from localization.maps.localizer import Localizer, State
from localization.maps.space_localizer import SpaceLocalizer
from localization.maps.space_places import Places, SpacePlaces
from localization.messages import Message, message
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2


class LocalizationTimes:
    """`add` step after step, and `add_keyframe` where the state may have changed."""

    def __init__(self) -> None:
        self._seconds: dict[State, float] = {"searching": 0.0, "localized": 0.0, "lost": 0.0}
        self._outside_s = 0.0
        self.first_s: float | None = None
        """When the robot was first localized [s]; None before."""
        self.n_losses = 0
        """How often its place was contradicted."""

    def add(self, duration_s: float, state: State, is_outside: bool) -> None:
        """A step of ``duration_s`` [s] in ``state``; ``is_outside``: the map has nothing where the robot is."""
        if state == "localized" and self.first_s is None:
            self.first_s = self.total_s
        self._seconds[state] += duration_s
        self._outside_s += duration_s if is_outside else 0.0

    def add_keyframe(self, before: State, after: State) -> None:
        """States before and after a keyframe was localized."""
        self.n_losses += before == "localized" and after == "lost"

    @property
    def lost_s(self) -> float:
        """[s]"""
        return self._seconds["lost"]

    @property
    def total_s(self) -> float:
        """[s]"""
        return sum(self._seconds.values())

    def as_json(self) -> Mapping[str, float | int | None]:
        """Times and counts by their names in JSON."""
        return {
            **{f"{state}_s": seconds for state, seconds in self._seconds.items()},
            "outside_s": self._outside_s,
            "first_localized_s": self.first_s,
            "losses": self.n_losses,
        }


KEYFRAME_DISTANCE_M = 0.5
"""Way after which the next keyframe follows [m]: scans of less are nearly the same evidence."""
KEYFRAME_ANGLE_RAD = 0.3
"""Turn after which the next keyframe follows [rad], for the same reason."""
_LISTED_PLACES = 5


@dataclass(frozen=True, eq=False)
class PriorMap:
    """A map that exists before the drive, and about where the drive begins in it."""

    places: Places
    initial: Pose2 | None = None
    """(3,) ``map_T_body`` [m, m, rad]; None for anywhere. In space height, roll and pitch are those of the map's ground and gravity."""

    @property
    def is_in_space(self) -> bool:
        """Whether it holds clouds in space."""
        return isinstance(self.places, SpacePlaces)

    def check_lidar(self, has_clouds: bool, is_kept_planar: bool = False) -> None:
        """Raises `MapError` for a map in space where the LiDAR is planar, or poses shall stay in the plane."""
        if self.is_in_space and (is_kept_planar or not has_clouds):
            why = "--config.step.planar keeps poses in the plane" if has_clouds else "the LiDAR is planar"
            raise MapError(
                f"the saved map holds clouds in space, and {why}. Name a map of planar scans, or the cloud's topic by --topic.points."
            )


class SavedMapFusion(FilteredOdometry[Filter]):
    """`MapFusion` or `SpaceMapFusion`."""

    localizer: Localizer | SpaceLocalizer

    def __init__(self, odometry: Filter) -> None:
        self.odometry = odometry
        self._times, self._waiting_s = LocalizationTimes(), 0.0

    @abstractmethod
    def set_pose(self, pose: Pose2, cov: Cov3) -> None:
        """Search near the present ``pose`` (3,) in the map, with covariance ``cov`` (3, 3), as a person gives it. Odometry goes on."""

    @abstractmethod
    def replace_map(self, prior: PriorMap) -> None:
        """Localize in ``prior`` instead of the present map, and search all of it. Odometry goes on. Raises `MapError` unless both are in
        the plane or both in space."""

    def relocalize(self) -> None:
        """Discard the pose in the map, and search the whole map. Odometry continues."""
        self.localizer.search_everywhere()
        self._take_pose()

    def _take_pose(self) -> None:
        """The localizer has moved the last keyframe."""

    def _count(self, duration_s: float) -> None:
        self._times.add(duration_s, self.localizer.state, self._is_outside)
        self._waiting_s += duration_s

    def _advance_search(self) -> None:
        """Take the result of a search that is due."""
        passed_s, self._waiting_s = self._waiting_s, 0.0
        if self.localizer.advance(passed_s):
            self._take_pose()

    @property
    def _is_outside(self) -> bool:
        """Whether the place is known, and is where the map has nothing."""
        return self.localizer.state == "localized" and self.localizer.is_outside

    @property
    @abstractmethod
    def probability(self) -> float:
        """`Localizer.probability` after the motion since the last keyframe."""

    @staticmethod
    def _from_above(pose: FloatArray) -> list[float]:
        """x, y, yaw of a pose of the localizer [m, m, rad]."""
        return [float(value) for value in pose]

    def localization(self) -> Mapping[str, Any]:
        """State, probability and places in the saved map so far, as JSON holds them."""
        places = [] if self.localizer.state == "localized" else self.localizer.hypotheses[:_LISTED_PLACES]
        return {
            "state": self.localizer.state,
            "probability": self.probability,
            "pose": self._from_above(self.localizer.pose),
            **self._times.as_json(),
            "is_outside": self._is_outside,
            "places": [{"pose": self._from_above(place.pose), "probability": place.probability} for place in places],
        }

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name, as the filter counts them."""
        return self.odometry.counts()

    def warnings(self) -> list[Message]:
        """Problems of the measurements so far: those of the filter, and for how long the place in the map was not known."""
        found, times = list(self.odometry.warnings()), self._times
        if times.first_s is None and self.odometry.counts()["scans"]:
            found.append(message("saved_map.never"))
        elif times.n_losses:
            lost = message("saved_map.lost", losses=times.n_losses, lost_s=times.lost_s, total_s=times.total_s, state=self.localizer.state)
            found.append(lost)
        return found

    def occupancy(self) -> Grid | None:
        """The saved map; None where nothing in it stands upright."""
        return self.localizer.grid

    def map_points(self) -> Points2:
        """(M, 2) points of the saved map, seen from above [m]."""
        return self.localizer.map_points()
