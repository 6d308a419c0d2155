"""Pose graph in GTSAM: keyframes, tied by wheels, scan matching, loop closures and positions, with the motion model's corrections.

    x_k          keyframe poses ``map_T_body``
    c_j          corrections of the motion model (k, centre of rotation, ... by name): one vector for each minute or so, a random walk
    t, l         ``enu_T_map`` and the lever arm of the positions' antenna, if there are positions

Incremental by ISAM2 (Kaess et al. 2012) on the way; Levenberg-Marquardt and marginals at the end. All perturbations act on the right.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from localization.core.measurements.position import predict_position
from localization.core.measurements.relative_pose import motion_residual
from localization.errors import EstimatorError
from localization.estimators.keyframe_motion import PreintegratedMotion
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2

_ALIGNMENT, _LEVER = gtsam.symbol("t", 0), gtsam.symbol("l", 0)
_FIRST_SIGMA = np.array([1e-3, 1e-3, 1e-4])
"""The first keyframe is the origin of the map [m, m, rad]."""
_CAUCHY = 1.0
"""Scale of the robust loss of loop closures [sigma]."""
_HUBER = 1.345
"""Scale of the robust loss of wheels and positions [sigma]: 95 % efficiency on Gaussian noise (Huber 1981)."""
LEVER_SIGMA_M = 0.5
"""Prior sigma of the antenna's lever arm around the given one, along each axis [m]: half of a robot's length."""
_ALIGNMENT_SIGMA = np.array([1e3, 1e3, 1e3])
_RELINEARIZE = 0.01
"""Change of a variable from which its factors are linearized anew [m, rad]. With GTSAM's 0.1 a loop that closes 0.15 m keeps the weight
that its robust loss had before: sigma of the last pose of 41 was 0.14 m, where the batch solution has 0.026 m."""
_MAX_UPDATES = 5
"""Updates of ISAM2 after a loop, at most."""
_MAX_ITERATIONS = 50
_CONVERGED = 1e-6
"""Relative change of the cost at which the optimization ends: a tenth of GTSAM's own default."""


@dataclass(frozen=True)
class BetweenMeasurement:
    """A measured motion from keyframe ``a`` to keyframe ``b``, with the information (3, 3) of its right perturbation."""

    a: int
    b: int
    delta: Pose2
    information: FloatArray
    is_loop: bool = False


@dataclass(frozen=True)
class PositionMeasurement:
    """A position by GPS, at ``offset`` (3,) from keyframe ``k``."""

    k: int
    offset: FloatArray
    position: FloatArray
    """(2,) east, north [m]."""
    cov: FloatArray
    """(2, 2)"""


@dataclass(frozen=True)
class GraphUpdate:
    """New variables and factors of one update. The same updates in the same order give the same graph to the last bit."""

    pose: Pose2 | None = None
    """(3,) initial value of the next keyframe, if there is one."""
    wheels: PreintegratedMotion | None = None
    epoch_cov: FloatArray | None = None
    """(c, c) if the corrections go on as a new variable: how far they may have changed."""
    betweens: tuple[BetweenMeasurement, ...] = ()
    positions: tuple[PositionMeasurement, ...] = ()
    alignment: Pose2 | None = None
    """(3,) initial value of ``enu_T_map``, with the first positions."""


@dataclass
class PoseGraph:
    """Add keyframes by `apply`; `poses`, `corrections` and `marginal` are the estimates by all that was added."""

    prior_cov: FloatArray
    """(c, c) of the corrections, around zero."""
    lever: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) of the positions' antenna in the body frame [m]."""
    updates: list[GraphUpdate] = field(default_factory=list)

    def __post_init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = 1
        params.setRelinearizeThreshold(_RELINEARIZE)
        params.setFactorization("QR")  # CHOLESKY ended in IndeterminateLinearSystem after thousands of ordinary steps
        self._isam, self.count, self._epochs = gtsam.ISAM2(params), 0, 0
        self._values = gtsam.Values()
        updates, self.updates = self.updates, []
        for update in updates:
            self.apply(update)

    def __getstate__(self) -> dict[str, Any]:
        return {"prior_cov": self.prior_cov, "lever": self.lever, "updates": self.updates}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def apply(self, update: GraphUpdate) -> None:
        """Add ``update`` and solve."""
        self.updates.append(update)
        factors, values = self._factors(update)
        with check_solvable():
            self._isam.update(factors, values)
            if any(between.is_loop for between in update.betweens) or update.alignment is not None:
                self._iterate()
            self._values = self._isam.calculateEstimate()

    def _iterate(self) -> None:
        """Until nothing changes: a robust loss gives what was just closed its weight only step by step."""
        for _ in range(_MAX_UPDATES):
            if not self._isam.update().getVariablesRelinearized():
                break

    def pose(self, k: int) -> Pose2:
        """(3,) ``map_T_body`` of keyframe ``k``."""
        return _array(self._values.atPose2(gtsam.symbol("x", k)))

    def poses(self) -> FloatArray:
        """(count, 3)"""
        values = gtsam.utilities.extractPose2(self._values)  # in order of keys: before x, there may be t
        return np.asarray(values[len(values) - self.count :])

    def marginal(self, k: int) -> Cov3:
        """(3, 3) covariance of keyframe ``k``."""
        return np.asarray(self._isam.marginalCovariance(gtsam.symbol("x", k)))

    def lever_arm(self) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) and covariance (2, 2) of where the positions' antenna is in the body frame [m]."""
        if not self._values.exists(_LEVER):
            return self.lever, LEVER_SIGMA_M**2 * np.eye(2)
        return np.asarray(self._values.atPoint2(_LEVER)), np.asarray(self._isam.marginalCovariance(_LEVER))

    @property
    def enu_T_map(self) -> Pose2 | None:
        """(3,) of the map in the plane of the positions; None without positions."""
        return _array(self._values.atPose2(_ALIGNMENT)) if self._values.exists(_ALIGNMENT) else None

    def alignment(self) -> tuple[Pose2, Cov3] | None:
        """``enu_T_map`` (3,) and the covariance (3, 3) of its right perturbation; None without positions."""
        pose = self.enu_T_map
        return None if pose is None else (pose, np.asarray(self._isam.marginalCovariance(_ALIGNMENT)))

    def position_errors(self) -> FloatArray:
        """(n,) normalised errors [sigma] of the positions by the present estimates."""
        positions = [position for update in self.updates for position in update.positions]
        errors = [position_factor(position).unwhitenedError(self._values) for position in positions]  # whitened ones have the robust weight
        return np.array([np.sqrt(e @ np.linalg.solve(position.cov, e)) for e, position in zip(errors, positions, strict=True)])

    def corrections(self) -> tuple[FloatArray, FloatArray]:
        """Mean (c,) and covariance (c, c) of the corrections."""
        if not len(self.prior_cov) or not self.count:
            return np.zeros(len(self.prior_cov)), self.prior_cov
        key = gtsam.symbol("c", self._epochs)
        return np.asarray(self._values.atVector(key)), np.asarray(self._isam.marginalCovariance(key))

    def smooth(self) -> tuple[FloatArray, FloatArray]:
        """Poses (count, 3) by all measurements, by Levenberg-Marquardt, and their covariances (count, 3, 3). Raises `EstimatorError`."""
        graph, values = gtsam.NonlinearFactorGraph(), self._isam.calculateEstimate()
        count, self.count, self._epochs = self.count, 0, 0
        for update in self.updates:
            graph.push_back(self._factors(update)[0])
        assert self.count == count
        with check_solvable():
            values = levenberg_marquardt(graph, values)
            linear = graph.linearize(values)
            marginals = gtsam.Marginals(linear, linear.optimize())
            covs = np.array([marginals.marginalCovariance(gtsam.symbol("x", k)) for k in range(count)])
        self._values = values
        if not (np.isfinite(self.poses()).all() and np.isfinite(covs).all()):
            raise EstimatorError("the pose graph has no finite solution. Check the log with `skidloc info`, and the robot file's noise.")
        return self.poses(), covs

    def _factors(self, update: GraphUpdate) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if update.pose is not None:
            self._add_keyframe(update.pose, factors, values)
        k = self.count - 1
        if update.epoch_cov is not None:
            self._add_correction_epoch(update.epoch_cov, factors, values)
        if update.wheels is not None:
            factors.add(wheel_factor(k - 1, k, gtsam.symbol("c", self._epochs), update.wheels))
        for between in update.betweens:
            noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(between.information)
            if between.is_loop:
                noise = robust_loop_noise(noise)
            a, b = (gtsam.symbol("x", i) for i in (between.a, between.b))
            factors.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*between.delta), noise))
        if update.alignment is not None:
            sigma = gtsam.noiseModel.Diagonal.Sigmas
            factors.add(gtsam.PriorFactorPose2(_ALIGNMENT, gtsam.Pose2(*update.alignment), sigma(_ALIGNMENT_SIGMA)))
            factors.add(gtsam.PriorFactorPoint2(_LEVER, self.lever, sigma(np.full(2, LEVER_SIGMA_M))))
            values.insert(_ALIGNMENT, gtsam.Pose2(*update.alignment))
            values.insert(_LEVER, self.lever)
        for position in update.positions:
            factors.add(position_factor(position))
        return factors, values

    def _add_keyframe(self, pose: Pose2, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        key = gtsam.symbol("x", self.count)
        values.insert(key, gtsam.Pose2(*pose))
        if not self.count:
            factors.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(*pose), gtsam.noiseModel.Diagonal.Sigmas(_FIRST_SIGMA)))
            if len(self.prior_cov):
                prior = np.zeros(len(self.prior_cov))
                factors.add(gtsam.PriorFactorVector(gtsam.symbol("c", 0), prior, gtsam.noiseModel.Gaussian.Covariance(self.prior_cov)))
                values.insert(gtsam.symbol("c", 0), prior)
        self.count += 1

    def _add_correction_epoch(self, cov: FloatArray, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        before, after = gtsam.symbol("c", self._epochs), gtsam.symbol("c", self._epochs + 1)
        factors.add(gtsam.BetweenFactorVector(before, after, np.zeros(len(cov)), gtsam.noiseModel.Gaussian.Covariance(cov)))
        values.insert(after, self._values.atVector(before))
        self._epochs += 1


def wheel_factor(a: int, b: int, corrections: int, wheels: PreintegratedMotion) -> gtsam.CustomFactor:
    """log((delta exp(D (c - c0)))^-1 (x_a^-1 x_b)): the motion model's prediction as a factor of both poses and the corrections."""
    keys = [gtsam.symbol("x", a), gtsam.symbol("x", b)]
    has_corrections = wheels.by_corrections.any()
    if has_corrections:
        keys.append(corrections)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        D = wheels.by_corrections
        shift = D @ (values.atVector(corrections) - wheels.at) if has_corrections else np.zeros(3)
        predicted = se2.retract(wheels.delta, shift)
        residual, by_a, by_b = motion_residual(_array(values.atPose2(keys[0])), _array(values.atPose2(keys[1])), predicted)
        if H is not None:
            H[0], H[1] = np.asfortranarray(by_a), np.asfortranarray(by_b)
            if has_corrections:
                by_predicted = -by_b @ se2.adjoint(se2.exp(-residual))
                H[2] = np.asfortranarray(by_predicted @ se2.right_jacobian(shift) @ D)
        return residual

    return robust_factor(keys, wheels.cov, error)


def position_factor(position: PositionMeasurement) -> gtsam.CustomFactor:
    """t x_k (offset l) - p: where the antenna at lever arm l is, against the measured position."""
    key = gtsam.symbol("x", position.k)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        enu_T_map, map_T_key, lever = _array(values.atPose2(_ALIGNMENT)), _array(values.atPose2(key)), np.asarray(values.atPoint2(_LEVER))
        predicted, *jacobians = predict_position(enu_T_map, map_T_key, position.offset, lever)
        if H is not None:
            H[0], H[1], H[2] = map(np.asfortranarray, jacobians)
        return np.asarray(predicted - position.position)

    return robust_factor([_ALIGNMENT, key, _LEVER], position.cov, error)


def robust_loop_noise(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
    """``noise`` of a loop closure, with a Cauchy loss: one that is wrong pulls little."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY), noise)


def robust_factor(keys: Sequence[int], cov: FloatArray, error: Callable[..., FloatArray]) -> gtsam.CustomFactor:
    """Pass a covariance, never a lower-triangular root: GTSAM takes that as diagonal, silently."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    return gtsam.CustomFactor(gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov)), list(keys), error)


def levenberg_marquardt(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """GTSAM's own loop copies all values at every Python callback; this one does the same without: damped steps until the cost stays."""
    cost, damping = graph.error(values), 0.0
    for _ in range(_MAX_ITERATIONS):
        linear = graph.linearize(values)
        for key, n in values.dims().items() if damping else ():
            linear.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
        moved = values.retract(linear.optimize())
        new_cost = graph.error(moved)
        if new_cost > cost * (1.0 + 1e-12) + 1e-12:
            damping = max(10.0 * damping, 1e-3)
            continue
        values, is_done = moved, cost - new_cost <= _CONVERGED * cost + 1e-9
        cost, damping = new_cost, 0.1 * damping if damping > 1e-6 else 0.0
        if is_done:
            break
    return values


@contextlib.contextmanager
def check_solvable() -> Iterator[None]:
    """Raises `EstimatorError` in place of GTSAM's error for systems that rounding makes singular."""
    try:
        yield
    except RuntimeError as error:
        raise EstimatorError(
            "the pose graph cannot be solved: some covariances are far smaller than others. Check those of the positions and the robot "
            f"file's noise. (GTSAM: {str(error).strip().splitlines()[0]})"
        ) from error


def _array(pose: gtsam.Pose2) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])
