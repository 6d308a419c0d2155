"""Two sensors that measure one quantity over the last seconds: scale and direction of the second against the first.

    b_k = alpha a_k + beta u_k + n_k

with the motions a_k and b_k in each bin by the two sensors as complex numbers: turns are real, ways are x + i y in the body. |alpha| is the
scale, arg alpha the direction: pi of a gyro that turns the other way, 25 deg of a LiDAR whose yaw is wrong by that. beta is by what both
differ without a fault, 0 +- `Quantity.offset_sigma` a priori: the gyro's bias in turns (u_k is time); in ways, what a robot slides in turns
(u_k is its turn), which along one arc looks like another direction. Least squares with a prior on beta (Bar-Shalom, Li, Kirubarajan 2001,
3.4).

Along the walls of a corridor no scan measures a way: there the equation counts across them alone. That shows the direction of a robot that
drives along them, but not whether it goes on or back, and no scale, for which there is a prior of 1. That a robot goes back is shown by the
bins that measure a way ahead alone: one scan at a wrong place is one of these, however many show that nothing moves across the walls.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import stdtrit

from localization.sensor_checks.window import MIN_BINS, WINDOW_BINS, Bins
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import invert
from motion_models.se2 import FloatArray

Sensor = Literal["wheels", "gyro", "LiDAR"]

MAX_RATIO = 2.5
"""Motions whose sizes differ by more are not equal: the wheels of a robot that skids turn about twice as far."""
OPPOSITE_RAD = math.radians(130.0)
"""Direction of a turn, which is 0 or pi, from where on it is opposite; equal and opposite are certain to 50 deg then, 4 standard errors of
alpha [rad]."""
SLIDE_RAD = math.radians(12.0)
"""Direction of a way, up to which it is equal: a robot on a side slope or in curves slides by a few degrees [rad]."""
_CONFIDENCE = 0.999
"""Confidence of a direction's one-sided bound: windows overlap, so that one of a thousand is one of some minutes."""
_SCALE_SIGMA = 0.5
"""Standard deviation of alpha about 1 a priori, along each axis: wheels that spin by half are one sigma."""
_QUANTILES = [math.inf, *stdtrit(np.arange(1, WINDOW_BINS - 1), _CONFIDENCE).tolist()]
"""Quantiles of Student's distribution at `_CONFIDENCE`, by its degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """What several sensors measure in each bin, and by what they differ without a fault."""

    offset_sigma: float
    """Standard deviation of the offset: of a bias [rad/s], of a slide [m/rad]."""
    noise: float
    """Standard deviation of a bin's motion along each axis, as a rule [rad, m]: the prior of the offset has its weight by it."""
    min_noise: float
    """The least one [rad, m]: what bins scatter by is at least this."""
    min_bins: int
    """Fewest bins that count."""
    max_angle: float
    """Directions that are no farther apart are equal [rad]."""


TURN = Quantity(0.025, 5e-3, 5e-4, MIN_BINS, OPPOSITE_RAD)
"""The bias: five prior sigmas of the shipped robots. The noise: 0.3 deg of a scan's turn; the least one half of a cheap gyro's 0.002
rad/s/sqrt(Hz) in a quarter of a second."""
WAY = Quantity(0.5, 5e-3, 5e-3, 6, SLIDE_RAD)
"""The slide: half the length of a robot a radian. The noise: a quarter of a range's."""
_TURNS: Mapping[Sensor, int] = {"wheels": 3, "gyro": 4, "LiDAR": 7}
"""Columns of `Bins.rows`."""
_MIN_WAY_M, _MAX_WAY_RATIO = 0.05, 2.0
"""Least way in a bin that counts [m], and the ratio of ways from which on they show no direction: wheels spin."""


class Gain(NamedTuple):
    """Motion by the second sensor as a multiple of that by the first."""

    scale: float
    angle: float
    """Direction [rad]."""
    bound: float
    """Error of the direction at most [rad], by the scatter of the bins (`_CONFIDENCE`); infinite where the window shows no direction."""
    is_equal: bool
    """Directions and scales (within `MAX_RATIO`) are equal, whatever the error."""


UNKNOWN = Gain(0.0, 0.0, math.inf, is_equal=False)
"""Gain of a sensor that has measured nothing."""


class Comparison(NamedTuple):
    """Two sensors, and what both measure."""

    quantity: Quantity
    first: Sensor
    second: Sensor

    def gain(self, bins: Bins) -> Gain:
        """How the second sensor relates to the first over all ``bins``."""
        quantity = self.quantity
        limits = quantity.offset_sigma, quantity.noise, quantity.min_noise
        if quantity is WAY:
            n, alpha, sigma = _fit_ways(bins.rows, *limits)
        else:
            a, b = bins.rows[:, _TURNS[self.first]], bins.rows[:, _TURNS[self.second]]
            n, alpha, sigma = _fit_turns(a, b, bins.durations_s, *limits)
        bound = _QUANTILES[n - 2] * sigma / abs(alpha) if n >= quantity.min_bins and alpha else math.inf
        scale, angle, most = abs(alpha), math.atan2(alpha.imag, alpha.real), quantity.max_angle
        is_equal = abs(angle) <= most and bound <= min(most, math.pi - most) and 1.0 <= MAX_RATIO * scale <= MAX_RATIO**2
        return Gain(scale, angle, bound, is_equal)


@kernel
def _fit_turns(
    a: FloatArray, b: FloatArray, u: FloatArray, offset_sigma: float, noise: float, min_noise: float
) -> tuple[int, complex, float]:
    """Number of bins that count, alpha of the turns ``a`` and ``b`` (n,) with offsets along ``u`` (n,), and its standard error. 0 bins
    where beta is farther from 0 than two of its sigmas: what differs then is no scale."""
    n, aa, au, uu, ab, ub, bb = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(a.shape[0]):
        if math.isnan(a[k] + b[k]):
            continue
        n, aa, uu, bb = n + 1, aa + a[k] ** 2, uu + u[k] ** 2, bb + b[k] ** 2
        au, ab, ub = au + a[k] * u[k], ab + a[k] * b[k], ub + u[k] * b[k]
    if n < 3 or aa == 0.0:
        return 0, 0j, 0.0
    information = uu + (noise / offset_sigma) ** 2
    determinant = aa * information - au**2
    alpha, beta = (information * ab - au * ub) / determinant, (aa * ub - au * ab) / determinant
    square = bb - alpha * ab - beta * ub  # of residuals and prior
    variance = max(square / (n - 2), min_noise**2)
    is_offset = abs(beta) > 2.0 * offset_sigma * max(abs(alpha) / MAX_RATIO, 1.0)  # another unit is one of the bias as well
    return 0 if is_offset else n, complex(alpha), math.sqrt(variance * information / determinant)


@kernel
def _fit_ways(rows: FloatArray, offset_sigma: float, noise: float, min_noise: float) -> tuple[int, complex, float]:
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
    of_scale, of_offset = (noise / _SCALE_SIGMA) ** 2, (noise / offset_sigma) ** 2
    for p in range(4):
        N[p, p] += of_scale if p < 2 else of_offset
    g[0] += of_scale
    square += of_scale
    C = invert(N)
    x, y, slide_x, slide_y = (C * g).sum(axis=1)
    scale = math.hypot(x, y)
    is_offset = math.hypot(slide_x, slide_y) > 2.0 * offset_sigma * max(scale / MAX_RATIO, 1.0)
    if is_offset or not 1.0 <= _MAX_WAY_RATIO * scale <= _MAX_WAY_RATIO**2:
        return 0, complex(x, y), 0.0
    variance = max((square - x * g[0] - y * g[1] - slide_x * g[2] - slide_y * g[3]) / max(equations - 4, 1), min_noise**2)
    u, v = -y / scale, x / scale
    return n if x > 0.0 else ahead, complex(x, y), math.sqrt(variance * (u * u * C[0, 0] + 2.0 * u * v * C[0, 1] + v * v * C[1, 1]))


@subroutine
def _add_equation(N: FloatArray, g: FloatArray, J: tuple[float, float, float, float], measured: float) -> None:
    """Add the equation of a way ``measured`` along one axis, J x, to the normal equations of x."""
    for p in range(4):
        g[p] += J[p] * measured
        for q in range(4):
            N[p, q] += J[p] * J[q]
