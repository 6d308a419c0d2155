"""Hills: their height, a drive over them with what the robot measures, and a robot that rolls over them without slip."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from localization.events import Event, ImuSample, WheelSample
from motion_models import se3
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

_WAVES = ((9.0, 0.3, 0.9), (13.0, 1.4, 2.1), (17.0, 2.6, 4.0), (11.0, 3.9, 5.2), (15.0, 5.1, 0.4))
"""Wavelength [m], direction and phase [rad] of the hills' waves, of equal steepness."""
_WAVE_SLOPE = math.tan(math.radians(4.2))
"""Of each at most; the median of all is 5.8 degrees."""
_GYRO_SIGMA, _FORCE_SIGMA, _BIAS = 0.01, 0.1, np.array([0.002, -0.003, 0.0002])
_START_NS = 1_000_000_000


@dataclass(frozen=True)
class HillDrive:
    """What robot and truth say."""

    robot: Robot
    mounts: dict[str, Mount]
    events: list[Event]
    stamps_ns: np.ndarray
    positions: FloatArray
    """(N, 3) true, of the body's origin on the ground [m]."""
    rotations: FloatArray
    """(N, 3, 3) true ``world_R_body``."""


def with_accelerometer_bias(drive: HillDrive, seed: int, sigma: float = 0.2) -> HillDrive:
    """``drive`` whose accelerometer has a constant bias by chance, as of a mount that is off, with ``sigma`` on each axis [m/s^2]."""
    bias = np.random.default_rng(1000 + seed).normal(0.0, sigma, 3)
    events = [replace(e, linear_acceleration=e.linear_acceleration + bias) if isinstance(e, ImuSample) else e for e in drive.events]
    return replace(drive, events=events)


def with_gyro_bias(drive: HillDrive, seed: int, sigmas: tuple[float, float, float] = (0.01, 0.01, 0.001)) -> HillDrive:
    """``drive`` whose gyro has a further constant bias by chance, with ``sigmas`` about its axes [rad/s]: the filter's priors."""
    bias = np.random.default_rng(2000 + seed).normal(0.0, sigmas)
    events = [replace(e, angular_velocity=e.angular_velocity + bias) if isinstance(e, ImuSample) else e for e in drive.events]
    return replace(drive, events=events)


def terrain(x: FloatArray, y: FloatArray) -> FloatArray:
    """Height of the hills [m]."""
    total = np.zeros(np.broadcast(x, y).shape)
    for wavelength, direction, phase in _WAVES:
        k = 2.0 * math.pi / wavelength
        total = total + _WAVE_SLOPE / k * np.sin(k * (math.cos(direction) * x + math.sin(direction) * y) + phase)
    return np.asarray(total)


def gradient(x: float, y: float) -> tuple[float, float]:
    """Slope of the hills along x and y [-]."""
    dx = dy = 0.0
    for wavelength, direction, phase in _WAVES:
        c, s = math.cos(direction), math.sin(direction)
        steep = _WAVE_SLOPE * math.cos(2.0 * math.pi / wavelength * (c * x + s * y) + phase)
        dx, dy = dx + c * steep, dy + s * steep
    return dx, dy


@dataclass(frozen=True)
class Ground:
    """A ground by its height."""

    height: Callable[[FloatArray, FloatArray], FloatArray]
    """At x and y [m]."""
    gradient: Callable[[float, float], tuple[float, float]]
    """Slope along x and y [-]."""


HILLS = Ground(terrain, gradient)
_RAMP_SLOPE = math.tan(math.radians(15.0))
_RAMP_EDGES = ((5.0, 1.0), (9.0, -2.0), (13.0, 1.0))
"""x where the ramp begins, has its crest and ends [m], and how its slope changes there, over `_RAMP_SLOPE`."""
_EDGE_M = 0.15
"""Scale over which an edge is rounded: nine tenths of its change lie within 3 of it."""


def _ramp_height(x: FloatArray, y: FloatArray) -> FloatArray:
    total = np.zeros(np.broadcast(x, y).shape)
    for at, change in _RAMP_EDGES:
        total = total + _RAMP_SLOPE * change * _EDGE_M * np.logaddexp(0.0, (x - at) / _EDGE_M)
    return np.asarray(total)


def _ramp_gradient(x: float, y: float) -> tuple[float, float]:
    return sum(0.5 * _RAMP_SLOPE * change * (1.0 + math.tanh(0.5 * (x - at) / _EDGE_M)) for at, change in _RAMP_EDGES), 0.0


RAMP = Ground(_ramp_height, _ramp_gradient)
"""Up by 15 degrees, over a crest, and down by 15 degrees, along x."""


def rolling_drive(seconds: float, speed: float = 0.7, turn_rate: float = 0.3, seed: int = 1, is_flat: bool = False) -> HillDrive:
    """A Husky that stands for 2 s, then drives along an arc and back, tangent to the ground, without slip; IMU at 100 Hz, wheels at 50.

    ``is_flat``: on the plane z = 0 instead of hills."""
    robot, rng, h = load_robot("husky_a200"), np.random.default_rng(seed), 0.01
    mount = Mount(0.1, 0.0, 0.2)
    poses = _roll(round(seconds / h) + 2, h, speed, turn_rate, is_flat)
    places = poses[:, :3, 3] + poses[:, :3, :3] @ [mount.x, mount.y, mount.z]
    events: list[Event] = []
    angles, half_track, radius = np.zeros(2), 0.5 * robot.geometry.track_width_m, robot.geometry.wheel_radius_m
    stamps = _START_NS + np.round(np.arange(len(poses)) * h * 1e9).astype(np.int64)
    for i in range(1, len(poses) - 1):
        tangent = se3.log(se3.inverse(poses[i - 1]) @ poses[i]) / h
        middle = poses[i, :3, :3]
        turn = se3.log(se3.inverse(poses[i - 1]) @ poses[i + 1])[3:] / (2.0 * h)
        own = (places[i + 1] - 2.0 * places[i] + places[i - 1]) / h**2
        force = middle.T @ (own + np.array([0.0, 0.0, 9.81]))
        noise = rng.normal(size=6) * np.repeat([_GYRO_SIGMA, _FORCE_SIGMA], 3)
        events.append(ImuSample(int(stamps[i]), turn + _BIAS + noise[:3], force + noise[3:], "imu_link"))
        rates = (tangent[0] + half_track * tangent[5] * np.array([-1.0, 1.0])) / radius
        angles = angles + h * rates
        if i % 2 == 0:
            events.append(WheelSample(int(stamps[i]), rates, angles))
    return HillDrive(robot, {"base_link": Mount(), "imu_link": mount}, events, stamps, poses[:, :3, 3], poses[:, :3, :3])


def _roll(n: int, h: float, speed: float, turn_rate: float, is_flat: bool) -> FloatArray:
    """(n, 4, 4) poses, ``h`` [s] apart."""
    x = y = yaw = 0.0
    poses = np.tile(np.eye(4), (n, 1, 1))
    for pose, t in zip(poses, np.arange(n) * h, strict=True):
        dx, dy = (0.0, 0.0) if is_flat else gradient(x, y)
        up = np.array([-dx, -dy, 1.0]) / math.sqrt(1.0 + dx * dx + dy * dy)
        ahead = np.array([math.cos(yaw), math.sin(yaw), dx * math.cos(yaw) + dy * math.sin(yaw)])
        ahead /= np.linalg.norm(ahead)
        pose[:3, :3] = np.column_stack([ahead, np.cross(up, ahead), up])
        pose[:3, 3] = x, y, 0.0 if is_flat else float(terrain(np.array([x]), np.array([y]))[0])
        ramp = min(max(t - 2.0, 0.0), 1.0)
        x, y, yaw = x + h * ramp * speed * ahead[0], y + h * ramp * speed * ahead[1], yaw + h * ramp * turn_rate
    return poses
