"""Evidence of what several sources measured of one channel of the robot's motion, with the motion integrated out.

In each bin the robot has a rate x ~ N(0, S^2), its forward speed or its yaw rate, where S is that of the drive, or that of a robot that
stands, by the share of the bins in which it moves. Source i measures z_i = a_i x + b_i + n_i, with a scale a_i = exp(c_i),
c_i ~ N(0, tau_i^2), a bias b_i of gyros, and n_i ~ N(0, V_i), V_i = floor_i^2 + (rel_i a_i x)^2. With x integrated out,

    log p(z) = -1/2 [z' V^-1 z - (a' V^-1 z)^2 / C + log|V| + log(C S^2) + k log 2 pi],    C = a' V^-1 a + S^-2,

(Rasmussen & Williams 2006, A.3). Scales and biases are those of the maximum, with the width of their posterior (Laplace); encoders of a
robot that stands show no scale. In a share of the bins one source is somewhere else, or all are: a mixture. A profile shows this to be most
of the time of a set-up: hence the loops.
"""

from __future__ import annotations

import math

import numpy as np

from localization.evidence.alternatives.alternative import OUTLIER, TEMPER
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray

_ITERATIONS = 2
"""Rounds of motion, scales and biases: the evidence of six healthy drives is that of ten to 0.02."""
_SIZE_SIGMA = 0.7
"""Standard deviation of the logarithm of a drive's speed over `WAY_M_S`, and of its turns: 0.1 m/s to 2 m/s are two of them."""
Pair = tuple[FloatArray, FloatArray]
"""Floors (k, n) and parts of the motion (k,) of the noise; or scales and biases (k,), or their sigmas."""


def log_size_prior(log_size: FloatArray) -> FloatArray:
    """Logarithm of the prior density of a drive's size over that of usual robots, by its logarithm: slow robots and fast ones."""
    return np.asarray(-0.5 * (log_size / _SIZE_SIGMA) ** 2)


@kernel
def channel_evidence(
    z: FloatArray,
    floor: FloatArray,
    relative: FloatArray,
    tau: FloatArray,
    bias_sigma: FloatArray,
    size: float,
    at_rest: tuple[FloatArray, FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Tempered evidence by bin (A, n); that of the size, the scales and the biases (A,); scales' logarithms and the data's information on
    them (A, k).

    ``z`` (A, k, n): A alternatives of k sources in n bins, NaN where unknown; ``floor`` (A, k, n); ``bias_sigma`` (k,); ``relative`` and
    ``tau`` (A, k); ``size``: prior standard deviation of the motion; ``at_rest``: least motion (A,), standard deviation (A, n) of the
    motion of a robot that stands, and (k, n) 0 where a source shows no scale there, as encoders that count nothing, else 1.
    """
    A, k, n = z.shape
    least, still, is_scaled = at_rest
    of_bins, price = np.zeros((A, n)), np.zeros(A)
    c, information = np.zeros((A, k)), np.zeros((A, k))
    x, b, scale_at_rest = np.zeros(n), np.zeros(k), np.ones(k)
    for i in range(A):
        noise = floor[i], relative[i]
        b[:] = 0.0
        _first(z[i], floor[i], tau[i], x, c[i])
        if k > 1:
            _maps(z[i], noise, (tau[i], bias_sigma), size, x, c[i], b, information[i])
        for _ in range(_ITERATIONS):
            _motion(z[i], noise, np.exp(c[i]), b, size, x)
            if k > 1:
                _maps(z[i], noise, (tau[i], bias_sigma), size, x, c[i], b, information[i])
        scale = np.exp(c[i])
        own, moving = _size_of_motion(z[i], noise, scale, b, size, x, least[i])
        price[i] = -0.5 * (math.log(own / size) / _SIZE_SIGMA) ** 2 + _price(c[i], b, information[i], tau[i], bias_sigma)
        for m in range(n):
            for j in range(k):
                scale_at_rest[j] = scale[j] if is_scaled[j, m] else 1.0
            of_bins[i, m] = TEMPER * _bin_evidence(z[i], noise, m, (scale, scale_at_rest), b, (own, still[i, m], moving), x[m])
    return of_bins, price, c, information


@subroutine
def _price(c: FloatArray, b: FloatArray, information: FloatArray, tau: FloatArray, bias_sigma: FloatArray) -> float:
    """Logarithm of the prior of scales and biases (k,), and of the width of the scales' posterior (Laplace)."""
    price = 0.0
    for j in range(len(c)):
        price -= 0.5 * (c[j] / tau[j]) ** 2 + 0.5 * math.log1p(information[j] * tau[j] ** 2)
        price -= 0.5 * (b[j] / bias_sigma[j]) ** 2 if bias_sigma[j] > 0.0 else 0.0
    return price


@subroutine
def _first(z: FloatArray, floor: FloatArray, tau: FloatArray, x: FloatArray, c: FloatArray) -> None:
    """Motion (n,) and logarithms of the scales (k,) by the source whose scale is known best beside its noise: from there the alternation
    with the scales converges. Noise of the first motion would make all scales small."""
    k, n = z.shape
    best, least = 0, math.inf
    for j in range(k):
        noise, square = 0.0, 1e-12
        for m in range(n):
            if math.isfinite(z[j, m]):
                noise += floor[j, m] ** 2
                square += z[j, m] ** 2
        if tau[j] ** 2 + noise / square < least:
            best, least = j, tau[j] ** 2 + noise / square
    for m in range(n):
        x[m] = z[best, m] if math.isfinite(z[best, m]) else 0.0
    for j in range(k):
        product, square = 0.0, 1e-12
        for m in range(n):
            if math.isfinite(z[j, m]):
                product += z[j, m] * x[m]
                square += x[m] ** 2
        ratio = product / square
        c[j] = math.log(min(max(ratio, 1e-4), 1e4)) if ratio > 0.0 else 0.0


@subroutine
def _variance(noise: Pair, j: int, m: int, scale: float, x: float) -> float:
    """Variance of source ``j`` in bin ``m`` at the motion ``x``."""
    return float(noise[0][j, m] ** 2 + (noise[1][j] * scale * x) ** 2)


@subroutine
def _motion(z: FloatArray, noise: Pair, a: FloatArray, b: FloatArray, size: float, x: FloatArray) -> None:
    """Posterior mean of the motion (n,), the noise as at the motion ``x`` so far."""
    for m in range(z.shape[1]):
        x[m] = _mean(z, noise, m, a, b, size, x[m])


@subroutine
def _mean(z: FloatArray, noise: Pair, m: int, a: FloatArray, b: FloatArray, size: float, near: float) -> float:
    """Posterior mean of the motion in bin ``m``, the noise as at a motion ``near``."""
    return float(_by_others(z, noise, -1, m, a, b, size, near)[0])


@subroutine
def _maps(
    z: FloatArray, noise: Pair, prior: Pair, size: float, x: FloatArray, c: FloatArray, b: FloatArray, information: FloatArray
) -> None:
    """Scales, the information on them, and biases (k,) by the motion ``x`` (n,), with sigmas of their ``prior``."""
    tau, bias_sigma = prior
    _scales(z, noise, tau, x, c, b, information)
    _biases(z, noise, np.exp(c), b, bias_sigma, size, x)


@subroutine
def _scales(z: FloatArray, noise: Pair, tau: FloatArray, x: FloatArray, c: FloatArray, b: FloatArray, information: FloatArray) -> None:
    """Scales and the information on them (k,) by the motion ``x`` and the biases ``b``, with sigmas ``tau`` of their prior."""
    for j in range(len(c)):
        wxx, wxz = _weighted_sums(z[j], x, noise[0][j], noise[1][j], math.exp(c[j]), b[j])
        ratio = min(max(wxz / wxx, 1e-4), 1e4)
        information[j] = TEMPER * wxx * ratio**2
        c[j] = math.log(ratio) * information[j] / (information[j] + tau[j] ** -2.0)


@subroutine
def _weighted_sums(z: FloatArray, x: FloatArray, floor: FloatArray, relative: float, a: float, b: float) -> tuple[float, float]:
    """Sums over the bins of x^2 and (z - b) x, weighted by the noise; a residual beyond three sigma counts less (Cauchy)."""
    wxx, wxz = 1e-12, 0.0
    for m in range(len(z)):
        if math.isfinite(z[m]):
            V = floor[m] ** 2 + (relative * a * x[m]) ** 2
            w = 1.0 / (V + (z[m] - b - a * x[m]) ** 2 / 9.0)
            wxx += w * x[m] * x[m]
            wxz += w * (z[m] - b) * x[m]
    return wxx, wxz


@subroutine
def _biases(z: FloatArray, noise: Pair, a: FloatArray, b: FloatArray, bias_sigma: FloatArray, size: float, x: FloatArray) -> None:
    """Biases (k,) by generalized least squares against the motion that the other sources measure, the noise as at ``x``: a motion that has
    the source itself takes most of its bias for motion. A residual beyond three sigma counts less (Cauchy)."""
    for j in range(len(b)):
        if bias_sigma[j] <= 0.0:
            continue
        weighted, weights = 0.0, bias_sigma[j] ** -2.0 / TEMPER
        for m in range(z.shape[1]):
            if math.isfinite(z[j, m]):
                others, information = _by_others(z, noise, j, m, a, b, size, x[m])
                off = z[j, m] - a[j] * others
                V = _variance(noise, j, m, a[j], x[m]) + a[j] ** 2 / information
                w = 1.0 / (V + (off - b[j]) ** 2 / 9.0)
                weighted, weights = weighted + w * off, weights + w
        b[j] = weighted / weights


@subroutine
def _by_others(z: FloatArray, noise: Pair, j: int, m: int, a: FloatArray, b: FloatArray, size: float, near: float) -> tuple[float, float]:
    """Posterior mean of the motion in bin ``m`` by all sources but ``j``, and the information on it, the noise as at a motion ``near``."""
    product, information = 0.0, size**-2.0
    for i in range(len(z)):
        if i != j and math.isfinite(z[i, m]):
            weight = a[i] / _variance(noise, i, m, a[i], near)
            product += weight * (z[i, m] - b[i])
            information += weight * a[i]
    return float(product / information), float(information)


@subroutine
def _size_of_motion(
    z: FloatArray, noise: Pair, a: FloatArray, b: FloatArray, size: float, x: FloatArray, least: float
) -> tuple[float, float]:
    """Standard deviation of the motion of this drive, near ``x``, where the robot moves, and the share of bins where it does; what is
    smaller than ``least`` is no motion."""
    square, moving = 0.0, 0
    for m in range(len(x)):
        mean = _mean(z, noise, m, a, b, size, x[m])
        if abs(mean) > least:
            square, moving = square + mean**2, moving + 1
    return math.sqrt(square / moving) if moving else least, (moving + 0.5) / (len(x) + 1.0)


@subroutine
def _bin_evidence(z: FloatArray, noise: Pair, m: int, a: Pair, b: FloatArray, motion: tuple[float, float, float], x: float) -> float:
    """Log density of bin ``m`` of a drive with this ``motion``: its size where the robot moves, that where it stands, and the share of bins
    in which it moves. ``a``: scales (k,) where it moves and where it stands."""
    size, still, moving = motion
    moves = _of_size(z, noise, m, a[0], b, size, x)
    if size <= still:
        return moves
    stands = _of_size(z, noise, m, a[1], b, still, x)
    best = max(moves, stands)
    return best + math.log(moving * math.exp(moves - best) + (1.0 - moving) * math.exp(stands - best))


@subroutine
def _of_size(z: FloatArray, noise: Pair, m: int, a: FloatArray, b: FloatArray, size: float, x: float) -> float:
    """Log density of bin ``m``: all sources measure the motion; or all but one do; or none does. Each is exp(-q / 2) / sqrt(d)."""
    k, S2 = len(z), size**2
    zz, az, C, V_all, zz_out, V_out = 0.0, 0.0, 1.0 / S2, 1.0, 0.0, 1.0
    for j in range(k):
        if math.isfinite(z[j, m]):
            r, V = z[j, m] - b[j], _variance(noise, j, m, a[j], x)
            zz, az, C, V_all = zz + r * r / V, az + a[j] * r / V, C + a[j] ** 2 / V, V_all * V * math.tau
            zz_out, V_out = zz_out + r * r / (a[j] ** 2 * S2 + V), V_out * (a[j] ** 2 * S2 + V) * math.tau
    together = zz - az * az / C
    least = min(together, zz_out)
    for j in range(k if k > 2 else 0):
        least = min(least, _without(z, noise, m, (a, b), S2, x, j, (zz, az, C, V_all))[0])
    total = (1.0 - OUTLIER) * _density(together - least, V_all * C * S2)
    total += (0.2 * OUTLIER if k > 2 else OUTLIER) * _density(zz_out - least, V_out)
    for j in range(k if k > 2 else 0):
        q, d = _without(z, noise, m, (a, b), S2, x, j, (zz, az, C, V_all))
        total += 0.8 * OUTLIER / k * _density(q - least, d)
    return math.log(total) - 0.5 * least


@subroutine
def _without(z: FloatArray, noise: Pair, m: int, maps: Pair, S2: float, x: float, j: int, sums: tuple[float, ...]) -> tuple[float, float]:
    """q and d of a bin in which source ``j`` measures another motion than the others, from the ``sums`` over all of them and the scales and
    biases (k,) of their ``maps``."""
    (a, b), (zz, az, C, V_all) = maps, sums
    if not math.isfinite(z[j, m]):
        return zz - az * az / C, V_all * C * S2
    r, V = z[j, m] - b[j], _variance(noise, j, m, a[j], x)
    rest, U = max(C - a[j] ** 2 / V, 1.0 / S2), a[j] ** 2 * S2 + V  # 1 / S2 at least, whatever is rounded off
    return zz - r * r / V - (az - a[j] * r / V) ** 2 / rest + r * r / U, V_all / V * rest * S2 * U


@subroutine
def _density(q: float, d: float) -> float:
    return math.exp(-0.5 * q) / math.sqrt(d)
