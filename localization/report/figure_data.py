"""Data of the figures as plain arrays: borders of the map, errors over time, means over bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.evaluation.metrics import relation_errors
from localization.evaluation.references import ReferenceTrack, Relations
from localization.report.runs import Ellipse, PlottedRun, best_run, ellipse, run_with_map
from localization.trajectory import Trajectory
from motion_models.se2 import FloatArray

_MAX_ELLIPSES = 12
_MAX_WIDENING = 0.2  # of the borders by other runs than the best, as a fraction of their size
# half-way between white and black paper: the map is a raster, whose colour the page cannot set
_MAP_GREY = (118, 125, 132)
_MAX_MEANS = 90
_MAX_BINS = 9
_MIN_BIN_RELATIONS = 5


@dataclass(frozen=True, eq=False)
class MapView:
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


def map_view(lines: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> MapView:
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
    return MapView(
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


def raster(view: MapView, resolution_m: float) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
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
