"""The most probable set-ups: from the robot file's, then one more row beside the best, again and again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from localization.evidence.alternatives import MAKERS, Alternative, Row
from localization.evidence.alternatives.alternative import correction, size_of, unrelated_evidence
from localization.evidence.changes import with_changes
from localization.evidence.delays import candidate_delays
from localization.evidence.likelihood import NOISE_LEVELS, Choice, Evidence, Levels, Stack, least_sizes, varied
from localization.evidence.sensor_errors import CLOCKS, clock_odds, describe_size, late_odds
from localization.evidence.signals import Source
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_WIDTHS = (8, 6, 5, 3)
"""Choices that are expanded by one more row, by depth: three faults at once are found, and the one beside them."""
_SAME = 0.2
"""Relative difference of channels that are the same."""
_SAME_DELAY_S = 0.15
"""Difference of delays that are the same alignment [s]: between candidates of three sources, and latencies."""
_RESCORED = 50
"""Best choices whose evidence is integrated over the level of the noise."""
_FAR = 30.0
"""Logarithm of the evidence below the best at any level, beyond which no level brings a choice back."""
_CHANGED = 3
"""Best choices of which one source is tried with a change within the log."""
_SEARCH_LEVELS = Levels(0.35, 0.35), Levels(0.35, 1.0), Levels(1.0, 1.0)
"""Levels of the noise at which set-ups are searched."""
_MAX_BINS = 140
_LATENCY_TAIL_S, _SYNCHRONIZED_S = 0.2, 0.02
"""Latency from a measurement to its recording, from where on longer ones are rarer as 1 / x^2 [s]: queues of scans reach 0.7 s. Nothing is
recorded before it is measured, but for clocks of computers, which NTP synchronizes to 20 ms."""
_UNRELATED_ODDS = math.log(1e-5)
"""Prior odds of a source that measures another motion, or none: another robot's, a frozen sensor, a fault that no row has."""

IntArray = NDArray[np.intp]


def clock_row(source: Source, delay_s: float) -> Row:
    """Stamps that are late by ``delay_s``."""
    name = {"driver": "wheels"}.get(source.kind, source.kind)
    error, (odds, is_fault) = CLOCKS.get(source.kind), late_odds(delay_s)
    text = describe_size(("its stamps are {} late", "its stamps are {} early"), "s", delay_s) if error is None else error.describe(delay_s)
    correct = correction(error, delay_s) if error is not None and is_fault else None
    return Row(f"clock.{name}", text, odds, value=delay_s, correct=correct, is_fault=is_fault)


def make_stacks(sources: Sequence[Source], edges: FloatArray, robot: Robot) -> list[Stack]:
    """All alternatives of each source at each of its delays; the robot file's is the first."""
    delays = candidate_delays(sources, edges)
    at_zero = [source.rates(edges) for source in sources]
    bins = _moving_bins(sources, at_zero)
    stacks = []
    sizes = [_sizes_of_motion(source, rates[bins]) for source, rates in zip(sources, at_zero, strict=True)]
    for i, (source, of_source) in enumerate(zip(sources, delays, strict=True)):
        found: list[Alternative] = []
        source = replace(source, sizes_by_others={n: s for of_other in (*sizes[:i], *sizes[i + 1 :]) for n, s in of_other.items()})
        for delay in of_source:
            rates = source.rates(edges, delay)[bins]
            second = source.rates(edges, delay, of_second=True)[bins] if source.second is not None else np.full_like(rates, np.nan)
            rows = (clock_row(source, delay),) if delay else ()
            found += [replace(a, rows=(*a.rows, *rows), delay_s=delay) for a in MAKERS[source.kind](source, rates, second, robot)]
        jitter = {name: math.sqrt(2.0) * of / (edges[1] - edges[0]) for name, of in zip(("way", "turn"), source.jitter, strict=True)}
        stacks.append(Stack(source.kind, found, behind_s=source.behind_s, t=edges[bins], jitter=jitter))
    least = {name: float(least_sizes(stacks, np.zeros((1, len(stacks)), int), name)[0]) for name in ("way", "turn")}
    for i, (source, stack) in enumerate(zip(sources, stacks, strict=True)):
        of_others = [other.alternatives[0] for other in (*stacks[:i], *stacks[i + 1 :])]
        found = [*stack.alternatives, _unrelated(source, stack.alternatives[0], of_others, least)]
        if sum(other.kind == source.kind for other in sources) > 1:
            found = [replace(a, rows=tuple(_row_of(source.name, row) for row in a.rows)) for a in found]
        stacks[i] = stack.of(found)
    return stacks


def _row_of(name: str, row: Row) -> Row:
    """``row`` of one of several sources of a kind, whose clock has no entry of its own in the robot file."""
    return replace(row, of=name, correct=None if row.source == "clock" else row.correct)


def _sizes_of_motion(source: Source, rates: FloatArray) -> dict[str, float]:
    """Root mean square of the way [m/s] and of the turn [rad/s] that a source measures, however it is mounted."""
    if source.kind == "gyro":
        return {"turn": size_of(np.linalg.norm(rates, axis=1))}
    if source.kind == "driver":
        return {"way": size_of(rates[:, 0])}  # its turns skid
    if source.kind == "wheels":
        return {}
    return {"way": size_of(np.linalg.norm(rates[:, :2], axis=1)), "turn": size_of(rates[:, 2])}


def _moving_bins(sources: Sequence[Source], rates: Sequence[FloatArray]) -> IntArray:
    """Bins (m,) with the most motion by any source, in order, and a fifth of bins at rest, up to `_MAX_BINS`."""
    n = len(rates[0])
    if n <= _MAX_BINS:
        return np.arange(n)
    size = np.zeros(n)
    for values in rates:
        magnitude = np.linalg.norm(np.nan_to_num(values), axis=1)
        size = np.maximum(size, magnitude / max(float(np.percentile(magnitude, 95.0)), 1e-9))
    moving = np.flatnonzero(size > 0.1)
    still = np.flatnonzero(size <= 0.1)
    take = np.concatenate([_thinned(moving, _MAX_BINS - min(len(still), _MAX_BINS // 5)), _thinned(still, _MAX_BINS // 5)])
    return np.sort(take)


def _thinned(rows: IntArray, most: int) -> IntArray:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def _unrelated(source: Source, by_file: Alternative, of_others: Sequence[Alternative], least: Mapping[str, float]) -> Alternative:
    """A source whose channels are of another motion than those ``of_others``: each has its own size, ``least`` at least as the robot's
    motion. What no other source measures stays: nothing contradicts it."""
    row = Row(f"{source.kind}.unrelated", f"{source.name} measures another motion than the others", _UNRELATED_ODDS)
    shared = {
        name: channel for name in ("way", "turn") if (channel := getattr(by_file, name)) is not None and _is_measured(of_others, name)
    }
    own = by_file.own + sum(unrelated_evidence(channel, least[name]) for name, channel in shared.items())
    return replace(by_file, rows=(row,), own=own, **{name: np.full_like(channel, np.nan) for name, channel in shared.items()})


def _is_measured(alternatives: Sequence[Alternative], name: str) -> bool:
    return any((channel := getattr(a, name)) is not None and np.isfinite(channel).any() for a in alternatives)


@dataclass(frozen=True)
class Found:
    """Result of a search."""

    scores: Mapping[Choice, float]
    """Log posterior by choice, of the best ones, the level of the noise integrated out."""
    against: Mapping[str, float]
    """By id of a row: logarithm of the Bayes factor against that fault alone."""
    stacks: Sequence[Stack]
    """With the alternatives that change within the log."""


def search(stacks: Sequence[Stack]) -> Found:
    """The best choices, and how far the drive refutes each single fault."""
    null = tuple(0 for _ in stacks)
    evidence = Evidence(stacks)
    found: dict[Choice, float] = {}
    against: dict[str, float] = {}
    for level in _SEARCH_LEVELS:
        for key, value in _search_at(evidence, null, level, found).items():
            against[key] = min(value, against.get(key, math.inf))
    best = [choice for choice in sorted(found, key=found.__getitem__, reverse=True)[:_RESCORED] if found[choice] > -_FAR]
    evidence, changed = with_changes(evidence, list(dict.fromkeys([*best[:_CHANGED], null])))
    simpler = [(*choice[:i], 0, *choice[i + 1 :]) for choice in best for i in range(len(stacks))]
    kept = list(dict.fromkeys([null, *best, *simpler, *changed]))
    return Found(dict(zip(kept, _marginal(evidence, kept).tolist(), strict=True)), against, evidence.stacks)


def _search_at(evidence: Evidence, null: Choice, level: Levels, found: dict[Choice, float]) -> dict[str, float]:
    """Add the best choices at a ``level`` to ``found``; the Bayes factors against single faults."""
    stacks = evidence.stacks
    at_level: dict[Choice, float] = {}
    done: set[Choice] = set()

    def expand(choice: Choice) -> None:
        done.add(choice)
        for i in range(len(stacks)):
            for k, value in enumerate(evidence.log_posterior(varied(choice, i, stacks[i]), level)):
                at_level[(*choice[:i], k, *choice[i + 1 :])] = float(value)

    expand(null)
    against = _against(stacks, null, at_level)
    for width in _WIDTHS:
        for choice in [c for c in sorted(at_level, key=at_level.__getitem__, reverse=True)[: 2 * width] if c not in done][:width]:
            expand(choice)
    best = sorted(at_level, key=at_level.__getitem__, reverse=True)[: _WIDTHS[0]]
    twins = [twin for choice in best for twin in (*_mirrored(stacks, choice), *_shifted(stacks, choice))]
    if twins:
        at_level.update(zip(twins, evidence.log_posterior(np.array(twins), level).tolist(), strict=True))
        for choice in sorted({*best, *twins}, key=at_level.__getitem__, reverse=True)[: _WIDTHS[0]]:
            if choice not in done:
                expand(choice)
    best = sorted(at_level, key=at_level.__getitem__, reverse=True)[:_RESCORED]
    top = at_level[best[0]]
    for choice in best:
        found[choice] = max(found.get(choice, -math.inf), at_level[choice] - top)
    return against


def _against(stacks: Sequence[Stack], null: Choice, scores: Mapping[Choice, float]) -> dict[str, float]:
    """By id of a row: logarithm of the Bayes factor of the robot file's set-up over that fault alone."""
    found: dict[str, float] = {}
    for choice, score in scores.items():
        faults = [row for row in rows_of(stacks, choice) if row.is_fault]
        if len(faults) == 1:
            key = faults[0].id
            found[key] = min(found.get(key, math.inf), scores[null] - score + faults[0].log_odds)
    return found


def _mirrored(stacks: Sequence[Stack], choice: Choice) -> list[Choice]:
    """Choices by which the robot moves backwards, to the other side, or both, for all sources or for all but one.

    They differ in several sources at once, so that no change of one source leads to them.
    """
    found = []
    for signs in ({"way": -1.0, "turn": 1.0}, {"way": 1.0, "turn": -1.0}, {"way": -1.0, "turn": -1.0}):
        mirrors = [_mirror_of(stack, k, signs) for stack, k in zip(stacks, choice, strict=True)]
        for kept in (None, *range(len(stacks))):
            twin = [k if i == kept else mirror for i, (k, mirror) in enumerate(zip(choice, mirrors, strict=True))]
            if all(k is not None for k in twin):
                found.append(tuple(k for k in twin if k is not None))
    return found


def _shifted(stacks: Sequence[Stack], choice: Choice) -> list[Choice]:
    """Choices with the same delays between the sources by which another source's clock is right.

    As mirrored ones, they differ in each source at once.
    """
    delays = np.array([stack.alternatives[k].delay_s for stack, k in zip(stacks, choice, strict=True)])
    found = []
    for zero in np.unique(delays[delays != 0.0]):
        shifted = [_at_delay(stack, k, delay) for stack, k, delay in zip(stacks, choice, delays - zero, strict=True)]
        if all(k is not None for k in shifted):
            found.append(tuple(k for k in shifted if k is not None))
    return found


def _at_delay(stack: Stack, k: int, delay_s: float) -> int | None:
    """The alternative of a source with the rows of alternative ``k``, but for the clock, whose delay is nearest ``delay_s``; None where
    none is near."""
    wanted = _rows_but_clock(stack.alternatives[k])
    like = [(abs(a.delay_s - delay_s), i) for i, a in enumerate(stack.alternatives) if _rows_but_clock(a) == wanted]
    distance, nearest = min(like)
    return nearest if distance < _SAME_DELAY_S else None


def _rows_but_clock(alternative: Alternative) -> tuple[tuple[str, str], ...]:
    return tuple(row.key for row in alternative.rows if row.source != "clock")


def _mirror_of(stack: Stack, k: int, signs: Mapping[str, float]) -> int | None:
    """The most probable alternative of one source, at the same delay, whose channels are those of alternative ``k`` times ``signs``."""
    delays = np.array([a.delay_s for a in stack.alternatives])
    fits = delays == delays[k]
    for name, sign in signs.items():
        channels = stack.channel(name)
        if channels is not None:
            wanted = np.nan_to_num(sign * channels[k])
            error = ((np.nan_to_num(channels) - wanted) ** 2).sum(axis=1)
            fits &= error < _SAME**2 * (wanted**2).sum() + 1e-12
    return int(np.flatnonzero(fits)[stack.own[fits].argmax()]) if fits.any() else None


def _marginal(evidence: Evidence, choices: Sequence[Choice]) -> FloatArray:
    """Log posterior (A,) of ``choices``, integrated over the level of the noise."""
    return np.asarray(np.logaddexp.reduce([evidence.log_posterior(np.array(choices), level) for level in NOISE_LEVELS]))


def rows_of(stacks: Sequence[Stack], choice: Choice) -> tuple[Row, ...]:
    """Rows of a choice."""
    return tuple(row for stack, k in zip(stacks, choice, strict=True) for row in stack.alternatives[k].rows)


def posterior(stacks: Sequence[Stack], scores: Mapping[Choice, float]) -> list[tuple[float, Choice]]:
    """Probability by choice, the most probable first; choices that are corrected alike count together.

    Delays that differ by one constant are the same alignment of the sources: they share its evidence, but for their prior and for the
    times of recording.
    """
    scores = _with_shared_evidence(stacks, scores)
    top = max(scores.values())
    grouped: dict[tuple[tuple[str, str], ...], list[tuple[float, Choice]]] = {}
    for choice, score in scores.items():
        key = tuple(sorted(row.key for row in rows_of(stacks, choice) if row.is_fault))
        grouped.setdefault(key, []).append((math.exp(score - top), choice))
    total = sum(p for members in grouped.values() for p, _ in members)
    return sorted(((sum(p for p, _ in members) / total, max(members)[1]) for members in grouped.values()), reverse=True)


def _with_shared_evidence(stacks: Sequence[Stack], scores: Mapping[Choice, float]) -> dict[Choice, float]:
    alignments: dict[tuple[object, ...], list[tuple[Choice, float]]] = {}
    for choice in scores:
        chosen = [stack.alternatives[k] for stack, k in zip(stacks, choice, strict=True)]
        rows = [row for a in chosen for row in a.rows]
        relative = tuple(round(a.delay_s - chosen[0].delay_s, 1) for a in chosen)
        others = tuple(row.key for row in rows if row.source != "clock")  # what they measure differs with the delay
        alignments.setdefault((relative, others), []).append((choice, sum(row.log_odds for row in rows if row.source == "clock")))
    found = {}
    for members in alignments.values():
        evidence = max(scores[choice] - prior for choice, prior in members)
        found.update({choice: evidence + prior + _recording_evidence(stacks, choice) for choice, prior in members})
    return found


def _recording_evidence(stacks: Sequence[Stack], choice: Choice) -> float:
    """Log density of the latencies from the measurements to their recording, by a recorder whose own clock may be off as any other."""
    chosen = [(stack.behind_s, stack.alternatives[k]) for stack, k in zip(stacks, choice, strict=True)]
    latencies = np.array([behind + a.delay_s for behind, a in chosen if behind is not None])
    by_offset = []
    for offset in (0.0, *latencies):
        late = latencies - offset
        scale = np.where(late > 0.0, _LATENCY_TAIL_S, _SYNCHRONIZED_S)
        prior = clock_odds(offset) if offset else 0.0
        by_offset.append(prior - float(np.log1p((late / scale) ** 2).sum()))
    return max(by_offset)
