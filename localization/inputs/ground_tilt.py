"""Tilt of the ground, apart from the error of the IMU's mount.

A mount that is off looks like a slope, but stays with the body, while a slope turns against it and changes with the way: both are the
states of a slow filter, whose measurement is their sum, the tilt by the attitude. Mounts in robot files are right within a degree or two,
or the IMU sits askew and the file does not have it; and floors are level, while hills are not: a bank of four filters, whose measurements
decide between them (Bar-Shalom, Li and Kirubarajan 2001, sec. 11.6, the static multiple-model estimator).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from localization.small_filters import propagate_in_place, update_in_place
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

_LEVEL = math.tan(math.radians(3.0))
"""Tilt up to which the ground counts as level: a Husky outdoors is level within 1.8 deg, and mounts are known to a degree or two."""
_CERTAIN = 3.5
"""Sigmas at which the ground counts as tilted."""
_HILL_M = 5.0
"""Way over which a slope changes."""
_LASTING = 2.0
"""For how many windows errors of the vertical last."""


class _Sigma(NamedTuple):
    """How large a slope is [rad], and the probability of that before anything is measured."""

    sigma: float
    prior: float


_MOUNTS = (_Sigma(math.radians(1.2), 0.95), _Sigma(math.radians(10.0), 0.05))
"""Errors of an IMU's mount that is as the robot file has it, and of one that is not, of one robot in twenty by judgement."""
_GROUNDS = (_Sigma(math.radians(1.0), 0.5), _Sigma(math.radians(6.0), 0.5))
"""Slopes of floors and yards, and of hills (median 5.8 deg, 95 % below 10.7), on which every second robot drives by judgement."""
_BANK = [(mount, ground) for mount in _MOUNTS for ground in _GROUNDS]


class GroundTilt:
    """`restart` with each first vertical, then `update` by each measured one."""

    def __init__(self) -> None:
        self._means = np.zeros((len(_BANK), 4))
        self._covs = np.array([np.diag([mount.sigma**2] * 2 + [ground.sigma**2] * 2) for mount, ground in _BANK])
        self._log_weights = np.log([mount.prior * ground.prior for mount, ground in _BANK])
        self._mean, self._cov = np.zeros(4), np.zeros((4, 4))
        self._mix()
        self.is_certain = False
        """Whether the ground has been found to tilt: until the mount is more probable to be off, and explains it."""

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

    @property
    def probabilities(self) -> FloatArray:
        """(2, 2) of `_MOUNTS` and `_GROUNDS`."""
        weights = np.exp(self._log_weights - self._log_weights.max())
        return np.asarray(weights / weights.sum()).reshape(len(_MOUNTS), len(_GROUNDS))

    @property
    def is_ambiguous(self) -> bool:
        """Whether it is certain that the ground tilts or the mount is off, and not which."""
        both = np.hstack([np.eye(2), np.eye(2)])
        is_large = bool(np.hypot(*self.ground) > _LEVEL)
        return not self.is_certain and is_large and _is_shown(both @ self._mean, both @ self._cov @ both.T)

    def restart(self) -> None:
        """The ground is another one: nothing is known of its tilt."""
        self._covs[:, 2:] = self._covs[:, :, 2:] = 0.0
        self._covs[:, 2, 2] = self._covs[:, 3, 3] = [ground.sigma**2 for _, ground in _BANK]
        self._mix()

    def update(self, downhill: FloatArray, cov: FloatArray, turn: float, way: float) -> None:
        """Update by the measured ``downhill`` slope (2,) of mount and ground together and its ``cov`` (2, 2), after ``turn`` [rad] and
        ``way`` [m]."""
        for i, (_, ground) in enumerate(_BANK):
            self._log_weights[i] += _separate(ground.sigma, self._means[i], self._covs[i], downhill, cov, turn, way) / _LASTING
        self._mix()
        is_shown = _is_shown(self.ground, self.ground_cov)
        self.is_certain = is_shown or (self.is_certain and bool(self.probabilities[0].sum() > 0.5))

    def _mix(self) -> None:
        """Mean and covariance of the mixture."""
        p = self.probabilities.ravel()
        self._mean = p @ self._means
        off = self._means - self._mean
        self._cov = np.einsum("h,hij->ij", p, self._covs + off[:, :, None] * off[:, None, :])


def _is_shown(slope: FloatArray, cov: FloatArray) -> bool:
    """Whether a ``slope`` (2,) of this ``cov`` (2, 2) is certain, and more than that of level ground."""
    return bool(np.hypot(*slope) > _LEVEL and slope @ np.linalg.solve(cov, slope) > _CERTAIN**2)


@kernel
def _separate(sigma: float, mean: FloatArray, cov: FloatArray, downhill: FloatArray, own: FloatArray, turn: float, way: float) -> float:
    """See `GroundTilt.update`: ``sigma`` is of the ground's slope [rad]; ``mean`` (4,) and ``cov`` (4, 4) change in place; ``own`` (2, 2)
    is the measurement's. Returns the log likelihood of the measurement."""
    c, s = math.cos(turn), math.sin(turn)
    fade = math.exp(-way / _HILL_M)
    move = np.eye(4)
    move[2, 2], move[2, 3], move[3, 2], move[3, 3] = fade * c, fade * s, -fade * s, fade * c
    before = mean.copy()
    mean[2] = move[2, 2] * before[2] + move[2, 3] * before[3]
    mean[3] = move[3, 2] * before[2] + move[3, 3] * before[3]
    propagate_in_place(move, cov)
    new = sigma * sigma * (1.0 - fade * fade)
    cov[2, 2] += new
    cov[3, 3] += new
    found, gain, log_likelihood = np.zeros(4), np.empty(4), 0.0
    for axis in range(2):
        row = np.array([1.0 - axis, axis, 1.0 - axis, axis])
        variance = _LASTING * own[axis, axis]
        error = downhill[axis] - mean[axis] - mean[2 + axis]
        off = error - found[axis] - found[2 + axis]
        spread = variance + cov[axis, axis] + 2.0 * cov[axis, 2 + axis] + cov[2 + axis, 2 + axis]
        log_likelihood -= 0.5 * (off * off / spread + math.log(math.tau * spread))
        update_in_place(found, cov, row, error, variance, gain)
    for i in range(4):
        mean[i] += found[i]
    return log_likelihood
