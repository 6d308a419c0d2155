"""Synchronize events: intervals between scans, and for each the preintegrated wheels, the gyro's turn and the scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from localization.events import CgSample, Event, ImuSample, Scan, Step, StepInterval, Turn, WheelSample, turn_twist
from localization.inputs.inertial import InertialSensors
from localization.inputs.scan_queue import ScanQueue
from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_gaps import UnknownVelocity
from localization.inputs.wheel_motion import WheelMotion
from localization.messages import Message
from motion_models.base import MotionModel
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_SCAN_WAIT_NS = 1_000_000_000
"""Wait for the first scan after the first wheel sample [ns]; later, the drive starts by wheels alone."""

_WAIT_PERIODS = 1.5
"""For how many periods of the wheels a scan waits for their next sample, where that is longer than the settings' time."""


class Synchronizer:
    """Cuts a stream of events into steps: `insert` an event, then take each `next_interval` and `preintegrate` it.

    Streaming and bounded: a scan waits until wheel data reach its stamp, or for at most `StepConfig.wait_s`.
    """

    def __init__(self, model: MotionModel, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: StepConfig | None = None):
        self.config = c = config or StepConfig()
        has_slopes = c.slopes and model.traits.is_level
        self.wheels = WheelMotion(model, robot, c.max_hold_s, c.unknown_sigma, has_slopes)
        """Wheel samples, and the motion model."""
        self.inertial = InertialSensors(robot, mounts, has_slopes)
        """Gyro and vertical."""
        if c.planar is False:
            self.inertial.measure_in_space()
        self.scans = ScanQueue(mounts)
        """Scans that wait."""
        self._velocity = UnknownVelocity(c.unknown_sigma)  # in gaps of the wheel data
        self._has_lidar = has_lidar
        self._wait_ns = round(c.wait_s * 1e9)
        self._start_ns: int | None = None  # of the next step
        self._now_ns = -(1 << 62)  # newest stamp of all events
        self._clock_offset_ns = 0

    def feed_back(self, params: FloatArray | None, clock_offset_s: float, *, is_pose_measured: bool = False) -> None:
        """Use what the estimator has found from the next step on: ``params`` (k,) of the motion model (None: unchanged), and by how much
        the wheels' stamps are late, ``clock_offset_s`` [s]: what happened at t is stamped t + offset.

        Where a matched scan has measured the pose, an unknown velocity in a gap of the wheel data acts only from here on.
        """
        if params is not None:
            self.wheels.params = params
        self._clock_offset_ns = round(clock_offset_s * 1e9)
        if is_pose_measured:
            self._velocity.lasted_s = 0.0

    def insert(self, event: Event) -> None:
        """Store ``event`` in the buffer of its sensor."""
        self._now_ns = max(self._now_ns, event.stamp_ns)
        if isinstance(event, WheelSample):
            self.wheels.buffer.insert(event)
            self._wait_ns = round(max(self.config.wait_s, _WAIT_PERIODS * self.wheels.buffer.period_s) * 1e9)
            if self._start_ns is None and not self._has_lidar and not self.scans.waiting:
                self._start_ns = event.stamp_ns
        elif isinstance(event, ImuSample):
            self.inertial.insert(event)
        elif isinstance(event, CgSample):
            self.wheels.buffer.set_cg(event)
        elif isinstance(event, Scan):
            self.scans.insert(event, used_until_ns=self._start_ns)

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """By the gyro's samples so far, as `GyroBuffer.turn`; changes nothing."""
        return self.inertial.gyro.turn(start_ns, end_ns, by_wheels=0.0) if end_ns > start_ns else None

    def warnings(self) -> list[Message]:
        """Problems of the sensors so far."""
        scans = self.scans
        of_scans = [*scans.faulty.warnings(), *scans.ground.warnings(), *scans.choice.warnings()]
        return [*self.inertial.warnings(), *of_scans, *self._velocity.warnings(), *scans.frames.warnings()]

    def next_interval(self, is_last: bool) -> StepInterval | None:
        """The next step's time, or None while it must wait for more events; with ``is_last`` no more will come."""
        if self.scans.waiting:
            end_ns, scan = self.scans.waiting[0]
            is_late = self._now_ns > end_ns + self._wait_ns
            if not (is_last or is_late or self._has_rates_until(end_ns)):
                return None
            self.scans.waiting.popleft()
        else:
            end, scan = self._end_without_scan(is_last), None
            if end is None:
                return None
            end_ns = end
        start_ns, self._start_ns = end_ns if self._start_ns is None else self._start_ns, end_ns
        return StepInterval(start_ns, end_ns, scan)

    def _end_without_scan(self, is_last: bool) -> int | None:
        """End of a step while no scan waits, or None."""
        first_ns, newest_ns = self.wheels.buffer.first_ns, self.wheels.buffer.newest_ns
        if self._start_ns is None and first_ns is not None and (is_last or self._now_ns > first_ns + _SCAN_WAIT_NS):
            self._start_ns = first_ns
        if self._start_ns is None or newest_ns is None:
            return None
        end_ns = newest_ns - self._clock_offset_ns
        if self._has_lidar:
            end_ns = min(end_ns, self._now_ns)  # wheels stamped too early must not overtake a scan that is still to come
            step_ns = round(self.config.max_step_s * 1e9)
            least_ns = step_ns if is_last else step_ns + self._wait_ns
            if end_ns - self._start_ns < least_ns:
                return None
            step_end_ns = self._start_ns + step_ns + self._clock_offset_ns
            sample_ns = self.wheels.buffer.end_of_interval(step_end_ns)  # within a longer interval the motion is not known as well
            is_within = sample_ns is not None and self.wheels.buffer.period_s > self.config.max_step_s
            return (sample_ns if is_within and sample_ns is not None else step_end_ns) - self._clock_offset_ns
        # the gyro's clock may be ahead of the wheels': holding its last rate would hide the offset between the two clocks
        gyro_ns = self.inertial.gyro.newest_ns
        if gyro_ns is not None and not is_last and self._now_ns <= gyro_ns + self._wait_ns:
            end_ns = min(end_ns, gyro_ns)
        least_ns = 1 if is_last else round(self.config.no_lidar_step_s * 1e9)
        return None if end_ns - self._start_ns < least_ns else end_ns

    def _has_rates_until(self, stamp_ns: int) -> bool:
        """Whether the rates of the wheels, and of a gyro that is not silent, are known until ``stamp_ns``: which of them comes first must
        not matter."""
        known_ns, gyro_ns = self.wheels.buffer.rates_known_until_ns, self.inertial.gyro.newest_ns
        is_gyro_known = gyro_ns is None or gyro_ns >= stamp_ns or self._now_ns > gyro_ns + self._wait_ns
        return is_gyro_known and known_ns is not None and known_ns >= stamp_ns + self._clock_offset_ns

    def preintegrate(self, interval: StepInterval) -> Step:
        """The wheels' motion, the gyro's turn and the scan of ``interval``."""
        start_ns, end_ns, scan = interval
        shift, attitude = self._clock_offset_ns, self.inertial.attitude
        window = self.wheels.buffer.window(start_ns + shift, end_ns + shift, self.config.max_hold_s)
        rates, missing = window.rates, window.missing
        tilt = None if attitude is None else attitude.advance(end_ns, window.dt, rates)
        if scan is not None and attitude is not None and tilt is not None:
            scan = self.scans.ground.leave_out(scan, attitude.curvature)
        motion, d_clock, last = self.wheels.integrate(start_ns + shift, window, tilt)
        if start_ns == end_ns:  # the first scan of a drive: its sweep needs a twist
            rates, last = self.wheels.twist_at(end_ns + shift)
        is_standing = bool(len(window.dt)) and missing == 0.0 and not rates.any()
        has_wheels = missing == 0.0 and bool(len(rates))
        turn, body_turn, gravity = self.inertial.measure(start_ns, end_ns, by_wheels=float(motion.delta[2]), scan=scan)
        self._velocity.known_m2 += motion.cov[0, 0] + motion.cov[1, 1]
        if missing:
            motion = replace(motion, cov=motion.cov + self._velocity.increment(missing, has_turn=turn is not None))
        if missing < (end_ns - start_ns) * 1e-9:  # wheels measured the velocity in this step
            self._velocity.lasted_s = missing
        if has_wheels:
            self._velocity.measured = last
        if scan is not None and len(scan.points) and not len(scan.offsets):
            self.scans.faulty.timeless += 1
            self.scans.faulty.has_turned |= bool(motion.delta[2])
        twist = last if has_wheels else turn_twist(turn)
        cg_cov = self.wheels.buffer.cg_cov
        step = Step(start_ns, end_ns, motion, d_clock, twist, is_standing, has_wheels, turn, scan, cg_cov, body_turn, gravity)
        if attitude is None or not attitude.is_tilt_ambiguous or is_standing or scan is None or not scan.is_planar:
            return step
        self.scans.ground.held += 1
        return step.without_scan()  # its beams may be on the ground
