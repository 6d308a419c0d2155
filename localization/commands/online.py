"""`skidloc online`: the estimator live, from ROS 2, ROS 1, or a log at a rate."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, NoReturn

import tyro
from rich.console import Console
from rich.live import Live
from rich.markup import escape

from localization.commands.online_line import live_line
from localization.commands.online_terminal import terminal_view
from localization.errors import DumpError, OutputError
from localization.events import Event
from localization.logs import open_log
from localization.pipeline import Pipeline
from localization.provenance import fingerprint
from localization.ros.node import Node
from localization.ros.playback_clock import Pace
from localization.ros.session import Session, View, made_by
from localization.ros.session_files import Files
from localization.ros.settings import OnlineSettings
from localization.ros.signals import Stop
from localization.ros.transports.base import Transport
from motion_models.robot import Robot, load_robot

_LINE_S = 0.25
_SLOWEST = 0.001  # a second of the log in a quarter of an hour


@dataclass(frozen=True)
class Online(OnlineSettings):
    """Run the estimator live on ROS topics, or on a log as it was recorded."""

    log: tyro.conf.Positional[Path | None] = None
    """A log to run from, instead of live topics."""
    rate: str = "1"
    """Of the log: times as fast as it was recorded, or `max`."""
    view: Literal["terminal", "rerun"] = "terminal"
    """Live picture: in the terminal, or in rerun's viewer as well (extra `viz`)."""
    view_file: Path | None = None
    """New .rrd file to record rerun's picture to, instead of opening its viewer."""
    door: Literal["auto", "dds", "rclpy", "rospy"] = "auto"
    """Of live topics: ROS 2 by DDS itself (extra `ros2`), ROS 2 by rclpy, ROS 1 by rospy. `auto`: rclpy where it is sourced, else DDS."""
    domain: int | None = None
    """ROS 2 domain (door dds); by default that of ROS_DOMAIN_ID, or 0."""
    interface: str | None = None
    """Network interface or address (door dds). `localhost`: this machine only, packets of others are dropped; `default`: what
    ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE demand, else all of the subnet. Without the option, what these variables demand,
    else `localhost`."""

    def run(self, console: Console) -> None:
        rate, files, robot = parse_rate(self.rate), self.files(), load_robot(self.robot)
        view = self._view()
        try:
            with Stop() as stop, files.claimed():
                if self.log is not None:
                    self._play(console, self.log, rate, files, robot, stop, view)
                else:
                    self._spin(console, files, robot, stop, view)
        finally:
            if view is not None:
                view.close()

    def _play(self, console: Console, path: Path, rate: float, files: Files, robot: Robot, stop: Stop, view: View | None) -> None:
        log = open_log(path, robot, self.topic)
        has_lidar = log.sources.lidar is not None
        pair = self.make_pair(has_lidar)
        made = made_by(pair, robot, log.mounts, has_lidar, self.config, f"log {fingerprint(path)[:12]}")
        pipeline = Pipeline(pair, robot, log.mounts, has_lidar, self.config)
        session = Session.start(files, pipeline, f"{pair.model.name}_{pair.estimator}", made)
        pace, began, first_ns, shown, seconds, is_done = Pace(rate, sleep=stop.sleep), time.monotonic(), None, -math.inf, 0.0, False
        try:
            if view is not None:
                view.begin(robot, log.mounts)
                session.view = view
            if session.head:
                console.print(f"resumed from {files.state} after {session.count} events", markup=False, soft_wrap=True)
            with Live(console=console, auto_refresh=False, transient=True) as live:
                for event in self._rest(log.events(), session.count):
                    pace.wait(event.stamp_ns)
                    if stop.is_set():
                        self._interrupt(console, session)
                    session.push(event)
                    session.dump()
                    first_ns = event.stamp_ns if first_ns is None else first_ns
                    seconds, now = (event.stamp_ns - first_ns) * 1e-9, time.monotonic()
                    if console.is_terminal or view is not None:
                        session.saw(event)
                    if console.is_terminal and now - shown >= _LINE_S:
                        shown, speed = now, f"  {seconds / max(now - began, 1e-9):.1f}x"
                        statuses = session.health.statuses(session.pipeline)
                        live.update(terminal_view(session, seconds, statuses, extra=speed), refresh=True)
            session.finish()
            count = session.write_out()
            is_done = True
        finally:
            session.close(forget=is_done)
        for note in dict.fromkeys([*log.warnings(), *session.pipeline.warnings()]):
            console.print(f"[yellow]![/] {escape(note)}", soft_wrap=True)
        self._summarize(console, session, seconds, count)

    def _rest(self, events: Iterator[Event], done: int) -> Iterator[Event]:
        """Those after the first ``done``. Raises `DumpError` where there are not so many."""
        found = sum(1 for _ in islice(events, done))
        if found < done:
            raise DumpError(f"the state in '{self.state}' is of {done} events where the log has {found}. Remove it to start anew.")
        yield from events

    def _interrupt(self, console: Console, session: Session) -> NoReturn:
        """With a state, the same command goes on from there. Without one nothing can: the output is what there is so far."""
        session.dump(now=True)
        if self.state is not None:
            console.print(f"the state is in {self.state}: the same command goes on from there", markup=False, soft_wrap=True)
        elif (count := session.write_out()) is not None:
            console.print(f"{self.out}: {count} estimates, up to where the run was stopped", markup=False, soft_wrap=True)
        raise KeyboardInterrupt

    def _spin(self, console: Console, files: Files, robot: Robot, stop: Stop, view: View | None) -> None:
        def tell(said: str) -> None:
            console.print(f"[yellow]![/] {escape(said)}", soft_wrap=True)

        transport = self._transport()
        try:
            node = Node.start(transport, robot, self.make_pair, files, tell, self.topic, self.config, self.node, stop.is_set, view)
            said = f"running {self.model} in {self.estimator} on {', '.join(node.topics)} of {transport.place}"
            console.print(said, markup=False, soft_wrap=True)
            with Live(console=console, auto_refresh=False, transient=True) as live:
                node.spin(stop.is_set, lambda n: self._show(console, live, n))
            count = node.finish()
        finally:
            transport.close()
        for note in node.warnings():
            tell(note)
        self._summarize(console, node.session, node.seconds, count)

    def _transport(self) -> Transport:
        """Raises `DoorError`. Each is imported only where it is wanted."""
        door, names = self.door, self.node.names
        if door == "auto":
            door = "dds" if importlib.util.find_spec("rclpy") is None else "rclpy"
        if door == "rospy":
            from localization.ros.transports.rospy import RospyTransport

            return RospyTransport()
        if door == "rclpy":
            from localization.ros.transports.rclpy import RclpyTransport

            return RclpyTransport(names.name, names.namespace)
        from localization.ros.transports.dds import DdsTransport
        from localization.ros.transports.dds_settings import choose_interface, default_domain

        return DdsTransport(
            default_domain() if self.domain is None else self.domain, choose_interface(self.interface), names.name, names.namespace
        )

    def _view(self) -> View | None:
        """Raises `DoorError` and `OutputError`. Imported only where it is wanted."""
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


def parse_rate(text: str) -> float:
    """Times real time; infinite for `max`. Raises `OutputError`."""
    try:
        rate = math.inf if text == "max" else float(text)
    except ValueError:
        rate = math.nan
    if not rate >= _SLOWEST:
        raise OutputError(f"--rate is '{text}'; it must be a number from {_SLOWEST} (1 is real time), or max.")
    return rate
