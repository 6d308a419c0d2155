"""Placebo searches: what the best of all candidates gains where it cannot act, on the same drive.

The level of a search over many shapes, places and times is that of the same search with placebos. For terms, functions of the motion
alone, what tolerances leave of the discrepancies is permuted in blocks of windows longer than the columns' correlation (Freedman & Lane
1983). What modulates a motion (place, time, a wheel's angle, tilt) is shifted along the drive, while motion and discrepancies stay: errors
of the model that follow the motion count as well. A candidate that takes the squares R of N numbers to R' has the statistic
N log(R / R') less its price: by the noise that is left beside it, as what is permuted contains the law that is tested. With the best
statistic s of the search, and s_1 .. s_n of n placebo searches, p = (1 + #(s_i >= s)) / (n + 1) (Phipson & Smyth 2010).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from motion_models.calibration.maneuvers import IntArray
from motion_models.se2 import FloatArray

LEVEL = 0.01
"""Probability that a search without any effect finds one, over the whole search."""
DRAWS = 200
_SHORTEST_BLOCK = 4  # windows, as in the folds of a drive
_FEWEST_BLOCKS = 6
_CORRELATED = 2.0
"""Correlation of windows at a lag, over its sigma without any, 1 / sqrt(M) (Bartlett 1946), above which blocks are longer than the lag."""
_FREE = 1e6
"""Prior sigma of columns that may have any size, in whitened numbers."""
_COLLINEAR = 0.02  # least share of a column's squares that those already chosen leave
_LEAST_LEFT = 1e-9  # share of squares that a candidate leaves: rounding


class Candidates(NamedTuple):
    """Whitened columns of a search, each of one candidate."""

    columns: FloatArray
    """(M, 6, K)"""
    prices: FloatArray
    """(K,) in twice the log-odds."""
    motions: FloatArray
    """(M, 6, K) columns of the motion alone, for what modulates one; zero for candidates that are permuted."""
    modulators: FloatArray
    """(M, K) mean of what modulates it in each window."""

    @property
    def is_modulated(self) -> np.ndarray:
        """(K,) whether a placebo shifts the modulator, and keeps the motion."""
        return np.asarray(np.abs(self.motions).sum(axis=(0, 1)) > 0.0)


def modulated(columns: FloatArray, motions: FloatArray, prices: FloatArray) -> Candidates:
    """``columns`` (M, 6, K) as ``motions`` (M, 6, K) times what modulates them in each window; where a column is no multiple of its motion
    in most windows, its windows are permuted."""
    along, squares = np.sum(columns * motions, axis=1), np.sum(motions**2, axis=1)
    share = np.divide(along, squares, out=np.zeros_like(along), where=squares > 0.0)
    left = np.sum((columns - share[:, None] * motions) ** 2, axis=(0, 1))
    is_multiple = left < 0.5 * np.sum(columns**2, axis=(0, 1))
    return Candidates(columns, prices, motions * is_multiple, share * is_multiple)


def block_length(columns: FloatArray) -> int:
    """Windows of a block: more than the lag up to which the columns (M, 6, K) of most candidates are correlated."""
    windows = len(columns)
    flat = columns.reshape(windows, -1)
    flat = flat - flat.mean(axis=0)
    power = np.sum(flat**2, axis=0)
    longest = max(windows // _FEWEST_BLOCKS, 1)
    for lag in range(1, longest):
        correlation = np.sum(flat[lag:] * flat[:-lag], axis=0)[power > 0.0] / power[power > 0.0]
        if not len(correlation) or np.median(np.abs(correlation)) < _CORRELATED / np.sqrt(windows):
            return min(max(lag, _SHORTEST_BLOCK), longest)
    return longest


def permute_blocks(windows: int, length: int, rng: np.random.Generator) -> IntArray:
    """(windows,) indices: blocks of so many windows, from a random one on, in random order and direction."""
    start = int(rng.integers(windows))
    blocks = np.array_split(np.roll(np.arange(windows), -start), max(windows // length, 1))
    return np.concatenate([blocks[i][:: rng.choice((-1, 1))] for i in rng.permutation(len(blocks))])


def placebo_statistics(
    y: FloatArray, beside: FloatArray, candidates: Candidates, rng: np.random.Generator, draws: int = DRAWS
) -> tuple[FloatArray, FloatArray]:
    """(K, r) twice the log-likelihood less its price that each candidate gains for each of the whitened discrepancies ``y`` (n, r), beside
    columns (n, b) times their prior sigmas; and (draws, r) the best of each placebo search."""
    windows, channels, _ = candidates.columns.shape
    q = _basis(beside)

    def left_of(values: FloatArray) -> FloatArray:
        return np.asarray(values - q @ (q.T @ values))

    def usable(columns: FloatArray) -> FloatArray:
        """(n, k) of ``columns`` (M, 6, k), of unit length beside the others; zero where these leave nothing of them."""
        T = columns.reshape(len(q), -1)
        squares = np.sum(T**2, axis=0)
        left = squares - np.sum((q.T @ T) ** 2, axis=0)
        return T * np.where(left > _COLLINEAR * np.maximum(squares, 1e-12), 1.0 / np.sqrt(np.maximum(left, 1e-12)), 0.0)

    def of(columns: FloatArray, values: FloatArray, prices: FloatArray) -> FloatArray:
        """(k, r) statistics of ``columns`` (n, k) for ``values`` (n, r)."""
        left = left_of(values)
        return _statistic((columns.T @ left) ** 2, np.sum(values * left, axis=0), count) - prices

    rest, length, is_modulated = left_of(y), block_length(candidates.columns), candidates.is_modulated
    whole, prices = usable(candidates.columns), candidates.prices[:, None]
    count = int(np.count_nonzero(np.any(y, axis=1)))
    terms, of_terms = whole[:, ~is_modulated], prices[~is_modulated]
    kept = (1.0 - np.sum(q**2, axis=1)).sum() / len(q)  # of the variance of white noise
    loose = (rest / np.sqrt(max(kept, 1e-3))).reshape(windows, channels, -1)
    found = np.full((draws, y.shape[1]), -np.inf)
    for draw in range(draws):
        if len(of_terms):
            permuted = loose[permute_blocks(windows, length, rng)].reshape(rest.shape)
            found[draw] = of(terms, permuted, of_terms).max(axis=0)
        if is_modulated.any():
            shift = int(rng.integers(length, max(windows - length, length + 1)))
            moved = np.roll(candidates.modulators[:, is_modulated][:: rng.choice((-1, 1))], shift, axis=0)
            columns = usable(candidates.motions[..., is_modulated] * moved[:, None])
            found[draw] = np.maximum(found[draw], of(columns, y, prices[is_modulated]).max(axis=0))
    return of(whole, y, prices), found


def joint_statistic(y: FloatArray, beside: FloatArray, columns: FloatArray, price: float) -> float:
    """Statistic of ``columns`` (n, k) together, at this ``price`` of them all, for ``y`` (n,) beside columns (n, b) times their sigmas."""
    q = _basis(beside)
    rest, left = (values - q @ (q.T @ values) for values in (y, columns))
    moment = columns.T @ rest
    gain = float(moment @ np.linalg.lstsq(columns.T @ left, moment, rcond=_COLLINEAR**2)[0])
    return float(_statistic(gain, float(y @ rest), int(np.count_nonzero(y)))) - price


def _statistic(gain: FloatArray | float, squares: FloatArray | float, count: int) -> FloatArray:
    """``count`` log(R / R') where R, the ``squares``, falls by ``gain`` to R'."""
    return np.asarray(-count * np.log(np.maximum(1.0 - gain / np.maximum(squares, 1e-12), _LEAST_LEFT)))


def _basis(beside: FloatArray) -> FloatArray:
    """(n, b) q with I - q q^T = (I + B B^T)^-1 for columns ``beside`` B (n, b) times their prior sigmas: y^T (I - q q^T) y are the squares
    of y by the covariance of noise and tolerated sizes."""
    return np.asarray(np.linalg.qr(np.vstack([beside, np.eye(beside.shape[1])]))[0][: len(beside)])


def free(columns: FloatArray) -> FloatArray:
    """Whitened ``columns`` (n, g) that may have any size, times their prior sigma."""
    return np.asarray(columns * (_FREE / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)))


def placebo_p(statistic: float, placebos: FloatArray) -> float:
    """Probability that the best of a search where nothing acts is as good as ``statistic``, by the best of ``placebos`` (draws,)."""
    return float((1 + np.count_nonzero(placebos >= statistic)) / (len(placebos) + 1))
