"""What a diagnosis returns, and its JSON form."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

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

    @property
    def is_plausible(self) -> bool:
        """Whether robots have the cause at such a size."""
        return abs(self.size) <= self.definition.largest_plausible

    @property
    def description(self) -> str:
        """What it does, with its direction and size in words."""
        return self.definition.describe(self.size)

    def to_dict(self) -> dict[str, Any]:
        return {
            "cause": self.cause,
            "meaning": self.definition.meaning,
            "description": self.description,
            "is_plausible": self.is_plausible,
            "size": self.size,
            "sigma": self.sigma,
            "unit": self.definition.unit,
            "p_value": self.p_value,
            "aliases": [name for name, _ in self.aliases],
            "alias_sizes": dict(self.aliases),
            "evidence": self.evidence,
            "gain": self.gain.to_dict(),
        }


RowStatus = Literal["noise", "attributed", "within tolerance", "unexplained"]


class Attribution(NamedTuple):
    """A cause that accounts for a part of one row of discrepancies."""

    cause: str
    size: float
    share: float
    """Of the row's whitened squares."""
    is_named: bool
    """Whether it is a finding; otherwise it is within its tolerance."""


@dataclass(frozen=True)
class Component:
    """One component of the discrepancy over the whole drive, without outlier windows."""

    unit: str
    rms: float
    expected_rms: float
    """What noise alone makes of it, as estimated from this drive."""
    p_value: float
    left_rms: float
    """Once everything named is corrected."""
    unattributed_rms: float
    """Once what is within tolerance is taken off as well."""
    noise_over_reference: float = 1.0
    """Noise of the drive over that of the motion reference by its own covariance."""
    status: RowStatus = "noise"
    attributions: tuple[Attribution, ...] = ()
    trend: str = ""
    """Along what a part follows that no cause has, where that makes the row unexplained."""

    def with_status(self, status: RowStatus, attributions: tuple[Attribution, ...]) -> Component:
        return dataclasses.replace(self, status=status, attributions=attributions)

    def to_dict(self) -> dict[str, Any]:
        return {
            "unit": self.unit,
            "rms": self.rms,
            "expected_rms": self.expected_rms,
            "p_value": self.p_value,
            "rms_explained": self.left_rms,
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
    over_noise: float
    """Its root mean square over the noise of the component."""
    instead_of: str = ""
    """The finding that it explains the drive better than; empty for a trend beside the findings."""

    @property
    def text(self) -> str:
        if self.instead_of:
            return f"{self.component} follows {self.along} better than {self.instead_of} (t = {self.t:+.1f}, p = {self.p_value:.2g})"
        size = f"{self.over_noise:.2g} times its noise"
        return f"the {self.component} left over follows {self.along} (t = {self.t:+.1f}, p = {self.p_value:.2g}, {size})"


@dataclass(frozen=True)
class HandoverCheck:
    """Discrepancies of the second half of a drive by the old robot, and by one that was corrected by the first half alone."""

    before: dict[str, float]
    """Root mean square by component, as `prediction.CHANNELS`."""
    after: dict[str, float]
    windows: int

    @property
    def is_better(self) -> bool:
        """Whether the product of all components' errors falls."""
        return math.prod(self.after[c] / max(self.before[c], 1e-12) for c in self.before) < 1.0

    def describe(self) -> str:
        rows = ", ".join(f"{c} {self.before[c]:.3g} -> {self.after[c]:.3g} {'rad' if c == 'yaw' else 'm'}" for c in self.before)
        return f"second half of the drive ({self.windows} windows), corrected by the first half alone: {rows} (root mean square)"

    def to_dict(self) -> dict[str, Any]:
        return {"windows": self.windows, "rms_before": self.before, "rms_after": self.after, "is_better": self.is_better}


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
    """Causes that are significant but smaller than their tolerance: size and sigma."""
    tolerances: Mapping[str, float] = field(default_factory=dict)
    """Tolerated size of each of them."""
    detectable_sizes: Mapping[str, float] = field(default_factory=dict)
    """Smallest size of each cause that this drive would show (three sigma, alone)."""
    gain: Gain | None = None
    """By all findings together."""
    contradictions: tuple[str, ...] = ()
    """Measurements that exclude each other, in sentences."""
    outliers_s: tuple[float, ...] = ()
    """When windows began that no cause explains to eight sigma: jumps of the reference, or events on the floor."""
    windows: int = 0
    warnings: tuple[str, ...] = ()
    hypothesis: Hypothesis = field(default_factory=Hypothesis)
    handover: HandoverCheck | None = None
    """What the corrected robot gains on the second half of the drive."""

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
            "tolerances": dict(self.tolerances),
            "handover": None if self.handover is None else self.handover.to_dict(),
            "contradictions": list(self.contradictions),
            "outlier_windows_s": list(self.outliers_s),
            "witness": self.motion_reference,
            "windows": self.windows,
            "within_tolerance": {name: list(value) for name, value in self.within.items()},
            "smallest_visible": dict(self.detectable_sizes),
            "notes": list(self.warnings),
        }
