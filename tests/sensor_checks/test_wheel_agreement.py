"""Agreement of wheels and estimate, and what begins where they do not agree: suspicion, departure, jump; past scans beside them."""

from __future__ import annotations

import numpy as np
import pytest

from localization.sensor_checks.past_views import LidarViews, PastViews, View
from localization.sensor_checks.scan_motion import make_profile
from localization.sensor_checks.wheel_agreement import Departure, Jump, Suspicion, agree, compare_motions, difference
from motion_models import se2

START = np.array([[1.0, 2.0, 0.5], [3.0, -1.0, -0.7]])


def moved(by_wheels, by_estimate, since=START):
    """The moment after both motions (3,)."""
    return se2.compose(since, np.array([by_wheels, by_estimate]))


def profile():
    angles = np.linspace(-np.pi, np.pi, 361)[:-1]
    found = make_profile(3.0 * np.column_stack([np.cos(angles), np.sin(angles)]), np.zeros(2))
    assert found is not None
    return found


def test_difference_is_the_motion_by_wheels_seen_from_the_estimate():
    by_estimate, off = np.array([0.4, 0.1, 0.3]), np.array([0.05, -0.02, 0.1])
    now = moved(se2.retract(by_estimate, off), by_estimate)
    np.testing.assert_allclose(difference(START, now), off, atol=1e-12)
    assert compare_motions(START, now)[1] == pytest.approx(np.hypot(*off[:2]))


@pytest.mark.parametrize(
    ("by_wheels", "off", "is_alike"),
    [
        ((0.0, 0.0, 0.0), (0.02, 0.0, 0.0), True),  # noise of two scans
        ((0.0, 0.0, 0.0), (0.04, 0.0, 0.0), False),
        ((0.4, 0.0, 0.0), (0.12, 0.0, 0.0), True),  # a quarter of the way is slip
        ((0.4, 0.0, 0.0), (0.16, 0.0, 0.0), False),
        ((0.0, 0.0, 0.5), (0.07, 0.0, 0.0), True),  # turning about another centre
        ((0.4, 0.0, 0.0), (0.0, 0.0, 0.25), False),
    ],
)
def test_wheels_and_estimate_agree_within_usual_slip(by_wheels, off, is_alike):
    by_estimate = se2.retract(np.array(by_wheels), -np.array(off))
    assert agree(START, moved(by_wheels, by_estimate)) is is_alike


@pytest.mark.parametrize(("motion", "is_near"), [((0.59, 0.0, 0.0), True), ((0.61, 0.0, 0.0), False), ((0.0, 0.0, 0.61), False)])
def test_moments_are_near_where_neither_motion_is_long(motion, is_near):
    for by_wheels, by_estimate in ((motion, np.zeros(3)), (np.zeros(3), motion)):
        assert compare_motions(START, moved(by_wheels, by_estimate))[0] is is_near


def test_suspicion_is_not_over_in_a_tight_curve():
    """A LiDAR whose yaw is 30 deg off moves as the wheels do, but for slip, over the .27 m of .6 rad at 2.25 rad/m."""
    suspicion, arc = Suspicion(START, 10.0, START[0]), np.array([0.02, 0.0, 0.045])
    now = START
    for _ in range(200):
        now = se2.compose(now, se2.exp(arc))
        assert not suspicion.is_over(20.0, now)
    for _ in range(100):
        now = se2.compose(now, np.array([0.02, 0.0, 0.0]))
    assert suspicion.is_over(20.0, now)


def test_suspicion_is_over_after_a_second_and_a_way_without_a_sign():
    suspicion = Suspicion(START, 10.0, START[0])
    far = moved((0.4, 0.0, 0.0), (0.4, 0.0, 0.0))
    assert not suspicion.is_over(10.9, far)
    assert not suspicion.is_over(20.0, START)  # stands
    assert suspicion.is_over(11.1, far)
    again = suspicion.add_sign(11.0, far)
    assert again.begin is START
    assert not again.is_over(12.5, far)


def test_departure_leaves_what_both_were_apart_by():
    near, far = moved((0.3, 0.0, 0.0), (0.3, 0.0, 0.0)), moved((0.5, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert Departure(START, True).remainder(near) is None
    np.testing.assert_allclose(Departure(START, True).remainder(far), [0.4, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(Departure(START, True, is_apart=True).remainder(near), np.zeros(3), atol=1e-12)


def test_jump_begins_before_the_estimate_went_elsewhere_and_ends_on_the_way():
    jump = Jump()
    jump.add(START, is_off=False, is_unclear=False)
    jump.add(carried := moved(np.zeros(3), (2.0, 0.0, 0.0)), is_off=True, is_unclear=False)
    assert jump.begin is START
    jump.add(on := moved((0.7, 0.0, 0.0), (0.7, 0.0, 0.0), carried), is_off=True, is_unclear=True)
    assert jump.begin is START
    jump.add(on, is_off=True, is_unclear=False)
    assert jump.begin is None


def test_slow_departure_is_no_jump():
    jump = Jump()
    jump.add(START, is_off=False, is_unclear=False)
    jump.add(moved((0.1, 0.0, 0.0), (0.3, 0.0, 0.0)), is_off=True, is_unclear=False)
    assert jump.begin is None


def test_views_are_compared_while_the_robot_is_near():
    views = PastViews()
    lidar = views.of("scan")
    places = [moved((0.11 * k, 0.0, 0.0), (0.11 * k, 0.0, 0.0)) for k in range(9)]
    for place in places:
        views.take(lidar, profile(), is_standing=False)
        views.keep(place)
        views.keep(place)  # once
    oldest, middle = views.of("scan").references(places[-1])
    np.testing.assert_array_equal(oldest.poses, places[3])
    np.testing.assert_array_equal(middle.poses, places[6])


def test_view_of_the_standing_robot_is_the_reference_until_it_leaves():
    lidar = LidarViews()
    for _ in range(3):
        lidar.add(View(START, profile()), is_standing=True)
    assert len(lidar.references(START)) == 1
    assert lidar.references(moved((0.7, 0.0, 0.0), (0.7, 0.0, 0.0))) == []
    for _ in range(3):
        lidar.add(View(START, profile()), is_standing=False)
    assert len(lidar.references(START)) == 2


def test_views_led_back_have_moved_as_the_wheels_have():
    view, now = View(START, profile()), moved((0.3, 0.1, 0.2), (0.1, 0.0, 0.0))
    back = view.led_back(now)
    np.testing.assert_allclose(difference(back.poses, now), np.zeros(3), atol=1e-12)
    np.testing.assert_array_equal(back.poses[0], START[0])


def test_objects_move_from_the_second_comparison_until_a_calm_second():
    lidar = LidarViews()
    found = []
    for k, is_moving in enumerate([True, False, True, True, False, False, False, False, False, False]):
        lidar.add_comparison(0.25 * k, 2, is_moving=is_moving)
        found.append(lidar.is_active)
    assert found == [False, False, False, True, True, True, True, False, False, False]
