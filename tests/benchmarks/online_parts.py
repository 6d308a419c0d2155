"""What part of a core each part of the node takes: at the pace of a robot over DDS, and for the same messages one after the other, when its
code stays in the processor's caches. Processor time of the node's own thread; the threads of DDS are in the whole process alone.
"""

from __future__ import annotations

import functools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from localization.pipeline import Pipeline, Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.live_outputs import LiveOutputs
from localization.ros.live_set_up import LiveSetUp
from localization.ros.live_stream import LiveStream
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.predictor import Predictor
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import Files, Session
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import Received
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.online import LogTransport

_SETTLED_S = 5.0
"""The first seconds, with what has waited for the start, do not count."""
_TICK_NS = 20_000_000
_PARTS: tuple[tuple[str, type[Any], str], ...] = (
    ("decoding, order of time", LiveStream, "events"),
    ("pipeline: steps of the estimator, buffers", Pipeline, "process"),
    ("work after an estimate", Pipeline, "run_deferred"),
    ("prediction", Predictor, "predict"),
    ("encoding of predictions", LiveOutputs, "publish_prediction"),
    ("encoding of estimates", EstimatePublisher, "publish_estimate"),
    ("state to disk", Session, "save_state"),
    ("comparison of sensors on the first metres", LiveSetUp, "add_event"),
    ("diagnostics, path, map", Node, "publish_status"),
)


class PartTimes:
    """Thread time [s] and calls of methods, each without what others of them took inside."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._running: list[str] = []
        self._since = time.thread_time()

    def clear(self) -> None:
        """Begin to count."""
        self.seconds.clear()
        self.calls.clear()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What is done inside is of the part ``name``."""
        self._switch()
        self._running.append(name)
        try:
            yield
        finally:
            self._switch()
            self._running.pop()

    def _switch(self) -> None:
        now = time.thread_time()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def measured(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, of whose results those of a generator are made at once."""

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            self.calls[name] += 1
            with self.part(name):
                found = function(*args, **kwargs)
                return list(found) if isinstance(found, Iterator) else found

        return call


@contextmanager
def watched(transport: type[Any], times: PartTimes) -> Iterator[None]:
    """Inside, the parts of nodes on a ``transport`` are measured."""
    parts = [*_PARTS, ("transport: receiving", transport, "take"), ("transport: sending", transport, "publish")]
    before = [(owner, method, getattr(owner, method)) for _, owner, method in parts]
    for name, owner, method in parts:
        setattr(owner, method, times.measured(name, getattr(owner, method)))
    try:
        yield
    finally:
        for owner, method, function in before:
            setattr(owner, method, function)


class QuickTransport(LogTransport):
    """A robot whose messages of 20 ms come at once; those after the first seconds wait until the node is ``started``."""

    started = False

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """Those of the next 20 ms."""
        if self._begin is not None and not self.started:
            time.sleep(timeout_s)
        if not self.left or (self._begin is not None and not self.started):
            return []
        begins_ns = self.left[0].received_ns if self._begin is None else self._begin
        self._begin = begins_ns + (_TICK_NS if self._begin is not None else round(_SETTLED_S * 1e9))
        found = []
        while self.left and self.left[0].received_ns < self._begin:
            found.append(self.left.popleft())
        return [message for message in found if message.topic in (self.subscribed if self.kept is None else self.kept)]


def live_run(folder: Path) -> LiveRun:
    """The simulated VaultBot's, with its state on disk."""
    robot = load_robot("vaultbot")
    run = LiveRun(robot, lambda has_lidar: Trial(make_model("skid_steer", robot), "ekf"), Files(state=folder / "state"))
    WarmUp(run).wait()
    return LiveRun(run.robot, run.make_trial, run.files, node=NodeConfig(wait_s=1.0))


def over_dds(folder: Path, seconds: float, domain: int, begin: Callable[[], None], times: PartTimes) -> tuple[float, float]:
    """The part of a core of this process in the first ``seconds``, and the time of its parts, of the next ones [s]: to measure parts takes
    time itself. ``begin`` makes the robot play."""
    from localization.ros.transports.dds import DdsTransport

    transport, run = DdsTransport(domain), live_run(folder)
    threading.Timer(1.0, begin).start()
    node = Node.start(transport, run, print)
    start = time.monotonic()
    node.spin(lambda: time.monotonic() > start + _SETTLED_S)
    cpu, start = time.process_time(), time.monotonic()
    node.spin(lambda: time.monotonic() > start + seconds)
    share = (time.process_time() - cpu) / (time.monotonic() - start)
    times.clear()
    start = time.monotonic()
    with watched(DdsTransport, times):
        node.spin(lambda: time.monotonic() > start + seconds)
    took = time.monotonic() - start
    node.finish()
    transport.close()
    return share, took


def one_after_the_other(path: Path, folder: Path, times: PartTimes) -> tuple[float, float]:
    """The same for the messages of ``path`` without a pause between them."""
    transport, run = QuickTransport(path), live_run(folder)
    node = Node.start(transport, run, print)
    transport.started = True
    first_ns = transport.now_ns()
    times.clear()
    cpu = time.process_time()
    with watched(QuickTransport, times):
        node.spin(transport.is_empty)
    cpu, took = time.process_time() - cpu, (transport.now_ns() - first_ns) * 1e-9
    node.finish()
    return cpu / took, took


def table(paced: tuple[PartTimes, float, float], quick: tuple[PartTimes, float, float]) -> Iterator[str]:
    """Lines by part: calls a second, microseconds a call and per cent of a core, at a robot's pace and one after the other."""
    yield f"{'':45}{'a second':>10}{'us':>8}{'%':>7}    one after the other: us      %"
    for name, _ in paced[0].seconds.most_common():
        cells = []
        for times, _, took in (paced, quick):
            calls = max(times.calls[name], 1)
            cells.append((times.calls[name] / took, 1e6 * times.seconds[name] / calls, 100.0 * times.seconds[name] / took))
        yield f"{name:45}{cells[0][0]:10.1f}{cells[0][1]:8.0f}{cells[0][2]:7.2f}{cells[1][1]:27.0f}{cells[1][2]:7.2f}"
    yield f"{'the whole process':45}{'':18}{100.0 * paced[1]:7.2f}{'':27}{100.0 * quick[1]:7.2f}"
