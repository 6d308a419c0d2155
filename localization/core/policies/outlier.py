"""A step in which the robot went elsewhere than predicted: its wheels slipped or counted wrongly, or it was moved by hand."""

from __future__ import annotations

import numpy as np

from localization.events import Step
from localization.lidar import LidarConfig, ScanMatch
from motion_models.se2 import Cov3

_MIN_OVERLAP = LidarConfig.search_below
"""Share of a scan's points on the submap, from which on it fits: below it the matcher searches another pose."""

NOTHING_MISSED: Cov3 = np.zeros((3, 3))


class PriorOutlier:
    """`apply` with each scan's match. Nothing is rejected: the prior is off by an independent error more, as wide as the search."""

    def __init__(self) -> None:
        self.count = 0
        """Matches for which the prior was an outlier."""
        self.has_scene_moved = False
        """The last scan of the robot at rest fitted elsewhere, or hardly: what the submap has there has moved."""

    def apply(self, step: Step, match: ScanMatch | None, moved_cov: Cov3 | None) -> tuple[ScanMatch | None, Cov3]:
        """``match`` if it is to be used, and the covariance (3, 3) of what the wheels missed in ``step`` besides their noise;
        ``moved_cov`` (3, 3) of a robot that was moved by hand, or None.

        The wheels of a robot at rest count nothing wrongly: a scan that fits elsewhere is no measurement of its pose.
        """
        is_outlier = match is not None and bool(match.outlier_cov.any())
        if step.rested_s:
            if match is not None:
                self.has_scene_moved = is_outlier or match.overlap < _MIN_OVERLAP
            return None if is_outlier else match, NOTHING_MISSED
        if is_outlier and match is not None:
            self.count += 1
            return match, match.outlier_cov
        return match, moved_cov if match is None and moved_cov is not None else NOTHING_MISSED
