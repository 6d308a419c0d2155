"""Summary of a comparison in words: which combination is best, over which others that is significant, and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from localization.comparison.jobs import OK, Row
from localization.comparison.statistics import Difference, Mean, combination, differences, means
from localization.lidar.losses import is_long, per_cent
from localization.report.runs import capitalize, describe_run, join_words
from localization.report.tables import unit_of

_SIGNIFICANCE_LEVEL = 0.05
_MEASURES = {
    "ate_rmse_m": "position error (ATE)",
    "ate_rmse_deg": "heading error (ATE)",
    "rpe_translation_percent": "relative position error (RPE)",
    "rpe_rotation_deg_per_m": "relative heading error (RPE)",
    "end_error_m": "error at the end",
    "drift_percent": "drift",
}


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
        """Runs of a combination whose LiDAR was lost for so long that they cannot be recommended."""
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
            sentences.append(f"Not recommended is {found.words[mean.name]}: LiDAR lost for long on {_logs(len(rows))} ({where} {since}).")
    if sentences:
        sentences.append("`skidloc replay` on those logs reports the causes.")
    return sentences


def _advice(found: Findings) -> str:
    usable = [mean for mean in found.means if not found.lost(mean.name)]
    if not usable:
        return "No combination can be recommended."
    if usable[0] is not found.best:
        return f"Of the others, {found.words[usable[0].name]} has the smallest mean: {_amount(usable[0], found)}."
    best, pairs = found.best, [(mean, found.against_best(mean.name)) for mean in usable[1:]]
    equal = [found.words[mean.name] for mean, d in pairs if d is None or not found.is_shown(d)]
    if not pairs and len(found.means) > 1:
        return f"Use {found.words[best.name]}."
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
