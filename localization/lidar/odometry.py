"""KISS-ICP alone, in the plane."""

from __future__ import annotations

from localization.lidar.kiss import Kiss
from localization.lidar.matcher import LidarConfig, in_range, pose_of_matrix, voxel_size
from motion_models.se2 import FloatArray

_FEW_POINTS = 10


class LidarOdometry:
    """KISS-ICP as it comes: its own constant-velocity guess, its own adaptive threshold, its own map."""

    def __init__(self, config: LidarConfig | None = None) -> None:
        self.config = config or LidarConfig()
        self._kiss: Kiss | None = None

    def register(self, points: FloatArray) -> FloatArray:
        """Pose (3,) ``world_T_body`` of ``points`` (N, 3) of the body frame. An empty cloud leaves it to the constant velocity."""
        points = in_range(points, self.config)
        if self._kiss is None:
            voxel = self.config.voxel_size_m or (voxel_size(points) if len(points) >= _FEW_POINTS else 0.5)
            self._kiss = Kiss(voxel, 0.0, self.config.max_range_m)
        return pose_of_matrix(self._kiss.register_frame(points))

    def point_cloud(self) -> FloatArray:
        """(M, 2) the map."""
        assert self._kiss is not None
        return self._kiss.point_cloud()[:, :2]
