"""Probability of the places that a search has found: logistic regression on how the best one fits, shared among those that fit as well.

A place that the next search finds again is confirmed, and one that is tracked is by the scans since it was taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.lidar.registration import mahalanobis
from localization.maps.place_search import Place
from localization.maps.position_plane import PositionFix
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2

LIKELY = 0.9
"""Probability from which on the robot is localized."""
RIGHT_M = 0.5
"""Distance up to which a pose is the right place [m]: half a door."""
RIGHT_RAD = 0.2
"""Angle up to which a pose is the right place [rad]: the scan still overlaps."""
MAX_SEARCH_ODDS = 5.0
"""Log-odds of a search, at most."""
_PRIOR_SQUARE = 9.0
"""A search agrees with an earlier place within 3 sigma of the odometry since, and of `SAME_COV`."""
SAME_COV = np.diag([0.1, 0.1, 0.033]) ** 2
"""Covariance of a searched pose against another of the same place [m^2, m^2, rad^2]."""
FITTING = 1.0
"""Log-odds of a keyframe from which on it fits; one that does not contradicts the place, and a pose farther from the odometry's is taken
instead if that fits: nine of ten right places have more, the best of wrong ones 0."""
INDEPENDENT_M = 1.0
"""Way between the first and the last of the scans that are searched, from which on they are more than the same view again [m]."""
_MAX_LOG_ODDS = 8.0
"""Log-odds of a place that is tracked, at most: a few scans from elsewhere are enough to be lost."""
_RIVALRY = 20.0
"""Decay of a place's probability with its score, exp(-20 (best - score)): 0.11 below the best it is one tenth as probable."""
_MAX_MARGIN, _POINTS = 0.5, 200.0
_MAX_NEAR_MARGIN = 0.3
"""Margin over the next place, at most, of a search that is narrowed: its window leaves out rivals."""


@dataclass(frozen=True, eq=False)
class PlaceHypothesis:
    """A place where the robot may be."""

    pose: Pose2
    """(3,) ``map_T_body`` at the last keyframe [m, m, rad]."""
    probability: float
    cov: Cov3
    """(3, 3) of the pose if the place is the right one, by the alignment of the scans."""


class Weights(NamedTuple):
    """Log-odds that the best place of a search is the right one are their products with `features`."""

    on_walls: float
    in_free: float
    margin: float
    points: float
    offset: float


SEARCH_WEIGHTS = Weights(4.5, -11.7, 13.8, 1.7, -5.2)
"""Logistic regression of 772 searches in halves of fr079, MIT-CSAIL and ACES: 357 after the robot was carried, 147 from random starts, 268
in the map of another building, with the whole score as margin of a place that is alone. With the margin over what was left out, 32 of 842
other searches have more than 0.9, all right. Weights fitted to these give more, and five keyframes of ACES after a cut were wrong."""
NEAR_WEIGHTS = Weights(17.3, -5.3, 3.2, 4.2, -5.0)
"""Weights of searches of the last 2 m within 3 sigma of a pose that is tracked, where the best place is right within 0.15 m and 0.05 rad:
597 searches in halves of fr079 and ACES. Of 336 in MIT-CSAIL, 296 of the 297 above 0.9 are right (Brier score 0.022)."""


def features(places: Sequence[Place], n_points: int, is_whole: bool = True, most_margin: float = _MAX_MARGIN) -> FloatArray:
    """(5,) of the best of ``places``, one at least: shares on walls and in free space, margin over the next place (at most
    ``most_margin``), log(``n_points`` / 200), 1. Where one place is alone in the whole map, the next one is what the search may have left
    out; a window (not ``is_whole``) has none."""
    best = places[0]
    next_score = places[1].score if len(places) > 1 else best.left_out_score if is_whole else 0.0
    margin = min(best.score - next_score, most_margin)
    return np.array([best.on_walls, best.in_free, margin, math.log(n_points / _POINTS), 1.0])


def weigh(
    places: Sequence[Place], n_points: int, weights: Weights = SEARCH_WEIGHTS, is_whole: bool = True, is_narrowed: bool = False
) -> list[PlaceHypothesis]:
    """``places`` with their probabilities; that of the best by regression, those of others by their scores. ``is_whole``: the whole map
    was searched. ``is_narrowed``: rivals are left out, and no odometry from a known place leads to what was found."""
    if not places:
        return []
    best, most_margin = places[0], _MAX_NEAR_MARGIN if is_narrowed else _MAX_MARGIN
    odds = float(features(places, n_points, is_whole, most_margin) @ weights)
    rivals = np.exp([-_RIVALRY * (best.score - place.score) for place in places[1:]])
    share = 1.0 / (1.0 + rivals.sum())  # places that fit equally are equally probable
    probability = min(sigmoid(min(max(odds, -MAX_SEARCH_ODDS), MAX_SEARCH_ODDS)), share)
    every = np.r_[probability, probability * rivals]
    return [PlaceHypothesis(place.pose, float(p), place.measured_cov) for place, p in zip(places, every, strict=True)]


def with_fix(found: Sequence[PlaceHypothesis], fix: PositionFix) -> list[PlaceHypothesis]:
    """``found`` near a measured position, by Bayes: probabilities times the density of ``fix`` at each place. That none of them is right
    has the mean density over the window of 3 sigma that was searched."""
    densities = np.exp([-0.5 * fix.squared_mahalanobis(place.pose[:2], np.zeros((2, 2))) for place in found])
    elsewhere = 2.0 * math.pi * math.sqrt(float(np.linalg.det(fix.cov))) / (36.0 * float(np.trace(fix.cov)))
    products = densities * [place.probability for place in found]
    total = products.sum() + elsewhere * (1.0 - sum(place.probability for place in found))
    order = np.argsort(-products, kind="stable")
    highest = sigmoid(MAX_SEARCH_ODDS)
    return [replace(found[i], probability=min(float(products[i] / total), highest)) for i in order]


def sigmoid(log_odds: float) -> float:
    """Probability of ``log_odds``."""
    return 1.0 / (1.0 + math.exp(-log_odds))


def log_odds(probability: float) -> float:
    """Inverse of `sigmoid`."""
    return math.log(probability / (1.0 - probability))


def within(cov: Cov3) -> float:
    """Probability that a pose with ``cov`` (3, 3) is within `RIGHT_M` and `RIGHT_RAD`, its position equally uncertain on all sides."""
    variance, sigma = max(0.5 * float(np.trace(cov[:2, :2])), 1e-12), math.sqrt(max(float(cov[2, 2]), 1e-12))
    return (1.0 - math.exp(-0.5 * RIGHT_M**2 / variance)) * math.erf(RIGHT_RAD / (sigma * math.sqrt(2.0)))


class FoundPlaces:
    """`move` by each motion of the robot since the scans that were searched."""

    def __init__(self, places: Sequence[PlaceHypothesis] = (), log_odds: float = -MAX_SEARCH_ODDS, moved_cov: Cov3 | None = None) -> None:
        """``places`` at the last keyframe, the most probable first, which is the right one by ``log_odds``. ``moved_cov`` (3, 3): of the
        motion since the scans, by default none."""
        self.places, self.log_odds = places, log_odds
        self._moved_cov = np.zeros((3, 3)) if moved_cov is None else moved_cov

    @property
    def probability(self) -> float:
        """That the first of the places is the right one."""
        return sigmoid(self.log_odds)

    def move(self, delta: Pose2, cov: Cov3) -> None:
        """The robot has moved by ``delta`` (3,) with covariance ``cov`` (3, 3)."""
        A = se2.adjoint(se2.inverse(delta))
        self._moved_cov = A @ self._moved_cov @ A.T + cov
        self.places = [replace(place, pose=se2.compose(place.pose, delta)) for place in self.places]

    def has(self, pose: Pose2) -> bool:
        """Whether ``pose`` (3,), where the robot is now, is at one of the places."""
        return any(agree(place.pose, pose, self._moved_cov) for place in self.places)


def agree(earlier: Pose2, pose: Pose2, cov: Cov3) -> bool:
    """Whether ``pose`` (3,) is where the odometry leads to from an ``earlier`` one, with covariance ``cov`` (3, 3)."""
    return mahalanobis(earlier, pose, cov + SAME_COV) < _PRIOR_SQUARE


class TrackedPlace:
    """`add` the evidence of each scan. A place that was taken by one view has a probability of `LIKELY` at most until scans from elsewhere
    fit as well."""

    def __init__(self, log_odds: float, is_one_view: bool) -> None:
        """``log_odds``: of the search that found the place."""
        self._log_odds, self._is_one_view = log_odds, is_one_view
        self._is_bounded = is_one_view  # by `LIKELY`: one view, or the last scan does not fit, as after the robot was carried unnoticed

    def add(self, evidence: float, way_m: float) -> None:
        """A scan adds the log-odds ``evidence``, after ``way_m`` [m] with scans."""
        self._is_one_view &= evidence < FITTING or way_m < INDEPENDENT_M
        self._is_bounded = evidence < FITTING or self._is_one_view
        self._log_odds = min(self._log_odds + evidence, log_odds(LIKELY) if self._is_one_view else _MAX_LOG_ODDS)

    def contradict(self) -> None:
        """The last scan contradicts, and gives no pose."""
        self._is_bounded = True

    @property
    def probability(self) -> float:
        """That the place is the right one."""
        return sigmoid(self._log_odds)

    @property
    def is_refuted(self) -> bool:
        """Whether no scan is to be compared with it any more."""
        return self._log_odds <= -_MAX_LOG_ODDS

    def probability_within(self, cov: Cov3) -> float:
        """That the robot is at the place, and its pose, with covariance ``cov`` (3, 3), right as by `within`."""
        probability = self.probability * within(cov)
        return min(probability, LIKELY) if self._is_bounded else probability
