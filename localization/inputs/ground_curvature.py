"""Curvature of the ground under a robot, by how its tilt changes along its way.

The height h(x, y) of smooth ground has the gradient g = (h_x, h_y), and the robot is tilted by it. Along a way s in the body's axes

    dg = H s,   H = [[h_xx, h_xy], [h_xy, h_yy]]                                        (Taylor)

so that a straight way measures the first column of H, and arcs all of it. H in the body's axes turns with the body, H' = R^T H R, and is
forgotten along the way: a Gauss-Markov process of first order. On ground that is twisted by h_xy, the four wheels are not in one plane: a
diagonal of them carries more (`twist`).
"""

from __future__ import annotations

import math

import numpy as np

from localization.small_filters import propagate_in_place, update_in_place
from motion_models.compiled import kernel
from motion_models.linear_equations import multiply
from motion_models.se2 import FloatArray, triple

_LENGTH_M = 3.0
"""Way over which slope and curvature of hills change: a quarter of waves of 12 m."""
_SIGMA = math.radians(6.0) / _LENGTH_M
"""Sigma of h_xx and h_yy where nothing is known [1/m]."""
_PRIOR = _SIGMA * _SIGMA / 3.0 * np.array([[3.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 3.0]])
"""Covariance of h_xx, h_xy, h_yy of a surface that has no direction of its own: the same in all axes [1/m^2]."""
_LASTING_M = 10.0 * _LENGTH_M
"""Way over which `GroundCurvature.root_mean_square` is taken: ten independent curvatures."""
_BUMPS = 2e-3
"""Random walk of the tilt by ground that is not smooth [rad/sqrt(m)]."""


class GroundCurvature:
    """`advance` along each step of the way."""

    def __init__(self) -> None:
        self._state, self._cov = np.zeros(3), _PRIOR.copy()
        self._weight, self._squares = 0.0, 0.0

    @property
    def twist(self) -> tuple[float, float]:
        """h_xy in the body's axes, and its sigma [1/m]."""
        return float(self._state[1]), math.sqrt(self._cov[1, 1])

    @property
    def root_mean_square(self) -> float:
        """Root mean square of h_xx over the last way [1/m]; 0 before there is one."""
        return math.sqrt(self._squares / self._weight) if self._weight > 0.0 else 0.0

    def advance(self, before: FloatArray, after: FloatArray, motion: tuple[float, float], variance: float) -> None:
        """Advance by a ``motion``: way ahead [m] and turn [rad] about the body's z axis.

        ``before`` and ``after`` (2,) are the ground's downhill slopes in the body's axes there (`motion_models.slope.Slope`), of whose
        change a gyro has an error of ``variance`` [rad^2].
        """
        _advance(self._state, self._cov, before, after, motion, variance)
        kept = math.exp(-abs(motion[0]) / _LASTING_M)
        self._weight = kept * self._weight + 1.0 - kept
        self._squares = kept * self._squares + (1.0 - kept) * float(self._state[0]) ** 2


@kernel
def _advance(
    state: FloatArray, cov: FloatArray, before: FloatArray, after: FloatArray, motion: tuple[float, float], variance: float
) -> None:
    """Propagate h_xx, h_xy, h_yy (3,) and their ``cov`` (3, 3), and update both by the change of the slope; see `GroundCurvature`."""
    way, turn = motion
    c, s = math.cos(turn), math.sin(turn)
    kept = math.exp(-abs(way) / _LENGTH_M)
    F = kept * np.array([[c * c, 2.0 * c * s, s * s], [-c * s, c * c - s * s, c * s], [s * s, -2.0 * c * s, c * c]])
    state[0], state[1], state[2] = multiply(F, triple(state))
    propagate_in_place(F, cov)
    for i in range(3):
        for j in range(3):
            cov[i, j] += (1.0 - kept * kept) * _PRIOR[i, j]
    # In the axes at the end: dg = H R^T (way, 0), and downhill is -g
    x, y = way * c, -way * s
    change = (c * before[0] + s * before[1] - after[0], c * before[1] - s * before[0] - after[1])
    rows, gain = np.array([[x, y, 0.0], [0.0, x, y]]), np.empty(3)
    for i in range(2):
        update_in_place(state, cov, rows[i], change[i], variance + _BUMPS * _BUMPS * abs(way), gain)
