"""Searches beside the estimates: nothing waits for them before they are due, and the result is that of a search at once."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from localization.maps.background_search import PlanarSearch
from localization.maps.localizer import Localizer
from localization.maps.place_search import PlaceMap
from localization.ros.state_serialization import deserialize, serialize
from motion_models import se2
from tests.helpers import floor_plan
from tests.helpers.floor_plan import OFFICE, path

pytestmark = pytest.mark.xdist_group("background_search")

COV = np.diag([0.01, 0.01, 0.005]) ** 2
WAY = path((7, 4), (10.5, 4), (10.5, 6.5), (7, 6.5))


@pytest.fixture(scope="module")
def office() -> PlaceMap:
    return PlaceMap(floor_plan.make_map(), 0.02)


def test_localizer_during_a_search_waits_for_nothing_until_it_is_due(office: PlaceMap, monkeypatch: pytest.MonkeyPatch) -> None:
    may_end, search = threading.Event(), PlaceMap.search

    def slow(self, *arguments):
        assert may_end.wait(20.0)
        return search(self, *arguments)

    monkeypatch.setattr(PlaceMap, "search", slow)
    localizer = Localizer(office, is_background=True)
    for k, delta in enumerate(floor_plan.moves(WAY[:3])):
        localizer.add(floor_plan.scan(OFFICE, WAY[k], seed=k), delta, COV)  # the search of the first scan runs meanwhile
    assert not localizer.advance(0.9 * office.search_s)
    assert not len(localizer.hypotheses)
    may_end.set()
    assert localizer.advance(0.2 * office.search_s)
    best = localizer.hypotheses[0].pose
    assert np.hypot(*(best[:2] - WAY[2, :2])) < 0.1  # two keyframes farther than the scan that was searched
    assert abs(se2.wrap_angle(best[2] - WAY[2, 2])) < 0.05


def test_localizer_with_searches_beside_it_is_localized_at_the_same_place(office: PlaceMap) -> None:
    localizer = Localizer(office, is_background=True)
    states = []
    for k, delta in enumerate(floor_plan.moves(WAY)):
        localizer.add(floor_plan.scan(OFFICE, WAY[k], seed=k), delta, COV)
        localizer.advance(office.search_s)
        states.append(localizer.state)
    assert states[-1] == "localized"
    assert np.hypot(*(localizer.pose[:2] - WAY[-1, :2])) < 0.05


def test_background_search_written_and_read_searches_again(office: PlaceMap) -> None:
    points = floor_plan.scan(OFFICE, WAY[0])
    search = PlanarSearch(office, points, None)
    search.move(np.array([0.5, 0.0, 0.1]), COV)
    search.advance(0.1)
    again = deserialize(*serialize(search, {"map": office}), {"map": office})
    np.testing.assert_array_equal([p.pose for p in again.result()], [p.pose for p in search.result()])
    np.testing.assert_array_equal(again.since.pose, search.since.pose)
    np.testing.assert_array_equal(again.since.cov, search.since.cov)
    assert not again.advance(office.search_s - 0.11)
    assert again.advance(0.02)


def test_background_search_that_fails_raises_where_the_result_is_taken(office: PlaceMap) -> None:
    search = PlanarSearch(office, np.zeros((3, 5)), None)
    with pytest.raises((IndexError, ValueError, TypeError)):
        search.result()
