"""What is published: where the robot is, what was learned of it, and how well it goes."""

from __future__ import annotations

import dataclasses
import itertools
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localization.errors import SettingError
from localization.estimators import Estimate
from localization.logs.fast_cdr import FusedWriter
from localization.logs.fused_log import FusedEstimate
from localization.logs.serialization import encode, make
from localization.ros.diagnostics import Status
from localization.ros.topic_names import Names
from localization.ros.transports.base import Transport
from localization.settings import Settings

ODOMETRY, CORRECTIONS, TF, DIAGNOSTICS = "~/odometry", "~/corrections", "/tf", "/diagnostics"

_RECENT = 500  # 10 s at 50 Hz: those of a start's backlog come back only after all of them
_TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    CORRECTIONS: "sensor_msgs/msg/JointState",
    TF: "tf2_msgs/msg/TFMessage",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}


@dataclass(frozen=True)
class Frames(Settings):
    """Frames of what is published (REP-105)."""

    map_frame: str = "map"
    """Frame of a graph's localization, parent of `odom_frame`; other estimators have none."""
    odom_frame: str = "odom"
    """Parent frame of the published odometry and transform, without jumps."""
    base_link_frame: str = "base_link"
    """Frame of the robot's body, child of `odom_frame`; the point about which the robot file's geometry is given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name, frame in frames.items():
            if not frame or frame.startswith("/") or frame != frame.strip():
                raise SettingError(f"setting {name} is '{frame}'; it must not be empty, begin with '/', or have blanks around it.")
        for (name, frame), (other, same) in itertools.combinations(frames.items(), 2):
            if frame == same:
                raise SettingError(f"{name} and {other} are both '{frame}'; they must be two frames.")


class Teller:
    """Publishes on a transport. Odometry and TF with every estimate; corrections and diagnostics when asked."""

    def __init__(self, transport: Transport, names: Names, frames: Frames, *, with_tf: bool) -> None:
        self._transport, self._with_tf, self._frames = transport, with_tf, frames
        self._fused = FusedWriter(is_ros1=transport.is_ros1, parent=frames.odom_frame, body=frames.base_link_frame)
        self._correction = FusedWriter(is_ros1=transport.is_ros1, parent=frames.map_frame, body=frames.odom_frame)
        self.recent_transforms: deque[bytes] = deque(maxlen=_RECENT)
        """Those of the body, as they were published."""
        self._topics = {topic: names.resolve(topic) for topic in _TYPES}
        for topic in _TYPES:
            if topic != TF or with_tf:
                self._advertise(topic)

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transform from now on, or no more."""
        if is_on and not self._with_tf and not self.recent_transforms:
            self._advertise(TF)
        self._with_tf = is_on

    def estimate(self, estimate: Estimate, stamp_ns: int) -> None:
        """nav_msgs/Odometry with true vy, and the transforms `odom` -> `base_link` and, of a graph, `map` -> `odom`, at ``stamp_ns``."""
        pose, covariance = estimate.odometry or (estimate.pose, estimate.covariance)
        fused = FusedEstimate(stamp_ns, pose, estimate.twist, covariance, estimate.twist_covariance)
        self._transport.publish(self._topics[ODOMETRY], self._fused.odometry(fused))
        if self._with_tf:
            self.recent_transforms.append(self._fused.transform(fused))
            self._transport.publish(self._topics[TF], self.recent_transforms[-1])
            if estimate.map_T_odom is not None:
                correction = FusedEstimate(stamp_ns, estimate.map_T_odom, np.zeros(3))
                self._transport.publish(self._topics[TF], self._correction.transform(correction))

    def corrections(self, parameters: Mapping[str, tuple[float, float]], stamp_ns: int) -> None:
        """Named numbers as sensor_msgs/JointState: ``position`` is the mean, ``effort`` its sigma."""
        means, sigmas = (np.array([value[i] for value in parameters.values()], dtype=float) for i in (0, 1))
        message = make(
            _TYPES[CORRECTIONS], header=self._header(stamp_ns), name=list(parameters), position=means, velocity=np.zeros(0), effort=sigmas
        )
        self._publish(CORRECTIONS, message)

    def diagnostics(self, statuses: Sequence[Status], hardware: str, stamp_ns: int) -> None:
        """diagnostic_msgs/DiagnosticArray, one status for each of ``statuses``."""
        entries = [
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=status.level,
                name=f"skidloc: {status.name}",
                message=status.message,
                hardware_id=hardware,
                values=[make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in status.values.items()],
            )
            for status in statuses
        ]
        self._publish(DIAGNOSTICS, make(_TYPES[DIAGNOSTICS], header=self._header(stamp_ns), status=entries))

    def _advertise(self, topic: str) -> None:
        self._transport.advertise(self._topics[topic], _TYPES[topic])

    def _publish(self, topic: str, message: object) -> None:
        self._transport.publish(self._topics[topic], encode(message, is_ros1=self._transport.is_ros1))

    def _header(self, stamp_ns: int) -> object:
        time = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return make("std_msgs/msg/Header", stamp=time, frame_id=self._frames.odom_frame)
