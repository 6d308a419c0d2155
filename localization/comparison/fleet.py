"""Robots of a fleet over days: rotation scaling k, centre of rotation, centre of gravity and faults, and whether k has changed.

A log is one sample. k of a day is compared with k of all days before on the same floor by Student's t with pooled variance (Snedecor and
Cochran, Statistical Methods, 8th ed., section 6.8), which takes the scatter from log to log: most of the filter's sigma is the same in all
logs of a robot (on 48 simulated drives of 20 s, sigma is 4 % and the scatter .1 %). The p-values of a table are corrected for their number
(Bonferroni).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.stats import t as student_t

from localization.comparison.jobs import FAULT_SEPARATOR, OK, Row
from localization.errors import EvaluationError
from motion_models.param import TURNING_SIGMA
from motion_models.se2 import FloatArray

LEAST_CHANGE = 0.03
"""Part of k: 11 degrees a turn."""
LEVEL = 0.01
"""Probability that a table in which no robot has changed has an alarm, at most."""
_MOST_SIGMA = TURNING_SIGMA / 3.0
"""Part of k. Of a log with more, over a tenth of k is its prior: the drive turned too little."""
_PREFERRED = "skid_steer/ekf"
_TIME = re.compile(r"^at t = [-+.0-9]+ s: ")
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?")


@dataclass(frozen=True)
class DayChange:
    """k of a day against the days before."""

    relative: float
    """Part of k before."""
    p_value: float
    """Probability of so large a change by chance, for this test alone."""


@dataclass(frozen=True)
class Day:
    """All logs of one robot, floor and day."""

    robot: str
    floor: str
    day: str
    logs: int
    learned: int
    """Logs in which k was learned; the means are theirs."""
    k: float | None
    k_error: float | None
    """Standard error of the mean; of one log, the filter's sigma."""
    centre_m: tuple[float, float] | None
    """Centre of rotation, x and y."""
    cg_m: tuple[float, float] | None
    """Centre of gravity by robot file, arms and topic, x and y."""
    with_faults: int
    """Logs with faults."""
    change: DayChange | None = None
    """None on a first day, and where fewer than three logs are compared."""
    is_alarm: bool = False


@dataclass(frozen=True)
class FleetTable:
    """Result of `fleet_table`."""

    pair: str
    """MODEL/ESTIMATOR whose k it is."""
    days: Sequence[Day]
    tests: int
    """Number of comparisons, by which p-values are corrected."""
    failed: int
    """Logs without a result."""
    faults: Sequence[tuple[str, str, int]]
    """Robot, what was reported, and in how many logs; the most frequent first."""

    @property
    def alarms(self) -> list[Day]:
        """Days on which k has changed."""
        return [day for day in self.days if day.is_alarm]


def fleet_table(rows: Sequence[Row], pair: str | None = None) -> FleetTable:
    """Table by robot, floor and day, in this order. Raises `EvaluationError` where no log has a k of ``pair``.

    After a day with an alarm, later days are compared with it and those after it.
    """
    pair, chosen = _rows_of(rows, pair)
    places = [list(group) for _, group in groupby(sorted(chosen, key=_place), key=_place)]
    tests = sum(len({_day(row) for row in group}) - 1 for group in places)
    days = [day for group in places for day in _days(group, tests)]
    done = {row["log"] for row in rows if row["status"] == OK}
    counts = Counter((row["robot"], text) for row in chosen for text in _faults(row))
    failed = {row["log"] for row in rows} - done
    return FleetTable(pair, days, tests, len(failed), [(*key, n) for key, n in counts.most_common()])


def compare_k(before: FloatArray, after: FloatArray) -> DayChange | None:
    """Change from k ``before`` (n,) to ``after`` (m,); None for n < 2."""
    n, m = len(before), len(after)
    if n < 2 or m < 1:
        return None
    variance = float(n * np.var(before) + m * np.var(after)) / (n + m - 2)
    change = float(after.mean() - before.mean())
    statistic = abs(change) / math.sqrt(variance * (1.0 / n + 1.0 / m)) if variance else (math.inf if change else 0.0)
    return DayChange(change / float(before.mean()), float(2.0 * student_t.sf(statistic, n + m - 2)))


def _rows_of(rows: Sequence[Row], pair: str | None) -> tuple[str, list[Row]]:
    """The pair, and its finished rows: one of each log."""
    by_pair: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row["status"] == OK and row.get("k_sigma") is not None:
            by_pair.setdefault(f"{row['model']}/{row['estimator']}", {}).setdefault(row["log"], row)
    if pair is None:
        pair = _PREFERRED if _PREFERRED in by_pair else next(iter(by_pair), None)
    if pair is None:
        raise EvaluationError("no log has a result with a learned k: compare with --estimator ekf, and not with --corrections none.")
    if pair not in by_pair:
        raise EvaluationError(f"no log has a learned k of '{pair}'; there are {', '.join(by_pair) or 'none'}.")
    return pair, list(by_pair[pair].values())


def _place(row: Row) -> tuple[str, str]:
    return row["robot"], row.get("floor") or ""


def _day(row: Row) -> str:
    return row.get("day") or ""


def _is_learned(row: Row) -> bool:
    return bool(row["k_sigma"] <= _MOST_SIGMA * row["k"])


def _days(rows: Sequence[Row], tests: int) -> Iterable[Day]:
    """Days of one robot on one floor, in order. ``tests``: number of p-values of the table."""
    before: list[Row] = []
    for name, group in groupby(sorted(rows, key=_day), key=_day):
        of_day = list(group)
        learned = [row for row in of_day if _is_learned(row)]
        change = compare_k(_column(before, "k"), _column(learned, "k"))
        is_alarm = change is not None and bool(abs(change.relative) > LEAST_CHANGE and change.p_value * tests < LEVEL)
        yield replace(_describe_day(name, of_day, learned), change=change, is_alarm=is_alarm)
        before = learned if is_alarm else [*before, *learned]


def _describe_day(day: str, rows: Sequence[Row], learned: Sequence[Row]) -> Day:
    k, n = _column(learned, "k"), len(learned)
    error = None if n == 0 else learned[0]["k_sigma"] if n == 1 else float(k.std(ddof=1) / math.sqrt(n))
    with_faults = sum(bool(_faults(row)) for row in rows)
    centre, cg = _means(learned, "centre_x_m", "centre_y_m"), _means(rows, "cg_x_m", "cg_y_m")
    return Day(*_place(rows[0]), day, len(rows), n, float(k.mean()) if n else None, error, centre, cg, with_faults)


def _column(rows: Sequence[Row], name: str) -> FloatArray:
    return np.array([row.get(name) for row in rows], dtype=float)


def _means(rows: Sequence[Row], x: str, y: str) -> tuple[float, float] | None:
    return (float(_column(rows, x).mean()), float(_column(rows, y).mean())) if rows else None


def _faults(row: Row) -> list[str]:
    """Sentences without times and numbers, which differ from log to log."""
    texts = (row.get("faults") or "").split(FAULT_SEPARATOR)
    return list(dict.fromkeys(_NUMBER.sub("...", _TIME.sub("", text)) for text in texts if text))
