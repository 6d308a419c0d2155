"""The robot on hills in MuJoCo: what its wheels measure is how they turn, and it moves as they push it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from localization.events import WheelSample
from tests.helpers.hills import HillDrive
from tests.helpers.mujoco_hills import Wander, drive, steady

_SPEED = 0.5


def _wheels(made: HillDrive) -> tuple[np.ndarray, np.ndarray]:
    """Rates and angles (N, 2)."""
    samples = [e for e in made.events if isinstance(e, WheelSample)]
    return np.array([e.velocity for e in samples]), np.array([e.position for e in samples])


def test_hills_robot_that_speeds_up_does_not_lead_its_wheels() -> None:
    """From rest to a constant speed on level ground it stays behind them by the slip that pushes it. By an integrator that is implicit in
    stiff servos' damping it led them by 3.8 ms of its speed."""
    made = drive(steady(_SPEED, 0.0), 6.0, slope_deg=0.0)
    _, angles = _wheels(made)
    rolled, moved = angles.mean(axis=1) - angles[0].mean(), made.positions[:, 0] - made.positions[0, 0]
    radius = (moved[-1] - moved[200]) / (rolled[-1] - rolled[200])  # from 4 s on at a constant speed
    behind = (radius * rolled - moved)[200:].mean()
    assert 0.0 < behind / _SPEED < 0.002


@pytest.mark.extended
def test_hills_wheels_measure_the_rates_by_which_their_angles_change() -> None:
    """Over hills, where the wheels' loads change: angles and the integral of the rates are within a step of the simulator, 1 ms. By set
    points that changed at the samples alone they were 9 ms apart."""
    rates, angles = _wheels(drive(Wander(3), 12.0, seed=3))
    off = np.diff(angles, axis=0) - 0.02 * 0.5 * (rates[1:] + rates[:-1])
    assert np.abs(rates).max() > 3.0
    assert np.abs(off.sum(axis=0)).max() < 0.001 * np.abs(rates).max()
    assert np.sqrt(np.mean(off**2)) < 1e-4
