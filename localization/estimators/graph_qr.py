"""Least squares along a chain of nodes by Householder reflections, and what small matrices need. Compiled scalar loops.

Matrices here are 3 to 20 wide: calls into LAPACK would cost more than the arithmetic. Slices are not assigned to each other: each such
line would take the compiler longer than the loop.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from motion_models.se2 import FloatArray, Triple


@numba.njit(cache=True)
def triangularize(A: FloatArray, columns: int) -> None:  # pragma: no cover
    """Householder reflections of A (r, c) in place, until its first ``columns`` are upper triangular."""
    rows, width = A.shape
    w, v = np.empty(width), np.empty(rows)
    for j in range(min(columns, rows)):
        square = 0.0
        for i in range(j, rows):
            v[i] = A[i, j]
            square += v[i] * v[i]
        if square == 0.0:
            continue
        alpha = -math.copysign(math.sqrt(square), v[j])
        scale = 1.0 / (square - alpha * v[j])
        v[j] -= alpha
        w[j:] = 0.0
        for i in range(j, rows):
            f = v[i]
            if f != 0.0:
                for k in range(j, width):
                    w[k] += f * A[i, k]
        for i in range(j, rows):
            f = v[i] * scale
            if f != 0.0:
                for k in range(j, width):
                    A[i, k] -= f * w[k]
        A[j, j] = alpha
        for i in range(j + 1, rows):
            A[i, j] = 0.0


@numba.njit(cache=True)
def eliminate(roots: FloatArray, conditionals: FloatArray, rows: FloatArray, unary: FloatArray) -> None:  # pragma: no cover
    """Eliminate nodes 0 .. N - 1 of N + 1 in order.

    ``roots`` (N + 1, n, n + 1): the first is given, the others are filled; ``conditionals`` (N, n, 2n + 1) are filled; ``rows``
    (N, r, 2n + 1) of `graph_factors.linearize`; ``unary`` (N + 1, u, c + 1) rows about the first c numbers of each node.
    """
    count, r, width = rows.shape
    n, u, c = roots.shape[1], unary.shape[1], unary.shape[2] - 1
    work = np.empty((n + r + u, width))
    for p in range(count):
        work[:] = 0.0
        place(roots[p], 0, n, work, 0, 0)
        place(rows[p], 0, 2 * n, work, n, 0)
        place(unary[p + 1], 0, c, work, n + r, n)
        triangularize(work, 2 * n)
        take(conditionals[p], work, 0, 0)
        take(roots[p + 1], work, n, n)


@numba.njit(cache=True)
def place(rows: FloatArray, first: int, count: int, work: FloatArray, row: int, column: int) -> None:  # pragma: no cover
    """Copy ``count`` columns of ``rows`` (r, c) from the ``first`` on into ``work``, and their last, the right side, into its last."""
    for i in range(rows.shape[0]):
        for j in range(count):
            work[row + i, column + j] = rows[i, first + j]
        work[row + i, -1] = rows[i, -1]


@numba.njit(cache=True)
def take(out: FloatArray, work: FloatArray, row: int, column: int) -> None:  # pragma: no cover
    """Fill ``out`` (r, c) from ``work``, where it stands at (``row``, ``column``)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = work[row + i, column + j]


@numba.njit(cache=True)
def is_regular(root: FloatArray) -> bool:  # pragma: no cover
    """``root`` (n, n or more), upper triangular, is finite, and none of its pivots is lost in the rounding of its column."""
    n = root.shape[0]
    for i in range(n):
        size = 0.0
        for j in range(root.shape[1]):
            if not math.isfinite(root[i, j]):
                return False
        for j in range(i + 1):
            size = max(size, abs(root[j, i]))
        if abs(root[i, i]) <= 1e-14 * size:
            return False
    return True


@numba.njit(cache=True)
def substitute(root: FloatArray, conditionals: FloatArray, change: FloatArray) -> bool:  # pragma: no cover
    """Fill ``change`` (N + 1, n) from the ``root`` (n, n + 1) of the last node and the ``conditionals`` (N, n, 2n + 1) before it.

    Returns whether there is a solution, as all of these do.
    """
    n = root.shape[0]
    last = change.shape[0] - 1
    for i in range(n):
        change[last, i] = root[i, n]
    return solve_upper(root, change[last]) and substitute_given(conditionals, change)


@numba.njit(cache=True)
def substitute_given(conditionals: FloatArray, change: FloatArray) -> bool:  # pragma: no cover
    """`substitute` where the last of ``change`` is known."""
    n = change.shape[1]
    for p in range(change.shape[0] - 2, -1, -1):
        for i in range(n):
            value = conditionals[p, i, 2 * n]
            for j in range(n):
                value -= conditionals[p, i, n + j] * change[p + 1, j]
            change[p, i] = value
        if not solve_upper(conditionals[p], change[p]):
            return False
    return True


@numba.njit(cache=True)
def solve_upper(R: FloatArray, x: FloatArray) -> bool:  # pragma: no cover
    """Make the right side ``x`` (n,) the solution by the upper triangle of ``R`` (n, n or more)."""
    for i in range(x.shape[0] - 1, -1, -1):
        for j in range(i + 1, x.shape[0]):
            x[i] -= R[i, j] * x[j]
        x[i] = x[i] / R[i, i] if R[i, i] != 0.0 else math.nan
        if not math.isfinite(x[i]):
            return False
    return True


@numba.njit(cache=True)
def inverse_root(cov: FloatArray) -> FloatArray:  # pragma: no cover
    """W (n, n), lower triangular, with W^T W = ``cov``^-1 (n, n); NaN if that is not positive definite."""
    n = cov.shape[0]
    L, W = np.zeros((n, n)), np.zeros((n, n))
    for j in range(n):
        rest = cov[j, j]
        for k in range(j):
            rest -= L[j, k] * L[j, k]
        if not rest > 0.0:
            W[:] = math.nan
            return W
        L[j, j] = math.sqrt(rest)
        for i in range(j + 1, n):
            value = cov[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
    for j in range(n):
        W[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= L[i, k] * W[k, j]
            W[i, j] = value / L[i, i]
    return W


@numba.njit(cache=True)
def inverse_of_upper(R: FloatArray) -> FloatArray:  # pragma: no cover
    """(n, n) inverse of the upper triangle of ``R``."""
    n = R.shape[0]
    inverse = np.zeros((n, n))
    for j in range(n):
        inverse[j, j] = 1.0 / R[j, j]
        for i in range(j - 1, -1, -1):
            value = 0.0
            for k in range(i + 1, j + 1):
                value -= R[i, k] * inverse[k, j]
            inverse[i, j] = value / R[i, i]
    return inverse


@numba.njit(cache=True)
def product(A: FloatArray, B: FloatArray) -> FloatArray:  # pragma: no cover
    """``A @ B``"""
    out = np.zeros((A.shape[0], B.shape[1]))
    add_product(out, A, B)
    return out


@numba.njit(cache=True)
def add_product(out: FloatArray, A: FloatArray, B: FloatArray) -> None:  # pragma: no cover
    """``out += A @ B``; ``out`` is neither of them."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]


@numba.njit(cache=True)
def add_outer(out: FloatArray, A: FloatArray, B: FloatArray) -> None:  # pragma: no cover
    """``out += A @ B^T``"""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[j, k]


@numba.njit(cache=True)
def add_square(out: FloatArray, A: FloatArray) -> None:  # pragma: no cover
    """``out += A @ A^T``"""
    add_outer(out, A, A)


@numba.njit(cache=True)
def add_spread(out: FloatArray, A: FloatArray, P: FloatArray) -> None:  # pragma: no cover
    """``out += A @ P @ A^T``"""
    add_outer(out, product(A, P), A)


@numba.njit(cache=True)
def apply(D: FloatArray, x: FloatArray) -> Triple:  # pragma: no cover
    """``D`` (3, m) ``@ x`` (m,)"""
    a, b, c = 0.0, 0.0, 0.0
    for k in range(x.shape[0]):
        a, b, c = a + D[0, k] * x[k], b + D[1, k] * x[k], c + D[2, k] * x[k]
    return a, b, c


@numba.njit(cache=True)
def is_covariance(cov: FloatArray) -> bool:  # pragma: no cover
    """Finite, symmetric and positive, up to rounding; it may be singular."""
    n = cov.shape[0]
    size, L = np.empty(n), np.zeros((n, n))
    for i in range(n):
        if not (math.isfinite(cov[i, i]) and cov[i, i] >= 0.0):
            return False
        size[i] = math.sqrt(cov[i, i]) + 1e-30
    for j in range(n):
        for i in range(j, n):
            value = cov[i, j] / size[i] / size[j]
            if not abs(value - cov[j, i] / size[i] / size[j]) < 1e-6:
                return False
            if i == j:
                value += 1e-9
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[j, j] = math.sqrt(value)
            else:
                return False
    return True
