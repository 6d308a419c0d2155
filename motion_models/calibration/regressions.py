"""Rotations in place: k and the centre of rotation (CoR) regressed on the CG, and the CoR of an arc by its poses (Ebersole 2016, Sec. 4.2).

Ebersole 2016, Sec. 4.2.3, fits k and x_CR to the means over y_G, and y_CR in three ways; each is here as it was done there.
`skid_steer_fit` is the plain way: all rows, all eleven coefficients of `SkidSteer`, with their covariance.

The CoR of an arc is that of Sec. 4.2.1.3. A robot that turns about a point keeps that point fixed twice: in its own body (c) and in the
world (w),

    p_k + R(theta_k) c = w        for every pose k of the arc.                                   (4.2, at any pair of poses)

The thesis takes the first and the last pose (`center_from_end_poses`); `center_of_arc` takes all. Both divide by the turned
angle, so the covariance grows as 1/angle^2 towards small turns. A turn of exactly zero has no CoR and is refused.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.input_files import read_table
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, adjoint, between, inverse, rotation, wrap_angle

COLUMNS = ("cg_x_m", "cg_y_m", "rotation_ratio", "cor_x_m", "cor_y_m")
CONTROLLER_MULTIPLIER = 1.875
"""Wheel separation multiplier of the controller that commanded the rotations: k = rotation ratio / multiplier."""
COMMANDED_RAD_PER_S = 0.3
"""Commanded yaw rate of the rotations (Ebersole 2016, sec. 4.2.1) [rad/s]."""
ROTATION_S = 5.0
"""Duration of each [s]."""
_ROTATION_SIGMA = (0.01, 0.01, 0.02)
"""Scatter of the table's rows about a smooth surface, at the end of a rotation [m, m, rad]."""

_MAX_ITERATIONS = 100
_MAX_CONDITION = 1e14


@dataclass(frozen=True)
class RotationTable:
    """Rotations in place at n centres of gravity."""

    cg: FloatArray
    """(n, 2) x_G, y_G [m]."""
    ratio: FloatArray
    """(n,) measured over commanded yaw rate [-]."""
    cor: FloatArray
    """(n, 2) x_CR, y_CR [m]."""

    def means_over_y(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The distinct x_G (m,) and the means (m,) of ``values`` (n,) at each."""
        x, index = np.unique(self.cg[:, 0], return_inverse=True)
        return x, np.bincount(index, values) / np.bincount(index)


def read_rotation_table(path: str | Path) -> RotationTable:
    """The table of a CSV file with the columns `COLUMNS`, in any order. Raises `CalibrationError`, naming row and column."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_table(path), newline="")))
        names = set(rows[0]) if rows else set()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"table '{path}' cannot be read: {error}.") from error
    if not rows:
        raise CalibrationError(f"table '{path}' has no rows below its header.")
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = ", ".join(str(name) for name in rows[0] if name)
        raise CalibrationError(f"table '{path}' has no column {', '.join(missing)}; it has {found}.")
    data = np.array([[_cell(row[name], name, i + 2, path) for name in COLUMNS] for i, row in enumerate(rows)])
    return RotationTable(data[:, :2], data[:, 2], data[:, 3:])


def read_rotations(path: str | Path, robot: Robot) -> RotationTable:
    """`read_rotation_table` of ``robot``. Raises `CalibrationError` as well for centres that are not those of its rotations in place: the
    centre of gravity lies between the wheels, and the centre of rotation not farther off the middle than twice as far as they stand."""
    table, geometry = read_rotation_table(path), robot.geometry
    half = 0.5 * np.array([geometry.wheelbase_m, geometry.track_width_m])
    for name, points, most in (("gravity", table.cg, half), ("rotation", table.cor, 2.0 * half)):
        off = np.flatnonzero((np.abs(points) > most).any(axis=1))
        if len(off):
            (x, y), (far_x, far_y) = points[off[0]], most
            raise CalibrationError(
                f"table '{path}': the centres of {name} of {len(off)} of {len(points)} rows, from line {off[0] + 2} on, lie beyond x ="
                f" +-{far_x:.3f} or y = +-{far_y:.3f} m, the first at ({x:g}, {y:g}) m, where the wheels of {robot.name} stand at"
                f" +-{half[0]:.3f} and +-{half[1]:.3f} m. All are in metres from the middle between the wheels, x ahead and y to the left."
            )
    return table


def _cell(text: str | None, column: str, line: int, path: str | Path) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CalibrationError(f"table '{path}', line {line}: {column} must be a number, found {text!r}.")
    return value


@dataclass(frozen=True)
class LinearRegression:
    """A linear least squares fit, with its statistics."""

    names: tuple[str, ...]
    """What each coefficient multiplies; "1" is the intercept."""
    coefficients: FloatArray
    """(p,)"""
    cov: FloatArray
    """(p, p) of the coefficients, from the scatter about the fit."""
    observations: int
    residual_ss: float
    total_ss: float
    """Sum of squares about the mean, or about zero if there is no intercept."""

    @property
    def sigma(self) -> FloatArray:
        """(p,) standard errors of the coefficients."""
        return np.asarray(np.sqrt(np.diagonal(self.cov)))

    @property
    def residual_df(self) -> int:
        """Degrees of freedom of the residuals."""
        return self.observations - len(self.names)

    @property
    def regression_df(self) -> int:
        """Degrees of freedom of the regression, without its constant."""
        return len(self.names) - ("1" in self.names)

    @property
    def r_squared(self) -> float:
        """Share of the variance that is explained."""
        return 1.0 - self.residual_ss / self.total_ss

    @property
    def adjusted_r_squared(self) -> float:
        """R^2 corrected for the number of coefficients."""
        return 1.0 - (1.0 - self.r_squared) * (self.residual_df + self.regression_df) / self.residual_df

    @property
    def standard_error(self) -> float:
        """Standard error of one observation about the fit."""
        return math.sqrt(self.residual_ss / self.residual_df)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return math.sqrt(self.residual_ss / self.observations)

    @property
    def f_statistic(self) -> float:
        """Explained over residual mean square."""
        return (self.total_ss - self.residual_ss) / self.regression_df / self.standard_error**2

    @property
    def significance(self) -> float:
        """Probability of an F as large without any dependence."""
        return float(stats.f.sf(self.f_statistic, self.regression_df, self.residual_df))

    @property
    def t_statistics(self) -> FloatArray:
        """(p,) coefficients over their standard errors."""
        return np.asarray(self.coefficients / self.sigma)

    @property
    def p_values(self) -> FloatArray:
        """(p,) two-sided probabilities of t as large for coefficients of 0."""
        return np.asarray(2.0 * stats.t.sf(np.abs(self.t_statistics), self.residual_df))

    def interval(self, confidence: float = 0.95) -> FloatArray:
        """(p, 2) confidence intervals of the coefficients."""
        half = stats.t.ppf(0.5 + confidence / 2.0, self.residual_df) * self.sigma
        return np.stack([self.coefficients - half, self.coefficients + half], axis=-1)


def regress(y: FloatArray, terms: dict[str, FloatArray]) -> LinearRegression:
    """``y`` (n,) by least squares as a sum of ``terms`` (n,) by name.

    Raises `CalibrationError` for fewer than p + 1 rows, and for terms that the rows do not separate.
    """
    names, design = tuple(terms), np.column_stack(list(terms.values()))
    n, p = design.shape
    if n <= p:
        raise CalibrationError(f"{n} rows are too few for the {p} coefficients of {', '.join(names)}; at least {p + 1} are needed.")
    size = np.linalg.norm(design, axis=0)
    _, values, directions = np.linalg.svd(design / np.where(size > 0, size, 1.0), full_matrices=False)
    if values[-1] < 1e-10 * values[0]:
        worst = [name for name, part in zip(names, directions[-1], strict=True) if abs(part) > 0.1]
        raise CalibrationError(
            f"the rows do not separate {' and '.join(worst)} (of {', '.join(names)}): vary the centre of gravity more, in x and in y."
        )
    coefficients: FloatArray = np.asarray(np.linalg.lstsq(design, y, rcond=None)[0], dtype=np.float64)
    residual_ss = float(np.sum((y - design @ coefficients) ** 2))
    total_ss = float(np.sum((y - (y.mean() if "1" in names else 0.0)) ** 2))
    cov: FloatArray = np.asarray(np.linalg.inv(design.T @ design) * (residual_ss / (n - p)), dtype=np.float64)
    return LinearRegression(names, coefficients, cov, n, residual_ss, total_ss)


def polynomial(y: FloatArray, x: FloatArray, degree: int, name: str = "x_G") -> LinearRegression:
    """``y`` (n,) as a polynomial in ``x`` (n,), from the constant up."""
    powers = ["1", name, *(f"{name}^{i}" for i in range(2, degree + 1))]
    return regress(y, {power: x**i for i, power in enumerate(powers)})


def rotation_ratio(table: RotationTable) -> LinearRegression:
    """4.21 before its division by the multiplier: the means of the ratio over y_G as a parabola in x_G."""
    x, mean = table.means_over_y(table.ratio)
    return polynomial(mean, x, 2)


def cor_x(table: RotationTable) -> LinearRegression:
    """4.22: the means of x_CR over y_G as a line in x_G."""
    x, mean = table.means_over_y(table.cor[:, 0])
    return polynomial(mean, x, 1)


def cor_y_multivariate(table: RotationTable) -> LinearRegression:
    """4.23 and Tables 4-4 to 4-6: y_CR as a plane over x_G and y_G, all rows."""
    x, y = table.cg.T
    return regress(table.cor[:, 1], {"1": np.ones_like(x), "x_G": x, "y_G": y})


def cor_y_lines(table: RotationTable) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Table 4-7: the distinct x_G (m,), and slope and intercept (m,) of y_CR as a line in y_G at each of them."""
    x = np.unique(table.cg[:, 0])
    lines = []
    for at in x:
        here = table.cg[:, 0] == at
        lines.append(polynomial(table.cor[here, 1], table.cg[here, 1], 1, "y_G").coefficients)
    intercept, slope = np.transpose(lines)
    return x, slope, intercept


def cor_y_full(x: FloatArray, slope: FloatArray, intercept: FloatArray) -> tuple[LinearRegression, LinearRegression]:
    """4.24, the thesis's second step: slopes and intercepts of `cor_y_lines` (m,) as parabolas in x_G. 4.25 is the first alone."""
    return polynomial(slope, x, 2), polynomial(intercept, x, 2)


@dataclass(frozen=True)
class SkidSteerFit:
    """Coefficients of `SkidSteer` as a table of rotations gives them."""

    coefficients: FloatArray
    """(11,) in the order of `SkidSteer.param_names`."""
    cov: FloatArray
    """(11, 11); k, x_CR and y_CR are taken as independent."""
    k: LinearRegression
    x_cr: LinearRegression
    y_cr: LinearRegression


def skid_steer_fit(table: RotationTable, multiplier: float = CONTROLLER_MULTIPLIER) -> SkidSteerFit:
    """All eleven coefficients from all rows in one step each: k, x_CR, and y_CR of the form of 4.24.

    ``multiplier`` is the wheel separation multiplier of the controller that commanded the rotations.
    """
    x, y = table.cg.T
    one = np.ones_like(x)
    k = regress(table.ratio / multiplier, {"1": one, "x_G": x, "x_G^2": x**2})
    x_cr = regress(table.cor[:, 0], {"1": one, "x_G": x})
    y_terms = {"1": one, "x_G": x, "x_G^2": x**2, "y_G": y, "x_G y_G": x * y, "x_G^2 y_G": x**2 * y}
    y_cr = regress(table.cor[:, 1], y_terms)
    cov = np.zeros((11, 11))
    cov[:3, :3], cov[3:5, 3:5], cov[5:, 5:] = k.cov, x_cr.cov, y_cr.cov
    return SkidSteerFit(np.concatenate([k.coefficients, x_cr.coefficients, y_cr.coefficients]), cov, k, x_cr, y_cr)


def rotations_as_maneuvers(
    table: RotationTable, robot: Robot, rate: float = COMMANDED_RAD_PER_S, seconds: float = ROTATION_S
) -> list[Maneuver]:
    """Rotations that were commanded at ``rate`` for ``seconds`` through the robot's own driver, one maneuver a row.

    The wheel rates are those that the driver makes of the command; the pose follows from the measured turn about the measured centre.
    Rows of one x_G are one group.
    """
    driver = robot.driver
    half = driver.half_track_m * rate / driver.wheel_radius_m
    maneuvers = []
    for cg, ratio, cor in zip(table.cg, table.ratio, table.cor, strict=True):
        turned = ratio * rate * seconds
        c, s = math.cos(turned), math.sin(turned)
        x = cor[0] - (c * cor[0] - s * cor[1])
        y = cor[1] - (s * cor[0] + c * cor[1])
        maneuvers.append(
            Maneuver(
                dt=np.array([seconds]),
                wheels=np.array([[-half, half]]),
                measured=np.array([[x, y, turned]]),
                ends=np.array([1]),
                cg=cg,
                cov=np.diag(np.square(_ROTATION_SIGMA)),
                group=f"x_G = {cg[0]:g} m",
            )
        )
    return maneuvers


@dataclass(frozen=True)
class CenterOfRotation:
    """Centre of rotation in the body frame, with its covariance."""

    value: FloatArray
    """(2,) x_CR, y_CR in the body frame [m]."""
    cov: FloatArray
    """(2, 2) [m^2]."""
    chi_square: float = 0.0
    """Squared normalized residuals of the poses about this centre; far above ``degrees_of_freedom`` means that the robot did not turn
    about one point, or that the poses are worse than by their covariance."""
    degrees_of_freedom: int = 0


def center_from_end_poses(
    world_T_start: ArrayLike, world_T_end: ArrayLike, cov_start: ArrayLike | None = None, cov_end: ArrayLike | None = None
) -> CenterOfRotation:
    """The thesis's final-point rule, eqs. 4.4 and 4.5, with the covariance propagated from those of the poses.

    Poses (3,); covariances (3, 3) of their right perturbations, independent of each other, zero where not given. Raises
    `CalibrationError` if the heading did not change (whole turns count as none: use `center_of_arc`).

    >>> from motion_models import se2
    >>> turned_about_its_front = se2.exp([0.0, -0.3, 1.0])  # wz = 1 and vy = -wz x_CR
    >>> center_from_end_poses([0.0, 0.0, 0.0], turned_about_its_front).value.round(6).tolist()
    [0.3, 0.0]
    """
    start_T_end = between(world_T_start, world_T_end)
    value, jacobian = _final_point(start_T_end)
    cov = np.zeros((3, 3))
    if cov_start is not None:
        in_end_frame = adjoint(inverse(start_T_end))
        cov = cov + in_end_frame @ np.asarray(cov_start, dtype=float) @ in_end_frame.T
    if cov_end is not None:
        cov = cov + np.asarray(cov_end, dtype=float)
    return CenterOfRotation(value, jacobian @ cov @ jacobian.T)


def _final_point(start_T_end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The CoR (2,) and its derivative (2, 3) by the right perturbation of ``start_T_end`` (3,)."""
    x, y, theta = start_T_end
    if theta == 0.0:
        raise CalibrationError("the heading at the end is the heading at the start: without a turn there is no centre of rotation.")
    # sin(t) / (1 - cos(t)) = cot(t / 2), which loses no digits at small angles.
    cot = 1.0 / math.tan(theta / 2.0)
    value = np.array([x - cot * y, y + cot * x]) / 2.0  # 4.4, 4.5 with (x_s, y_s) = 0
    by_cot = np.array([-y, x]) / 2.0
    cot_by_theta = -0.5 / math.sin(theta / 2.0) ** 2
    by_position = np.array([[1.0, -cot], [cot, 1.0]]) / 2.0
    return value, np.column_stack([by_position @ rotation(theta), by_cot * cot_by_theta])


def center_of_arc(world_T_body: ArrayLike, cov: ArrayLike) -> CenterOfRotation:
    """The CoR from all poses of an arc: maximum likelihood with positions and headings both noisy.

    ``world_T_body`` (n, 3), n >= 2; ``cov`` (3, 3) or (n, 3, 3) of the poses' right perturbations, independent from pose to pose and
    positive definite. The true headings are unknowns beside c and w: plain least squares with the measured ones would pull c
    towards zero on short arcs. Raises `CalibrationError` for fewer than two poses, for an arc without a turn, or if the
    poses do not agree on any centre.
    """
    poses = np.atleast_2d(np.asarray(world_T_body, dtype=float))
    n = poses.shape[0]
    if n < 2 or poses.shape != (n, 3) or not np.isfinite(poses).all():
        raise CalibrationError(f"a centre of rotation needs at least two finite poses [x, y, theta]; found shape {poses.shape}.")
    if not np.any(wrap_angle(poses[:, 2] - poses[0, 2])):
        raise CalibrationError(f"all {n} poses have the same heading: without a turn there is no centre of rotation.")
    covs = np.broadcast_to(np.asarray(cov, dtype=float), (n, 3, 3))
    try:
        whiten = np.linalg.inv(np.linalg.cholesky(covs))
    except np.linalg.LinAlgError:
        raise CalibrationError("the covariance of a pose is not positive definite; give every pose some uncertainty.") from None

    center, fixed, heading = _centre_by_least_squares(poses)
    cost = math.inf
    for _ in range(_MAX_ITERATIONS):
        error, by_heading, by_point = _residuals(poses, whiten, center, fixed, heading)
        # Each heading appears in one pose only: eliminate it there (Schur complement), leaving (c, w).
        weight = np.sum(by_heading**2, axis=1)
        slope = np.sum(by_heading * error, axis=1)
        coupling = np.einsum("ki,kij->kj", by_heading, by_point)
        information = np.einsum("kij,kil->jl", by_point, by_point) - np.einsum("kj,kl->jl", coupling, coupling / weight[:, None])
        gradient = np.einsum("kij,ki->j", by_point, error) - coupling.T @ (slope / weight)
        if np.linalg.cond(information) > _MAX_CONDITION:
            raise _disagreement(n)
        step = -np.linalg.solve(information, gradient)
        heading = heading - (slope + coupling @ step) / weight
        center, fixed = center + step[:2], fixed + step[2:]
        previous, cost = cost, float(np.sum(error**2))
        if abs(previous - cost) <= 1e-12 * (1.0 + cost) and np.max(np.abs(step)) <= 1e-9 * (1.0 + np.max(np.abs(center))):
            break
    else:
        raise _disagreement(n)
    return CenterOfRotation(center, np.linalg.inv(information)[:2, :2], cost, 2 * n - 4)


def _disagreement(n: int) -> CalibrationError:
    return CalibrationError(f"the {n} poses do not agree on a centre of rotation: their turn is too small for their uncertainty.")


def _centre_by_least_squares(poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Start of the iteration: c and w (2,) from p_k = w - R_k c, linear if the measured headings (n,) were exact."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    one, zero = np.ones_like(c), np.zeros_like(c)
    rows = np.concatenate([np.column_stack([-c, s, one, zero]), np.column_stack([-s, -c, zero, one])])
    solution = np.linalg.lstsq(rows, np.concatenate([poses[:, 0], poses[:, 1]]), rcond=None)[0]
    return solution[:2], solution[2:], poses[:, 2]


def _residuals(
    poses: FloatArray, whiten: FloatArray, center: FloatArray, fixed: FloatArray, heading: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whitened error (n, 3) of the poses, its derivative (n, 3) by the true headings and (n, 3, 4) by c and w."""
    n = poses.shape[0]
    turn = rotation(heading)  # (n, 2, 2) world_R_body
    body = np.einsum("kji,kj->ki", turn, poses[:, :2] - fixed)  # the fixed point is at -body in the body frame
    error = np.column_stack([body + center, wrap_angle(poses[:, 2] - heading)])
    by_heading = np.column_stack([body[:, 1], -body[:, 0], -np.ones(n)])
    by_point = np.zeros((n, 3, 4))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :2, 2:] = -np.swapaxes(turn, -1, -2)
    return np.einsum("kij,kj->ki", whiten, error), np.einsum("kij,kj->ki", whiten, by_heading), whiten @ by_point
