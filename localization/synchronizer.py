"""Synchronize events: intervals between scans, and for each the preintegrated wheels, the gyro's turn and the scan."""

from __future__ import annotations

import bisect
import math
import operator
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from localization.attitude import AttitudeFilter
from localization.body_rates import BodyRates
from localization.bounded_settings import Positive, Settings, at_least
from localization.events import CgSample, Event, ImuSample, Scan, Step, StepInterval, Turn, WheelSample, turn_twist
from localization.gyro import GyroBuffer
from localization.lidar.frames import LidarFrames
from localization.wheel_motion import WheelMotion
from motion_models.base import MotionModel
from motion_models.robot import Mount, Robot
from motion_models.se2 import Cov3, FloatArray, Twist2

_MIN_REPORTED_S = 0.05
"""Shorter times without wheel data are not reported: the first scan is often some milliseconds before the first wheel sample."""
_SCAN_WAIT_NS = 1_000_000_000
"""Wait for the first scan after the first wheel sample [ns]; later, the drive starts by wheels alone. Scanners have 2 Hz or more."""


@dataclass(frozen=True)
class StepConfig(Settings):
    """How the time between events is cut into steps."""

    max_step_s: Annotated[float, at_least(0.001)] = 0.25
    """A step ends at a scan; where none comes for this long, it ends without one [s]."""
    no_lidar_step_s: Positive = 0.05
    """Shortest step in a log without a LiDAR [s]; it ends at the last stamp that wheels and gyro have both reached."""
    wait_s: float = 0.3
    """How long a scan waits for the wheel samples around it before it is used without them, and wheels for the gyro [s]."""
    max_hold_s: float = 0.5
    """How long the last wheel rates are held when no more come [s]."""
    lost_speed_m_s: Positive = 0.5
    """Sigma of the unknown constant speed while wheel data are missing [m/s]."""
    lost_rate_rad_s: Positive = 0.5
    """Sigma of the unknown constant turn rate while wheel data are missing [rad/s]."""
    slopes: bool = True
    """Model gravity on slopes where the IMU's accelerometer shows that the ground tilts; false takes all ground as level."""
    planar: bool | None = None
    """Estimate poses in the plane; false: in space, which takes an IMU with an accelerometer and a 3D LiDAR. None: in the plane, until the
    IMU shows that the ground tilts while there are clouds of a 3D LiDAR."""


_MAX_VARIANCE = np.array([math.inf, math.inf, math.pi**2 / 3.0])
"""Upper bounds of the variances of x, y and yaw; yaw: that of a uniform distribution from -pi to pi [rad^2]."""
_MIN_KNOWN_S = 1e-6
"""Least time with wheel data in a step that counts [s]: less than a microsecond is rounding."""


class UnknownVelocity:
    """Motion by an unmeasured constant velocity, whose sigma is that of the settings or the last measured velocity, if that is larger.

    It moves the robot by v t, with the variance sigma^2 t^2: a step from t_0 to t_1 after the last measured pose adds
    sigma^2 (t_1^2 - t_0^2), so that the sum does not depend on how the time is cut into steps.
    """

    def __init__(self, config: StepConfig) -> None:
        self._least = np.array([config.lost_speed_m_s, config.lost_speed_m_s, config.lost_rate_rad_s])
        self.measured: Twist2 = np.zeros(3)
        """(3,) the last measured twist: the next unknown velocity may be as large."""
        self.lasted_s: FloatArray | float = 0.0
        """For how long the motion along x, along y and the turn (3,), or all alike, have been unknown [s]: 0 where the pose was measured
        now."""

    def increment(self, missing_s: float, has_turn: bool) -> Cov3:
        """Covariance (3, 3) of the motion in the next ``missing_s`` [s]. ``has_turn``: a gyro measures the turn of each step, so that
        the turn before is known."""
        is_unknown, speed = np.array([True, True, not has_turn]), math.hypot(self.measured[0], self.measured[1])
        sigma = np.maximum(self._least, [speed, speed, abs(self.measured[2])])
        since = self.lasted_s * is_unknown
        until = since + missing_s
        self.lasted_s = until * is_unknown
        after, before = (np.minimum((sigma * t) ** 2, _MAX_VARIANCE) for t in (until, since))
        return np.diag(after - before)


@dataclass
class FaultyScans:
    """Numbers of scans with missing points or times, or that came too late."""

    empty: int = 0
    """Scans without a usable point."""
    late: int = 0
    """Scans that came after later ones."""
    timeless: int = 0
    """Scans without the times of their points."""
    has_turned: bool = False
    """The robot turned in a step with one of these."""

    def warnings(self) -> list[str]:
        """A sentence each."""
        found = []
        if self.empty:
            scans = f"{self.empty} scan{'s' * (self.empty > 1)}"
            found.append(f"{scans} without a usable point: the pose is by wheels and gyro there.")
        if self.late:
            found.append(f"{self.late} scan{'s' * (self.late > 1)} came after later ones and could not be used.")
        if self.has_turned:
            found.append(
                f"{self.timeless} scan{'s' * (self.timeless > 1)} without the times of their points, taken as measured at one "
                "instant: if the scanner sweeps, turns distort them. Let its driver publish the times (time_increment of a scan, a "
                "field of a cloud)."
            )
        return found


class Synchronizer:
    """Cuts a stream of events into steps: `insert` an event, then take each `next_interval` and `preintegrate` it.

    Streaming and bounded: a scan waits until wheel data reach its stamp, or for at most `StepConfig.wait_s`.
    """

    def __init__(self, model: MotionModel, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: StepConfig | None = None):
        self.config = c = config or StepConfig()
        has_slopes = c.slopes and model.traits.is_level
        unknown = np.array([c.lost_speed_m_s, c.lost_speed_m_s, c.lost_rate_rad_s])
        self.wheels = WheelMotion(model, robot, c.max_hold_s, unknown, has_slopes)
        """Wheel samples, and the motion model."""
        self._gyro = GyroBuffer(robot.gyro_noise, mounts)
        self.attitude: AttitudeFilter | None = None
        """The vertical; None for models of robots that do not skid, and where `StepConfig.slopes` is off."""
        self._imu = robot.gyro_noise, mounts, robot.geometry.wheel_radius_m  # of which attitude and body rates are made
        self._body_rates: BodyRates | None = None
        if has_slopes:
            self._measure_attitude()
        if c.planar is False:
            self.measure_in_space()
        self.frames = LidarFrames(mounts)
        """Frames of the scans, with their mounts."""
        self._has_lidar = has_lidar
        self._scans: deque[tuple[int, Scan]] = deque()  # and the middle of its sweep
        self._faulty, self._no_wheel_data_s = FaultyScans(), 0.0
        self._velocity = UnknownVelocity(c)  # in gaps of the wheel data
        self._wait_ns, self._max_step_ns = _ns(c.wait_s), _ns(c.max_step_s)
        self._start_ns: int | None = None
        self._now_ns = -(1 << 62)
        self._clock_offset_ns = 0

    def set_calibration(self, params: FloatArray | None, clock_offset_s: float) -> None:
        """Use ``params`` (k,) of the motion model (None: unchanged) and the wheels' clock offset from the next step on.

        ``clock_offset_s``: the wheels' stamps are late by this much [s]; what happened at t is stamped t + offset.
        """
        if params is not None:
            self.wheels.params = params
        self._clock_offset_ns = _ns(clock_offset_s)

    def measure_in_space(self) -> None:
        """Measure attitude and turns about all three axes from here on, as poses in space need them."""
        if self._body_rates is None:
            self._body_rates = BodyRates(*self._imu[:2])
        if self.attitude is None:
            self._measure_attitude()

    def _measure_attitude(self) -> None:
        self.attitude = AttitudeFilter(*self._imu)

    def restart_gap(self) -> None:
        """Restart the gap in the wheel data: a matched scan measured the pose, so the unknown velocity acts only from here on."""
        self._velocity.lasted_s = 0.0

    def insert(self, event: Event) -> None:
        """Store ``event`` in the buffer of its sensor."""
        self._now_ns = max(self._now_ns, event.stamp_ns)
        if isinstance(event, WheelSample):
            self.wheels.buffer.insert(event)
            if self._start_ns is None and not self._has_lidar:
                self._start_ns = event.stamp_ns
        elif isinstance(event, ImuSample):
            self._gyro.insert(event)
            if self.attitude is not None:
                self.attitude.insert(event)
            if self._body_rates is not None:
                self._body_rates.insert(event)
        elif isinstance(event, CgSample):
            self.wheels.buffer.set_cg(event)
        elif isinstance(event, Scan) and self.frames.admit(event):
            self._faulty.empty += not len(event.points)
            middle_ns = event.middle_ns
            # one that was overtaken goes where it belongs, if that still waits
            self._scans.insert(bisect.bisect_right(self._scans, middle_ns, key=operator.itemgetter(0)), (middle_ns, event))

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """By the gyro's samples so far, as `GyroBuffer.turn`; changes nothing."""
        return self._gyro.turn(start_ns, end_ns, by_wheels=0.0) if end_ns > start_ns else None

    @property
    def stored_samples(self) -> int:
        """Samples of wheels and gyro, and scans, that are stored; bounded."""
        return len(self.wheels.buffer) + len(self._gyro) + len(self._scans)

    @property
    def is_waiting(self) -> bool:
        """A scan waits for wheel data up to its stamp."""
        return bool(self._scans)

    def warnings(self) -> list[str]:
        """Problems of the sensors so far."""
        found = self._gyro.warnings()
        if self.attitude is not None:
            found += self.attitude.warnings()
        found += self._faulty.warnings()
        if self._no_wheel_data_s >= _MIN_REPORTED_S:
            found.append(f"no wheel data for {self._no_wheel_data_s:.1f} s in all: motion there is predicted with a wide covariance.")
        return [*found, *self.frames.warnings()]

    def next_interval(self, is_last: bool) -> StepInterval | None:
        """The next step's time, or None while it must wait for more events; with ``is_last`` no more will come."""
        while (end := self._next_end(is_last)) is not None:
            end_ns, scan = end
            start_ns = end_ns if self._start_ns is None else self._start_ns
            if end_ns >= start_ns:
                self._start_ns = end_ns
                return StepInterval(start_ns, end_ns, scan)
            self._faulty.late += 1  # going back would count the motion since then twice
        return None

    def _next_end(self, is_last: bool) -> tuple[int, Scan | None] | None:
        """End of the next step and the scan there, or None."""
        if self._scans:
            middle_ns, _ = self._scans[0]
            is_late = self._now_ns > middle_ns + self._wait_ns
            return self._scans.popleft() if is_last or is_late or self._has_rates_until(middle_ns) else None
        first_ns, newest_ns = self.wheels.buffer.first_ns, self.wheels.buffer.newest_ns
        if self._start_ns is None and first_ns is not None and (is_last or self._now_ns > first_ns + _SCAN_WAIT_NS):
            self._start_ns = first_ns
        if self._start_ns is None or newest_ns is None:
            return None
        end_ns = newest_ns - self._clock_offset_ns
        if self._has_lidar:
            end_ns = min(end_ns, self._now_ns)  # wheels stamped too early must not overtake a scan that is still to come
            least_ns = self._max_step_ns + (0 if is_last else self._wait_ns)
            return None if end_ns - self._start_ns < least_ns else (self._start_ns + self._max_step_ns, None)
        # the gyro's clock may be ahead of the wheels': holding its last rate would hide the offset between the two clocks
        gyro_ns = self._gyro.newest_ns
        if gyro_ns is not None and not is_last and self._now_ns <= gyro_ns + self._wait_ns:
            end_ns = min(end_ns, gyro_ns)
        least_ns = 1 if is_last else _ns(self.config.no_lidar_step_s)
        return None if end_ns - self._start_ns < least_ns else (end_ns, None)

    def _has_rates_until(self, stamp_ns: int) -> bool:
        """Whether the rates of the wheels, and of a gyro that is not silent, are known until ``stamp_ns``: which of them comes first must
        not matter."""
        known_ns, gyro_ns = self.wheels.buffer.rates_known_until_ns, self._gyro.newest_ns
        is_gyro_known = gyro_ns is None or gyro_ns >= stamp_ns or self._now_ns > gyro_ns + self._wait_ns
        return is_gyro_known and known_ns is not None and known_ns >= stamp_ns + self._clock_offset_ns

    def preintegrate(self, interval: StepInterval) -> Step:
        """The wheels' motion, the gyro's turn and the scan of ``interval``."""
        start_ns, end_ns, scan = interval
        shift = self._clock_offset_ns
        dt, rates, cg, missing = self.wheels.buffer.window(start_ns + shift, end_ns + shift, self.config.max_hold_s)
        tilt = None if self.attitude is None else self.attitude.advance(end_ns, dt, rates)
        motion, d_clock, last = self.wheels.integrate(start_ns + shift, dt, rates, cg, tilt)
        if start_ns == end_ns:  # the first scan of a drive: its sweep needs a twist
            rates, last = self.wheels.twist_at(end_ns + shift)
        is_standing = bool(len(dt)) and missing == 0.0 and not rates.any()
        has_wheels = missing == 0.0 and bool(len(rates))
        has_turn = end_ns > start_ns and self._gyro.newest_ns is not None
        turn = self._gyro.turn(start_ns, end_ns, float(motion.delta[2])) if has_turn else None
        if missing:
            self._no_wheel_data_s += missing
            motion = replace(motion, cov=motion.cov + self._velocity.increment(missing, has_turn=turn is not None))
        if missing < (end_ns - start_ns) * 1e-9 - _MIN_KNOWN_S:  # wheels measured the velocity in this step
            self._velocity.lasted_s = missing
        if scan is not None and len(scan.points) and not len(scan.offsets):
            self._faulty.timeless += 1
            self._faulty.has_turned |= bool(motion.delta[2])
        if has_wheels:
            self._velocity.measured = last
        twist = last if has_wheels else turn_twist(turn)
        body_turn, gravity = None, None
        if self._body_rates is not None and self.attitude is not None:
            body_turn, gravity = self._body_rates.turn(start_ns, end_ns), self.attitude.gravity
        cg_cov = self.wheels.buffer.cg_cov
        return Step(start_ns, end_ns, motion, d_clock, twist, is_standing, has_wheels, turn, scan, cg_cov, body_turn, gravity)


def _ns(seconds: float) -> int:
    """Whole nanoseconds: a stamp plus a float would be rounded to 256 ns."""
    return round(seconds * 1e9)
