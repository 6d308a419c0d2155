"""The EKF of robot_localization, whose package is not on the index, by its equations (`src/ekf.cpp`, branch `ros2`) and default settings.

Two dimensions (`two_d_mode`): x, y, yaw, vx, vy, vyaw, ax, ay, whose noise is the package's default, as are the covariance at the start and
no gate. It fuses vx, vy and vyaw of the wheels' odometry, with the variances of ros2_control_demos' diffbot (`twist_covariance_diagonal`):
the mean twist between two scans at the middle of that time, for the logs have the wheels at their scans alone.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
from exchange import Drive, FloatArray, arguments, matrix, planar, write

_X, _Y, _YAW, _VX, _VY, _VYAW, _AX, _AY = range(8)
_PROCESS_NOISE = np.diag([0.05, 0.05, 0.06, 0.025, 0.025, 0.02, 0.01, 0.01])
"""`process_noise_covariance` of params/ekf.yaml, per second."""
_START = 1e-9 * np.eye(8)
"""`initial_estimate_covariance` by default."""
_H = np.eye(8)[[_VX, _VY, _VYAW]]
_R = np.diag([0.001, 0.001, 0.01])


class _State(NamedTuple):
    x: FloatArray
    """(8,)"""
    P: FloatArray
    """(8, 8)"""


def predict(state: _State, dt: float) -> _State:
    """Constant acceleration in the body's frame over ``dt`` [s] (`Ekf::predict`)."""
    x, P = state
    c, s = np.cos(x[_YAW]), np.sin(x[_YAW])
    F = np.eye(8)
    F[_X, [_VX, _VY, _AX, _AY]] = c * dt, -s * dt, 0.5 * c * dt**2, -0.5 * s * dt**2
    F[_Y, [_VX, _VY, _AX, _AY]] = s * dt, c * dt, 0.5 * s * dt**2, 0.5 * c * dt**2
    F[_YAW, _VYAW] = F[_VX, _AX] = F[_VY, _AY] = dt
    moved = F @ x
    forward, across = x[_VX] * dt + 0.5 * x[_AX] * dt**2, x[_VY] * dt + 0.5 * x[_AY] * dt**2
    F[_X, _YAW], F[_Y, _YAW] = -s * forward - c * across, c * forward - s * across
    return _State(moved, F @ P @ F.T + dt * _PROCESS_NOISE)


def correct(state: _State, twist: FloatArray) -> _State:
    """Fuse ``twist`` (3,) of the wheels (`Ekf::correct`, in the form of Joseph)."""
    x, P = state
    K = P @ _H.T @ np.linalg.inv(_H @ P @ _H.T + _R)
    A = np.eye(8) - K @ _H
    return _State(x + K @ (twist - _H @ x), A @ P @ A.T + K @ _R @ K.T)


def estimate(drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Poses of the body (N, 3) in the frame of the first, and covariances (N, 3, 3) of their right perturbations."""
    body_T_lidar = matrix(drive.body_T_lidar)
    motions = planar(body_T_lidar @ drive.predictions() @ np.linalg.inv(body_T_lidar))
    seconds = np.diff(drive.stamps_ns, prepend=drive.stamps_ns[0]) * 1e-9
    state, poses, covariances = _State(np.zeros(8), _START), [], []
    for motion, dt in zip(motions, seconds, strict=True):
        if dt > 0.0:
            half = 0.5 * motion[2]  # the twist of an arc: its chord is seen along the mean heading
            c, s = np.cos(half), np.sin(half)
            chord = np.array([c * motion[0] + s * motion[1], c * motion[1] - s * motion[0]])
            twist = np.array([*chord / np.sinc(half / np.pi), motion[2]]) / dt
            state = predict(correct(predict(state, 0.5 * dt), twist), 0.5 * dt)
        poses.append(state.x[:3])
        c, s = np.cos(state.x[_YAW]), np.sin(state.x[_YAW])
        body_R_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        covariances.append(body_R_world @ state.P[:3, :3] @ body_R_world.T)
    return np.array(poses), np.array(covariances)


if __name__ == "__main__":
    drive, out = arguments()
    begin = sum(os.times()[:4])
    poses, covariances = estimate(drive)
    write(out, drive.stamps_ns, poses, sum(os.times()[:4]) - begin, covariances)
