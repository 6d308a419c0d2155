"""Who measures the motion that the wheels are held against: a LiDAR, a gyro, or a reference that the user names."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from localization.events import Event, ImuSample, Scan
from localization.gyro import GyroHistory
from localization.lidar import LidarConfig, LidarMatcher, body_points
from localization.references import ReferenceTrack
from localization.trajectory import Trajectory
from localization.wheel_history import WheelHistory
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.integrate import integrate_twists
from motion_models.robot import GyroNoise, Mount, WheelNoise
from motion_models.se2 import FloatArray

_NS = 1e-9
_LONGEST_SCAN_GAP_S, _LONGEST_REFERENCE_GAP_S = 1.0, 0.5
HOLD_S = 0.5
"""Without a new sample, the wheels' last rates hold for this time [s]."""
_LOST = np.array([0.1, 0.1, 0.1])  # sigma of the guess that starts a scan's search, beyond the wheels' slip [m, m, rad]
_WRONG_TURN = 0.5  # how wrong the nominal model may be about a turn, as sigma over its size
_HOLDS_M = 0.05  # sigma of a position beyond which a scene counts as a corridor: matching then slides towards no motion at all
_STANDING = np.diag([1e-12, 1e-12, 1e-12])


@dataclass(frozen=True)
class Span:
    """What a witness measured of one stretch of time."""

    start_ns: int
    end_ns: int
    measured: FloatArray
    """(3,) pose at the end seen from that at the start [m, m, rad]."""
    cov: FloatArray
    """(3, 3) of its right perturbation, inf on the diagonal for what is not measured."""
    is_trusted: bool = True


@dataclass(frozen=True)
class Wheels:
    """The wheels' latest motion, as the nominal model has it."""

    history: WheelHistory
    model: MotionModel
    noise: WheelNoise

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """What they say of this stretch; the last rates hold for half a second."""
        dt, rates, cg, _ = self.history.window(start_ns, end_ns, HOLD_S)
        return integrate_twists(dt, self.model.twist(rates, cg, self.model.nominal), self.noise)

    def stood(self, start_ns: int, end_ns: int) -> bool:
        """No wheel moved."""
        dt, rates, _, _ = self.history.window(start_ns, end_ns, HOLD_S)
        return len(dt) > 0 and not np.any(rates)


class Witness(Protocol):
    """Gets all events of one log, in order."""

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """Stretches that ``event`` completes, of the length that the witness was made for."""

    def correct(self, spans: Sequence[Span], still: Sequence[Span]) -> list[Span]:
        """``spans`` in the light of the whole log; ``still`` are those during which no wheel moved."""

    def notes(self) -> list[str]:
        """What a user should know."""


class GyroWitness:
    """Yaw by the gyro; its bias from the times at which the robot stood still. It knows nothing of positions."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount], window_s: float) -> None:
        self._noise, self._window_ns = noise, round(window_s / _NS)
        self._gyro = GyroHistory(noise, mounts, keep_s=2.0 * window_s + 10.0)
        self._start_ns = self._newest_ns = None  # type: int | None
        self._bias: tuple[float, float] | None = None

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        if isinstance(event, ImuSample):
            self._gyro.push(event)
            self._newest_ns = event.stamp_ns
        newest = wheels.history.newest_ns
        if newest is None or self._newest_ns is None:
            return
        if self._start_ns is None:
            self._start_ns = max(newest, self._newest_ns)
        end_ns = self._start_ns + self._window_ns
        if min(newest, self._newest_ns) < end_ns:
            return
        turn = self._gyro.turn(self._start_ns, end_ns, float(wheels.motion(self._start_ns, end_ns).delta[2]))
        angle, variance = (0.0, math.inf) if turn is None else (turn.angle, turn.variance)
        yield Span(
            self._start_ns, end_ns, np.array([0.0, 0.0, angle]), np.diag([math.inf, math.inf, variance]), is_trusted=turn is not None
        )
        self._start_ns = end_ns

    def correct(self, spans: Sequence[Span], still: Sequence[Span]) -> list[Span]:
        heard = [span for span in still if span.is_trusted]
        bias, sigma = 0.0, self._noise.bias_sigma_rad_per_s
        if heard:
            rates = np.array([span.measured[2] / ((span.end_ns - span.start_ns) * _NS) for span in heard])
            seconds = sum((span.end_ns - span.start_ns) * _NS for span in heard)
            # The scatter covers the noise, and the bias's walk between the stops.
            scatter = float(rates.std(ddof=1)) / math.sqrt(len(rates)) if len(rates) > 1 else 0.0
            bias, sigma = float(rates.mean()), max(scatter, self._noise.white_rad_per_sqrt_s / math.sqrt(seconds))
            self._bias = bias, seconds
        corrected = []
        for span in spans:
            duration = (span.end_ns - span.start_ns) * _NS
            cov = span.cov + np.diag([0.0, 0.0, (sigma * duration) ** 2])
            yaw = se2.wrap_angle(np.asarray(span.measured[2] - bias * duration))
            corrected.append(dataclasses.replace(span, measured=np.array([0.0, 0.0, float(yaw)]), cov=cov))
        return corrected

    def notes(self) -> list[str]:
        if self._bias is None:
            said = "the robot never stood still, so the gyro's bias is not known and counts as error; let it stand for a few seconds."
        else:
            said = f"the gyro's bias is {self._bias[0]:+.5f} rad/s, by {self._bias[1]:.0f} s of standing still; it was taken off."
        return [said, *self._gyro.notes()]


class LidarWitness:
    """Scan matching alone: the last scan of each window against the first.

    The scans between lead from one to the other. The wheels start each search; neither the pose nor its covariance knows of them.
    """

    def __init__(self, mounts: Mapping[str, Mount], window_s: float, config: LidarConfig | None = None) -> None:
        self._mounts, self._window_ns = mounts, round(window_s / _NS)
        self._config = config or LidarConfig()
        self._matcher: LidarMatcher | None = None
        self._first: Scan | None = None
        self._start_ns = self._last_ns = 0
        self._pose, self._twist = np.zeros(3), np.zeros(3)
        self._mistrusted = self._scans = self._slippery = 0

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        if not isinstance(event, Scan) or wheels.history.newest_ns is None:
            return
        self._scans += 1
        gap = (event.stamp_ns - self._last_ns) * _NS
        if self._first is None or gap > _LONGEST_SCAN_GAP_S:
            self._twist = np.zeros(3)
            self._begin(event)
            return
        if wheels.stood(self._start_ns, event.stamp_ns):
            self._twist = np.zeros(3)
            if event.stamp_ns - self._start_ns >= self._window_ns:
                yield Span(self._start_ns, event.stamp_ns, np.zeros(3), _STANDING)
                self._begin(event)
            self._last_ns = event.stamp_ns
            return
        if self._matcher is None:
            self._matcher = LidarMatcher(self._config)
            self._matcher.register(self._points(self._first), self._first.is_planar, np.zeros(3), np.diag(_LOST**2))
            self._matcher.insert(np.zeros(3))
        trusted, cov = self._follow(self._matcher, event, wheels.motion(self._last_ns, event.stamp_ns), gap)
        if event.stamp_ns - self._start_ns >= self._window_ns:
            if trusted and np.linalg.eigvalsh(cov[:2, :2])[1] > _HOLDS_M**2:
                self._slippery += 1
                cov = np.diag([math.inf, math.inf, cov[2, 2]])
            yield Span(self._start_ns, event.stamp_ns, self._pose, cov, is_trusted=trusted)
            self._begin(event)

    def correct(self, spans: Sequence[Span], still: Sequence[Span]) -> list[Span]:
        return list(spans)

    def notes(self) -> list[str]:
        said = []
        if self._slippery:
            said.append(f"{self._slippery} windows count by their heading alone: along walls and corridors scans do not hold the place.")
        if not self._mistrusted:
            return said
        lost = f"{self._mistrusted} of {self._scans} scans could not be matched with the first of their window"
        return [f"{lost}; windows that end in one were left out."]

    def _begin(self, scan: Scan) -> None:
        self._first, self._matcher = scan, None
        self._start_ns = self._last_ns = scan.stamp_ns
        self._pose = np.zeros(3)

    def _follow(self, matcher: LidarMatcher, scan: Scan, driven: Motion, gap: float) -> tuple[bool, FloatArray]:
        guess = se2.compose(self._pose, driven.delta)
        spread = driven.cov + np.diag(_LOST**2 + np.array([0.0, 0.0, (_WRONG_TURN * driven.delta[2]) ** 2]))
        found = matcher.register(self._points(scan), scan.is_planar, guess, spread)
        trusted = found is not None and found.is_trusted
        pose, cov = (found.pose, found.cov) if found is not None and trusted else (guess, np.diag([1.0, 1.0, 1.0]))
        self._mistrusted += not trusted
        if trusted and gap > 0.0:
            self._twist = se2.log(se2.between(self._pose, pose)) / gap
        self._pose, self._last_ns = pose, scan.stamp_ns
        return trusted, cov

    def _points(self, scan: Scan) -> FloatArray:
        """The sweep is put right by the motion that the LiDAR itself saw last."""
        return body_points(scan, self._mounts.get(scan.frame_id, Mount()), self._twist)


class ReferenceWitness:
    """A reference with headings that the user names: motion capture, a total station with a compass, another estimator."""

    def __init__(self, track: ReferenceTrack, window_s: float, sigma_m: float = 0.02, sigma_rad: float = 0.01) -> None:
        """Raises `EvaluationError` for a reference of positions only."""
        self._track = Trajectory(track.stamps_ns, track.poses)
        self._notes = track.notes
        self._window_ns = round(window_s / _NS)
        # Of the motion between two poses that err independently.
        self._cov = 2.0 * np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
        self._start_ns: int | None = None

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        newest = wheels.history.newest_ns
        if newest is None:
            return
        if self._start_ns is None:
            self._start_ns = newest
        end_ns = self._start_ns + self._window_ns
        if newest < end_ns:
            return
        known = bool(self._track.covers([self._start_ns, end_ns], _LONGEST_REFERENCE_GAP_S).all())
        start, end = self._track.at([self._start_ns, end_ns])
        measured = se2.between(start, end) if known else np.zeros(3)
        yield Span(self._start_ns, end_ns, measured, self._cov, is_trusted=known)
        self._start_ns = end_ns

    def correct(self, spans: Sequence[Span], still: Sequence[Span]) -> list[Span]:
        return list(spans)

    def notes(self) -> list[str]:
        return list(self._notes)
