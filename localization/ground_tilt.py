"""Tilt of the ground, apart from the error of the IMU's mount.

A mount that is off by a degree or two looks like a slope, but stays with the body, while a slope turns against it and changes with the way:
both are the states of a slow filter, whose measurement is their sum, the tilt by the attitude.
"""

from __future__ import annotations

import math

import numpy as np

from localization.small_filters import propagate_in_place, update_in_place
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

_LEVEL = math.tan(math.radians(3.0))
"""Tilt up to which the ground counts as level: a Husky outdoors is level within 1.8 deg, and mounts are known to a degree or two."""
_CERTAIN = 3.5
"""Sigmas at which the ground counts as tilted."""
_MOUNT_SIGMA, _GROUND_SIGMA = math.radians(1.2), math.radians(6.0)
"""Sigma of mounts in robot files, and of the slope of hills (median 5.8 deg, 95 % below 10.7)."""
_HILL_M = 5.0
"""Way over which a slope changes."""
_LASTING = 2.0
"""For how many windows errors of the vertical last."""


class GroundTilt:
    """`restart` with each first vertical, then `update` by each measured one."""

    def __init__(self) -> None:
        self._mean, self._cov = np.zeros(4), np.diag([_MOUNT_SIGMA**2] * 2 + [_GROUND_SIGMA**2] * 2)
        self.is_certain = False
        """Whether the ground has been found to tilt."""

    @property
    def mount_error(self) -> FloatArray:
        """(2,) downhill slope that stays with the body (`motion_models.slope.Slope.downhill`)."""
        return self._mean[:2]

    @property
    def mount_cov(self) -> FloatArray:
        """(2, 2) of the mount's error."""
        return self._cov[:2, :2]

    @property
    def ground(self) -> FloatArray:
        """(2,) downhill slope of the ground."""
        return self._mean[2:]

    @property
    def ground_cov(self) -> FloatArray:
        """(2, 2) of the ground's slope."""
        return self._cov[2:, 2:]

    def restart(self) -> None:
        """The ground is another one: nothing is known of its tilt."""
        self._cov[2:] = self._cov[:, 2:] = 0.0
        self._cov[2, 2] = self._cov[3, 3] = _GROUND_SIGMA**2

    def update(self, downhill: FloatArray, cov: FloatArray, turn: float, way: float) -> None:
        """Update by the measured ``downhill`` slope (2,) of mount and ground together and its ``cov`` (2, 2), after ``turn`` [rad] and
        ``way`` [m]."""
        _separate(self._mean, self._cov, downhill, cov, turn, way)
        if not self.is_certain and np.hypot(*self.ground) > _LEVEL:
            self.is_certain = bool(self.ground @ np.linalg.solve(self.ground_cov, self.ground) > _CERTAIN**2)


@kernel
def _separate(mean: FloatArray, cov: FloatArray, downhill: FloatArray, own: FloatArray, turn: float, way: float) -> None:
    """See `GroundTilt.update`: ``mean`` (4,) and ``cov`` (4, 4) change in place; ``own`` (2, 2) is the measurement's."""
    c, s = math.cos(turn), math.sin(turn)
    fade = math.exp(-way / _HILL_M)
    move = np.eye(4)
    move[2, 2], move[2, 3], move[3, 2], move[3, 3] = fade * c, fade * s, -fade * s, fade * c
    before = mean.copy()
    mean[2] = move[2, 2] * before[2] + move[2, 3] * before[3]
    mean[3] = move[3, 2] * before[2] + move[3, 3] * before[3]
    propagate_in_place(move, cov)
    new = _GROUND_SIGMA * _GROUND_SIGMA * (1.0 - fade * fade)
    cov[2, 2] += new
    cov[3, 3] += new
    found, gain = np.zeros(4), np.empty(4)
    for axis in range(2):
        row = np.array([1.0 - axis, axis, 1.0 - axis, axis])
        variance = _LASTING * own[axis, axis]
        update_in_place(found, cov, row, downhill[axis] - mean[axis] - mean[2 + axis], variance, gain)
    for i in range(4):
        mean[i] += found[i]
