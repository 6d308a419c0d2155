"""small_gicp as in the scan-to-model odometry of its examples (voxels of 0.25 and 1 m), each registration started from wheel odometry."""

from __future__ import annotations

import numpy as np
import small_gicp
from exchange import Drive, FloatArray, planar, run, setting

_DOWNSAMPLING_M, _VOXEL_M = 0.25, 1.0


def register(drive: Drive) -> FloatArray:
    """(N, 3) poses of the LiDAR."""
    target, downsampling_m = small_gicp.GaussianVoxelMap(setting("voxel", _VOXEL_M)), setting("downsampling", _DOWNSAMPLING_M)
    if keys := int(setting("keys", 0)):
        target.set_lru(horizon=keys, clear_cycle=1)
    pose, poses = np.eye(4), []
    for points, prediction in zip(drive.scans(), drive.predictions(), strict=True):
        source, _ = small_gicp.preprocess_points(points, downsampling_m)
        pose = pose @ prediction
        if poses and source.size():
            pose = small_gicp.align(target, source, pose).T_target_source
        target.insert(source, pose)
        poses.append(pose)
    return planar(np.array(poses))


if __name__ == "__main__":
    run(register)
