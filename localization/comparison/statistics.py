"""Statistics of a comparison: means with intervals over logs, what is better than what on the same logs, and both in words.

A log is the unit: errors within one are correlated, logs are not. Intervals are percentiles of the bootstrap over logs; differences
are tested by flipping their signs log by log (exact for few logs), which assumes no distribution of errors. With n logs no
p-value can be below 2^(1-n); several of them are corrected after Holm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from localization.comparison.jobs import OK, Row
from localization.lidar.losses import is_long, per_cent
from localization.report.replay_page import unit_of
from localization.report.runs import capitalize, describe_run, join_words
from motion_models.se2 import FloatArray

_DRAWS = 10_000
_EXACT_UP_TO = 14

_SIGNIFICANCE_LEVEL = 0.05
_MEASURES = {
    "ate_rmse_m": "position error (ATE)",
    "ate_rmse_deg": "heading error (ATE)",
    "rpe_translation_percent": "relative position error (RPE)",
    "rpe_rotation_deg_per_m": "relative heading error (RPE)",
    "end_error_m": "error at the end",
    "drift_percent": "drift",
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
    """Differences of every two combinations with at least two logs in common, the smallest p-value first. Smaller numbers are better."""
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


@dataclass(frozen=True, eq=False)
class Findings:
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
        return _MEASURES.get(self.metric, self.metric)

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


def find(rows: Sequence[Row], metric: str) -> Findings:
    """Means, differences and words of ``rows``. ``means`` is empty where none has a number ``metric``."""
    found = sorted(means(rows, metric), key=lambda mean: mean.mean)
    forms = {row["corrections"] for row in rows if row["corrections"]}
    words = {}
    for row in rows:
        form = f" ({row['corrections']})" if row["corrections"] and len(forms) > 1 else ""
        words[combination(row)] = describe_run(row["estimator"], row["model"]) + form
    return Findings(metric, rows, found, differences(rows, metric), words)


def headline(found: Findings) -> str:
    """The best against the next one."""
    best, others = found.best, found.means[1:]
    return (
        against_best(others[0], found) if others else f"{capitalize(found.words[best.name])}: {_amount(best, found)} over {_logs(best.n)}."
    )


def against_best(other: Mean, found: Findings) -> str:
    """Sentence that compares the best with another one."""
    difference = found.against_best(other.name)
    if difference is None:
        names = f"{capitalize(found.words[found.best.name])} and {found.words[other.name]}"
        return f"{names} share fewer than two logs: no test is possible."
    return _of(difference, found)


def closing(found: Findings) -> list[str]:
    """What is missing, and what to do."""
    return [*_incomplete(found), *_losses(found), _advice(found)]


def _of(d: Difference, found: Findings) -> str:
    better, worse = found.words[d.better], found.words[d.worse]
    gap = f"by {percent(d, found.unit)} of {found.measure}, p = {p_words(d.p_value)}"
    if found.is_shown(d):
        return f"{capitalize(better)} beats {worse} on {d.wins} of {_logs(d.n)}, {gap}."
    return f"The difference of {better} and {worse} is not significant: the first is better on {d.wins} of {_logs(d.n)}, {gap}."


def percent(d: Difference, unit: str = "") -> str:
    """By how much the better one is smaller, with its interval: in percent of the worse one's mean if positive, else in the ``unit``."""
    if math.isnan(d.relative):
        return f"{d.mean:.3g} {unit}".rstrip() + f" [{d.low:.3g}, {d.high:.3g}]"
    return f"{_part(d.relative)} % [{_part(d.relative_low)}, {_part(d.relative_high)}]"


def p_words(p: float) -> str:
    """A p value in words."""
    return "1" if p >= 0.995 else f"{p:.2g}" if p >= 1e-4 else "less than 0.0001"


def _part(value: float) -> str:
    """Per cent, never rounded up to all of it."""
    per_cent = 100.0 * value
    return f"{per_cent:.1f}" if 99.0 <= per_cent < 100.0 else f"{per_cent:z.0f}"


def _amount(mean: Mean, found: Findings) -> str:
    between = f" [{mean.low:.3g}, {mean.high:.3g}]" if mean.n > 1 else ""
    return f"mean {found.measure} {mean.mean:.3g}{between} {found.unit}".rstrip()


def _incomplete(found: Findings) -> list[str]:
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


def _losses(found: Findings) -> list[str]:
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


def _advice(found: Findings) -> str:
    best, pairs = found.best, [(mean, found.against_best(mean.name)) for mean in found.means[1:]]
    equal = [found.words[mean.name] for mean, d in pairs if d is None or not found.is_shown(d)]
    if not pairs:
        return "Name another model or estimator to have it compared."
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
