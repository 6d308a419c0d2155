"""The friction model against VaultBot's 68 rotations in place: with the thesis's own constants, then with four numbers fitted.

python -m tests.studies.friction_grid

`tests.studies.contact_law` compares contact laws on the same rotations.

A rotation was commanded at 0.3 rad/s through diff_drive_controller, so the wheel rates are known; the friction model says how fast
and about which point the robot then turns. A row of the table is left out and predicted from the others: of constant y_G (the
tables' rows, 7 of them) or of constant x_G (their columns, 10).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel
from motion_models.calibration.regressions import RotationTable, polynomial, skid_steer_fit
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer
from tests.studies.thesis_regressions import grid

COMMAND = np.array([0.0, 0.3])  # m/s, rad/s
FITTED = ("tracked_x", "warp", "track_width", "scrub")
MEANING = {
    "tracked_x": "m: the point tracked by the LiDAR lies this far ahead of the wheelbase's centre (thesis: on it)",
    "warp": "of m g / 4: load that a twisted chassis moves onto the front left and rear right wheels",
    "track_width": "m: distance of the left and right contacts (thesis: 0.56, 'rough'; a Husky's URDF: 0.571)",
    "scrub": "m: yaw moment by which the contact patches oppose a turn, over mu m g (a round patch: 12 cm across)",
}
ALIASES = ("mu_ratio", "wheelbase", "wheel_radius")
"""Numbers that do the work of scrub about as well: each sets how hard the floor resists a turn, and this table shows no more than that."""


@dataclass(frozen=True)
class Errors:
    """Root mean square errors over rotations."""

    ratio: float
    """Of the rotation ratio [-]."""
    x_cr: float
    """[m]"""
    y_cr: float
    """[m]"""

    @classmethod
    def of(cls, errors: FloatArray) -> Errors:
        """``errors`` (n, 3) of ratio, x_CR and y_CR."""
        return cls(*(float(e) for e in np.sqrt(np.mean(errors**2, axis=0))))


@dataclass(frozen=True)
class GridFit:
    """Parameters of the friction model fitted to rotations."""

    names: tuple[str, ...]
    params: FloatArray
    """(13,) all parameters."""
    values: FloatArray
    """(c,) of ``names``."""
    sigma: FloatArray
    """(c,) from the scatter about the fit, as if all rows were independent."""


def friction(contact: str = "isotropic") -> FrictionModel:
    """VaultBot, with Appendix A's constants."""
    return FrictionModel.from_robot(dataclasses.replace(load_robot("vaultbot"), options={"friction": {"contact": contact}}))


VAULTBOT = friction()


def wheel_rates() -> FloatArray:
    """(2,) what the controller made of the command [rad/s]: diff-drive with the multiplier 1.875."""
    controller = make_model("diff_drive", load_robot("vaultbot"))
    return controller.wheels(COMMAND, np.zeros(2), controller.nominal)


def measured(table: RotationTable) -> FloatArray:
    """(n, 3) rotation ratio, x_CR, y_CR."""
    return np.column_stack([table.ratio, table.cor])


def predict(cg: FloatArray, params: FloatArray, model: MotionModel = VAULTBOT) -> tuple[FloatArray, FloatArray]:
    """`measured` (n, 3) as the friction model predicts it for ``cg`` (n, 2), and its derivative (n, 3, 13) by ``params`` (13,)."""
    twist = model.twist(wheel_rates(), cg, params)
    (vx, vy, wz), (d_vx, d_vy, d_wz) = np.moveaxis(twist.value, -1, 0), np.moveaxis(twist.d_params, 1, 0)
    value = np.stack([wz / COMMAND[1], -vy / wz, vx / wz], axis=-1)
    by_x = -(d_vy - (vy / wz)[:, None] * d_wz) / wz[:, None]
    by_y = (d_vx - (vx / wz)[:, None] * d_wz) / wz[:, None]
    return value, np.stack([d_wz / COMMAND[1], by_x, by_y], axis=1)


def fit(names: tuple[str, ...], cg: FloatArray, seen: FloatArray, model: MotionModel = VAULTBOT) -> GridFit:
    """``names`` fitted to ``seen`` (n, 3) at ``cg`` (n, 2) from Appendix A's constants; components weigh by their own scatter."""
    free = [model.param_names.index(name) for name in names]
    params = model.nominal.copy()
    value, derivative = predict(cg, params, model)
    for _ in range(40):
        scatter = (seen - value).std(axis=0)
        residual = ((seen - value) / scatter).ravel()
        design = (derivative[:, :, free] / scatter[:, None]).reshape(residual.size, -1)
        step = np.linalg.lstsq(design, residual, rcond=None)[0]
        params[free] += step * min(1.0, 0.05 / np.max(np.abs(step) / np.maximum(np.abs(params[free]), 1.0)))
        value, derivative = predict(cg, params, model)
        if np.max(np.abs(step)) < 1e-11:
            break
    variance = residual @ residual / (residual.size - len(free))
    return GridFit(names, params, params[free], np.sqrt(np.diagonal(np.linalg.inv(design.T @ design)) * variance))


def unfitted(model: MotionModel = VAULTBOT) -> tuple[Errors, float]:
    """Errors with Appendix A's constants and nothing fitted, and the slope of x_CR on x_G, by the thesis's way of means over y_G."""
    table = grid()
    value, _ = predict(table.cg, model.nominal, model)
    x, mean = table.means_over_y(value[:, 1])
    return Errors.of(value - measured(table)), float(polynomial(mean, x, 1).coefficients[1])


def fitted(names: tuple[str, ...] = FITTED, model: MotionModel = VAULTBOT) -> tuple[GridFit, Errors]:
    """The fit to all rows, and what error it leaves in them."""
    table = grid()
    found = fit(names, table.cg, measured(table), model)
    return found, Errors.of(predict(table.cg, found.params, model)[0] - measured(table))


def jackknife_sigma(names: tuple[str, ...] = FITTED, model: MotionModel = VAULTBOT) -> FloatArray:
    """(c,) standard deviations from what the fit becomes without one row: the larger of rows of constant x_G and of constant y_G.

    Errors within a row are alike, so this is up to twice `GridFit.sigma`, and the honest one.
    """
    table, seen = grid(), measured(grid())
    spread = []
    for axis in (0, 1):
        rows = np.unique(table.cg[:, axis])
        values = np.array([fit(names, table.cg[keep], seen[keep], model).values for keep in (table.cg[:, axis] != at for at in rows)])
        spread.append(np.sqrt((len(rows) - 1) * values.var(axis=0)))
    return np.max(spread, axis=0)


def left_out(names: tuple[str, ...] | None, axis: int, model: MotionModel = VAULTBOT) -> Errors:
    """Errors in rows of constant x_G (``axis`` 0) or y_G (1), each predicted from the other rows.

    By the friction model with ``names`` fitted, or by the heuristic with its eleven coefficients where ``names`` is None.
    """
    table, seen = grid(), measured(grid())
    errors = np.zeros_like(seen)
    for at in np.unique(table.cg[:, axis]):
        out = table.cg[:, axis] == at
        if names is None:
            kept = RotationTable(table.cg[~out], table.ratio[~out], table.cor[~out])
            coefficients = skid_steer_fit(kept).coefficients
            k, x_cr, y_cr = SkidSteer(1.0, 1.0, coefficients).rotation(table.cg[out], coefficients)
            value = np.stack([1.875 * k, x_cr, y_cr], axis=-1)
        else:
            value, _ = predict(table.cg[out], fit(names, table.cg[~out], seen[~out], model).params, model)
        errors[out] = value - seen[out]
    return Errors.of(errors)


def _line(what: str, errors: Errors) -> str:
    return f"{what:58} {errors.ratio:8.4f} {errors.x_cr:9.4f} {errors.y_cr:9.4f}"


def main() -> None:
    errors, slope = unfitted()
    found, inside = fitted()
    print(f"{'RMS errors over 68 rotations':58} {'ratio':>8} {'x_CR [m]':>9} {'y_CR [m]':>9}")
    print(_line("friction, Appendix A's constants, nothing fitted", errors))
    print(_line(f"friction, {len(FITTED)} fitted", inside))
    for axis, name in enumerate(("x_G", "y_G")):
        print(_line(f"friction, {len(FITTED)} fitted, rows of constant {name} left out", left_out(FITTED, axis)))
        print(_line(f"heuristic, 11 fitted, rows of constant {name} left out", left_out(None, axis)))
    print(f"\nSlope of x_CR on x_G, nothing fitted: {slope:.4f} (measured 2.1722, {100 * (slope / 2.1722 - 1):+.2f} %).\n")
    for name, value, sigma in zip(found.names, found.values, jackknife_sigma(), strict=True):
        print(f"{name:12} {value:8.4f} +- {sigma:.4f} {MEANING[name]}")
    print("\nWhat each is needed for: RMS errors, all fitted but one")
    for name in FITTED:
        print(_line(f"without {name}", fitted(tuple(n for n in FITTED if n != name))[1]))
    print(_line("tread (grip by direction of sliding) in place of warp", fitted((*(n for n in FITTED if n != "warp"), "tread"))[1]))
    print("\nIn place of scrub, which this table cannot tell from them")
    for name in ALIASES:
        other, errors = fitted((*FITTED[:3], name))
        print(_line(f"{name} {other.values[3]:.4f} +- {jackknife_sigma(other.names)[3]:.4f}", errors))


if __name__ == "__main__":
    main()
