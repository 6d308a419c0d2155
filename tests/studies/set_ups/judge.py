"""How answers are judged, and what many of them show: outcomes by number of symptoms and of sources, and whether probabilities are true."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from localization.evaluation.reference_files import load_reference
from localization.logs import Log, open_log
from localization.logs.decode import Oddity
from tests.studies.set_ups.answers import is_part, is_same, is_twin
from tests.studies.set_ups.draws import Draw

Infer = Callable[..., Any]
OUTCOMES = ("right", "ambiguous", "twin", "part", "misnamed", "silent", "false alarm", "failed")
"""
- right: certain, and corrects to the true motion; of a healthy log, silence
- ambiguous: nothing is certain, and the truth is among what is named
- twin: certain of as few rows, or of none, that no sensor of the log can separate from the truth
- part: names some of what is wrong, and nothing that is right
- misnamed: accuses what is right
- silent: something is wrong, and nothing is named
- false alarm: a healthy log is accused
"""
MAX_NAMED = 8
"""An answer that names more ways than these names none."""


@dataclass(frozen=True)
class Judged:
    """Outcome of a draw."""

    draw: str
    sources: tuple[str, ...]
    truth: tuple[str, ...]
    outcome: str
    probability: float
    """Of the most probable hypothesis."""
    is_top_right: bool
    answer: str
    cpu_s: float
    family: str = "simulated"


def judge(draw: Draw, folder: Path, infer: Infer) -> Judged:
    """Write the log, ask what its set-up is, and compare."""
    path = draw.write(folder)
    log = open_log(path, draw.robot)
    reference = None if draw.reference is None else load_reference(log, draw.reference)
    began = time.process_time()
    family = "simulated" if draw.name.startswith("drawn") else "real"
    truth = tuple(str(t) for t in draw.truth)
    try:
        answer = _ask(infer, log, reference)
    except Exception as error:  # a study goes on
        text = f"{type(error).__name__}: {error}"
        return Judged(draw.name, draw.sources, truth, "failed", 0.0, False, text, time.process_time() - began, family)
    cpu = time.process_time() - began
    moved = [*log.shifted_s, *(warning.partition(":")[0] for warning in log.warnings() if Oddity.FOREIGN_CLOCK.value in warning)]
    outcome, is_top_right = outcome_of(answer, without_clocks(draw, moved))
    hypotheses = answer.hypotheses
    named = "; ".join(f"{h.probability:.3f} {describe(h.rows)}" for h in hypotheses[:3])
    top = hypotheses[0].probability if hypotheses else 1.0
    return Judged(draw.name, draw.sources, truth, outcome, top, is_top_right, f"{answer.verdict}: {named}", cpu, family)


def _ask(infer: Infer, log: Log, reference: Any) -> Any:
    return infer(log, reference)


def without_clocks(draw: Draw, topics: Sequence[str]) -> Draw:
    """``draw`` without the faults of clocks of ``topics``: the log has named them, and takes the time of recording."""
    sources = {"wheels" if s == "driver" else s for s in draw.sources if draw.topics[s] in topics}
    faults = tuple(f for f in draw.faults if not (f.truth.id.startswith("clock.") and f.truth.id.partition(".")[2] in sources))
    return replace(draw, faults=faults)


def describe(rows: Sequence[Any]) -> str:
    """Rows in short."""
    parts = [f"{r.id} {r.detail or ''} {'' if r.value is None else f'{r.value:.3g}'}".strip() for r in rows]
    return "as the robot file says" if not parts else " + ".join(parts)


def outcome_of(answer: Any, draw: Draw) -> tuple[str, bool]:
    """One of `OUTCOMES`, and whether the most probable hypothesis is the truth."""

    def rows_of(hypothesis: Any) -> list[Any]:
        return [row for row in hypothesis.rows if row.id not in draw.known or _is_hidden(row.id, draw)]

    def is_true(hypothesis: Any) -> bool:
        return is_same(rows_of(hypothesis), draw.truth, draw.body)

    hypotheses = answer.hypotheses
    top = hypotheses[0] if hypotheses else None
    is_top_right = not draw.truth if top is None else is_true(top)
    is_quiet = answer.verdict in ("consistent", "undecidable") or (top is not None and answer.verdict == "certain" and not rows_of(top))
    if not draw.truth:
        return ("right" if is_quiet or (answer.verdict == "certain" and is_top_right) else "false alarm"), is_top_right
    if is_quiet:
        return ("twin" if is_twin([], draw.truth, draw.body) else "silent"), is_top_right
    if answer.verdict == "certain":
        assert top is not None
        rows = rows_of(top)
        if is_top_right:
            return "right", True
        if len(rows) <= len(draw.truth) and is_twin(rows, draw.truth, draw.body):
            return "twin", False
        return ("part" if is_part(rows, draw.truth, draw.body) else "misnamed"), False
    named = hypotheses[:MAX_NAMED]
    if any(is_true(h) for h in named):
        return "ambiguous", is_top_right
    if any(len(rows_of(h)) <= len(draw.truth) and is_twin(rows_of(h), draw.truth, draw.body) for h in named):
        return "twin", False
    return ("part" if all(not h.rows or is_part(rows_of(h), draw.truth, draw.body) for h in named) else "misnamed"), False


def _is_hidden(row: str, draw: Draw) -> bool:
    """Whether a row that is true of the log anyway is hidden in it besides."""
    return any(truth.id == row for truth in draw.truth)


def print_table(found: Sequence[Judged]) -> None:
    """Outcomes by number of symptoms, then of sources; calibration of the probabilities; CPU."""
    keys = [("all", lambda j: True)]
    for n in sorted({len(j.truth) for j in found}):
        keys.append((f"{n} symptoms", lambda j, n=n: len(j.truth) == n))
    for n in sorted({len(j.sources) for j in found}):
        keys.append((f"{n} sources", lambda j, n=n: len(j.sources) == n and len(j.truth) > 0))
    for family in sorted({j.family for j in found}):
        keys.append((family, lambda j, f=family: j.family == f))
    print(f"\n{'':14s}" + "".join(f"{o:>12s}" for o in OUTCOMES) + f"{'right+amb.':>12s}{'and twins':>12s}")
    for name, is_in in keys:
        these = [j for j in found if is_in(j)]
        counts = Counter(j.outcome for j in these)
        good = counts["right"] + counts["ambiguous"]
        print(
            f"{name:14s}"
            + "".join(f"{counts[o] or '.':>12}" for o in OUTCOMES)
            + f"{100.0 * good / max(len(these), 1):>11.1f}%"
            + f"{100.0 * (good + counts['twin']) / max(len(these), 1):>11.1f}%"
        )
    print("\nprobability of the most probable set-up, and how often it was the true one:")
    edges = (0.0, 0.5, 0.9, 0.97, 0.99, 1.0 + 1e-9)
    for low, high in itertools.pairwise(edges):
        these = [j for j in found if low < j.probability <= high and j.outcome != "failed"]
        if these:
            print(f"  {low:.2f} to {min(high, 1.0):.2f}: {sum(j.is_top_right for j in these)} of {len(these)}")
    times = sorted(j.cpu_s for j in found)
    print(f"CPU per check: median {times[len(times) // 2]:.1f} s, largest {times[-1]:.1f} s")
