"""Drift of the filter on ACES, MIT-CSAIL and fr079, by variants of its scan matching.

python -m tests.studies.drift [VARIANT ...]

ACES is judged by hand-verified relations (`tests.studies.buildings`), of which 59 of 1,279 span more than 480 s and loops: their mean error
is drift of one drive. Here it is the error over 10 and 40 m of way from each metre on, against the smoothed graph of the same log, whose
loops end drift: root mean square of the position [m], of the heading [deg], and the heading's mean [deg]. The first number of a log is the
ATE, or the mean error of the relations [m]. Variants with fewer points show how far chance moves these numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from localization.core.motion import FilterConfig
from localization.estimators import EstimatorConfig, fusion
from localization.events import Scan
from localization.lidar import LidarConfig
from localization.lidar.key_scans import KeyScan
from localization.log_replay import replay
from localization.pipeline import ReplayConfig, Trial
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS, Drive, errors_of

LENGTHS_M = (10.0, 40.0)
_KEPT = 0.9
"""Share of the points in variants with fewer."""


class Variant(NamedTuple):
    """What differs from the default."""

    lidar: Mapping[str, Any] = {}
    seed: int | None = None
    """Of the choice of points, where fewer are used."""
    estimator: str = "ekf"
    change: Callable[[], AbstractContextManager[Any]] = nullcontext


def _scaled_scan_noise(factor: float) -> Callable[[], AbstractContextManager[Any]]:
    measure = fusion.measure_scan
    return lambda: mock.patch.object(fusion, "measure_scan", lambda state, pose, R: measure(state, pose, factor * R))


def _scaled_drift(factor: float) -> Callable[[], AbstractContextManager[Any]]:
    """Old key scans stay while they have drifted by ``1 / factor`` of what they may by default."""
    drift = KeyScan.drift_variance
    return lambda: mock.patch.object(KeyScan, "drift_variance", lambda key, *args: factor**2 * drift(key, *args))


VARIANTS: Mapping[str, Variant] = {
    "default": Variant(),
    "KISS-ICP first": Variant({"matcher": "kiss"}),
    "graph, live": Variant(estimator="graph"),
    **{f"9 of 10 points, {seed}": Variant(seed=seed) for seed in (1, 2, 3)},
    **{f"KISS-ICP first, 9 of 10 points, {seed}": Variant({"matcher": "kiss"}, seed) for seed in (1, 2)},
    **{f"graph, live, 9 of 10 points, {seed}": Variant(seed=seed, estimator="graph") for seed in (1, 2)},
    **{f"{n} key scans": Variant({"key_scans": n}) for n in (20, 80)},
    **{f"a key scan each {d} m": Variant({"key_distance_m": d}) for d in (0.25, 1.0)},
    **{f"range noise {s} m": Variant({"range_noise_m": s}) for s in (0.01, 0.04)},
    "no old key scans": Variant(change=_scaled_drift(1e6)),
    "old key scans within 8 cm": Variant(change=_scaled_drift(0.5)),
    "old key scans within 30 cm": Variant(change=_scaled_drift(0.04 / 0.3)),
    **{f"covariance of scans x {q}": Variant(change=_scaled_scan_noise(q)) for q in (0.25, 4.0)},
}


@cache
def drive_of(name: str) -> Drive:
    """The log, read once."""
    return BUILDINGS[name].open()


@cache
def smoothed(name: str) -> Trajectory:
    """The reference: of the default graph."""
    return drive_of(name).run("graph").trajectory


def run(name: str, variant: Variant) -> Trajectory:
    """Poses as they are published live."""
    drive, rng = drive_of(name), np.random.default_rng(variant.seed)
    events = drive.events
    if variant.seed is not None:
        events = [_thinned(event, rng) if isinstance(event, Scan) else event for event in events]
    config = ReplayConfig(estimator=EstimatorConfig(ekf=FilterConfig(), lidar=LidarConfig(**variant.lidar)))
    with variant.change():
        found = replay(events, [Trial(make_model("diff_drive", drive.robot), variant.estimator)], drive.robot, drive.mounts, True, config)[
            0
        ]
    return found.live or found.trajectory


def _thinned(scan: Scan, rng: np.random.Generator) -> Scan:
    kept = rng.random(len(scan.points)) > 1.0 - _KEPT
    return replace(scan, points=scan.points[kept], offsets=scan.offsets[kept] if len(scan.offsets) else scan.offsets)


def drift(name: str, trajectory: Trajectory, length_m: float) -> tuple[float, float, float]:
    """Position (RMS) [m], heading (RMS and mean) [deg] after ``length_m``."""
    reference = smoothed(name)
    _, at, use = np.intersect1d(trajectory.stamps_ns, reference.stamps_ns, return_indices=True)
    estimate, truth = trajectory.poses[at], reference.poses[use]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    start = np.searchsorted(way, np.arange(0.0, way[-1] - length_m, 1.0))
    end = np.searchsorted(way, way[start] + length_m)
    start, end = start[end < len(way)], end[end < len(way)]
    error = se2.between(se2.between(truth[start], truth[end]), se2.between(estimate[start], estimate[end]))
    yaw = np.degrees(error[:, 2])
    return float(np.sqrt(np.mean(error[:, 0] ** 2 + error[:, 1] ** 2))), float(np.sqrt(np.mean(yaw**2))), float(np.mean(yaw))


def main(*names: str) -> None:
    """Print a row for each variant."""
    print("| variant | " + " | ".join(BUILDINGS) + " |\n" + "|---" * (1 + len(BUILDINGS)) + "|")
    for name in names or VARIANTS:
        cells = []
        for log in BUILDINGS:
            trajectory = run(log, VARIANTS[name])
            parts = ["{:.3f}, {:.2f} ({:+.2f})".format(*drift(log, trajectory, length)) for length in LENGTHS_M]
            cells.append("; ".join([f"{errors_of(trajectory, drive_of(log).reference)[0]:.3f}", *parts]))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
