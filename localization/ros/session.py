"""A pipeline at work: events in, estimates recorded, its health monitored, its state on disk at most a second old; and its files."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TextIO

from localization.errors import CheckpointError, OutputError
from localization.estimate import Estimate
from localization.estimate_table import trajectory
from localization.events import Event
from localization.logs.fused_messages import MAP_FRAME, PARENT_FRAME
from localization.logs.writer import write_fused
from localization.output import output_errors, refuse_existing
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.checkpoint import Checkpoint, CheckpointWriter, fingerprints, read_checkpoint, remove_checkpoint
from localization.ros.continuous_odometry import ContinuousOdometry
from localization.ros.diagnostics import Health
from localization.ros.estimate_log import EstimateLog, fused_estimates
from localization.ros.payloads import Load
from localization.ros.start_pose import StartPose
from localization.trajectory import write_tum
from motion_models.robot import Mount, Robot

_CONSEQUENCES = {"state": "The state of before stays", "output": "Estimates made meanwhile are missing from the output"}

_SUFFIXES = (".mcap", ".tum")


class View(Protocol):
    """Shows a session while it runs. It is called after estimates are published, so that none waits for it."""

    def begin(self, robot: Robot, mounts: Mapping[str, Mount]) -> None:
        """Show what stays as it is. Called once, before the first event."""

    def show(self, event: Event | None, estimates: Sequence[Estimate], pipeline: Pipeline) -> None:
        """``event`` has gone in (None: no more will come), ``estimates`` have come out."""

    def close(self) -> None:
        """No more will come."""


def shared_of(trial: Trial) -> dict[str, Any]:
    """Objects of ``trial`` that a checkpoint does not hold: a saved map, which whoever resumes it reads again."""
    return {} if trial.prior is None else {"map": trial.prior.places}


def made_by(trial: Trial, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: ReplayConfig, source: str) -> dict[str, str]:
    """Fingerprints of what must be the same where a state is resumed."""
    return fingerprints(
        robot=robot,
        model=trial.model,
        estimator=trial.estimator,
        corrections=trial.corrections,
        map="none" if trial.prior is None else trial.prior.places.fingerprint,
        configuration=config,
        mounts=dict(mounts),
        LiDAR="used" if has_lidar else "not used",
        source=source,
    )


@dataclass(frozen=True)
class LiveRobot:
    """A robot as its live sensors show it, where they contradict its file."""

    robot: Robot
    uses_gyro: bool
    """False where the signs of wheels and gyro contradict each other, and nothing decides."""


@dataclass
class SessionState:
    """What a checkpoint holds."""

    pipeline: Pipeline
    start: StartPose = field(default_factory=StartPose)
    angles: Any = None
    """`WheelAngles` of a live session."""
    loads: dict[str, Load] = field(default_factory=dict)
    """Payloads by frame, of a live session."""
    odometry: ContinuousOdometry = field(default_factory=ContinuousOdometry)
    """What a live session has published last in `odom`."""
    wiring: LiveRobot | None = None
    """How the messages of a live session are read, where that is not the robot file's."""


class Session:
    """Made by `start`."""

    def __init__(
        self,
        state: SessionState,
        name: str,
        files: Files,
        estimate_log: EstimateLog | None,
        checkpoints: CheckpointWriter | None,
        head: Mapping[str, Any],
        report: Callable[[str], None] | None,
    ) -> None:
        self.state, self.name, self.health = state, name, Health()
        self.head = head
        """Head of the checkpoint that was resumed; empty for a new session."""
        self._files, self._estimate_log, self._report = files, estimate_log, report
        self.checkpoints = checkpoints
        """The writer of the state on disk; None without one."""
        self.troubles: dict[str, str] = {}
        """What cannot be written at present, and why."""
        self._reported: set[str] = set()
        self._is_log_referenced = head.get("records") is not None  # by a checkpoint
        self.count = int(head.get("events", 0))
        """Events so far, those before the checkpoint included."""
        self.start_error_m = 0.0
        """Standard deviation of the position that published estimates have besides their own [m], while sensors contradict each other."""
        self.view: View | None = None
        self._not_shown: list[Estimate] = []

    @classmethod
    def start(
        cls,
        files: Files,
        state: SessionState,
        name: str,
        made: Mapping[str, str],
        shared: Mapping[str, Any] | None = None,
        report: Callable[[str], None] | None = None,
    ) -> Session:
        """A new session from ``state``, or the one of the checkpoint on disk, if there is one that was ``made`` by the same.

        ``shared``: objects in the state that are not to be written. ``report`` is of a live session: what cannot be written or read is
        reported once, where other sessions raise it, for the robot must still be localized; and its output may begin at the checkpoint.
        Raises `CheckpointError` and `OutputError`.
        """
        shared = shared or {}
        checkpoints = None if files.state is None else CheckpointWriter(files.state, made, shared)
        if files.state is None or not files.state.exists():
            log = None if files.estimate_log is None else EstimateLog.create(files.estimate_log)
            return cls(state, name, files, log, checkpoints, {}, report)
        found = read_checkpoint(files.state, made, shared)
        if not isinstance(found.value, SessionState) or not isinstance(found.value.pipeline, Pipeline):
            raise CheckpointError(f"the state in '{files.state}' holds no estimator. Remove it to start anew.")
        log, head = _resume_log(files, found, report)
        return cls(found.value, name, files, log, checkpoints, head, report)

    @property
    def pipeline(self) -> Pipeline:
        """The one that runs; `restart` replaces it."""
        return self.state.pipeline

    def restart(self, pipeline: Pipeline, start: StartPose) -> None:
        """Continue with a new ``pipeline`` that begins at ``start``."""
        self.state.pipeline, self.state.start = pipeline, start
        self.health.reset()

    def change_map(self, trial: Trial) -> None:
        """The saved map of ``trial`` is the one that checkpoints are of from now on."""
        if self.checkpoints is not None and trial.prior is not None:
            self.checkpoints.change_identity(fingerprints(map=trial.prior.places.fingerprint), shared_of(trial))

    def change_lidar(self) -> None:
        """Checkpoints are of a robot whose LiDAR is used from now on."""
        if self.checkpoints is not None:
            self.checkpoints.change_identity(fingerprints(LiDAR="used"), {})

    def change_mounts(self, mounts: Mapping[str, Mount]) -> None:
        """Checkpoints are of a robot with ``mounts`` from now on."""
        if self.checkpoints is not None:
            self.checkpoints.change_identity(fingerprints(mounts=mounts), {})

    def process(self, event: Event, publish: Callable[[Estimate], None] = lambda estimate: None) -> list[Estimate]:
        """``publish`` is called with each estimate before anything else is done with it. Raises `EstimatorError`."""
        self.count += 1
        found = self.pipeline.process(event)
        if not found:  # of most events
            return found
        start = self.state.start.widened(self.start_error_m)
        estimates = [start.apply(estimate) for estimate in found]
        for estimate in estimates:
            publish(estimate)
        self._record(estimates)
        return estimates

    def observe(self, event: Event) -> None:
        """After `process`, for diagnostics and a view."""
        self.health.observe_event(event)
        self._show(event)

    def _show(self, event: Event | None) -> None:
        if self.view is not None:
            self.view.show(event, self._not_shown, self.pipeline)
            self._not_shown.clear()

    def finish(self) -> list[Estimate]:
        """No more events will come. Raises `EstimatorError`."""
        estimates = [self.state.start.apply(estimate) for estimate in self.pipeline.finish()]
        self._record(estimates)
        self._show(None)
        return estimates

    def _record(self, estimates: list[Estimate]) -> None:
        for estimate in estimates:
            self.health.add_estimate(estimate, self.pipeline)
            if self.view is not None:
                self._not_shown.append(estimate)
            if self._estimate_log is not None:
                with self._writing("output"):
                    self._estimate_log.add(estimate)

    @contextmanager
    def _writing(self, what: str) -> Iterator[None]:
        """Report what fails of a live session, instead of raising it."""
        try:
            yield
            self.troubles.pop(what, None)
        except (CheckpointError, OutputError) as error:
            if self._report is None:
                raise
            self.troubles[what] = str(error)
            if what not in self._reported:
                self._reported.add(what)
                self._report(f"{error} {_CONSEQUENCES[what]}; it is tried again.")

    def save_state(self, extra: Callable[[], Mapping[str, Any]] = dict, now: bool = False) -> None:
        """Write a checkpoint, if one is due or wanted ``now``; then it is on disk on return. ``extra`` gives entries of its head.

        Raises `CheckpointError` unless live.
        """
        if self.checkpoints is None or not (now or self.checkpoints.is_due()):
            return
        on_disk = () if self._estimate_log is None else (self._estimate_log.descriptor,)
        records = None if self._estimate_log is None else self._estimate_log.count
        with self._writing("state"):
            self.checkpoints.write(self.state, {**extra(), "events": self.count, "records": records}, on_disk)
            self._is_log_referenced = True
            if now:
                self.checkpoints.wait()

    def write_output(self) -> int | None:
        """The output, if one is wanted; returns how many estimates it holds. Raises `OutputError` where there are none."""
        if self._estimate_log is None or self._files.out is None:
            return None
        stamps, table = self._estimate_log.rows()
        if len(stamps) and self._files.out.suffix == ".tum":
            write_tum(self._files.out, trajectory(stamps, table))
        elif len(stamps):
            parent = MAP_FRAME if self.pipeline.is_localizing else PARENT_FRAME
            with self._files.beside() as bag:
                write_fused(bag, {self.name: fused_estimates(stamps, table, parent)}, self.name)
        if self._report is not None and self._estimate_log.missing:
            self._report(f"'{self._files.out}': {self._estimate_log.missing} estimates are missing, for there was no room on the disk.")
        if self.checkpoints is not None:
            with self._writing("state"):
                self.checkpoints.wait()  # it may refer to the rows
        self._estimate_log.remove()
        self._estimate_log = None
        if not len(stamps):
            raise OutputError(f"output '{self._files.out}': there is nothing to write, the messages gave no motion.")
        return len(stamps)

    def close(self, forget: bool = False) -> None:
        """End; ``forget`` removes the state, where there is nothing to continue.

        Estimates that no checkpoint refers to are removed where a run can make them again, or where there are none. Raises
        `CheckpointError` unless live.
        """
        try:
            if self.checkpoints is not None:
                with self._writing("state"):
                    self.checkpoints.close()
                if forget:
                    remove_checkpoint(self.checkpoints.path)
        finally:
            if self._estimate_log is not None:
                is_referenced = self._is_log_referenced and self.checkpoints is not None and self.checkpoints.path.exists()
                is_needed = is_referenced or (self._report is not None and self._estimate_log.count)
                (self._estimate_log.close if is_needed else self._estimate_log.remove)()


@dataclass(frozen=True)
class Files:
    """What a session writes. Raises `OutputError` for an output of unknown kind, a state that is a folder, and two that are one file."""

    out: Path | None = None
    """Trajectory, .mcap or .tum, written at the end."""
    state: Path | None = None
    """Resumed at the start if it is there."""

    def __post_init__(self) -> None:
        if self.out is not None and self.out.suffix not in _SUFFIXES:
            raise OutputError(f"output '{self.out}': its name must end in {' or '.join(_SUFFIXES)}.")
        if self.state is not None and self.state.is_dir():
            raise OutputError(f"the state '{self.state}' is a folder. Name a file in it.")
        if self.out is not None and self.estimate_log is not None and self.state is not None:
            for taken, what in ((self.out, "the output"), (self.estimate_log, "where the output grows")):
                if self.state.resolve() == taken.resolve():
                    raise OutputError(f"the state '{self.state}' is {what} as well. Give the state a name of its own.")

    @property
    def estimate_log(self) -> Path | None:
        """Where the estimates are until the end."""
        return None if self.out is None else self.out.with_name(f".{self.out.name}.part")

    @contextlib.contextmanager
    def beside(self) -> Iterator[Path]:
        """Where to write what becomes the output at the end, under its name, for a bag holds that. What a process that was killed has left
        there is removed. Raises `OutputError`."""
        assert self.out is not None
        folder = self.out.with_name(f".{self.out.name}.new")
        with output_errors(self.out):
            if folder.is_symlink() or folder.is_file():
                folder.unlink()
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        try:
            yield folder / self.out.name
            refuse_existing(self.out)
            with output_errors(self.out):
                (folder / self.out.name).replace(self.out)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Inside, they are this process's alone. Raises `OutputError` where they cannot be written, for an output that exists, and where
        another process has them."""
        if self.out is not None:
            refuse_existing(self.out)
        with contextlib.ExitStack() as stack:
            for path in (self.out, self.state):
                if path is not None:
                    lock = path.with_name(f".{path.name}.lock")
                    stack.enter_context(_locked(path, lock))
                    stack.callback(lock.unlink, missing_ok=True)  # while it is locked
            yield


def _resume_log(files: Files, found: Checkpoint, report: Callable[[str], None] | None) -> tuple[EstimateLog | None, Mapping[str, Any]]:
    """The estimates up to the checkpoint ``found``, and its head. Raises `CheckpointError` and `OutputError`.

    A live session whose estimates were lost, as by a power cut, continues without them.
    """
    records = found.head.get("records")
    if (records is not None and files.estimate_log is None) or (records is None and files.estimate_log is not None and report is None):
        with_or_without = "without an --out" if records is None else "with an --out"
        raise CheckpointError(f"the state in '{files.state}' is of a run {with_or_without}: resume it so, or remove it to start anew.")
    if files.estimate_log is None:
        return None, found.head
    if records is None:
        return EstimateLog.create(files.estimate_log), found.head
    try:
        return EstimateLog.resume(files.estimate_log, int(records)), found.head
    except CheckpointError as error:
        if report is None:
            raise
        report(f"{error} This run continues from the state; its output begins here.")
        return EstimateLog.create(files.estimate_log), {**found.head, "records": None}


def _locked(path: Path, lock: Path) -> TextIO:
    """The file ``lock``, which is another than ``path``, for a state is replaced again and again. The lock ends with the process, however
    that ends."""
    while True:
        try:
            file = os.fdopen(os.open(lock, os.O_CREAT | os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644), "a")
        except OSError as error:
            raise OutputError(f"'{path}' cannot be written: {error.strerror}. Name a file in a folder that is there and yours.") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise OutputError(f"'{path}' is in use by another process that runs. Stop that, or name another file.") from error
        except OSError:
            return file  # a file system without locks is no reason not to work
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                return file
        file.close()  # whoever had it removed it meanwhile
