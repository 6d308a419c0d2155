"""Statistics of a table of many logs: means with intervals over logs, and whether one is better than another on the same logs.

A log is the unit: errors within one are correlated, logs are not. Intervals are percentiles of the bootstrap over logs; differences
are tested by flipping their signs log by log (exact for few logs), which assumes no distribution of errors. With n logs no
p-value can be below 2^(1-n); several of them are corrected after Holm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from localization.comparison.jobs import OK, Row
from motion_models.se2 import FloatArray

_DRAWS = 10_000
_EXACT_UP_TO = 14


@dataclass(frozen=True)
class Mean:
    """Mean of one combination over logs, with its interval."""

    name: str
    n: int
    """Logs that have the number."""
    mean: float
    low: float
    """2.5 % of the bootstrap; with one log, NaN."""
    high: float


@dataclass(frozen=True)
class Difference:
    """Difference of two combinations on the logs that both have."""

    better: str
    worse: str
    n: int
    mean: float
    """Of worse minus better, per log."""
    low: float
    high: float
    wins: int
    """Logs on which the better one has the smaller number."""
    relative: float
    """By what part of the worse one's mean the better one is smaller; NaN where that mean is 0."""
    relative_low: float
    relative_high: float
    p_value: float
    """Probability of a mean as far from zero if neither were better; corrected for all differences of the table."""


def combination(row: Row) -> str:
    """Name of a row's model, estimator and corrections."""
    return f"{row['model']} {row['estimator']}" + (f" ({row['corrections']})" if row["corrections"] else "")


def by_combination(rows: Sequence[Row], metric: str) -> dict[str, dict[str, float]]:
    """The numbers of ``metric`` by combination and log; failed rows, and those without a number there, are left out."""
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        value = row.get(metric) if row["status"] == OK else None
        table = found.setdefault(combination(row), {})
        if isinstance(value, int | float) and math.isfinite(value):
            table[row["log"]] = float(value)
    return found


def means(rows: Sequence[Row], metric: str, seed: int = 0) -> list[Mean]:
    """One for each combination that has a number, in the order of the rows."""
    rng = np.random.default_rng(seed)
    found = []
    for name, table in by_combination(rows, metric).items():
        if table:
            values = np.array(list(table.values()))
            found.append(Mean(name, len(values), float(values.mean()), *_interval(values, rng)))
    return found


def differences(rows: Sequence[Row], metric: str, seed: int = 0) -> list[Difference]:
    """Of every two combinations with at least two logs in common, the smallest p-value first. Smaller numbers are better."""
    rng = np.random.default_rng(seed)
    found = []
    for (a, a_table), (b, b_table) in itertools.combinations(by_combination(rows, metric).items(), 2):
        shared = [log for log in a_table if log in b_table]
        if len(shared) < 2:
            continue
        less, more = (np.array([table[log] for log in shared]) for table in (a_table, b_table))
        better, worse = a, b
        if more.mean() < less.mean():
            better, worse, less, more = b, a, more, less
        off = more - less
        low, high = _interval(off, rng)
        wins, part = int((off > 0.0).sum()), _relative(less, more, rng)
        found.append(Difference(better, worse, len(off), float(off.mean()), low, high, wins, *part, sign_flip_p(off, rng)))
    return _holm(sorted(found, key=lambda d: d.p_value))


def _interval(values: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    if len(values) < 2:
        return math.nan, math.nan
    drawn = values[rng.integers(0, len(values), (_DRAWS, len(values)))].mean(axis=1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _relative(less: FloatArray, more: FloatArray, rng: np.random.Generator) -> tuple[float, float, float]:
    """1 - mean(less) / mean(more) of numbers (n,) of the same logs, and its interval."""
    drawn = rng.integers(0, len(less), (_DRAWS, len(less)))
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = 1.0 - less[drawn].mean(axis=1) / more[drawn].mean(axis=1)
    if not (more.mean() > 0.0 and np.isfinite(parts).all()):
        return math.nan, math.nan, math.nan
    low, high = np.quantile(parts, [0.025, 0.975])
    return float(1.0 - less.mean() / more.mean()), float(low), float(high)


def sign_flip_p(off: FloatArray, rng: np.random.Generator) -> float:
    """Share of all assignments of signs to ``off`` (n,) whose mean is at least as far from zero as theirs; drawn ones for many."""
    n = len(off)
    if n <= _EXACT_UP_TO:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=n)))
        extra = 0
    else:
        signs = rng.choice((1.0, -1.0), size=(_DRAWS, n))
        extra = 1  # the one that was observed
    reached = np.abs(signs @ off) >= abs(off.sum()) * (1.0 - 1e-12)
    return float((reached.sum() + extra) / (len(signs) + extra))


def _holm(found: list[Difference]) -> list[Difference]:
    """Corrected p-values of those sorted by p-value."""
    corrected, largest = [], 0.0
    for i, difference in enumerate(found):
        largest = max(largest, min(1.0, (len(found) - i) * difference.p_value))
        corrected.append(replace(difference, p_value=largest))
    return corrected
