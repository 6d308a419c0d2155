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


def _by_reference(change: Callable[[FloatArray, float], FloatArray]) -> Callable[[Drive], Drive]:
    """``change`` takes the (3,) measured motion of a window and the share of the drive that is over."""

    def apply(drive: Drive) -> Drive:
        over = drive.starts_s / drive.starts_s[-1]
        maneuvers = (
            dataclasses.replace(m, measured=change(m.measured[0], float(share))[None])
            for m, share in zip(drive.maneuvers, over, strict=True)
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


UNKNOWN: Mapping[str, Callable[[Drive], Drive]] = {
    "puncture of the left tyres": _by_wheels(_puncture),
    "slip in left turns only": _by_wheels(lambda m, h, t: (m, np.where(h > 0.0, h / 0.85, h))),
    "slip when driving backwards": _by_wheels(lambda m, h, t: (np.where(m < 0.0, m / 0.92, m), h)),
    "slip with the square of speed": _by_wheels(lambda m, h, t: (m * (1.0 + 0.03 * np.abs(m)), h)),
    "rates saturate": _by_wheels(lambda m, h, t: _clip(m, h, 2.6)),
    "slow rates are lost": _by_wheels(lambda m, h, t: _dead_zone(m, h, 1.3)),
    "wet patches of floor": _by_wheels(lambda m, h, t: (m, h * (1.0 + 0.15 * (np.sin(40.0 * t) > 0.3)))),
    "radius varies with time": _by_wheels(lambda m, h, t: (m * (1.0 + 0.06 * np.sin(4.0 * math.pi * t)), h)),
    "reference is longer in one quarter": _by_reference(lambda p, t: p * np.array([1.06, 1.06, 1.0]) if 0.25 < t < 0.5 else p),
    "reference turns with its range": _by_reference(lambda p, t: p + np.array([0.0, 0.0, 0.05 * abs(p[0])])),
}
"""By what happens."""
INSEPARABLE = frozenset({"slip with the square of speed"})
"""Those that a drive at two speeds shows as a wheel radius, 8 % off."""
