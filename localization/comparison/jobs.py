"""One log of a comparison: all pairs of motion model and estimator over it, each scored, as rows of numbers. Runs in any process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from localization.errors import EvaluationError
from localization.estimators import CORRECTING, check_estimator
from localization.evaluation.references import ReferenceTrack, Relations, read_reference_file, reference_track
from localization.evaluation.scores import score
from localization.logs import Log, TopicOverrides, open_log
from localization.output import fingerprint, versions
from localization.pipeline import ReplayConfig, Trial, replay
from motion_models.errors import SkidlocError
from motion_models.online_calibration import Form
from motion_models.registry import make_model
from motion_models.robot import Robot

OK, FAILED = "ok", "failed"

Row = dict[str, Any]
"""One row of the table: what was run, `status`, `error`, `notes` on problems of the log, `damage` of its files, and the scores."""


@dataclass(frozen=True)
class TrialSpec:
    """Model, estimator and corrections to be run on a log."""

    model: str
    estimator: str
    corrections: Form

    @property
    def name(self) -> str:
        """Model, estimator and corrections, as in tables."""
        form = f" ({self.corrections})" if self.estimator in CORRECTING else ""
        return f"{self.model} {self.estimator}{form}"


@dataclass(frozen=True)
class Job:
    """A log and the trials to be run on it."""

    log: str
    robot: Robot
    trials: tuple[TrialSpec, ...]
    key: str
    """What the results depend on besides the trial: log, robot, reference, configuration, versions."""
    reference: str | None = None
    """Topic, or a file in which `{stem}` stands for the log's name; the robot file's topic if None."""
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)
    folder: Path = field(default_factory=Path.cwd)
    """Where relative paths start; a worker of a cluster runs in another one."""


def job_key(log: Path, robot: Robot, reference: str | None, topics: TopicOverrides, config: ReplayConfig) -> str:
    """Twelve digits that change with anything that the results depend on."""
    settings = {
        "robot": repr(replace(robot, folder=None)),
        "reference": reference,
        "topics": asdict(topics),
        "config": asdict(config),
        "versions": versions(),
    }
    file = _reference_file(log, reference)
    try:
        settings["log"] = fingerprint(log)
        settings["reference file"] = fingerprint(file) if file is not None else ""
    except OSError as error:
        settings["log"] = str(error)
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def run_job(job: Job) -> list[Row]:
    """Rows of all trials. Any error of the log becomes rows with that error."""
    try:
        return _run(job)
    except SkidlocError as error:
        return failed_rows(job, str(error))
    except Exception as error:  # one log must not end a comparison of many
        return failed_rows(job, f"{type(error).__name__}: {error}")


def failed_rows(job: Job, reason: str) -> list[Row]:
    """Rows with an error instead of scores."""
    return [{**_head(job, trial), "status": FAILED, "error": " ".join(reason.split())} for trial in job.trials]


def _run(job: Job) -> list[Row]:
    log = open_log(job.folder / job.log, job.robot, job.topics)
    has_lidar = log.sources.lidar is not None
    rows, able = [], []
    for trial in job.trials:
        try:
            check_estimator(trial.estimator, has_lidar)
            able.append(trial)
        except SkidlocError as error:
            rows.append({**_head(job, trial), "status": FAILED, "error": str(error)})
    if not able:
        return rows
    reference = _reference(log, job)
    named = [Trial(make_model(trial.model, job.robot), trial.estimator, trial.corrections) for trial in able]
    runs = replay(log.events(), named, job.robot, log.mounts, has_lidar, job.config)
    problems = {"notes": " ".join(log.warnings()), "damage": " ".join(log.damage())}
    for trial, result in zip(able, score(runs, reference), strict=True):
        scores = _scores(result.metrics(log.duration_s, with_timing=False))
        rows.append({**_head(job, trial), "status": OK, "error": "", **problems, **scores})
    return rows


def _head(job: Job, trial: TrialSpec) -> Row:
    form = trial.corrections if trial.estimator in CORRECTING else ""
    return {
        "log": job.log,
        "robot": job.robot.name,
        "model": trial.model,
        "estimator": trial.estimator,
        "corrections": form,
        "key": job.key,
    }


def _scores(metrics: Mapping[str, Any]) -> Row:
    left_out = ("model", "estimator", "corrections", "parameters", "counts", "lidar", "moments", "real_time_factor")
    lidar = metrics["lidar"] or dict.fromkeys(("lost_share", "longest_lost_s", "longest_lost_since_s"))
    losses = {f"lidar_{name}": lidar[name] for name in ("lost_share", "longest_lost_s", "longest_lost_since_s")}
    return {**{name: value for name, value in metrics.items() if name not in left_out}, **losses}


def _reference(log: Log, job: Job) -> ReferenceTrack | Relations:
    """Raises `EvaluationError` where there is none: without, there is nothing to compare."""
    file = _reference_file(log.path, job.reference, job.folder)
    if file is not None:
        return read_reference_file(file)
    topic = job.reference or log.reference_topic
    if topic is None:
        raise EvaluationError(f"{log.path.name} has no reference by the robot file's name; pass --reference.")
    return reference_track(log.references(topic), topic)


def _reference_file(log: Path, name: str | None, folder: Path = Path()) -> Path | None:
    if name is None or (name.startswith("/") and not Path(name).parent.is_dir()):
        return None
    path = folder / name.replace("{stem}", log.stem)
    return path if path.exists() or path.suffix in (".tum", ".relations") else None


def trials(models: Sequence[str], estimators: Sequence[str], forms: Sequence[Form]) -> list[TrialSpec]:
    """All combinations; forms of corrections only where an estimator makes some, and the LiDAR alone once, as it uses no model."""
    return [
        TrialSpec(model, estimator, form)
        for estimator in estimators
        for model in (models[:1] if estimator == "lidar" else models)
        for form in forms[: None if estimator in CORRECTING else 1]
    ]
