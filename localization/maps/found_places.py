"""Places that a search of the map has found, moved with the robot: the next search confirms the one that it finds again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from localization.lidar.registration import mahalanobis
from localization.maps.place_probability import MAX_SEARCH_ODDS, PlaceHypothesis, sigmoid
from motion_models import se2
from motion_models.se2 import Cov3, Pose2

_PRIOR_SQUARE = 9.0
"""A search agrees with an earlier place within 3 sigma of the odometry since, and of `SAME_COV`."""
SAME_COV = np.diag([0.1, 0.1, 0.033]) ** 2
"""Covariance of a searched pose against another of the same place [m^2, m^2, rad^2]."""


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
