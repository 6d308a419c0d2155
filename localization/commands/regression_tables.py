"""The thesis's regressions on a table of rotations in place, as `skidloc calibrate` prints them (Ebersole 2016, ch. 4)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from rich.console import Console

from localization.commands.tables import add_row, plain_table, print_line, print_table
from motion_models.calibration.plan import MEANING
from motion_models.calibration.regressions import (
    Regression,
    RotationTable,
    SkidSteerFit,
    cor_x,
    cor_y_full,
    cor_y_lines,
    cor_y_multivariate,
    rotation_ratio,
)
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer


def print_regressions(console: Console, table: RotationTable, found: SkidSteerFit, robot: Robot) -> None:
    """The thesis's results (Ebersole 2016, eqs. 4.21-4.25, Tables 4-4 to 4-7) from a table of rotations."""
    ratio, x_cr, plane = rotation_ratio(table), cor_x(table), cor_y_multivariate(table)
    multiplier = robot.driver.wheel_separation_multiplier
    c, b, a = ratio.coefficients
    print_line(console, f"{len(table.ratio)} rotations in place, wheel separation multiplier {multiplier:g} (Ebersole 2016, ch. 4)\n")
    print_line(console, f"4.21  k = ({a:.3f} x_G^2 {b:+.4f} x_G {c:+.4f}) / {multiplier:g}     R^2 {ratio.r_squared:.4f}")
    print_line(console, f"4.22  x_CR = {x_cr.coefficients[1]:.4f} x_G {x_cr.coefficients[0]:+.4f}     R^2 {x_cr.r_squared:.4f}")
    one, by_x, by_y = plane.coefficients
    print_line(console, f"4.23  y_CR = {by_x:.4f} x_G {by_y:+.4f} y_G {one:+.5f}     R^2 {plane.r_squared:.4f}")
    slope, intercept = (r.coefficients for r in cor_y_full(*cor_y_lines(table)))
    print_line(console, f"4.24  y_CR = ({slope[2]:.2f} x_G^2 {slope[1]:+.4f} x_G {slope[0]:+.4f}) y_G")
    print_line(console, f"             + ({intercept[2]:.4f} x_G^2 {intercept[1]:+.4f} x_G {intercept[0]:+.5f})")
    print_line(console, "4.25  the first line of 4.24 alone\n")
    _print_plane(console, plane)
    lines = plain_table("Table 4-7  x_G [m]", "slope", "intercept [m]")
    for at, by, constant in zip(*cor_y_lines(table), strict=True):
        add_row(lines, f"{at:.2f}", f"{by:.4f}", f"{constant:.4f}")
    print_table(console, lines)
    rms = plain_table("RMS error", "ratio", "x_CR [m]", "y_CR [m]", title="")
    for what, values in variant_errors(table, found, multiplier).items():
        add_row(rms, what, *(f"{value:.4f}" for value in values))
    print_table(console, rms)
    free = plain_table("skid_steer, all rows at once", "value", "sigma", "meaning", title="")
    free.columns[3].justify = "left"
    for name, value, sigma in zip(SkidSteer.param_names, found.coefficients, np.sqrt(np.diagonal(found.cov)), strict=True):
        add_row(free, name, f"{value:.5g}", f"{sigma:.2g}", MEANING.get(name, ""))
    print_table(console, free)


def _print_plane(console: Console, plane: Regression) -> None:
    print_line(console, "Table 4-4  regression of y_CR on x_G and y_G")
    for what, value in (
        ("multiple R", math.sqrt(plane.r_squared)),
        ("R^2", plane.r_squared),
        ("adjusted R^2", plane.adjusted_r_squared),
        ("standard error", plane.standard_error),
    ):
        print_line(console, f"  {what:16} {value:.9f}")
    print_line(console, f"  {'observations':16} {plane.observations}\n")
    variance = plain_table("Table 4-5", "df", "SS", "MS", "F", "significance")
    explained = plane.total_ss - plane.residual_ss
    mean = explained / plane.regression_df
    add_row(
        variance,
        "regression",
        str(plane.regression_df),
        f"{explained:.9f}",
        f"{mean:.5f}",
        f"{plane.f_statistic:.6f}",
        f"{plane.significance:.5E}",
    )
    add_row(
        variance, "residual", str(plane.residual_df), f"{plane.residual_ss:.9f}", f"{plane.residual_ss / plane.residual_df:.6f}", "", ""
    )
    add_row(variance, "total", str(plane.observations - 1), f"{plane.total_ss:.9f}", "", "", "")
    print_table(console, variance)
    console.print()
    coefficients = plain_table("Table 4-6", "coefficient", "standard error", "t", "p", "lower 95 %", "upper 95 %")
    for name, value, sigma, t, p, (low, high) in zip(
        plane.names, plane.coefficients, plane.sigma, plane.t_statistics, plane.p_values, plane.interval(), strict=True
    ):
        what = "intercept" if name == "1" else name
        add_row(coefficients, what, f"{value:.9f}", f"{sigma:.9f}", f"{t:.5f}", f"{p:.5G}", f"{low:.9f}", f"{high:.9f}")
    print_table(console, coefficients)
    console.print()


def variant_errors(table: RotationTable, found: SkidSteerFit, multiplier: float) -> dict[str, tuple[float, float, float]]:
    """RMS errors of ratio, x_CR and y_CR: the regressions in the thesis's order, with each of its forms of y_CR, then all rows at once."""
    x, y = table.cg.T
    k = np.polynomial.polynomial.polyval(x, rotation_ratio(table).coefficients)
    x_cr = np.polynomial.polynomial.polyval(x, cor_x(table).coefficients)
    slope, intercept = (np.polynomial.polynomial.polyval(x, r.coefficients) for r in cor_y_full(*cor_y_lines(table)))
    one, by_x, by_y = cor_y_multivariate(table).coefficients
    forms = {"multivariate (4.23)": one + by_x * x + by_y * y, "full (4.24)": slope * y + intercept, "symmetric (4.25)": slope * y}
    rms = {}
    for name, y_cr in forms.items():
        rms[name] = _rms(k - table.ratio, x_cr - table.cor[:, 0], y_cr - table.cor[:, 1])
    rms["all rows at once"] = _skid_rms(found.coefficients, table, multiplier)
    return rms


def _skid_rms(coefficients: FloatArray, table: RotationTable, multiplier: float) -> tuple[float, float, float]:
    k, x_cr, y_cr = SkidSteer(1.0, 1.0, coefficients).rotation(table.cg, coefficients)
    return _rms(multiplier * k - table.ratio, x_cr - table.cor[:, 0], y_cr - table.cor[:, 1])


def _rms(*errors_of: FloatArray) -> tuple[float, float, float]:
    a, b, c = (float(np.sqrt(np.mean(e**2))) for e in errors_of)
    return a, b, c


def regression_numbers(
    table: RotationTable, found: SkidSteerFit, values: dict[str, float], sigmas: dict[str, float], multiplier: float
) -> dict[str, Any]:
    """The regressions for JSON."""
    x, slope, intercept = cor_y_lines(table)
    by_slope, by_intercept = cor_y_full(x, slope, intercept)

    def numbers(r: Regression) -> dict[str, Any]:
        return {"terms": list(r.names), "coefficients": r.coefficients.tolist(), "sigma": r.sigma.tolist(), "r_squared": r.r_squared}

    return {
        "rotations": len(table.ratio),
        "parameters": {name: {"value": value, "sigma": sigmas[name], "meaning": MEANING.get(name, "")} for name, value in values.items()},
        "regressions": {
            "rotation_ratio": numbers(rotation_ratio(table)),
            "x_cr": numbers(cor_x(table)),
            "y_cr_multivariate": numbers(cor_y_multivariate(table)),
            "y_cr_slope": numbers(by_slope),
            "y_cr_intercept": numbers(by_intercept),
        },
        "lines": [{"cg_x_m": float(a), "slope": float(b), "intercept": float(c)} for a, b, c in zip(x, slope, intercept, strict=True)],
        "rms": {name: list(rms) for name, rms in variant_errors(table, found, multiplier).items()},
    }
