"""The gyro's yaw rate: about the body's z axis by the IMU's mount, or about gravity where the mount cannot be true."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping

import numpy as np

from localization.events import ImuSample, Turn
from motion_models.robot import GyroNoise, Mount

_NS = 1e-9
_MAX_GAP_NS, _MAX_HOLD_NS = 500_000_000, 100_000_000
"""Time between samples over which no turn is interpolated, and time for which the newest rate is held [ns]: at 1 rad/s^2 the turn is off by
0.1 and 0.005 rad then."""
_MAX_SILENCE_NS = 2_000_000_000
"""Time without a sample after which another IMU of the topic is used [ns]: longer than a driver drops messages, for its bias and scale are
others."""
_SCATTER_SAMPLES = 25
"""Samples over which the scatter of the rates is measured: half a second of most drivers."""
GRAVITY_SAMPLES = 20
"""First samples of an IMU, whose mean specific force is that of gravity."""
_GRAVITY_M_S2 = 8.0, 12.0
"""Size of a mean specific force that is gravity's [m/s^2]: 9.81 with a scale that is off by less than a fifth."""
MAX_MOUNT_ERROR_RAD = math.radians(30.0)
"""Angle between gravity and the vertical of an IMU's mount, from where on the mount is wrong: no ground is as steep [rad]."""
_JUMP_RAD_PER_S, _JUMP_RAD_PER_S2, _MAX_JUMP_RAD_PER_S = 2.0, 200.0, 10.0
"""Change of the rate that is no spike: noise and shaking, how fast such a robot may begin to turn, and what none reaches."""
_MAX_SPIKES = 2
"""Spikes in a row that agree; a third is accepted."""
_MIN_TURN_RAD = 0.5
"""Turn by the wheels, after which they show which way the gyro's axis points [rad]."""


class GyroBuffer:
    """The last seconds of the yaw rate: ``keep_s`` of them [s], of IMUs that sit at ``mounts`` (by frame).

    Gravity shows which axis of the IMU is upright. Where the mount gives another one, the rate is that about gravity, and whether this
    axis points up or down (some drivers publish gravity, not specific force) follows from the turns of the wheels; until these suffice,
    the gyro is not used.

    Spike filter: a sample that differs from the last accepted one by more than 2 rad/s + 200 rad/s^2 dt (at most 10 rad/s) is held; three
    in a row that agree are accepted.

    Of several IMUs on one topic the first is used, another one once it has been silent for 2 s.
    """

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], keep_s: float = 10.0) -> None:
        self._noise, self._mounts = noise, mounts
        self._keep_ns = keep_s / _NS
        self._stamps: list[int] = []
        self.newest_ns: int | None = None
        """Stamp of the newest sample; None before the first."""
        self._rates: list[float] = []
        self._angles: list[float] = []
        self._sum_squared_differences: list[float] = []  # second ones, of the rate
        self._rate = self._rate_before = 0.0
        self._pending: list[tuple[int, float]] = []
        self._spikes = 0
        self._frame: str | None = None
        self._last_ns = 0  # stamp of the newest sample of that frame
        self._unused: dict[str, int] = {}  # number of samples by frame of the other IMUs
        self._force = np.zeros(3)
        self._axis = np.array([0.0, 0.0, 1.0])
        self._contradicts, self._sign = False, 1.0
        self._agreement = self._turned = 0.0

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample; one that does not come after the newest changes nothing."""
        if self._frame is None:
            self._begin(sample)
        elif sample.frame_id != self._frame:
            if sample.stamp_ns - self._last_ns <= _MAX_SILENCE_NS:
                self._unused[sample.frame_id] = self._unused.get(sample.frame_id, 0) + 1
                return
            self._begin(sample)
        elif sample.stamp_ns <= self._last_ns:
            return
        self._last_ns = sample.stamp_ns
        self._check_mount(sample)
        self._filter_rate(sample.stamp_ns, float(self._axis @ sample.angular_velocity))

    def _filter_rate(self, stamp_ns: int, rate: float) -> None:
        """Append a rate, or keep it pending until later ones agree with it."""
        if self._stamps and stamp_ns - self._stamps[-1] > _MAX_GAP_NS:
            self._reset()
        if not self._stamps or _may_follow((self._stamps[-1], self._rate), (stamp_ns, rate)):
            self._reject()
            self._take(stamp_ns, rate)
            return
        if self._pending and not _may_follow(self._pending[-1], (stamp_ns, rate)):
            self._reject()
        self._pending.append((stamp_ns, rate))
        if len(self._pending) > _MAX_SPIKES:
            accepted, self._pending = self._pending, []
            if len(self._stamps) == 1:  # only the first sample contradicts them
                self._reset()
                self._spikes += 1
            for entry in accepted:
                self._take(*entry)

    def _take(self, stamp_ns: int, rate: float) -> None:
        if self._stamps:
            dt = (stamp_ns - self._stamps[-1]) * _NS
            self._angles.append(self._angles[-1] + 0.5 * (self._rate + rate) * dt)
            difference = rate - 2.0 * self._rate + self._rate_before if len(self._stamps) > 1 else 0.0
            self._sum_squared_differences.append(self._sum_squared_differences[-1] + difference**2)
        else:
            self._angles.append(0.0)
            self._sum_squared_differences.append(0.0)
        self._rate_before, self._rate = self._rate, rate
        self._stamps.append(stamp_ns)
        self.newest_ns = stamp_ns
        self._rates.append(rate)
        if self._stamps[0] < stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._stamps, stamp_ns - self._keep_ns)
            del self._stamps[:n], self._rates[:n], self._angles[:n], self._sum_squared_differences[:n]

    def _reject(self) -> None:
        self._spikes += len(self._pending)
        self._pending = []

    def __len__(self) -> int:
        """Stored samples."""
        return len(self._stamps)

    def turn(self, start_ns: int, end_ns: int, by_wheels: float) -> Turn | None:
        """The turn from ``start_ns`` to ``end_ns``; ``by_wheels`` [rad] gives its sign alone, where the mount does not.

        None where the gyro has no sample from before the start to (nearly) the end, or while its axis is not known.
        """
        if not self._stamps or start_ns < self._stamps[0] or end_ns > self._stamps[-1] + _MAX_HOLD_NS:
            return None
        angle = self._angle(end_ns) - self._angle(start_ns)
        if self._contradicts:
            self._agreement += angle * by_wheels
            self._turned += abs(by_wheels)
            if self._turned < _MIN_TURN_RAD:
                return None
            self._sign = math.copysign(1.0, self._agreement)
        dt = (end_ns - start_ns) * _NS
        variance = self._noise.white_rad_per_sqrt_s**2 * dt + self._sampling_variance(start_ns, end_ns)
        age_s = max(end_ns - self._stamps[-1], 0) * _NS
        return Turn(self._sign * angle, variance, dt, self._sign * self._rate_at(end_ns), self._rate_variance(end_ns), age_s)

    def _rate_at(self, stamp_ns: int) -> float:
        """Between samples by interpolation, after the newest its own [rad/s]."""
        i = bisect.bisect_left(self._stamps, stamp_ns)
        if i in (0, len(self._stamps)):
            return self._rates[min(i, len(self._stamps) - 1)]
        part = (stamp_ns - self._stamps[i - 1]) / (self._stamps[i] - self._stamps[i - 1])
        return self._rates[i - 1] + part * (self._rates[i] - self._rates[i - 1])

    def _rate_variance(self, stamp_ns: int) -> float:
        """Variance of `_rate_at` [rad^2/s^2]: white noise sigma gives second differences the variance 6 sigma^2; shaking adds to both."""
        j = min(bisect.bisect_left(self._stamps, stamp_ns), len(self._stamps) - 1)
        i = max(j - _SCATTER_SAMPLES, 0)
        squares = self._sum_squared_differences[j] - self._sum_squared_differences[i]
        return squares / 6.0 / (j - i) if j > i else 0.0

    def _sampling_variance(self, start_ns: int, end_ns: int) -> float:
        """Variance of the turn [rad^2] by what the rate does between samples: shaking, wheels that slip by jerks.

        A white rate of density q [rad^2/s], sampled every dt as the mean over 2 dt around the stamp: second differences have the variance
        q / dt, and the sum of trapezoids errs by q dt / 8 at each end. White noise of the gyro adds 6 sigma^2 / dt to the former.
        """
        last = len(self._stamps) - 1
        i = min(bisect.bisect_right(self._stamps, start_ns) - 1, last)
        j = min(bisect.bisect_left(self._stamps, end_ns), last)
        if j <= i:
            return 0.0
        dt = (self._stamps[j] - self._stamps[i]) / (j - i) * _NS
        noise = 6.0 * self._noise.white_rad_per_sqrt_s**2 / dt
        squares = self._sum_squared_differences[j] - self._sum_squared_differences[i]
        return 0.25 * dt**2 * max(squares / (j - i) - noise, 0.0)

    def warnings(self) -> list[str]:
        """Problems of the IMU and their remedy."""
        found = []
        if self._unused:
            frames = " and ".join(f"'{frame}'" for frame in (self._frame, *self._unused))
            found.append(f"IMU frames {frames} on one topic: only '{self._frame}' is used.")
        if self._spikes:
            plural = "s" * (self._spikes > 1)
            found.append(f"IMU '{self._frame}': {self._spikes} reading{plural} dropped (the yaw rate jumped as no such robot's does).")
        if not self._contradicts:
            return found
        if self._turned < _MIN_TURN_RAD:
            return [
                *found,
                f"the mount of IMU '{self._frame}' contradicts gravity, and the robot turned too little to find its axis: it was not used.",
            ]
        axis = ", ".join(f"{value:+.2f}" for value in self._sign * self._axis)
        return [
            *found,
            f"the mount of IMU '{self._frame}' contradicts gravity: the yaw rate was taken about [{axis}] in the IMU's frame. "
            "Correct its roll, pitch and yaw in /tf_static or in the robot file's [mounts].",
        ]

    def _begin(self, sample: ImuSample) -> None:
        mount = self._mounts.get(sample.frame_id, Mount())
        self._frame, self._up = sample.frame_id, mount.rotation[2]
        self._axis, self._force = self._up, np.zeros(3)
        self._contradicts, self._sign, self._n_force = False, 1.0, 0
        self._agreement = self._turned = 0.0
        self._unused.pop(sample.frame_id, None)
        self._reset()

    def _check_mount(self, sample: ImuSample) -> None:
        """Check the mount once, by the mean of the first samples."""
        if self._n_force >= GRAVITY_SAMPLES:
            return
        self._force = self._force + sample.linear_acceleration
        self._n_force += 1
        strength = float(np.linalg.norm(self._force)) / self._n_force
        if self._n_force == GRAVITY_SAMPLES and is_gravity(strength):
            found = self._force / np.linalg.norm(self._force)
            if found @ self._up < math.cos(MAX_MOUNT_ERROR_RAD):
                self._axis, self._contradicts = found, True
                self._reset()

    def _reset(self) -> None:
        self._reject()
        self._stamps.clear()
        self.newest_ns = None
        self._rates.clear()
        self._angles.clear()
        self._sum_squared_differences.clear()

    def _angle(self, stamp_ns: int) -> float:
        past = stamp_ns - self._stamps[-1]
        if past > 0:
            return self._angles[-1] + self._rate * past * _NS
        i = max(bisect.bisect_left(self._stamps, stamp_ns), 1)
        if i >= len(self._stamps):
            return self._angles[-1]
        part = (stamp_ns - self._stamps[i - 1]) / (self._stamps[i] - self._stamps[i - 1])
        return self._angles[i - 1] + part * (self._angles[i] - self._angles[i - 1])


class GyroRecord:
    """The whole record of a gyro: a `GyroBuffer` for each stretch without a gap."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount]) -> None:
        self._noise, self._mounts = noise, mounts
        self._stretches: list[GyroBuffer] = []
        self._starts: list[int] = []
        self.silent_s = 0.0
        """Length of all gaps [s]."""

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample."""
        newest = self._stretches[-1].newest_ns if self._stretches else None
        if newest is None or sample.stamp_ns - newest > _MAX_GAP_NS:
            if newest is not None:
                self.silent_s += (sample.stamp_ns - newest) * _NS
            self._stretches.append(GyroBuffer(self._noise, self._mounts, keep_s=math.inf))
            self._starts.append(sample.stamp_ns)
        self._stretches[-1].insert(sample)

    @property
    def gaps(self) -> int:
        """Number of gaps."""
        return max(len(self._stretches) - 1, 0)

    def turn(self, start_ns: int, end_ns: int, by_wheels: float) -> Turn | None:
        """The turn from ``start_ns`` to ``end_ns`` (see `GyroBuffer.turn`); None also where there is a gap between."""
        i = bisect.bisect_right(self._starts, start_ns) - 1
        return None if i < 0 else self._stretches[i].turn(start_ns, end_ns, by_wheels)


def is_gravity(force_m_s2: float) -> bool:
    """Whether the size of a mean specific force [m/s^2] is gravity's: some drivers publish none, or in other units."""
    return _GRAVITY_M_S2[0] < force_m_s2 < _GRAVITY_M_S2[1]


def _may_follow(before: tuple[int, float], after: tuple[int, float]) -> bool:
    """Whether a robot's rate can be ``after`` [ns, rad/s] where it was ``before``."""
    return abs(after[1] - before[1]) <= min(_JUMP_RAD_PER_S + _JUMP_RAD_PER_S2 * (after[0] - before[0]) * _NS, _MAX_JUMP_RAD_PER_S)
