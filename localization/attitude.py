"""Attitude: the vertical in body axes by a 3-axis gyro and an accelerometer, and whether the ground tilts.

Gravity is a measurement of the vertical once the robot's own acceleration is taken off, which wheels and turning give; what they do not
explain (bumps, slip, vibration) is the measurement's noise, estimated on the way. The state is the vertical with the gyro's biases; its
error is a small rotation (Sola 2017, "Quaternion kinematics for the error-state Kalman filter").

A mount that is off by a degree or two looks like a slope, too, but stays with the body while a slope turns against it and changes with
the way. A second, slow filter separates both: only what is not the mount is the ground's tilt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.events import Gravity, ImuSample
from localization.ground_curvature import GroundCurvature
from localization.gyro import GRAVITY_SAMPLES, MAX_MOUNT_ERROR_RAD, is_gravity
from localization.trajectory import IntArray
from motion_models.compiled import kernel, subroutine
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_NS = 1e-9
_MAX_GAP_S = 0.5
"""Without a sample for longer, the vertical starts anew."""
_IN_G, _NO_GRAVITY = (0.8, 1.2), 3.0
"""Size of the mean specific force in g (some drivers), and below what gravity was removed [m/s^2]."""
_MIN_TURN_RAD = 3.0
"""Turn by the wheels, as difference of the sides' angles, after which it shows whether the gyro's axis points up."""
_LEVEL = math.tan(math.radians(3.0))
"""Tilt up to which the ground counts as level: a Husky outdoors is level within 1.8 deg, and mounts are known to a degree or two."""
_CERTAIN = 3.5
"""Sigmas at which the ground counts as tilted."""
_MOUNT_SIGMA, _GROUND_SIGMA = math.radians(1.2), math.radians(6.0)
"""Sigma of mounts in robot files, and of the slope of hills (median 5.8 deg, 95 % below 10.7)."""
_HILL_M = 5.0
"""Way over which a slope changes."""
_START_SIGMA, _MOVING_SIGMA = math.radians(0.5), math.radians(4.0)
"""Sigma of the first vertical, at rest and on the way [rad]."""
_BIAS_SIGMA = 0.01
"""Sigma of the bias of a gyro that is not zeroed [rad/s]."""
_ACCELEROMETER_RAD = math.radians(0.3)
"""Error of the vertical by an accelerometer's bias of 0.05 m/s^2 [rad]."""
_LASTING = 2.0
"""For how many windows errors of the vertical last."""
_SLOPE_EFFECT = 0.25
"""Relative uncertainty of a slope's effect, by mu and the height of the CG."""
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

    def at(self, shares: FloatArray) -> FloatArray:
        """(n, 2) at ``shares`` (n,) of the step, 0 to 1."""
        return np.asarray(self.before + shares[:, None] * (self.after - self.before))


class _Imu(NamedTuple):
    """The IMU and where it sits, as compiled loops take them."""

    rotation: FloatArray
    """(3, 3) from its axes into the body's."""
    place: FloatArray
    """(3,) in the body [m]."""
    scale: float
    """Scale of the accelerometer's forces; 0 until known."""
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


def scale_of_force(size: float, name: str) -> tuple[float, str]:
    """Factor to m/s^2 of an accelerometer whose first samples have a mean of ``size``, which is gravity at rest; and its problem, as a
    sentence about ``name``. The factor is 0 with a problem, and where all samples are zero (no accelerometer, no problem)."""
    if is_gravity(size):
        return 1.0, ""
    if _IN_G[0] < size < _IN_G[1]:
        return GRAVITY, ""
    if not size:
        return 0.0, ""
    if size < _NO_GRAVITY:
        return 0.0, f"{name} shows no gravity ({size:.2f} m/s^2 on average): its driver removes it."
    return 0.0, f"{name} shows {size:.1f} m/s^2 on average, neither gravity in m/s^2 nor in g."


class AttitudeFilter:
    """`insert` each sample of the IMU, `advance` to the end of each step."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], wheel_radius_m: float) -> None:
        self._mounts = mounts
        self._frame: str | None = None
        self._unmounted: str | None = None  # frame of an accelerometer whose mount is not known
        self._stamps, self._samples, self._n = np.empty(_BUFFER, np.int64), np.empty((_BUFFER, 6)), 0
        self._imu = _Imu(np.eye(3), np.zeros(3), 0.0, wheel_radius_m, noise.white_rad_per_sqrt_s)
        self._first: list[FloatArray] = []
        self._problem = ""  # why there is no attitude
        self._is_unusable = False
        self._last_ns, self._is_explained = 0, False
        self._sums = _Sums(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((6, 6)), np.zeros(7), np.zeros(3), np.zeros(4))
        self._split, self._split_cov = np.zeros(4), np.diag([_MOUNT_SIGMA**2] * 2 + [_GROUND_SIGMA**2] * 2)
        self._has_started, self._tilts = False, False
        self._downhill, self._curvature = np.zeros(2), GroundCurvature()
        self.gravity: Gravity | None = None
        """By the window that ended in the last `advance`; None where none did."""

    @property
    def has_attitude(self) -> bool:
        """Whether the vertical is known."""
        return self._has_started

    @property
    def is_tilting(self) -> bool:
        """Whether the ground has been found to tilt."""
        return self._tilts

    @property
    def up(self) -> FloatArray:
        """(3,) the vertical in body axes; the body's z axis where it is not known."""
        return self._sums.state[:3].copy() if self._has_started else np.array([0.0, 0.0, 1.0])

    @property
    def ground_up(self) -> FloatArray:
        """(3,) the vertical in the axes of the robot as it stands on the ground: without the mount's error."""
        x, y, z = self.up.tolist()
        down_x, down_y = -x / max(z, _MIN_UP) - self._split[0], -y / max(z, _MIN_UP) - self._split[1]
        whole = 1.0 / math.sqrt(1.0 + down_x * down_x + down_y * down_y)
        return np.array([-down_x * whole, -down_y * whole, whole])

    @property
    def tilt_variances(self) -> tuple[float, float]:
        """Variances of roll and pitch [rad^2]: by the attitude, and by the mount, which stays."""
        return 0.5 * float(self._sums.cov[0, 0] + self._sums.cov[1, 1]) + _ACCELEROMETER_RAD**2, 0.5 * float(
            self._split_cov[0, 0] + self._split_cov[1, 1]
        )

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
        return self._split[:2].copy()

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample of the first IMU whose mount is known."""
        if self._frame is None and sample.frame_id in self._mounts:
            self._frame = sample.frame_id
        if self._frame is None and sample.linear_acceleration.any():
            self._unmounted = sample.frame_id
        if sample.frame_id != self._frame or self._problem or self._is_unusable:
            return
        if not self._imu.scale:
            self._first.append(sample.linear_acceleration)
            if len(self._first) == GRAVITY_SAMPLES:
                self._check_force()
        n = self._n
        if n == len(self._stamps):
            self._stamps, self._samples = np.concatenate([self._stamps] * 2), np.concatenate([self._samples] * 2)
        self._stamps[n], self._samples[n, :3], self._samples[n, 3:] = sample.stamp_ns, sample.angular_velocity, sample.linear_acceleration
        self._n = n + 1

    def _check_force(self) -> None:
        """Units and sign of the accelerometer, by the mean of the first samples."""
        size = float(np.linalg.norm(np.mean(self._first, axis=0)))
        scale, self._problem = scale_of_force(size, f"the accelerometer of IMU '{self._frame}'")
        if self._problem:
            self._problem += " Slopes are not modelled."
        elif scale:
            self._set_scale(scale)
        else:
            self._is_unusable = True
        if self._problem or self._is_unusable:
            self._n = 0

    def _set_scale(self, scale: float) -> None:
        mount = self._mounts[self._frame or ""]
        rotation, place = np.ascontiguousarray(mount.rotation), np.array([mount.x, mount.y, mount.z])
        self._imu = self._imu._replace(rotation=rotation, place=place, scale=scale)

    def advance(self, end_ns: int, dt_s: FloatArray, rates: FloatArray) -> Tilt | None:
        """Advance to ``end_ns``; wheels rolled at ``rates`` (n, 2) [rad/s] for ``dt_s`` (n,) [s] each, n = 0 where that is not known.

        The tilt since the last call, where the ground tilts; else None.
        """
        self.gravity = None
        if not self._n or self._problem:
            return None
        wheels = np.ascontiguousarray(dt_s), np.ascontiguousarray(rates)
        before, left, turned = self._n, self._last_ns, float(self._sums.wheels[1])
        self._n, self._last_ns, dt = _advance(self._imu, self._sums, self._stamps, self._samples, self._n, left, end_ns, wheels)
        if self._n == before or not self._imu.scale:
            return None
        has_wheels = len(rates) > 0
        if not 0.0 < dt < _MAX_GAP_S:
            self._has_started = False
            self._restart(has_wheels)
            return None
        self._is_explained &= has_wheels
        if self._has_started and has_wheels:
            way = 0.5 * self._imu.radius * float(dt_s @ rates.sum(axis=1))
            turn = float(self._sums.wheels[1]) - turned - float(self._sums.state[5]) * dt
            self._curvature.advance(self._downhill, self._slope(), (way, turn), self._imu.white**2 * dt)
        if self._sums.window[6] >= (_WINDOW_S if self._has_started else _FIRST_WINDOW_S):
            self._measure(has_wheels)
        return self._tilt() if self._has_started else None

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
        if not self._has_started:
            self._start(gravity)
        else:
            _update_vertical(state, cov, gravity, _EXPLAINED if is_explained else _UNEXPLAINED)
            self.gravity = Gravity(gravity, max(float(state[6]), (_EXPLAINED if is_explained else _UNEXPLAINED) ** 2))
            _separate(self._split, self._split_cov, state, cov, float(turn), float(way))
            ground, cov = self._split[2:], self._split_cov[2:, 2:]
            if not self._tilts and np.hypot(ground[0], ground[1]) > _LEVEL:
                self._tilts = bool(ground @ np.linalg.solve(cov, ground) > _CERTAIN**2)
        self._restart(has_wheels)

    def _start(self, gravity: FloatArray) -> None:
        """The first vertical."""
        up = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
        if not self._is_above(float(up[2])):
            return
        is_still = self._is_explained and not self._sums.wheels[0] and not self._sums.wheels[2]
        sigma = _START_SIGMA if is_still else _MOVING_SIGMA
        self._sums.state[:] = [*up, *self._sums.state[3:6], 0.01 if is_still else 0.1]
        self._sums.cov[:] = np.diag([sigma**2] * 3 + [_BIAS_SIGMA**2] * 3)
        self._split_cov[2:] = self._split_cov[:, 2:] = 0.0
        self._split_cov[2, 2] = self._split_cov[3, 3] = _GROUND_SIGMA**2
        self._has_started, self._downhill, self._curvature = True, -up[:2] / up[2], GroundCurvature()
        self.gravity = Gravity(gravity, (GRAVITY * sigma) ** 2)

    def _is_above(self, up_z: float) -> bool:
        """Whether the vertical by the mount is above the robot; where it is below, the wheels' turns show why."""
        least = math.cos(MAX_MOUNT_ERROR_RAD)
        if up_z > least:
            return True
        named = f"gravity contradicts the mount of IMU '{self._frame}'"
        if up_z > -least:
            angle = math.degrees(math.acos(min(max(up_z, -1.0), 1.0)))
            self._problem = f"{named} by {angle:.0f} deg. Slopes are not modelled. Correct the mount's roll and pitch."
        elif self._sums.wheels[2] > _MIN_TURN_RAD:
            if self._sums.wheels[3] > 0.0:  # the gyro agrees with the mount: this driver publishes gravity, not specific force
                self._set_scale(-self._imu.scale)
            else:
                self._problem = f"{named}: it hangs upside down. Slopes are not modelled. Correct the mount's roll or pitch."
        return False

    def _tilt(self) -> Tilt | None:
        """The tilt by the mount's error and the vertical as they are now."""
        before, self._downhill = self._downhill, self._slope()
        if not self._tilts:
            return None
        error, P = self._split[:2], self._sums.cov
        now = self._downhill - error
        own = np.array([[P[1, 1], -P[0, 1]], [-P[0, 1], P[0, 0]]]) + _ACCELEROMETER_RAD**2 * np.eye(2)
        cov = own + self._split_cov[:2, :2] + _SLOPE_EFFECT**2 * np.outer(now, now)
        return Tilt(before - error, now, cov, self._curvature.twist)

    def _slope(self) -> FloatArray:
        """(2,) `motion_models.slope.Slope.downhill` by the vertical as it is, mount and ground together."""
        state = self._sums.state
        return np.asarray(-state[:2] / max(state[2], _MIN_UP))

    def warnings(self) -> list[str]:
        """Problems of the accelerometer, and their remedy."""
        if self._problem:
            return [self._problem]
        if self._frame is None and self._unmounted is not None:
            where = "/tf_static or in the robot file's [mounts]"
            return [f"the mount of IMU '{self._unmounted}' is unknown: slopes are not modelled. Give it in {where}."]
        if self._imu.scale == GRAVITY:
            return [f"the accelerometer of IMU '{self._frame}' is in g, not m/s^2: it was scaled by {GRAVITY}."]
        if self._imu.scale < 0.0:
            return [f"the accelerometer of IMU '{self._frame}' publishes gravity, not specific force: its sign was turned."]
        return []


@kernel
def _advance(
    imu: _Imu,
    sums: _Sums,
    stamps: IntArray,
    samples: FloatArray,
    n: int,
    last_ns: int,
    end_ns: int,
    wheels: tuple[FloatArray, FloatArray],
) -> tuple[int, int, float]:
    """Advance by the mean of those of the first ``n`` samples, of the times ``stamps``, that are not after ``end_ns``; they are removed.

    How many are left, the stamp of the last one that was used, and the time since ``last_ns`` [s]. ``wheels``: intervals (m,) and rates
    (m, 2). Where the time is none or too long for a gap, nothing but the velocity is propagated; while the scale is unknown, nothing.
    """
    used = 0
    while used < n and stamps[used] <= end_ns:
        used += 1
    if not used:
        return n, last_ns, 0.0
    dt = 0.0
    if imu.scale:
        dt = (stamps[used - 1] - last_ns) * _NS
        last_ns = stamps[used - 1]
        _add_mean(imu, sums, samples[:used], dt, wheels)
    for i in range(used, n):
        stamps[i - used] = stamps[i]
        samples[i - used] = samples[i]
    return n - used, last_ns, dt


@subroutine
def _add_mean(imu: _Imu, sums: _Sums, samples: FloatArray, dt: float, wheels: tuple[FloatArray, FloatArray]) -> None:
    """Rotate by the mean of ``samples`` (n, 6), which acts for ``dt``, and add the motion of the wheels."""
    rate, force, mean = np.zeros(3), np.zeros(3), np.zeros(6)
    for i in range(len(samples)):
        for j in range(6):
            mean[j] += samples[i, j] / len(samples)
    for i in range(3):
        for j in range(3):
            rate[i] += imu.rotation[i, j] * mean[j]
            force[i] += imu.scale * imu.rotation[i, j] * mean[3 + j]
    _sum_wheels(imu, sums, rate, dt, wheels[0], wheels[1])
    if 0.0 < dt < _MAX_GAP_S:
        _rotate(sums.state, sums.cov, sums.window, rate, force, dt, imu.white)


@subroutine
def _sum_wheels(imu: _Imu, sums: _Sums, rate: FloatArray, dt: float, dt_s: FloatArray, rates: FloatArray) -> None:
    """The IMU's velocity at the end, and the wheels' way and turns."""
    m, place = len(dt_s), imu.place
    if m:
        sums.velocity[0] = rate[1] * place[2] - rate[2] * place[1] + 0.5 * imu.radius * (rates[m - 1, 0] + rates[m - 1, 1])
        sums.velocity[1] = rate[2] * place[0] - rate[0] * place[2]
        sums.velocity[2] = rate[0] * place[1] - rate[1] * place[0]
    if not 0.0 < dt < _MAX_GAP_S:
        return
    way, turn = 0.0, 0.0
    for i in range(m):
        way += dt_s[i] * (rates[i, 0] + rates[i, 1])
        turn += dt_s[i] * (rates[i, 1] - rates[i, 0])
    sums.wheels[0] += abs(0.5 * imu.radius * way)
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
    _propagate(move, cov)
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
        _update(found, cov, rows[i], error[i], variance, gain)
    a, b, c = state[0], state[1], state[2]
    state[0] += found[1] * c - found[2] * b
    state[1] += found[2] * a - found[0] * c
    state[2] += found[0] * b - found[1] * a
    whole = 1.0 / math.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    for i in range(3):
        state[i] *= whole
        state[3 + i] += found[3 + i]


@kernel
def _separate(split: FloatArray, cov: FloatArray, state: FloatArray, own: FloatArray, turn: float, way: float) -> None:
    """Separate the mount's error from the ground's tilt: ``split`` (4,) and ``cov`` (4, 4) change in place after ``turn`` and ``way``."""
    c, s = math.cos(turn), math.sin(turn)
    fade = math.exp(-way / _HILL_M)
    move = np.eye(4)
    move[2, 2], move[2, 3], move[3, 2], move[3, 3] = fade * c, fade * s, -fade * s, fade * c
    before = split.copy()
    split[2] = move[2, 2] * before[2] + move[2, 3] * before[3]
    split[3] = move[3, 2] * before[2] + move[3, 3] * before[3]
    _propagate(move, cov)
    new = _GROUND_SIGMA * _GROUND_SIGMA * (1.0 - fade * fade)
    cov[2, 2] += new
    cov[3, 3] += new
    found, gain = np.zeros(4), np.empty(4)
    for axis in range(2):
        row = np.array([1.0 - axis, axis, 1.0 - axis, axis])
        variance = _LASTING * (own[1 - axis, 1 - axis] + _ACCELEROMETER_RAD * _ACCELEROMETER_RAD)
        _update(found, cov, row, -state[axis] / max(state[2], _MIN_UP) - split[axis] - split[2 + axis], variance, gain)
    for i in range(4):
        split[i] += found[i]


@subroutine
def _propagate(move: FloatArray, cov: FloatArray) -> None:
    """``cov`` = ``move`` ``cov`` ``move``^T, in place."""
    half, n = np.zeros_like(cov), len(cov)
    for i in range(n):
        for j in range(n):
            for k in range(n):
                half[i, j] += move[i, k] * cov[k, j]
    cov[:] = 0.0
    for i in range(n):
        for j in range(n):
            for k in range(n):
                cov[i, j] += half[i, k] * move[j, k]


@subroutine
def _update(found: FloatArray, cov: FloatArray, row: FloatArray, error: float, variance: float, gain: FloatArray) -> None:
    """One scalar measurement with derivative ``row`` by the first states: ``found``, the estimated error, and ``cov`` change in place."""
    spread, left = variance, error
    for i in range(len(found)):
        gain[i] = 0.0
        for j in range(len(row)):
            gain[i] += cov[i, j] * row[j]
    for j in range(len(row)):
        spread += row[j] * gain[j]
        left -= row[j] * found[j]
    for i in range(len(found)):
        found[i] += gain[i] * left / spread
    for i in range(len(found)):
        for j in range(len(found)):
            cov[i, j] -= gain[i] * gain[j] / spread


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
