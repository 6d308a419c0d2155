"""Attitude: the vertical in body axes by a 3-axis gyro and an accelerometer, and whether the ground tilts.

Gravity is a measurement of the vertical once the robot's own acceleration is taken off, which wheels and turning give; what they do not
explain (bumps, slip, vibration) is the measurement's noise, estimated on the way. The state is the vertical with the gyro's biases; its
error is a small rotation (Sola 2017, "Quaternion kinematics for the error-state Kalman filter"). What of it is the mount's error, and what
the ground's tilt, is separated by `localization.inputs.ground_tilt`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.events import Gravity, ImuSample, Turn
from localization.inputs.accelerometer import Accelerometer, PlacedImu
from localization.inputs.ground_curvature import GroundCurvature
from localization.inputs.ground_tilt import GroundTilt
from localization.messages import Message
from localization.small_filters import propagate_in_place, update_in_place
from localization.trajectory import IntArray
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import assign
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_NS = 1e-9
_MAX_GAP_S = 0.5
"""Without a sample for longer, the vertical starts anew."""
_START_SIGMA, _MOVING_SIGMA = math.radians(0.5), math.radians(4.0)
"""Sigma of the first vertical, at rest and on the way [rad]."""
_BIAS_SIGMA = 0.01
"""Sigma of the bias of a gyro that is not zeroed [rad/s]."""
_ACCELEROMETER_RAD = math.radians(0.3)
"""Error of the vertical by an accelerometer's bias of 0.05 m/s^2 [rad]."""
_SLOPE_EFFECT = 0.1
"""Relative uncertainty of a slope's effect by the height of the CG and the law, whose slides are within 3 to 13 % of MuJoCo's; mu and the
tyres' stiffness are estimated (`localization.inputs.tyre_friction`)."""
_MIN_UP = 0.2
"""Least z of the vertical: beyond 78 deg nothing drives."""
_WINDOW_S, _FIRST_WINDOW_S = 1.0, 0.5
"""Over which forces are summed [s]: wheels that are read at 10 Hz give accelerations from step to step to 3 m/s^2 only."""
_FORGETTING = 0.8
"""Factor of the older noise, from window to window."""
_EXPLAINED, _UNEXPLAINED = 0.05, 0.5
"""Least noise of gravity, with the robot's own acceleration taken off and without [m/s^2]."""
_AXES_ERROR = 3e-3
"""Relative error of a gyro's scale and axes [-]."""
_BIAS_WALK = 1e-4
"""[rad/s/sqrt(s)]"""
_BUFFER = 64
"""Samples for which there is room at first."""


@dataclass(frozen=True)
class Tilt:
    """How the ground tilts."""

    before: FloatArray
    """(2,) `motion_models.slope.Slope.downhill` at the start of a step."""
    after: FloatArray
    """(2,) at its end."""
    cov: FloatArray
    """(2, 2) of both, by the attitude, the mount, friction and the CG's height."""
    twist: tuple[float, float] = (0.0, 0.0)
    """Twist of the ground, the second derivative of its height by x and y in the body's axes, and its sigma [1/m]."""
    turn: Turn | None = None
    """Turn in the step about the body's z axis, by the gyro; None without one."""

    def at(self, shares: FloatArray) -> FloatArray:
        """(n, 2) at ``shares`` (n,) of the step, 0 to 1."""
        return np.asarray(self.before + shares[:, None] * (self.after - self.before))


class _Robot(NamedTuple):
    """Constants of the robot, as compiled loops take them."""

    radius: float
    """Radius of the wheels [m]."""
    white: float
    """White noise of the gyro's angle [rad/sqrt(s)]."""


class _Sums(NamedTuple):
    """What is propagated from step to step, in place."""

    state: FloatArray
    """(7,) vertical, biases, variance of the noise."""
    cov: FloatArray
    """(6, 6)"""
    window: FloatArray
    """(7,) sum of the forces, velocity at its begin, both turned into the body as it is now; length [s]."""
    velocity: FloatArray
    """(3,) of the IMU at the end, where wheels do not slip [m/s]."""
    wheels: FloatArray
    """(4,) way [m] and turn [rad] in the window, turn by the wheels as difference of the sides' angles, and its agreement with the gyro."""


class _ImuMeans:
    """`insert` samples of the IMU, then `take` their mean."""

    def __init__(self) -> None:
        self._stamps, self._samples, self._n = np.empty(_BUFFER, np.int64), np.empty((_BUFFER, 6)), 0
        self._last_ns = 0

    def insert(self, sample: ImuSample) -> None:
        """Store ``sample`` until it is taken."""
        n = self._n
        if n == len(self._stamps):
            self._stamps, self._samples = np.concatenate([self._stamps] * 2), np.concatenate([self._samples] * 2)
        self._stamps[n], self._samples[n, :3], self._samples[n, 3:] = sample.stamp_ns, sample.angular_velocity, sample.linear_acceleration
        self._n = n + 1

    def take(self, end_ns: int, *, is_used: bool) -> tuple[FloatArray, float] | None:
        """Mean (6,) of the samples until ``end_ns``, rates [rad/s] and forces, and the time since the last mean that was used [s].

        These samples are removed. None where there are none, or it is not used.
        """
        n, last_ns, mean = self._n, self._last_ns, np.zeros(6)
        self._n, end_ns = _take(self._stamps, self._samples, n, end_ns, mean)
        if self._n == n or not is_used:
            return None
        self._last_ns = end_ns
        return mean, (end_ns - last_ns) * _NS


class AttitudeFilter:
    """`insert` each sample of the IMU, `advance` to the end of each step."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], wheel_radius_m: float) -> None:
        self._accelerometer, self._samples = Accelerometer(mounts), _ImuMeans()
        self._robot = _Robot(wheel_radius_m, noise.white_rad_per_sqrt_s)
        self._sums = _Sums(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((6, 6)), np.zeros(7), np.zeros(3), np.zeros(4))
        self._is_explained = False
        self._downhill: FloatArray | None = None
        """(2,) by the vertical at the end of the last step, mount and ground together; None while the vertical is unknown."""
        self._ground, self._curvature = GroundTilt(), GroundCurvature()
        self.gravity: Gravity | None = None
        """By the window that ended in the last `advance`; None where none did."""

    @property
    def has_attitude(self) -> bool:
        """Whether the vertical is known."""
        return self._downhill is not None

    @property
    def is_tilting(self) -> bool:
        """Whether the ground has been found to tilt."""
        return self._ground.is_certain

    @property
    def is_tilt_ambiguous(self) -> bool:
        """Whether the ground may tilt, or an IMU that sits askew measures the same."""
        return self._ground.is_ambiguous

    @property
    def up(self) -> FloatArray:
        """(3,) the vertical in body axes; the body's z axis where it is not known."""
        return self._sums.state[:3].copy() if self.has_attitude else np.array([0.0, 0.0, 1.0])

    @property
    def ground_up(self) -> FloatArray:
        """(3,) the vertical in the axes of the robot as it stands on the ground: without the mount's error."""
        x, y, z = self.up.tolist()
        error = self._ground.mount_error
        down_x, down_y = -x / max(z, _MIN_UP) - error[0], -y / max(z, _MIN_UP) - error[1]
        whole = 1.0 / math.sqrt(1.0 + down_x * down_x + down_y * down_y)
        return np.array([-down_x * whole, -down_y * whole, whole])

    @property
    def curvature(self) -> float:
        """Root mean square of the ground's curvature along the way [1/m]."""
        return self._curvature.root_mean_square

    @property
    def tilt_variances(self) -> tuple[float, float]:
        """Variances of roll and pitch [rad^2]: by the attitude, and by the mount, which stays."""
        own, mount = self._sums.cov, self._ground.mount_cov
        return 0.5 * float(own[0, 0] + own[1, 1]) + _ACCELEROMETER_RAD**2, 0.5 * float(mount[0, 0] + mount[1, 1])

    @property
    def cov(self) -> FloatArray:
        """(6, 6) of the small rotation of the vertical about the body's axes [rad], then of the gyro's biases [rad/s]."""
        return self._sums.cov.copy()

    @property
    def gyro_bias(self) -> FloatArray:
        """(3,) in body axes [rad/s]; what is about the vertical is not observable by gravity."""
        return self._sums.state[3:6].copy()

    @property
    def mount_error(self) -> FloatArray:
        """(2,) the tilt that stays with the body: by the mount, not the ground."""
        return self._ground.mount_error.copy()

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample of the first IMU whose mount is known."""
        if self._accelerometer.accept(sample):
            self._samples.insert(sample)

    def advance(self, end_ns: int, dt_s: FloatArray, rates: FloatArray) -> Tilt | None:
        """Advance to ``end_ns``; wheels rolled at ``rates`` (n, 2) [rad/s] for ``dt_s`` (n,) [s] each, n = 0 where that is not known.

        The tilt since the last call, where the ground tilts; else None.
        """
        self.gravity = None
        imu = self._accelerometer.imu
        taken = self._samples.take(end_ns, is_used=imu.scale != 0.0) if self._accelerometer.is_usable else None
        if taken is None:
            return None
        (mean, dt), has_wheels, turned = taken, len(rates) > 0, float(self._sums.wheels[1])
        _advance(imu, self._robot, self._sums, mean, dt, np.ascontiguousarray(dt_s), np.ascontiguousarray(rates))
        if not 0.0 < dt < _MAX_GAP_S:
            self._downhill = None
            self._restart(has_wheels)
            return None
        self._is_explained &= has_wheels
        white = self._robot.white**2 * dt
        turn = Turn(float(self._sums.wheels[1]) - turned - float(self._sums.state[5]) * dt, white, dt)
        if self._downhill is not None and has_wheels:
            way = 0.5 * self._robot.radius * float(dt_s @ rates.sum(axis=1))
            error = self._ground.mount_error  # turns with the body, as no ground does
            unknown = self.tilt_variances[1] * turn.angle**2
            self._curvature.advance(self._downhill - error, self._slope() - error, (way, turn.angle), white + unknown)
        if self._sums.window[6] >= (_FIRST_WINDOW_S if self._downhill is None else _WINDOW_S):
            self._measure(has_wheels)
        return None if self._downhill is None else self._tilt(self._downhill, turn)

    def _restart(self, has_wheels: bool) -> None:
        """Begin a window, over which forces are summed, at the IMU's velocity where ``has_wheels``."""
        self._sums.window[:], self._is_explained = 0.0, has_wheels
        if has_wheels:
            self._sums.window[3:6] = self._sums.velocity
        self._sums.wheels[:2] = 0.0

    def _measure(self, has_wheels: bool) -> None:
        """Update by gravity: the window's mean force, less what changed the velocity."""
        state, cov, window, velocity, (way, turn, _, _) = self._sums
        is_explained = self._is_explained and has_wheels
        gravity = (window[:3] - (velocity - window[3:6]) if is_explained else window[:3]) / window[6]
        if self._downhill is None:
            self._start(gravity)
        else:
            least = _EXPLAINED if is_explained else _UNEXPLAINED
            _update_vertical(state, cov, gravity, least)
            self.gravity = Gravity(gravity, max(float(state[6]), least**2))
            own = self.gravity.variance / GRAVITY**2 + _ACCELEROMETER_RAD**2  # what is new in it: the vertical holds the windows before
            self._ground.update(self._slope(), own * np.eye(2), float(turn), float(way))
        self._restart(has_wheels)

    def _start(self, gravity: FloatArray) -> None:
        """The first vertical."""
        up = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
        way, _, turned, agreement = self._sums.wheels.tolist()
        if not self._accelerometer.is_above(float(up[2]), turned, agreement):
            return
        is_still = self._is_explained and not way and not turned
        sigma = _START_SIGMA if is_still else _MOVING_SIGMA
        self._sums.state[:] = [*up, *self._sums.state[3:6], 0.01 if is_still else 0.1]
        self._sums.cov[:] = np.diag([sigma**2] * 3 + [_BIAS_SIGMA**2] * 3)
        self._ground.restart()
        self._downhill, self._curvature = -up[:2] / up[2], GroundCurvature()
        self.gravity = Gravity(gravity, (GRAVITY * sigma) ** 2)

    def _tilt(self, before: FloatArray, turn: Turn) -> Tilt | None:
        """The tilt since the downhill slope ``before`` (2,), by the mount's error and the vertical as they are now."""
        self._downhill = after = self._slope()
        if not self._ground.is_certain:
            return None
        error = self._ground.mount_error
        now = after - error
        cov = self._slope_cov() + self._ground.mount_cov + _SLOPE_EFFECT**2 * np.outer(now, now)
        return Tilt(before - error, now, cov, self._curvature.twist, turn)

    def _slope(self) -> FloatArray:
        """(2,) `motion_models.slope.Slope.downhill` by the vertical as it is, mount and ground together."""
        state = self._sums.state
        return np.asarray(-state[:2] / max(state[2], _MIN_UP))

    def _slope_cov(self) -> FloatArray:
        """(2, 2) of `_slope`, by the attitude."""
        P = self._sums.cov
        return np.array([[P[1, 1], -P[0, 1]], [-P[0, 1], P[0, 0]]]) + _ACCELEROMETER_RAD**2 * np.eye(2)

    def warnings(self) -> list[Message]:
        """Problems of the accelerometer, and their remedy."""
        return self._accelerometer.warnings()


@kernel
def _take(stamps: IntArray, samples: FloatArray, n: int, end_ns: int, mean: FloatArray) -> tuple[int, int]:
    """Fill ``mean`` (6,) by those of the first ``n`` samples, of the times ``stamps``, that are not after ``end_ns``; they are removed.

    How many are left, and the stamp of the last one that was taken.
    """
    used = 0
    while used < n and stamps[used] <= end_ns:
        used += 1
    if not used:
        return n, 0
    last_ns = stamps[used - 1]
    for i in range(used):
        for j in range(6):
            mean[j] += samples[i, j] / used
    for i in range(used, n):
        stamps[i - used] = stamps[i]
        assign(samples[i - used], samples[i])
    return n - used, last_ns


@kernel
def _advance(imu: PlacedImu, robot: _Robot, sums: _Sums, mean: FloatArray, dt: float, dt_s: FloatArray, rates: FloatArray) -> None:
    """Rotate by ``mean`` (6,) of the IMU's samples, which acts for ``dt``, and add the motion of the wheels, of `AttitudeFilter.advance`.

    Where the time is none, or too long for a gap, nothing but the velocity is propagated.
    """
    rate, force = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            rate[i] += imu.rotation[i, j] * mean[j]
            force[i] += imu.scale * imu.rotation[i, j] * mean[3 + j]
    _sum_wheels(imu.place, robot.radius, sums, rate, dt, dt_s, rates)
    if 0.0 < dt < _MAX_GAP_S:
        _rotate(sums.state, sums.cov, sums.window, rate, force, dt, robot.white)


@subroutine
def _sum_wheels(place: FloatArray, radius: float, sums: _Sums, rate: FloatArray, dt: float, dt_s: FloatArray, rates: FloatArray) -> None:
    """The IMU's velocity at the end, and the wheels' way and turns."""
    m = len(dt_s)
    if m:
        sums.velocity[0] = rate[1] * place[2] - rate[2] * place[1] + 0.5 * radius * (rates[m - 1, 0] + rates[m - 1, 1])
        sums.velocity[1] = rate[2] * place[0] - rate[0] * place[2]
        sums.velocity[2] = rate[0] * place[1] - rate[1] * place[0]
    if not 0.0 < dt < _MAX_GAP_S:
        return
    way, turn = 0.0, 0.0
    for i in range(m):
        way += dt_s[i] * (rates[i, 0] + rates[i, 1])
        turn += dt_s[i] * (rates[i, 1] - rates[i, 0])
    sums.wheels[0] += abs(0.5 * radius * way)
    sums.wheels[1] += rate[2] * dt
    sums.wheels[2] += abs(turn)
    sums.wheels[3] += turn * rate[2]


@subroutine
def _rotate(state: FloatArray, cov: FloatArray, window: FloatArray, rate: FloatArray, force: FloatArray, dt: float, white: float) -> None:
    """Rotate the vertical, and what the window has summed, into the body as it turns at ``rate`` (3,) for ``dt``; add ``force`` (3,)."""
    turn, half = np.empty((3, 3)), np.empty((3, 3))
    x, y, z = -dt * (rate[0] - state[3]), -dt * (rate[1] - state[4]), -dt * (rate[2] - state[5])
    _fill_rotation(x, y, z, turn)
    _fill_rotation(0.5 * x, 0.5 * y, 0.5 * z, half)
    for vector in (state[0:3], window[0:3], window[3:6]):
        a, b, c = vector[0], vector[1], vector[2]
        for i in range(3):
            vector[i] = turn[i, 0] * a + turn[i, 1] * b + turn[i, 2] * c
    for i in range(3):
        window[i] += dt * (half[i, 0] * force[0] + half[i, 1] * force[1] + half[i, 2] * force[2])
    window[6] += dt
    move = np.eye(6)
    for i in range(3):
        for j in range(3):
            move[i, j] = turn[i, j]
        move[i, 3 + i] = dt
    propagate_in_place(move, cov)
    wide = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2) * _AXES_ERROR
    for i in range(3):
        cov[i, i] += (white * white + wide * wide) * dt
        cov[3 + i, 3 + i] += _BIAS_WALK * _BIAS_WALK * dt


@kernel
def _update_vertical(state: FloatArray, cov: FloatArray, gravity: FloatArray, least: float) -> None:
    """Update by measured ``gravity`` (3,), whose noise is what it left unexplained so far, ``least`` [m/s^2] at least."""
    error = np.array([gravity[i] - GRAVITY * state[i] for i in range(3)])
    square = (error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / 3.0
    state[6] = _FORGETTING * state[6] + (1.0 - _FORGETTING) * square
    variance = max(state[6], square, least * least)
    x, y, z = GRAVITY * state[0], GRAVITY * state[1], GRAVITY * state[2]
    rows = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    found, gain = np.zeros(6), np.empty(6)
    for i in range(3):
        update_in_place(found, cov, rows[i], error[i], variance, gain)
    a, b, c = state[0], state[1], state[2]
    state[0] += found[1] * c - found[2] * b
    state[1] += found[2] * a - found[0] * c
    state[2] += found[0] * b - found[1] * a
    whole = 1.0 / math.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    for i in range(3):
        state[i] *= whole
        state[3 + i] += found[3 + i]


@subroutine
def _fill_rotation(x: float, y: float, z: float, out: FloatArray) -> None:
    """The rotation by the vector ``x, y, z`` [rad] (Rodrigues)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    a = math.sin(angle) / angle if angle > 1e-6 else 1.0
    b = (1.0 - math.cos(angle)) / square if angle > 1e-6 else 0.5
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
