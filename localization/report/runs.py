"""Runs as plotted in a report: name, colour, headline error and path of each."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from localization.evaluation.metrics import Accuracy
from localization.evaluation.scores import Result
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.se2 import FloatArray

WHEELLESS = "lidar"
"""The estimator that does not use wheels: its runs are the same for every motion model."""
DEAD_RECKONING = "odometry"

_WORDS = {DEAD_RECKONING: "dead reckoning", WHEELLESS: "LiDAR alone"}
# Okabe and Ito's colours by name; those for white paper have 3:1 contrast on it or more, plots.py and the style sheet hold the values.
_COLOURS = {"ekf": "blue", DEAD_RECKONING: "red", WHEELLESS: "purple", "graph": "green"}
_SPARE_COLOURS = ("orange", "sky")
_DASHES: tuple[tuple[float, ...], ...] = ((), (4.0, 1.8), (1.2, 1.4), (5.0, 1.5, 1.2, 1.5), (8.0, 2.0))


@dataclass(frozen=True, eq=False)
class PlottedRun:
    """One run with the name and style that it has everywhere in a report."""

    number: int
    result: Result
    colour: str
    """Name of a colour: one for each estimator."""
    dashes: tuple[float, ...]
    """On and off lengths in line widths: one pattern for each motion model, () for solid."""

    @property
    def model(self) -> str | None:
        """None where the estimator does not use wheels."""
        return None if self.result.run.estimator == WHEELLESS else self.result.run.model

    @property
    def label(self) -> str:
        """Short, in the command line's words."""
        return self.result.run.estimator if self.model is None else f"{self.result.run.estimator} · {self.model}"

    @property
    def words(self) -> str:
        """Name in a sentence."""
        return describe_run(self.result.run.estimator, self.result.run.model)

    @property
    def error(self) -> float | None:
        """The headline number [m]: mean error of the relations, else ATE; None where there is no (finite) score."""
        return headline(self.result.accuracy)

    @property
    def is_lost(self) -> bool:
        """Whether the LiDAR was lost for so long that the run is not to be recommended."""
        losses = self.result.run.lidar
        return losses is not None and losses.is_long

    def placed(self, poses: FloatArray) -> FloatArray:
        """Poses (N, 3) of the run's world in the reference's plane where they are aligned to one, else as they are."""
        alignment = self.result.accuracy.reference_T_world if self.result.accuracy else None
        return poses if alignment is None else se2.compose(alignment, poses)

    def placed_points(self, points: FloatArray) -> FloatArray:
        """The same for points (N, 2)."""
        alignment = self.result.accuracy.reference_T_world if self.result.accuracy else None
        return points if alignment is None else se2.transform(alignment, points)


def headline(accuracy: Accuracy | None) -> float | None:
    """Mean error of the relations, else ATE [m]; None where there is no (finite) score."""
    if accuracy is None:
        return None
    value = accuracy.relations.all.translation_m if accuracy.relations else accuracy.ate_rmse_m
    return value if value is not None and math.isfinite(value) else None


def describe_run(estimator: str, model: str) -> str:
    """Name of an estimator and its motion model in a sentence."""
    name = _WORDS.get(estimator, estimator)
    return name if estimator == WHEELLESS else f"{name} with {model}"


def capitalize(text: str) -> str:
    """The first letter of a sentence, but for names that are what one types."""
    return "Dead" + text[4:] if text.startswith("dead ") else text


def join_words(parts: Sequence[str], last: str = "and") -> str:
    """a, b and c."""
    return f"{', '.join(parts[:-1])} {last} {parts[-1]}" if len(parts) > 1 else "".join(parts)


def estimator_colours(estimators: Iterable[str]) -> dict[str, str]:
    """Names of colours: usual estimators always have the same one."""
    colours = dict(_COLOURS)
    spare = iter(_SPARE_COLOURS)
    for estimator in estimators:
        if estimator not in colours:
            colours[estimator] = next(spare, "grey")
    return colours


def plotted_runs(results: Sequence[Result]) -> list[PlottedRun]:
    """Lines in the order of the results; of estimators that use no wheels only the first run is kept, the others are its copies."""
    models: list[str] = []
    colours = estimator_colours(result.run.estimator for result in results)
    lines: list[PlottedRun] = []
    for result in results:
        run = result.run
        if run.estimator == WHEELLESS and any(line.result.run.estimator == WHEELLESS for line in lines):
            continue
        if run.estimator != WHEELLESS and run.model not in models:
            models.append(run.model)
        style = 0 if run.estimator == WHEELLESS else models.index(run.model)
        lines.append(PlottedRun(len(lines), result, colours[run.estimator], _DASHES[style % len(_DASHES)]))
    return lines


def best_run(lines: Sequence[PlottedRun]) -> PlottedRun | None:
    """The one of the smallest headline error that can be recommended; None without scores."""
    scored = [line for line in lines if line.error is not None and not line.is_lost]
    return min(scored, key=lambda line: (line.error, line.number)) if scored else None


def run_with_map(lines: Sequence[PlottedRun]) -> PlottedRun | None:
    """The best run that has a map. Without scores a fusing estimator is preferred to the LiDAR alone."""
    mapped = [line for line in lines if np.isfinite(line.result.run.map_points).all(axis=1).any()]
    order = {"graph": 0, "ekf": 1, WHEELLESS: 3}
    key = lambda line: (math.inf if line.error is None else line.error, order.get(line.result.run.estimator, 2), line.number)  # noqa: E731
    return min(mapped, key=key) if mapped else None


def baseline_run(lines: Sequence[PlottedRun]) -> PlottedRun | None:
    """Dead reckoning with the ideal differential drive, else with whatever model: the baseline of all other runs."""
    reckoned = [line for line in lines if line.result.run.estimator == DEAD_RECKONING]
    return min(reckoned, key=lambda line: (line.model != "diff_drive", line.number)) if reckoned else None


@dataclass(frozen=True)
class Ellipse:
    """A region of confidence around a position."""

    center: tuple[float, float]
    semi_axes: tuple[float, float]
    """Larger first [m]."""
    angle: float
    """Of the larger axis, from x [rad]."""


def ellipse(pose: FloatArray, covariance: FloatArray, sigmas: float = 2.0) -> Ellipse:
    """The ellipse of ``sigmas`` standard deviations of the position of ``pose`` (3,), of the covariance (3, 3) of its right perturbation.

    The perturbation lives in the body frame, so its block of x and y is rotated by the heading: R P R^T. In the plane two sigmas
    contain 86 % of all cases, not 95 %.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    small, large = np.sqrt(np.maximum(values, 0.0)) * sigmas
    angle = math.atan2(vectors[1, 1], vectors[0, 1]) + float(pose[2])
    return Ellipse((float(pose[0]), float(pose[1])), (float(large), float(small)), angle)


def thin_path(positions: FloatArray, resolution_m: float, most: int = 2500) -> IntArray:
    """Indices of enough of a path's positions (N, 2) to draw it at a resolution: first and last, and at most ``most`` in all.

    Unlike in `path_nodes` a sample is kept by the length of the path so far, which is one pass over an array of any length.
    """
    n = len(positions)
    if n < 3:
        return np.arange(n)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))])
    cell = np.floor(length / max(resolution_m, length[-1] / (most - 2), 1e-12)).astype(np.int64)
    kept = np.flatnonzero(np.diff(cell, prepend=-1) > 0)
    return kept if kept[-1] == n - 1 else np.append(kept, n - 1)


def thin_series(values: FloatArray, most: int = 700) -> IntArray:
    """Indices of at most ``most`` values of a series (N,), the extremes of every stretch among them, so that no peak is lost."""
    n = len(values)
    if n <= most:
        return np.arange(n)
    edges = np.linspace(0, n, most // 2 + 1).astype(np.int64)
    stretches = [(int(a), values[a:b]) for a, b in itertools.pairwise(edges)]
    picked = [(start + int(np.argmin(part)), start + int(np.argmax(part))) for start, part in stretches]
    return np.unique(np.array(picked, dtype=np.int64))
