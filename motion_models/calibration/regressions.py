"""Regressions of the rotation scaling k and the centre of rotation (CoR) on the CG, from a table of rotations in place.

Ebersole 2016, Sec. 4.2.3, fits k and x_CR to the means over y_G, and y_CR in three ways; each is here as it was done there.
`skid_steer_fit` is the plain way: all rows, all eleven coefficients of `SkidSteer`, with their covariance.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.text_files import check_file

COLUMNS = ("cg_x_m", "cg_y_m", "rotation_ratio", "cor_x_m", "cor_y_m")
CONTROLLER_MULTIPLIER = 1.875
"""Wheel separation multiplier of the controller that commanded the rotations: k = rotation ratio / multiplier."""
COMMANDED_RAD_PER_S = 0.3
"""Commanded yaw rate of the rotations (Ebersole 2016, sec. 4.2.1) [rad/s]."""
ROTATION_S = 5.0
"""Duration of each [s]."""
_ROTATION_SIGMA = (0.01, 0.01, 0.02)
"""Scatter of the table's rows about a smooth surface, at the end of a rotation [m, m, rad]."""


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
        check_file(path)
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
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


def _cell(text: str | None, column: str, line: int, path: str | Path) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CalibrationError(f"table '{path}', line {line}: {column} must be a number, found {text!r}.")
    return value


@dataclass(frozen=True)
class Regression:
    """A linear least squares fit, with what a statistician wants to see of it."""

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
        """Of one observation about the fit."""
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


def regress(y: FloatArray, terms: dict[str, FloatArray]) -> Regression:
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
    return Regression(names, coefficients, cov, n, residual_ss, total_ss)


def polynomial(y: FloatArray, x: FloatArray, degree: int, name: str = "x_G") -> Regression:
    """``y`` (n,) as a polynomial in ``x`` (n,), from the constant up."""
    powers = ["1", name, *(f"{name}^{i}" for i in range(2, degree + 1))]
    return regress(y, {power: x**i for i, power in enumerate(powers)})


def rotation_ratio(table: RotationTable) -> Regression:
    """4.21 before its division by the multiplier: the means of the ratio over y_G as a parabola in x_G."""
    x, mean = table.means_over_y(table.ratio)
    return polynomial(mean, x, 2)


def cor_x(table: RotationTable) -> Regression:
    """4.22: the means of x_CR over y_G as a line in x_G."""
    x, mean = table.means_over_y(table.cor[:, 0])
    return polynomial(mean, x, 1)


def cor_y_multivariate(table: RotationTable) -> Regression:
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


def cor_y_full(x: FloatArray, slope: FloatArray, intercept: FloatArray) -> tuple[Regression, Regression]:
    """4.24, the thesis's second step: slopes and intercepts of `cor_y_lines` (m,) as parabolas in x_G. 4.25 is the first alone."""
    return polynomial(slope, x, 2), polynomial(intercept, x, 2)


@dataclass(frozen=True)
class SkidSteerFit:
    """Coefficients of `SkidSteer` as a table of rotations gives them."""

    coefficients: FloatArray
    """(11,) in the order of `SkidSteer.param_names`."""
    cov: FloatArray
    """(11, 11); k, x_CR and y_CR are taken as independent."""
    k: Regression
    x_cr: Regression
    y_cr: Regression


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
    half = driver.wheel_separation_multiplier * driver.track_width_m * rate / (2.0 * driver.wheel_radius_m)
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
