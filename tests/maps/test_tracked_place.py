"""A place that is tracked by one view is likely at most until scans from elsewhere fit, and is refuted by a few that do not."""

from __future__ import annotations

import numpy as np

from localization.maps.place_probability import LIKELY, TrackedPlace

_NARROW = np.diag([0.01, 0.01, 0.005]) ** 2


def test_tracked_place_of_one_view_is_at_most_likely_until_others_fit() -> None:
    place = TrackedPlace(4.0, is_one_view=True)
    for _ in range(5):
        place.add(2.5, way_m=0.5)
        assert place.probability_within(_NARROW) <= LIKELY
    place.add(2.5, way_m=1.5)
    assert place.probability_within(_NARROW) > LIKELY


def test_tracked_place_after_one_scan_that_does_not_fit_is_at_most_likely() -> None:
    place = TrackedPlace(4.0, is_one_view=False)
    place.add(2.5, way_m=2.0)
    assert place.probability_within(_NARROW) > 0.99
    place.contradict()
    assert place.probability_within(_NARROW) == LIKELY
    place.add(2.5, way_m=2.0)
    assert place.probability_within(_NARROW) > 0.99


def test_tracked_place_is_refuted_by_a_few_scans_however_long_it_was_right() -> None:
    place = TrackedPlace(4.0, is_one_view=False)
    for _ in range(100):
        place.add(3.0, way_m=2.0)
    n = 0
    while not place.is_refuted:
        place.add(-3.0, way_m=2.0)
        n += 1
    assert n == 6
    assert place.probability < 0.001
