"""What the IMU measures of a step, and what is measured only where it is needed."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import ImuSample, Scan
from localization.inputs.inertial import InertialMotion, InertialSensors
from motion_models.robot import Mount
from motion_models.robot_file import load_robot

S = 1_000_000_000
ROBOT = load_robot("vaultbot")


def sensors(has_slopes, is_in_space=False):
    """After 2 s at 0.3 rad/s."""
    made = InertialSensors(ROBOT, {"imu": Mount()}, has_slopes)
    if is_in_space:
        made.measure_in_space()
    for i in range(201):
        made.insert(ImuSample(i * S // 100, np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 9.81]), "imu"))
    return made


def test_measure_without_samples_or_time_is_nothing():
    assert InertialSensors(ROBOT, {}, has_slopes=True).measure(0, S, by_wheels=0.1) == InertialMotion()
    assert sensors(has_slopes=False).measure(S, S, by_wheels=0.0).turn is None


@pytest.mark.parametrize("is_in_space", [False, True])
def test_measure_gives_turns_about_all_axes_in_space_alone(is_in_space):
    found = sensors(has_slopes=False, is_in_space=is_in_space).measure(S, 2 * S, by_wheels=0.3)
    assert found.turn is not None
    assert found.turn.angle == pytest.approx(0.3)
    assert (found.body_turn is not None) == is_in_space
    if found.body_turn is not None:
        assert found.body_turn.angles == pytest.approx([0.0, 0.0, 0.3])


def test_measure_gives_turns_through_the_sweep_of_a_scan():
    """A robot that rocks within a sweep: its turns until each time of it, not those at a constant rate."""
    made, rocking = sensors(has_slopes=False, is_in_space=True), 2.0 * np.pi / 0.2
    for i in range(201, 260):
        rate = np.array([0.0, 0.1 * np.sin(rocking * (i - 200) / 100), 0.3])
        made.insert(ImuSample(i * S // 100, rate, np.array([0.0, 0.0, 9.81]), "imu"))
    scan = Scan(2 * S, np.zeros((2, 3)), np.array([0.0, 0.1]))
    found = made.measure(2 * S - S // 20, scan.middle_ns, by_wheels=0.3, scan=scan).body_turn
    assert found is not None
    times, *turned = found.sweep.T
    pitch = 0.1 / rocking * (np.cos(rocking * 0.05) - np.cos(rocking * (times + 0.05)))
    np.testing.assert_allclose(np.transpose(turned), np.column_stack([0.0 * times, pitch, 0.3 * times]), atol=5e-5)
    assert np.abs(pitch - 0.1 * times).max() > 1e-3


def test_vertical_is_measured_on_slopes_and_in_space_alone():
    assert sensors(has_slopes=False).attitude is None
    assert sensors(has_slopes=True).attitude is not None
    assert sensors(has_slopes=False, is_in_space=True).attitude is not None
