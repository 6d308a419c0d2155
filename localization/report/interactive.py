"""Data of the interactive part of a replay's page: trajectories, errors, sigmas, innovations and events over time.

`templates/explore.js` draws everything in the browser from one JSON object.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from localization.evaluation.references import ReferenceTrack, Relations
from localization.maps.grid import Grid
from localization.report.page import Explorer
from localization.report.runs import PlottedRun, ellipse, map_view, run_with_map, thin_series, timeline
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.se2 import FloatArray

_MOST_POINTS = 2_700
"""Points of all paths together, of all errors, and of all innovations: 80 bytes in all, so that a page stays below 2 MB."""
_MOST_MAP_POINTS = 5_000
_MOST_LOOPS = 400
_MOST_SLIPS = 60
_MOST_MEANS = 300
_LOST_AFTER_S = 1.0
"""A time without a matched scan that is shown as lost [s]: ten scans of a usual LiDAR."""
_SLIP_NIS = float(chi2.isf(1e-9, 3))
"""Innovation of a scan that noise exceeds once in 1e9 scans: the wheels slipped, or the robot was pushed."""
_MILLIMETRES, _TENTHS = 3, 1
"""Time and text of a warning of the sensor checks."""


Scans = Sequence[tuple[int, FloatArray]]
"""Stamps [ns] and points (M, 2) in the body frame [m]."""


def explorer(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None, scans: Scans = ()) -> Explorer:
    """The block of ``runs``, thinned, with ``scans`` as a layer of the map."""
    return Explorer(json.dumps(explorer_data(runs, reference, scans), separators=(",", ":"), allow_nan=False))


def explorer_data(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None, scans: Scans = ()) -> dict[str, Any]:
    """What the page draws: times in seconds since the first run's first pose, metres, degrees."""
    start_ns = int(min(run.result.run.trajectory.stamps_ns[0] for run in runs if len(run.result.run.trajectory)))
    most = max(_MOST_POINTS // max(len(runs), 1), 100)
    drawn = run_with_map(runs)
    points = drawn.placed_points(drawn.result.run.map_points) if drawn is not None else np.empty((0, 2))
    points = points[_evenly(len(points), _MOST_MAP_POINTS)]
    track = reference if isinstance(reference, ReferenceTrack) else None
    return {
        "runs": [_run(run, start_ns, most, track) for run in runs if len(run.result.run.trajectory)],
        "borders": _borders(runs, reference),
        "reference": None if track is None else _reference(track, start_ns),
        "map": {"x": numbers(points[:, 0], 2), "y": numbers(points[:, 1], 2), "run": "" if drawn is None else drawn.label},
        "scans": _scans(runs[-1] if drawn is None else drawn, scans, start_ns),
    }


def _scans(run: PlottedRun, scans: Scans, start_ns: int) -> list[list[Any]]:
    """Time, x and y of the points of each of ``scans`` that ``run`` covers, from where it puts the robot at that moment."""
    trajectory = run.result.run.trajectory
    stamps = np.array([stamp for stamp, _ in scans], dtype=np.int64)
    covered = (stamps >= trajectory.stamps_ns[0]) & (stamps <= trajectory.stamps_ns[-1])
    found: list[list[Any]] = []
    for (stamp, points), pose in zip(itertools.compress(scans, covered), trajectory.at(stamps[covered]), strict=True):
        placed = run.placed_points(se2.transform(pose, points))
        found.append([round((stamp - start_ns) * 1e-9, 2), numbers(placed[:, 0], 2), numbers(placed[:, 1], 2)])
    return found


def _borders(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> dict[str, list[float | None]]:
    """Part of the plane that the map shows at first [m]: runs that diverged do not set its scale."""
    view = map_view(runs, reference)
    return {axis: numbers([view.low[i], view.high[i]], 2) for i, axis in enumerate("xy")}


def _run(run: PlottedRun, start_ns: int, most: int, track: ReferenceTrack | None) -> dict[str, Any]:
    """One run: path with sigma, errors, innovations, loops, times of slip and without a matched scan, and when sensor faults began."""
    trajectory = run.result.run.trajectory
    t = np.asarray((trajectory.stamps_ns - start_ns) * 1e-9, dtype=np.float64)
    poses = run.placed(trajectory.poses)
    keep = _evenly(len(poses), most)
    way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(trajectory.poses[:, :2], axis=0).T))]
    sigma = None if trajectory.covariances is None else np.sqrt(np.trace(trajectory.covariances[:, :2, :2], axis1=1, axis2=2))
    return {
        "label": run.label,
        "number": run.number,
        "colour": run.colour,
        "dash": ",".join(f"{1.8 * d:g}px" for d in run.dashes) or "solid",
        "t": numbers(t[keep], 2),
        "x": numbers(poses[keep, 0], _MILLIMETRES),
        "y": numbers(poses[keep, 1], _MILLIMETRES),
        "heading": numbers(np.degrees(poses[keep, 2]), _TENTHS),
        "way": numbers(way[keep], 2),
        "sigma": None if sigma is None else numbers(sigma[keep], 4),
        "ellipse": None if trajectory.covariances is None else _ellipses(poses[keep], trajectory.covariances[keep]),
        "errors": _errors(run, t, way, most, track),
        "nis": _innovations(run, t),
        "loops": _loops(run),
        "lost": _lost(run, t),
        "slips": _slips(run, t),
        "faults": [[found.at_s, found.body] for found in run.result.run.warnings if found.at_s is not None],
        "parameters": {name: _history(rows, start_ns) for name, rows in _by_movement(run.result.run.parameter_history)},
    }


def _errors(run: PlottedRun, t: FloatArray, way: FloatArray, most: int, track: ReferenceTrack | None) -> dict[str, Any] | None:
    """Errors against the reference, aligned as a whole and, where ``track`` has headings, at the first pose."""
    line = timeline(run)
    if line is None:
        return None
    keep = np.unique(np.r_[thin_series(line.position_m, most), len(line.seconds) - 1])
    seconds = line.seconds + t[0]
    return {
        "t": numbers(seconds[keep], 2),
        "way": numbers(np.interp(seconds[keep], t, way), 2),
        "position": numbers(line.position_m[keep], 4),
        "heading": None if line.heading_deg is None else numbers(np.abs(line.heading_deg[keep]), 3),
        "start": None if track is None or track.yaws is None else _start_errors(run, track, keep),
    }


def _start_errors(run: PlottedRun, track: ReferenceTrack, keep: IntArray) -> dict[str, list[float | None]]:
    """Errors of the samples ``keep`` once the first matched poses are the same: how errors grow on the way."""
    assert run.result.accuracy is not None
    assert run.result.accuracy.errors is not None
    series = run.result.accuracy.errors
    truth = track.poses[np.searchsorted(track.stamps_ns, series.stamps_ns)]
    aligned = se2.compose(se2.compose(truth[0], se2.inverse(series.estimate[0])), series.estimate)[keep]
    return {
        "position": numbers(np.hypot(*(aligned[:, :2] - truth[keep, :2]).T), 4),
        "heading": numbers(np.abs(np.degrees(se2.wrap_angle(aligned[:, 2] - truth[keep, 2]))), 3),
    }


def _innovations(run: PlottedRun, t: FloatArray) -> dict[str, Any] | None:
    """Means of successive NIS values: single ones scatter by a factor of ten."""
    nis = run.result.run.nis
    use = np.flatnonzero(np.isfinite(nis))
    if not len(use):
        return None
    groups = np.array_split(use, min(_MOST_MEANS, len(use)))
    return {"t": numbers([t[g].mean() for g in groups], 2), "nis": numbers([nis[g].mean() for g in groups], 3)}


def _loops(run: PlottedRun) -> list[list[float | None]]:
    """Loop closures: both poses' x and y, and the time of the later one."""
    found = run.result.run.keyframes
    if found is None:
        return []
    start_ns = run.result.run.trajectory.stamps_ns[0]
    edges = found.edges[found.edge_is_loop][:_MOST_LOOPS]
    poses = run.placed(found.poses)
    return [
        [*numbers(np.r_[poses[a, :2], poses[b, :2]], 2), round(float(found.stamps_ns[max(a, b)] - start_ns) * 1e-9, 2)] for a, b in edges
    ]


def _lost(run: PlottedRun, t: FloatArray) -> list[list[float | None]]:
    """Intervals without a matched scan, [from, to] in seconds."""
    matched = t[np.isfinite(run.result.run.nis)]
    if not len(matched):
        return []
    gaps = np.flatnonzero(np.diff(matched) > _LOST_AFTER_S)
    found = [[float(matched[i]), float(matched[i + 1])] for i in gaps]
    if t[-1] - matched[-1] > _LOST_AFTER_S:
        found.append([float(matched[-1]), float(t[-1])])
    return [numbers(np.array(pair), 2) for pair in found]


def _slips(run: PlottedRun, t: FloatArray) -> list[list[float | None]]:
    """Intervals in which scans contradict the wheels: [from, to] in seconds, and the largest innovation in sigmas; the largest of all."""
    nis = run.result.run.nis
    large = np.flatnonzero(nis > _SLIP_NIS)
    if not len(large):
        return []
    parts = np.split(large, np.flatnonzero(np.diff(t[large]) > _LOST_AFTER_S) + 1)
    found = [[t[part[0]], t[part[-1]], np.sqrt(nis[part].max())] for part in parts]
    return [numbers(row, 2) for row in sorted(sorted(found, key=lambda row: -row[2])[:_MOST_SLIPS])]


def _ellipses(poses: FloatArray, covariances: FloatArray) -> list[list[float | None]]:
    """Half axes [m] and direction [rad] of the two-sigma ellipses of ``poses`` (N, 3) with covariances (N, 3, 3): three columns."""
    found = [ellipse(pose, cov) for pose, cov in zip(poses, covariances, strict=True)]
    return [numbers([e.semi_axes[0] for e in found], 3), numbers([e.semi_axes[1] for e in found], 3), numbers([e.angle for e in found], 2)]


def _by_movement(histories: Mapping[str, FloatArray]) -> list[tuple[str, FloatArray]]:
    """Histories (N, 3) of stamp, mean and sigma by name; first what moved by the most of its first sigmas, which the page opens on."""
    moved = {name: float(np.ptp(rows[:, 1])) / max(float(rows[0, 2]), 1e-12) for name, rows in histories.items()}
    return sorted(histories.items(), key=lambda item: -moved[item[0]])


def _history(rows: FloatArray, start_ns: int) -> dict[str, list[float | None]]:
    """Mean and sigma over time of one estimated parameter; three digits of its final sigma."""
    rows = rows[_evenly(len(rows), _MOST_MEANS)]
    digits = int(np.clip(2.0 - np.floor(np.log10(max(float(rows[-1, 2]), 1e-9))), 0, 9))
    return {"t": numbers(rows[:, 0] - start_ns * 1e-9, 2), "mean": numbers(rows[:, 1], digits), "sigma": numbers(rows[:, 2], digits)}


def _reference(track: ReferenceTrack, start_ns: int) -> dict[str, Any]:
    keep = _evenly(len(track.stamps_ns), _MOST_POINTS // 2)
    return {
        "t": numbers((track.stamps_ns[keep] - start_ns) * 1e-9, 2),
        "x": numbers(track.positions[keep, 0], _MILLIMETRES),
        "y": numbers(track.positions[keep, 1], _MILLIMETRES),
    }


def _evenly(count: int, most: int) -> IntArray:
    """Indices of at most ``most`` of ``count`` rows, the first and the last among them."""
    return np.linspace(0, max(count - 1, 0), min(most, count)).astype(np.int64)


def grid_layer(grid: Grid, url: str) -> dict[str, Any]:
    """The picture of ``grid`` at ``url``, as the map of the page is drawn over it."""
    height, width = (cells * grid.resolution for cells in grid.cells.shape)
    return {"source": url, "left": grid.origin[0], "top": grid.origin[1] + height, "width": width, "height": height}


def numbers(values: ArrayLike, digits: int) -> list[float | None]:
    """Rounded; what is not finite is null."""
    rounded = np.round(np.asarray(values, dtype=float), digits)
    return [float(v) if np.isfinite(v) else None for v in rounded]
