"""Effects that no cause of the diagnosis describes, applied to the wheels or the reference of a recorded drive."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np

from localization.diagnosis.drive import Drive
from motion_models.calibration.maneuvers import Maneuver
from motion_models.se2 import FloatArray

WheelChange = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Changed mean and half difference (n,) of a maneuver's wheel rates, from these and the share of the drive that is over (n,)."""


def _by_wheels(change: WheelChange) -> Callable[[Drive], Drive]:
    def apply(drive: Drive) -> Drive:
        whole = float(drive.starts_s[-1])

        def changed(m: Maneuver, start_s: float) -> Maneuver:
            over = np.full(len(m.dt), start_s / whole)
            mean, half = change(m.wheels.mean(axis=1), 0.5 * (m.wheels[:, 1] - m.wheels[:, 0]), over)
            return dataclasses.replace(m, wheels=np.column_stack([mean - half, mean + half]))

        return dataclasses.replace(
            drive, maneuvers=tuple(changed(m, float(s)) for m, s in zip(drive.maneuvers, drive.starts_s, strict=True))
        )

    return apply


def _by_reference(change: Callable[[FloatArray, float, float], FloatArray]) -> Callable[[Drive], Drive]:
    """``change`` takes the (3,) measured motion of a window, the share of the drive that is over, and the heading in its middle."""

    def apply(drive: Drive) -> Drive:
        over = drive.starts_s / drive.starts_s[-1]
        turns = np.array([m.measured[0, 2] for m in drive.maneuvers])
        headings = np.cumsum(turns) - 0.5 * turns
        maneuvers = (
            dataclasses.replace(m, measured=change(m.measured[0], float(share), float(heading))[None])
            for m, share, heading in zip(drive.maneuvers, over, headings, strict=True)
        )
        return dataclasses.replace(drive, maneuvers=tuple(maneuvers))

    return apply


def _puncture(mean: FloatArray, half: FloatArray, over: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The left tyres lose 5 % of their radius in the middle of the drive."""
    more = np.where(over > 0.5, 0.05 * (mean - half), 0.0)
    return mean + 0.5 * more, half - 0.5 * more


def _clip(mean: FloatArray, half: FloatArray, most: float) -> tuple[FloatArray, FloatArray]:
    left, right = np.clip(mean - half, -most, most), np.clip(mean + half, -most, most)
    return 0.5 * (left + right), 0.5 * (right - left)


def _dead_zone(mean: FloatArray, half: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    left, right = (np.where(np.abs(rate) < least, 0.0, rate) for rate in (mean - half, mean + half))
    return 0.5 * (left + right), 0.5 * (right - left)


def _stretched(motion: FloatArray, heading: float) -> FloatArray:
    """``motion`` on a map that is 6 % too long along the first heading."""
    c, s = math.cos(heading), math.sin(heading)
    turn = np.array([[c, s], [-s, c]])
    return np.r_[turn @ np.diag([1.06, 1.0]) @ turn.T @ motion[:2], motion[2]]


def _backlash(half: FloatArray) -> FloatArray:
    """Half differences (n,) without the first 15 intervals after each change of their sign."""
    sign = np.sign(np.where(np.abs(half) > 0.1, half, 0.0))
    changes = np.flatnonzero(np.diff(sign) != 0) + 1
    is_lost = np.zeros(len(half), dtype=bool)
    for i in changes:
        is_lost[i : i + 15] = True
    return np.where(is_lost, 0.0, half)


UNKNOWN: Mapping[str, Callable[[Drive], Drive]] = {
    "puncture of the left tyres": _by_wheels(_puncture),
    "slip in left turns only": _by_wheels(lambda m, h, t: (m, np.where(h > 0.0, h / 0.85, h))),
    "slip when driving backwards": _by_wheels(lambda m, h, t: (np.where(m < 0.0, m / 0.92, m), h)),
    "slip with the square of speed": _by_wheels(lambda m, h, t: (m * (1.0 + 0.03 * np.abs(m)), h)),
    "rates saturate": _by_wheels(lambda m, h, t: _clip(m, h, 2.6)),
    "slow rates are lost": _by_wheels(lambda m, h, t: _dead_zone(m, h, 1.3)),
    "wet patches of floor": _by_wheels(lambda m, h, t: (m, h * (1.0 + 0.15 * (np.sin(40.0 * t) > 0.3)))),
    "radius varies with time": _by_wheels(lambda m, h, t: (m * (1.0 + 0.06 * np.sin(4.0 * math.pi * t)), h)),
    "reference is longer in one quarter": _by_reference(lambda p, t, h: p * np.array([1.06, 1.06, 1.0]) if 0.25 < t < 0.5 else p),
    "reference turns with its range": _by_reference(lambda p, t, h: p + np.array([0.0, 0.0, 0.05 * abs(p[0])])),
}
"""By what happens."""
VERIFYING: Mapping[str, Callable[[Drive], Drive]] = {
    "slip in braking and accelerating": _by_wheels(lambda m, h, t: (m - 8.0 * np.gradient(m), h)),
    "backlash when the turn reverses": _by_wheels(lambda m, h, t: (m, _backlash(h))),
    "left wheels slip backwards": _by_wheels(lambda m, h, t: (m - 0.03 * np.minimum(m - h, 0.0), h + 0.03 * np.minimum(m - h, 0.0))),
    "sideways drift while it drives": _by_reference(lambda p, t, h: p + np.array([0.0, 0.04, 0.0])),
    "compass of the reference": _by_reference(lambda p, t, h: p + np.array([0.0, 0.0, 0.03 * math.sin(h)])),
    "nap of a carpet": _by_reference(lambda p, t, h: p * np.array([1.0 + 0.05 * math.cos(h), 1.0, 1.0])),
    "stretched map of the reference": _by_reference(lambda p, t, h: _stretched(p, h)),
    "slip with the square of the turning rate": _by_wheels(lambda m, h, t: (m, h * (1.0 + 0.05 * h**2))),
    "turning rate saturates": _by_wheels(lambda m, h, t: (m, np.where(np.abs(h) > 0.8, h + 0.3 * (h - np.clip(h, -0.8, 0.8)), h))),
    "turns slip from time to time": _by_wheels(lambda m, h, t: (m, h * (1.0 + 0.12 * np.sin(6.0 * math.pi * t)))),
}
"""Effects that no threshold of the diagnosis was chosen on."""
FURTHER: Mapping[str, Callable[[Drive], Drive]] = {
    "pull to the left with the square of speed": _by_wheels(lambda m, h, t: (m, h - 0.006 * m * np.abs(m))),
    "wheels slip in the third quarter": _by_wheels(lambda m, h, t: (np.where((t > 0.5) & (t < 0.75), 1.06 * m, m), h)),
    "map sheared along diagonals": _by_reference(lambda p, t, h: p + np.array([0.0, 0.05 * p[0] * math.sin(2.0 * h), 0.0])),
}
"""Effects that were invented after all of the above were used."""
