"""The end of a drive in space: keyframes smoothed by the graph, the path through them, its projection to the plane, and the map."""

from __future__ import annotations

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.pose_graph import GraphUpdate, PoseGraph
from localization.estimators.recorded_path import RecordedPath
from localization.lidar.cloud_loops import find_loops
from localization.lifting import SpaceTable, Trajectory3
from localization.maps import KeyframeMap
from localization.maps.keyframe_map import MappedKeyframe, MeasuredMotion, make_map
from localization.messages import Message, message
from localization.space_pose import Pose3
from localization.trajectory import IntArray, Trajectory
from motion_models import se3
from motion_models.groups import SE3
from motion_models.se2 import FloatArray, Pose2


class SpaceSmoothing:
    """What smoothing takes, `add_keyframe` and ``path`` by step, and what it has found. Memory grows with the drive."""

    def __init__(self, range_noise_m: float, has_loops: bool) -> None:
        """``range_noise_m``: sigma of a range [m]. With ``has_loops``, clouds of a place that was visited again tie its keyframes."""
        self.path = RecordedPath(SE3)
        self._range_noise_m, self._has_loops = range_noise_m, has_loops
        self._clouds: list[FloatArray] = []  # in the body frame
        self._sensors: list[FloatArray] = []
        self.trajectory: Trajectory3 | None = None
        """Poses in space by all measurements, once smoothed."""
        self.map: KeyframeMap | None = None
        """Keyframes as they can be saved, once smoothed."""
        self.failure: Message | None = None
        """Why the trajectory could not be smoothed."""

    def add_keyframe(self, cloud: FloatArray | None, sensor: FloatArray) -> None:
        """The newest element of the path is a keyframe with ``cloud`` (N, 3), measured from ``sensor`` (3,), in the body frame [m]."""
        self.path.add_node()
        self._clouds.append(np.empty((0, 3), np.float32) if cloud is None else cloud.astype(np.float32))
        self._sensors.append(sensor)

    def finish(self, graph: PoseGraph, map_T_odom: Pose2, filtered: Trajectory) -> Trajectory | None:
        """The trajectory that ``graph`` smooths, in the map, projected to the plane at the stamps of ``filtered``; None where it fails, or
        with one keyframe."""
        stamps = self.path.stamps_ns
        if len(self.path.nodes) < 2:
            return None
        try:
            keyframes = graph.smooth()
            if self._has_loops:
                found = find_loops(self._clouds, keyframes.poses, keyframes.relative_cov, self._range_noise_m)
                closed = [MeasuredMotion.by_cov(loop.a, loop.b, loop.delta, loop.cov, is_loop=True) for loop in found]
                graph.apply(GraphUpdate(motions=tuple(closed)))
            if graph.loops:
                keyframes = graph.smooth()
        except EstimatorError as error:
            self.failure = message("smoothing.failed", reason=str(error))
            return None
        to_map = se3.lift(map_T_odom)
        mapped = zip(stamps[self.path.nodes].tolist(), to_map @ keyframes.poses, self._clouds, self._sensors, keyframes.covs, strict=True)
        self.map = make_map([MappedKeyframe(*key) for key in mapped], graph.motions)
        smoothed, covs = self.path.through(keyframes.poses, keyframes.covs)
        return self._project(filtered, stamps, to_map @ smoothed, covs)

    def _project(self, filtered: Trajectory, stamps_ns: IntArray, poses: FloatArray, covs: FloatArray) -> Trajectory:
        """``filtered`` with ``poses`` (N, 4, 4) and their ``covs`` (N, 6, 6) at ``stamps_ns`` (N,), seen from above."""
        table, planar = SpaceTable(), filtered.poses.copy()
        planar_covs = None if filtered.covariances is None else filtered.covariances.copy()
        rows = np.searchsorted(filtered.stamps_ns, stamps_ns)
        for stamp, row, pose, cov in zip(stamps_ns.tolist(), rows.tolist(), poses, covs, strict=True):
            world = np.kron(np.eye(2), pose[:3, :3])
            in_space = Pose3(pose[:3, 3], pose[:3, :3], world @ cov @ world.T)
            table.add(stamp, in_space)
            planar[row], above = in_space.from_above()
            if planar_covs is not None:
                planar_covs[row] = above
        self.trajectory = table.trajectory()
        return Trajectory(filtered.stamps_ns, planar, planar_covs)
