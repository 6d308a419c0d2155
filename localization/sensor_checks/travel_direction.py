"""Direction in which the LiDAR travels, against that in which the wheels drive, over the last seconds.

    b_k = alpha a_k + beta u_k + n_k

with the ways a_k by wheels and b_k by LiDAR in each bin as complex numbers, x + i y in the body. arg alpha is the direction: 25 deg of a
LiDAR whose yaw is wrong by that. beta is what the robot slides in turns (u_k is its turn), which along one arc looks like another
direction; a priori it is 0 +- `_SLIDE_SIGMA`. Least squares with a prior on beta (Bar-Shalom, Li, Kirubarajan 2001, 3.4).

Along the walls of a corridor no scan measures a way: there the equation counts across them alone. That shows the direction of a robot that
drives along them, but not whether it goes on or back, and no scale, for which there is a prior of 1. That a robot goes back is shown by the
bins that measure a way ahead alone: one scan at a wrong place is one of these, however many show that nothing moves across the walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from localization.sensor_checks.window import WINDOW_BINS, Bins
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import invert
from motion_models.se2 import FloatArray

SLIDE_RAD = math.radians(12.0)
"""Direction of a way, up to which it is equal: a robot on a side slope or in curves slides by a few degrees [rad]."""
_CONFIDENCE = 0.999
"""Confidence of a direction's one-sided bound: windows overlap, so that one of a thousand is one of some minutes."""
_SCALE_SIGMA = 0.5
"""Standard deviation of alpha about 1 a priori, along each axis: wheels that spin by half are one sigma."""
_SLIDE_SIGMA = 0.5
"""Standard deviation of the slide: half the length of a robot a radian [m/rad]."""
_NOISE_M = 5e-3
"""Standard deviation of a bin's way along each axis, a quarter of a range's: the least that bins scatter by, and priors' weight [m]."""
_MIN_BINS = 6
"""Fewest bins that count."""
_MIN_WAY_M, _MAX_WAY_RATIO = 0.05, 2.0
"""Least way in a bin that counts [m], and the ratio of ways from which on they show no direction: wheels spin."""
_QUANTILES = [math.inf, *stdtrit(np.arange(1, WINDOW_BINS - 1), _CONFIDENCE).tolist()]
"""Quantiles of Student's distribution at `_CONFIDENCE`, by its degrees of freedom."""


class Direction(NamedTuple):
    """Direction of the way by the LiDAR, in that by the wheels."""

    angle: float
    """[rad]"""
    bound: float
    """Its error at most, by the scatter of the bins (`_CONFIDENCE`) [rad]; infinite where the window shows none."""

    @property
    def is_equal(self) -> bool:
        """Both travel alike, but for what robots slide by."""
        return abs(self.angle) <= SLIDE_RAD and self.bound <= SLIDE_RAD

    @property
    def least(self) -> float:
        """How far it is from 0 at least [rad]; negative where it may be 0."""
        return abs(self.angle) - self.bound


def direction_of(bins: Bins) -> Direction:
    """By all ``bins``."""
    n, alpha, sigma = _fit_ways(bins.rows)
    bound = _QUANTILES[n - 2] * sigma / abs(alpha) if n >= _MIN_BINS and alpha else math.inf
    return Direction(math.atan2(alpha.imag, alpha.real), bound)


@kernel
def _fit_ways(rows: FloatArray) -> tuple[int, complex, float]:
    """Number of bins that count, alpha of the ways by wheels and LiDAR in ``rows`` (n, 12) of `Bins`, and its standard error across its own
    direction. 0 bins where beta is farther from 0 than two of its sigmas, or alpha beyond `_MAX_WAY_RATIO`: what differs then is no
    direction. Where alpha is one of a robot that goes back, bins without a way ahead do not count."""
    N, g, square, n, ahead, equations = np.zeros((4, 4)), np.zeros(4), 0.0, 0, 0, 0
    for k in range(rows.shape[0]):
        ax, ay, turn, across, nx, ny = rows[k, 1], rows[k, 2], rows[k, 3], rows[k, 9], rows[k, 10], rows[k, 11]
        size, way = math.hypot(ax, ay), math.hypot(rows[k, 5], rows[k, 6])
        has_both = not math.isnan(way)
        shorter, longer = (min(size, way), max(size, way)) if has_both else (size, size)
        if math.isnan(size + across) or shorter < _MIN_WAY_M or longer > _MAX_WAY_RATIO * shorter:
            continue
        n, equations = n + 1, equations + 1 + has_both
        ahead += has_both or abs(nx * ax + ny * ay) >= _MIN_WAY_M
        square += across**2
        _add_equation(N, g, (nx * ax + ny * ay, ny * ax - nx * ay, nx * turn, ny * turn), across)
        if has_both:
            along = nx * rows[k, 6] - ny * rows[k, 5]
            square += along**2
            _add_equation(N, g, (nx * ay - ny * ax, nx * ax + ny * ay, -ny * turn, nx * turn), along)
    if n < 3:
        return 0, 0j, 0.0
    of_scale, of_offset = (_NOISE_M / _SCALE_SIGMA) ** 2, (_NOISE_M / _SLIDE_SIGMA) ** 2
    for p in range(4):
        N[p, p] += of_scale if p < 2 else of_offset
    g[0] += of_scale
    square += of_scale
    C = invert(N)
    x, y, slide_x, slide_y = (C * g).sum(axis=1)
    scale = math.hypot(x, y)
    is_offset = math.hypot(slide_x, slide_y) > 2.0 * _SLIDE_SIGMA
    if is_offset or not 1.0 <= _MAX_WAY_RATIO * scale <= _MAX_WAY_RATIO**2:
        return 0, complex(x, y), 0.0
    variance = max((square - x * g[0] - y * g[1] - slide_x * g[2] - slide_y * g[3]) / max(equations - 4, 1), _NOISE_M**2)
    u, v = -y / scale, x / scale
    return n if x > 0.0 else ahead, complex(x, y), math.sqrt(variance * (u * u * C[0, 0] + 2.0 * u * v * C[0, 1] + v * v * C[1, 1]))


@subroutine
def _add_equation(N: FloatArray, g: FloatArray, J: tuple[float, float, float, float], measured: float) -> None:
    """Add the equation of a way ``measured`` along one axis, J x, to the normal equations of x."""
    for p in range(4):
        g[p] += J[p] * measured
        for q in range(4):
            N[p, q] += J[p] * J[q]
