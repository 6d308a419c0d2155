"""`skidloc replay`: all pairs of motion model and estimator over one log, scored, plotted and written."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from localization.calibration.robot_notes import robot_notes
from localization.commands.common import WIDE, names, new_folder, print_message, print_table, write_json
from localization.commands.models import model_names
from localization.errors import EstimatorError, EvaluationError, MapError, SettingError
from localization.estimators import ESTIMATORS_WITH_CORRECTIONS, ESTIMATORS_WITH_MAP, LOCALIZER, PriorMap, check_estimator, merge_maps
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import (
    ReferenceTrack,
    Relations,
    describe_instant,
    no_overlap_message,
    reference_track,
    with_noise,
)
from localization.evaluation.scores import Result, score
from localization.events import Event, PositionSample
from localization.evidence import open_log_with_set_up
from localization.lifting import write_tum3
from localization.log_replay import Run, replay, warnings_of
from localization.logs import Log, TopicOverrides
from localization.logs.fused_messages import MAP_FRAME, PARENT_FRAME, FusedEstimate
from localization.logs.reference_topics import merge_positions, read_positions
from localization.logs.writer import write_fused
from localization.maps import SavedMap, load_map, save_map
from localization.maps.space_places import make_places
from localization.messages import Message, message
from localization.output import as_text, check_outputs, fingerprint, versions
from localization.pipeline import ReplayConfig, Trial
from localization.report.cg_figure import turn_blocks
from localization.report.page import Block
from localization.report.replay_page import COLUMNS, MISSING, Column, ReportHead, overview_png, verdict, with_values, write_report
from localization.report.scan_layer import ScanLayer
from localization.report.turn_layer import TurnLayer
from localization.trajectory import write_tum
from motion_models.base import MotionModel
from motion_models.online_calibration import Form, check_forms
from motion_models.prior import scaling_prior
from motion_models.registry import advice, make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

_WHEELLESS = "lidar"
_PROGRESS_NS = 500_000_000
_FIRST_LEFT_OUT = ("RPE deg/m", "speed x", "drift %", "ATE deg", "end m", "NEES", "LiDAR lost %")
"""Titles of columns, in the order in which a narrow terminal leaves them out."""


@dataclass(frozen=True)
class Replay:
    """Run motion models and estimators over a log and score their trajectories."""

    log: tyro.conf.Positional[Path]
    """ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    out: Path
    """New folder for metrics.json, report.html, overview.png, trajectories (TUM) and fused.mcap, in which /tf is
    that of the last model and estimator."""
    model: str = "auto"
    """Motion models, separated by commas; `auto`: diff_drive, skid_steer, and friction for a robot with arms."""
    estimator: str = "odometry,lidar,ekf"
    """Estimators, separated by commas; `lidar` is left out where the log has no scans, unless asked for."""
    pairs: str = ""
    """MODEL/ESTIMATOR, separated by commas, such as diff_drive/odometry,skid_steer/ekf; default: each estimator with each model."""
    corrections: str = "constant"
    """Parameters of the motion model that ekf and graph estimate, one or more forms separated by commas: none; constant (k and centre
    of rotation, as random walks); cg_field (coefficients of both as functions of the centre of gravity); or parameters by name joined
    by +, such as constant+cg_offset_x (friction model: mu_ratio, tracked_x, tracked_y, warp, cg_offset_x, cg_offset_y)."""
    reference: str | None = None
    """Topic of the log, or file (TUM, EuRoC, KITTI, CSV with a header, g2o, GPX, NMEA, .relations), to score against; `none`: no
    reference. Default: the reference topic of the robot file, if any."""
    reference_sigma: tuple[float, float] | None = None
    """Sigmas of position and heading of a reference without covariances [m, deg], such as 0.02 0.5; default: an exact reference."""
    positions: str | None = None
    """Topic of positions (NavSatFix or poses) that `graph` fuses, such as `/fix`; with a `--map` that was built with positions, they
    narrow the search. The antenna's lever arm is set by --config.estimator.graph.antenna-x-m and -y-m. If the topic is the reference as
    well, every second position is fused, and the others are the reference."""
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Map saved by `--save-map`. Adds the estimator `map`, which localizes in it; its poses are in the frame of that map."""
    initial_pose: tuple[float, float, float] | None = None
    """Approximate first pose in `--map` [m, m, deg], such as 3.5 -1.2 90; without it the whole map is searched."""
    save_map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """New file for the map of the last `graph` run, such as `office.skidmap`. `skidloc map` shows and exports it."""
    extend_map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """New file for `--map` extended by the keyframes of this drive that add to it or change it. The file of `--map` is not changed."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)
    timing: bool = False
    """Put computing time into metrics.json (`real_time_factor`). It differs from run to run; without this the file does not."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a copy of metrics.json to this file as well."""
    static: bool = False
    """Write a report without scripts, smaller by 1.2 MB, with static figures."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        robot = load_robot(self.robot)
        check_outputs(self.out, self.json, self.save_map, self.extend_map)
        for name in self._models(robot):
            make_model(name, robot)
        for name in self._named_estimators:
            check_estimator(name, has_lidar=True, has_map=True)
        log = self._open(robot)
        robot, mounts = log.robot, log.mounts
        has_lidar = log.sources.lidar is not None
        models = [make_model(name, robot) for name in self._models(robot)]
        forms = names(self.corrections, "--corrections")
        pairs = self._trials(log, models, check_forms(forms))
        self._check_map(has_lidar)
        if self.extend_map is not None and self.map is None:
            raise EstimatorError("--extend-map adds to a saved map. Name it by --map, or write a new one by --save-map.")
        reference, positions = self._reference(log), self._positions(log)
        held_out = [message("positions.held_out", topic=self.positions or "")] if self._is_held_out(log) else []
        # the LiDAR alone uses no motion model: it runs once, and counts for each
        alone = next((p for p in pairs if p.estimator == _WHEELLESS), None)
        once = [p for p in pairs if p.estimator != _WHEELLESS or p is alone]
        layer, turns = ScanLayer(log.duration_s, mounts), TurnLayer(robot)
        with _progress(console, log) as (events, on_event):
            watched = turns.watch(layer.watch(merge_positions(events, positions)))
            found = replay(watched, once, robot, mounts, has_lidar, self.config, on_event)
        self._refuse_tilt(log, once, found)
        by_pair = {(p.model.name, p.estimator, p.corrections): run for p, run in zip(once, found, strict=True)}
        runs = []
        for p in pairs:
            run = by_pair[(alone if alone is not None and p.estimator == _WHEELLESS else p).model.name, p.estimator, p.corrections]
            several = run.corrections is not None and len(forms) > 1
            label = f"{p.estimator}_{p.corrections.replace('+', '_')}" if several else p.estimator
            runs.append(dataclasses.replace(run, model=p.model.name, estimator=label))
        results = score(runs, reference)
        head = ReportHead(
            log=as_text(log.path.name),
            robot=robot.name,
            start=describe_instant(log.start_ns),
            duration_s=log.duration_s,
            warnings=list(
                dict.fromkeys(
                    [
                        *robot_notes(robot, [m.name for m in models]),
                        *held_out,
                        *log.warnings(),
                        *warnings_of(found),
                        *_in_space_notes(found),
                    ]
                )
            ),
            versions=versions(),
            log_fingerprint=fingerprint(log.path),
            center_of_gravity=_about_center_of_gravity(turns, found, models, robot),
            scans=layer.scans,
        )
        self._write(head, results, reference)
        if self.save_map is not None:
            save_map(
                self.save_map, saved_map([run for run in runs if run.estimator != LOCALIZER], head, mounts, dataclasses.asdict(self.config))
            )
        if self.extend_map is not None:
            console.print(self._extend(self.extend_map, runs, head, mounts), markup=False, soft_wrap=True)
        self._print(console, head, results, reference)

    @property
    def _chosen(self) -> list[tuple[str, str]]:
        """Model and estimator of `--pairs`; none by default. Raises `SettingError` for what is no pair."""
        found = []
        for pair in names(self.pairs, "--pairs") if self.pairs else ():
            model, slash, estimator = pair.partition("/")
            if not (model and slash and estimator):
                raise SettingError(f"--pairs has '{pair}'; a pair is MODEL/ESTIMATOR, such as skid_steer/ekf.")
            found.append((model, estimator))
        return found

    def _models(self, robot: Robot) -> list[str]:
        if self._chosen:
            return list(dict.fromkeys(model for model, _ in self._chosen))
        return model_names(self.model, [robot])

    @property
    def _named_estimators(self) -> list[str]:
        return list(dict.fromkeys(estimator for _, estimator in self._chosen)) or names(self.estimator, "--estimator")

    def _open(self, robot: Robot) -> Log:
        return open_log_with_set_up(self.log, robot, self.topic.scored_against(self.reference)).log

    def _trials(self, log: Log, models: Sequence[MotionModel], forms: Sequence[Form]) -> list[Trial]:
        """Each estimator with each model, and, where it corrects that, each of the ``forms`` of corrections."""
        prior, chosen = self._prior(log), self._chosen
        return [
            Trial(model, estimator, form, prior if estimator == LOCALIZER else None)
            for estimator in self._estimators(log)
            for model in models
            if not chosen or estimator == LOCALIZER or (model.name, estimator) in chosen
            for form in forms[: None if estimator in ESTIMATORS_WITH_CORRECTIONS else 1]
        ]

    def _write(self, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
        """The folder of results, and the copy of its metrics. Raises `OutputError`."""
        metrics = self._metrics(head, results)
        with new_folder(self.out) as folder:
            write_json(folder / "metrics.json", metrics)
            for result in results:
                write_tum(folder / f"{result.name}.tum", result.run.trajectory)
                write_tum3(folder / f"{result.name}_3d.tum", result.run.in_space)
            write_fused(folder / "fused.mcap", {r.name: _estimates(r.run) for r in results}, results[-1].name)
            write_report(folder / "report.html", head, results, reference, is_interactive=not self.static)
            overview_png(folder / "overview.png", head, results, reference)
        if self.json is not None:
            write_json(self.json, metrics)

    def _estimators(self, log: Log) -> list[str]:
        has_lidar, is_default = log.sources.lidar is not None, not self.pairs and self.estimator == type(self).estimator
        found = self._named_estimators
        found += [LOCALIZER] if self.map is not None and LOCALIZER not in found else []
        for name in found:
            check_estimator(name, has_lidar or (is_default and name != LOCALIZER), self.map is not None, log.no_wheels)
        if is_default and not has_lidar:
            found.remove(_WHEELLESS)
        return found

    def _prior(self, log: Log) -> PriorMap | None:
        """The saved map. Raises `MapError` where it cannot be read, or does not fit the LiDAR of ``log``."""
        pose = self.initial_pose
        if pose is not None and (self.map is None or not all(map(math.isfinite, pose))):
            raise EstimatorError("--initial-pose is three numbers x y yaw [m, m, deg] in a saved map. Name the map by --map.")
        if self.map is None:
            return None
        saved, is_planar = load_map(self.map), self.config.step.planar
        prior = PriorMap(make_places(saved.map, self.config.estimator.lidar.range_noise_m), self._initial())
        prior.check_lidar(log.sources.has_clouds, bool(is_planar))
        if not prior.is_in_space and is_planar is False:
            raise MapError(f"map '{self.map}' holds planar scans: poses in it are in the plane. Leave out --config.step.no-planar.")
        if self.positions is not None and "graph" not in self._named_estimators:
            saved.planar(self.map, "--positions without the estimator graph")
        return prior

    def _refuse_tilt(self, log: Log, trials: Sequence[Trial], runs: Sequence[Run]) -> None:
        """Raises `MapError` where a 3D LiDAR was tilted by the ground in a map of planar scans."""
        for trial, run in zip(trials, runs, strict=True):
            is_planar_map = trial.prior is not None and not trial.prior.is_in_space
            if is_planar_map and run.in_space is not None and log.sources.has_clouds and self.config.step.planar is None:
                raise MapError(
                    f"map '{self.map}' holds planar scans, and the IMU shows that the ground tilts: a 3D LiDAR is lost in it. "
                    "Save a map in space by --estimator graph --save-map, or stay in the plane by --config.step.planar."
                )

    def _initial(self) -> FloatArray | None:
        """(3,) `--initial-pose` [m, m, rad]."""
        pose = self.initial_pose
        return None if pose is None else np.array([pose[0], pose[1], math.radians(pose[2])])

    def _extend(self, path: Path, runs: Sequence[Run], head: ReportHead, mounts: Mapping[str, Mount]) -> str:
        """Write the map with what is new in the drive, and return a sentence on it. Raises `MapError` where the drive does not fit."""
        assert self.map is not None
        old = load_map(self.map)
        if all(run.keyframes is None for run in runs):
            raise MapError(f"nothing was added to the map '{self.map}': the drive was never localized in it. Give --initial-pose.")
        of_graph = [run for run in runs if run.estimator != LOCALIZER]
        drive = saved_map(
            of_graph if any(run.keyframes is not None for run in of_graph) else runs, head, mounts, dataclasses.asdict(self.config)
        )
        found = merge_maps(old.map, drive.map, self.config.estimator.lidar.range_noise_m, only_new=True, initial=self._initial())
        save_map(path, SavedMap(found.map, {"extended_from": [dict(old.provenance), dict(drive.provenance)]}))
        added = f"map: {found.added} of {len(drive.map.poses)} keyframes are new in '{path}', {found.closed} were found in '{self.map}'"
        return f"{added}, {found.removed} points of which are gone" if found.removed else added

    def _check_map(self, has_lidar: bool) -> None:
        """Refuse `--save-map` before the run, where there will be no map."""
        if self.save_map is None:
            return
        if "graph" not in self._named_estimators:
            raise EstimatorError("--save-map saves the map of the graph. Add it: --estimator odometry,ekf,graph.")
        if not has_lidar:
            raise EstimatorError("--save-map needs scans, and there are none in this log. Leave it out, or pass --topic.scan.")

    def _reference(self, log: Log) -> ReferenceTrack | Relations | None:
        """The reference, by topic or file; read before the run, so that a wrong name is reported at once."""
        name = self._reference_name(log)
        if name is None or name == "none":
            if self.reference_sigma is not None:
                raise EvaluationError("--reference-sigma is the noise of a reference, and there is none. Name one with --reference.")
            return None
        if self._is_held_out(log) and name in log.types:
            found: ReferenceTrack | Relations = reference_track(itertools.islice(log.references(name), 1, None, 2), name)
        else:
            found = load_reference(log, name)
        check_overlap(found, log)
        if self.reference_sigma is None:
            return found
        if isinstance(found, Relations):
            raise EvaluationError("--reference-sigma is the noise of poses, and the reference has relations. Leave it out.")
        return with_noise(found, self.reference_sigma[0], math.radians(self.reference_sigma[1]))

    def _positions(self, log: Log) -> list[PositionSample]:
        if self.positions is None:
            return []
        if "graph" not in self._named_estimators and self.map is None:
            raise EstimatorError("--positions are fused by the graph alone. Add it: --estimator odometry,ekf,graph.")
        samples = log.references(self.positions)
        return read_positions(itertools.islice(samples, 0, None, 2) if self._is_held_out(log) else samples, self.positions)

    def _reference_name(self, log: Log) -> str | None:
        return self.reference if self.reference is not None else log.reference_topic

    def _is_held_out(self, log: Log) -> bool:
        """Whether the positions that are fused are the reference as well."""
        return self.positions is not None and self.positions == self._reference_name(log)

    def _metrics(self, head: ReportHead, results: Sequence[Result]) -> dict[str, Any]:
        robot = load_robot(self.robot)
        prior = scaling_prior(robot, self._models(robot))
        return {
            "log": head.log,
            "robot": head.robot,
            "duration_s": head.duration_s,
            "distance_m": _distance(results),
            "results": [result.metrics(head.duration_s, self.timing) for result in results],
            "notes": list(head.warnings),
            "messages": [note.as_json() for note in head.warnings],
            "k_prior": None if prior is None else prior._asdict(),
            "provenance": {
                "log_fingerprint": head.log_fingerprint,
                "versions": dict(head.versions),
                "config": dataclasses.asdict(self.config),
            },
        }

    def _print(self, console: Console, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
        of_reference = reference.warnings if isinstance(reference, ReferenceTrack) else ()
        for note in dict.fromkeys([*head.warnings, *of_reference]):
            print_message(console, note)
        print_table(console, accuracy_table(results, head.duration_s, console.width if console.is_terminal else WIDE))
        console.print(verdict(results, reference), markup=False, soft_wrap=True)
        robot = load_robot(self.robot)
        for sentence in advice(robot, self._models(robot)):
            console.print(sentence, markup=False, soft_wrap=True)
        console.print(f"report: {self.out / 'report.html'}", markup=False, soft_wrap=True)


def _about_center_of_gravity(layer: TurnLayer, runs: Sequence[Run], models: Sequence[MotionModel], robot: Robot) -> list[Block]:
    """k and centre of rotation against a centre of gravity that moves, by the last estimator that fuses the LiDAR; none without."""
    fused = [run for run in runs if run.lidar is not None and run.estimator != _WHEELLESS and len(run.trajectory)]
    if not fused:
        return []
    turns = layer.turns(fused[-1].trajectory)
    return turn_blocks(turns, [(model.name, model) for model in models], robot) if turns.moves else []


def saved_map(runs: Sequence[Run], head: ReportHead, mounts: Mapping[str, Mount], config: Mapping[str, Any]) -> SavedMap:
    """The map of the last of ``runs`` that has one, and where it comes from: ``mounts`` of sensors by frame, settings ``config``.

    Raises `MapError` where there is none."""
    mapped = [(run, run.keyframes) for run in runs if run.keyframes is not None]
    if not mapped:
        raise MapError("no map was made, as no two keyframes have a pose: the robot did not move, or poses in space lacked the vertical.")
    run, keyframes = mapped[-1]
    provenance = {
        "log": head.log,
        "log_fingerprint": head.log_fingerprint,
        "robot": head.robot,
        "model": run.model,
        "corrections": run.corrections,
        "mounts": {frame: dataclasses.asdict(mounts[frame]) for frame in sorted(mounts)},
        "config": config,
        "versions": dict(head.versions),
    }
    return SavedMap(keyframes, provenance)


def check_overlap(reference: ReferenceTrack | Relations, log: Log) -> None:
    """Refuse a reference from another time before the log is replayed. Raises `EvaluationError`."""
    stamps = reference.stamps_ns if isinstance(reference, ReferenceTrack) else np.sort(np.r_[reference.starts_ns, reference.ends_ns])
    first = next(iter(log.events()), None)
    if first is None:
        return
    span = np.array([first.stamp_ns, first.stamp_ns + log.end_ns - log.start_ns])
    slack = 10_000_000_000  # recording may begin later and end earlier than the stamps
    if stamps[0] > span[1] + slack or stamps[-1] < span[0] - slack:
        raise EvaluationError(no_overlap_message(span, stamps, reference.source, 0))


def accuracy_table(results: Sequence[Result], duration_s: float, width: int) -> Table:
    """For rich's console: on a terminal narrower than ``width`` characters whole columns are left out, rather than digits."""
    speed = Column("Speed", "", 0, lambda r: duration_s / r.run.seconds if r.run.seconds > 0 else None, "speed x", is_error=False)
    columns = [column for column in with_values((*COLUMNS, speed), results) if column.terminal]
    table = _accuracy_cells(results, columns)
    for title in _FIRST_LEFT_OUT:
        if Console(width=1000).measure(table).maximum <= width:
            break
        columns = [column for column in columns if column.terminal != title]
        table = _accuracy_cells(results, columns)
    return table


def _accuracy_cells(results: Sequence[Result], columns: Sequence[Column]) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("model", "estimator"):
        table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column.terminal, justify="right", no_wrap=True)
    for result in results:
        numbers = [(column.value(result), column.digits) for column in columns]
        cells = [MISSING if number is None else f"{number:.{digits}f}" for number, digits in numbers]
        table.add_row(result.run.model, result.run.estimator, *cells)
    return table


def _distance(results: Sequence[Result]) -> float | None:
    """Distance driven [m] by the reference, else by the last estimate, at a resolution above the jitter at standstill."""
    known = [r.accuracy.distance_m for r in results if r.accuracy and r.accuracy.distance_m is not None]
    return known[-1] if known else results[-1].run.driven_m


def _estimates(run: Run) -> Iterator[FusedEstimate]:
    t = run.published
    in_space = (
        {} if run.in_space is None or run.in_space.is_lifted else dict(zip(run.in_space.stamps_ns, run.in_space.poses(), strict=True))
    )
    left_ns = run.left_plane_ns
    parent = MAP_FRAME if run.estimator in ESTIMATORS_WITH_MAP else PARENT_FRAME
    for i in range(len(t)):
        twist_cov = run.twist_covariances[i]
        yield FusedEstimate(
            int(t.stamps_ns[i]),
            t.poses[i],
            run.twists[i],
            None if t.covariances is None else t.covariances[i],
            twist_cov if np.isfinite(twist_cov).all() else None,
            parent,
            in_space.get(t.stamps_ns[i]) if left_ns is None or t.stamps_ns[i] > left_ns else None,
        )


def _in_space_notes(runs: Sequence[Run]) -> list[Message]:
    """Which of the ``runs`` have left the plane, when, and why."""
    return [
        message("tilting_ground.in_space", begin_s=run.in_space_from_s).of(f"{run.estimator} ({run.model})")
        for run in runs
        if run.in_space_from_s is not None
    ]


@contextlib.contextmanager
def _progress(console: Console, log: Log) -> Iterator[tuple[Iterator[Event], Callable[[int], None]]]:
    """The log's events, which advance the progress bar."""
    events = log.events()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"replaying {escape(log.path.name)}", total=max(log.duration_s, 1e-9))
        begin = shown = None

        def on_event(stamp_ns: int) -> None:
            nonlocal begin, shown
            begin = stamp_ns if begin is None else begin
            if shown is None or stamp_ns - shown > _PROGRESS_NS:
                shown = stamp_ns
                progress.update(task, completed=(stamp_ns - begin) * 1e-9)

        yield events, on_event
