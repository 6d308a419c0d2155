"""Turns by gyro and wheels against the covariances of both, whatever the reason; learned parameters against the robot file.

A filter that is right has white innovations nu_k with the variances S_k that it computes: over any window the sum of nu has the variance
sum of S (Bar-Shalom, Li, Kirubarajan 2001, 5.4: time-average test). A fault that the filter learns, as a factor, leaves white innovations:
there the learned parameter is far from the robot file.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from localization.estimators import LearnedParameter, Residuals
from localization.events import Step
from localization.sensor_checks.faults import DetectedFault, Fault, FaultLog
from localization.sensor_checks.gyro_rate import GYRO_RATE
from localization.sensor_checks.standstill import WHEELS_STANDING
from localization.sensor_checks.turn_rates import GYRO_OPPOSITE, GYRO_STUCK, GYRO_UNIT, WHEELS_OPPOSITE, WHEELS_SPIN
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2

TURNS_DIFFER = Fault(
    "for {seconds:.0f} s in all the turns by the gyro and those by the wheels differ by more than both sensors' noise ({sigmas:.1f} sigma:"
    " {degrees:+.0f} deg in {window:.0f} s). {cause} {use}",
)
PARAMETER_FAR = Fault(
    "{name} is learned as {value:.3g} +- {sigma:.2g}, {sigmas:.0f} sigma from this robot's file ({file:.3g}). Another floor or load, a"
    " wrong scale of the gyro, or encoders that lose counts. {use} Fit the file with `skidloc calibrate`.",
)
_NAMED = (GYRO_RATE, GYRO_OPPOSITE, GYRO_STUCK, GYRO_UNIT, WHEELS_OPPOSITE, WHEELS_SPIN, WHEELS_STANDING)
"""Faults that explain why turns differ."""
_NAMED_WITHIN_S = 10.0
"""A named fault is found at most so long after the turns begin to differ."""

_BIN_S = 0.25
_WINDOWS_S = (2.0, 10.0, 60.0)
_MAX_SIGMAS = 4.5
"""Largest sum of innovations over a window, in sigmas: 7e-6 by chance, one of 60 hours. Simulated drives of six robots have at most 4.0,
the Husky outdoors 1.0; gyros with a range of 20 deg/s or a jump of the bias, and encoders that lose 30 % have 4.3 and more."""
_FLOOR_RAD = 0.01
"""Turn of a standing robot that no model has: tyres that relax, someone who leans on it [rad]."""
_MIN_LEARNED_SIGMAS = 4.0
"""Distance of a learned factor on turns from the robot file's, in its own sigmas."""
_MIN_TURNING_SIGMAS, _MIN_TURNING_SHARE = 1.4, 0.18
"""Factors on turns stand for the gyro's scale as well, whose prior is far narrower: they count from so many sigmas of the prior
on, and from this share of the file's value. ACES, fr079, CSAIL and the Husky outdoors have 0.2 sigmas and 3 %, simulated robots 11 %
(two wheels, and a caster that drags)."""
_TURNING = ("k_0", "wheel_separation_multiplier", "rotation_scale")
_MATCHED_S = 2.0
"""Scans that were matched so recently hold the pose, whatever wheels and gyro do [s]."""
_MAX_CLIPPED_SIGMAS = 3.0
"""Largest sum of innovations over a window, in sigmas, where the gyro's rates end at a value."""
_OTHER = {"left": "right", "right": "left"}
_REPEATED_RAD_S, _MIN_REPEATED_S, _MIN_CLIPPED_RAD_S = 1e-9, 0.5, 0.05
"""Rates that are equal to the last digit, for so long, and far from zero, are the end of the gyro's range."""
_USE_WITHOUT_SCANS = "The covariance has the distance between both while that lasts."
_USE_WITH_SCANS = "The scans decide."


class _Bin(NamedTuple):
    """Sums over a quarter of a second or more."""

    end_s: float
    innovation: float
    variance: float
    turn: float
    """By the wheels [rad]."""
    way: float
    """[m]"""
    seconds: float
    estimated: Pose2
    """(3,) pose at the end."""
    by_file: Pose2
    """(3,) dead reckoning by wheels with the robot file's parameters, from the same start."""


class _Reported(NamedTuple):
    """What was reported of a fault."""

    begin_s: float
    seconds: float
    sigmas: float
    numbers: Mapping[str, float | str]


class TurnConsistency:
    """Leaves out nothing, as either may be right. While it lasts the covariance has the distance of the estimate from the dead reckoning by
    the wheels with the robot file's parameters; it stays afterwards, as no scan takes it back."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._clipping = faults, _Clipping()
        self._bins: deque[_Bin] = deque()
        self._estimated, self._by_file, self._file_delta = np.zeros(3), np.zeros(3), np.zeros(3)
        self._sums = np.zeros(5)  # of the open bin: innovation, variance, turn, way, time
        self._has_moved = False
        self._matched_s = -math.inf
        self._begin: tuple[float, Pose2, Pose2] | None = None
        """Beginning of the present episode: its time [s], and both poses (3,) there."""

        self._reported: dict[Fault, _Reported] = {}

    def add(self, step: Step, residuals: Residuals, learned: Callable[[], Sequence[LearnedParameter]]) -> None:
        """Take the ``residuals`` of ``step``; compare once for each bin."""
        self._file_delta = residuals.file_delta
        self._has_moved |= not step.is_standing
        if residuals.turn is None or step.turn is None or not step.has_wheels or not self._has_moved:
            return  # before the first motion, the bias is measured
        delta = step.predicted.delta
        self._sums += [*residuals.turn, delta[2], math.hypot(delta[0], delta[1]), step.duration]
        self._clipping.add(step.turn.angle / step.duration, step.duration)
        if self._sums[4] < _BIN_S:
            return
        innovation, variance, turn, way, seconds = self._sums.tolist()
        self._bins.append(_Bin(self._faults.now_s, innovation, variance, turn, way, seconds, self._estimated, self._by_file))
        self._sums[:] = 0.0
        while self._bins[0].end_s < self._faults.now_s - _WINDOWS_S[-1]:
            self._bins.popleft()
        self._compare(learned())

    def compare_estimate(self, delta: Pose2, nis: float | None) -> None:
        """The last step moved the estimate by ``delta`` (3,); ``nis`` of its scan, if one was matched."""
        self._estimated = se2.compose(self._estimated, delta)
        self._by_file = se2.compose(self._by_file, self._file_delta)
        if nis is not None:
            self._matched_s = self._faults.now_s
        if self._begin is not None:
            self._faults.inflation.ongoing_turn = None if self._has_scans else self._difference(self._begin)

    @property
    def _has_scans(self) -> bool:
        return self._faults.now_s - self._matched_s < _MATCHED_S

    def _difference(self, begin: tuple[float, Pose2, Pose2]) -> FloatArray:
        """(3,) of the dead reckoning from the estimate since ``begin``."""
        _, estimated, by_file = begin
        return se2.log(se2.between(se2.between(estimated, self._estimated), se2.between(by_file, self._by_file)))

    def _compare(self, learned: Sequence[LearnedParameter]) -> None:
        """Report what differs now, and begin or end an episode."""
        named = [self._faults.found[fault].at_s for fault in _NAMED if fault in self._faults]
        windows = [window for seconds in _WINDOWS_S if (window := _Window.of(self._bins, seconds)) is not None]
        worst = max(windows, key=lambda window: window.sigmas, default=None)
        limit = _MAX_SIGMAS if not self._clipping.is_clipped else _MAX_CLIPPED_SIGMAS
        off = _farthest(learned)
        if worst is not None and worst.sigmas < limit:
            worst = None
        if named and self._begin is not None and named[0] - self._begin[0] < _NAMED_WITHIN_S:
            self._faults.retract(TURNS_DIFFER)
            self._faults.retract(PARAMETER_FAR)
            self._reported.clear()
            self._end()
        if (worst is None and off is None) or (named and self._begin is None):
            self._end()
            return
        if self._begin is None:
            first = self._bins[0] if worst is None else worst.bins[0]
            self._begin = first.end_s, first.estimated, first.by_file
        use = _USE_WITH_SCANS if self._has_scans else _USE_WITHOUT_SCANS
        if worst is not None:
            cause = self._clipping.describe() or worst.explain()
            numbers: dict[str, float | str] = {
                "degrees": math.degrees(worst.innovation),
                "window": worst.seconds,
                "cause": cause,
                "use": use,
            }
            self._report(TURNS_DIFFER, worst.sigmas, numbers)
        if off is not None:
            numbers = {"name": off.name, "value": off.value, "sigma": off.sigma, "file": off.file_value, "use": use}
            self._report(PARAMETER_FAR, abs(off.value - off.file_value) / off.sigma, numbers)

    def _report(self, fault: Fault, sigmas: float, numbers: Mapping[str, float | str]) -> None:
        """Report the begin of the first episode, the time of all, and the numbers of the worst moment."""
        assert self._begin is not None
        now = _Reported(self._begin[0], 0.0, sigmas, numbers)
        before = self._reported.get(fault, now)
        worst = now if sigmas >= before.sigmas else before
        seconds = before.seconds + self._bins[-1].seconds
        self._reported[fault] = _Reported(before.begin_s, seconds, worst.sigmas, worst.numbers)
        message = fault.message.format(seconds=seconds, sigmas=worst.sigmas, **worst.numbers)
        self._faults.revise(DetectedFault(fault, before.begin_s, message))

    def _end(self) -> None:
        """The sensors agree again: what the pose is off by stays."""
        if self._begin is not None and not self._has_scans:
            self._faults.inflation.add(self._difference(self._begin))
        self._begin = self._faults.inflation.ongoing_turn = None


def _farthest(learned: Sequence[LearnedParameter]) -> LearnedParameter | None:
    """The factor on turns that is farthest from the robot file, if it is too far by its own sigma and by that of its prior."""

    def distance(p: LearnedParameter) -> float:
        if p.name == "wheel_separation_multiplier" and p.file_value == 1.0 < p.value:
            return 0.0  # a driver's factor that nobody has set, of a robot that slides as it turns
        least = max(_MIN_TURNING_SIGMAS * p.prior_sigma, _MIN_TURNING_SHARE * abs(p.file_value), _MIN_LEARNED_SIGMAS * p.sigma)
        return abs(p.value - p.file_value) / least

    far = max((p for p in learned if p.name in _TURNING), key=distance, default=None)
    return far if far is not None and distance(far) > 1.0 else None


class _Window(NamedTuple):
    """The innovations of the last seconds."""

    bins: list[_Bin]
    seconds: float
    innovation: float
    """Their sum [rad]."""
    sigmas: float

    @classmethod
    def of(cls, bins: Sequence[_Bin], seconds: float) -> _Window | None:
        """Window of the last ``seconds`` [s]; None where there are not enough."""
        inside = [b for b in bins if b.end_s > bins[-1].end_s - seconds]
        if sum(b.seconds for b in inside) < 0.9 * seconds:
            return None
        total, variance = sum(b.innovation for b in inside), sum(b.variance for b in inside)
        return cls(inside, seconds, total, abs(total) / math.sqrt(variance + _FLOOR_RAD**2))

    def explain(self) -> str:
        """What explains the innovations best, of a change of the bias, a factor on turns, and a side that loses counts."""
        if not any(b.way or b.turn for b in self.bins):
            return "The wheels stand: the gyro's bias has changed, or the robot was turned by something else."
        weights = np.array([1.0 / b.variance for b in self.bins])
        innovations = np.array([b.innovation for b in self.bins])

        def fit(values: list[float]) -> tuple[float, float]:
            """Chi-square that a multiple of ``values`` takes away, and the factor."""
            x = np.array(values)
            power = float(weights @ x**2)
            product = float(weights @ (x * innovations))
            return (product**2 / power, product / power) if power else (0.0, 0.0)

        by_bias, by_turn = fit([b.seconds for b in self.bins]), fit([b.turn for b in self.bins])
        by_way = fit([b.way for b in self.bins])
        best = max(by_bias, by_turn, by_way)
        if best is by_bias:
            return f"A change of the gyro's bias by {math.degrees(best[1]):+.1f} deg/s explains it best."
        if best is by_turn:
            return (
                f"A factor of {1.0 + best[1]:.2f} on the wheels' turns explains it best: a floor that is more or less slippery, encoders"
                " that lose counts, or the gyro's scale."
            )
        side = "left" if best[1] < 0.0 else "right"
        return f"Encoders that lose counts, or a smaller radius, of the {side} wheels explain it best, or the {_OTHER[side]} ones spin."


class _Clipping:
    """Whether a gyro's rates end at a value: the end of its range."""

    def __init__(self) -> None:
        self._largest = self._seconds = 0.0

    def add(self, rate: float, seconds: float) -> None:
        """Mean ``rate`` of the gyro over a step [rad/s]."""
        size = abs(rate)
        if size > self._largest + _REPEATED_RAD_S:
            self._largest, self._seconds = size, 0.0
        elif size >= self._largest - _REPEATED_RAD_S:
            self._seconds += seconds

    @property
    def is_clipped(self) -> bool:
        """Its largest rate lasts, to the last digit."""
        return self._largest > _MIN_CLIPPED_RAD_S and self._seconds >= _MIN_REPEATED_S

    def describe(self) -> str:
        """The fault in a sentence; "" without one."""
        if not self.is_clipped:
            return ""
        return f"The gyro's rates end at {math.degrees(self._largest):.3g} deg/s, its range: set a larger one, or turn more slowly."
