"""Probability of places: by what is as good, listed or left out, and by a measured position."""

from __future__ import annotations

import numpy as np
import pytest

from localization.lidar.registration import Alignment
from localization.maps.place_probability import LIKELY, weigh
from localization.maps.place_search import Place


def place(on_walls: float, in_free: float, x: float = 0.0) -> Place:
    pose = np.array([x, 0.0, 0.0])
    fit = Alignment(pose, 1e4 * np.eye(3), np.zeros(3), on_walls, 0.0, 100, 100, 100.0, 100.0)
    return Place(pose, fit, on_walls, in_free, in_free)


def test_wrong_place_alone_down_to_085_of_its_score_is_not_likely() -> None:
    """As searches found them, and what came next: another room of fr079, where the map does not have the robot's, twice; a corridor of
    ACES."""
    for on_walls, in_free, next_score, n in ((0.79, 0.19, 0.28, 566), (0.78, 0.21, 0.27, 640), (0.65, 0.06, 0.27, 187)):
        assert weigh([place(on_walls, in_free), place(next_score, 0.0, 5.0)], n)[0].probability < LIKELY


def test_place_alone_is_weighed_against_what_the_search_left_out() -> None:
    best = place(0.79, 0.19)
    assert weigh([best], 566)[0].probability < LIKELY < weigh([best, place(0.0, 0.0, 5.0)], 566)[0].probability


def test_wrong_place_by_one_view_of_a_hundred_points_is_not_taken() -> None:
    """In a corridor of ACES, 7 m off, with a margin of 0.36."""
    assert weigh([place(0.77, 0.01), place(0.39, 0.0, 5.0)], 112)[0].probability < LIKELY


def test_place_alone_that_fits_well_is_certain() -> None:
    assert weigh([place(0.96, 0.01)], 300)[0].probability > 0.98


def test_places_that_fit_alike_share_the_probability() -> None:
    found = weigh([place(0.96, 0.01), place(0.96, 0.01, 5.0), place(0.5, 0.1, 9.0)], 300)
    assert [each.probability for each in found[:2]] == pytest.approx([found[0].probability] * 2)
    assert found[0].probability <= 0.5
    assert sum(each.probability for each in found) <= 1.0
    assert found[2].probability < 1e-3


def test_place_of_a_narrowed_search_has_no_rivals_beyond_its_window() -> None:
    assert weigh([place(0.8, 0.02)], 300, is_whole=False)[0].probability > LIKELY


def test_left_out_score_is_above_what_any_place_of_a_lower_search_score_has() -> None:
    """Scores of searches are 0.4 + 0.6 w - 0.8 f: of all shares on walls and in free space with at most 0.7 of it, none has more."""
    best = place(0.8, 0.19)
    w, f = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    is_left_out = (w + f <= 1.0) & (0.4 + 0.6 * w - 0.8 * f <= 0.7 * (0.4 + 0.6 * 0.8 - 0.8 * 0.19))
    most = (w - 2.0 * f)[is_left_out].max()
    assert best.left_out_score == pytest.approx(most, abs=0.01)
    assert best.left_out_score >= most
