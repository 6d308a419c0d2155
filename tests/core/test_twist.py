"""The twist at the end of a step: never exact, and with the gyro's rate where there is one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from localization.core.twist import SLIP_LASTS_S, fuse_turn, slip_change_cov, twist_at_end
from localization.events import Event, ImuSample, Scan
from localization.pipeline import Pipeline, Trial
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers.extended import cases
from tests.helpers.fault_drives import FaultDrive, in_room


def test_twist_at_end_is_never_exact_and_takes_the_gyros_rate():
    still, cov = twist_at_end(np.zeros(3), np.zeros((3, 3)), np.zeros(3), 0.1)
    assert not still.any()
    assert (np.sqrt(np.diagonal(cov)) >= 2e-3).all()
    mean, change = np.array([0.5, 0.0, 0.3]), np.array([0.1, 0.0, 0.2])
    twist, cov = twist_at_end(mean, np.diag([1e-2, 1e-2, 4e-2]), change, 0.1)
    assert twist == pytest.approx(mean + change)
    assert cov[2, 2] == pytest.approx(4e-3 + 1e-2 + 4e-6)
    fused, fused_cov = fuse_turn(twist, cov, 0.6, 1e-4, np.zeros((3, 3)))
    assert fused[2] == pytest.approx(0.6, abs=2e-3)
    assert 0.0 < fused_cov[2, 2] < 1e-4


SENSORS: dict[str, Callable[[Event], bool]] = {
    "wheels, gyro, LiDAR": lambda event: True,
    "wheels, LiDAR": lambda event: not isinstance(event, ImuSample),
    "wheels, gyro": lambda event: not isinstance(event, Scan),
    "wheels": lambda event: not isinstance(event, Scan | ImuSample),
}


@pytest.mark.parametrize("sensors", cases(SENSORS, usual=["wheels, gyro, LiDAR", "wheels"]))
def test_published_twist_is_consistent_under_the_noise_of_the_robot_file(sensors: str) -> None:
    """NEES per degree of freedom of the twist, and of its turn rate alone, over two drives with each set of sensors."""
    found, of_turns = [], []
    for seed in (11, 12):
        drive = in_room(seed % 3, seed)
        errors, covs = _twist_errors(drive, [event for event in drive.events if SENSORS[sensors](event)])
        found.append(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors).mean() / 3.0)
        of_turns.append((errors[:, 2] ** 2 / covs[:, 2, 2]).mean())
    assert 0.4 < np.mean(found) < 2.0
    assert 0.3 < np.mean(of_turns) < 2.0


def _twist_errors(drive: FaultDrive, events: list[Event], half_ns: int = 10_000_000) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 3) of the published twists against the true motion over 20 ms, and their covariances (n, 3, 3), after two seconds."""
    has_lidar = any(isinstance(event, Scan) for event in events)
    pipeline = Pipeline(Trial(make_model("diff_drive", drive.robot), "ekf"), drive.robot, drive.mounts, has_lidar)
    found = [e for event in events for e in pipeline.process(event) if e.stamp_ns > drive.stamps[0] + 2_000_000_000]
    stamps = np.array([e.stamp_ns for e in found])
    true = se2.log(se2.between(drive.truth(stamps - half_ns), drive.truth(stamps + half_ns))) / (2e-9 * half_ns)
    twists = [e.twist for e in found if e.twist is not None]
    return np.array(twists) - true, np.array([e.twist_covariance for e in found])


@pytest.mark.parametrize("duration", [0.02, 0.1, 1.0])
def test_change_of_slip_within_a_step_is_that_of_a_gauss_markov_process(duration: float) -> None:
    """Its mean over a step and its value at the end, by 4,000 sample paths."""
    rng, tau, dt = np.random.default_rng(0), 0.5 * SLIP_LASTS_S, 2e-3
    paths = np.empty((round(duration / dt), 4000))
    value, decay = rng.normal(size=4000) / np.sqrt(2.0 * tau), np.exp(-dt / tau)
    for k in range(len(paths)):
        value = decay * value + np.sqrt((1.0 - decay**2) / (2.0 * tau)) * rng.normal(size=4000)
        paths[k] = value
    expected = slip_change_cov(np.eye(3) * duration, duration)[0, 0]  # of a density of 1
    assert np.var(paths[-1] - paths.mean(axis=0)) == pytest.approx(expected, rel=0.12)


def test_turn_rate_changes_no_velocity_by_the_clock_of_the_wheels():
    """Wheels that speed up by 1.2 m/s^2 and .4 rad/s^2, their clock open by .1 s, and a gyro that is off by 4 deg/s."""
    twist, by_noise = np.array([0.15, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4])
    of_clock = 0.1**2 * np.outer([1.2, 0.0, 0.4], [1.2, 0.0, 0.4])
    fused, cov = fuse_turn(twist, by_noise + of_clock, -0.07, 1e-5, of_clock)
    np.testing.assert_allclose(fused[:2], twist[:2])
    assert abs(fused[2] + 0.07) < 1e-3
    assert cov[0, 0] == pytest.approx(by_noise[0, 0] + of_clock[0, 0])
    assert np.linalg.eigvalsh(cov).min() > 0.0
