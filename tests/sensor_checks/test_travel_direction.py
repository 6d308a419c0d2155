"""A LiDAR whose yaw is wrong."""

from __future__ import annotations

import re

import pytest

from localization.sensor_checks.travel_direction import LIDAR_DIRECTION
from tests.helpers.checked_drive import CheckedDrive, turned


@pytest.mark.parametrize(("degrees", "correction"), [(20.0, -20.0), (-30.0, 30.0), (170.0, -170.0)])
def test_lidar_whose_mount_is_turned_is_left_out(degrees: float, correction: float) -> None:
    robot = CheckedDrive(scan=lambda points: turned(points, degrees))
    checks = robot.drive()
    assert list(checks.found) == [LIDAR_DIRECTION]
    found = re.search(r"yaw of its frame by ([-+0-9]+) deg", checks.warnings()[0])
    assert found is not None
    assert float(found[1]) == pytest.approx(correction, abs=2.0)
    assert robot.applied[-1].scan is None
    assert robot.applied[-1].is_scan_excluded
    assert robot.applied[-1].turn is not None
