"""Compiled changes of covariances against their matrices written out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import EstimatorError
from localization.estimators.error_states import cloned, corrected, eigen, inverse, motion_covariance, moved
from motion_models import se2

SEEDS = st.integers(0, 2**31)
BEHIND, N = 14, 20  # states of the filter, and with two poses behind them


def spd(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    P = A @ A.T
    return np.asarray(0.5 * (P + P.T))


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_poses_move_with_what_they_depend_on(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, Q, D, delta = spd(rng, N), spd(rng, BEHIND), rng.normal(size=(3, 4)), rng.normal(size=3)
    A, G = se2.adjoint(se2.inverse(delta)), np.eye(N)
    for at in (0, 14, 17):
        G[at : at + 3, at : at + 3] = A
    G[:3, 10:14] = D
    expected = G @ P @ G.T
    expected[:BEHIND, :BEHIND] += Q
    before = P.copy()
    np.testing.assert_allclose(moved(P, delta, D, Q), expected, atol=1e-12 * np.abs(expected).max())
    G = np.eye(N)
    G[6:9] = np.eye(N)[:3]
    np.testing.assert_array_equal(cloned(P, 6), G @ P @ G.T)
    np.testing.assert_array_equal(P, before)  # estimates hold views of it


@given(SEEDS, st.sampled_from([1, 3]))
@settings(max_examples=30, deadline=None)
def test_any_gain_corrects(seed: int, r: int) -> None:
    rng = np.random.default_rng(seed)
    P, K, H, R = spd(rng, N), rng.normal(size=(BEHIND, r)), rng.normal(size=(r, 17)) * (rng.random((r, 17)) < 0.4), spd(rng, r)
    gain = np.vstack([K, np.zeros((N - BEHIND, r))])
    T = np.eye(N) - gain @ np.hstack([H, np.zeros((r, N - 17))])
    expected = T @ P @ T.T + gain @ R @ gain.T
    found = corrected(P, K, H, R)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(found, found.T)


def test_a_motion_is_as_sure_as_differences_say() -> None:
    rng, h = np.random.default_rng(0), 1e-6
    P, start, delta = spd(rng, 6), rng.normal(size=3), rng.normal(size=3)
    pose = se2.compose(start, delta)

    def motion(e: np.ndarray) -> np.ndarray:
        return se2.log(se2.between(delta, se2.between(se2.compose(start, se2.exp(e[3:])), se2.compose(pose, se2.exp(e[:3])))))

    J = np.stack([(motion(h * e) - motion(-h * e)) / (2.0 * h) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(motion_covariance(P, 3, delta), J @ P @ J.T, rtol=1e-7, atol=1e-7)


@given(SEEDS, st.lists(st.sampled_from([0.0, 1e-9, 1.0, 1.0, 3.0, 1e9]), min_size=3, max_size=3))
@settings(max_examples=100, deadline=None)
def test_eigenvalues_are_those_of_lapack(seed: int, scales: list[float]) -> None:
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    A = (Q * scales) @ Q.T
    values, V = eigen(A)
    size = max(scales)
    np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(0.5 * (A + A.T)), atol=1e-14 * size)
    np.testing.assert_allclose(V @ V.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose((V * values) @ V.T, A, atol=2e-15 * size)


def test_the_inverse_is_one_or_is_told() -> None:
    rng = np.random.default_rng(1)
    for n in (1, 3):
        S = spd(rng, n)
        np.testing.assert_allclose(inverse(S) @ S, np.eye(n), atol=1e-9)
    u = np.array([0.0, 1.4, 1.2])
    slipped = 1e10 * np.outer(u, u) + 1e-7 * np.eye(3)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(slipped)  # by rounding
    assert inverse(slipped)[0, 0] == pytest.approx(1e7)
    with pytest.raises(EstimatorError, match="noise"):
        inverse(np.diag([1.0, 0.0, 1.0]))
