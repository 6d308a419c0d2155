"""Evidence of a choice of alternatives, one a source, of all channels, with their priors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from localization.evidence.alternatives.alternative import (
    STILL_M_S,
    STILL_RAD_S,
    TEMPER,
    TURN_RAD_S,
    WAY_M_S,
    Alternative,
    size_of,
)
from localization.evidence.channel import channel_evidence, log_size_prior
from localization.evidence.signals import BoolArray, Kind
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
    skid_relative: float = 0.0
    """Part of the turns where the robot turns by a changing part of what its wheels turn (`_SKID_ODDS`)."""


NOISE: Mapping[Kind, Noise] = {
    "wheels": Noise(0.15, 0.03, 0.02, 0.25, 0.08, skid_relative=1.2),
    "driver": Noise(0.15, 0.03, 0.02, 0.05, 0.08, skid_relative=1.2),
    "gyro": Noise(0.04, 0.01, 0.0, 0.03, 0.0, bias=0.03),
    "lidar": Noise(0.06, 0.02, 0.02, 0.01, 0.04),
    "reference": Noise(0.05, 0.02, 0.02, 0.01, 0.02),
}
"""Measured on fr079, MIT-CSAIL, ACES and the Husky of `tests/data`; the level is estimated in each log (`LEVELS`)."""
_SKID_ODDS, _SKID_SIGMA = math.log(0.03), 0.4
"""Logarithm of the odds of a k that changes with speed, floor or load within a log, or that is unusual; sigma of its logarithm."""
_STANDS_ODDS = math.log(0.03)
"""Share of drives without a way, as turning in place, or without a turn."""
_AT_REST = 0.05
"""Part of the root mean square of a source's rates up to which it stands."""
_SIZES = {"way": WAY_M_S, "turn": TURN_RAD_S}
Choice = tuple[int, ...]
"""Index of an alternative, by source."""
_SCALE_SHARE: Mapping[Kind, tuple[float, float]] = {
    "wheels": (0.5, 0.5),
    "driver": (1.0, 0.0),
    "gyro": (0.0, 1.0),
    "lidar": (0.5, 0.0),
    "reference": (0.5, 0.0),
}
"""Part of `Alternative.log_jacobian` that is the logarithm of the unit of the way, and of the turn."""


@dataclass(frozen=True, eq=False)
class Stack:
    """All alternatives of one source."""

    kind: Kind
    alternatives: Sequence[Alternative]
    raw: Mapping[str, float] = field(default_factory=dict)
    """`sizes`, where ``alternatives`` are not all of them."""
    behind_s: float | None = None
    """`Source.behind_s`."""
    t: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n,) begin of each bin [s]."""

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """Size of the way [m/s] and of the turn [rad/s], the largest by any wiring or axis in the file's units; of what is no motion at
        least."""
        if self.raw:
            return self.raw
        sizes = {"way": STILL_M_S, "turn": STILL_RAD_S}
        in_units = [a for a in self.alternatives if not np.any(a.log_jacobian)]
        of = {name: [size_of(c) for a in in_units if (c := getattr(a, name)) is not None and np.isfinite(c).any()] for name in sizes}
        return {name: max([least, *of[name]]) for name, least in sizes.items() if getattr(self.alternatives[0], name) is not None}

    def only(self, k: int) -> Stack:
        """The stack with alternative ``k`` alone."""
        return self.of([self.alternatives[k]])

    def of(self, alternatives: Sequence[Alternative]) -> Stack:
        """The stack with other ``alternatives`` of the source, its sizes as they are."""
        return replace(self, alternatives=alternatives, raw=self.sizes)

    @cached_property
    def alone(self) -> Mapping[str, FloatArray]:
        """Evidence (A,) by channel, where no other source measures it; 0 where it is unknown."""
        return {name: self._alone(name, channel, _SIZES[name]) for name, channel in self._channels.items() if channel is not None}

    def _alone(self, name: str, channel: FloatArray, size: float) -> FloatArray:
        known = np.isfinite(channel)
        mean_square = (np.where(known, channel, 0.0) ** 2).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        plausible = log_size_prior(0.5 * np.log(mean_square / size**2 + 1e-4))
        stands = mean_square < (_AT_REST * self.sizes[name] * np.exp(self._log_unit(name).max(axis=1))) ** 2
        plausible = np.where(stands, np.maximum(plausible, _STANDS_ODDS), plausible)
        log_size = math.log(self.sizes[name]) + 0.5 * (1.0 + math.log(math.tau))
        of_unit = self._jacobians_of(name).sum(axis=1)
        return np.asarray(np.where(known.any(axis=1), plausible - TEMPER * known.sum(axis=1) * log_size - of_unit, 0.0))

    @cached_property
    def own(self) -> FloatArray:
        """(A,) prior and evidence by the source alone, with the Jacobians."""
        return np.asarray(np.array([a.log_prior + a.own for a in self.alternatives]) + self.log_jacobians.sum(axis=1))

    @cached_property
    def log_jacobians(self) -> FloatArray:
        """(A, n) tempered logarithm of the Jacobian of each bin, of all channels; what is sideways moves as the way does."""
        of_side = 1.0 - sum(_SCALE_SHARE[self.kind])
        shares = {name: share for name, share in zip(_SIZES, _SCALE_SHARE[self.kind], strict=True) if self.channel(name) is not None}
        found = sum(self._jacobians_of(name) for name in shares)
        if of_side > 0.0:
            found = found + of_side / shares["way"] * self._jacobians_of("way")
        return np.asarray(found)

    def _jacobians_of(self, name: str) -> FloatArray:
        """(A, n) tempered logarithm of the Jacobian of a channel, for encoders where they move: at rest they count nothing in any unit."""
        channel = self.channel(name)
        assert channel is not None
        names = list(_SIZES) if self.kind == "driver" else [name]  # a driver reckons both of the same wheels
        has_noise = self.kind not in ("wheels", "driver")  # at rest as well
        counts = np.isfinite(channel) if has_noise else np.any([self._is_moving(each) for each in names], axis=0)
        return np.asarray(TEMPER * self._log_unit(name) * counts)

    def _log_unit(self, name: str) -> FloatArray:
        """(A, n) logarithm of the unit of a channel."""
        channel, shares = self.channel(name), _SCALE_SHARE[self.kind]
        assert channel is not None
        of_each = [np.broadcast_to(shares[(name == "turn") != a.is_crossed] * a.log_jacobian, channel.shape[1:]) for a in self.alternatives]
        return np.stack(of_each)

    def _is_moving(self, name: str) -> BoolArray:
        """(A, n)"""
        channel = self.channel(name)
        assert channel is not None
        return np.array([np.abs(np.nan_to_num(z)) > _AT_REST * size_of(z) for z in channel])

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


def log_posterior(stacks: Sequence[Stack], choice: Sequence[int], vary: int, level: float) -> FloatArray:
    """Log posterior (A,) of all alternatives of source ``vary``, the others as in ``choice``, at a ``level`` of the noise."""
    others = sum(float(stack.own[c]) for i, (stack, c) in enumerate(zip(stacks, choice, strict=True)) if i != vary)
    return np.asarray(stacks[vary].own + others + evidence_by_bin(stacks, choice, vary, level).sum(axis=1))


def evidence_by_bin(stacks: Sequence[Stack], choice: Sequence[int], vary: int, level: float) -> FloatArray:
    """(A, n) the part of `log_posterior` that the sources have of each other."""
    names = [name for name in _SIZES if any(stack.channel(name) is not None for stack in stacks)]
    return np.asarray(sum(_evidence(stacks, choice, vary, name, level) for name in names))


def scales(single: Sequence[Stack], name: str) -> list[tuple[float, float]]:
    """Logarithm of each source's scale on the channel ``name``, and its sigma; stacks of one alternative each. 0 and its prior where the
    source does not measure it."""
    used = [i for i, stack in enumerate(single) if stack.channel(name) is not None]
    found = [(0.0, float(stack.tau[name][0])) for stack in single]
    if used:
        inputs = _inputs(single, [0] * len(single), 0, name, 1.0, used)
        _, _, c, information = channel_evidence(*inputs, (_SIZES[name], 0.0))
        for k, i in enumerate(used):
            found[i] = float(c[0, k]), 1.0 / math.sqrt(float(information[0, k]) + float(single[i].tau[name][0]) ** -2.0)
    return found


def _evidence(stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, level: float) -> FloatArray:
    """Evidence (A, n) by bin of one channel, at a level of the noise; what concerns all bins is spread over them."""
    used = [i for i, stack in enumerate(stacks) if stack.channel(name) is not None]
    inputs = z, floor, relative, tau, bias_sigma = _inputs(stacks, choice, vary, name, level, used)
    sizes = _SIZES[name], min(stacks[i].sizes[name] for i in used)
    of_bins, price, _, _ = channel_evidence(*inputs, sizes)
    skids = np.array([NOISE[stacks[i].kind].skid_relative for i in used])
    for share in (level * skids, relative) if name == "turn" and skids.any() else ():  # k changes, or is unusual
        of_share = np.ascontiguousarray(np.where(skids > 0.0, share, relative))
        of_k = np.ascontiguousarray(np.where(skids > 0.0, np.maximum(tau, _SKID_SIGMA), tau))
        of_sliding, price_of_sliding, _, _ = channel_evidence(z, floor, of_share, of_k, bias_sigma, sizes)
        is_better = of_sliding.sum(axis=1) + price_of_sliding + _SKID_ODDS > of_bins.sum(axis=1) + price
        of_bins = np.where(is_better[:, None], of_sliding, of_bins)
        price = np.where(is_better, price_of_sliding + _SKID_ODDS, price)
    is_alone = np.isfinite(z).any(axis=2).sum(axis=1) < 2
    found = of_bins + price[:, None] / z.shape[2]
    if is_alone.any():
        found[is_alone] = (_of_one_source(stacks, choice, vary, name, used) / z.shape[2])[is_alone, None]
    return np.asarray(found)


def _of_one_source(stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, used: Sequence[int]) -> FloatArray:
    """Evidence (A,) of a channel that one source measures alone: of its unit, and of nothing else.

    Flat over motions up to the size of the source's rates: a map by which the robot moves less than its wheels turn explains nothing.
    """
    found = np.zeros(len(stacks[vary].alternatives))
    for i in used:
        mine = stacks[i].alone[name]
        found = found + (mine if i == vary else mine[choice[i]])
    return found


def _inputs(
    stacks: Sequence[Stack], choice: Sequence[int], vary: int, name: str, level: float, used: Sequence[int]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Channels (A, k, n), floors (k,), relative noise (A, k), sigmas of scales (A, k) and of biases (k,)."""
    A = len(stacks[vary].alternatives)
    rows = [slice(None) if i == vary else slice(choice[i], choice[i] + 1) for i in used]
    channels = [stacks[i].channel(name) for i in used]
    z = np.stack([np.broadcast_to(c[r], (A, c.shape[1])) for c, r in zip(channels, rows, strict=True) if c is not None], axis=1)
    noise = [NOISE[stacks[i].kind] for i in used]
    is_turn = name == "turn"
    floor = level * np.array([n.turn_floor if is_turn else n.way_floor for n in noise])
    relative = level * np.broadcast_to([n.relative for n in noise], (A, len(used)))
    tau = np.stack([np.broadcast_to(stacks[i].tau[name][r], A) for i, r in zip(used, rows, strict=True)], axis=1)
    bias_sigma = np.array([n.bias if is_turn else 0.0 for n in noise])
    z, relative, tau = (np.ascontiguousarray(each) for each in (z, relative, tau))  # else each layout is compiled
    return z, floor, relative, tau, bias_sigma
