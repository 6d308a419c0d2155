"""KISS-ICP (Vizzo et al., RA-L 2023) in the plane: as odometry of its own, and as registration from a prior.

Deskewing is ours (`lidar.deskew`), so timestamps never reach kiss-icp, whose deskewing aborts the process when they are all equal.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from motion_models import se3
from motion_models.se2 import FloatArray, Pose2

_NO_STAMPS = np.empty(0)
_INITIAL_THRESHOLD_M, _MIN_MOTION_M = 0.5, 0.01
"""Initial value and least motion of the adaptive threshold [m], as suits indoor robots (KISS-ICP's defaults, 2 and 0.1 m, are for cars)."""
_KISS_OF_RANGE, _MIN_VOXEL_M, _MAX_VOXEL_M = 0.05, 0.1, 1.0
"""Voxel of the map as a share of the first scan's median range, at least and at most [m]. Its default, a hundredth of the maximal range,
fails indoors, where scanners reach far less than they could."""

_LEAST_ERROR_VOXELS = 0.5
"""Least sigma of associations, in voxels: points of the map are that far apart."""


@contextlib.contextmanager
def _without_environment() -> Iterator[None]:
    """kiss-icp's settings also come from environment variables; a stray one must not change results."""
    stray = {key: value for key, value in os.environ.items() if key.lower().startswith("kiss_icp_")}
    for key in stray:
        del os.environ[key]
    try:
        yield
    finally:
        os.environ.update(stray)


def choose_voxel_size(points: FloatArray) -> float:
    """Voxel [m] that suits the scene of ``points`` (N, 3) or (N, 2)."""
    return float(np.clip(_KISS_OF_RANGE * np.median(np.linalg.norm(points, axis=1)), _MIN_VOXEL_M, _MAX_VOXEL_M))


class KissIcp:
    """One KISS-ICP pipeline and its local map. Poses are planar (3,), points (N, 3) in the body frame [m].

    ``voxel_size`` is the edge of the map's voxels, points beyond ``max_range`` are left out [m].
    """

    def __init__(self, voxel_size: float, max_range: float) -> None:
        from kiss_icp.config import load_config  # here: both take 0.2 s to import, and usual planar runs need neither
        from kiss_icp.kiss_icp import KissICP

        self._made = voxel_size, max_range
        with _without_environment():
            config = load_config(None)
        config.data.deskew = False
        config.data.min_range, config.data.max_range = 0.0, max_range
        config.mapping.voxel_size = voxel_size
        config.registration.max_num_threads = 1  # two threads are not bit-identical from run to run
        self._kiss = KissICP(config)
        self._threshold = AdaptiveThreshold(_INITIAL_THRESHOLD_M, _MIN_MOTION_M, max_range)
        self._kiss.adaptive_threshold = self._threshold

    def register_frame(self, points: FloatArray) -> Pose2:
        """The pose of the next frame as KISS-ICP alone finds it, from its own constant-velocity guess; the map grows."""
        self._kiss.register_frame(points, _NO_STAMPS)
        return _planar(self._kiss.last_pose)

    def align(self, points: FloatArray, guess: Pose2, error: float) -> Pose2:
        """The pose of ``points`` in the map, searched from ``guess`` (3,), by which a point is off by up to ``error`` (3 sigma) [m].

        KISS-ICP alone learns the error of its guesses from past frames; that of a filter's prediction is known.
        """
        kiss, sigma = self._kiss, max(error / 3.0, _LEAST_ERROR_VOXELS * self._made[0])
        source, _ = kiss.voxelize(kiss.preprocessor.preprocess(points, _NO_STAMPS, np.eye(4)))
        pose = kiss.registration.align_points_to_map(
            points=source,
            voxel_map=kiss.local_map,
            initial_guess=se3.lift(guess),
            max_correspondance_distance=3.0 * sigma,  # the spelling is theirs
            kernel=sigma,
        )
        return _planar(pose)

    def insert(self, points: FloatArray, pose: Pose2) -> None:
        """Add ``points``, measured from ``pose`` (3,), to the map."""
        kiss = self._kiss
        downsampled = kiss.voxelize(kiss.preprocessor.preprocess(points, _NO_STAMPS, np.eye(4)))[1]
        kiss.local_map.update(downsampled, se3.lift(pose))

    def point_cloud(self) -> FloatArray:
        """(M, 3) the map's points."""
        return np.asarray(self._kiss.local_map.point_cloud())

    def __getstate__(self) -> dict[str, Any]:
        kiss = self._kiss
        return {
            "made": self._made,
            "threshold": self._threshold,
            "last_pose": kiss.last_pose,
            "last_delta": kiss.last_delta,
            "points": self.point_cloud(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The map is made anew: within a voxel the points come in the order in which they were added, so that it is the same voxel."""
        self.__init__(*state["made"])  # type: ignore[misc]
        kiss = self._kiss
        self._threshold = kiss.adaptive_threshold = state["threshold"]
        kiss.last_pose, kiss.last_delta = state["last_pose"], state["last_delta"]
        kiss.local_map.add_points(state["points"])


class AdaptiveThreshold:
    """KISS-ICP's adaptive threshold (eq. 5 to 7), with a state that can be saved: theirs is in C++ and cannot be read.

    The deviation of poses from their guesses sets the distance of associations. Same methods as kiss-icp's class of this name.
    """

    def __init__(self, initial: float, min_motion: float, max_range: float) -> None:
        """``initial`` [m]; deviations below ``min_motion`` [m] do not count; turns count by what they move at ``max_range`` [m]."""
        self._min_motion, self._max_range = min_motion, max_range
        self._squares, self._count = initial**2, 1

    def get_threshold(self) -> float:
        """Sigma of the deviation [m]."""
        return math.sqrt(self._squares / self._count)

    def update_model_deviation(self, model_deviation: FloatArray) -> None:
        """``model_deviation`` (4, 4): guess^-1 @ pose."""
        R = model_deviation[:3, :3]
        skew = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        angle = math.atan2(float(np.linalg.norm(skew)), 0.5 * (float(np.trace(R)) - 1.0))
        error = 2.0 * self._max_range * math.sin(0.5 * angle) + float(np.linalg.norm(model_deviation[:3, 3]))
        if error > self._min_motion:
            self._squares += error * error
            self._count += 1


def _planar(matrix: FloatArray) -> FloatArray:
    return np.array([matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])])
