"""What is left once causes are named: trends along speed, turning, place and time that noise alone would not show."""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.findings import Trend
from localization.diagnosis.noise import Noise
from localization.diagnosis.prediction import CHANNELS, DrivePredictor
from localization.diagnosis.subset_selection import max_statistic, p_value, regression, statistics
from motion_models.calibration.maneuvers import IntArray
from motion_models.se2 import FloatArray

_SIGNIFICANT = 0.01
_COMPONENTS = 3
_MIN_VARIANCE = 0.01  # of what is left of a channel, over the noise's


def features(predictor: DrivePredictor) -> dict[str, FloatArray]:
    """Trends by name, each (M,) a number per measured pose."""
    batch = predictor.batch
    twist, cg = predictor._base, batch.cg
    rows: list[list[float]] = []
    for end, owner in zip(batch.ends, batch.owner, strict=True):
        a = batch.first[owner] + batch.lead[owner]
        t, dt = twist[a:end], batch.dt[a:end]
        v, w = t[:, 0], t[:, 2]
        whole = dt.sum()
        heading = predictor.headings[owner]
        clock = predictor.drive.starts_s[owner]
        driven, turned = float(v @ dt), float(w @ dt)
        x, y = float(cg[a:end, 0] @ dt / whole), float(cg[a:end, 1] @ dt / whole)
        rows.append(
            [
                *(whole, driven, abs(driven), turned, abs(turned)),
                *(float((v * w) @ dt), float((v * np.abs(w)) @ dt), float((np.abs(v) * w) @ dt), float((w * np.abs(w)) @ dt)),
                *(float((v * np.abs(v)) @ dt), turned * x, turned * y, abs(turned) * x, abs(turned) * y, driven * x, driven * y),
                *(clock, clock * driven, clock * turned, np.cos(heading) * whole, np.sin(heading) * whole),
                *(np.cos(heading) * driven, np.sin(heading) * driven, np.cos(heading) * turned, np.sin(heading) * turned),
                *(float(v[-1] - v[0]), float(w[-1] - w[0])),
            ]
        )
    names = (
        *("time that passes", "distance", "distance either way", "turning", "turning either way"),
        *("v wz", "v |wz|", "|v| wz", "wz |wz|"),
        *("v |v|", "turning x CG x", "turning x CG y", "turning either way x CG x", "turning either way x CG y"),
        *("distance x CG x", "distance x CG y"),
        *("time into the drive", "distance x time into the drive", "turning x time into the drive"),
        *("heading (cosine)", "heading (sine)", "distance x heading (cosine)", "distance x heading (sine)"),
        *("turning x heading (cosine)", "turning x heading (sine)", "gain in speed", "gain in turning rate"),
    )
    table = np.array(rows)
    return {name: table[:, i] for i, name in enumerate(names) if np.ptp(table[:, i]) > 1e-9 or i == 0}


def find_trends(
    predictor: DrivePredictor,
    noise: Noise,
    left: FloatArray,
    signatures: FloatArray,
    nuisances: FloatArray,
    spreads: FloatArray,
    rng: np.random.Generator,
) -> tuple[tuple[Trend, ...], float]:
    """Significant trends of ``left`` (M, 6), strongest first, beyond what causes of ``signatures`` (M, 6, p) make within their ``spreads``
    (p,) and ``nuisances`` (M, 6, q) at any size; and twice the log-likelihood that they would gain."""
    found = features(predictor)
    measured = [c for c in range(_COMPONENTS) if np.isfinite(left[:, c]).any()]
    columns, names = [], []
    for channel in measured:
        for name, values in found.items():
            column = np.zeros(left.shape)
            column[:, channel] = values / max(float(np.sqrt(np.mean(values**2))), 1e-12)
            columns.append(np.where(np.isfinite(left), column, np.nan))
            names.append((CHANNELS[channel], name))
    y = noise.whiten(left).ravel()
    trends = np.stack(columns, axis=-1)
    s = noise.whiten(np.concatenate([trends, signatures], axis=-1)).reshape(len(y), -1)
    z = noise.whiten(nuisances).reshape(len(y), -1)
    n = len(names)
    scale = np.r_[np.ones(n), spreads]
    problem = regression(y, s, z, scale, np.r_[np.zeros(n), spreads])
    whitened = noise.whiten(left)
    rest = np.column_stack([np.sum(whitened**2, axis=0), np.isfinite(left).sum(axis=0)]).astype(float)  # squares and degrees of freedom
    t_channels = np.array([CHANNELS.index(channel) for channel, _ in names])
    given: tuple[int, ...] = ()
    result = []
    gained = 0.0
    for _ in range(3):
        t = np.zeros(n)
        free = [i for i in range(n) if i not in given]
        t[free] = statistics(problem, given, free) / _residual_sigmas(rest, t_channels[free], statistics(problem, given, free))
        best = int(np.argmax(np.abs(t)))
        freedom = max(min(noise.freedom, rest[t_channels[best], 1] - 1.0), 1.0)
        p = p_value(float(t[best]), max_statistic(problem, given, rng, freedom, n), freedom)
        if p > _SIGNIFICANT:
            break
        rest[t_channels[best], 0] -= float(statistics(problem, given, [best])[0]) ** 2
        rest[t_channels[best], 1] -= 1.0
        gained += float(t[best]) ** 2
        result.append(Trend(*names[best], float(t[best]), p, abs(float(t[best])) / math.sqrt(len(left))))
        given = (*given, best)
    return tuple(result), gained


def _residual_sigmas(rest: FloatArray, channels: IntArray, t: FloatArray) -> FloatArray:
    """(n,) standard deviation that is left of each trend's channel with the trend taken out, in units of the noise; at most 1.

    Noise that was estimated while the trend was in it is too large. ``rest`` (6, 2) are each channel's squares and degrees of freedom.
    """
    squares, freedom = rest[channels].T
    return np.asarray(np.sqrt(np.clip((squares - t**2) / np.maximum(freedom - 1.0, 1.0), _MIN_VARIANCE, 1.0)))
