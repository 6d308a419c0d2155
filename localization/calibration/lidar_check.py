"""Mount and clock of a LiDAR against wheels and gyro, before a log is replayed.

A turned LiDAR travels in another direction than the wheels, and turns alike; wheels that count backwards turn the other way as well. That
decides between the two. Healthy mounts are recognised after a metre of driving, yaws of a slide's size after three metres straight ahead.
One that turns opposite to wheels and gyro is upside down; of the three sensors one may turn later than the two others, by another clock;
wheels that turn later than a LiDAR alone are brought to its clock, and the covariance has the way in that time. The drive is read until it
has turned.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from localization.calibration.lidar_turns import GyroHeading, LidarTurns, compare_clocks, compare_turns
from localization.calibration.wheel_signals import MAX_SLIDE_RAD, MIN_COHERENCE
from localization.calibration.wheel_units import CORRECTED
from localization.calibration.wheel_wiring import WiringReport, open_checked
from localization.events import Event, ImuSample, Scan, WheelSample
from localization.lidar import LidarConfig
from localization.logs import Log, TopicOverrides, open_log
from localization.sensor_checks.clocks import apart_message
from localization.sensor_checks.scan_motion import ScanOdometry, profile_of
from motion_models import se2
from motion_models.robot import Clock, Mount, Robot
from motion_models.se2 import FloatArray, Pose2

_INTERVAL_S = 0.5
_MIN_WAY_M = 0.03
"""By the wheels in an interval, for its direction to count: scans err by millimetres."""
_MAX_CURVATURE_RAD_M = 0.6
"""Sharper turns slide sideways."""
_SURE_WAY_M, _MAX_S, _MAX_SCANS = 1.0, 60.0, 1200
"""Way after which a mount is healthy, and the longest that is read [s from the first motion; scans in all]."""
_SCANS_PER_RESULT = 10  # after that way
_STRAIGHT_RAD_M, _STRAIGHT_WAY_M, _CERTAIN_WAY_M, _MIN_STRAIGHT = 0.2, 3.0, 10.0, 6
"""Largest curvature of straight driving, its least way and intervals, and the way [m] after which a yaw is certain. A centre of
rotation 0.1 m off turns the direction by 1 degree there."""
_FAR_RAD, _MIN_NEAR = math.radians(10.0), 0.8
"""Direction of an interval's travel against the usual one, from where on its scans were matched to the wrong place, as along a corridor,
and the least share of the others."""
_HEALTHY_RAD, _MIN_YAW_RAD, _MAX_YAW_SIGMA_RAD = math.radians(3.5), math.radians(5.0), math.radians(1.0)
"""Direction of travel that is healthy, the least in straight driving that is a wrong yaw, and its largest standard error. After 3 m, it is
2.8 degrees at most in 17 parts of three buildings and on 25 simulated drives."""
_YAW_SIGMA_RAD = math.radians(1.5)
"""Standard error of a yaw that is named: of 6 to 18 degrees, 24 simulated drives on a floor that shears have 0.6 left (root mean
square; `tests.studies.lidar_mounts`), and ten parts of fr079, MIT-CSAIL and ACES 1.2, at most 2.2."""
_MAX_WAY_CHANGE = 0.08
"""Largest logarithm of the way by scans over that by wheels, for a yaw or a shift of its mount to be one: -0.05 to 0.03 in healthy
parts of fr079 and MIT-CSAIL and on 25 simulated drives. Beams on the robot, 30 % of all, turn the direction by 11 degrees; the logarithm
is -0.14."""
_MAX_LATE_M, _MAX_SLIP = 0.08, 0.15
"""Largest difference of the ways by wheels and LiDAR [m], and its growth with the way by slip and tyres: a latency of 0.1 s has less up to
some m/s, one of 0.35 s more from 0.35 m/s on."""
_MAX_START_NS = 600_000_000
"""Longest time from the first motion of the wheels to the stamp of the first scan after it, of LiDARs that are on."""
_MIN_PART = 0.15
"""Smallest part of the way on each side of a change of the mount."""
_SNAP_RAD = math.radians(4.0)
"""LiDARs are mounted by quarter turns: an estimate that is so near to one is that."""
_MAX_PASSES = 3
"""A yaw, a place and a clock may all be wrong; each shows when what was found before is corrected."""
_MIN_LEVEL = 0.5
"""Least vertical component of the axis of a planar LiDAR: beyond 60 degrees of tilt it measures no motion along the floor."""
_MIN_TURN_RAD, _MIN_TURN_LIKENESS = 0.3, 0.6
_SHIFT_TURN_RAD, _SHIFT_SIGMAS, _MIN_SHIFT_M, _CERTAIN_SHIFT_M = 1.0, 3.0, 0.15, 0.05
"""Turns in all that show where along the robot a LiDAR is, the standard errors by which its place is beyond every point about which the
robot may turn, the least distance from its mount that is named, and the standard error from where on no more driving is read [m]."""
_SLIDE_SIGMA_S, _MIN_SIDEWAYS_M = 0.1, 0.004
"""Sideways speed in a curve over v wz: -0.12 s on the Husky of tests/data/drive-husky, 0.02 to 0.09 by `slip_at_speed`; and the least
standard deviation of an interval's sideways motion by scans."""


@dataclass(frozen=True)
class LidarFinding:
    """A LiDAR whose mount or clock is wrong."""

    text: str
    """What was found, in a sentence."""
    frame: str
    mount: Mount | None
    """The mount that is used in place of the log's; None where other causes are as likely."""
    is_certain: bool = False
    """More driving would not change it."""
    clock: Clock | None = None
    """The clocks that are used in place of the robot file's, where that of LiDAR, gyro or wheels is another than the two others', or where
    those of wheels and LiDAR are apart."""

    @property
    def is_corrected(self) -> bool:
        """Whether mount or clock are others in what follows; else it is named alone."""
        return self.mount is not None or self.clock is not None


@dataclass
class _Travel:
    """Motion of one LiDAR, interval by interval."""

    odometry: ScanOdometry = field(default_factory=ScanOdometry)
    begin_ns: int = 0
    delta: Pose2 | None = None
    """(3,) by the scans since ``begin_ns``, NaN for a way that the scene does not show; None before the first."""
    rows: list[tuple[int, int, Pose2]] = field(default_factory=list)
    arcs: list[FloatArray] = field(default_factory=list)
    """For each of ``rows``, (2,): sideways motion of a point that moves straight ahead alone, by the ways and turns from scan to scan [m],
    and the integral of v wz over time [m rad/s]."""
    arc: FloatArray = field(default_factory=lambda: np.zeros(2))
    """That since ``begin_ns``."""
    last_ns: int = 0


class LidarCheck:
    """`add` the events of a drive until `is_done`; then `result` is what they show."""

    def __init__(self, mounts: Mapping[str, Mount], robot: Robot, topic: str, has_gyro: bool = False, is_clock_known: bool = False) -> None:
        """``topic``: of the scans, for the sentence. ``has_gyro``: one whose turns are to be compared as well. ``is_clock_known``: do not
        compare clocks."""
        self._mounts, self._robot, self._topic, self._is_clock_known = mounts, robot, topic, is_clock_known
        self._radius_m = robot.geometry.wheel_radius_m
        self._gyro = GyroHeading(mounts) if has_gyro else None
        self._wheels: list[WheelSample] = []
        self._travels: dict[str, _Travel] = defaultdict(_Travel)
        self._on_edge: set[str] = set()
        self._config = LidarConfig()
        self._moving_ns: int | None = None
        self._scans, self._next_scan, self._way_m = 0, 0, 0.0
        self.contradicted_way_m = 0.0
        """Half the largest distance between the ways by wheels and LiDAR since the start, while one travels in another direction than they
        do; what one lags behind them [m]; else 0."""
        self.is_done = False
        """The mount agrees, or is certainly wrong, or a minute has passed."""

    @property
    def has_moved(self) -> bool:
        """Whether the wheels have turned so far."""
        return self._moving_ns is not None

    def add(self, event: Event) -> None:
        """Take the next event."""
        if isinstance(event, WheelSample):
            self._add_wheels(event)
        elif isinstance(event, ImuSample) and self._gyro is not None:
            self._gyro.add(event)
        elif isinstance(event, Scan) and self.has_moved:
            self._scans += 1
            travel = self._travel_of(event)
            intervals = len(travel.rows)
            _register(travel, event, self._mounts.get(event.frame_id, Mount()), self._config)
            if self._scans == 1 and self._moving_ns is not None and travel.begin_ns - self._moving_ns < _MAX_START_NS:
                travel.begin_ns = min(travel.begin_ns, self._moving_ns)  # where it stood until now, whatever this scan's stamp
            if len(travel.rows) > intervals:
                self.contradicted_way_m = self._contradicted_m(event.frame_id)
            if self._way_m > _SURE_WAY_M and self._scans >= self._next_scan:
                self._next_scan = self._scans + _SCANS_PER_RESULT
                is_healthy = all(self._is_healthy(frame) for frame in self._travels)
                self.is_done |= is_healthy or ((found := self.result()) is not None and found.is_certain)
        is_late = self._moving_ns is not None and event.stamp_ns > self._moving_ns + _MAX_S * 1e9
        self.is_done |= is_late or self._scans > _MAX_SCANS

    def _travel_of(self, scan: Scan) -> _Travel:
        """Travel of the sensor of ``scan``; a planar one whose plane stands on edge by its transform is taken as level."""
        frame = scan.frame_id
        mount = self._mounts.get(frame)
        if frame not in self._travels and mount is not None and scan.is_planar and abs(mount.rotation[2, 2]) < _MIN_LEVEL:
            self._mounts = {**self._mounts, frame: Mount(mount.x, mount.y, mount.z)}
            self._on_edge.add(frame)
        return self._travels[frame]

    def _add_wheels(self, sample: WheelSample) -> None:
        if self._wheels and self._moving_ns is None:
            self._moving_ns = sample.stamp_ns if _has_moved(self._wheels[0], sample) else None
            self._wheels[1:] = []  # while it stands
        if self._wheels and self.has_moved:
            steps = sample.position - self._wheels[-1].position
            seconds = (sample.stamp_ns - self._wheels[-1].stamp_ns) * 1e-9
            steps = steps if np.isfinite(steps).all() else np.nan_to_num(sample.velocity) * seconds
            self._way_m += abs(float(steps.mean())) * self._radius_m
        self._wheels.append(sample)

    def result(self) -> LidarFinding | None:
        """What was found so far; None where the mount agrees, or the drive does not show it."""
        found = (self._judge_level(frame) for frame in list(self._travels) if frame in self._mounts)
        return next((one for one in found if one is not None), None)

    def _is_healthy(self, frame: str) -> bool:
        direction = _direction(*self._compare(frame)[:2])
        is_known = self._is_clock_known or (self._wheels_late_s(frame) if self._gyro is None else self._by_turns(frame)) is not None
        if direction is None or not is_known or abs(direction) > MAX_SLIDE_RAD or self._shift(frame) is not None:
            return False
        return abs(direction) <= _HEALTHY_RAD or abs(self._straight(frame) or math.pi) <= _HEALTHY_RAD

    def _straight(self, frame: str) -> float | None:
        """Direction of its travel against the wheels' in straight driving [rad]; None for too little of it, or where it or the ways
        differ."""
        by_wheels, by_scans, _ = self._compare(frame, _STRAIGHT_RAD_M)
        if len(by_wheels) < _MIN_STRAIGHT or float(np.abs(by_wheels).sum()) < _STRAIGHT_WAY_M:
            return None
        by_wheels, by_scans = _without_far(by_wheels, by_scans)
        product = by_scans * by_wheels.conj()
        mean = float(np.angle(product.sum()))
        weight = np.abs(product) / np.abs(product).sum()
        apart = np.angle(product * np.exp(-1j * mean))
        sigma = math.sqrt(float(np.sum((weight * apart) ** 2)))
        return mean if sigma < _MAX_YAW_SIGMA_RAD and _is_equally_long(by_wheels, by_scans) else None

    def _shift(self, frame: str) -> tuple[float, float] | None:
        """How far ahead of its mount the LiDAR is, by its sideways motion in turns, and its standard error [m]; None where it may be there.

        A sensor s ahead of where it is taken to be, on a robot that turns by a about a point x ahead of its middle, moves sideways by
        (s - x) sin(a) beside the arc, by its yaw times the way, and by the slide in curves: least squares with priors of yaw and slide.
        Robots turn about a point between their axles.
        """
        travel = self._travels[frame]
        moves = np.array([delta for _, _, delta in travel.rows]).reshape(-1, 3)
        arcs = np.array(travel.arcs).reshape(-1, 2)
        is_shown = np.isfinite(moves).all(axis=1)
        moves, arcs = moves[is_shown], arcs[is_shown]
        if float(np.abs(moves[:, 2]).sum()) < _SHIFT_TURN_RAD:
            return None
        columns, sideways = np.stack([np.sin(moves[:, 2]), arcs[:, 1], moves[:, 0]], axis=1), moves[:, 1] - arcs[:, 0]
        shift, sigma = with_priors(columns, sideways, np.array([math.inf, _SLIDE_SIGMA_S, MAX_SLIDE_RAD]))
        half_m = 0.5 * self._robot.geometry.wheelbase_m
        if abs(shift) - _SHIFT_SIGMAS * sigma < max(_MIN_SHIFT_M, half_m) or not _is_equally_long(*self._compare(frame)[:2]):
            return None
        turns_about_m = float(np.clip(self._robot.models.get("skid_steer", {}).get("x_cr_0", 0.0), -half_m, half_m))
        return shift + turns_about_m, sigma

    def _shifted(self, frame: str) -> LidarFinding | None:
        """A LiDAR that is elsewhere along the robot; None where it is where its mount has it."""
        found, mount = self._shift(frame), self._mounts[frame]
        if found is None:
            return None
        ahead, sigma = found
        right, error_m = round(mount.x + ahead, 3), math.hypot(0.25 * self._robot.geometry.wheelbase_m, sigma)
        text = (
            f"{self._topic}: in turns it moves sideways as a sensor does that is {abs(ahead):.2f} m"
            f" {'ahead of' if ahead > 0.0 else 'behind'} the mount of '{frame}', farther than from any point between the axles, about which"
            f" robots turn: its x is wrong, or the middle of the wheels is not where the body's frame is. Corrected in this run; write x ="
            f" {right:g} m (+- {error_m:.2f}, as the point about which it turns is not known) in /tf_static, or in [mounts.{frame}] where"
            " the log has none."
        )
        return LidarFinding(text, frame, replace(mount, x=right), is_certain=sigma < _CERTAIN_SHIFT_M)

    def _by_turns(self, frame: str) -> LidarTurns | None:
        """Against wheels and gyro; None for too few turns."""
        if self._gyro is None or len(self._wheels) < 2:
            return None
        t, ways = _ways(self._wheels, self._radius_m)
        return compare_turns(self._travels[frame].rows, (t, ways[:, 1] - ways[:, 0]), self._gyro, self._wheels[0].stamp_ns)

    def _wheels_late_s(self, frame: str) -> float | None:
        """Against the LiDAR's stamps [s], without a gyro; None where turns do not show it."""
        if len(self._wheels) < 2:
            return None
        t, ways = _ways(self._wheels, self._radius_m)
        return compare_clocks(self._travels[frame].rows, (t, ways[:, 1] - ways[:, 0]), self._wheels[0].stamp_ns)

    def _contradicted_m(self, frame: str) -> float:
        """The way by the wheels, where it travels in another direction than they do, or the part of it by which that may be off, where the
        angle is small; what it lags behind them, where scans that are late begin to move late; else 0 [m]."""
        by_wheels, by_scans, _ = self._compare(frame)
        if not len(by_wheels):
            return 0.0
        if abs(float(np.angle(np.sum(by_scans * by_wheels.conj())))) > MAX_SLIDE_RAD:
            return self._way_m
        if abs(straight := self._straight(frame) or 0.0) >= _MIN_YAW_RAD:
            return self._way_m * math.sin(0.5 * abs(straight))
        ways = np.abs(by_wheels)
        behind = np.abs(np.cumsum(ways - np.abs(by_scans)))
        is_late = behind > _MAX_LATE_M + _MAX_SLIP * np.cumsum(ways)
        return float(behind[is_late].max(initial=0.0))

    def _compare(self, frame: str, max_curvature: float = _MAX_CURVATURE_RAD_M) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Way of the sensor by the wheels and by the scans (n,) complex [m] on arcs of up to ``max_curvature`` [rad/m], and turns (m, 2) by
        wheels, up to a scale, and scans [rad] of all intervals."""
        mount = self._mounts.get(frame, Mount())
        t, ways = _ways(self._wheels, self._radius_m)
        by_wheels, by_scans, turns = [], [], []
        for begin_ns, end_ns, delta in self._travels[frame].rows:
            edges = np.array([begin_ns - self._wheels[0].stamp_ns, end_ns - self._wheels[0].stamp_ns]) * 1e-9
            if edges[0] < t[0] or edges[1] > t[-1]:
                continue
            left, right = (np.diff(np.interp(edges, t, side))[0] for side in ways.T)
            turn, forward = float(delta[2]), 0.5 * (left + right)
            turns.append((right - left, turn))
            if abs(forward) >= _MIN_WAY_M and abs(turn) <= max_curvature * abs(forward) and math.isfinite(delta[0]):
                lever = (np.exp(1j * turn) - 1.0) * complex(mount.x, mount.y)
                by_wheels.append(forward * np.exp(0.5j * turn) + lever)
                by_scans.append(complex(delta[0], delta[1]) + lever)
        return np.array(by_wheels), np.array(by_scans), np.array(turns).reshape(-1, 2)

    def _judge_level(self, frame: str) -> LidarFinding | None:
        found = self._judge(frame)
        if frame not in self._on_edge:
            return found
        mount = self._mounts[frame] if found is None or found.mount is None else found.mount
        text = (
            f"{self._topic}: by the transform of '{frame}' its plane stands on edge, as of an optical frame (z ahead) or a mount with wrong"
            f" roll or pitch; it is taken as level. Corrected in this run; write roll = {mount.roll:.4f}, pitch = {mount.pitch:.4f}, yaw ="
            f" {mount.yaw:.4f} rad in /tf_static, or in [mounts.{frame}] where the log has none."
        )
        if found is None:
            return LidarFinding(text, frame, mount)  # the travel may still show a yaw
        return replace(found, text=text, mount=mount)

    def _judge(self, frame: str) -> LidarFinding | None:
        mount, by_turns = self._mounts[frame], self._by_turns(frame)
        by_wheels, by_scans, turns = self._compare(frame)
        direction = _direction(by_wheels, by_scans)
        if by_turns is not None and by_turns.late_s and not self._is_clock_known:
            return self._other_clock(frame, by_turns)
        if self._gyro is None and not self._is_clock_known and (late_s := self._wheels_late_s(frame)):
            return self._clocks_apart(frame, late_s)
        if by_turns is not None and by_turns.is_opposite:
            return None if direction is None else self._upside_down(frame, direction)
        straight = self._straight(frame)
        if direction is None:
            direction = straight
        if direction is not None and abs(direction) <= MAX_SLIDE_RAD and (straight is None or abs(straight) < _MIN_YAW_RAD):
            return self._shifted(frame)
        if direction is None:
            return None
        if (turned_rad := _largest_change(*_without_far(by_wheels, by_scans))) > MAX_SLIDE_RAD:
            text = (
                f"{self._topic}: its scans travel {math.degrees(turned_rad):.0f} deg apart before and after some point of the first"
                f" {np.abs(by_wheels).sum():.1f} m: '{frame}' was turned on the way (a bump, a loose mount, a pan joint). Fix its mount."
            )
            return LidarFinding(text, frame, None)
        direction, is_quarter = _snapped(direction if straight is None else straight)
        yaw = math.remainder(mount.yaw - direction, math.tau)
        side = "backwards" if abs(abs(direction) - math.pi) < _SNAP_RAD else f"{abs(math.degrees(direction)):.0f} deg to the "
        side += "" if side == "backwards" else "left" if direction > 0.0 else "right"
        begin = f"{self._topic}: by its scans the robot travels {side} against the wheels over {np.abs(by_wheels).sum():.1f} m"
        likeness = _likeness(turns)
        if likeness is None and side == "backwards":
            return LidarFinding(
                f"{begin}: the yaw of '{frame}' is wrong by 180 deg, or all wheels count backwards; a turn shows which.", frame, None
            )
        if likeness is not None and likeness < _MIN_TURN_LIKENESS:
            return None  # turns differ as well: wheels or an upside-down LiDAR
        where = f"in /tf_static, or in [mounts.{frame}] where the log has none"
        turned = "" if likeness is None else ", and turns as they do"
        within = "" if is_quarter else f" (+- {math.degrees(_YAW_SIGMA_RAD):.1f}, as the robot may slide)"
        text = (
            f"{begin}{turned}: the yaw of '{frame}' is wrong by {abs(math.degrees(direction)):.0f} deg{within}. Corrected in this run by"
            f" {-math.degrees(direction):+.0f} deg; write yaw = {yaw:.4f} rad {where}."
        )
        is_certain = likeness is not None and (is_quarter or self._way_m > _CERTAIN_WAY_M)
        return LidarFinding(text, frame, replace(mount, yaw=yaw), is_certain=is_certain)

    def _upside_down(self, frame: str, direction: float) -> LidarFinding:
        """``direction``: of its travel, by the mount that is assumed: a mirrored sensor's is the sum of the two yaws."""
        mount, (direction, _) = self._mounts[frame], _snapped(direction)
        yaw = math.remainder(direction - mount.yaw, math.tau)
        right = replace(mount, roll=math.remainder(mount.roll + math.pi, math.tau), yaw=yaw)
        text = (
            f"{self._topic}: by its scans the robot turns opposite to wheels and gyro, which agree: '{frame}' is mounted upside down"
            f" against its transform. Corrected in this run; write roll = {right.roll:.4f}, yaw = {yaw:.4f} rad in /tf_static, or in"
            f" [mounts.{frame}] where the log has none."
        )
        return LidarFinding(text, frame, right, is_certain=True)

    def _other_clock(self, frame: str, turns: LidarTurns) -> LidarFinding:
        names = {"lidar": self._topic, "gyro": "the gyro", "wheel": "the wheels"}
        odd = names.pop(turns.sensor)
        key = f"{turns.sensor}_time_offset_s"
        value = round(getattr(self._robot.clock, key) + turns.late_s, 2)
        way = "later" if turns.late_s > 0.0 else "earlier"
        text = (
            f"{odd}: by the stamps its turns are {abs(turns.late_s):.2f} s {way} than those of {' and '.join(names.values())}, which agree:"
            f" the clocks of two computers, or stamps of arrival. {CORRECTED} clock.{key} = {value:g}, or synchronize the clocks."
        )
        return LidarFinding(text, frame, None, is_certain=True, clock=replace(self._robot.clock, **{key: value}))

    def _clocks_apart(self, frame: str, late_s: float) -> LidarFinding:
        """Wheels and LiDAR alone: the wheels' stamps are later by ``late_s`` [s]."""
        clock = self._robot.clock
        right = replace(clock, wheel_time_offset_s=round(clock.wheel_time_offset_s + late_s, 2), sigma_s=abs(late_s))
        text = apart_message("LiDAR", late_s, right.wheel_time_offset_s, round(clock.lidar_time_offset_s - late_s, 2))
        return LidarFinding(text, frame, None, is_certain=True, clock=right)


def check_lidar(log: Log, is_clock_known: bool = False, mounts: Mapping[str, Mount] | None = None) -> LidarFinding | None:
    """Compare the first minute of driving; None where mount and clock agree, unless that ``is_clock_known``, or the drive does not show
    it. ``mounts``: by frame, in place of the log's."""
    if log.sources.lidar is None or log.sources.wheels is None or log.wheels_error is not None:
        return None
    check = LidarCheck(
        log.mounts if mounts is None else mounts, log.robot, log.sources.lidar.topic, log.sources.imu is not None, is_clock_known
    )
    for event in log.events():
        check.add(event)
        if check.is_done:
            break
    return check.result()


@dataclass(frozen=True, eq=False)
class CheckedLog:
    """A log whose wheels, gyro and LiDAR were compared, with what is certain corrected."""

    log: Log
    wiring: WiringReport
    mounts: Mapping[str, Mount]
    """By frame."""
    lidar: tuple[LidarFinding, ...] = ()
    """What is wrong with the LiDAR; the sentences are in `Log.warnings` as well."""


def open_log_checked(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> CheckedLog:  # noqa: B008
    """`open_checked`, and the LiDAR's mount and clock after that. Raises what that does."""
    log, wiring = open_checked(path, robot, topics)
    if wiring.is_ambiguous:
        return CheckedLog(log, wiring, log.mounts)
    mounts, lidar, is_clock_known = log.mounts, list[LidarFinding](), False
    for _ in range(_MAX_PASSES):
        found = check_lidar(log, is_clock_known, mounts)
        if found is None or (not found.is_corrected and any(one.mount is not None for one in lidar)):
            break
        lidar.append(found)
        mounts = corrected(mounts, found)
        if found.clock is not None:
            log, is_clock_known = open_log(path, replace(log.robot, clock=found.clock), topics), True
            log.add_notes(wiring.findings)
        if not found.is_corrected:
            break
    log.add_notes(one.text for one in lidar)
    return CheckedLog(log, wiring, mounts, tuple(lidar))


def _has_moved(first: WheelSample, now: WheelSample) -> bool:
    return bool((np.abs(now.velocity) > 0.02).any() or (np.abs(now.position - first.position) > 0.02).any())


def _register(travel: _Travel, scan: Scan, mount: Mount, config: LidarConfig) -> None:
    """Add the motion since the scan before; an interval ends at the first scan after `_INTERVAL_S`. Where the scene does not show the way,
    the interval has the turn alone."""
    motion = travel.odometry.register(profile_of(scan, mount, config))
    now = scan.middle_ns
    if motion is None or travel.delta is None:
        travel.begin_ns, travel.last_ns, travel.delta, travel.arc = now, now, np.zeros(3), np.zeros(2)
        return
    x, y, turn = motion.delta.tolist() if motion.has_translation else (math.nan, math.nan, float(motion.delta[2]))
    chord_m, speed = x / math.cos(0.5 * turn), x / max((now - travel.last_ns) * 1e-9, 1e-3)
    travel.arc = travel.arc + np.array([chord_m * math.sin(travel.delta[2] + 0.5 * turn), speed * turn])
    travel.delta, travel.last_ns = se2.compose(travel.delta, np.array([x, y, turn])), now
    if now - travel.begin_ns >= _INTERVAL_S * 1e9:
        travel.rows.append((travel.begin_ns, now, travel.delta))
        travel.arcs.append(travel.arc)
        travel.begin_ns, travel.delta, travel.arc = now, np.zeros(3), np.zeros(2)


def _ways(wheels: Sequence[WheelSample], radius_m: float) -> tuple[FloatArray, FloatArray]:
    """Stamps (n,) [s] after the first, and accumulated ways (n, 2) of left and right wheels [m]."""
    t = np.array([sample.stamp_ns - wheels[0].stamp_ns for sample in wheels]) * 1e-9
    angles = np.array([sample.position for sample in wheels])
    if not np.isfinite(angles).all():
        rates = np.nan_to_num(np.array([sample.velocity for sample in wheels]))
        angles = np.vstack([np.zeros((1, 2)), np.cumsum(np.diff(t)[:, None] * rates[:-1], axis=0)])
    return t, angles * radius_m


def _direction(by_wheels: FloatArray, by_scans: FloatArray) -> float | None:
    """Direction of the LiDAR's travel against the wheels' [rad]; None where the drive does not show one."""
    product = by_scans * by_wheels.conj()
    size = float(np.abs(product).sum())
    if float(np.abs(by_wheels).sum()) < 0.5 * _SURE_WAY_M or size == 0.0 or abs(product.sum()) < MIN_COHERENCE * size:
        return None
    return float(np.angle(product.sum()))


def with_priors(columns: FloatArray, values: FloatArray, sigmas: FloatArray) -> tuple[float, float]:
    """First coefficient of the least squares of ``values`` (n,) on ``columns`` (n, k) with priors of mean 0 and ``sigmas`` (k,), and its
    standard error, with the scatter of what is left as noise."""
    noise = _MIN_SIDEWAYS_M
    for _ in range(3):
        covariance = np.linalg.inv(columns.T @ columns / noise**2 + np.diag(sigmas**-2.0))
        found = covariance @ columns.T @ values / noise**2
        noise = max(_MIN_SIDEWAYS_M, math.sqrt(float(np.mean((values - columns @ found) ** 2))))
    return float(found[0]), math.sqrt(float(covariance[0, 0]))


def _is_equally_long(by_wheels: FloatArray, by_scans: FloatArray) -> bool:
    """Whether the ways (n,) by wheels and scans have nearly one length, so that the scans are of surfaces that stand still."""
    return abs(math.log(float(np.abs(by_scans).sum() / np.abs(by_wheels).sum()))) < _MAX_WAY_CHANGE


def _without_far(by_wheels: FloatArray, by_scans: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The ways (n,) without those of intervals whose direction is far from the usual one, where these are few."""
    product = by_scans * by_wheels.conj()
    mean = float(np.angle(product.sum()))
    usual = mean + float(np.median(np.angle(product * np.exp(-1j * mean))))
    is_near = np.abs(np.angle(product * np.exp(-1j * usual))) < _FAR_RAD
    return (by_wheels[is_near], by_scans[is_near]) if is_near.mean() >= _MIN_NEAR else (by_wheels, by_scans)


def _largest_change(by_wheels: FloatArray, by_scans: FloatArray) -> float:
    """Largest angle between the directions of the LiDAR's travel before and after any of the intervals (n,) [rad]."""
    product = by_scans * by_wheels.conj()
    size, before = np.cumsum(np.abs(product)), np.cumsum(product)
    is_inside = (size > _MIN_PART * size[-1]) & (size < (1.0 - _MIN_PART) * size[-1])
    changes = np.abs(np.angle(before * (before[-1] - before).conj()))
    return float(changes[is_inside].max(initial=0.0))


def _snapped(direction: float) -> tuple[float, bool]:
    """The quarter turn that ``direction`` [rad] is near, and True; else it, and False."""
    quarter = round(direction / (0.5 * math.pi)) * 0.5 * math.pi
    is_quarter = abs(direction - quarter) <= _SNAP_RAD
    return (quarter if is_quarter else direction), is_quarter


def _likeness(turns: FloatArray) -> float | None:
    """Correlation about zero of the turns by wheels and scans; None without turns."""
    if not len(turns) or float(np.abs(turns[:, 1]).sum()) < _MIN_TURN_RAD:
        return None
    a, b = turns.T
    return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)


def corrected(mounts: Mapping[str, Mount], found: LidarFinding | None) -> dict[str, Mount]:
    """``mounts`` by frame, with that of ``found``."""
    return dict(mounts) if found is None or found.mount is None else {**mounts, found.frame: found.mount}
