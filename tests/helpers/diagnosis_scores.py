"""From the benchmark's rows to its tables and its picture. `python -m tests.helpers.diagnosis_scores ROWS.csv PICTURE.png`."""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localization.report import figures
from tests.helpers.diagnosis_drives import TYPICAL
from tests.helpers.diagnosis_rivals import NONE

COLUMNS = ("key", "kind", "truth", "alike", "verdict", "findings", "seconds", "rivals", "gain", "oracle", "significance", "rms")
STRONG = 3.0
METHODS = ("diagnosis", "stepwise", "stlsq", "gp", "noise")


@dataclass(frozen=True)
class Row:
    """One case, as read."""

    kind: str
    verdict: str
    truth: dict[str, float]
    alike: tuple[str, ...]
    findings: list[dict[str, Any]]
    rivals: dict[str, tuple[str, float]]
    gain: float
    oracle: float
    significance: float
    """The weakest hidden cause's; inf for a cause that the drive should show and whose traces were not found."""
    rms: float
    """Of the weakest hidden cause over its channels' noise, in the channel where it shows most."""
    seconds: float

    @property
    def first(self) -> str:
        return self.findings[0]["cause"] if self.findings else NONE

    @property
    def open(self) -> set[str]:
        """The first finding and its aliases."""
        return {self.first, *self.findings[0]["aliases"]} if self.findings else {NONE}

    @property
    def said(self) -> set[str]:
        return {name for f in self.findings for name in (f["cause"], *f["aliases"])}

    @property
    def cause(self) -> str:
        return next(iter(self.truth), NONE)


def read(path: Path) -> list[Row]:
    with path.open(newline="") as file:
        return [_row(r) for r in csv.DictReader(file)]


def _row(r: dict[str, str]) -> Row:
    strengths = json.loads(r["significance"] or "{}").values()
    return Row(
        *(r["kind"], r["verdict"], json.loads(r["truth"]), tuple(json.loads(r["alike"])), json.loads(r["findings"])),
        rivals={name: (said, gain) for name, (said, gain) in json.loads(r["rivals"] or "{}").items()},
        gain=float(r["gain"] or 0.0),
        oracle=float(r["oracle"] or 0.0),
        significance=min((np.inf if s is None else s for s in strengths), default=0.0),
        rms=min((np.inf if s is None else s for s in json.loads(r["rms"] or "{}").values()), default=0.0),
        seconds=float(r["seconds"]),
    )


def share(hits: Sequence[bool]) -> str:
    """In percent, with how many of how many."""
    return f"{100.0 * sum(hits) / len(hits):.1f} % ({sum(hits)}/{len(hits)})" if hits else "-"


def report(path: Path, picture: Path | None = None) -> str:
    """Tables in Markdown; and the confusion matrix as a picture."""
    rows = read(path)
    single = [r for r in rows if r.kind == "single"]
    strong = [r for r in single if r.significance >= STRONG]
    nulls = [r for r in rows if r.kind == "null"]
    lines = [
        "| method | right name first, effects >= 3 sigma | right name first, all | false alarms | held-out gain over the oracle's |",
        "|---|---|---|---|---|",
    ]
    for method in METHODS:
        lines.append(
            f"| {method} | {share([_right(r, method) for r in strong])} | {share([_right(r, method) for r in single])} "
            f"| {share([_alarms(r, method) for r in nulls])} | {_gains(strong, method)} |"
        )
    lines += ["", "| predicted significance | named first | named among aliases only | something else | nothing |", "|---|---|---|---|---|"]
    for low, high in ((0.0, 3.0), (3.0, 5.0), (5.0, 10.0), (10.0, 30.0), (30.0, np.inf)):
        some = [r for r in single if low <= r.significance < high]
        parts = (
            [r.first == r.cause for r in some],
            [r.first != r.cause and r.cause in r.open for r in some],
            [r.first != NONE and r.cause not in r.open for r in some],
            [r.first == NONE for r in some],
        )
        lines.append(f"| {low:g} to {high:g} | {' | '.join(share(p) for p in parts)} |")
    loud = [r for r in single if r.rms >= STRONG]
    lines += [
        "",
        f"right name first where the effect's RMS is 3 times the noise of a window or more: {share([r.cause in r.open for r in loud])}",
    ]
    hits = [(f, r.truth[f["cause"]]) for r in rows if r.kind in ("single", "pair") for f in r.findings if f["cause"] in r.truth]
    covered = [abs(f["size"] - size) <= 1.96 * f["sigma"] for f, size in hits]
    clear = [c for c, (f, _) in zip(covered, hits, strict=True) if f["cause"] not in ("encoder_dropout",)]
    spurious = [len({f["cause"] for f in r.findings} - set(r.truth) - set(r.alike)) for r in rows if r.kind == "single"]
    pairs = [r for r in rows if r.kind == "pair"]
    lines += [
        "",
        f"95 % intervals that hold the true size: {share(covered)}; without encoder_dropout: {share(clear)}",
        f"names beside the true one, on average: {np.mean(spurious) if spurious else 0.0:.3f} a drive; aliases of the first: "
        f"{np.mean([len(r.open) - 1 for r in single if r.findings] or [0.0]):.2f}",
        f"pairs of causes, both named: {share([set(r.truth) <= r.said for r in pairs])}, "
        f"both among those >= 3 sigma: {share([set(r.truth) <= r.said for r in pairs if r.significance >= STRONG])}",
        f"indistinguishable causes left open: {share([set(r.alike) <= r.open for r in rows if r.kind == 'alike'])}",
        f"CPU of a diagnosis, median and most: {np.median([r.seconds for r in rows]):.1f} s, {max(r.seconds for r in rows):.1f} s",
    ]
    if picture is not None:
        picture.write_bytes(_picture(strong, nulls))
    return "\n".join(lines)


def _name(r: Row, method: str) -> str:
    return r.first if method == "diagnosis" else r.rivals.get(method, (NONE, 0.0))[0]


def _alarms(r: Row, method: str) -> bool:
    """It says that something is wrong, with a name or without."""
    return r.verdict not in ("consistent", "undecidable") if method == "diagnosis" else _name(r, method) != NONE


def _right(r: Row, method: str) -> bool:
    """The true cause first, or (for all methods) a name that the diagnosis says is an alias of it on that drive."""
    name = _name(r, method)
    return name == r.cause or (r.cause in r.open and name in r.open)


def _gains(rows: Sequence[Row], method: str) -> str:
    shares = [(r.gain if method == "diagnosis" else r.rivals.get(method, (NONE, 0.0))[1]) / r.oracle for r in rows if r.oracle > 0.02]
    return f"{100.0 * np.median(shares):.0f} % ({100.0 * np.mean(np.array(shares) >= 0.8):.0f} % of drives reach 80 %)" if shares else "-"


def _picture(strong: Sequence[Row], nulls: Sequence[Row]) -> bytes:
    counts = Counter((r.cause, r.cause if r.cause in r.open else r.first) for r in [*strong, *nulls])
    names = [*TYPICAL, NONE]
    columns = [*names, *sorted({said for _, said in counts} - set(names))]
    table = np.array([[counts[truth, said] for said in columns] for truth in names], dtype=float)
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


if __name__ == "__main__":
    print(report(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None))
