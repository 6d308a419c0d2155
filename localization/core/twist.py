"""Twist of the body at the end of a step, by the mean twist over it, the change of the wheels' rates in it, and the gyro."""

from __future__ import annotations

import numpy as np

from motion_models import se2
from motion_models.se2 import Cov3, Pose2, Tangent2, Twist2

SLIP_LASTS_S = 1.0
"""Noise of the wheels is that of slip that lasts, not of single steps: over a shorter step it is the twist's noise over this time."""
_IDENTITY = np.eye(3)
TWIST_FLOOR = np.diag([3e-3, 3e-3, 2e-3]) ** 2
"""Covariance added to every twist [m^2/s^2, m^2/s^2, rad^2/s^2]: a robot whose wheels stand rocks on its tyres by 1 mm/s and 1 mrad/s
(simulated)."""
CHANGE_SHARE = 0.5
"""Sigma of the change of the twist within a step, by wheel rates that are means over their own interval."""


def twist_at_end(mean: Twist2, cov: Cov3, change: Twist2, measured_over_s: float) -> tuple[Twist2, Cov3]:
    """Twist (3,) at the end of a step and its covariance (3, 3), by its ``mean`` and the ``cov`` of that.

    ``change`` (3,): of the wheels' twist from its mean over the step to its end. ``measured_over_s``: duration of a step that the wheels
    have measured alone [s]; infinite where a scan has.
    """
    share = min(measured_over_s / SLIP_LASTS_S, 1.0)
    return mean + change, share * cov + _IDENTITY * (CHANGE_SHARE * change) ** 2 + TWIST_FLOOR


def fuse_turn(twist: Tangent2, cov: Cov3, turn: float, variance: float) -> tuple[Tangent2, Cov3]:
    """``twist`` (3,), or a way along one, with ``cov`` (3, 3), updated by a measured turn (rate) and its variance."""
    gain = cov[:, 2] / (cov[2, 2] + variance)
    return twist + gain * (turn - twist[2]), cov - gain[:, None] * cov[2]


def mean_twist(delta: Pose2, cov: Cov3, duration: float) -> tuple[Twist2, Cov3]:
    """Twist (3,) that moves by ``delta`` (3,) in ``duration`` [s], and its covariance (3, 3) by that of ``delta``."""
    way = se2.log(delta)
    J = se2.right_jacobian_inverse(way) / duration
    return way / duration, J @ cov @ J.T
