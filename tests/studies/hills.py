"""Slopes: what the flat model gets wrong and what the friction model on slopes predicts, beside measurements in MuJoCo.

python -m tests.studies.hills

The measurements are two independent sets, turning in place on inclined planes, with soft contacts (ellipsoid wheels, solref .01 to .1,
elliptic cones, steps of 1 ms or less); nothing of the law is fitted to them. The first is of a robot of a Husky's size, 10 s, about 540
degrees; the second gives k and the centre of rotation over all headings, mu 0.6 and contacts that slide (slip_stiffness 100).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from motion_models.friction import FrictionModel
from motion_models.robot import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope

_RADIUS_M, _STEP_S = 0.165, 0.02
_MODEL = FrictionModel.from_robot(load_robot("husky_a200"))


@dataclass(frozen=True)
class Turning:
    """Turns in place for 10 s on an inclined plane, measured."""

    slope_deg: float
    mu: float
    cg_height_m: float
    slid_m: float
    """Downhill."""
    turned_more: float
    """Than on the flat, as a share."""


TURNINGS = (
    Turning(5.0, 0.8, 0.40, 0.68, 0.014),
    Turning(10.0, 0.8, 0.40, 1.24, 0.081),
    Turning(15.0, 0.8, 0.40, 1.77, 0.23),
    Turning(5.0, 0.5, 0.40, 1.07, 0.027),
    Turning(10.0, 0.5, 0.40, 2.12, 0.11),
    Turning(5.0, 0.8, 0.25, 0.71, 0.012),
)
_WHEELBASE_M, _TRACK_M = 0.512, 0.57
_TURNED_RAD, _DURATION_S = math.radians(540.0), 10.0


@dataclass(frozen=True)
class Headings:
    """k, and the ranges of the centre of rotation, over all headings."""

    robot: str
    wheelbase_m: float
    track_m: float
    cg_height_m: float
    slope_deg: float
    k: tuple[float, float]
    x_m: float
    y_m: float


HEADINGS = (
    Headings("Jackal", 0.262, 0.3756, 0.12, 5.0, (0.668, 0.739), 0.177, 0.071),
    Headings("Jackal", 0.262, 0.3756, 0.12, 10.0, (0.637, 0.824), 0.225, 0.153),
    Headings("Husky", 0.512, 0.5708, 0.20, 5.0, (0.475, 0.545), 0.292, 0.265),
    Headings("Husky", 0.512, 0.5708, 0.20, 10.0, (0.416, 0.684), 0.460, 0.539),
)


def parameters(wheelbase_m: float, track_m: float, mu: float, slip_stiffness: float, rolling_resistance: float) -> FloatArray:
    """(12,) of a symmetric robot."""
    return np.array([_RADIUS_M, track_m, wheelbase_m, mu, 1.0, slip_stiffness, rolling_resistance, 0.0, 0.0, 0.0, 0.0, 0.0])


def turn(of: Turning) -> FloatArray:
    """(3,) the pose after `Turning` by the law, on a plane that rises towards +x; the flat model stays at the start."""
    params = parameters(_WHEELBASE_M, _TRACK_M, of.mu, 10.0, 0.0)
    flat = _MODEL.twist(np.array([-1.0, 1.0]), np.zeros(2), params).value[2]
    rate = _TURNED_RAD / _DURATION_S / flat
    steep, pose = math.tan(math.radians(of.slope_deg)), np.zeros(3)
    for _ in range(round(_DURATION_S / _STEP_S)):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        slope = Slope(steep * np.array([-c, s]), of.cg_height_m)
        vx, vy, wz = _MODEL.twist_on_slope(np.array([-rate, rate]), np.zeros(2), params, slope).twist.value
        pose = pose + _STEP_S * np.array([c * vx - s * vy, s * vx + c * vy, wz])
    return np.asarray(pose)


def over_headings(of: Headings, n: int = 72) -> Headings:
    """``of`` with k and the centre of rotation by the law."""
    params, psi = parameters(of.wheelbase_m, of.track_m, 0.6, 100.0, 0.0), np.linspace(0.0, 2.0 * math.pi, n, endpoint=False)
    slope = Slope(math.tan(math.radians(of.slope_deg)) * np.column_stack([np.cos(psi), np.sin(psi)]), of.cg_height_m)
    vx, vy, wz = _MODEL.twist_on_slope(np.tile([-1.0, 1.0], (n, 1)), np.zeros(2), params, slope).twist.value.T
    k = wz * of.track_m / (2.0 * _RADIUS_M)
    found = (float(k.min()), float(k.max())), float(np.ptp(vy / wz)), float(np.ptp(vx / wz))
    return Headings(of.robot, of.wheelbase_m, of.track_m, of.cg_height_m, of.slope_deg, *found)


def main() -> None:
    """Print the tables."""
    print(
        "| slope | mu | CG [m] | slid downhill: MuJoCo = flat model's error | with the law | left | turned more: MuJoCo | law |\n"
        + "|---" * 8
        + "|"
    )
    for row in TURNINGS:
        x, _, yaw = turn(row)
        more = yaw / _TURNED_RAD - 1.0
        print(
            f"| {row.slope_deg:.0f} deg | {row.mu} | {row.cg_height_m:.2f} | {row.slid_m:.2f} m | {-x:.2f} m | {-x - row.slid_m:+.2f} m "
            f"| {row.turned_more:.1%} | {more:.1%} |"
        )
    print("\n| robot | slope | k: law | k: MuJoCo | x of the centre of rotation: law / MuJoCo [m] | y |\n" + "|---" * 6 + "|")
    for seen in HEADINGS:
        law = over_headings(seen)
        print(
            f"| {seen.robot} | {seen.slope_deg:.0f} deg | {law.k[0]:.3f} to {law.k[1]:.3f} | {seen.k[0]:.3f} to {seen.k[1]:.3f} "
            f"| {law.x_m:.3f} / {seen.x_m:.3f} | {law.y_m:.3f} / {seen.y_m:.3f} |"
        )


if __name__ == "__main__":
    main()
