"""Whether probabilities of places are right as often as they say: reliability diagram, Brier score, and weights held out by building.

Searches are recorded with what they found (`RecordedSearches`). The weights of the regression are fitted to the searches of all buildings
but one, and give the probabilities of that one's.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from localization.maps import KeyframeMap
from localization.maps.place_probability import LIKELY, SEARCH_WEIGHTS, Weights, features, weigh
from localization.maps.place_search import Place, PlaceMap
from motion_models.se2 import FloatArray, Points2, Pose2

BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
_OF_SEARCHES = ("searches, weights of other buildings", "searches, weights of the program")
_RIDGE = 1e-2
"""Prior of the weights: 1 over the square of a sigma of 10."""


class RecordedSearches(PlaceMap):
    """A map that keeps what each search of the whole found, and the number of its points."""

    def __init__(self, keyframes: KeyframeMap, range_noise_m: float) -> None:
        super().__init__(keyframes, range_noise_m)
        self.found: list[tuple[Sequence[Place], int]] = []

    def search(self, points: Points2, near: Pose2 | None = None, half: FloatArray | None = None) -> list[Place]:
        places = super().search(points, near, half)
        if near is None and places:
            self.found.append((places, len(points)))
        return places


class Search(NamedTuple):
    """What a search found in a map of ``building``, and whether the best place is the right one."""

    building: str
    places: Sequence[Place]
    n_points: int
    is_right: bool


class Moment(NamedTuple):
    """A probability that was published, and whether the place was right."""

    kind: str
    building: str
    probability: float
    is_right: bool


def fit(searches: Sequence[Search]) -> Weights:
    """Logistic regression with a weak prior (Bishop 2006, 4.3.2)."""
    X = np.array([features(search.places, search.n_points) for search in searches])
    sign = np.array([1.0 if search.is_right else -1.0 for search in searches])

    def cost(w: np.ndarray) -> float:
        return float(np.logaddexp(0.0, -sign * (X @ w)).sum() + 0.5 * _RIDGE * (w @ w))

    return Weights(*minimize(cost, np.zeros(X.shape[1])).x.tolist())


def held_out(searches: Sequence[Search]) -> list[Moment]:
    """The probability of each best place by weights of the other buildings' searches, and by those of the program; none of one building."""
    found, buildings = [], list(dict.fromkeys(search.building for search in searches))
    for building in buildings if len(buildings) > 1 else ():
        weights = fit([search for search in searches if search.building != building])
        for search in searches:
            if search.building == building:
                for kind, w in zip(_OF_SEARCHES, (weights, SEARCH_WEIGHTS), strict=True):
                    found.append(Moment(kind, building, weigh(search.places, search.n_points, w)[0].probability, search.is_right))
    return found


def table(moments: Sequence[Moment]) -> str:
    """By kind: number and share right [%] in each bin of probability, those wrong above `LIKELY`, and the Brier score."""
    titles = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(BINS)]
    lines = [f"| kind | {' | '.join(titles)} | wrong above {LIKELY} | Brier score |", "|---" * (len(titles) + 3) + "|"]
    for kind in dict.fromkeys(moment.kind for moment in moments):
        p, right = _arrays(moments, kind)
        cells = [f"{n}: {100 * share:.0f}" if n else "-" for _, n, share in _bins(p, right)]
        wrong = int(((p > LIKELY) & ~right).sum())
        lines.append(f"| {kind} | {' | '.join(cells)} | {wrong} of {int((p > LIKELY).sum())} | {np.mean((p - right) ** 2):.3f} |")
    return "\n".join(lines)


def draw(moments: Sequence[Moment], path: Path) -> None:
    """Reliability diagram of all keyframes and of searches: share right over the mean probability of each bin, with 95 % intervals (Wilson
    1927)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    pooled = [moment if moment.kind in _OF_SEARCHES else moment._replace(kind="keyframes of all kinds") for moment in moments]
    for kind in dict.fromkeys(moment.kind for moment in pooled):
        rows = np.array([row for row in _bins(*_arrays(pooled, kind)) if row[1]])
        low, high = _wilson(rows[:, 2], rows[:, 1])
        axes.errorbar(
            rows[:, 0], rows[:, 2], [np.maximum(rows[:, 2] - low, 0), np.maximum(high - rows[:, 2], 0)], marker="o", capsize=3, label=kind
        )
    axes.set(xlabel="probability that is given", ylabel="share that is right", xlim=(0, 1), ylim=(0, 1.02))
    axes.legend(fontsize=8)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _arrays(moments: Sequence[Moment], kind: str) -> tuple[np.ndarray, np.ndarray]:
    rows = [moment for moment in moments if moment.kind == kind]
    return np.array([row.probability for row in rows]), np.array([row.is_right for row in rows], dtype=bool)


def _bins(p: np.ndarray, right: np.ndarray) -> list[tuple[float, int, float]]:
    """Mean probability, number and share right of each bin."""
    which = np.clip(np.digitize(p, BINS) - 1, 0, len(BINS) - 2)
    ids = [which == k for k in range(len(BINS) - 1)]
    return [(float(p[i].mean()), int(i.sum()), float(right[i].mean())) if i.any() else (0.0, 0, 0.0) for i in ids]


def _wilson(share: np.ndarray, n: np.ndarray, z: float = 1.96) -> tuple[np.ndarray, np.ndarray]:
    middle, half = (share + z**2 / (2 * n)) / (1 + z**2 / n), z / (1 + z**2 / n) * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return middle - half, middle + half
