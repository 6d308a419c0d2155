"""Ranges that the robot file corrects, when scans are decoded."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from localization.events import Scan
from localization.logs import open_log
from motion_models.robot import Lidar
from motion_models.robot_file import load_robot

_ACES = Path("tests/data/aces/aces.mcap")


def test_scans_have_true_ranges_by_the_robot_file() -> None:
    """Measured r is 1.02 times the true range and 0.03 m."""
    robot = load_robot("aces")
    corrected = dataclasses.replace(robot, lidar=Lidar(range_scale=1.02, range_offset_m=0.03))
    measured, true = (next(e for e in open_log(_ACES, r).events() if isinstance(e, Scan)).points for r in (robot, corrected))
    ranges, found = np.linalg.norm(measured, axis=1), np.linalg.norm(true, axis=1)
    np.testing.assert_allclose(1.02 * found + 0.03, ranges, atol=1e-9)
    np.testing.assert_allclose(true / found[:, None], measured / ranges[:, None], atol=1e-9)
