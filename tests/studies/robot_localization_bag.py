"""What robot_localization's own test of the Husky's bag expects, and where GPS is at its end.

`python -m tests.studies.robot_localization_bag`: end of the driver's speeds along the orientations of the IMU (magnetometer), of the
driver's odometry, and of GPS [m] from the start. The test (test_ekf_localization_node_bag1.test) fuses just these orientations, with the
IMU as it is mounted there, and expects x -40.0454, y -76.9988, z -2.6974 +- 1.0452: it shows that the filter has not changed, not where the
robot was (cra-ros-pkg/robot_localization, issue 763).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer

BAG = Path("tests/data/husky-outdoor-gps/test1.bag")
EXPECTED_M, TOLERANCE_M = np.array([-40.0454, -76.9988, -2.6974]), 1.0452
MOUNT = Rotation.from_euler("ZYX", [-math.pi / 2, 0.0, math.pi / 2])
"""base_link to imu_link, of the test's static_transform_publisher (yaw, pitch, roll)."""


def read() -> dict[str, np.ndarray]:
    """By topic: times and speeds with positions (n, 4); times and orientations (n, 5); times, latitudes and longitudes (n, 3)."""
    rows: dict[str, list[tuple[float, ...]]] = {"odom": [], "imu": [], "fix": []}
    source = open_source(BAG)
    deserialize = LogDeserializer(source.channels, is_ros1=source.is_ros1)
    for raw in source.messages([channel.topic for channel in source.channels]):
        m, t = deserialize(raw), raw.log_ns * 1e-9
        if raw.topic == "/imu/data":
            q = m.orientation
            rows["imu"].append((t, q.x, q.y, q.z, q.w))
        elif raw.topic == "/fix":
            rows["fix"].append((t, m.latitude, m.longitude))
        elif raw.topic.endswith("/odom"):
            p = m.pose.pose.position
            rows["odom"].append((t, m.twist.twist.linear.x, p.x, p.y))
    return {name: np.array(found) for name, found in rows.items()}


def end_by_orientations(odom: np.ndarray, imu: np.ndarray) -> np.ndarray:
    """(3,) end of the driver's speeds along the IMU's orientations [m], from the start."""
    ahead = (Rotation.from_quat(imu[:, 1:]) * MOUNT.inv()).apply([1.0, 0.0, 0.0])
    directions = np.column_stack([np.interp(odom[:-1, 0], imu[:, 0], axis) for axis in ahead.T])
    return np.asarray((directions * (odom[:-1, 1] * np.diff(odom[:, 0]))[:, None]).sum(axis=0))


def main() -> None:
    """Print the three ends."""
    rows = read()
    odom, imu, fix = rows["odom"], rows["imu"], rows["fix"]
    end = end_by_orientations(odom, imu)
    print(f"speeds along the IMU's orientations {end.round(2)} m, {np.linalg.norm(end):.1f} m from the start;", end=" ")
    print(f"{np.linalg.norm(end - EXPECTED_M):.2f} m from what the test expects (+- {TOLERANCE_M})")
    print(f"driver's odometry {np.linalg.norm(odom[-1, 2:] - odom[0, 2:]):.1f} m from the start")
    north, east = np.radians(fix[-1, 1:] - fix[0, 1:]) * 6.378e6 * np.array([1.0, math.cos(math.radians(fix[0, 1]))])
    print(f"GPS {math.hypot(north, east):.1f} m from the start")


if __name__ == "__main__":
    main()
