"""From events to steps: between two moments, what the wheels predict and what the gyro and the LiDAR measured."""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import CgSample, Event, ImuSample, Scan, WheelSample
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.integrate import integrate_twists
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_NS = 1e-9


@dataclass(frozen=True)
class StepConfig:
    """How the time between events is cut into steps."""

    max_step_s: float = 0.25
    """A step ends at a scan; where none comes for this long, it ends without one [s]."""
    no_lidar_step_s: float = 0.05
    """Length of steps in a log without a LiDAR, at least [s]; they end at wheel samples."""
    wait_s: float = 0.3
    """How long a scan waits for the wheel samples around it before it is used without them [s]."""
    max_hold_s: float = 0.5
    """For how long the last wheel rates are believed when no more come [s]."""
    lost_speed_m_s: float = 0.5
    """How fast the robot may move while no wheels are heard: sigma [m/s]."""
    lost_rate_rad_s: float = 0.5
    """How fast it may turn meanwhile: sigma [rad/s]."""


@dataclass(frozen=True)
class Turn:
    """Yaw about the body's z axis, summed up from a gyro; its bias is still in it."""

    angle: float
    """[rad]"""
    variance: float
    """[rad^2], of white noise and scale; without the bias."""
    duration: float
    """Time that the bias acted [s]."""


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
    """(3,) body twist at the end, by the wheels."""
    is_standing: bool
    """No wheel moved during the step."""
    has_wheels: bool
    """Wheels were heard during all of the step."""
    turn: Turn | None = None
    scan: Scan | None = None

    @property
    def duration(self) -> float:
        """[s]"""
        return (self.end_ns - self.start_ns) * _NS


class WheelHistory:
    """The last seconds of wheel motion as intervals of constant rates, with the centre of gravity that held in each."""

    def __init__(self, cg: FloatArray, keep_s: float = 10.0) -> None:
        self._cg, self._cg_cov = cg, np.zeros((2, 2))
        self._keep_ns = int(keep_s / _NS)
        self._last: WheelSample | None = None
        self._ends: list[int] = []
        self._intervals: list[tuple[int, float, float, float, float]] = []  # start_ns, q_l, q_r, x_G, y_G

    @property
    def newest_ns(self) -> int | None:
        return None if self._last is None else self._last.stamp_ns

    def set_cg(self, sample: CgSample) -> None:
        self._cg, self._cg_cov = sample.position, sample.covariance

    @property
    def cg_cov(self) -> FloatArray:
        return self._cg_cov

    def push(self, sample: WheelSample) -> None:
        last, self._last = self._last, sample
        if last is None or sample.stamp_ns <= last.stamp_ns:
            return
        rates = (sample.position - last.position) / ((sample.stamp_ns - last.stamp_ns) * _NS)
        if not np.isfinite(rates).all():
            rates = np.nanmean([last.velocity, sample.velocity], axis=0)
        if not np.isfinite(rates).all():
            return
        self._ends.append(sample.stamp_ns)
        self._intervals.append((last.stamp_ns, rates[0], rates[1], self._cg[0], self._cg[1]))
        if self._ends[0] < sample.stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._ends, sample.stamp_ns - self._keep_ns)
            del self._ends[:n], self._intervals[:n]

    def window(self, start_ns: int, end_ns: int, max_hold_s: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Intervals (n,) [s], rates (n, 2), CG (n, 2) from ``start_ns`` to ``end_ns``, and the seconds that nothing is known of.

        Past the newest sample the last rates hold for at most ``max_hold_s``.
        """
        rows: list[tuple[float, float, float, float, float]] = []
        known = start_ns
        for i in range(bisect.bisect_right(self._ends, start_ns), len(self._ends)):
            begin, q_l, q_r, x, y = self._intervals[i]
            begin, end = max(begin, known), min(self._ends[i], end_ns)
            if end <= begin:
                break
            rows.append(((end - begin) * _NS, q_l, q_r, x, y))
            known = end
        covered = sum(row[0] for row in rows)
        if known < end_ns and self._ends:
            _, q_l, q_r, x, y = self._intervals[-1]
            hold = min(end_ns, self._ends[-1] + int(max_hold_s / _NS)) - max(known, self._ends[-1])
            if hold > 0:
                rows.append((hold * _NS, q_l, q_r, x, y))
                covered += hold * _NS
        table = np.array(rows).reshape(-1, 5)
        missing = max((end_ns - start_ns) * _NS - covered, 0.0)
        return table[:, 0], table[:, 1:3], table[:, 3:5], missing if missing > 1e-6 else 0.0


class GyroHistory:
    """The last seconds of the yaw rate, in the body frame."""

    def __init__(self, robot: Robot, mounts: Mapping[str, Mount], keep_s: float = 10.0) -> None:
        self._noise, self._mounts = robot.gyro_noise, mounts
        self._keep_ns = int(keep_s / _NS)
        self._stamps: list[int] = []
        self._angles: list[float] = []

    def push(self, sample: ImuSample) -> None:
        mount = self._mounts.get(sample.frame_id)
        rate = float((mount.rotation() @ sample.angular_velocity)[2]) if mount else float(sample.angular_velocity[2])
        if self._stamps and sample.stamp_ns - self._stamps[-1] > 0.5 / _NS:
            self._stamps.clear(), self._angles.clear()
        if self._stamps:
            dt = (sample.stamp_ns - self._stamps[-1]) * _NS
            self._angles.append(self._angles[-1] + 0.5 * (self._rate + rate) * dt)
        else:
            self._angles.append(0.0)
        self._rate = rate
        self._stamps.append(sample.stamp_ns)
        if self._stamps[0] < sample.stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._stamps, sample.stamp_ns - self._keep_ns)
            del self._stamps[:n], self._angles[:n]

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """The turn from ``start_ns`` to ``end_ns``, or None where the gyro was not heard from before its start to (nearly) its end."""
        if not self._stamps or start_ns < self._stamps[0] or end_ns > self._stamps[-1] + 0.1 / _NS:
            return None
        angle = self._angle(end_ns) - self._angle(start_ns)
        dt = (end_ns - start_ns) * _NS
        variance = self._noise.white_rad_per_sqrt_s**2 * dt + (self._noise.scale_sigma * angle) ** 2
        return Turn(angle, variance, dt)

    def _angle(self, stamp_ns: int) -> float:
        past = stamp_ns - self._stamps[-1]
        if past > 0:
            return self._angles[-1] + self._rate * past * _NS
        i = max(bisect.bisect_left(self._stamps, stamp_ns), 1)
        if i >= len(self._stamps):
            return self._angles[-1]
        part = (stamp_ns - self._stamps[i - 1]) / (self._stamps[i] - self._stamps[i - 1])
        return self._angles[i - 1] + part * (self._angles[i] - self._angles[i - 1])


class Stepper:
    """Cuts a stream of events into steps. Give it events with `push`; then take all steps that are ready.

    Streaming and bounded: a scan waits until the wheels and the gyro around it were heard, or for at most `StepConfig.wait_s`.
    """

    def __init__(self, model: MotionModel, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: StepConfig | None = None):
        self.config = config or StepConfig()
        self._model, self._robot, self._params = model, robot, model.nominal
        self._wheels = WheelHistory(robot.center_of_gravity)
        self._gyro = GyroHistory(robot, mounts)
        self._has_lidar, self._has_gyro = has_lidar, False
        self._scans: deque[Scan] = deque()
        self._start_ns: int | None = None
        self._now_ns = -(1 << 62)
        self.clock_offset_s = 0.0
        """The wheels' stamps are early by this much [s]: estimated by the filter, and used from the next step on."""

    def push(self, event: Event) -> Iterator[Step]:
        """Take ``event`` and yield the steps that it completes."""
        self._now_ns = max(self._now_ns, event.stamp_ns)
        if isinstance(event, WheelSample):
            self._wheels.push(event)
            if self._start_ns is None and not self._has_lidar:
                self._start_ns = event.stamp_ns
        elif isinstance(event, ImuSample):
            self._gyro.push(event)
            self._has_gyro = True
        elif isinstance(event, CgSample):
            self._wheels.set_cg(event)
        elif isinstance(event, Scan):
            self._scans.append(event)
        while (end := self._next_end()) is not None:
            end_ns, scan = end
            if self._start_ns is None or end_ns <= self._start_ns:
                self._start_ns = end_ns
                yield self._step(end_ns, end_ns, scan)
            else:
                start_ns, self._start_ns = self._start_ns, end_ns
                yield self._step(start_ns, end_ns, scan)

    def finish(self) -> Iterator[Step]:
        """The steps that were still waiting when the log ended."""
        while self._scans:
            scan = self._scans.popleft()
            start_ns = scan.stamp_ns if self._start_ns is None else self._start_ns
            self._start_ns = scan.stamp_ns
            yield self._step(start_ns, scan.stamp_ns, scan)

    def _next_end(self) -> tuple[int, Scan | None] | None:
        if self._scans:
            scan = self._scans[0]
            if self._is_heard(scan.stamp_ns) or self._now_ns > scan.stamp_ns + self.config.wait_s / _NS:
                return scan.stamp_ns, self._scans.popleft()
            return None
        if self._start_ns is None or self._wheels.newest_ns is None:
            return None
        end_ns = self._wheels.newest_ns - round(self.clock_offset_s / _NS)
        least = self.config.max_step_s + self.config.wait_s if self._has_lidar else self.config.no_lidar_step_s
        if end_ns - self._start_ns < least / _NS:
            return None
        return (self._start_ns + round(self.config.max_step_s / _NS), None) if self._has_lidar else (end_ns, None)

    def _is_heard(self, stamp_ns: int) -> bool:
        wheels = self._wheels.newest_ns
        return wheels is not None and wheels >= stamp_ns + self.clock_offset_s / _NS

    def _step(self, start_ns: int, end_ns: int, scan: Scan | None) -> Step:
        shift = round(self.clock_offset_s / _NS)
        dt, rates, cg, missing = self._wheels.window(start_ns + shift, end_ns + shift, self.config.max_hold_s)
        twist = self._model.twist(rates, cg, self._params)
        cg_cov = self._wheels.cg_cov
        motion = integrate_twists(dt, twist, self._robot.wheel_noise, cg_cov if cg_cov.any() else None)
        d_clock, last = np.zeros(3), np.zeros(3)
        if len(dt):
            first, last = twist.value[0], twist.value[-1]
            d_clock = last - se2.adjoint(se2.inverse(motion.delta)) @ first
        if missing:
            lost = np.array([self.config.lost_speed_m_s, self.config.lost_speed_m_s, self.config.lost_rate_rad_s]) * missing
            motion = Motion(motion.delta, motion.cov + np.diag(lost**2), motion.d_params)
        standing = bool(len(dt)) and missing == 0.0 and not rates.any()
        turn = self._gyro.turn(start_ns, end_ns) if self._has_gyro and end_ns > start_ns else None
        return Step(start_ns, end_ns, motion, d_clock, last, standing, missing == 0.0, turn, scan)


def steps(events: Iterable[Event], stepper: Stepper) -> Iterator[Step]:
    """All steps of a stream of events. `Stepper.clock_offset_s` may be changed between two of them."""
    for event in events:
        yield from stepper.push(event)
    yield from stepper.finish()
