"""A Warthog that nobody calibrated: 305 m of gentle arcs by wheels alone, simulated on drawn tyres and floors.

python -m tests.studies.warthog [--robots 40]

A stand-in for a real log that is not shipped (GNSS truth, gentle arcs; ATE 37 m by the thesis's contact law, 7.5 m by the isotropic one,
3.5 m with the best constant k). The robot is the friction model with the centripetal force; drawn for each robot are slip stiffness,
friction, the ratio across to along, the effective track, the CG, the radius of all wheels and of left against right, and slip noise. The
estimator has skid_steer with the shipped geometry: no coefficient of a Warthog. "20 s" is `calibrate` on the first 20 s in windows of 2 s
with a reference of 2 cm and 0.01 rad; both are scored by the absolute trajectory error of the whole drive. "true k" is the regression of
the whole drive's yaw without any noise: no drive, however long, gives a better constant by which to predict. What it leaves is the
difference of the radii and the slip of the drive itself, which the best constant k, fitted in hindsight, takes for a part of k.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np

from localization.evaluation.metrics import align
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.fit import FitConfig
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.plan import calibrate, free_of
from motion_models.errors import CalibrationError
from motion_models.friction import FrictionModel
from motion_models.online_calibration import CorrectedWheels
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

DT, SPEED_M_PER_S, LENGTH_M = 0.05, 1.5, 305.0
_WINDOW, _FIRST = 40, 400  # steps of DT: 2 s and 20 s
_YAW_NOISE_RAD2_PER_M = 2e-5  # leaves some 3 m of error with the best constant k, as on the real log
_SPREAD = {"slip_stiffness": (5.0, 13.0), "mu": (0.5, 0.9), "mu_ratio": (0.85, 1.15)}
_TRACK, _RADIUS, _DIFFERENCE = 0.02, 0.01, 0.0013  # relative standard deviations
_CG_M = np.array([0.05, 0.02])
_REFERENCE_SIGMA = np.array([0.02, 0.02, 0.01])


class Drive(NamedTuple):
    """Wheel rates (n, 2) and true twists (n, 3) of one robot."""

    wheels: FloatArray
    twists: FloatArray


class Errors(NamedTuple):
    """ATE [m]: without slip (k = 1), with k of the geometry, after 20 s of driving, with the true k, and with the best constant k."""

    no_slip: float
    zero_drive: float
    after_20_s: float
    true_k: float
    best_k: float


def simulate(rng: np.random.Generator, yaw_noise: float = _YAW_NOISE_RAD2_PER_M) -> Drive:
    """Gentle arcs to both sides, by wheel rates that the true robot turns into its own motion."""
    robot = load_robot("warthog")
    model = FrictionModel.from_robot(robot)
    truth, params = FrictionModel(model.nominal, model.saturation, centripetal=True), model.nominal.copy()
    names = FrictionModel.param_names
    for name, (low, high) in _SPREAD.items():
        params[names.index(name)] = rng.uniform(low, high)
    params[names.index("track_width")] *= 1.0 + rng.normal(0.0, _TRACK)
    n = round(LENGTH_M / (SPEED_M_PER_S * DT))
    t = np.arange(n) * DT
    curvature = rng.uniform(0.08, 0.15) * np.sin(2.0 * np.pi * t / rng.uniform(25.0, 50.0)) + rng.uniform(-0.03, 0.03)
    half = curvature * robot.geometry.track_width_m / (2.0 * 0.6)
    wheels = SPEED_M_PER_S * np.stack([1.0 - half, 1.0 + half], axis=-1) / robot.geometry.wheel_radius_m
    scale, difference = 1.0 + rng.normal(0.0, _RADIUS), rng.normal(0.0, _DIFFERENCE)
    rolled = wheels * scale * np.array([1.0 + difference / 2.0, 1.0 - difference / 2.0])
    twists = truth.twist(rolled, rng.normal(0.0, _CG_M), params).value
    twists[:, 2] += rng.normal(0.0, np.sqrt(yaw_noise * SPEED_M_PER_S / DT), n)
    return Drive(wheels, twists)


def path(twists: FloatArray) -> FloatArray:
    """(n, 3) poses after each step of ``twists`` (n, 3)."""
    steps, heading = se2.exp(twists * DT), np.cumsum(twists[:, 2]) * DT
    before = heading - twists[:, 2] * DT
    c, s = np.cos(before), np.sin(before)
    x, y = steps[:, 0], steps[:, 1]
    return np.column_stack([np.cumsum(c * x - s * y), np.cumsum(s * x + c * y), heading])


def ate(twists: FloatArray, truth: FloatArray) -> float:
    """Absolute trajectory error [m] of dead reckoning by ``twists`` (n, 3) against poses (n, 3)."""
    estimate = path(twists)
    aligned = se2.compose(align(estimate, truth[:, :2], truth[:, 2]), estimate)
    return float(np.sqrt(np.mean(np.sum((aligned - truth)[:, :2] ** 2, axis=1))))


def first_windows(drive: Drive, rng: np.random.Generator) -> list[Maneuver]:
    """The first 20 s, in windows of 2 s between poses of a reference; neighbours share one."""
    found, start = [], rng.normal(0.0, _REFERENCE_SIGMA)
    world_T_body = np.vstack([np.zeros(3), path(drive.twists[:_FIRST])])
    for begin in range(0, _FIRST, _WINDOW):
        inside = slice(begin, begin + _WINDOW)
        end = world_T_body[begin + _WINDOW] + rng.normal(0.0, _REFERENCE_SIGMA)
        cov = np.diag(2.0 * _REFERENCE_SIGMA**2)
        measured = se2.between(start, end)[None]
        found.append(
            Maneuver(np.full(_WINDOW, DT), drive.wheels[inside], measured, np.array([_WINDOW]), cov=cov, group=f"{begin * DT:g} s")
        )
        start = end
    return found


def study(seed: int) -> Errors:
    """One robot and drive."""
    rng, robot = np.random.default_rng(seed), load_robot("warthog")
    drive = simulate(rng)
    truth, cg = path(drive.twists), robot.center_of_gravity
    skid = make_model("skid_steer", robot)

    def error(model: MotionModel, params: FloatArray) -> float:
        return ate(model.twist(drive.wheels, cg, params).value, truth)

    def constant(k: float) -> float:
        return error(skid, np.concatenate([[k], np.zeros(10)]))

    wheels = CorrectedWheels(skid)
    windows = first_windows(drive, rng)
    try:
        found = calibrate(wheels, windows, free_of(wheels, windows), FitConfig(noise=robot.wheel_noise)).fit.params
    except CalibrationError:
        found = wheels.nominal
    best = min(constant(k) for k in np.linspace(0.45, 0.75, 31))
    exact = simulate(np.random.default_rng(seed), yaw_noise=0.0).twists[:, 2]
    by_wheels = skid.twist(drive.wheels, cg, np.concatenate([[1.0], np.zeros(10)])).value[:, 2]
    true_k = float(by_wheels @ exact / (by_wheels @ by_wheels))
    return Errors(constant(1.0), error(skid, skid.nominal), error(wheels, found), constant(true_k), best)


def main() -> None:
    """Print quantiles over robots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=40)
    found = np.array([study(seed) for seed in range(parser.parse_args().robots)])
    print(f"ATE [m] over {LENGTH_M:g} m, {len(found)} robots\n\n| | median | 90 % | largest |\n|---|---|---|---|")
    for name, column in zip(("k = 1", "geometry", "20 s", "true k", "best constant k"), found.T, strict=True):
        print(f"| {name} | {np.median(column):.2f} | {np.quantile(column, 0.9):.2f} | {column.max():.2f} |")


if __name__ == "__main__":
    main()
