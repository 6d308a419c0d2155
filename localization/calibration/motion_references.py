"""What measures the motion that the wheels' is compared with: a LiDAR, a gyro, or a reference that the user names."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from localization.evaluation.consistency import covariances_in_body
from localization.evaluation.references import ReferenceTrack, with_noise
from localization.events import Event, ImuSample, Scan, Turn
from localization.inputs.gyro import GyroBuffer
from localization.inputs.wheel_buffer import WheelBuffer
from localization.lidar import MIN_POINTS, LidarConfig, ScanMatch, ScanMatcher, Sweep, choose_cell
from localization.messages import Message, message
from localization.trajectory import BoolArray, Trajectory
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.motion import Motion
from motion_models.preintegration import preintegrate
from motion_models.robot import GyroNoise, Mount, WheelNoise
from motion_models.se2 import FloatArray

_NS = 1e-9
_MAX_SCAN_GAP_S = 1.0
"""Gap in the scans beyond which a window is not measured [s]."""
MAX_REFERENCE_GAP_S = 0.5
"""Gap in a reference beyond which a window is not measured [s]."""
MAX_GAP_OVER_PERIOD = 2.5  # for references that are sparser than that: one missing measurement does not end a window
_MAX_GYRO_BIAS = 0.05  # rad/s; a robot that turns faster by the gyro than any bias does not stand, whatever its wheels report
HOLD_S = 0.5
"""Without a new sample, the wheels' last rates hold for this time [s]."""
_MAX_CLOCK_SHIFT_S = 0.3  # of IMU and LiDAR against the wheels; the largest of real logs is 0.16 s (MIT-CSAIL)
_MIN_STANDSTILL_S = 0.3
_ROUNDING_RAD_PER_S = 1e-6  # of rates from the poses of a driver's odometry: up to 1e-11 rad/s where MIT-CSAIL stands
_PRIOR_SIGMA = np.array([0.1, 0.1, 0.1])
"""Sigma of a match's prior, beyond the wheels' slip [m, m, rad]."""
_TURN_ERROR = 0.5
"""Sigma of a turn by the nominal model, as a share of the turn."""
_OPEN_SIGMA_M = 0.05
"""Sigma of a position beyond which a scene counts as a corridor: matching then slides towards no motion at all [m]."""
_RATE_GAPS = 20  # gaps between scans, by which their rate is measured
_MAX_UNMATCHED_S, _MAX_UNMATCHED_M, _MAX_UNMATCHED_RAD = 0.3, 0.15, 0.15
"""Scans within a window only lead to its last one: those nearer than this to the last matched one, by the wheels, are left out."""
_RANGE_STEP_M = 0.2
"""Added to all ranges, and taken off, for the scene's derivative [m]. In a hall the derivative is 2 to 4 mm per metre, and its own noise
3 mm at 0.05 m, 0.7 mm at 0.2 m and 0.6 mm at 0.4 m."""
REFERENCE_SIGMA_M = 0.02
"""Sigma of the position of a reference without covariances [m]: about that of RTK-GPS; motion capture is better."""
_REFERENCE_SIGMA_RAD = 0.01
"""Sigma of its heading [rad]: about that of RTK-GPS with two antennas."""
_FINEST_SIGMA = 1e-4
"""Smallest sigma of a position [m] or heading [rad]: what the best references resolve, whatever their covariance."""
_STANDSTILL_COV = np.diag([1e-12, 1e-12, 1e-12])
"""Covariance of the motion of a robot whose wheels stand: a micrometre and a microradian [m^2, m^2, rad^2]."""


@dataclass(frozen=True)
class Span:
    """Motion measured from one moment to another."""

    start_ns: int
    end_ns: int
    measured: FloatArray
    """(3,) pose at the end relative to that at the start [m, m, rad]."""
    cov: FloatArray
    """(3, 3) of its right perturbation, inf on the diagonal for what is not measured."""
    is_valid: bool = True
    middle_ns: int | None = None
    """Where positions alone were measured, the moment of the one between: ``measured`` is then the second chord relative to the first
    (`motion_models.calibration.chords`)."""
    range_slope: FloatArray | None = None
    """(3,) change of ``measured`` per metre that is added to all ranges of a LiDAR; None for other references."""


@dataclass(frozen=True)
class Wheels:
    """The wheels' latest motion, by the nominal model."""

    buffer: WheelBuffer
    model: MotionModel
    noise: WheelNoise

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """Motion from start to end; the last rates hold for `HOLD_S`."""
        dt, rates, cg, *_ = self.buffer.window(start_ns, end_ns, HOLD_S)
        return preintegrate(self.model, dt, rates, cg, self.model.nominal, self.noise)

    def is_standing(self, start_ns: int, end_ns: int) -> bool:
        """Whether no wheel moved."""
        dt, rates, *_ = self.buffer.window(start_ns, end_ns, HOLD_S)
        return len(dt) > 0 and bool(_stands(rates).all())

    def standstill(self, start_ns: int, end_ns: int) -> tuple[int, int] | None:
        """The longest part of a span in which no other clock has a wheel moving either; None where it is too short to measure in.

        It may begin by `_MAX_CLOCK_SHIFT_S` earlier than the span, and ends as much before its end, so that those of neighbouring spans
        adjoin.
        """
        shift = round(_MAX_CLOCK_SHIFT_S / _NS)
        begin = start_ns - 2 * shift
        if self.buffer.window(begin, start_ns, HOLD_S).missing:
            begin = start_ns
        dt, rates, _, _, missing = self.buffer.window(begin, end_ns, HOLD_S)
        if missing:
            return None
        stamps = begin + np.r_[0, np.round(np.cumsum(dt) / _NS)].astype(np.int64)
        edges = np.diff(np.r_[0, _stands(rates).astype(int), 0])
        starts, ends = stamps[edges == 1] + shift, stamps[edges == -1] - shift
        if not len(starts):
            return None
        longest = int(np.argmax(ends - starts))
        found = int(starts[longest]), int(ends[longest])
        return found if found[1] - found[0] >= round(_MIN_STANDSTILL_S / _NS) else None


def _stands(rates: FloatArray) -> BoolArray:
    """(n,) whether no wheel turns by the ``rates`` (n, 2)."""
    return np.asarray((np.abs(rates) < _ROUNDING_RAD_PER_S).all(axis=1))


class MotionReference(Protocol):
    """Takes all events of one log, in order."""

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """Spans that ``event`` completes, of the length that the reference was made for."""

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        """``spans`` without errors that the whole log shows."""

    def warnings(self) -> list[Message]:
        """Limits of what was measured, in sentences for the user."""


class GyroMotionReference:
    """Yaw by the gyro; its bias from the times at which the robot stood still. Positions are not measured."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], window_s: float) -> None:
        """``window_s``: length of the spans [s]."""
        self._noise, self._window_ns = noise, round(window_s / _NS)
        self._gyro = GyroBuffer(noise, mounts, keep_s=2.0 * window_s + 10.0)
        self._start_ns = self._newest_ns = None  # type: int | None
        self._standstills: list[Turn] = []
        self._bias: tuple[float, float] | None = None

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """See `MotionReference.spans`."""
        if isinstance(event, ImuSample):
            self._gyro.insert(event)
            self._newest_ns = event.stamp_ns
        newest = wheels.buffer.newest_ns
        if newest is None or self._newest_ns is None:
            return
        if self._start_ns is None:
            self._start_ns = max(newest, self._newest_ns)
        end_ns = self._start_ns + self._window_ns
        if min(newest, self._newest_ns) < end_ns:
            return
        standstill = wheels.standstill(self._start_ns, end_ns)
        stood = None if standstill is None else self._gyro.turn(*standstill, 0.0)
        if stood is not None:
            self._standstills.append(stood)
        turn = self._gyro.turn(self._start_ns, end_ns, float(wheels.motion(self._start_ns, end_ns).delta[2]))
        angle, variance = 0.0, math.inf
        if turn is not None:
            angle, variance = turn.angle, turn.variance + (self._noise.scale_sigma * turn.angle) ** 2
        yield Span(self._start_ns, end_ns, np.array([0.0, 0.0, angle]), np.diag([math.inf, math.inf, variance]), is_valid=turn is not None)
        self._start_ns = end_ns

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        """See `MotionReference.correct`."""
        bias, sigma = self._measure_bias()
        corrected = []
        for span in spans:
            duration = (span.end_ns - span.start_ns) * _NS
            cov = span.cov + np.diag([0.0, 0.0, (sigma * duration) ** 2])
            yaw = se2.wrap_angle(np.asarray(span.measured[2] - bias * duration))
            corrected.append(replace(span, measured=np.array([0.0, 0.0, float(yaw)]), cov=cov))
        return corrected

    def _measure_bias(self) -> tuple[float, float]:
        """Bias and sigma by the standstills [rad/s]; those of the noise model where there are none."""
        stood = [turn for turn in self._standstills if abs(turn.angle) < _MAX_GYRO_BIAS * turn.duration]
        if not stood:
            return 0.0, self._noise.bias_sigma_rad_per_s
        angles, durations = np.array([turn.angle for turn in stood]), np.array([turn.duration for turn in stood])
        seconds, n = float(durations.sum()), len(stood)
        bias = float(angles.sum()) / seconds
        # The scatter covers the noise, and the bias's walk between the stops.
        scatter = float(np.linalg.norm(angles - bias * durations)) / seconds * math.sqrt(n / (n - 1)) if n > 1 else 0.0
        self._bias = bias, seconds
        return bias, max(scatter, self._noise.white_rad_per_sqrt_s / math.sqrt(seconds))

    def warnings(self) -> list[Message]:
        """See `MotionReference.warnings`."""
        if self._bias is None:
            note = message("motion_reference.no_rest")
        else:
            note = message("motion_reference.bias", bias=self._bias[0], seconds=self._bias[1])
        return [note, *self._gyro.warnings()]


class LidarMotionReference:
    """Scan matching alone: the last scan of each window against the submap of its first. Spans run between the middles of sweeps.

    Scans between lead from one to the other. Wheels are the prior of each match, also along directions that the scene leaves open, and
    the twist within a sweep is theirs plus the slip of the last match. The measured pose and its covariance are without that prior.
    """

    def __init__(self, mounts: Mapping[str, Mount], window_s: float, config: LidarConfig | None = None) -> None:
        """``window_s``: length of the spans [s]; each has one key scan, whatever ``config`` has."""
        self._mounts, self._window_ns = mounts, round(window_s / _NS)
        self._config = replace(config or LidarConfig(), key_scans=1)
        self._matcher: ScanMatcher | None = None
        self._start_ns: int | None = None
        self._last_ns = self._last_scan_ns = 0
        self._max_gap_s, self._first_gaps_s = _MAX_SCAN_GAP_S, list[float]()
        self._pose, self._slip = np.zeros(3), np.zeros(3)
        self._first_points = np.empty((0, 2))
        self._unmatched = self._scans = self._open = 0

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """See `MotionReference.spans`."""
        if not isinstance(event, Scan) or wheels.buffer.newest_ns is None:
            return
        self._scans += 1
        stamp_ns = event.middle_ns
        self._adapt_to_rate(stamp_ns)
        if self._matcher is None or self._start_ns is None or (stamp_ns - self._last_ns) * _NS > self._max_gap_s:
            self._slip = np.zeros(3)
            self._begin(stamp_ns, self._deskew(self._sweep(event), event, wheels))
            return
        is_complete = stamp_ns - self._start_ns >= self._window_ns
        if wheels.is_standing(self._start_ns, stamp_ns):
            self._slip = np.zeros(3)
            self._last_ns = stamp_ns
            if is_complete:
                yield Span(self._start_ns, stamp_ns, np.zeros(3), _STANDSTILL_COV)
                self._begin(stamp_ns, self._deskew(self._sweep(event), event, wheels))
            return
        if not is_complete and self._is_near_last(stamp_ns, wheels):
            return
        match, points = self._match(self._matcher, event, wheels)
        if is_complete:
            yield self._span(stamp_ns, match, self._range_slope(match, points, event.frame_id))
            self._begin(stamp_ns, points)

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        """See `MotionReference.correct`."""
        return list(spans)

    def warnings(self) -> list[Message]:
        """See `MotionReference.warnings`."""
        notes = [message("motion_reference.open", count=self._open)] if self._open else []
        if self._unmatched:
            notes.append(message("motion_reference.unmatched", count=self._unmatched, scans=self._scans))
        return notes

    def _adapt_to_rate(self, stamp_ns: int) -> None:
        """Let the longest gap within a window follow the median of the first gaps between scans: keyframes may be seconds apart."""
        if len(self._first_gaps_s) < _RATE_GAPS and self._scans > 1:
            self._first_gaps_s.append((stamp_ns - self._last_scan_ns) * _NS)
            self._max_gap_s = max(_MAX_SCAN_GAP_S, MAX_GAP_OVER_PERIOD * float(np.median(self._first_gaps_s)))
        self._last_scan_ns = stamp_ns

    def _is_near_last(self, stamp_ns: int, wheels: Wheels) -> bool:
        """Whether the robot has hardly moved since the last matched scan, and not for long."""
        if (stamp_ns - self._last_ns) * _NS >= _MAX_UNMATCHED_S:
            return False
        moved = wheels.motion(self._last_ns, stamp_ns).delta
        return math.hypot(moved[0], moved[1]) < _MAX_UNMATCHED_M and abs(float(moved[2])) < _MAX_UNMATCHED_RAD

    def _range_slope(self, match: ScanMatch | None, points: FloatArray, frame: str) -> FloatArray | None:
        """(3,) see `Span.range_slope`: both scans of the window with shorter and with longer ranges, matched from where they fit.

        Against ``match`` the difference would hold the noise of ``match``, and that noise would look like a bias of the ranges.
        """
        if match is None or self._matcher is None:
            return None
        mount = self._mounts.get(frame, Mount())
        sensor = np.array([mount.x, mount.y])
        moved = []
        for step in (-_RANGE_STEP_M, _RANGE_STEP_M):
            matcher = ScanMatcher(self._config, self._matcher.submap.cell)
            matcher.insert_key_scan(np.zeros(3), _with_longer_ranges(self._first_points, sensor, step))
            shifted = matcher.refine(_with_longer_ranges(points, sensor, step), match.pose, np.diag(_PRIOR_SIGMA**2), match)
            if shifted is None:
                return None
            moved.append(shifted.measured)
        return np.asarray((moved[1] - moved[0]) / (2.0 * _RANGE_STEP_M))

    def _begin(self, stamp_ns: int, points: FloatArray) -> None:
        """A window begins with a scan of these ``points`` (N, 2), or with the next one if they are too few."""
        self._last_ns, self._pose, self._first_points = stamp_ns, np.zeros(3), points
        self._start_ns = stamp_ns if len(points) >= MIN_POINTS else None
        if self._start_ns is None:
            return
        if self._matcher is None:
            self._matcher = ScanMatcher(self._config, choose_cell(self._config, points))
        self._matcher.insert_key_scan(self._pose, points)

    def _match(self, matcher: ScanMatcher, scan: Scan, wheels: Wheels) -> tuple[ScanMatch | None, FloatArray]:
        """The match of ``scan`` with the first of its window, and its points (M, 2) as they were deskewed. Without a match, the pose is
        the wheels'."""
        motion = wheels.motion(self._last_ns, scan.middle_ns)
        prior = se2.compose(self._pose, motion.delta)
        cov = motion.cov + np.diag(_PRIOR_SIGMA**2 + np.array([0.0, 0.0, (_TURN_ERROR * motion.delta[2]) ** 2]))
        sweep = self._sweep(scan)
        points = self._deskew(sweep, scan, wheels)
        match, gap = None, (scan.middle_ns - self._last_ns) * _NS
        if len(points) >= MIN_POINTS:
            match = matcher.match(points, prior, cov)
            if match is not None and gap > 0.0:
                self._slip = (se2.local(self._pose, match.pose) - se2.log(motion.delta)) / gap
                points = self._deskew(sweep, scan, wheels)
                match = matcher.refine(points, prior, cov, match)
        self._unmatched += match is None
        self._pose, self._last_ns = prior if match is None else match.pose, scan.middle_ns
        return match, points

    def _span(self, end_ns: int, match: ScanMatch | None, range_slope: FloatArray | None) -> Span:
        assert self._start_ns is not None
        if match is None:
            return Span(self._start_ns, end_ns, self._pose, np.eye(3), is_valid=False)
        cov = match.cov
        if np.linalg.eigvalsh(cov[:2, :2])[1] > _OPEN_SIGMA_M**2:
            self._open += 1
            cov = np.diag([math.inf, math.inf, cov[2, 2]])
        return Span(self._start_ns, end_ns, match.measured, cov, range_slope=range_slope)

    def _sweep(self, scan: Scan) -> Sweep:
        mount = self._mounts.get(scan.frame_id, Mount())
        return Sweep.from_scan(scan, mount, self._config.min_range_m, self._config.max_range_m)

    def _deskew(self, sweep: Sweep, scan: Scan, wheels: Wheels) -> FloatArray:
        """(M, 2) what is matched in the plane, at the middle of the sweep: the wheels' mean twist within it, and their last slip."""
        if not len(sweep.times):
            return sweep.project(sweep.points)
        half = max(round(0.5 * float(np.ptp(sweep.times)) / _NS), 1)
        driven = wheels.motion(scan.middle_ns - half, scan.middle_ns + half).delta
        return sweep.project(sweep.deskew(se2.log(driven) / (2 * half * _NS) + self._slip))


def _with_longer_ranges(points: FloatArray, sensor: FloatArray, step_m: float) -> FloatArray:
    """(N, 2) points whose distances from the ``sensor`` (2,) are longer by ``step_m``, and never negative."""
    rays = points - sensor
    r = np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(sensor + np.maximum(r + step_m, 0.0) * rays / np.maximum(r, 1e-9))


class TrackMotionReference:
    """A reference with headings that the user names: motion capture, a total station with a compass, another estimator."""

    def __init__(self, track: ReferenceTrack, window_s: float, sigmas: tuple[float, float] | None = None) -> None:
        """``sigmas``: noise of its poses [m, rad]; by default its covariances, or `REFERENCE_SIGMA_M` and `_REFERENCE_SIGMA_RAD`.

        Raises `EvaluationError` for a reference of positions only, and for negative ``sigmas``.
        """
        given = track if sigmas is None else replace(track, covariances=None)
        noise = with_noise(given, *(sigmas or (REFERENCE_SIGMA_M, _REFERENCE_SIGMA_RAD))).covariances
        assert noise is not None
        self._track = Trajectory(track.stamps_ns, track.poses, covariances_in_body(noise, track.poses[:, 2]))
        self._warnings = (*track.warnings, *([] if sigmas is not None else [_describe_noise(track, noise)]))
        self._window_ns = round(window_s / _NS)
        self._start_ns: int | None = None
        self._stamps = track.stamps_ns
        period_s = float(np.median(np.diff(track.stamps_ns))) * _NS if len(track.stamps_ns) > 1 else 0.0
        self._is_sparse = period_s > MAX_REFERENCE_GAP_S
        self._max_gap_s = max(MAX_REFERENCE_GAP_S, MAX_GAP_OVER_PERIOD * period_s)

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """See `MotionReference.spans`."""
        newest = wheels.buffer.newest_ns
        if newest is None:
            return
        if self._start_ns is None:
            self._start_ns = self._at_stamp(newest)
        end_ns = self._at_stamp(self._start_ns + self._window_ns)
        if newest < end_ns:
            return
        is_covered = bool(self._track.covers([self._start_ns, end_ns], self._max_gap_s).all())
        if is_covered:
            yield self._span(self._start_ns, end_ns)
        else:
            yield Span(self._start_ns, end_ns, np.zeros(3), np.eye(3), is_valid=False)
        self._start_ns = end_ns

    def _span(self, start_ns: int, end_ns: int) -> Span:
        """Motion between two poses that err independently: P = P_1 + A P_0 A^T with A the adjoint of the inverse motion."""
        start, end = self._track.at([start_ns, end_ns])
        noise = self._track.covariances_at([start_ns, end_ns])
        assert noise is not None
        measured = se2.between(start, end)
        a = se2.adjoint(se2.inverse(measured))
        return Span(start_ns, end_ns, measured, noise[1] + a @ noise[0] @ a.T + _FINEST_SIGMA**2 * np.eye(3))

    def _at_stamp(self, moment_ns: int) -> int:
        """``moment_ns``, or for a sparse reference the first of its stamps from then on: between them nothing was measured."""
        i = int(np.searchsorted(self._stamps, moment_ns))
        return int(self._stamps[i]) if self._is_sparse and i < len(self._stamps) else moment_ns

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        """See `MotionReference.correct`."""
        return list(spans)

    def warnings(self) -> list[Message]:
        """See `MotionReference.warnings`."""
        return list(self._warnings)


def _describe_noise(track: ReferenceTrack, noise: FloatArray) -> Message:
    """Noise (N, 3, 3) of a reference's poses, and where it is from."""
    x, y, yaw = np.sqrt(np.median(np.diagonal(noise, axis1=1, axis2=2), axis=0))
    sizes = {"sigma_mm": 1e3 * math.hypot(x, y) / math.sqrt(2.0), "sigma_deg": math.degrees(yaw)}
    if track.covariances is None:
        return message("motion_reference.no_covariances", source=track.source, **sizes)
    return message("motion_reference.covariances", source=track.source, **sizes)
