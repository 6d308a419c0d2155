"""Pairs of sensors that measure one quantity, against the covariances of both, whatever the reason; learned parameters against the file.

The filter's innovations are compared over windows (`innovations.py`). A fault that the filter learns, as a factor, leaves them white: there
the learned parameter is far from the robot file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from localization.estimators import LearnedParameter, Residuals
from localization.events import Step
from localization.messages import Message, Value, message, phrase
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault, is_certain
from localization.sensor_checks.innovations import (
    NO_REGRESSORS,
    TURN,
    TURN_CHANGE,
    InnovationWindows,
    Pair,
    add_step,
    log_bayes_factor,
)
from localization.sensor_checks.pairs import (
    CAUSES,
    GYRO_WHEELS,
    K_SIGMA,
    LIDAR_GYRO,
    LIDAR_WHEELS_TURNS,
    LIDAR_WHEELS_WAYS,
    NAMED,
)
from localization.sensor_checks.reckoning import FILE, FILE_GYRO
from localization.sensor_checks.scales import RADIUS, ScaleCheck
from motion_models.se2 import FloatArray

DIFFERENCES: Mapping[Pair, SensorFault] = {
    GYRO_WHEELS: SensorFault("sensor_pairs.gyro_and_wheels"),
    LIDAR_GYRO: SensorFault("sensor_pairs.lidar_and_gyro"),
    LIDAR_WHEELS_TURNS: SensorFault("sensor_pairs.turns_of_lidar_and_wheels"),
    LIDAR_WHEELS_WAYS: SensorFault("sensor_pairs.ways_of_lidar_and_wheels"),
}
"""What is reported of each pair that differs."""
PARAMETER_FAR = SensorFault(
    "sensor_pairs.learned",
)
_NAMED_WITHIN_S = 10.0
"""A named fault is found at most so long after a pair begins to differ."""
_MAX_SIGMAS = 4.5
"""Largest sum of innovations over a window, in sigmas: 7e-6 by chance, one of 60 hours. Largest of healthy drives: gyro and wheels 4.0 (six
simulated robots; Husky outdoors 1.0), LiDAR and gyro 3.3, ways by LiDAR and wheels 3.1 (ACES), turns by both 1.0 (ACES)."""
_PRIOR_SIGMAS, _FAULT_FACTOR = 1.645, 10.0
"""A robot file's value outside of its prior's 90 % interval is not relied on. Where something is wrong with a learned parameter, it is off
by ten times what it is off by in healthy robots."""
_CENTER_X = "x_cr"
"""Centre of rotation ahead of base_link, which in turns moves a LiDAR to the side as its own place ahead does."""
_MULTIPLIER = "wheel_separation_multiplier"
_TURNING = ("k_0", _MULTIPLIER, "rotation_scale")
_MATCHED_S = 2.0
"""Scans that were matched so recently hold the pose, whatever wheels and gyro do [s]."""
_MAX_CLIPPED_SIGMAS = 3.0
"""Largest sum of innovations over a window, in sigmas, where the gyro's rates end at a value."""
_REPEATED_RAD_S, _MIN_REPEATED_S, _MIN_CLIPPED_RAD_S = 1e-9, 0.5, 0.05
"""Rates that are equal to the last digit, for so long, and far from zero, are the end of the gyro's range."""


class _Episode(NamedTuple):
    """A time in which a pair differs, or a learned parameter is far from the robot file."""

    begin_s: float
    poses: FloatArray
    """(6, 3) at its begin, as `Reckoning` has them."""
    row: int
    """Row of the dead reckoning that the estimate is compared with."""
    is_by_lidar: bool = False
    """The LiDAR's stamps explain the difference: matched scans do not decide."""


class _Reported(NamedTuple):
    """A reported fault: its begin and significance."""

    begin_s: float
    sigmas: float


class SensorConsistency:
    """Leaves out nothing, as either sensor may be right. While a pair differs the covariance has the distance of the estimate from the
    dead reckoning by the wheels with the robot file's parameters (LiDAR and gyro: with the gyro's turns); it stays afterwards, as no scan
    takes it back. Where scans are matched, and it is not their stamps that explain the difference, they decide."""

    def __init__(self, faults: FaultLog, usual: Mapping[Pair, Mapping[int, float]]) -> None:
        """``usual``: what healthy wheels err by, as `pairs.usual_errors` has it."""
        self._faults, self._clipping, self._scales = faults, _Clipping(), ScaleCheck(faults)
        self._usual = usual
        self._windows = {pair: InnovationWindows(pair) for pair in NAMED}
        self._reckoning = faults.inflation.reckoning
        self._totals = NO_REGRESSORS
        self._has_moved = False
        self._driven_s = 0.0
        self._matched_s = -math.inf
        self._episodes: dict[SensorFault, _Episode] = {}
        self._reported: dict[SensorFault, _Reported] = {}
        self._inflation_reasons: dict[SensorFault, tuple[float, str]] = {}

    def inflation_reasons(self) -> list[Message]:
        """Why the covariance has more than the sensors' noise, though no fault is probable enough to be reported."""
        reasons = [(at_s, what) for fault, (at_s, what) in self._inflation_reasons.items() if fault not in self._faults.found]
        return [message("sensor_pairs.widened", at_s=max(at_s, 0.0), what=what) for at_s, what in reasons]

    def add(self, step: Step, residuals: Residuals, learned: Callable[[], Sequence[LearnedParameter]]) -> None:
        """Take the ``residuals`` of ``step``; compare each pair once for each bin."""
        self._has_moved |= not step.is_standing
        self._driven_s += 0.0 if step.is_standing else step.duration
        self._totals = add_step(self._totals, step)
        if not self._has_moved:
            return  # before the first motion, the bias is measured
        if step.turn is not None and step.has_wheels:
            self._clipping.add(step.turn.angle / step.duration, step.duration)
        has_ended = False
        for pair, innovation in _innovations(step, residuals):
            if innovation is None:
                continue
            if self._windows[pair].add(*innovation, self._totals, self._faults.now_s, residuals.bias_sigma, self._reckoning.poses):
                self._compare(pair, learned)
                has_ended = True
        if has_ended:
            self._compare_parameters(learned())

    def compare_estimate(self, nis: float | None) -> None:
        """Compare the estimate with dead reckonings while a pair differs; ``nis`` of the last scan, if one was matched."""
        if nis is not None:
            self._matched_s = self._faults.now_s
        inflation = self._faults.inflation
        if not self._episodes:
            inflation.are_wheels_outvoted, inflation.ongoing_pair = False, None
            return
        differences = [self._difference(e) for e in self._episodes.values() if self._is_inflating(e)]
        is_lidar_right = self._has_scans and bool(self._windows[LIDAR_GYRO].bins) and DIFFERENCES[LIDAR_GYRO] not in self._episodes
        inflation.are_wheels_outvoted = is_lidar_right and DIFFERENCES[GYRO_WHEELS] in self._episodes
        inflation.ongoing_pair = max(differences, key=lambda d: float(d @ d), default=None)

    def restart(self) -> None:
        """The pose is known: differences that last count from here on."""
        self._episodes = {fault: episode._replace(poses=self._reckoning.poses) for fault, episode in self._episodes.items()}

    @property
    def _has_scans(self) -> bool:
        return self._faults.now_s - self._matched_s < _MATCHED_S

    def _is_inflating(self, episode: _Episode) -> bool:
        return episode.is_by_lidar or not self._has_scans

    def _difference(self, episode: _Episode) -> FloatArray:
        """(3,) of the dead reckoning from the estimate since the begin of ``episode``."""
        return self._reckoning.distance(episode.poses, episode.row)

    def _compare(self, pair: Pair, learned: Callable[[], Sequence[LearnedParameter]]) -> None:
        """Report whether ``pair`` differs now, and begin or end an episode; parameters ``learned`` so far are for the sentence."""
        fault, worst = DIFFERENCES[pair], self._windows[pair].worst()
        is_clipped = self._clipping.is_clipped and pair != LIDAR_WHEELS_WAYS
        if self._is_explained(fault, NAMED[pair]) or worst is None or worst.sigmas < (_MAX_CLIPPED_SIGMAS if is_clipped else _MAX_SIGMAS):
            self._end(fault)
            return
        best = worst.explain(pair, CAUSES[pair], self._usual.get(pair, {}))
        regressor, cause = best.regressor, best.sentence
        if regressor == TURN:
            unset = [p for p in learned() if p.name == _MULTIPLIER and p.file_value == 1.0 < p.value]
            cause += "".join(phrase("sensor_pairs.plain_model", model=p.owner) for p in unset)
        if is_clipped:
            regressor, cause = TURN, self._clipping.describe()
        is_by_lidar = regressor == TURN_CHANGE
        before = self._episodes.get(fault)
        begin_s, poses = (worst.bins[1].end_s, worst.bins[1].poses) if before is None else (before.begin_s, before.poses)
        row = FILE_GYRO if pair == LIDAR_GYRO else FILE
        episode = self._episodes[fault] = _Episode(begin_s, poses, row, is_by_lidar)
        difference = math.degrees(worst.innovation) if pair.quantity == "turns" else worst.innovation
        numbers: dict[str, Value] = {"difference": difference, "window": worst.seconds, "cause": cause}
        if is_clipped or is_certain(best.log_odds):  # what floors do as well is no fault of a sensor
            self._report(fault, episode, worst.sigmas if is_clipped else best.sigmas, numbers)
        elif self._is_inflating(episode):
            self._inflation_reasons[fault] = begin_s, _describe_difference(pair, difference, worst.seconds)

    def _compare_parameters(self, learned: Sequence[LearnedParameter]) -> None:
        """Report the learned parameter that is farthest from the robot file, where it is too far; the radius has its own check."""
        if learned and learned[0].name == RADIUS:
            self._scales.compare(learned[0], self._driven_s)
            learned = learned[1:]
        outside = [p for p in learned if _is_outside_prior(p)]
        if not outside or self._is_explained(PARAMETER_FAR, NAMED[GYRO_WHEELS]):
            self._end(PARAMETER_FAR)
            return
        bins = next(window.bins for window in self._windows.values() if window.bins)
        episode = self._episodes.setdefault(PARAMETER_FAR, _Episode(bins[0].end_s, bins[0].poses, FILE))
        off = max(outside, key=self._evidence)
        numbers: dict[str, Value] = {"name": off.name, "owner": off.owner, "value": off.value, "sigma": off.sigma}
        ahead_m = off.value - off.file_value
        numbers |= {"file": round(off.file_value, 6) + 0.0, "cause": _describe_cause(off)}
        if is_certain(self._evidence(off)):
            self._report(PARAMETER_FAR, episode, abs(ahead_m) / off.sigma, numbers)
        elif self._is_inflating(episode):
            self._inflation_reasons[PARAMETER_FAR] = episode.begin_s, phrase("sensor_pairs.learned_otherwise", **numbers)

    def _evidence(self, p: LearnedParameter) -> float:
        """Logarithm of the evidence that something is wrong with ``p``, over that for a healthy robot: Bayes factor of two normal
        distributions of what was learned, which the prior keeps near the file. Turns vary with the floor by what is usual for the drive,
        and with a multiplier of 1, which nobody has set, by that of any drive."""
        usual = K_SIGMA if p.name == _MULTIPLIER and p.file_value == 1.0 else self._usual.get(GYRO_WHEELS, {}).get(TURN, 0.0)
        healthy = max(p.prior_sigma, usual * abs(p.file_value) if p.name in _TURNING else 0.0) ** 2
        variance = healthy + p.sigma**2
        return log_bayes_factor((p.value - p.file_value) ** 2 / variance, (_FAULT_FACTOR**2 - 1.0) * healthy / variance)

    def _is_explained(self, fault: SensorFault, named: Sequence[SensorFault]) -> bool:
        """Whether one of the ``named`` faults explains ``fault``: was found before it, or soon after its begin; it is retracted then."""
        if not self._faults.declared:
            return False
        found = [self._faults.found[other].at_s for other in named if other in self._faults.declared]
        if not found:
            return False
        episode = self._episodes.get(fault)
        if episode is not None and found[0] - episode.begin_s >= _NAMED_WITHIN_S:
            return False
        if episode is not None:
            self._faults.retract(fault)
            self._reported.pop(fault, None)
        return True

    def _report(self, fault: SensorFault, episode: _Episode, sigmas: float, numbers: Mapping[str, Value]) -> None:
        """Report the begin of the first episode, and the numbers of the worst moment."""
        before = self._reported.get(fault)
        if before is not None and sigmas < before.sigmas:
            return
        begin_s = episode.begin_s if before is None else before.begin_s
        self._reported[fault] = _Reported(begin_s, sigmas)
        is_wide = self._is_inflating(episode)
        use = phrase("sensor_pairs.without_scans") if is_wide else phrase("sensor_pairs.with_scans")
        found = fault.describe({"sigmas": sigmas, "use": use, **numbers})
        self._faults.revise(DetectedFault(fault, begin_s, found))

    def _end(self, fault: SensorFault) -> None:
        """The sensors agree again: what the pose is off by stays."""
        episode = self._episodes.pop(fault, None)
        if episode is None or not self._is_inflating(episode):
            return
        other = next((name for name, e in self._episodes.items() if self._is_inflating(e)), None)
        if other is None:
            self._faults.inflation.add(self._difference(episode))
        elif episode.begin_s < self._episodes[other].begin_s:  # the difference of both counts once
            self._episodes[other] = episode


def _innovations(step: Step, residuals: Residuals) -> Sequence[tuple[Pair, tuple[float, float] | None]]:
    """Innovation and variance of each pair; None where ``step`` has not measured it."""
    ways = LIDAR_WHEELS_WAYS, residuals.scan_way if step.has_wheels else None
    if step.turn is None:
        return (LIDAR_WHEELS_TURNS, residuals.scan_turn if step.has_wheels else None), ways
    return (GYRO_WHEELS, residuals.turn if step.has_wheels else None), (LIDAR_GYRO, residuals.scan_turn), ways


def _describe_difference(pair: Pair, difference: float, seconds: float) -> str:
    """That ``pair`` differs as it does on some floors, as part of a sentence."""
    if pair.quantity == "turns":
        return phrase("sensor_pairs.turns_as_on_floors", first=pair.first, second=pair.second, difference=difference, seconds=seconds)
    return phrase("sensor_pairs.ways_as_on_floors", first=pair.first, second=pair.second, difference=difference, seconds=seconds)


def _describe_cause(learned: LearnedParameter) -> str:
    """What may be the reason why ``learned`` is far from the robot file, as part of a sentence."""
    if not learned.name.startswith(_CENTER_X):
        return phrase("sensor_pairs.turning_cause")
    ahead_m = learned.value - learned.file_value
    if ahead_m > 0.0:
        return phrase("sensor_pairs.center_behind", distance_m=ahead_m)
    return phrase("sensor_pairs.center_ahead", distance_m=-ahead_m)


def _is_outside_prior(p: LearnedParameter) -> bool:
    """Whether the robot file's value is not within its prior's 90 % interval of what was learned."""
    return abs(p.value - p.file_value) > _PRIOR_SIGMAS * math.hypot(p.prior_sigma, p.sigma)


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
        """The fault in a sentence."""
        return phrase("sensor_pairs.clipped", degrees=math.degrees(self._largest))
