"""What `skidloc calibrate` prints and writes as JSON: fits by maneuvers, and the thesis's regressions on rotations in place (ch. 4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from localization.calibration.calibrate import Calibrated, Cut, TurningInPlace, describe_clocks, heading_error
from localization.calibration.windows import driven
from localization.commands.common import add_row, plain_table, print_line, print_message, print_table
from motion_models.base import MotionModel
from motion_models.calibration.cross_validation import Interval, LearnedNoise, root_mean, root_mean_gain
from motion_models.calibration.plan import CLOCK, text_of
from motion_models.calibration.regressions import (
    COMMANDED_RAD_PER_S,
    LinearRegression,
    RotationTable,
    SkidSteerFit,
    cor_x,
    cor_y_full,
    cor_y_lines,
    cor_y_multivariate,
    rotation_ratio,
)
from motion_models.registry import make_model, recommended_model
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer

Trial = tuple[float, float]
_MANY_TIMES = 1.5  # a noise model that is wrong by less is right
_DIGITS = 12
"""Digits beyond which a robot's own number is rounding, and zero is printed."""


def print_cuts(console: Console, robot: Robot, cuts: Sequence[Cut]) -> None:
    """What was fitted on."""
    g = robot.geometry
    for each in cuts:
        seconds, metres, radians = driven(each.maneuvers, g.wheel_radius_m, g.track_width_m)
        print_line(
            console,
            f"{each.source}: {seconds:.0f} s of motion, {metres:.1f} m and {radians:.1f} rad by the wheels, measured by {each.measured_by}",
        )
        for note in each.warnings:
            print_message(console, note)


def print_better_model(console: Console, found: Calibrated, cuts: Sequence[Cut], robot: Robot) -> None:
    """That the model which describes ``robot`` best predicts these maneuvers better than the fit of another, where it does."""
    best = recommended_model(robot)
    maneuvers = [m for each in cuts for m in each.maneuvers]
    if best == found.model.name or found.heldout is None or any(m.middle for m in maneuvers):  # chords of positions have no headings
        return
    fitted = math.sqrt(float(found.heldout.squared_angle.mean()))
    other = heading_error(found, maneuvers, make_model(best, robot))
    if other < fitted:
        print_line(
            console,
            f"{best} fits this robot better: as the robot file has it, it predicts the heading of these windows to"
            f" {math.degrees(other):.2f} deg (root mean square), {found.model.name} as fitted to {math.degrees(fitted):.2f} deg on windows"
            f" that it was not fitted to. Calibrate with --model {best}.",
        )


def print_fit(console: Console, found: Calibrated, about: TurningInPlace, cuts: Sequence[Cut], robot: Robot) -> None:
    """Parameters, what is not revealed, what it means, and the errors that it leaves."""
    fit = found.fit
    table = plain_table(
        "parameter", "before", "fitted", "sigma", "meaning", title=f"\n{found.model.name}, {len(fit.names)} parameters fitted"
    )
    table.columns[4].justify = "left"
    for name, (before, value, sigma) in _parameters(found).items():
        shown = f"{round(before, _DIGITS) + 0.0:.5g}", f"{value:.5g}", f"{sigma:.2g}"
        add_row(table, name, *shown, text_of(found.model, name))
    print_table(console, table)
    if found.calibration.held:
        print_line(console, "\nNot revealed by this drive, and held:")
        for name, why in found.calibration.held:
            print_line(console, f"  {name}: {why}")
    for line in describe_clock(found, cuts, robot):
        print_line(console, line)
    print_line(console, f"\nTurning in place it needs an effective track of {_pm(about.effective_track_m)} m.")
    if found.measures_positions:
        x, y, forward = _pm(about.x_cr_m), _pm(about.y_cr_m), _pm(about.forward_scale, 4)
        print_line(console, f"It then turns about ({x}, {y}) m, and drives {forward} m for each metre that its wheels roll.")
    if any("scan matching" in each.measured_by for each in cuts):
        print_line(
            console,
            "A LiDAR that sits further ahead than its mount gives looks like a centre of rotation that far ahead; only measuring the mount,"
            " or turns with the centre of gravity moved, distinguish them.",
        )
    print_table(console, _errors_table(found))
    if found.heldout is None:
        print_line(
            console, "Too few groups of maneuvers to hold any out: these errors are of the maneuvers that were fitted. Drive longer."
        )
    if found.gain is not None and not found.is_recommended:
        print_line(
            console,
            f"NOT RECOMMENDED: on maneuvers that it was not fitted to, this fit errs {1.0 / found.gain:.2f} times as much as the robot"
            " file's own numbers. The old values are kept. Drive longer, on the same floor, or fit fewer parameters with --fit.",
        )
    if found.noise != LearnedNoise(1.0, 1.0):
        print_line(
            console,
            f"Wheel noise learned from held-out maneuvers: yaw variances {found.noise.yaw:.2g} times the robot file's, position variances"
            f" {found.noise.position:.2g} times.",
        )
    if fit.scale > _MANY_TIMES:
        print_line(
            console,
            f"What is left is {fit.scale:.1f} times what the robot file's wheel_noise and the reference's noise explain; `skidloc diagnose`"
            " finds what this model gets wrong.",
        )


def describe_clock(found: Calibrated, cuts: Sequence[Cut], robot: Robot) -> list[str]:
    """What becomes of the wheels' clock, and where one offset does not describe it; nothing where it was not fitted."""
    if CLOCK not in found.fit.names:
        return []
    offset, sigma = float(found.fit.values[found.fit.names.index(CLOCK)]), found.sigmas[CLOCK]
    clock = f"\nThe wheels' clock is off by {1e3 * offset:+.0f} ms"
    if found.clock_offset_s:
        lines = [f"{clock}, which goes into the robot file's [clock]."]
    else:
        why = "less than two sigma" if abs(offset) < 2.0 * sigma else "against no sensor of the robot"
        lines = [f"{clock}, {why}: the robot file's [clock] stays, and errors before and after are both without it."]
    note = describe_clocks(offset, sigma, [m for each in cuts for m in each.maneuvers], robot)
    return [*lines, f"! {note}"] if note else lines


def _parameters(found: Calibrated) -> dict[str, tuple[float, float, float]]:
    """Name -> before, fitted, sigma; free parameters and those tied to them."""
    fit = found.fit
    everything = {**dict(zip(found.model.param_names, fit.params, strict=True)), **dict(zip(fit.names, fit.values, strict=True))}
    nominal = dict(zip(found.model.param_names, found.model.nominal, strict=True))
    return {name: (float(nominal.get(name, 0.0)), float(everything[name]), sigma) for name, sigma in found.sigmas.items()}


def errors(found: Calibrated) -> dict[str, dict[str, Interval]]:
    """RMS errors at the maneuvers' ends before and after, and the gain; positions [m] where they were measured, headings [deg].

    After is held out, if there were enough groups.
    """
    after = found.inside if found.heldout is None else found.heldout.residuals
    found_errors: dict[str, dict[str, Interval]] = {}
    for name, pick, unit in (("position_m", slice(0, 2), 1.0), ("heading_deg", slice(2, 3), 180.0 / math.pi)):
        if name == "position_m" and not found.measures_positions:
            continue
        scored = found.position_known if name == "position_m" else np.ones(len(after), dtype=bool)
        squares = [np.sum(r[scored, pick] ** 2, axis=1) * unit**2 for r in (found.before, after)]
        group = found.group[scored]
        found_errors[name] = {
            "before": root_mean(squares[0], group, np.random.default_rng(0)),
            "after": root_mean(squares[1], group, np.random.default_rng(0)),
            "gain": root_mean_gain(squares[0], squares[1], group, np.random.default_rng(0)),
        }
    return found_errors


def _errors_table(found: Calibrated) -> Table:
    kind = "held out" if found.heldout is not None else "as fitted"
    table = plain_table("RMS error [95 %]", "before", f"after, {kind}", "gain", title="")
    for name, values in errors(found).items():
        quantity, unit = name.split("_")
        add_row(table, f"{quantity} [{unit}]", str(values["before"]), str(values["after"]), str(values["gain"]))
    return table


def print_by_source(console: Console, by_source: Sequence[tuple[str, TurningInPlace | None]]) -> None:
    """The effective track on the floor of each log."""
    if not by_source:
        return
    table = plain_table("by each alone", "effective track [m]", "95 %", title="")
    for source, about in by_source:
        if about is None:
            add_row(table, source, "-", "not revealed")
        else:
            value, sigma = about.effective_track_m
            add_row(table, source, f"{value:.3f}", f"{value - 1.96 * sigma:.3f} .. {value + 1.96 * sigma:.3f}")
    print_table(console, table)


def calibration_numbers(
    found: Calibrated, about: TurningInPlace, cuts: Sequence[Cut], by_source: Sequence[tuple[str, TurningInPlace | None]]
) -> dict[str, Any]:
    """All of it for JSON."""
    return {
        "seconds": found.fit.seconds,
        "maneuvers": sum(len(each.maneuvers) for each in cuts),
        "witness": {each.source: each.measured_by for each in cuts},
        "parameters": {
            name: {"value": value, "sigma": sigma, "before": before, "meaning": text_of(found.model, name)}
            for name, (before, value, sigma) in _parameters(found).items()
        },
        "held": [{"parameter": name, "why": why} for name, why in found.calibration.held],
        "turning": _turning(about),
        "noise_scale": found.fit.scale,
        "wheel_noise_factors": {"yaw": found.noise.yaw, "position": found.noise.position},
        "heldout": found.heldout is not None,
        "gain": found.gain,
        "recommended": found.is_recommended,
        "errors": {name: {k: [v.value, v.low, v.high] for k, v in values.items()} for name, values in errors(found).items()},
        "by_source": {source: None if each is None else _turning(each) for source, each in by_source},
        "notes": {each.source: list(each.warnings) for each in cuts},
    }


def _turning(about: TurningInPlace) -> dict[str, list[float]]:
    return {
        "effective_track_m": list(about.effective_track_m),
        "x_cr_m": list(about.x_cr_m),
        "y_cr_m": list(about.y_cr_m),
        "forward_scale": list(about.forward_scale),
    }


def rotation_errors(model: MotionModel, params: FloatArray, table: RotationTable, robot: Robot) -> FloatArray:
    """(3,) RMS errors of rotation ratio [-], x_CR and y_CR [m] of a model over a table of rotations."""
    driver = robot.driver
    half = driver.half_track_m * COMMANDED_RAD_PER_S / driver.wheel_radius_m
    vx, vy, wz = np.moveaxis(model.twist(np.array([-half, half]), table.cg, params).value, -1, 0)
    predicted = np.stack([wz / COMMANDED_RAD_PER_S, -vy / wz, vx / wz], axis=-1)
    return np.asarray(np.sqrt(np.mean((predicted - np.column_stack([table.ratio, table.cor])) ** 2, axis=0)))


def print_rotation_errors(console: Console, found: Calibrated, rotations: RotationTable, robot: Robot) -> None:
    """Errors over the table, before and after."""
    table = plain_table(f"RMS over {len(rotations.ratio)} rotations", "ratio", "x_CR [m]", "y_CR [m]", title="")
    for what, params in (("before", found.model.nominal), ("fitted", found.fit.params)):
        add_row(table, what, *(f"{e:.4f}" for e in rotation_errors(found.model, params, rotations, robot)))
    print_table(console, table)


def _pm(value: Trial, digits: int = 3) -> str:
    return f"{value[0]:.{digits}f} +- {value[1]:.{digits}f}" if value[1] > 0.0 else f"{value[0]:.{digits}f}"


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
    for param, value, sigma in zip(SkidSteer.params, found.coefficients, np.sqrt(np.diagonal(found.cov)), strict=True):
        add_row(free, param.name, f"{value:.5g}", f"{sigma:.2g}", param.text)
    print_table(console, free)


def _print_plane(console: Console, plane: LinearRegression) -> None:
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

    def numbers(r: LinearRegression) -> dict[str, Any]:
        return {"terms": list(r.names), "coefficients": r.coefficients.tolist(), "sigma": r.sigma.tolist(), "r_squared": r.r_squared}

    return {
        "rotations": len(table.ratio),
        "parameters": {p.name: {"value": values[p.name], "sigma": sigmas[p.name], "meaning": p.text} for p in SkidSteer.params},
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
