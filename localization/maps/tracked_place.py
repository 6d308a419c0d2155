"""Whether the place that a robot is tracked at is the right one, by the scans since it was taken."""

from __future__ import annotations

from localization.maps.place_probability import LIKELY, log_odds, sigmoid, within
from motion_models.se2 import Cov3

FITTING = 1.0
"""Log-odds of a keyframe from which on it fits; one that does not contradicts the place, and a pose farther from the odometry's is taken
instead if that fits: nine of ten right places have more, the best of wrong ones 0."""
INDEPENDENT_M = 1.0
"""Way between the first and the last of the scans that are searched, from which on they are more than the same view again [m]."""
_MAX_LOG_ODDS = 8.0
"""Log-odds of a place that is tracked, at most: a few scans from elsewhere are enough to be lost."""


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
