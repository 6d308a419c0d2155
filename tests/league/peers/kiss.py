"""KISS-ICP by its own pipeline and defaults: its constant velocity predicts."""

from __future__ import annotations

import numpy as np
from exchange import Drive, FloatArray, planar, run, setting
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP


def register(drive: Drive, predictions: FloatArray | None = None) -> FloatArray:
    """(N, 3) poses of the LiDAR; motions ``predictions`` (N, 4, 4) replace the pipeline's constant velocity."""
    config = load_config(None)
    config.data.deskew, config.data.min_range, config.data.max_range = False, 0.0, drive.max_range_m
    config.mapping.voxel_size = setting("voxel", drive.max_range_m / 100.0)  # what its command line takes
    config.adaptive_threshold.initial_threshold = setting("threshold", config.adaptive_threshold.initial_threshold)
    config.data.max_range = min(setting("range", drive.max_range_m), drive.max_range_m)
    kiss = KissICP(config)
    poses = []
    for index, points in enumerate(drive.scans()):
        if predictions is not None:
            kiss.last_delta = predictions[index]
        kiss.register_frame(points, np.empty(0))
        poses.append(kiss.last_pose)
    return planar(np.array(poses))


if __name__ == "__main__":
    run(register)
