"""Discrepancies of a drive under a hypothesis: measured minus predicted motion, with the model's own integration."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import get_args

import numpy as np

from localization.diagnosis.causes.cause import Cause, DriveMotion, Hypothesis, Spell, Stage, changed
from localization.diagnosis.causes.floor import slip_stiffness_cause
from localization.diagnosis.drive import Drive
from localization.diagnosis.friction_response import TRACKED, ManeuverSamples, dynamic_twists, quasi_static_twists
from localization.evidence.sensor_errors import GYRO_SCALE_SIGMA
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import Batch, IntArray, Maneuver, make_batch
from motion_models.calibration.prediction import predict, series_of
from motion_models.compiled import kernel, subroutine
from motion_models.diff_drive import DiffDrive
from motion_models.extended_model import in_series
from motion_models.friction import FrictionModel
from motion_models.motion import Twist
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_DROP = (0.4, 0.62)  # one of two encoders silent; the rate of a side is their mean
_LEAST_RATE = 0.5  # rad/s
REST_RATE_RAD_PER_S = 0.25  # rad/s
_STANDING_RATE = 1e-6  # rad/s of wheels that stand, by which parts of a window in which they do are shares of it
_LONGEST_S = 3.0


def find_dropouts(batch: Batch) -> FloatArray:
    """(N, 2) what would have to be added to each rate, as a share of it: 1 where half of a side's counts are missing, else 0.

    A spell begins where a side's rate falls to about half between two samples while the other's stays, and ends where it doubles.
    """
    found = np.zeros_like(batch.wheels)
    for w in range(len(batch.first) - 1):
        inside = slice(batch.first[w], batch.first[w + 1])
        for side in (0, 1):
            found[inside, side] = _spells(batch.wheels[inside, side], batch.wheels[inside, 1 - side], batch.dt[inside])
    return found


@kernel
def _spells(rate: FloatArray, other: FloatArray, dt: FloatArray) -> FloatArray:
    share = np.zeros_like(rate)
    n = len(rate)
    if n < 3:
        return share
    jumps = [(0, 0) for _ in range(0)]  # (index, +1 for a rise, -1 for a fall)
    for i in range(1, n):
        before, after = rate[i - 1], rate[i]
        earlier, later = rate[max(i - 2, 0)], rate[min(i + 1, n - 1)]
        if abs(other[i] - other[i - 1]) > 0.15 * max(abs(other[i]), _LEAST_RATE) or before * after <= 0.0:
            continue
        # a step between two samples, level on both sides of it: no wheel accelerates so
        falls, rises = after / before, before / after
        level = _like(before, earlier) and _like(after, later)
        if level and abs(before) > _LEAST_RATE and _DROP[0] < falls < _DROP[1]:
            jumps.append((i, -1))
        elif level and abs(after) > _LEAST_RATE and _DROP[0] < rises < _DROP[1]:
            jumps.append((i, 1))
    # steps do not show while wheels hardly turn, so that every spell ends at a rest
    rests = np.flatnonzero(np.abs(rate) < REST_RATE_RAD_PER_S)
    spells = [(0, 0) for _ in range(0)]
    start = -1  # none
    if jumps and jumps[0][1] == 1:
        resting = rests[rests < jumps[0][0]]
        start = int(resting[-1]) + 1 if len(resting) else 0  # it was silent when the window began, or when the wheels began to turn
    for i, kind in jumps:
        if start >= 0:
            spells.append((start, _until(rests, start, i)))
        start = i if kind == -1 else -1
    if start >= 0:
        spells.append((start, _until(rests, start, n)))
    for a, b in spells:
        if dt[a:b].sum() < _LONGEST_S:
            share[a:b] = 1.0
    return share


@subroutine
def _until(rests: IntArray, start: int, end: int) -> int:
    """``end``, or the first rest between it and ``start``."""
    between = rests[(rests > start) & (rests < end)]
    return int(between[0]) if len(between) else end


@subroutine
def _like(a: float, b: float) -> bool:
    """Nearly the same rate."""
    return abs(a - b) < 0.12 * max(abs(a), abs(b)) + 0.05


CHANNELS = ("x", "y", "yaw", "gyro", "force_x", "force_y")
CHANNEL_UNITS = ("m", "m", "rad", "rad", "m/s^2", "m/s^2")
_GYRO_TURN_SIGMA_RAD = 1e-3  # of a window's turn by the gyro against the motion reference
_MAX_CACHED_TWISTS = 100
_STAGES = get_args(Stage)
_TURNS_RAD2_S2 = 0.01**2  # mean square of the yaw rate from where on a robot turns: noise of counts is less
_LEAST_MU = 0.05  # ice
_MAX_CONTACT_LAW = 1.3  # share of the other contact law; beyond 1 for the search only
_NO_COLUMNS: IntArray = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Baseline:
    """How a robot differs from its file when nothing is wrong (`localization.diagnosis.baseline`)."""

    hypothesis: Hypothesis = field(default_factory=Hypothesis)
    noise_over_reference: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """What is left of x, y and yaw on a drive without faults, over the motion reference's own sigma."""
    windows: float = 4.0
    """Number of windows that these sigmas count for."""


@dataclass(frozen=True)
class Unmodelled:
    """What no robot file has of the contacts, as nuisances of a diagnosis (`model_error`)."""

    has_stiffness: bool = False
    """The tyres' slip stiffness, and how it grows with speed, are unknown."""
    slip_share: float = 0.0
    """Sigma of slips by kind of motion, alike on both sides, that the model does not have, over the wheels' way."""
    log_stiffness: float = 0.0
    """Logarithm of the slip stiffness over the robot file's, about which the drive is linearized."""
    stiffness_exponent: float = 0.0
    """Power of speed with which the slip stiffness grows, about which the drive is linearized: 1 where forces depend on the speed of the
    slip alone (`friction_response`)."""

    @property
    def contacts(self) -> tuple[float, float]:
        """What differs from the robot file's contacts; (0, 0) where nothing does."""
        return self.log_stiffness, self.stiffness_exponent


@dataclass
class DrivePredictor:
    """Predicts a drive's motions with one model; discrepancies are measured minus predicted.

    Causes of the floor act through the friction model whatever the model is: what they change there is added to the model's prediction.
    ``has_inertia`` adds what constant-rate models leave out by their nature: inertia, and the load that accelerations shift.
    """

    drive: Drive
    model: MotionModel
    has_inertia: bool
    baseline: Baseline = field(default_factory=Baseline)
    """Hypotheses count from there."""
    is_gyro_scaled: bool = False
    """Whether headings are corrected by the gyro's scale against the motion reference: turning for a minute, 1 % makes 0.1 rad."""
    unmodelled: Unmodelled = field(default_factory=Unmodelled)
    """What the model's own error may be; no cause, and part of what is tolerated."""
    batch: Batch = field(init=False)
    headings: FloatArray = field(init=False)
    """(W,) at the start of each maneuver, counted from the first [rad]."""
    times_s: FloatArray = field(init=False)
    """(N,) start of every interval, from the drive's start [s]."""
    kinematic_forces: FloatArray = field(init=False)
    """(W, 2) mean specific force of the motion itself, by the wheels [m/s^2]."""

    def __post_init__(self) -> None:
        self.batch = make_batch(self.drive.maneuvers)
        self._friction = FrictionModel.from_robot(self.drive.robot)
        runs = [_whole(m, path) for m, path in zip(self.drive.maneuvers, self.drive.paths, strict=False)]
        self._path_batch = make_batch(runs) if runs else None
        self._lost = find_dropouts(self.batch)
        rolls = np.abs(self.batch.wheels).max(axis=1) > REST_RATE_RAD_PER_S
        self._lost_time = float((self._lost.max(axis=1) * rolls) @ self.batch.dt / max(float(rolls @ self.batch.dt), 1e-9))
        self._base = self._settled_twist()
        self.headings = self._headings()
        first, lead = self.batch.first, self.batch.lead
        self._last = self.batch.ends[np.searchsorted(self.batch.owner, np.arange(len(first) - 1), side="right") - 1]
        self.times_s = np.empty(len(self.batch.dt))
        for w, start in enumerate(self.drive.starts_s):
            inside = slice(first[w], first[w + 1])
            dt = self.batch.dt[inside]
            self.times_s[inside] = start + np.cumsum(dt) - dt - dt[: lead[w]].sum()
        self.kinematic_forces = self._accelerations()
        self._twists: dict[tuple[object, ...], FloatArray] = {}
        self._rows: dict[tuple[object, ...], FloatArray] = {}
        self._turns: dict[int, tuple[FloatArray, FloatArray]] = {}

    @property
    def has_baseline(self) -> bool:
        """Whether the robot differs from its file when nothing is wrong."""
        return self.baseline != Baseline()

    @cached_property
    def by_file(self) -> DrivePredictor:
        """The drive with the contacts of the robot file."""
        if not any(self.unmodelled.contacts):
            return self
        return dataclasses.replace(self, unmodelled=dataclasses.replace(self.unmodelled, log_stiffness=0.0, stiffness_exponent=0.0))

    @property
    def nominal_twist(self) -> FloatArray:
        """(N, 3) by the friction model as the robot file has it, settled, and of robots with casters by their geometry
        [m/s, m/s, rad/s]."""
        return self._base

    def _settled_twist(self) -> FloatArray:
        batch, robot = self.batch, self.drive.robot
        if robot.drive == DIFF_DRIVE:
            model = DiffDrive.from_robot(robot)
            return model.twist(batch.wheels, batch.cg, model.nominal).value
        return quasi_static_twists(self._friction, self._friction.nominal, batch.wheels, batch.cg)

    @property
    def has_dropouts(self) -> bool:
        """Whether an encoder lost counts anywhere in the drive."""
        return bool(self._lost.any())

    @property
    def dropout_count(self) -> int:
        """Number of spells in which a side's counts drop to half. Windows share what comes before and after them with their neighbours."""
        begins = np.diff(self._lost, axis=0, prepend=0.0) > 0.0
        for w, m in enumerate(self.drive.maneuvers):
            a, b = self.batch.first[w], self.batch.first[w + 1]
            begins[a : a + m.lead] = begins[a + m.lead + int(m.ends[-1]) : b] = False
        return int(np.count_nonzero(begins))

    def _headings(self) -> FloatArray:
        """By the gyro less its bias (and scale) against the motion reference; else by the reference's own turns, one after the other."""
        batch, drive = self.batch, self.drive
        last = np.r_[batch.owner[1:] != batch.owner[:-1], True]
        yaw = batch.measured[last, 2] if drive.has_headings else self._turned()
        if drive.gyro is not None:
            turns = [drive.gyro.turn(int(a), int(b), float(t)) for (a, b), t in zip(drive.spans_ns, yaw, strict=True)]
            known = [(t.angle - y, y, t.duration) for t, y in zip(turns, yaw, strict=True) if t is not None]
            if known:
                scale, bias = 0.0, sum(k[0] for k in known) / sum(k[2] for k in known)
                if self.is_gyro_scaled:
                    prior = (0.0, _GYRO_TURN_SIGMA_RAD / GYRO_SCALE_SIGMA, 0.0)  # of the scale, where the robot hardly turns
                    off, *columns = np.array([*known, prior]).T
                    (scale, bias), *_ = np.linalg.lstsq(np.column_stack(columns), off, rcond=None)
                starts = drive.spans_ns[:, 0]
                between = [drive.gyro.turn(int(a), int(b), 0.0) for a, b in itertools.pairwise(starts)]
                turned = [y if t is None else (t.angle - bias * t.duration) / (1.0 + scale) for t, y in zip(between, yaw[:-1], strict=True)]
                return np.array([0.0, *itertools.accumulate(turned)])
        return np.asarray(np.cumsum(yaw) - yaw)

    def _turned(self) -> FloatArray:
        """(W,) turn of each maneuver by the nominal friction model [rad]."""
        batch = self.batch
        total = np.r_[0.0, np.cumsum(self._base[:, 2] * batch.dt)]
        starts = batch.first[:-1] + batch.lead
        return np.asarray(total[starts + [int(m.ends[-1]) for m in self.drive.maneuvers]] - total[starts])

    def _accelerations(self) -> FloatArray:
        """(W, 2) mean specific force of the motion itself, by the wheels [m/s^2]."""
        batch = self.batch
        found = np.zeros((len(batch.first) - 1, 2))
        for w in range(len(found)):
            a = batch.first[w] + batch.lead[w]
            inside = slice(a, a + int(self.drive.maneuvers[w].ends[-1]))
            t, dt = self._base[inside], batch.dt[inside]
            whole = dt.sum()
            found[w, 0] = (t[-1, 0] - t[0, 0]) / whole - (t[:, 1] * t[:, 2]) @ dt / whole
            found[w, 1] = (t[-1, 1] - t[0, 1]) / whole + (t[:, 0] * t[:, 2]) @ dt / whole
        return found

    def discrepancies(self, hypothesis: Hypothesis) -> FloatArray:
        """(M, 6) measured minus predicted, as `CHANNELS`: motion in the predicted end's frame; NaN where nothing was measured.

        What holds in a part of the drive changes the windows in it, and one that it shares by its share (`shares`).
        """
        if not hypothesis.spells:
            return self._discrepancies(hypothesis).copy()
        lasting = dataclasses.replace(hypothesis, spells={})
        rows = self._discrepancies(lasting)
        changes = (self.shares(spell)[:, None] * (self._discrepancies(lasting + more) - rows) for spell, more in hypothesis.spells.items())
        return np.asarray(rows + sum(changes))

    @cached_property
    def window_times_s(self) -> tuple[FloatArray, FloatArray]:
        """(M,) start and (M,) end of the motion to every measured pose, from the drive's start [s]."""
        batch = self.batch
        begins = self.drive.starts_s[batch.owner]
        total = np.r_[0.0, np.cumsum(batch.dt)]
        return begins, begins + total[batch.ends] - total[batch.first[batch.owner] + batch.lead[batch.owner]]

    def shares(self, spell: Spell) -> FloatArray:
        """(M,) share of the wheels' way to every measured pose that lies in ``spell``: what moves the robot in another way acts along it,
        and not while it stands."""
        begins, ends = self.window_times_s
        knots, way = self._way
        at = np.interp(np.stack([np.clip(t, spell.start_s, spell.end_s) for t in (begins, ends)]), knots, way)
        whole = np.interp(ends, knots, way) - np.interp(begins, knots, way)
        return np.asarray((at[1] - at[0]) / np.maximum(whole, 1e-12))

    @cached_property
    def _way(self) -> tuple[FloatArray, FloatArray]:
        """(n,) starts and ends of all intervals in windows [s], and (n,) the way of both wheels until then [rad]; what stands for a whole
        window goes by time."""
        batch = self.batch
        inside = [slice(first + lead, last) for first, lead, last in zip(batch.first[:-1], batch.lead, self._last, strict=True)]
        starts, dt = (np.concatenate([values[i] for i in inside]) for values in (self.times_s, batch.dt))
        steps = dt * (_STANDING_RATE + np.concatenate([np.abs(batch.wheels[i]).sum(axis=1) for i in inside]))
        way = np.cumsum(steps)
        return np.column_stack([starts, starts + dt]).ravel(), np.column_stack([way - steps, way]).ravel()

    def _discrepancies(self, hypothesis: Hypothesis) -> FloatArray:
        """(M, 6) `discrepancies` of a hypothesis that holds in the whole drive; kept, as searches and linearizations share them."""
        key = hypothesis.key(*_STAGES)
        if key not in self._rows:
            self._rows[key] = self._predicted_discrepancies(hypothesis)
        return self._rows[key]

    def _predicted_discrepancies(self, hypothesis: Hypothesis) -> FloatArray:
        log_stiffness, exponent = self.unmodelled.contacts
        contacts = slip_stiffness_cause(self.drive.robot).inject(Hypothesis(stiffness_exponent=exponent), log_stiffness)
        hypothesis = self.baseline.hypothesis + contacts + hypothesis
        batch, drive = self.batch, self.drive
        out = np.full((len(batch.ends), len(CHANNELS)), np.nan)
        reference_params = np.array([self.wheel_shift(hypothesis), hypothesis.wheel_lag_s, *self._tracked(hypothesis)])
        if drive.is_gyro_reference:
            reference_params[2:] = 0.0
        changed = _HypothesisModel(self, hypothesis)
        if self._path_batch is not None:
            poses, _, _ = predict(changed, self._path_batch, changed.nominal, reference_params, _NO_COLUMNS, drive.robot.wheel_noise)
            apart = np.hypot(*(poses - self._path_batch.measured)[:, :2].T)
            out[:, 0] = drive.path_errors - np.bincount(self._path_batch.owner, apart) / np.bincount(self._path_batch.owner)
            return out
        poses, _, _ = predict(changed, batch, changed.nominal, reference_params, _NO_COLUMNS, drive.robot.wheel_noise)
        off = se2.between(poses, self._measured(hypothesis, poses))
        known = np.isfinite(np.diagonal(batch.cov, axis1=1, axis2=2))
        out[:, :3] = np.where(known, off, np.nan)
        if drive.is_gyro_reference:
            seconds = np.array([float(m.dt[m.lead : m.lead + int(m.ends[-1])].sum()) for m in drive.maneuvers])
            # times the predicted turn: times the measured one, its own noise and all slip would look like a scale
            out[:, 2] -= hypothesis.gyro_bias * seconds + poses[:, 2] * hypothesis.gyro_scale
        if drive.gyro is not None:
            angles, seconds = self._gyro_turns(round((hypothesis.lidar_time_offset_s - hypothesis.gyro_time_offset_s) * 1e9))
            # times the predicted turn: the measured one's noise and bias would look like a scale
            out[:, 3] = angles - batch.measured[:, 2] - hypothesis.gyro_scale * poses[:, 2] - hypothesis.gyro_bias * seconds
        if drive.forces is not None:
            middle = self.headings + 0.5 * batch.measured[:, 2]
            c, s = np.cos(middle), np.sin(middle)
            turned = np.sinc(batch.measured[:, 2] / (2.0 * math.pi))  # mean of what turns with the body, over its value in the middle
            sx, sy = (GRAVITY * math.sin(rise) * turned for rise in hypothesis.slope)
            out[:, 4] = drive.forces[:, 0] - self.kinematic_forces[:, 0] - (c * sx + s * sy)
            out[:, 5] = drive.forces[:, 1] - self.kinematic_forces[:, 1] - (-s * sx + c * sy)
        return out

    def _gyro_turns(self, late_ns: int) -> tuple[FloatArray, FloatArray]:
        """(W,) turn [rad] and (W,) length [s] of every window by a gyro whose stamps are so much earlier than the motion reference's; NaN
        where it has no samples. Kept, as nearly all hypotheses have the same clocks."""
        if late_ns not in self._turns:
            gyro, found = self.drive.gyro, np.full((2, len(self.drive.spans_ns)), np.nan)
            for i, (a, b) in enumerate(self.drive.spans_ns):
                turn = None if gyro is None else gyro.turn(int(a) - late_ns, int(b) - late_ns, float(self.batch.measured[i, 2]))
                if turn is not None:
                    found[:, i] = turn.angle, turn.duration
            self._turns[late_ns] = found[0], found[1]
        return self._turns[late_ns]

    def wheel_shift(self, hypothesis: Hypothesis) -> float:
        """By how much the wheels' stamps are later than those of the motion reference under ``hypothesis`` [s]."""
        b = hypothesis
        return b.wheel_time_offset_s - (b.gyro_time_offset_s if self.drive.is_gyro_reference else b.lidar_time_offset_s)

    def _measured(self, hypothesis: Hypothesis, predicted: FloatArray) -> FloatArray:
        """(M, 3) measured poses without the ranging errors of ``hypothesis``: scan matching scales the LiDAR's own path, and a constant
        error of all ranges acts by the scene's own derivative (`Drive.range_slopes`).

        Scaled is the ``predicted`` path (M, 3): as a multiple of the measured one the scale, together with one of the wheels, would
        explain any discrepancy of the two.
        """
        b, measured = hypothesis, self.batch.measured
        if self.drive.range_slopes is None or not (b.range_scale or b.range_bias_m):
            return measured
        found = measured - b.range_bias_m * self.drive.range_slopes
        x, y = self.drive.lidar_at
        c, s = np.cos(predicted[:, 2]), np.sin(predicted[:, 2])
        lever = np.column_stack([(c - 1.0) * x - s * y, s * x + (c - 1.0) * y])
        found[:, :2] -= b.range_scale * (predicted[:, :2] + lever)
        return found

    def _tracked(self, hypothesis: Hypothesis) -> tuple[float, float, float]:
        """Real pose of the frame that the LiDAR's transform takes for the body's: it turns about the sensor, not about the body. Of a
        reference it is the frame that this tracks."""
        (x, y), (dx, dy, yaw) = self.drive.lidar_at, hypothesis.lidar_offset
        c, s = math.cos(yaw), math.sin(yaw)
        at_x, at_y = self.drive.antenna
        return dx + at_x + x - (c * x - s * y), dy + at_y + y - (s * x + c * y), yaw

    def corrected_twist(self, hypothesis: Hypothesis) -> FloatArray:
        """(N, 3) the model's twists in every interval under ``hypothesis`` [m/s, m/s, rad/s]."""
        changed = _HypothesisModel(self, hypothesis)
        return changed.twist(self.batch.wheels, self.batch.cg, changed.nominal).value

    @cached_property
    def effective_track_m(self) -> float:
        """Difference of both sides' speeds over the yaw rate, by the model on this drive [m]; the robot's track where it does not turn."""
        geometry, wz = self.drive.robot.geometry, self.corrected_twist(Hypothesis())[:, 2]
        apart = geometry.wheel_radius_m * (self.batch.wheels[:, 1] - self.batch.wheels[:, 0])
        return float(apart @ wz / (wz @ wz)) if wz @ wz > _TURNS_RAD2_S2 * len(wz) else geometry.track_width_m

    def signature(self, hypothesis: Hypothesis, cause: Cause, base: FloatArray | None = None) -> FloatArray:
        """(M, 6) change of the discrepancy per unit of ``cause`` around ``hypothesis``, with the sign of what a correction removes."""
        if cause.is_clock:
            step = 0.5 * cause.typical
            behind, ahead = (self.discrepancies(cause.inject(hypothesis, s)) for s in (-step, step))
            return np.asarray((behind - ahead) / (2.0 * step))
        step = 0.1 * cause.typical
        ahead = self.discrepancies(cause.inject(hypothesis, step))
        return np.asarray(((self.discrepancies(hypothesis) if base is None else base) - ahead) / step)


def moved_by(twist: FloatArray, dt: FloatArray, increments: FloatArray) -> FloatArray:
    """(3, 3, K) change of a window's last pose, in its frame, by the ``increments`` (n, K) of each component (second axis) of the twist."""
    turned = np.cumsum(twist[:, 2] * dt)
    before = turned - 0.5 * twist[:, 2] * dt - turned[-1]
    c, s = np.cos(before), np.sin(before)
    steps = np.column_stack([c * twist[:, 0] - s * twist[:, 1], s * twist[:, 0] + c * twist[:, 1]]) * dt[:, None]
    ahead = steps[::-1].cumsum(axis=0)[::-1] - 0.5 * steps
    moved = np.zeros((3, 3, increments.shape[1]))
    moved[0, 0], moved[1, 0] = c @ increments, s @ increments
    moved[0, 1], moved[1, 1] = -s @ increments, c @ increments
    moved[0, 2], moved[1, 2], moved[2, 2] = -ahead[:, 1] @ increments, ahead[:, 0] @ increments, increments.sum(axis=0)
    return moved


_KINDS = 8
"""Straight ahead and back, turns in place and arcs, to both sides."""


def slip_columns(predictor: DrivePredictor) -> FloatArray:
    """(M, 6, 3 `_KINDS`) motion by a slip of each component of the twist in each kind of motion, as a share of the wheels' way.

    The kind is the direction of (q_l + q_r, q_r - q_l); slips are piecewise linear around its circle.
    """
    batch, g = predictor.batch, predictor.drive.robot.geometry
    found = np.zeros((len(batch.ends), len(CHANNELS), 3 * _KINDS))
    for i, inside in enumerate(batch.intervals()):
        ways = batch.wheels[inside] * batch.dt[inside, None] * g.wheel_radius_m
        direction = np.arctan2(ways[:, 1] - ways[:, 0], ways[:, 0] + ways[:, 1]) * (_KINDS / (2.0 * math.pi))
        apart = (direction[:, None] - np.arange(_KINDS) + 0.5 * _KINDS) % _KINDS - 0.5 * _KINDS
        slips = np.maximum(1.0 - np.abs(apart), 0.0) * np.sqrt(np.mean(ways**2, axis=1))[:, None]
        moved = moved_by(predictor.nominal_twist[inside], batch.dt[inside], slips)
        moved[:, 2] /= 0.5 * g.track_width_m
        found[i, :3] = moved.reshape(3, -1)
    return found


def mirrored(columns: FloatArray) -> FloatArray:
    """(M, 6, 11) sums of the `slip_columns` (M, 6, 24) of robots whose sides are alike: in mirrored motions vx slips alike, vy and wz to
    the other side, and neither when the robot drives straight on. Slips of one side alone are no error of contacts."""
    by = columns.reshape(*columns.shape[:2], 3, _KINDS)
    half = _KINDS // 2
    ahead = [by[..., 0, k] + (by[..., 0, -k] if k % half else 0.0) for k in range(half + 1)]
    aside = [by[..., component, k] - by[..., component, -k] for component in (1, 2) for k in range(1, half)]
    return np.stack([*ahead, *aside], axis=-1)


def relative_speeds(predictor: DrivePredictor) -> FloatArray:
    """(M,) how much faster the wheels roll than in the mean of the drive, over that mean: slips of contacts that do not follow the model's
    law depend on the speed as well."""
    batch = predictor.batch
    speeds = np.array([np.sqrt(np.mean(np.square(batch.wheels[inside]))) for inside in batch.intervals()])
    mean = max(float(speeds.mean()), 1e-9)
    return np.asarray(speeds / mean - 1.0)


def late_columns(predictor: DrivePredictor, late_s: float) -> FloatArray:
    """(M, 6, 2) motion by speed and turning rate, one each, that come ``late_s`` [s] after those of the wheels while they change."""
    batch, twist = predictor.batch, predictor.nominal_twist
    found = np.zeros((len(batch.ends), len(CHANNELS), 2))
    for i, inside in enumerate(batch.intervals()):
        gains = np.diff(twist[inside], axis=0, prepend=twist[inside][:1])[:, [0, 2]] * late_s
        moved = moved_by(twist[inside], batch.dt[inside], gains)
        found[i, :3] = np.column_stack([moved[:, 0, 0], moved[:, 2, 1]])
    return found


def rolling_column(predictor: DrivePredictor) -> FloatArray:
    """(M, 6, 1) motion by the load that rolling resistance moves against the direction of rolling, which the friction model does not have.

    A wheel that rolls is resisted by a moment f_r N r: its normal force acts f_r r ahead of its axle (Wong 2008, sec. 1.2), so that the
    axles' loads are those of a centre of gravity so much farther back, 4.3 mm on a Husky; where a robot turns in place both sides cancel.
    """
    batch, model = predictor.batch, FrictionModel.from_robot(predictor.drive.robot)
    params = model.nominal.copy()
    radius, resistance, wheelbase = (params[model.param_names.index(name)] for name in ("wheel_radius", "rolling_resistance", "wheelbase"))
    params[model.param_names.index("slip_stiffness")] *= math.exp(predictor.unmodelled.log_stiffness)
    back = resistance * radius * np.sign(batch.wheels).mean(axis=1)
    half = 0.49 * wheelbase  # a centre of gravity over an axle would lift the other one
    cg = np.column_stack([np.clip(batch.cg[:, 0] - back, -half, half), batch.cg[:, 1]])
    change = quasi_static_twists(model, params, batch.wheels, cg) - quasi_static_twists(model, params, batch.wheels, batch.cg)
    found = np.zeros((len(batch.ends), len(CHANNELS), 1))
    for i, inside in enumerate(batch.intervals()):
        moved = moved_by(predictor.nominal_twist[inside], batch.dt[inside], change[inside] * batch.dt[inside, None])
        found[i, :3, 0] = np.trace(moved, axis1=1, axis2=2)
    return found


def _whole(maneuver: Maneuver, path: FloatArray) -> Maneuver:
    """``maneuver`` with the poses (n, 3) of ``path`` at the end of each of its intervals."""
    return dataclasses.replace(maneuver, measured=path, ends=np.arange(1, len(path) + 1), cov=np.zeros((3, 3)))


class _HypothesisModel:
    """The model with a hypothesis's changes: a `MotionModel` for the length of one batch."""

    def __init__(self, predictor: DrivePredictor, hypothesis: Hypothesis) -> None:
        self._p, self._b = predictor, hypothesis
        self.name, self.param_names = predictor.model.name, predictor.model.param_names
        self.nominal = predictor.model.nominal

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        p, b = self._p, self._b
        rates = wheels * np.maximum(1.0 + np.array([b.left_radius_scale, b.right_radius_scale]), 0.1)
        if b.wheel_radius_drift:
            rates = rates * (1.0 + b.wheel_radius_drift * p.times_s / max(float(p.drive.starts_s[-1]), 1e-9))[:, None]
        if b.encoder_loss:
            rates = rates * (1.0 + b.encoder_loss / max(p._lost_time, 1e-9) * p._lost)
        if b.changed_rates:
            rates = changed(b.changed_rates, DriveMotion(rates, np.zeros((len(rates), 3)), p.batch.dt, p.times_s), "rates")
        value = self._of_model(rates, cg, params) + self._floor(rates, cg)
        if p.drive.robot.drive == DIFF_DRIVE:
            track = p.drive.robot.geometry.track_width_m
            value = value * np.array([1.0, 1.0, track / (track + b.friction.get("track_width", 0.0))])
        if any(b.rotation_coefficients):
            energy = 2.0 * np.maximum(np.sum(rates**2, axis=-1), 1e-12)
            straight = 1.0 - (rates[:, 1] - rates[:, 0]) ** 2 / energy
            more, rate, gentle = b.rotation_coefficients
            value = value * np.stack(
                [np.ones(len(rates)), np.ones(len(rates)), 1.0 + more - rate * np.abs(value[:, 2]) - gentle * straight], axis=-1
            )
        if b.longitudinal_curvature_slip:
            energy = 2.0 * np.maximum(np.sum(rates**2, axis=-1), 1e-12)
            value = value * np.stack(
                [1.0 - b.longitudinal_curvature_slip * (rates[:, 1] - rates[:, 0]) ** 2 / energy, *(np.ones(len(rates)),) * 2], axis=-1
            )
        if any(b.slip_coefficients):
            vx, vy, wz = value.T
            lateral, rotation, forward = b.slip_coefficients
            value = np.stack([vx * (1.0 - forward * np.abs(wz)), vy + lateral * vx * wz, wz * (1.0 - rotation * np.abs(vx))], axis=-1)
        if b.changed_twists:
            value = changed(b.changed_twists, DriveMotion(rates, value, p.batch.dt, p.times_s), "twist")
        n, k = len(value), len(params)
        return Twist(np.ascontiguousarray(value), np.zeros((n, 3, 2)), np.zeros((n, 3, 2)), np.zeros((n, 3, k)))

    def _of_model(self, rates: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """(N, 3) by the motion model; cached, and without derivatives for the friction model."""
        model, twists = self._p.model, self._p._twists
        if isinstance(model, FrictionModel):
            return self._quasi_static(model, rates, cg, params, 0.0)
        key = (*self._rates_key(), "model")
        if key not in twists:
            twists[key] = in_series(model, series_of(self._p.batch)).twist(rates, cg, params).value
        return twists[key]

    def _floor(self, rates: FloatArray, cg: FloatArray) -> FloatArray:
        """(N, 3) change of the friction model's twists by causes of the floor, and by inertia."""
        p, b = self._p, self._b
        is_changed = (
            (b.friction and p.drive.robot.drive != DIFF_DRIVE)
            or any(b.cg)
            or b.payload_kg
            or b.friction_change
            or b.other_contact_law
            or b.split_friction
            or b.cg_height
        )
        is_changed = is_changed or b.stiffness_exponent
        if not (is_changed or any(b.slope) or p.has_inertia):
            return np.zeros((len(rates), 3))
        friction = p._friction
        params = friction.nominal.copy()
        for name, more in b.friction.items():
            i = friction.param_names.index(name)
            params[i] = max(params[i] * (1.0 + more), 0.05) if name == "mu_ratio" else params[i] + more
        params[6], params[7] = max(params[6], 0.0), max(params[7], 0.0)
        params[9] = min(max(params[9], -0.9), 0.9)
        params[1] = max(params[1], 0.2 * friction.nominal[1])
        params[3] = max(params[3], _LEAST_MU)
        law = friction
        if b.other_contact_law:
            share = min(b.other_contact_law, _MAX_CONTACT_LAW)
            law = dataclasses.replace(friction, saturation=friction.saturation + (1.0 - 2.0 * friction.saturation) * share)
        nominal = self._quasi_static(friction, rates, cg, friction.nominal, 0.0)
        moved = cg
        if any(b.cg) or b.payload_kg:
            mass = p.drive.robot.geometry.mass_kg
            moved = cg + np.array(b.cg) + (p.drive.payload_arms * (b.payload_kg / (mass + b.payload_kg)) if b.payload_kg else 0.0)
        half = 0.49 * np.array([params[2], params[1]])
        if moved is not cg:
            moved = np.clip(moved, -half, half)
        grip = moved
        split, params[12] = params[12] + b.split_friction, 0.0
        if split:
            shifted, params[8] = _shifted_by_grip(moved, (0.5 * params[2], 0.5 * params[1]), params[8], split)
            grip = np.clip(shifted, -half, half)
        centers = moved, grip
        if not b.friction_change:
            return self._with_inertia(law, rates, centers, params) - nominal
        later = params.copy()
        later[4] = max(later[4] * (1.0 + b.friction_change), 0.05)
        is_after_change = (p.times_s >= b.friction_change_at_s)[:, None]
        return np.asarray(
            np.where(is_after_change, self._with_inertia(law, rates, centers, later), self._with_inertia(law, rates, centers, params))
            - nominal
        )

    def _quasi_static(self, law: FrictionModel, rates: FloatArray, cg: FloatArray, params: FloatArray, exponent: float) -> FloatArray:
        """(N, 3) twists of the tracked point without inertia; cached, as many hypotheses share them."""
        p = self._p
        key = (
            *self._rates_key(),
            law.saturation,
            exponent,
            params.tobytes(),
            *(self._load_key() if cg is not p.batch.cg else ()),
        )
        if key not in p._twists:
            if len(p._twists) > _MAX_CACHED_TWISTS:
                p._twists.clear()
            p._twists[key] = quasi_static_twists(law, params, rates, cg, exponent)
        return p._twists[key]

    def _load_key(self) -> tuple[object, ...]:
        return self._b.key("load")

    def _rates_key(self) -> tuple[object, ...]:
        return *self._b.key("rates"), self._p.wheel_shift(self._b)

    def _with_inertia(
        self, law: FrictionModel, rates: FloatArray, centers: tuple[FloatArray, FloatArray], params: FloatArray
    ) -> FloatArray:
        """(N, 3) twists of the tracked point, with inertia where that counts; ``centers`` (N, 2) of gravity and of the grip."""
        p, b = self._p, self._b
        cg, grip = centers
        settled = self._quasi_static(law, rates, grip, params, b.stiffness_exponent)
        if not (p.has_inertia or any(b.slope)):
            return settled
        key = (
            *self._rates_key(),
            law.saturation,
            b.stiffness_exponent,
            params.tobytes(),
            b.slope,
            b.cg_height,
            *(self._load_key() if grip is not p.batch.cg else ()),
            "inertia",
        )
        if key not in p._twists:
            x, y = params[TRACKED[0]], params[TRACKED[1]]
            middle = settled + settled[:, 2:] * np.array([y, -x, 0.0])
            batch, robot = p.batch, with_cg_height(p.drive.robot, b.cg_height)
            turned = np.r_[0.0, np.cumsum(settled[:, 2] * batch.dt)]
            headings = p.headings - (turned[batch.first[:-1] + batch.lead] - turned[batch.first[:-1]])
            drive = ManeuverSamples(batch.dt, rates, cg, grip, batch.first, p._last, headings, np.array(b.slope), b.stiffness_exponent)
            twists = dynamic_twists(robot, law, params, drive, middle)
            p._twists[key] = np.asarray(twists - twists[:, 2:] * np.array([y, -x, 0.0]))
        return p._twists[key]


def with_cg_height(robot: Robot, more: float) -> Robot:
    """``robot`` whose centre of gravity lies higher by ``more`` [m], above the floor."""
    g = robot.geometry
    return robot if not more else dataclasses.replace(robot, geometry=dataclasses.replace(g, cg_height_m=max(g.cg_height_m + more, 0.0)))


def _shifted_by_grip(cg: FloatArray, half: tuple[float, float], warp: float, split: float) -> tuple[FloatArray, float]:
    """(N, 2) centres of the contact forces where the left wheels grip ``split`` more than the right ones, over the mean of both; and the
    warp of these forces.

    A contact's force goes with its load times its friction. With g = split / 2, loads (1 + sx xi + sy eta + sx sy t) / 4 as in
    `motion_models.friction.contact.loads` times (1 + sy g) have the same form: xi' = (xi + g t) / n, eta' = (eta + g) / n and
    t' = (t + g xi) / n with n = 1 + g eta. ``half`` are half wheelbase and half track; the warp is that at the mean centre of gravity.
    """
    g = 0.5 * split
    xi, eta = (cg / np.array(half)).T
    n = 1.0 + g * eta
    shifted = np.column_stack([(xi + g * warp) / n, (eta + g) / n]) * np.array(half)
    return shifted, (warp + g * float(xi.mean())) / float(n.mean())
