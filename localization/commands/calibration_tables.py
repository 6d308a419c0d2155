"""What `skidloc calibrate` prints and writes as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from localization.calibration.calibrate import Calibrated, Cut, Turning
from localization.calibration.windows import driven
from localization.commands.tables import add_row, plain_table, print_line, print_table
from motion_models.base import MotionModel
from motion_models.calibration.cross_validation import Interval, LearnedNoise, root_mean, root_mean_gain
from motion_models.calibration.plan import MEANING
from motion_models.calibration.regressions import COMMANDED_RAD_PER_S, RotationTable
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

Trial = tuple[float, float]
_MANY_TIMES = 1.5  # a noise model that is wrong by less is right


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
            print_line(console, f"  {note}")


def print_fit(console: Console, found: Calibrated, about: Turning, cuts: Sequence[Cut]) -> None:
    """Parameters, what is not revealed, what it means, and the errors that it leaves."""
    fit = found.fit
    table = plain_table(
        "parameter", "before", "fitted", "sigma", "meaning", title=f"\n{found.model.name}, {len(fit.names)} parameters fitted"
    )
    table.columns[4].justify = "left"
    for name, (before, value, sigma) in _parameters(found).items():
        add_row(table, name, f"{before:.5g}", f"{value:.5g}", f"{sigma:.2g}", MEANING.get(name, ""))
    print_table(console, table)
    if found.calibration.held:
        print_line(console, "\nNot revealed by this drive, and held:")
        for name, why in found.calibration.held:
            print_line(console, f"  {name}: {why}")
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


def print_by_source(console: Console, by_source: Sequence[tuple[str, Turning | None]]) -> None:
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
    found: Calibrated, about: Turning, cuts: Sequence[Cut], by_source: Sequence[tuple[str, Turning | None]]
) -> dict[str, Any]:
    """All of it for JSON."""
    return {
        "seconds": found.fit.seconds,
        "maneuvers": sum(len(each.maneuvers) for each in cuts),
        "witness": {each.source: each.measured_by for each in cuts},
        "parameters": {
            name: {"value": value, "sigma": sigma, "before": before, "meaning": MEANING.get(name, "")}
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


def _turning(about: Turning) -> dict[str, list[float]]:
    return {
        "effective_track_m": list(about.effective_track_m),
        "x_cr_m": list(about.x_cr_m),
        "y_cr_m": list(about.y_cr_m),
        "forward_scale": list(about.forward_scale),
    }


def rotation_errors(model: MotionModel, params: FloatArray, table: RotationTable, robot: Robot) -> FloatArray:
    """(3,) RMS errors of rotation ratio [-], x_CR and y_CR [m] of a model over a table of rotations."""
    driver = robot.driver
    half = driver.wheel_separation_multiplier * driver.track_width_m * COMMANDED_RAD_PER_S / (2.0 * driver.wheel_radius_m)
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
