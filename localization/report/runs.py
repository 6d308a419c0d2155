"""Runs as plotted in a report: name, colour, headline error and path of each; and the data of their figures as plain arrays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.evaluation.metrics import Accuracy, relation_errors
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.trajectory import IntArray, Trajectory
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

_MAX_ELLIPSES = 12
_MAX_WIDENING = 0.2  # of the borders by other runs than the best, as a fraction of their size
# half-way between white and black paper: the map is a raster, whose colour the page cannot set
_MAP_GREY = (118, 125, 132)
_MAX_MEANS = 90
_MAX_BINS = 9
_MIN_BIN_RELATIONS = 5


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
        """Whether the LiDAR was lost for so long that the run is not to be recommended without a measured error."""
        losses = self.result.run.lidar
        return losses is not None and losses.is_long

    def placed(self, poses: FloatArray) -> FloatArray:
        """Poses (N, 3) of the run's world in the reference's plane where they are aligned to one, else as they are."""
        alignment = self.result.accuracy.reference_T_world if self.result.accuracy else None
        return poses if alignment is None else se2.compose(alignment, poses)

    def placed_points(self, points: FloatArray) -> FloatArray:
        """Points (N, 2) of the run's world in the reference's plane where they are aligned to one, else as they are."""
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
    """The one of the smallest headline error; None without scores.

    How long the LiDAR was lost does not count: not all runs measure it, and the error includes it.
    """
    scored = [line for line in lines if line.error is not None]
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
    """Angle of the larger axis, from x [rad]."""


def ellipse(pose: FloatArray, covariance: FloatArray, sigmas: float = 2.0) -> Ellipse:
    """The ellipse of ``sigmas`` standard deviations of the position of ``pose`` (3,), of the covariance (3, 3) of its right perturbation.

    The perturbation lives in the body frame, so its block of x and y is rotated by the heading: R P R^T. In the plane two sigmas
    contain 86 % of all cases, not 95 %.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    small, large = np.sqrt(np.maximum(values, 0.0)) * sigmas
    angle = math.atan2(vectors[1, 1], vectors[0, 1]) + float(pose[2])
    return Ellipse((float(pose[0]), float(pose[1])), (float(large), float(small)), angle)


def thin_path(positions: FloatArray, resolution_m: float, most: int = 1000) -> IntArray:
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


@dataclass(frozen=True, eq=False)
class MapPlane:
    """Map, reference and paths in one plane: the reference's where the runs are aligned to one, else the world of the common start."""

    low: FloatArray
    """(2,) lower left corner [m]."""
    high: FloatArray
    """(2,) upper right corner [m]."""
    points: FloatArray
    """(M, 2) the map; (0, 2) without one."""
    map_of: PlottedRun | None
    """Whose map it is."""
    reference: FloatArray | None
    """(N, 2)"""
    paths: tuple[FloatArray, ...]
    """(N, 2) for each line."""
    best: PlottedRun | None
    """The run that is always inside the borders, with its map and the ellipses of its covariances if it has any."""
    ellipses: tuple[Ellipse, ...]
    """Two sigmas of the best run's position, at equal distances along its path."""
    ranks: Mapping[int, int]
    """By number of the line: 0 is the best."""
    start: tuple[float, float] | None
    """Where the best run (or the first) starts."""
    n_cut: int
    """Number of lines that leave the picture."""


def map_view(lines: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> MapPlane:
    """Borders hold the reference, the best run, and the map without its outliers. The others widen them by at most a fifth: a diverged
    run must not make the rest too small.
    """
    best = best_run(lines) or run_with_map(lines) or (lines[-1] if lines else None)
    mapped = run_with_map(lines)
    points = np.empty((0, 2))
    if mapped is not None:
        raw = mapped.result.run.map_points
        points = mapped.placed_points(raw[np.isfinite(raw).all(axis=1)])
    track = reference.positions if isinstance(reference, ReferenceTrack) else None
    paths = tuple(line.placed(line.result.run.trajectory.poses)[:, :2] for line in lines)
    core = [part for part in (track, paths[best.number] if best else None, _without_strays(points)) if part is not None and len(part)]
    low, high = _borders(core or [np.zeros((1, 2))])
    reach = _MAX_WIDENING * max(float((high - low).max()), 1.0)
    all_low, all_high = _borders([*core, *(path for path in paths if len(path))] or [np.zeros((1, 2))])
    low, high = np.maximum(all_low, low - reach), np.minimum(all_high, high + reach)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    order = sorted(lines, key=lambda line: (line.error is None, line.error or 0.0, line.number))
    return MapPlane(
        low=low,
        high=high,
        points=points,
        map_of=mapped,
        reference=track,
        paths=paths,
        best=best,
        ellipses=() if best is None else _ellipses(best),
        ranks={line.number: rank for rank, line in enumerate(order)},
        start=_start(paths[best.number]) if best else None,
        n_cut=sum(bool(((path < low) | (path > high)).any()) for path in paths),
    )


def raster(view: MapPlane, resolution_m: float) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
    """The map's points as grey of more or less alpha (H, W, 4), top row first, and its left, right, bottom and top border [m]."""
    width, height = np.maximum(np.ceil((view.high - view.low) / resolution_m).astype(int), 1)
    column, row = np.floor((view.points - view.low) / resolution_m).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    counts = np.bincount(row[inside] * width + column[inside], minlength=width * height).reshape(height, width)
    image = np.zeros((height, width, 4), dtype=np.uint8)
    image[..., :3] = _MAP_GREY
    image[..., 3] = np.where(counts > 0, np.minimum(150.0 + 60.0 * np.log2(np.maximum(counts, 1)), 255.0), 0.0).astype(np.uint8)
    left, bottom = (float(x) for x in view.low)
    return image[::-1], (left, left + float(width) * resolution_m, bottom, bottom + float(height) * resolution_m)


@dataclass(frozen=True, eq=False)
class Timeline:
    """Errors of one run over time."""

    seconds: FloatArray
    """(N,) since the run's first pose."""
    position_m: FloatArray
    """(N,)"""
    heading_deg: FloatArray | None
    """(N,)"""


def timeline(line: PlottedRun) -> Timeline | None:
    """None where the reference is no track."""
    errors = line.result.accuracy.errors if line.result.accuracy else None
    if errors is None:
        return None
    heading = None if errors.heading_rad is None else np.degrees(errors.heading_rad)
    return Timeline(_seconds(errors.stamps_ns, line.result.run.trajectory), errors.position_m, heading)


@dataclass(frozen=True, eq=False)
class RelationBins:
    """Mean errors of relations, binned by the time that they span."""

    seconds: FloatArray
    """(K,) geometric means of the spans in each bin."""
    translation_m: FloatArray
    """(K,)"""
    rotation_deg: FloatArray
    """(K,)"""
    n: tuple[int, ...]
    """Relations in each bin."""


def relation_bins(line: PlottedRun, relations: Relations) -> RelationBins:
    """Bins of equal width in the logarithm of the span; those of fewer than five relations are added to their neighbour."""
    found = relation_errors(line.result.run.trajectory, relations)
    span = np.maximum(found.spans_s, 1e-3)
    edges = np.geomspace(span.min(), span.max() * (1.0 + 1e-9), _MAX_BINS + 1)
    bins = np.clip(np.searchsorted(edges, span, side="right") - 1, 0, _MAX_BINS - 1)
    groups = [np.flatnonzero(bins == b) for b in range(_MAX_BINS)]
    merged: list[NDArray[np.intp]] = []
    for group in groups:
        if merged and (len(group) < _MIN_BIN_RELATIONS or len(merged[-1]) < _MIN_BIN_RELATIONS):
            merged[-1] = np.concatenate([merged[-1], group])
        else:
            merged.append(group)
    return RelationBins(
        np.array([float(np.exp(np.log(span[g]).mean())) for g in merged]),
        np.array([float(found.translation_m[g].mean()) for g in merged]),
        np.array([float(np.degrees(found.rotation_rad[g]).mean()) for g in merged]),
        tuple(len(g) for g in merged),
    )


@dataclass(frozen=True, eq=False)
class NisMeans:
    """Means of successive NIS values."""

    seconds: FloatArray
    """(K,) mean time since the run's first pose."""
    mean: FloatArray
    """(K,)"""
    group: int
    """How many values each is the mean of."""
    fraction_inside: float
    """Part of the single values below the 95 % quantile."""


def nis_means(lines: Sequence[PlottedRun], limit: float) -> tuple[list[PlottedRun], list[NisMeans]]:
    """The lines that have innovations, and about ninety means of each; ``limit``: the 95 % quantile of one value."""
    known = [(line, np.isfinite(line.result.run.nis)) for line in lines]
    known = [(line, use) for line, use in known if use.any()]
    group = max(1, -(-max((int(use.sum()) for _, use in known), default=0) // _MAX_MEANS))
    means = []
    for line, use in known:
        values, t = line.result.run.nis[use], _seconds(line.result.run.trajectory.stamps_ns[use], line.result.run.trajectory)
        whole = max(len(values) // group, 1) * min(group, len(values))  # the rest is no full group and would need its own band
        shape = (-1, min(group, len(values)))
        means.append(
            NisMeans(t[:whole].reshape(shape).mean(1), values[:whole].reshape(shape).mean(1), group, float(np.mean(values <= limit)))
        )
    return [line for line, _ in known], means


def _seconds(stamps_ns: np.ndarray, trajectory: Trajectory) -> FloatArray:
    elapsed: FloatArray = (stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    return elapsed


def _ellipses(line: PlottedRun) -> tuple[Ellipse, ...]:
    trajectory = line.result.run.trajectory
    if trajectory.covariances is None or not len(trajectory):
        return ()
    poses = line.placed(trajectory.poses)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    if length[-1] <= 0.0:
        return (ellipse(poses[-1], trajectory.covariances[-1]),)
    at = np.unique(np.searchsorted(length, np.linspace(0.0, length[-1], _MAX_ELLIPSES + 1)[1:] * (1.0 - 1e-12)))
    return tuple(ellipse(poses[i], trajectory.covariances[i]) for i in at)


def _borders(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    return np.min([part.min(axis=0) for part in parts], axis=0), np.max([part.max(axis=0) for part in parts], axis=0)


def _without_strays(points: FloatArray) -> FloatArray:
    """The corners of what remains of a map without the outermost half percent on each side, where glass and mirrors put their points."""
    return np.percentile(points, [0.5, 99.5], axis=0) if len(points) else points


def _start(path: FloatArray) -> tuple[float, float] | None:
    return (float(path[0, 0]), float(path[0, 1])) if len(path) else None
