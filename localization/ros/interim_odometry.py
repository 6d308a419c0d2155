"""Odometry by wheels alone while the estimator compiles: a robot that is driven at once has its transforms after seconds, not a minute."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from localization.estimators import Estimate
from localization.events import CgSample, WheelSample
from localization.ros.discovery import MAX_BACKLOG
from localization.ros.live_stream import LiveStream
from localization.ros.predictor import Predictor
from localization.ros.transports.transport import Received
from localization.wheel_buffer import WheelBuffer
from motion_models.se2 import FloatArray


class InterimOdometry:
    """`add` each message. `messages` holds them all for the estimator, which begins with the first of them.

    The pose starts at the origin of `odom`, as the estimator's does. A gap of the wheels ends it.
    """

    def __init__(self, stream: LiveStream, predictor: Predictor, cg: FloatArray, is_over: Callable[[], bool]) -> None:
        """``stream`` and ``predictor`` are its own: those of the node begin when the estimator does, which is when ``is_over``. ``cg``: the
        robot's centre of gravity (2,), while none comes [m]."""
        self._stream, self._predictor, self.is_over = stream, predictor, is_over
        self._wheels = WheelBuffer(cg)
        self._has_begun = False
        self.messages: deque[Received] = deque(maxlen=MAX_BACKLOG)

    def add(self, received: Received) -> tuple[Estimate, int] | None:
        """Keep a message. Returns the pose at the newest wheel sample and its stamp in the sender's clock [ns], where one is due."""
        self.messages.append(received)
        newest = None
        for event in self._stream.events(received):
            if isinstance(event, CgSample):
                self._wheels.set_cg(event)
            if not isinstance(event, WheelSample):
                continue
            self._wheels.insert(event)
            if not self._has_begun:
                self._has_begun = True
                self._predictor.begin(event.stamp_ns)
            elif self._predictor.is_due(event.stamp_ns) and (estimate := self._predictor.predict(self._wheels)) is not None:
                self._predictor.reset(estimate, None, 0.0)
                newest = estimate, self._stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=False)
        return newest
