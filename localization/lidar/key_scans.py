"""Key scans: those that a submap is drawn from, and how their errors enter it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from localization.lidar import submap
from localization.lidar.correlative_search import LikelihoodImage, draw_image
from localization.lidar.submap import VoxelGrid, make_grid
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_MAX_OLD_SUBMAPS = 3
"""Key scans older than the last ones, at most, in units of their number."""
_SEEN_POINTS = 60
"""Points of a scan, by which the key scans that have drawn its surroundings are found."""
_MAPPED_INFORMATION = 1e2
"""Information of a key scan along a direction, from which on its noise moves its surfaces along it [1/m^2, 1/rad^2]."""


@dataclass(frozen=True)
class KeyScanError:
    """How the error of a key scan enters that of the submap around the robot: e_map' = (1 - s) e_map + s e_pose + m."""

    share: float
    """s, 0 to 1: the scan's share of its surroundings in the submap."""
    new_cov: Cov3
    """(3, 3) of m: places that were not mapped before have this scan alone."""


def key_scan_noise(cov: FloatArray, new: float) -> FloatArray:
    """(k, k) by which the noise of a scan, whose match has covariance ``cov`` (k, k), moves the submap, of which it draws the share ``new``
    anew: not along directions that the scene leaves open."""
    W = np.linalg.inv(np.eye(len(cov)) + cov * _MAPPED_INFORMATION)
    return np.asarray(new * W @ cov @ W.T)


@dataclass(frozen=True, eq=False)
class KeyScan:
    """A scan of the submap."""

    points: Points2
    """(N, 2) in the odometry frame [m]."""
    pose: Pose2
    """(3,) from which it was drawn."""
    map_cov: Cov3
    """(3, 3) covariance of the submap's error around it, before it was drawn; a right perturbation."""

    def drift_cov(self, pose: Pose2, map_cov: Cov3) -> Cov3:
        """(3, 3) of the drift from this scan to the submap around ``pose`` (3,), whose error has covariance ``map_cov`` (3, 3)."""
        A = se2.adjoint(se2.inverse(se2.between(self.pose, pose)))
        return np.asarray(map_cov - A @ self.map_cov @ A.T)

    def drift_variance(self, pose: Pose2, map_cov: Cov3, range_m: float) -> float:
        """Variance [m^2] by which points at ``range_m`` have drifted from this scan to the submap around ``pose`` (3,)."""
        grown = self.drift_cov(pose, map_cov)
        return float(grown[0, 0] + grown[1, 1] + range_m**2 * grown[2, 2])


class KeyScans:
    """`insert` scans; `grid` and `image` are drawn from those that stay."""

    def __init__(self, cell: float, range_noise_m: float, n: int) -> None:
        """``cell``: edge of the voxels [m]; ``range_noise_m``: sigma of a range [m]; ``n`` last scans stay in any case."""
        self.cell, self._range_noise_m, self._n = cell, range_noise_m, n
        self.keys: list[KeyScan] = []
        """Those that stay, the newest last."""
        self.grid = self._make_grid()
        """Their surfaces."""
        self._image: LikelihoodImage | None = None

    @property
    def image(self) -> LikelihoodImage:
        """Where a point of a scan is likely; there is one key scan at least. Drawn when it is first used."""
        if self._image is None:
            self._image = draw_image(self.grid.means, self.cell)
        return self._image

    def points(self) -> FloatArray:
        """(M, 2) in the odometry frame [m]."""
        return np.vstack([key.points for key in self.keys]) if self.keys else np.empty((0, 2))

    def drift_cov(self, points: Points2, pose: Pose2, map_cov: Cov3) -> tuple[Cov3, float]:
        """(3, 3) mean drift up to ``pose`` (3,) of the key scans that have drawn the surfaces nearest to ``points`` (N, 2) of the body, and
        how far these were drawn from there, in the mean [m]."""
        seen = np.asarray(se2.transform(pose, points[:: max(len(points) // _SEEN_POINTS, 1)]))
        of_key = np.repeat(np.arange(len(self.keys)), [len(key.points) for key in self.keys])
        _, nearest = cKDTree(self.points()).query(seen)
        counts = np.bincount(of_key[nearest], minlength=len(self.keys))
        grown = sum(n * key.drift_cov(pose, map_cov) for n, key in zip(counts, self.keys, strict=True) if n)
        values, vectors = np.linalg.eigh(grown / counts.sum())
        far_m = sum(n * math.dist(key.pose[:2], pose[:2]) for n, key in zip(counts, self.keys, strict=True)) / counts.sum()
        return np.asarray(vectors * np.maximum(values, 0.0) @ vectors.T), float(far_m)

    def insert(self, pose: Pose2, points: Points2, map_cov: Cov3 | None) -> tuple[float, float]:
        """Draw the scan ``points`` (N, 2) of the body frame from ``pose`` (3,); returns its shares, as `measure_shares` does.

        ``map_cov`` (3, 3) of the submap's error there: with it, old scans stay while they fit.
        """
        drawn = np.asarray(se2.transform(pose, points))
        scan = make_grid(drawn, self.cell, self._range_noise_m)
        shares = submap.measure_shares(self.grid, scan)
        key = KeyScan(drawn, pose, np.zeros((3, 3)) if map_cov is None else map_cov)
        self.keys = [*self._fitting_keys(pose, points, map_cov), key]
        self.grid, self._image = self._make_grid(), None
        return shares

    def _fitting_keys(self, pose: Pose2, points: Points2, map_cov: Cov3 | None) -> list[KeyScan]:
        """The key scans that stay beside a new one: the last ones, and older ones from which the drift is within two sigmas of a range's.

        These thicken no surface; the drift does not grow where the robot comes back to them.
        """
        recent = self.keys[max(len(self.keys) - self._n + 1, 0) :]
        if map_cov is None:
            return recent
        range_m, limit = float(np.median(np.hypot(points[:, 0], points[:, 1]))), (2.0 * self._range_noise_m) ** 2
        older = [key for key in self.keys[: len(self.keys) - len(recent)] if key.drift_variance(pose, map_cov, range_m) < limit]
        return [*older[-_MAX_OLD_SUBMAPS * self._n :], *recent]

    def _make_grid(self) -> VoxelGrid:
        return make_grid(self.points(), self.cell, self._range_noise_m)

    def __getstate__(self) -> dict[str, Any]:
        """The key scans; grid and image are computed from them."""
        return {name: value for name, value in vars(self).items() if name not in ("grid", "_image")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _image=None)
        self.grid = self._make_grid()
