"""Odometry by wheels alone while no estimator gives any: it compiles, takes up the messages that have waited, or begins anew."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from localization.estimate import Estimate
from localization.events import CgSample, Event, WheelSample
from localization.inputs.wheel_buffer import WheelBuffer
from localization.ros.continuous_odometry import ContinuousOdometry
from localization.ros.discovery import MAX_BACKLOG
from localization.ros.live_stream import LiveStream
from localization.ros.predictor import Predictor
from localization.ros.publisher import EstimatePublisher
from localization.ros.transports.transport import Received
from motion_models.compiled import interpreted


class InterimOdometry:
    """`insert` each event. The pose begins at the predictor's last estimate, or at the origin of `odom`, as an estimator's does."""

    def __init__(self, predictor: Predictor, wheels: WheelBuffer) -> None:
        """``predictor`` and ``wheels`` are its own: the pipeline has others."""
        self._predictor, self._wheels = predictor, wheels

    @property
    def newest(self) -> Estimate | None:
        """The pose at the newest wheel sample; None before the first."""
        return self._predictor.predict(self._wheels) or self._predictor.last

    def restart(self, start: Estimate) -> None:
        """Go on from ``start``."""
        self._predictor.advance(start)

    def publish_due(self, event: Event, stream: LiveStream, continuous: ContinuousOdometry, publisher: EstimatePublisher) -> None:
        """Take the next event, of ``stream``, and publish the pose at the newest wheel sample, where one is due. Interpreted: it shall not
        wait for what compiles meanwhile."""
        with interpreted():
            if (estimate := self.insert(event)) is not None:
                continuous.publish(estimate, stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=False), publisher)

    def insert(self, event: Event) -> Estimate | None:
        """Take the next event. Returns the pose at the newest wheel sample, where one is due."""
        if isinstance(event, CgSample):
            self._wheels.set_cg(event)
        if not isinstance(event, WheelSample):
            return None
        if self._wheels.newest_ns is None:
            self._predictor.begin(event.stamp_ns)
        self._wheels.insert(event)
        if not self._predictor.is_due(event.stamp_ns):
            return None
        estimate = self._predictor.predict(self._wheels)
        if estimate is not None:
            self._predictor.advance(estimate)
        return estimate


@dataclass
class WaitingMessages:
    """Messages for an estimator that is not ready, or has not taken them up yet. Interim odometry reads them by ``stream`` as they come."""

    stream: LiveStream
    is_ready: Callable[[], bool]
    queue: deque[Received]
    past: int = 0
    """So many of the queue were processed before, by another reading of the sensors: their estimates are not published again."""

    @classmethod
    def of(cls, stream: LiveStream, past: Iterable[Received] = (), is_ready: Callable[[], bool] = lambda: True) -> WaitingMessages:
        """``past`` messages first."""
        queue = deque(past, maxlen=MAX_BACKLOG)
        return cls(stream, is_ready, queue, len(queue))

    def take(self) -> tuple[Received, bool]:
        """The next message, and whether it is a past one."""
        is_past = self.past > 0
        self.past -= is_past
        return self.queue.popleft(), is_past
