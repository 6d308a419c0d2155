"""The gyro's turn: the integral of the rate about the body's upright axis, whichever way the IMU was screwed on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from localization.events import ImuSample
from localization.inputs.gyro import GyroBuffer
from motion_models.robot import GyroNoise, Mount
from tests.helpers import bags

MS, S, T0 = 1_000_000, bags.S, bags.START
NOISE = GyroNoise()
UP = np.array([0.0, 0.0, 1.0])


def rate(t):
    """Yaw rate of the body [rad/s]: both ways, never still."""
    return 0.6 * math.sin(0.8 * t) + 0.25


def turned(t):
    """Its integral."""
    return 0.75 * (1.0 - math.cos(0.8 * t)) + 0.25 * t


def samples(seconds, body_R_imu=None, gravity=9.81, hz=100.0, start_s=0.0, frame="imu_link", wz=rate):
    """IMU samples of a robot that turns in the plane, as an IMU sees it whose axes stand in the body like ``body_R_imu`` (3, 3)."""
    R = np.eye(3) if body_R_imu is None else body_R_imu
    return [
        ImuSample(T0 + round((start_s + i / hz) * S), R.T @ (wz(start_s + i / hz) * UP), R.T @ (gravity * UP), frame)
        for i in range(round(seconds * hz) + 1)
    ]


def history(events, mounts=None, noise=NOISE):
    made = GyroBuffer(noise, mounts or {})
    for event in events:
        made.insert(event)
    return made


def turns(events, mounts=None, window_s=0.1, wheels=lambda a, b: turned(b) - turned(a)):
    """(start, end, turn) of windows asked for as the samples come, and the history."""
    made, found, start = GyroBuffer(NOISE, mounts or {}), [], 0.0
    for event in events:
        made.insert(event)
        end = start + window_s
        if event.stamp_ns >= T0 + round(end * S):
            found.append((start, end, made.turn(T0 + round(start * S), T0 + round(end * S), wheels(start, end))))
            start = end
    return found, made


def check_all_right(found, from_s=0.3, tolerance=2e-5):
    """Every turn is there from ``from_s`` on, and true in size and sign."""
    late = [(a, b, t) for a, b, t in found if a >= from_s]
    assert late
    for start, end, turn in late:
        assert turn is not None
        assert turn.angle == pytest.approx(turned(end) - turned(start), abs=tolerance)


@given(st.integers(1, 5_000), st.integers(1, 5_000))
@settings(max_examples=50, deadline=None)
def test_gyro_turn_equals_integral_of_rate(one_ms, other_ms):
    start, end = sorted((one_ms, other_ms))
    turn = history(samples(5.0, hz=200.0)).turn(T0 + start * MS, T0 + end * MS, 0.0)
    assert turn.angle == pytest.approx(turned(end / 1e3) - turned(start / 1e3), abs=1e-4)
    assert turn.duration == pytest.approx((end - start) / 1e3)


@given(st.lists(st.tuples(st.integers(1, 400), st.floats(-1, 1)), min_size=2, max_size=40), st.floats(0, 1), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_gyro_turn_of_any_stamps_sums_trapezoids(profile, one, other):
    """And turns of two windows that touch add up to that of both."""
    stamps = np.cumsum([dt for dt, _ in profile]) * MS
    rates = np.array([wz for _, wz in profile])
    past = history([ImuSample(T0 + int(t), wz * UP, 9.81 * UP) for t, wz in zip(stamps, rates, strict=True)])
    areas = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(stamps) * 1e-9)])
    span = stamps[-1] - stamps[0]
    start, end = sorted(int(stamps[0]) + round(float(f * span)) for f in (one, other))
    middle = (start + end) // 2
    expected = np.interp(end, stamps, areas) - np.interp(start, stamps, areas)
    whole, first, second = (past.turn(T0 + a, T0 + b, 0.0) for a, b in ((start, end), (start, middle), (middle, end)))
    assert whole.angle == pytest.approx(expected, abs=1e-9)
    assert first.angle + second.angle == pytest.approx(whole.angle, abs=1e-9)


def test_gyro_variance_grows_with_time_without_scale():
    """The scale is a state of the filter: its error is the same in all turns."""
    turn = history(samples(5.0)).turn(T0 + S, T0 + 3 * S, 0.0)
    assert abs(turn.angle) > 0.5
    assert turn.variance == pytest.approx(NOISE.white_rad_per_sqrt_s**2 * 2.0, rel=1e-3)


@pytest.mark.parametrize("white", [1e-5, 1e-3])
def test_gyro_variance_covers_what_the_rate_does_between_samples(white):
    """A yaw that moves at random, sampled at 50 Hz; with a gyro that hardly has noise, and one that has some."""
    rng, hz = np.random.default_rng(4), 50
    yaw = np.cumsum(rng.normal(0.0, 2e-3 / math.sqrt(10 * hz), 10 * hz * 400))[::10]
    rates = np.gradient(yaw, 1.0 / hz) + white * math.sqrt(hz) * rng.normal(size=len(yaw))
    stamps = [T0 + round(i / hz * S) for i in range(len(yaw))]
    made = GyroBuffer(GyroNoise(white_rad_per_sqrt_s=white, scale_sigma=0.0), {}, keep_s=1e4)
    for stamp, wz in zip(stamps, rates, strict=True):
        made.insert(ImuSample(stamp, wz * UP, 9.81 * UP, "imu"))
    squares = []
    for a in range(10, len(yaw) - 20, 10):
        turn = made.turn(stamps[a], stamps[a + 10], 0.0)
        squares.append((turn.angle - (yaw[a + 10] - yaw[a])) ** 2 / turn.variance)
    assert 0.8 < np.mean(squares) < 1.2


def test_gyro_rate_at_the_end_has_the_scatter_of_the_samples():
    """Interpolated between samples; that of the newest sample, with its age, after it."""
    rng = np.random.default_rng(0)
    made = history(samples(4.0, wz=lambda t: rate(t) + 5e-3 * rng.normal()))
    found = [made.turn(T0 + S, T0 + 2 * S + i * 13 * MS, 0.0) for i in range(100)]
    errors = [turn.rate - rate(1.0 + turn.duration) for turn in found]
    assert np.std(errors) == pytest.approx(np.mean([math.sqrt(turn.rate_variance) for turn in found]), rel=0.35)
    assert all(turn.rate_age_s == 0.0 for turn in found)
    late = made.turn(T0 + S, T0 + 4 * S + 30 * MS, 0.0)
    assert late.rate_age_s == pytest.approx(0.03)
    assert late.rate == made.turn(T0 + S, T0 + 4 * S, 0.0).rate


def test_gyro_turn_outside_samples_is_none():
    past = history(samples(1.0, start_s=1.0))
    assert past.turn(T0 + 900 * MS, T0 + 1500 * MS, 0.0) is None
    assert past.turn(T0 + 1500 * MS, T0 + 2200 * MS, 0.0) is None
    assert GyroBuffer(NOISE, {}).turn(T0, T0 + S, 0.0) is None
    held = past.turn(T0 + 1900 * MS, T0 + 2050 * MS, 0.0)  # a sample or two that are still on their way
    assert held.angle == pytest.approx(turned(2.0) - turned(1.9) + 0.05 * rate(2.0), abs=1e-5)


def test_gyro_gap_is_bridged_only_if_short():
    constant = samples(4.0, wz=lambda t: 0.3)
    short = [s for s in constant if not 2.0 < (s.stamp_ns - T0) * 1e-9 < 2.4]
    assert history(short).turn(T0 + S, T0 + 3 * S, 0.0).angle == pytest.approx(0.6, abs=1e-9)
    long = [s for s in constant if not 2.0 < (s.stamp_ns - T0) * 1e-9 < 2.6]
    past = history(long)
    assert past.turn(T0 + S, T0 + 3 * S, 0.0) is None
    assert past.turn(T0 + 2500 * MS, T0 + 3 * S, 0.0) is None
    assert past.turn(T0 + 2600 * MS, T0 + 3 * S, 0.0).angle == pytest.approx(0.12, abs=1e-9)


def spoiled(wild, hz=100.0):
    """Four seconds of turning by 0.5 rad/s, with other samples in the place of those that ``wild`` [rad/s] says by index."""
    return [
        ImuSample(s.stamp_ns, wild[i] * UP, s.linear_acceleration, s.frame_id) if i in wild else s
        for i, s in enumerate(samples(4.0, hz=hz, wz=lambda t: 0.5))
    ]


@pytest.mark.parametrize("hz", [10.0, 100.0, 400.0])
@pytest.mark.parametrize("wild", [{20: 30.0}, {20: -30.0, 21: 30.0, 22: -30.0}, {20: 12.0, 22: 12.0, 24: 12.0, 27: -12.0, 28: -12.0}])
def test_gyro_spikes_are_left_out_and_reported(wild, hz):
    past = history(spoiled(wild, hz))
    assert past.turn(T0, T0 + 4 * S, 0.0).angle == pytest.approx(2.0, abs=1e-9)
    (note,) = past.warnings()
    assert note.startswith(f"IMU 'imu_link': {len(wild)} reading{'s' * (len(wild) > 1)} dropped")
    # meanwhile the last rate that was believed holds
    begun = spoiled(wild, hz)[: min(wild) + 1]
    assert history(begun).turn(T0, begun[-1].stamp_ns, 0.0).angle == pytest.approx(0.5 * 20 / hz, abs=1e-9)


def test_gyro_lasting_jump_is_used_from_its_begin():
    past = history(samples(4.0, wz=lambda t: 12.0 if 2.0 <= t < 3.0 else 0.0))
    assert past.turn(T0, T0 + 4 * S, 0.0).angle == pytest.approx(12.0)
    assert past.warnings() == []


@pytest.mark.parametrize("hz", [10.0, 100.0])
def test_gyro_spike_at_the_begin_is_left_out(hz):
    past = history(spoiled({0: 30.0}, hz))
    assert past.turn(T0, T0 + S, 0.0) is None
    assert past.turn(T0 + round(S / hz), T0 + 4 * S, 0.0).angle == pytest.approx(0.5 * (4.0 - 1.0 / hz), abs=1e-9)
    (note,) = past.warnings()
    assert "1 reading dropped" in note


@pytest.mark.parametrize("late", [[100], [100, 100], [0, 100], [37, 12], [4000]])
def test_gyro_late_and_repeated_samples_change_nothing(late):
    events = samples(1.0)
    wrong = [ImuSample(T0 + 500 * MS - i * MS, 9.0 * UP, 9.81 * UP, "imu_link") for i in late]
    found = history([*events[:51], *wrong, *events[51:]]).turn(T0, T0 + S, 0.0)
    assert found == history(events).turn(T0, T0 + S, 0.0)
    first = [events[0], events[0], *events[1:]]
    assert history(first).turn(T0, T0 + S, 0.0) == history(events).turn(T0, T0 + S, 0.0)


@given(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5), st.floats(-math.pi, math.pi))
@settings(max_examples=40, deadline=None)
def test_gyro_with_true_mount_gives_yaw_rate(roll, pitch, yaw):
    """The rotation by an independent library; no turn of the wheels is needed."""
    R = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    found, past = turns(samples(2.0, R), {"imu_link": Mount(roll=roll, pitch=pitch, yaw=yaw)}, wheels=lambda a, b: 0.0)
    check_all_right(found, 0.0)
    assert past.warnings() == []


def test_gyro_mounts_are_taken_by_frame():
    tipped = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    mounts = {"other": Mount(), "imu_link": Mount(roll=math.pi / 2)}
    check_all_right(turns(samples(2.0, tipped), mounts, wheels=lambda a, b: 0.0)[0], 0.0)


WRONG = {
    "rolled by 90 deg": (Rotation.from_euler("x", 90, degrees=True).as_matrix(), 9.81, Mount()),
    "pitched by -90 deg": (Rotation.from_euler("y", -90, degrees=True).as_matrix(), 9.81, Mount()),
    "upside down": (Rotation.from_euler("x", 180, degrees=True).as_matrix(), 9.81, Mount()),
    "gravity's sign wrong": (np.eye(3), -9.81, Mount()),
    "rolled, and gravity's sign wrong": (Rotation.from_euler("x", 90, degrees=True).as_matrix(), -9.81, Mount()),
    "askew": (Rotation.from_euler("xyz", [50, -35, 20], degrees=True).as_matrix(), 9.81, Mount()),
    "the mount is upside down, the IMU is not": (np.eye(3), 9.81, Mount(roll=math.pi)),
}


@pytest.mark.parametrize("case", WRONG)
def test_gyro_mount_against_gravity_is_corrected(case):
    body_R_imu, gravity, mount = WRONG[case]
    found, past = turns(samples(12.0, body_R_imu, gravity), {"imu_link": mount})
    sworn = [t for _, _, t in found if t is not None]
    told = next(i for i, (a, _, t) in enumerate(found) if t is not None and a > 0.3)
    check_all_right(found[told:], 0.0)
    assert len(sworn) > 80
    by_then = sum(abs(turned(b) - turned(a)) for a, b, _ in found[2 : told + 1])
    assert 0.4 < by_then < 0.7  # it waits for half a radian of turning by the wheels, and not longer
    if case == "gravity's sign wrong":  # the mount is right
        assert past.warnings() == []
        return
    (note,) = past.warnings()
    assert "imu_link" in note
    assert "contradicts gravity" in note
    axis = [float(number) for number in note[note.index("[") + 1 : note.index("]")].split(",")]
    np.testing.assert_allclose(axis, body_R_imu.T @ UP, atol=0.006)


def test_gyro_sign_is_found_with_noisy_wheels():
    rng = np.random.default_rng(1)
    body_R_imu, gravity, mount = WRONG["rolled, and gravity's sign wrong"]
    found, _ = turns(
        samples(12.0, body_R_imu, gravity), {"imu_link": mount}, wheels=lambda a, b: 1.8 * (turned(b) - turned(a)) + 0.02 * rng.normal()
    )
    check_all_right(found, 4.0)


def test_gyro_with_unknown_sign_gives_no_turn():
    body_R_imu, _, _ = WRONG["upside down"]
    found, past = turns(samples(5.0, body_R_imu), wheels=lambda a, b: 0.001)
    assert all(t is None for a, _, t in found if a > 0.3)
    (note,) = past.warnings()
    assert "turned too little" in note


@pytest.mark.parametrize("gravity", [0.0, 1.0, 981.0])
def test_gyro_without_gravity_uses_the_mount(gravity):
    """Drivers that publish no acceleration, or one in other units, say nothing of the mount."""
    found, past = turns(samples(3.0, gravity=gravity), {"imu_link": Mount()}, wheels=lambda a, b: 0.0)
    check_all_right(found, 0.0)
    assert past.warnings() == []
    tipped = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    found, past = turns(samples(3.0, tipped, gravity=gravity), {"imu_link": Mount(roll=math.pi)}, wheels=lambda a, b: 0.0)
    check_all_right(found, 0.0)


@pytest.mark.parametrize("degrees", [10.0, -10.0])
def test_gyro_on_slope_of_ten_degrees_uses_the_mount(degrees):
    """Gravity alone cannot tell a slope from a mount: the mount holds, and the scale is off by the cosine."""
    R = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    found, past = turns(samples(3.0, R), {"imu_link": Mount()}, wheels=lambda a, b: 0.0)
    assert past.warnings() == []
    for start, end, turn in found:
        assert turn.angle == pytest.approx(math.cos(math.radians(10.0)) * (turned(end) - turned(start)), abs=2e-5)


def test_gyro_with_vibration_uses_the_mount():
    rng = np.random.default_rng(0)
    shaken = [
        ImuSample(s.stamp_ns, s.angular_velocity, s.linear_acceleration + rng.normal([1.5, 0.0, 0.0], 2.0), s.frame_id)
        for s in samples(3.0)
    ]
    assert history(shaken).warnings() == []


def test_buffer_of_long_stream_is_bounded():
    past = GyroBuffer(NOISE, {}, keep_s=2.0)
    for sample in samples(120.0):
        past.insert(sample)
    assert len(past) <= 401
    turn = past.turn(T0 + 118_100 * MS, T0 + 119 * S, 0.0)
    assert turn.angle == pytest.approx(turned(119.0) - turned(118.1), abs=1e-4)


def test_gyro_frame_change_measures_the_sign_anew():
    """The axis of the first IMU was found by the wheels; that of the second one, upside down as well, is still unknown."""
    upside_down = WRONG["upside down"][0]
    found, past = turns(samples(12.0, upside_down))
    assert found[-1][2] is not None
    for sample in samples(2.0, upside_down, start_s=20.0, frame="other"):
        past.insert(sample)
    assert past.turn(T0 + 21 * S, T0 + 22 * S, 0.0) is None
    assert "turned too little" in past.warnings()[-1]


@pytest.mark.parametrize("apart_s", [0.0, 0.005])
def test_gyro_two_imus_on_one_topic_use_the_first(apart_s):
    mounts = {"a": Mount(), "b": Mount(roll=math.pi)}
    a, b = samples(4.0, frame="a"), samples(4.0, np.diag([1.0, -1.0, -1.0]), start_s=apart_s, frame="b", wz=lambda t: rate(t) + 0.1)
    past = history(sorted([*a, *b], key=lambda sample: sample.stamp_ns), mounts)
    assert past.turn(T0 + S, T0 + 3 * S, 0.0) == history(a, mounts).turn(T0 + S, T0 + 3 * S, 0.0)
    assert past.warnings() == ["IMU frames 'a' and 'b' on one topic: only 'a' is used."]


def test_gyro_frame_that_replaces_a_silent_one_is_used():
    a, b = samples(4.0, frame="a"), samples(6.0, start_s=4.1, frame="b")
    past = history([*a, *b])
    assert past.turn(T0 + 7 * S, T0 + 8 * S, 0.0).angle == pytest.approx(turned(8.0) - turned(7.0), abs=2e-5)
    assert past.warnings() == []


def test_gyro_late_samples_do_not_check_the_mount():
    """Two samples upright, then eighteen times an old one with gravity along another axis, then on."""
    events = samples(1.0)
    tipped = ImuSample(events[0].stamp_ns, np.zeros(3), 9.81 * np.array([1.0, 0.0, 0.0]), "imu_link")
    past = history([*events[:2], *[tipped] * 18, *events[2:]])
    assert past.turn(T0, T0 + S, 0.0) == history(events).turn(T0, T0 + S, 0.0)
    assert past.warnings() == []
