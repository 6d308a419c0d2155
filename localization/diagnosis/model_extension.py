"""What a motion model lacks on a drive: terms, which a robot file holds, and effects that are bound to this drive; and their words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from localization.diagnosis.bound_effects import BoundShape
from localization.diagnosis.gate import HandoverCheck
from localization.diagnosis.parameter_laws import Law
from localization.diagnosis.term_words import describe_memory
from motion_models.terms import Term

_TWO_SIDED_95 = 1.96
_NOT_WRITTEN = {
    "time": "another drive begins after another way",
    "place": "a robot file has no map",
    "wheel angle": "the angle at the start differs from drive to drive",
    "tilt": "models have no tilt as an input",
    "torque": "models have no torque as an input",
    "temperature": "models have no temperature as an input",
    "sensor": "it does not move the robot",
}
"""Why a robot file does not hold an effect, by what it is bound to."""


class FoundEffect(NamedTuple):
    """An effect bound to a time, a place, a wheel's angle, a tilt or a sensor, which no robot file holds."""

    shape: BoundShape
    value: float
    sigma: float
    stability: float
    gain: float
    """Twice the log-likelihood that it gains beside the others."""


@dataclass(frozen=True)
class FoundTerm:
    """A law of the drive, with what supports it."""

    law: Law
    stability: float
    """Share of random halves of the drive in which it, or one that this drive does not separate from it, is among the best."""
    gain: float
    """Twice the log-likelihood that it gains beside the others."""
    alike: tuple[str, ...] = ()
    """Candidates that the drive hardly separates from it, best first."""

    @property
    def term(self) -> Term:
        """The first of its terms, which has the law's coefficient."""
        return self.law.term


@dataclass(frozen=True)
class Extension:
    """Terms missing in a model on a drive, and what a robot file with them gains."""

    model: str
    terms: tuple[FoundTerm, ...]
    replaced: tuple[str, ...]
    """Findings of the plain model in whose place the terms explain the drive better."""
    check: HandoverCheck | None
    """Check of its file on the half of the drive that it was not fitted to; None without terms, and where nothing was measured there."""
    effects: tuple[FoundEffect, ...] = ()
    """Effects bound to time, place or sensors, which are not written."""
    refusal: str = ""
    """Why the terms are not written, whatever the half held out shows; empty without a reason."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Terms and effects by name that the search had found, and why they are none."""

    @property
    def is_better(self) -> bool:
        """Whether nothing refuses the terms, and their file is better on the half held out, beyond its scatter."""
        return not self.refusal and self.check is not None and self.check.is_better

    def describe_effects(self) -> str:
        """The bound effects as sentences; empty without any."""
        return " ".join(f"{describe_effect(e)[0].upper()}{describe_effect(e)[1:]}." for e in self.effects)

    def describe(self) -> str:
        """The terms and their gain, then the bound effects, in sentences."""
        return " ".join(text for text in (f"{self.describe_terms()}." if self.terms else "", self.describe_effects()) if text)

    def describe_terms(self) -> str:
        """The terms and their gain, as a sentence without a stop."""
        parts = [describe_law(t.law) for t in self.terms]
        known = [] if all(t.law.words for t in self.terms) else ["no physical cause known"]
        if self.replaced:
            known.append(f"it explains the drive better than {' and '.join(self.replaced)}")
        if any("t" in t.term.expression.variables for t in self.terms):
            known.append("t counts from the start of each drive, so that it holds for drives that start as this one did")
        beside = f" ({'; '.join(known)})" if known else ""
        text = f"{', and '.join(parts)} beyond {self.model}{beside}; "
        if self.refusal:
            return f"{text}{self.refusal}, so that it is not written"
        if self.check is None:
            return f"{text}nothing was measured on the other half of the drive, so that it is not written"
        if self.check.refusal:
            return f"{text}not written: {self.check.refusal}"
        fallen = [
            f"{name} falls from {r.before_m:.3g} to {r.after_m:.3g} m" for name, r in self.check.replays.items() if r.after_m < r.before_m
        ]
        if not fallen:
            return f"{text}with it in robot.toml, {self.check.describe()}"
        return f"{text}with it in robot.toml {' and '.join(fallen)} a window on the other half"

    def describe_refused(self) -> str:
        """What the search had found and the drive does not confirm, as sentences; empty without any."""
        return " ".join(f"Not confirmed: {name}, as {why}." for name, why in self.refused.items())

    def table(self) -> list[tuple[str, ...]]:
        """Component, term or effect, value, 95 % interval, unit, stability and log-likelihood of each, as text."""
        content = self.to_dict()
        return [
            (
                row["component"],
                row.get("expression", row.get("along", "")),
                *_rounded((row["value"],), row["sigma"]),
                " to ".join(_rounded(row["interval"], row["sigma"])),
                row["unit"],
                f"{100 * row['stability']:.0f} %",
                f"{row['log_likelihood']:+.0f}",
            )
            for row in (*content["terms"], *content["effects"])
        ]

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`: sizes in SI units with their 95 % intervals."""
        terms = [
            {
                "component": term.component,
                "expression": str(term.expression),
                "value": term.value,
                "sigma": term.sigma,
                "interval": [term.value - _TWO_SIDED_95 * term.sigma, term.value + _TWO_SIDED_95 * term.sigma],
                "unit": term.unit,
                "parameter": t.law.parameter,
                "stability": t.stability,
                "log_likelihood": 0.5 * t.gain,
                "alike": list(t.alike),
            }
            for t in self.terms
            for term in t.law.terms
        ]
        effects = [
            {
                "component": e.shape.component,
                "along": e.shape.along,
                "bound_to": e.shape.kind,
                "value": e.value,
                "sigma": e.sigma,
                "interval": [e.value - _TWO_SIDED_95 * e.sigma, e.value + _TWO_SIDED_95 * e.sigma],
                "unit": e.shape.unit,
                "stability": e.stability,
                "log_likelihood": 0.5 * e.gain,
            }
            for e in self.effects
        ]
        heldout = None if self.check is None else self.check.to_dict()
        return {
            "model": self.model,
            "terms": terms,
            "effects": effects,
            "replaced": list(self.replaced),
            "heldout": heldout,
            "refusal": self.refusal,
            "refused": dict(self.refused),
        }


EXTENSION_HEADS = ("component", "term", "value", "95 %", "unit", "stability", "log-likelihood")
"""Heads of `Extension.table`."""


def _rounded(values: Sequence[float], sigma: float) -> list[str]:
    """``values`` with two digits of their ``sigma``."""
    decimals = max(0, 1 - math.floor(math.log10(max(sigma, 1e-9))))
    return [f"{value:+.{decimals}f}" for value in values]


def describe_law(law: Law) -> str:
    """A law as an addition to its component, as ``vy is -0.12 (+- 0.01) m s x wz*abs(wz)``, with what it is in words."""
    unit = "" if law.term.unit == "1" else f" {law.term.unit}"
    words = law.words or describe_memory(law.expression.factors)
    more = "".join(f", {t.component} by {t.value:+.2g}{'' if t.unit == '1' else f' {t.unit}'} x {t.expression}" for t in law.terms[1:])
    text = f"{law.component} is {law.value:+.3g} (+- {law.sigma:.1g}){unit} x {law.expression}{f', with it{more[1:]}' if more else ''}"
    return f"{text}{f' ({words})' if words else ''}"


def describe_effect(effect: FoundEffect) -> str:
    """A bound effect with its size, unit and what it follows, as a part of a sentence."""
    unit = "" if effect.shape.unit == "1" else f" {effect.shape.unit}"
    size = f"{effect.value:+.3g} (+- {effect.sigma:.1g}){unit}"
    why = f"bound to a {effect.shape.kind} and not written: {_NOT_WRITTEN[effect.shape.kind]}"
    return f"{effect.shape.moves or effect.shape.component} is {size} x {effect.shape.along} off, {why}"
