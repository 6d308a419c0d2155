"""Findings in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from localization.diagnosis.causes import CAUSES, MISSING_MESSAGES, WINDOW_CAUSES, Cause
from localization.diagnosis.drive import MessageLoss, StandstillTurn
from localization.diagnosis.findings import Component, Diagnosis, Finding
from localization.diagnosis.linearization import Noise
from localization.diagnosis.prediction import CHANNELS
from localization.diagnosis.verdict import MAX_NOISE_OVER_REFERENCE
from motion_models.se2 import FloatArray

_CHANNEL_WORDS = {
    "x": "along the drive",
    "y": "sideways",
    "yaw": "in heading",
    "gyro": "between gyro and LiDAR",
    "force_x": "in the accelerometers",
    "force_y": "in the accelerometers",
}


def evidence(cause: Cause, part: FloatArray, noise: Noise, twice_likelihood: float) -> str:
    """Where the cause shows: ``part`` (M, 6) is what it adds to the discrepancy."""
    strength = np.sum(noise.whiten(np.nan_to_num(part)) ** 2, axis=0)
    whole = max(float(strength.sum()), 1e-12)
    order = np.argsort(-strength)
    places = [f"{_CHANNEL_WORDS[CHANNELS[c]]} ({100.0 * strength[c] / whole:.0f} %)" for c in order if strength[c] > 0.15 * whole]
    text = f"shows {', '.join(dict.fromkeys(places))}; log-likelihood +{twice_likelihood / 2.0:.0f}"
    if cause.id == "friction_change" and cause.at_s is not None:
        text += f"; from {cause.at_s:.0f} s on"
    return text


def describe_loss(loss: MessageLoss) -> str:
    """Where the share of missing messages comes from."""
    return f"{loss.gaps} gaps of up to {loss.longest_s:.2g} s between messages that come every {1e3 * loss.period_s:.3g} ms"


def describe_standstill_turn(turn: StandstillTurn) -> str:
    """A gyro that turns while the wheels stand, and what to check."""
    return (
        f"in {turn.seconds:.0f} s of standing by the wheels, first at {turn.first_s:.0f} s, the gyro turned "
        f"{math.degrees(turn.angle_rad):.0f} deg: "
        "the wheels' messages are wrong or belong to another time, or the robot was carried; check the joint states' topic and names."
    )


def describe_tolerated(d: Diagnosis) -> list[str]:
    """One line for each cause that is significant but within its tolerance."""
    found = []
    for name, (size, sigma) in d.within.items():
        unit = _unit_of(name)
        found.append(f"{name} {size:+.2g} +- {sigma:.1g}{unit} (tolerated {d.tolerances.get(name, math.nan):.2g}{unit})")
    return found


def describe_row(row: Component) -> str:
    """The causes behind one row of the table of discrepancies, or that there are none."""
    by = ", ".join(f"{a.cause} {100 * a.share:.0f} %" for a in row.attributions)
    if row.status == "unexplained" and row.noise_over_reference > MAX_NOISE_OVER_REFERENCE:
        return f"unexplained: the noise is {row.noise_over_reference:.1f} times the reference's own"
    if row.trend:
        return f"unexplained: follows {row.trend}" + (f" beside {by}" if by else "")
    if row.status == "unexplained":
        return f"unexplained ({by} and no more)" if by else "unexplained"
    return f"{by} (within tolerance)" if row.status == "within tolerance" else by


def describe_outliers(d: Diagnosis) -> list[str]:
    """Windows that were left out of the table, in one sentence; empty without any."""
    if not d.outliers_s:
        return []
    times = ", ".join(f"{t:.0f}" for t in d.outliers_s[:5]) + (", ..." if len(d.outliers_s) > 5 else "")
    return [
        f"{len(d.outliers_s)} of {d.windows} windows are outliers of eight sigma that no cause explains (at {times} s) and are not in the "
        "table: the reference jumps or turns there, or the robot hit something; check the reference at these times."
    ]


def _unit_of(name: str) -> str:
    cause = CAUSES.get(name) or WINDOW_CAUSES.get(name)
    return "" if cause is None or cause.unit == "1" else f" {cause.unit}"


def sentence(d: Diagnosis) -> str:
    """What to do, in one or two sentences: nothing is corrected beside sizes that no robot has, or that a trend contests."""
    contradiction = f" {d.contradictions[0][0].upper()}{d.contradictions[0][1:]}" if d.contradictions else ""
    if d.verdict == "undecidable":
        return f"This drive cannot show what is wrong with {d.model}. {d.next_drive}{contradiction}"
    if d.verdict == "consistent":
        text = f"Nothing beyond tolerances is wrong with {d.model} on this drive that {d.windows} windows could show"
        tolerated = describe_tolerated(d)
        return text + (f"; within tolerance: {', '.join(tolerated)}." if tolerated else ".")
    estimated = [f for f in d.findings if f.cause != MISSING_MESSAGES.id]
    if any(t.instead_of for t in d.trends) or not all(f.is_plausible for f in estimated):
        estimated = []
    missing = [f"{f.description} ({f.evidence})" for f in d.findings if f.cause == MISSING_MESSAGES.id]
    parts = [f"{part[0].upper()}{part[1:]}" for part in ([_correction(d, estimated)] if estimated else []) + missing]
    left = _left(d) if d.verdict == "unexplained" else ""
    if left:
        unnamed = "Something without a name is left" if parts else f"{d.model} is wrong here, but not in a way that has a name"
        parts.append(f"{unnamed}: {left}")
    return (". ".join(parts) + "." * bool(parts) + contradiction).strip()


def _correction(d: Diagnosis, findings: Sequence[Finding]) -> str:
    """What to correct, strongest finding first."""
    first = findings[0]
    text = f"Correct {first.cause} by {first.size:+.3g}{_unit_of(first.cause)} (+- {first.sigma:.1g}): {first.description}"
    whole = d.gain or first.gain
    text += f"; held-out discrepancies fall by {100 * whole.relative:.0f} %"
    if first.aliases:
        text += f". This drive cannot separate it from {', '.join(f'{name} {size:+.3g}' for name, size in first.aliases)}"
    if len(findings) > 1:
        text += f". Then {', '.join(f'{f.cause} by {f.size:+.3g} ({f.description})' for f in findings[1:])}"
    return text


def _left(d: Diagnosis) -> str:
    """What no cause accounts for: trends, else rows of the table."""
    if d.trends:
        return d.trends[0].text
    implausible = [f"{f.cause} {f.size:+.2g}" for f in d.findings if not f.is_plausible]
    if implausible:
        return f"{' and '.join(implausible)} would fit, but are more than robots have"
    rows = [
        f"{name} {row.unattributed_rms:.2g} {row.unit}, noise {row.expected_rms:.2g}, {describe_row(row).removeprefix('unexplained: ')}"
        for name, row in d.discrepancy.items()
        if row.status == "unexplained"
    ]
    return f"more than noise without a trend ({'; '.join(rows)})" if rows else ""
