"""Coefficients of `SkidSteer` and `Icr` for a robot without a calibration: from geometry, by the friction model, with uncertainty.

With equally loaded wheels and the isotropic contact law, rotations in place (all wheels slide) and gentle arcs (force proportional to
slip) have the same limit,

    k = 1 / (1 + (wheelbase / track)^2).

The friction model adds the finite slip stiffness, rolling resistance, and how k and the centre of rotation (CoR) change with the centre of
gravity (CG). Nothing here is fitted to a robot; measured robots only set the standard deviation (`EVIDENCE`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motion_models.errors import CgError, ModelError
from motion_models.friction.model import FrictionModel
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

_GRID_X, _GRID_Y = 0.15, 0.05
"""Half widths of the CG grid for the polynomials, over wheelbase and track. VaultBot's arms reach 0.17 and 0.05 (Ebersole 2016)."""
_POINTS_X, _POINTS_Y = 7, 5
"""Points of the CG grid along x and y: twice as many as the polynomials have degrees."""
_CENTER_X, _CENTER_Y = 0.10, 0.05
"""Standard deviations of the CoR at the nominal CG, over wheelbase and track: errors of CG and tracked point. VaultBot's
rotations have their CoR 0.12 wheelbases behind its weighed CG (Ebersole 2016, 4.22)."""
_CURVED, _SLOPE_SIGMA = [2, 4, 8, 10], 0.25
"""k_2, x_cr_1, y_cr_s0 and y_cr_s2: their relative standard deviation. VaultBot's are within 25 % of those by geometry (a test)."""
_DRIVEN_SIGMA = 0.02
"""Relative standard deviation of k of a robot with two driven wheels and a caster: its track. Freiburg's Pioneers, fr079: 1 %."""
CALIBRATION_TURN_S = 20.0
"""Duration of the turning that a note recommends [s]."""
_TURN_RAD_PER_S = 0.5
"""Its yaw rate [rad/s]."""


@dataclass(frozen=True)
class MeasuredK:
    """A robot whose k was measured, or is in its manufacturer's driver."""

    robot: str
    measured: float
    """k by measurement, or by its manufacturer's multiplier (k = 1 / multiplier)."""
    predicted: float
    """k by the friction model at its geometry, CG in the middle, nothing fitted."""
    source: str


EVIDENCE = (
    MeasuredK("vaultbot", 0.9541 / 1.875, 0.5263, "68 rotations in place, Ebersole 2016, 4.21"),
    MeasuredK("husky_a200", 1.0 / 1.875, 0.5433, "Clearpath's wheel_separation_multiplier"),
    MeasuredK("drive_husky", 0.43 / 0.928, 0.5433, "DRIVE windows: k 0.43 by the wheels, over their effectiveness of 0.928 straight ahead"),
    MeasuredK("borealtc_husky", 0.6764, 0.5433, "BorealTC, 75 runs: geometric mean of 0.768 (floor), 0.722, 0.722, 0.599, 0.590 (snow)"),
    MeasuredK("upenn_4wd", 0.525, 0.576, "a four-wheeled rover whose log is not shipped"),
    MeasuredK("jackal", 1.0 / 1.5, 0.6614, "Clearpath's wheel_separation_multiplier"),
    MeasuredK("husky_a300", 1.0 / 1.75, 0.5357, "Clearpath's wheel_separation_multiplier"),
    MeasuredK("leo", 1.0 / 1.76, 0.5681, "firmware's robot_angular_velocity_multiplier"),
    MeasuredK("rosbot", 0.192 / (0.186 * 1.36), 0.7555, "Husarion's wheel_separation_multiplier, at radii that it measured"),
    MeasuredK("rosbot_xl", 1.0 / 1.3, 0.6690, "Husarion's wheel_separation_multiplier, an office floor"),
    MeasuredK("warthog", 0.61, 0.5957, "middle of 0.59 to 0.63 by logs that are not shipped"),
)
"""Grounds from floor to snow are averaged for each robot; they differ by 12 % (BorealTC). The last three were added as a test of the first
eight, with a standard deviation of 0.105: all are inside its 90 % interval."""


def scaling_sigma(evidence: tuple[MeasuredK, ...] = EVIDENCE) -> float:
    """Relative standard deviation of a predicted k: root mean square of log(measured / predicted) over robots.

    The mean of the logarithms (0.014) is well inside its standard error (0.03), so no bias is subtracted.
    """
    return math.sqrt(sum(math.log(e.measured / e.predicted) ** 2 for e in evidence) / len(evidence))


def geometric_scaling(wheelbase_m: float, track_width_m: float) -> float:
    """k [-] of a centred CG by geometry alone, the limit of the module's text.

    >>> round(geometric_scaling(0.512, 0.5708), 3)  # a Husky; its driver has 1 / 1.875 = 0.533
    0.554
    """
    return 1.0 / (1.0 + (wheelbase_m / track_width_m) ** 2)


@dataclass(frozen=True)
class SkidPrior:
    """Mean and standard deviation of the eleven coefficients of `SkidSteer`."""

    coefficients: FloatArray
    """(11,)"""
    sigmas: FloatArray
    """(11,)"""
    source: str
    """Source of the numbers, for messages."""


def expected_scaling(robot: Robot) -> float:
    """k of the robot: of its file, else by its geometry; 1 for two driven wheels with casters."""
    if robot.drive == DIFF_DRIVE:
        return 1.0
    known = robot.models.get("skid_steer", {}).get("k_0")
    return float(skid_prior(robot).coefficients[0]) if known is None else known


def skid_prior(robot: Robot) -> SkidPrior:
    """Coefficients of `SkidSteer` for ``robot`` from its geometry and CG alone; its file's own coefficients are not used.

    A robot with two driven wheels and a caster does not skid: k = 1 and a CoR on its axle.
    """
    g = robot.geometry
    center = np.array([_CENTER_X * g.wheelbase_m, _CENTER_Y * g.track_width_m])
    values, sigmas = np.zeros(11), np.zeros(11)
    if robot.drive == DIFF_DRIVE:
        values[0], sigmas[0] = 1.0, _DRIVEN_SIGMA
        return SkidPrior(values, sigmas, "two driven wheels and a caster")
    source = "geometry"
    model, lengths = FrictionModel.from_robot(robot), (g.wheelbase_m, g.track_width_m, *map(float, robot.center_of_gravity))
    try:
        values = np.array(_polynomials(model.nominal.tobytes(), model.saturation, model.centripetal, *lengths))
    except (CgError, ModelError):  # a CG outside its wheels: their limit for a centred CG remains
        values[0] = geometric_scaling(g.wheelbase_m, g.track_width_m)
        source = "wheelbase and track alone"
    sigmas[_CURVED] = _SLOPE_SIGMA * np.abs(values[_CURVED])
    sigmas[0], sigmas[1], sigmas[3], sigmas[5] = scaling_sigma() * values[0], 2.0 * abs(values[2]) * center[0], *center
    return SkidPrior(values, sigmas, source)


@functools.lru_cache(maxsize=64)  # 20 ms, and a command makes dozens of models of one robot
def _polynomials(
    nominal: bytes, saturation: float, centripetal: bool, wheelbase: float, track_width: float, x_0: float, y_0: float
) -> tuple[float, ...]:
    """Eleven regressions of the friction model's rotations in place on the CG, in the form of Ebersole 2016, 4.21-4.24.

    k is exact at the nominal CG (``x_0``, ``y_0``); the rest is least squares over a grid around it. The first three arguments are those
    of the friction model, ``nominal`` as bytes. Lengths are in m.
    """
    model = FrictionModel(np.frombuffer(nominal), saturation, centripetal)
    grid = np.meshgrid(
        x_0 + np.linspace(-_GRID_X, _GRID_X, _POINTS_X) * wheelbase,
        y_0 + np.linspace(-_GRID_Y, _GRID_Y, _POINTS_Y) * track_width,
    )
    x, y = (axis.ravel() for axis in grid)
    turn = np.array([-1.0, 1.0])
    k, x_cr, y_cr = _rotation(model, turn, np.stack([x, y], axis=-1), track_width)
    k_nominal = float(_rotation(model, turn, np.array([[x_0, y_0]]), track_width)[0][0])
    dx, one = x - x_0, np.ones_like(x)
    slope, curve = np.linalg.lstsq(np.stack([dx, dx**2], axis=-1), k - k_nominal, rcond=None)[0]
    by_x = np.linalg.lstsq(np.stack([one, x], axis=-1), x_cr, rcond=None)[0]
    by_xy = np.linalg.lstsq(np.stack([one, x, x**2, y, x * y, x**2 * y], axis=-1), y_cr, rcond=None)[0]
    k_0 = k_nominal - slope * x_0 + curve * x_0**2
    return k_0, slope - 2.0 * curve * x_0, curve, *by_x, *by_xy


def _rotation(model: FrictionModel, wheels: FloatArray, cg: FloatArray, track_width_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """k [-], x_CR and y_CR [m], each (n,), of a rotation in place at ``cg`` (n, 2)."""
    vx, vy, wz = model.interpret_twist(wheels, cg, model.nominal).value.T
    return wz * track_width_m / (model.nominal[0] * (wheels[1] - wheels[0])), -vy / wz, vx / wz


def slip_at_speed(robot: Robot, speed_m_per_s: float = 1.0, yaw_rate_rad_per_s: float = 0.5) -> tuple[float, float]:
    """lateral_slip_speed [s] and rotation_slip_speed [s/m] (`FullLinear`) that the centripetal force causes on ``robot`` at a gentle arc.

    Differences of the friction model with and without m v wz on the lateral balance (`friction.equilibrium`), CG in the middle. They
    give sign and size of a prior: a robot's own values depend on its tyres.
    """
    still = FrictionModel.from_robot(robot)
    moving = FrictionModel(still.nominal, still.saturation, centripetal=True)
    cg = robot.center_of_gravity
    wheels = still.wheels(np.array([speed_m_per_s, yaw_rate_rad_per_s]), cg, still.nominal)
    vx, vy, wz = moving.twist(wheels, cg, still.nominal).value
    _, vy_still, wz_still = still.twist(wheels, cg, still.nominal).value
    return float((vy - vy_still) / (vx * wz)), float((1.0 - wz / wz_still) / abs(vx))


class ScalingPrior(NamedTuple):
    """k of a robot without a calibration."""

    k: float
    """Rotation scaling [-]."""
    sigma: float
    """Its standard deviation."""
    sigma_after_turning: float
    """Standard deviation of k after `CALIBRATION_TURN_S` of turning: k sqrt(yaw variance per radian / turned angle)."""
    source: str
    """Source of k."""


def scaling_prior(robot: Robot, models: Sequence[str] = ("skid_steer",)) -> ScalingPrior | None:
    """Prior of k, where the file of ``robot`` has no k_0 and one of ``models`` uses it; else None."""
    if not {"skid_steer", "icr"} & set(models) or "k_0" in robot.models.get("skid_steer", {}):
        return None
    prior = skid_prior(robot)
    k, sigma = float(prior.coefficients[0]), float(prior.sigmas[0])
    turned = CALIBRATION_TURN_S * _TURN_RAD_PER_S
    measured = k * math.sqrt(robot.wheel_noise.yaw_rad2_per_rad / turned)
    return ScalingPrior(k, sigma, sigma * measured / math.hypot(sigma, measured), prior.source)
