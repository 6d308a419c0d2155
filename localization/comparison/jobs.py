"""Jobs of a comparison: all pairs of motion model and estimator over one log, as rows of numbers; and the executors that run them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from localization.blas_threads import ONE_BLAS_THREAD
from localization.comparison.remote import AccessError, is_url, local_copy, url_fingerprint
from localization.comparison.turning import MeanCg, turning
from localization.errors import EvaluationError, LogError, OutputError, TransportError
from localization.estimators import ESTIMATORS_WITH_CORRECTIONS, check_estimator
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import ReferenceTrack, Relations, describe_instant
from localization.evaluation.scores import score
from localization.evidence import open_log_with_set_up
from localization.log_replay import Run, replay
from localization.logs import Log, TopicOverrides
from localization.output import fingerprint, output_errors, versions
from localization.pipeline import ReplayConfig, Trial
from localization.trajectory import Trajectory, write_tum
from motion_models.errors import SkidlocError
from motion_models.online_calibration import Form
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

OK, FAILED = "ok", "failed"
INPUT, ACCESS, PROCESS, DEFECT = "input", "access", "process", "defect"
"""Causes of a failure: the log or its settings, which fail alike each time; a store or a library; a process that died; skidloc."""

CONNECT_TIMEOUT_S = 10.0
"""For a Dask scheduler and its first worker to answer."""
FAULT_SEPARATOR = " | "
"""Between the sentences of a row's `faults`."""
_TRIES = 2
_POLL_S = 5.0  # after which a lost connection is noticed at the latest
_ONE_THREAD = {**ONE_BLAS_THREAD, "NUMBA_NUM_THREADS": "1"}
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucxx?)://)?(\[[^\]]+\]|[^/:\[\]\s]+):\d+")

Row = dict[str, Any]
"""One row of the table: what was run, where, `status`, `error` and its `cause`, `notes` on problems of the log, `damage` of its files,
`faults` of its sensors, how the robot turned, and the scores."""


@dataclass(frozen=True)
class TrialSpec:
    """Model, estimator and corrections to be run on a log."""

    model: str
    estimator: str
    corrections: Form

    @property
    def name(self) -> str:
        """Model, estimator and corrections, as in tables."""
        form = f" ({self.corrections})" if self.estimator in ESTIMATORS_WITH_CORRECTIONS else ""
        return f"{self.model} {self.estimator}{form}"

    @property
    def file_name(self) -> str:
        """Name of the trajectory's file, without its suffix."""
        form = f"_{self.corrections.replace('+', '_')}" if self.estimator in ESTIMATORS_WITH_CORRECTIONS else ""
        return f"{self.model}_{self.estimator}{form}"


@dataclass(frozen=True)
class LogOrigin:
    """Where and when a log was recorded."""

    floor: str = ""
    day: str = ""
    """By default the UTC date of the log's first message."""


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
    place: LogOrigin = field(default_factory=LogOrigin)
    trajectories: Path | None = None
    """New folder for the trajectories, one file MODEL_ESTIMATOR.tum for each trial; None: they are not kept."""


def job_key(log: str, robot: Robot, reference: str | None, topics: TopicOverrides, config: ReplayConfig, folder: Path | None = None) -> str:
    """Twelve digits that change with anything that the results depend on. Raises `TransportError` for a URL without a library for it."""
    settings = {
        "robot": repr(replace(robot, folder=None)),
        "reference": reference,
        "topics": asdict(topics),
        "config": asdict(config),
        "versions": versions(),
    }
    folder = folder or Path()
    file = _reference_file(PurePath(log).stem, reference, folder)
    try:
        settings["log"] = url_fingerprint(log) if is_url(log) else fingerprint(folder / log)
        settings["reference file"] = fingerprint(file) if file is not None else ""
    except (OSError, LogError, AccessError) as error:
        settings["log"] = str(error)
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def run_job(job: Job) -> list[Row]:
    """Rows of all trials. Any error of the log becomes rows with that error."""
    try:
        with local_copy(job.log, job.folder) as path:
            return _run(job, path)
    except (TransportError, OutputError) as error:
        return failed_rows(job, str(error), ACCESS)
    except SkidlocError as error:
        return failed_rows(job, str(error), INPUT)
    except Exception as error:  # one log must not end a comparison of many
        return failed_rows(job, f"{type(error).__name__}: {error}", DEFECT)


def failed_rows(job: Job, reason: str, cause: str) -> list[Row]:
    """Rows with an error instead of scores."""
    return [_failed(job, trial, reason, cause) for trial in job.trials]


def _failed(job: Job, trial: TrialSpec, reason: str, cause: str = INPUT) -> Row:
    return {**_head(job, trial), "status": FAILED, "error": " ".join(reason.split()), "cause": cause}


def _run(job: Job, path: Path) -> list[Row]:
    log = open_log_with_set_up(path, job.robot, job.topics.scored_against(job.reference)).log
    has_lidar = log.sources.lidar is not None
    rows, able = [], []
    for trial in job.trials:
        try:
            check_estimator(trial.estimator, has_lidar, no_wheels=log.no_wheels)
            able.append(trial)
        except SkidlocError as error:
            rows.append(_failed(job, trial, str(error)))
    if not able:
        return rows
    reference = _reference(log, job)
    named = [Trial(make_model(trial.model, log.robot), trial.estimator, trial.corrections) for trial in able]
    cg = MeanCg(log.robot.center_of_gravity)
    runs = replay(cg.watch(log.events()), named, log.robot, log.mounts, has_lidar, job.config)
    problems = {"notes": " ".join(log.warnings()), "damage": " ".join(log.damage())}
    date, has_time, _ = describe_instant(log.start_ns).partition("T")
    day = {"day": job.place.day or (date if has_time else "")}
    for trial, named_trial, result in zip(able, named, score(runs, reference), strict=True):
        if result.contradictions:
            rows.append(_failed(job, trial, " ".join(result.contradictions)))
            continue
        scores = flat_scores(result.metrics(log.duration_s, with_timing=False))
        faults = {"faults": FAULT_SEPARATOR.join(dict.fromkeys(result.run.warnings))}
        turned = {} if trial.estimator == "lidar" else _turning(named_trial, log.robot, cg.value, result.run)
        rows.append({**_head(job, trial), **day, "status": OK, "error": "", "cause": "", **problems, **faults, **scores, **turned})
        if job.trajectories is not None:
            _write_trajectory(job.trajectories / f"{trial.file_name}.tum", result.run.trajectory)
    return rows


def _turning(trial: Trial, robot: Robot, cg: FloatArray, run: Run) -> Row:
    found = turning(trial.model, robot, cg, run.corrections or "none", run.parameters)
    return {**found._asdict(), "cg_x_m": float(cg[0]), "cg_y_m": float(cg[1])}


def _write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, over that of an earlier run with other settings. Raises `OutputError`."""
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
    write_tum(path, trajectory)


def _head(job: Job, trial: TrialSpec) -> Row:
    form = trial.corrections if trial.estimator in ESTIMATORS_WITH_CORRECTIONS else ""
    return {
        "log": job.log,
        "robot": job.robot.name,
        "model": trial.model,
        "estimator": trial.estimator,
        "corrections": form,
        "key": job.key,
        "floor": job.place.floor,
        "day": job.place.day,
    }


def flat_scores(metrics: Mapping[str, Any]) -> Row:
    """The numbers of ``metrics`` as the columns of a row of the results."""
    left_out = ("model", "estimator", "corrections", "parameters", "counts", "lidar", "moments", "real_time_factor")
    lidar = metrics["lidar"] or dict.fromkeys(("lost_share", "longest_lost_s", "longest_lost_since_s"))
    losses = {f"lidar_{name}": lidar[name] for name in ("lost_share", "longest_lost_s", "longest_lost_since_s")}
    numbers = {name: value for name, value in metrics.items() if name not in left_out and not isinstance(value, list | dict)}
    return {**numbers, **losses}


def _reference(log: Log, job: Job) -> ReferenceTrack | Relations:
    """Raises `EvaluationError` where there is none: without, there is nothing to compare."""
    name = job.reference or log.reference_topic
    if name is None:
        raise EvaluationError(f"{log.path.name} has no reference by the robot file's name; pass --reference.")
    if is_url(name):
        url = name.replace("{stem}", log.path.stem)
        with local_copy(url, job.folder) as file:
            return load_reference(log, url, file)
    return load_reference(log, name, _reference_file(log.path.stem, job.reference, job.folder))


def _reference_file(stem: str, name: str | None, folder: Path) -> Path | None:
    """The file that the reference ``name`` of the log ``stem`` is; None where it is a topic or a URL."""
    if name is None or is_url(name) or (name.startswith("/") and not Path(name).parent.is_dir()):
        return None
    path = folder / name.replace("{stem}", stem)
    return path if path.exists() or path.suffix in (".tum", ".relations") else None


def trials(models: Sequence[str], estimators: Sequence[str], forms: Sequence[Form]) -> list[TrialSpec]:
    """All combinations; forms of corrections only where an estimator makes some, and the LiDAR alone once, as it uses no model."""
    return [
        TrialSpec(model, estimator, form)
        for estimator in estimators
        for model in (models[:1] if estimator == "lidar" else models)
        for form in forms[: None if estimator in ESTIMATORS_WITH_CORRECTIONS else 1]
    ]


Work = Callable[[Job], list[Row]]


def run_jobs(
    jobs: Sequence[Job], executor: Executor, work: Work = run_job, is_lost: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Job, list[Row]]]:
    """Each job with its rows, as it ends. Raises `CancelledError` where the executor cancels a job or ``is_lost``."""
    waiting = {executor.submit(work, job): job for job in jobs}
    while waiting:
        ended, _ = wait(waiting, _POLL_S, FIRST_COMPLETED)
        if not ended and is_lost():
            raise CancelledError("the connection was lost")
        for future in ended:
            job = waiting.pop(future)
            yield job, _rows(future, job)


def _rows(future: Future[list[Row]], job: Job) -> list[Row]:
    """Rows of a future that has ended; an error of its process or worker becomes rows with that error."""
    error = future.exception()
    return future.result() if error is None else failed_rows(job, _describe(error), PROCESS)


def _describe(error: BaseException) -> str:
    return str(error) if isinstance(error, BrokenProcessPool) else " ".join(f"{type(error).__name__}: {error}".split())[:200]


# Processes of this machine


def run_local(jobs: Sequence[Job], processes: int, work: Work = run_job) -> Iterator[tuple[Job, list[Row]]]:
    """`run_jobs` on so many processes, in which ``work`` must be importable."""
    with ProcessExecutor(processes) as executor:
        yield from run_jobs(jobs, executor, work)


class _Worker(NamedTuple):
    """A pool of one process, and that process; None where it died at its start."""

    pool: ProcessPoolExecutor
    process: BaseProcess | None

    def terminate(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.terminate()

    def end(self) -> str:
        """How the process ended, once its call has failed."""
        self.pool.shutdown()  # waits until the exit code is there
        code = None if self.process is None else self.process.exitcode
        return f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"


class ProcessExecutor(ThreadPoolExecutor):
    """A pool of processes in which one that dies loses only its own call, which is tried once more.

    In a `ProcessPoolExecutor` all calls fail where one process dies. Here each thread has such a pool of one process, and a new one after
    that has died. Used as a context manager that is left by an exception, it terminates all processes.
    """

    def __init__(self, processes: int) -> None:
        super().__init__(processes)
        self._of_thread = threading.local()
        self._workers: list[_Worker] = []
        self._lock = threading.Lock()
        self._is_terminated = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run ``fn(*args, **kwargs)`` in a process. Its future raises `BrokenProcessPool` where the process dies, twice."""
        return super().submit(self._call, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for all calls; ``cancel_futures``: drop those that wait, and terminate the processes of the others."""
        if cancel_futures:
            with self._lock:
                self._is_terminated = True
                for worker in self._workers:
                    worker.terminate()
        super().shutdown(wait, cancel_futures=cancel_futures)
        for worker in self._workers:
            worker.pool.shutdown(wait)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=kind is not None)

    def _call(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """In a thread: ``fn`` in this thread's process."""
        for _ in range(_TRIES):
            worker = getattr(self._of_thread, "worker", None) or self._start_worker()
            self._of_thread.worker = worker
            try:
                return worker.pool.submit(fn, *args, **kwargs).result()
            except BrokenProcessPool:
                self._of_thread.worker = None
                cause = worker.end()
                if self._is_terminated:
                    raise
        raise BrokenProcessPool(f"its process died, {cause}, {_TRIES} times over.")

    def _start_worker(self) -> _Worker:
        # libraries with threads do not survive a fork
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_prepare_process)
        with self._lock:
            before = {name: os.environ.get(name) for name in _ONE_THREAD}
            os.environ.update(_ONE_THREAD)  # one process, one core
            try:
                started = pool.submit(os.getpid)
            finally:
                for name, value in before.items():
                    os.environ.pop(name) if value is None else os.environ.update({name: value})
        process = None
        with contextlib.suppress(BrokenProcessPool):
            pid = started.result()
            process = next((child for child in multiprocessing.active_children() if child.pid == pid), None)
        worker = _Worker(pool, process)
        with self._lock:
            self._workers.append(worker)
            if self._is_terminated:
                worker.terminate()
        return worker


def _prepare_process() -> None:
    """Ignore Ctrl-C, which goes to all processes of a terminal, and end with the parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


# A Dask cluster. Its workers need this library, and the logs under the same paths.


def run_on_cluster(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, list[Row]]]:
    """`run_jobs` on the cluster of the scheduler at ``address``. Jobs of a lost worker run again on another. Raises `TransportError`."""
    try:
        import distributed
    except ImportError as error:
        raise TransportError(f"a Dask cluster needs the extra 'dask': pip install 'skidloc[dask]' ({error}).") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # it logs tracebacks for a lost scheduler; here it is one sentence
    if not _ADDRESS.fullmatch(address):  # distributed would retry until its timeout, then raise a traceback
        raise TransportError(f"'{address}' is not an address of a Dask scheduler; an example is tcp://host:8786.")
    try:
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise TransportError(
            f"no Dask scheduler answers at {address} ({_describe(error)}). Start `dask scheduler` there, or leave --dask out."
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            try:
                client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
            except TimeoutError as error:
                raise TransportError(f"the Dask scheduler at {address} has no workers. Start some: dask worker {address}.") from error
        yield from run_jobs(jobs, client.get_executor(pure=False, retries=1), is_lost=lambda: client.status != "running")
    except (OSError, distributed.client.ClosedClientError, CancelledError) as error:
        raise TransportError(
            f"the Dask scheduler at {address} went away ({_describe(error)}). What was done is kept: run the same again."
        ) from error
    finally:
        client.close(timeout=CONNECT_TIMEOUT_S)
