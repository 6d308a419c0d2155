"""Estimates as messages, and where ROS's conventions differ from this library's:

- nav_msgs/Odometry, `odom` -> `base_link`, or `map` -> `base_link` of estimators that localize; the twist is the body's, with the true vy.
- The covariance of a pose is, here, that of a perturbation in the body's axes; ROS defines it as that of x, y in the axes of `odom`
  (REP-103, nav_msgs/Odometry). The block of x, y, yaw is therefore turned by the heading. The covariance of a twist stays in
  the body's axes, in both.
- What planar motion does not estimate (z, roll, pitch and their rates) is zero with a variance of `UNKNOWN_VARIANCE`, and so is
  every variance of an estimate without covariance: robot_localization and similar filters then give it no weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from rosbags.typesys.stores.ros2_humble import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Point as Point
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Pose as Pose
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__PoseWithCovariance as PoseWithCovariance
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Quaternion as Quaternion
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Transform as Transform
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__TransformStamped as TransformStamped
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Twist as Twist
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__TwistWithCovariance as TwistWithCovariance
from rosbags.typesys.stores.ros2_humble import geometry_msgs__msg__Vector3 as Vector3
from rosbags.typesys.stores.ros2_humble import nav_msgs__msg__Odometry as Odometry
from rosbags.typesys.stores.ros2_humble import std_msgs__msg__Header as Header
from rosbags.typesys.stores.ros2_humble import tf2_msgs__msg__TFMessage as TFMessage

from localization.space_pose import Pose3, quaternion
from motion_models import se2
from motion_models.se2 import FloatArray

UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated [m^2, rad^2, and per s^2]: ROS drivers' convention for values without information."""

PARENT_FRAME = "odom"
MAP_FRAME = "map"
BODY_FRAME = "base_link"

_UNKNOWN = np.diag(np.full(6, UNKNOWN_VARIANCE)).ravel()
_PLANAR = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]  # x, y, yaw among x, y, z, roll, pitch, yaw


@dataclass(frozen=True)
class FusedEstimate:
    """Pose and twist of one estimator at one moment."""

    stamp_ns: int
    pose: FloatArray
    """(3,) x, y, theta of the body in the world [m, m, rad]."""
    twist: FloatArray
    """(3,) vx, vy, wz of the body in its own axes [m/s, m/s, rad/s]."""
    covariance: FloatArray | None = None
    """(3, 3) of the pose's right (body-frame) perturbation, or None where it is unknown."""
    twist_covariance: FloatArray | None = None
    """(3, 3) of the twist, or None where it is unknown."""
    parent: str = PARENT_FRAME
    """Frame that the pose is in."""
    in_space: Pose3 | None = None
    """The pose in space, of which ``pose`` is the one seen from above: it is written with its (6, 6) covariance."""

    def place(self) -> tuple[FloatArray, FloatArray]:
        """Position (3,) [m] and quaternion x, y, z, w (4,); on the plane where there is no pose in space."""
        if self.in_space is not None:
            return self.in_space.position, np.array(quaternion(self.in_space.rotation))
        x, y, theta = self.pose.tolist()
        return np.array([x, y, 0.0]), np.array([0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)])

    def pose_covariance(self) -> FloatArray:
        """(36,) row-major covariance of x, y, z, roll, pitch, yaw in the parent's axes."""
        if self.in_space is not None:
            return self.in_space.covariance.ravel()
        return six_by_six(None if self.covariance is None else odom_axes(self.covariance, float(self.pose[2])))


def odometry_message(estimate: FusedEstimate) -> Odometry:
    """nav_msgs/Odometry."""
    (x, y, z), turn = estimate.place()
    vx, vy, wz = (float(v) for v in estimate.twist)
    return Odometry(
        header=_header(estimate),
        child_frame_id=BODY_FRAME,
        pose=PoseWithCovariance(
            pose=Pose(position=Point(x=float(x), y=float(y), z=float(z)), orientation=_quaternion(turn)),
            covariance=estimate.pose_covariance(),
        ),
        twist=TwistWithCovariance(
            twist=Twist(linear=Vector3(x=vx, y=vy, z=0.0), angular=Vector3(x=0.0, y=0.0, z=wz)),
            covariance=six_by_six(estimate.twist_covariance),
        ),
    )


def transform_message(estimate: FusedEstimate) -> TFMessage:
    """tf2_msgs/TFMessage, from the frame of the pose to `base_link`."""
    (x, y, z), turn = estimate.place()
    transform = Transform(translation=Vector3(x=float(x), y=float(y), z=float(z)), rotation=_quaternion(turn))
    return TFMessage(transforms=[TransformStamped(header=_header(estimate), child_frame_id=BODY_FRAME, transform=transform)])


def odom_axes(covariance: FloatArray, theta: float) -> FloatArray:
    """(3, 3) covariance of x, y, yaw in the parent's axes, from that of the body-frame perturbation at heading ``theta`` [rad].

    To first order, compose(pose, exp(e)) moves x, y by R(theta) e_xy and the yaw by e_theta.
    """
    turned = se2.rotate_covariance(covariance, theta)
    return (turned + turned.T) / 2


def six_by_six(planar: FloatArray | None) -> FloatArray:
    """(36,) row-major covariance of x, y, z, roll, pitch, yaw, from the (3, 3) of x, y, yaw."""
    full = _UNKNOWN.copy()
    if planar is not None:
        full[_PLANAR] = planar.ravel()
    return full


def _header(estimate: FusedEstimate) -> Header:
    stamp_ns = estimate.stamp_ns
    return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=estimate.parent)


def _quaternion(turn: FloatArray) -> Quaternion:
    x, y, z, w = map(float, turn)
    return Quaternion(x=x, y=y, z=z, w=w)
