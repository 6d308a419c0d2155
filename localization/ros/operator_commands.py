"""Commands of an operator to a running node: a pose on /initialpose or /set_pose; the services reset, pause and tare_payload."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from localization.logs.decode import UnusableError, frame_name
from localization.logs.serialization import decoder
from localization.logs.writer import odom_axes
from localization.ros.start_pose import StartPose
from localization.ros.topic_names import Names
from localization.ros.transports.base import Received, ServiceReply, Transport
from motion_models.se2 import FloatArray

SET_POSE, INITIAL_POSE = "set_pose", "initialpose"
"""As of robot_localization, and as of RViz and nav2."""
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
RESET, PAUSE, TARE_PAYLOAD = "~/reset", "~/pause", "~/tare_payload"
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
_MIN_SIGMA = 1e-3
"""Sigmas of a pose without a covariance: RViz sends one, `ros2 topic pub` mostly zeros [m, rad]."""


class CommandedNode(Protocol):
    """What commands need of a `Node`."""

    is_paused: bool

    @property
    def frames(self) -> Any: ...

    @property
    def session(self) -> Any: ...

    def restart(self, start: StartPose) -> None: ...


class OperatorCommands:
    """Subscribes to the topics and offers the services."""

    def __init__(self, node: CommandedNode, transport: Transport, names: Names, report: Callable[[str], None]) -> None:
        self._node, self._report = node, report
        self._decode = decoder(POSE_TYPE, is_ros1=transport.is_ros1)
        self.topics = [names.resolve(SET_POSE), names.resolve(INITIAL_POSE)]
        for topic in self.topics:
            transport.subscribe(topic, POSE_TYPE, is_latched=False)
        transport.offer_service(names.resolve(RESET), "std_srvs/srv/Empty", self.reset)
        transport.offer_service(names.resolve(PAUSE), "std_srvs/srv/SetBool", self.pause)
        transport.offer_service(names.resolve(TARE_PAYLOAD), "std_srvs/srv/Trigger", self.tare_payload)

    def execute(self, received: Received) -> bool:
        """Set the pose that ``received`` holds; False where it is of another topic."""
        if received.topic not in self.topics:
            return False
        try:
            message = self._decode(received.data)
            pose, cov = _planar(message.pose)
        except (UnusableError, ValueError) as error:
            self._report(f"{received.topic}: the pose is ignored, for {error}.")
            return True
        reply = self.set_pose(pose, cov, frame_name(message.header.frame_id))
        self._report(f"{received.topic}: {reply.message}")
        return True

    def set_pose(self, pose: FloatArray, cov: FloatArray, frame: str) -> ServiceReply:
        """Begin anew at ``pose`` (3,) in ``frame``, with covariance ``cov`` (3, 3) of its right perturbation.

        A pose in `map` leaves `odom` as it is, without a jump (REP-105); one in `odom` moves that.
        """
        frames, (odom, odom_cov) = self._node.frames, self._present_odometry()
        has_map = self._node.session.pipeline.is_localizing
        if frame == frames.map_frame and has_map:
            start = StartPose(odom, odom_cov, pose, cov)
        elif frame == frames.odom_frame:
            start = StartPose(pose, cov, pose, cov)
        else:
            known = [frames.map_frame, frames.odom_frame] if has_map else [frames.odom_frame]
            return ServiceReply(False, f"the pose is ignored: its frame is '{frame}', and this estimator has {' and '.join(known)}.")
        self._node.restart(start)
        return ServiceReply(True, f"begins anew at x {pose[0]:.3f} m, y {pose[1]:.3f} m, yaw {math.degrees(pose[2]):.1f} deg in '{frame}'.")

    def reset(self, _: bool = True) -> ServiceReply:
        """Begin anew at the origin, with a new map and nothing learned (as ~/reset of robot_localization)."""
        self._node.restart(StartPose())
        self._report("reset: begins anew at the origin.")
        return ServiceReply(True, "begins anew at the origin")

    def pause(self, is_paused: bool) -> ServiceReply:
        """Use no messages and publish no estimates, or continue. Motion meanwhile is a gap in the wheels' data."""
        self._node.is_paused = is_paused
        text = "paused" if is_paused else "continued"
        self._report(f"pause: {text}.")
        return ServiceReply(True, text)

    def tare_payload(self, _: bool = True) -> ServiceReply:
        """Discard what was learned of the motion model, which holds for another payload; the pose and its covariance stay."""
        (odom, odom_cov), estimate = self._present_odometry(), self._node.session.health.estimate
        in_map = (odom, odom_cov) if estimate is None else (estimate.pose, _known(estimate.covariance))
        self._node.restart(StartPose(odom, odom_cov, *in_map))
        self._report("tare_payload: the motion model is learned anew from here on.")
        return ServiceReply(True, "the motion model is learned anew from the present pose on")

    def _present_odometry(self) -> tuple[FloatArray, FloatArray]:
        estimate = self._node.session.health.estimate
        if estimate is None:
            start = self._node.session.state.start
            return start.odom_T_start, start.odom_cov
        pose, cov = estimate.odometry or (estimate.pose, estimate.covariance)
        return pose, _known(cov)


def _known(cov: FloatArray | None) -> FloatArray:
    return np.zeros((3, 3)) if cov is None else cov


def _planar(stamped: Any) -> tuple[FloatArray, FloatArray]:
    """Pose (3,) and covariance (3, 3) of its right perturbation, of a PoseWithCovariance. Raises `ValueError`."""
    p, q = stamped.pose.position, stamped.pose.orientation
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not (math.isfinite(norm) and 0.5 < norm < 2.0):
        raise ValueError("its orientation is no unit quaternion")
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm**2 - 2.0 * (q.y**2 + q.z**2))
    pose = np.array([p.x, p.y, yaw])
    in_parent = np.asarray(stamped.covariance, dtype=float).reshape(6, 6)[_PLANAR]
    if not (np.isfinite(pose).all() and np.isfinite(in_parent).all()):
        raise ValueError("it holds numbers that are not finite")
    in_parent = (in_parent + in_parent.T) / 2 + _MIN_SIGMA**2 * np.eye(3)
    if np.linalg.eigvalsh(in_parent)[0] < 0.0:
        raise ValueError("its covariance has negative eigenvalues")
    return pose, odom_axes(in_parent, -yaw)  # the inverse turn: from the axes of the parent to those of the body
