"""Odometry by wheels from the first second of the process on: it needs messages and a motion model, and no package of the estimator, which
is imported meanwhile. The node takes over what it has begun."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_buffer import WheelBuffer
from localization.logs.decode import MessageStats
from localization.logs.topic_roles import TopicOverrides
from localization.ros.continuous_odometry import ContinuousOdometry
from localization.ros.discovery import DiscoveredTopics, TopicDiscovery
from localization.ros.interim_odometry import InterimOdometry, WaitingMessages
from localization.ros.live_stream import LiveStream
from localization.ros.node_config import NodeConfig
from localization.ros.predictor import Predictor
from localization.ros.publisher import EstimatePublisher
from localization.ros.transports.transport import Received, Transport
from motion_models.compiled import interpreted
from motion_models.registry import make_model
from motion_models.robot import Robot

_POLL_S = 0.2


class EarlyOdometry:
    """Discovers the topics and publishes odometry by wheels in a thread of its own, until `take_over`."""

    def __init__(
        self, transport: Transport, robot: Robot, topics: TopicOverrides, node: NodeConfig, model: str, report: Callable[[str], None]
    ) -> None:
        """Begin. ``robot``, ``topics`` and the name of the motion ``model`` as options have them."""
        self.transport, self._node, self._model, self._report = transport, node, model, report
        names = node.names
        robot, topics = names.apply_to_robot(robot), names.apply_to_overrides(topics)
        self.discovery = TopicDiscovery(transport, robot, topics, names, node.frames.base_link_frame)
        self.publisher = EstimatePublisher.of_node(transport, node)
        self.continuous = ContinuousOdometry()
        self._first_ended, self._stopped = threading.Event(), threading.Event()
        self.interim: InterimOdometry | None = None
        """None before the topics are known."""
        self.waiting: WaitingMessages | None = None
        """Messages for the estimator; None before the topics are known."""
        self._executor = ThreadPoolExecutor(1, "early-odometry")
        self._found = self._executor.submit(self._run)

    def wait(self, seconds: float) -> None:
        """Until the first odometry is out, or for ``seconds``: what is imported meanwhile would only delay it."""
        self._first_ended.wait(seconds)

    def take_over(self) -> DiscoveredTopics | None:
        """End the thread. The topics in use; None where they are not known yet. Raises `TransportError` and `TopicError`."""
        self._stopped.set()
        return self._found.result()

    def close(self) -> None:
        """End the thread, whatever has become of it."""
        self._stopped.set()
        self._executor.shutdown()

    def _run(self) -> DiscoveredTopics | None:
        try:
            with interpreted():
                return self._publish_until_stopped()
        except KeyboardInterrupt:  # raised by `discover` where it is stopped
            return None
        finally:
            self._first_ended.set()

    def _publish_until_stopped(self) -> DiscoveredTopics:
        discovery, node, is_stopped = self.discovery, self._node, self._stopped.is_set
        discovered = discovery.discover(node.wait_s, (), self._report, is_stopped, is_ready=is_stopped, patience_s=0.0)
        robot, transport = discovered.parts.robot, self.transport
        stream = LiveStream(discovered, robot, MessageStats(), transport.epoch_ns, is_ros1=transport.is_ros1)
        predictor = Predictor(make_model(self._model, robot), robot, StepConfig(), node.predict_hz)
        self.interim, self.waiting = InterimOdometry(predictor, WheelBuffer(robot.center_of_gravity)), WaitingMessages.of(stream)
        messages = discovered.backlog
        while True:
            for received in messages:
                self._receive(received, self.interim, self.waiting)
            if self.continuous.last is not None:
                self._first_ended.set()
            if is_stopped():  # after all that was taken is stored
                return discovered
            messages = transport.take(_POLL_S)

    def _receive(self, received: Received, interim: InterimOdometry, waiting: WaitingMessages) -> None:
        waiting.queue.append(received)
        for event in waiting.stream.events(received):
            interim.publish_due(event, waiting.stream, self.continuous, self.publisher)
