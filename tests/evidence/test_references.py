"""Clock, scale and axes of references against the motion by the sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from localization.evaluation.references import ReferenceTrack
from localization.evidence.references import compare_reference
from localization.evidence.signals import position_noise
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray


def _drive(seed: int = 3, duration_s: float = 90.0) -> Trajectory:
    """Maneuvers of 1.5 to 5 s: straight, turns both ways, arcs and halts."""
    rng = np.random.default_rng(seed)
    n = int(duration_s * 20)
    twists = np.zeros((n, 3))
    at = 0
    while at < n:
        end = at + int(rng.uniform(30, 100))
        twists[at:end, 0] = rng.choice([0.0, 0.0, 0.4, 0.8])
        twists[at:end, 2] = rng.choice([0.0, 0.6, -0.6, -0.3])
        at = end
    poses = [np.zeros(3)]
    for step in se2.exp(twists / 20.0):
        poses.append(se2.compose(poses[-1], step))
    return Trajectory(1_700_000_000 * 10**9 + 50_000_000 * np.arange(n + 1), np.array(poses))


DRIVE = _drive()


def _reference(period: int = 4, noise_m: float = 0.005, has_yaws: bool = True, drive: Trajectory = DRIVE) -> ReferenceTrack:
    """In a plane of its own, turned by 2 rad."""
    poses = se2.compose(np.array([5.0, -3.0, 2.0]), drive.poses[::period])
    noise = np.random.default_rng(1).normal(0.0, noise_m, (len(poses), 2))
    return ReferenceTrack(drive.stamps_ns[::period], poses[:, :2] + noise, se2.wrap_angle(poses[:, 2]) if has_yaws else None)


def _sentence(reference: ReferenceTrack) -> str:
    (found,) = compare_reference(reference, [DRIVE]).sentences
    return found


@pytest.mark.parametrize("noise_m", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("has_yaws", [True, False])
def test_reference_that_agrees_has_no_contradiction(noise_m, has_yaws):
    assert compare_reference(_reference(noise_m=noise_m, has_yaws=has_yaws), [DRIVE]).sentences == ()
    slow = replace(DRIVE, poses=DRIVE.poses * [0.85, 0.85, 1.0])
    assert compare_reference(_reference(noise_m=noise_m, has_yaws=has_yaws), [slow]).sentences == ()


@pytest.mark.parametrize("has_yaws", [True, False])
@pytest.mark.parametrize(("offset_s", "words"), [(18.0, "18.0 s ahead"), (-18.0, "18.0 s behind"), (0.7, "0.7 s ahead"), (37.0, "TAI")])
def test_reference_of_another_clock_is_named_with_its_offset(offset_s, words, has_yaws):
    reference = _reference(has_yaws=has_yaws)
    found = _sentence(replace(reference, stamps_ns=reference.stamps_ns + round(offset_s * 1e9)))
    assert words in found
    assert ("GPS time" in found) == (abs(offset_s) == 18.0)


@pytest.mark.parametrize(("scale", "words"), [(1000.0, "scale is 1000"), (100.0, "centimetres"), (2.0, "scale is 2")])
def test_reference_in_another_unit_is_named_with_its_scale(scale, words):
    reference = _reference()
    assert words in _sentence(replace(reference, positions=scale * reference.positions))


def test_reference_with_mirrored_axes_is_named():
    ned = _reference(has_yaws=False)
    assert "mirrored" in _sentence(replace(ned, positions=ned.positions[:, ::-1]))
    left = _reference()
    assert "mirrored" in _sentence(replace(left, positions=left.positions * [1, -1], yaws=-left.yaws))


def test_reference_with_clockwise_headings_is_named():
    reference = _reference()
    assert "clockwise" in _sentence(replace(reference, yaws=-reference.yaws))


@pytest.mark.parametrize("has_yaws", [True, False])
def test_reference_of_another_run_is_named(has_yaws):
    assert "another run" in _sentence(_reference(drive=_drive(seed=8), has_yaws=has_yaws))


@pytest.mark.parametrize("seed", [31, 32, 33, 34])
def test_reference_of_a_straight_drive_by_gps_is_not_accused(seed: int) -> None:
    """Errors of GPS of a metre that last for ten seconds; a straight way shows neither axes nor clock."""
    rng = np.random.default_rng(seed)
    n = 1200
    poses = np.zeros((n, 3))
    poses[:, 0] = 0.05 * np.arange(n) * rng.uniform(0.5, 1.0)
    poses[:, 2] = 0.001 * np.cumsum(rng.normal(size=n))
    drive = Trajectory(DRIVE.stamps_ns[0] + 50_000_000 * np.arange(n), poses)
    wander = np.zeros((n, 2))
    for k in range(1, n):
        wander[k] = 0.995 * wander[k - 1] + rng.normal(0.0, 0.1, 2)
    shown = replace(drive, poses=np.column_stack([poses[:, :2] + wander, poses[:, 2]]))
    assert compare_reference(_reference(period=8, noise_m=0.05, has_yaws=False, drive=shown), [drive]).sentences == ()


def test_reference_of_two_faults_names_both() -> None:
    reference = _reference()
    both = replace(reference, positions=1000.0 * reference.positions, stamps_ns=reference.stamps_ns + 18 * 10**9)
    found = " ".join(compare_reference(both, [DRIVE]).sentences)
    assert "millimetres" in found
    assert "GPS time" in found


def test_reference_whose_times_were_spread_has_no_clock() -> None:
    reference = _reference()
    late = replace(reference, stamps_ns=reference.stamps_ns + 700_000_000, has_times=False)
    assert not any("clock is" in text for text in compare_reference(late, [DRIVE]).sentences)


def test_reference_comparison_counts_the_run_that_agrees_best():
    wrong = replace(DRIVE, poses=_drive(seed=8).poses)
    assert compare_reference(_reference(), [wrong, DRIVE]).sentences == ()


def test_reference_of_hardly_any_motion_is_not_judged():
    still = replace(DRIVE, poses=0.01 * DRIVE.poses)
    assert "hardly moves" in compare_reference(_reference(), [still]).reason
    assert compare_reference(_reference(), [still]).sentences == ()


@pytest.mark.extended
@pytest.mark.parametrize(("rate", "words"), [(0.01, "faster"), (-0.01, "slower")])
def test_reference_whose_clock_runs_at_another_rate_is_named(rate, words):
    reference = _reference()
    begin = reference.stamps_ns[0]
    later = begin + np.round((1.0 + rate) * (reference.stamps_ns - begin)).astype(np.int64)
    found = " ".join(compare_reference(replace(reference, stamps_ns=later), [DRIVE]).sentences)
    assert f"% {words}" in found


@pytest.mark.parametrize("degrees", [90.0, -90.0, 170.0, 30.0])
def test_reference_whose_body_points_elsewhere_is_named(degrees):
    reference = _reference()
    side = "left" if degrees > 0.0 else "right"
    found = _sentence(replace(reference, yaws=se2.wrap_angle(reference.yaws + np.radians(degrees))))
    assert f"{abs(degrees):.0f} deg {side}" in found


def test_reference_of_inverse_poses_is_named():
    inverse = se2.inverse(np.column_stack([_reference().positions, _reference().yaws]))
    found = _sentence(replace(_reference(), positions=inverse[:, :2], yaws=inverse[:, 2]))
    assert "inverse" in found


def _found_noise(positions: FloatArray, sigma_m: float, outliers: float = 0.0) -> tuple[float, float]:
    """Mean of `position_noise` over 200 draws, and its standard error [m]; a share of ``outliers`` is off by some 10 m."""
    rng, found = np.random.default_rng(0), []
    for _ in range(200):
        far = (rng.uniform(size=(len(positions), 1)) < outliers) * rng.normal(0.0, 10.0, positions.shape)
        found.append(position_noise(positions + rng.normal(0.0, sigma_m, positions.shape) + far))
    return float(np.mean(found)), float(np.std(found, ddof=1)) / np.sqrt(200.0)


@pytest.mark.parametrize("sigma_m", [0.005, 0.3])
def test_position_noise_of_a_steady_turn_is_that_drawn(sigma_m: float) -> None:
    """1 m/s on a circle of 1.5 m, by a reference of 20 Hz."""
    angles = np.arange(1000) / 20.0 / 1.5
    mean, error = _found_noise(1.5 * np.column_stack([np.cos(angles), np.sin(angles)]), sigma_m)
    assert mean == pytest.approx(sigma_m, abs=3.0 * error)


@pytest.mark.parametrize(("period", "sigma_m", "largest"), [(1, 0.005, 1.02), (4, 0.02, 1.05), (10, 0.02, 1.25), (20, 0.3, 1.1)])
def test_position_noise_hardly_counts_that_speeds_change(period: int, sigma_m: float, largest: float) -> None:
    mean, error = _found_noise(_reference(period=period, noise_m=0.0).positions, sigma_m)
    assert sigma_m - 3.0 * error < mean < largest * sigma_m


@pytest.mark.parametrize("sigma_m", [0.005, 0.3])
def test_position_noise_with_outliers_is_a_quantile_of_the_others(sigma_m: float) -> None:
    """One outlier of 100 positions is in 4 of 100 third differences: the median of all is a higher quantile of the others."""
    mean, error = _found_noise(np.zeros((1000, 2)), sigma_m, outliers=0.01)
    assert mean == pytest.approx(sigma_m * norm.ppf(0.5 + 0.25 / 0.99**4) / norm.ppf(0.75), abs=3.0 * error)


@pytest.mark.parametrize("seed", [3, 11])
def test_prism_on_a_robot_that_turns_in_place_is_of_the_same_run(seed: int) -> None:
    """The point moves while the robot does not: its speed is not that of base_link."""
    n = 600
    twists = np.zeros((n, 3))
    for at in range(0, n, 60):
        twists[at : at + 20, 0] = 0.4
        twists[at + 20 : at + 60, 2] = np.random.default_rng(seed + at).choice([0.7, -0.7])
    poses = [np.zeros(3)]
    for step in se2.exp(twists / 20.0):
        poses.append(se2.compose(poses[-1], step))
    drive = Trajectory(DRIVE.stamps_ns[: n + 1], np.array(poses))
    point = replace(drive, poses=se2.compose(drive.poses, np.array([-0.5, 0.2, 0.0])))
    assert compare_reference(_reference(has_yaws=False, drive=point), [drive]).sentences == ()
    other = replace(drive, poses=_drive(seed + 1).poses[: n + 1])
    assert compare_reference(_reference(has_yaws=False, drive=other), [drive]).sentences != ()
