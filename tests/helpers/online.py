"""Short simulated drives for the tests of what runs online: a lap's part through rooms, turns and rests, all sensors."""

from __future__ import annotations

import functools
import hashlib
import json
import math
import tempfile
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from localization.estimators import Estimate, PriorMap
from localization.logs import open_log
from localization.logs.reader import open_source
from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import Pipeline, Trial
from localization.ros.discovery import TF
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import Names, NodeConfig
from localization.ros.publisher import DIAGNOSTICS, FIX, MAP, ODOMETRY, PATH, POSE, PREDICTED_ODOMETRY
from localization.ros.session import Files, View
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import MonotonicTime, Received, ServiceHandler
from localization.simulation.experiments import Experiment, MoveArms, OpenLoop, Rest, constant
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import EncoderConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-tests-")


def _phases(robot, config):
    yield Rest(1.0)
    yield OpenLoop("ahead", constant(0.5, 0.1), 3.0)
    yield OpenLoop("turn", constant(0.0, 0.5), 2.0)
    yield MoveArms(np.array([0.02, 0.01]))
    yield OpenLoop("back", constant(-0.4, -0.3), 4.0)
    yield Rest(0.5)
    yield OpenLoop("arc", constant(0.5, 0.5), 6.0)


DRIVE = Experiment("short", "for tests", "hall", (0.0, 0.0, 0.0), _phases)


@functools.cache
def drive_log(lidar: str = "2d", seed: int = 0, scans_hz: float = 12.5, *, rear: bool = False) -> Path:
    """An .mcap of about 20 s; ``scans_hz`` is that of the planar scanner, or of two (``rear``)."""
    path = Path(_FOLDER.name) / f"drive_{lidar}_{seed}_{scans_hz}_{rear}.mcap"
    sensors = SensorConfig(lidar=lidar, rear=rear, scanner=ScannerConfig(rate_hz=scans_hz), encoders=EncoderConfig())
    config = SimulationConfig(sensors=sensors)
    write_simulation(path, Simulation(DRIVE, ROBOT, seed, {}, config))
    return path


@functools.cache
def drive_events():
    log = open_log(drive_log(), ROBOT)
    return list(log.events()), log.mounts


def new_core(estimator: str, model: str = "skid_steer", form: str = "constant") -> Pipeline:
    _, mounts = drive_events()
    return Pipeline(Trial(make_model(model, ROBOT), estimator, form), ROBOT, mounts, has_lidar=True)


def numbers(estimate: Estimate) -> tuple:
    """All of an estimate, to the last bit."""
    arrays = (estimate.pose, estimate.covariance, estimate.twist, estimate.twist_covariance)
    return estimate.stamp_ns, *(None if a is None else np.asarray(a).tobytes() for a in arrays), estimate.nis


class LogTransport(MonotonicTime):
    """A robot made of a log: its messages as bytes, as fast as they are taken; ``spoil`` may lose, double, delay or change them."""

    is_ros1 = False
    place, elsewhere = "a log", "Look elsewhere."

    def __init__(self, path: Path, spoil: Callable[[list[Received]], list[Received]] = list, types: dict[str, str] | None = None) -> None:
        source = open_source(path)
        self.types = {channel.topic: channel.type for channel in source.channels} | (types or {})
        base = time.monotonic_ns() - (source.end_ns - source.start_ns)
        messages = [Received(m.topic, base + m.log_ns - source.start_ns, m.data) for m in source.messages(list(self.types))]
        self.left = deque(spoil(messages))
        self._begin: int | None = None
        self.subscribed: dict[str, bool] = {}
        self.kept: set[str] | None = None
        self.services: dict[str, ServiceHandler] = {}
        self.published: dict[str, list[bytes]] = {}
        self.is_closed = False

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        self.subscribed[topic] = is_latched
        if self.kept is not None:
            self.kept.add(topic)

    def restrict(self, topics, urgent=()) -> None:
        self.kept, self.urgent = set(topics), set(urgent)

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        self.services[name] = handler
        return True

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        self.published[topic] = []

    def publish(self, topic: str, data: bytes) -> None:
        self.published[topic].append(data)

    def publishers(self) -> dict[str, set[str]]:
        return {topic: {kind} for topic, kind in self.types.items()}

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """The first two seconds at once, then a tenth of a second at a time."""
        if not self.left:
            return []
        span = 100_000_000 if self._begin is not None else 2_000_000_000
        self._begin = end = (self.left[0].received_ns if self._begin is None else self._begin) + span
        found = []
        while self.left and self.left[0].received_ns < end:
            found.append(self.left.popleft())
        wanted = self.subscribed if self.kept is None else self.kept
        return [message for message in found if message.topic in wanted]

    def now_ns(self) -> int:
        """When the last message was taken: a microsecond after it came."""
        return (self._begin or time.monotonic_ns()) + 1000

    def is_empty(self) -> bool:
        return not self.left

    def close(self) -> None:
        self.is_closed = True


def run_node(
    transport: LogTransport,
    estimator: str = "ekf",
    files: Files | None = None,
    config: NodeConfig | None = None,
    topics: TopicOverrides | None = None,
    view: View | None = None,
    prior: PriorMap | None = None,
    robot: Robot = ROBOT,
) -> tuple[Node, list[str]]:
    """A node over all that ``transport`` holds, and what it reported. It publishes no predictions unless ``config`` has it so."""
    reports: list[str] = []
    run = LiveRun(
        robot,
        lambda has_lidar: Trial(make_model("skid_steer", robot), estimator, prior=prior),
        files or Files(),
        topics or TopicOverrides(),
        node=config or NodeConfig(wait_s=0.0, predict=False),
    )
    warming = WarmUp(run)  # the transport has no time: everything would come while the node compiles
    warming.wait(with_clouds={"sensor_msgs/msg/PointCloud2"} in transport.publishers().values())
    node = Node.start(transport, run, reports.append, view=view)
    node.spin(transport.is_empty)
    return node, reports


def reseal(state: Path, name: str, value: object) -> None:
    """Replace ``name`` in the header of a state file by ``value``, with a valid check sum."""
    magic, _, head, rest = state.read_bytes().split(b"\n", 3)
    body = json.dumps({**json.loads(head), name: value}).encode() + b"\n" + rest
    state.write_bytes(b"\n".join([magic, hashlib.sha256(body).hexdigest().encode(), body]))


def published(transport: LogTransport, topic: str) -> list:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {
        ODOMETRY: "nav_msgs/msg/Odometry",
        PREDICTED_ODOMETRY: "nav_msgs/msg/Odometry",
        TF: "tf2_msgs/msg/TFMessage",
        DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
        POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
        PATH: "nav_msgs/msg/Path",
        MAP: "nav_msgs/msg/OccupancyGrid",
        FIX: "sensor_msgs/msg/NavSatFix",
    }
    return [
        store.deserialize_cdr(data, kinds.get(topic, "sensor_msgs/msg/JointState")) for data in transport.published[Names().resolve(topic)]
    ]


def stamp_of(message) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def track(transport: LogTransport, topic: str = ODOMETRY) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Pose and sigmas (x, y, yaw) that were published on ``topic``, by stamp."""
    found = {}
    for m in published(transport, topic):
        q, p = m.pose.pose.orientation, m.pose.pose.position
        pose = np.array([p.x, p.y, 2.0 * math.atan2(q.z, q.w)])
        found[stamp_of(m)] = pose, np.sqrt(m.pose.covariance[[0, 7, 35]])
    return found
