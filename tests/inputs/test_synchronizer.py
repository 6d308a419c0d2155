"""From events to steps: no motion is lost, none is counted twice, and what was not heard is not claimed."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import EventError
from localization.events import CgSample, ImuSample, Scan, WheelSample
from localization.inputs.step_config import StepConfig
from localization.inputs.synchronizer import Synchronizer
from localization.inputs.wheel_buffer import WheelBuffer, WheelWindow
from localization.inputs.wheel_gaps import UnknownVelocity, VelocityWithinIntervals
from motion_models import se2
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.steps import last_steps, steps, steps_after

MS, S = 1_000_000, bags.S
T0 = bags.START
ROBOT = load_robot("vaultbot")
NAN = np.full(2, np.nan)


def wheel(t_s, position=None, velocity=None, t0=T0):
    return WheelSample(
        t0 + round(t_s * S), NAN if velocity is None else np.array(velocity, float), NAN if position is None else np.array(position, float)
    )


def scan(t_s, n=1, frame="laser"):
    return Scan(T0 + round(t_s * S), np.ones((n, 3)), frame_id=frame)


def angles(t):
    """Smooth wheel angles that turn, stop nowhere and are no straight line."""
    return 3.0 * t + 0.4 * np.sin(2.0 * t), 3.5 * t - 0.3 * np.cos(1.7 * t)


def wheels(until_s, rate=50.0, start_s=0.0, turned=angles):
    return [wheel(start_s + i / rate, turned(start_s + i / rate)) for i in range(round((until_s - start_s) * rate) + 1)]


def in_order(*groups):
    return sorted((event for group in groups for event in group), key=lambda e: (e.stamp_ns, not isinstance(e, WheelSample)))


def stepper(has_lidar=True, model="skid_steer", config=None):
    return Synchronizer(make_model(model, ROBOT), ROBOT, {"laser": Mount()}, has_lidar, config)


def cut(events, **kind):
    """All steps, and the stepper that cut them."""
    cutter = stepper(**kind)
    return list(steps(events, cutter)), cutter


def composed(found):
    pose = np.zeros(3)
    for step in found:
        pose = se2.compose(pose, step.predicted.delta)
    return pose


def whole(samples, cg=(0.0, 0.0), model="skid_steer"):
    """The motion of all samples at once, without windows: rates by differences, one preintegration."""
    stamps = np.array([s.stamp_ns for s in samples])
    positions = np.array([s.position for s in samples])
    dt = np.diff(stamps) * 1e-9
    made = make_model(model, ROBOT)
    cgs = np.broadcast_to(np.asarray(cg, float), (len(dt), 2))
    return preintegrate(made, dt, np.diff(positions, axis=0) / dt[:, None], cgs, made.nominal, ROBOT.wheel_noise)


# --- windows of the wheels' history


def history(samples, cg=(0.0, 0.0)):
    made = WheelBuffer(np.array(cg))
    for sample in samples:
        made.insert(sample)
    return made


def test_window_inside_one_interval_has_its_share():
    dt, rates, _, _, missing = history([wheel(0.0, (0, 0)), wheel(0.4, (2, 4))]).window(T0 + 100 * MS, T0 + 240 * MS, 0.5)
    assert missing == 0.0
    assert dt.sum() == pytest.approx(0.14, abs=1e-9)
    np.testing.assert_allclose(dt @ rates, [0.7, 1.4], atol=1e-9)


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.integers(0, 2**31), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_window_equals_difference_of_interpolated_angles(gaps_ms, seed, one, other):
    """A window's angles by interpolating the samples: the second way is numpy's."""
    stamps = np.concatenate([[0], np.cumsum(gaps_ms)]) * MS
    positions = np.cumsum(np.random.default_rng(seed).normal(size=(len(stamps), 2)), axis=0)
    past = history([WheelSample(T0 + int(t), NAN, q) for t, q in zip(stamps, positions, strict=True)])
    start, end = sorted((round(one * stamps[-1]), round(other * stamps[-1])))
    dt, rates, _, _, missing = past.window(T0 + start, T0 + end, 0.5)
    expected = [np.interp(end, stamps, positions[:, i]) - np.interp(start, stamps, positions[:, i]) for i in range(2)]
    np.testing.assert_allclose(dt @ rates if len(dt) else np.zeros(2), expected, atol=1e-6)
    assert dt.sum() == pytest.approx((end - start) * 1e-9, abs=1e-9)
    assert missing == 0.0
    assert (dt > 0).all()


def test_window_past_last_sample_holds_rates_for_max_hold():
    past = history([wheel(0.0, (0, 0)), wheel(0.1, (0.1, 0.2))])
    dt, rates, _, _, missing = past.window(T0, T0 + 400 * MS, 0.5)
    assert missing == 0.0
    np.testing.assert_allclose(dt @ rates, [0.4, 0.8], atol=1e-9)
    dt, rates, _, _, missing = past.window(T0, T0 + 2 * S, 0.5)
    np.testing.assert_allclose(dt @ rates, [0.6, 1.2], atol=1e-9)
    assert missing == pytest.approx(1.4)
    dt, _, _, _, missing = past.window(T0 + 5 * S, T0 + 6 * S, 0.5)
    assert len(dt) == 0
    assert missing == pytest.approx(1.0)


def test_window_before_first_sample_is_missing():
    dt, rates, _, _, missing = history([wheel(1.0, (0, 0)), wheel(1.2, (0.2, 0.2))]).window(T0, T0 + 1100 * MS, 0.5)
    assert missing == pytest.approx(1.0)
    np.testing.assert_allclose(dt @ rates, [0.1, 0.1], atol=1e-9)
    assert history([]).window(T0, T0 + S, 0.5).missing == pytest.approx(1.0)


def test_window_without_angles_uses_rates_except_over_gaps():
    past = history([wheel(0.0, velocity=(1, 2)), wheel(0.1, velocity=(3, 2)), wheel(9.1, velocity=(3, 2))])
    dt, rates, _, _, missing = past.window(T0, T0 + 9100 * MS, 0.5)
    np.testing.assert_allclose(dt @ rates, [0.2 + 1.5, 0.2 + 1.0], atol=1e-9)  # means of two samples; then held for half a second
    assert missing == pytest.approx(8.5)


def test_window_over_long_gap_with_angles_is_measured():
    dt, rates, _, inside, missing = history([wheel(0.0, (0, 0)), wheel(10.0, (20, 30))]).window(T0 + S, T0 + 10 * S, 0.5)
    np.testing.assert_allclose(dt @ rates, [18.0, 27.0])
    assert missing == 0.0
    np.testing.assert_allclose(inside, [[10.0, 1.0, 1.0]])


def test_rates_of_slow_wheels_hold_for_two_of_their_periods():
    past = history([wheel(0.9 * i, velocity=(2, 2)) for i in range(9)])
    dt, rates, _, _, missing = past.window(T0, T0 + 10 * S, 0.5)
    np.testing.assert_allclose(dt @ rates, [18.0, 18.0])
    assert missing == pytest.approx(1.0)
    assert len(past.at(T0 + 8900 * MS, 0.5)[0]) == 1


def test_window_over_gap_with_equal_angles_is_standing():
    dt, rates, _, _, missing = history([wheel(0.0, (5, 7)), wheel(10.0, (5, 7))]).window(T0, T0 + 10 * S, 0.5)
    assert missing == 0.0
    assert dt.sum() == pytest.approx(10.0)
    assert not rates.any()


def test_insert_of_sample_without_numbers_changes_nothing(recwarn):
    plain = [wheel(0.0, (0, 0)), wheel(0.2, (0.4, 0.4))]
    deaf = [plain[0], wheel(0.1), wheel(0.15, (np.inf, np.nan)), plain[1]]
    assert all(
        np.array_equal(a, b)
        for a, b in zip(history(plain).window(T0, T0 + 200 * MS, 0.5), history(deaf).window(T0, T0 + 200 * MS, 0.5), strict=True)
    )
    assert not recwarn.list


def test_insert_with_angles_of_one_side_uses_rates():
    past = history([wheel(0.0, (0.0, np.nan), (5.0, 1.0)), wheel(0.1, (0.5, np.nan), (5.0, 1.0))])
    dt, rates, _, _, missing = past.window(T0, T0 + 100 * MS, 0.5)
    np.testing.assert_allclose(dt @ rates, [0.5, 0.1], atol=1e-9)
    assert missing == 0.0


@pytest.mark.parametrize("late", [wheel(0.1, (9.0, 9.0)), wheel(0.05, (9.0, 9.0)), wheel(-3.0, (9.0, 9.0))])
def test_insert_of_repeated_or_late_samples_changes_nothing(late):
    plain = [wheel(0.0, (0, 0)), wheel(0.1, (0.1, 0.2)), wheel(0.2, (0.3, 0.4))]
    for window in [(T0, T0 + 200 * MS), (T0 + 50 * MS, T0 + 150 * MS)]:
        expected, found = history(plain).window(*window, 0.5), history([*plain[:2], late, plain[2]]).window(*window, 0.5)
        assert all(np.array_equal(a, b) for a, b in zip(expected, found, strict=True))


def test_window_keeps_the_cg_of_each_interval():
    past = WheelBuffer(np.array([0.0, 0.0]))
    for i, x in enumerate([0.0, 0.0, 0.1, 0.2]):
        past.set_cg(CgSample(T0, np.array([x, -x])))
        past.insert(wheel(0.1 * i, (i, i)))
    _, _, cg, _, _ = past.window(T0, T0 + 300 * MS, 0.5)
    np.testing.assert_allclose(cg, [[0.0, 0.0], [0.1, -0.1], [0.2, -0.2]])


def test_buffer_of_long_stream_is_bounded():
    past = WheelBuffer(np.zeros(2), keep_s=2.0)
    for i in range(20_000):
        past.insert(wheel(i / 100.0, (i, i)))
    assert len(past) <= 401
    dt, rates, _, _, missing = past.window(T0 + 198 * S, T0 + 199 * S, 0.5)  # and the last seconds are all there
    assert missing == 0.0
    np.testing.assert_allclose(dt @ rates, [100.0, 100.0])


# --- steps


def check_contiguous(found, first_ns=None):
    """No gap, no overlap, time never runs back."""
    assert found
    if first_ns is not None:
        assert found[0].start_ns == first_ns
    for step in found:
        assert step.start_ns <= step.end_ns
    for before, after in itertools.pairwise(found):
        assert before.end_ns == after.start_ns


@given(
    st.lists(st.integers(0, 3000), min_size=2, max_size=25),
    st.integers(1, 60),
    st.integers(0, 2**31),
)
@settings(max_examples=60, deadline=None)
def test_steps_cut_anywhere_sum_to_the_whole_motion(scan_ms, wheel_ms, seed):
    """Scans at any moments, wheels at any rate, events in any order of arrival within a tenth of a second."""
    samples = wheels(3.0, rate=1000.0 / wheel_ms)
    scans = [scan(t / 1000.0) for t in sorted(set(scan_ms))]
    rng = np.random.default_rng(seed)
    due = [(e.stamp_ns + (rng.integers(0, 100) * MS if isinstance(e, Scan) else 0), i, e) for i, e in enumerate([*samples, *scans])]
    arrivals: list = []
    newest = 0
    for _, _, event in sorted(due, key=lambda d: d[:2]):
        if isinstance(event, Scan):
            if event.stamp_ns < newest:
                continue  # scans stay in order among themselves
            newest = event.stamp_ns
        arrivals.append(event)
    found, _ = cut(arrivals)
    kept = [e for e in arrivals if isinstance(e, Scan)]
    check_contiguous(found)
    before = itertools.takewhile(lambda e: e is not kept[0], arrivals)
    is_lidar_late = any(e.stamp_ns > samples[0].stamp_ns + S for e in before)  # then the wheels begin
    assert found[0].start_ns == (samples if is_lidar_late else kept)[0].stamp_ns
    assert [s.scan.stamp_ns for s in found if s.scan is not None] == [e.stamp_ns for e in kept]
    assert max(s.duration for s in found) < 3.1
    start, end = found[0].start_ns, found[-1].end_ns
    inside = [s for s in samples if start < s.stamp_ns < end]
    ends = [WheelSample(t, NAN, interpolated(samples, t)) for t in (start, end)]
    if end > start and end <= samples[-1].stamp_ns:
        np.testing.assert_allclose(composed(found), whole([ends[0], *inside, ends[1]]).delta, atol=1e-9)


def interpolated(samples, stamp_ns):
    stamps = np.array([s.stamp_ns - T0 for s in samples], float)
    return np.array([np.interp(stamp_ns - T0, stamps, [s.position[i] for s in samples]) for i in range(2)])


@given(st.floats(0.001, 1.0), st.integers(5, 200))
@settings(max_examples=30, deadline=None)
def test_steps_without_lidar_use_all_wheels(step_s, wheel_ms):
    samples = wheels(3.0, rate=1000.0 / wheel_ms)
    found, _ = cut(samples, has_lidar=False, config=StepConfig(no_lidar_step_s=step_s))
    check_contiguous(found, samples[0].stamp_ns)
    assert found[-1].end_ns == samples[-1].stamp_ns
    assert all(s.duration >= step_s - 1e-9 for s in found[:-1])
    total = whole(samples)
    np.testing.assert_allclose(composed(found), total.delta, atol=1e-9)


def test_steps_cut_anywhere_have_equal_cov_and_derivatives():
    samples = wheels(2.0)
    fine, _ = cut(samples, has_lidar=False, config=StepConfig(no_lidar_step_s=0.02))
    cov, d = np.zeros((3, 3)), np.zeros((3, 11))
    for step in fine:
        A = se2.adjoint(se2.inverse(step.predicted.delta))
        cov, d = A @ cov @ A.T + step.predicted.cov, A @ d + step.predicted.d_params
    total = whole(samples)
    np.testing.assert_allclose(cov, total.cov, rtol=1e-7)  # what the velocity does between samples is not turned within a step
    np.testing.assert_allclose(d, total.d_params, rtol=1e-9, atol=1e-12)


def test_scan_waits_for_late_wheels():
    samples = wheels(1.0)
    cutter, found = stepper(), []
    for event in [*samples[:11], scan(0.0), scan(0.3)]:
        found += steps_after(event, cutter)
    assert [s.end_ns for s in found] == [T0]  # wheels were heard up to 0.2 s
    for event in samples[11:]:
        found += steps_after(event, cutter)
        if event.stamp_ns >= T0 + 300 * MS:
            break
    assert found[-1].end_ns == T0 + 300 * MS
    assert found[-1].has_wheels
    np.testing.assert_allclose(composed(found), whole([s for s in samples if s.stamp_ns <= T0 + 300 * MS]).delta, atol=1e-9)


@pytest.mark.parametrize("ns", range(1, 256, 50))
def test_scan_at_the_stamp_of_a_wheel_sample_waits_for_no_later_one(ns):
    """Stamps of today are beyond the whole numbers of a float."""
    cutter, turned = stepper(), [WheelSample(T0 + i * 20 * MS + ns, NAN, np.full(2, 0.1 * i)) for i in range(6)]
    found = [
        step for event in [*turned, Scan(T0 + 100 * MS + ns, np.ones((1, 3)), frame_id="laser")] for step in steps_after(event, cutter)
    ]
    assert [step.end_ns for step in found] == [T0 + 100 * MS + ns]


def test_missing_wheels_give_wide_covariance_and_warning():
    config = StepConfig()
    scans = [scan(0.1 * i) for i in range(1, 60)]
    found, cutter = cut(in_order(wheels(2.0), scans), config=config)
    check_contiguous(found)
    assert found[-1].end_ns == scans[-1].stamp_ns  # every scan is used, without wheels
    heard = [s for s in found if s.end_ns <= T0 + 2500 * MS]
    deaf = [s for s in found if s.start_ns >= T0 + 2500 * MS]
    assert all(s.has_wheels for s in heard)
    assert not any(s.has_wheels or s.is_standing for s in deaf)
    for step in deaf:
        assert np.sqrt(step.predicted.cov[0, 0]) >= config.lost_speed_m_s * step.duration * 0.999
        assert np.sqrt(step.predicted.cov[2, 2]) >= config.lost_rate_rad_s * step.duration * 0.999
        assert not step.predicted.delta.any()
        assert not step.twist.any()
    assert f"no wheel data for {5.9 - 2.5:.1f} s" in cutter.warnings()[-1]


@pytest.mark.parametrize(("missing_s", "is_reported"), [(0.1, False), (2.0, True)])
def test_missing_wheels_are_reported_where_more_of_the_way_is_unknown_than_by_the_wheels(missing_s, is_reported):
    """A minute of wheels, and scans that go on after their last rates have been held."""
    end_s = 60.0 + StepConfig().max_hold_s + missing_s
    _, cutter = cut(in_order(wheels(60.0), [scan(t) for t in np.linspace(0.5, end_s, 120)]))
    assert any("no wheel data" in warning for warning in cutter.warnings()) == is_reported


@pytest.mark.parametrize("scan_s", [0.05, 0.1, 0.4])
def test_missing_wheels_covariance_grows_with_time_squared(scan_s):
    """A velocity that nobody knows lasts: how far it leads does not depend on how often a scanner looks meanwhile. The variance of
    a heading that may be any is that of all from -pi to pi."""
    config = StepConfig()
    gone = [w for w in wheels(20.0, turned=lambda t: (0.1 * (t > 12.5),) * 2) if not 2.0 < (w.stamp_ns - T0) * 1e-9 < 12.99]
    found, _ = cut(in_order(gone, [scan(scan_s * i) for i in range(round(15.0 / scan_s))]))
    lost = [s for s in found if not s.has_wheels and s.end_ns <= T0 + 12_500 * MS]
    seconds = (lost[-1].end_ns - T0) * 1e-9 - 2.0 - config.max_hold_s
    assert seconds > 9.0
    variance = np.sum([np.diag(s.predicted.cov) for s in lost], axis=0)
    np.testing.assert_allclose(np.sqrt(variance[:2]), config.lost_speed_m_s * seconds, rtol=1e-6)
    assert config.lost_rate_rad_s * seconds > np.pi
    assert variance[2] == pytest.approx(np.pi**2 / 3.0)
    again = next(s for s in found if s.has_wheels and s.start_ns >= T0 + 13 * S)
    assert np.diag(again.predicted.cov).max() < 1e-3


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_velocity_within_an_interval_scatters_as_its_covariance(share):
    """Monte Carlo: velocities are random walks, and wheels have angles every 0.9 s."""
    rng, period, n, fine = np.random.default_rng(3), 0.9, 120, 30
    found, variances = [], []
    for _ in range(300):
        speeds = np.cumsum(rng.normal(scale=[0.3, 0.4], size=(n * fine, 2)) * np.sqrt(period / fine), axis=0)
        ways = np.vstack([np.zeros(2), np.cumsum(speeds, axis=0) * period / fine])
        means, before = np.diff(ways[::fine], axis=0) / period, round(share * fine)
        law = VelocityWithinIntervals(np.ones(3))
        for mean in means:
            piece = WheelWindow(np.array([period]), np.zeros((1, 2)), np.zeros((1, 2)), np.array([[period, 0.0, 1.0]]), 0.0)
            law.add(piece, np.array([[mean[0], 0.0, mean[1]]]))
        start = (n - 1) * fine
        found.append(ways[start + before] - ways[start] - means[-1] * share * period)
        part = piece._replace(dt=np.array([share * period]))
        variances.append(np.diag(law.add(part, np.array([[means[-1][0], 0.0, means[-1][1]]])))[[0, 2]])
    nees = np.array(found) ** 2 / np.array(variances)
    np.testing.assert_allclose(nees.mean(axis=0), 1.0, atol=0.25)


def test_angles_across_a_gap_leave_its_end_certain():
    """2.5 s without data between two samples that both have angles, known before the steps are cut."""
    config = StepConfig(wait_s=10.0)
    events = [w for w in wheels(5.0, turned=lambda t: (0.01 * t, 0.01 * t)) if not 1.0 < (w.stamp_ns - T0) * 1e-9 < 3.5]
    (whole_gap,) = [s for s in cut([*events, scan(0.0), scan(1.0), scan(3.5), scan(5.0)], config=config)[0] if s.end_ns == T0 + 3500 * MS]
    (half,) = [s for s in cut([*events, scan(0.0), scan(1.0), scan(2.25), scan(5.0)], config=config)[0] if s.end_ns == T0 + 2250 * MS]
    assert whole_gap.has_wheels
    assert half.has_wheels
    np.testing.assert_allclose(whole_gap.predicted.delta[0], 2.0 * half.predicted.delta[0], rtol=1e-6)
    assert whole_gap.predicted.cov[0, 0] < half.predicted.cov[0, 0]


def test_unknown_velocity_turns_from_the_last_turn_of_the_gyro_on():
    """Ten seconds with a gyro, in which any turn is known, then one without: the limit of the yaw variance is not reached."""
    velocity = UnknownVelocity(StepConfig().unknown_sigma)
    for _ in range(100):
        np.testing.assert_allclose(np.sqrt(velocity.increment(0.1, has_turn=True)[2, 2]), 0.05)
    found = np.sum([velocity.increment(0.1, has_turn=False) for _ in range(10)], axis=0)
    np.testing.assert_allclose(np.diag(found), [0.25 * (11.0**2 - 10.0**2)] * 2 + [0.25])
    velocity.lasted_s = 0.0
    np.testing.assert_allclose(np.diag(velocity.increment(0.2, has_turn=False)), 0.01)


def test_missing_wheels_with_gyro_give_its_turn_rate():
    """However long: the wheels' heading stays so uncertain that the gyro's counts."""
    imu = [ImuSample(T0 + 10 * MS * i, np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 9.81])) for i in range(2000)]
    found, _ = cut(in_order(wheels(2.0), imu, [scan(0.1 * i) for i in range(1, 195)]))
    deaf = [s for s in found if s.start_ns >= T0 + 2500 * MS]
    assert (deaf[-1].end_ns - deaf[0].start_ns) * 1e-9 * StepConfig().lost_rate_rad_s > 2.0 * np.pi
    for step in deaf:
        np.testing.assert_allclose(step.twist, [0.0, 0.0, 0.3], atol=1e-9)
        assert np.sqrt(step.predicted.cov[2, 2]) == pytest.approx(StepConfig().lost_rate_rad_s * step.duration)


def test_pose_measured_by_each_scan_makes_steps_in_a_gap_independent():
    cutter = stepper()
    found = []
    for event in in_order(wheels(2.0), [scan(0.1 * i) for i in range(1, 60)]):
        found += steps_after(event, cutter)
        cutter.feed_back(None, 0.0, is_pose_measured=True)  # as if each scan was matched
    deaf = [s for s in found if s.start_ns >= T0 + 2600 * MS]
    assert len(deaf) > 20
    for step in deaf:
        np.testing.assert_allclose(np.sqrt(np.diag(step.predicted.cov)), 0.5 * step.duration, rtol=1e-6)


def test_missing_wheels_covariance_covers_last_velocity():
    """A robot at 1 m/s is not at 0.5 m/s because its wheels' messages stop."""
    fast = 1.0 / ROBOT.geometry.wheel_radius_m
    found, _ = cut(in_order(wheels(2.0, turned=lambda t: (fast * t, fast * t)), [scan(0.1 * i) for i in range(1, 55)]))
    speed = np.hypot(*found[10].twist[:2])
    assert speed > StepConfig().lost_speed_m_s
    lost = [s for s in found if s.start_ns >= T0 + 2600 * MS]
    seconds = (lost[-1].end_ns - T0) * 1e-9 - 2.5
    sigma = np.sqrt(np.sum([s.predicted.cov[0, 0] for s in lost]))
    assert sigma == pytest.approx(speed * math.sqrt(seconds**2 - 0.1**2), rel=1e-3)


# --- scans with a duration, and the wheels' clock


def test_step_of_a_sweep_ends_at_its_middle():
    sweeps = [Scan(T0 + 100 * i * MS, np.ones((3, 3)), np.array([0.0, 0.02, 0.06])) for i in range(1, 15)]
    found, _ = cut(in_order(wheels(2.0), sweeps))
    assert [s.end_ns for s in found if s.scan is not None] == [scan.stamp_ns + 30 * MS for scan in sweeps]


def test_sweep_waits_for_wheels_until_its_middle():
    cutter, found = stepper(), []
    for event in [*wheels(0.1), Scan(T0 + 100 * MS, np.ones((2, 3)), np.array([0.0, 0.08]))]:
        found += steps_after(event, cutter)
    assert not found
    for event in wheels(0.2, start_s=0.12):
        found += steps_after(event, cutter)
    assert [s.end_ns for s in found] == [T0 + 140 * MS]


def test_sweeps_of_two_lidars_are_ordered_by_their_middles():
    early = Scan(T0 + 100 * MS, np.ones((2, 3)), np.array([0.0, 0.2]), "laser")
    late = Scan(T0 + 150 * MS, np.ones((2, 3)), np.array([0.0, 0.02]), "laser")
    found, _ = cut([*wheels(0.1), early, late, *wheels(1.0, start_s=0.12)])
    assert [s.scan for s in found if s.scan is not None] == [late, early]


@pytest.mark.parametrize("wheel_hz", [100.0, 20.0, 10.0, 5.0])
def test_d_clock_is_the_derivative_of_the_motion_by_the_shift(wheel_hz):
    """Also with one wheel sample per scan, or fewer: there too, an offset of the clocks has to be observable."""
    events, h = in_order(wheels(4.0, rate=wheel_hz), [scan(0.0171 + 0.1 * i) for i in range(30)]), 1e-4

    def shifted(offset):
        cutter = stepper()
        cutter.feed_back(None, offset)
        return list(steps(events, cutter))

    found, less, more = shifted(0.0), shifted(-h), shifted(h)
    by_difference = [se2.log(se2.between(a.predicted.delta, b.predicted.delta)) / (2 * h) for a, b in zip(less, more, strict=True)]
    np.testing.assert_allclose([s.d_clock for s in found[1:]], by_difference[1:], atol=1e-4)
    assert np.abs([s.d_clock for s in found[1:]]).max() > 0.01


def test_wheels_after_gap_are_used_again():
    samples = [w for w in wheels(8.0) if not 2.0 < (w.stamp_ns - T0) * 1e-9 < 5.0]
    found, cutter = cut(in_order(samples, [scan(0.1 * i) for i in range(1, 80)]))
    check_contiguous(found)
    assert all(s.has_wheels for s in found if s.start_ns >= T0 + 5 * S or s.end_ns <= T0 + 2 * S)
    assert not any(s.has_wheels for s in found if s.start_ns >= T0 + 2600 * MS and s.end_ns < T0 + 4600 * MS)  # then angles
    assert cutter.warnings()


def test_missing_lidar_gives_steps_by_wheels():
    samples = wheels(10.0)
    found, _ = cut(in_order(samples, [scan(0.1 * i) for i in range(1, 20)]))
    check_contiguous(found, T0 + 100 * MS)
    alone = [s for s in found if s.scan is None]
    assert {s.end_ns - s.start_ns for s in alone} == {250 * MS}
    assert samples[-1].stamp_ns - found[-1].end_ns < 250 * MS  # `finish` gives all whole steps that were left


def test_scans_before_wheels_give_steps_without_wheels():
    found, _ = cut(in_order(wheels(3.0, start_s=1.0), [scan(0.1 * i) for i in range(30)]))
    check_contiguous(found, T0)
    assert not any(s.has_wheels for s in found[1:] if s.end_ns <= T0 + S)
    assert all(s.has_wheels for s in found if s.start_ns >= T0 + S)


def test_log_without_wheels_gives_steps_by_scans():
    scans = [scan(0.1 * i) for i in range(20)]
    found, cutter = cut(scans)
    assert [s.scan for s in found] == scans
    assert not any(s.is_standing for s in found)
    assert "1.9 s" in cutter.warnings()[0]


def test_late_or_repeated_scans_keep_time_order():
    samples = wheels(3.0)
    scans = [scan(t) for t in (0.1, 0.2, 0.3, 0.25, 0.25, 0.3, 0.4, -1.0, 0.5)]
    events = [*samples[:30], *scans, *samples[30:]]
    found, cutter = cut(events)
    check_contiguous(found, T0 + 100 * MS)
    assert all(s.duration >= 0.0 for s in found)
    end = found[-1].end_ns
    expected = whole(
        [s for s in samples if T0 + 100 * MS <= s.stamp_ns <= end]
        + ([] if (end - T0) % (20 * MS) == 0 else [WheelSample(end, NAN, interpolated(samples, end))])
    )
    np.testing.assert_allclose(composed(found), expected.delta, atol=1e-9)
    assert "3 scans came after later ones" in cutter.warnings()[0]


def test_finish_keeps_time_order():
    cutter = stepper()
    found = [s for e in [*wheels(0.1), scan(0.05), scan(0.5), scan(0.4)] for s in steps_after(e, cutter)] + list(last_steps(cutter))
    check_contiguous(found, T0 + 50 * MS)
    assert found[-1].end_ns == T0 + 500 * MS


@pytest.mark.parametrize("order", [lambda e: e[::-1], lambda e: e + e, lambda e: [x for x in e for _ in range(2)]])
def test_events_in_any_order_give_ordered_steps(order):
    imus = [ImuSample(T0 + i * 10 * MS, np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 9.81])) for i in range(300)]
    events = order(in_order(wheels(3.0), [scan(0.1 * i) for i in range(30)], imus))
    found, _ = cut(events)
    check_contiguous(found)
    assert all(np.isfinite(s.predicted.delta).all() and np.isfinite(s.predicted.cov).all() for s in found)


@pytest.mark.parametrize("late_s", [0.04, -0.04])
def test_clock_offset_shifts_the_wheels_window(late_s):
    """Wheels whose stamps are late by so much give the same motion once the stepper knows it."""
    true = [WheelSample(w.stamp_ns, NAN, w.position) for w in wheels(4.0)]
    late = [WheelSample(w.stamp_ns + round(late_s * S), NAN, w.position) for w in true]
    scans = [scan(0.5 + 0.1 * i) for i in range(20)]
    expected, _ = cut(in_order(true, scans))
    cutter = stepper()
    cutter.feed_back(None, late_s)
    found = list(steps(in_order(late, scans), cutter))
    uncorrected, _ = cut(in_order(late, scans))
    scanned = [[s.predicted.delta for s in steps_ if s.scan is not None] for steps_ in (expected, found, uncorrected)]
    np.testing.assert_allclose(scanned[1], scanned[0], atol=1e-12)
    assert np.abs(np.array(scanned[2]) - scanned[0]).max() > 1e-4


@pytest.mark.parametrize("late_s", [-0.6, -0.4, 0.4])
def test_clock_offset_makes_no_scan_late(late_s):
    """Wheels that are stamped much too early must not take the time past a scan that has not come yet."""
    cutter = stepper()
    cutter.feed_back(None, late_s)
    scans = [scan(0.5 + 0.3 * i) for i in range(20)]
    found = list(steps(in_order(wheels(8.0), scans), cutter))
    assert [s.scan for s in found if s.scan is not None] == scans
    assert not any("came after later ones" in note for note in cutter.warnings())


@pytest.mark.parametrize("model", ["diff_drive", "skid_steer", "full_linear"])
def test_d_clock_equals_numeric_differences(model):
    """Inside the wheels' intervals the motion is smooth in the offset; both ends lie there."""
    samples, h = wheels(3.0, rate=20.0), 1e-4
    by_offset = {}
    for offset in (-h, 0.0, h):
        cutter = stepper(model=model)
        cutter.feed_back(None, offset)
        by_offset[offset] = list(steps(in_order(samples, [scan(0.525), scan(0.875), scan(1.325)]), cutter))[1:3]
    for minus, at, plus in zip(*(by_offset[o] for o in (-h, 0.0, h)), strict=True):
        numerical = se2.log(se2.between(minus.predicted.delta, plus.predicted.delta)) / (2.0 * h)
        np.testing.assert_allclose(at.d_clock, numerical, rtol=1e-5, atol=1e-6)
        assert np.abs(at.d_clock).max() > 1e-2  # the drive does tell the offset


def test_is_standing_needs_wheel_data_without_motion():
    def turned(t):
        return (0.0, 0.0) if t < 1.0 else (t - 1.0, t - 1.0) if t < 2.0 else (1.0, 1.0)

    found, _ = cut(in_order(wheels(4.0, turned=turned), [scan(0.1 * i) for i in range(46)]))
    for step in found[1:]:
        start, end = ((t - T0) * 1e-9 for t in (step.start_ns, step.end_ns))
        if end <= 0.99 or (start >= 2.01 and end <= 4.4):
            assert step.is_standing
            assert not step.predicted.cov.any()
            assert not step.d_clock.any()
        elif end > 1.02 and start < 1.98:
            assert not step.is_standing
    assert not found[0].is_standing  # of length zero: no wheel was asked


def test_twist_of_step_is_that_of_its_end():
    found, _ = cut(in_order(wheels(3.0, rate=200.0), [scan(0.1 * i) for i in range(1, 25)]), model="diff_drive")
    model = make_model("diff_drive", ROBOT)
    for step in found[1:]:
        t = (step.end_ns - T0) * 1e-9
        rates = (np.array(angles(t)) - np.array(angles(t - 1e-5))) / 1e-5
        np.testing.assert_allclose(step.twist, model.twist(rates, np.zeros(2), model.nominal).value, atol=0.02)


@pytest.mark.parametrize("scan_s", [0.0, -0.1, 0.1])
def test_twist_of_first_scan_is_that_of_its_moment(scan_s):
    """Scans are swept from their stamp on, and the wheels of a robot that moves already tell how only by two samples."""
    cutter, model = stepper(model="diff_drive"), make_model("diff_drive", ROBOT)
    turned = lambda t: (3.0 * t, 3.5 * t)  # noqa: E731
    assert not list(steps_after(scan(scan_s), cutter))
    samples = wheels(0.2, turned=turned)
    first = next(step for sample in samples for step in steps_after(sample, cutter))
    assert first.duration == 0.0
    assert first.has_wheels
    np.testing.assert_allclose(first.twist, model.twist(np.array([3.0, 3.5]), np.zeros(2), model.nominal).value, atol=1e-9)


def test_feed_back_holds_from_the_next_step():
    cutter = stepper(model="diff_drive", has_lidar=False)
    other = make_model("diff_drive", ROBOT).nominal * [1.1, 1.3]
    found = []
    for event in wheels(2.0):
        for step in steps_after(event, cutter):
            cutter.feed_back(other, 0.0)
            found.append(step)
    before, after = stepper(model="diff_drive", has_lidar=False), stepper(model="diff_drive", has_lidar=False)
    after.feed_back(other, 0.0)
    expected = list(steps(wheels(2.0), before))[:1] + list(steps(wheels(2.0), after))[1:]
    for one, two in zip(found, expected, strict=False):
        np.testing.assert_array_equal(one.predicted.delta, two.predicted.delta)
    assert len(found) > 10


def test_uncertain_cg_widens_the_prediction():
    events = wheels(1.0)
    plain, _ = cut(events, has_lidar=False)
    known = CgSample(T0, np.zeros(2), np.diag([1e-4, 1e-4]))
    found, _ = cut([known, *events], has_lidar=False)
    for one, other in zip(plain, found, strict=True):
        np.testing.assert_array_equal(one.predicted.delta, other.predicted.delta)
        assert np.linalg.eigvalsh(other.cov - one.cov).min() > -1e-15
        assert np.trace(other.cov) > np.trace(one.cov)


def test_empty_scans_give_steps_and_warning():
    found, cutter = cut(in_order(wheels(2.0), [scan(0.1 * i, n=i % 2) for i in range(1, 15)]))
    assert sum(s.scan is not None for s in found) == 14
    assert "7 scans without a usable point" in cutter.warnings()[0]


def test_scans_of_unknown_frame_are_reported_and_not_mixed():
    ahead = wheels(2.0, turned=lambda t: (3.0 * t, 3.0 * t))
    known, strange = [scan(0.1 * i) for i in range(1, 8)], [scan(0.1 * i, frame="top") for i in range(8, 15)]
    found, cutter = cut(in_order(ahead, known, strange))
    assert [s.scan for s in found if s.scan is not None] == known
    assert found[-1].end_ns > strange[-1].stamp_ns
    (note,) = cutter.warnings()
    assert "frame 'top'" in note
    assert "7 scans of it were not used" in note
    assert "[mounts.top]" in note
    assert cutter.scans.frames.problem is not None
    # where none is known, they are all there is
    found, cutter = cut(in_order(ahead, strange))
    assert sum(s.scan is not None for s in found) == 7
    (note,) = cutter.warnings()
    assert "7 scans of it were taken as if from the body's origin" in note
    # the first of them may come before any other
    found, cutter = cut(in_order(ahead, [scan(0.05, frame="top")], known, strange))
    assert sum(s.scan is not None for s in found) == 8
    assert ["1 scan of it was taken" in note or "7 scans of it were not used" in note for note in cutter.warnings()] == [True, True]


def test_scans_without_times_are_reported_where_robot_turns():
    timed = [replace(scan(0.1 * i), offsets=np.zeros(1)) for i in range(1, 15)]
    spin = wheels(2.0, turned=lambda t: (-3.0 * t, 3.0 * t))
    (note,) = cut(in_order(spin, [scan(0.1 * i) for i in range(1, 15)]))[1].warnings()
    assert "14 scans without the times" in note
    assert cut(in_order(spin, timed))[1].warnings() == []
    assert cut(in_order(wheels(2.0, turned=lambda t: (3.0, 3.0)), [scan(0.1 * i) for i in range(1, 15)]))[1].warnings() == []


@pytest.mark.extended
def test_synchronizer_of_long_stream_is_bounded():
    """Ten minutes: what is remembered is seconds, however long it runs."""
    cutter, most = stepper(), 0
    for i in range(600 * 20):
        t = i / 20.0
        events = [wheel(t, (t, 1.1 * t)), ImuSample(T0 + round(t * S), np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 9.81]))]
        if i % 2 == 0:
            events.append(scan(t))
        for event in events:
            for _ in steps_after(event, cutter):
                pass
        most = max(most, len(cutter.wheels.buffer) + len(cutter.inertial.gyro) + len(cutter.scans.waiting))
    assert most <= 2 * (20 * 20 + 1) + 8


def test_step_length_is_zero_only_at_the_first_scan():
    found, _ = cut(in_order(wheels(2.0), [scan(0.1 * i) for i in range(1, 15)]))
    assert found[0].duration == 0.0
    assert found[0].turn is None
    assert not found[0].predicted.delta.any()
    assert all(s.duration > 0.0 for s in found[1:])
    assert math.isclose(sum(s.duration for s in found), (found[-1].end_ns - found[0].start_ns) * 1e-9)


# --- events that nobody can use


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WheelSample(7, NAN, np.zeros(4)), "WheelSample at 7 ns: position has shape (4,); it must be an array of shape (2,)"),
        (lambda: WheelSample(7, [1.0, 1.0], NAN), "velocity is a list; it must be an array of shape (2,)"),
        (lambda: CgSample(7, np.array([np.nan, 0.0])), "CgSample at 7 ns: position holds nan; it must be finite"),
        (lambda: CgSample(7, np.zeros(3)), "position has shape (3,)"),
        (lambda: CgSample(7, np.zeros(2), np.eye(3)), "covariance has shape (3, 3)"),
        (lambda: CgSample(7, np.zeros(2), np.diag([np.inf, 1.0])), "covariance holds inf"),
        (lambda: CgSample(7, np.zeros(2), np.diag([1e-4, -1e-6])), "covariance is [[0.0001, 0.0], [0.0, -1e-06]]; it must be symmetric"),
        (lambda: CgSample(7, np.zeros(2), np.array([[1e-4, 1e-5], [0.0, 1e-4]])), "it must be symmetric"),
        (lambda: CgSample(7, np.zeros(2), np.array([[1e-4, 2e-4], [2e-4, 1e-4]])), "symmetric, no variance negative"),
        (lambda: Scan(7, np.ones((5, 2))), "Scan at 7 ns: points has shape (5, 2); it must be an array of shape (5, 3)"),
        (lambda: Scan(7, np.ones((5, 3)), np.zeros(4)), "offsets has shape (4,); it must be an array of shape (5,)"),
        (lambda: Scan(7, np.ones((5, 3)), np.full(5, np.nan)), "offsets holds nan"),
        (lambda: ImuSample(7, np.full(3, np.nan), np.zeros(3)), "ImuSample at 7 ns: angular_velocity holds nan; it must be finite"),
        (lambda: ImuSample(7, np.zeros(3), np.array([0.0, 0.0, np.inf])), "linear_acceleration holds inf"),
    ],
)
def test_event_with_unusable_numbers_is_refused(make, message):
    with pytest.raises(EventError, match=re.escape(message)):
        make()


@given(st.floats(0.0, math.pi), st.floats(-12.0, 6.0), st.floats(0.0, 1.0))
def test_event_with_rounded_covariance_is_accepted(turn, magnitude, flatness):
    c, s = math.cos(turn), math.sin(turn)
    half = np.array([[c, -s], [s, c]]) * 10.0**magnitude * [1.0, flatness]
    covariance = (half @ half.T) * (1.0 + 1e-12 * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    assert CgSample(T0, np.zeros(2), covariance).covariance is covariance
