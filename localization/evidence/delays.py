"""Delays between sources, whatever their wiring, units, signs and mounts are.

A canonical correlation (Hotelling 1936) does not change under invertible linear maps of either side, so that the lag of its maximum is the
delay between two sources before anything is known of their maps.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from localization.evidence.alternatives.alternative import TEMPER
from localization.evidence.signals import Source
from motion_models.se2 import FloatArray

_SPAN_S, _COARSE_S, _FINE_S = 12.0, 0.25, 0.02
"""Longest delay that is searched where times of recording show none, and steps of the search [s]."""
_FLOOR = 0.003
"""Part of the variance that no source shares with another: slip, bias, encoder steps."""
_MIN_GAIN = 3.0
"""Logarithm of the likelihood that a lag must gain over none to be a candidate; the evidence with its prior decides."""


def candidate_delays(sources: Sequence[Source], edges: FloatArray) -> list[tuple[float, ...]]:
    """Delays [s] that each source may have, 0 first: the lags at which it has the motion of another one."""
    found: list[list[float]] = [[0.0] for _ in sources]
    for i, j in itertools.combinations(range(len(sources)), 2):
        lag = _lag(sources[i], sources[j], edges)
        if lag is not None:
            found[i].append(-lag)
            found[j].append(lag)
    return [tuple(dict.fromkeys(delays)) for delays in found]


def _lag(a: Source, b: Source, edges: FloatArray) -> float | None:
    """By how much later ``b`` has the motion of ``a`` [s]; None where no lag gains."""
    of_a = a.rates(edges)
    lags = np.arange(-_SPAN_S, _SPAN_S + 1e-9, _COARSE_S)
    if a.behind_s is not None and b.behind_s is not None:  # by the times of recording, at any distance
        lags = np.concatenate([lags, a.behind_s - b.behind_s + np.arange(-1.0, 1.0 + 1e-9, _COARSE_S)])
    coarse = np.array([_log_likelihood(of_a, b.rates(edges, lag)) for lag in lags])
    best = lags[int(coarse.argmax())]
    fine_lags = best + np.arange(-_COARSE_S, _COARSE_S + 1e-9, _FINE_S)
    fine = np.array([_log_likelihood(of_a, b.rates(edges, lag)) for lag in fine_lags])
    lag = float(round(fine_lags[int(fine.argmax())], 3))
    gain = float(fine.max()) - _log_likelihood(of_a, b.rates(edges, 0.0))
    return lag if abs(lag) >= _FINE_S and gain > _MIN_GAIN else None


def _log_likelihood(a: FloatArray, b: FloatArray) -> float:
    """Tempered log likelihood gain of two sets of channels (n, k), (n, l) by their first canonical correlation."""
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if known.sum() < 16:
        return 0.0
    correlations = np.linalg.svd(_white(a[known]).T @ _white(b[known]), compute_uv=False)
    r = min(float(correlations[0]), 1.0) if len(correlations) else 0.0  # a source that stands has none
    return float(-0.5 * TEMPER * known.sum() * np.log(1.0 - r**2 + _FLOOR))


def _white(channels: FloatArray) -> FloatArray:
    """Orthonormal basis of the columns, about zero; those that only have rounding are none."""
    u, s, _ = np.linalg.svd(channels, full_matrices=False)
    return np.asarray(u[:, s > 1e-3 * s[0] + 1e-12])
