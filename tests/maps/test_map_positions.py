"""Measured positions, as by GNSS, in a saved map: its plane in the file, their covariance, what they exclude and what contradicts them."""

from __future__ import annotations

import dataclasses
import functools
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from localization.errors import MapError
from localization.events import PositionSample
from localization.logs.reference_topics import in_plane, position_sample, reference_decoder
from localization.maps import SavedMap, load_map, save_map
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.maps.position_plane import PositionFix, PositionPlane
from motion_models import se2
from tests.helpers import floor_plan, office_floor, square_room
from tests.helpers.floor_plan import OFFICE, path

pytestmark = pytest.mark.xdist_group("map_positions")

COV = np.diag([0.01, 0.01, 0.005]) ** 2
PLANE = PositionPlane(
    np.array([40.0, -25.0, 2.0]), np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.002], [0.0, 0.002, 0.001]]), np.array([0.3, 0.1])
)


@functools.cache
def equal_rooms() -> tuple[np.ndarray, PlaceMap]:
    """Walls of a corridor with equal rooms, and their map."""
    rng = np.random.default_rng(1)
    walls = office_floor.make_equal_rooms(rng)
    return walls, PlaceMap(floor_plan.make_map(walls, office_floor.drive(walls, rng, 150)), 0.02)


def test_position_in_a_map_has_its_covariance() -> None:
    """Monte Carlo of 20,000: normalised errors have a mean square of 2, for plane, position and heading drawn at random."""
    rng, n = np.random.default_rng(1), 20_000
    truth, measured_cov = np.array([12.0, 7.0]), np.diag([1.0, 0.25])
    planes = se2.retract(np.tile(PLANE.plane_T_map, (n, 1)), rng.multivariate_normal(np.zeros(3), PLANE.covariance, n))
    bodies = np.column_stack([np.tile(truth, (n, 1)), rng.uniform(-np.pi, np.pi, n)])
    antennas = se2.transform(bodies[:, None], PLANE.antenna[None])[:, 0]
    measured = se2.transform(planes[:, None], antennas[:, None])[:, 0] + rng.multivariate_normal(np.zeros(2), measured_cov, n)
    cov = PLANE.to_map(measured.mean(axis=0), measured_cov).cov
    off = se2.transform(se2.inverse(PLANE.plane_T_map), measured) - truth
    assert np.einsum("ni,ij,nj->n", off, np.linalg.inv(cov), off).mean() == pytest.approx(2.0, abs=0.1)


def test_map_with_a_plane_is_kept_in_the_file(tmp_path: Path) -> None:
    placed = dataclasses.replace(PLANE, origin=(48.1, 11.5, 500.0))
    save_map(tmp_path / "room.skidmap", SavedMap(dataclasses.replace(square_room.make_map(), plane=placed), {}))
    found = load_map(tmp_path / "room.skidmap").map.plane
    assert found is not None
    assert found.as_json() == placed.as_json()


@pytest.mark.parametrize("positions", [{}, [], {**PLANE.as_json(), "plane_T_map": [1.0, 2.0]}, {**PLANE.as_json(), "origin": "here"}])
def test_map_with_another_plane_is_refused(tmp_path: Path, positions: object) -> None:
    path = tmp_path / "room.skidmap"
    save_map(path, SavedMap(square_room.make_map(), {}))
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["skidmap.json"] = json.dumps(json.loads(members["skidmap.json"]) | {"positions": positions}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(MapError, match="damaged"):
        load_map(path)


def fix_message(latitude: float, longitude: float):
    from types import SimpleNamespace

    return SimpleNamespace(
        latitude=latitude, longitude=longitude, altitude=500.0, status=SimpleNamespace(status=0), position_covariance_type=0
    )


def test_positions_of_two_days_are_in_one_plane() -> None:
    """Each log has its first fix as origin."""
    first, second = (reference_decoder("sensor_msgs/msg/NavSatFix") for _ in range(2))
    first(fix_message(48.1, 11.5), 0)
    second(fix_message(48.101, 11.502), 0)
    expected, other = (position_sample(decode(fix_message(48.102, 11.504), 1)) for decode in (first, second))
    np.testing.assert_allclose(in_plane(other, expected.origin), expected.position, atol=0.01)
    assert in_plane(PositionSample(0, np.zeros(2), np.eye(2)), expected.origin) is None


@pytest.mark.parametrize("has_positions", [False, True])
def test_localizer_among_equal_rooms_lists_them_or_is_told_by_positions(has_positions: bool) -> None:
    """A fix of 1 m excludes the rooms 4 m away, which scans alone can't tell apart."""
    walls, places = equal_rooms()
    rng, localizer, room = np.random.default_rng(1), Localizer(places), path((14.0, 1.0), (13.0, 1.0), (13.0, 1.0), (14.5, 1.0))
    for k, delta in enumerate(floor_plan.moves(room)):
        localizer.add(floor_plan.scan(walls, room[k], seed=k), delta, COV)
        if has_positions:
            localizer.add_position(PositionFix(room[k, :2] + rng.normal(0.0, 1.0, 2), np.eye(2)))
        else:
            assert localizer.state == "searching"
    if has_positions:
        assert localizer.state == "localized"
        assert np.hypot(*(localizer.pose[:2] - room[-1, :2])) < 0.1
    else:
        assert {-1, 0, 1} <= {round((place.pose[0] - room[-1, 0]) / 4.0) for place in localizer.hypotheses}
        assert localizer.hypotheses[0].probability < 0.5


def test_localizer_far_from_its_positions_is_lost() -> None:
    localizer, way = Localizer(PlaceMap(floor_plan.make_map(), 0.02)), path((7, 4), (10.5, 4), (10.5, 6.5), (7, 6.5))
    for k, delta in enumerate(floor_plan.moves(way[:8])):
        localizer.add(floor_plan.scan(OFFICE, way[k], seed=k), delta, COV)
    assert localizer.state == "localized"
    for k, delta in enumerate(floor_plan.moves(way)[8:13], 8):
        localizer.add_position(PositionFix(way[k, :2] + [40.0, 0.0], np.eye(2)))
        localizer.add(floor_plan.scan(OFFICE, way[k], seed=k), delta, COV)
    assert localizer.state != "localized"
    assert localizer.probability < 0.5
