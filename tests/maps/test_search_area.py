"""What narrows a search: a given pose for ten keyframes, a measured position by its sigma, and nothing where the robot may be anywhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.maps.position_plane import PositionFix
from localization.maps.search_area import SearchArea, around
from localization.maps.uncertain_pose import UncertainPose

_EXTENT = np.diag([20.0, 20.0, math.pi]) ** 2


def fixed(sigma_m: float) -> SearchArea:
    area = SearchArea()
    area.fix = PositionFix(np.array([3.0, 4.0]), sigma_m**2 * np.eye(2))
    return area


def test_search_area_of_a_given_pose_is_dropped_after_ten_searches() -> None:
    area = SearchArea()
    assert not area.is_given
    area.give()
    assert [area.take_given() for _ in range(10)] == [False] * 9 + [True]
    assert not area.is_given
    assert not area.take_given()


def test_search_area_of_a_given_pose_is_open_when_the_robot_is_found() -> None:
    area = SearchArea()
    area.give()
    area.open()
    assert not area.is_given


def test_search_area_around_a_position_is_three_sigma_wide_at_any_heading() -> None:
    window = fixed(2.0).around_fix(_EXTENT)
    assert window is not None
    np.testing.assert_allclose(window[0][:2], [3.0, 4.0])
    np.testing.assert_allclose(window[1], [3.0 * math.sqrt(8.0)] * 2 + [math.pi])


def test_search_area_of_a_position_wider_than_the_map_is_all_of_it() -> None:
    assert fixed(25.0).around_fix(_EXTENT) is None
    assert SearchArea().around_fix(_EXTENT) is None


def test_search_area_position_contradicts_by_five_sigma_and_less_after_driving() -> None:
    area = fixed(1.0)
    assert not area.contradicts(np.array([7.9, 4.0, 0.0]))
    assert area.contradicts(np.array([8.2, 4.0, 0.0]))
    area.move(np.array([3.0, 0.0, 0.0]))
    assert not area.contradicts(np.array([8.2, 4.0, 0.0]))
    assert not SearchArea().contradicts(np.array([100.0, 0.0, 0.0]))


def test_search_window_around_a_pose_is_three_sigma_along_any_axes() -> None:
    pose, half = around(UncertainPose(np.array([1.0, 2.0, 0.5]), np.diag([0.3, 0.4, 0.1]) ** 2))
    np.testing.assert_allclose(pose, [1.0, 2.0, 0.5])
    assert half == pytest.approx([1.5, 1.5, 0.3])
