"""The choice between poses in the plane and poses in space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.core.space import SpaceConfig
from localization.estimate import Estimate
from localization.estimators.estimator import Estimator
from localization.estimators.space_fusion import SpaceFusion
from localization.estimators.space_graph_fusion import SpaceGraphFusion, SpaceGraphSettings
from localization.inputs.attitude import AttitudeFilter
from localization.lidar import LidarConfig
from localization.lifting import Lifting
from localization.space_pose import Pose3
from motion_models.robot import GyroNoise, Mount


class SpaceChoice:
    """Poses of an estimator in the plane, until the IMU shows that the ground tilts: from there on they are in space.

    Without a 3D LiDAR they stay in the plane, whatever the ground does: planar scans are not matched in space.
    """

    def __init__(
        self,
        gyro: GyroNoise,
        mounts: Mapping[str, Mount],
        lidar: LidarConfig,
        config: SpaceConfig,
        graph: SpaceGraphSettings | None = None,
    ) -> None:
        """Arguments are those of `SpaceFusion`; ``graph`` are settings of a `SpaceGraphFusion`, None without one."""
        self._of_space, self._lifting, self._graph = (gyro, mounts, lidar, config), Lifting(), graph
        self._map_T_odom = np.zeros(3)
        self._pose: Pose3 | None = None
        self.has_clouds = False
        """A 3D LiDAR has measured: from the first cloud on there is a choice."""
        self.left_ns: int | None = None
        """Stamp of the last estimate in the plane; None while it is not left."""

    def choose(self, estimator: Estimator, attitude: AttitudeFilter | None, start_ns: int) -> Estimator:
        """``estimator``, or from now on, where the ground has been found to tilt, one in space."""
        if self._pose is None or self.left_ns is not None or attitude is None or not attitude.is_tilting:
            return estimator
        self.left_ns = start_ns
        return self._with_graph(SpaceFusion.continuing(estimator, self._pose, *self._of_space))

    def begin(self) -> Estimator:
        """An estimator in space, at the origin."""
        return self._with_graph(SpaceFusion(*self._of_space))

    def _with_graph(self, in_space: SpaceFusion) -> Estimator:
        return in_space if self._graph is None else SpaceGraphFusion(in_space, self._graph, self._map_T_odom)

    def add(self, estimate: Estimate, attitude: AttitudeFilter | None) -> None:
        """Lift the ``estimate`` of the estimator in the plane."""
        pose, covariance = estimate.odometry or (estimate.pose, estimate.covariance)
        if self.left_ns is not None or attitude is None or covariance is None:
            return
        lifted = self._lifting.add(pose, covariance, attitude.ground_up, attitude.tilt_variances)
        self._pose = replace(lifted, position=np.array([pose[0], pose[1], lifted.position[2]]))
        if estimate.map_T_odom is not None:
            self._map_T_odom = estimate.map_T_odom
