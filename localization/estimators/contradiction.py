"""Two motions that contradict each other: wheels and LiDAR cannot both be right, and which is wrong is known with some probability only.

The estimate is then that of a mixture of both cases: its mean lies between them, and its covariance is as wide as they are apart
(Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, sec. 1.4). So no threshold decides between
two places that are far from each other, and the next scan that says the same finds an estimate that is open for it.
"""

from __future__ import annotations

import numpy as np

from motion_models.se2 import FloatArray

_SURE = 3.0  # times the gate: beyond this, they cannot both be right
_LOST = 0.9999  # it keeps numbers finite


def admit_doubt(
    error: FloatArray, nis: float, gate: float, trust: float, innovation_cov: FloatArray, seen_cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What is added to the covariance (3, 3) of the wheels' motion, and the covariance (3, 3) to be taken for the LiDAR's.

    The motions are ``error`` (3,) apart, with ``innovation_cov`` (3, 3) if both are right, normalised and squared ``nis``, more than the
    ``gate``; with the probability ``trust`` the LiDAR's is right, whose covariance was said to be ``seen_cov`` (3, 3).

    Covariances of ``trust`` and 1 - ``trust`` times the error's square let an update go that part of the way, and leave the mixture's
    variance, trust (1 - trust) error^2. Along other directions, too, the LiDAR counts by ``trust``: that is what an innovation's
    covariance of 1 / ``trust`` does. All of it sets in gradually beyond the gate: there is no edge.
    """
    beyond = min((nis / gate - 1.0) / (_SURE - 1.0), 1.0)
    contradiction = beyond * beyond * (3.0 - 2.0 * beyond)
    is_lost = min(contradiction * (1.0 - trust), _LOST)
    apart = np.outer(error, error)
    return contradiction * trust * apart, seen_cov + is_lost * (innovation_cov / (1.0 - is_lost) + apart)
