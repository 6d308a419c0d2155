"""The one question that is asked of every reference: is its motion that of the robot's sensors, and in which clock, unit and axes?

`compare_reference` compares a reference with one or several paths, of estimates or of the sensors (`paths_of`). A reference is contradicted
only if no path agrees with it as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from localization.evidence.alternatives import MAKERS
from localization.evidence.alternatives.positions import Candidate, alternatives
from localization.evidence.paths import make_path, make_track
from localization.evidence.signals import Source
from localization.evidence.verdict import CERTAIN, Hypothesis, Verdict
from localization.messages import Message, message
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_MIN_WAY_M, _WAY_RESOLUTION_M = 2.0, 0.05
"""Way of a path that is compared, at this resolution."""
_MIN_DURATION_S = 20.0
"""Two windows: in less, a curve of its own explains any motion."""
_NAMED = 0.01
"""Least probability of a set-up that is named beside others."""
_STEP_S = 0.1
"""Interval of the paths by the sensors [s]."""


@dataclass(frozen=True)
class ReferenceSetUp:
    """How a reference is given."""

    verdict: Verdict
    hypotheses: tuple[Hypothesis, ...] = ()
    sentences: tuple[Message, ...] = ()
    """What contradicts the sensors."""
    scale: float = math.nan
    """Length of its ways over the sensors', by the most probable of all."""
    delay_s: float = math.nan
    """By how much its stamps are ahead of the sensors', by that."""
    reason: str = ""
    """Why nothing could be compared."""


class ReferenceSamples(Protocol):
    """Poses or positions of the robot by a reference system."""

    @property
    def source(self) -> str:
        """Topic or file."""

    @property
    def stamps_ns(self) -> IntArray:
        """(n,) increasing."""

    @property
    def positions(self) -> FloatArray:
        """(n, 2)"""

    @property
    def yaws(self) -> FloatArray | None:
        """(n,) [rad], or None where there are positions only."""

    @property
    def has_times(self) -> bool:
        """False where its times were spread over the log's."""


def compare_reference(reference: ReferenceSamples, paths: Sequence[Trajectory]) -> ReferenceSetUp:
    """How the ``reference`` is given, by the motion of ``paths``, any of which may be right."""
    name = reference.source
    usable = [path for path in paths if len(path) > 3 and path.distance(_WAY_RESOLUTION_M) > _MIN_WAY_M]
    if not usable:
        return ReferenceSetUp("undecidable", reason=f"{name}: the robot hardly moves by its sensors: drive 5 m with turns both ways.")
    origin_ns = int(usable[0].stamps_ns[0])
    begin, end = (max(path.stamps_ns[i] for path in usable) if i == 0 else min(path.stamps_ns[i] for path in usable) for i in (0, -1))
    if min(end - begin, reference.stamps_ns[-1] - reference.stamps_ns[0]) < _MIN_DURATION_S * 1e9:
        return ReferenceSetUp("undecidable", reason=f"{name}: less than {_MIN_DURATION_S:g} s: drive on, with turns both ways.")
    track = make_track(np.asarray((reference.stamps_ns - origin_ns) * 1e-9, dtype=float), reference.positions, reference.yaws)
    if track is None:
        return ReferenceSetUp("undecidable", reason=f"{name}: too few samples, or more noise than motion: drive further, with turns.")
    found = alternatives(track, [make_path(path, origin_ns) for path in usable], reference.has_times)
    return _decide(name, found)


def _decide(name: str, found: Sequence[Candidate]) -> ReferenceSetUp:
    top = max(candidate.score for candidate in found)
    grouped: dict[tuple[tuple[str, str], ...], list[Candidate]] = {}
    for candidate in found:
        grouped.setdefault(tuple(sorted(row.key for row in candidate.faults)), []).append(candidate)
    mass = {key: sum(math.exp(each.score - top) for each in members) for key, members in grouped.items()}
    total = sum(mass.values())
    ranked = sorted(((mass[key] / total, max(members, key=lambda each: each.score)) for key, members in grouped.items()), key=_first)[::-1]
    kept = [(p, candidate) for p, candidate in ranked if p >= _NAMED]
    hypotheses = tuple(Hypothesis(p, candidate.faults) for p, candidate in kept)
    best = kept[0][1]
    scale, delay_s = (math.nan, math.nan) if best.fit is None else (best.fit.scale, best.delay_s)
    by_file = mass.get((), 0.0) / total
    if by_file > 1.0 - CERTAIN:
        return ReferenceSetUp("consistent", hypotheses, (), scale, delay_s)
    if kept[0][0] >= CERTAIN:
        sentences = tuple(message("set_up.reference", reference=name, fault=row.text, remedy=row.remedy) for row in best.faults)
        return ReferenceSetUp("certain", hypotheses, sentences, scale, delay_s)
    ways = ", or ".join(f"{hypothesis.text} ({hypothesis.probability:.2f})" for hypothesis in hypotheses)
    sentence = message("set_up.reference_ambiguous", reference=name, ways=ways)
    return ReferenceSetUp("ambiguous", hypotheses, (sentence,), scale, delay_s)


def _first(pair: tuple[float, Candidate]) -> float:
    return pair[0]


def paths_of(sources: Sequence[Source], robot: Robot) -> list[Trajectory]:
    """Paths by the ``sources`` of a log as ``robot`` has them: ways by wheels, driver or LiDAR, turns by any, of both fields
    of messages that have two; unknown is standing."""
    ways, turns = list[FloatArray](), list[FloatArray]()
    used = [source for source in sources if source.kind != "reference"]
    edges = np.arange(min((s.t[0] for s in used), default=0.0), max((s.t[-1] for s in used), default=0.0), _STEP_S)
    if len(edges) < 3:
        return []
    for source in used:
        rates, second = source.rates(edges), source.rates(edges, of_second=True)
        both = (rates,) if source.second is None else (rates, second)
        for own in both:
            by_file = MAKERS[source.kind](source, own, second, robot)[0]
            ways += [] if by_file.way is None else [by_file.way]
            turns += [] if by_file.turn is None else [by_file.turn]
    stamps = used[0].first_ns + np.round(edges * 1e9).astype(np.int64)
    return [Trajectory(stamps, _integrated(way, turn)) for way in ways for turn in turns]


def _integrated(way: FloatArray, turn: FloatArray) -> FloatArray:
    twists = np.nan_to_num(np.stack([way, np.zeros_like(way), turn], axis=1))
    poses = [np.zeros(3)]
    for step in se2.exp(twists * _STEP_S):
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)
