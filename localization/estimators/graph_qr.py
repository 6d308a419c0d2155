"""Least squares along a chain of nodes by Householder reflections: elimination forward, substitution backward. Compiled scalar loops."""

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
    (N, r, 2n + 1) of `graph_factors.linearize`; ``unary`` (N + 1, u, 4) rows about the pose of each node.
    """
    count, r, width = rows.shape
    n = roots.shape[1]
    u = unary.shape[1]
    work = np.empty((n + r + u, width))
    for p in range(count):
        work[:] = 0.0
        work[:n, :n] = roots[p, :, :n]
        work[:n, 2 * n] = roots[p, :, n]
        work[n : n + r] = rows[p]
        work[n + r :, n : n + 3] = unary[p + 1, :, :3]
        work[n + r :, 2 * n] = unary[p + 1, :, 3]
        triangularize(work, 2 * n)
        conditionals[p] = work[:n]
        roots[p + 1] = work[n : 2 * n, n:]


@numba.njit(cache=True)
def is_regular(root: FloatArray) -> bool:  # pragma: no cover
    """``root`` (n, n + 1) is finite, and none of its pivots is lost in the rounding of its column."""
    n = root.shape[0]
    for i in range(n):
        size = 0.0
        for j in range(n + 1):
            if not math.isfinite(root[i, j]):
                return False
        for j in range(i + 1):
            size = max(size, abs(root[j, i]))
        if abs(root[i, i]) <= 1e-14 * size:
            return False
    return True


@numba.njit(cache=True)
def substitute(root: FloatArray, conditionals: FloatArray, change: FloatArray) -> bool:  # pragma: no cover
    """Fill ``change`` (N + 1, n) from the ``root`` (n, n + 1) of the last node and the ``conditionals`` (N, n, 2n + 1) before it."""
    n, last = root.shape[0], change.shape[0] - 1
    for p in range(last, -1, -1):
        for i in range(n - 1, -1, -1):
            if p == last:
                value, pivot = root[i, n], root[i, i]
                for j in range(i + 1, n):
                    value -= root[i, j] * change[p, j]
            else:
                value, pivot = conditionals[p, i, 2 * n], conditionals[p, i, i]
                for j in range(i + 1, n):
                    value -= conditionals[p, i, j] * change[p, j]
                for j in range(n):
                    value -= conditionals[p, i, n + j] * change[p + 1, j]
            change[p, i] = value / pivot if pivot != 0.0 else math.nan
            if not math.isfinite(change[p, i]):
                return False
    return True
