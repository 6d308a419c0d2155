"""Pose graph in GTSAM: keyframes, tied by wheels, scan matching, gravity, loop closures and positions, with the model's corrections.

    x_k          keyframe poses ``map_T_body``, of SE(2) or SE(3)
    c_j          corrections of the motion model (k, centre of rotation, ... by name): one vector for each minute or so, a random walk
    t, l         ``enu_T_map`` and the lever arm of the positions' antenna, if there are positions

What differs between the plane and space is a `Keyframes`. A `PoseGraph` is solved once, by Levenberg-Marquardt; a `LivePoseGraph` also on
the way, by ISAM2 (Kaess et al. 2012). All perturbations act on the right.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.maps.keyframe_map import MeasuredMotion
from motion_models.groups import PoseGroup, between
from motion_models.se2 import FloatArray

ALIGNMENT, LEVER = gtsam.symbol("t", 0), gtsam.symbol("l", 0)
"""Keys of ``enu_T_map`` and of the lever arm of the positions' antenna."""
LEVER_SIGMA_M = 0.5
"""Prior sigma of the antenna's lever arm around the given one, along each axis [m]: half of a robot's length."""
ALIGNMENT_SIGMA = 1e3
"""Prior sigma of ``enu_T_map`` [m, rad]."""
_CAUCHY = 1.0
"""Scale of the robust loss of loop closures [sigma]."""
_HUBER = 1.345
"""Scale of the robust loss of wheels and positions [sigma]: 95 % efficiency on Gaussian noise (Huber 1981)."""
_RELINEARIZE = 0.01
"""Change of a variable from which its factors are linearized anew [m, rad]. With GTSAM's 0.1 a loop that closes 0.15 m keeps the weight
that its robust loss had before: sigma of the last pose of 41 was 0.14 m, where the batch solution has 0.026 m."""
_MAX_UPDATES = 5
"""Updates of ISAM2 after a loop, at most."""
_MAX_ITERATIONS = 50
_CONVERGED = 1e-6
"""Relative change of the cost at which the optimization ends: a tenth of GTSAM's own default."""


@dataclass(frozen=True)
class GravityMeasurement:
    """Gravity in the axes of keyframe ``k``."""

    k: int
    force: FloatArray
    """(3,) upwards [m/s^2]."""
    turned: FloatArray
    """(3, 3) ``key_R_body`` at the measurement: the bias is constant in the body."""
    variance: float
    """[m^2/s^4]"""


@dataclass(frozen=True)
class PositionMeasurement:
    """A position, as by GPS, of the antenna of a body at ``offset`` from keyframe ``k``, (3,) in the plane or (4, 4) in space."""

    k: int
    offset: FloatArray
    position: FloatArray
    """(2,) east and north [m]; in space also (3,), with up where that is measured."""
    cov: FloatArray
    """(2, 2) or (3, 3)"""


@dataclass(frozen=True)
class GraphUpdate:
    """New variables and factors of one update. The same updates in the same order give the same graph to the last bit."""

    pose: FloatArray | None = None
    """Initial value of the next keyframe, if there is one."""
    wheels: PreintegratedMotion | None = None
    epoch_cov: FloatArray | None = None
    """(c, c) if the corrections go on as a new variable: how far they may have changed."""
    motions: tuple[MeasuredMotion, ...] = ()
    gravities: tuple[GravityMeasurement, ...] = ()
    positions: tuple[PositionMeasurement, ...] = ()
    alignment: FloatArray | None = None
    """Initial value of ``enu_T_map``, with the first positions: x, y and yaw, or x, y, z and yaw."""


class Keyframes(Protocol):
    """Poses of a group as GTSAM has them, and the factors that measure them."""

    @property
    def group(self) -> PoseGroup:
        """SE(2) or SE(3)."""

    @property
    def rows(self) -> Sequence[int]:
        """(dim,) rows of GTSAM's tangents in the order of the group's."""

    def value(self, pose: FloatArray, /) -> Any:
        """``pose`` as GTSAM has it."""

    def pose(self, values: gtsam.Values, key: int, /) -> FloatArray:
        """The pose ``key`` of ``values``."""

    def poses(self, values: gtsam.Values, count: int, /) -> FloatArray:
        """The first ``count`` keyframes of ``values``."""

    def first(self, key: int, pose: FloatArray, /) -> gtsam.NonlinearFactor:
        """The prior of the first keyframe, which is the origin of the map."""

    def motion(self, a: int, b: int, delta: FloatArray, noise: gtsam.noiseModel.Base, /) -> gtsam.NonlinearFactor:
        """The motion ``delta`` from the pose ``a`` to ``b``, with ``noise`` in GTSAM's order."""

    def wheels(self, a: int, b: int, corrections: int, wheels: PreintegratedMotion, /) -> gtsam.CustomFactor:
        """The motion model's prediction as a factor of two poses and of the ``corrections``."""

    def gravity(self, measured: GravityMeasurement, /) -> gtsam.CustomFactor:
        """Gravity at a keyframe."""

    def bias_prior(self) -> tuple[int, gtsam.NonlinearFactor] | None:
        """Key and prior, around zero, of the bias that all gravities share; None in the plane."""

    def place(self, alignment: FloatArray, lever: FloatArray, /) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Priors and values of ``enu_T_map`` and of the antenna's ``lever`` arm."""

    def alignment(self, values: gtsam.Values, /) -> FloatArray:
        """``enu_T_map`` of ``values``."""

    def position(self, measured: PositionMeasurement, /) -> gtsam.CustomFactor:
        """t x_k (offset l) - p: where the antenna at lever arm l is, against the measured position."""


@dataclass(frozen=True, eq=False)
class SmoothedKeyframes:
    """Keyframes by all measurements."""

    poses: FloatArray
    """(K, 3) or (K, 4, 4)"""
    covs: FloatArray
    """(K, dim, dim) of their right perturbations."""
    group: PoseGroup
    rows: Sequence[int]
    marginals: gtsam.ISAM2

    def relative_cov(self, a: int, b: int) -> FloatArray:
        """(dim, dim) covariance of the right perturbation of the motion from keyframe ``a`` to ``b``."""
        keys = [gtsam.symbol("x", k) for k in (a, b)]
        joint = self.marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
        cov = np.block([[joint.at(i, j)[np.ix_(self.rows, self.rows)] for j in keys] for i in keys])
        J = np.hstack([-self.group.adjoint(between(self.group, self.poses[b], self.poses[a])), np.eye(self.group.dim)])
        return np.asarray(J @ cov @ J.T)


@dataclass
class PoseGraph:
    """`apply` update after update, and `smooth` all of them."""

    keyframes: Keyframes
    prior_cov: FloatArray
    """(c, c) of the corrections, around zero; (0, 0) without such."""
    lever: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) of the positions' antenna in the body frame [m]."""
    updates: list[GraphUpdate] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.count, self._epochs = 0, 0
        self._values, self._measured = gtsam.Values(), gtsam.NonlinearFactorGraph()
        updates, self.updates = self.updates, []
        for update in updates:
            self.apply(update)

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("keyframes", "prior_cov", "lever", "updates")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def apply(self, update: GraphUpdate) -> None:
        """Add ``update``."""
        _, values = self._add(update)
        self._values.insert(values)

    def _add(self, update: GraphUpdate) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Its new factors but for loops, and its new values."""
        factors, values = self._factors(update)
        self.updates.append(update)
        self._measured.push_back(factors)
        self.count += update.pose is not None
        return factors, values

    def pose(self, k: int) -> FloatArray:
        """``map_T_body`` of keyframe ``k``."""
        return self.keyframes.pose(self._values, gtsam.symbol("x", k))

    def poses(self) -> FloatArray:
        """(count, 3) or (count, 4, 4)"""
        return self.keyframes.poses(self._values, self.count)

    @property
    def motions(self) -> list[MeasuredMotion]:
        """All motions by gyro and scans, and loops."""
        return [motion for update in self.updates for motion in update.motions]

    @property
    def loops(self) -> list[MeasuredMotion]:
        """All loop closures."""
        return [motion for motion in self.motions if motion.is_loop]

    @property
    def enu_T_map(self) -> FloatArray | None:
        """Pose of the map among the positions; None without such."""
        return self.keyframes.alignment(self._values) if self._values.exists(ALIGNMENT) else None

    def position_errors(self) -> FloatArray:
        """(n,) normalised errors [sigma] of the positions by the present estimates."""
        positions = [position for update in self.updates for position in update.positions]
        factors = [self.keyframes.position(position) for position in positions]
        errors = [factor.unwhitenedError(self._values) for factor in factors]  # whitened ones have the robust weight
        return np.array([np.sqrt(e @ np.linalg.solve(position.cov, e)) for e, position in zip(errors, positions, strict=True)])

    def smooth(self) -> SmoothedKeyframes:
        """The keyframes by all measurements. Raises `EstimatorError`."""
        values, graph = self._start(), gtsam.NonlinearFactorGraph()
        graph.push_back(self._measured)
        with check_solvable():
            for loop in self.loops:
                graph.add(self._motion(loop))
            values = levenberg_marquardt(graph, values)
            marginals, rows = make_isam(), self.keyframes.rows
            marginals.update(graph, values)
            covs = np.array([marginals.marginalCovariance(gtsam.symbol("x", k))[np.ix_(rows, rows)] for k in range(self.count)])
        self._values = values
        poses = self.poses()
        if not (np.isfinite(poses).all() and np.isfinite(covs).all()):
            raise EstimatorError("the pose graph has no finite solution. Check the log with `skidloc info`, and the robot file's noise.")
        return SmoothedKeyframes(poses, covs, self.keyframes.group, rows, marginals)

    def _start(self) -> gtsam.Values:
        """Where loops are closed as if they were right: a robust loss does not feel what is hundreds of its scales away."""
        if not self.loops:
            return self._values
        closed = gtsam.NonlinearFactorGraph()
        closed.push_back(self._measured)
        for loop in self.loops:
            closed.add(self._motion(loop, is_robust=False))
        with check_solvable():
            return levenberg_marquardt(closed, self._values)

    def _motion(self, motion: MeasuredMotion, is_robust: bool = True) -> gtsam.NonlinearFactor:
        rows = self.keyframes.rows
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(motion.information[np.ix_(rows, rows)])
        if motion.is_loop and is_robust:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY), noise)
        return self.keyframes.motion(gtsam.symbol("x", motion.a), gtsam.symbol("x", motion.b), motion.delta, noise)

    def _factors(self, update: GraphUpdate) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        kind, factors, values = self.keyframes, gtsam.NonlinearFactorGraph(), gtsam.Values()
        k = self.count - (update.pose is None)
        if update.pose is not None:
            self._add_keyframe(update.pose, factors, values)
        if update.epoch_cov is not None:
            self._add_correction_epoch(update.epoch_cov, factors, values)
        if update.wheels is not None:
            factors.add(kind.wheels(gtsam.symbol("x", k - 1), gtsam.symbol("x", k), gtsam.symbol("c", self._epochs), update.wheels))
        for motion in update.motions:
            if not motion.is_loop:
                factors.add(self._motion(motion))
        for gravity in update.gravities:
            factors.add(kind.gravity(gravity))
        if update.alignment is not None:
            of_place, place = kind.place(update.alignment, self.lever)
            factors.push_back(of_place)
            values.insert(place)
        for position in update.positions:
            factors.add(kind.position(position))
        return factors, values

    def _add_keyframe(self, pose: FloatArray, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        key = gtsam.symbol("x", self.count)
        values.insert(key, self.keyframes.value(pose))
        if self.count:
            return
        factors.add(self.keyframes.first(key, pose))
        if len(self.prior_cov):
            prior = np.zeros(len(self.prior_cov))
            factors.add(gtsam.PriorFactorVector(gtsam.symbol("c", 0), prior, gtsam.noiseModel.Gaussian.Covariance(self.prior_cov)))
            values.insert(gtsam.symbol("c", 0), prior)
        if (bias := self.keyframes.bias_prior()) is not None:
            factors.add(bias[1])
            values.insert(bias[0], np.zeros(3))

    def _add_correction_epoch(self, cov: FloatArray, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        before, after = gtsam.symbol("c", self._epochs), gtsam.symbol("c", self._epochs + 1)
        factors.add(gtsam.BetweenFactorVector(before, after, np.zeros(len(cov)), gtsam.noiseModel.Gaussian.Covariance(cov)))
        values.insert(after, self._values.atVector(before))
        self._epochs += 1


@dataclass
class LivePoseGraph(PoseGraph):
    """A `PoseGraph` that is solved at each update: `poses`, `corrections` and `marginal` are the estimates by all that was added."""

    def __post_init__(self) -> None:
        self._isam = make_isam()
        super().__post_init__()

    def apply(self, update: GraphUpdate) -> None:
        """Add ``update`` and solve. Raises `EstimatorError` where there is no solution."""
        factors, values = self._add(update)
        loops = [motion for motion in update.motions if motion.is_loop]
        for loop in loops:
            factors.add(self._motion(loop))
        with check_solvable():
            self._isam.update(factors, values)
            if loops or update.alignment is not None:
                self._iterate()
            self._values = self._isam.calculateEstimate()

    def _start(self) -> gtsam.Values:
        """Loops have their robust weight by now."""
        return self._isam.calculateEstimate()

    def _iterate(self) -> None:
        """Until nothing changes: a robust loss gives what was just closed its weight only step by step."""
        for _ in range(_MAX_UPDATES):
            if not self._isam.update().getVariablesRelinearized():
                break

    def marginal(self, k: int) -> FloatArray:
        """(dim, dim) covariance of keyframe ``k``."""
        rows = self.keyframes.rows
        return np.asarray(self._isam.marginalCovariance(gtsam.symbol("x", k)))[np.ix_(rows, rows)]

    def lever_arm(self) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) and covariance (2, 2) of where the positions' antenna is in the body frame [m]."""
        if not self._values.exists(LEVER):
            return self.lever[:2], LEVER_SIGMA_M**2 * np.eye(2)
        return np.asarray(self._values.atPoint2(LEVER)), np.asarray(self._isam.marginalCovariance(LEVER))

    def alignment(self) -> tuple[FloatArray, FloatArray] | None:
        """``enu_T_map`` (3,) and the covariance (3, 3) of its right perturbation; None without positions."""
        pose = self.enu_T_map
        return None if pose is None else (pose, np.asarray(self._isam.marginalCovariance(ALIGNMENT)))

    def corrections(self) -> tuple[FloatArray, FloatArray]:
        """Mean (c,) and covariance (c, c) of the corrections."""
        if not len(self.prior_cov) or not self.count:
            return np.zeros(len(self.prior_cov)), self.prior_cov
        key = gtsam.symbol("c", self._epochs)
        return np.asarray(self._values.atVector(key)), np.asarray(self._isam.marginalCovariance(key))


def robust_factor(keys: Sequence[int], cov: FloatArray, error: Callable[..., FloatArray]) -> gtsam.CustomFactor:
    """Pass a covariance, never a lower-triangular root: GTSAM takes that as diagonal, silently."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    return gtsam.CustomFactor(gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov)), list(keys), error)


def make_isam() -> gtsam.ISAM2:
    """ISAM2 that factorizes by QR. Its error grows with the condition number of the factors, that of Cholesky with the square: where a
    LiDAR is lost for a fifth of the drive the number is 1.8e7, and its square beyond double precision."""
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(_RELINEARIZE)
    params.setFactorization("QR")
    return gtsam.ISAM2(params)


def levenberg_marquardt(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """GTSAM's own loop copies all values at every Python callback; this one does the same without: damped steps until the cost stays."""
    cost, damping = graph.error(values), 0.0
    for _ in range(_MAX_ITERATIONS):
        linear = graph.linearize(values)
        for key, n in values.dims().items() if damping else ():
            linear.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(n), np.zeros(n), gtsam.noiseModel.Unit.Create(n)))
        moved = values.retract(linear.optimize(gtsam.EliminateQR))  # as in `make_isam`
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
