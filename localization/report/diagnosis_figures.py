"""Pictures of a diagnosis: discrepancies over time and turning, before and after correction, and the gain of each finding."""

from __future__ import annotations

import numpy as np

from localization.diagnosis.diagnose import DiagnosisResult
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.prediction import CHANNEL_UNITS, CHANNELS
from localization.report.figures import Axes, Figure, svg
from localization.report.page import COLOURS, WIDTH_IN
from motion_models.se2 import FloatArray

_NAMES = {"x": "along", "y": "sideways", "yaw": "heading", "gyro": "gyro - LiDAR"}
_SHOWN = 4


def discrepancy_svg(found: DiagnosisResult) -> str:
    """Each component window by window: as found, once corrected, and the band of noise."""
    assert found.predictor is not None
    assert found.residuals is not None
    r = found.residuals
    owner = found.predictor.batch.owner
    seconds = found.predictor.drive.starts_s[owner]
    shown = [c for c in range(_SHOWN) if np.isfinite(r.rows[:, c]).any()]

    def draw(figure: Figure) -> None:
        panels = np.atleast_1d(figure.subplots(len(shown), 1, sharex=True))
        for axes, c in zip(panels, shown, strict=True):
            _band(axes, seconds, 2.0 * r.sigmas[:, c])
            axes.plot(seconds, r.rows[:, c], ".", color=COLOURS["red"], markersize=4.0)
            axes.plot(seconds, r.left[:, c], ".", color=COLOURS["blue"], markersize=3.0)
            axes.set_ylabel(f"{_NAMES[CHANNELS[c]]} [{CHANNEL_UNITS[c]}]")
        panels[-1].set_xlabel("time since the first window [s]" if found.diagnosis.windows and seconds.any() else "maneuver")

    return svg("discrepancy", WIDTH_IN, 1.35 * len(shown) + 0.5, draw)


def dependence_svg(found: DiagnosisResult) -> str:
    """Each component against what the wheels did: distance and turn by their rates, before and after."""
    assert found.predictor is not None
    assert found.residuals is not None
    r = found.residuals
    driven, turned = _motion(found)
    shown = [c for c in range(3) if np.isfinite(r.rows[:, c]).any()]

    def draw(figure: Figure) -> None:
        panels = np.reshape(figure.subplots(len(shown), 2, sharex="col", sharey="row", squeeze=False), (len(shown), 2))
        for row, c in enumerate(shown):
            for axes, along in zip(panels[row], (driven, turned), strict=True):
                axes.plot(along, r.rows[:, c], ".", color=COLOURS["red"], markersize=4.0)
                axes.plot(along, r.left[:, c], ".", color=COLOURS["blue"], markersize=3.0)
            panels[row][0].set_ylabel(f"{_NAMES[CHANNELS[c]]} [{CHANNEL_UNITS[c]}]")
        panels[-1][0].set_xlabel("driven in the window [m]")
        panels[-1][1].set_xlabel("turned in the window [rad]")

    return svg("dependence", WIDTH_IN, 1.6 * len(shown) + 0.5, draw)


def gain_svg(d: Diagnosis) -> str:
    """What each finding takes off the held-out discrepancy, with its interval."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for row, f in enumerate(d.findings):
            gain, low, high = (100.0 * v for v in (f.gain.relative, f.gain.low, f.gain.high))
            axes.barh(row, gain, height=0.5, color=COLOURS["green"])
            axes.plot([low, high], [row, row], color=COLOURS["ink"], linewidth=1.0)
        axes.set(yticks=range(len(d.findings)), yticklabels=[f.cause for f in d.findings], xlabel="held-out discrepancy taken off [%]")
        axes.invert_yaxis()

    return svg("gain", WIDTH_IN, 0.4 * len(d.findings) + 0.7, draw)


def _band(axes: Axes, seconds: FloatArray, width: FloatArray) -> None:
    axes.fill_between(seconds, -width, width, facecolor=COLOURS["band"], edgecolor="none", zorder=0.5)
    axes.axhline(0.0, color=COLOURS["soft"], linewidth=0.6, zorder=0.6)


def _motion(found: DiagnosisResult) -> tuple[FloatArray, FloatArray]:
    assert found.predictor is not None
    batch = found.predictor.batch
    twist = found.predictor.nominal_twist
    parts = []
    for end, owner in zip(batch.ends, batch.owner, strict=True):
        inside = slice(batch.first[owner] + batch.lead[owner], end)
        parts.append(twist[inside].T @ batch.dt[inside])
    moved = np.array(parts)
    return moved[:, 0], moved[:, 2]
