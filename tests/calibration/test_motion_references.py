"""Scan matching as the reference of calibration and diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, Span, TrackMotionReference, Wheels
from localization.calibration.windows import WindowConfig, cut
from localization.evaluation.references import ReferenceTrack
from localization.events import ImuSample, Scan, WheelSample
from localization.inputs.wheel_buffer import WheelBuffer
from localization.simulation.world import WORLDS
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import GyroNoise
from motion_models.robot_file import load_robot
from tests.helpers.rooms import scan_from

_NS = 1_000_000_000
_START, _END = np.array([-1.0, 0.5, 0.2]), np.array([-0.6, 0.6, 0.5])


def _span(seed: int, noise: float = 0.012, bias: float = 0.0) -> Span:
    """One window of a second in the hall; all ranges have noise of their own, and are longer by ``bias`` [m]."""
    rng = np.random.default_rng(seed)
    robot = load_robot("vaultbot")
    wheels = Wheels(WheelBuffer(np.zeros(2)), make_model("diff_drive", robot), robot.wheel_noise)
    reference = LidarMotionReference({}, 0.9)
    for i in range(56):
        wheels.buffer.insert(WheelSample(i * _NS // 50, np.full(2, np.nan), 0.05 * i * np.array([0.8, 1.2])))
    walls = WORLDS["hall"]().walls
    for second, pose in ((0, _START), (1, _END)):
        planar = scan_from(walls, pose, rng, noise, beams=180)
        planar *= 1.0 + bias / np.linalg.norm(planar, axis=1, keepdims=True)
        found = list(reference.spans(Scan(second * _NS, np.column_stack([planar, np.zeros(len(planar))])), wheels))
    return found[0]


@pytest.mark.extended
def test_the_slope_of_ranges_is_what_longer_ranges_do_to_the_measured_motion():
    true = (_span(0, 0.0, 0.1).measured - _span(0, 0.0, -0.1).measured) / 0.2
    slopes = np.array([s.range_slope for s in map(_span, range(40)) if s.range_slope is not None])
    assert len(slopes) == 40
    assert np.abs(slopes[:, :2].mean(axis=0) - true[:2]).max() < 0.25 * np.linalg.norm(true[:2])
    # noise of the slope would count as information about the bias, and make it look smaller
    assert slopes[:, :2].std(axis=0).max() < 0.25 * np.linalg.norm(true[:2])


def test_gyro_reference_variance_includes_the_scale():
    """Calibration has no state for the gyro's scale: its error is part of each measured turn."""
    robot, noise = load_robot("vaultbot"), GyroNoise(scale_sigma=0.01)
    wheels = Wheels(WheelBuffer(np.zeros(2)), make_model("diff_drive", robot), robot.wheel_noise)
    reference = GyroMotionReference(noise, {}, 1.0)
    found = []
    for i in range(120):
        wheels.buffer.insert(WheelSample(i * _NS // 100, np.full(2, np.nan), np.zeros(2)))
        found += list(reference.spans(ImuSample(i * _NS // 100, np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.0, 9.81])), wheels))
    assert found[0].cov[2, 2] == pytest.approx(noise.white_rad_per_sqrt_s**2 + (0.01 * 0.8) ** 2)


@pytest.mark.parametrize(("stop_s", "acceleration"), [(3.3, 1e3), (1.4, 1e3), (3.3, 0.25)])
def test_gyro_reference_measures_its_bias_where_no_wheel_turns(stop_s: float, acceleration: float) -> None:
    """A small robot whose gyro is biased and 0.1 s late turns in place and stops, at times of windows of 2 s or between: a wheel that rolls
    by less than a millimetre turns it by a degree, and no stop of 1.4 s fills a window."""
    robot, bias = load_robot("turtlebot3_burger"), 0.01
    half, radius = 0.5 * robot.geometry.track_width_m, robot.geometry.wheel_radius_m
    t, period = 0.02 * np.arange(3000), 4.0 + stop_s
    wanted = np.where(t % period < 4.0, 0.5, 0.0) * np.where(t // period % 2, -1.0, 1.0)
    rates = np.zeros(3000)
    for k in range(1, 3000):
        rates[k] = rates[k - 1] + np.clip(wanted[k] - rates[k - 1], -0.02 * acceleration, 0.02 * acceleration)
    wheels = np.outer(np.cumsum(rates) * 0.02 * half / radius, [-1.0, 1.0])
    events: list[WheelSample | ImuSample] = []
    for k in range(3000):
        events.append(WheelSample(k * _NS // 50, np.full(2, np.nan), wheels[k]))
        events.append(ImuSample(k * _NS // 50, np.array([0.0, 0.0, rates[max(k - 5, 0)] + bias]), np.array([0.0, 0.0, 9.81]), "base_link"))
    reference = GyroMotionReference(robot.gyro_noise, {}, 2.0)
    found = cut(events, reference, make_model("diff_drive", robot), robot, WindowConfig(window_s=2.0))
    assert "the gyro's bias is +0.01000 rad/s" in found.warnings[0]


def test_wheels_standstill_leaves_out_how_far_clocks_may_differ() -> None:
    """Wheels that stand from 4 s on: by a clock that is 0.3 s late they stand from 4.3 s on."""
    robot = load_robot("husky_a200")
    wheels = Wheels(WheelBuffer(np.zeros(2), keep_s=100.0), make_model("diff_drive", robot), robot.wheel_noise)
    for i in range(1001):
        wheels.buffer.insert(WheelSample(i * _NS // 100, np.full(2, np.nan), np.full(2, max(4.0 - 0.01 * i, 0.0))))
    assert wheels.standstill(0, 4 * _NS) is None
    assert wheels.standstill(3 * _NS, 5 * _NS) == pytest.approx((4.3 * _NS, 4.7 * _NS), abs=2e7)
    assert wheels.standstill(5 * _NS, 7 * _NS) == pytest.approx((4.7 * _NS, 6.7 * _NS), abs=2e7)


def _spans_of(reference: TrackMotionReference, seconds: float) -> list[Span]:
    robot = load_robot("husky_a200")
    wheels = Wheels(WheelBuffer(np.zeros(2), keep_s=100.0), make_model("diff_drive", robot), robot.wheel_noise)
    found = []
    for i in range(round(50 * seconds) + 1):
        sample = WheelSample(i * _NS // 50, np.ones(2), np.full(2, 0.02 * i))
        wheels.buffer.insert(sample)
        found += list(reference.spans(sample, wheels))
    return found


def test_track_reference_covariance_is_that_of_two_poses() -> None:
    """A reference that drives along the plane's y, 2 m a window, with 3 mm of noise along it, 5 mm across and 2 mrad: by simulation."""
    stamps = np.arange(101, dtype=np.int64) * (_NS // 10)
    poses = np.column_stack([np.zeros(101), stamps / _NS, np.full(101, np.pi / 2.0)])
    cov = np.diag([0.005, 0.003, 0.002]) ** 2
    track = ReferenceTrack(stamps, poses[:, :2], poses[:, 2], np.broadcast_to(cov, (101, 3, 3)))
    span = _spans_of(TrackMotionReference(track, 2.0), 4.5)[0]
    rng = np.random.default_rng(0)
    start, end = (poses[[0]] + rng.normal(0.0, np.sqrt(np.diag(cov)), (20_000, 3)) + [0.0, ahead, 0.0] for ahead in (0.0, 2.0))
    errors = se2.between(span.measured, se2.between(start, end))
    assert np.sqrt(np.diagonal(span.cov)) == pytest.approx(errors.std(axis=0), rel=0.03)


@pytest.mark.parametrize("given", [None, (0.002, 0.001)])
def test_track_reference_given_sigmas_go_before_its_covariances(given: tuple[float, float] | None) -> None:
    """Covariances that are of some poses alone leave those of others to the default."""
    stamps = np.arange(101, dtype=np.int64) * (_NS // 10)
    covariances = np.full((101, 3, 3), np.nan)
    covariances[:50] = np.eye(3)
    track = ReferenceTrack(stamps, np.zeros((101, 2)), np.zeros(101), covariances)
    first, *_, last = _spans_of(TrackMotionReference(track, 2.0, given), 9.5)
    expected = (1.0, 0.01) if given is None else (given[1], given[1])
    assert [first.cov[2, 2], last.cov[2, 2]] == pytest.approx([2.0 * sigma**2 for sigma in expected], rel=0.02)


def test_track_reference_without_covariances_names_the_option() -> None:
    stamps = np.arange(101, dtype=np.int64) * (_NS // 10)
    track = ReferenceTrack(stamps, np.zeros((101, 2)), np.zeros(101), source="/mocap")
    assert "/mocap has no covariances" in TrackMotionReference(track, 2.0).warnings()[0]
    assert "20 mm and 0.57 deg; give their noise with --reference-sigma" in TrackMotionReference(track, 2.0).warnings()[0]
    assert TrackMotionReference(track, 2.0, (0.02, 0.01)).warnings() == []
