"""Scan-to-map matching in three moves: KISS-ICP searches, point-to-line steps refine, the curvature of their cost says how sure it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from localization.lidar.cells import ALL_AGES, Ages
from localization.lidar.kiss import Kiss
from localization.lidar.lines import AT_ONCE, FitOptions, LineMap
from localization.lidar.noise import Noise
from localization.lidar.revisit import Revisit, RevisitConfig, Revisits, Way
from localization.lidar.sweep import walls
from localization.settings import Allowed, Below, Count, Positive, Settings
from motion_models import se2
from motion_models.se2 import FloatArray

_FEW_POINTS = 10
_EVEN, _EVEN_SIGMA = 0.25, 0.1  # part of a scan's points on lines of the map with which it is as probable that the pose is right as not
_DEGENERATE = 0.02  # smaller over larger variance of the position; rooms: 0.2 and more
_SURPRISE = 0.05
_APART_M = 1e-4  # scans drawn on one spot are told apart by this


@dataclass(frozen=True)
class LidarConfig(Settings):
    """How scans are matched."""

    voxel_size_m: Annotated[float, Allowed("0, or from 0.01 to 10", lambda value: value == 0.0 or 0.01 <= value <= 10.0)] = 0.0
    """Voxel of KISS-ICP's map [m]; 0 takes a 15th of the first scan's median range, within 0.1 and 1 m."""
    min_range_m: Annotated[float, Below("max_range_m")] = 0.1
    """Nearer points are the robot itself [m]."""
    max_range_m: Positive = 50.0
    """Farther points are left out [m]."""
    sigma_point_m: Positive = 0.03
    """Noise of one LiDAR point, until scans have shown it [m]."""
    sigma_line_m: Positive = 0.02
    """Error of a line in the map, shared by all points of a scan that meet it in one cell, until scans have shown it [m]."""
    iterations: Count = 12
    """Point-to-line steps at most."""
    max_shift_m: float = 0.02
    """Where the motion within a sweep turns out otherwise than expected, and moves points by more than this, they are matched again [m];
    by less, the pose moves as its derivative by that motion says."""
    max_jump_m_s: Positive = 2.0
    """Nothing moves the robot faster than this against its wheels: a scan that says so is left out [m/s]."""
    max_jump_rad_s: Positive = 3.0
    """Nor turns it faster [rad/s]."""
    max_jumps: int = 5
    """So many scans that jump one after the other are right: the robot was carried elsewhere."""
    revisit: RevisitConfig = field(default_factory=RevisitConfig)


@dataclass(frozen=True)
class MapTie:
    """How the map that a scan meets hangs together with the map that the scan before met, and which errors of the scan are its own.

    All are parts of what fixes the pose, as information about it.
    """

    information: FloatArray
    """(3, 3) all of it."""
    old: FloatArray
    """(3, 3) what comes from lines that the map had before the last scan was drawn into it; zero for a first map."""
    of_map: FloatArray
    """(3, 3) by which errors of the map's lines, not of the scan's points, enter the pose."""
    sweep: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) of the registration's covariance, what comes from a motion within the sweep other than was thought. What the scan adds to
    the map has no part in it: the points are off one way, and the pose that was found for them the other."""
    bent: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) the same, by which the map itself is off, as nobody could set right the sweep that began it."""


@dataclass(frozen=True)
class Registration:
    """What one scan says about the pose: the most likely one and its covariance, by the scan and the map alone."""

    pose: FloatArray
    """(3,) ``world_T_body``."""
    cov: FloatArray
    """(3, 3) of its right perturbation; wide open along directions that the scene does not hold."""
    n_points: int
    """Points that could match."""
    n_matched: int
    """Points that did: they are on lines of the map, within their noise."""
    residual_rms_m: float
    """RMS distance of the matched points from the map's lines."""
    tie: MapTie
    """What of the covariance is the map's, and since when."""
    lateness: FloatArray
    """(3, 3) [s] how long after the stamp that was seen which fixes the pose: a twist in the sweep that is off by d moves it by this
    times d."""

    @property
    def trust(self) -> float:
        """How probable it is that the pose is right where something else contradicts it: that grows with the part of what is seen that is
        in the map. Within 0 and 1, both excluded."""
        share = self.n_matched / max(self.n_points, _FEW_POINTS / _EVEN)
        return 1.0 / (1.0 + math.exp((_EVEN - share) / _EVEN_SIGMA))

    @property
    def is_trusted(self) -> bool:
        """Most of what is seen is in the map: the pose is not a wild guess."""
        return self.n_matched >= _FEW_POINTS and self.n_matched >= 0.4 * self.n_points

    @property
    def is_degenerate(self) -> bool:
        """The scene holds the position in one direction only, as a corridor or a single wall does."""
        low, high = np.linalg.eigvalsh(self.cov[:2, :2])
        return bool(low < _DEGENERATE * high)


class LidarMatcher:
    """A map of what was seen so far, and where scans fit into it. The caller says where each scan was taken (`insert`)."""

    def __init__(self, config: LidarConfig | None = None, is_thorough: bool = False) -> None:
        self.config, self._is_thorough = config or LidarConfig(), is_thorough
        self._kiss: Kiss | None = None
        self._lines: LineMap | None = None
        sigmas = self.config.sigma_point_m, self.config.sigma_line_m
        self._noise = Noise(*sigmas)
        self._downsampled = np.empty((0, 3))
        self._planar, self._is_planar, self._offsets = np.empty((0, 2)), True, AT_ONCE
        self._guess: tuple[FloatArray, FloatArray] | None = None  # and its information
        self._revisits: Revisits | None = None
        self._travel, self._last = 0.0, np.zeros(3)
        self._drawn_at, self._is_met = math.inf, False  # travelled distance at which the last scan was drawn; a scan has met it since

    @property
    def has_map(self) -> bool:
        """There is something to match with."""
        return self._kiss is not None

    def register(
        self, points: FloatArray, is_planar: bool, guess: FloatArray, guess_cov: FloatArray, offsets: FloatArray = AT_ONCE
    ) -> Registration | None:
        """Where ``points`` (N, 3) of the body frame fit, searched around ``guess`` (3,) with its covariance (3, 3).

        The guess starts the search and holds it along directions that the scene leaves free; the result's covariance knows nothing
        of it. ``offsets``: when the points were seen, (N,) [s] after the stamp, or `AT_ONCE`. None for a scan with hardly a point.
        """
        points = self._prepare(points, is_planar, offsets)
        if self._kiss is None or self._lines is None:
            return None
        if self._is_met:
            self._drawn_at = math.inf
        if len(self._planar) < _FEW_POINTS:
            self._downsampled, self._planar = np.empty((0, 3)), np.empty((0, 2))
            return None
        found, self._downsampled = self._kiss.align(points, _matrix(guess))
        self._guess = guess, np.linalg.inv(9.0 * guess_cov + np.diag([1e-6, 1e-6, 1e-8])).astype(np.float64, copy=False)
        return self._fit(self._lines, pose_of_matrix(found))

    def refine(self, points: FloatArray, is_planar: bool, start: FloatArray, offsets: FloatArray = AT_ONCE) -> Registration | None:
        """The same scan once more, as other ``points`` (N, 3), close to where it was found, ``start`` (3,)."""
        if self._lines is None:
            return None
        self.replace_points(points, is_planar, offsets)
        return self._fit(self._lines, start) if len(self._planar) >= _FEW_POINTS else None

    def replace_points(self, points: FloatArray, is_planar: bool, offsets: FloatArray = AT_ONCE) -> None:
        """What the scan that was last given to `register` adds to the map: other ``points`` (N, 3), or when they were seen."""
        if self._kiss is not None:
            self._downsampled = self._kiss.downsampled(self._prepare(points, is_planar, offsets))

    def _fit(self, lines: LineMap, start: FloatArray) -> Registration:
        assert self._guess is not None
        guess, prior = self._guess
        self._is_met = True
        believed = self._noise.sigma_line
        since = self._drawn_at
        fit = lines.fit(self._planar, start, self._fit_options(), prior, guess, self._ages, since, self._offsets)
        self._noise.see(fit.spread)
        if abs(self._noise.sigma_line - believed) > _SURPRISE * believed:
            # the first scans show that the map is better or worse than was guessed
            fit = lines.fit(self._planar, fit.pose, self._fit_options(), prior, guess, self._ages, since, self._offsets)
        pose, cov = fit.measurement()
        tie = MapTie(fit.information, fit.old, fit.of_map)
        return Registration(pose, cov, len(self._planar), fit.n_on, fit.residual_rms, tie, fit.lateness)

    def _fit_options(self) -> FitOptions:
        noise = self._noise
        sigma_point, sigma_beam = noise.sigmas_of_a_point
        return replace(
            self._options, sigma_point=sigma_point, sigma_beam=sigma_beam, sigma_line=noise.sigma_line, place_part=noise.place_part
        )

    def insert(self, pose: FloatArray) -> None:
        """Add the scan that was last given to `register` to the map, as seen from ``pose`` (3,) ``world_T_body``."""
        if self._kiss is None or self._lines is None:
            return
        self._advance(pose)
        self._kiss.insert(self._downsampled, _matrix(pose))
        self._travel += _APART_M
        self._drawn_at, self._is_met = float(np.float32(self._travel)), False  # as the map remembers it
        self._lines.insert(self._planar, pose, self._travel, self._ages)

    def recall(self, pose: FloatArray, cov: FloatArray, stamp_ns: int) -> Revisit | None:
        """Whether the scan that was last given to `register`, seen from ``pose`` (3,) with ``cov`` (3, 3) after all that is known of
        the motion, is of a place seen long before. If so, correct the pose by it and say so (`correct`) before you `insert` the scan."""
        if self._kiss is None or self._lines is None or not self.config.revisit.is_on:
            return None
        if self._revisits is None:
            self._revisits = Revisits(self.config.revisit, self._options, self._voxel, self._is_thorough)
        self._advance(pose)
        return self._revisits.look(self._planar, self._lines, pose, cov, self._travel, stamp_ns)

    def correct(self, before: FloatArray, after: FloatArray) -> None:
        """By a revisit the pose became ``after`` (3,) instead of ``before`` (3,): what was seen of late was seen from elsewhere, too."""
        if self._kiss is None or self._lines is None or self._revisits is None:
            return
        world_T_world = se2.compose(after, se2.inverse(before))
        since = self._travel - self.config.revisit.old_after_m
        self._lines.move_since(since, world_T_world)
        self._revisits.correct(world_T_world, since)
        self._last = se2.compose(world_T_world, self._last)
        # KISS-ICP's map does not know when it saw what; of a planar scene, the lines' points are all there is to know
        points = self._lines.point_cloud()
        self._kiss.restart(np.column_stack([points, np.zeros(len(points))]) if self._is_planar else np.empty((0, 3)))

    @property
    def _ages(self) -> Ages:
        """Those parts of the map that are drawn from where the robot believes to be; others tell of other times' errors."""
        return ALL_AGES if self._revisits is None else self._revisits.ages

    def _advance(self, pose: FloatArray) -> None:
        self._travel += float(np.hypot(*(pose - self._last)[:2]))
        self._last = np.array(pose, dtype=float)

    def point_cloud(self, way: Way | None = None) -> FloatArray:
        """(M, 2) the map; had it been drawn along another ``way``, if there is one."""
        if self._lines is None:
            return np.empty((0, 2))
        points = self._lines.point_cloud()
        return points if way is None or self._revisits is None else self._revisits.mend(points, self._lines.point_travels(), way)

    def _prepare(self, points: FloatArray, is_planar: bool, offsets: FloatArray) -> FloatArray:
        """The points in range, which become those to match."""
        is_near = is_in_range(points, self.config)
        if is_near.all():
            points = np.ascontiguousarray(points)
        else:
            points, offsets = points[is_near], offsets[is_near] if len(offsets) else offsets
        self._is_planar = is_planar
        if self._kiss is None:
            if len(points) < _FEW_POINTS:
                return points
            voxel = self.config.voxel_size_m or voxel_size(points)
            self._kiss = Kiss(voxel, 0.0, self.config.max_range_m)
            self._lines = LineMap(2.0 * voxel, 0.1 * voxel, 2.0 * self.config.max_range_m)
            self._options = FitOptions(
                2.0 * voxel, self.config.sigma_point_m, self.config.sigma_line_m, 0.5 * voxel, 1.5 * voxel, self.config.iterations
            )
            self._voxel = voxel
            self._downsampled = points
        if is_planar:
            self._planar, self._offsets = np.ascontiguousarray(points[:, :2]), offsets
        else:  # a wall is seen by many rings and all the sweep long
            self._planar = walls(points, 0.5 * self._voxel)
            self._offsets = np.full(len(self._planar), offsets.mean()) if len(offsets) else offsets
        return points


def is_in_range(points: FloatArray, config: LidarConfig) -> NDArray[np.bool_]:
    """(N,) which of ``points`` (N, 3) are neither the robot itself nor too far."""
    r2 = np.einsum("ij,ij->i", points, points)
    return np.asarray((r2 > config.min_range_m**2) & (r2 < config.max_range_m**2))


def in_range(points: FloatArray, config: LidarConfig) -> FloatArray:
    """(M, 3) those of ``points`` (N, 3)."""
    return np.ascontiguousarray(points[is_in_range(points, config)])


def voxel_size(points: FloatArray) -> float:
    """A voxel [m] that suits the scene of the first scan ``points`` (N, 3): KISS-ICP's own default, a hundredth of the maximal range,
    fails indoors, where scanners see far less than they could."""
    return float(np.clip(np.median(np.linalg.norm(points, axis=1)) / 15.0, 0.1, 1.0))


def _matrix(pose: FloatArray) -> FloatArray:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, 0.0, pose[0]], [s, c, 0.0, pose[1]], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def pose_of_matrix(matrix: FloatArray) -> FloatArray:
    """(3,) the planar part of a pose (4, 4)."""
    return np.array([matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])])
