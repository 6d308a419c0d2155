"""Logs of robots whose LiDAR is not where its transform has it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from tests.helpers.bags import write_mcap
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, drive, records_of


def rear_lidar_described_at_the_front(folder: Path) -> tuple[Path, Vehicle, Motion]:
    """It faces backwards from .3 m behind the middle, and /tf_static has it facing ahead from .3 m ahead."""
    vehicle = Vehicle(0.11, 0.4, 0.3, 0.55, scan_hz=8.0, beams=180, seed=78)
    motion, rear = drive(vehicle), Publishing(lidar_yaw=math.pi, lidar_ahead_m=-0.3)
    described = records_of(vehicle, motion, replace(rear, lidar_ahead_m=0.3))
    records = [record for record in records_of(vehicle, motion, rear) if record[0] != "/tf_static"]
    path = write_mcap(folder / "log.mcap", [*(record for record in described if record[0] == "/tf_static"), *records])
    return path, vehicle, motion
