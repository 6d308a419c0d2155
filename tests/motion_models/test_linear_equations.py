"""Scalar linear algebra of matrices (3, 3), against numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from motion_models import linear_equations
from motion_models.compiled import kernel
from motion_models.linear_equations import Matrix3

diagonalize, multiply, transform_symmetric = (
    kernel(f) for f in (linear_equations.diagonalize, linear_equations.multiply, linear_equations.transform_symmetric)
)
solve, solve_3x3, invert = (kernel(f) for f in (linear_equations.solve, linear_equations.solve_3x3, linear_equations.invert))


def random_matrices(n: int = 200) -> list[np.ndarray]:
    """With entries from a thousandth to a thousand."""
    rng = np.random.default_rng(0)
    return [rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3.0, 3.0, size=3) for _ in range(n)]


def test_diagonalize_gives_eigenvalues_and_orthogonal_eigenvectors() -> None:
    for B in random_matrices():
        A = B @ B.T
        D = A.copy()
        V = diagonalize(D)
        assert np.allclose(np.sort(np.diag(D)), np.linalg.eigvalsh(A), rtol=1e-12, atol=1e-12 * np.abs(A).max())
        assert np.allclose(V @ np.diag(np.diag(D)) @ V.T, A, rtol=0.0, atol=1e-13 * np.abs(A).max())
        assert np.allclose(V.T @ V, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_invert_gives_the_inverse(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(100):
        B = rng.normal(size=(n, n + 2)) * 10.0 ** rng.uniform(-3.0, 3.0, size=n)[:, None]
        A = B @ B.T
        assert np.allclose(invert(A.copy()) @ A, np.eye(n), atol=1e-4)


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.eye(3), np.diag([3.0, 1.0, 2.0]), np.ones((3, 3))])
def test_diagonalize_of_special_matrices(A: np.ndarray) -> None:
    D = A.copy()
    V = diagonalize(D)
    assert np.allclose(V @ np.diag(np.diag(D)) @ V.T, A, atol=1e-14)


def test_solve_multiply_and_transform_agree_with_numpy() -> None:
    for A in random_matrices():
        b = A @ [1.0, -2.0, 0.5]
        assert np.allclose(multiply(A, (1.0, -2.0, 0.5)), b, rtol=1e-12)
        assert np.allclose(solve_3x3(Matrix3(*A.ravel()), *b), [1.0, -2.0, 0.5], rtol=1e-6)
        assert solve(A, b) == solve_3x3(Matrix3(*A.ravel()), *b)
        S = A + A.T
        assert np.allclose(transform_symmetric(A, S), A.T @ S @ A, rtol=1e-9, atol=1e-12 * np.abs(A).max() ** 3)


def test_solve_of_a_singular_matrix_gives_nothing_finite() -> None:
    assert not np.isfinite(solve_3x3(Matrix3(*np.ones(9)), 1.0, 2.0, 3.0)).any()
