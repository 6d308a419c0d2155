"""Where a sensor of planar motion is along the robot: what its sideways speed shows of it, and what is known before.

Only the sum of a sensor's place and of the centre of rotation is measured: a load ahead moves the whole robot sideways in a turn just as a
sensor that is farther behind. What is known before decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from localization.evidence.alternatives.alternative import LEVELS, TEMPER, mixture_by_bin, over_levels, size_of
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

_SIDE_FLOOR_M_S, _SIDE_OF_WAY, _SIDE_OF_TURN_M = 0.02, 0.1, 0.05
"""Standard deviation of a robot's sideways speed: floor, part of the speed (slides are below 20 degrees in 99.9 % of three buildings), and
metres per radian of turn beyond its centre of rotation."""
_ANYWHERE_M = 10.0
"""Standard deviation of a place of which nothing is known [m]: that of the estimate to which a `PlacePrior` is applied."""
_LOADED = 0.1
"""Share of robots with a load or a base_link that the robot file does not describe."""
_LEAST = 1e-300
"""Density below which a place has no logarithm [1/m]."""


@dataclass(frozen=True)
class PlacePrior:
    """How far ahead of where the robot file has it a sensor is, with the centre of rotation.

    Normal about 0; of a share of robots a load has moved the centre of rotation to anywhere between the axles, which no load moves it
    beyond: where the centre of gravity is over an axle, the other one carries nothing.
    """

    sigma_m: float
    wheelbase_m: float = 0.0
    loaded: float = 0.0
    """Share of robots with such a load."""

    @property
    def spread_m(self) -> float:
        """Standard deviation [m]."""
        return math.hypot(self.sigma_m, math.sqrt(self.loaded / 12.0) * self.wheelbase_m)

    def log_evidence(self, ahead_m: FloatArray, variance_m2: FloatArray) -> FloatArray:
        """Logarithm (m,) of the mean, by this prior, of likelihoods that are normal about ``ahead_m`` (m,) and 1 there."""
        s = np.sqrt(self.sigma_m**2 + variance_m2)
        found = (1.0 - self.loaded) * np.exp(-0.5 * (ahead_m / s) ** 2) / (s * math.sqrt(math.tau))
        if self.loaded:
            half = 0.5 * self.wheelbase_m
            found += self.loaded * (ndtr((half - ahead_m) / s) - ndtr((-half - ahead_m) / s)) / self.wheelbase_m
        return np.asarray(np.log(np.maximum(found, _LEAST)) + 0.5 * np.log(math.tau * variance_m2))


def usual_place(sigma_m: float, robot: Robot, moves_cg: bool = False) -> PlacePrior:
    """A sensor that is where the robot file has it to ``sigma_m``.

    Where the centre of gravity moves, each robot has such a load; one with casters turns about its driven axle with any load.
    """
    if robot.drive == DIFF_DRIVE:
        return PlacePrior(sigma_m)
    return PlacePrior(sigma_m, robot.geometry.wheelbase_m, 1.0 if moves_cg or robot.arms is not None else _LOADED)


class SideEvidence(NamedTuple):
    """Evidence of the sideways speed of a sensor."""

    evidence: float
    ahead_m: float
    """How far ahead of its place the sensor is, with the centre of rotation [m]."""
    by_bin: FloatArray
    """(n,) the part of the evidence that each bin has."""


def side_evidence(side: FloatArray, way: FloatArray, turn: FloatArray, place: PlacePrior) -> SideEvidence:
    """Evidence of the sideways speed (n,) of a point that should be on the body's x axis.

    side = ahead wz + noise, by reweighted least squares at each level of the noise; the place ahead is integrated over its prior.
    """
    wide, known = size_of(np.hypot(way, side)), np.isfinite(side)
    side, way, turn = side[known], way[known], turn[known]
    sigma = np.sqrt(_SIDE_FLOOR_M_S**2 + (_SIDE_OF_WAY * way) ** 2 + (_SIDE_OF_TURN_M * turn) ** 2)
    variance = np.square(np.outer(LEVELS, sigma))
    weight, residual, ahead = 1.0 / variance, np.zeros_like(variance), np.zeros(len(LEVELS))
    for _ in range(3):
        information = TEMPER * (weight @ turn**2) + _ANYWHERE_M**-2
        ahead = TEMPER * (weight @ (turn * side)) / information
        residual = side - np.outer(ahead, turn)
        weight = 1.0 / (variance + (residual / 3.0) ** 2)
    bins = mixture_by_bin(residual, sigma, wide)
    by_level = bins.sum(axis=1) + place.log_evidence(ahead, 1.0 / information)
    best, by_bin = int(by_level.argmax()), np.zeros(len(known))
    by_bin[known] = bins[best]
    return SideEvidence(over_levels(by_level), float(ahead[best]), by_bin)
