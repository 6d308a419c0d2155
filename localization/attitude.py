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

import numpy as np

from localization.events import ImuSample
from motion_models.compiled import kernel, subroutine
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray

GRAVITY = 9.81
"""[m/s^2]"""
_NS = 1e-9
_FIRST_SAMPLES = 20
"""Whose mean gives units, sign and the first vertical."""
_MAX_GAP_S = 0.5
"""Without a sample for longer, the vertical starts anew."""
_IN_M_S2, _IN_G, _NO_GRAVITY = (8.0, 12.0), (0.8, 1.2), 3.0
"""Size of the mean specific force: its ranges in m/s^2 and in g (some drivers), and below what gravity was removed [m/s^2]."""
_MAX_MOUNT_ERROR_RAD = math.radians(30.0)
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


@dataclass(frozen=True)
class Tilt:
    """How the ground tilts."""

    before: FloatArray
    """(2,) `motion_models.slope.Slope.downhill` at the start of a step."""
    after: FloatArray
    """(2,) at its end."""
    cov: FloatArray
    """(2, 2) of both, by the attitude, the mount, friction and the CG's height."""

    def at(self, shares: FloatArray) -> FloatArray:
        """(n, 2) at ``shares`` (n,) of the step, 0 to 1."""
        return np.asarray(self.before + shares[:, None] * (self.after - self.before))


class AttitudeFilter:
    """`insert` each sample of the IMU, `advance` to the end of each step."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], wheel_radius_m: float) -> None:
        self._noise, self._mounts, self._radius = noise, mounts, wheel_radius_m
        self._frame: str | None = None
        self._samples: list[tuple[int, FloatArray, FloatArray]] = []
        self._first: list[FloatArray] = []
        self._scale, self._problem = 0.0, ""  # of the force, 0 until known; why there is no attitude
        self._is_unusable = False
        self._turn_by_wheels = self._agreement = 0.0
        self._last_ns = 0
        self._window = np.zeros(7)  # sum of the forces, velocity at its begin, both turned into the body as it is now; length [s]
        self._is_explained, self._way, self._turn = False, 0.0, 0.0
        self._state, self._cov = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), np.zeros((6, 6))  # vertical, biases, noise's variance
        self._split, self._split_cov = np.zeros(4), np.diag([_MOUNT_SIGMA**2] * 2 + [_GROUND_SIGMA**2] * 2)
        self._has_started, self._tilts = False, False
        self._downhill = np.zeros(2)

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
        return self._state[:3].copy() if self._has_started else np.array([0.0, 0.0, 1.0])

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
        return 0.5 * float(self._cov[0, 0] + self._cov[1, 1]) + _ACCELEROMETER_RAD**2, 0.5 * float(
            self._split_cov[0, 0] + self._split_cov[1, 1]
        )

    @property
    def cov(self) -> FloatArray:
        """(6, 6) of the small rotation of the vertical about the body's axes [rad], then of the gyro's biases [rad/s]."""
        return self._cov.copy()

    @property
    def gyro_bias(self) -> FloatArray:
        """(3,) in body axes [rad/s]; what is about the vertical is not observable by gravity."""
        return self._state[3:6].copy()

    @property
    def mount_error(self) -> FloatArray:
        """(2,) the tilt that stays with the body: by the mount, not the ground."""
        return self._split[:2].copy()

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample of the first IMU whose mount is known."""
        if self._frame is None and sample.frame_id in self._mounts:
            self._frame = sample.frame_id
            self._rotation = self._mounts[sample.frame_id].rotation()
            mount = self._mounts[sample.frame_id]
            self._place = np.array([mount.x, mount.y, mount.z])
        if sample.frame_id != self._frame or self._problem or self._is_unusable:
            return
        if not self._scale:
            self._first.append(sample.linear_acceleration)
            if len(self._first) == _FIRST_SAMPLES:
                self._check_force()
        self._samples.append((sample.stamp_ns, sample.angular_velocity, sample.linear_acceleration))

    def _check_force(self) -> None:
        """Units and sign of the accelerometer, by the mean of the first samples."""
        mean = np.mean(self._first, axis=0)
        size = float(np.linalg.norm(mean))
        named = f"the accelerometer of IMU '{self._frame}'"
        if _IN_M_S2[0] < size < _IN_M_S2[1]:
            self._scale = 1.0
        elif _IN_G[0] < size < _IN_G[1]:
            self._scale = GRAVITY
        elif not size:  # no accelerometer
            self._is_unusable = True
        elif size < _NO_GRAVITY:
            self._problem = f"{named} shows no gravity ({size:.2f} m/s^2 on average): its driver removes it. Slopes are not modelled."
        else:
            self._problem = f"{named} shows {size:.1f} m/s^2 on average, neither gravity in m/s^2 nor in g. Slopes are not modelled."
        if self._problem or self._is_unusable:
            self._samples = []

    def advance(self, end_ns: int, dt_s: FloatArray, rates: FloatArray) -> Tilt | None:
        """Advance to ``end_ns``; wheels rolled at ``rates`` (n, 2) [rad/s] for ``dt_s`` (n,) [s] each, n = 0 where that is not known.

        The tilt since the last call, where the ground tilts; else None.
        """
        n = next((i for i, sample in enumerate(self._samples) if sample[0] > end_ns), len(self._samples))
        taken, self._samples = self._samples[:n], self._samples[n:]
        if not taken or not self._scale or self._problem:
            return None
        dt = (taken[-1][0] - self._last_ns) * _NS
        self._last_ns = taken[-1][0]
        rate = self._rotation @ np.mean([w for _, w, _ in taken], axis=0)
        force = self._scale * (self._rotation @ np.mean([f for _, _, f in taken], axis=0))
        velocity = None
        if len(rates):  # of the IMU, where wheels do not slip; what they do remains unexplained
            velocity = np.cross(rate, self._place)
            velocity[0] += 0.5 * self._radius * float(rates[-1, 0] + rates[-1, 1])
        if not 0.0 < dt < _MAX_GAP_S:
            self._has_started = False
            self._restart(velocity)
            return None
        _rotate(self._state, self._cov, self._window, rate, force, dt, self._noise.white_rad_per_sqrt_s)
        self._is_explained &= velocity is not None
        self._way += abs(0.5 * self._radius * float(dt_s @ (rates[:, 0] + rates[:, 1])))
        by_wheels = float(dt_s @ (rates[:, 1] - rates[:, 0]))
        self._turn_by_wheels += abs(by_wheels)
        self._agreement += by_wheels * float(rate[2])
        self._turn += float(rate[2]) * dt
        if self._window[6] >= (_WINDOW_S if self._has_started else _FIRST_WINDOW_S):
            self._measure(velocity)
        return self._tilt() if self._has_started else None

    def _restart(self, velocity: FloatArray | None) -> None:
        """Begin a window, over which forces are summed, at the IMU's ``velocity`` (3,) [m/s]."""
        self._window[:] = 0.0
        self._is_explained = velocity is not None
        if velocity is not None:
            self._window[3:6] = velocity
        self._way = self._turn = 0.0

    def _measure(self, velocity: FloatArray | None) -> None:
        """Update by gravity: the window's mean force, less what changed the velocity."""
        force, first, seconds = self._window[:3], self._window[3:6], float(self._window[6])
        is_explained = self._is_explained and velocity is not None
        gravity = (force - (velocity - first) if is_explained and velocity is not None else force) / seconds
        if not self._has_started:
            self._start(gravity)
        else:
            _update_vertical(self._state, self._cov, gravity, _EXPLAINED if is_explained else _UNEXPLAINED)
            _separate(self._split, self._split_cov, self._state, self._cov, self._turn, self._way)
            ground, cov = self._split[2:], self._split_cov[2:, 2:]
            if not self._tilts and np.hypot(ground[0], ground[1]) > _LEVEL:
                self._tilts = bool(ground @ np.linalg.solve(cov, ground) > _CERTAIN**2)
        self._restart(velocity)

    def _start(self, gravity: FloatArray) -> None:
        """The first vertical."""
        up = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
        if not self._is_above(float(up[2])):
            return
        is_still = self._is_explained and not self._way and not self._turn_by_wheels
        sigma = _START_SIGMA if is_still else _MOVING_SIGMA
        self._state[:] = [*up, *self._state[3:6], 0.01 if is_still else 0.1]
        self._cov = np.diag([sigma**2] * 3 + [_BIAS_SIGMA**2] * 3)
        self._split_cov[2:] = self._split_cov[:, 2:] = 0.0
        self._split_cov[2, 2] = self._split_cov[3, 3] = _GROUND_SIGMA**2
        self._has_started, self._downhill = True, -up[:2] / up[2]

    def _is_above(self, up_z: float) -> bool:
        """Whether the vertical by the mount is above the robot; where it is below, the wheels' turns show why."""
        least = math.cos(_MAX_MOUNT_ERROR_RAD)
        if up_z > least:
            return True
        named = f"gravity contradicts the mount of IMU '{self._frame}'"
        if up_z > -least:
            angle = math.degrees(math.acos(min(max(up_z, -1.0), 1.0)))
            self._problem = f"{named} by {angle:.0f} deg: slopes are not modelled. Correct the mount's roll and pitch."
        elif self._turn_by_wheels > _MIN_TURN_RAD:
            if self._agreement > 0.0:  # the gyro agrees with the mount: this driver publishes gravity, not specific force
                self._scale = -self._scale
            else:
                self._problem = f"{named}, it hangs upside down: slopes are not modelled. Correct the mount's roll or pitch."
        return False

    def _tilt(self) -> Tilt | None:
        """The tilt by the mount's error and the vertical as they are now."""
        before, self._downhill = self._downhill, -self._state[:2] / max(self._state[2], _MIN_UP)
        if not self._tilts:
            return None
        error, P = self._split[:2], self._cov
        now = self._downhill - error
        own = np.array([[P[1, 1], -P[0, 1]], [-P[0, 1], P[0, 0]]]) + _ACCELEROMETER_RAD**2 * np.eye(2)
        return Tilt(before - error, now, own + self._split_cov[:2, :2] + _SLOPE_EFFECT**2 * np.outer(now, now))

    def warnings(self) -> list[str]:
        """Problems of the accelerometer, and their remedy."""
        if self._problem:
            return [self._problem]
        if self._scale == GRAVITY:
            return [f"the accelerometer of IMU '{self._frame}' is in g, not m/s^2: it was scaled by {GRAVITY}."]
        if self._scale < 0.0:
            return [f"the accelerometer of IMU '{self._frame}' publishes gravity, not specific force: its sign was turned."]
        return []


@kernel
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
