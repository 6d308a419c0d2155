"""Planar scans on hills: which points may be hits of the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.events import Scan
from localization.lidar.ground_hits import GroundHits
from motion_models.robot import Mount

MOUNTS = {"laser": Mount(x=0.4, z=0.3, yaw=0.5), "pitched": Mount(x=0.4, z=0.3, pitch=0.1)}


def _scan(ranges, frame="laser", is_planar=True):
    bearings = np.linspace(-1.0, 1.0, len(ranges))
    points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings), np.zeros(len(ranges))])
    return Scan(1, points, 1e-3 * np.arange(len(ranges)), frame, is_planar)


def test_points_beyond_the_reach_of_curved_ground_stay():
    """Ground of 2 x .02 rises by .02 d^2 over the robot's plane: to .3 m after 3.87 m from the body, 3.47 to 4.27 m from the scanner."""
    ranges = np.linspace(1.0, 8.0, 141)
    above = GroundHits(MOUNTS).leave_out(_scan(ranges), 0.02)
    left = np.hypot(above.points[:, 0], above.points[:, 1])
    assert left.min() == 1.0
    assert 3.4 < left.max() <= 4.28
    assert len(above.offsets) == len(above.points)


def test_beams_that_point_down_reach_the_ground_earlier():
    near, far = (GroundHits(MOUNTS).leave_out(_scan(np.full(9, r), "pitched"), 0.02).points for r in (1.5, 2.9))
    assert len(near) == 9
    assert not len(far)


@pytest.mark.parametrize(("curvature", "is_planar"), [(0.003, True), (0.02, False)], ids=["plane", "cloud"])
def test_scan_stays_on_a_plane_and_a_cloud_everywhere(curvature, is_planar):
    scan, hits = _scan(np.linspace(1.0, 40.0, 50), is_planar=is_planar), GroundHits(MOUNTS)
    assert hits.leave_out(scan, curvature) is scan
    assert hits.warnings() == []


def test_many_points_on_the_ground_are_reported():
    hits = GroundHits(MOUNTS)
    for ranges in (np.full(30, 1.0), np.full(10, 20.0)):
        hits.leave_out(_scan(ranges), 0.02)
    (text,) = hits.warnings()
    assert f"'laser' may hit the ground from {math.sqrt(0.3 / 0.02):.1f} m on" in text
    assert "25 % of its points" in text
