"""Dead reckoning: the covariance that the centre of gravity adds to it."""

import numpy as np
import pytest

from localization.estimators.baselines import DeadReckoning
from localization.events import Step
from motion_models import se2
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot

MODEL = make_model("skid_steer", load_robot("vaultbot"))
S = 1_000_000_000
N = 100
RATES = np.linspace([-2.0, 2.5], [2.0, 3.0], N)
CG = np.array([0.05, 0.01])


def dead_reckoning(n_steps, cg_cov):
    """Estimate after 10 s in ``n_steps`` steps; ``cg_cov`` (2, 2), or one for each step."""
    estimator, dt = DeadReckoning(), np.full(N // n_steps, 10.0 / N)
    for i, (rates, cov) in enumerate(zip(np.split(RATES, n_steps), np.broadcast_to(cg_cov, (n_steps, 2, 2)), strict=True)):
        motion = preintegrate(MODEL, dt, rates, CG, MODEL.nominal, WheelNoise())
        ends = i * 10 * S // n_steps, (i + 1) * 10 * S // n_steps
        estimate = estimator.step(Step(*ends, motion, np.zeros(3), np.zeros(3), False, True, cg_cov=cov))
    return estimate


@pytest.mark.parametrize("cg_cov", [np.array([[4e-4, 1e-4], [1e-4, 1e-4]]), np.diag([1e-4, 0.0]), np.full((2, 2), 1e-4)])
def test_sigma_of_an_uncertain_cg_does_not_depend_on_steps(cg_cov):
    whole, cut = dead_reckoning(1, cg_cov), dead_reckoning(N, cg_cov)
    np.testing.assert_allclose(cut.pose, whole.pose, atol=1e-12)
    np.testing.assert_allclose(cut.covariance, whole.covariance, rtol=1e-9, atol=1e-15)


def test_covariance_of_an_uncertain_cg_is_that_of_moved_cgs():
    cg_cov, h = np.array([[4e-4, 1e-4], [1e-4, 1e-4]]), 1e-6
    dt = np.full(N, 10.0 / N)
    deltas = [[preintegrate(MODEL, dt, RATES, CG + s * h * e, MODEL.nominal, WheelNoise()).delta for s in (-1, 1)] for e in np.eye(2)]
    by_cg = np.stack([se2.log(se2.between(*pair)) / (2.0 * h) for pair in deltas], axis=-1)
    added = dead_reckoning(N, cg_cov).covariance - dead_reckoning(N, np.zeros((2, 2))).covariance
    np.testing.assert_allclose(added, by_cg @ cg_cov @ by_cg.T, rtol=1e-5, atol=1e-9)


def test_covariance_does_not_shrink_when_the_cg_becomes_known():
    sizes = np.where(np.arange(N) < N // 2, 1e-4, 0.0)
    assert dead_reckoning(N, sizes[:, None, None] * np.eye(2)).covariance[2, 2] > dead_reckoning(N, np.zeros((2, 2))).covariance[2, 2]
