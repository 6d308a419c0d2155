"""Probability of the places that a search has found: logistic regression on how the best one fits, shared among those that fit as well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.maps.place_search import Place
from localization.maps.position_plane import PositionFix
from motion_models.se2 import Cov3, FloatArray, Pose2

LIKELY = 0.9
"""Probability from which on the robot is localized."""
RIGHT_M, RIGHT_RAD = 0.5, 0.2
"""How near a pose is the right place [m, rad]: half a door, and a scan that still overlaps."""
MAX_SEARCH_ODDS = 5.0
"""Log-odds of a search, at most."""
_RIVALRY = 20.0
"""Decay of a place's probability with its score, exp(-20 (best - score)): 0.11 below the best it is one tenth as probable."""
_MAX_MARGIN, _POINTS = 0.3, 200.0
"""Margin over the next place, at most: with 0.5 one view of 112 points had 0.99 at a wrong place of ACES, by a margin of 0.36."""


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


SEARCH_WEIGHTS = Weights(3.3, -19.4, 20.4, 1.5, -4.1)
"""Logistic regression of 842 searches in halves of fr079, MIT-CSAIL and ACES: 143 after the robot was carried, 350 from random starts,
229 in a map of fr079 of which a tenth of the walls was changed, 120 in maps of other buildings, none of which has more than 0.5. Of them
59 have more than 0.9, one of which is wrong, and 26 the `_ONE_VIEW` of the localizer, all right. With the other two logs' weights 64 have
more than 0.9, and seven are wrong: five are one room of fr079 in the changed map, with a fifth of the points in free space, of which the
others have no example."""
NEAR_WEIGHTS = Weights(17.3, -5.3, 3.2, 4.2, -5.0)
"""Weights of searches of the last 2 m within 3 sigma of a pose that is tracked, where the best place is right within 0.15 m and 0.05 rad:
597 searches in halves of fr079 and ACES. Of 336 in MIT-CSAIL, 296 of the 297 above 0.9 are right (Brier score 0.022)."""


def features(places: Sequence[Place], n_points: int, is_narrowed: bool = False) -> FloatArray:
    """(5,) of the best of ``places``, one at least: shares on walls and in free space, margin over the next place, log(``n_points`` / 200),
    1. Where a search of the whole map lists one place alone, the next one is what it may have left out; one that ``is_narrowed`` has none
    in its window."""
    best = places[0]
    next_score = places[1].score if len(places) > 1 else 0.0 if is_narrowed else best.left_out_score
    margin = best.score - next_score
    return np.array([best.on_walls, best.in_free, min(margin, _MAX_MARGIN), math.log(n_points / _POINTS), 1.0])


def weigh(places: Sequence[Place], n_points: int, weights: Weights = SEARCH_WEIGHTS, is_narrowed: bool = False) -> list[PlaceHypothesis]:
    """``places`` with their probabilities; that of the best by regression, those of others by their scores. ``is_narrowed``: the search
    was about a pose or a position, and left out rivals elsewhere."""
    if not places:
        return []
    best, odds = places[0], float(features(places, n_points, is_narrowed) @ weights)
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
