"""`skidloc online`: the estimator live, from ROS 2, ROS 1, or a log at a rate; and what the terminal shows of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NoReturn

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from localization.calibration.robot_notes import robot_notes
from localization.commands.common import print_message, print_warning
from localization.commands.online_options import CommandOptions, listening
from localization.errors import CheckpointError, OutputError
from localization.estimators import check_estimator
from localization.events import Event
from localization.evidence import open_log_with_set_up
from localization.output import fingerprint
from localization.pipeline import Pipeline
from localization.ros.diagnostics import ERROR, OK, WARN, Status
from localization.ros.early_odometry import EarlyOdometry
from localization.ros.node import Node, StopSignal
from localization.ros.session import Session, SessionState, View, made_by, shared_of
from localization.ros.settings import LiveRun, OnlineSettings
from localization.ros.transports.transport import Transport
from motion_models.registry import advice

_LINE_S = 0.25
_MAX_GAP_S = 5.0
"""Longer pauses of a log are cut to this [s]."""
_NS = 1e-9
_SLOWEST = 0.001  # a second of the log in a quarter of an hour

_SERVED_S = 86_400.0
"""How long a dashboard stays after the log has ended."""
_LEARNED = 8  # corrections that are shown; grids of them have dozens


@dataclass(frozen=True)
class OnlineCommand(CommandOptions, OnlineSettings):
    """Run the estimator live on ROS topics, or on a log as it was recorded."""

    def run(self, console: Console, early: EarlyOdometry | None = None) -> None:
        """Run the command, with output on ``console``; ``early`` has begun on live topics."""
        rate, run = parse_rate(self.rate), self.live_run()
        view = self._view(console)
        try:
            with StopSignal() as stop, run.files.claimed():
                if self.log is not None:
                    self._play(console, self.log, rate, run, stop, view)
                elif early is not None:
                    self._spin(console, run, stop, view, early.transport, early)
                else:
                    self._listen(console, run, stop, view)
        finally:
            if view is not None:
                view.close()

    def _play(self, console: Console, path: Path, rate: float, run: LiveRun, stop: StopSignal, view: View | None) -> None:
        files, log = run.files, open_log_with_set_up(path, run.robot, self.topic).log
        robot, mounts = log.robot, log.mounts
        has_lidar = log.sources.lidar is not None
        check_estimator(self.estimator, has_lidar, self.map is not None, log.no_wheels)
        trial = self.make_trial(has_lidar, robot)
        if trial.prior is not None:
            trial.prior.check_lidar(log.sources.has_clouds, bool(self.config.step.planar))
        made = made_by(trial, robot, mounts, has_lidar, self.config, f"log {fingerprint(path)[:12]}")
        pipeline = Pipeline(trial, robot, mounts, has_lidar, self.config)
        session = Session.start(files, SessionState(pipeline), f"{trial.model.name}_{trial.estimator}", made, shared_of(trial))
        is_done = False
        try:
            if view is not None:
                view.begin(robot, mounts)
                session.view = view
            if session.head:
                console.print(f"resumed from {files.state} after {session.count} events", markup=False, soft_wrap=True)
            seconds = self._play_events(console, self._rest(log.events(), session.count), session, rate, stop)
            session.finish()
            count = session.write_output()
            is_done = True
        finally:
            session.close(forget=is_done)
        for note in dict.fromkeys([*robot_notes(robot, [trial.model.name]), *log.warnings(), *session.pipeline.warnings()]):
            print_message(console, note)
        for sentence in advice(robot, [trial.model.name]):
            console.print(sentence, markup=False, soft_wrap=True)
        self._summarize(console, session, seconds, count)
        if self.dashboard and console.is_terminal:
            console.print("the dashboard stays until Ctrl-C", markup=False)
            stop.sleep(_SERVED_S)

    def _play_events(self, console: Console, events: Iterable[Event], session: Session, rate: float, stop: StopSignal) -> float:
        """Process ``events`` at ``rate``; the time of the log that was played [s]."""
        clock, began, shown, seconds, first_ns = PlaybackClock(rate, sleep=stop.sleep), time.monotonic(), -math.inf, 0.0, None
        with Live(console=console, auto_refresh=False, transient=True) as live:
            for event in events:
                clock.wait(event.stamp_ns)
                if stop.is_set():
                    self._interrupt(console, session)
                session.process(event)
                session.save_state()
                first_ns = event.stamp_ns if first_ns is None else first_ns
                seconds, now = (event.stamp_ns - first_ns) * 1e-9, time.monotonic()
                if console.is_terminal or session.view is not None:
                    session.observe(event)
                if console.is_terminal and now - shown >= _LINE_S:
                    shown, speed = now, f"  {seconds / max(now - began, 1e-9):.1f}x"
                    live.update(terminal_view(session, seconds, session.health.statuses(session.pipeline), extra=speed), refresh=True)
        return seconds

    def _rest(self, events: Iterator[Event], done: int) -> Iterator[Event]:
        """Events after the first ``done``. Raises `CheckpointError` where there are not so many."""
        found = sum(1 for _ in islice(events, done))
        if found < done:
            raise CheckpointError(f"the state in '{self.state}' is of {done} events where the log has {found}. Remove it to start anew.")
        yield from events

    def _interrupt(self, console: Console, session: Session) -> NoReturn:
        """With a state, the same command goes on from there. Without one nothing can: the output is what there is so far."""
        session.save_state(now=True)
        if self.state is not None:
            console.print(f"the state is in {self.state}: the same command goes on from there", markup=False, soft_wrap=True)
        elif (count := session.write_output()) is not None:
            console.print(f"{self.out}: {count} estimates, up to where the run was stopped", markup=False, soft_wrap=True)
        raise KeyboardInterrupt

    def _listen(self, console: Console, run: LiveRun, stop: StopSignal, view: View | None) -> None:
        with listening(self, run.node, console) as transport:
            self._spin(console, run, stop, view, transport)

    def _spin(
        self, console: Console, run: LiveRun, stop: StopSignal, view: View | None, transport: Transport, early: EarlyOdometry | None = None
    ) -> None:
        def report(text: str) -> None:
            print_warning(console, text)

        answers = ThreadPoolExecutor(1, "set-up")
        try:
            node = Node.start(transport, run, report, stop.is_set, view, answers, early)
            text = f"running {self.model} in {self.estimator} on {', '.join(node.topics)} of {transport.place}"
            console.print(text, markup=False, soft_wrap=True)
            for sentence in advice(run.robot, [self.model]):
                console.print(sentence, markup=False, soft_wrap=True)
            with Live(console=console, auto_refresh=False, transient=True) as live:
                node.spin(stop.is_set, lambda n: self._show(console, live, n))
            count = node.finish()
        finally:
            answers.shutdown(wait=False, cancel_futures=True)
        for note in node.warnings():
            print_message(console, note)
        self._summarize(console, node.session, node.seconds, count)

    def _view(self, console: Console) -> View | None:
        """Raises `TransportError` and `OutputError`. Imported only where it is wanted."""
        if self.dashboard:
            if self.view != "terminal" or self.view_file is not None:
                raise OutputError("--dashboard and rerun's view are both given. Leave one of them out.")
            from localization.ros.dashboard import Dashboard

            served = Dashboard()
            console.print(f"dashboard: {served.address}", markup=False, soft_wrap=True)
            return served
        if self.view == "terminal" and self.view_file is None:
            return None
        from localization.ros.rerun_view import RerunView

        return RerunView(self.view_file)

    def _show(self, console: Console, live: Live, node: Node) -> None:
        if console.is_terminal:
            live.update(terminal_view(node.session, node.seconds, node.statuses, node.rates()), refresh=True)

    def _summarize(self, console: Console, session: Session, seconds: float, count: int | None) -> None:
        console.print(live_line(session, seconds, []), soft_wrap=True)
        if count is not None:
            console.print(f"{self.out}: {count} estimates", markup=False, soft_wrap=True)


class PlaybackClock:
    """``rate`` times as fast as the log was recorded; infinite: without waiting. ``clock`` and ``sleep`` are in seconds."""

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        self._rate, self._clock, self._sleep = rate, clock, sleep
        self._last_ns: int | None = None
        self._due = 0.0

    def wait(self, stamp_ns: int) -> None:
        """Sleep until the event of ``stamp_ns`` is due; return at once where it is overdue."""
        if math.isinf(self._rate):
            return
        now = self._clock()
        if self._last_ns is None:
            self._due = now
        else:
            gap = min(max((stamp_ns - self._last_ns) * _NS, 0.0), _MAX_GAP_S)
            self._due += gap / self._rate
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)
        if self._due > now:
            self._sleep(self._due - now)


def parse_rate(text: str) -> float:
    """Times real time; infinite for `max`. Raises `OutputError`."""
    try:
        rate = math.inf if text == "max" else float(text)
    except ValueError:
        rate = math.nan
    if not rate >= _SLOWEST:
        raise OutputError(f"--rate is '{text}'; it must be a number from {_SLOWEST} (1 is real time), or max.")
    return rate


def live_line(session: Session, seconds: float, statuses: list[Status], extra: str = "") -> Text:
    """One line of the terminal after ``seconds`` of the robot's time."""
    e = session.health.estimate
    if e is None:
        return Text(f"{seconds:8.1f} s  no estimate yet{extra}")
    x, y, yaw = e.pose
    text = f"{seconds:8.1f} s  x {x:+8.3f}  y {y:+8.3f} m  yaw {math.degrees(math.remainder(yaw, math.tau)):+7.2f} deg"
    if e.covariance is not None:
        sigma = np.sqrt(np.diag(e.covariance))
        text += f"  +-{1e3 * math.hypot(sigma[0], sigma[1]):.0f} mm {math.degrees(sigma[2]):.2f} deg"
    text += f"  v {e.twist[0]:+5.2f} m/s  wz {e.twist[2]:+5.2f} rad/s"
    if session.health.nis is not None:
        text += f"  NIS {session.health.nis:4.1f}"
    line = Text(text + extra, no_wrap=True, overflow="ellipsis")
    for status in statuses:
        if status.level != OK:
            line.append(f"  {status.name}: {status.message}", style="yellow" if status.level == WARN else "red")
    return line


def terminal_view(
    session: Session, seconds: float, statuses: Sequence[Status], rates: Mapping[str, float] | None = None, extra: str = ""
) -> Table:
    """Rows for the estimator after ``seconds`` of the robot's time. ``rates``: messages per second by topic [Hz]."""
    view = Table.grid(padding=(0, 2))
    view.add_column(style="bold", no_wrap=True)
    view.add_column(overflow="fold")
    _row(view, "state", [session.name, f"{seconds:.1f} s", extra])
    e = session.health.estimate
    if e is None:
        _row(view, "pose", ["no estimate yet: it begins with wheels that turn or a second scan"])
    else:
        x, y, yaw = e.pose
        _row(view, "pose", [f"x {x:+.3f} m", f"y {y:+.3f} m", f"yaw {math.degrees(math.remainder(yaw, math.tau)):+.2f} deg"])
        if e.covariance is not None:
            sigma_x, sigma_y, sigma_yaw = np.sqrt(np.diag(e.covariance))
            nis = "" if session.health.nis is None else f"NIS {session.health.nis:.1f} (3 expected)"
            _row(view, "sigma", [f"{1e3 * sigma_x:.0f} mm", f"{1e3 * sigma_y:.0f} mm", f"{math.degrees(sigma_yaw):.2f} deg", nis])
        _row(view, "motion", [f"vx {e.twist[0]:+.2f} m/s", f"vy {e.twist[1]:+.2f} m/s", f"wz {e.twist[2]:+.2f} rad/s"])
    _row(view, "rates", [f"{topic} {rate:.1f} Hz" for topic, rate in (rates or {}).items()])
    learned = list(session.pipeline.estimator.parameters().items())
    more = f"and {len(learned) - _LEARNED} more" if len(learned) > _LEARNED else ""
    _row(view, "learned", [*(f"{name} {mean:.4g} +- {sigma:.2g}" for name, (mean, sigma) in learned[:_LEARNED]), more])
    for status in statuses:
        if status.level != OK:
            _row(view, status.name, [status.message], style="red" if status.level == ERROR else "yellow")
    return view


def _row(view: Table, label: str, parts: Sequence[str], style: str = "") -> None:
    """A row, unless there is nothing in it."""
    text = "  ".join(part.strip() for part in parts if part)
    if text:
        view.add_row(Text(label, style=style), Text(text, style=style))
