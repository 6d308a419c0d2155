"""Change points: a source that has one row more, or less, from some time on.

The evidence is a sum over bins. With E_a(m) that of alternative a in bin m, a change from a to b at m has sum_{i < m} E_a(i) +
sum_{i >= m} E_b(i), whose maximum over m are two cumulative sums (Page 1954; Killick et al. 2012, for one change). The best are tried with
the scales that they have with the change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from localization.evidence.alternatives import Alternative, Row
from localization.evidence.angles import BoolArray
from localization.evidence.likelihood import NOISE_LEVELS, Choice, Evidence, Stack, varied
from motion_models.se2 import FloatArray

_ODDS = math.log(0.1)
"""Logarithm of the odds that a symptom begins or ends within a log, beside one that it has from the start."""
_MIN_BINS = 6
"""Bins on each side of a change: three seconds of motion, below which one bad match would be one."""
_TRIED, _EVERY = 8, 2
"""Pairs of alternatives that are tried with a change in each second bin, scale and all."""
_REMEDY = "Drive with one set-up per log: cut the log there, and find what restarted."


def with_changes(evidence: Evidence, choices: Sequence[Choice]) -> tuple[Evidence, list[Choice]]:
    """``evidence`` with an alternative that changes within the log for each source and each of ``choices`` that one improves, and those
    choices."""
    found, changed = list(evidence.stacks), list[Choice]()
    for choice in choices:
        for i, stack in enumerate(evidence.stacks):
            composite = _best_change(evidence, choice, i)
            if composite is not None:
                alternatives = [*found[i].alternatives, composite]
                found[i] = stack.of(alternatives)
                changed.append((*choice[:i], len(alternatives) - 1, *choice[i + 1 :]))
    return evidence.with_more(found), changed


def _best_change(evidence: Evidence, choice: Choice, index: int) -> Alternative | None:
    """The most probable alternative of one source that has a row more on one side of a change, the other sources as in ``choice``; None
    where none is more probable than the best without a change."""
    stacks = evidence.stacks
    stack, bins = stacks[index], range(_MIN_BINS, len(stacks[index].t) - _MIN_BINS, _EVERY)
    level = max(NOISE_LEVELS, key=lambda each: evidence.log_posterior(np.array([choice]), each)[0])
    choices = varied(choice, index, stack)
    E = evidence.by_bin(choices, level) + stack.log_jacobians
    own = np.array([a.log_prior + a.own for a in stack.alternatives])
    candidates = list[tuple[float, int, int, Row, bool]]()
    for base, k, row in _pairs(stack) if bins else ():
        before = np.cumsum(E[k] - E[base])[_MIN_BINS - 1 : -_MIN_BINS]  # gain of the row until a bin; the rest of the sum is since it
        whole = float((E[k] - E[base]).sum())
        for gain, is_since in ((whole - before.min(), True), (before.max(), False)):
            candidates.append((own[base] + E[base].sum() + gain + row.log_odds, base, k, row, is_since))
    best = sorted(candidates, key=lambda each: -each[0])[:_TRIED]
    joined = [_joined(stack, base, k, row, m, is_since) for _, base, k, row, is_since in best for m in bins]
    if not joined:
        return None
    tried = Evidence([stack.of(joined) if i == index else other for i, other in enumerate(stacks)])
    scores = tried.log_posterior(varied(choice, index, tried.stacks[index]), level)
    unchanged = evidence.log_posterior(choices, level)
    return joined[int(scores.argmax())] if scores.max() > unchanged.max() else None


def _pairs(stack: Stack) -> Iterator[tuple[int, int, Row]]:
    """Two alternatives at the same delay, of which the second has one row more that may change within a log, and that row."""
    by_rows = {(a.delay_s, frozenset(row.key for row in a.rows)): i for i, a in enumerate(stack.alternatives)}
    for k, other in enumerate(stack.alternatives):
        for row in other.rows:
            rest = frozenset(each.key for each in other.rows if each is not row)
            base = by_rows.get((other.delay_s, rest))
            if base is not None and row.may_change:
                yield base, k, row


def _joined(stack: Stack, of_base: int, k: int, row: Row, m: int, is_since: bool) -> Alternative:
    """Alternative ``of_base`` with the channels of alternative ``k`` since, or until, bin ``m``."""
    base, other, at = stack.alternatives[of_base], stack.alternatives[k], float(stack.t[m])
    is_other = (np.arange(len(stack.t)) >= m) == is_since
    since_s, until_s = (at, None) if is_since else (None, at)
    text = f"{row.text} {'since' if is_since else 'until'} t = {at:.0f} s"
    odds = row.log_odds + _ODDS - math.log(len(stack.t))
    changed = replace(row, text=text, log_odds=odds, correct=None, remedy=_REMEDY, since_s=since_s, until_s=until_s)
    rows = (*base.rows, changed)
    return replace(
        base,
        rows=rows,
        way=_spliced(base.way, other.way, is_other),
        turn=_spliced(base.turn, other.turn, is_other),
        units=(np.where(is_other, other.units[0], base.units[0]), np.where(is_other, other.units[1], base.units[1])),
        own=base.own + _own_of(is_other, base, other),
    )


def _own_of(is_other: BoolArray, base: Alternative, other: Alternative) -> float:
    """What the evidence of the source itself changes where the bins ``is_other`` (n,) are the ``other`` alternative's."""
    if base.own_by_bin is None or other.own_by_bin is None:
        return float(is_other.mean()) * (other.own - base.own)
    return float((other.own_by_bin - base.own_by_bin)[is_other].sum())


def _spliced(base: FloatArray | None, other: FloatArray | None, is_other: FloatArray) -> FloatArray | None:
    return None if base is None or other is None else np.where(is_other, other, base)
