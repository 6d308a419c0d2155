"""Evidence of a choice of alternatives, one a source, of all channels, with their priors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.evidence.alternatives.alternative import (
    LEVELS,
    STILL_M_S,
    STILL_RAD_S,
    TEMPER,
    TURN_RAD_S,
    WAY_M_S,
    Alternative,
    size_of,
)
from localization.evidence.angles import BoolArray
from localization.evidence.channel import channel_evidence, log_size_prior
from localization.evidence.noise import NOISE
from localization.evidence.signals import Kind
from motion_models.se2 import FloatArray

_SKID_ODDS, _SKID_SIGMA = math.log(0.03), 0.4
"""Logarithm of the odds of a k that changes with speed, floor or load within a log, or that is unusual; sigma of its logarithm."""
_STANDS_ODDS = math.log(0.03)
"""Share of drives without a way, as turning in place, or without a turn."""
_AT_REST = 0.05
"""Part of a source's `Stack.sizes` up to which it stands."""
STILL = {"way": STILL_M_S, "turn": STILL_RAD_S}
_FAST = 5.0
"""Size of a fast robot's motion over `_SIZES`: 2.5 m/s, 3 rad/s."""
_SIZES = {"way": WAY_M_S, "turn": TURN_RAD_S}
Choice = tuple[int, ...]
"""Index of an alternative, by source."""
Choices = NDArray[np.intp]
"""(A, sources) choices."""
_HAS_SIDE: frozenset[Kind] = frozenset(("lidar", "reference"))
"""Sources that measure sideways motion as well, in the unit of the way."""


class Levels(NamedTuple):
    """Factors on the noise of a log."""

    sensors: float
    wheels: float
    """That of the sensors at least: no floor is as quiet as they are."""


NOISE_LEVELS = [Levels(sensors, wheels) for sensors in LEVELS for wheels in LEVELS if wheels >= sensors]
"""Those of which each log has one, equally probable before."""


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
    jitter: Mapping[str, float] = field(default_factory=dict)
    """Noise of the way and of the turn over a bin that the source itself shows, at any level, in its own unit."""

    @cached_property
    def sizes(self) -> Mapping[str, float]:
        """Size of the way [m/s] and of the turn [rad/s], the largest by any wiring or axis in the file's units; of what is no motion at
        least."""
        if self.raw:
            return self.raw
        sizes = dict(STILL)
        in_units = [a for a in self.alternatives if np.all(np.array(a.units[0]) == 1.0) and np.all(np.array(a.units[1]) == 1.0)]
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
        stands = mean_square < (_AT_REST * self.sizes[name] * self.unit(name)) ** 2
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
        found = sum(self._jacobians_of(name) for name in _SIZES if self.channel(name) is not None)
        return np.asarray(found + self._jacobians_of("way") if self.kind in _HAS_SIDE else found)

    def _jacobians_of(self, name: str) -> FloatArray:
        """(A, n) tempered logarithm of the Jacobian of a channel: what counts nothing at rest does so in any unit."""
        channel = self.channel(name)
        assert channel is not None
        log_unit = self.log_unit(name)
        of_sides = np.array([[a.has_two_units] for a in self.alternatives])
        if of_sides.any():
            log_unit = np.where(of_sides & (log_unit > 0.0), np.minimum(log_unit, self._log_growth(name, channel)), log_unit)
        return np.asarray(TEMPER * np.where(np.isfinite(channel) & self._is_scaled, log_unit, 0.0))

    def _log_growth(self, name: str, channel: FloatArray) -> FloatArray:
        """(A, n) logarithm of a channel's noise over that by the robot file, at which the Jacobian of a side's larger unit ends.

        Way and turn have less of that noise than the side itself, and a unit would gain where sensors agree no better.
        """
        log_noise = np.log(np.hypot(self._floors[name], NOISE[self.kind].relative * channel))
        return np.asarray(log_noise - log_noise[0])

    def log_unit(self, name: str) -> FloatArray:
        """(A, n) logarithm of the unit of a channel."""
        return self._log_units[name]

    def unit(self, name: str) -> FloatArray:
        """(A,) largest unit of a channel over the bins."""
        return self._largest_units[name]

    @cached_property
    def _largest_units(self) -> dict[str, FloatArray]:
        return {name: np.exp(log_unit.max(axis=1)) for name, log_unit in self._log_units.items() if log_unit.shape[1]}

    @cached_property
    def _log_units(self) -> dict[str, FloatArray]:
        found = {}
        for (name, channel), of_name in zip(self._channels.items(), zip(*(a.units for a in self.alternatives), strict=True), strict=True):
            found[name] = np.zeros((len(self.alternatives), 0 if channel is None else channel.shape[1]))
            for row, of_one in zip(found[name], of_name, strict=True):
                row[:] = np.log(of_one)
        return found

    def floor(self, name: str) -> FloatArray:
        """(A, n) noise of a channel, or of turns while "skidding", that does not grow with the channel itself; that of turns grows with the
        way. It is in the unit of the channel, so that no unit has less noise than another."""
        return self._floors[name]

    def level(self, levels: Levels) -> float:
        """Factor on its noise."""
        return levels.wheels if self._counts else levels.sensors

    def noise_floor(self, name: str, levels: Levels) -> FloatArray:
        """(A, n) `floor` at ``levels`` of the noise, with what the source itself shows."""
        channel = "turn" if name == "skidding" else name
        own, floor = self.jitter.get(channel, 0.0), self.level(levels) * self.floor(name)
        return np.hypot(floor, own * self.unit(channel)[:, None]) if own else floor

    def alike(self, name: str) -> Choices:
        """(A,) index of the first alternative by which a channel is the same, with its noise and its unit."""
        return self._alike[name]

    @cached_property
    def _alike(self) -> dict[str, Choices]:
        found = {}
        for name in _SIZES:
            parts = [self.tau[name][:, None], self.log_unit(name)]
            parts += [a for a in (self.channel(name), self._floors.get(name)) if a is not None]
            parts += [self._floors["skidding"]] if name == "turn" and "skidding" in self._floors else []
            rows = np.hstack(parts)
            first: dict[bytes, int] = {}
            found[name] = np.array([first.setdefault(row.tobytes(), i) for i, row in enumerate(rows)])
        return found

    @cached_property
    def _floors(self) -> dict[str, FloatArray]:
        noise, way = NOISE[self.kind], self.channel("way")
        found = {}
        for name, floor in noise.floors.items():
            if self.channel(name) is None:
                continue
            scaled = floor * (self.sizes[name] if self._counts else 1.0) * np.exp(self.log_unit(name))
            found[name] = np.where(self._is_scaled, scaled, STILL[name])
        if "turn" in found:
            by_way = 0.0 if way is None else np.exp(self.log_unit("turn") - self.log_unit("way")) * np.nan_to_num(way)
            found["skidding"] = np.hypot(found["turn"], noise.skid_of_way * by_way)
            found["turn"] = np.hypot(found["turn"], noise.turn_of_way * by_way)
        turn = self.channel("turn")
        if "way" in found and turn is not None:
            by_turn = np.exp(self.log_unit("way") - self.log_unit("turn")) * np.nan_to_num(turn)
            found["way"] = np.hypot(found["way"], noise.way_of_turn * by_turn)
        return found

    @property
    def _counts(self) -> bool:
        """Whether the source counts encoders."""
        return self.kind in ("wheels", "driver")

    @cached_property
    def _is_scaled(self) -> BoolArray:
        """(n,) where the source's rates have a unit: encoders have none where all are still, other sensors have noise there."""
        of_rates = [
            np.max(np.abs(np.nan_to_num(channel)) / np.exp(self.log_unit(name)), axis=0) / self.sizes[name]
            for name, channel in self._channels.items()
            if channel is not None
        ]
        return np.asarray(np.max(of_rates, axis=0) > (_AT_REST if self._counts else -1.0))

    def known(self, name: str) -> FloatArray:
        """(A,) bins in which a channel is known."""
        channel = self.channel(name)
        assert channel is not None
        return np.asarray(np.isfinite(channel).sum(axis=1))

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


def varied(choice: Choice, index: int, stack: Stack) -> Choices:
    """``choice`` with each alternative of source ``index``, whose ``stack`` it is."""
    found = np.repeat(np.array([choice]), len(stack.alternatives), axis=0)
    found[:, index] = np.arange(len(found))
    return found


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of choices among the alternatives of ``stacks``.

    Most choices differ from others in one channel, or in rows that no channel shows: what was computed of a channel is kept.
    """

    stacks: Sequence[Stack]
    _known: dict[tuple[str, Levels], dict[Choice, FloatArray]] = field(default_factory=dict)
    """Evidence (n,) by channel, levels of the noise, and index of the first alternative of each source with the same channel."""

    def with_more(self, stacks: Sequence[Stack]) -> Evidence:
        """The evidence of ``stacks``, which have further alternatives behind those that were there."""
        return Evidence(stacks, self._known)

    def log_posterior(self, choices: Choices, levels: Levels) -> FloatArray:
        """Log posterior (A,) of ``choices`` at these ``levels`` of the noise."""
        own = sum(stack.own[rows] for stack, rows in zip(self.stacks, choices.T, strict=True))
        return np.asarray(own + self.by_bin(choices, levels).sum(axis=1))

    def by_bin(self, choices: Choices, levels: Levels) -> FloatArray:
        """(A, n) the part of `log_posterior` that the sources have of each other."""
        names = [name for name in _SIZES if any(stack.channel(name) is not None for stack in self.stacks)]
        return np.asarray(sum(self._of_channel(choices, name, levels) for name in names))

    def _of_channel(self, choices: Choices, name: str, levels: Levels) -> FloatArray:
        known = self._known.setdefault((name, levels), {})
        firsts = [tuple(row) for row in np.stack([s.alike(name)[k] for s, k in zip(self.stacks, choices.T, strict=True)], axis=1).tolist()]
        new = [first for first in dict.fromkeys(firsts) if first not in known]
        if new:
            known.update(zip(new, _evidence(self.stacks, np.array(new), name, levels), strict=True))
        return np.array([known[first] for first in firsts])


def scales(single: Sequence[Stack], name: str) -> list[tuple[float, float]]:
    """Logarithm of each source's scale on the channel ``name``, and its sigma; stacks of one alternative each. 0 and its prior where the
    source does not measure it."""
    used = [i for i, stack in enumerate(single) if stack.channel(name) is not None]
    found = [(0.0, float(stack.tau[name][0])) for stack in single]
    if used:
        inputs = _inputs(single, np.zeros((1, len(single)), int), name, Levels(1.0, 1.0), used)
        _, _, c, information = channel_evidence(*inputs, _SIZES[name], _at_rest(single, np.zeros((1, len(single)), int), name, used))
        for k, i in enumerate(used):
            found[i] = float(c[0, k]), 1.0 / math.sqrt(float(information[0, k]) + float(single[i].tau[name][0]) ** -2.0)
    return found


def least_sizes(stacks: Sequence[Stack], choices: Choices, name: str) -> FloatArray:
    """Size (A,) of the motion below which the robot stands, or goes straight on: what is smaller explains no more the smaller it is.

    It is part of the largest that its sensors may have measured, in the robot file's unit or in that of the choice, or of a fast robot's.
    """
    measured = [s.sizes[name] * np.maximum(s.unit(name)[rows], 1.0) for s, rows in zip(stacks, choices.T, strict=True) if name in s.sizes]
    largest = np.max([*measured, np.zeros(len(choices))], axis=0)
    return np.asarray(np.maximum(_AT_REST * np.minimum(largest, _FAST * _SIZES[name]), STILL[name]))


def _at_rest(stacks: Sequence[Stack], choices: Choices, name: str, used: Sequence[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`least_sizes` (A,), the size (A, n) of the motion of a robot that stands, where encoders count in its unit, and (k, n) 1 where the
    sources ``used`` show their scale."""
    units = [
        np.where(stack._is_scaled, np.maximum(np.exp(stack.log_unit(name)[rows]), 1.0), 1.0)
        for stack, rows in zip(stacks, choices.T, strict=True)
        if stack.channel(name) is not None
    ]
    is_scaled = np.array([stacks[i]._is_scaled for i in used], dtype=float)
    return least_sizes(stacks, choices, name), np.asarray(STILL[name] * np.max(units, axis=0)), is_scaled


def _evidence(stacks: Sequence[Stack], choices: Choices, name: str, levels: Levels) -> FloatArray:
    """Evidence (A, n) by bin of one channel, at ``levels`` of the noise; what concerns all bins is spread over them."""
    used = [i for i, stack in enumerate(stacks) if stack.channel(name) is not None]
    inputs = z, floor, relative, tau, bias_sigma = _inputs(stacks, choices, name, levels, used)
    size, at_rest = _SIZES[name], _at_rest(stacks, choices, name, used)
    of_bins, price, _, _ = channel_evidence(*inputs, size, at_rest)
    skids = np.array([NOISE[stacks[i].kind].skid_relative for i in used])
    slips = np.array([NOISE[stacks[i].kind].relative for i in used])
    for part in (skids, slips) if name == "turn" and skids.any() else ():
        skidding = np.stack([stacks[i].noise_floor("skidding", levels)[choices[:, i]] for i in used], axis=1)
        skidding = np.where(skids[:, None] > 0.0, skidding, floor)
        of_share = np.ascontiguousarray(np.where(skids > 0.0, levels.wheels * part, relative))
        of_k = np.ascontiguousarray(np.where(skids > 0.0, np.maximum(tau, _SKID_SIGMA), tau))
        of_sliding, price_of_sliding, _, _ = channel_evidence(z, skidding, of_share, of_k, bias_sigma, size, at_rest)
        is_better = of_sliding.sum(axis=1) + price_of_sliding + _SKID_ODDS > of_bins.sum(axis=1) + price
        of_bins = np.where(is_better[:, None], of_sliding, of_bins)
        price = np.where(is_better, price_of_sliding + _SKID_ODDS, price)
    is_alone = np.isfinite(z).any(axis=2).sum(axis=1) < 2
    found = of_bins + price[:, None] / z.shape[2]
    if is_alone.any():
        found[is_alone] = (_of_one_source(stacks, choices, name, used, at_rest[0]) / z.shape[2])[is_alone, None]
    return np.asarray(found)


def _of_one_source(stacks: Sequence[Stack], choices: Choices, name: str, used: Sequence[int], least: FloatArray) -> FloatArray:
    """Evidence (A,) of a channel that one source measures alone: of its unit, and of nothing else.

    Flat over motions up to the size of the source's rates, and of the ``least`` motion (A,) as beside other sources: a map by which the
    robot moves less than its wheels turn explains nothing.
    """
    found = np.zeros(len(choices))
    for i in used:
        rows = choices[:, i]
        smaller = np.log(np.maximum(least / stacks[i].sizes[name], 1.0))
        found += stacks[i].alone[name][rows] - TEMPER * stacks[i].known(name)[rows] * smaller
    return found


def _inputs(
    stacks: Sequence[Stack], choices: Choices, name: str, levels: Levels, used: Sequence[int]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Channels and floors (A, k, n), relative noise (A, k), sigmas of scales (A, k) and of biases (k,)."""
    rows = {i: choices[:, i] for i in used}
    z = np.stack([c[r] for i, r in rows.items() if (c := stacks[i].channel(name)) is not None], axis=1)
    floor = np.stack([stacks[i].noise_floor(name, levels)[r] for i, r in rows.items()], axis=1)
    tau = np.stack([stacks[i].tau[name][r] for i, r in rows.items()], axis=1)
    noise = [NOISE[stacks[i].kind] for i in used]
    relative = np.repeat([[stacks[i].level(levels) * n.relative for i, n in zip(used, noise, strict=True)]], len(choices), axis=0)
    bias_sigma = np.array([n.bias if name == "turn" else 0.0 for n in noise])
    return z, floor, relative, tau, bias_sigma
