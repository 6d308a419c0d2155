"""Motion of the robot from step to step: what the wheels predict, process noise, and the state before the first step.

    x = [ pose, start, map, key, gyro_bias, gyro_scale, clock, radius, corrections ]

`start` and `key` are clones of the pose at the start of the step and at the last keyframe. `map` is the error of the submap around the
robot, as a right perturbation of the pose: scans that are matched to one submap share it. `clock` is the offset of the wheels' stamps [s],
`radius` the relative error of the radius of all wheels, and `corrections` are added to the parameters of the motion model along their
directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localization.bounded_settings import Settings
from localization.core.filter import Transition, begin
from localization.core.state import Perturbation, State, Vector
from localization.events import Step
from motion_models import se2
from motion_models.groups import SE2, Group
from motion_models.motion import Motion
from motion_models.online_calibration import PRIOR_RETURNS_AFTER_S, WHEEL_RADIUS_SIGMA, Corrections
from motion_models.robot import GyroNoise, WheelNoise
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class FilterConfig(Settings):
    """Prior and process noise of the filter."""

    clock_sigma_s: float = 0.1
    """Sigma of the offset between the clocks of the wheels and of LiDAR or gyro at first [s]; 0 takes them as one."""
    clock_walk_s_per_sqrt_s: float = 1e-4
    """Random walk of the clock offset."""
    wheel_radius_sigma: float = WHEEL_RADIUS_SIGMA
    """Prior sigma of the radius of all wheels, relative: wear, pressure, load of tyres; 0: the robot file's. Only a LiDAR measures it."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Priors and process noise of all variables."""

    wheels: WheelNoise
    gyro: GyroNoise
    corrections: Corrections
    config: FilterConfig


def initial_state(noise: NoiseModel, has_lidar: bool = True) -> State:
    """State at the origin of the odometry frame: zero covariance of pose and submap, which define it, and priors of the others.

    Without a LiDAR there is no second clock until the gyro's first reading.
    """
    gyro, corrections, config = noise.gyro, noise.corrections, noise.config
    one, known, unknown = Vector(1), np.zeros((3, 3)), np.ones((1, 1))
    priors: dict[str, tuple[Group, FloatArray]] = {
        "pose": (SE2, known),
        "start": (SE2, known),
        "map": (Perturbation(3, "pose"), known),
        "key": (SE2, known),
        "gyro_bias": (one, unknown * gyro.bias_sigma_rad_per_s**2),
        "gyro_scale": (one, unknown * gyro.scale_sigma**2),
        "clock": (one, unknown * has_lidar * config.clock_sigma_s**2),
        "radius": (one, unknown * config.wheel_radius_sigma**2),
        "corrections": (Vector(len(corrections.names)), corrections.cov),
    }
    return begin({name: (group, np.zeros(group.dim), cov) for name, (group, cov) in priors.items()})


def wheel_transition(state: State, step: Step, motion: Motion, noise: NoiseModel) -> Transition:
    """The wheels' ``motion`` in ``step``, and process noise of what changes meanwhile:

    e_pose' = Ad(delta^-1) e_pose + (d delta / d clock) e_clock + (d delta / d radius) e_radius + (d delta / d params) e_corrections + slip.

    Ways scale with the wheels' radius; turns have a scale of their own among the parameters.
    """
    gyro, corrections, config = noise.gyro, noise.corrections, noise.config
    dt, radius = step.duration, 1.0 + state.number("radius")
    delta = motion.delta * [radius, radius, 1.0]
    A = se2.adjoint(se2.inverse(delta))
    jacobians = {
        ("pose", "pose"): A,
        ("pose", "clock"): step.d_clock[:, None],
        ("pose", "radius"): np.append(-se2.inverse(motion.delta)[:2], 0.0)[:, None],  # R^T (x, y)
        ("pose", "corrections"): motion.d_params @ corrections.directions,
        ("map", "map"): A,  # the same error of the submap, as a perturbation of the present pose
    }
    Q = {"pose": motion.cov, "gyro_bias": np.array([[gyro.bias_walk_rad_per_s_sqrt_s**2 * dt]])}
    if state.variance("clock"):  # else there is one clock
        Q["clock"] = np.array([[config.clock_walk_s_per_sqrt_s**2 * dt]])
    if step.is_standing:
        floor = noise.wheels.floor_m2_per_s, noise.wheels.floor_m2_per_s, noise.wheels.floor_rad2_per_s
        Q["pose"] = motion.cov + np.diag(floor) * dt  # a push, a slope
    else:
        Q["corrections"] = corrections.process_noise * dt
        if state.variance("radius"):
            Q["radius"] = np.array([[config.wheel_radius_sigma**2 / PRIOR_RETURNS_AFTER_S * dt]])
    what = f"the motion of the wheels until stamp {step.end_ns} ns"
    return Transition({"pose": se2.compose(state["pose"], delta)}, jacobians, Q, what)
