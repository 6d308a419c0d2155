"""Place of a robot in a saved map in space, and its probability: search around a given pose, then track until the map contradicts.

The pose against the map's surfaces is a filter of its own over keyframes, as `localizer.Localizer` is in the plane: moved by the odometry,
updated by clouds registered to the map. The map's own uncertainty is considered (Schmidt 1966): it is added to what is published, and no
cloud reduces it. Odometry and map are both level by gravity, so that heading and position alone are searched: about a pose that is given
or reckoned, else everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.maps.background_search import BackgroundSearch, BackgroundSearcher
from localization.maps.grid import Grid
from localization.maps.localizer import INITIAL_COV, State
from localization.maps.place_probability import LIKELY, sigmoid, within
from localization.maps.space_places import SpacePlace, SpacePlaces
from localization.maps.uncertain_pose import UncertainPose
from motion_models import se3
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2
from motion_models.se3 import Transform3

_BEND = np.diag([5e-3, 5e-3, 5e-3, 5e-4, 5e-4, 5e-4]) ** 2
"""Covariance of a map's surfaces against its nearest keyframe [m^2, rad^2]."""
_LEVEL_COV = np.diag([0.0, 0.0, 0.3, 0.05, 0.05, 0.0]) ** 2
"""Covariance of the height of the ground below a planar pose, and of gravity against the map's [m^2, rad^2]."""
_PLANAR = [0, 1, 5]
_INDEPENDENT_M = 1.0
"""Way over which searches find the same place, from which on they are more than the same view again, as in the plane [m]."""
_SAME_COV = np.diag([0.1, 0.1, 0.1, 0.03, 0.03, 0.03]) ** 2
"""Covariance of a searched pose against another of the same place [m^2, rad^2]."""
_GATE, _OUTLIER = 9.0, 25.0
"""Squared Mahalanobis distances of 3 sigma, within which places agree, and of 5 sigma, beyond which a cloud contradicts the place."""
WEIGHTS = (10.0, -20.0, -4.0)
"""Log-odds of a place are their products with the shares of a cloud's points on and off the map's surfaces, and 1."""
_MAX_LOG_ODDS = 6.0
_LOST = 0.5
"""Probability of a tracked place below which the robot is lost."""
_KNOWN_SHARE = 0.3
"""Share of points near surfaces of the map, below which a cloud is no evidence for or against the place."""
_TRACKED_M, _TRACKED_RAD = 0.5, 0.3
"""Sigma of a pose that is tracked, at most, as in the plane."""
_NEAR_M, _NEAR_RAD = 1.0, 0.4
"""Sigma of a pose by odometry since it was known, up to which it is searched about that: 3 sigma are searched in seconds."""
_NEAR_KEYFRAMES = 10
"""Keyframes after which a given or reckoned pose that no cloud confirms is dropped."""
_NEAR_SEARCH_S, _SEARCH_S = 0.3, 1.5
"""Times after which the result of a search beside the estimates is due, about a pose and in the whole map [s]."""


class SpaceMotion(NamedTuple):
    """Motion since the last keyframe."""

    delta: Transform3
    """(4, 4)"""
    cov: FloatArray
    """(6, 6) of its right perturbation."""


_NO_MOTION = SpaceMotion(np.eye(4), np.zeros((6, 6)))


@dataclass(frozen=True, eq=False)
class SpaceHypothesis:
    """A place where the robot may be."""

    pose: Transform3
    """(4, 4) ``map_T_body`` at the last keyframe."""
    probability: float
    cov: FloatArray
    """(6, 6) of the pose if the place is the right one, by the cloud."""
    way_m: float = 0.0
    """Way over which all searches have found it [m]."""


class SpaceLocalizer(BackgroundSearcher[BackgroundSearch[SpacePlace]]):
    """`add` keyframe after keyframe; `state`, `probability`, `pose` and `covariance` are those at the last one."""

    def __init__(
        self, places: SpacePlaces, initial: Pose2 | None = None, initial_cov: Cov3 = INITIAL_COV, is_background: bool = False
    ) -> None:
        """``initial`` (3,): about where the robot is in the map, with covariance ``initial_cov`` (3, 3). ``is_background``: searches run
        beside the estimates (`BackgroundSearch`), and `advance` counts the time until they are due."""
        super().__init__(is_background)
        self.places = places
        self.state: State = "searching"
        self.hypotheses: list[SpaceHypothesis] = []
        """Places that the last search found, the most probable first."""
        self.is_outside = False
        """Whether most of the last cloud is where the map has nothing: the tracked pose is by odometry meanwhile."""
        if initial is None:
            self.search_everywhere()
        else:
            self.set_pose(initial, initial_cov)

    def set_pose(self, pose: Pose2, cov: Cov3 = INITIAL_COV) -> None:
        """Search near ``pose`` (3,) with covariance ``cov`` (3, 3), as a person gives it."""
        self.search_everywhere()
        self._near_left, self._at = _NEAR_KEYFRAMES, UncertainPose(self.places.on_ground(pose, np.eye(3)), _level(cov))

    def search_everywhere(self) -> None:
        """Forget the place, and search the whole map from now on."""
        self.state = "searching"
        self.hypotheses, self._log_odds, self.is_outside = [], -_MAX_LOG_ODDS, False
        self._running = None
        self._since = self._before = UncertainPose(*_NO_MOTION)  # since the clouds of the last search, and the search before until then
        self._pacing.restart()
        self._forget(self.places.on_ground(self.places.centre, np.eye(3)))

    @property
    def pose(self) -> Transform3:
        """(4, 4) ``map_T_body``."""
        return self._at.pose

    @property
    def probability(self) -> float:
        """That the robot is within 0.5 m and 0.2 rad of `pose`; while it is searched, that it is at the first of `hypotheses`."""
        return self.probability_after(_NO_MOTION)

    def probability_after(self, motion: SpaceMotion) -> float:
        """`probability` when the robot has moved by ``motion`` since the last keyframe."""
        if self.state != "localized":
            return min(sigmoid(self._log_odds), LIKELY)
        return sigmoid(self._log_odds) * within(self._at.move(*motion).cov[np.ix_(_PLANAR, _PLANAR)])

    @property
    def grid(self) -> Grid | None:
        """The map's walls and free ground, as seen from above; None where nothing stands upright."""
        return None if self.places.from_above is None else self.places.from_above.grid

    def map_points(self) -> Points2:
        """(M, 2) points of the map, seen from above [m]."""
        return self.places.points[:, :2]

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of the right perturbation of `pose`, with the map's own."""
        return np.asarray(self._at.cov + self.places.mapped.cov_at(self.pose))

    def add(self, cloud: FloatArray, motion: SpaceMotion, rotation: FloatArray) -> None:
        """A keyframe with ``cloud`` (N, 3) of the body frame [m], after ``motion`` since the one before.

        ``rotation`` (3, 3): by the odometry, from the body's axes to level ones.
        """
        self._at, self._since = self._at.move(*motion), self._since.move(*motion)
        self.hypotheses = [replace(found, pose=found.pose @ motion.delta) for found in self.hypotheses]
        if self.state == "localized" and _is_within(self._at.cov, _TRACKED_M, _TRACKED_RAD):
            self._running = None
            self._track(cloud)
            return
        if self.state == "localized":  # by odometry for long: the place is searched about the pose, or everywhere
            self.state, self.hypotheses, self._log_odds = "searching", [], -_MAX_LOG_ODDS
            self._near_left = _NEAR_KEYFRAMES
        if self._is_search_due():
            self._search(cloud, rotation)

    def _track(self, cloud: FloatArray) -> None:
        """Register near the pose. Where that contradicts, again and again, the robot is lost."""
        place = self.places.align(cloud, self._at.pose, self._at.cov + _BEND)
        self.is_outside = place.on_surfaces + place.off_surfaces < _KNOWN_SHARE
        if self.is_outside:
            return
        measured, R = place.match.measured, place.cov + _BEND
        is_outlier = self._at.squared_distance(measured, R) > _OUTLIER
        evidence = min(_evidence(place), -1.0) if is_outlier else _evidence(place)
        self._log_odds = min(self._log_odds + 0.5 * evidence, _MAX_LOG_ODDS)
        if sigmoid(self._log_odds) < _LOST:
            self._lose()
        elif not is_outlier:
            self._at = self._at.update(measured, R)

    def _lose(self) -> None:
        """The place was wrong, or the map is."""
        self.state, self.hypotheses, self._log_odds = "lost", [], -_MAX_LOG_ODDS
        self._pacing.restart()
        self._forget(self.pose)

    def _forget(self, pose: Transform3) -> None:
        """The robot may be anywhere in the map, at the height and the tilt of ``pose`` (4, 4)."""
        self._near_left, self._at = 0, UncertainPose(pose, _level(self.places.extent_cov))

    def _search(self, cloud: FloatArray, rotation: FloatArray) -> None:
        """Search ``cloud`` (N, 3) of the last keyframe, and take the best place where searches over some way agree."""
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        level = se3.rotation(np.array([0.0, 0.0, -yaw])) @ rotation
        near: tuple[FloatArray, ...] = ()
        if self._near_left and _is_within(self._at.cov, _NEAR_M, _NEAR_RAD):
            at = np.array([*self.pose[:2, 3], math.atan2(self.pose[1, 0], self.pose[0, 0])])
            near = at, 3.0 * np.sqrt(np.diagonal(self._at.cov)[_PLANAR])
        if self._near_left:
            self._near_left -= 1
            if not self._near_left:
                self._forget(self.pose)
        self._before, self._since = self._since, UncertainPose(*_NO_MOTION)
        self._start(BackgroundSearch(self.places, cloud, level, *near, due_s=_NEAR_SEARCH_S if near else _SEARCH_S))

    def _take(self, search: BackgroundSearch[SpacePlace]) -> None:
        """Take the best place of ``search`` if it is probable and the searches before agree."""
        earlier, since = self.hypotheses, self._since
        self.hypotheses = [replace(found, pose=found.pose @ since.pose) for found in _weigh(search.result())]
        self._log_odds = -_MAX_LOG_ODDS
        if not self.hypotheses:
            return
        best = self.hypotheses[0]
        self._log_odds = math.log(best.probability / (1.0 - best.probability))
        cov = self._before.move(since.pose, _SAME_COV).cov
        way = max((found.way_m for found in earlier if _agree(found.pose, best.pose, cov)), default=-math.inf)
        way = max(way + math.hypot(*self._before.pose[:3, 3]), 0.0)
        self.hypotheses[0] = replace(best, way_m=way)
        if best.probability >= LIKELY and way >= _INDEPENDENT_M:
            self.state = "localized"
            self._at = UncertainPose(best.pose, UncertainPose(best.pose, best.cov + _BEND).move(since.pose, since.cov).cov)
            self._near_left = 0
            self._pacing.restart()


def _level(cov: Cov3) -> FloatArray:
    """(6, 6) of a pose on the map's ground and level by gravity, of which x, y and yaw have ``cov`` (3, 3)."""
    full = _LEVEL_COV.copy()
    full[np.ix_(_PLANAR, _PLANAR)] = cov
    return full


def _is_within(cov: FloatArray, sigma_m: float, sigma_rad: float) -> bool:
    """Whether a pose with ``cov`` (6, 6) has at most these sigmas of position in the plane and heading."""
    return bool(cov[0, 0] + cov[1, 1] < sigma_m**2 and cov[5, 5] < sigma_rad**2)


def _evidence(place: SpacePlace) -> float:
    on, off, offset = WEIGHTS
    return on * place.on_surfaces + off * place.off_surfaces + offset


def _weigh(places: Sequence[SpacePlace]) -> list[SpaceHypothesis]:
    """``places``, the best first, with their probabilities: those that fit as well share it."""
    if not places:
        return []
    odds = np.array([_evidence(place) for place in places])
    rivals = np.exp(odds - odds[0])
    first = min(max(float(odds[0]), -_MAX_LOG_ODDS), _MAX_LOG_ODDS)
    probabilities = sigmoid(first) * rivals / rivals.sum()
    return [SpaceHypothesis(place.pose, float(p), place.cov) for place, p in zip(places, probabilities, strict=True)]


def _agree(a: Transform3, b: Transform3, cov: FloatArray) -> bool:
    off = se3.local(a, b)
    return bool(off @ np.linalg.solve(cov, off) < _GATE)
