"""A drive over hills as a log: wheels, IMU, clouds and static transforms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localization.events import ImuSample, Scan, WheelSample
from motion_models.robot import Mount
from tests.helpers import bags
from tests.helpers.hill_scans import MOUNT
from tests.helpers.hills import HillDrive
from tests.helpers.in_space import in_order

_CLOUD = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")]


def write(path: Path, drive: HillDrive, clouds: Sequence[Scan]) -> Path:
    """The log of ``drive`` with ``clouds`` as an .mcap file."""
    start = int(drive.stamps_ns[0])
    mounts: dict[str, Mount] = {"imu_link": drive.mounts["imu_link"], "lidar_link": MOUNT}
    edges = [("base_link", name, (m.x, m.y, m.z), bags.quaternion()) for name, m in mounts.items()]
    records = [("/tf_static", bags.tf(start, edges), start)]
    for event in in_order(drive, list(clouds)):
        stamp = event.stamp_ns
        if isinstance(event, WheelSample):
            both = [np.tile(values, 2) for values in (event.position, event.velocity)]
            records.append(("/joint_states", bags.joint_state(stamp, bags.WHEELS, *both), stamp))
        elif isinstance(event, ImuSample):
            records.append(("/imu/data", bags.imu(stamp, event.angular_velocity, event.linear_acceleration, event.frame_id), stamp))
        elif isinstance(event, Scan):
            table = np.empty(len(event.points), _CLOUD)
            for axis, values in zip("xyz", event.points.T, strict=True):
                table[axis] = values
            table["t"] = np.rint(1e9 * event.offsets)
            order = np.argsort(table["t"], kind="stable")
            records.append(("/points", bags.cloud(stamp, table[order], event.frame_id), stamp + 100_000_000))
    return bags.write_mcap(path, records)
