"""Places that were found move with the robot, and are found again within the odometry's covariance alone."""

from __future__ import annotations

import math

import numpy as np

from localization.maps.place_probability import FoundPlaces, PlaceHypothesis

_PLACES = [PlaceHypothesis(np.array([x, 2.0, 0.5 * math.pi]), 0.4, np.eye(3) * 1e-4) for x in (1.0, 8.0)]


def test_found_places_after_a_motion_are_where_the_odometry_leads() -> None:
    found = FoundPlaces(_PLACES, 0.0)
    found.move(np.array([2.0, 0.0, 0.0]), np.zeros((3, 3)))
    assert found.has(np.array([8.0, 4.0, 0.5 * math.pi]))
    assert not found.has(np.array([8.0, 2.0, 0.5 * math.pi]))
    assert not found.has(np.array([8.0, 4.0, 0.0]))


def test_found_places_after_sideways_drift_agree_across_the_way_only() -> None:
    """Sigma of 1 m to the left of a robot that looks along y: along x of the map."""
    found = FoundPlaces(_PLACES[:1], 0.0)
    found.move(np.zeros(3), np.diag([0.0, 1.0, 0.0]))
    assert found.has(np.array([3.0, 2.0, 0.5 * math.pi]))
    assert not found.has(np.array([1.0, 4.0, 0.5 * math.pi]))


def test_found_places_of_a_search_in_vain_have_none_and_are_improbable() -> None:
    assert not FoundPlaces().has(np.zeros(3))
    assert FoundPlaces().probability < 0.01
