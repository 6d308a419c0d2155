"""From the rows of the diagnosis benchmark to its tables and its picture.

`python -m tests.helpers.diagnosis_scores ROWS.jsonl PICTURE.png [A:B]`
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from localization.diagnosis.diagnose import TOLERANCE
from localization.report import figures
from tests.helpers.diagnosis_drives import TYPICAL
from tests.helpers.diagnosis_rivals import NONE

Row = dict[str, Any]
STRONG, CLEAR = 3.0, 5.0  # sigmas


def significance(row: Row) -> float:
    """Of the weakest hidden cause; inf for one that the drive does not show at all."""
    return min((np.inf if s is None else s for s in row.get("significance", {}).values()), default=0.0)


def significance_beyond_tolerance(row: Row) -> float:
    """Of the weakest hidden cause, where a robot of the same file may have a part of it without any fault: over the drive's sigma and the
    sigma that is tolerated of the cause itself, which `significance` leaves out."""
    found = []
    for name, of_drive in row.get("significance", {}).items():
        size = abs(row["truth"][name])
        sigma = 0.0 if of_drive is None else size / max(of_drive, 1e-9)
        found.append(size / max(float(np.hypot(sigma, TOLERANCE * (row["tolerated"][name] or 0.0))), 1e-9))
    return min(found, default=0.0)


def is_beyond_tolerance(row: Row) -> bool:
    """Whether every hidden cause is larger than what robot files and mounts are accurate to, which is never named."""
    return all(abs(size) > (row["tolerated"][name] or 0.0) for name, size in row["truth"].items())


def names_of(finding: dict[str, Any]) -> set[str]:
    """The finding and its aliases."""
    return {finding["cause"], *finding["aliases"]}


def is_named(row: Row, cause: str) -> bool:
    return any(cause in names_of(f) for f in row["findings"])


def is_first(row: Row) -> bool:
    """Whether the hidden cause is the first finding or one of its aliases."""
    return bool(row["findings"]) and bool(names_of(row["findings"][0]) & set(row["truth"]))


def has_suspicion(row: Row) -> bool:
    """Whether nothing is named, but a cause is mentioned as too weak for it."""
    return bool(row.get("suspected"))


def is_suspected(row: Row) -> bool:
    """Whether that is the hidden cause or an alias of it."""
    return has_suspicion(row) and bool(names_of(row["suspected"][0]) & set(row["truth"]))


def is_wrong(row: Row) -> bool:
    """Under any verdict, the name that is printed first is neither hidden nor the alias of what is."""
    return bool(row["findings"]) and not is_first(row)


def has_extra_name(row: Row) -> bool:
    """Under any verdict, one of the names is neither hidden nor the alias of what is."""
    return any(not names_of(f) & set(row["truth"]) for f in row["findings"])


def is_alarm(row: Row) -> bool:
    """Something is reported, with a name or without."""
    return row["verdict"] not in ("consistent", "undecidable")


def is_inside(row: Row, finding: dict[str, Any]) -> bool:
    """Whether the 95 % interval of a named cause holds the true size."""
    return bool(abs(finding["size"] - row["truth"][finding["cause"]]) <= 1.96 * finding["sigma"])


def share(hits: Sequence[bool]) -> str:
    """In percent, with how many of how many."""
    return f"{100.0 * sum(hits) / len(hits):.1f} % ({sum(hits)}/{len(hits)})" if hits else "-"


def report(rows: Sequence[Row]) -> str:
    """Tables in Markdown."""
    single, pairs, nulls = ([r for r in rows if r["kind"] == kind] for kind in ("single", "pair", "null"))
    strong = [r for r in single if significance(r) >= STRONG and is_beyond_tolerance(r)]
    clear = [r for r in strong if significance_beyond_tolerance(r) >= CLEAR]
    inside = [is_inside(r, f) for r in rows for f in r["findings"] if f["cause"] in r["truth"]]
    lines = [
        f"{len(rows)} cases: {len(single)} with one cause, {len(pairs)} with two, {len(nulls)} with none",
        "",
        "| figure | measured |",
        "|---|---|",
        f"| right name or alias set first, over 3 sigma and tolerance | {share([is_first(r) for r in strong])} |",
        f"| the same, or suspected first where nothing is named | {share([is_first(r) or is_suspected(r) for r in strong])} |",
        f"| over 5 sigma | {share([is_first(r) for r in strong if significance(r) >= CLEAR])} |",
        f"| over 5 sigma of drive and tolerance together | {share([is_first(r) for r in clear])} |",
        f"| right name or alias set first, all sizes | {share([is_first(r) for r in single])} |",
        f"| pairs over 3 sigma and tolerance: both named | {share([all(is_named(r, c) for c in r['truth']) for r in _strong(pairs)])} |",
        f"| false alarms where nothing is hidden | {share([is_alarm(r) for r in nulls])} |",
        f"| suspicions where nothing is hidden | {share([has_suspicion(r) for r in nulls])} |",
        f"| suspicions that are right, where one cause is hidden | {share([is_suspected(r) for r in single if has_suspicion(r)])} |",
        f"| wrong name first, under any verdict | {share([is_wrong(r) for r in rows])} |",
        f"| a wrong name behind the right one, under any verdict | {share([has_extra_name(r) and not is_wrong(r) for r in rows])} |",
        f"| 95 % intervals that hold the true size | {share(inside)} |",
        f"| CPU of a case, simulation included, median and most | {_seconds(rows)} |",
        "",
        "| sigmas of the effect | right | something else | unexplained without a name | nothing |",
        "|---|---|---|---|---|",
    ]
    for low, high in ((0.0, 3.0), (3.0, 5.0), (5.0, 10.0), (10.0, 30.0), (30.0, np.inf)):
        some = [r for r in single if low <= significance(r) < high]
        named = [r["findings"] != [] for r in some]
        right = [is_first(r) for r in some]
        parts = (
            right,
            [n and not hit for n, hit in zip(named, right, strict=True)],
            [not n and is_alarm(r) for n, r in zip(named, some, strict=True)],
            [not n and not is_alarm(r) for n, r in zip(named, some, strict=True)],
        )
        lines.append(f"| {low:g} to {high:g} | {' | '.join(share(p) for p in parts)} |")
    return "\n".join([*lines, *_rivals(strong, nulls)])


def _strong(rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if significance(r) >= STRONG and is_beyond_tolerance(r)]


def _seconds(rows: Sequence[Row]) -> str:
    seconds = [r["seconds"] for r in rows] or [0.0]
    return f"{np.median(seconds):.1f} s, {max(seconds):.1f} s"


def _rivals(strong: Sequence[Row], nulls: Sequence[Row]) -> list[str]:
    """The other methods' table, of the rows that have them."""
    measured = [r for r in strong if "rivals" in r]
    if not measured:
        return []
    lines = ["", "| method | right name first | false alarms | held-out gain over that of the true sizes, median |", "|---|---|---|---|"]
    for method in measured[0]["rivals"]:
        right = [r["rivals"][method][0] in r["truth"] for r in measured]
        alarms = [r["rivals"][method][0] != NONE for r in nulls if "rivals" in r]
        gains = [r["rivals"][method][1] / r["oracle"] for r in measured if r["oracle"] > 0.02]
        lines.append(f"| {method} | {share(right)} | {share(alarms)} | {100.0 * np.median(gains or [0.0]):.0f} % |")
    return lines


def picture(rows: Sequence[Row]) -> bytes:
    """Confusion matrix of the cases over 3 sigma and of those with nothing hidden, as PNG."""
    shown = [r for r in rows if r["kind"] == "null" or (r["kind"] == "single" and significance(r) >= STRONG and is_beyond_tolerance(r))]
    counts = Counter((_hidden(r), _hidden(r) if is_first(r) else _first(r)) for r in shown)
    names = [*TYPICAL, NONE]
    columns = [*names, *sorted({named for _, named in counts} - set(names))]
    table = np.array([[counts[hidden, named] for named in columns] for hidden in names], dtype=float)
    whole = np.maximum(table.sum(axis=1, keepdims=True), 1.0)

    def draw(figure: figures.Figure) -> None:
        axes = figure.add_subplot()
        axes.imshow(table / whole, cmap="Blues", vmin=0.0, vmax=1.0)
        for i, j in np.argwhere(table > 0):
            colour = "white" if table[i, j] > 0.6 * whole[i, 0] else "black"
            axes.text(j, i, f"{table[i, j]:.0f}", ha="center", va="center", fontsize=7, color=colour)
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
        axes.set_yticks(range(len(names)), names, fontsize=8)
        axes.set(xlabel="named first (or the truth, where it is among the aliases)", ylabel="hidden")
        axes.grid(visible=False)

    return figures.picture(6.4, 6.0, draw)


def _hidden(row: Row) -> str:
    return next(iter(row["truth"]), NONE)


def _first(row: Row) -> str:
    if row["findings"]:
        return str(row["findings"][0]["cause"])
    return "unexplained" if is_alarm(row) else NONE


if __name__ == "__main__":
    chosen = [json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]
    if len(sys.argv) > 3:
        first, last = (int(number) for number in sys.argv[3].split(":"))
        chosen = [row for row in chosen if first <= row["number"] < last]
    Path(sys.argv[2]).write_bytes(picture(chosen))
    print(report(chosen))
