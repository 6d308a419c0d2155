"""Localization in maps of floor plans: from nothing, near a given pose, in another building, carried, through changes and symmetry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from localization.errors import MapError
from localization.maps.localizer import Localizer
from localization.maps.place_probability import LIKELY
from localization.maps.place_search import PlaceMap
from motion_models import se2
from tests.helpers import floor_plan
from tests.helpers.floor_plan import HALL, OFFICE, path

pytestmark = pytest.mark.xdist_group("localizer")

COV = np.diag([0.01, 0.01, 0.005]) ** 2
CARRIED = np.diag([3.0, 3.0, 1.5]) ** 2
CORRIDOR = np.array([*floor_plan.box(0, 0, 25, 2.4), *floor_plan.box(2.5, 0, 3, 0.6), *floor_plan.box(0.4, 1.8, 1.2, 2.4)], dtype=float)
WAY = path((7, 4), (10.5, 4), (10.5, 6.5), (7, 6.5), (7, 4), (3.5, 3.6), (3.5, 1), (1, 1))


@pytest.fixture(scope="module")
def office() -> PlaceMap:
    return PlaceMap(floor_plan.make_map(), 0.02)


def drive(localizer: Localizer, walls: np.ndarray, poses: np.ndarray, first_cov: np.ndarray = COV) -> list[tuple[str, float]]:
    """State and error [m] after each of ``poses`` (K, 3); odometry drifts by 1 % and 0.2 degrees a step."""
    found = []
    for k, delta in enumerate(floor_plan.moves(poses)):
        delta = delta * 1.01 + np.array([0.0, 0.0, math.radians(0.2)]) * (k > 0)
        localizer.add(floor_plan.scan(walls, poses[k], seed=100 + k), delta, first_cov if k == 0 else COV)
        found.append((localizer.state, float(math.hypot(*(localizer.pose[:2] - poses[k, :2])))))
    return found


def test_localizer_from_nothing_finds_the_place_and_keeps_it(office: PlaceMap) -> None:
    localizer = Localizer(office)
    assert localizer.state == "searching"
    assert localizer.covariance[0, 0] > 9.0
    found = drive(localizer, OFFICE, WAY)
    first = [state for state, _ in found].index("localized")
    assert first <= 5
    assert all(state == "localized" for state, _ in found[first:])
    errors = [error for _, error in found[first:]]
    assert np.median(errors) < 0.03
    assert max(errors) < 0.1
    assert localizer.probability > 0.95
    assert abs(se2.wrap_angle(localizer.pose[2] - WAY[-1, 2])) < 0.02
    assert 0.02 < math.sqrt(localizer.covariance[0, 0]) < 0.1


def test_place_map_search_finds_the_true_pose_at_any_heading(office: PlaceMap) -> None:
    """Off the middles of blocks; nothing that is left out by its bound is better."""
    rng = np.random.default_rng(4)
    for x, y in ((7.3, 4.1), (9.9, 5.7), (3.4, 2.2), (1.3, 1.1)):
        pose = np.array([x, y, rng.uniform(-math.pi, math.pi)])
        scan = floor_plan.scan(OFFICE, pose, seed=int(10 * x))
        best = office.search(scan)[0]
        assert se2.between(pose, best.pose) == pytest.approx(np.zeros(3), abs=0.06)
        assert best.score >= office.align(scan, pose).score - 0.02


def test_localizer_in_another_buildings_map_is_never_localized(office: PlaceMap) -> None:
    """Nor does it give any place a probability above 0.9."""
    localizer, way = Localizer(office), path((1, 1), (12, 1), (13, 4), step=2.0)[:4]
    for k, delta in enumerate(floor_plan.moves(way)):
        localizer.add(floor_plan.scan(HALL, way[k], seed=k), delta, COV)
        assert localizer.state == "searching"
        assert localizer.probability < LIKELY


@pytest.mark.extended
def test_localizer_carried_is_found_by_one_view_and_sure_after_the_next(office: PlaceMap) -> None:
    """A view that fits nowhere else is enough to be tracked; more than 0.9 is given only after another one fits as well."""
    localizer = Localizer(office)
    assert drive(localizer, OFFICE, WAY[:8])[-1][0] == "localized"
    way = path((3.5, 1), (3.5, 3.6), (7, 3.8), (10, 4.1))
    assert localizer.probability_after(np.zeros(3), CARRIED) < 0.1 < LIKELY < localizer.probability
    localizer.add(floor_plan.scan(OFFICE, way[0]), np.zeros(3), CARRIED)
    assert localizer.state == "localized"
    assert localizer.probability <= LIKELY
    assert se2.between(way[0], localizer.pose) == pytest.approx(np.zeros(3), abs=0.1)
    found = drive(localizer, OFFICE, way)
    assert found[-1][0] == "localized"
    assert found[-1][1] < 0.1
    assert localizer.probability > LIKELY


def test_localizer_at_a_wrong_place_by_one_view_leaves_it_at_the_next(office: PlaceMap) -> None:
    localizer, way = Localizer(office), path((3.5, 1), (3.5, 3.6))
    localizer.add(floor_plan.scan(OFFICE, WAY[0]), np.zeros(3), COV)
    assert localizer.state == "localized"
    localizer.add(floor_plan.scan(OFFICE, way[3]), np.array([0.5, 0.0, 0.0]), COV)
    assert se2.between(way[3], localizer.pose) == pytest.approx(np.zeros(3), abs=0.1)
    assert localizer.probability <= LIKELY


def test_localizer_carried_unnoticed_is_found_within_metres(office: PlaceMap) -> None:
    """The odometry goes on as if nothing had happened."""
    localizer = Localizer(office)
    assert drive(localizer, OFFICE, WAY[:8])[-1][0] == "localized"
    way = path((3.5, 1), (3.5, 3.6), (7, 3.8), (10, 4.1))
    localizer.add(floor_plan.scan(OFFICE, way[0]), np.zeros(3), COV)
    assert localizer.probability <= LIKELY  # as soon as one scan does not fit
    found = drive(localizer, OFFICE, way)
    assert max(error for _, error in found[4:]) < 0.2
    assert [state for state, _ in found[4:]] == ["localized"] * len(found[4:])


def test_localizer_with_moved_furniture_stays_localized(office: PlaceMap) -> None:
    changed = np.vstack([OFFICE[:-4], floor_plan.box(5.4, 5.0, 6.2, 5.6)])
    found = drive(Localizer(office), changed, WAY[:20])
    assert [state for state, _ in found[6:]] == ["localized"] * len(found[6:])
    assert max(error for _, error in found[6:]) < 0.15


def test_localizer_in_a_square_room_lists_four_places_unless_a_pose_is_given() -> None:
    walls = np.array(floor_plan.box(0, 0, 6, 6), dtype=float)
    way = path((1, 1), (4, 1), (4, 3))
    places = PlaceMap(floor_plan.make_map(walls, path((1, 1), (5, 1), (5, 5), (1, 5), (1, 1))), 0.02)
    localizer = Localizer(places)
    assert {state for state, _ in drive(localizer, walls, way)} == {"searching"}
    assert len(localizer.hypotheses) == 4
    assert localizer.hypotheses[0].probability < 0.5
    near = Localizer(places, np.array([1.3, 0.7, 0.1]))
    state, error = drive(near, walls, way)[-1]
    assert state == "localized"
    assert error < 0.05


def test_localizer_with_a_wrong_given_pose_searches_everywhere(office: PlaceMap) -> None:
    state, error = drive(Localizer(office, np.array([1.0, 7.0, 1.0])), OFFICE, WAY[:18])[-1]
    assert state == "localized"
    assert error < 0.1


def test_localizer_without_scans_keeps_searching(office: PlaceMap) -> None:
    localizer = Localizer(office)
    for _ in range(3):
        localizer.add(np.empty((0, 2)), np.zeros(3), COV)
    assert localizer.state == "searching"


@pytest.mark.extended
@pytest.mark.parametrize("scale", [3.28, 1 / 3.28])
def test_localizer_in_a_map_of_other_units_is_never_localized(scale: float) -> None:
    metres = floor_plan.make_map()
    other = replace(metres, poses=metres.poses * [scale, scale, 1.0], points=metres.points * np.float32(scale))
    assert {state for state, _ in drive(Localizer(PlaceMap(other, 0.02)), OFFICE, WAY[:4])} == {"searching"}


def test_place_map_in_millimetres_asks_for_the_unit() -> None:
    metres = floor_plan.make_map()
    with pytest.raises(MapError, match="Is the map in metres"):
        PlaceMap(replace(metres, poses=metres.poses * [1000.0, 1000.0, 1.0], points=metres.points * np.float32(1000.0)), 0.02)


def test_localizer_with_a_sensor_of_another_height_is_never_wrong(office: PlaceMap) -> None:
    """It misses the low furniture of the map, and has table tops instead."""
    tops = np.vstack([floor_plan.box(10.5, 5.0, 11.5, 5.8), floor_plan.box(1.5, 6.0, 3.5, 7.0)])
    found = drive(Localizer(office), np.vstack([OFFICE[:7], OFFICE[11:12], OFFICE[-5:-4], tops]), WAY[:18])
    assert all(error < 0.3 for state, error in found if state == "localized")


def test_localizer_by_one_view_again_and_again_is_not_certain(office: PlaceMap) -> None:
    localizer = Localizer(office)
    for k in range(6):
        localizer.add(floor_plan.scan(OFFICE, WAY[0], seed=k), np.zeros(3), COV)
        assert localizer.state == "localized"
        assert localizer.probability <= LIKELY
    assert math.hypot(*(localizer.pose[:2] - WAY[0, :2])) < 0.05


@pytest.fixture(scope="module")
def corridor() -> PlaceMap:
    """A corridor of 25 m, mapped from its end with poses that are off by 3 cm: of walls that slanting beams alone touch, many cells are
    free."""
    rng, n = np.random.default_rng(0), 40
    poses = np.column_stack([rng.uniform(0.6, 2.0, n), rng.uniform(0.5, 1.6, n), rng.uniform(-math.pi, math.pi, n)])
    mapped = floor_plan.make_map(CORRIDOR, poses)
    return PlaceMap(replace(mapped, poses=poses + rng.normal(0.0, [0.03, 0.03, 0.01], (n, 3))), 0.02)


def test_place_in_a_corridor_mapped_from_its_end_is_not_contradicted(corridor: PlaceMap) -> None:
    """Half a metre beside it is."""
    cov = np.diag([1e-4, 1e-4, 1e-4]) ** 2
    for x, in_free, beside in ((7.0, 0.1, 0.05), (5.0, 0.02, 0.2)):
        points = floor_plan.scan(CORRIDOR, np.array([x, 1.2, 0.0]))
        right, wrong = (corridor.align(points, np.array([x, y, 0.0]), cov) for y in (1.2, 1.7))
        assert right.in_free > in_free
        assert right.contradicting < 0.02
        assert wrong.contradicting > beside


def test_localizer_that_leaves_the_map_is_outside_with_its_covariance(corridor: PlaceMap) -> None:
    localizer, way = Localizer(corridor), path((0.8, 0.6), (2, 1.5), (0.9, 1.2), (16, 1.2))
    found = drive(localizer, CORRIDOR, way)
    first = [state for state, _ in found].index("localized")
    assert {state for state, _ in found[first:]} == {"localized"}
    assert localizer.is_outside
    assert found[-1][1] < 3.0 * math.sqrt(np.trace(localizer.covariance[:2, :2]))


def test_localizer_beyond_the_map_keeps_its_pose_and_is_found_near_it(office: PlaceMap) -> None:
    """Odometry alone: searched about its pose, with its covariance and not that of the whole map, and never lost."""
    localizer = Localizer(office)
    assert drive(localizer, OFFICE, WAY[:8])[-1][0] == "localized"
    grown = np.diag([0.1, 0.1, 0.12]) ** 2
    for _ in range(9):
        localizer.add(np.empty((0, 2)), np.zeros(3), grown)
    assert localizer.state == "searching"
    assert localizer.probability < 0.1  # no place is found yet
    assert 0.3 < math.sqrt(localizer.covariance[2, 2]) < 0.5
    found = drive(localizer, OFFICE, WAY[8:12], grown)
    assert found[0][0] == "localized"
    assert found[0][1] < 0.1


def test_localizer_back_at_the_border_of_the_map_takes_its_pose_at_once() -> None:
    """After a way without scans whose odometry is off by 0.3 m, as large as its sigma: two fifths of the scan are on walls of the map, the
    others where it has nothing."""
    way, begun = WAY[14:20], path((1, 1), (4, 1), (4, 3.6), (1, 3.6))
    localizer = Localizer(PlaceMap(floor_plan.make_map(OFFICE, begun), 0.02), way[0], np.diag([0.1, 0.1, 0.05]) ** 2)
    assert drive(localizer, OFFICE, way)[-1][0] == "localized"
    for _ in range(6):
        localizer.add(np.empty((0, 2)), np.array([0.033, -0.042, 0.0]), np.diag([0.12, 0.12, 0.01]) ** 2)
    assert math.hypot(*(localizer.pose[:2] - way[-1, :2])) > 0.25
    points = floor_plan.scan(OFFICE, way[-1], seed=1)
    points[::3] *= 20.0
    assert localizer.places.align(points, way[-1]).on_walls < 0.5
    localizer.add(points, np.zeros(3), COV)
    assert localizer.state == "localized"
    assert not localizer.is_outside
    assert math.hypot(*(localizer.pose[:2] - way[-1, :2])) < 0.03


@pytest.mark.extended
def test_localizer_with_scans_beyond_walls_and_in_free_space_doubts(office: PlaceMap) -> None:
    """As after it was carried unnoticed: 75 % of the points are where the map has nothing, 10 % in free space."""
    localizer = Localizer(office)
    assert drive(localizer, OFFICE, WAY[:8])[-1][0] == "localized"
    points = floor_plan.scan(OFFICE, WAY[7], seed=1)
    index = np.arange(len(points)) % 20
    points = points * np.where(index < 2, 0.5, np.where(index < 17, 20.0, 1.0))[:, None]
    localizer.add(points, np.zeros(3), COV)
    assert localizer.probability <= LIKELY
    for _ in range(8):
        localizer.add(points, np.zeros(3), COV)
    assert localizer.state == "lost"
