"""Links: all that wheels, gyro and standing still say of the motion between two nodes, preintegrated into one Gaussian.

Given the slow states s (gyro bias, clock offset, corrections of the model), the relative motion is Gaussian: ``delta exp(D (s - s0))`` and
a covariance. What wheels and gyro say together about s itself (they see the same turn) are rows ``R (s - s0) = r`` of unit variance.
Links compose, so nodes need not be where samples are (Forster et al., "On-manifold preintegration", TRO 2017, here with wheels).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_qr import condition, is_covariance, product, triangularize
from motion_models import se2
from motion_models.se2 import FloatArray

_LEAST = 1e-12 * np.eye(3)  # m^2, rad^2: below this a motion is as good as certain, and the numbers stay finite


@dataclass(frozen=True)
class Link:
    """The motion from one moment to a later one, m slow states."""

    delta: FloatArray
    """(3,) relative pose at the slow states ``at``."""
    cov: FloatArray
    """(3, 3) of its right perturbation, given the slow states."""
    d_slow: FloatArray
    """(3, m) change of ``delta`` (right perturbation) by the slow states."""
    at: FloatArray
    """(m,)"""
    rows: FloatArray
    """(r, m) what the witnesses say together about the slow states: ``rows @ (s - at) = rhs`` with unit variances."""
    rhs: FloatArray
    """(r,)"""
    duration: float
    """[s]"""
    moving: float
    """Part of the duration in which wheels moved [s]."""

    @property
    def n_slow(self) -> int:
        return len(self.at)

    def observe(self, error: FloatArray, d_delta: FloatArray, d_slow: FloatArray, variances: FloatArray) -> Link:
        """Condition on r scalar measurements of this motion.

        ``error`` (r,) = measured - predicted = d_delta (r, 3) perturbation + d_slow (r, m) (s - at) + noise of ``variances`` (r,).
        """
        delta, cov, by_slow, rows, rhs = _observe(self.delta, self.cov, self.d_slow, self.rows, self.rhs, error, d_delta, d_slow, variances)
        return Link(delta, cov, by_slow, self.at, rows, rhs, self.duration, self.moving)

    def rebased(self, at: FloatArray) -> Link:
        """The same link expanded at other slow states (m,)."""
        change = at - self.at
        if not change.any():
            return self
        shift = self.d_slow @ change
        J = se2.right_jacobian(shift)
        return replace(
            self,
            delta=se2.compose(self.delta, se2.exp(shift)),
            cov=J @ self.cov @ J.T,
            d_slow=J @ self.d_slow,
            at=at,
            rhs=self.rhs - self.rows @ change,
        )

    def then(self, later: Link) -> Link:
        """This motion and the ``later`` one as one, expanded where this one is; the slow states do not walk in between."""
        later = later.rebased(self.at)
        A = se2.adjoint(se2.inverse(later.delta))
        return Link(
            se2.compose(self.delta, later.delta),
            A @ self.cov @ A.T + later.cov,
            A @ self.d_slow + later.d_slow,
            self.at,
            np.vstack([self.rows, later.rows]),
            np.append(self.rhs, later.rhs),
            self.duration + later.duration,
            self.moving + later.moving,
        )

    def compressed(self) -> tuple[FloatArray, FloatArray]:
        """``rows`` and ``rhs`` as exactly m rows (m, m), (m,) that say the same about the slow states."""
        m = self.n_slow
        rows, rhs = np.empty((m, m)), np.empty(m)
        compress(self.rows, self.rhs, rows, rhs)
        return rows, rhs


def first_link(delta: FloatArray, cov: FloatArray, d_slow: FloatArray, at: FloatArray, duration: float, moving: float) -> Link:
    """A link of a motion ``delta`` (3,) alone. Raises `EstimatorError` for numbers that are no motion."""
    check_motion(delta, cov, "the wheels' motion")
    if not math.isfinite(d_slow.sum()):
        raise EstimatorError(
            "the derivatives of the wheels' motion are not finite: check the log's wheel rates and the model's parameters."
        )
    m = len(at)
    return Link(delta, np.ascontiguousarray(cov + _LEAST), d_slow, at, np.empty((0, m)), np.empty(0), duration, moving)


@numba.njit(cache=True)
def _observe(
    delta: FloatArray,
    cov: FloatArray,
    d_state: FloatArray,
    rows: FloatArray,
    rhs: FloatArray,
    error: FloatArray,
    d_delta: FloatArray,
    d_slow: FloatArray,
    variances: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:  # pragma: no cover
    """`Link.observe`: the new delta, cov, d_slow, rows and rhs."""
    r, old = error.shape[0], rhs.shape[0]
    cov, d_state = cov.copy(), d_state.copy()
    all_rows, all_rhs = np.empty((old + r, rows.shape[1])), np.empty(old + r)
    all_rows[:old], all_rhs[:old] = rows, rhs
    shift = condition(cov, d_state, error, d_delta, d_slow, variances, all_rows[old:], all_rhs[old:])
    J = np.empty((3, 3))
    se2.fill_right_jacobian(shift, J)
    there: FloatArray = np.array(se2.scalar_compose(delta, se2.scalar_exp(shift)))
    return there, product(product(J, 0.5 * (cov + cov.T)), J.T), product(J, d_state), all_rows, all_rhs


@numba.njit(cache=True)
def compress(rows: FloatArray, rhs: FloatArray, m_rows: FloatArray, m_rhs: FloatArray) -> None:  # pragma: no cover
    """Fill ``m_rows`` (m, m) and ``m_rhs`` (m,) with what ``rows`` (r, m) and ``rhs`` (r,) say."""
    r, m = rows.shape
    both = np.zeros((max(r, m), m + 1))
    both[:r, :m], both[:r, m] = rows, rhs
    if r > m:
        triangularize(both, m)
    m_rows[:], m_rhs[:] = both[:m, :m], both[:m, m]


def check_motion(delta: FloatArray, cov: FloatArray, what: str) -> None:
    """Raises `EstimatorError` unless ``delta`` (3,) is finite and ``cov`` (3, 3) a covariance."""
    if delta.shape != (3,) or not math.isfinite(delta[0] + delta[1] + delta[2]):
        raise EstimatorError(f"{what} is {delta}: it must be three finite numbers.")
    check_covariance(cov, 3, what)


def check_covariance(cov: FloatArray, n: int, what: str) -> None:
    """Raises `EstimatorError` unless ``cov`` is an (n, n) covariance, which may be singular."""
    if cov.shape != (n, n):
        raise EstimatorError(f"the covariance of {what} must be {n} x {n} numbers, found shape {cov.shape}.")
    if not is_covariance(cov):
        raise EstimatorError(f"the covariance of {what} is not finite, symmetric and positive: {cov.tolist()}.")
