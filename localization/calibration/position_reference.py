"""Positions without headings (GPS of centimetres, total stations, a prism) as what measures the motion that the wheels' is compared with.

The robot's heading in the frame of its positions is unknown, so that each window has a heading of its own. Three positions of a window
leave the lengths of two chords and the angle between them (`motion_models.calibration.chords`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from localization.calibration.motion_references import MAX_GAP_OVER_PERIOD, MAX_REFERENCE_GAP_S, REFERENCE_SIGMA_M, Span, Wheels
from localization.errors import EvaluationError
from localization.evaluation.references import ReferenceTrack
from localization.events import Event
from localization.messages import Message, message
from motion_models.calibration.chords import chord_covariances, chord_poses
from motion_models.errors import CalibrationError
from motion_models.se2 import FloatArray

_NS = 1e-9
_MIN_CHORD_SIGMAS = 8.0
"""Length of a chord over the sigma of its ends' difference, from which on its direction is nearly linear in their noise: 0.12 rad."""
_MIN_PREDICTED = 0.4
"""Least length of a chord by the wheels over that by the positions: where the wheels hardly move the antenna, it has no direction."""
_FEWEST = 5
"""Windows below which positions are refused if most were too coarse."""
_FINEST_M = 1e-4


class PositionMotionReference:
    """Two chords of ``window_s`` in each window, between stamps of the positions themselves."""

    def __init__(
        self,
        track: ReferenceTrack,
        window_s: float,
        antenna: tuple[float, float] | None = None,
        sigma_m: float | None = None,
        guess: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """``antenna``: where in the body frame the positions are measured [m]; None where that is unknown, and about at the ``guess``.
        ``sigma_m``: noise of x and y of a position; by default its covariances, and `REFERENCE_SIGMA_M` without any. Raises
        `EvaluationError` for a negative one."""
        if sigma_m is not None and not (math.isfinite(sigma_m) and sigma_m >= 0.0):
            raise EvaluationError(f"noise of the reference is {sigma_m} m; it must be 0 or more.")
        self.antenna = guess if antenna is None else antenna
        self.is_antenna_known = antenna is not None
        self._track, self._window_ns = track, round(window_s / _NS)
        self._noise, self._sigma_given = _noise(track, sigma_m), sigma_m
        stamps = track.stamps_ns
        period_s = float(np.median(np.diff(stamps))) * _NS if len(stamps) > 1 else 0.0
        self._max_gap_ns = round(max(MAX_REFERENCE_GAP_S, MAX_GAP_OVER_PERIOD * period_s) / _NS)
        self._start: int | None = None
        self._coarse = 0
        self._sigma_m = float(np.sqrt(np.median(np.trace(self._noise, axis1=1, axis2=2)) / 2.0))
        self._is_given = sigma_m is not None or track.covariances is not None

    def spans(self, event: Event, wheels: Wheels) -> Iterator[Span]:
        """See `MotionReference.spans`."""
        newest, stamps = wheels.buffer.newest_ns, self._track.stamps_ns
        if newest is None:
            return
        if self._start is None:
            self._start = int(np.searchsorted(stamps, newest))
        while True:
            middle = self._after(self._start)
            end = self._after(middle)
            if end >= len(stamps) or newest < stamps[end]:
                return
            yield self._span(self._start, middle, end, wheels)
            self._start = end

    def _after(self, index: int) -> int:
        """Index of the first position from a window's length after that of ``index`` on; the number of positions where there is none."""
        stamps = self._track.stamps_ns
        return len(stamps) if index >= len(stamps) else int(np.searchsorted(stamps, stamps[index] + self._window_ns))

    def _span(self, start: int, middle: int, end: int, wheels: Wheels) -> Span:
        at = [start, middle, end]
        stamps, (p0, p1, p2) = self._track.stamps_ns[at], self._track.positions[at]
        first, both = (p1 - p0)[None], (p2 - p0)[None]
        nothing = Span(int(stamps[0]), int(stamps[2]), np.zeros(3), np.eye(3), is_valid=False)
        if np.diff(stamps).max() > self._window_ns + self._max_gap_ns:
            return nothing
        chords = np.array([p1 - p0, p2 - p1])
        lengths = np.linalg.norm(chords, axis=1)
        sigmas = np.sqrt([np.trace(self._noise[i] + self._noise[j]) / 2.0 for i, j in ((start, middle), (middle, end))])
        by_wheels = [self._way(int(a), int(b), wheels) for a, b in ((stamps[0], stamps[1]), (stamps[1], stamps[2]))]
        if (by_wheels < _MIN_PREDICTED * lengths).any() or not lengths.all():
            return nothing
        if (lengths < _MIN_CHORD_SIGMAS * sigmas).any():
            self._coarse += 1
            return nothing
        cov = chord_covariances(first, both, self._noise[None, at])[0]
        # noise across a chord makes it longer by sigma^2 / (2 l) in the mean
        shorter = chords * (1.0 - 0.5 * np.square(sigmas / lengths))[:, None]
        measured = chord_poses(shorter[:1], shorter.sum(axis=0)[None])[0]
        return Span(int(stamps[0]), int(stamps[2]), measured, cov, middle_ns=int(stamps[1]))

    def _way(self, start_ns: int, end_ns: int, wheels: Wheels) -> float:
        """Length of the antenna's displacement by the wheels [m]."""
        x, y, yaw = wheels.motion(start_ns, end_ns).delta
        lever = complex(*self.antenna)
        return abs(complex(x, y) + (complex(math.cos(yaw), math.sin(yaw)) - 1.0) * lever)

    def with_guess(self, guess: tuple[float, float]) -> PositionMotionReference:
        """One for the same log from its beginning, with this ``guess`` of the antenna."""
        return PositionMotionReference(self._track, self._window_ns * _NS, None, self._sigma_given, guess)

    def correct(self, spans: Sequence[Span]) -> list[Span]:
        """See `MotionReference.correct`. Raises `CalibrationError` where most windows were shorter than the positions' noise allows."""
        if len(spans) < _FEWEST and self._coarse > len(spans):
            need = 1.2 * _MIN_CHORD_SIGMAS * math.sqrt(2.0) * self._sigma_m
            raise CalibrationError(
                f"the positions of {self._track.source} are too coarse: they err by {self._sigma_m:.2g} m, and in {self._coarse} windows"
                f" the robot moved less than the {need:.2g} m that two chords need at that noise. Take positions of centimetres (RTK, a"
                " total station), faster driving or a longer --window-s, a reference with headings, a LiDAR or a gyro."
            )
        return list(spans)

    def warnings(self) -> list[Message]:
        """See `MotionReference.warnings`."""
        name = self._track.source
        about = {"sigma_mm": 1e3 * self._sigma_m, "chord_s": self._window_ns * _NS}
        if self._is_given:
            noise = message("positions_as_reference.given_noise", source=name, **about)
        else:
            noise = message("positions_as_reference.assumed_noise", source=name, **about)
        notes = [*self._track.warnings, noise]
        if not self.is_antenna_known:
            notes.append(message("positions_as_reference.antenna", source=name))
        if self._coarse == 1:
            notes.append(message("positions_as_reference.short_chord", source=name))
        elif self._coarse:
            notes.append(message("positions_as_reference.short_chords", source=name, count=self._coarse))
        return notes


def _noise(track: ReferenceTrack, sigma_m: float | None) -> FloatArray:
    """(N, 2, 2) covariances of the positions [m^2]."""
    usual = np.eye(2) * (REFERENCE_SIGMA_M if sigma_m is None else max(sigma_m, _FINEST_M)) ** 2
    found = np.broadcast_to(usual, (len(track.stamps_ns), 2, 2))
    if sigma_m is None and track.covariances is not None:
        given = track.covariances[:, :2, :2]
        is_known = np.isfinite(given).all(axis=(1, 2), keepdims=True)
        found = np.where(is_known, given + _FINEST_M**2 * np.eye(2), found)
    return np.array(found)
