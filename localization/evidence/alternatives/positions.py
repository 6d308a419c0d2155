"""A reference's poses or positions against a path: axes, headings, unit, clock, lever arm, another run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import TEMPER, Row
from localization.evidence.paths import Fit, Path, Track, curve_price, fit, fit_curve, lags, wide_evidence, yaw_log_prior
from localization.evidence.sensor_errors import late_odds
from motion_models.se2 import FloatArray

_ODDS = {
    "axes": math.log(1e-3),
    "headings": math.log(5e-4),
    "unit": math.log(1e-3),
    "factor": math.log(3e-4),
    "yaw": math.log(2e-3),
    "leap": math.log(5e-4),
    "rate": math.log(1e-4),
    "unrelated": math.log(1e-5),
    "even": math.log(0.03),
}
"""Prior odds by kind (`docs/theory/set-up.md`)."""
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "kilometres": 0.001, "feet": 1.0 / 0.3048, "inches": 1.0 / 0.0254}
"""Units per metre."""
_LEAPS_S = {18.0: "GPS time is 18 s ahead of UTC", 37.0: "TAI is 37 s ahead of UTC"}
_LEAP_SIGMA_S = 0.1
_SCALE_SIGMA, _FACTOR_SIGMA = 0.08, 2.0
"""Sigma of the logarithm of the scale of ways by the radius of tyres and slip, and of a factor that no unit explains."""
_LATENCY_SIGMA_S = 0.07
"""Standard deviation of the latencies of GPS receivers and mocap bridges, which reach 0.2 s [s]."""
_RATE_SIGMA = 0.01
"""Standard deviation of the rates of clocks that are wrong: stamps of simulators that lag, and of counters of a wrong period."""
_COARSE_S, _FINE_S = 0.25, 0.02
"""Steps of the search of delays [s]."""
_MIN_COVERED = 0.5
"""Part of the shorter of track and path that the other covers at all delays that are searched."""
_COINCIDENCE = 7.0
"""Logarithm of the likelihood ratio from where on a path and the track of another run agree by chance in fewer than one of a thousand
drives."""
_DEGREES = (1, 3)
"""Degrees of the curve that is left to the track's own errors, in a window that is straight on and in one with a turn."""
_RATE_SPAN_S, _MIN_DRIFT_S, _MIN_RATE_DRIVE_S = 2.5, 0.15, 40.0
"""Difference of the delays of both halves of a drive that is searched, least one that is tried, and shortest drive [s]."""

Transform = Callable[[Track], Track]


@dataclass(frozen=True)
class Candidate:
    """One way in which a reference may be given, and its log posterior."""

    score: float
    rows: tuple[Row, ...]
    fit: Fit | None = None
    delay_s: float = 0.0

    @property
    def faults(self) -> tuple[Row, ...]:
        """Rows that healthy references do not have."""
        return tuple(row for row in self.rows if row.is_fault)


def alternatives(track: Track, paths: Sequence[Path], has_times: bool = True) -> list[Candidate]:
    """All candidates against each of ``paths``, any of which may be right."""
    fitted = []
    for transform, rows in _axes(track.yaws is not None):
        of_axes = transform(track)
        for delay, rate in _clocks(of_axes, max(paths, key=partial(_nearest, of_axes)), has_times):
            clock = (*_clock_rows(delay, has_times), *_rate_rows(rate, track.t[-1] - track.t[0]))
            fitted += [(fit(of_axes, path, delay, rate), (*rows, *clock), delay) for path in paths]
    even, own = (fit_curve(track, paths[0], degree) for degree in _DEGREES)
    independent = max([own, even, *(each[0] for each in fitted)], key=lambda each: each.evidence).share / TEMPER
    prices = [curve_price(track, degree) / independent for degree in _DEGREES]
    # another motion is explained by chance: a likelihood ratio of e^g over none has at most the probability e^-g (Ville 1939)
    by_chance = max(0.0, max(f.evidence for f, rows, _ in fitted if not any(row.is_fault for row in rows)) - wide_evidence(track))
    of_own = independent * (own.evidence - prices[1] - by_chance)
    if independent * by_chance > _COINCIDENCE:  # a smooth track beside a path with noise: its smoothness is no other run
        of_own = min(of_own, independent * (max(f.evidence for f, _, _ in fitted) - by_chance))
    fitted.append((replace(even, evidence=even.evidence - prices[0]), (_even(),), 0.0))
    found = [Candidate(_ODDS["unrelated"] + of_own, (_unrelated(),))]
    for of_fit, rows, delay in fitted:
        for more, extra in _scales_and_yaws(of_fit):
            all_rows = (*rows, *more)
            score = independent * of_fit.evidence + extra + sum(row.log_odds for row in all_rows) - math.log(len(paths))
            found.append(Candidate(score, all_rows, of_fit, delay))
    return found


def _nearest(track: Track, path: Path) -> float:
    """The most likelihood of a delay that a path has on a coarse grid: all paths have one clock, which the best one shows."""
    delays = _searched(track, path)
    return float(lags(track, path, delays[:: max(len(delays) // 40, 1)]).max()) if len(delays) else -math.inf


def _axes(has_yaws: bool) -> Iterator[tuple[Transform, tuple[Row, ...]]]:
    """What undoes each choice of axes."""
    mirrored = Row(
        "reference.mirrored",
        "its path turns opposite to the sensors': its axes are mirrored, as of NED (x north, y east) or a left-handed system, or the"
        " robot's left and right wheels are swapped",
        _ODDS["axes"],
        remedy="If the wheels are right, swap x and y, or invert y and the heading.",
    )
    yield lambda track: track, ()
    yield Track.mirrored, (mirrored,)
    if has_yaws:
        clockwise = "its headings turn opposite to the sensors', its path does not: they count clockwise"
        yield Track.turned_opposite, (Row("reference.clockwise", clockwise, _ODDS["headings"], remedy="Invert them."),)
        yield lambda track: track.mirrored().turned_opposite(), (mirrored, Row("reference.clockwise", clockwise, _ODDS["headings"]))
        inverse = "the inverse of its poses has the motion of the robot's sensors: it is the world in the body's frame"
        yield Track.inverted, (Row("reference.inverse", inverse, _ODDS["headings"], remedy="Invert it."),)


def _scales_and_yaws(fitted: Fit) -> Iterator[tuple[tuple[Row, ...], float]]:
    """Rows of the scale and of the body's heading, with the log density of what was measured."""
    yaws: list[tuple[tuple[Row, ...], float]] = [((), 0.0)]
    if fitted.yaw is not None:
        degrees = math.degrees(fitted.yaw)
        text = (
            f"its headings are {abs(degrees):.0f} deg {'left' if degrees > 0.0 else 'right'} of those of the sensors, against the direction"
            " of motion: its body's x axis does not point ahead"
        )
        row = Row("reference.yaw", text, _ODDS["yaw"], value=fitted.yaw, remedy="Turn its headings back by that.")
        yaws = [((), fitted.aligned + yaw_log_prior(fitted.yaw)), ((row,), fitted.aligned - math.log(math.tau))]
    log_scale = math.log(max(fitted.scale, 1e-9))
    scales: list[tuple[tuple[Row, ...], float]] = [((), _log_normal(log_scale, _SCALE_SIGMA))]
    for name, size in UNITS.items():
        text = f"its scale is {size:.4g}: its way is {fitted.scale:.4g} times the sensors', as in {name}"
        row = Row("reference.unit", text, _ODDS["unit"], name, size, remedy=f"Divide its positions by {size:.4g}.")
        scales.append(((row,), _log_normal(log_scale - math.log(size), _SCALE_SIGMA)))
    text = f"its scale is {fitted.scale:.3g}: its way is that many times the sensors'"
    remedy = "Divide its positions by that factor, or correct the wheels' radius if that is the wrong one."
    scales.append(
        ((Row("reference.factor", text, _ODDS["factor"], value=fitted.scale, remedy=remedy),), _log_normal(log_scale, _FACTOR_SIGMA))
    )
    for scale_rows, of_scale in scales:
        for yaw_rows, of_yaw in yaws:
            yield (*scale_rows, *yaw_rows), of_scale + of_yaw


def _log_normal(x: float, sigma: float) -> float:
    return -0.5 * (x / sigma) ** 2 - math.log(sigma)


def _clock_rows(delay_s: float, has_times: bool) -> tuple[Row, ...]:
    """Stamps that are ahead by ``delay_s``: a latency, a leap of time scales, or a clock that is off, whichever is most probable."""
    if not delay_s:
        return ()
    if not has_times:  # its times were spread over the log's: any delay is one's of the spreading
        return (Row("clock.reference", "", -0.5 * (delay_s / _LATENCY_SIGMA_S) ** 2, value=delay_s, is_fault=False),)
    odds, is_clock = late_odds(delay_s, _LATENCY_SIGMA_S)
    leap = min(_LEAPS_S, key=lambda each: abs(abs(delay_s) - each))
    of_leap = _ODDS["leap"] - 0.5 * ((abs(delay_s) - leap) / _LEAP_SIGMA_S) ** 2
    words = f" ({_LEAPS_S[leap]})" if of_leap > odds else ""
    text = f"its clock is {abs(delay_s):.1f} s {'ahead of' if delay_s > 0.0 else 'behind'} that of the sensors{words}"
    undo = f"{'Subtract' if delay_s > 0.0 else 'Add'} {abs(delay_s):.1f} s {'from' if delay_s > 0.0 else 'to'} its stamps."
    is_fault = is_clock or of_leap > odds
    return (Row("clock.reference", text, max(odds, of_leap), value=delay_s, remedy=undo, is_fault=is_fault),)


def _rate_rows(rate: float, duration_s: float) -> tuple[Row, ...]:
    """A delay that grows: a latency that changes, or a clock of another rate, whichever is more probable of that growth."""
    if not rate:
        return ()
    drift = abs(rate) * duration_s
    latency, clock = -0.5 * (drift / (math.sqrt(2.0) * _LATENCY_SIGMA_S)) ** 2, _ODDS["rate"] - 0.5 * (rate / _RATE_SIGMA) ** 2
    text = (
        f"its clock runs {abs(rate):.2%} {'faster' if rate > 0.0 else 'slower'} than that of the sensors: in both halves of the drive it"
        " has other offsets"
    )
    remedy = "Synchronize the clocks, or scale its stamps."
    return (Row("clock.reference_rate", text, max(latency, clock), value=rate, remedy=remedy, is_fault=clock > latency),)


def _unrelated() -> Row:
    text = (
        "its motion is not that of the robot's sensors, at any offset of the clocks: it is of another run or another robot, or its clock is"
        " not set"
    )
    return Row("reference.unrelated", text, 0.0)


def _even() -> Row:
    """A drive that shows nothing but its speed."""
    return Row("reference.even", "it is straight on at a steady speed", _ODDS["even"], is_fault=False)


def _clocks(track: Track, path: Path, has_times: bool) -> list[tuple[float, float]]:
    """Delays [s] and rates that the evidence is computed for: none, the best near none, the best of all, and one that grows."""
    near = np.arange(-0.3, 0.3 + 1e-9, _FINE_S)
    found = [(0.0, 0.0), (_finest(track, path, _best(near, lags(track, path, near))), 0.0)]
    if not has_times:
        return found
    all_lags = _searched(track, path)
    if len(all_lags) > 1:
        coarse = _best(all_lags, lags(track, path, all_lags))
        around = coarse + np.arange(-_COARSE_S, _COARSE_S + 1e-9, _FINE_S)
        delay = _finest(track, path, _best(around, lags(track, path, around)))
        found.append((delay, 0.0))
        found += _growing(track, path, delay)
    return list(dict.fromkeys(found))


def _finest(track: Track, path: Path, delay_s: float) -> float:
    """The delay of the most evidence about ``delay_s``."""
    return max((round(delay_s + k * 0.04, 3) for k in range(-3, 4)), key=lambda delay: fit(track, path, delay).evidence)


def _searched(track: Track, path: Path) -> FloatArray:
    """Delays [s] at which half of the shorter of track and path is covered by the other."""
    shorter = min(track.t[-1] - track.t[0], path.t[-1] - path.t[0])
    least, most = track.t[0] - path.t[-1] + _MIN_COVERED * shorter, track.t[-1] - path.t[0] - _MIN_COVERED * shorter
    return np.arange(least, most + 1e-9, max(_COARSE_S, (most - least) / 4000.0))


def _growing(track: Track, path: Path, delay_s: float) -> list[tuple[float, float]]:
    """The delay at the begin and the rate by which both halves of a drive have other delays, where they have."""
    t = track.t - track.t[0]
    if t[-1] < _MIN_RATE_DRIVE_S:
        return []
    candidates = delay_s + np.arange(-_RATE_SPAN_S, _RATE_SPAN_S + 1e-9, 2.0 * _FINE_S)
    halves = [_part(track, part) for part in (t < 0.5 * t[-1], t >= 0.5 * t[-1])]
    if any(half is None for half in halves):
        return []
    first, second = (_best(candidates, lags(half, path, candidates)) for half in halves if half is not None)
    middle = [float(np.mean(half.t)) - track.t[0] for half in halves if half is not None]
    if abs(second - first) < _MIN_DRIFT_S:
        return []
    rate = (second - first) / (middle[1] - middle[0])
    begin = first - rate * middle[0]
    around = begin + np.arange(-0.3, 0.3 + 1e-9, 0.1)
    rates = rate + np.linspace(-0.2, 0.2, 5) / max(t[-1], 1.0)
    pairs = [(float(a), float(b)) for a in around for b in rates]
    best = max(pairs, key=lambda pair: fit(track, path, *pair).evidence)
    return [(round(best[0], 3), best[1])]


def _part(track: Track, which: np.ndarray) -> Track | None:
    if which.sum() < 10:
        return None
    yaws = None if track.yaws is None else track.yaws[which]
    window = np.unique(track.window[which], return_inverse=True)[1]
    return replace(track, t=track.t[which], positions=track.positions[which], yaws=yaws, window=window)


def _best(candidates: FloatArray, scores: FloatArray) -> float:
    return round(float(candidates[int(scores.argmax())]), 3)
