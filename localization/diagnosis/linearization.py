"""A drive linearized about a hypothesis: discrepancies, the signature of every cause, and the noise of both."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Cause, Hypothesis, Setting, with_sizes
from localization.diagnosis.causes.floor import slip_stiffness_cause, stiffness_exponent_cause
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import (
    Baseline,
    DrivePredictor,
    late_columns,
    mirrored,
    relative_speeds,
    rolling_column,
    slip_columns,
)
from localization.diagnosis.floor_slope import find_floor_slope
from localization.diagnosis.noise import FLAT, Noise, estimate_drive_noise
from motion_models.base import MotionModel
from motion_models.compiled import kernel
from motion_models.diff_drive import DiffDrive
from motion_models.friction import FrictionModel
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

TOLERANCE = 0.35
"""Sigma of unnamed causes, over what is negligible: the spread of robots about their files."""
MAX_TOLERANCE_SIGMAS = 1.0 / TOLERANCE
"""Largest size of a cause that is not named, over the sigma of its tolerance: what is negligible."""
_MAX_SWEEPS, _MAX_LAST_GAIN = 2000, 1e-8  # of the search for tolerated sizes, the latter in squares of whitened numbers
_NO_SIZE = 1e-6  # sigma of a size that is not there, in units of its prior's
_FREE_VARIANCE = 1e6  # of a size that may be any, in squares of its prior's sigma


@dataclass(frozen=True)
class Regression:
    """Whitened discrepancies and signatures in normal form; nuisances are already projected out, sizes are in units of their sigma
    a priori.

    Every cause is always present, if only within its tolerance: robot files, mounts and clocks are no more accurate. To name a cause
    is to let it have any size. So subsets are weighed by their evidence (marginal likelihood), in which causes outside of the subset
    are noise of a known shape.
    """

    gram: FloatArray
    """(p, p)"""
    moment: FloatArray
    """(p,)"""
    rest: float
    """Sum of squares of the discrepancies without nuisances."""
    count: int
    """How many numbers were measured."""
    scale: FloatArray
    """(p,) prior sigma of each cause in its own unit."""
    tolerance: FloatArray
    """(p,) sigma of each cause that is not named, in units of its prior's."""

    def _variances(self, subset: tuple[int, ...]) -> FloatArray:
        variances = np.square(self.tolerance)
        variances[list(subset)] = 1.0
        return variances

    def _evidence(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray, float]:
        """Factor of the posterior's information, mean of all sizes, and twice the log-evidence but for a constant."""
        variances = self._variances(subset)
        factor = np.linalg.cholesky(self.gram + np.diag(1.0 / variances))
        half = np.linalg.solve(factor, self.moment)
        twice = float(half @ half) - 2.0 * float(np.log(np.diagonal(factor)).sum()) - float(np.log(variances).sum())
        return np.asarray(factor), np.asarray(half), twice

    @cached_property
    def _evidence_of_nothing(self) -> float:
        return self._evidence(())[2]

    def fit(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray, float]:
        """Sizes in own units, their covariance, and twice the log-evidence gained over naming nothing."""
        if not subset:
            return np.zeros(0), np.zeros((0, 0)), 0.0
        i = list(subset)
        factor, half, twice = self._evidence(subset)
        sizes = np.linalg.solve(factor.T, half)[i]
        inverse = np.linalg.solve(factor, np.eye(len(factor))[:, i])
        scale = self.scale[i]
        return sizes * scale, (inverse.T @ inverse) * np.outer(scale, scale), twice - self._evidence_of_nothing

    def fit_by_likelihood(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Sizes in own units and their covariance by the drive alone, all other causes within tolerance: `fit` without the priors of
        ``subset``, which hold a size that the drive hardly shows near zero and yet make its sigma small."""
        i = list(subset)
        variances = self._variances(subset)
        variances[i] = _FREE_VARIANCE
        cov = np.linalg.inv(self.gram + np.diag(1.0 / variances))
        scale = self.scale[i]
        return (cov @ self.moment)[i] * scale, cov[np.ix_(i, i)] * np.outer(scale, scale)

    def detectable_sizes(self, sigmas: float) -> FloatArray:
        """(p,) size of each cause, in its own unit, that the drive would show to so many ``sigmas`` beside all that is tolerated of the
        others; at most so many sigmas of its prior."""
        information = 1.0 / np.diagonal(np.linalg.inv(self.gram + np.diag(1.0 / np.square(self.tolerance)))) - 1.0 / np.square(
            self.tolerance
        )
        return np.asarray(sigmas * self.scale / np.sqrt(np.maximum(information, 0.0) + 1.0))

    def posterior_sigmas(self, subset: tuple[int, ...]) -> FloatArray:
        """(p,) posterior sigmas of all sizes, in own units, with those outside of ``subset`` held to their tolerance."""
        factor, _, _ = self._evidence(subset)
        return np.asarray(np.linalg.norm(np.linalg.solve(factor, np.eye(len(factor))), axis=0) * self.scale)

    def gain(self, subset: tuple[int, ...]) -> float:
        """Twice the log-evidence gained over naming nothing."""
        return self._evidence(subset)[2] - self._evidence_of_nothing if subset else 0.0

    def gain_over(self, subset: tuple[int, ...], others: tuple[int, ...]) -> float:
        """Twice the log-evidence gained over naming the ``others`` alone, where the rest of ``subset`` has no size at all."""
        tolerance = self.tolerance.copy()
        tolerance[[i for i in subset if i not in others]] = _NO_SIZE
        return self._evidence(subset)[2] - dataclasses.replace(self, tolerance=tolerance)._evidence(others)[2]

    def misfit(self) -> float:
        """Sum of squares that is left where every cause keeps within its tolerance, and what that takes."""
        x = self.tolerated((), np.zeros(0)) / self.scale
        return self.rest + float(x @ self.gram @ x - 2.0 * x @ self.moment + np.sum(np.square(x / self.tolerance)))

    def tolerated(self, chosen: tuple[int, ...], sizes: FloatArray) -> FloatArray:
        """(p,) most likely sizes, in own units, of all causes that are not named, beside those ``chosen`` with their ``sizes`` (k,); 0 for
        these.

        A prior does not hold a size against much data: beyond `MAX_TOLERANCE_SIGMAS` a size would not be tolerated, and ends there.
        """
        i = list(chosen)
        limit = MAX_TOLERANCE_SIGMAS * self.tolerance
        limit[i] = 0.0
        moment = self.moment - self.gram[:, i] @ (sizes / self.scale[i])
        return np.asarray(bounded_minimum(self.gram + np.diag(1.0 / np.square(self.tolerance)), moment, limit) * self.scale)

    def joint_p(self, chosen: tuple[int, ...], sizes: FloatArray) -> float:
        """Probability that all causes that are not named, each with the sigma of its tolerance, make together as much as they do beside
        those ``chosen`` with their ``sizes`` (k,): the prior predictive check (Box 1980) of the directions of sizes that the drive
        determines better than the prior. With moment m = G u + e of unit sizes u, cov(e) = G and cov(m) = G + G^2."""
        i = list(chosen)
        rest = np.setdiff1d(np.arange(len(self.moment)), i)
        tolerance = self.tolerance[rest]
        moment = (self.moment - self.gram[:, i] @ (sizes / self.scale[i]))[rest] * tolerance
        values, vectors = np.linalg.eigh(self.gram[np.ix_(rest, rest)] * np.outer(tolerance, tolerance))
        shown = values > 1.0
        squares = (vectors.T @ moment)[shown] ** 2 / (values * (1.0 + values))[shown]
        return float(chi2.sf(squares.sum(), np.count_nonzero(shown))) if shown.any() else 1.0

    def scores(self, given: tuple[int, ...], wanted: list[int]) -> tuple[FloatArray, FloatArray]:
        """(n,) scores of the ``wanted`` causes with those ``given`` free and all others within tolerance, and their (n, n) covariance if
        they were zero."""
        others = [i for i in range(len(self.moment)) if i not in wanted or i in given]
        variances = self._variances(given)[others]
        variances[[n for n, i in enumerate(others) if i in given]] = 1e6
        a = self.gram[np.ix_(others, others)] + np.diag(1.0 / variances)
        across = np.linalg.solve(a, self.gram[np.ix_(others, wanted)])
        cov = self.gram[np.ix_(wanted, wanted)] - self.gram[np.ix_(wanted, others)] @ across
        return self.moment[wanted] - across.T @ self.moment[others], cov


@kernel
def bounded_minimum(a: FloatArray, b: FloatArray, limit: FloatArray) -> FloatArray:
    """(p,) x within +- ``limit`` (p,) where x' a x / 2 - b' x is least, by coordinate descent; ``a`` (p, p) is positive definite."""
    x = np.zeros_like(b)
    slope = -b
    for _ in range(_MAX_SWEEPS):
        moved = 0.0
        for i in range(len(b)):
            step = min(max(x[i] - slope[i] / a[i, i], -limit[i]), limit[i]) - x[i]
            if step != 0.0:
                x[i] += step
                slope += step * a[i]
                moved = max(moved, step * step * a[i, i])
        if moved < _MAX_LAST_GAIN:
            break
    return x


def without_nuisances(nuisances: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """What takes whitened ``nuisances`` (K, q) with sizes of the sigma `FLAT` off whitened columns (K, ...): their least squares, whose
    rows of priors are appended (K + q, ...) (Barfoot 2017, sec. 3.1)."""
    q = np.linalg.qr(np.vstack([nuisances * FLAT, np.eye(nuisances.shape[1])]))[0]

    def take_off(columns: FloatArray) -> FloatArray:
        padded = np.concatenate([columns, np.zeros((nuisances.shape[1], *columns.shape[1:]))])
        return np.asarray(padded - q @ (q.T @ padded))

    return take_off


def regression(
    y: FloatArray, signatures: FloatArray, nuisances: FloatArray, scale: FloatArray, tolerance: FloatArray | None = None
) -> Regression:
    """From whitened rows (K,), signatures (K, p) and nuisances (K, q); ``scale`` and ``tolerance`` (p,) in the causes' own units."""
    s = signatures * scale
    count = int(np.count_nonzero(np.abs(signatures).sum(axis=1) + np.abs(y)))
    if nuisances.size:
        without = without_nuisances(nuisances)
        y, s = without(y), without(s)
    within = np.full(len(scale), _NO_SIZE) if tolerance is None else np.maximum(tolerance / scale, _NO_SIZE)
    return Regression(s.T @ s, s.T @ y, float(y @ y), count, scale, within)


@dataclass(frozen=True)
class Linearization:
    """Discrepancies of a drive about a hypothesis, to first order in the sizes of all causes."""

    causes: tuple[Cause, ...]
    rows: FloatArray
    """(M, 6) at the hypothesis."""
    linear: FloatArray
    """(M, 6) discrepancies, moved back from the hypothesis to the robot file by the signatures."""
    signatures: FloatArray
    """(M, 6, p)"""
    nuisances: FloatArray
    """(M, 6, q)"""
    noise: Noise
    tolerance: float
    """Sigma of causes that are not named, over what is negligible."""
    problem: Regression

    def tolerated(self, named: Collection[Cause] = ()) -> FloatArray:
        """(M, 6, b) signatures of causes within tolerance, without those ``named``, and of nuisances, each times its prior sigma."""
        is_tolerated = np.array([cause not in named for cause in self.causes], dtype=bool)
        S = np.nan_to_num(self.signatures) * (self.problem.scale * self.problem.tolerance)
        return np.concatenate([S[..., is_tolerated], np.nan_to_num(self.nuisances) * FLAT], axis=-1)


def is_skid_steer(robot: Robot) -> bool:
    """Whether the robot's wheels skid in turns; a robot with casters turns by its geometry."""
    return robot.drive != DIFF_DRIVE


def default_model(robot: Robot) -> str:
    """Name of the motion model that suits ``robot``."""
    return FrictionModel.name if is_skid_steer(robot) else DiffDrive.name


def make_predictor(drive: Drive, model: MotionModel, baseline: Baseline | None = None) -> DrivePredictor:
    """From ``baseline`` (by default the robot file), with inertia where that describes the drive better, or is what the friction model
    leaves out by its nature."""
    start = baseline or Baseline()
    plain = DrivePredictor(drive, model, has_inertia=False, baseline=start)
    if drive.kind != "log" or not is_skid_steer(drive.robot):
        return plain
    with_inertia = DrivePredictor(drive, model, has_inertia=True, baseline=start)
    squares = []
    for predictor in (plain, with_inertia):
        rows = predictor.discrepancies(Hypothesis())[:, :3]
        known = np.isfinite(rows).any(axis=0)
        squares.append(np.nanmedian(np.abs(rows[:, known]), axis=0))
    better = np.sum(np.log(np.maximum(squares[0], 1e-9)) - np.log(np.maximum(squares[1], 1e-9))) > 0.0
    return with_inertia if better or model.name == FrictionModel.name else plain


_FEWEST_WITH_CHANGES = 24
"""Windows of a drive in which a change of the floor is tried."""


def setting_of(predictor: DrivePredictor, moments: int = 0) -> Setting:
    """What the drive can show; a change of the floor at so many ``moments``."""
    drive = predictor.drive
    is_long = drive.kind == "log" and len(drive.maneuvers) >= _FEWEST_WITH_CHANGES
    return Setting(
        drive.robot,
        drive.kind,
        has_positions=drive.has_positions or drive.kind == "runs",
        has_headings=drive.has_headings,
        has_gyro=drive.gyro is not None or drive.is_gyro_reference,
        has_ranges=drive.range_slopes is not None,
        has_dropouts=predictor.has_dropouts,
        skids=is_skid_steer(drive.robot),
        is_on_slope=find_floor_slope(predictor) is not None,
        is_friction_model=predictor.model.name == FrictionModel.name,
        change_times_s=tuple(float(drive.starts_s[-1]) * q for q in np.linspace(0.2, 0.8, moments)) if is_long else (),
        has_baseline=predictor.has_baseline,
    )


def candidate_causes(predictor: DrivePredictor, moments: int) -> tuple[Cause, ...]:
    """Causes that this drive could show; a change of the floor at so many ``moments``."""
    setting = setting_of(predictor, moments)
    found: list[Cause] = []
    for cause in CAUSES.values():
        if not setting.has_positions and not cause.is_shown_by_headings:
            continue
        if cause.applies(setting) and (setting.skids or not cause.by_skidding):
            found += cause.variants(cause, setting)
    if predictor.drive.is_lidar_reference:
        return tuple(found)
    return tuple(dataclasses.replace(cause, words=cause.reference_words or cause.words) for cause in found)


def linearize(predictor: DrivePredictor, causes: tuple[Cause, ...], sizes: dict[Cause, float], tolerance: float) -> Linearization:
    """Everything around the hypothesis that causes have these ``sizes``."""
    hypothesis = with_sizes(sizes)
    rows = predictor.discrepancies(hypothesis)
    signatures = np.stack([_signature(predictor, e, sizes, rows) for e in causes], axis=-1)
    linear = rows.copy()
    for cause, size in sizes.items():
        linear += signatures[..., [e.key for e in causes].index(cause.key)] * size
    nuisances = _nuisances(predictor, hypothesis, rows)
    noise = estimate_drive_noise(predictor, linear, signatures, nuisances, causes)
    problem = make_regression(linear, signatures, nuisances, noise, causes, tolerance)
    return Linearization(causes, rows, linear, signatures, nuisances, noise, tolerance, problem)


def _signature(predictor: DrivePredictor, cause: Cause, sizes: dict[Cause, float], rows: FloatArray) -> FloatArray:
    """(M, 6) of ``cause`` where causes have these ``sizes``, which leave ``rows`` (M, 6); without another one of its group, whose place it
    would take: a floor that changes at another moment does not change at both."""
    others = {e: size for e, size in sizes.items() if e.key == cause.key or e.group != cause.group}
    return predictor.signature(with_sizes(others), cause, rows if len(others) == len(sizes) else None)


def make_regression(
    linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, causes: tuple[Cause, ...], tolerance: float
) -> Regression:
    """Whitened, without nuisances, and with what is not named within ``tolerance``."""
    y = noise.whiten(linear).ravel()
    s = noise.whiten(signatures).reshape(len(y), -1)
    z = noise.whiten(nuisances).reshape(len(y), -1)
    return regression(y, s, z, np.array([e.plausible for e in causes]), tolerance * np.array([e.negligible for e in causes]))


def nuisance_part(state: Linearization, left: FloatArray) -> FloatArray:
    """(M, 6) what nuisances make of ``left`` (M, 6), each within what is tolerated of its prior."""
    z = state.noise.whiten(state.nuisances).reshape(state.rows.size, -1) * FLAT
    gram = z.T @ z + np.eye(z.shape[1])
    sizes = bounded_minimum(gram, z.T @ state.noise.whiten(left).ravel(), np.full(z.shape[1], MAX_TOLERANCE_SIGMAS))
    return np.asarray(np.nan_to_num(state.nuisances) @ (FLAT * sizes))


def noise_beside(predictor: DrivePredictor, state: Linearization, columns: FloatArray) -> Noise:
    """Noise of the drive where ``columns`` (M, 6, k) may have any size beside all causes."""
    unit = columns / np.maximum(np.sqrt(np.mean(np.nan_to_num(columns) ** 2, axis=(0, 1))), 1e-12)
    known = np.isfinite(state.linear)[..., None]
    nuisances = np.concatenate([state.nuisances, np.where(known, unit, np.nan)], axis=-1)
    return estimate_drive_noise(predictor, state.linear, state.signatures, nuisances, state.causes)


LEVELS = 2
"""Nuisances that are no error of the model: the first ones."""


def _nuisances(predictor: DrivePredictor, hypothesis: Hypothesis, rows: FloatArray) -> FloatArray:
    """(M, 6, q) accelerometers and the floor under the IMU are never quite level; speeds in gaps of the wheels' messages are late; and what
    the model itself is off."""
    columns = [np.zeros((*rows.shape, LEVELS))]
    columns[0][:, 4, 0] = columns[0][:, 5, 1] = 1.0
    loss = predictor.drive.message_loss
    late = [] if loss is None or not loss.gaps else [late_columns(predictor, loss.held_s) / FLAT]
    if predictor.unmodelled.has_stiffness:
        for cause in (slip_stiffness_cause(predictor.drive.robot), stiffness_exponent_cause()):
            columns.append(predictor.signature(hypothesis, cause, rows)[..., None] * (cause.plausible / FLAT))
        columns[1] *= math.exp(predictor.unmodelled.log_stiffness)  # the cause is relative to the robot file's stiffness
        columns.append(rolling_column(predictor) / FLAT)
    if predictor.unmodelled.slip_share:
        slips = mirrored(slip_columns(predictor)) * (predictor.unmodelled.slip_share / FLAT)
        columns += [slips, slips * relative_speeds(predictor)[:, None, None]]
    return np.where(np.isfinite(rows)[..., None], np.concatenate([*columns, *late], axis=-1), np.nan)
