"""The gyro's yaw rate: about the body's z axis by the IMU's mount, or about gravity where the mount cannot be true."""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.events import ImuSample, Turn
from localization.inputs.rate_series import MAX_GAP_NS, RateSeries
from localization.messages import Message, message
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray

_NS = 1e-9
_MAX_SILENCE_NS = 2_000_000_000
"""Time without a sample after which another IMU of the topic is used [ns]: longer than a driver drops messages, for its bias and scale are
others."""
GRAVITY_SAMPLES = 20
"""First samples of an IMU, whose mean specific force is that of gravity."""
_GRAVITY_M_S2 = 8.0, 12.0
"""Size of a mean specific force that is gravity's [m/s^2]: 9.81 with a scale that is off by less than a fifth."""
MAX_MOUNT_ERROR_RAD = math.radians(30.0)
"""Angle between gravity and the vertical of an IMU's mount, from where on the mount is wrong: no ground is as steep [rad]."""
_MIN_TURN_RAD = 0.5
"""Turn by the wheels, after which they show which way the gyro's axis points [rad]."""


class UprightAxis:
    """The axis of an IMU about which the robot turns: that of its mount ``up`` (3,), in the IMU's frame, or gravity where these contradict.

    Whether gravity's axis points up or down (some drivers publish gravity, not specific force) follows from the turns of the wheels; until
    these suffice, there is no sign.
    """

    def __init__(self, up: FloatArray) -> None:
        self._up = self.axis = up
        self._force, self._n_force = np.zeros(3), 0
        self.is_mount_wrong = False
        """Gravity contradicts the mount."""
        self.sign: float | None = 1.0
        """1 or -1, times the rate about the axis; None while it is not known."""
        self._agreement = self._turned = 0.0

    def add_force(self, force: FloatArray) -> bool:
        """Check the mount, once, by the mean specific force of the first samples. Whether the axis has changed by it."""
        if self._n_force >= GRAVITY_SAMPLES:
            return False
        self._force, self._n_force = self._force + force, self._n_force + 1
        strength = float(np.linalg.norm(self._force)) / self._n_force
        if self._n_force < GRAVITY_SAMPLES or not is_gravity(strength):
            return False
        found = self._force / np.linalg.norm(self._force)
        if found @ self._up >= math.cos(MAX_MOUNT_ERROR_RAD):
            return False
        self.axis, self.is_mount_wrong, self.sign = found, True, None
        return True

    @property
    def is_force_reversed(self) -> bool:
        """Whether the mount is right, and the accelerometer publishes gravity instead of specific force: by the turns of the wheels."""
        return self.is_mount_wrong and self.sign is not None and float(self.sign * self.axis @ self._up) >= math.cos(MAX_MOUNT_ERROR_RAD)

    def compare(self, angle: float, by_wheels: float) -> None:
        """A turn about the axis, and that by the wheels [rad]: which way the axis points."""
        if self.is_mount_wrong:
            self._agreement += angle * by_wheels
            self._turned += abs(by_wheels)
            self.sign = None if self._turned < _MIN_TURN_RAD else math.copysign(1.0, self._agreement)


class GyroBuffer:
    """The last seconds of the yaw rate: ``keep_s`` of them [s], of IMUs that sit at ``mounts`` (by frame).

    Of several IMUs on one topic the first is used, another one once it has been silent for 2 s.
    """

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], keep_s: float = 10.0) -> None:
        self._mounts, self._series = mounts, RateSeries(noise.white_rad_per_sqrt_s, keep_s)
        self._axis = UprightAxis(np.array([0.0, 0.0, 1.0]))
        self.newest_ns: int | None = None
        """Stamp of the newest sample that was accepted; None before the first."""
        self._frame: str | None = None
        self._last_ns = 0  # stamp of the newest sample of that frame
        self._unused: dict[str, int] = {}  # number of samples by frame of the other IMUs

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
        if self._axis.add_force(sample.linear_acceleration):
            self._series.restart()
        self._series.insert(sample.stamp_ns, float(self._axis.axis @ sample.angular_velocity))
        self.newest_ns = self._series.newest_ns

    def __len__(self) -> int:
        """Stored samples."""
        return len(self._series)

    def turn(self, start_ns: int, end_ns: int, by_wheels: float) -> Turn | None:
        """The turn from ``start_ns`` to ``end_ns``; ``by_wheels`` [rad] gives its sign alone, where the mount does not.

        None where the gyro has no sample from before the start to (nearly) the end, or while its axis is not known.
        """
        turn = self._series.turn(start_ns, end_ns)
        if turn is None:
            return None
        self._axis.compare(turn.angle, by_wheels)
        if self._axis.sign is None:
            return None
        return turn if self._axis.sign > 0.0 else replace(turn, angle=-turn.angle, rate=None if turn.rate is None else -turn.rate)

    def warnings(self) -> list[Message]:
        """Problems of the IMU and their remedy."""
        found, spikes, frame = list[Message](), self._series.spikes, self._frame or ""
        if self._unused:
            frames = " and ".join(f"'{other}'" for other in (frame, *self._unused))
            found.append(message("imu.several_frames", frames=frames, used=frame))
        if spikes:
            found.append(message("imu.spike", frame=frame) if spikes == 1 else message("imu.spikes", frame=frame, count=spikes))
        if not self._axis.is_mount_wrong or self._axis.is_force_reversed:
            return found
        if self._axis.sign is None:
            return [*found, message("imu.no_axis", frame=frame)]
        axis = ", ".join(f"{value:+.2f}" for value in self._axis.sign * self._axis.axis)
        return [*found, message("imu.axis", frame=frame, axis=axis)]

    def _begin(self, sample: ImuSample) -> None:
        self._frame, self._axis = sample.frame_id, UprightAxis(self._mounts.get(sample.frame_id, Mount()).rotation[2])
        self._unused.pop(sample.frame_id, None)
        self._series.restart()


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
        if newest is None or sample.stamp_ns - newest > MAX_GAP_NS:
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
