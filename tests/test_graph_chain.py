"""A chain with few ties, eliminated in part by ourselves: against dense least squares, and against GTSAM with the whole of it."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import EstimatorError
from localization.estimators.graph import Block, IndeterminateError, chain, marginals, solve
from localization.estimators.graph_chain import Chain
from motion_models import se2
from motion_models.base import Motion
from tests.graph_help import feed, make, recorded
from tests.synthetic_steps import Seer

N = 4  # numbers a node
TIES = {
    "none": [],
    "ends": [(0, 9)],
    "neighbours": [(3, 4)],
    "one behind the other": [(1, 2), (2, 3), (6, 9)],
    "crossing": [(1, 6), (4, 8)],
    "nested": [(0, 9), (2, 7), (4, 5)],
    "one node with many": [(5, 0), (5, 2), (8, 5)],
    "the same again": [(2, 7), (7, 2)],
}


def random_chain(seed, ties, count=10, unary_rows=0, about=3):
    """All parts are full of random numbers, so that nothing is zero where it ought not to be read."""
    rng = np.random.default_rng(seed)

    def tie(a, b):
        return Block((a, b), (rng.normal(size=(2, N)), rng.normal(size=(2, N))), rng.normal(size=2))

    rows = rng.normal(size=(count - 1, N + 1, 2 * N + 1))
    unary = rng.normal(size=(count, unary_rows, about + 1))
    return Chain(rows, unary, Block((0,), (rng.normal(size=(N, N)),), rng.normal(size=N)), [tie(*pair) for pair in ties])


def dense(found):
    """Changes and covariances of all nodes by one matrix, its columns scaled."""
    (count, u, about), n = found.unary.shape, found.prior.matrices[0].shape[1]
    about -= 1
    blocks = [found.prior, *found.ties]
    blocks += [Block((i, i + 1), (rows[:, :n], rows[:, n : 2 * n]), rows[:, -1]) for i, rows in enumerate(found.rows)]
    blocks += [Block((i,), (np.hstack([rows[:, :about], np.zeros((u, n - about))]),), rows[:, -1]) for i, rows in enumerate(found.unary)]
    A, b = [], []
    for block in blocks:
        full = np.zeros((len(block.rhs), count * n))
        for node, matrix in zip(block.nodes, block.matrices, strict=True):
            full[:, node * n : node * n + n] = matrix
        A.append(full)
        b.append(block.rhs)
    A, b = np.vstack(A), np.concatenate(b)
    scale = 1.0 / np.linalg.norm(A, axis=0)
    changes = np.linalg.lstsq(A * scale, b, rcond=None)[0] * scale
    root = np.linalg.inv(np.linalg.qr(A * scale, mode="r"))
    covariance = scale[:, None] * root @ root.T * scale
    return changes.reshape(count, n), np.array([covariance[i : i + n, i : i + n] for i in range(0, count * n, n)])


def agrees(found):
    """Up to a millionth of a sigma."""
    changes, covariances = dense(found)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert (np.abs(found.solve() - changes) / sigmas).max() < 1e-6
    scale = sigmas[:, :, None] * sigmas[:, None, :]
    np.testing.assert_allclose(found.marginals() / scale, covariances / scale, atol=1e-6)


@pytest.mark.parametrize("ties", TIES)
@pytest.mark.parametrize(("unary_rows", "about"), [(0, 3), (3, 3), (5, N)])
def test_a_chain_with_ties_is_dense_least_squares(ties, unary_rows, about):
    agrees(random_chain(1, TIES[ties], unary_rows=unary_rows, about=about))


@given(st.integers(0, 10_000), st.integers(1, 7), st.data())
@settings(max_examples=60, deadline=None)
def test_so_is_any_other(seed, count, data):
    nodes = st.integers(0, count - 1)
    ties = data.draw(st.lists(st.tuples(nodes, nodes).filter(lambda pair: pair[0] != pair[1]), max_size=4)) if count > 1 else []
    agrees(random_chain(seed, ties, count, unary_rows=2))


def test_a_history_is_dense_least_squares_and_gtsams_of_the_whole():
    steps = recorded(seed=5, steps=40)
    seer = Seer()
    estimator = make("graph", seer, backend="batch")
    feed(estimator, seer, steps)
    stamps, poses = [step.end_ns for step, _ in steps], estimator._history.poses()
    for i in (0, 7, 7, 30):
        estimator.add_position(stamps[i], poses[i][:2] + 0.05, 0.01 * np.eye(2), np.array([0.2, 0.1]))
    for a, b in ((2, 33), (33, 20), (3, 4)):
        seen = se2.compose(se2.between(poses[a], poses[b]), np.array([0.02, -0.01, 0.01]))
        estimator.add_closure(stamps[a], stamps[b], Motion(seen, 1e-4 * np.eye(3)))
    history = estimator._history
    rows = history._linear()[0]
    found, every = history._chain(rows), range(history.count)
    agrees(found)
    # GTSAM eliminates all of it by Cholesky's factors, which lose half of the digits
    changes, covariances = found.solve(), found.marginals()
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert (np.abs(changes) / sigmas).max() > 0.1  # there is something to agree about
    assert (np.abs(solve(history._blocks(rows), every, history._n) - changes) / sigmas).max() < 1e-3
    scale = sigmas[:, :, None] * sigmas[:, None, :]
    np.testing.assert_allclose(marginals(history._blocks(rows), every, every, history._n) / scale, covariances / scale, atol=1e-3)
    held = history._chain(rows, 1e12)
    assert (np.abs(held.solve()) / sigmas).max() < 1e-3 * (np.abs(changes) / sigmas).max()


@pytest.mark.parametrize("ties", TIES)
@pytest.mark.parametrize("of", [0, 4, 8])
def test_a_node_of_which_nothing_is_known_is_named(ties, of):
    good = random_chain(2, TIES[ties])
    lost = good.rows.copy()
    for pair in range(9):  # one number of one node, of which no factor speaks
        if pair == of:
            lost[pair, :, 2] = 0.0
        if pair + 1 == of:
            lost[pair, :, N + 2] = 0.0
    prior = Block((0,), (good.prior.matrices[0].copy(),), good.prior.rhs)
    if of == 0:
        prior.matrices[0][:, 2] = 0.0
    tied = []
    for block in good.ties:
        matrices = tuple(
            m * np.where(np.arange(N) == 2, 0.0, 1.0) if node == of else m for node, m in zip(block.nodes, block.matrices, strict=True)
        )
        tied.append(Block(block.nodes, matrices, block.rhs))
    bad = Chain(lost, good.unary, prior, tied)
    for work in (bad.solve, bad.marginals):
        with pytest.raises(IndeterminateError, match="singular"):
            work()


def test_rows_that_are_not_finite_are_named():
    found = random_chain(3, [(2, 7)])
    found.rows[4, 1, 2] = math.inf
    for work in (found.solve, found.marginals, lambda: list(chain(found.rows))):
        with pytest.raises(EstimatorError, match="nodes 4 and 5"):
            work()


HOSTILE = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e150, 0.0, 1e-300])


@given(st.sampled_from(sorted(TIES)), st.data())
@settings(max_examples=60, deadline=None)
def test_no_numbers_in_a_chain_end_the_process(ties, data):
    found = random_chain(4, TIES[ties], unary_rows=2)
    parts = [found.rows, found.unary, found.prior.matrices[0], *(tie.matrices[0] for tie in found.ties)]
    for _ in range(data.draw(st.integers(1, 4))):
        part = data.draw(st.sampled_from(parts))
        part.flat[data.draw(st.integers(0, part.size - 1))] = data.draw(HOSTILE)
    for work in (found.solve, found.marginals):
        with contextlib.suppress(EstimatorError):
            assert np.isfinite(work()).all()
