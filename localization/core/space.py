"""Motion and measurements of a pose in space: the wheels' planar motion lifted into the body's plane, the gyro's turns and gravity.

    x = [ pose, start, map, gyro_bias, gyro_scale, accelerometer ]

`start` is a clone of the pose at the start of the step. `map` is the error of the submap around the robot, as a right perturbation of the
pose: clouds that are matched to one submap share it. `accelerometer` is its bias with what its mount is off [m/s^2], constant in the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from localization.bounded_settings import Settings, at_least
from localization.core.filter import Measurement, Transition, begin, set_marginal
from localization.core.state import Perturbation, State, Vector
from localization.events import BodyTurn, Gravity, Step
from motion_models import se3
from motion_models.groups import SE3
from motion_models.robot import GyroNoise
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_LIFT = np.zeros((6, 3))
"""Matrix from planar tangents (x, y, yaw) to tangents of SE(3) (translation, rotation)."""
_LIFT[[0, 1, 5], [0, 1, 2]] = 1.0
_TILT_RATE_RAD_S = 0.5
"""Sigma of roll and pitch rates by the terrain alone, wide beside the gyro that measures them: a wheel that drops 0.1 m off a kerb in 0.4 s
tilts a robot of 0.5 m by so much [rad/s]."""
_FIRST_TILT_SIGMA = np.radians(10.0)
"""Before gravity is measured for the first time [rad]."""


@dataclass(frozen=True)
class SpaceConfig(Settings):
    """Prior and process noise of poses in space."""

    terrain_m_per_sqrt_s: Annotated[float, at_least(1e-4)] = 0.02
    """Random walk of the body across its own plane: bumps, tyres that give way [m/sqrt(s)]."""
    accelerometer_m_s2: Annotated[float, at_least(1e-3)] = 0.2
    """Sigma of the accelerometer's bias with a mount that is off by 1.2 deg [m/s^2]."""
    standstill_m2_per_s: float = 1e-6
    """Variance of the position while no wheel moves, per second [m^2/s]."""


def initial_space_state(gyro: GyroNoise, bias_sigma: float, config: SpaceConfig) -> State:
    """State at the odometry origin, level within 10 deg (1 sigma); ``bias_sigma``: gyro axes across the vertical [rad/s]."""
    known, tilt = np.zeros((6, 6)), _FIRST_TILT_SIGMA**2
    return begin(
        {
            "pose": (SE3, np.eye(4), np.diag([0.0, 0.0, 0.0, tilt, tilt, 0.0])),
            "start": (SE3, np.eye(4), known),
            "map": (Perturbation(6, "pose"), np.zeros(6), known),
            "gyro_bias": (Vector(3), np.zeros(3), np.diag([bias_sigma**2, bias_sigma**2, gyro.bias_sigma_rad_per_s**2])),
            "gyro_scale": (Vector(1), np.zeros(1), np.array([[gyro.scale_sigma**2]])),
            "accelerometer": (Vector(3), np.zeros(3), config.accelerometer_m_s2**2 * np.eye(3)),
        }
    )


def start_at(state: State, position: FloatArray, rotation: FloatArray, cov: FloatArray) -> State:
    """``state`` at a pose (3,), (3, 3) of an estimator in the plane, with its covariance (6, 6) in the world's axes.

    Roll and pitch keep their first variance: gravity measures them anew.
    """
    pose, world = np.eye(4), np.kron(np.eye(2), rotation)
    pose[:3, :3], pose[:3, 3] = rotation, position
    body, tilt = world.T @ cov @ world, np.diag(state.cov("pose"))[3:5]
    body[3:5], body[:, 3:5] = 0.0, 0.0
    body[3:5, 3:5] = np.diag(tilt)
    return set_marginal(state, "pose", pose, body)


def lifted_transition(state: State, step: Step, gyro: GyroNoise, config: SpaceConfig) -> Transition:
    """The wheels' planar motion in the body's plane, which the terrain tilts and moves along its normal meanwhile:

    e_pose' = Ad(delta^-1) e_pose + L slip + B (n_z, n_roll, n_pitch)

    Turns by the terrain are constant in a step: a turn a over the way d moves the end by a x d / 2.
    """
    dt, delta = step.duration, se3.lift(step.predicted.delta)
    A = se3.adjoint(se3.inverse(delta))
    end = -se3.inverse(delta)[:3, 3]  # the way, in the body's axes at the end
    B = np.zeros((6, 3))
    B[2, 0] = B[3, 1] = B[4, 2] = 1.0
    B[:3, 1:] = -0.5 * se3.cross(end)[:, :2]
    turn = (_TILT_RATE_RAD_S * dt) ** 2
    if step.is_standing:
        still = config.standstill_m2_per_s * dt
        terrain, slip = np.diag([still, turn, turn]), step.cov + np.diag([still, still, still])
    else:
        terrain, slip = np.diag([config.terrain_m_per_sqrt_s**2 * dt, turn, turn]), step.cov
    noise = {
        "pose": _LIFT @ slip @ _LIFT.T + B @ terrain @ B.T,
        "gyro_bias": gyro.bias_walk_rad_per_s_sqrt_s**2 * dt * np.eye(3),
    }
    return Transition({"pose": state["pose"] @ delta}, {("pose", "pose"): A, ("map", "map"): A}, noise, "the motion of the wheels")


def measure_body_turn(state: State, turn: BodyTurn) -> Measurement:
    """A gyro's turn between the poses "start" and "pose": z = (1 + gyro_scale) log(R_start^T R_pose) + gyro_bias dt + n [rad]."""
    turned = se3.rotation_vector(state["start"][:3, :3].T @ state["pose"][:3, :3])
    scale, half = 1.0 + float(state["gyro_scale"][0]), 0.5 * se3.cross(turned)
    nothing = np.zeros((3, 3))
    jacobians: dict[str, FloatArray] = {
        "pose": np.hstack([nothing, scale * (np.eye(3) + half)]),  # inverse right Jacobian of SO(3), to first order
        "start": np.hstack([nothing, -scale * (np.eye(3) - half)]),
        "gyro_bias": turn.duration * np.eye(3),
        "gyro_scale": turned[:, None],
    }
    residual = turn.angles - scale * turned - turn.duration * state["gyro_bias"]
    return Measurement(residual, jacobians, turn.variance * np.eye(3), what="a turn by the gyro")


def measure_gravity(state: State, gravity: Gravity) -> Measurement:
    """Gravity in body axes: z = g R^T e_z + accelerometer + n [m/s^2]."""
    up = state["pose"][2, :3]
    jacobians = {"pose": np.hstack([np.zeros((3, 3)), GRAVITY * se3.cross(up)]), "accelerometer": np.eye(3)}
    residual = gravity.force - GRAVITY * up - state["accelerometer"]
    return Measurement(residual, jacobians, gravity.variance * np.eye(3), what="gravity")
