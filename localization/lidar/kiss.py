"""KISS-ICP (Vizzo et al., RA-L 2023) behind one door: 3D poses, a prior from outside, no deskewing, one thread.

Deskewing is ours (`lidar.sweep`), and so timestamps never reach kiss-icp, whose deskewing aborts the process when they are all equal.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

from localization.lidar.threshold import AdaptiveThreshold
from motion_models.se2 import FloatArray

_NO_STAMPS = np.empty(0)


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


class Kiss:
    """One KISS-ICP pipeline and its local map. Poses are ``map_T_body`` (4, 4), points (N, 3) in the body frame [m]."""

    def __init__(self, voxel_size: float, min_range: float, max_range: float) -> None:
        self._made = voxel_size, min_range, max_range
        with _without_environment():
            config = load_config(None)
        config.data.deskew = False
        config.data.min_range, config.data.max_range = min_range, max_range
        config.mapping.voxel_size = voxel_size
        config.registration.max_num_threads = 1  # two threads are not bit-identical from run to run
        self._kiss = KissICP(config)
        self._threshold = AdaptiveThreshold(0.5, 0.01, max_range)
        self._kiss.adaptive_threshold = self._threshold

    def register_frame(self, points: FloatArray) -> FloatArray:
        """The pose (4, 4) of the next frame as KISS-ICP alone finds it, from its own constant-velocity guess; the map grows."""
        self._kiss.register_frame(points, _NO_STAMPS)
        return np.asarray(self._kiss.last_pose)

    def align(self, points: FloatArray, guess: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The pose (4, 4) of ``points`` in the map, searched from ``guess`` (4, 4), and the points (M, 3) to `insert`."""
        kiss = self._kiss
        frame = kiss.preprocessor.preprocess(points, _NO_STAMPS, np.eye(4))
        source, frame_downsample = kiss.voxelize(frame)
        sigma = kiss.adaptive_threshold.get_threshold()
        pose = kiss.registration.align_points_to_map(
            points=source,
            voxel_map=kiss.local_map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma,  # the spelling is theirs
            kernel=sigma,
        )
        kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        return pose, frame_downsample

    def downsampled(self, points: FloatArray) -> FloatArray:
        """(M, 3) of ``points`` (N, 3), to `insert`."""
        kiss = self._kiss
        found: FloatArray = kiss.voxelize(kiss.preprocessor.preprocess(points, _NO_STAMPS, np.eye(4)))[1]
        return found

    def insert(self, points: FloatArray, pose: FloatArray) -> None:
        """Add ``points`` (M, 3), seen from ``pose`` (4, 4), to the map."""
        self._kiss.local_map.update(points, pose)

    def restart(self, points: FloatArray) -> None:
        """Forget the map but for ``points`` (M, 3) of it."""
        self._kiss.local_map.clear()
        self._kiss.local_map.add_points(points)

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
