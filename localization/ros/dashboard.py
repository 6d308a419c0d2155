"""The estimator live in a browser of this machine: map, path, covariance, learned parameters and faults, by server-sent events.

`Dashboard.show` keeps decimated numbers and returns; threads of a server of the standard library encode and send them. The protocol has
two events: `history` replaces all that a page has, `update` adds to it.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from localization.errors import TransportError
from localization.estimate import Estimate
from localization.events import Event, Scan
from localization.logs.fused_messages import odom_axes
from localization.pipeline import Pipeline
from localization.report.interactive import numbers
from localization.report.page import Live, Page, Section, render
from localization.report.scan_layer import thin_scan
from motion_models import se2
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

PORT = 8790
"""Tried first, so that a page that is open finds the next run."""
_LOOPBACK = "127.0.0.1"
_SENT_EVERY_S = 0.25
_SAMPLE_NS, _SLOW_NS = 100_000_000, 1_000_000_000
"""Between two samples of pose, and of parameters and warnings, by the robot's time."""
_MAP_S = 5.0
"""Between two maps, by the computer's time."""
_MOST_SAMPLES = 3_000
"""When there are more, every second one is left out: ten hours are drawn as fast as one."""
_MOST_MAP_POINTS, _MOST_SCAN_POINTS = 4_000, 180
_KEEP_ALIVE_S = 10.0


class History:
    """Rows over time in bounded memory: one per period, which doubles when there are too many."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns, self.rows = period_ns, []  # type: int, list[list[float | None]]
        self.thinned = 0
        """How often the period was doubled."""
        self._first_ns = self._next_ns = -(1 << 62)

    def is_due(self, stamp_ns: int) -> bool:
        """Whether the next row is due at ``stamp_ns``."""
        return stamp_ns >= self._next_ns

    def add(self, stamp_ns: int, row: list[float | None]) -> None:
        """Append ``row``."""
        if not self.rows:
            self._first_ns = stamp_ns
        self._next_ns = stamp_ns + self.period_ns
        self.rows.append(row)
        if len(self.rows) > _MOST_SAMPLES:
            self.rows, self.thinned = self.rows[::2], self.thinned + 1
            self.period_ns = max(2 * self.period_ns, (stamp_ns - self._first_ns) // len(self.rows))


class Dashboard:
    """A `session.View`; it serves from its construction until `close`."""

    def __init__(self, port: int = PORT) -> None:
        """``port``: another one is taken where it is in use. Raises `TransportError` where none can be opened."""
        self._feed = Feed()
        self._server = _Server(port, self._feed)
        self._mounts: Mapping[str, Mount] = {}
        self._scan: Scan | None = None
        self._names: list[str] = []
        self._start_ns: int | None = None
        self._next_send = self._next_map = 0.0
        threading.Thread(target=self._server.serve_forever, daemon=True, name="dashboard").start()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{_LOOPBACK}:{self._server.server_address[1]}/"

    def begin(self, robot: Robot, mounts: Mapping[str, Mount]) -> None:
        """Take the robot's outline and the mounts of its sensors."""
        self._mounts = mounts
        self._feed.set(robot=robot.name, size=[robot.geometry.wheelbase_m, robot.geometry.track_width_m])

    def show(self, event: Event | None, estimates: Sequence[Estimate], pipeline: Pipeline) -> None:
        """``event`` has gone in (None: no more will come), ``estimates`` have come out."""
        if isinstance(event, Scan):
            self._scan = event
        for estimate in estimates:
            self._add(estimate, pipeline)
        now = time.monotonic()
        if estimates and now >= self._next_send:
            self._next_send = now + _SENT_EVERY_S
            self._send(estimates[-1], pipeline, now)
        if event is None:
            self._feed.set(map=_map_points(pipeline), warnings=pipeline.warnings())
            self._feed.end()

    def close(self) -> None:
        """End the server; pages that are open keep what they show."""
        self._feed.end()
        self._server.shutdown()
        self._server.server_close()

    def _add(self, e: Estimate, pipeline: Pipeline) -> None:
        """Append to the histories what is due."""
        start_ns = self._start_ns = e.stamp_ns if self._start_ns is None else self._start_ns
        t = (e.stamp_ns - start_ns) * 1e-9
        if self._feed.samples.is_due(e.stamp_ns):
            cov = np.full((3, 3), np.nan) if e.covariance is None else e.covariance
            sigma_m, sigma_deg = np.sqrt(cov[0, 0] + cov[1, 1]), np.degrees(np.sqrt(cov[2, 2]))
            nis = np.nan if e.nis is None else e.nis
            self._feed.samples.add(e.stamp_ns, numbers([t, *e.pose, sigma_m, sigma_deg, nis, e.twist[0], e.twist[2]], 4))
        if self._feed.parameters.is_due(e.stamp_ns):
            found = pipeline.estimator.parameters()
            self._names += [name for name in found if name not in self._names]
            values = [value for name in self._names for value in found.get(name, (np.nan, np.nan))]
            self._feed.parameters.add(e.stamp_ns, numbers([t, *values], 7))
            self._feed.set(names=list(self._names), warnings=pipeline.warnings())

    def _send(self, e: Estimate, pipeline: Pipeline, now: float) -> None:
        """Set the present pose, its covariance in the world's axes, scan and map."""
        state: dict[str, Any] = {"pose": numbers(e.pose, 4)}
        if e.covariance is not None:
            cov = odom_axes(e.covariance, e.pose[2])
            state["cov"] = [float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])]
        if self._scan is not None:
            state["scan"] = _columns(se2.transform(e.pose, thin_scan(self._scan, self._mounts, _MOST_SCAN_POINTS)))
        if now >= self._next_map:
            self._next_map = now + _MAP_S
            state["map"] = _map_points(pipeline)
        self._feed.set(**state)


class Feed:
    """What pages are given, from the estimator's thread to those of the server."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.samples, self.parameters = History(_SAMPLE_NS), History(_SLOW_NS)
        self._state: dict[str, tuple[int, Any]] = {}
        """By name, with the version in which it was set."""
        self._version = 0
        self._is_ended = False

    def set(self, **state: Any) -> None:
        """Replace parts of the state."""
        with self._changed:
            self._version += 1
            self._state.update({name: (self._version, value) for name, value in state.items()})
            self._changed.notify_all()

    def end(self) -> None:
        """No more will come."""
        with self._changed:
            self._is_ended = True
            self._changed.notify_all()

    def messages(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Events for one page, as they come: name and content; "wait" after `_KEEP_ALIVE_S` without one, "end" as the last.

        The first has everything; of the histories, later ones have the rows that were added, or all again after they were thinned.
        """
        version, sent, thinned = -1, {"samples": 0, "parameters": 0}, -1
        while True:
            with self._changed:
                self._changed.wait_for(lambda seen=version: self._version > seen or self._is_ended, _KEEP_ALIVE_S)  # type: ignore[misc]
                is_new, is_ended = self._version > version, self._is_ended
                histories = {"samples": self.samples, "parameters": self.parameters}
                is_all = thinned != sum(history.thinned for history in histories.values())
                thinned = sum(history.thinned for history in histories.values())
                rows = {name: history.rows[0 if is_all else sent[name] :] for name, history in histories.items()}
                sent = {name: len(history.rows) for name, history in histories.items()}
                state = {name: value for name, (since, value) in self._state.items() if is_all or since > version}
                version = self._version
            if is_new:
                yield "history" if is_all else "update", {**state, **rows}
            if is_ended:
                yield "end", {}
                return
            if not is_new:
                yield "wait", {}


class _Server(ThreadingHTTPServer):
    """The page at / and its events at /events, for this machine alone."""

    daemon_threads = True

    def __init__(self, port: int, feed: Feed) -> None:
        self.feed = feed
        try:
            super().__init__((_LOOPBACK, port), _Handler)
        except OSError:
            try:
                super().__init__((_LOOPBACK, 0), _Handler)
            except OSError as error:
                raise TransportError(f"the dashboard cannot be served on {_LOOPBACK}: {error.strerror or error}.") from error


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """Answer one request; a page of another site that names this machine by a name of its own is refused (DNS rebinding)."""
        host = (self.headers.get("Host") or "").rpartition(":")[0]
        if host not in (_LOOPBACK, "localhost"):
            self.send_error(403)
        elif self.path == "/":
            self._send(page().encode(), "text/html; charset=utf-8")
        elif self.path == "/events":
            self._stream()
        else:
            self.send_error(404)

    def _send(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with contextlib.suppress(OSError):  # the page was closed
            for name, content in self.server.feed.messages():
                text = json.dumps(content, separators=(",", ":"))
                self.wfile.write(f"event: {name}\ndata: {text}\n\n".encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal shows the estimator."""


def page() -> str:
    """HTML of the page."""
    facts = "Live on this machine. Drag to move the map, scroll to zoom, click a name to hide it."
    return render(Page("skidloc online", facts, ["Waiting for the first estimate."], [Section("Map and state", [Live()])]))


def _map_points(pipeline: Pipeline) -> list[list[float | None]]:
    points = pipeline.estimator.map_points()
    return _columns(points[np.linspace(0, len(points) - 1, min(len(points), _MOST_MAP_POINTS)).astype(np.int64)])


def _columns(points: FloatArray) -> list[list[float | None]]:
    """x and y of ``points`` (N, 2)."""
    return [numbers(points[:, 0], 2), numbers(points[:, 1], 2)]
