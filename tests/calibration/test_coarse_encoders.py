"""Encoders of few counts: rates of single samples are those of their counts, and are merged."""

from __future__ import annotations

import numpy as np
import pytest

from localization.calibration.windows import merge_counts
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

_DT = 0.02
_TRUE = np.array([1.1, 2.7])
"""Rates of the sides [rad/s]: an arc."""


def counted(step_rad: float, seconds: float = 2.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intervals, rates and CG by encoders that report whole steps."""
    times = np.arange(round(seconds / _DT) + 1) * _DT
    angles = np.floor(times[:, None] * _TRUE / step_rad) * step_rad
    dt = np.full(len(times) - 1, _DT)
    return dt, np.diff(angles, axis=0) / _DT, np.zeros((len(dt), 2))


def test_merge_counts_coarse_encoder_keeps_ways_and_gives_rates() -> None:
    dt, rates, cg = counted(0.05)
    merged, means, _ = merge_counts(dt, rates, cg, 0.05)
    assert merged.sum() == pytest.approx(dt.sum())
    assert merged @ means == pytest.approx(dt @ rates)
    assert np.abs(rates - _TRUE).max() > 1.0
    assert np.abs(means[:-1] - _TRUE).max() < 0.3


def test_merge_counts_fine_encoder_changes_nothing() -> None:
    dt, rates, cg = counted(0.0015)
    assert merge_counts(dt, rates, cg, 0.0015)[1] is rates


@pytest.mark.parametrize("step_rad", [0.05, 0.0115])
def test_merge_counts_turn_by_the_friction_model_is_that_of_the_wheels(step_rad: float) -> None:
    """Rates of single samples turn the robot as if it drove turns in place and straight on by turns."""
    robot = load_robot("husky_a200")
    model = make_model("friction", robot)

    def turn(dt: FloatArray, rates: FloatArray) -> float:
        return float(preintegrate(model, dt, rates, robot.center_of_gravity, model.nominal, WheelNoise()).delta[2])

    dt, rates, cg = counted(step_rad)
    merged, means, _ = merge_counts(dt, rates, cg, step_rad)
    true = turn(np.array([dt.sum()]), (dt @ rates / dt.sum())[None])
    assert abs(turn(merged, means) - true) < 5e-4
    assert abs(turn(dt, rates) - true) > 2.0 * abs(turn(merged, means) - true)
