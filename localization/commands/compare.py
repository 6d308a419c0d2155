"""`skidloc compare`: motion models and estimators over many logs, on all cores or on a cluster."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as Grid

from localization.calibration.robot_notes import robot_notes
from localization.commands.common import names, print_warning, write_json
from localization.commands.models import model_names
from localization.comparison.comparison_page import CompareHead, check_report, write_comparison_report
from localization.comparison.jobs import OK, Job, LogOrigin, Row, job_key, run_job, run_local, run_on_cluster, trials
from localization.comparison.manifest import Entry, read_manifest
from localization.comparison.remote import is_url
from localization.comparison.result_table import ResultFolder, ResultTable
from localization.comparison.statistics import ComparisonFindings, against_best, closing, find, leading
from localization.errors import EvaluationError, LogError, OutputError
from localization.estimators import check_estimator
from localization.logs import TopicOverrides
from localization.output import check_outputs, versions
from localization.pipeline import ReplayConfig
from motion_models.errors import RobotError
from motion_models.online_calibration import check_forms
from motion_models.registry import make_model
from motion_models.robot_file import load_robot


@dataclass(frozen=True)
class Compare:
    """Compare motion models and estimators over many logs."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs with a reference each: ROS 1 .bag, ROS 2 bag folders, bare .mcap. None with --manifest."""
    out: Path
    """Folder for table.csv and report.html; or the table itself, .csv or .parquet, with the report beside it. What is in the table
    already, and unchanged, is not computed again."""
    robot: str | None = None
    """Name of a shipped robot, or path of a robot TOML file; needed where no manifest names it."""
    manifest: Path | None = None
    """CSV file with a row for each log: log (path, or URL as s3://bucket/drive.mcap, extra `fleet`), robot, reference, floor, day. Results
    are kept log by log in results/ beside the table, trajectories in trajectories/. `skidloc table` shows k by robot, floor and day."""
    model: str = "auto"
    """Motion models, separated by commas; `auto`: diff_drive, skid_steer, and friction where a robot has arms."""
    estimator: str = "odometry,ekf"
    """Estimators, separated by commas."""
    corrections: str = "constant"
    """What ekf and graph estimate of the motion model: none, constant, cg_field; forms separated by commas."""
    reference: str | None = None
    """Topic, or file (.tum, .relations) in whose name {stem} stands for the log's. Default: the robot file's topic. A manifest may name
    another for each log."""
    metric: str = "ate_rmse_m"
    """Column that is compared; smaller is better."""
    processes: int = 0
    """On this machine; 0: as many as there are cores."""
    dask: str | None = None
    """Address of a Dask scheduler, as tcp://host:8786; its workers need this library, and the logs under the same paths."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write means and differences to this file as well."""
    static: bool = False
    """Write a report without scripts, smaller by 1.2 MB, with static figures."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.json)
        if self.processes < 0:
            raise OutputError(f"--processes is {self.processes}; it must be 1 or more, or 0 for as many as there are cores.")
        table_path, report_path = places(self.out)
        check_report(report_path)
        table = ResultTable(table_path) if self.manifest is None else ResultFolder(table_path)
        jobs = self._jobs(console, table)
        notes = self._notes(jobs)
        for note in notes:
            print_warning(console, note)
        left = [dataclasses.replace(job, trials=missing) for job in jobs if (missing := table.missing(job))]
        done = sum(len(job.trials) for job in jobs) - sum(len(job.trials) for job in left)
        if done:
            console.print(f"{done} results are in {table_path} already", markup=False, soft_wrap=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task("logs", total=len(left))
            for job, rows in self._run(left):
                table.record(job, rows, jobs)
                progress.advance(task)
                for reason in dict.fromkeys(row["error"] for row in rows if row["status"] != OK):
                    print_warning(console, f"{job.log}: {reason}")
        table.save(jobs)
        self._report(console, jobs, table, report_path)

    def _jobs(self, console: Console, table: ResultTable | ResultFolder) -> list[Job]:
        """One for each log; what is the same as another would make intervals narrower than they are."""
        forms = check_forms(names(self.corrections, "--corrections"))
        estimators = names(self.estimator, "--estimator")
        for estimator in estimators:
            check_estimator(estimator, has_lidar=True)
        entries = self._entries()
        robots = {name: load_robot(name) for name in dict.fromkeys(entry.robot for entry in entries)}
        models = model_names(self.model, list(robots.values()))
        wanted = tuple(trials(models, estimators, forms))
        for robot, model in itertools.product(robots.values(), models):
            make_model(model, robot)
        folder = Path.cwd() if self.manifest is None else self.manifest.parent.absolute()
        jobs: dict[str, Job] = {}
        for entry in dict.fromkeys(entries):
            robot = robots[entry.robot]
            key = job_key(entry.log, robot, entry.reference, self.topic, self.config, folder)
            job = Job(entry.log, robot, wanted, key, entry.reference, self.topic, self.config, folder, entry.place)
            first = jobs.setdefault(key, job)
            if first.log != entry.log:
                console.print(f"{entry.log} is the same log as {first.log}: counted once.", markup=False, soft_wrap=True)
        if not jobs:
            raise LogError("no logs to compare on; name some.")
        if isinstance(table, ResultFolder):
            return [dataclasses.replace(job, trajectories=table.trajectories(job)) for job in jobs.values()]
        return list(jobs.values())

    def _entries(self) -> list[Entry]:
        """Logs of the command line or of the manifest. Raises `LogError` and `RobotError`."""
        if self.manifest is None:
            if self.robot is None:
                raise RobotError("--robot is missing: name a shipped robot (`skidloc robots`) or the path of a robot file.")
            return [Entry(str(log), self.robot, self.reference, LogOrigin()) for log in self.logs]
        if self.logs:
            raise LogError(f"logs are named on the command line and by --manifest {self.manifest}. Leave one of them out.")
        return read_manifest(self.manifest, self.robot, self.reference)

    def _run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, list[Row]]]:
        if self.dask is not None:
            return run_on_cluster(jobs, self.dask)
        absent = [job for job in jobs if not is_url(job.log) and not (job.folder / job.log).exists()]  # needs no process
        there = [job for job in jobs if job not in absent]
        return itertools.chain(((job, run_job(job)) for job in absent), run_local(there, self.processes or os.cpu_count() or 1))

    def _report(self, console: Console, jobs: Sequence[Job], table: ResultTable | ResultFolder, report: Path) -> None:
        rows, notes = table.rows(jobs), self._notes(jobs)
        failed = [row for row in rows if row["status"] != OK]
        if len(failed) == len(rows):
            logs = len({row["log"] for row in rows})
            raise LogError(f"none of {logs} logs could be compared; the reasons are in {table.path}.")
        found = find(rows, self.metric)
        if not found.means:
            known = ", ".join(sorted({name for row in rows for name, value in row.items() if isinstance(value, float)}))
            raise EvaluationError(f"no result has a number '{self.metric}'; there are {known}.")
        for log, damage in found.damaged.items():
            print_warning(console, f"{log}: {damage}")
        grid = Grid("", "logs", f"mean {self.metric}", "95 %", box=None, header_style="bold", pad_edge=False)
        for m in found.means:
            grid.add_row(m.name, str(m.n), f"{m.mean:.4g}", f"{m.low:.4g} to {m.high:.4g}" if m.n > 1 else "")
        console.print(grid)
        for sentence in (*leading(found), *(against_best(mean, found) for mean in found.means[2:]), *closing(found)):
            console.print(sentence, markup=False, soft_wrap=True)
        if failed:
            console.print(f"The reasons of what failed are in {table.path}.", markup=False, soft_wrap=True)
        reference = self.reference or ("" if self.manifest is None else "by the manifest, else ") + "the robot file's topic"
        robots = ", ".join(dict.fromkeys(job.robot.name for job in jobs))
        head = CompareHead(robots, reference, table.path.name, versions(), notes)
        write_comparison_report(report, head, found, is_interactive=not self.static)
        console.print(f"report: {report}", markup=False, soft_wrap=True)
        if self.json is not None:
            write_json(self.json, {**_content(found), "notes": notes})

    def _notes(self, jobs: Sequence[Job]) -> list[str]:
        """On the robots: where k comes from if its file has none."""
        robots = {job.robot.name: job.robot for job in jobs}
        models = model_names(self.model, list(robots.values()))
        return list(dict.fromkeys(note for robot in robots.values() for note in robot_notes(robot, models)))


def places(out: Path) -> tuple[Path, Path]:
    """Paths of the table and of the report: in the folder ``out``, or ``out`` itself and beside it."""
    if out.is_dir() or not out.suffix:
        return out / "table.csv", out / "report.html"
    return out, out.with_suffix(".html")


def _content(found: ComparisonFindings) -> dict[str, Any]:
    return {
        "metric": found.metric,
        "verdict": " ".join([*leading(found), *closing(found)]),
        "means": [dataclasses.asdict(m) for m in found.means],
        "differences": [dataclasses.asdict(d) for d in found.tested],
        "damaged": found.damaged,
        "failed": [{name: row[name] for name in ("log", "model", "estimator", "corrections", "error")} for row in found.failed],
    }
