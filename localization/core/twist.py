"""Twist of the body at the end of a step, by the mean twist over it, the change of the wheels' rates in it, and the gyro.

Slip is a first-order Gauss-Markov process: with the density q that the wheels' noise model has over long times and the time constant tau,
its rate has the variance q / (2 tau) at any instant.
"""

from __future__ import annotations

import math

import numpy as np

from localization.core.state import clip_eigenvalues
from motion_models import se2
from motion_models.se2 import Cov3, Pose2, Tangent2, Twist2

SLIP_LASTS_S = 1.0
"""Twice the time constant tau of slip: wheels pass from one patch of floor to the next in .5 s. Over a step that is shorter than this, the
twist's noise is that over this time."""
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


def slip_change_cov(slip: Cov3, duration: float) -> Cov3:
    """Covariance (3, 3) of the change of slip from its mean over a step to its end [m^2/s^2, m^2/s^2, rad^2/s^2].

    A scan measures the mean over the step; of a Gauss-Markov process with variance s^2 and a = duration / tau,

        var(end - mean) = s^2 [1 + 2 (a - 1 + exp(-a)) / a^2 - 2 (1 - exp(-a)) / a].

    ``slip`` (3, 3): covariance of the motion in the step by slip, q duration, with ``duration`` [s].
    """
    a = 2.0 * duration / SLIP_LASTS_S
    decay = -math.expm1(-a)
    factor = 1.0 + 2.0 * (a - decay) / a**2 - 2.0 * decay / a
    return np.asarray(factor * slip / (duration * SLIP_LASTS_S))


def wheel_twist_cov(cov: Cov3, slip: Cov3, duration: float) -> Cov3:
    """Covariance (3, 3) of the mean twist by the wheels, for `twist_at_end` with a step that is measured for good: of ``cov`` (3, 3), what
    is by ``slip`` (3, 3) of the motion is that of `SLIP_LASTS_S`, and what is by calibration stays."""
    of_step = slip / duration**2
    return clip_eigenvalues(cov - of_step) + min(duration / SLIP_LASTS_S, 1.0) * of_step


def fuse_turn(twist: Tangent2, cov: Cov3, turn: float, variance: float, of_clock: Cov3) -> tuple[Tangent2, Cov3]:
    """``twist`` (3,) with ``cov`` (3, 3), updated by a measured turn rate and its variance.

    Of ``cov``, ``of_clock`` (3, 3) is by the offset of the wheels' clock. A turn rate is no measurement of velocities by way of that: where
    wheels accelerate, a gyro with a bias would change the speed by all that the clock leaves open. The gain of the velocities is without
    it (Schmidt 1966), and the covariance is by that gain (Joseph form).
    """
    K = np.append(cov[:2, 2] - of_clock[:2, 2], cov[2, 2]) / (cov[2, 2] + variance)
    I_KH = np.eye(3) - np.outer(K, [0.0, 0.0, 1.0])
    return twist + K * (turn - twist[2]), I_KH @ cov @ I_KH.T + variance * np.outer(K, K)


def mean_twist(delta: Pose2, cov: Cov3, duration: float) -> tuple[Twist2, Cov3]:
    """Twist (3,) that moves by ``delta`` (3,) in ``duration`` [s], and its covariance (3, 3) by that of ``delta``."""
    way = se2.log(delta)
    J = se2.right_jacobian_inverse(way) / duration
    return way / duration, J @ cov @ J.T
