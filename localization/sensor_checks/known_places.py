"""Places from before a fault: where a scan fits onto one, the pose is known again, whatever the fault has done to it meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.scan_motion import Profile, align_from
from motion_models import se2
from motion_models.se2 import Cov3, Pose2

_DISTANCE_M, _TURN_RAD = 1.0, 0.5
"""Motion from one place to the next."""
_MAX_PLACES = 200
"""The oldest but the first are dropped."""
_REACH_M, _REACH_RAD = 2.0, math.radians(60.0)
"""Farther from a place, too little of it is in the scan [m, rad]."""
_MIN_INLIERS = 0.7
"""Share of a scan's bearings that fit onto a place that shows the pose: more than half, which a wall alone has."""
_MARGIN_S = 1.0
"""Places of this time before the begin of a fault are left out [s]."""
_EVERY_S = 0.5
"""Time between two comparisons [s]."""


class _Place(NamedTuple):
    at_s: float
    pose: Pose2
    """(3,) by the estimate."""
    profile: Profile
    spread: Cov3
    """(3, 3) of the faults until then."""


class KnownPlaces:
    """Places are kept while no fault lasts; the first scan is one, as its pose is the origin by definition."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._inflation = faults, faults.inflation
        self._places: list[_Place] = []
        self._compared_s = -math.inf
        self._was_lasting, self._count = False, 0

    def update(self, profile_of: Callable[[], Profile | None], pose: Pose2) -> bool:
        """Keep a scan from the estimated ``pose`` (3,), or compare it; ``profile_of`` gives its profile.

        Returns whether a place has shown the pose: differences of sensors count from here on."""
        inflation, now_s = self._inflation, self._faults.now_s
        is_lasting = inflation.is_lasting
        if (is_lasting and not self._was_lasting) or inflation.carried.count > self._count:
            begin_s = self._faults.latest_s
            self._places = [p for i, p in enumerate(self._places) if not i or p.at_s < begin_s - _MARGIN_S]
        self._was_lasting, self._count = is_lasting, inflation.carried.count
        if not is_lasting:
            self._keep(profile_of, pose, now_s)
        if not inflation.is_inflating or now_s - self._compared_s < _EVERY_S:
            return False
        self._compared_s = now_s
        spread = self._find(profile_of, pose)
        if spread is None or np.trace(spread[:2, :2]) >= np.trace(inflation.total[:2, :2]):
            return False
        inflation.set_known(spread)
        return True

    def _keep(self, profile_of: Callable[[], Profile | None], pose: Pose2, now_s: float) -> None:
        if self._places:
            moved = se2.between(self._places[-1].pose, pose)
            if math.hypot(moved[0], moved[1]) < _DISTANCE_M and abs(moved[2]) < _TURN_RAD:
                return
        profile = profile_of()
        if profile is not None:
            self._places.append(_Place(now_s, pose, profile, self._inflation.carried.total))
            del self._places[1 : 1 + len(self._places) - _MAX_PLACES]

    def _find(self, profile_of: Callable[[], Profile | None], pose: Pose2) -> Cov3 | None:
        """Covariance (3, 3) that faults have left of ``pose`` (3,): that of a place within reach that the scan fits onto, and the distance
        of the estimate from the pose that it shows; None where there is none."""
        if not self._places:
            return None
        motions = se2.between(np.array([place.pose for place in self._places]), pose)
        is_near = (np.hypot(motions[:, 0], motions[:, 1]) < _REACH_M) & (np.abs(se2.wrap_angle(motions[:, 2])) < _REACH_RAD)
        if not is_near.any():
            return None
        best = min(np.flatnonzero(is_near).tolist(), key=lambda k: float(np.trace(self._places[k].spread[:2, :2])))
        profile = profile_of()
        motion = None if profile is None else align_from(self._places[best].profile, profile, motions[best], _MIN_INLIERS)
        if motion is None or not motion.has_translation:
            return None
        off, A = se2.local(motions[best], motion.delta), se2.adjoint(se2.inverse(motion.delta))
        return np.asarray(A @ self._places[best].spread @ A.T + np.outer(off, off))
