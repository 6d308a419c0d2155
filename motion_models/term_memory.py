"""What terms with a memory are along a drive: responses of first and second order, and hysteresis, of rates that are held in each sample.

    lag(x,T)      y' = (x - y) / T                                      what follows x late: lags of a drive train, slip that builds up
    swing(x,f,d)  y - x with y'' + 2 d w y' + w^2 (y - x) = 0, w = 2 pi f   what swings after x: a load, an arm; 0 in steady motion
    play(x,r)     y' = 0 while |x - y| < r, else |x - y| = r             hysteresis: backlash, friction of a joint

Between samples both responses are exact for a held x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from motion_models.se2 import FloatArray

CONSTANTS: Mapping[str, tuple[tuple[float, float], ...]] = {
    "lag": ((0.02, 10.0),),
    "swing": ((0.05, 5.0), (0.02, 0.95)),
    "play": ((1e-4, 10.0),),
}
"""Least and largest constants by form: a time constant [s]; a frequency [Hz] and a damping ratio; half the width, in the unit of x."""
HORIZON_S = 8.0
"""Time before a step that its memory is taken from, where all samples of a drive are not at hand [s]: a swing of 0.3 Hz damped by 0.1 has
fallen to a fifth, a lag of 2 s to 2 %."""


class SampleSeries(NamedTuple):
    """When samples were taken, for terms of accelerations, of time and with a memory."""

    dt: FloatArray
    """(n,) time from the sample before to each sample [s]; 0 where there is none before, so that nothing accelerates."""
    t: FloatArray
    """(n,) time since the drive began [s]; where it steps back, the memory is what it was at that time."""


def respond(form: str, constants: tuple[float, ...], x: FloatArray, series: SampleSeries | None) -> FloatArray:
    """(n,) response of ``form`` to ``x`` (n,) in the middle of each sample of the ``series``; in steady motion without one."""
    if series is None:
        return _steady(form, constants, x)
    values, times, lengths = x.tolist(), series.t.tolist(), series.dt.tolist()
    states, found = [(0.0, 0.0)] * len(values), np.empty(len(values))
    for i, (value, now) in enumerate(zip(values, times, strict=True)):
        before = i - 1
        while before >= 0 and times[before] > now:
            before -= 1
        if before < 0 or (before < i - 1 and now <= times[0]):  # a drive, or a window of a table without times, begins
            states[i] = (0.0 if form == "play" else value), 0.0
        else:
            states[i] = _advance(form, constants, states[before], values[before], now - times[before])
        y, _ = _advance(form, constants, states[i], value, 0.5 * lengths[i])
        found[i] = y - value if form == "swing" else y
    return found


def _advance(form: str, constants: tuple[float, ...], state: tuple[float, float], x: float, dt: float) -> tuple[float, float]:
    """The ``state`` y, y' after ``dt`` [s] of a held ``x``."""
    y, rate = state
    if form == "play":
        (r,) = constants
        return min(max(y, x - r), x + r), 0.0
    if form == "lag":
        return x + (y - x) * math.exp(-dt / constants[0]), 0.0
    natural, damping = 2.0 * math.pi * constants[0], constants[1]
    damped, e = natural * math.sqrt(1.0 - damping**2), y - x
    a = (rate + damping * natural * e) / damped
    c, s, fades = math.cos(damped * dt), math.sin(damped * dt), math.exp(-damping * natural * dt)
    off = fades * (e * c + a * s)
    return x + off, fades * damped * (a * c - e * s) - damping * natural * off


def _steady(form: str, constants: tuple[float, ...], x: FloatArray) -> FloatArray:
    """Response to a lasting ``x``, from rest on."""
    if form == "play":
        return np.asarray(np.sign(x) * np.maximum(np.abs(x) - constants[0], 0.0))
    return np.zeros_like(x) if form == "swing" else np.asarray(x)
