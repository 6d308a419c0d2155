"""What a diagnosis returns, and its JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from localization.diagnosis.causes import Cause, Hypothesis

Verdict = Literal["consistent", "explained", "ambiguous", "unexplained", "undecidable"]


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

    @property
    def cause(self) -> str:
        return self.definition.id

    def to_dict(self) -> dict[str, Any]:
        return {
            "cause": self.cause,
            "meaning": self.definition.meaning,
            "size": self.size,
            "sigma": self.sigma,
            "unit": self.definition.unit,
            "p_value": self.p_value,
            "aliases": [name for name, _ in self.aliases],
            "alias_sizes": dict(self.aliases),
            "evidence": self.evidence,
            "gain": self.gain.to_dict(),
        }


@dataclass(frozen=True)
class Component:
    """One component of the discrepancy over the whole drive."""

    unit: str
    rms: float
    expected_rms: float
    """What noise alone makes of it, as estimated from this drive."""
    p_value: float
    left_rms: float
    """Once everything named is corrected."""

    def to_dict(self) -> dict[str, Any]:
        return {
            "unit": self.unit,
            "rms": self.rms,
            "expected_rms": self.expected_rms,
            "p_value": self.p_value,
            "rms_explained": self.left_rms,
        }


@dataclass(frozen=True)
class Trend:
    """A trend in what is left that no cause has."""

    component: str
    along: str
    t: float
    p_value: float

    @property
    def text(self) -> str:
        return f"the {self.component} left over follows {self.along} (t = {self.t:+.1f}, p = {self.p_value:.2g})"


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
    """How much of what can be predicted of the discrepancy follows such trends, 0 to 1."""
    next_drive: str
    sentence: str
    within: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Causes that show, but are smaller than anyone would correct: size and sigma."""
    detectable_sizes: Mapping[str, float] = field(default_factory=dict)
    """Smallest size of each cause that this drive would show (three sigma, alone)."""
    gain: Gain | None = None
    """By all findings together."""
    windows: int = 0
    warnings: tuple[str, ...] = ()
    hypothesis: Hypothesis = field(default_factory=Hypothesis)

    def to_dict(self) -> dict[str, Any]:
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
            "next_drive": self.next_drive,
            "sentence": self.sentence,
            "witness": self.motion_reference,
            "windows": self.windows,
            "within_tolerance": {name: list(value) for name, value in self.within.items()},
            "smallest_visible": dict(self.detectable_sizes),
            "notes": list(self.warnings),
        }
