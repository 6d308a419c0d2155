"""Drives of a robot whose MJCF is known: the truth of tests in which a copy of that file is spoiled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localization.twin.mujoco_simulator import MujocoSimulator, read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.simulator import Numbers, Simulator
from localization.twin.windows import windows_of
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver
from motion_models.robot import Robot

GROUNDED = {"time_constant_s": 0.06, "softness": 0.5, "impratio": 5.0, "is_elliptic": 1.0, "mu": 0.7}
"""Contacts of a true robot on which the wheels keep to the floor."""
_SIGMA = np.array([0.003, 0.003, 0.005])
"""Noise of the measured motion over two seconds [m, m, rad]."""
_STEP_S = 0.1


def true_simulator(robot: Robot, **numbers: float) -> MujocoSimulator:
    """The robot as it is: its file on grounded contacts with a stiff servo, changed by ``numbers``."""
    stock = read_simulator(mjcf_of(robot), robot)
    true = replace(stock.numbers, **{**GROUNDED, "servo_gain": 5.0 * stock.numbers.servo_gain, **numbers})
    return read_simulator(stock.with_numbers(true), robot)


def drive(true: Simulator, robot: Robot, seed: int, count: int = 48) -> list[Maneuver]:
    """Windows of two seconds with ramps: turns in place, arcs and straight ways to both sides at several speeds, with noise."""
    rng = np.random.default_rng(seed)
    maneuvers = []
    for i in range(count):
        kind = i % 4
        speed = 0.0 if kind == 0 else rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.8)
        turn = rng.choice([-1.0, 1.0]) * (0.0 if kind == 3 else rng.uniform(0.3, 1.2))
        shape = np.clip(np.arange(20) / rng.uniform(2.0, 10.0), 0.0, 1.0)[:, None]
        sides = (speed + turn * robot.geometry.track_width_m * np.array([-0.9, 0.9])) / robot.geometry.wheel_radius_m
        maneuvers.append(
            Maneuver(np.full(20, _STEP_S), sides * shape, np.zeros((1, 3)), np.array([20]), robot.center_of_gravity, group=f"window {i}")
        )
    played = true.engine.play(windows_of(maneuvers, robot))
    noise = rng.normal(0.0, _SIGMA, (count, 3))
    cov = np.diag(_SIGMA**2)
    return [replace(m, measured=se2.compose(p, e)[None], cov=cov) for m, p, e in zip(maneuvers, played.poses, noise, strict=True)]


def spoiled(true: MujocoSimulator, **numbers: float) -> MujocoSimulator:
    """The file of ``true`` with other ``numbers``."""
    changed: Numbers = replace(true.numbers, **numbers)
    return read_simulator(true.with_numbers(changed), true.robot)
