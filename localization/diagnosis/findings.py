"""Result of a diagnosis: findings, their JSON form, and their sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from localization.diagnosis.causes import CAUSES, COUNTED
from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.causes.gyro_and_ranging import RANGE_BIAS, RANGE_SCALE
from localization.diagnosis.drive import EncoderLoss, MessageLoss, StandstillTurn
from localization.diagnosis.drive_predictor import CHANNELS
from localization.diagnosis.gate import HandoverCheck
from localization.diagnosis.model_extension import Extension
from localization.diagnosis.noise import Noise
from localization.messages import Message, message, phrase
from motion_models.se2 import FloatArray

Verdict = Literal["consistent", "explained", "extended", "ambiguous", "unexplained", "undecidable"]
MAX_NOISE_OVER_REFERENCE = 3.0
"""Noise of the drive, over that of the motion reference by its own covariance: up to 2.0 where nothing is hidden, 3.1 to 200 for effects
that no cause has (`tests.studies.unknown_effects --develop`)."""

_SHOWN_GAIN = 0.01  # smallest gain that a sentence reports: in short drives tolerated differences mask it

_AND = " and "
"""Between the causes in whose place a trend explains a drive."""
_NOT_SHOWN = "This drive cannot show what is wrong with {}."
_TWO_SIDED_95 = 1.96
_USUAL_SHARE = 0.75  # three of the four sigma up to which a size is plausible
_MAX_MOVED_SHARE = 0.1  # of a size that is right although another finding beside it is not: accuracy of signatures
_JOINT_LEVEL = 0.001
"""Probability of all sizes within tolerance together below which it is reported: one of a thousand healthy robots has it."""
_MAX_SUSPECTED_ALIASES = 3  # that a sentence names

_CHANNEL_WORDS = {
    "x": "along the drive",
    "y": "sideways",
    "yaw": "in heading",
    "gyro": "between gyro and motion reference",
    "force_x": "in the accelerometers",
    "force_y": "in the accelerometers",
}


@dataclass(frozen=True)
class Gain:
    """Held-out discrepancies, in units of their noise (root mean square): without and with the cause, each predicted by sizes that were
    fitted to other parts of the drive."""

    before: float
    after: float
    relative: float
    low: float
    """95 % interval of ``relative``, by bootstrap over blocks of neighbouring windows."""
    high: float

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`."""
        return {
            "heldout_rms_before": self.before,
            "heldout_rms_after": self.after,
            "relative": self.relative,
            "relative_interval": [self.low, self.high],
        }


@dataclass(frozen=True)
class Finding:
    """A named cause."""

    definition: Cause
    size: float
    sigma: float
    p_value: float
    """Probability that noise alone would make any cause look as strong as this."""
    aliases: tuple[tuple[str, float], ...]
    """Causes that would explain the same drive about as well, each with its size."""
    evidence: str
    gain: Gain
    moves: Mapping[str, float] = field(default_factory=dict)
    """By how much the size would be less if another finding had none, by its cause: their covariance over its variance, times its size."""

    @property
    def cause(self) -> str:
        """The cause's id."""
        return self.definition.id

    @property
    def is_counted(self) -> bool:
        """Whether it was counted where the log was read, and not estimated from the motion."""
        return self.definition in COUNTED

    @property
    def is_plausible(self) -> bool:
        """Whether robots have the cause at a size in its 95 % interval."""
        low, high = self.definition.limits
        return abs(self.size) - _TWO_SIDED_95 * self.sigma <= self.definition.largest_plausible and low <= self.size <= high

    @property
    def is_usual(self) -> bool:
        """Whether the size is within three sigma of what robots have: only such sizes are written."""
        return abs(self.size) <= _USUAL_SHARE * self.definition.largest_plausible

    def is_independent_of(self, causes: Collection[str]) -> bool:
        """Whether the size stays within its sigma, or within a tenth of it, where none of these ``causes`` has a size."""
        moved = sum(move for cause, move in self.moves.items() if cause in causes)
        return abs(moved) <= max(self.sigma, _MAX_MOVED_SHARE * abs(self.size))

    @property
    def description(self) -> str:
        """Effect of the cause, with direction and size, as a clause."""
        return self.definition.describe(self.size)

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`; the size is in the unit of the cause."""
        return {
            "cause": self.cause,
            "meaning": self.definition.meaning,
            "description": self.description,
            "is_plausible": self.is_plausible,
            "size": self.size,
            "sigma": self.sigma,
            "unit": self.definition.unit,
            "spell": _spell_dict(self.definition),
            "p_value": self.p_value,
            "aliases": [name for name, _ in self.aliases],
            "alias_sizes": dict(self.aliases),
            "evidence": self.evidence,
            "gain": self.gain.to_dict(),
        }


def _spell_dict(cause: Cause) -> dict[str, Any] | None:
    """Start and end of the part of the drive in which ``cause`` holds [s], with their 95 % intervals; None for the whole drive."""
    if cause.spell is None:
        return None
    start, end = cause.spell
    intervals = cause.spell_95 or ((start, start), (end, end))
    is_open = math.isinf(end)
    return {"start_s": start, "end_s": None if is_open else end, "start_95": intervals[0], "end_95": None if is_open else intervals[1]}


RowStatus = Literal["noise", "attributed", "within tolerance", "unexplained"]


class Attribution(NamedTuple):
    """A cause that accounts for a part of one row of discrepancies."""

    cause: str
    size: float
    share: float
    """Share of the row's whitened squares that the cause accounts for."""
    is_named: bool
    """Whether it is a finding; otherwise it is within its tolerance."""


@dataclass(frozen=True)
class Component:
    """One component of the discrepancy over the whole drive, without outlier windows."""

    unit: str
    rms: float
    expected_rms: float
    """Root mean square by noise alone, as estimated from this drive."""
    p_value: float
    corrected_rms: float
    """Root mean square after correction of all named causes."""
    unattributed_rms: float
    """Once what is within tolerance is taken off as well."""
    noise_over_reference: float = 1.0
    """Noise of the drive over that of the motion reference by its own covariance."""
    status: RowStatus = "noise"
    attributions: tuple[Attribution, ...] = ()
    trend: str = ""
    """Along what a part follows that no cause has, where that makes the row unexplained."""

    def with_status(self, status: RowStatus, attributions: tuple[Attribution, ...]) -> Component:
        """The row with this status and these attributions."""
        return dataclasses.replace(self, status=status, attributions=attributions)

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`; root mean squares are in ``unit``."""
        return {
            "unit": self.unit,
            "rms": self.rms,
            "expected_rms": self.expected_rms,
            "p_value": None if math.isnan(self.p_value) else self.p_value,
            "rms_explained": self.corrected_rms,
            "rms_unattributed": self.unattributed_rms,
            "noise_over_reference": self.noise_over_reference,
            "status": self.status,
            "attributions": [a._asdict() for a in self.attributions],
            "trend": self.trend,
        }


@dataclass(frozen=True)
class Trend:
    """A trend in what is left that no cause has."""

    component: str
    along: str
    t: float
    p_value: float
    """Probability that noise alone would follow any trend as well; for one in place of findings the ratio of the likelihoods, at most 1."""
    over_noise: float
    """Its root mean square over the noise of the component."""
    instead_of: str = ""
    """The findings in whose place it explains the drive; empty for a trend beside the findings."""
    lead: float = 0.0
    """Log-likelihood by which it explains the drive better than these, below 0 where it is preferred as one number in place of several."""

    @property
    def text(self) -> str:
        """The trend in a sentence, with t and p or log-likelihood."""
        if self.instead_of and self.lead > 0.0:
            return (
                f"{self.component} is explained better by {self.along} than by {self.instead_of} (t = {self.t:+.1f}, "
                f"log-likelihood +{self.lead:.0f})"
            )
        if self.instead_of:
            return f"{self.component} follows {self.along}, one trend in place of {self.instead_of} (log-likelihood {self.lead:+.0f})"
        size = f"{self.over_noise:.2g} times its noise"
        return f"the {self.component} left over follows {self.along} (t = {self.t:+.1f}, p = {self.p_value:.2g}, {size})"


@dataclass(frozen=True)
class Diagnosis:
    """The answer to one drive and one model."""

    log: str
    robot: str
    model: str
    motion_reference: str
    verdict: Verdict
    discrepancy: Mapping[str, Component]
    findings: tuple[Finding, ...]
    trends: tuple[Trend, ...]
    left_share: float
    """Share of the predictable part of the discrepancy that `trends` explain, 0 to 1."""
    next_drive: str
    within: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Causes that are significant but smaller than their tolerance: size and sigma."""
    tolerances: Mapping[str, float] = field(default_factory=dict)
    """Tolerated size of each of them."""
    detectable_sizes: Mapping[str, float] = field(default_factory=dict)
    """Smallest size of each cause that this drive would show (three sigma, beside all that is tolerated)."""
    gain: Gain | None = None
    """Gain of correcting all findings together."""
    contradictions: tuple[Message, ...] = ()
    """Measurements that exclude each other, in sentences."""
    outliers_s: tuple[float, ...] = ()
    """When windows began that no cause explains to eight sigma: jumps of the reference, or events on the floor."""
    windows: int = 0
    warnings: tuple[Message, ...] = ()
    too_little: str = ""
    """Why the drive was not searched for causes: too little was measured."""
    suspected: Finding | None = None
    """Where the verdict is consistent: the strongest cause, too weak to be named, but stronger than four in five healthy drives show."""
    joint_p: float = 1.0
    """Probability that a healthy robot has as much within tolerance as this drive shows, of all causes together."""
    handover: HandoverCheck | None = None
    """Gain of the corrected robot file on the second half of the drive."""
    set_up: tuple[Message, ...] = ()
    """How the sensors are set up otherwise than the robot file had it, which was corrected before anything was compared."""
    extension: Extension | None = None
    """Terms and bound effects that were searched beside the findings; None where none were searched, or none found."""

    @property
    def sentence(self) -> str:
        """What to do, in one or two sentences; every text about the drive has it from here."""
        return sentence(self)

    @property
    def is_confirmed(self) -> bool:
        """Whether the robot may be corrected by the findings: by the file that they make, on the part of the drive that did not make it.

        Where a part of the drive stays unexplained, errors have to shrink beyond their scatter over the windows: what is unexplained is in
        the drive's noise, whose sigma does not show whether anything changed. Without such a file they are those of windows that sizes
        were not fitted to.
        """
        if self.handover is not None and not self.handover.is_better:
            return False
        check = self.gain if self.handover is None else self.handover.gain
        return self.verdict != "unexplained" or (check is not None and check.low > 0.0)

    def to_dict(self) -> dict[str, Any]:
        """The format of `diagnose --json`, whose keys stay as they are."""
        left: dict[str, Any] = {"share": self.left_share, "shapes": [vars(s) for s in self.trends], "text": [s.text for s in self.trends]}
        return {
            "log": self.log,
            "robot": self.robot,
            "model": self.model,
            "verdict": self.verdict,
            "discrepancy": {name: c.to_dict() for name, c in self.discrepancy.items()},
            "findings": [f.to_dict() for f in self.findings],
            "gain": None if self.gain is None else self.gain.to_dict(),
            "left_unexplained": left if self.trends else {},
            "suspected": None if self.suspected is None else self.suspected.to_dict(),
            "next_drive": self.next_drive,
            "sentence": self.sentence,
            "set_up": [each.as_json() for each in self.set_up],
            "tolerances": dict(self.tolerances),
            "handover": None if self.handover is None else {**self.handover.to_dict(), "is_better": self.is_confirmed},
            "extension": None if self.extension is None else self.extension.to_dict(),
            "not_written": {f.definition.label: why for f, why in not_written(self)},
            "contradictions": list(self.contradictions),
            "outlier_windows_s": list(self.outliers_s),
            "witness": self.motion_reference,
            "windows": self.windows,
            "within_tolerance_p": self.joint_p,
            "within_tolerance": {name: list(value) for name, value in self.within.items()},
            "smallest_visible": dict(self.detectable_sizes),
            "notes": list(self.warnings),
        }


def evidence(cause: Cause, part: FloatArray, noise: Noise, twice_likelihood: float) -> str:
    """Where the cause shows: ``part`` (M, 6) is what it adds to the discrepancy."""
    strength = np.sum(noise.whiten(np.nan_to_num(part)) ** 2, axis=0)
    whole = max(float(strength.sum()), 1e-12)
    order = np.argsort(-strength)
    places = [f"{_CHANNEL_WORDS[CHANNELS[c]]} ({100.0 * strength[c] / whole:.0f} %)" for c in order if strength[c] > 0.15 * whole]
    text = f"shows {', '.join(dict.fromkeys(places))}; log-likelihood +{twice_likelihood / 2.0:.0f}"
    if cause.at_s is not None and cause.changes_on_the_way:
        text += f"; from {cause.at_s:.0f} s on"
    return text


def describe_loss(loss: MessageLoss) -> str:
    """Where the share of missing messages comes from."""
    return f"{loss.gaps} gaps of up to {loss.longest_s:.2g} s between messages that come every {1e3 * loss.period_s:.3g} ms"


def describe_encoder_losses(losses: Sequence[EncoderLoss]) -> str:
    """Which encoders lost how much; the largest first."""
    each = [f"'{one.joint}' in {one.spells} spell{'' if one.spells == 1 else 's'}, {100.0 * one.share:.2g} %" for one in losses]
    return f"{', '.join(each)} of the messages; the other wheels of its side replace it"


def describe_standstill_turn(turn: StandstillTurn) -> Message:
    """A gyro that turns while the wheels stand, and what to check."""
    at, before = phrase("measured_motion.first_at", seconds=turn.first_s), phrase("measured_motion.first_before", seconds=-turn.first_s)
    angle, rate = math.degrees(turn.angle_rad), math.degrees(turn.angle_rad / turn.seconds)
    first = at if turn.first_s >= 0.0 else before
    return message("measured_motion.standstill_turn", seconds=turn.seconds, first=first, degrees=angle, rate=rate)


def describe_tolerated(d: Diagnosis) -> list[str]:
    """One line for each cause that is significant but within its tolerance, and not suspected."""
    found = []
    for name, (size, sigma) in d.within.items():
        if d.suspected is not None and name == d.suspected.cause:
            continue
        unit = unit_of(name)
        found.append(f"{name} {size:+.2g} +- {sigma:.1g}{unit} (tolerated {d.tolerances.get(name, math.nan):.2g}{unit})")
    return found


def noise_notes(rows: Mapping[str, Component]) -> tuple[Message, ...]:
    """Rows in which nothing is significant, and whose noise is more than the motion reference states: it is the reference's."""
    return tuple(
        message("measured_motion.small_noise", row=name, rms=row.expected_rms, unit=row.unit, ratio=row.noise_over_reference)
        for name, row in rows.items()
        if row.status != "unexplained" and row.noise_over_reference > MAX_NOISE_OVER_REFERENCE
    )


def describe_p(p: float) -> str:
    """The p of a row as tables show it."""
    return "-" if math.isnan(p) else f"{p:.2g}"


_LEAST_REST = 0.15
"""Share of a row's squares that its causes leave, or explain too much, from which it is given: noise and what is tolerated together."""


def describe_row(row: Component) -> str:
    """The causes behind one row of the table of discrepancies, or that there are none; empty for a row that is noise."""
    if row.status == "noise":
        return ""
    mixed = any(a.is_named for a in row.attributions)
    by = ", ".join(f"{a.cause} {100 * a.share:.0f} %{' (tolerated)' * (mixed and not a.is_named)}" for a in row.attributions)
    if row.trend:
        return f"unexplained: follows {row.trend}" + (f" beside {by}" if by else "")
    if row.status == "unexplained" and row.noise_over_reference > MAX_NOISE_OVER_REFERENCE:
        return f"unexplained: the noise is {row.noise_over_reference:.1f} times the reference's own"
    if row.status == "unexplained":
        return f"unexplained ({by} and no more)" if by else "unexplained"
    if not by:
        return "several causes together, none of them significant by itself (within tolerance)"
    rest = 1.0 - sum(a.share for a in row.attributions)
    by += f", the rest {100 * rest:.0f} %" if abs(rest) >= _LEAST_REST else ""
    return f"{by} (within tolerance)" if row.status == "within tolerance" else by


def describe_outliers(d: Diagnosis) -> list[Message]:
    """Windows that were left out of the table, in one sentence; empty without any."""
    if not d.outliers_s:
        return []
    times = ", ".join(f"{t:.0f}" for t in d.outliers_s[:5]) + (", ..." if len(d.outliers_s) > 5 else "")
    return [message("measured_motion.outliers", count=len(d.outliers_s), windows=d.windows, times=times)]


def unit_of(name: str) -> str:
    """The unit of a cause's size after a space; empty for ratios."""
    cause = CAUSES.get(name)
    return "" if cause is None or cause.unit == "1" else f" {cause.unit}"


_RANGES = (RANGE_SCALE.id, RANGE_BIAS.id)
"""A Hokuyo UTM-30LX measures 10 m to 30 mm by its data sheet, tyres differ by 2 %; and all that scans measure is as wrong as a file's scale
of the ranges. On ACES, where the wheels' radius explained a drive as well as ranges 0.8 % short, the filter's error was 0.069 m with that
scale and 0.062 m without."""


def not_written(d: Diagnosis) -> list[tuple[Finding, str]]:
    """Findings that a robot file is not written with, each with the reason as a clause."""
    written = confirmed_findings(d)
    return [(f, _why_not(d, f)) for f in d.findings if not f.is_counted and f not in written]


def _why_not(d: Diagnosis, f: Finding) -> str:
    """Why a robot file is not written with ``f``."""
    if why := _objection(d, f):
        return why
    if (contested := [other.cause for other in d.findings if _objection(d, other)]) and not f.is_independent_of(contested):
        return f"its size depends on {' and '.join(dict.fromkeys(contested))}"
    if d.handover is not None:
        return d.handover.refused.get(f.definition.key, "") or d.handover.refusal or "a part of the drive stays unexplained"
    return "nothing shows that it improves windows to which it was not fitted"


def _objection(d: Diagnosis, f: Finding) -> str:
    """What speaks against ``f`` by itself, before its file is tried; empty where nothing does.

    Where a part stays unexplained, a finding has to improve by itself windows that it was not fitted to, and may not change within the
    drive: it may be a step in the place of an unknown change. Ranges are not corrected where the wheels explain the drive as well.
    """
    if f.is_counted:
        return ""
    if not f.is_plausible:
        return "no robot has as much"
    if not f.is_usual:
        return "it is more than three sigma of what robots have"
    better = next((t for t in d.trends if f.cause in t.instead_of.split(_AND)), None) if d.trends else None
    if better is not None:
        return f"{better.component} follows {better.along} instead"
    if f.cause in _RANGES and f.aliases:
        return "other sensors explain it as well"
    if d.verdict == "unexplained" and f.gain.low <= 0.0:
        return "it does not improve windows to which it was not fitted beyond their scatter"
    if d.verdict == "unexplained" and f.definition.changes_on_the_way:
        return "it holds in a part of the drive, of which another part is unexplained"
    return ""


def correctable_findings(d: Diagnosis) -> list[Finding]:
    """Findings that a robot may be corrected by, strongest first: nothing speaks against them, and their sizes do not depend on one against
    which something does."""
    estimated = [f for f in d.findings if not f.is_counted]
    contested = {f.cause for f in estimated if _objection(d, f)}
    return [f for f in estimated if f.cause not in contested and f.is_independent_of(contested)]


def confirmed_findings(d: Diagnosis) -> list[Finding]:
    """Findings that the sentence orders to correct, and that a robot file is written with: they improve what they were not fitted to."""
    if not d.is_confirmed:
        return []
    held = None if d.handover is None else d.handover.corrected
    return [f for f in correctable_findings(d) if held is None or f.definition.key in held]


def sentence(d: Diagnosis) -> str:
    """What to do: the set-up, corrections, terms and effects, what is not written and why, and what is left without a name."""
    return " ".join((*d.set_up, _of_motion(d)))


def _of_motion(d: Diagnosis) -> str:
    """The sentence without the set-up."""
    contradiction = f" {d.contradictions[0][0].upper()}{d.contradictions[0][1:]}" if d.contradictions else ""
    missing = [f"{f.description} ({f.evidence})" for f in d.findings if f.is_counted]
    if d.verdict == "undecidable":
        cannot = f"{d.model} cannot be diagnosed on this drive: {d.too_little}" if d.too_little else _NOT_SHOWN.format(d.model)
        found = "".join(f" {text[0].upper()}{text[1:]}." for text in missing)
        return f"{cannot}{found}{contradiction} {d.next_drive}"
    added = [] if d.extension is None else [text for text in (d.extension.describe(), d.extension.describe_refused()) if text]
    if d.verdict == "consistent" or (d.verdict == "explained" and d.set_up and not (d.findings or added)):
        begin = "With that corrected, " if d.set_up else ""
        text = f"{begin}{d.model} fits this drive: {d.windows} windows show no error beyond its tolerance"
        if d.joint_p < _JOINT_LEVEL:
            text = f"Each cause by itself is within its tolerance, and {_joint(d)}"
        tolerated = describe_tolerated(d)
        text += f"; within tolerance: {', '.join(tolerated)}." if tolerated else "."
        text = text if d.suspected is None else f"{text} {_suspicion(d.suspected)}"
        return " ".join((text, *(f"{a.removesuffix('.')}." for a in added)))
    confirmed = confirmed_findings(d)
    orders = [*([_correction(d, confirmed)] if confirmed else []), *added]
    refused = not_written(d)
    if refused:
        orders.append(f"Not written: {'; '.join(f'{_further(f)}, as {why}' for f, why in refused)}")
    if d.joint_p < _JOINT_LEVEL and d.verdict == "explained":
        missing.append(f"of what is within tolerance, {_joint(d)}")
    parts = [f"{part[0].upper()}{part[1:]}".removesuffix(".") for part in orders + missing]
    left = _left(d) if d.verdict == "unexplained" else ""
    if left:
        unnamed = "Something without a name is left" if parts else f"{d.model} is wrong here, but not in a way that has a name"
        parts.append(f"{unnamed}: {left}")
    return (". ".join(parts) + "." * bool(parts) + contradiction).strip()


def _joint(d: Diagnosis) -> str:
    """That sizes within tolerance are too many to be a healthy robot's, as a clause."""
    robots = f"{1.0 / _JOINT_LEVEL:,.0f}"
    return (
        f"all together are more than one healthy robot in {robots} has (p = {d.joint_p:.1g}): a small law may be spread over them. Record a"
        " drive of the robot while it is right, and diagnose with --healthy"
    )


def _correction(d: Diagnosis, findings: Sequence[Finding]) -> str:
    """What to correct, strongest finding first, and what that gains on windows that did not correct it."""
    first = findings[0]
    text = f"Correct {first.definition.label} by {first.size:+.3g}{unit_of(first.cause)} (+- {first.sigma:.1g}): {first.description}"
    gain, what = (d.gain or first.gain).relative, "held-out discrepancies"
    if d.handover is not None:
        gain, what = d.handover.gain.value, "the held-out errors that it changes"
    if d.handover is not None and any(each.after_m < each.before_m for each in d.handover.replays.values()):
        text += f"; {d.handover.describe_replays()}"
    elif gain >= _SHOWN_GAIN:
        text += f"; {what} fall by {100 * gain:.0f} %"
    if first.aliases:
        text += f". This drive cannot separate it from {describe_sizes(first.aliases)}"
    if len(findings) > 1:
        text += f". Then {', '.join(_further(f) for f in findings[1:])}"
    return text


def _further(f: Finding) -> str:
    aliases = f", or {describe_sizes(f.aliases)}" if f.aliases else ""
    return f"{f.definition.label} by {f.size:+.3g}{unit_of(f.cause)} ({f.description}{aliases})"


def describe_sizes(aliases: Sequence[tuple[str, float]]) -> str:
    """Causes with their sizes, in one line."""
    return ", ".join(f"{name} {size:+.3g}{unit_of(name)}" for name, size in aliases)


def _suspicion(f: Finding) -> str:
    """What shows, but may be noise."""
    aliases = "".join(f" or {name} {size:+.3g}{unit_of(name)}" for name, size in f.aliases[:_MAX_SUSPECTED_ALIASES])
    size = f"{f.size:+.3g}{unit_of(f.cause)} (+- {f.sigma:.1g}, tolerated {f.definition.negligible:.2g})"
    share = f"up to {100 * f.p_value:.0f} %" if f.p_value >= 0.005 else "less than 1 %"
    return f"Too weak to be named is {f.cause} {size}{aliases}: {share} of healthy drives show as much."


def is_contesting(d: Diagnosis, trend: Trend) -> bool:
    """Whether ``trend`` makes a row of the table unexplained; others are less than the noise."""
    row = d.discrepancy.get(trend.component)
    return bool(trend.instead_of) or (row is not None and bool(row.trend))


def _left(d: Diagnosis) -> str:
    """What no cause accounts for: trends, else rows of the table."""
    contesting = [trend for trend in d.trends if is_contesting(d, trend)]
    if contesting:
        return contesting[0].text
    rows = [
        f"{name} {row.unattributed_rms:.2g} {row.unit}, noise {row.expected_rms:.2g}, {describe_row(row).removeprefix('unexplained: ')}"
        for name, row in d.discrepancy.items()
        if row.status == "unexplained"
    ]
    return f"more than noise without a trend ({'; '.join(rows)})" if rows else ""
