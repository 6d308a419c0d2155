"""Sweeps at one moment, and the walls of clouds."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localization.events import Scan
from localization.lidar import Sweep
from localization.lidar.deskew import extract_walls
from localization.simulation import world
from motion_models import se2
from motion_models.robot import Mount, WheelNoise
from tests.helpers import rooms

NO_SLIP = WheelNoise(*[0.0] * 8)
LAB = world.lab().walls


def scans_of(drive: rooms.Drive) -> list[Scan]:
    return [event for event in drive.events if isinstance(event, Scan)]


def test_deskew_moves_each_point_by_its_own_time() -> None:
    rng, twist = np.random.default_rng(0), np.array([0.4, -0.1, 0.9])
    scan = Scan(0, rng.normal(size=(50, 3)), np.sort(rng.uniform(0.02, 0.1, 50)))
    mount = Mount(x=0.3, y=-0.1, z=0.5, yaw=0.2)
    found = Sweep.from_scan(scan, mount).deskew(twist)
    body = scan.points @ mount.rotation.T + [0.3, -0.1, 0.5]
    middle = 0.5 * (scan.offsets[0] + scan.offsets[-1])
    expected = [se2.transform(se2.exp((t - middle) * twist), p[:2]) for t, p in zip(scan.offsets, body, strict=True)]
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-12)
    np.testing.assert_array_equal(found[:, 2], body[:, 2])


def test_deskew_makes_walls_straight() -> None:
    """A turning robot in a room: with the sweep's own times the walls are straight; with none, or as if the sweep filled all of the scan's
    period, they are not."""
    drive = rooms.drive_through(world.box(-4, -3, 5, 3), rooms.path((1.0, 0.3, 1.0)), 0, noise=NO_SLIP, scanner=rooms.Beams(noise=0.0))
    scan, pose = scans_of(drive)[3], se2.compose(drive.start, drive.poses[3])
    twist = np.array([0.3, 0.0, 1.0])
    fill = rooms.Beams().view / (2.0 * math.pi)

    def rms_from_walls(offsets: np.ndarray) -> float:
        points = se2.transform(pose, Sweep.from_scan(replace(scan, offsets=offsets), drive.mount).deskew(twist)[:, :2])
        from_walls = np.min(np.abs(np.stack([points[:, 0] + 4, points[:, 0] - 5, points[:, 1] + 3, points[:, 1] - 3])), axis=0)
        return float(np.sqrt(np.mean(from_walls**2)))

    assert rms_from_walls(scan.offsets) < 0.002
    assert rms_from_walls(np.empty(0)) > 0.01
    assert rms_from_walls(scan.offsets / fill) > 0.01


def test_deskew_with_wrong_twist_does_not_turn_the_sweep() -> None:
    """Points all around, a twist that errs by 0.1 rad/s over 0.1 s: about the start, the mean turn would be 5 mrad."""
    angles = np.linspace(-math.pi, math.pi, 361)
    points = np.column_stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), np.zeros(361)])
    sweep = Sweep.from_scan(Scan(0, points, np.linspace(0.0, 0.1, 361)), Mount())
    moved = sweep.deskew(np.array([0.0, 0.0, 0.1]))
    turned = np.angle(np.exp(1j * (np.arctan2(moved[:, 1], moved[:, 0]) - angles)))
    assert abs(turned.mean()) < 1e-6
    assert np.abs(turned).max() == pytest.approx(0.005, rel=1e-3)
    assert sweep.displacement(np.array([0.0, 0.0, 0.1])) == pytest.approx(0.1 * 0.1 * 5.0, rel=1e-6)


def test_deskew_without_times_or_motion_keeps_points() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    still = Sweep.from_scan(Scan(0, points, np.linspace(0.0, 0.1, 5)), Mount())
    np.testing.assert_array_equal(still.deskew(np.zeros(3)), points)
    at_once = Sweep.from_scan(Scan(0, points), Mount())
    np.testing.assert_array_equal(at_once.deskew(np.ones(3)), points)
    assert at_once.displacement(np.ones(3)) == 0.0


@pytest.mark.parametrize("times", [True, False])
def test_sweep_with_infinite_points_leaves_them_out(times: bool) -> None:
    points = np.ones((6, 3))
    points[1, 0], points[3, 2], points[4, 1] = math.nan, math.inf, -math.inf
    sweep = Sweep.from_scan(Scan(0, points, np.arange(6.0) if times else np.empty(0)), Mount(x=1.0))
    assert sweep.points.shape == (3, 3)
    np.testing.assert_array_equal(sweep.times, np.array([0.0, 2.0, 5.0]) - 2.5 if times else [])
    assert Sweep.from_scan(Scan(0, np.full((4, 3), math.nan)), Mount()).deskew(np.ones(3)).shape == (0, 3)


def test_sweep_of_a_body_that_rocks_is_deskewed_by_its_turns() -> None:
    """It drives ahead, turns and pitches to and fro within the sweep; by its mean rates points would be more than a centimetre off."""
    times, rng = np.linspace(-0.05, 0.05, 60), np.random.default_rng(1)
    turns = np.column_stack([0.0 * times, 4e-3 * np.sin(40.0 * times) ** 2, 0.3 * times])
    velocity, true = np.array([0.7, 0.0, 0.0]), rng.uniform(-10.0, 10.0, (60, 3))
    ways = times[:, None] * velocity + 0.5 * times[:, None] ** 2 * np.cross([0.0, 0.0, 0.3], velocity)
    sweep = Sweep(Rotation.from_rotvec(turns).inv().apply(true - ways), times, is_planar=False)
    np.testing.assert_allclose(sweep.deskew_in_space(velocity, turns), true, atol=1e-4)
    assert np.abs(sweep.deskew_in_space(velocity, np.outer(times, [0.0, 0.0, 0.3])) - true).max() > 0.01


def test_sweep_within_keeps_points_in_range() -> None:
    points = np.array([[0.05, 0.0, 0.0], [1.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
    sweep = Sweep.from_scan(Scan(0, points, np.arange(4.0)), Mount(), 0.1, 50.0)
    np.testing.assert_array_equal(sweep.points, points[[1, 3]])
    np.testing.assert_array_equal(sweep.times, [-0.5, 1.5])


def test_extract_walls_gives_means_of_high_cells() -> None:
    points, cell, height = rooms.cloud(LAB, np.zeros(3), 0), 0.2, 0.3
    cells: dict[tuple[int, int], list[np.ndarray]] = defaultdict(list)
    for p in points:
        cells[math.floor(p[0] / cell), math.floor(p[1] / cell)].append(p)
    expected = [np.mean(found, axis=0)[:2] for found in cells.values() if np.ptp([p[2] for p in found]) >= height]
    walls = extract_walls(points, cell, height)
    assert len(walls) == len(expected) > 50
    np.testing.assert_allclose(walls[np.lexsort(walls.T)], np.array(expected)[np.lexsort(np.array(expected).T)], atol=1e-9)
    assert extract_walls(points[points[:, 2] < 0.1], cell, height).shape == (0, 2)  # a floor
    assert extract_walls(np.empty((0, 3)), cell).shape == (0, 2)
