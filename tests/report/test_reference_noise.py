"""Summary of scores against a reference with noise of its own: errors below it are not ranked."""

import dataclasses
import re

import numpy as np
import pytest

from localization.evaluation.references import ReferenceTrack, with_noise
from localization.evaluation.scores import score
from localization.report.summary import verdict
from localization.trajectory import Trajectory
from motion_models import se2
from tests.helpers.report import run, track

SIGMA_M = 0.6
NOISE_M = SIGMA_M * np.sqrt(2.0)


def gps(sigma_m: float = SIGMA_M) -> ReferenceTrack:
    """Positions with independent noise of ``SIGMA_M``, and covariances of ``sigma_m``."""
    exact = track(yaws=False)
    noise = np.random.default_rng(7).normal(scale=SIGMA_M, size=exact.positions.shape)
    return with_noise(dataclasses.replace(exact, positions=exact.positions + noise), sigma_m, 0.0)


def runs(odometry_m: float, ekf_m: float) -> list:
    return [run("diff_drive", "odometry", noise=odometry_m), run("diff_drive", "ekf", noise=ekf_m)]


def test_position_noise_is_root_mean_square_of_its_covariances():
    assert gps().position_noise_m == pytest.approx(NOISE_M)
    assert track().position_noise_m is None


def test_summary_of_errors_below_the_noise_ranks_none():
    text = verdict(score(runs(0.2, 0.002), gps()), gps())
    assert "cannot be seen with /ground_truth/odom, by its own covariances" in text
    assert "% less" not in text
    assert "Use ekf" not in text
    assert "takes a reference of less noise" in text


def test_summary_of_errors_above_the_noise_ranks_them():
    text = verdict(score(runs(3.0, 2.0), gps()), gps())
    assert "cannot be seen" not in text
    assert "% less than dead reckoning" in text


def test_summary_noise_hides_the_best_run_but_not_the_others():
    text = verdict(score(runs(3.0, 0.002), gps()), gps())
    assert "% less than dead reckoning" in text
    assert "Use ekf" in text
    assert "Errors below 0.849 m cannot be seen" in text


def test_summary_of_covariances_too_large_takes_the_errors_found():
    text = verdict(score(runs(3.0, 0.002), gps(sigma_m=10.0)), gps(sigma_m=10.0))
    assert "Errors below 0.797 m" in text
    assert "by its own covariances of 14.1 m" in text
    assert "% less than dead reckoning" in text


@pytest.mark.extended
@pytest.mark.parametrize(
    ("jitter_m", "drift_m", "expected"), [(0.1, 0.0, "consistent"), (0.0, 0.6, "overconfident"), (0.1, 1.2, "overconfident")]
)
def test_summary_takes_the_scatter_of_a_reference_without_covariances_as_its_noise(jitter_m: float, drift_m: float, expected: str):
    """A slow error of the estimate is none."""
    rng = np.random.default_rng(11)
    exact = track()
    jitter = rng.normal(scale=jitter_m, size=exact.positions.shape)
    reference = dataclasses.replace(exact, positions=exact.positions + jitter, yaws=exact.yaws + 0.1 * rng.normal(scale=jitter_m, size=400))
    one = run("diff_drive", "ekf", nis=rng.chisquare(3, size=400))
    slow = np.column_stack([drift_m * np.sin(np.linspace(0.0, 6.0, 400)), np.zeros((400, 2))])
    poses = se2.compose(one.trajectory.poses, slow)
    small = np.broadcast_to(np.diag([0.02, 0.02, 0.005]) ** 2, (400, 3, 3)) * np.linspace(0.01, 1.0, 400)[:, None, None]
    one = dataclasses.replace(one, trajectory=Trajectory(one.trajectory.stamps_ns, poses, small))
    results = score([one], reference)
    assert f"covariances are {expected}" in verdict(results, reference)
    scatter = results[0].scatter_nees
    if scatter is not None and jitter_m:
        assert scatter.sigma_m == pytest.approx(jitter_m, rel=0.1)
        assert ("poses of the reference scatter" in verdict(results, reference)) == (expected == "consistent")


def test_summary_of_a_prism_compares_runs_at_its_point():
    """On curves of both directions; dead reckoning drifts by 5 cm, the lever is 41 cm."""
    first = runs(0.05, 0.002)
    stamps, t = first[0].trajectory.stamps_ns, np.linspace(0.0, 40.0, len(first[0].trajectory.stamps_ns))
    heading = 2.0 * np.sin(0.4 * t) + 0.3 * t
    steps = 0.05 * np.column_stack([np.cos(heading), np.sin(heading)])
    truth = np.column_stack([np.cumsum(steps, axis=0), heading])
    found = []
    for each, noise in zip(first, (0.05, 0.002), strict=True):
        off = np.random.default_rng(4).normal(size=truth.shape) * [noise, noise, 0.1 * noise]
        found.append(dataclasses.replace(each, trajectory=Trajectory(stamps, se2.compose(truth, off), each.trajectory.covariances)))
    prism = ReferenceTrack(stamps, se2.compose(truth, np.array([0.4, -0.1, 0.0]))[:, :2], source="prism.csv")
    text = verdict(score(found, prism), prism)
    assert "prism.csv is of a point 0.40" in text
    assert re.search(r"ekf with diff_drive is best: [1-9][.\d]* mm position error", text)
    less = re.search(r"(\d+) % less than dead reckoning", text)
    assert less is not None
    assert int(less[1]) > 80
