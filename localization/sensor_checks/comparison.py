"""Two sensors that measure one quantity over the last seconds: scale and direction of the second against the first.

    b_k = alpha a_k + beta u_k + n_k

with the motions a_k and b_k in each bin by the two sensors as complex numbers: turns are real, ways are x + i y in the body. |alpha| is the
scale, arg alpha the direction: pi of a gyro that turns the other way, 25 deg of a LiDAR whose yaw is wrong by that. beta is by what both
differ without a fault, 0 +- `Quantity.offset_sigma` a priori: the gyro's bias in turns (u_k is time); in ways, what a robot slides in turns
(u_k is its turn), which along one arc looks like another direction. Least squares with a prior on beta (Bar-Shalom, Li, Kirubarajan 2001,
3.4).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import stdtrit

from localization.sensor_checks.window import MIN_BINS, WINDOW_BINS, Bins
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

Sensor = Literal["wheels", "gyro", "LiDAR"]

_MAX_RATIO = 2.5
"""Motions whose sizes differ by more are not equal: the wheels of a robot that skids turn about twice as far."""
OPPOSITE_RAD = math.radians(130.0)
"""Direction of a turn, which is 0 or pi, from where on it is opposite; equal and opposite are certain to 50 deg then, 4 standard errors of
alpha [rad]."""
SLIDE_RAD = math.radians(12.0)
"""Direction of a way, up to which it is equal: a robot on a side slope or in curves slides by a few degrees [rad]."""
_CONFIDENCE = 0.999
"""Confidence of a direction's one-sided bound: windows overlap, so that one of a thousand is one of some minutes."""
_QUANTILES = [math.inf, *stdtrit(np.arange(1, WINDOW_BINS - 1), _CONFIDENCE).tolist()]
"""Quantiles of Student's distribution at `_CONFIDENCE`, by its degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """What several sensors measure in each bin, and by what they differ without a fault."""

    columns: Mapping[Sensor, slice]
    """Columns of `Bins.rows` by sensor: one of a turn, two of a way."""
    offset_column: int
    """Column of `Bins.rows` that the offset is proportional to."""
    offset_sigma: float
    """Standard deviation of the offset: of a bias [rad/s], of a slide [m/rad]."""
    noise: float
    """Standard deviation of a bin's motion along each axis, as a rule [rad, m]: the prior of the offset has its weight by it."""
    min_noise: float
    """The least one [rad, m]: what bins scatter by is at least this."""
    min_size: float
    """Least motion in a bin that counts [rad, m]."""
    max_ratio: float
    """Ratio of motions from which on they show no direction: wheels spin."""
    min_bins: int
    """Fewest bins that count."""
    max_angle: float
    """Directions that are no farther apart are equal [rad]."""


_TURNS: Mapping[Sensor, slice] = {"wheels": slice(3, 4), "gyro": slice(4, 5), "LiDAR": slice(7, 8)}
TURN = Quantity(_TURNS, 0, 0.025, 5e-3, 5e-4, 0.0, math.inf, MIN_BINS, OPPOSITE_RAD)
"""The bias: five prior sigmas of the shipped robots. The noise: 0.3 deg of a scan's turn; the least one half of a cheap gyro's 0.002
rad/s/sqrt(Hz) in a quarter of a second."""
WAY = Quantity({"wheels": slice(1, 3), "LiDAR": slice(5, 7)}, 3, 0.5, 5e-3, 5e-3, 0.05, 2.0, 6, SLIDE_RAD)
"""The slide: half the length of a robot a radian. The noise: a quarter of a range's."""


class Gain(NamedTuple):
    """Motion by the second sensor as a multiple of that by the first."""

    scale: float
    angle: float
    """Direction [rad]."""
    bound: float
    """Error of the direction at most [rad], by the scatter of the bins (`_CONFIDENCE`); infinite where the window shows no direction."""
    is_equal: bool
    """Directions and scales (within `_MAX_RATIO`) are equal, whatever the error."""


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
        a, b = bins.rows[:, quantity.columns[self.first]], bins.rows[:, quantity.columns[self.second]]
        limits = quantity.offset_sigma, quantity.noise, quantity.min_noise, quantity.min_size, quantity.max_ratio
        n, alpha, sigma = _fit(a, b, bins.rows[:, quantity.offset_column], *limits)
        bound = _QUANTILES[n - 2] * sigma / abs(alpha) if n >= quantity.min_bins and alpha else math.inf
        scale, angle, most = abs(alpha), math.atan2(alpha.imag, alpha.real), quantity.max_angle
        is_equal = abs(angle) <= most and bound <= min(most, math.pi - most) and 1.0 <= _MAX_RATIO * scale <= _MAX_RATIO**2
        return Gain(scale, angle, bound, is_equal)


@kernel
def _fit(
    a: FloatArray, b: FloatArray, u: FloatArray, offset_sigma: float, noise: float, min_noise: float, min_size: float, max_ratio: float
) -> tuple[int, complex, float]:
    """Number of bins that count, alpha of the motions ``a`` and ``b`` (n, 1 or 2) with offsets along ``u`` (n,), and the standard error of
    alpha along each axis. 0 bins where beta is farther from 0 than two of its sigmas, or alpha beyond ``max_ratio``: what differs then
    is no direction."""
    n, aa, au, uu, ab, ub, bb = 0, 0.0, 0j, 0.0, 0j, 0j, 0.0
    axes = a.shape[1]
    for k in range(a.shape[0]):
        first = complex(a[k, 0], a[k, 1] if axes == 2 else 0.0)
        second = complex(b[k, 0], b[k, 1] if axes == 2 else 0.0)
        shorter, longer = min(abs(first), abs(second)), max(abs(first), abs(second))
        if math.isnan(abs(first) + abs(second)) or shorter < min_size or longer > max_ratio * shorter:
            continue
        n, aa, uu, bb = n + 1, aa + abs(first) ** 2, uu + u[k] ** 2, bb + abs(second) ** 2
        au, ab, ub = au + first.conjugate() * u[k], ab + first.conjugate() * second, ub + u[k] * second
    if n < 3 or aa == 0.0:
        return 0, 0j, 0.0
    information = uu + (noise / offset_sigma) ** 2
    determinant = aa * information - abs(au) ** 2
    alpha, beta = (information * ab - au * ub) / determinant, (aa * ub - au.conjugate() * ab) / determinant
    square = bb - (alpha.conjugate() * ab + beta.conjugate() * ub).real  # of residuals and prior
    variance = max(square / (axes * (n - 2)), min_noise**2)
    is_offset = abs(beta) > 2.0 * offset_sigma * max(abs(alpha) / _MAX_RATIO, 1.0)  # another unit is one of the bias as well
    is_direction = not is_offset and 1.0 <= max_ratio * abs(alpha) <= max_ratio**2
    return n if is_direction else 0, alpha, math.sqrt(variance * information / determinant)
