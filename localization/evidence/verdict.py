"""From the posterior to an answer: consistent, certain, ambiguous or undecidable; what is corrected, and what the covariance must hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from localization.evidence.alternatives import Row
from localization.evidence.likelihood import Choice, Stack
from localization.evidence.refine import measured_scales, refined_rows
from localization.evidence.search import posterior, rows_of, search
from localization.evidence.signals import Source
from localization.messages import Message, message, phrase
from motion_models.robot import Robot

CERTAIN = 0.97
"""Probability from where on an answer is certain: of the answers above, 99 % are right (`tests.studies.set_ups`)."""
_NAMED = 0.01
"""Least probability of a set-up that is named beside others."""
_SIGN_TURN_RAD, _SIGN_WAY_M = np.pi, 10.0
"""Turn and way after which a wheel noise that grows with the motion has the error of an unknown factor: (2 x)^2 = 4 pi x at x = pi."""

Verdict = Literal["consistent", "certain", "ambiguous", "undecidable"]


@dataclass(frozen=True)
class Hypothesis:
    """One set-up and its probability."""

    probability: float
    rows: tuple[Row, ...] = ()
    """Faults; empty: all is as the robot file says."""

    @property
    def text(self) -> str:
        """Its faults in a clause."""
        return " and ".join(row.text for row in self.rows) or "all is as the robot file says"


@dataclass(frozen=True)
class SetUp:
    """Which set-up a log's sensors agree with."""

    verdict: Verdict
    robot: Robot
    """With what is certain corrected, and a covariance for what is not."""
    hypotheses: tuple[Hypothesis, ...] = ()
    sentences: tuple[Message, ...] = ()
    keys: dict[str, str] = field(default_factory=dict)
    """Entries to write to the robot file, by their key: text of the value in TOML."""
    is_gyro_used: bool = True
    """False where the gyro may have another sign or axis, or measures another motion."""
    reason: str = ""
    """Why nothing could be compared."""
    by_file: float = 0.0
    """Probability that all is as the robot file declares."""
    against: Mapping[str, float] = field(default_factory=dict)
    """By id of a row: logarithm of the Bayes factor against that fault alone."""
    scales: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict)
    """By source and channel (way, turn): logarithm of what it measures over the motion, with the others as scale, and its sigma."""

    @property
    def is_as_declared(self) -> bool:
        """Whether the log is read as the robot file declares it."""
        return not self.sentences and not self.keys

    @property
    def is_ambiguous(self) -> bool:
        """Whether several set-ups remain."""
        return self.verdict == "ambiguous"

    @property
    def is_open(self) -> bool:
        """Whether several set-ups remain that read the log otherwise: of two clocks that are apart, either brings them together."""
        return self.is_ambiguous and any(each.id == "set_up.ambiguous" for each in self.sentences)

    @property
    def faults(self) -> tuple[Row, ...]:
        """Rows of the most probable set-up, where the robot file's is refuted."""
        return self.hypotheses[0].rows if self.verdict in ("certain", "ambiguous") else ()


def decide(sources: Sequence[Source], stacks: Sequence[Stack], robot: Robot, own: tuple[Row, ...] = ()) -> SetUp:
    """The answer to `search`, beside the faults that messages show by their ``own`` fields."""
    searched = search(stacks)
    stacks = searched.stacks
    ranked = posterior(stacks, searched.scores)
    found = [(p, choice, (*own, *_faults(refined_rows(stacks, choice, robot)))) for p, choice in ranked]
    hypotheses = tuple(Hypothesis(p, rows) for p, _, rows in found if p >= _NAMED)
    by_file = sum(p for p, _, rows in found if not rows)
    if by_file > 1.0 - CERTAIN:
        chosen = next(choice for _, choice, rows in found if not rows)
        usual = _with_usual(robot, stacks, chosen)
        scales, keys = measured_scales(stacks, chosen), changed_entries(robot, usual)
        reported = _reported(sources, stacks, robot, ranked, chosen)
        return SetUp("consistent", usual, hypotheses, reported, keys, by_file=by_file, against=searched.against, scales=scales)
    kept = [(p, choice, rows) for p, choice, rows in found if p >= _NAMED]
    common = _common(kept)
    is_certain = kept[0][0] >= CERTAIN or all(len(rows) == len(common) for _, _, rows in kept)
    usual = _with_usual(robot, stacks, kept[0][1])
    if (alignment := _alignment(sources, kept, common)) is not None:
        return _aligned(sources, kept, common, alignment, (robot, usual), hypotheses, by_file)
    corrected = _correct(usual, common)
    keys = changed_entries(robot, corrected)
    families = {row.family for row in common}
    rest = [] if is_certain else [tuple(row for row in rows if row.family not in families) for _, _, rows in kept]
    is_gyro_used = not any(row.source == "gyro" and row.correct is None for row in common)
    is_gyro_used &= not any(row.source == "gyro" for rows in rest for row in rows)
    unresolved = [(p, choice) for p, choice, rows in kept if any(row.correct is None or row.family not in families for row in rows)]
    corrected = _with_mixture_noise(corrected, stacks, unresolved)
    reported = _reported(sources, stacks, robot, ranked, kept[0][1])
    sentences = (*reported, *_correction_warnings(sources, common, usual, kept), *_ambiguity_warnings(sources, kept, rest))
    return SetUp("certain" if is_certain else "ambiguous", corrected, hypotheses, sentences, keys, is_gyro_used, by_file=by_file)


def _alignment(sources: Sequence[Source], kept: Sequence[tuple[float, Choice, tuple[Row, ...]]], common: tuple[Row, ...]) -> Row | None:
    """The clock to shift where set-ups differ in which of the clocks is off, whatever else they differ in, and all have one; else None."""
    families = {row.family for row in common}
    rest = [[row for row in rows if row.source == "clock" and row.family not in families] for _, _, rows in kept]
    clocks = {row.id: row for rows in rest for row in rows}
    if len(kept) < 2 or len(clocks) < 2 or any(len(rows) != 1 for rows in rest):
        return None
    return next((clocks[key] for key in ("clock.wheels", "clock.gyro", "clock.lidar") if key in clocks), None)


def _aligned(
    sources: Sequence[Source],
    kept: Sequence[tuple[float, Choice, tuple[Row, ...]]],
    common: tuple[Row, ...],
    clock: Row,
    robots: tuple[Robot, Robot],
    hypotheses: tuple[Hypothesis, ...],
    by_file: float,
) -> SetUp:
    """Two clocks are apart, and nothing shows which is off: they are brought together, and the covariance has the way in that time.

    ``robots``: as declared, and with what the robot file leaves open.
    """
    robot, usual = robots
    rows = (*common, clock)
    families = {row.family for row in rows}
    corrected = _correct(usual, rows)
    others = sorted({" and ".join(row.text for row in r if row.family not in families) for _, _, r in kept} - {""})
    late_s = abs(clock.value or 0.0)
    keys = changed_entries(robot, corrected)
    text = _alignment_warning(sources, clock, others, keys)
    corrected = replace(corrected, clock=replace(corrected.clock, sigma_s=max(corrected.clock.sigma_s, late_s)))
    return SetUp("ambiguous", corrected, hypotheses, (*_correction_warnings(sources, common, usual, kept), text), keys, by_file=by_file)


def _alignment_warning(sources: Sequence[Source], clock: Row, others: Sequence[str], keys: Mapping[str, str]) -> Message:
    written = "; ".join(f"{key} = {value}" for key, value in keys.items() if key.startswith("clock."))
    names = " and ".join(source.name for source in sources)
    return message(
        "set_up.clocks",
        sources=names,
        seconds=abs(clock.value or 0.0),
        topic=_topic(sources, clock),
        clock=clock.text,
        others=", ".join(others),
        correction=phrase("set_up.in_this_run"),
        entries=written,
    )


def _faults(rows: Sequence[Row]) -> tuple[Row, ...]:
    return tuple(row for row in rows if row.is_fault)


def _common(kept: Sequence[tuple[float, Choice, tuple[Row, ...]]]) -> tuple[Row, ...]:
    """Faults of the most probable set-up of whose family all named ones have one: their measured values hardly differ."""
    shared = set.intersection(*({row.family for row in rows} for _, _, rows in kept))
    return tuple(row for row in kept[0][2] if row.family in shared)


def _with_usual(robot: Robot, stacks: Sequence[Stack], choice: Choice) -> Robot:
    """``robot`` with the rows of a choice that are no faults, which its file leaves open."""
    return _correct(robot, [row for row in rows_of(stacks, choice) if not row.is_fault])


def _reported(
    sources: Sequence[Source], stacks: Sequence[Stack], robot: Robot, ranked: Sequence[tuple[float, Choice]], chosen: Choice
) -> tuple[Message, ...]:
    """Messages on what the robot file leaves open and should have, which the ``chosen`` set-up shows."""
    found = list[Message]()
    for row in rows_of(stacks, chosen):
        if not row.is_fault and row.is_reported:
            having = [(p, choice, (row,)) for p, choice in ranked if any(other.key == row.key for other in rows_of(stacks, choice))]
            found += _correction_warnings(sources, [row], robot, having)
    return tuple(found)


def _correct(robot: Robot, rows: Sequence[Row]) -> Robot:
    for row in rows:
        robot = robot if row.correct is None else row.correct(robot)
    return robot


def _with_mixture_noise(robot: Robot, stacks: Sequence[Stack], unresolved: Sequence[tuple[float, Choice]]) -> Robot:
    """``robot`` whose wheel noise has the spread of the motion between the set-ups that remain: E[(x_h - x)^2] / E[x^2] per unit of x."""
    shares = {"way": 0.0, "turn": 0.0}
    total = sum(p for p, _ in unresolved)
    wheels = next((i for i, stack in enumerate(stacks) if stack.kind in ("wheels", "driver")), None)
    if not total or wheels is None:
        return robot
    for name in shares:
        by_file = getattr(stacks[wheels].alternatives[0], name)
        size = float(np.nansum(by_file**2)) or 1.0
        for p, choice in unresolved:
            other = getattr(stacks[wheels].alternatives[choice[wheels]], name)
            shares[name] += p / total * min(float(np.nansum((other - by_file) ** 2)) / size, 4.0)
    noise = robot.wheel_noise
    noise = replace(
        noise,
        yaw_rad2_per_rad=max(noise.yaw_rad2_per_rad, _SIGN_TURN_RAD * shares["turn"]),
        longitudinal_m2_per_m=max(noise.longitudinal_m2_per_m, _SIGN_WAY_M * shares["way"]),
    )
    return replace(robot, wheel_noise=noise)


def _correction_warnings(
    sources: Sequence[Source], common: Sequence[Row], robot: Robot, kept: Sequence[tuple[float, Choice, tuple[Row, ...]]]
) -> list[Message]:
    found = []
    probability = min(sum(p for p, _, _ in kept), 0.999)
    for row in common:
        after = robot if row.correct is None else row.correct(robot)
        entries = changed_entries(robot, after)
        written = "; ".join(f"{key} = {value}" for key, value in entries.items())
        about = {"topic": _topic(sources, row), "fault": row.text, "probability": probability, "others": _others(sources, row)}
        if written:
            found.append(message("set_up.certain", correction=phrase("set_up.in_this_run"), entries=written, **about))
        else:
            found.append(message("set_up.by_hand", remedy=row.remedy or phrase("set_up.check"), **about))
    return found


def _ambiguity_warnings(
    sources: Sequence[Source], kept: Sequence[tuple[float, Choice, tuple[Row, ...]]], rest: Sequence[tuple[Row, ...]]
) -> list[Message]:
    if not rest:
        return []
    ways = []
    for (p, _, _), rows in zip(kept, rest, strict=True):
        faults = " and ".join(row.text for row in rows) or phrase("set_up.nothing_more")
        ways.append(phrase("set_up.one_way", faults=faults, probability=p))
    kinds = {source.kind for source in sources}
    deciders = {"gyro": phrase("set_up.gyro"), "lidar": phrase("set_up.lidar")}
    absent = [text for kind, text in deciders.items() if kind not in kinds]
    record = phrase("set_up.record", sensors=phrase("set_up.or").join(absent)) if absent else ""
    listed = ", ".join(ways[:-1]) + (f", or {ways[-1]}" if len(ways) > 1 else ways[-1])
    return [message("set_up.ambiguous", sources=" and ".join(source.name for source in sources), ways=listed, record=record)]


def as_written(messages: Sequence[Message]) -> tuple[Message, ...]:
    """``messages``, of which those on the set-up say that its entries are in the robot file that is written."""
    return tuple(each.but(correction=phrase("set_up.written")) if each.id.startswith("set_up.") else each for each in messages)


def _topic(sources: Sequence[Source], row: Row) -> str:
    if row.of:
        return row.of
    kind = row.id.partition(".")[2] if row.source == "clock" else row.source
    kinds = {"wheels": ("wheels", "driver"), "driver": ("driver",)}.get(kind, (kind,))
    return next((source.name for source in sources if source.kind in kinds), kind)


def _others(sources: Sequence[Source], row: Row) -> str:
    topic = _topic(sources, row)
    return " and ".join(source.name for source in sources if source.name != topic) or phrase("set_up.own_messages")


def changed_entries(before: Robot, after: Robot) -> dict[str, str]:
    """Entries of the robot file that differ, by key: text of the value in TOML."""
    found: dict[str, str] = {}
    for part in ("geometry", "driver", "joints", "imu", "lidar", "clock", "tf"):
        _add_changed(found, part, getattr(before, part), getattr(after, part))
    for frame, mount in after.mounts.items():
        _add_changed(found, f"mounts.{frame}", before.mounts.get(frame), mount)
    return found


def _add_changed(found: dict[str, str], part: str, before: Any, after: Any) -> None:
    for entry in dataclasses.fields(after):
        value = getattr(after, entry.name)
        if before is None or getattr(before, entry.name) != value:
            if before is None and value == entry.default:
                continue
            found[f"{part}.{entry.name}"] = _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f'"{item}"' for item in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else f'"{value}"' if isinstance(value, str) else str(value).lower()
