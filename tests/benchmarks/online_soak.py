"""Hours of the estimator live, as fast as it goes: a simulated robot drives round four rooms, and every message of its topics passes
through the node as bytes, with an output and a state on disk. WheelAngles and time must stay as they are.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.logs.message_templates import Message, MessageLayout, Template
from localization.pipeline import Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.session import Files
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import MonotonicTime, Received
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, simulate
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

_EVERY_S = 600
_TOLD_PARTS = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Row:
    """The state of things after some simulated time."""

    hours: float
    resident_mb: float
    median_ms: float
    """Over the last ten minutes, of all the work between one scan and the next."""
    p99_ms: float
    position_error_m: float


class SimulatedRobot(MonotonicTime):
    """A `Transport` whose messages are made when they are asked for, one at a time; it stops the time until it is asked for the next."""

    is_ros1 = False
    place, elsewhere = "this process", ""

    def __init__(self, hours: float, beams: int) -> None:
        sensors = SensorConfig(scanner=ScannerConfig(beams=beams))
        simulation = simulate("soak", load_robot("vaultbot"), 0, {}, SimulationConfig(ExperimentConfig(hours=hours), sensors=sensors))
        self._runs = simulation.runs
        self._messages = simulation.messages()
        self._templates: dict[int, tuple[MessageLayout, Template]] = {}
        self._types: dict[str, str] = {}
        self._topics: set[str] = set()
        self._base_ns = time.monotonic_ns()
        self._is_begun = False
        self._returned = 0.0
        self._busy_s = 0.0
        self.seconds = 0.0
        """Simulated."""
        self.truth = np.zeros(2)
        self.took_s: list[float] = []
        """Work between scans, since it was last cleared."""
        self.published = 0
        self.is_over = False

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        self._topics.add(topic)

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        self._topics = set(topics)

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None: ...

    def publish(self, topic: str, data: bytes) -> None:
        self.published += 1

    def publishers(self) -> Mapping[str, set[str]]:
        return {topic: {kind} for topic, kind in self._types.items()}

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """The first two seconds at once, as a robot that has been there; then message by message."""
        self._busy_s += time.perf_counter() - self._returned
        found = self._first() if not self._is_begun else [received for received in [next(self._received(), None)] if received]
        self.is_over = not found
        self._returned = time.perf_counter()
        return found

    def close(self) -> None: ...

    def _first(self) -> list[Received]:
        self._is_begun = True
        found = []
        for received in self._received():
            found.append(received)
            if self.seconds > 2.0:
                break
        return found

    def _received(self) -> Iterator[Received]:
        for message in self._messages:
            self._runs.clear()  # what the simulator keeps of its laps would be taken for the estimator's
            topic = message.layout.topic
            self._types.setdefault(topic, message.layout.type)
            self.seconds = (message.log_ns - 1_000_000_000) * 1e-9
            if topic == "/ground_truth/odom":
                self.truth = np.array(message.parts[0])
            if topic == "/scan":
                self.took_s.append(self._busy_s)
                self._busy_s = 0.0
            if topic in self._topics:
                yield Received(topic, self._base_ns + message.log_ns, self._bytes(message))

    def _bytes(self, message: Message) -> bytes:
        known = self._templates.get(id(message.layout))
        if known is None:
            known = self._templates[id(message.layout)] = message.layout, Template(message.layout, is_ros1=False)
        return known[1].fill(message)


def drive(hours: float, beams: int, estimator: str = "ekf") -> list[Row]:
    """A row for every ten simulated minutes, printed as it comes."""
    robot, transport = load_robot("vaultbot"), SimulatedRobot(hours, beams)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        files = Files(Path(folder) / "soak.tum", Path(folder) / "state")
        pair = Trial(make_model("skid_steer", robot), estimator)
        run = LiveRun(robot, lambda has_lidar: pair, files, node=NodeConfig(wait_s=0.0))
        WarmUp(run).wait()
        node = Node.start(transport, run, print)
        start = np.append(transport.truth, 0.0)

        def look() -> bool:
            if transport.seconds >= 60.0 if not rows else transport.seconds >= 3600.0 * rows[-1].hours + _EVERY_S:
                took = 1e3 * np.array(transport.took_s)
                transport.took_s.clear()
                estimate = node.session.health.estimate
                assert estimate is not None
                error = float(np.hypot(*(estimate.pose[:2] + start[:2] - transport.truth)))
                rows.append(Row(transport.seconds / 3600.0, _resident_mb(), *np.percentile(took, [50, 99]), error))
                _print(rows[-1])
            return transport.is_over

        node.spin(look)
        node.finish()
    return rows


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def _print(row: Row) -> None:
    print(f"{row.hours:8.2f} h{row.resident_mb:10.1f} MB{row.median_ms:10.2f}{row.p99_ms:10.2f}{row.position_error_m:12.3f}", flush=True)


def soak(hours: float, beams: int) -> None:
    print(f"{hours:g} h of {beams} beams at 12.5 Hz, wheels and IMU at 50 Hz, as bytes through the node, output and state on disk")
    print(f"{'driven':>10}{'resident':>13}{'p50':>10}{'p99 ms':>10}{'off by [m]':>12}    (work from scan to scan)", flush=True)
    begin = time.perf_counter()
    rows = drive(hours, beams)
    took = time.perf_counter() - begin
    settled = [row for row in rows if row.hours >= 0.5 * hours]
    print(f"{took / 60.0:.0f} min, simulation included. Of these:")
    for part in _TOLD_PARTS:
        _print(min(rows, key=lambda row: abs(row.hours - part * hours)))
    slope = np.polyfit([row.hours for row in settled], [row.resident_mb for row in settled], 1)[0] if len(settled) > 2 else float("nan")
    print(f"memory in the second half: {slope:+.2f} MB an hour")
