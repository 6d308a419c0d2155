"""The league's numbers in docs/lab/league.md, and the best peer of each log in README.md: both from the rows of a run.

Cells of what was not run this time stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_REPOSITORY = Path(__file__).parents[2]
_BEGIN, _END = "<!-- league: begin -->", "<!-- league: end -->"
_NOTHING, _FAILED = "–", "failed"  # noqa: RUF001
BEST_PEER = "best peer"


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    title: str
    log: str
    key: str
    """Without it in a row, there is no number."""
    show: Callable[[Mapping[str, Any]], str]


def _errors(row: Mapping[str, Any]) -> str:
    return f"{row['ate_m']:.3f} / {row['rpe_m']:.3f}"


COLUMNS: Sequence[Column] = (
    Column("fr079, ATE / RPE [m]", "fr079", "ate_m", _errors),
    Column("MIT-CSAIL", "csail", "ate_m", _errors),
    Column("ACES, relations all / < 20 s", "aces", "ate_m", _errors),
    Column("ANEES of positions, fr079 (2)", "fr079", "anees", lambda row: f"{row['anees']:.1f}"),
    Column("MIT-CSAIL (2)", "csail", "anees", lambda row: f"{row['anees']:.1f}"),
    Column("CPU ms per s of ACES", "aces", "cpu_per_s", lambda row: f"{1e3 * row['cpu_per_s']:.1f}"),
    Column("memory MB", "aces", "memory_mb", lambda row: f"{row['memory_mb']:.0f}"),
)
_WITH_ERRORS = 3
"""First columns, which are errors on a log; README has one for each."""


def write(rows: Sequence[Mapping[str, Any]], repository: Path = _REPOSITORY) -> None:
    """Put ``rows`` into the tables of the files under ``repository``."""
    journal, readme = repository / "docs/lab/league.md", repository / "README.md"
    before, _, rest = journal.read_text().partition(_BEGIN)
    table, _, after = rest.partition(_END)
    cells = _merge(_parse(table), rows)
    lines = [f"| {' | '.join(('system', *(column.title for column in COLUMNS)))} |", "|---" * (len(COLUMNS) + 1) + "|"]
    lines += [f"| {' | '.join((system, *found))} |" for system, found in cells.items()]
    journal.write_text("\n".join([before + _BEGIN, *lines, _END + after]))
    text = readme.read_text().splitlines()
    at = next(i for i, line in enumerate(text) if line.startswith(f"| {BEST_PEER}"))
    name, *old = (cell.strip() for cell in text[at].split("|")[1:-1])
    new = [_best_peer(cells, i) for i in range(_WITH_ERRORS)]
    text[at] = f"| {' | '.join((name, *new, *old[_WITH_ERRORS:]))} |".replace("|  |", "| |")
    readme.write_text("\n".join(text) + "\n")


def _parse(table: str) -> dict[str, list[str]]:
    """Cells by system."""
    lines = [line for line in table.splitlines() if line.startswith("|")][2:]
    return {name: cells for name, *cells in ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)}


def _merge(cells: dict[str, list[str]], rows: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """``cells`` with those of ``rows``."""
    for row in rows:
        of_system = cells.setdefault(row["system"], [_NOTHING] * len(COLUMNS))
        for i, column in enumerate(COLUMNS):
            if row["log"] == column.log:
                of_system[i] = column.show(row) if column.key in row else _FAILED if "failure" in row and i < _WITH_ERRORS else _NOTHING
    return cells


def _best_peer(cells: Mapping[str, Sequence[str]], column: int) -> str:
    """The peer of the least error, with its errors."""
    peers = {name: found[column] for name, found in cells.items() if " / " in found[column] and not name.startswith(("skidloc", "wheels"))}
    name = min(peers, key=lambda peer: float(peers[peer].partition(" / ")[0]))
    return f"{name}: {peers[name]}"
