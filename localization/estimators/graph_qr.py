"""Least squares along a chain of nodes by Householder reflections, and what small matrices need. Compiled scalar loops.

Matrices here are 3 to 20 wide: calls into LAPACK would cost more than the arithmetic.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from motion_models.se2 import FloatArray


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
    n = roots.shape[1]
    u, c = unary.shape[1], unary.shape[2] - 1
    work = np.empty((n + r + u, width))
    for p in range(count):
        work[:] = 0.0
        work[:n, :n] = roots[p, :, :n]
        work[:n, 2 * n] = roots[p, :, n]
        work[n : n + r] = rows[p]
        work[n + r :, n : n + c] = unary[p + 1, :, :c]
        work[n + r :, 2 * n] = unary[p + 1, :, c]
        triangularize(work, 2 * n)
        conditionals[p] = work[:n]
        roots[p + 1] = work[n : 2 * n, n:]


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
    change[-1] = root[:, n]
    return solve_upper(root, change[-1]) and substitute_given(conditionals, change)


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
    """``A @ B``."""
    out = np.zeros((A.shape[0], B.shape[1]))
    add_product(out, 1.0, A, B)
    return out


@numba.njit(cache=True)
def add_product(out: FloatArray, factor: float, A: FloatArray, B: FloatArray) -> None:  # pragma: no cover
    """``out += factor * A @ B``; ``out`` is neither of them."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            f = factor * A[i, k]
            if f == 0.0:
                continue
            for j in range(B.shape[1]):
                out[i, j] += f * B[k, j]


@numba.njit(cache=True)
def condition(
    cov: FloatArray,
    d_state: FloatArray,
    error: FloatArray,
    d_delta: FloatArray,
    d_slow: FloatArray,
    variances: FloatArray,
    rows: FloatArray,
    rhs: FloatArray,
) -> FloatArray:  # pragma: no cover
    """Condition a Gaussian of 3 numbers on r scalar measurements, one after the other.

    ``error`` (r,) = d_delta (r, 3) perturbation + d_slow (r, m) slow + noise; the perturbation's mean depends on the slow states by
    ``d_state`` (3, m). Changes ``cov`` (3, 3) and ``d_state``; fills ``rows`` (r, m) and ``rhs`` (r,), what the innovations say of the
    slow states in unit variances; returns the shift (3,) of the mean.
    """
    m = d_state.shape[1]
    shift, gain, shared, by_slow = np.zeros(3), np.empty(3), np.empty(3), np.empty(m)
    for r in range(error.shape[0]):
        S, innovation = variances[r], error[r]
        for i in range(3):
            shared[i] = 0.0
            for j in range(3):
                shared[i] += cov[i, j] * d_delta[r, j]
        for i in range(3):
            S += d_delta[r, i] * shared[i]
            innovation -= d_delta[r, i] * shift[i]
        for k in range(m):
            by_slow[k] = d_slow[r, k]
            for i in range(3):
                by_slow[k] += d_delta[r, i] * d_state[i, k]
        for i in range(3):
            gain[i] = shared[i] / S
            shift[i] += gain[i] * innovation
            for k in range(m):
                d_state[i, k] -= gain[i] * by_slow[k]
        for i in range(3):
            for j in range(3):
                cov[i, j] -= gain[i] * shared[j]
        root = math.sqrt(S)
        rhs[r] = innovation / root
        for k in range(m):
            rows[r, k] = by_slow[k] / root
    return shift


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
