"""The graph's back ends: each against dense least squares or another back end, and whatever may be handed to them."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from localization.errors import EstimatorError
from localization.estimators import graph_history
from localization.estimators.graph import Block, Incremental, IndeterminateError, chain, marginals, solve
from localization.estimators.graph_node import Node, SingularError
from localization.estimators.graph_robust import Closure
from localization.estimators.graph_window import Window
from localization.gyro import Turn
from motion_models import se2
from motion_models.base import Motion
from tests.graph_help import feed, make, recorded, run
from tests.synthetic_steps import DT, Noise, Seer, straight
from tests.test_graph_factors import whitened

SURE = np.diag([0.02, 0.02, 0.01]) ** 2
GPS = 0.05**2 * np.eye(2)


@pytest.fixture(scope="module")
def steps():
    return recorded(seed=5, steps=40)


PLAIN = {"form": "none", "learn": ()}  # learns nothing by which steps are cut: the same steps are right for whatever it believes


@pytest.fixture(scope="module")
def plain_steps():
    return recorded(seed=6, steps=40, **PLAIN)


def graph(**config):
    seer = Seer()
    return make("graph", seer, **config), seer


def fed(steps, **config):
    estimator, seer = graph(**config)
    return estimator, feed(estimator, seer, steps)


def moments(steps):
    return [step.end_ns for step, _ in steps]


def true_position(steps, i):
    """What a good GPS would say there: the pose by wheels and LiDAR, moved a little."""
    _, found = fed(steps[: i + 1])
    return found[-1].pose[:2] + np.array([0.03, -0.02])


# --- batch = dense least squares


def dense(history):
    """Poses, slow states and covariances of the newest node by SciPy, from the factors' formulas in `test_graph_factors`."""
    count, n = history.count, history._n
    pairs, first = history._pairs[: count - 1], history._first
    poses0, slow0 = history.poses(), history.slow()

    def place(x):
        change = x.reshape(count, n)
        return se2.compose(poses0, se2.exp(change[:, :3])), slow0 + change[:, 3:]

    def residuals(x):
        poses, slow = place(x)
        found = [first.root @ np.concatenate([se2.log(se2.between(first.pose, poses[0])), slow[0] - first.slow])]
        found += [whitened(pairs[slice(k, k + 1)], poses[k], slow[k], poses[k + 1], slow[k + 1]) for k in range(count - 1)]
        found += [p.white @ (se2.transform(poses[k], p.lever) - p.xy) for k, p in history._positions]
        found += [c.white @ se2.log(se2.between(c.delta, se2.between(poses[c.a], poses[c.b]))) for c in history._closures]
        return np.concatenate(found)

    scale = np.tile(1.0 / np.abs(np.diag(first.root)), count)
    scale[np.arange(count * n) % n < 3] = 0.01
    best = least_squares(residuals, np.zeros(count * n), x_scale=scale, method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    poses, slow = place(best.x)
    poses0, slow0 = poses, slow
    J = np.column_stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e, h in zip(np.eye(count * n), 1e-4 * scale, strict=True)])
    covariance = np.linalg.inv((J * scale).T @ (J * scale)) * np.outer(scale, scale)
    return poses, slow, covariance[-n:, -n:], best.cost


def test_batch_is_dense_least_squares(steps):
    steps = steps[:9]
    estimator, _ = fed(steps, backend="batch", kernel="none")
    stamps = moments(steps)
    estimator.add_position(stamps[4], true_position(steps, 4), GPS, np.array([0.2, 0.1]))
    estimator.add_closure(stamps[1], stamps[7], Motion(se2.between(*estimator._history.poses()[[1, 7]]) + 0.01, SURE))
    history = estimator._history
    cost = history.solve()
    poses, slow, covariance, best = dense(history)
    assert cost == pytest.approx(best, rel=1e-5)
    sigmas = np.sqrt(np.diag(covariance))
    assert (np.abs(history.poses()[-1] - poses[-1]) < 1e-2 * sigmas[:3]).all()
    assert (np.abs(history.slow()[-1] - slow[-1]) < 1e-2 * sigmas[3:]).all()
    found = marginals(history._blocks(history._linear()[0]), [history.count - 1], range(history.count), history._n)[0]
    np.testing.assert_allclose(found / np.outer(sigmas, sigmas), covariance / np.outer(sigmas, sigmas), atol=1e-2)


def test_damping_finds_the_way_from_a_bad_start(steps):
    estimator, _ = fed(steps, backend="batch")
    history = estimator._history
    best = history.solve()
    good = history.poses()
    rng = np.random.default_rng(0)
    history._poses[1 : history.count] += rng.normal(size=(history.count - 1, 3)) * [1.0, 1.0, 0.5]
    assert history.solve() == pytest.approx(best, rel=1e-4)
    np.testing.assert_allclose(history.poses(), good, atol=1e-4)


# --- the back ends agree


def test_a_lag_that_forgets_nothing_is_the_batch(steps):
    window, _ = fed(steps, lag_nodes=len(steps) + 1, relinearize_at=1e-9)
    batch, _ = fed(steps, backend="batch")
    batch._history.solve()
    sigmas = np.sqrt(np.diag(window.covariance()))
    history = batch._history
    assert (np.abs(window._now.pose - history.poses()[-1]) < 1e-3 * sigmas[:3]).all()
    assert (np.abs(window._now.slow - history.slow()[-1]) < 1e-3 * sigmas[3:]).all()
    newest = marginals(history._blocks(history._linear()[0]), [history.count - 1], range(history.count), history._n)[0]
    np.testing.assert_allclose(window.covariance() / np.outer(sigmas, sigmas), newest / np.outer(sigmas, sigmas), atol=1e-3)
    np.testing.assert_allclose(window._window.poses(), history.poses(), atol=1e-5)


def test_a_world_that_moves_as_one_is_not_linearised_anew(monkeypatch):
    """After hours each bit that is learned of k moves all that was driven: by far more than a way may be off, but it moves as one."""
    anew, again = [], Window._again
    monkeypatch.setattr(Window, "_again", lambda window: (anew.append(1), again(window))[1])
    long = recorded(steps=200)

    def as_after_hours(at):
        anew.clear()
        seer = Seer()
        estimator = make("graph", seer, relinearize_at=at)
        feed(estimator, seer, long[:60])
        drift = np.eye(estimator._window._n)
        drift[:3, 3 + estimator._slow.corrections.start] = 30.0, 15.0, 3.0  # m and rad for an error of 1 in k
        node = estimator._now
        estimator._window.restart(Node.known(node.pose, node.slow, drift @ node.covariance @ drift.T))
        estimator._newest = estimator._now = estimator._window.newest
        return feed(estimator, seer, long[60:]), len(anew)

    found, times = as_after_hours(0.01)
    exact, always = as_after_hours(1e-9)
    assert times < 5
    assert always > 100
    for one, other in zip(found, exact, strict=True):
        sigmas = np.sqrt(np.diag(other.covariance))
        assert (np.abs(se2.log(se2.between(other.pose, one.pose))) < 0.2 * sigmas).all()
        np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)), sigmas, rtol=0.05)


@pytest.mark.parametrize("lag", [2, 5, 20])
def test_a_short_lag_loses_little(steps, lag):
    short, _ = fed(steps, lag_nodes=lag)
    whole, _ = fed(steps, lag_nodes=len(steps) + 1)
    sigmas = np.sqrt(np.diag(whole.covariance()))
    assert (np.abs(short._now.pose - whole._now.pose) < 0.1 * sigmas[:3]).all()
    assert (np.abs(short._now.slow - whole._now.slow) < 0.1 * sigmas[3:]).all()
    np.testing.assert_allclose(np.sqrt(np.diag(short.covariance())), sigmas, rtol=0.05)


def test_isam2_is_the_batch(steps):
    stamps = moments(steps)
    found = []
    for backend in ("isam2", "batch"):
        estimator, _ = fed(steps, backend=backend, kernel="none")
        estimator.add_position(stamps[10], true_position(steps, 10), GPS)
        estimator.add_closure(stamps[2], stamps[33], Motion(se2.between(*estimator._history.poses()[[2, 33]]), SURE))
        found.append(estimator.finish())
    isam, batch = found
    np.testing.assert_allclose(isam.poses, batch.poses, atol=1e-4)
    sigmas = np.sqrt(np.maximum(batch.covariances.diagonal(axis1=1, axis2=2), 1e-12))
    np.testing.assert_allclose(np.sqrt(isam.covariances.diagonal(axis1=1, axis2=2)), sigmas, rtol=0.01, atol=1e-6)


def test_a_loop_that_is_closed_mends_its_middle():
    """Over seeds, the middle of the way by all measurements is nearer the truth than as it was believed on the way."""
    smoothed, believed = [], []
    for seed in range(8):
        estimator, seer = graph(backend="batch")
        found, truth = run(estimator, seer, seed, 40)
        off = np.random.default_rng(seed).normal(size=3) * np.sqrt(np.diag(SURE))
        estimator.add_closure(0, found[-1].stamp_ns, Motion(se2.compose(truth[-1], se2.exp(0.1 * off)), 0.01 * SURE))
        for errors, poses in ((smoothed, estimator.finish().poses[1:]), (believed, np.array([e.pose for e in found]))):
            errors.append(se2.log(se2.between(poses, truth))[20:35, :2])
    assert np.sqrt(np.mean(np.square(smoothed))) < 0.8 * np.sqrt(np.mean(np.square(believed)))


@pytest.mark.parametrize("form", ["constant", "cg_field"])
def test_what_is_known_of_the_first_node_is_what_is_believed(form):
    estimator, _ = graph(form=form)
    expected = estimator._slow.cov
    assert estimator.covariance()[3:, 3:] == pytest.approx(expected, rel=1e-9, abs=1e-12 * expected.max())


# --- late and out of order


def test_late_positions_in_any_order_count_as_if_they_had_come_in_time(plain_steps):
    steps, stamps = plain_steps, moments(plain_steps)
    gps = {i: true_position(steps, i) for i in (20, 25, 30, 33)}
    in_time, seer = graph(relinearize_at=1e-6, kernel="none", **PLAIN)
    for i, (step, seer.next) in enumerate(steps):
        in_time.step(step)
        if i in gps:
            assert in_time.add_position(stamps[i], gps[i], GPS)
    late, _ = fed(steps, relinearize_at=1e-6, kernel="none", **PLAIN)
    for i in (30, 20, 33, 25):
        assert late.add_position(stamps[i], gps[i].tolist(), GPS.tolist())
    sigmas = np.sqrt(np.diag(in_time.covariance()))
    assert (np.abs(late._now.pose - in_time._now.pose) < 0.02 * sigmas[:3]).all()
    np.testing.assert_allclose(np.sqrt(np.diag(late.covariance())), sigmas, rtol=0.01)
    assert late.counts()["positions"] == 4
    assert late.counts()["late"] == 0


def test_what_comes_after_the_lag_is_counted_and_changes_nothing(steps):
    stamps = moments(steps)
    estimator, _ = fed(steps, lag_nodes=10)
    before = estimator._now
    assert not estimator.add_position(stamps[5], np.zeros(2), GPS)
    assert not estimator.add_position(stamps[-1] + 60 * 10**9, np.zeros(2), GPS)
    assert not estimator.add_closure(stamps[3], stamps[-1], Motion(np.zeros(3), SURE))
    assert estimator.counts()["late"] == 3
    assert estimator._now is before
    kept, _ = fed(steps, lag_nodes=10, backend="batch")
    assert kept.add_position(stamps[5], true_position(steps, 5), GPS)
    assert kept.counts()["late"] == 0


def test_a_fixed_lag_forgets_what_it_does_not_smooth(steps):
    """All that it holds is bounded by the lag, and numbers of nodes still mean the same."""
    estimator, _ = fed(steps, lag_nodes=4)
    again, shift = estimator, steps[-1][0].end_ns
    seer = estimator._witness
    sizes = []
    for lap in range(1, 6):
        feed(again, seer, [(replace(s, start_ns=s.start_ns + lap * shift, end_ns=s.end_ns + lap * shift), seen) for s, seen in steps[1:]])
        arrays = [v for part in (again, again._window) for v in vars(part).values() if isinstance(v, (np.ndarray, list))]
        sizes.append((sum(len(v) for v in arrays) - len(again._nodes_ns), len(again._nodes_ns) <= 16))
    assert set(sizes) == {(sizes[0][0], True)}
    now = 6 * shift
    node = again._node_at(now, 1000)
    assert node == again._counts["nodes"]
    assert not again.add_closure(shift, now, Motion(np.zeros(3), SURE))
    assert again.counts()["late"] == 1
    assert again.add_closure(steps[-3][0].end_ns + 5 * shift, now, Motion(np.array([0.1, 0.0, 0.0]), SURE))


def test_a_closure_inside_the_window_is_that_of_the_batch(steps):
    stamps = moments(steps)
    batch, _ = fed(steps, backend="batch")
    batch._history.solve()
    seen = Motion(se2.compose(se2.between(*batch._history.poses()[[8, 35]]), se2.exp(np.array([0.03, 0.02, -0.01]))), SURE)
    window, _ = fed(steps, lag_nodes=len(steps) + 1)
    before = window._now.pose
    for estimator in (window, batch):
        assert estimator.add_closure(stamps[8], stamps[35], seen)
    history = batch._history
    history.solve()
    sigmas = np.sqrt(np.diag(window.covariance()))
    moved = np.abs(history.poses()[-1] - before).max()
    assert np.abs(window._now.pose - history.poses()[-1]).max() < 0.01 * moved
    newest = marginals(history._blocks(history._linear()[0]), [history.count - 1], range(history.count), history._n)[0]
    np.testing.assert_allclose(window.covariance() / np.outer(sigmas, sigmas), newest / np.outer(sigmas, sigmas), atol=0.01)
    assert window.counts()["closures"] == 1


def test_a_robust_kernel_resists_one_wild_closure(steps):
    stamps = moments(steps)
    clean, _ = fed(steps, backend="batch")
    truth = clean.finish()

    def pulled(size, **config):
        estimator, _ = fed(steps, backend="batch", **config)
        wild = se2.between(truth.poses[3], truth.poses[36]) + size * np.array([20.0, -15.0, 0.0])
        estimator.add_closure(stamps[3], stamps[36], Motion(wild, SURE))
        off = se2.log(se2.between(truth.poses[-1], estimator.finish().poses[-1]))
        return float(np.sqrt(off @ np.linalg.solve(truth.covariances[-1], off)))

    assert pulled(1.0) < 0.1  # sigmas; as it comes
    assert pulled(1.0, kernel="none") > 20.0
    # Huber's pull is bounded: it does not grow with the error
    assert pulled(10.0, kernel="huber") == pytest.approx(pulled(1.0, kernel="huber"), rel=0.1)


def test_a_robust_kernel_listens_to_a_good_closure(steps):
    stamps = moments(steps)
    smoothed, _ = fed(steps, backend="batch")
    expected = se2.between(*smoothed.finish().poses[[3, 36]])
    found = []
    for kernel in ("cauchy", "none"):
        estimator, _ = fed(steps, backend="batch", kernel=kernel)
        seen = se2.compose(expected, se2.exp(np.array([0.01, 0.005, 0.0])))
        estimator.add_closure(stamps[3], stamps[36], Motion(seen, SURE))
        found.append(estimator.finish())
    sigmas = np.sqrt(np.diag(found[1].covariances[-1]))
    assert (np.abs(se2.log(se2.between(found[0].poses[-1], found[1].poses[-1]))) < 0.2 * sigmas).all()


# --- what cannot be solved, and what is no measurement


def added(block):
    isam = Incremental(2)
    isam.update([block], [0])
    return isam.changes([0])


def test_singular_graphs_are_named():
    n = 2
    one = Block((0,), (np.eye(n),), np.zeros(n))
    with pytest.raises(IndeterminateError, match="node 1"):
        solve([one], range(2), n)
    with pytest.raises(IndeterminateError):
        solve([one, Block((0, 1), (np.zeros((1, n)), np.zeros((1, n))), np.ones(1))], range(2), n)
    loose = Block((0, 1), (-np.eye(n), np.eye(n)), np.ones(n))
    with pytest.raises(IndeterminateError):
        marginals([loose], [0], range(2), n)
    with pytest.raises(IndeterminateError):
        added(Block((0,), (np.array([[1.0, 0.0]]),), np.zeros(1)))


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (Block((0, 7), (np.eye(2), np.eye(2)), np.zeros(2)), "node 7"),
        (Block((0,), (np.eye(3),), np.zeros(3)), "shape"),
        (Block((0, 0), (np.eye(2), np.eye(2)), np.zeros(2)), "says nothing"),
        (Block((0,), (np.zeros((0, 2)),), np.zeros(0)), "says nothing"),
    ],
)
def test_factors_that_gtsam_would_choke_on_are_refused(block, message):
    good = Block((0,), (np.eye(2),), np.zeros(2))
    with pytest.raises(EstimatorError, match=message):
        solve([good, block], range(1), 2)
    isam = Incremental(2)
    with pytest.raises(EstimatorError, match=message):
        isam.update([good, block], [0])


def test_rows_that_are_not_finite_are_named():
    rows = np.ones((3, 4, 5))
    rows[1, 2, 3] = np.nan
    with pytest.raises(EstimatorError, match="nodes 11 and 12"):
        list(chain(rows, 10))


def test_a_covariance_that_is_not_positive_is_no_node():
    with pytest.raises(EstimatorError, match="positive"):
        Node.known(np.zeros(3), np.zeros(0), np.diag([1.0, -1.0, 1.0]))
    with pytest.raises(SingularError):
        Window(Node(np.zeros(3), np.zeros(0), np.diag([1.0, np.nan, 1.0])), 5, 0.01)


def spoiled_step(step, kind):
    p, bad = step.predicted, np.full(3, np.nan)
    return {
        "wheels": lambda: replace(step, predicted=replace(p, delta=bad)),
        "their covariance": lambda: replace(step, predicted=replace(p, cov=np.diag([1e-4, -1.0, 1e-4]))),
        "their derivatives": lambda: replace(step, predicted=replace(p, d_params=np.full_like(p.d_params, np.inf))),
        "clock": lambda: replace(step, d_clock=bad),
        "turn": lambda: replace(step, turn=Turn(math.nan, 1e-6, DT)),
        "its variance": lambda: replace(step, turn=Turn(0.0, 0.0, DT)),
    }[kind]()


@pytest.mark.parametrize("kind", ["wheels", "their covariance", "their derivatives", "clock", "turn", "its variance"])
def test_a_step_that_is_no_measurement_is_refused_and_leaves_the_state_whole(steps, kind):
    estimator, seer = graph()
    feed(estimator, seer, steps[:10])
    step, seer.next = steps[10]
    with pytest.raises(EstimatorError):
        estimator.step(spoiled_step(step, kind))
    expected, _ = fed(steps[:11])
    assert estimator.step(step).pose == pytest.approx(expected._now.pose, abs=1e-12)


@pytest.mark.parametrize(
    "motion",
    [
        Motion(np.array([0.1, np.nan, 0.0]), SURE),
        Motion(np.zeros(2), SURE),
        Motion(np.zeros(3), -SURE),
        Motion(np.zeros(3), np.full((3, 3), np.inf)),
        Motion(np.zeros(3), np.eye(2)),
    ],
)
def test_a_lidar_that_measures_nonsense_is_refused(steps, motion):
    estimator, seer = graph()
    feed(estimator, seer, steps[:10])
    seer.next = motion
    with pytest.raises(EstimatorError):
        estimator.step(steps[10][0])
    with pytest.raises(EstimatorError):
        estimator.add_closure(steps[2][0].end_ns, steps[5][0].end_ns, motion)
    assert np.isfinite(estimator.covariance()).all()


def test_positions_and_closures_that_are_none_are_refused(steps):
    estimator, _ = fed(steps, backend="batch")
    now = steps[-1][0].end_ns
    for xy, cov in ((np.array([np.nan, 0.0]), GPS), (np.zeros(3), GPS), (np.zeros(2), -GPS), (np.zeros(2), np.eye(3))):
        with pytest.raises(EstimatorError):
            estimator.add_position(now, xy, cov)
    for a, b in ((now, now), (now, now + 10**9), (-(10**9), now)):
        with pytest.raises(EstimatorError, match="closure"):
            estimator.add_closure(a, b, Motion(np.zeros(3), SURE))
    with pytest.raises(EstimatorError, match="node 3"):
        estimator._history.add_closure(Closure(3, 3, np.zeros(3), np.eye(3)))
    with pytest.raises(EstimatorError, match="closure"):
        graph()[0].add_closure(0, 1, Motion(np.zeros(3), SURE))
    with pytest.raises(EstimatorError, match="lidar_z"):
        graph(learn=("lidar_z",))


HOSTILE = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e150, 0.0, 1e-300, -1.0, 0.1])


def drawn(data, *shape):
    count = int(np.prod(shape))
    return np.array(data.draw(st.lists(HOSTILE, min_size=count, max_size=count))).reshape(shape)


@pytest.mark.parametrize("size", [math.nan, math.inf, 1e150, 1e300])
@pytest.mark.parametrize("where", ["matrix", "right side"])
def test_a_factor_too_large_to_compute_with_is_our_error(size, where):
    good = [Block((0,), (np.eye(2),), np.zeros(2)), Block((0, 1), (-np.eye(2), np.eye(2)), np.ones(2))]
    row = np.array([[size, 0.0]]) if where == "matrix" else np.array([[1.0, 0.0]])
    bad = Block((1,), (row,), np.array([1e300 if where == "matrix" else size]))
    with contextlib.suppress(EstimatorError):
        assert np.isfinite(solve([*good, bad], range(2), 2)).all()
    if not math.isfinite(size):
        with pytest.raises(EstimatorError, match="finite"):
            solve([*good, bad], range(2), 2)
        with pytest.raises(EstimatorError, match="finite"):
            Incremental(2).update([bad], [1])


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_no_numbers_in_factors_end_the_process(data):
    """GTSAM takes matrices only, and gives finite numbers or our error."""
    good = [Block((0,), (np.eye(2),), np.zeros(2)), Block((0, 1), (-np.eye(2), np.eye(2)), np.ones(2))]
    bad = data.draw(
        st.sampled_from(
            [
                Block((0, 1), (drawn(data, 2, 2), drawn(data, 2, 2)), drawn(data, 2)),
                Block((1,), (drawn(data, 1, 2),), drawn(data, 1)),
                Block((0,), (np.eye(2),), drawn(data, 2)),
            ]
        )
    )
    with contextlib.suppress(EstimatorError):
        assert np.isfinite(solve([*good, bad], range(2), 2)).all()
    with contextlib.suppress(EstimatorError):
        assert np.isfinite(marginals([*good, bad], [0, 1], range(2), 2)).all()
    isam = Incremental(2)
    isam.update(good, [0, 1])
    with contextlib.suppress(EstimatorError):
        isam.update([bad], [])
        assert np.isfinite(isam.changes([0, 1])).all()
        assert np.isfinite(isam.marginals([0, 1])).all()


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_no_input_makes_the_graph_non_finite(steps, data):
    """Whatever the witnesses say, for every back end: our error, or a finite state, from which good steps go on."""
    backend = data.draw(st.sampled_from(["fixed_lag", "batch", "isam2"]))
    estimator, seer = graph(backend=backend, lag_nodes=5)
    feed(estimator, seer, steps[:8])
    step, seen = steps[8]
    now, p = steps[7][0].end_ns, step.predicted
    calls = {
        "motion": lambda: estimator.step(replace(step, predicted=replace(p, delta=drawn(data, 3)))),
        "covariance": lambda: estimator.step(replace(step, predicted=replace(p, cov=np.diag(drawn(data, 3))))),
        "derivatives": lambda: estimator.step(replace(step, predicted=replace(p, d_params=drawn(data, *p.d_params.shape)))),
        "clock": lambda: estimator.step(replace(step, d_clock=drawn(data, 3))),
        "turn": lambda: estimator.step(replace(step, turn=Turn(*drawn(data, 3).tolist()))),
        "lidar": lambda: estimator.step(step),
        "position": lambda: estimator.add_position(now, drawn(data, 2), np.diag(drawn(data, 2))),
        "closure": lambda: estimator.add_closure(steps[3][0].end_ns, now, Motion(drawn(data, 3), np.diag(drawn(data, 3)))),
    }
    for name in data.draw(st.lists(st.sampled_from(sorted(calls)), min_size=1, max_size=3)):
        seer.next = Motion(drawn(data, 3), np.diag(drawn(data, 3))) if name == "lidar" else seen
        with contextlib.suppress(EstimatorError):
            calls[name]()
        assert np.isfinite(estimator._now.pose).all()
        assert np.isfinite(estimator._now.slow).all()
        assert np.isfinite(estimator.params).all()
    for step, seer.next in steps[9:12]:
        with contextlib.suppress(EstimatorError):
            assert np.isfinite(estimator.step(step).pose).all()


# --- rebuilt from marginals


def test_isam2_that_becomes_indeterminate_is_rebuilt_from_the_marginal(steps, monkeypatch):
    whole, _ = fed(steps, backend="isam2")
    real, calls = Incremental.update, []

    def fails_once(self, blocks, new):
        calls.append(new)
        if len(calls) == 20:
            raise IndeterminateError("Indeterminant linear system detected while working near variable 20.")
        return real(self, blocks, new)

    monkeypatch.setattr(graph_history.Incremental, "update", fails_once)
    estimator, found = fed(steps, backend="isam2")
    assert estimator.counts()["rebuilt"] == 1
    assert found[-1].pose == pytest.approx(whole._now.pose, abs=1e-9)  # the window went on
    trajectory, expected = estimator.finish(), whole.finish()
    sigmas = np.sqrt(np.diag(expected.covariances[-1]))
    assert (np.abs(trajectory.poses[-1] - expected.poses[-1]) < 0.1 * sigmas).all()
    np.testing.assert_allclose(np.sqrt(np.diag(trajectory.covariances[-1])), sigmas, rtol=0.05)


@pytest.mark.parametrize("method", ["extend", "commit", "see"])
def test_a_window_that_becomes_singular_is_rebuilt_from_the_marginal(steps, method, monkeypatch):
    whole, _ = fed(steps)
    real, calls = getattr(Window, method), []

    def fails_once(self, *args):
        calls.append(args)
        if len(calls) == 20:
            raise SingularError("as if")
        return real(self, *args)

    monkeypatch.setattr(Window, method, fails_once)
    estimator, found = fed(steps)
    assert estimator.counts()["rebuilt"] == 1
    sigmas = np.sqrt(np.diag(whole.covariance()))
    assert (np.abs(found[-1].pose - whole._now.pose) < 0.1 * sigmas[:3]).all()
    np.testing.assert_allclose(np.sqrt(np.diag(estimator.covariance())), sigmas, rtol=0.05)


def test_a_window_whose_last_marginal_is_singular_too_says_so(steps, monkeypatch):
    estimator, seer = graph()
    feed(estimator, seer, steps[:10])

    def fails(self, *args):
        raise SingularError("as if")

    monkeypatch.setattr(Window, "extend", fails)
    monkeypatch.setattr(Window, "restart", fails)
    with pytest.raises(EstimatorError, match="singular"):
        estimator.step(steps[10][0])


# --- the LiDAR's mount and the clock, by name

MOUNT = ("clock", "lidar_x", "lidar_y", "lidar_yaw")


def test_the_mount_is_learned_where_it_is_named():
    estimator, seer = graph(model="icr", learn=MOUNT)
    run(estimator, seer, 4, 400, mount=(0.04, -0.03, 0.02))
    found = estimator.parameters()
    for name, true, prior in (("lidar_x_m", 0.04, 0.05), ("lidar_y_m", -0.03, 0.05), ("lidar_yaw_rad", 0.02, 0.03)):
        mean, sigma = found[name]
        assert abs(mean - true) < 3.0 * sigma
        assert sigma < 0.6 * prior
    none, seer = graph(model="icr", learn=())
    run(none, seer, 4, 20)
    assert not set(none.parameters()) & {"lidar_x_m", "lidar_y_m", "lidar_yaw_rad", "wheel_clock_offset_s"}
    assert none.clock_offset_s == 0.0


def test_a_straight_way_shows_nothing_of_where_the_lidar_sits():
    """Only its yaw, for the robot does not drive sideways; the noise of the measured turns must not pass for turning."""
    steady = Noise(wheels=Noise().scaled(0.02).wheels)  # a slip that turns would show it
    estimator, seer = graph(form="none", learn=MOUNT, noise=steady)
    run(estimator, seer, 1, 400, wheels=straight, mount=(0.05, 0.05, 0.02), noise=steady)
    found = estimator.parameters()
    for name in ("lidar_x_m", "lidar_y_m"):
        assert found[name][1] > 0.98 * 0.05
        assert abs(found[name][0]) < 0.1 * 0.05
    assert found["lidar_yaw_rad"][1] < 0.3 * 0.03
    assert found["wheel_clock_offset_s"][1] > 0.99 * 0.05  # nothing changes: nothing is early or late


def test_standing_shows_nothing_of_the_mount():
    estimator, seer = graph(form="none", learn=MOUNT)
    run(estimator, seer, 1, 200, wheels=lambda t: (0.0, 0.0), mount=(0.05, 0.05, 0.02))
    found = estimator.parameters()
    for name, prior in (("lidar_x_m", 0.05), ("lidar_y_m", 0.05), ("lidar_yaw_rad", 0.03)):
        assert found[name][1] > 0.98 * prior


def test_every_estimate_with_a_mount_is_that_of_the_batch_too():
    learn = {"form": "none", "learn": ("lidar_x", "lidar_y", "lidar_yaw")}
    steps = recorded(seed=2, steps=40, **PLAIN, mount=(0.04, -0.03, 0.02))
    window, _ = fed(steps, lag_nodes=50, relinearize_at=1e-9, **learn)
    batch, _ = fed(steps, backend="batch", **learn)
    batch._history.solve()
    sigmas = np.sqrt(np.diag(window.covariance()))
    assert (np.abs(window._now.pose - batch._history.poses()[-1]) < 1e-2 * sigmas[:3]).all()
    assert (np.abs(window._now.slow - batch._history.slow()[-1]) < 1e-2 * sigmas[3:]).all()
