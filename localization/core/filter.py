"""The error-state Kalman filter: the only code that writes the covariance of a `State`. A state in, a new state out.

Each function is one equation of the textbook (Barfoot, "State Estimation for Robotics", 2017, ch. 3; Särkkä, "Bayesian Filtering and
Smoothing", 2013, ch. 4) on the errors of all variables, whatever their groups are. What a step or a sensor means is in
`localization.core.measurements`, as Jacobians by the names of variables.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from filterpy.kalman import predict

from localization.core.state import Layout, Perturbation, State
from localization.errors import EstimatorError
from motion_models.groups import Group
from motion_models.se2 import FloatArray

_STEP_MOMENTS = np.array([[2.0 / 15.0, -0.1], [-0.1, 1.2]])
"""E (a, b)^T (a, b) of the line that is next to a step at a uniform time (`add_change`)."""
_MAX_NUMBER = 1e12
"""No state or covariance of a robot on Earth is larger, in SI units."""


@dataclass(frozen=True, eq=False)
class Transition:
    """Change of means and errors: e' = F e + w, cov(w) = Q. Variables that are not named are constant and without noise."""

    means: Mapping[str, FloatArray] = field(default_factory=dict)
    """New means of the variables that move."""
    jacobians: Mapping[tuple[str, str], FloatArray] = field(default_factory=dict)
    """Blocks (k, m) of F: derivative of the new error of the first variable by the old error of the second. Where none is given, F is
    the identity."""
    noise: Mapping[str, FloatArray] = field(default_factory=dict)
    """Blocks (k, k) on the diagonal of Q."""
    what: str = "a transition"
    """Name of the transition in error messages."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """A linearized measurement: residual = sum of H_i e_i + n over the variables i, cov(n) = R."""

    residual: FloatArray
    """(m,) what is measured less what the means predict."""
    jacobians: Mapping[str, FloatArray]
    """H_i (m, k) by the name of the variable."""
    R: FloatArray
    """(m, m) covariance of the sensor's noise."""
    relative: tuple[str, str] | None = None
    """Variable whose error relative to that of a second one is measured, where the second is considered: the gain of the first then
    minimises the covariance of the difference (`update`)."""
    what: str = "a measurement"
    """Name of the measurement in error messages."""


@dataclass(frozen=True, eq=False)
class Innovation:
    """Innovation of an update, with its covariance, Jacobian and gain."""

    residual: FloatArray
    """(m,)"""
    S: FloatArray
    """(m, m) its covariance, H P H^T + R."""
    H: FloatArray
    """(m, n)"""
    K: FloatArray
    """(n, m); zero for considered variables."""

    @cached_property
    def nis(self) -> float:
        """Normalised innovation squared, residual^T S^-1 residual: chi-square with m degrees of freedom."""
        return float(self.residual @ np.linalg.solve(self.S, self.residual))

    def nis_of(self, rows: list[int]) -> float:
        """NIS of some ``rows`` of the residual: chi-square with as many degrees of freedom."""
        residual = self.residual[rows]
        return float(residual @ np.linalg.solve(self.S[np.ix_(rows, rows)], residual))

    def component(self, i: int) -> tuple[float, float]:
        """Component ``i`` of the residual and its variance."""
        return float(self.residual[i]), float(self.S[i, i])


def begin(variables: Mapping[str, tuple[Group, FloatArray, FloatArray]]) -> State:
    """The state of these ``variables``, each a group, a mean and a covariance (k, k), whose errors are independent."""
    layout = Layout({name: group for name, (group, _, _) in variables.items()})
    P = np.zeros((sum(group.dim for group in layout.groups.values()),) * 2)
    for name, (_, _, cov) in variables.items():
        P[layout.rows[name], layout.rows[name]] = cov
    return State(layout, {name: mean for name, (_, mean, _) in variables.items()}, P)


def propagate(state: State, transition: Transition) -> State:
    """The state after ``transition``: P' = F P F^T + Q. Raises `EstimatorError` for numbers that would spoil the state for good."""
    n, rows = len(state.P), state.layout.rows
    F, Q = np.eye(n), np.zeros((n, n))
    for (to, by), block in transition.jacobians.items():
        F[rows[to], rows[by]] = block
    for name, block in transition.noise.items():
        Q[rows[name], rows[name]] = block
    _, P = predict(np.zeros(n), state.P, F=F, Q=Q)  # F @ P @ F.T + Q
    _check(transition.what, *transition.means.values(), P)
    return State(state.layout, {**state.means, **transition.means}, P)


def update(state: State, measurement: Measurement, considered: Collection[str] = ()) -> tuple[State, Innovation]:
    """The state after ``measurement``, and the innovation. Raises `EstimatorError` for numbers that would spoil the state for good.

        S = H P H^T + R      K = P H^T S^-1      d = K residual      P' = G [(I - K H) P (I - K H)^T + K R K^T] G^T

    ``considered`` variables keep their means: their rows of K are zero, and their covariance and correlations count (Schmidt 1966,
    consider states). Joseph's form is the covariance for any gain, and each row of K has an aim of its own: K_i = P_i H^T S^-1 minimises
    E (e_i - K_i y)^2 for innovation y, whatever the other rows are.

    Of a measurement that is `Measurement.relative`, of a variable a against a considered b, the rows of a minimise the covariance of the
    difference: E |e_a - e_b - K y|^2 is least at K = (P_a - P_b) H^T S^-1, the difference of both optimal gains. With its own optimal gain,
    a pose that is better known than the submap around it would stay off the submap, and later scans be matched from a wide prior.

    G turns the error of the submap with the pose that d has moved (`_reset_jacobian`).
    """
    P, R, residual, rows = state.P, measurement.R, measurement.residual, state.layout.rows
    H = np.zeros((len(residual), len(P)))
    for name, block in measurement.jacobians.items():
        H[:, rows[name]] = block
    S = H @ P @ H.T + R
    _check(measurement.what, residual, S)
    K = np.asarray(np.linalg.solve(S, H @ P).T, dtype=float)  # P H^T S^-1
    if measurement.relative is not None:
        a, b = measurement.relative
        K[rows[a]] -= K[rows[b]]
    for name in considered:
        K[rows[name]] = 0.0
    A = np.eye(len(P)) - K @ H
    means = _retract(state, K @ residual, considered)
    G = _reset_jacobian(state, means)
    P = G @ (A @ P @ A.T + K @ R @ K.T) @ G.T
    P = 0.5 * (P + P.T)
    _check(measurement.what, P)
    return State(state.layout, means, P), Innovation(residual, S, H, K)


def _retract(state: State, error: FloatArray, considered: Collection[str]) -> dict[str, FloatArray]:
    """Means moved by the estimated ``error`` (n,): mean * exp(error)."""
    means = dict(state.means)
    for name, group in state.layout.groups.items():
        if name not in considered:
            means[name] = group.retract(means[name], error[state.layout.rows[name]])
    return means


def _reset_jacobian(state: State, means: Mapping[str, FloatArray]) -> FloatArray:
    """G (n, n) of the errors about ``means``, which an update has moved by d, by those about the former means (Solà 2017, sec. 6.3).

    The true pose is mean exp(e_map) exp(e), to first order e_pose = e_map + e: the submap around the robot is off by e_map, and the pose by
    e against that. Noise of a scan is a perturbation of the pose that it measures, where the new mean is: e keeps its covariance. Of a
    former error e_map the new mean, mean exp(d), has exp(-d) exp(e_map) exp(d) = exp(Ad(exp(-d)) e_map): it keeps its direction in the
    world. Solà's right Jacobian, I - 1/2 ad(d), is for e_map and d that are Gaussian together, as if they had grown at the same time.
    """
    G, rows, groups = np.eye(len(state.P)), state.layout.rows, state.layout.groups
    for name, group in groups.items():
        if isinstance(group, Perturbation):
            pose, before, after = groups[group.of], state[group.of], means[group.of]
            if after is not before:
                A = pose.adjoint(pose.compose(pose.inverse(after), before))
                G[rows[name], rows[name]], G[rows[group.of], rows[name]] = A, A - np.eye(group.dim)
    return G


def clone(state: State, source: str, name: str) -> State:
    """The state with a copy ``name`` of the variable ``source`` as it is now (stochastic cloning, Roumeliotis & Burdick 2002).

    An older variable ``name`` is marginalized, and the copy takes its place.
    """
    if name not in state.means:
        group = state.layout.groups[source]
        state = augment(state, name, group, state[source], np.zeros((group.dim, group.dim)))
    P, copy, original = state.P.copy(), state.layout.rows[name], state.layout.rows[source]
    P[copy, :] = P[original, :]
    P[:, copy] = P[:, original]
    return State(state.layout, {**state.means, name: state[source]}, P)


def augment(state: State, name: str, group: Group, mean: FloatArray, cov: FloatArray) -> State:
    """The state with another variable ``name``, whose error is independent of the others, with covariance ``cov`` (k, k)."""
    n = len(state.P)
    P = np.zeros((n + group.dim, n + group.dim))
    P[:n, :n], P[n:, n:] = state.P, cov
    return State(Layout({**state.layout.groups, name: group}), {**state.means, name: mean}, P)


def inflate(state: State, name: str, cov: FloatArray) -> State:
    """The state whose variable ``name`` is off by an independent error more, with covariance ``cov`` (k, k)."""
    P, rows = state.P.copy(), state.layout.rows[name]
    P[rows, rows] += cov
    return State(state.layout, state.means, P)


def inflate_both(state: State, names: tuple[str, str], cov: FloatArray) -> State:
    """The state whose two variables ``names`` are off by one and the same independent error more, with covariance ``cov`` (k, k): that of
    their difference stays as it is."""
    P = state.P.copy()
    for a in names:
        for b in names:
            P[state.layout.rows[a], state.layout.rows[b]] += cov
    return State(state.layout, state.means, P)


def widen(state: State, name: str, variance: float) -> State:
    """The state whose variable ``name``, of one dimension, has at least this ``variance``: what was known of it was known too well.

    The errors of all variables that come from its own grow with it: P' = P + (variance - P_nn) c c^T with their regression c = P_n / P_nn.
    """
    row = state.layout.rows[name].start
    known = state.P[row, row]
    c = state.P[:, row] / known
    return State(state.layout, state.means, state.P + max(variance - known, 0.0) * np.outer(c, c))


def add_change(state: State, name: str, variance: float, by: str, seconds: float) -> State:
    """The state whose variable ``name``, of one dimension, has changed by an independent error with this ``variance``, at a time that is
    unknown in the last ``seconds``. ``by`` (2,) is considered, and adds to ``name`` since then: a constant, and a slope over time.

    A change d at the share s of that time is, over all of it, next to the line d (a + b t / seconds), b = 6 s (1 - s), a = 1 - s - b / 2:
    the least squares of a step. With s uniform, E (a, b) = (0, 1), that of a ramp. What the line has done to the other errors is C (a, b).
    """
    row, rows = state.layout.rows[name].start, state.layout.rows[by]
    C = np.linalg.solve(state.P[rows, rows] * [1.0, max(seconds, 1e-9)], state.P[rows, :]).T
    C[rows], C[row] = 0.0, 0.0
    one = np.eye(len(C))[row]
    ramp = np.outer(C[:, 1], one)
    return State(state.layout, state.means, state.P + variance * (C @ _STEP_MOMENTS @ C.T + ramp + ramp.T + np.outer(one, one)))


def set_marginal(state: State, name: str, mean: FloatArray, cov: FloatArray) -> State:
    """The state with ``mean`` and ``cov`` (k, k) of the variable ``name`` by another estimator, which has used these measurements too:
    correlations with the other variables are dropped."""
    P, rows = state.P.copy(), state.layout.rows[name]
    P[rows, :] = P[:, rows] = 0.0
    P[rows, rows] = cov
    return State(state.layout, {**state.means, name: mean}, P)


def _check(what: str, *arrays: FloatArray) -> None:
    for array in arrays:
        if not (np.abs(array) < _MAX_NUMBER).all():
            raise EstimatorError(
                f"{what} has numbers that are not finite, or too large to compute with. Check that sensor's messages in the log."
            )
