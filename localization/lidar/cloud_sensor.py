"""The 3D LiDAR as a sensor of the filter in space: clouds in, poses in the submap out, and the submap grows by key clouds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import Step
from localization.lidar.cloud_map import SYSTEMATIC_COV, CloudMap, thin
from localization.lidar.deskew import Sweep
from localization.lidar.key_scans import KeyScanError, key_scan_noise
from localization.lidar.kiss_icp import choose_voxel_size
from localization.lidar.lost_scans import LostScans
from localization.lidar.scan_matcher import MIN_POINTS, LidarConfig
from motion_models import se3
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Points2
from motion_models.se3 import Transform3

_MIN_POINTS_MAPPED = 50
"""Points with a surface in the submap, below which a cloud is lost. The first cloud of a standing robot has surfaces for a sixth of it."""


@dataclass(frozen=True, eq=False)
class CloudPose:
    """The pose that a cloud measures."""

    measured: Transform3
    """(4, 4) ``odom_T_body``."""
    cov: FloatArray
    """(6, 6) of the right perturbation of ``measured``."""
    first: KeyScanError | None
    """Error of the first cloud in the submap, which errs as this one does; None but for the first match."""


class CloudMatchingSensor:
    """For each step with a cloud: `measure`, then `insert_key_cloud`. Poses are ``odom_T_body`` (4, 4)."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config = mounts, config
        self._map: CloudMap | None = None
        self._odom_T_map = np.eye(4)
        self._cov: FloatArray | None = None  # (6, 6) of the last match; None before the first one
        self._last_key: Transform3 | None = None
        self.lost = LostScans()
        """Clouds that could not be matched."""
        self.cloud: FloatArray | None = None
        """(N, 3) the cloud at hand, deskewed and thinned, in the body frame [m]; None where there is none."""
        self.position = np.zeros(3)
        """(3,) of the last cloud's LiDAR in the body frame [m]."""

    def measure(self, step: Step, gyro_bias: FloatArray, prior: Transform3, cov: FloatArray) -> CloudPose | None:
        """Match the cloud of ``step`` near ``prior``, whose error against the submap has ``cov`` (6, 6).

        None where it is lost, or the first. The sweep is deskewed by the wheels' velocity and the turns of a gyro with ``gyro_bias`` (3,)
        [rad/s].
        """
        self.cloud = None
        found, cause = self._measure(step, gyro_bias, prior, cov)
        self.lost.add(step.end_ns, cause)
        return found

    def _measure(self, step: Step, gyro_bias: FloatArray, prior: Transform3, cov: FloatArray) -> tuple[CloudPose | None, str]:
        """The pose, and why the cloud is lost; "" where it is not, also of the first cloud."""
        assert step.scan is not None
        c, mount = self._config, self._mounts.get(step.scan.frame_id, Mount())
        self.position = np.array([mount.x, mount.y, mount.z])
        sweep = Sweep.from_scan(step.scan, mount, c.min_range_m, c.max_range_m)
        if len(sweep.points) < MIN_POINTS:
            return None, "sparse"
        velocity = np.array([step.twist[0], step.twist[1], 0.0])
        points = sweep.deskew_in_space(velocity, _turns(step, sweep.times, gyro_bias))
        if self._map is None:
            self._map = CloudMap(c.voxel_size_m or choose_voxel_size(points), c.range_noise_m)
            self.cloud = thin(points, self._map.cell)
            return None, ""
        self.cloud = thin(points, self._map.cell)
        match = self._map.match(self.cloud, se3.inverse(self._odom_T_map) @ prior, cov)
        if match.mapped < _MIN_POINTS_MAPPED or match.overlap < c.lost_below:
            return None, "lost"
        before, self._cov = self._cov, match.cov + SYSTEMATIC_COV
        first = KeyScanError(0.0, key_scan_noise(self._cov, 1.0)) if before is None else None
        return CloudPose(self._odom_T_map @ match.measured, self._cov, first), ""

    def add_no_cloud(self, stamp_ns: int, *, is_excluded: bool) -> None:
        """A step without a cloud: the LiDAR may be silent, or a check left the cloud out."""
        self.lost.add(stamp_ns, "excluded") if is_excluded else self.lost.add_no_scan(stamp_ns)

    def insert_key_cloud(self, pose: Transform3) -> KeyScanError | None:
        """Draw the cloud at hand from ``pose``, if it is a key cloud; how its error enters that of the submap. No cloud is at hand then."""
        cloud, self.cloud = self.cloud, None
        if cloud is None or self._map is None:
            return None
        if self._last_key is not None:
            moved = se3.log(se3.inverse(self._last_key) @ pose)
            if math.hypot(*moved[:3]) < self._config.key_distance_m and math.hypot(*moved[3:]) < self._config.key_angle_rad:
                return None
        self._last_key = pose
        share, new = self._map.insert(se3.inverse(self._odom_T_map) @ pose, cloud)
        return KeyScanError(share, np.zeros((6, 6)) if self._cov is None else key_scan_noise(self._cov, new))

    def move_map(self, pose: Transform3, error: FloatArray) -> None:
        """Move the submap by its estimated ``error`` (6,), a right perturbation of ``pose``."""
        self._odom_T_map = pose @ se3.exp(error) @ se3.inverse(pose) @ self._odom_T_map

    def map_points(self) -> Points2:
        """(M, 2) points of the submap projected to the plane [m]."""
        return np.empty((0, 2)) if self._map is None else se3.transform(self._odom_T_map, self._map.points())[:, :2]


def _turns(step: Step, times: FloatArray, gyro_bias: FloatArray) -> FloatArray:
    """(N, 3) turns of the body from the end of ``step``, the middle of the sweep, to ``times`` (N,) after it [rad]: by the gyro, else by
    the wheels."""
    is_left_out = step.turn is None and step.duration > 0.0  # by a sensor check
    if step.body_turn is None or is_left_out:
        return np.outer(times, [0.0, 0.0, step.twist[2]])
    known, *turned = step.body_turn.sweep.T
    return np.column_stack([np.interp(times, known, angles) for angles in turned]) - np.outer(times, gyro_bias)
