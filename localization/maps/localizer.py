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
from localization.lidar.registration import OUTLIER_SIGMAS, is_narrow
from localization.lidar.scan_matcher import MIN_POINTS, OPEN_INFORMATION
from localization.maps.background_search import BackgroundSearcher, PlanarSearch
from localization.maps.grid import Grid
from localization.maps.place_probability import (
    FITTING,
    INDEPENDENT_M,
    LIKELY,
    NEAR_WEIGHTS,
    FoundPlaces,
    PlaceHypothesis,
    TrackedPlace,
    agree,
    log_odds,
    weigh,
    with_fix,
)
from localization.maps.place_search import CELL_M, Place, PlaceMap
from localization.maps.position_plane import PositionFix
from localization.maps.recent_scans import RecentMotion, RecentScans
from localization.maps.search_area import SearchArea, around
from localization.maps.uncertain_pose import UncertainPose
from motion_models import se2
from motion_models.se2 import Cov3, Points2, Pose2

State = Literal["searching", "localized", "lost"]

_LOST = 0.5
"""Probability of a tracked place below which the robot is lost."""
_BEND = np.diag([0.02, 0.02, 0.005]) ** 2
"""Covariance of a map's surfaces against its nearest keyframe, as for loop closures [m^2, m^2, rad^2]."""
_TRACK_GAIN, _CONTRADICTION = 3.0, 5.0
"""Log-odds of a keyframe that is tracked: the first times (share on walls - the second times share in free space). Right places have 0.86
and 0.04 in the median, 0.69 and 0.13 at the ends of 90 %; the best of wrong ones 0.6 and 0.12."""
_KNOWN_SHARE, _CONTRADICTING_SHARE = 0.5, 0.1
"""Share of points in mapped space, below which a scan is no evidence for or against the place, unless the second share contradicts: of 375
scans at right poses outside of the maps (halves of three logs), none has more than 0.085."""
_PROMISING = 0.3
"""Probability of a place, from which on the search was not in vain: in maps of other buildings one keyframe of 72 has more."""
_TRACKED_M, _TRACKED_RAD = 0.5, 0.3
"""Sigma of a pose that is tracked, at most, through places that the map does not have."""
_NEAR_M, _NEAR_RAD = 3.0, 0.8
"""Sigma of a pose by odometry alone since it was tracked, up to which it is searched about that: 3 sigma are a building."""
_TRACKED_SCANS = 4
"""Scans that are searched near a tracked pose: 2 m of way, so that those of space that is not mapped are soon behind."""
_JOINED_M = 0.8 * CELL_M
"""Voxel of joined scans [m]."""
_STAYED_M, _STAYED_RAD = 1.0, 0.8
"""A place this near to where the odometry leads confirms it, however wide that is: in a building of 20 m it is there by chance once in
a thousand times."""
_ONE_VIEW = 0.95
"""Probability from which on one view of a place is enough to track it, in a search of the whole map: of 842 searches in three logs and maps
of other buildings 21 have more, all right, and of the wrong ones none more than 0.89."""
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
    ) -> None:
        """``initial`` (3,): about where the robot is in the map, with covariance ``initial_cov`` (3, 3). With ``is_background``, searches
        run beside the estimates, and `advance` takes their results when they are due; else `add` returns with them."""
        super().__init__(is_background)
        self.places = place_map
        self.state: State = "searching"
        self._at, self._area = UncertainPose(place_map.centre, np.zeros((3, 3))), SearchArea()
        self._tracked: TrackedPlace | None = None
        self._recent, self._found = RecentScans(place_map.range_noise_m), FoundPlaces()
        self.is_outside = False
        """Whether most of the last scan is where the map has nothing: the tracked pose is by odometry meanwhile."""
        if initial is not None:
            self.set_pose(initial, initial_cov)

    def set_pose(self, pose: Pose2, cov: Cov3 = INITIAL_COV) -> None:
        """Search near ``pose`` (3,) with covariance ``cov`` (3, 3), as a person gives it."""
        self.state, self._tracked, self._at = "searching", None, UncertainPose(np.asarray(pose, dtype=float), cov)
        self._area.give()
        self._found = FoundPlaces(log_odds=0.0)
        self._pacing.restart()
        self._recent.clear()
        self._running = None

    def add_position(self, fix: PositionFix) -> None:
        """The robot was at ``fix`` at the last keyframe, as by GNSS: it narrows the search, and a place that contradicts it is left."""
        self._area.fix = fix

    def search_everywhere(self) -> None:
        """Forget the place, and search the whole map by the scans from now on."""
        self.set_pose(self.places.centre, np.zeros((3, 3)))
        self._area.open()
        self._found = FoundPlaces()

    @property
    def pose(self) -> Pose2:
        """(3,) ``map_T_body``."""
        return self._at.pose

    @property
    def hypotheses(self) -> Sequence[PlaceHypothesis]:
        """Places that a search found, the most probable first."""
        return self._found.places

    @property
    def probability(self) -> float:
        """That the robot is within 0.5 m and 0.2 rad of `pose`; while it is searched, that it is at the first of `hypotheses`."""
        return self.probability_after(np.zeros(3), np.zeros((3, 3)))

    def probability_after(self, delta: Pose2, cov: Cov3) -> float:
        """`probability` when the robot has moved by ``delta`` (3,) with covariance ``cov`` (3, 3) since the last keyframe."""
        if self._tracked is None or self.state != "localized":
            return self._found.probability
        return self._tracked.probability_within(self._at.move(delta, cov).cov)

    @property
    def covariance(self) -> Cov3:
        """(3, 3) of the right perturbation of `pose`, with the map's own; of a place that is not known, with the extent of the map."""
        if self.state == "localized" or (self.state == "searching" and self._area.is_reckoned):
            return np.asarray(self._at.cov + self.places.mapped.cov_at(self.pose))
        return self._at.cov if self._area.is_given else np.asarray(self._at.cov + self.places.extent_cov)

    def add(self, points: Points2, delta: Pose2, cov: Cov3) -> None:
        """A keyframe with the scan ``points`` (N, 2) of the body frame [m]: moved by ``delta`` (3,) with covariance ``cov`` (3, 3) since
        the one before."""
        delta, cov = self._recent.move(RecentMotion(delta, cov), points)
        if not is_narrow(cov):  # carried, or driven blind: scans before and after do not belong together
            self._running, self._found = None, FoundPlaces(log_odds=self._found.log_odds)
            self._pacing.restart()
        self._at = self._at.move(delta, cov)
        self._found.move(delta, cov)
        self._area.move(delta)
        if self._running is not None:
            self._running.move(delta, cov)
        if len(points) < MIN_POINTS:
            if self._tracked is not None and not _is_trackable(self._at.cov):
                self._reckon()
            return
        self._recent.add(points)
        if self._tracked is not None and _is_trackable(self._at.cov):
            self._track(self._tracked, points)
        elif self._tracked is not None or self._area.is_reckoned:
            self._reckon()
        if self.state == "localized":
            self._running = None
        elif self._is_search_due():
            self._start_search()

    @property
    def grid(self) -> Grid:
        """The map's walls and free space."""
        return self.places.grid

    def map_points(self) -> Points2:
        """(M, 2) points of the map [m]."""
        return self.places.surfaces.means

    def _track(self, tracked: TrackedPlace, points: Points2) -> None:
        """Align with the map near the pose. Where that contradicts, the place stays a hypothesis beside the search until it is refuted."""
        likely, at = self._align(points), self._at
        place = likely or self.places.align(points, at.pose, at.cov)
        is_unmapped = place.on_walls + place.in_free < _KNOWN_SHARE and place.contradicting < _CONTRADICTING_SHARE
        self.is_outside = is_unmapped and (likely is None or is_narrow(at.cov))  # what a search finds likely is where the map has walls
        if likely is None and place.contradicting >= _CONTRADICTING_SHARE:
            tracked.contradict()
        if likely is None or self.is_outside:
            return
        evidence = self._evidence(place, at)
        if evidence < -_TRACK_GAIN:  # the odometry may be an outlier, as by slip in a turn
            wide = replace(at, cov=at.cov + prior_outlier_cov(at.cov))
            again = self.places.align(points, wide.pose, wide.cov)
            of_again = self._evidence(again, wide)
            if of_again >= FITTING:
                place, at, evidence = again, wide, of_again
        tracked.add(evidence, self._recent.way_m)
        self._tracked = None if tracked.is_refuted else tracked
        if self.state == "localized" and tracked.probability < _LOST:
            self._lose()
        elif self.state == "lost" and tracked.probability >= LIKELY:
            self.state = "localized"
        measured, R = _measurement(place)
        if not _is_outlier(at, measured, R):
            self._at = at.update(measured, R)

    def _evidence(self, place: Place, at: UncertainPose) -> float:
        """Log-odds that ``place`` adds to the one that is tracked, whose pose is ``at``."""
        if _is_outlier(at, *_measurement(place)) or self._area.contradicts(place.pose):
            return -_TRACK_GAIN
        return _TRACK_GAIN * (place.on_walls - _CONTRADICTION * place.contradicting)

    def _align(self, points: Points2) -> Place | None:
        """Near the pose. Where that is wider than the basin of an alignment, the last scans are searched within 3 sigma, and None where
        that is not `LIKELY`: where much is unmapped, another place than the right one may have more on walls."""
        if is_narrow(self._at.cov):
            return self.places.align(points, self._at.pose, self._at.cov)
        joined = self._recent.joined(_JOINED_M, _TRACKED_SCANS)
        found = self.places.search(joined, *around(self._at))
        return found[0] if found and weigh(found, len(joined), NEAR_WEIGHTS, False, is_narrowed=True)[0].probability >= LIKELY else None

    def _reckon(self) -> None:
        """The pose is too wide to align scans: search about it, or everywhere where it is wider than that."""
        if self._tracked is not None:
            self._found = FoundPlaces()
        self._tracked, self._area.is_reckoned = None, True
        self.state = "searching" if _is_within(self._at.cov, _NEAR_M, _NEAR_RAD) else "lost"

    def _lose(self) -> None:
        """The place was wrong, or the map is: search anywhere, by the last scan and those from now on."""
        self.state, self._area.is_reckoned, self._found = "lost", False, FoundPlaces()
        self._pacing.restart()
        self._recent.keep_last()

    def _start_search(self) -> None:
        """Search the merged scans of the last keyframes."""
        is_near = self._area.is_given or (self._area.is_reckoned and self.state == "searching")
        near = around(self._at) if is_near else self._area.around_fix(self.places.extent_cov)
        if self._area.take_given():
            self._at = replace(self._at, cov=np.zeros((3, 3)))
        is_by_fix = near is not None and not is_near
        self._start(PlanarSearch(self.places, self._recent.joined(_JOINED_M), near, is_by_fix, self._recent.way_m))

    def _take(self, search: PlanarSearch) -> None:
        """Take the best place of ``search`` if it is probable and the search before agrees, or if nothing else in the map is like it: then
        the probability is at most `LIKELY` until scans from elsewhere fit."""
        before, since = self._found, search.since
        weighed = weigh(search.result(), search.n_points, is_whole=search.is_whole, is_narrowed=search.is_by_fix)
        places = [replace(place, pose=se2.compose(place.pose, since.pose)) for place in weighed]
        if not places:
            self._found = FoundPlaces()
            return
        best, *others = places if self._area.fix is None else with_fix(places, self._area.fix)
        cov = UncertainPose(best.pose, best.cov + _BEND).move(since.pose, since.cov).cov
        is_repeated = search.way_m >= INDEPENDENT_M and before.has(best.pose)
        is_fitting = self._is_fitting(best.pose, cov)
        is_confirmed = (is_repeated or self._is_reckoned_at(best.pose)) and is_fitting
        is_unmistakable = search.is_whole and best.probability >= _ONE_VIEW and is_fitting
        probability = best.probability if is_confirmed else min(best.probability, LIKELY)
        self._found = FoundPlaces([replace(best, probability=probability), *others], log_odds(probability), since.cov)
        if probability >= _PROMISING:
            self._pacing.restart()
        if (is_confirmed or is_unmistakable) and probability >= LIKELY and is_narrow(best.cov):
            self._begin_tracking(best.pose, cov, not is_confirmed)

    def _is_fitting(self, pose: Pose2, cov: Cov3) -> bool:
        """Whether the last scan alone fits at ``pose`` (3,), with covariance ``cov`` (3, 3): the scans of a way may fit together where that
        of the present place does not. False without one."""
        if not len(self._recent):
            return False
        place = self.places.align(self._recent.joined(_JOINED_M, 1), pose, cov)
        known = min((place.on_walls + place.in_free) / _KNOWN_SHARE, 1.0)
        return _TRACK_GAIN * (place.on_walls - _CONTRADICTION * place.contradicting) >= FITTING * known

    def _is_reckoned_at(self, pose: Pose2) -> bool:
        """Whether the odometry leads to ``pose`` (3,) from where the robot was tracked: nearly, where it is wide as after being carried."""
        if self.state == "searching":
            return self._area.is_reckoned and agree(self.pose, pose, self._at.cov)
        off = se2.between(self.pose, pose)
        return self._area.is_reckoned and math.hypot(off[0], off[1]) < _STAYED_M and abs(off[2]) < _STAYED_RAD

    def _begin_tracking(self, pose: Pose2, cov: Cov3, is_one_view: bool) -> None:
        """The robot is at ``pose`` (3,) with covariance ``cov`` (3, 3), the first of the places that were found."""
        self.state, self._at = "localized", UncertainPose(pose, cov)
        self._tracked = TrackedPlace(self._found.log_odds, is_one_view)
        self.is_outside = False
        self._area.open()
        self._pacing.restart()


def _measurement(place: Place) -> tuple[Pose2, Cov3]:
    """Pose (3,) that the scan alone gives in the map, and its covariance (3, 3)."""
    measured = se2.retract(place.pose, -np.linalg.solve(place.fit.information + OPEN_INFORMATION, place.fit.gradient))
    return measured, place.measured_cov + _BEND


def _is_outlier(at: UncertainPose, measured: Pose2, R: Cov3) -> bool:
    return at.squared_distance(measured, R) > OUTLIER_SIGMAS**2


def _is_trackable(cov: Cov3) -> bool:
    return _is_within(cov, _TRACKED_M, _TRACKED_RAD)


def _is_within(cov: Cov3, sigma_m: float, sigma_rad: float) -> bool:
    """Whether a pose with ``cov`` (3, 3) has at most these sigmas of position and heading."""
    return bool(np.trace(cov[:2, :2]) < sigma_m**2 and cov[2, 2] < sigma_rad**2)
