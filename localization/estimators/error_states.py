"""What becomes of the covariance of errors as poses move, are cloned and corrected. Compiled scalar loops, as in `graph_qr`.

Of the N states of ``P`` (N, N), symmetric, the first three are the pose now. Functions that are called from outside give a new matrix.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_qr import add_spread, inverse_root, product
from motion_models import se2
from motion_models.se2 import FloatArray, triple


@numba.njit("void(f8[:, ::1], i8, f8[:, ::1], i8, i8)", cache=True)  # once, instead of anew for each literal
def replace(P: FloatArray, at: int, M: FloatArray, first: int, m: int) -> None:  # pragma: no cover
    """In place: the three states from ``at`` on become the first m columns of ``M`` (3, ...) times m states from ``first`` on."""
    size = P.shape[0]
    rows, own = np.zeros((3, size)), np.zeros((3, 3))
    for i in range(3):
        for k in range(m):
            for j in range(size):
                rows[i, j] += M[i, k] * P[first + k, j]
    for i in range(3):
        for k in range(m):
            for j in range(3):
                own[i, j] += rows[i, first + k] * M[j, k]
    for i in range(3):
        for j in range(size):
            P[at + i, j] = rows[i, j]
            P[j, at + i] = rows[i, j]
    for i in range(3):
        for j in range(3):
            P[at + i, at + j] = 0.5 * (own[i, j] + own[j, i])


@numba.njit(cache=True)
def moved(P: FloatArray, delta: FloatArray, D: FloatArray, Q: FloatArray) -> FloatArray:  # pragma: no cover
    """The pose moves by ``delta`` (3,), which depends by ``D`` (3, k) on the last k of the first n states, with noise ``Q`` (n, n):

    e' = Ad(delta^-1) e + D x + q. Poses behind the n states move on into the frame of the pose now.
    """
    out, n, k = P.copy(), Q.shape[0], D.shape[1]
    M = np.zeros((3, n))
    se2.fill_adjoint(se2.scalar_inverse(triple(delta)), M)
    for i in range(3):
        for j in range(k):
            M[i, n - k + j] = D[i, j]
    replace(out, 0, M, 0, n)
    for pose in range(n, P.shape[0], 3):
        replace(out, pose, M, pose, 3)
    for i in range(n):
        for j in range(n):
            out[i, j] += Q[i, j]
    return out


@numba.njit(cache=True)
def cloned(P: FloatArray, at: int) -> FloatArray:  # pragma: no cover
    """The three states from ``at`` on become the pose now."""
    out = P.copy()
    for i in range(3):
        for j in range(P.shape[0]):
            out[at + i, j] = P[i, j]
            out[j, at + i] = P[i, j]
    for i in range(3):
        for j in range(3):
            out[at + i, at + j] = P[i, j]
    return out


@numba.njit(cache=True)
def corrected(P: FloatArray, K: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:  # pragma: no cover
    """(I - K H) P (I - K H)^T + K R K^T for any gain ``K`` (n, r) on the first n states, ``H`` (r, m) of the first m, ``R`` (r, r)."""
    size, n, r, m = P.shape[0], K.shape[0], K.shape[1], H.shape[1]
    out, seen, by_noise = P.copy(), np.zeros((r, size)), product(K, R)
    for a in range(r):
        for k in range(m):
            if H[a, k] != 0.0:  # most are
                for j in range(size):
                    seen[a, j] += H[a, k] * P[k, j]
    for i in range(n):
        for a in range(r):
            for j in range(size):
                out[i, j] -= K[i, a] * seen[a, j]
    for i in range(size):
        for a in range(r):
            seen[a, i] = by_noise[i, a] if i < n else 0.0
            for k in range(m):
                seen[a, i] -= out[i, k] * H[a, k]
    for i in range(size):
        for a in range(r):
            for j in range(n):
                out[i, j] += seen[a, i] * K[j, a]
    make_symmetric(out)
    return out


@numba.njit(cache=True)
def symmetric(P: FloatArray) -> FloatArray:  # pragma: no cover
    """The symmetric part of ``P`` (n, n)."""
    out = P.copy()
    make_symmetric(out)
    return out


@numba.njit(cache=True)
def make_symmetric(P: FloatArray) -> None:  # pragma: no cover
    """`symmetric`, in place."""
    for i in range(P.shape[0]):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j], P[j, i] = mean, mean


@numba.njit(cache=True)
def motion_covariance(P: FloatArray, start: int, delta: FloatArray) -> FloatArray:  # pragma: no cover
    """(3, 3) of the motion ``delta`` (3,) to the pose now from the pose whose states begin at ``start``."""
    both, J, out = np.empty((6, 6)), np.zeros((3, 6)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            both[i, j], both[i, 3 + j] = P[i, j], P[i, start + j]
            both[3 + i, j], both[3 + i, 3 + j] = P[start + i, j], P[start + i, start + j]
    se2.fill_adjoint(se2.scalar_inverse(triple(delta)), J[:, 3:])
    for i in range(3):
        J[i, i] = 1.0
        for j in range(3, 6):
            J[i, j] = -J[i, j]
    add_spread(out, J, both)
    return out


def inverse(S: FloatArray) -> FloatArray:
    """Of ``S`` (n, n), a finite covariance. Raises `EstimatorError` if it is singular."""
    found = quick_inverse(S)
    if math.isnan(found[0, 0]):  # rounding took a pivot: of what is next to nothing beside a huge slip
        try:
            found = np.asarray(np.linalg.inv(S), dtype=float)
        except np.linalg.LinAlgError as singular:
            raise EstimatorError(
                "a measurement without any noise meets a prediction without any: give the sensors of the robot file some noise."
            ) from singular
    return np.asarray(found)


@numba.njit(cache=True)
def quick_inverse(S: FloatArray) -> FloatArray:  # pragma: no cover
    """`inverse` by Cholesky's factors, NaN where there are none."""
    W, n = inverse_root(S), S.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for k in range(n):
                out[i, j] += W[k, i] * W[k, j]
    return out


@numba.njit(cache=True)
def is_usable(numbers: FloatArray) -> bool:  # pragma: no cover
    """All of ``numbers`` (n,) are finite, and so small that their products, as filters form them, are."""
    for x in numbers:  # noqa: SIM110
        if not abs(x) < 1e100:
            return False
    return True


@numba.njit(cache=True)
def eigen(A: FloatArray) -> tuple[FloatArray, FloatArray]:  # pragma: no cover
    """Eigenvalues (n,) in no order and eigenvectors (n, n), in columns, of the symmetric part of ``A`` (n, n).

    Jacobi's rotations (Golub, Van Loan, "Matrix computations", 2013, algorithm 8.5.2).
    """
    n = A.shape[0]
    D, V, values = A.copy(), np.zeros((n, n)), np.empty(n)
    make_symmetric(D)
    for i in range(n):
        V[i, i] = 1.0
    for _ in range(30):  # each sweep squares what is left; some six do
        is_done = True
        for p in range(n):
            for q in range(p + 1, n):
                if abs(D[p, q]) <= 1e-18 * (abs(D[p, p]) + abs(D[q, q])):
                    continue
                is_done = False
                tau = (D[q, q] - D[p, p]) / (2.0 * D[p, q])
                t = math.copysign(1.0, tau) / (abs(tau) + math.hypot(1.0, tau))
                c = 1.0 / math.hypot(1.0, t)
                s = t * c
                for k in range(n):
                    D[k, p], D[k, q] = c * D[k, p] - s * D[k, q], s * D[k, p] + c * D[k, q]
                for k in range(n):
                    D[p, k], D[q, k] = c * D[p, k] - s * D[q, k], s * D[p, k] + c * D[q, k]
                    V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]
                D[p, q], D[q, p] = 0.0, 0.0
        if is_done:
            break
    for i in range(n):
        values[i] = D[i, i]
    return values, V


@numba.njit(cache=True)
def of_eigen(values: FloatArray, vectors: FloatArray) -> FloatArray:  # pragma: no cover
    """(n, n) the symmetric matrix with eigenvalues ``values`` (n,) and eigenvectors ``vectors`` (n, n), in columns."""
    n = len(values)
    out = np.zeros((n, n))
    for k in range(n):
        for i in range(n):
            for j in range(n):
                out[i, j] += values[k] * vectors[i, k] * vectors[j, k]
    return out
