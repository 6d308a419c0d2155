"""Where clouds fit into a saved map in space: registration to its surfaces, from near a pose or from many starts around one."""

from __future__ import annotations

import hashlib
import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from localization.errors import MapError
from localization.lidar.cloud_map import SYSTEMATIC_COV, CloudMap, CloudMatch, thin
from localization.lidar.kiss_icp import choose_voxel_size
from localization.lidar.scan_matcher import MIN_POINTS
from localization.maps.height_slice import HEIGHTS_M, HeightSlice, find_ground
from localization.maps.keyframe_map import KeyframeMap
from localization.maps.place_search import PlaceMap
from motion_models import se3
from motion_models.se2 import Cov3, FloatArray, Pose2
from motion_models.se3 import Transform3

_COARSE = 4.0
"""Voxels of the first registration, in those of the second, as of loops in space."""
_START_M, _START_RAD = 1.0, 0.25
"""Distance of starts: half of a coarse voxel, and what turns points at the median range by one."""
_COARSE_SIGMAS = np.array([0.5, 0.5, 0.3, 0.05, 0.05, 0.15])
"""Sigmas of a start: half of their distance, the ground's height in a column, and gravity against that of the map [m, rad]."""
_FINE_SIGMAS = np.array([0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
"""Sigmas of a coarse registration, as of loops in space [m, rad]."""
_COARSE_POINTS = 250
"""Points of a coarse registration, at most."""
_REGISTERED = 8
"""Starts from which a coarse registration begins, those with the most points on surfaces."""
_REFINED, _SHARE_OF_BEST = 6, 0.6
"""Coarse registrations that are refined, the best first, at most, and down to this share of the best one's points on surfaces."""
_APART_M, _APART_RAD = 0.5, 0.2
"""Poses nearer than both are one place."""


@dataclass(frozen=True, eq=False)
class SpacePlace:
    """A pose in a map in space, and how a cloud agrees with it."""

    match: CloudMatch
    on_surfaces: float
    """Share of the points that lie within 3 sigma of a surface of the map."""
    off_surfaces: float
    """Share of the points that lie near a surface, and beyond 3 sigma of it; the others are where the map has none."""

    @property
    def pose(self) -> Transform3:
        """(4, 4) ``map_T_body``."""
        return self.match.pose

    @property
    def cov(self) -> FloatArray:
        """(6, 6) of the right perturbation of the pose that the cloud alone gives."""
        return np.asarray(self.match.cov + SYSTEMATIC_COV)


class SpacePlaces:
    """The surfaces of a map in space, as clouds are matched to them."""

    def __init__(self, mapped: KeyframeMap, range_noise_m: float) -> None:
        """``range_noise_m``: sigma of a range, added to the thickness of surfaces [m]. Raises `MapError` without points."""
        clouds = mapped.scans()
        if not len(mapped.points):
            raise MapError("the map has no points, so nothing can be localized in it. Build it from a log with clouds of a 3D LiDAR.")
        cell = choose_voxel_size(next(cloud for cloud in clouds if len(cloud)))
        self._surfaces, self._coarse = CloudMap(cell, range_noise_m), CloudMap(_COARSE * cell, range_noise_m)
        for pose, cloud in zip(mapped.poses, clouds, strict=True):
            for surfaces in (self._surfaces, self._coarse):
                surfaces.insert(pose, cloud)
        self.mapped, self.range_noise_m = mapped, range_noise_m
        self.fingerprint = hashlib.sha256(mapped.poses.tobytes() + mapped.points.tobytes()).hexdigest()[:12]
        points = mapped.points_in_map()
        self._ground = find_ground(points)
        self.points = thin(points, cell)
        """(M, 3) of the map, one in each cube of 0.4 voxels [m]."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        self.centre: Pose2 = np.array([*(0.5 * (low + high)), 0.0])
        """(3,) the middle of the map, seen from above."""
        self.extent_cov: Cov3 = np.diag(np.array([*np.full(2, 0.5 * math.hypot(*(high - low))), math.pi]) ** 2)
        """(3, 3) of a pose that may be anywhere in it."""

    @property
    def cell(self) -> float:
        """Edge of a voxel [m]."""
        return self._surfaces.cell

    def on_ground(self, planar: Pose2, level: FloatArray) -> Transform3:
        """(4, 4) the pose on the map's ground below the planar one (3,), tilted as the rotation ``level`` (3, 3) of heading zero."""
        pose = np.eye(4)
        pose[:3, :3] = se3.rotation(np.array([0.0, 0.0, planar[2]])) @ level
        pose[:2, 3] = planar[:2]
        pose[2, 3] = -self._ground.above(pose[None, :3, 3])[0]
        return pose

    def align(self, cloud: FloatArray, pose: Transform3, cov: FloatArray) -> SpacePlace:
        """The place of ``cloud`` (N, 3) of the body frame near ``pose`` (4, 4), uncertain by ``cov`` (6, 6)."""
        return _compare(self._surfaces.match(cloud, pose, cov), len(cloud))

    def search(self, cloud: FloatArray, level: FloatArray, near: Pose2 | None = None, half: FloatArray | None = None) -> list[SpacePlace]:
        """Places where ``cloud`` (N, 3) of the body frame fits best, the best first: with ``near`` (3,), within ``half`` (3,) [m, m, rad]
        of it, else in the whole map, from where what stands upright fits as seen from above. ``level`` as of `on_ground`."""
        if near is None or half is None:
            return self._search_everywhere(cloud, level)
        axes = [np.linspace(-h, h, max(math.ceil(2.0 * h / d), 1) + 1) for h, d in zip(half, (_START_M, _START_M, _START_RAD), strict=True)]
        starts = [near + np.array(offset) for offset in itertools.product(*axes) if np.hypot(*(offset[:2] / half[:2])) <= 1.0]
        return self.refine(cloud, starts, level)

    def _search_everywhere(self, cloud: FloatArray, level: FloatArray) -> list[SpacePlace]:
        """None where nothing stands upright."""
        upright = cloud @ level.T
        above = find_ground(upright).above(upright)
        walls = upright[(above >= HEIGHTS_M[0]) & (above <= HEIGHTS_M[1]), :2]
        if self.from_above is None or len(walls) < MIN_POINTS:
            return []
        return self.refine(cloud, [place.pose for place in self.from_above.search(walls)], level)

    @cached_property
    def from_above(self) -> PlaceMap | None:
        """The slice of what stands upright; None where nothing does."""
        try:
            return PlaceMap(HeightSlice(self.mapped).keyframes, self.range_noise_m)
        except MapError:
            return None

    def refine(self, cloud: FloatArray, starts: list[Pose2], level: FloatArray) -> list[SpacePlace]:
        """Places where ``cloud`` (N, 3) of the body frame fits from each of ``starts`` (3,) on, the best first; ``level`` as of
        `on_ground`."""
        few, cov = thin(cloud, self._coarse.cell), np.diag(_COARSE_SIGMAS**2)
        few = np.ascontiguousarray(few[:: math.ceil(len(few) / _COARSE_POINTS)])
        poses = [self.on_ground(start, level) for start in starts]
        shares = np.array([self._coarse.inlier_share(few, pose) for pose in poses])
        best = np.argsort(-shares, kind="stable")[:_REGISTERED]
        coarse = [_compare(self._coarse.match(few, poses[i], cov), len(few)) for i in best]
        apart = _distinct(coarse)
        likely = [place for place in apart[:_REFINED] if place.on_surfaces >= _SHARE_OF_BEST * apart[0].on_surfaces]
        return _distinct([self.align(cloud, place.pose, np.diag(_FINE_SIGMAS**2)) for place in likely])


Places = PlaceMap | SpacePlaces
"""A map as scans or clouds are localized in it."""


def make_places(mapped: KeyframeMap, range_noise_m: float) -> Places:
    """``mapped`` as scans or clouds are localized in it, with a sigma of a range [m]. Raises `MapError` without points."""
    return SpacePlaces(mapped, range_noise_m) if mapped.is_in_space else PlaceMap(mapped, range_noise_m)


def _compare(match: CloudMatch, n_points: int) -> SpacePlace:
    share = match.mapped / max(n_points, 1)
    return SpacePlace(match, share * match.overlap, share * (1.0 - match.overlap))


def _distinct(places: list[SpacePlace]) -> list[SpacePlace]:
    """The best of ``places`` that are apart, the best first."""
    found: list[SpacePlace] = []
    for place in sorted(places, key=lambda p: -p.on_surfaces):
        off = [se3.local(other.pose, place.pose) for other in found]
        if all(math.hypot(*o[:3]) > _APART_M or math.hypot(*o[3:]) > _APART_RAD for o in off):
            found.append(place)
    return found
