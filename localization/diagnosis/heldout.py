"""What naming a cause gains on windows that its size was not fitted to."""

from __future__ import annotations

import numpy as np

from localization.diagnosis.findings import Gain
from localization.diagnosis.noise import Noise
from motion_models.se2 import FloatArray

_BLOCK, _FOLDS, _DRAWS = 4, 5, 1000


def heldout_gain(
    linear: FloatArray,
    signatures: FloatArray,
    nuisances: FloatArray,
    noise: Noise,
    scale: FloatArray,
    chosen: tuple[int, ...],
    others: tuple[int, ...],
    rng: np.random.Generator,
) -> Gain:
    """Root mean square of held-out whitened discrepancies by ``others`` and by ``chosen``; folds are of blocks of 4 windows."""
    squares = [_heldout(linear, signatures, nuisances, noise, scale, subset) for subset in (others, chosen)]
    n = len(linear)
    block = np.arange(n) // _BLOCK
    counts = np.bincount(block, weights=np.isfinite(linear).sum(axis=1))
    sums = [np.bincount(block, weights=s) for s in squares]
    rms = [float(np.sqrt(s.sum() / counts.sum())) for s in sums]
    draws = rng.multinomial(len(counts), np.full(len(counts), 1.0 / len(counts)), size=_DRAWS)
    before, after = (np.sqrt((draws @ s) / np.maximum(draws @ counts, 1.0)) for s in sums)
    low, high = np.quantile(1.0 - after / np.maximum(before, 1e-12), [0.025, 0.975])
    return Gain(rms[0], rms[1], 1.0 - rms[1] / max(rms[0], 1e-12), float(low), float(high))


def _heldout(
    linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, scale: FloatArray, subset: tuple[int, ...]
) -> FloatArray:
    """(M,) sum of squares of each window."""
    y = noise.whiten(linear)
    columns = [noise.whiten(signatures[..., list(subset)]) * scale[list(subset)], noise.whiten(nuisances) * 1e3]
    design = np.concatenate(columns, axis=-1)
    fold = (np.arange(len(y)) // _BLOCK) % _FOLDS
    out = np.zeros(len(y))
    for f in range(_FOLDS):
        held = fold == f
        if not held.any() or held.all():
            continue
        a = design[~held].reshape(-1, design.shape[-1])
        x = np.linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ y[~held].ravel())
        out[held] = np.sum((y[held] - design[held] @ x) ** 2, axis=1)
    return out
