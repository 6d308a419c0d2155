"""Statistics of a comparison: means with intervals over logs, what is better than what on the same logs, and both in words.

A log is the unit: errors within one are correlated, logs are not. Intervals of means are percentiles of the bootstrap over logs;
differences are tested by flipping their signs log by log (exact for few logs), which assumes no distribution of errors. With n logs no
p-value can be below 2^(1-n); several of them are corrected after Holm (1979, Scand. J. Statist. 6). The interval of a difference holds
all values that the same test, at the level that Holm's correction leaves it, does not reject (inversion of a test: Lehmann & Romano 2005,
section 3.5): it contains 0 where, and only where, the difference is not significant, and has no end where so few logs exclude nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.comparison.jobs import OK, Row
from localization.lidar.losses import is_long, per_cent
from localization.report.replay_page import unit_of
from localization.report.runs import capitalize, describe_run, join_words
from motion_models.se2 import FloatArray

_DRAWS = 10_000
_EXACT_UP_TO = 14

_SIGNIFICANCE_LEVEL = 0.05
_UNKNOWN = (math.nan, math.nan)
_LEAST_STEP, _MOST_STEPS = 1e-3, 1e4
"""First step of the search for the end of an interval, and how many times that the last one is."""
_BOUND_ACCURACY = 1e-4
"""Accuracy of an end, over the interval in which it was found."""
_MEASURES = {
    "ate_rmse_m": "position error (ATE)",
    "ate_rmse_deg": "heading error (ATE)",
    "rpe_translation_percent": "relative position error (RPE)",
    "rpe_rotation_deg_per_m": "relative heading error (RPE)",
    "end_error_m": "error at the end",
    "drift_percent": "drift",
    "relations_all_translation_m": "translation error of relations",
    "relations_all_rotation_deg": "rotation error of relations",
    "nees_mean": "NEES",
    "nis_mean": "NIS",
    "lidar_lost_share": "share without LiDAR",
    "distance_m": "distance",
}


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
    """Mean over the logs of the worse one's number minus the better one's."""
    low: float
    """95 % interval by the test itself, corrected for all differences of the table; -inf where the logs are too few for a bound."""
    high: float
    wins: int
    """Logs on which the better one has the smaller number."""
    relative: float
    """By what part of the worse one's mean the better one is smaller; NaN where that mean is 0."""
    relative_low: float
    relative_high: float
    p_value: float
    """Probability of a mean as far from zero if neither were better; corrected for all differences of the table."""


def measure_of(metric: str) -> str:
    """Name of a column of the table in a sentence."""
    return _MEASURES.get(metric, metric)


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
    """Differences of every two combinations with at least two logs in common, the smallest p-value first. Smaller numbers are better."""
    rng = np.random.default_rng(seed)
    signs: dict[int, FloatArray] = {}
    found: list[tuple[Difference, _Flips, _Flips]] = []
    for (a, a_table), (b, b_table) in itertools.combinations(by_combination(rows, metric).items(), 2):
        shared = [log for log in a_table if log in b_table]
        n = len(shared)
        if n < 2:
            continue
        if n not in signs:
            signs[n] = _signs(n, rng)
        less, more = (np.array([table[log] for log in shared]) for table in (a_table, b_table))
        better, worse = a, b
        if more.mean() < less.mean():
            better, worse, less, more = b, a, more, less
        off = more - less
        absolute, relative = (_Flips(signs[n] @ off, signs[n] @ unit, float(off.sum()), float(unit.sum())) for unit in (np.ones(n), more))
        difference = Difference(
            *(
                better,
                worse,
                n,
                float(off.mean()),
                *_UNKNOWN,
                int((off > 0.0).sum()),
                _relative(less, more),
                *_UNKNOWN,
                absolute.p_value(0.0),
            )
        )
        found.append((difference, absolute, relative))
    return _holm(sorted(found, key=lambda entry: entry[0].p_value))


class _Flips(NamedTuple):
    """Sums over logs of d - v u with all assignments of signs: d differences, u the unit in which a value v of the difference is given."""

    differences: FloatArray
    """(m,) sums of d with each assignment."""
    units: FloatArray
    """(m,) of u: 1 for absolute differences, the worse one's numbers for relative ones."""
    difference: float
    """Sum of d as measured."""
    unit: float

    def p_value(self, value: float) -> float:
        """Share of the assignments with a sum at least as far from zero as the measured one, if the difference really were ``value``."""
        reached = np.abs(self.differences - value * self.units) >= abs(self.difference - value * self.unit) * (1.0 - 1e-12)
        return float(np.mean(reached))


def _interval(values: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    if len(values) < 2:
        return math.nan, math.nan
    drawn = values[rng.integers(0, len(values), (_DRAWS, len(values)))].mean(axis=1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _relative(less: FloatArray, more: FloatArray) -> float:
    """1 - mean(less) / mean(more) of numbers (n,) of the same logs; NaN where that is no number."""
    return float(1.0 - less.mean() / more.mean()) if more.mean() > 0.0 and np.isfinite(less.mean() / more.mean()) else math.nan


def sign_flip_p(off: FloatArray, rng: np.random.Generator) -> float:
    """Share of all assignments of signs to ``off`` (n,) whose mean is at least as far from zero as theirs; drawn ones for many."""
    signs = _signs(len(off), rng)
    return _Flips(signs @ off, signs.sum(axis=1), float(off.sum()), float(len(off))).p_value(0.0)


def _signs(n: int, rng: np.random.Generator) -> FloatArray:
    """(m, n) all assignments of signs to n numbers; drawn ones, after the observed one, for many."""
    if n <= _EXACT_UP_TO:
        return np.array(list(itertools.product((1.0, -1.0), repeat=n)))
    return np.vstack([np.ones(n), rng.choice((1.0, -1.0), size=(_DRAWS, n))])


def _holm(found: Sequence[tuple[Difference, _Flips, _Flips]]) -> list[Difference]:
    """Corrected p-values of those sorted by p-value, and the intervals that belong to them.

    Once one is not rejected none of the following is, and the level stays.
    """
    corrected: list[Difference] = []
    largest, left = 0.0, len(found)
    for difference, absolute, relative in found:
        largest = max(largest, min(1.0, left * difference.p_value))
        level = _SIGNIFICANCE_LEVEL / left
        low, high = _accepted(absolute, difference.mean, level)
        least, most = _UNKNOWN if math.isnan(difference.relative) else _accepted(relative, difference.relative, level)
        corrected.append(replace(difference, p_value=largest, low=low, high=high, relative_low=least, relative_high=most))
        left -= largest < _SIGNIFICANCE_LEVEL
    return corrected


def _accepted(flips: _Flips, estimate: float, level: float) -> tuple[float, float]:
    """Smallest and largest value with a p-value of at least ``level``, by bisection from the ``estimate``; infinite without a bound."""
    ends = []
    for side in (-1.0, 1.0):
        step = max(abs(estimate), _LEAST_STEP)
        while flips.p_value(estimate + side * step) >= level and step < _MOST_STEPS * max(abs(estimate), _LEAST_STEP):
            step *= 2.0
        inside, outside = 0.0, step
        if flips.p_value(estimate + side * step) >= level:
            ends.append(side * math.inf)
            continue
        while outside - inside > _BOUND_ACCURACY * step:
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if flips.p_value(estimate + side * middle) >= level else (inside, middle)
        ends.append(estimate + side * inside)
    return ends[0], ends[1]


@dataclass(frozen=True, eq=False)
class ComparisonFindings:
    """Results of a comparison; made by `find`."""

    metric: str
    rows: Sequence[Row]
    means: Sequence[Mean]
    """The smallest first."""
    tested: Sequence[Difference]
    words: Mapping[str, str]
    """Name of each combination in a sentence."""

    @property
    def best(self) -> Mean:
        """The combination of the smallest mean."""
        return self.means[0]

    @property
    def measure(self) -> str:
        """Name of the metric in a sentence."""
        return measure_of(self.metric)

    @property
    def unit(self) -> str:
        """Unit of the metric."""
        return unit_of(self.metric)

    @property
    def failed(self) -> list[Row]:
        """Rows of runs that failed."""
        return [row for row in self.rows if row["status"] != OK]

    @property
    def damaged(self) -> dict[str, str]:
        """Parts of logs that could not be read, by log; the rest of such a log counts."""
        return {row["log"]: row["damage"] for row in self.rows if row.get("damage")}

    def lost(self, name: str) -> list[Row]:
        """Runs of a combination whose LiDAR was lost for long."""
        return [
            row for row in self.rows if combination(row) == name and is_long(row.get("lidar_lost_share"), row.get("lidar_longest_lost_s"))
        ]

    def against_best(self, name: str) -> Difference | None:
        """Difference of a combination and the best; None where they have fewer than two logs in common."""
        pair = {name, self.best.name}
        return next((d for d in self.tested if {d.better, d.worse} == pair), None)

    def is_shown(self, difference: Difference) -> bool:
        """Whether a difference is significant."""
        return difference.p_value < _SIGNIFICANCE_LEVEL

    def least_p(self, n: int) -> float:
        """Smallest possible corrected p-value of ``n`` logs."""
        return min(1.0, len(self.tested) * 2.0 ** (1 - n))


def find(rows: Sequence[Row], metric: str) -> ComparisonFindings:
    """Means, differences and words of ``rows``. ``means`` is empty where none has a number ``metric``."""
    found = sorted(means(rows, metric), key=lambda mean: mean.mean)
    forms = {row["corrections"] for row in rows if row["corrections"]}
    words = {}
    for row in rows:
        form = f" ({row['corrections']})" if row["corrections"] and len(forms) > 1 else ""
        words[combination(row)] = describe_run(row["estimator"], row["model"]) + form
    return ComparisonFindings(metric, rows, found, differences(rows, metric), words)


def leading(found: ComparisonFindings) -> list[str]:
    """What users ask first: which motion model is better with one estimator, by the largest difference that is shown; then the best run."""
    alike = [d for d in found.tested if found.is_shown(d) and d.better.split()[1:] == d.worse.split()[1:]]
    largest = max(alike, key=lambda d: -math.inf if math.isnan(d.relative) else d.relative, default=None)
    return list(dict.fromkeys([*([] if largest is None else [_of(largest, found)]), headline(found)]))


def headline(found: ComparisonFindings) -> str:
    """The best against the next one."""
    best, others = found.best, found.means[1:]
    return (
        against_best(others[0], found) if others else f"{capitalize(found.words[best.name])}: {_amount(best, found)} over {_logs(best.n)}."
    )


def against_best(other: Mean, found: ComparisonFindings) -> str:
    """Sentence that compares the best with another one."""
    difference = found.against_best(other.name)
    if difference is None:
        names = f"{capitalize(found.words[found.best.name])} and {found.words[other.name]}"
        return f"{names} share fewer than two logs: no test is possible."
    return _of(difference, found)


def closing(found: ComparisonFindings) -> list[str]:
    """What is missing, and what to do."""
    return [*_incomplete(found), *_losses(found), _advice(found)]


def _of(d: Difference, found: ComparisonFindings) -> str:
    better, worse = found.words[d.better], found.words[d.worse]
    gap = f"by {percent(d, found.unit)} of {found.measure}, p = {p_words(d.p_value)}"
    if found.is_shown(d):
        return f"{capitalize(better)} beats {worse} on {d.wins} of {_logs(d.n)}, {gap}."
    return f"The difference of {better} and {worse} is not significant: the first is better on {d.wins} of {_logs(d.n)}, {gap}."


def percent(d: Difference, unit: str = "") -> str:
    """By how much the better one is smaller, with its interval where the logs are enough for one: in percent of the worse one's mean if
    positive, else in the ``unit``."""
    is_relative = not math.isnan(d.relative)
    value = f"{_part(d.relative)} %" if is_relative else f"{d.mean:.3g} {unit}".rstrip()
    low, high = (d.relative_low, d.relative_high) if is_relative else (d.low, d.high)
    if math.isinf(low) or math.isinf(high):
        return value
    return f"{value} [{_part(low)}, {_part(high)}]" if is_relative else f"{value} [{low:.3g}, {high:.3g}]"


def p_words(p: float) -> str:
    """A p value in words."""
    return "1" if p >= 0.995 else f"{p:.2g}" if p >= 1e-4 else "less than 0.0001"


def _part(value: float) -> str:
    """Per cent, never rounded up to all of it."""
    per_cent = 100.0 * value
    return f"{per_cent:.1f}" if 99.0 <= per_cent < 100.0 else f"{per_cent:z.0f}"


def _amount(mean: Mean, found: ComparisonFindings) -> str:
    between = f" [{mean.low:.3g}, {mean.high:.3g}]" if mean.n > 1 else ""
    return f"mean {found.measure} {mean.mean:.3g}{between} {found.unit}".rstrip()


def _incomplete(found: ComparisonFindings) -> list[str]:
    sentences = []
    if len({mean.n for mean in found.means}) > 1:
        sentences.append(
            "Not all have a number on all logs, so their means are of different drives; the tests use the logs that both have."
        )
    if failed := found.failed:
        logs = len({row["log"] for row in failed})
        sentences.append(f"{len(failed)} of {len(found.rows)} runs failed, on {_logs(logs)}.")
    if n := len(found.damaged):
        sentences.append(f"{_logs(n)} {'is' if n == 1 else 'are'} not whole: what could be read counts as much as a whole drive.")
    return sentences


def _losses(found: ComparisonFindings) -> list[str]:
    """Combinations that lost the LiDAR for long, and where it was the longest."""
    sentences = []
    for mean in found.means:
        if rows := found.lost(mean.name):
            worst = max(rows, key=lambda row: row["lidar_longest_lost_s"])
            where = f"{per_cent(worst['lidar_lost_share'])} of {worst['log']}, longest {worst['lidar_longest_lost_s']:.2g} s"
            since = f"at t = {worst['lidar_longest_lost_since_s']:.0f} s"
            name = found.words[mean.name]
            sentences.append(
                f"{capitalize(name)} lost the LiDAR for long on {_logs(len(rows))} ({where} {since}); the errors include that."
            )
    if sentences:
        sentences.append("`skidloc replay` on those logs reports the causes.")
    return sentences


def _advice(found: ComparisonFindings) -> str:
    best, pairs = found.best, [(mean, found.against_best(mean.name)) for mean in found.means[1:]]
    equal = [found.words[mean.name] for mean, d in pairs if d is None or not found.is_shown(d)]
    if not pairs:
        return "Name another model or estimator to have it compared."
    if not found.tested:
        return "No test was made: it takes two logs or more on which the same pairs ran."
    if not equal:
        return f"Use {found.words[best.name]}."
    if len(equal) < len(pairs):
        return f"Use {found.words[best.name]}; it is not significantly better than {join_words(equal, 'or')} on these logs."
    if (least := found.least_p(best.n)) >= _SIGNIFICANCE_LEVEL:
        enough = next(n for n in range(2, 99) if found.least_p(n) < _SIGNIFICANCE_LEVEL)
        return f"{_logs(best.n)} cannot show it: p is at least {p_words(least)} for {_pairs(len(found.tested))}. Take at least {enough}."
    return "No difference is significant on these logs: take the simplest, or record more drives."


def _pairs(n: int) -> str:
    return f"{n} pairs" if n != 1 else "one pair"


def _logs(n: int) -> str:
    return f"{n} log{'s' * (n != 1)}"
