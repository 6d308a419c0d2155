"""Turns in place on inclined planes in MuJoCo: k over all headings and the slide downhill, beside the law of slopes.

python -m tests.studies.hill_headings

Each robot turns twice by its wheels; the law is given their rates and the true heading. It has the robot file's contacts once, and once
those of MuJoCo, whose wheels do not resist rolling and whose friction is full from 3 cm/s of slip on (slip_stiffness 50). A third time it
has the slip stiffness, mu and k that the filter (ekf, wheels and IMU) estimates during the same turns, from the robot file's.
Needs the extra `mujoco`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from localization.events import WheelSample
from localization.pipeline import Pipeline, Trial
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope
from tests.helpers.hills import HillDrive
from tests.helpers.mujoco_hills import drive, steady

_TURN_RATE, _TURNS, _SETTLED_S = 0.6, 2, 4.0
_SPAN = 15
"""Samples over which turns are measured: .3 s."""
_SECTORS = 36
CONTACTS = {"by the robot file": {}, "as MuJoCo's": {"slip_stiffness": 50.0, "rolling_resistance": 0.0}}


@dataclass(frozen=True)
class Turned:
    """Motion of a robot that turns in place, N times."""

    headings: FloatArray
    """(N,) 0 is uphill [rad]."""
    rates: FloatArray
    """(N, 2) of the wheels [rad/s]."""
    k: FloatArray
    """(N,) turn rate over that of wheels that do not slip."""
    slid_m: float
    """Downhill."""


def robot_of(name: str, mu: float, contacts: dict[str, float]) -> Robot:
    """A robot file with known friction."""
    robot = load_robot(name)
    return replace(robot, models={**robot.models, "friction": {**robot.models.get("friction", {}), "mu": mu, **contacts}})


def measured(made: HillDrive, robot: Robot) -> Turned:
    """The motion of ``made``, which lies on a plane that rises towards +x."""
    stamps = made.stamps_ns - made.stamps_ns[0]
    at = np.flatnonzero(stamps > _SETTLED_S * 1e9)[:-_SPAN]
    yaw = np.unwrap(np.arctan2(made.rotations[:, 1, 0], made.rotations[:, 1, 1]))  # y is level on this plane
    angles = np.array([e.position for e in made.events if isinstance(e, WheelSample)])
    turned, rolled = yaw[at + _SPAN] - yaw[at], angles[at + _SPAN] - angles[at]
    k = turned / _turn_without_slip(robot, rolled)
    way = made.positions[at[-1]] - made.positions[at[0]]
    rates = rolled / (1e-9 * (made.stamps_ns[at + _SPAN] - made.stamps_ns[at])[:, None])
    return Turned(0.5 * (yaw[at + _SPAN] + yaw[at]), rates, k, float(np.copysign(np.hypot(way[0], way[2]), -way[2])))


def by_law(found: Turned, robot: Robot, slope_deg: float, step_s: float) -> tuple[FloatArray, float]:
    """k (N,) and slide downhill [m] of the law at the rates and headings of ``found``."""
    model, psi = FrictionModel.from_robot(robot), found.headings
    downhill = math.tan(math.radians(slope_deg)) * np.column_stack([-np.cos(psi), np.sin(psi)])
    slope = Slope(downhill, robot.geometry.cg_height_m)
    vx, vy, wz = model.twist_on_slope(found.rates, np.zeros(2), np.asarray(model.nominal), slope).twist.value.T
    return wz / _turn_without_slip(robot, found.rates), -float(np.sum(np.cos(psi) * vx - np.sin(psi) * vy)) * step_s


def estimated(made: HillDrive, robot: Robot) -> tuple[Robot, float]:
    """``robot`` with the tyres that ekf has estimated at the end of ``made``, and the factor of its turns on level ground."""
    pipeline = Pipeline(Trial(make_model("skid_steer", robot), "ekf"), robot, made.mounts, False)
    for event in made.events:
        pipeline.process(event)
    on_slopes = pipeline.synchronizer.wheels.on_slopes
    assert on_slopes is not None, "the model is of level ground"
    nominal = dict(zip(FrictionModel.param_names, FrictionModel.from_robot(robot).nominal.tolist(), strict=True))
    sizes = {name: nominal[name] * math.exp(log) for name, log in zip(("slip_stiffness", "mu"), on_slopes.tyres.logs, strict=True)}
    friction = {**robot.models["friction"], **sizes}
    return replace(robot, models={**robot.models, "friction": friction}), 1.0 + on_slopes.tyres.turning_error


def _turn_without_slip(robot: Robot, wheels: FloatArray) -> FloatArray:
    g = robot.geometry
    return np.asarray(g.wheel_radius_m * (wheels[:, 1] - wheels[:, 0]) / g.track_width_m)


def over_headings(psi: FloatArray, values: FloatArray) -> FloatArray:
    """Means of ``values`` (N,) in sectors of the heading."""
    sector = np.floor(np.mod(psi, 2.0 * math.pi) / (2.0 * math.pi) * _SECTORS).astype(int)
    return np.array([values[sector == i].mean() for i in range(_SECTORS)])


def main() -> None:
    """Print the table."""
    print("| robot | slope | mu | contacts | k: MuJoCo | law | rms | ends off by | slide: MuJoCo | law |\n" + "|---" * 10 + "|")
    for name, deg, mu in ((n, d, m) for n in ("husky_a200", "jackal") for d in (0.0, 5.0, 10.0) for m in (0.5, 0.8)):
        seconds = _SETTLED_S + 2.0 * math.pi * _TURNS / _TURN_RATE
        robot = robot_of(name, mu, {})
        made = drive(steady(0.0, _TURN_RATE), seconds, mu, deg, robot)
        found = measured(made, robot)
        k = over_headings(found.headings, found.k)
        models = {contacts: (robot_of(name, mu, of), 1.0) for contacts, of in CONTACTS.items()}
        for contacts, (of, factor) in {**models, "as ekf estimates": estimated(made, robot)}.items():
            law, slid = by_law(found, of, deg, 0.02)
            own = factor * over_headings(found.headings, law)
            print(
                f"| {name} | {deg:.0f} deg | {mu} | {contacts} | {k.min():.3f} to {k.max():.3f} | {own.min():.3f} to {own.max():.3f} "
                f"| {np.sqrt(np.mean((own - k) ** 2)):.3f} | {own.min() - k.min():+.3f}, {own.max() - k.max():+.3f} "
                f"| {found.slid_m:.2f} m | {slid:.2f} m |",
                flush=True,
            )


if __name__ == "__main__":
    main()
