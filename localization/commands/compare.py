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
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as Grid

from localization.commands.common import names, write_json
from localization.comparison.jobs import OK, Job, Row, job_key, run_job, run_local, run_on_cluster, trials
from localization.comparison.page import CompareHead, check_report, write_comparison_report
from localization.comparison.statistics import Findings, against_best, closing, find, headline
from localization.comparison.table import ResultTable
from localization.errors import EvaluationError, LogError, OutputError
from localization.estimators import check_estimator
from localization.logs import TopicOverrides
from localization.output import check_outputs, versions
from localization.pipeline import ReplayConfig
from motion_models.online_calibration import check_forms
from motion_models.prior import prior_notes
from motion_models.registry import make_model
from motion_models.robot_file import load_robot


@dataclass(frozen=True)
class Compare:
    """Compare motion models and estimators over many logs."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs with a reference each: ROS 1 .bag, ROS 2 bag folders, bare .mcap."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    out: Path
    """Folder for table.csv and report.html; or the table itself, .csv or .parquet, with the report beside it. What is in the table
    already, and unchanged, is not computed again."""
    model: str = "diff_drive,skid_steer"
    """Motion models, separated by commas."""
    estimator: str = "odometry,ekf"
    """Estimators, separated by commas."""
    corrections: str = "constant"
    """What ekf and graph estimate of the motion model: none, constant, cg_field; forms separated by commas."""
    reference: str | None = None
    """Topic, or file (.tum, .relations) in whose name {stem} stands for the log's. Default: the robot file's topic."""
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
    """Write a report without scripts: smaller by 1.2 MB, with figures as on paper."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.json)
        if self.processes < 0:
            raise OutputError(f"--processes is {self.processes}; it must be 1 or more, or 0 for as many as there are cores.")
        table_path, report_path = places(self.out)
        check_report(report_path)
        jobs, table = self._jobs(console), ResultTable(table_path)
        for note in self._notes():
            console.print(f"[yellow]![/] {escape(note)}", soft_wrap=True)
        left = [dataclasses.replace(job, trials=missing) for job in jobs if (missing := table.missing(job))]
        done = sum(len(job.trials) for job in jobs) - sum(len(job.trials) for job in left)
        if done:
            console.print(f"{done} results are in {table_path} already", markup=False, soft_wrap=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task("logs", total=len(left))
            for job, rows in self._run(left):
                table.put(rows)
                table.save(jobs)
                progress.advance(task)
                for reason in dict.fromkeys(row["error"] for row in rows if row["status"] != OK):
                    console.print(f"[yellow]![/] {escape(job.log)}: {escape(reason)}", soft_wrap=True)
        if not left:
            table.save(jobs)
        self._report(console, table, report_path, table.rows(jobs))

    def _jobs(self, console: Console) -> list[Job]:
        """One for each log; what is the same as another would make intervals narrower than they are."""
        robot, forms = load_robot(self.robot), check_forms(names(self.corrections, "--corrections"))
        models, estimators = names(self.model, "--model"), names(self.estimator, "--estimator")
        for model in models:
            make_model(model, robot)
        for estimator in estimators:
            check_estimator(estimator, has_lidar=True)
        wanted = tuple(trials(models, estimators, forms))
        jobs: dict[str, Job] = {}
        for path in dict.fromkeys(self.logs):
            key = job_key(path, robot, self.reference, self.topic, self.config)
            first = jobs.setdefault(key, Job(str(path), robot, wanted, key, self.reference, self.topic, self.config))
            if first.log != str(path):
                console.print(f"{path} is the same log as {first.log}: counted once.", markup=False, soft_wrap=True)
        if not jobs:
            raise LogError("no logs to compare on; name some.")
        return list(jobs.values())

    def _run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, list[Row]]]:
        if self.dask is not None:
            return run_on_cluster(jobs, self.dask)
        absent = [job for job in jobs if not Path(job.log).exists()]  # no process needs to be started for that
        there = [job for job in jobs if job not in absent]
        return itertools.chain(((job, run_job(job)) for job in absent), run_local(there, self.processes or os.cpu_count() or 1))

    def _report(self, console: Console, table: ResultTable, report: Path, rows: Sequence[Row]) -> None:
        failed = [row for row in rows if row["status"] != OK]
        if len(failed) == len(rows):
            logs = len({row["log"] for row in rows})
            raise LogError(f"none of {logs} logs could be compared; the reasons are in {table.path}.")
        found = find(rows, self.metric)
        if not found.means:
            known = ", ".join(sorted({name for row in rows for name, value in row.items() if isinstance(value, float)}))
            raise EvaluationError(f"no result has a number '{self.metric}'; there are {known}.")
        for log, damage in found.damaged.items():
            console.print(f"[yellow]![/] {escape(log)}: {escape(damage)}", soft_wrap=True)
        grid = Grid("", "logs", f"mean {self.metric}", "95 %", box=None, header_style="bold", pad_edge=False)
        for m in found.means:
            grid.add_row(m.name, str(m.n), f"{m.mean:.4g}", f"{m.low:.4g} to {m.high:.4g}" if m.n > 1 else "")
        console.print(grid)
        for sentence in (headline(found), *(against_best(mean, found) for mean in found.means[2:]), *closing(found)):
            console.print(sentence, markup=False, soft_wrap=True)
        if failed:
            console.print(f"The reasons of what failed are in {table.path}.", markup=False, soft_wrap=True)
        reference = self.reference or "the robot file's topic"
        head = CompareHead(load_robot(self.robot).name, reference, table.path.name, versions(), self._notes())
        write_comparison_report(report, head, found, is_interactive=not self.static)
        console.print(f"report: {report}", markup=False, soft_wrap=True)
        if self.json is not None:
            write_json(self.json, {**_content(found), "notes": self._notes()})

    def _notes(self) -> list[str]:
        """On the robot: where k comes from if its file has none."""
        return prior_notes(load_robot(self.robot), names(self.model, "--model"))


def places(out: Path) -> tuple[Path, Path]:
    """Paths of the table and of the report: in the folder ``out``, or ``out`` itself and beside it."""
    if out.is_dir() or not out.suffix:
        return out / "table.csv", out / "report.html"
    return out, out.with_suffix(".html")


def _content(found: Findings) -> dict[str, Any]:
    return {
        "metric": found.metric,
        "verdict": " ".join([headline(found), *closing(found)]),
        "means": [dataclasses.asdict(m) for m in found.means],
        "differences": [dataclasses.asdict(d) for d in found.tested],
        "damaged": found.damaged,
        "failed": [{name: row[name] for name in ("log", "model", "estimator", "corrections", "error")} for row in found.failed],
    }
