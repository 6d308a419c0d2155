"""Equations and eigenvectors of matrices (3, 3) within compiled loops, where numpy's compile and run more slowly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from motion_models.compiled import subroutine
from motion_models.se2 import FloatArray, Triple


class Matrix3(NamedTuple):
    """Derivatives of x, y, z (rows) by u, v, w (columns)."""

    xu: float
    xv: float
    xw: float
    yu: float
    yv: float
    yw: float
    zu: float
    zv: float
    zw: float


@subroutine
def solve_3x3(a: Matrix3, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Solution of the linear equations with matrix ``a`` and right side ``x, y, z``, by Cramer's rule. NaN where it is singular."""
    c00 = a.yv * a.zw - a.yw * a.zv
    c10 = a.yw * a.zu - a.yu * a.zw
    c20 = a.yu * a.zv - a.yv * a.zu
    whole = 1.0 / (a.xu * c00 + a.xv * c10 + a.xw * c20)
    u = c00 * x + (a.xw * a.zv - a.xv * a.zw) * y + (a.xv * a.yw - a.xw * a.yv) * z
    v = c10 * x + (a.xu * a.zw - a.xw * a.zu) * y + (a.xw * a.yu - a.xu * a.yw) * z
    w = c20 * x + (a.xv * a.zu - a.xu * a.zv) * y + (a.xu * a.yv - a.xv * a.yu) * z
    return u * whole, v * whole, w * whole


@subroutine
def assign(target: FloatArray, source: FloatArray) -> None:
    """``target[:] = source`` of vectors of one length, whose check numba compiles for seconds in each process."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@subroutine
def solve(a: FloatArray, b: FloatArray) -> Triple:
    """`solve_3x3` of arrays: ``a`` (3, 3) and ``b`` (3,)."""
    rows = Matrix3(a[0, 0], a[0, 1], a[0, 2], a[1, 0], a[1, 1], a[1, 2], a[2, 0], a[2, 1], a[2, 2])
    return solve_3x3(rows, b[0], b[1], b[2])


@subroutine
def invert(a: FloatArray) -> FloatArray:
    """Inverse (n, n) of the symmetric positive definite ``a`` (n, n), which becomes the unit matrix: Gauss-Jordan elimination, which needs
    no pivots there (Golub and Van Loan 2013, 4.2)."""
    n = a.shape[0]
    inverse = np.eye(n)
    for p in range(n):
        scale = 1.0 / a[p, p]
        for q in range(n):
            a[p, q], inverse[p, q] = a[p, q] * scale, inverse[p, q] * scale
        for r in range(n):
            factor = a[r, p] if r != p else 0.0
            for q in range(n):
                a[r, q], inverse[r, q] = a[r, q] - factor * a[p, q], inverse[r, q] - factor * inverse[p, q]
    return inverse


_SWEEPS = 6
"""Jacobi's method converges quadratically: three sweeps give single precision, six double."""


@subroutine
def diagonalize(a: FloatArray) -> FloatArray:
    """Eigenvectors (3, 3) of the symmetric ``a`` (3, 3), in columns; its eigenvalues are left on its diagonal.

    Jacobi's cyclic method (Golub and Van Loan 2013, 8.5).
    """
    vectors = np.empty((3, 3))
    vectors[:] = 0.0
    vectors[0, 0] = vectors[1, 1] = vectors[2, 2] = 1.0
    for _ in range(_SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                _rotate(a, vectors, p, q)
    return vectors


@subroutine
def _rotate(a: FloatArray, vectors: FloatArray, p: int, q: int) -> None:
    """Turn axes ``p`` and ``q`` so that ``a[p, q]`` becomes 0."""
    angle = 0.5 * math.atan2(2.0 * a[p, q], a[q, q] - a[p, p])
    c, s = math.cos(angle), math.sin(angle)
    for k in range(3):
        a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
        vectors[k, p], vectors[k, q] = c * vectors[k, p] - s * vectors[k, q], s * vectors[k, p] + c * vectors[k, q]
    for k in range(3):
        a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]


@subroutine
def multiply(a: FloatArray, v: Triple) -> Triple:
    """``a @ v`` for ``a`` (3, 3)."""
    return (
        a[0, 0] * v[0] + a[0, 1] * v[1] + a[0, 2] * v[2],
        a[1, 0] * v[0] + a[1, 1] * v[1] + a[1, 2] * v[2],
        a[2, 0] * v[0] + a[2, 1] * v[1] + a[2, 2] * v[2],
    )


@subroutine
def multiply_affine(a: FloatArray, v: Triple) -> Triple:
    """`multiply` for ``a`` whose last row is 0, 0, 1, as of adjoints and Jacobians of SE(2)."""
    return a[0, 0] * v[0] + a[0, 1] * v[1] + a[0, 2] * v[2], a[1, 0] * v[0] + a[1, 1] * v[1] + a[1, 2] * v[2], v[2]


@subroutine
def transform_symmetric(a: FloatArray, s: FloatArray) -> FloatArray:
    """``a.T @ s @ a`` for the symmetric ``s`` (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        x, y, z = multiply(s, (a[0, i], a[1, i], a[2, i]))
        for j in range(3):
            out[i, j] = a[0, j] * x + a[1, j] * y + a[2, j] * z
    return out
