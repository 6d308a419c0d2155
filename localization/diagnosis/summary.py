"""Findings in sentences."""

from __future__ import annotations

import numpy as np

from localization.diagnosis.causes import Cause
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.noise import Noise
from localization.diagnosis.prediction import CHANNELS
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


def sentence(d: Diagnosis) -> str:
    """One sentence to act on."""
    if d.verdict == "undecidable":
        return f"This drive cannot show what is wrong with {d.model}. {d.next_drive}"
    if d.verdict == "consistent":
        return f"Nothing is wrong with {d.model} on this drive that {d.windows} windows could show."
    if not d.findings:
        return f"{d.model} is wrong here, but not in a way that has a name: {d.trends[0].text}."
    first = d.findings[0]
    text = (
        f"Correct {first.cause} by {first.size:+.3g} {first.definition.unit if first.definition.unit != '1' else ''}".rstrip()
        + f" (+- {first.sigma:.1g})"
    )
    whole = d.gain or first.gain
    text += f": {first.definition.meaning}; held-out discrepancies fall by {100 * whole.relative:.0f} %"
    if first.aliases:
        text += f". This drive cannot tell it from {', '.join(name for name, _ in first.aliases)}"
    if len(d.findings) > 1:
        text += f". Then {', '.join(f'{f.cause} by {f.size:+.3g}' for f in d.findings[1:])}"
    if d.verdict == "unexplained" and d.trends:
        text += f". Something without a name is left: {d.trends[0].text}"
    return text + "."
