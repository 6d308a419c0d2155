"""GenZ-ICP by its own pipeline and defaults; its interface takes no initial guess."""

from __future__ import annotations

import numpy as np
from exchange import Drive, FloatArray, planar, run
from genz_icp.config import load_config
from genz_icp.genz_icp import GenZICP


def register(drive: Drive) -> FloatArray:
    """(N, 3) poses of the LiDAR."""
    config = load_config(None)
    config.data.deskew, config.data.min_range, config.data.max_range = False, 0.0, drive.max_range_m
    genz = GenZICP(config)
    poses = []
    for points in drive.scans():
        genz.register_frame(points, None)
        poses.append(genz.last_pose.copy())
    return planar(np.array(poses))


if __name__ == "__main__":
    run(register)
