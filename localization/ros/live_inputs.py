"""The robot's topics that a node uses, and how their messages become events: as the robot file and /tf_static have it, or as the sensors
were found to be wired."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from localization.logs.decode import MessageStats, Oddity
from localization.logs.topic_roles import Sources
from localization.ros.discovery import ROLE_GROUPS, TF, TF_STATIC, TF_TYPE, DiscoveredTopics, TransformConflicts
from localization.ros.gnss import FIX_TYPE, GnssReceiver, parse_datum, utm_pose
from localization.ros.live_stream import LiveStream
from localization.ros.payloads import Payloads
from localization.ros.session import LiveRobot
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import Received, Transport
from motion_models.robot import Mount

_MAX_WAIT_PERIODS = 1.5
"""For how long a scan waits for the processor where a newer one is here [periods of its topic]: its estimate would be as old as the newer
scan's. Half a period is for those that come in one reading."""
_FIRST_WAIT_S = 0.5
"""For how long one of a topic waits whose period is not known yet [s]."""


class LiveInputs:
    """`subscribe`, then give messages to `stream`, `gnss`, `transforms` and `conflicts`, by topic. `rewire` begins another stream."""

    def __init__(self, transport: Transport, run: LiveRun, discovered: DiscoveredTopics) -> None:
        """``run`` with resolved topics. Raises `SettingError` for a datum that is none, and for UTM without pyproj."""
        self._transport, self.robot = transport, run.robot
        self.discovered = replace(discovered, backlog=())
        """Topics in use, as they are read now."""
        self.tf_static, self.tf = run.node.names.resolve(TF_STATIC), run.node.names.resolve(TF)
        self.transforms = discovered.transforms
        self.conflicts = TransformConflicts(run.node.frames.base_link_frame, is_ros1=transport.is_ros1)
        """Other publishers of the node's own transform."""
        self.stats = MessageStats()
        self.stream = self.open_stream(self.stats)
        self.gnss = _gnss(run, transport, self.stats)
        """None without a topic of positions."""

    @property
    def sources(self) -> Sources:
        """Topics in use, by what they are used for."""
        return self.discovered.parts.sources

    @property
    def has_lidar(self) -> bool:
        """Whether scans or clouds are among the topics in use."""
        return self.sources.lidar is not None

    @property
    def topics(self) -> list[str]:
        """Names of the topics in use."""
        return [source.topic for source in self.sources.used()]

    @property
    def payloads(self) -> Payloads:
        """Loads that the robot holds."""
        return self.stream.payloads

    def open_stream(self, stats: MessageStats) -> LiveStream:
        """A stream that begins now, of the topics and the robot as they are known now; it counts in ``stats``."""
        return LiveStream(self.discovered, self.robot, stats, self._transport.epoch_ns, is_ros1=self._transport.is_ros1)

    def subscribe(self, commands: Iterable[str], *, with_tf: bool, is_predicting: bool) -> None:
        """Receive what is used from here on, and the topics of ``commands``. Wheels are urgent where messages of them make predictions;
        /tf shows another publisher of the transform, if ``with_tf``."""
        others = [self.tf_static]
        if with_tf:
            self._transport.subscribe(self.tf, TF_TYPE, is_latched=False)
            others.append(self.tf)
        if self.gnss is not None:
            self._transport.subscribe(self.gnss.topic, FIX_TYPE, is_latched=False)
            others.append(self.gnss.topic)
        sources = self.sources
        urgent = [source.topic for source in (*sources.lidars, sources.wheels if is_predicting else None) if source is not None]
        self._transport.restrict([*others, *self.topics, *commands], [*urgent, *commands])

    def without_overtaken(self, messages: Sequence[Received], now_ns: int, since_ns: int = 0) -> Sequence[Received]:
        """``messages`` without the scans that have waited for more than `_MAX_WAIT_PERIODS` while a newer one came.

        Where the processor is too slow for all, the newest counts; messages of wheels and gyro are all integrated. What came before
        ``since_ns``, when the node itself was ready, has not waited for the processor until then.
        """
        if len(messages) < 2:
            return messages
        lidars = {source.topic for source in self.sources.lidars}
        newest, kept = {received.topic: received for received in messages if received.topic in lidars}, list[Received]()
        for received in messages:
            has_waited_s = (now_ns - max(received.received_ns, since_ns)) * 1e-9
            if received.topic in lidars and received is not newest[received.topic] and has_waited_s > self._longest_wait_s(received.topic):
                self.stream.topic_rates[received.topic].count(received.received_ns)
                self.stats.count(received.topic, Oddity.OVERTAKEN)
                continue
            kept.append(received)
        return kept

    def _longest_wait_s(self, topic: str) -> float:
        return _MAX_WAIT_PERIODS * self.stream.topic_rates[topic].period_s or _FIRST_WAIT_S

    def lacking(self) -> list[tuple[str, ...]]:
        """Groups of roles without a topic."""
        used = {source.kind for source in self.sources.used()}
        return [group for group in ROLE_GROUPS if used.isdisjoint(group)]

    def take(self, discovered: DiscoveredTopics, mounts: Mapping[str, Mount]) -> None:
        """Read the topics of ``discovered`` from here on; angles of the wheels go on."""
        angles = self.stream.wheel_angles
        self.discovered = replace(discovered, backlog=(), transforms=self.transforms)
        self.reopen(mounts)
        self.stream.restore(angles)

    def rewire(self, wiring: LiveRobot, mounts: Mapping[str, Mount]) -> None:
        """Read messages from here on as of the robot of ``wiring``."""
        self.robot = wiring.robot
        parts, joints = self.discovered.parts, wiring.robot.joints
        if {*parts.joints[0]} != {*joints.left} and {*parts.joints[0], *parts.joints[1]} == {*joints.left, *joints.right}:
            parts = replace(parts, joints=(joints.left, joints.right))
        if not wiring.uses_gyro:
            parts = replace(parts, sources=replace(parts.sources, imu=None))
        self.discovered = replace(self.discovered, parts=parts)
        self.reopen(mounts)

    def reopen(self, mounts: Mapping[str, Mount]) -> None:
        """Begin another stream, with nothing counted; the loads stay."""
        loads = self.payloads.loads
        self.stats.clear()
        self.stream = self.open_stream(self.stats)
        self.payloads.loads, self.payloads.mounts = loads, mounts


def _gnss(run: LiveRun, transport: Transport, stats: MessageStats) -> GnssReceiver | None:
    """Raises `SettingError` for a datum that is none, and for UTM without pyproj."""
    node = run.node
    if not node.positions:
        return None
    datum = parse_datum(node.datum)
    if node.utm_frame:
        utm_pose(np.zeros(2) if datum is None else datum)  # what is missing is reported now
    return GnssReceiver(node.names.resolve(node.positions), datum, stats, transport.epoch_ns, is_ros1=transport.is_ros1)
