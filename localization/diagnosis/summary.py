"""Findings in sentences."""

from __future__ import annotations

import numpy as np

from localization.diagnosis.causes import Effect
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.noise import Noise
from localization.diagnosis.prediction import CHANNELS
from motion_models.se2 import FloatArray

_SEEN_IN = {
    "x": "along the drive",
    "y": "sideways",
    "yaw": "in heading",
    "gyro": "between gyro and LiDAR",
    "force_x": "in the accelerometers",
    "force_y": "in the accelerometers",
}


def evidence(effect: Effect, part: FloatArray, noise: Noise, twice_likelihood: float) -> str:
    """Where the cause shows: ``part`` (M, 6) is what it adds to the discrepancy."""
    strength = np.sum(noise.whiten(np.nan_to_num(part)) ** 2, axis=0)
    whole = max(float(strength.sum()), 1e-12)
    order = np.argsort(-strength)
    places = [f"{_SEEN_IN[CHANNELS[c]]} ({100.0 * strength[c] / whole:.0f} %)" for c in order if strength[c] > 0.15 * whole]
    said = f"shows {', '.join(dict.fromkeys(places))}; log-likelihood +{twice_likelihood / 2.0:.0f}"
    if effect.id == "friction_change" and effect.at_s is not None:
        said += f"; from {effect.at_s:.0f} s on"
    return said


def sentence(d: Diagnosis) -> str:
    """One sentence to act on."""
    if d.verdict == "undecidable":
        return f"This drive cannot show what is wrong with {d.model}. {d.next_drive}"
    if d.verdict == "consistent":
        return f"Nothing is wrong with {d.model} on this drive that {d.windows} windows could show."
    if not d.findings:
        return f"{d.model} is wrong here, but not in a way that has a name: {d.shapes[0].text}."
    first = d.findings[0]
    said = (
        f"Correct {first.cause} by {first.size:+.3g} {first.effect.unit if first.effect.unit != '1' else ''}".rstrip()
        + f" (+- {first.sigma:.1g})"
    )
    whole = d.gain or first.gain
    said += f": {first.effect.meaning}; held-out discrepancies fall by {100 * whole.relative:.0f} %"
    if first.aliases:
        said += f". This drive cannot tell it from {', '.join(name for name, _ in first.aliases)}"
    if len(d.findings) > 1:
        said += f". Then {', '.join(f'{f.cause} by {f.size:+.3g}' for f in d.findings[1:])}"
    if d.verdict == "unexplained" and d.shapes:
        said += f". Something without a name is left: {d.shapes[0].text}"
    return said + "."
