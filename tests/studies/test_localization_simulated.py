"""Parts of the study of simulated floors: drives stay clear of walls, changes are of the share asked for, particles follow a drive."""

from __future__ import annotations

import numpy as np

from localization.maps.place_search import PlaceMap
from tests.helpers import floor_plan, office_floor
from tests.helpers.floor_plan import OFFICE, path
from tests.studies.localization_simulated import ParticleFilter, is_right, measured


def test_office_floor_drives_are_clear_of_walls_and_changes_are_of_the_share() -> None:
    rng = np.random.default_rng(7)
    walls = office_floor.make_walls(rng)
    poses = office_floor.drive(walls, rng, 60)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.51
    nearest = min(np.hypot(*floor_plan.scan(walls, pose, beams=90, noise=0.0).T).min() for pose in poses)
    assert nearest > 0.3
    changed = office_floor.change(walls, rng)
    kept = sum(any(np.array_equal(wall, other) for other in changed) for wall in walls[4:])
    assert 0.05 < 1.0 - kept / (len(walls) - 4) < 0.2


def test_particle_filter_around_the_truth_follows_a_drive() -> None:
    rng, way = np.random.default_rng(3), path((7, 4), (10.5, 4), (10.5, 6.5))
    particles = ParticleFilter(PlaceMap(floor_plan.make_map(), 0.02).grid, 500, rng)
    particles.poses = way[0] + rng.normal(0.0, [0.2, 0.2, 0.1], (500, 3))
    for delta, points in measured(OFFICE, way, rng):
        particles.add(delta, np.diag([0.02, 0.02, 0.01]) ** 2, points)
    pose, share, _ = particles.guess()
    assert is_right(pose, way[-1])
    assert share > 0.9
