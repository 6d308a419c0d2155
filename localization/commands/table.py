"""`skidloc table`: what a comparison learned of each robot, by floor and day, and whether k has changed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from localization.commands.common import add_row, plain_table, print_line, print_table, write_json
from localization.comparison.fleet import LEAST_CHANGE, LEVEL, Day, FleetTable, fleet_table
from localization.comparison.result_table import read_results
from localization.output import check_outputs

_MOST_FAULTS = 10
"""Sentences that are printed; all are in the JSON file."""


@dataclass(frozen=True)
class TableCommand:
    """Show k, centres of rotation and gravity, and faults by robot, floor and day, with an alarm where k changed."""

    results: tyro.conf.Positional[Path]
    """Folder or table that `skidloc compare` has written; it may still be at work."""
    pair: str | None = None
    """MODEL/ESTIMATOR whose k is shown. Default: skid_steer/ekf, or the first that learned one."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all of it to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.json)
        found = fleet_table(read_results(self.results), self.pair)
        grid = plain_table("robot", "floor", "day", "logs", "k", "+-", "x_CR m", "y_CR m", "CG x m", "CG y m", "faults", "change", "p", "")
        for day in found.days:
            add_row(grid, *_cells(day, found.tests))
        print_table(console, grid)
        for sentence in _sentences(found):
            print_line(console, sentence)
        if self.json is not None:
            write_json(self.json, {**dataclasses.asdict(found), "alarms": [dataclasses.asdict(day) for day in found.alarms]})


def _cells(day: Day, tests: int) -> list[str]:
    change = day.change
    return [
        *(day.robot, day.floor or "-", day.day or "-", str(day.logs)),
        *("-" if value is None else f"{value:.4f}" for value in (day.k, day.k_error)),
        *(f"{value:+.3f}" if value is not None else "-" for value in (*(day.centre_m or (None, None)), *(day.cg_m or (None, None)))),
        str(day.with_faults),
        *(("-", "-") if change is None else (f"{100.0 * change.relative:+.1f} %", f"{min(1.0, change.p_value * tests):.2g}")),
        "ALARM" if day.is_alarm else "",
    ]


def _sentences(found: FleetTable) -> list[str]:
    return [
        *(_alarm(day, found.tests) for day in found.alarms),
        *([] if found.alarms else [_no_alarm(found)]),
        *_unlearned(found),
        *(f"{robot}, {n} log{'s' * (n != 1)}: {text}" for robot, text, n in found.faults[:_MOST_FAULTS]),
        *([f"{len(found.faults) - _MOST_FAULTS} more kinds of faults are in --json FILE."] if len(found.faults) > _MOST_FAULTS else []),
        *(
            [f"{found.failed} log{'s have' if found.failed > 1 else ' has'} no result; `skidloc compare` prints the causes."]
            if found.failed
            else []
        ),
    ]


def _alarm(day: Day, tests: int) -> str:
    assert day.change is not None
    p = min(1.0, day.change.p_value * tests)
    return (
        f"ALARM: {day.robot}{f' on {day.floor}' if day.floor else ''}, {day.day}: k has changed by {100.0 * day.change.relative:+.1f} % "
        f"since the days before (p = {p:.1g}, corrected for {tests} comparisons). Check tyres, load and floor; `skidloc diagnose LOG` "
        "names causes, `skidloc calibrate` fits k."
    )


def _no_alarm(found: FleetTable) -> str:
    if not any(day.change is not None for day in found.days):
        return "No alarm is possible: a change of k needs two logs of a robot and floor, and one of a later day."
    least = f"{100.0 * LEAST_CHANGE:.0f} %"
    return f"No k of {found.pair} has changed by over {least} with p below {LEVEL:g}, corrected for {found.tests} comparisons."


def _unlearned(found: FleetTable) -> list[str]:
    short = sum(day.logs - day.learned for day in found.days)
    return [f"{short} log{'s' * (short != 1)} turned too little for k and are not in its mean."] if short else []
