"""Which set-up is this log's? Symptoms of practice, up to four at once, hidden in logs of drawn robots and in parts of real logs.

`python -m tests.studies.set_ups --draws N --seed S --faults 0:4 [--real SHARE] [--row ID] [--json FILE] [--by MODULE:FUNCTION]`
prints a line for each answer that is not right, a table by number of symptoms and of sources, and whether the probabilities are true.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.studies.set_ups.draws import SENSORS, Draw, real, seed_of, simulated
from tests.studies.set_ups.judge import Judged, judge, print_table
from tests.studies.set_ups.symptoms import Symptom


def draw_log(seed: int, i: int, faults: tuple[int, int], real_share: float, rows: Sequence[str] = ()) -> Draw:
    """The ``i``-th draw of a seed: sources in turn, then numbers of symptoms in turn, at most one for each source."""

    def is_asked(symptom: Symptom) -> bool:
        return not rows or any(symptom.id.startswith(row) for row in rows)

    own = seed_of(seed, i)
    low, high = faults
    count = low + (i // len(SENSORS) + i) % (high - low + 1)  # each number with each choice of sources
    if (own % 1000) / 1000.0 < real_share:
        return real(own, min(count, 2), allowed=is_asked)
    having = [sources for sources in SENSORS if not rows or any(row.split(".")[0] in (*sources, "clock") for row in rows)]
    sources = having[i % len(having)]
    return simulated(own, min(count, len(sources)), sources, is_asked)


def run(draws: Sequence[int], seed: int, faults: tuple[int, int], real_share: float, rows: Sequence[str], by: str) -> list[Judged]:
    """Judge draws, and print what is not right."""
    module, _, function = by.partition(":")
    infer = getattr(importlib.import_module(module), function)
    found = []
    for i in draws:
        drawn = draw_log(seed, i, faults, real_share, rows)
        with tempfile.TemporaryDirectory() as folder:
            one = judge(drawn, Path(folder), infer)
        found.append(one)
        if one.outcome != "right":
            print(
                f"{i:4d} {one.outcome:11s} {'+'.join(one.sources)} [{drawn.name}] {' + '.join(one.truth)} -> {one.answer[:300]}", flush=True
            )
    return found


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--only", type=int, nargs="*", help="indices of draws")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--faults", default="0:3", help="least and most symptoms of a log")
    parser.add_argument("--real", type=float, default=0.2, help="share of parts of real logs")
    parser.add_argument("--row", nargs="*", default=[], help="ids of the table, or beginnings of them")
    parser.add_argument("--by", default="localization.evidence:infer_set_up", help="module and function that answers")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    low, _, high = given.faults.partition(":")
    draws = given.only if given.only is not None else range(given.draws)
    found = run(draws, given.seed, (int(low), int(high or low)), given.real, given.row, given.by)
    if given.json:
        given.json.write_text(json.dumps([dataclasses.asdict(j) for j in found], indent=1))
    print_table(found)


if __name__ == "__main__":
    main()
