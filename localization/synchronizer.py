"""From events to steps: between two moments, what the wheels predict and what the gyro and the LiDAR measured."""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from localization.events import CgSample, Event, ImuSample, Scan, WheelSample
from localization.gyro import GyroHistory, Turn
from localization.lidar_frames import LidarFrames
from localization.lidar_tilt import LidarTilt
from localization.settings import Positive, Settings, at_least
from localization.wheel_history import WheelHistory
from motion_models import se2
from motion_models.base import Motion, MotionModel, Twist
from motion_models.integrate import integrate_twists
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_NS = 1e-9


@dataclass(frozen=True)
class StepConfig(Settings):
    """How the time between events is cut into steps."""

    max_step_s: Annotated[float, at_least(0.001)] = 0.25
    """A step ends at a scan; where none comes for this long, it ends without one [s]."""
    no_lidar_step_s: Positive = 0.05
    """Length of steps in a log without a LiDAR, at least [s]; they end where wheels and gyro both were heard up to."""
    wait_s: float = 0.3
    """How long a scan waits for the wheel samples around it before it is used without them, and wheels for the gyro [s]."""
    max_hold_s: float = 0.5
    """For how long the last wheel rates are believed when no more come [s]."""
    lost_speed_m_s: Positive = 0.5
    """How fast the robot may move while no wheels are heard, all the while: sigma [m/s]."""
    lost_rate_rad_s: Positive = 0.5
    """How fast it may turn meanwhile, unless a gyro tells: sigma [rad/s]."""


@dataclass(frozen=True)
class Step:
    """The time from ``start_ns`` to ``end_ns``, and what each witness says of it."""

    start_ns: int
    end_ns: int
    predicted: Motion
    """By the wheels and the motion model, at its nominal parameters."""
    d_clock: FloatArray
    """(3,) change of the predicted motion (right perturbation) per second by which the wheels' clock is shifted [m/s, m/s, rad/s]."""
    twist: FloatArray
    """(3,) body twist at the end, by the wheels; of a step of no duration, by what they say next or said last. Where they were not heard,
    zero, but for the mean turn rate by the gyro."""
    is_standing: bool
    """No wheel moved during the step."""
    has_wheels: bool
    """Wheels were heard during all of the step; of no duration, about then."""
    turn: Turn | None = None
    scan: Scan | None = None

    @property
    def duration(self) -> float:
        """[s]"""
        return (self.end_ns - self.start_ns) * _NS


class Synchronizer:
    """Cuts a stream of events into steps. Give it events with `push`; then take all steps that are ready.

    Streaming and bounded: a scan waits until the wheels were heard up to it, or for at most `StepConfig.wait_s`.
    """

    def __init__(self, model: MotionModel, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: StepConfig | None = None):
        self.config = config or StepConfig()
        self._model, self._robot = model, robot
        self.params = model.nominal
        """(k,) the model's parameters: estimated by the filter, and used from the next step on."""
        self._wheels = WheelHistory(robot.center_of_gravity)
        self._gyro = GyroHistory(robot.gyro_noise, mounts)
        self.frames = LidarFrames(mounts)
        """Of the scans."""
        self._tilt = LidarTilt(mounts)
        self._has_lidar = has_lidar
        self._scans: deque[tuple[int, Scan]] = deque()  # and the middle of its sweep
        self._empty_scans, self._late_scans, self._deaf_s = 0, 0, 0.0
        self._lost_s = 0.0  # how long no wheels have been heard
        self._speed = np.zeros(2)  # the last that wheels gave [m/s, rad/s]
        self._timeless, self._has_turned = 0, False  # scans without the times of their points, and whether the robot turned at one
        self._start_ns: int | None = None
        self._now_ns = -(1 << 62)
        self.clock_offset_s = 0.0
        """The wheels' stamps are late by this much [s], what happened at t bears t + this.

        Estimated by the filter, and used from the next step on."""

    def push(self, event: Event) -> Iterator[Step]:
        """Take ``event`` and yield the steps that it completes."""
        self._now_ns = max(self._now_ns, event.stamp_ns)
        if isinstance(event, WheelSample):
            self._wheels.push(event)
            if self._start_ns is None and not self._has_lidar:
                self._start_ns = event.stamp_ns
        elif isinstance(event, ImuSample):
            self._gyro.push(event)
        elif isinstance(event, CgSample):
            self._wheels.set_cg(event)
        elif isinstance(event, Scan) and self.frames.admit(event):
            self._empty_scans += not len(event.points)
            self._tilt.see(event)
            # one that was overtaken goes where it belongs, if that still waits
            self._scans.insert(bisect.bisect_right(self._scans, event.middle_ns, key=lambda scan: scan[0]), (event.middle_ns, event))
        yield from self._ready(is_last=False)

    @property
    def is_waiting(self) -> bool:
        """A scan waits until the wheels are heard up to it."""
        return bool(self._scans)

    def finish(self) -> Iterator[Step]:
        """The steps that were still waiting when the log ended."""
        yield from self._ready(is_last=True)

    def notes(self) -> list[str]:
        """What was found amiss with the sensors on the way."""
        said = self._gyro.notes()
        if self._empty_scans:
            said.append(f"{self._empty_scans} scan{'s' * (self._empty_scans > 1)} without a usable point: the wheels carried on alone.")
        if self._late_scans:
            said.append(f"{self._late_scans} scan{'s' * (self._late_scans > 1)} came after later ones and could not be used.")
        if self._has_turned:
            said.append(
                f"{self._timeless} scan{'s' * (self._timeless > 1)} without the times of their points, taken as seen at once: if the "
                "scanner sweeps, turns bend them. Have its driver tell the times (time_increment of a scan, a field of a cloud)."
            )
        if self._deaf_s > 0.0:
            said.append(f"no wheels were heard for {self._deaf_s:.1f} s in all: there the motion is a guess with a wide covariance.")
        return [*said, *self._tilt.notes(), *self.frames.notes()]

    def _ready(self, is_last: bool) -> Iterator[Step]:
        while (end := self._next_end(is_last)) is not None:
            end_ns, scan = end
            start_ns = end_ns if self._start_ns is None else self._start_ns
            if end_ns < start_ns:  # a scan of the time before: going back would count the motion since then twice
                self._late_scans += 1
                continue
            self._start_ns = end_ns
            yield self._step(start_ns, end_ns, scan)

    def _next_end(self, is_last: bool) -> tuple[int, Scan | None] | None:
        """Where the next step ends, and the scan there; None while there is more to wait for, which ``is_last`` says will not come."""
        if self._scans:
            middle_ns, _ = self._scans[0]
            is_late = self._now_ns > middle_ns + self.config.wait_s / _NS
            return self._scans.popleft() if is_last or is_late or self._has_rates_until(middle_ns) else None
        if self._start_ns is None or self._wheels.newest_ns is None:
            return None
        end_ns = self._wheels.newest_ns - round(self.clock_offset_s / _NS)
        if self._has_lidar:
            least = self.config.max_step_s + (0.0 if is_last else self.config.wait_s)
            return None if end_ns - self._start_ns < least / _NS else (self._start_ns + round(self.config.max_step_s / _NS), None)
        # the gyro's clock may be ahead of the wheels': where its last rate stood for what it has not said yet, the two could not tell
        gyro_ns = self._gyro.newest_ns
        if gyro_ns is not None and not is_last and self._now_ns <= gyro_ns + self.config.wait_s / _NS:
            end_ns = min(end_ns, gyro_ns)
        least = _NS if is_last else self.config.no_lidar_step_s
        return None if end_ns - self._start_ns < least / _NS else (end_ns, None)

    def _has_rates_until(self, stamp_ns: int) -> bool:
        """Of the wheels, and of a gyro that is not silent: which of them comes first must not matter."""
        known_ns, gyro_ns = self._wheels.told_ns, self._gyro.newest_ns
        is_gyro_known = gyro_ns is None or gyro_ns >= stamp_ns or self._now_ns > gyro_ns + self.config.wait_s / _NS
        return is_gyro_known and known_ns is not None and known_ns >= stamp_ns + self.clock_offset_s / _NS

    def _step(self, start_ns: int, end_ns: int, scan: Scan | None) -> Step:
        shift = round(self.clock_offset_s / _NS)
        dt, rates, cg, missing = self._wheels.window(start_ns + shift, end_ns + shift, self.config.max_hold_s)
        motion, d_clock, last = self._integrate(start_ns + shift, dt, rates, cg)
        if start_ns == end_ns:  # the first scan of a drive: its sweep needs a twist
            rates, cg = self._wheels.at(end_ns + shift, self.config.max_hold_s)
            last = self._model.twist(rates, cg, self.params).value.sum(axis=0)
        is_standing = bool(len(dt)) and missing == 0.0 and not rates.any()
        has_wheels = missing == 0.0 and bool(len(rates))
        motion = self._widen(motion, missing, has_rates=bool(len(dt)))
        turn = self._gyro.turn(start_ns, end_ns, float(motion.delta[2])) if end_ns > start_ns else None
        if scan is not None and len(scan.points) and not len(scan.offsets):
            self._timeless += 1
            self._has_turned |= bool(motion.delta[2])
        if has_wheels:
            self._speed = np.array([float(np.hypot(last[0], last[1])), abs(float(last[2]))])
        else:
            last = np.array([0.0, 0.0, 0.0 if turn is None else turn.angle / turn.duration])
        return Step(start_ns, end_ns, motion, d_clock, last, is_standing, has_wheels, turn, scan)

    def _integrate(self, start_ns: int, dt: FloatArray, rates: FloatArray, cg: FloatArray) -> tuple[Motion, FloatArray, FloatArray]:
        """Motion of the wheels over the intervals, its derivative by the wheels' clock (3,), and the twist (3,) at the end.

        A window that is late by c has motion exp(-c twist_before) delta exp(c twist_end): the derivative is the twist just before the end
        less that just before the start, seen from the end. It is not zero where each window has one wheel sample.
        """
        if not len(dt):
            return Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, len(self.params)))), np.zeros(3), np.zeros(3)
        before, before_cg = self._wheels.at(start_ns - 1, self.config.max_hold_s)
        n = len(before)
        twist = self._model.twist(np.vstack([before, rates]), np.vstack([before_cg, cg]), self.params)
        cg_cov = self._wheels.cg_cov
        inside = Twist(twist.value[n:], twist.d_wheels[n:], twist.d_cg[n:], twist.d_params[n:])
        motion = integrate_twists(dt, inside, self._robot.wheel_noise, cg_cov if cg_cov.any() else None)
        first, last = twist.value[0], twist.value[-1]
        return motion, last - se2.adjoint(se2.inverse(motion.delta)) @ first, last

    def _widen(self, motion: Motion, missing_s: float, has_rates: bool) -> Motion:
        """``motion`` with the covariance of a velocity that is unknown for ``missing_s`` [s] of it, and lasts.

        Such a velocity takes the robot as far as the time, however that is cut into steps. It may be as large as the last that was known.
        """
        before, self._lost_s = self._lost_s, missing_s + (0.0 if has_rates else self._lost_s)
        if not missing_s:
            return motion
        self._deaf_s += missing_s
        v = max(self.config.lost_speed_m_s, float(self._speed[0]))
        w = max(self.config.lost_rate_rad_s, float(self._speed[1]))
        grown = np.diag([v, v, w]) ** 2 * ((before + missing_s) ** 2 - before**2)
        return Motion(motion.delta, motion.cov + grown, motion.d_params)


def steps(events: Iterable[Event], synchronizer: Synchronizer) -> Iterator[Step]:
    """All steps of a stream of events. `Synchronizer.clock_offset_s` may be changed between two of them."""
    for event in events:
        yield from synchronizer.push(event)
    yield from synchronizer.finish()
