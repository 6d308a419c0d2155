"""Links, rows and compiled small matrices: each against another way to the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import EstimatorError
from localization.estimators.graph_factors import Pairs, linearize, whitening
from localization.estimators.graph_link import Link, check_covariance, first_link
from localization.estimators.graph_qr import inverse_of_upper, triangularize
from localization.estimators.graph_robust import Closure, Kernel, Position
from localization.residuals import motion_residual, position_residual
from motion_models import se2
from motion_models.base import Motion
from motion_models.integrate import preintegrate
from motion_models.registry import make_model
from motion_models.robot import load_robot

ROBOT = load_robot("husky_a200")
seeds = st.integers(0, 10_000)


def random_cov(rng, n: int, size: float = 0.05):
    a = rng.normal(size=(n, n)) * size
    return a @ a.T + 1e-4 * size * np.eye(n)


def random_link(rng, m: int, rows: int = 2) -> Link:
    return Link(
        rng.normal(size=3),
        random_cov(rng, 3),
        rng.normal(size=(3, m)),
        rng.normal(size=m) * 0.1,
        rng.normal(size=(rows, m)),
        rng.normal(size=rows),
        0.2,
        0.1,
    )


def whitened(pair: Pairs, pose_a, slow_a, pose_b, slow_b):
    """The residuals of one pair by the formulas of `Link`'s text, nonlinear."""
    white, at = pair.white[0], pair.at[0]
    measured = se2.compose(pair.delta[0], se2.exp(pair.d_slow[0] @ (slow_a - at)))
    moved = white @ se2.log(se2.between(measured, se2.between(pose_a, pose_b)))
    about = pair.rows[0] @ (slow_a - at) - pair.rhs[0]
    walk = pair.walk[0] @ (slow_b - slow_a)
    body_T_believed = se2.exp(pair.mount[0] @ slow_a)
    by_lidar = se2.between(se2.compose(pose_a, body_T_believed), se2.compose(pose_b, body_T_believed))
    seen = pair.seen_white[0] @ se2.log(se2.between(pair.seen[0], by_lidar))
    return np.concatenate([moved, about, walk, seen])


@given(seeds, st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_rows_are_the_derivatives_of_the_residuals(seed, m):
    rng = np.random.default_rng(seed)
    pair = Pairs.one(random_link(rng, m), np.tril(rng.normal(size=(m, m))) + 2 * np.eye(m)).seeing(
        Motion(rng.normal(size=3), random_cov(rng, 3)), rng.integers(0, 2) * rng.normal(size=(3, m))
    )
    poses, slow = rng.normal(size=(2, 3)), rng.normal(size=(2, m)) * 0.1
    poses[1] = se2.compose(poses[0], se2.compose(pair.delta[0], se2.exp(rng.normal(size=3) * 0.3)))
    rows = linearize(pair, poses, slow)[0]
    n, h = 3 + m, 1e-6

    def at(change):
        a, b = change[:n], change[n:]
        return whitened(
            pair, se2.compose(poses[0], se2.exp(a[:3])), slow[0] + a[3:], se2.compose(poses[1], se2.exp(b[:3])), slow[1] + b[3:]
        )

    numeric = np.column_stack([(at(h * e) - at(-h * e)) / (2 * h) for e in np.eye(2 * n)])
    scale = np.abs(numeric).max()
    assert rows[:, :-1] == pytest.approx(numeric, abs=1e-6 * scale)
    assert rows[:, -1] == pytest.approx(-at(np.zeros(2 * n)), abs=1e-9 * scale)


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_positions_and_closures_too(seed):
    rng = np.random.default_rng(seed)
    pose, lever, xy = rng.normal(size=3), rng.normal(size=2), rng.normal(size=2)
    error, d_pose = position_residual(pose, lever, xy)
    h = 1e-6
    numeric = [
        (
            position_residual(se2.compose(pose, se2.exp(h * e)), lever, xy)[0]
            - position_residual(se2.compose(pose, se2.exp(-h * e)), lever, xy)[0]
        )
        / (2 * h)
        for e in np.eye(3)
    ]
    assert d_pose == pytest.approx(np.column_stack(numeric), abs=1e-8)
    assert error == pytest.approx(se2.transform(pose, lever) - xy)
    none = Kernel("none")
    assert Position(xy, np.eye(2), lever).linearize(pose, none) == pytest.approx(np.column_stack([d_pose, -error]))
    poses = rng.normal(size=(3, 3))
    e, a, b = motion_residual(poses[0], poses[2], pose)
    assert Closure(0, 2, pose, np.eye(3)).linearize(poses, none) == pytest.approx(np.column_stack([a, b, -e]))


@given(seeds, st.sampled_from(["skid_steer", "diff_drive", "icr", "full_linear"]))
@settings(max_examples=30, deadline=None)
def test_two_links_are_the_link_of_both_spans(seed, name):
    rng = np.random.default_rng(seed)
    model = make_model(name, ROBOT)
    dt, wheels, cg = np.full(20, 0.02), rng.normal(3.0, 3.0, size=(20, 2)), rng.normal(size=(20, 2)) * 0.02
    m = len(model.nominal)

    def link(part: slice) -> Link:
        motion = preintegrate(model, dt[part], wheels[part], cg[part], model.nominal, ROBOT.wheel_noise)
        return first_link(motion.delta, motion.cov, motion.d_params, np.zeros(m), 0.2, 0.2)

    both, one = link(slice(0, 9)).then(link(slice(9, 20))), link(slice(0, 20))
    assert both.delta == pytest.approx(one.delta, abs=1e-12)
    assert both.cov == pytest.approx(one.cov, abs=1e-11)
    assert both.d_slow == pytest.approx(one.d_slow, abs=1e-12)


@given(seeds, st.integers(1, 4), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_observing_is_conditioning_the_joint_gaussian(seed, m, r):
    """Of the perturbation and the slow states together, with any prior on the latter, by the textbook formula."""
    rng = np.random.default_rng(seed)
    link = random_link(rng, m, 0)
    link = Link(np.zeros(3), 1e-6 * link.cov, link.d_slow, link.at, link.rows, link.rhs, 1.0, 1.0)  # small, so that SE(2) is flat
    H, G, variances = rng.normal(size=(r, 3)), rng.normal(size=(r, m)), rng.uniform(0.5, 2.0, size=r) * 1e-8
    prior = random_cov(rng, m, 1e-4)
    D = link.d_slow
    # x = D s + w: joint covariance of (x, s), and the measurement z = H x + G s + noise
    P = np.block([[D @ prior @ D.T + link.cov, D @ prior], [prior @ D.T, prior]])
    J = np.hstack([H, G])
    z = rng.normal(size=r) * 1e-4
    S = J @ P @ J.T + np.diag(variances)
    mean, cov = P @ J.T @ np.linalg.solve(S, z), P - P @ J.T @ np.linalg.solve(S, J @ P)

    found = link.observe(z, H, G, variances)
    rows, rhs = found.compressed()
    information = np.linalg.inv(prior) + rows.T @ rows
    slow_cov = np.linalg.inv(information)
    slow = slow_cov @ rows.T @ rhs
    assert slow == pytest.approx(mean[3:], rel=1e-5, abs=1e-9)
    assert slow_cov == pytest.approx(cov[3:, 3:], rel=1e-5, abs=1e-14)
    x = se2.log(found.delta) + found.d_slow @ slow
    assert x == pytest.approx(mean[:3], rel=1e-3, abs=3e-7)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov))[:3, :3])  # of each entry: small correlations are no smaller to round
    assert (found.cov + found.d_slow @ slow_cov @ found.d_slow.T) / scale == pytest.approx(cov[:3, :3] / scale, abs=2e-3)


@given(seeds, st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_a_link_says_the_same_wherever_it_is_expanded(seed, m):
    rng = np.random.default_rng(seed)
    link = random_link(rng, m)
    at = link.at + rng.normal(size=m) * 1e-4
    moved = link.rebased(at)
    for slow in (at, at + rng.normal(size=m) * 1e-4):
        by_link = se2.compose(link.delta, se2.exp(link.d_slow @ (slow - link.at)))
        by_moved = se2.compose(moved.delta, se2.exp(moved.d_slow @ (slow - moved.at)))
        assert by_moved == pytest.approx(by_link, abs=1e-6)
        assert moved.rows @ (slow - moved.at) - moved.rhs == pytest.approx(link.rows @ (slow - link.at) - link.rhs, abs=1e-12)


@given(seeds, st.integers(1, 9), st.integers(2, 9))
@settings(max_examples=30, deadline=None)
def test_compiled_matrices_agree_with_lapack(seed, n, rows):
    rng = np.random.default_rng(seed)
    cov = random_cov(rng, n, 1.0) + 0.1 * np.eye(n)
    W = whitening(cov)
    assert pytest.approx(np.linalg.inv(cov), rel=1e-8, abs=1e-8) == W.T @ W
    A = rng.normal(size=(rows + n, n + 1))
    work = A.copy()
    triangularize(work, n)
    assert np.tril(work[:, :n], -1) == pytest.approx(0.0, abs=1e-12)
    assert work.T @ work == pytest.approx(A.T @ A, abs=1e-10)
    R = work[:n, :n]
    assert inverse_of_upper(R) @ R == pytest.approx(np.eye(n), abs=1e-6)


def test_kernels_bound_what_an_outlier_can_do():
    sizes = np.array([0.5, 3.0, 10.0, 1000.0])
    pull = {name: [Kernel(name, 3.0).weight(s) ** 2 * s for s in sizes] for name in ("none", "huber", "cauchy")}
    assert pull["none"] == pytest.approx(sizes)
    assert pull["huber"] == pytest.approx([0.5, 3.0, 3.0, 3.0])
    assert pull["cauchy"][3] < 0.01


@pytest.mark.parametrize(
    "cov",
    [
        np.diag([1.0, -1e-3, 1.0]),
        np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.full((3, 3), np.nan),
        np.eye(2),
    ],
)
def test_what_is_no_covariance_is_refused(cov):
    with pytest.raises(EstimatorError):
        check_covariance(cov, 3, "this")


def test_singular_covariances_are_covariances():
    check_covariance(np.zeros((3, 3)), 3, "standing still")
    v = np.array([1.0, 2.0, 3.0])
    check_covariance(np.outer(v, v), 3, "one direction")
