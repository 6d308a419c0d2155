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
from localization.estimators.graph_qr import add_product, add_spread, is_covariance, triangularize
from motion_models import se2
from motion_models.se2 import FloatArray, triple

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
        old, new = len(self.rhs), len(self.rhs) + len(error)
        delta, cov, by_slow = self.delta.copy(), self.cov.copy(), self.d_slow.copy()
        rows, rhs = np.empty((new, self.n_slow)), np.empty(new)
        rows[:old], rhs[:old] = self.rows, self.rhs
        _condition(delta, cov, by_slow, error, d_delta, d_slow, variances, rows[old:], rhs[old:])
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
        both = np.zeros((max(len(self.rhs), m), m + 1))
        both[: len(self.rhs), :m], both[: len(self.rhs), m] = self.rows, self.rhs
        triangularize(both, m)
        return both[:m, :m], both[:m, m]


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
def _condition(
    delta: FloatArray,
    cov: FloatArray,
    d_state: FloatArray,
    error: FloatArray,
    d_delta: FloatArray,
    d_slow: FloatArray,
    variances: FloatArray,
    rows: FloatArray,
    rhs: FloatArray,
) -> None:  # pragma: no cover
    """Condition a motion on r scalar measurements, one after the other: see `Link.observe`.

    Changes ``delta`` (3,), ``cov`` (3, 3) and ``d_state`` (3, m), the change of the motion by the slow states; fills ``rows`` (r, m) and
    ``rhs`` (r,), what the innovations say of the slow states in unit variances.
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

    # the mean has moved, and perturbations with it
    x, y, t = se2.scalar_compose(triple(delta), se2.scalar_exp(triple(shift)))
    delta[0], delta[1], delta[2] = x, y, t
    J, conditioned, moved = np.empty((3, 3)), cov.copy(), d_state.copy()
    se2.fill_right_jacobian(triple(shift), J)
    cov[:], d_state[:] = 0.0, 0.0
    add_product(d_state, J, moved)
    add_spread(cov, J, conditioned)


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
