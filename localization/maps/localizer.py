"""Place of a robot in a saved map, and its probability: search by the scans of several keyframes, then track until the map contradicts.

The pose against the map's walls is a filter of its own over keyframes: moved by the odometry, updated by scans aligned with the map. The
map's own uncertainty is considered (Schmidt 1966): it is added to what is published, and no scan reduces it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from localization.lidar.correlative_search import prior_outlier_cov
from localization.lidar.registration import OUTLIER_SIGMAS, is_narrow, mahalanobis
from localization.lidar.scan_matcher import MIN_POINTS
from localization.lidar.submap import voxel_means
from localization.maps.background_search import BackgroundSearch
from localization.maps.grid import Grid
from localization.maps.place_search import CELL_M, Place, PlaceMap
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

State = Literal["searching", "localized", "lost"]

LIKELY = 0.9
"""Probability from which on the robot is localized."""
_LOST = 0.5
"""Probability of a tracked place below which the robot is lost."""
_SEARCH_KEYFRAMES = 12
"""Keyframes whose scans are searched together, at most: 6 m of way."""
_BEND = np.diag([0.02, 0.02, 0.005]) ** 2
"""Covariance of a map's surfaces against its nearest keyframe, as for loop closures [m^2, m^2, rad^2]."""
_OPEN = np.diag([1e-2, 1e-2, 1.0])
"""Information of a scan along directions that the scene leaves open, at least [1/m^2, 1/m^2, 1/rad^2]."""
_BY_WALLS, _BY_FREE, _BY_MARGIN, _BY_POINTS, _OFFSET = 7.2, -5.3, 11.2, 1.7, -7.8
"""Log-odds that the best place of a search is the right one, by its shares on walls and in free space, its margin over the next place (at
most 0.5) and log(points / 200): logistic regression of 640 searches in halves of three buildings, most of them of another building. All of
the 64 that have more than 0.9 are right."""
_RIVALRY = 20.0
"""By which the probability of a place falls with its score: a place that scores 0.11 less than the best is one tenth as probable."""
_MAX_MARGIN, _POINTS = 0.5, 200.0
_TRACK_GAIN, _CONTRADICTION = 3.0, 5.0
"""Log-odds of a keyframe that is tracked: the first times (share on walls - the second times share in free space). Right places have 0.86
and 0.04 in the median, 0.69 and 0.13 at the ends of 90 %; the best of wrong ones 0.6 and 0.12."""
_FITTING = 1.0
"""Log-odds of a keyframe that contradicts the place, from which on a pose farther from the odometry's is taken instead: nine of ten right
places have more, the best of wrong ones 0."""
_KNOWN_SHARE, _CONTRADICTING_SHARE = 0.5, 0.2
"""Share of points in mapped space, below which a scan is no evidence for or against the place, unless the second share is in free space."""
_MAX_SEARCH_ODDS, _MAX_LOG_ODDS = 5.0, 8.0
"""Log-odds of a search, and of a place that is tracked, at most: a few scans from elsewhere are enough to be lost."""
_PATIENCE, _MAX_WAIT = 6, 3
"""After each so many searches in vain, one more keyframe is left out between them, at most the second number."""
_TRACKED_M, _TRACKED_RAD, _LEAST_MARGIN = 0.5, 0.3, 0.1
"""Sigma of a pose that is tracked, at most, through places that the map does not have; margin of the score over the next place, by which
it is found again where the map goes on."""
_NEAR_M, _NEAR_RAD = 3.0, 0.8
"""Sigma of a pose by odometry alone since it was tracked, up to which it is searched about that: 3 sigma are a building."""
_PRIOR_SQUARE = 9.0
"""A search agrees with an earlier place within 3 sigma of the odometry since, and of `_SAME_COV`."""
_SAME_COV = np.diag([0.1, 0.1, 0.033]) ** 2
"""Covariance of a searched pose against another of the same place [m^2, m^2, rad^2]."""
_INDEPENDENT_M = 1.0
"""Way between the first and the last of the scans that are searched, from which on they are more than the same view again [m]."""
_NEW_VIEW_M = 2.0 / math.pi
"""Way that a turn counts for, where the LiDAR does not measure all around: after 90 degrees half of a view of 180 is new [m/rad]."""
_INITIAL_KEYFRAMES = 10
"""Keyframes after which a given pose that no scan confirms is dropped."""
INITIAL_COV = np.diag([0.5, 0.5, 0.26]) ** 2
"""Covariance of a pose that a person gives [m^2, m^2, rad^2]: the default of RViz's tool for /initialpose."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A place where the robot may be."""

    pose: Pose2
    """(3,) ``map_T_body`` at the last keyframe [m, m, rad]."""
    probability: float


@dataclass(frozen=True, eq=False)
class _Keyframe:
    odometry: Pose2
    points: Points2
    cov: Cov3
    """(3, 3) of the motion since."""
    way_m: float
    """Way that the robot had driven there, turns to new views included [m]."""


class Localizer:
    """`add` keyframe after keyframe; `state`, `probability`, `pose` and `covariance` are those at the last one."""

    def __init__(
        self, place_map: PlaceMap, initial: Pose2 | None = None, initial_cov: Cov3 = INITIAL_COV, is_background: bool = False
    ) -> None:
        """``initial`` (3,): about where the robot is in the map, with covariance ``initial_cov`` (3, 3). With ``is_background``, searches
        run beside the estimates, and `advance` takes their results when they are due; else `add` returns with them."""
        self.places, self._is_background = place_map, is_background
        self.state: State = "searching"
        self.pose, self._cov = place_map.centre, np.zeros((3, 3))
        self._is_tracking, self._track_odds, self._search_odds = False, 0.0, -_MAX_SEARCH_ODDS
        self._recent: deque[_Keyframe] = deque(maxlen=_SEARCH_KEYFRAMES)
        self.hypotheses: Sequence[Hypothesis] = ()
        """Places that a search found, the most probable first."""
        self._initial_left = 0
        self._is_reckoned = False  # the pose is by odometry since it was tracked, and was not refuted
        self._travelled_m, self._searched_m, self._since_search = 0.0, 0.0, np.zeros((3, 3))
        self._failures, self._wait = 0, 0
        self._running: BackgroundSearch | None = None
        if initial is not None:
            self.set_pose(initial, initial_cov)

    def set_pose(self, pose: Pose2, cov: Cov3 = INITIAL_COV) -> None:
        """Search near ``pose`` (3,) with covariance ``cov`` (3, 3), as a person gives it."""
        self.state, self._is_tracking, self._is_reckoned, self.hypotheses = "searching", False, False, ()
        self.pose, self._cov, self._search_odds = np.asarray(pose, dtype=float), cov, 0.0
        self._initial_left, self._failures, self._wait = _INITIAL_KEYFRAMES, 0, 0
        self._recent.clear()
        self._running = None

    def search_everywhere(self) -> None:
        """Forget the place, and search the whole map by the scans from now on."""
        self.set_pose(self.places.centre, np.zeros((3, 3)))
        self._initial_left, self._search_odds = 0, -_MAX_SEARCH_ODDS

    @property
    def probability(self) -> float:
        """That the robot is where `pose` has it; while it is searched, that it is at the first of `hypotheses`."""
        return _sigmoid(self._track_odds if self.state == "localized" else self._search_odds)

    @property
    def covariance(self) -> Cov3:
        """(3, 3) of the right perturbation of `pose`, with the map's own; of a place that is not known, with the extent of the map."""
        if self.state == "localized" or (self.state == "searching" and self._is_reckoned):
            return np.asarray(self._cov + self.places.map_cov(self.pose))
        return self._cov if self._initial_left else np.asarray(self._cov + self.places.extent_cov)

    def add(self, odometry: Pose2, points: Points2, delta: Pose2, cov: Cov3) -> None:
        """A keyframe at ``odometry`` (3,) with the scan ``points`` (N, 2) of the body frame [m]: moved by ``delta`` (3,) with covariance
        ``cov`` (3, 3) since the one before."""
        if not is_narrow(cov):  # carried, or driven blind: scans before and after do not belong together
            self._recent.clear()
            self._running, self.hypotheses = None, ()
        A = se2.adjoint(se2.inverse(delta))
        self.pose, self._cov = se2.compose(self.pose, delta), A @ self._cov @ A.T + cov
        self._travelled_m += math.hypot(delta[0], delta[1]) + (_NEW_VIEW_M * abs(delta[2]) if _is_partial(points) else 0.0)
        self._since_search = A @ self._since_search @ A.T + cov
        self.hypotheses = [replace(place, pose=se2.compose(place.pose, delta)) for place in self.hypotheses]
        moved = [replace(key, cov=A @ key.cov @ A.T + cov) for key in self._recent]
        self._recent = deque((key for key in moved if is_narrow(key.cov)), _SEARCH_KEYFRAMES)
        if self._running is not None:
            self._running.move(delta, cov)
        if len(points) < MIN_POINTS:
            return
        self._recent.append(_Keyframe(odometry, points, np.zeros((3, 3)), self._travelled_m))
        if self._is_tracking and _is_trackable(self._cov):
            self._track(points)
        elif self._is_tracking or self._is_reckoned:
            self._reckon()
        if self.state == "localized":
            self._running = None
        elif self._running is None:
            self._start_search()

    def advance(self, duration_s: float) -> bool:
        """``duration_s`` more have passed in the log; returns whether the result of a search was due, and has been taken."""
        if self._running is None or not self._running.advance(duration_s):
            return False
        self.finish_search()
        return True

    def finish_search(self) -> None:
        """Take the result of the search that runs, if one does."""
        search, self._running = self._running, None
        if search is not None:
            self._conclude(search.result(), search.n_points, search.moved, search.cov)

    @property
    def grid(self) -> Grid:
        """The map's walls and free space."""
        return self.places.grid

    def map_points(self) -> Points2:
        """(M, 2) points of the map [m]."""
        return self.places.surfaces.means

    def _track(self, points: Points2) -> None:
        """Align with the map near the pose. Where that contradicts, the place stays a hypothesis beside the search until it is refuted."""
        place, cov = self._align(points), self._cov
        if place is None or (place.on_walls + place.contradicting < _KNOWN_SHARE and place.contradicting < _CONTRADICTING_SHARE):
            return
        evidence = self._evidence(place, cov)
        if evidence < -_TRACK_GAIN:  # the odometry may be an outlier, as by slip in a turn
            wide = cov + prior_outlier_cov(cov)
            again = self.places.align(points, self.pose, wide)
            of_again = self._evidence(again, wide)
            if of_again >= _FITTING:
                place, cov, evidence = again, wide, of_again
        self._track_odds = min(self._track_odds + evidence, _MAX_LOG_ODDS)
        self._is_tracking = self._track_odds > -_MAX_LOG_ODDS
        if self.state == "localized" and _sigmoid(self._track_odds) < _LOST:
            self._lose()
        elif self.state == "lost" and _sigmoid(self._track_odds) >= LIKELY:
            self.state = "localized"
        measured, R = _measurement(place)
        if not self._is_outlier(measured, cov + R):
            K = np.linalg.solve(cov + R, cov).T
            self.pose = se2.retract(self.pose, K @ se2.local(self.pose, measured))
            self._cov = np.asarray((np.eye(3) - K) @ cov @ (np.eye(3) - K).T + K @ R @ K.T)

    def _evidence(self, place: Place, cov: Cov3) -> float:
        """Log-odds that ``place`` adds to the one that is tracked, whose pose has covariance ``cov`` (3, 3)."""
        measured, R = _measurement(place)
        if self._is_outlier(measured, cov + R):
            return -_TRACK_GAIN
        return _TRACK_GAIN * (place.on_walls - _CONTRADICTION * place.contradicting)

    def _is_outlier(self, measured: Pose2, cov: Cov3) -> bool:
        return mahalanobis(self.pose, measured, cov) > OUTLIER_SIGMAS**2

    def _align(self, points: Points2) -> Place | None:
        """Near the pose; searched within 3 sigma where that is wider than the basin of an alignment, and None where that is ambiguous."""
        if is_narrow(self._cov):
            return self.places.align(points, self.pose, self._cov)
        found = self.places.search(points, self.pose, _three_sigma(self._cov))
        return found[0] if found and (len(found) == 1 or found[0].score - found[1].score > _LEAST_MARGIN) else None

    def _reckon(self) -> None:
        """The pose is too wide to align scans: search about it, or everywhere where it is wider than that."""
        self._is_tracking, self._is_reckoned = False, True
        is_near = np.trace(self._cov[:2, :2]) < _NEAR_M**2 and self._cov[2, 2] < _NEAR_RAD**2
        self.state = "searching" if is_near else "lost"

    def _lose(self) -> None:
        """The place was wrong, or the map is: search anywhere, by the scans from now on."""
        self.state, self._is_reckoned, self.hypotheses, self._search_odds = "lost", False, (), -_MAX_SEARCH_ODDS
        self._failures = self._wait = 0
        last = self._recent[-1]
        self._recent.clear()
        self._recent.append(last)

    def _start_search(self) -> None:
        """Search the merged scans of the last keyframes."""
        self._wait -= 1
        if self._wait > 0:
            return
        self._failures += 1
        self._wait = 1 + min(self._failures // _PATIENCE, _MAX_WAIT)
        here = self._recent[-1].odometry
        merged = np.vstack([se2.transform(se2.between(here, key.odometry), key.points) for key in self._recent])
        is_near = self._initial_left > 0 or (self._is_reckoned and self.state == "searching")
        near = (self.pose, _three_sigma(self._cov)) if is_near else None
        if self._initial_left:
            self._initial_left -= 1
            self._cov = self._cov if self._initial_left else np.zeros((3, 3))
        points, self._searched_m = voxel_means(merged, 0.8 * CELL_M), self._travelled_m - self._recent[0].way_m
        if self._is_background:
            self._running = BackgroundSearch(self.places, points, near)
        else:
            self._conclude(self.places.search(points, *(near or ())), len(points), np.zeros(3), np.zeros((3, 3)))

    def _conclude(self, places: Sequence[Place], n_points: int, moved: Pose2, moved_cov: Cov3) -> None:
        """Take the best of ``places``, which ``n_points`` have found before the robot ``moved`` (3,), if it is probable and the search
        before agrees."""
        before, since_cov = self.hypotheses, self._since_search
        self._since_search = moved_cov
        self.hypotheses = [replace(place, pose=se2.compose(place.pose, moved)) for place in _weigh(places, n_points)]
        self._search_odds = -_MAX_SEARCH_ODDS
        if not places:
            return
        best = self.hypotheses[0]
        is_repeated = self._searched_m >= _INDEPENDENT_M and any(_agree(place.pose, best.pose, since_cov) for place in before)
        is_confirmed = is_repeated or self._is_reckoned_at(best.pose)
        probability = best.probability if is_confirmed else min(best.probability, LIKELY)
        self.hypotheses = [replace(best, probability=probability), *self.hypotheses[1:]]
        self._search_odds = _log_odds(probability)
        cov = np.asarray(np.linalg.inv(places[0].fit.information + _OPEN)) * max(places[0].residual_variance, 1.0)
        if is_confirmed and probability >= LIKELY and is_narrow(cov):
            A = se2.adjoint(se2.inverse(moved))
            self._begin_tracking(best.pose, A @ (cov + _BEND) @ A.T + moved_cov)

    def _is_reckoned_at(self, pose: Pose2) -> bool:
        """Whether the odometry leads to ``pose`` (3,) from where the robot was tracked; not where it is as wide as after being carried."""
        return self._is_reckoned and self.state == "searching" and _agree(self.pose, pose, self._cov)

    def _begin_tracking(self, pose: Pose2, cov: Cov3) -> None:
        """The robot is at ``pose`` (3,) with covariance ``cov`` (3, 3)."""
        self.pose, self._cov, self._track_odds = pose, np.asarray(cov), self._search_odds
        self._is_tracking, self._is_reckoned, self.state = True, False, "localized"
        self._initial_left, self._failures, self._wait = 0, 0, 0


def _is_partial(points: Points2) -> bool:
    """Whether the bearings of ``points`` (N, 2) leave a quarter of a turn open."""
    bearings = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    return len(points) < 2 or float(np.diff(bearings, append=bearings[0] + 2.0 * math.pi).max()) > 0.5 * math.pi


def _measurement(place: Place) -> tuple[Pose2, Cov3]:
    """Pose (3,) that the scan alone gives in the map, and its covariance (3, 3)."""
    information = place.fit.information + _OPEN
    measured = se2.retract(place.pose, -np.linalg.solve(information, place.fit.gradient))
    return measured, np.asarray(np.linalg.inv(information)) * max(place.residual_variance, 1.0) + _BEND


def _agree(earlier: Pose2, pose: Pose2, cov: Cov3) -> bool:
    """Whether ``pose`` (3,) is where the odometry leads to from an ``earlier`` one, with covariance ``cov`` (3, 3)."""
    return mahalanobis(earlier, pose, cov + _SAME_COV) < _PRIOR_SQUARE


def _weigh(places: Sequence[Place], n_points: int) -> list[Hypothesis]:
    """``places`` with their probabilities; that of the best by regression, those of others by their scores."""
    if not places:
        return []
    best = places[0]
    margin = min(best.score - places[1].score, _MAX_MARGIN) if len(places) > 1 else min(best.score, _MAX_MARGIN)
    by_points = _BY_POINTS * math.log(n_points / _POINTS)
    odds = _BY_WALLS * best.on_walls + _BY_FREE * best.in_free + _BY_MARGIN * margin + by_points + _OFFSET
    weights = np.exp([-_RIVALRY * (best.score - place.score) for place in places[1:]])
    share = 1.0 / (1.0 + weights.sum())  # places that fit equally are equally probable
    probability = min(_sigmoid(min(max(odds, -_MAX_SEARCH_ODDS), _MAX_SEARCH_ODDS)), share)
    shares = probability * weights
    return [Hypothesis(best.pose, probability), *(Hypothesis(place.pose, float(p)) for place, p in zip(places[1:], shares, strict=True))]


def _is_trackable(cov: Cov3) -> bool:
    return bool(np.trace(cov[:2, :2]) < _TRACKED_M**2 and cov[2, 2] < _TRACKED_RAD**2)


def _three_sigma(cov: Cov3) -> FloatArray:
    """(3,) half the window of a search [m, m, rad], along any axes."""
    radius = math.sqrt(float(np.trace(cov[:2, :2])))
    return 3.0 * np.array([radius, radius, math.sqrt(cov[2, 2])])


def _sigmoid(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))
