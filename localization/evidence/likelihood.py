"""Evidence of a choice of alternatives, one a source, with the robot's motion integrated out.

In each bin the robot has a forward speed and a yaw rate x ~ N(0, S^2). Source i measures z_i = exp(c_i) x + b_i + n_i, with a scale
c_i ~ N(0, tau_i^2) and a bias b_i of gyros that are profiled, and n_i ~ N(0, floor_i^2 + (rel_i x)^2). With the motion integrated out,

    log p(z) = -1/2 [z' V^-1 z - (a' V^-1 z)^2 / C + log|V| + log(C S^2)],    a = exp(c),    C = a' V^-1 a + S^-2,

(Rasmussen & Williams 2006, A.3). In a share of the bins one source is somewhere else: a mixture over which one it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from localization.evidence.alternatives.alternative import (
    OUTLIER,
    STILL_M_S,
    STILL_RAD_S,
    TEMPER,
    TURN_RAD_S,
    WAY_M_S,
    Alternative,
    size_of,
)
from localization.evidence.signals import Kind
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Noise:
    """Errors of one kind of source over half a second."""

    relative: float
    """Part of the motion: slip, matching."""
    turn_floor: float
    """[rad/s]"""
    way_floor: float
    """[m/s]"""
    turn_scale: float
    """Sigma of the logarithm of its scale: skidding, gyro."""
    way_scale: float
    """Radius, ranges."""
    bias: float = 0.0
    """Sigma of a constant yaw rate [rad/s]."""


NOISE: Mapping[Kind, Noise] = {
    "wheels": Noise(0.15, 0.03, 0.02, 0.25, 0.08),
    "driver": Noise(0.15, 0.03, 0.02, 0.05, 0.08),
    "gyro": Noise(0.04, 0.01, 0.0, 0.03, 0.0, bias=0.03),
    "lidar": Noise(0.06, 0.02, 0.02, 0.01, 0.04),
    "reference": Noise(0.05, 0.02, 0.02, 0.01, 0.02),
}
"""Measured on fr079, MIT-CSAIL, ACES and the Husky of `tests/data`; the level is estimated in each log (`LEVELS`)."""
_ITERATIONS = 4
_SCALE_SHARE: Mapping[Kind, tuple[float, float]] = {
    "wheels": (0.5, 0.5),
    "driver": (1.0, 0.0),
    "gyro": (0.0, 1.0),
    "lidar": (0.5, 0.0),
    "reference": (0.5, 0.0),
}
"""Part of `Alternative.log_jacobian` that is the logarithm of the unit of the way, and of the turn."""
_SIZE_SIGMA = 0.7
"""Standard deviation of the logarithm of a drive's speed over `WAY_M_S`, and of its turns: 0.1 m/s to 2 m/s are two of them."""


@dataclass(frozen=True, eq=False)
class Stack:
    """All alternatives of one source."""

    kind: Kind
    alternatives: Sequence[Alternative]
    raw: Mapping[str, float] = field(default_factory=dict)
    """Size of the way and of the turn by the robot file, where ``alternatives`` are not all of them."""
    behind_s: float | None = None
    """`Source.behind_s`."""

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """Size of the way [m/s] and of the turn [rad/s] by the robot file, of what is no motion at least."""
        if self.raw:
            return self.raw
        by_file = self.alternatives[0]
        floors = {"way": STILL_M_S, "turn": STILL_RAD_S}
        return {name: max(size_of(c), floors[name]) for name in floors if (c := getattr(by_file, name)) is not None}

    def only(self, k: int) -> Stack:
        """The stack with alternative ``k`` alone."""
        return Stack(self.kind, [self.alternatives[k]], self.sizes)

    def alone(self, name: str, size: float) -> FloatArray:
        """Evidence (A,) of a channel that no other source measures; ``size``: of the motion of usual robots. 0 where it is unknown."""
        channel = self.channel(name)
        assert channel is not None
        known = np.isfinite(channel)
        mean_square = (np.where(known, channel, 0.0) ** 2).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        plausible = -0.5 * (0.5 * np.log(mean_square / size**2 + 1e-4) / _SIZE_SIGMA) ** 2
        log_size = self.log_scale(name) + math.log(self.sizes[name]) + 0.5 * (1.0 + math.log(math.tau))
        return np.asarray(np.where(known.any(axis=1), plausible - TEMPER * known.sum(axis=1) * log_size, 0.0))

    @cached_property
    def own(self) -> FloatArray:
        """(A,) prior and evidence by the source alone, with the Jacobians."""
        return np.array([a.log_prior + a.own + TEMPER * a.log_jacobian * self._known(a) for a in self.alternatives])

    @staticmethod
    def _known(a: Alternative) -> int:
        channels = [c for c in (a.way, a.turn) if c is not None]
        return int(np.isfinite(channels[0]).sum()) if channels else 0

    def channel(self, name: str) -> FloatArray | None:
        """(A, n) way or turn; None where it is not measured."""
        return self._channels[name]

    @cached_property
    def _channels(self) -> dict[str, FloatArray | None]:
        return {
            name: None if getattr(self.alternatives[0], name) is None else np.array([getattr(a, name) for a in self.alternatives])
            for name in ("way", "turn")
        }

    @cached_property
    def tau(self) -> dict[str, FloatArray]:
        """(A,) sigma of the logarithm of the scale."""
        noise = NOISE[self.kind]
        return {
            "way": np.array([math.hypot(noise.way_scale, a.way_sigma) for a in self.alternatives]),
            "turn": np.array([math.hypot(noise.turn_scale, a.turn_sigma) for a in self.alternatives]),
        }

    def log_scale(self, name: str) -> FloatArray:
        """(A,) logarithm of the unit of a channel."""
        shares = _SCALE_SHARE[self.kind]
        return np.array([a.log_jacobian * shares[(name == "turn") != a.is_crossed] for a in self.alternatives])

    @cached_property
    def relative(self) -> FloatArray:
        """(A,) relative noise of turns."""
        return NOISE[self.kind].relative * np.array([a.relative for a in self.alternatives])


def log_posterior(stacks: Sequence[Stack], choice: Sequence[int], vary: int, level: float) -> FloatArray:
    """Log posterior (A,) of all alternatives of source ``vary``, the others as in ``choice``, at a ``level`` of the noise."""
    total = stacks[vary].own + sum(stack.own[c] for i, (stack, c) in enumerate(zip(stacks, choice, strict=True)) if i != vary)
    for name, size in (("way", WAY_M_S), ("turn", TURN_RAD_S)):
        used = [i for i, stack in enumerate(stacks) if stack.channel(name) is not None]
        if used:
            total = total + _channel_evidence(stacks, choice, vary, name, size, level, used)
    return np.asarray(total)


def scales(single: Sequence[Stack], name: str) -> list[tuple[float, float]]:
    """Logarithm of each source's scale on the channel ``name``, and its sigma; stacks of one alternative each. 0 and its prior where the
    source does not measure it."""
    used = [i for i, stack in enumerate(single) if stack.channel(name) is not None]
    found = [(0.0, float(stack.tau[name][0])) for stack in single]
    if used:
        size = WAY_M_S if name == "way" else TURN_RAD_S
        _, _, _, c, _, info = _profile(*_channel_inputs(single, [0] * len(single), 0, name, 1.0, used), size)
        for k, i in enumerate(used):
            found[i] = float(c[0, k]), 1.0 / math.sqrt(float(info[0, k]) + float(single[i].tau[name][0]) ** -2.0)
    return found


def _channel_evidence(
    stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, size: float, level: float, used: Sequence[int]
) -> FloatArray:
    inputs = _channel_inputs(stacks, choice, vary, name, level, used)
    _, known, _, _, tau, bias_sigma = inputs
    fitted = _profile(*inputs, size)
    own_size, of_size = _size_of_motion(*fitted[:3], size)
    found = _integrated(*fitted, known, own_size) + _scale_price(*fitted[3:], tau, bias_sigma) + of_size
    is_alone = known.any(axis=2).sum(axis=1) < 2
    return np.asarray(np.where(is_alone, _of_one_source(stacks, choice, vary, name, size, used), found))


def _of_one_source(stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, size: float, used: Sequence[int]) -> FloatArray:
    """Evidence (A,) of a channel that one source measures alone: of its unit, and of nothing else.

    Flat over motions up to the size of the source's rates: a map by which the robot moves less than its wheels turn explains nothing.
    """
    found = np.zeros(len(stacks[vary].alternatives))
    for i in used:
        mine = stacks[i].alone(name, size)
        found = found + (mine if i == vary else mine[choice[i]])
    return found


def _channel_inputs(
    stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, level: float, used: Sequence[int]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Channels (A, k, n), where they are known, floors (1, k, 1), relative noise, sigmas of scales (A, k) and of biases (1, k)."""
    A = len(stacks[vary].alternatives)
    rows = [slice(None) if i == vary else slice(choice[i], choice[i] + 1) for i in used]
    channels = [stacks[i].channel(name) for i in used]
    z = np.stack([np.broadcast_to(c[r], (A, c.shape[1])) for c, r in zip(channels, rows, strict=True) if c is not None], axis=1)
    known = np.isfinite(z)
    z = np.where(known, z, 0.0)
    noise = [NOISE[stacks[i].kind] for i in used]
    floor = level * np.array([n.turn_floor if name == "turn" else n.way_floor for n in noise])[None, :, None]
    if name == "turn":
        relative = level * np.stack([np.broadcast_to(stacks[i].relative[r], A) for i, r in zip(used, rows, strict=True)], axis=1)[..., None]
    else:
        relative = level * np.array([n.relative for n in noise])[None, :, None]
    tau = np.stack([np.broadcast_to(stacks[i].tau[name][r], A) for i, r in zip(used, rows, strict=True)], axis=1)
    bias_sigma = np.array([n.bias if name == "turn" else 0.0 for n in noise])[None, :]
    return z, known, floor, relative, tau, bias_sigma


def _profile(
    z: FloatArray, known: FloatArray, floor: FloatArray, relative: FloatArray, tau: FloatArray, bias_sigma: FloatArray, size: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Channels less bias (A, k, n), scales (A, k, n) and variances (A, k, n); logarithms of the scales, biases (A, k), information (A, k)
    on the scales: the maximum of the posterior by alternation with the motion."""
    count = z.shape[1]
    c, b = _first_scales(z, known, tau), np.zeros(z.shape[:2])
    info = np.zeros(z.shape[:2])
    for _ in range(_ITERATIONS):
        scale, less = np.exp(c)[..., None], z - b[..., None]
        variance = np.where(known, floor**2, np.inf)
        x = _motion(less, scale, variance, size)
        variance = np.where(known, floor**2 + (relative * scale * x) ** 2, np.inf)
        x = _motion(less, scale, variance, size)
        # a residual beyond three sigma counts less (Cauchy)
        weight = 1.0 / (variance * (1.0 + (less - scale * x) ** 2 / (9.0 * np.where(known, variance, 1.0))))
        weight = np.where(known, weight, 0.0)
        if count > 1:
            ratio = np.clip((weight * less * x).sum(2) / ((weight * x * x).sum(2) + 1e-12), 1e-4, 1e4)
            info = TEMPER * (weight * x * x).sum(2) * ratio**2
            c = np.log(ratio) * info / (info + tau**-2.0)
            flat = (weight).sum(2) * TEMPER
            residual = (weight * (z - np.exp(c)[..., None] * x)).sum(2) * TEMPER
            b = np.where(bias_sigma > 0.0, residual / (flat + np.where(bias_sigma > 0.0, bias_sigma, 1.0) ** -2.0), 0.0)
    scale = np.exp(c)[..., None]
    variance = np.where(known, floor**2 + (relative * scale * x) ** 2, 1.0)
    return z - b[..., None] * known, np.where(known, scale, 0.0), variance, c, b, info


def _first_scales(z: FloatArray, known: FloatArray, tau: FloatArray) -> FloatArray:
    """Logarithms of the scales (A, k) by the source whose own is known best: from there the alternation with the motion converges."""
    best = tau.argmin(axis=1)
    rows = np.arange(len(z))
    reference = z[rows, best][:, None]
    both = known & known[rows, best][:, None]
    ratio = np.where(both, z * reference, 0.0).sum(2) / (np.where(both, reference**2, 0.0).sum(2) + 1e-12)
    return np.where(ratio > 0.0, np.log(np.clip(ratio, 1e-4, 1e4)), 0.0)


def _size_of_motion(z: FloatArray, a: FloatArray, variance: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Standard deviation (A, 1) of the motion of this drive, and the logarithm of its prior density (A,): slow robots and fast ones."""
    x = (z * a / variance).sum(1) / ((a * a / variance).sum(1) + size**-2.0)
    own = np.sqrt(np.mean(x * x, axis=1) + (0.01 * size) ** 2)
    return own[:, None], -0.5 * (np.log(own / size) / _SIZE_SIGMA) ** 2


def _motion(z: FloatArray, scale: FloatArray, variance: FloatArray, size: float) -> FloatArray:
    """Posterior mean of the motion (A, 1, n)."""
    return np.asarray(((z * scale / variance).sum(1) / ((scale**2 / variance).sum(1) + size**-2.0))[:, None])


def _integrated(
    z: FloatArray, a: FloatArray, variance: FloatArray, c: FloatArray, b: FloatArray, info: FloatArray, known: FloatArray, size: FloatArray
) -> FloatArray:
    """Tempered sum (A,) over the bins, with the motion integrated out; in some bins one source is off, in few all are."""
    count = z.shape[1]
    zz, az, aa = z * z / variance, a * z / variance, a * a / variance
    log_v, n = np.where(known, np.log(variance), 0.0), known * math.log(math.tau)
    out_variance = (np.exp(c) * size)[..., None] ** 2 + variance
    log_out = np.where(known, -0.5 * (z * z / out_variance + np.log(out_variance) + math.log(math.tau)), 0.0)

    def gaussian(zz: FloatArray, az: FloatArray, aa: FloatArray, log_v: FloatArray, n: FloatArray) -> FloatArray:
        C = aa + size**-2.0
        return -0.5 * (zz - az**2 / C + log_v + np.log(C * size**2) + n)

    sums = [part.sum(1) for part in (zz, az, aa, log_v, n)]
    parts = [math.log(1.0 - OUTLIER) + gaussian(*sums)]
    for i in range(count) if count > 2 else ():
        without = [s - part[:, i] for s, part in zip(sums, (zz, az, aa, log_v, n), strict=True)]
        parts.append(math.log(0.8 * OUTLIER / count) + gaussian(*without) + log_out[:, i])
    rest = 0.2 * OUTLIER if count > 2 else OUTLIER
    parts.append(math.log(rest) + log_out.sum(1))
    return np.asarray(TEMPER * np.logaddexp.reduce(parts, axis=0).sum(1))


def _scale_price(c: FloatArray, b: FloatArray, info: FloatArray, tau: FloatArray, bias_sigma: FloatArray) -> FloatArray:
    """Prior (A,) of scales and biases, and the width of their posterior (Laplace)."""
    price = 0.5 * (c / tau) ** 2 + 0.5 * np.log1p(info * tau**2)
    of_bias = 0.5 * np.where(bias_sigma > 0.0, b / np.where(bias_sigma > 0.0, bias_sigma, 1.0), 0.0) ** 2
    return np.asarray(-(price + of_bias).sum(1))
