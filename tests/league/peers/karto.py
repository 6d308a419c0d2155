"""Karto's scan matcher and graph by yag_slam, which slam_toolbox has as well: defaults, and scans as often as slam_toolbox takes them."""

from __future__ import annotations

import numpy as np
from exchange import Drive, FloatArray, matrix, planar, run
from yag_slam.graph_slam import GraphSlam
from yag_slam.helpers import default_config, default_config_loop
from yag_slam.models import LocalizedRangeScan
from yag_slam.scan_matching import Scan2DMatcherCpp

_MIN_DISTANCE_M, _MIN_TURN_RAD = 0.5, 0.5
"""slam_toolbox's `minimum_travel_distance` and `minimum_travel_heading`."""


def register(drive: Drive) -> FloatArray:
    """(N, 3) poses of the LiDAR: those of the final graph, and wheel odometry in between."""
    slam = GraphSlam(Scan2DMatcherCpp(default_config), Scan2DMatcherCpp(default_config_loop, loop=True))
    keys: list[tuple[int, LocalizedRangeScan]] = []
    for index, (points, odometry) in enumerate(zip(drive.scans(), drive.odometry, strict=True)):
        if keys and not _has_moved(drive.odometry[keys[-1][0]], odometry):
            continue
        scan = _scan(drive, points, odometry)
        slam.process_scan(scan)
        keys.append((index, scan))
    at = np.searchsorted([index for index, _ in keys], np.arange(len(drive.odometry)), side="right") - 1
    corrected = [scan.corrected_pose for _, scan in keys]
    key_poses = matrix(np.array([[pose.x, pose.y, pose.euler[-1]] for pose in corrected]))[at]
    moved = np.linalg.inv(matrix(drive.odometry[[index for index, _ in keys]])[at]) @ matrix(drive.odometry)
    return planar(key_poses @ moved)


def _has_moved(before: FloatArray, after: FloatArray) -> bool:
    turn = abs((after[2] - before[2] + np.pi) % (2 * np.pi) - np.pi)
    return bool(np.hypot(*(after - before)[:2]) > _MIN_DISTANCE_M or turn > _MIN_TURN_RAD)


def _scan(drive: Drive, points: FloatArray, odometry: FloatArray) -> LocalizedRangeScan:
    first, step, count = drive.beams
    ranges = drive.ranges(points, np.nan)
    last = first + step * (count - 1)
    return LocalizedRangeScan(ranges, first, last, step, 0.0, drive.max_range_m, default_config["range_threshold"], *odometry)


if __name__ == "__main__":
    run(register)
