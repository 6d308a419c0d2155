"""Place of a robot in a saved map, and its probability: search by the scans of several keyframes, then track until the map contradicts.

The pose against the map's walls is a filter of its own over keyframes: moved by the odometry, updated by scans aligned with the map. The
map's own uncertainty is considered (Schmidt 1966): it is added to what is published, and no scan reduces it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from localization.lidar.correlative_search import prior_outlier_cov
from localization.lidar.registration import OUTLIER_SIGMAS, is_narrow, mahalanobis
from localization.lidar.scan_matcher import MIN_POINTS, OPEN_INFORMATION
from localization.maps.background_search import BackgroundSearcher, PlanarSearch
from localization.maps.grid import Grid
from localization.maps.place_probability import (
    MAX_SEARCH_ODDS,
    NEAR_WEIGHTS,
    SEARCH_WEIGHTS,
    PlaceHypothesis,
    Weights,
    log_odds,
    sigmoid,
    weigh,
    with_fix,
)
from localization.maps.place_search import CELL_M, Place, PlaceMap
from localization.maps.position_plane import PositionFix
from localization.maps.recent_scans import RecentMotion, RecentScans
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

State = Literal["searching", "localized", "lost"]

LIKELY = 0.9
"""Probability from which on the robot is localized."""
RIGHT_M, RIGHT_RAD = 0.5, 0.2
"""How near a pose is the right place [m, rad]: half a door, and a scan that still overlaps."""
_LOST = 0.5
"""Probability of a tracked place below which the robot is lost."""
_BEND = np.diag([0.02, 0.02, 0.005]) ** 2
"""Covariance of a map's surfaces against its nearest keyframe, as for loop closures [m^2, m^2, rad^2]."""
_TRACK_GAIN, _CONTRADICTION = 3.0, 5.0
"""Log-odds of a keyframe that is tracked: the first times (share on walls - the second times share in free space). Right places have 0.86
and 0.04 in the median, 0.69 and 0.13 at the ends of 90 %; the best of wrong ones 0.6 and 0.12."""
_FITTING = 1.0
"""Log-odds of a keyframe that contradicts the place, from which on a pose farther from the odometry's is taken instead: nine of ten right
places have more, the best of wrong ones 0."""
_KNOWN_SHARE, _CONTRADICTING_SHARE = 0.5, 0.1
"""Share of points in mapped space, below which a scan is no evidence for or against the place, unless the second share contradicts: of 375
scans at right poses outside of the maps (halves of three logs), none has more than 0.085."""
_MAX_LOG_ODDS = 8.0
"""Log-odds of a place that is tracked, at most: a few scans from elsewhere are enough to be lost."""
_PATIENCE, _MAX_WAIT = 6, 3
"""After each so many searches in vain, one more keyframe is left out between them, at most the second number."""
_PROMISING = 0.3
"""Probability of a place, from which on the search was not in vain: in maps of other buildings one keyframe of 72 has more."""
_TRACKED_M, _TRACKED_RAD = 0.5, 0.3
"""Sigma of a pose that is tracked, at most, through places that the map does not have."""
_NEAR_M, _NEAR_RAD = 3.0, 0.8
"""Sigma of a pose by odometry alone since it was tracked, up to which it is searched about that: 3 sigma are a building."""
_PRIOR_SQUARE = 9.0
"""A search agrees with an earlier place within 3 sigma of the odometry since, and of `_SAME_COV`."""
_SAME_COV = np.diag([0.1, 0.1, 0.033]) ** 2
"""Covariance of a searched pose against another of the same place [m^2, m^2, rad^2]."""
_TRACKED_SCANS = 4
"""Scans that are searched near a tracked pose: 2 m of way, so that those of space that is not mapped are soon behind."""
_JOINED_M = 0.8 * CELL_M
"""Voxel of joined scans [m]."""
_STAYED_M, _STAYED_RAD = 1.0, 0.8
"""A place this near to where the odometry leads confirms it, however wide that is: in a building of 20 m it is there by chance once in
a thousand times."""
_INDEPENDENT_M = 1.0
"""Way between the first and the last of the scans that are searched, from which on they are more than the same view again [m]."""
_ONE_VIEW = 0.98
"""Probability from which on one view of a place is enough to track it, in a search of the whole map: after the robot was carried in
three logs, 34 of 93 views have more, and all are right; of the wrong ones none has more than 0.26, and of 164 searches in maps of other
buildings none more than 0.81."""
_INITIAL_KEYFRAMES = 10
"""Keyframes after which a given pose that no scan confirms is dropped."""
INITIAL_COV = np.diag([0.5, 0.5, 0.26]) ** 2
"""Covariance of a pose that a person gives [m^2, m^2, rad^2]: the default of RViz's tool for /initialpose."""


class Localizer(BackgroundSearcher[PlanarSearch]):
    """`add` keyframe after keyframe; `state`, `probability`, `pose` and `covariance` are those at the last one."""

    def __init__(
        self,
        place_map: PlaceMap,
        initial: Pose2 | None = None,
        initial_cov: Cov3 = INITIAL_COV,
        is_background: bool = False,
        weights: Weights = SEARCH_WEIGHTS,
    ) -> None:
        """``initial`` (3,): about where the robot is in the map, with covariance ``initial_cov`` (3, 3). With ``is_background``, searches
        run beside the estimates, and `advance` takes their results when they are due; else `add` returns with them.
        ``weights`` give the probability of what a search has found."""
        self.places, self._is_background, self._weights = place_map, is_background, weights
        self.state: State = "searching"
        self.pose, self._cov = place_map.centre, np.zeros((3, 3))
        self._is_tracking, self._track_odds, self._search_odds = False, 0.0, -MAX_SEARCH_ODDS
        self._recent = RecentScans(place_map.range_noise_m)
        self.hypotheses: Sequence[PlaceHypothesis] = ()
        """Places that a search found, the most probable first."""
        self._initial_left = 0
        self._is_doubtful = False  # the last scan does not fit, as the first one does after the robot was carried unnoticed
        self._is_one_view = False  # the place was taken by one view, and the robot has not left it
        self.is_outside = False
        """Whether most of the last scan is where the map has nothing: the tracked pose is by odometry meanwhile."""
        self._is_reckoned = False  # the pose is by odometry since it was tracked, and was not refuted
        self._searched_m, self._is_whole_searched, self._since_search = 0.0, False, np.zeros((3, 3))
        self._failures, self._wait = 0, 0
        self._fix: PositionFix | None = None
        if initial is not None:
            self.set_pose(initial, initial_cov)

    def set_pose(self, pose: Pose2, cov: Cov3 = INITIAL_COV) -> None:
        """Search near ``pose`` (3,) with covariance ``cov`` (3, 3), as a person gives it."""
        self.state, self._is_tracking, self._is_reckoned, self.hypotheses = "searching", False, False, ()
        self.pose, self._cov, self._search_odds = np.asarray(pose, dtype=float), cov, 0.0
        self._initial_left, self._failures, self._wait = _INITIAL_KEYFRAMES, 0, 0
        self._recent.clear()
        self._running = None

    def add_position(self, fix: PositionFix) -> None:
        """The robot was at ``fix`` at the last keyframe, as by GNSS: it narrows the search, and a place that contradicts it is left."""
        self._fix = fix

    def search_everywhere(self) -> None:
        """Forget the place, and search the whole map by the scans from now on."""
        self.set_pose(self.places.centre, np.zeros((3, 3)))
        self._initial_left, self._search_odds = 0, -MAX_SEARCH_ODDS

    @property
    def probability(self) -> float:
        """That the robot is within 0.5 m and 0.2 rad of `pose`; while it is searched, that it is at the first of `hypotheses`."""
        return self.probability_after(np.zeros(3), np.zeros((3, 3)))

    def probability_after(self, delta: Pose2, cov: Cov3) -> float:
        """`probability` when the robot has moved by ``delta`` (3,) with covariance ``cov`` (3, 3) since the last keyframe."""
        if self.state != "localized":
            return sigmoid(self._search_odds)
        A = se2.adjoint(se2.inverse(delta))
        probability = sigmoid(self._track_odds) * within(A @ self._cov @ A.T + cov)
        return min(probability, LIKELY) if self._is_doubtful else probability

    @property
    def covariance(self) -> Cov3:
        """(3, 3) of the right perturbation of `pose`, with the map's own; of a place that is not known, with the extent of the map."""
        if self.state == "localized" or (self.state == "searching" and self._is_reckoned):
            return np.asarray(self._cov + self.places.map_cov(self.pose))
        return self._cov if self._initial_left else np.asarray(self._cov + self.places.extent_cov)

    def add(self, points: Points2, delta: Pose2, cov: Cov3) -> None:
        """A keyframe with the scan ``points`` (N, 2) of the body frame [m]: moved by ``delta`` (3,) with covariance ``cov`` (3, 3) since
        the one before."""
        delta, cov = self._recent.move(RecentMotion(delta, cov), points)
        if not is_narrow(cov):  # carried, or driven blind: scans before and after do not belong together
            self._running, self.hypotheses = None, ()
            self._failures = self._wait = 0
        A = se2.adjoint(se2.inverse(delta))
        self.pose, self._cov = se2.compose(self.pose, delta), A @ self._cov @ A.T + cov
        self._since_search = A @ self._since_search @ A.T + cov
        self._fix = None if self._fix is None else self._fix._replace(way_m=self._fix.way_m + math.hypot(delta[0], delta[1]))
        self.hypotheses = [replace(place, pose=se2.compose(place.pose, delta)) for place in self.hypotheses]
        if self._running is not None:
            self._running.move(delta, cov)
        if len(points) < MIN_POINTS:
            if self._is_tracking and not _is_trackable(self._cov):
                self._reckon()
            return
        self._recent.add(points)
        if self._is_tracking and _is_trackable(self._cov):
            self._track(points)
        elif self._is_tracking or self._is_reckoned:
            self._reckon()
        if self.state == "localized":
            self._running = None
        elif self._running is None:
            self._start_search()

    def _take(self, search: PlanarSearch) -> None:
        self._conclude(search.result(), search.n_points, search.is_by_fix, search.moved, search.cov)

    @property
    def grid(self) -> Grid:
        """The map's walls and free space."""
        return self.places.grid

    def map_points(self) -> Points2:
        """(M, 2) points of the map [m]."""
        return self.places.surfaces.means

    def _track(self, points: Points2) -> None:
        """Align with the map near the pose. Where that contradicts, the place stays a hypothesis beside the search until it is refuted."""
        likely, cov = self._align(points), self._cov
        place = likely or self.places.align(points, self.pose, cov)
        is_unmapped = place.on_walls + place.in_free < _KNOWN_SHARE and place.contradicting < _CONTRADICTING_SHARE
        self.is_outside = is_unmapped and (likely is None or is_narrow(cov))  # what a search finds likely is where the map has walls
        if likely is None:
            self._is_doubtful |= place.contradicting >= _CONTRADICTING_SHARE
        if likely is None or self.is_outside:
            return
        evidence = self._evidence(place, cov)
        if evidence < -_TRACK_GAIN:  # the odometry may be an outlier, as by slip in a turn
            wide = cov + prior_outlier_cov(cov)
            again = self.places.align(points, self.pose, wide)
            of_again = self._evidence(again, wide)
            if of_again >= _FITTING:
                place, cov, evidence = again, wide, of_again
        self._is_one_view &= evidence < _FITTING or self._recent.way_m < _INDEPENDENT_M
        self._is_doubtful = evidence < _FITTING or self._is_one_view
        self._track_odds = min(self._track_odds + evidence, log_odds(LIKELY) if self._is_one_view else _MAX_LOG_ODDS)
        self._is_tracking = self._track_odds > -_MAX_LOG_ODDS
        if self.state == "localized" and sigmoid(self._track_odds) < _LOST:
            self._lose(points)
        elif self.state == "lost" and sigmoid(self._track_odds) >= LIKELY:
            self.state = "localized"
        measured, R = _measurement(place)
        if not self._is_outlier(measured, cov + R):
            K = np.linalg.solve(cov + R, cov).T
            self.pose = se2.retract(self.pose, K @ se2.local(self.pose, measured))
            self._cov = np.asarray((np.eye(3) - K) @ cov @ (np.eye(3) - K).T + K @ R @ K.T)

    def _evidence(self, place: Place, cov: Cov3) -> float:
        """Log-odds that ``place`` adds to the one that is tracked, whose pose has covariance ``cov`` (3, 3)."""
        measured, R = _measurement(place)
        if self._is_outlier(measured, cov + R) or self._is_beyond_fix(place.pose):
            return -_TRACK_GAIN
        return _TRACK_GAIN * (place.on_walls - _CONTRADICTION * place.contradicting)

    def _is_beyond_fix(self, pose: Pose2) -> bool:
        """Whether a measured position contradicts ``pose`` (3,) of the map."""
        return self._fix is not None and self._fix.squared_mahalanobis(pose[:2], _SAME_COV[:2, :2]) > OUTLIER_SIGMAS**2

    def _is_outlier(self, measured: Pose2, cov: Cov3) -> bool:
        return mahalanobis(self.pose, measured, cov) > OUTLIER_SIGMAS**2

    def _align(self, points: Points2) -> Place | None:
        """Near the pose. Where that is wider than the basin of an alignment, the last scans are searched within 3 sigma, and None where
        that is not `LIKELY`: where much is unmapped, another place than the right one may have more on walls."""
        if is_narrow(self._cov):
            return self.places.align(points, self.pose, self._cov)
        joined = self._recent.joined(_JOINED_M, _TRACKED_SCANS)
        found = self.places.search(joined, self.pose, _three_sigma(self._cov))
        return found[0] if found and weigh(found, len(joined), NEAR_WEIGHTS, is_narrowed=True)[0].probability >= LIKELY else None

    def _reckon(self) -> None:
        """The pose is too wide to align scans: search about it, or everywhere where it is wider than that."""
        if self._is_tracking:
            self.hypotheses, self._search_odds = (), -MAX_SEARCH_ODDS
        self._is_tracking, self._is_reckoned = False, True
        is_near = np.trace(self._cov[:2, :2]) < _NEAR_M**2 and self._cov[2, 2] < _NEAR_RAD**2
        self.state = "searching" if is_near else "lost"

    def _lose(self, points: Points2) -> None:
        """The place was wrong, or the map is: search anywhere, by ``points`` (N, 2) and the scans from now on."""
        self.state, self._is_reckoned, self.hypotheses, self._search_odds = "lost", False, (), -MAX_SEARCH_ODDS
        self._failures = self._wait = 0
        self._recent.clear()
        self._recent.add(points)

    def _start_search(self) -> None:
        """Search the merged scans of the last keyframes."""
        self._wait -= 1
        if self._wait > 0:
            return
        self._failures += 1
        self._wait = 1 + min(self._failures // _PATIENCE, _MAX_WAIT)
        is_near = self._initial_left > 0 or (self._is_reckoned and self.state == "searching")
        near = (self.pose, _three_sigma(self._cov)) if is_near else self._near_fix()
        is_by_fix, self._is_whole_searched = near is not None and not is_near, near is None
        if self._initial_left:
            self._initial_left -= 1
            self._cov = self._cov if self._initial_left else np.zeros((3, 3))
        points, self._searched_m = self._recent.joined(_JOINED_M), self._recent.way_m
        if self._is_background:
            self._running = PlanarSearch(self.places, points, near, is_by_fix)
        else:
            self._conclude(self.places.search(points, *(near or ())), len(points), is_by_fix, np.zeros(3), np.zeros((3, 3)))

    def _near_fix(self) -> tuple[Pose2, FloatArray] | None:
        """Where a measured position has the robot: pose (3,), and half the window (3,) about it; None where it narrows nothing."""
        if self._fix is None or np.trace(self._fix.cov) > np.trace(self.places.extent_cov[:2, :2]):
            return None
        radius = 3.0 * math.sqrt(float(np.trace(self._fix.cov)))
        return np.array([*self._fix.position, 0.0]), np.array([radius, radius, math.pi])

    def _conclude(self, places: Sequence[Place], n_points: int, is_by_fix: bool, moved: Pose2, moved_cov: Cov3) -> None:
        """Take the best of ``places``, which ``n_points`` have found before the robot ``moved`` (3,), if it is probable and the search
        before agrees, or if nothing else in the map is like it: then the probability is at most `LIKELY` until scans from elsewhere fit."""
        before, since_cov = self.hypotheses, self._since_search
        self._since_search = moved_cov
        found = [replace(place, pose=se2.compose(place.pose, moved)) for place in weigh(places, n_points, self._weights, is_by_fix)]
        self.hypotheses = found if self._fix is None else with_fix(found, self._fix)
        self._search_odds = -MAX_SEARCH_ODDS
        if not found:
            return
        best = self.hypotheses[0]
        is_repeated = self._searched_m >= _INDEPENDENT_M and any(_agree(place.pose, best.pose, since_cov) for place in before)
        A = se2.adjoint(se2.inverse(moved))
        cov = np.asarray(A @ (best.cov + _BEND) @ A.T + moved_cov)
        is_fitting = self._is_fitting(best.pose, cov)
        is_confirmed = (is_repeated or self._is_reckoned_at(best.pose)) and is_fitting
        is_unmistakable = self._is_whole_searched and best.probability >= _ONE_VIEW and is_fitting
        probability = best.probability if is_confirmed else min(best.probability, LIKELY)
        self.hypotheses = [replace(best, probability=probability), *self.hypotheses[1:]]
        self._search_odds = log_odds(probability)
        if probability >= _PROMISING:
            self._failures = self._wait = 0
        if (is_confirmed or is_unmistakable) and probability >= LIKELY and is_narrow(best.cov):
            self._begin_tracking(best.pose, cov)
            self._is_doubtful = self._is_one_view = not is_confirmed

    def _is_fitting(self, pose: Pose2, cov: Cov3) -> bool:
        """Whether the last scan alone fits at ``pose`` (3,), with covariance ``cov`` (3, 3): the scans of a way may fit together where that
        of the present place does not. False without one."""
        if not len(self._recent):
            return False
        place = self.places.align(self._recent.joined(_JOINED_M, 1), pose, cov)
        known = min((place.on_walls + place.in_free) / _KNOWN_SHARE, 1.0)
        return _TRACK_GAIN * (place.on_walls - _CONTRADICTION * place.contradicting) >= _FITTING * known

    def _is_reckoned_at(self, pose: Pose2) -> bool:
        """Whether the odometry leads to ``pose`` (3,) from where the robot was tracked: nearly, where it is wide as after being carried."""
        if self.state == "searching":
            return self._is_reckoned and _agree(self.pose, pose, self._cov)
        off = se2.between(self.pose, pose)
        return self._is_reckoned and math.hypot(off[0], off[1]) < _STAYED_M and abs(off[2]) < _STAYED_RAD

    def _begin_tracking(self, pose: Pose2, cov: Cov3) -> None:
        """The robot is at ``pose`` (3,) with covariance ``cov`` (3, 3)."""
        self.pose, self._cov, self._track_odds = pose, np.asarray(cov), self._search_odds
        self._is_tracking, self._is_reckoned, self._is_doubtful, self.state = True, False, False, "localized"
        self.is_outside = False
        self._initial_left, self._failures, self._wait = 0, 0, 0


def _measurement(place: Place) -> tuple[Pose2, Cov3]:
    """Pose (3,) that the scan alone gives in the map, and its covariance (3, 3)."""
    measured = se2.retract(place.pose, -np.linalg.solve(place.fit.information + OPEN_INFORMATION, place.fit.gradient))
    return measured, place.measured_cov + _BEND


def _agree(earlier: Pose2, pose: Pose2, cov: Cov3) -> bool:
    """Whether ``pose`` (3,) is where the odometry leads to from an ``earlier`` one, with covariance ``cov`` (3, 3)."""
    return mahalanobis(earlier, pose, cov + _SAME_COV) < _PRIOR_SQUARE


def within(cov: Cov3) -> float:
    """Probability that a pose with ``cov`` (3, 3) is within `RIGHT_M` and `RIGHT_RAD`, its position equally uncertain on all sides."""
    variance, sigma = max(0.5 * float(np.trace(cov[:2, :2])), 1e-12), math.sqrt(max(float(cov[2, 2]), 1e-12))
    return (1.0 - math.exp(-0.5 * RIGHT_M**2 / variance)) * math.erf(RIGHT_RAD / (sigma * math.sqrt(2.0)))


def _is_trackable(cov: Cov3) -> bool:
    return bool(np.trace(cov[:2, :2]) < _TRACKED_M**2 and cov[2, 2] < _TRACKED_RAD**2)


def _three_sigma(cov: Cov3) -> FloatArray:
    """(3,) half the window of a search [m, m, rad], along any axes."""
    radius = math.sqrt(float(np.trace(cov[:2, :2])))
    return 3.0 * np.array([radius, radius, math.sqrt(cov[2, 2])])
