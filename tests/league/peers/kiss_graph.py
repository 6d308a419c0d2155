"""KISS-SLAM by its own defaults: KISS-ICP with local maps, closures by map-closures and a pose graph. Final poses."""

from __future__ import annotations

import numpy as np
from exchange import Drive, FloatArray, planar, run
from kiss_slam.config import load_config
from kiss_slam.slam import KissSLAM


def register(drive: Drive) -> FloatArray:
    """(N, 3) poses of the LiDAR."""
    config = load_config(None)
    config.odometry.preprocessing.deskew = False
    config.odometry.preprocessing.min_range, config.odometry.preprocessing.max_range = 0.0, drive.max_range_m
    slam = KissSLAM(config)
    for points in drive.scans():
        slam.process_scan(points, np.empty(0))
    slam.generate_new_node()
    slam.local_map_graph.erase_last_local_map()
    poses, _ = slam.fine_grained_optimization()
    return planar(np.array(poses))


if __name__ == "__main__":
    run(register)
