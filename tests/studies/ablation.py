"""What each mechanism of matcher, filter and graph is worth: one is switched off at a time, all else stays at its defaults.

python -m tests.studies.ablation [--only NAME;...] [--seconds 300] [--begin 0] [--silent A:B,...] [--minutes 10] [--cells FILE] [--write]

Five drives, the first 300 s of each (`--seconds`): ACES (mean error of the relations), fr079 and MIT-CSAIL (ATE, and mean NEES, at the
reference's instants), laps simulated by the physics of the tyres with nominal sensors, and laps over a slippery patch whose ranges are
twice as noisy as assumed, with slip that the filter's noise model does not have (ATE, and mean NEES of the pose with 3 expected).
Mechanisms of matcher and filter are measured by the EKF, those of the graph by its smoothed trajectory. Cells are stored in a file as
they are computed: called again, the study goes on where it was stopped, or where `--minutes` ended. `--write` puts the table into
`docs/lab/estimators.md`. `--begin` leaves out the first seconds of each drive, `--silent` its scans from A to B seconds after its begin:
cells of other drives need another file.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numba
import numpy as np

from localization.core.filter import Measurement, Transition, set_marginal
from localization.core.measurements.scan import key_scan_transition, measure_scan
from localization.core.policies import wheel_noise
from localization.core.policies.excitation import Excitation
from localization.core.policies.open_way import OpenWay
from localization.core.policies.slip import SlipChanges
from localization.core.state import State
from localization.estimators import fusion, graph_fusion, pose_graph
from localization.estimators.fusion import EkfFusion
from localization.evaluation.consistency import pose_consistency
from localization.evaluation.metrics import evaluate
from localization.evaluation.references import ReferenceTrack, reference_track
from localization.events import Event, Scan, Step
from localization.lidar import correlative_search, key_scans, registration, scan_matcher
from localization.lidar.key_scans import KeyScanError, KeyScans
from localization.lidar.loop_detection import LoopDetector
from localization.lidar.scan_matcher import ScanMatcher
from localization.lidar.scan_sensor import ScanMatchingSensor
from localization.lidar.submap import VoxelGrid, fill_surface, make_grid
from localization.logs import open_log
from localization.sensor_checks.moving_objects import MovingObjects
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from motion_models.robot_file import load_robot
from tests.studies.buildings import BUILDINGS, Drive, errors_of, nees_at_instants

JOURNAL = Path(__file__).parents[2] / "docs/lab/estimators.md"
CELLS = Path(tempfile.gettempdir()) / "skidloc_ablation.json"
BEGIN, END = "<!-- ablation: begin -->", "<!-- ablation: end -->"
_NO_PRIOR = 1e6 * np.eye(3)
"""Covariance of a prior that says nothing [m^2, m^2, rad^2]."""
_align_points = registration.align_points
_NO_LOSS = 1e6
"""Scale of a robust loss [sigma] that never acts."""
_LAPS = 1

Patch = Callable[[], contextlib.AbstractContextManager[Any]]


def _attribute(owner: Any, name: str, value: Any) -> Patch:
    return lambda: mock.patch.object(owner, name, value)


@contextlib.contextmanager
def _together(*patches: Patch) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch())
        yield


def _wrap(owner: Any, name: str, change: Callable[..., Any]) -> Patch:
    """``change`` (original, self, *arguments) in place of a method."""
    original = getattr(owner, name)
    return lambda: mock.patch.object(owner, name, lambda *a, **k: change(original, *a, **k))


def _independent(original: Callable[..., Any], self: EkfFusion, state: State, step: Step) -> Any:
    """The submap's error is drawn anew for each scan."""
    return original(self, set_marginal(state, "map", state["map"], state.cov("map")), step)


def _without_new(state: State, error: KeyScanError) -> Transition:
    return key_scan_transition(state, replace(error, new_cov=np.zeros((3, 3))))


def _of_least_variance(*arguments: Any) -> Measurement:
    return replace(measure_scan(*arguments), relative=None)


@numba.njit(cache=True)
def _fill_surfaces(grid: VoxelGrid, column: int, value: float) -> None:
    for v in range(grid.sums.shape[0]):
        fill_surface(grid, v)
        if not math.isinf(grid.surfaces[v, 4]):
            grid.surfaces[v, column] = value


def _thin_grid(*arguments: Any) -> VoxelGrid:
    """All surfaces have the variance of a range."""
    grid = make_grid(*arguments)
    _fill_surfaces(grid, 4, grid.noise)
    return grid


def _exact_normals(*arguments: Any) -> VoxelGrid:
    grid = make_grid(*arguments)
    _fill_surfaces(grid, 5, 0.0)
    return grid


def _align_freely(grid: VoxelGrid, points: Any, prior: Any, cov: Any, guess: Any, first: Any = None) -> Any:
    """The prior sets the reach of associations but does not pull."""
    error = registration.prior_error_at_points(points, cov) if first is None else first
    return _align_points(grid, points, prior, _NO_PRIOR, guess, error)


def _match_without_new_place(original: Callable[..., Any], self: ScanMatcher, *rest: Any, **named: Any) -> Any:
    found = original(self, *rest, **named)
    self.is_new_place = False
    return found


_NO_SEARCH = (
    _attribute(scan_matcher, "find_place", lambda *a: None),
    _attribute(registration, "_BASIN", math.inf),
)
_ASSUMED_NOISE = (_attribute(ScanMatcher, "_residual_variance", 1.0), _attribute(ScanMatcher, "_block_variance", 1.0))
PATCHES: Mapping[str, Patch] = {
    "old key scans that fit": _wrap(
        KeyScans, "_fitting_keys", lambda original, self, pose, points, map_cov: original(self, pose, points, None)
    ),
    "slip that changes within a sweep": _attribute(SlipChanges, "rate", lambda *a: np.zeros((3, 3))),
    "second deskewing pass": _attribute(ScanMatchingSensor, "refine", lambda self, match, twist: match),
    "correlative search": lambda: _together(*_NO_SEARCH),
    "motion of the last step in the search": _wrap(
        ScanMatchingSensor,
        "measure",
        lambda original, self, step, prior, cov, offset: original(self, step, prior, cov, np.zeros(3)),
    ),
    "rival test of the search": _attribute(correlative_search, "_MAX_RIVAL", math.inf),
    "total cost (more points fit, instead)": _attribute(
        scan_matcher, "_is_better", lambda found, fit, prior, cov: found.overlap > fit.overlap
    ),
    "prior as possible outlier": lambda: _together(
        _attribute(scan_matcher, "OUTLIER_COST", math.inf), _attribute(correlative_search, "OUTLIER_COST", math.inf)
    ),
    "prior in the least squares": _attribute(scan_matcher, "align_points", _align_freely),
    "thickness of surfaces": _attribute(key_scans, "make_grid", _thin_grid),
    "size of the residuals": lambda: _together(*_ASSUMED_NOISE),
    "correlation of neighbouring residuals": _attribute(ScanMatcher, "_block_variance", property(lambda self: self._residual_variance)),
    "submap's error": _attribute(fusion, "key_scan_transition", lambda state, error: Transition()),
    "submap's error as consider state (independent noise, instead)": _wrap(EkfFusion, "_update_scan", _independent),
    "pose kept on the submap": _attribute(fusion, "measure_scan", _of_least_variance),
    "new surfaces' error of key scans": _attribute(fusion, "key_scan_transition", _without_new),
    "scale of the wheel noise": _attribute(wheel_noise, "_MAX_NOISE_SCALE", 1.0),
    "excitation gate of corrections": _attribute(Excitation, "start_step", lambda self, motion: None),
    "radius considered while the way is open": _attribute(Excitation, "considered_by_scan", lambda self, *a: self.considered()),
    "ways by wheels alone": _attribute(OpenWay, "cov", lambda self, step: np.zeros((3, 3))),
    "moving objects left out": _attribute(MovingObjects, "apply", lambda self, step, **_: step),
    "noise of normals": _attribute(key_scans, "make_grid", _exact_normals),
    "key scans of new places at once": _wrap(ScanMatcher, "match", _match_without_new_place),
}
GRAPH_PATCHES: Mapping[str, Patch] = {
    "loop closures": _attribute(LoopDetector, "detect", lambda self, cell, poses, marginal: None),
    "robust loss of loops": _attribute(pose_graph, "_CAUCHY", _NO_LOSS),
    "robust loss of wheels": _attribute(pose_graph, "_HUBER", _NO_LOSS),
    "ways that the scene leaves open as the wheels' alone": _attribute(graph_fusion, "_OPEN_SHARE", math.inf),
    "corrections of the graph in the filter": _attribute(EkfFusion, "set_corrections", lambda self, mean, cov: None),
    "random walk of the corrections": _attribute(graph_fusion, "_CORRECTION_EPOCH_S", math.inf),
}
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "clock offset": {"clock_sigma_s": 0.0, "clock_walk_s_per_sqrt_s": 0.0},
    "radius of the wheels": {"wheel_radius_sigma": 0.0},
    "corrections to the motion model": {"corrections": "none"},
}
MECHANISMS = (*PATCHES, *SETTINGS, *GRAPH_PATCHES)
COLUMNS = ("ACES: relations [m]", "fr079: ATE [m], NEES", "CSAIL: ATE [m], NEES", "laps: ATE [mm], NEES", "slippery, noisy: ATE [mm], NEES")


def simulated(experiment: str, sensors: SensorConfig, seed: int) -> Drive:
    """A drive of VaultBot, by the physics of its tyres."""
    robot = load_robot("vaultbot")
    config = SimulationConfig(experiment=ExperimentConfig(laps=_LAPS), sensors=sensors)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_simulation(path, simulate(experiment, robot, seed, {}, config))
        log = open_log(path, robot)
        truth = reference_track(log.references("/ground_truth/odom"), "/ground_truth/odom")
        return Drive(list(log.events()), robot, log.mounts, truth)


def part_of(drive: Drive, begin_s: float, seconds: float, silent: Sequence[tuple[float, float]] = ()) -> Drive:
    """``seconds`` of ``drive`` from ``begin_s`` on, without the scans of the ``silent`` spans after that [s]."""
    first_ns = drive.events[0].stamp_ns + round(begin_s * 1e9)

    def is_kept(event: Event) -> bool:
        at_s = (event.stamp_ns - first_ns) * 1e-9
        return 0.0 <= at_s <= seconds and not (isinstance(event, Scan) and any(a <= at_s < b for a, b in silent))

    return replace(drive, events=[event for event in drive.events if is_kept(event)])


def drives(seconds: float, begin_s: float = 0.0, silent: Sequence[tuple[float, float]] = ()) -> Mapping[str, Drive]:
    """`part_of` all five, by the heads of their columns."""
    imu = ImuConfig(rate_hz=0.0)
    noisy = ScannerConfig(noise_m=0.04)  # twice `LidarConfig.range_noise_m`
    found = [BUILDINGS[name].open() for name in ("aces", "fr079", "csail")]
    found += [simulated("laps", SensorConfig(imu=imu), 0), simulated("slippery_patch", SensorConfig(imu=imu, scanner=noisy), 1)]
    return {column: part_of(drive, begin_s, seconds, silent) for column, drive in zip(COLUMNS, found, strict=True)}


def cell(name: str, drive: Drive, settings: Mapping[str, Any], estimator: str) -> str:
    """One number of the table, or two."""
    run = drive.run(estimator, "skid_steer", **settings)
    if not isinstance(drive.reference, ReferenceTrack):
        return f"{errors_of(run.trajectory, drive.reference)[0]:.4f}"
    if "[m]" in name:
        return f"{errors_of(run.trajectory, drive.reference)[0]:.3f}, {nees_at_instants(run.trajectory, drive.reference)[0]:.1f}"
    ate = evaluate(run.trajectory, drive.reference).ate_rmse_m or 0.0  # truth is exact at any time: interpolated
    found = pose_consistency(run.trajectory, drive.reference)
    return f"{1e3 * ate:.1f}, " + ("–" if found is None else f"{found.mean:.2f}")  # noqa: RUF001


def rows(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Label, mechanism ("" for none) and estimator of each row; the rows with everything come first."""
    ekf = [("nothing (EKF)", "", "ekf"), *((name, name, "ekf") for name in names if name not in GRAPH_PATCHES)]
    graph = [("nothing (graph, smoothed)", "", "graph"), *((name, name, "graph") for name in names if name in GRAPH_PATCHES)]
    return [*(ekf if len(ekf) > 1 else []), *(graph if len(graph) > 1 else [])]


def compute(
    names: Sequence[str], open_drives: Callable[[], Mapping[str, Drive]], minutes: float, cells: dict[str, str], store: Callable[[], None]
) -> None:
    """Add the missing ``cells``, by "row | column", until ``minutes`` are over; `store` is called after each."""
    end = time.monotonic() + 60.0 * minutes
    missing = [(f"{label} | {column}", mechanism, estimator) for label, mechanism, estimator in rows(names) for column in COLUMNS]
    missing = [entry for entry in missing if entry[0] not in cells]
    logs = open_drives() if missing else {}
    for key, mechanism, estimator in missing:
        if time.monotonic() > end:
            return
        column = key.split(" | ")[1]
        with {**PATCHES, **GRAPH_PATCHES}.get(mechanism, contextlib.nullcontext)():
            cells[key] = cell(column, logs[column], SETTINGS.get(mechanism, {}), estimator)
        store()
        print(key, cells[key], flush=True)


def table(names: Sequence[str], cells: Mapping[str, str]) -> list[str]:
    """Lines of the table; a cell that is not computed yet is empty."""
    head = [f"| without | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    return [*head, *(f"| {label} | {' | '.join(cells.get(f'{label} | {c}', '') for c in COLUMNS)} |" for label, _, _ in rows(names))]


def write_into(text: str, lines: Sequence[str]) -> str:
    """``text`` with ``lines`` between the markers."""
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{rest.split(END)[1]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default=";".join(MECHANISMS), help="mechanisms, separated by semicolons")
    parser.add_argument("--seconds", type=float, default=300.0, help="of each drive")
    parser.add_argument("--begin", type=float, default=0.0, help="left out at the start of each drive [s]")
    parser.add_argument("--silent", default="", help="spans without scans, as 60:90,120:150 [s]")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no further cell is begun")
    parser.add_argument("--cells", type=Path, default=CELLS, help="file of the cells that are computed already")
    parser.add_argument("--write", action="store_true", help="write the table into the lab journal")
    options = parser.parse_args()
    names = options.only.split(";")
    if unknown := [name for name in names if name not in MECHANISMS]:
        parser.error(f"no mechanism '{unknown[0]}'; there are {', '.join(MECHANISMS)}.")
    cells = json.loads(options.cells.read_text()) if options.cells.exists() else {}
    silent = [(float(a), float(b)) for a, _, b in (span.partition(":") for span in options.silent.split(",") if span)]

    def open_drives() -> Mapping[str, Drive]:
        return drives(options.seconds, options.begin, silent)

    compute(names, open_drives, options.minutes, cells, lambda: options.cells.write_text(json.dumps(cells, indent=1)) and None)
    lines = table(names, cells)
    print("\n".join(lines))
    if options.write:
        JOURNAL.write_text(write_into(JOURNAL.read_text(encoding="utf-8"), lines), encoding="utf-8")


if __name__ == "__main__":
    main()
