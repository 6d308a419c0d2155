"""Bins of motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.events import Scan, Step, Turn
from localization.lidar import LidarConfig
from localization.sensor_checks.window import MIN_BINS, WINDOW_BINS, Window
from motion_models.motion import Motion

S = 1_000_000_000
STEP_S = 0.1


def step(k: int, has_gyro: bool = True, has_wheels: bool = True, has_scan: bool = False) -> Step:
    motion = Motion(np.array([0.05, 0.0, 0.02]), np.eye(3))
    turn = Turn(0.03, 1e-8, STEP_S) if has_gyro else None
    scan = Scan(0, np.zeros((0, 3))) if has_scan else None
    return Step(k * S // 10, (k + 1) * S // 10, motion, np.zeros(3), np.zeros(3), False, has_wheels, turn, scan)


def test_window_without_scans_has_bins_of_a_quarter_of_a_second() -> None:
    window = Window({}, LidarConfig())
    ends = [k for k in range(40) if window.add(step(k), (k + 1) * STEP_S)]
    assert ends == list(range(3 * MIN_BINS - 1, 40, 3))
    np.testing.assert_allclose(window.bins.rows[:, [3, 4, 7]].T / window.bins.durations_s, np.tile([[0.2], [0.3], [np.nan]], 13))
    assert window.end_s - window.begin_s == pytest.approx(39 * STEP_S)
    for k in range(40, 400):
        window.add(step(k), (k + 1) * STEP_S)
    assert len(window.bins.rows) == WINDOW_BINS


def test_window_with_scans_has_bins_that_end_at_scans() -> None:
    window = Window({}, LidarConfig())
    for k in range(35):
        window.add(step(k, has_scan=k % 5 == 0), (k + 1) * STEP_S)
    np.testing.assert_allclose(window.bins.durations_s, [0.6, *[0.5] * 5])
    for k in range(35, 47):  # no more come
        window.add(step(k), (k + 1) * STEP_S)
    assert window.bins.durations_s[-1] == pytest.approx(1.1)  # ten steps of 0.1 s are a little less than 1 s


def test_window_bin_without_gyro_or_wheels_has_unknown_rates() -> None:
    window = Window({}, LidarConfig())
    for k in range(6):
        window.add(step(k, has_gyro=k != 1, has_wheels=k != 4), (k + 1) * STEP_S)
    np.testing.assert_allclose((window.bins.rows[:, 3:5].T / window.bins.durations_s), [[0.2, np.nan], [np.nan, 0.3]])


@pytest.mark.parametrize("is_planar", [True, False])
def test_window_takes_ways_across_walls_alone_from_planar_scans_only(is_planar: bool) -> None:
    """In a corridor. What stands about on open ground may look like one in the projection of a cloud, as the robot tilts."""
    window, x = Window({}, LidarConfig()), np.arange(-20.0, 20.0, 0.05)
    walls = np.vstack([np.column_stack([x, np.full(len(x), side), np.zeros(len(x))]) for side in (-4.1, 4.1)])
    points = walls if is_planar else np.vstack([walls + np.array([0.0, 0.0, z]) for z in np.arange(-0.6, 0.7, 0.1)])
    for k in range(35):
        scan = Scan(k * S // 10, points, np.zeros(0 if is_planar else len(points)), is_planar=is_planar)
        window.add(replace(step(k), scan=scan if k % 5 == 0 else None), (k + 1) * STEP_S)
    assert np.isfinite(window.bins.lidar[1:, 2]).all()  # turns
    assert np.isnan(window.bins.lidar[:, :2]).all()
    assert np.isfinite(window.bins.across[1:]).all() == is_planar
    assert np.isnan(window.bins.across).all() != is_planar
