"""A pipeline at work: events in, estimates recorded, its health watched, its state on disk at most a second old."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from localization.errors import DumpError, OutputError
from localization.estimate_table import trajectory
from localization.estimators import Estimate
from localization.events import Event
from localization.logs.fused_log import MAP_FRAME, PARENT_FRAME, write_fused
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.checkpoint import Dumper, fingerprints, read_dump, remove_dump
from localization.ros.diagnostics import Health
from localization.ros.estimate_log import Spool, fused_estimates
from localization.ros.session_files import Files
from localization.trajectory import write_tum
from motion_models.robot import Mount, Robot

_MEANWHILE = {"state": "The state of before stays", "output": "The output lacks what is estimated meanwhile"}


class View(Protocol):
    """Shows a session while it runs. It is asked after estimates are out, so that none waits for it."""

    def begin(self, robot: Robot, mounts: Mapping[str, Mount]) -> None: ...

    def show(self, event: Event | None, estimates: Sequence[Estimate], pipeline: Pipeline) -> None: ...

    def close(self) -> None: ...


def made_by(pair: Trial, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: ReplayConfig, source: str) -> dict[str, str]:
    """What must be the same where a state is resumed."""
    return fingerprints(
        robot=robot,
        model=pair.model,
        estimator=pair.estimator,
        corrections=pair.corrections,
        configuration=config,
        mounts=dict(mounts),
        LiDAR="used" if has_lidar else "not used",
        source=source,
    )


class Session:
    """Made by `start`."""

    def __init__(
        self,
        pipeline: Pipeline,
        kept: Any,
        name: str,
        files: Files,
        spool: Spool | None,
        dumper: Dumper | None,
        head: Mapping[str, Any],
        tell: Callable[[str], None] | None,
    ) -> None:
        self.pipeline, self.name, self.health = pipeline, name, Health()
        self.kept = kept
        """What is dumped with the core; of a resumed session, what had been."""
        self.head = head
        """Of the state that was resumed; empty for a new one."""
        self._files, self._spool, self._dumper, self._tell = files, spool, dumper, tell
        self.troubles: dict[str, str] = {}
        """What cannot be written at present, and why."""
        self._told: set[str] = set()
        self._is_counted_on = head.get("records") is not None
        """The spool, by a state."""
        self.count = int(head.get("events", 0))
        """Events so far, those before the state included."""
        self.view: View | None = None
        self._unseen: list[Estimate] = []

    @classmethod
    def start(
        cls,
        files: Files,
        pipeline: Pipeline,
        name: str,
        made: Mapping[str, str],
        kept: Any = None,
        shared: Mapping[str, Any] | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> Session:
        """A new session with ``core``, or one that goes on from the state on disk, if there is one that was ``made`` by the same.

        ``kept`` is dumped with the core; ``shared`` is what it holds that is not to be dumped. ``tell`` is of a live session: it hears
        what cannot be written, once, where others raise it, for the robot must still know where it is; and its output may hold the
        estimates from the state on, others' hold them from the very first. Raises `DumpError` and `OutputError`.
        """
        shared = shared or {}
        dumper = None if files.state is None else Dumper(files.state, made, shared)
        if files.state is None or not files.state.exists():
            return cls(pipeline, kept, name, files, None if files.spool is None else Spool.create(files.spool), dumper, {}, tell)
        found = read_dump(files.state, made, shared)
        records = found.head.get("records")
        if (records is not None and files.spool is None) or (records is None and files.spool is not None and tell is None):
            with_or_without = "without an --out" if records is None else "with an --out"
            raise DumpError(f"the state in '{files.state}' is of a run {with_or_without}: resume it so, or remove it to start anew.")
        if not (isinstance(found.value, list) and len(found.value) == 2 and isinstance(found.value[0], Pipeline)):
            raise DumpError(f"the state in '{files.state}' holds no estimator. Remove it to start anew.")
        spool = None
        if files.spool is not None:
            spool = Spool.create(files.spool) if records is None else Spool.resume(files.spool, int(records))
        pipeline, kept = found.value
        return cls(pipeline, kept, name, files, spool, dumper, found.head, tell)

    def push(self, event: Event, out: Callable[[Estimate], None] = lambda estimate: None) -> list[Estimate]:
        """``out`` is given each estimate before anything else is done with it. Raises `EstimatorError`."""
        self.count += 1
        estimates = self.pipeline.process(event)
        for estimate in estimates:
            out(estimate)
        return self._take(estimates)

    def saw(self, event: Event) -> None:
        """After `push`, for whoever watches: its health, and a view."""
        self.health.saw(event)
        self._show(event)

    def _show(self, event: Event | None) -> None:
        if self.view is not None:
            self.view.show(event, self._unseen, self.pipeline)
            self._unseen.clear()

    def finish(self) -> list[Estimate]:
        """No more events will come. Raises `EstimatorError`."""
        estimates = self._take(self.pipeline.finish())
        self._show(None)
        return estimates

    def _take(self, estimates: list[Estimate]) -> list[Estimate]:
        for estimate in estimates:
            self.health.made(estimate, self.pipeline)
            if self.view is not None:
                self._unseen.append(estimate)
            if self._spool is not None:
                with self._on_disk("output"):
                    self._spool.add(estimate)
        return estimates

    @contextmanager
    def _on_disk(self, what: str) -> Iterator[None]:
        """What is told, not raised, of a live session."""
        try:
            yield
            self.troubles.pop(what, None)
        except (DumpError, OutputError) as error:
            if self._tell is None:
                raise
            self.troubles[what] = str(error)
            if what not in self._told:
                self._told.add(what)
                self._tell(f"{error} {_MEANWHILE[what]}; it is tried again.")

    def dump(self, extra: Callable[[], Mapping[str, Any]] = dict, now: bool = False) -> None:
        """The state to disk, if it is due or wanted ``now``; then it is there on return. What ``extra`` tells enters its head.

        Raises `DumpError` unless live.
        """
        if self._dumper is None or not (now or self._dumper.is_due()):
            return
        on_disk = () if self._spool is None else (self._spool.descriptor,)
        records = None if self._spool is None else self._spool.count
        with self._on_disk("state"):
            self._dumper.write([self.pipeline, self.kept], {**extra(), "events": self.count, "records": records}, on_disk)
            self._is_counted_on = True
            if now:
                self._dumper.wait()

    def write_out(self) -> int | None:
        """The output, if one is wanted; returns how many estimates it holds. Raises `OutputError` where there are none."""
        if self._spool is None or self._files.out is None:
            return None
        stamps, table = self._spool.rows()
        if len(stamps) and self._files.out.suffix == ".tum":
            write_tum(self._files.out, trajectory(stamps, table))
        elif len(stamps):
            parent = MAP_FRAME if self.pipeline.is_localizing else PARENT_FRAME
            with self._files.beside() as bag:
                write_fused(bag, {self.name: fused_estimates(stamps, table, parent)}, self.name)
        if self._tell is not None and self._spool.missing:
            self._tell(f"'{self._files.out}' lacks {self._spool.missing} estimates, for which there was no room on the disk.")
        if self._dumper is not None:
            with self._on_disk("state"):
                self._dumper.wait()  # it may count on the rows being there
        self._spool.remove()
        self._spool = None
        if not len(stamps):
            raise OutputError(f"output '{self._files.out}': there is nothing to write, no motion could be told from what was heard.")
        return len(stamps)

    def close(self, forget: bool = False) -> None:
        """End; ``forget`` removes the state, for there is nothing to go on with. Estimates that no state counts on are removed where they
        can be had again, or are none: they would be in the way of the next run. Raises `DumpError` unless live.
        """
        try:
            if self._dumper is not None:
                with self._on_disk("state"):
                    self._dumper.close()
                if forget:
                    remove_dump(self._dumper.path)
        finally:
            if self._spool is not None:
                is_counted_on = self._is_counted_on and self._dumper is not None and self._dumper.path.exists()
                is_needed = is_counted_on or (self._tell is not None and self._spool.count)
                (self._spool.close if is_needed else self._spool.remove)()
