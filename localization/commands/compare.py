"""`skidloc compare`: motion models and estimators over many logs, on all cores or on a cluster."""

from __future__ import annotations

import dataclasses
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

from localization.commands.common import check_new, write_json
from localization.compare_job import OK, Job, Row, job_key, trials
from localization.compare_pool import run_local
from localization.compare_stats import Difference, Mean, differences, means
from localization.compare_table import Table
from localization.errors import EvaluationError, LogError
from localization.estimators import check_estimator
from localization.logs import TopicOverrides
from localization.run import ReplayConfig
from motion_models.corrections import check_forms
from motion_models.registry import make_model
from motion_models.robot import load_robot

_CERTAIN = 0.05


@dataclass(frozen=True)
class Compare:
    """Run motion models and estimators over many logs, and tell which is better and how sure that is."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs with a reference each: ROS 1 .bag, ROS 2 bag folders, bare .mcap."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    out: Path
    """Table, .csv or .parquet, one row per log and combination. What is in it already, and unchanged, is not computed again."""
    model: str = "diff_drive,skid_steer"
    """Motion models, separated by commas."""
    estimator: str = "odometry,ekf"
    """Estimators, separated by commas."""
    corrections: str = "constant"
    """What ekf and graph learn of the motion model: none, constant, cg_field; forms separated by commas."""
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

    def run(self, console: Console) -> None:
        if self.json is not None:
            check_new(self.json)
        jobs, table = self._jobs(), Table(self.out)
        left = [dataclasses.replace(job, trials=missing) for job in jobs if (missing := table.missing(job))]
        done = sum(len(job.trials) for job in jobs) - sum(len(job.trials) for job in left)
        if done:
            console.print(f"{done} results are in {self.out} already", markup=False, soft_wrap=True)
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
        self._report(console, jobs, table.rows(jobs))

    def _jobs(self) -> list[Job]:
        robot, forms = load_robot(self.robot), check_forms(_names(self.corrections))
        models, estimators = _names(self.model), _names(self.estimator)
        for model in models:
            make_model(model, robot)
        for estimator in estimators:
            check_estimator(estimator, has_lidar=True)
        wanted = tuple(trials(models, estimators, forms))
        logs = list(dict.fromkeys(self.logs))
        if not logs:
            raise LogError("no logs to compare on; name some.")
        return [
            Job(
                str(path),
                robot,
                wanted,
                job_key(path, robot, self.reference, self.topic, self.config),
                self.reference,
                self.topic,
                self.config,
            )
            for path in logs
        ]

    def _run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, list[Row]]]:
        if self.dask is not None:
            from localization.compare_dask import run_on_cluster

            return run_on_cluster(jobs, self.dask)
        return run_local(jobs, self.processes or os.cpu_count() or 1)

    def _report(self, console: Console, jobs: Sequence[Job], rows: Sequence[Row]) -> None:
        failed = [row for row in rows if row["status"] != OK]
        if len(failed) == len(rows):
            raise LogError(f"none of {len(jobs)} logs could be compared; the reasons are in {self.out}.")
        found = means(rows, self.metric)
        if not found:
            known = ", ".join(sorted({name for row in rows for name, value in row.items() if isinstance(value, float)}))
            raise EvaluationError(f"no result has a number '{self.metric}'; there are {known}.")
        tested = differences(rows, self.metric)
        grid = Grid("", "logs", f"mean {self.metric}", "95 %", box=None, header_style="bold", pad_edge=False)
        for m in sorted(found, key=lambda m: m.mean):
            grid.add_row(m.name, str(m.n), f"{m.mean:.4g}", f"{m.low:.4g} to {m.high:.4g}" if m.n > 1 else "")
        console.print(grid)
        for sentence in sentences(found, tested, self.metric):
            console.print(sentence, markup=False, soft_wrap=True)
        if failed:
            logs = len({row["log"] for row in failed})
            console.print(f"{len(failed)} results of {logs} logs failed; the reasons are in {self.out}.", markup=False, soft_wrap=True)
        if self.json is not None:
            write_json(self.json, self._content(found, tested, failed))

    def _content(self, found: Sequence[Mean], tested: Sequence[Difference], failed: Sequence[Row]) -> dict[str, Any]:
        return {
            "metric": self.metric,
            "means": [dataclasses.asdict(m) for m in found],
            "differences": [dataclasses.asdict(d) for d in tested],
            "failed": [{name: row[name] for name in ("log", "model", "estimator", "corrections", "error")} for row in failed],
        }


def sentences(found: Sequence[Mean], tested: Sequence[Difference], metric: str) -> list[str]:
    """What can be said of the best, and what not."""
    best = min(found, key=lambda m: m.mean).name
    said = []
    for d in (d for d in tested if best in (d.better, d.worse)):
        other = d.worse if d.better == best else d.better
        gap = f"{d.mean:.3g} ({d.low:.3g} to {d.high:.3g}) over {d.n} logs, p = {d.p_value:.2g}"
        if d.better == best and d.p_value < _CERTAIN:
            said.append(f"{best} is better than {other}: {metric} smaller by {gap}.")
        else:
            few = f" {d.n} logs cannot show it: p is at least {2.0 ** (1 - d.n):.2g}." if 2.0 ** (1 - d.n) > _CERTAIN else ""
            said.append(f"{best} and {other} are not told apart: {gap}.{few}")
    return said


def _names(text: str) -> list[str]:
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
