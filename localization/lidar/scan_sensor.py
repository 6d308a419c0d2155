"""The LiDAR as a sensor of the filter: scans in, poses in the submap out, and the submap grows where the filter puts its key scans."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import Step
from localization.lidar import registration
from localization.lidar.deskew import Sweep
from localization.lidar.key_scans import KeyScanError
from localization.lidar.kiss_icp import KissIcp, choose_voxel_size
from localization.lidar.lost_scans import LostScans
from localization.lidar.merged_sweep import MergedSweeps
from localization.lidar.scan_matcher import MIN_POINTS, LidarConfig, ScanMatch, ScanMatcher, choose_cell
from localization.lidar.scan_policies import MovedRobot, StaleScans
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Tangent2, Twist2

_MIN_DISPLACEMENT_M = 1e-3
"""Points that another twist moves by less are not deskewed again [m]."""


@dataclass(frozen=True, eq=False)
class _Scan:
    """The last scan, deskewed, and the prior pose that it is matched with."""

    prior: Pose2
    """(3,) ``odom_T_body``."""
    cov: Cov3
    """(3, 3) of the prior against the submap."""
    sweep: Sweep
    twist: Twist2
    """(3,) with which it was deskewed."""
    points: FloatArray
    """(N, 3) at the middle of the sweep."""
    planar: FloatArray
    """(M, 2) what is matched in the plane."""
    times: FloatArray
    """(M,) when these were measured, after the middle of the sweep [s]; (0,) without times."""


class ScanMatchingSensor:
    """For each step with a scan: `measure`, perhaps `refine`, then `insert_key_scan` where `is_key`."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config = mounts, config
        self._is_placed = True  # the submap was drawn with known mounts
        self._matcher: ScanMatcher | None = None
        self._kiss: KissIcp | None = None
        self._scan: _Scan | None = None
        self._match_cov: Cov3 | None = None  # of the last scan; None where it was not matched
        self._frame = ""  # of the last scan
        self._stale, self.moved, self.lost = StaleScans(), MovedRobot(config), LostScans()
        self.merged = MergedSweeps(mounts, config)
        """Scans of several LiDARs."""

    def measure(self, step: Step, prior: Pose2, cov: Cov3, offset: Tangent2) -> ScanMatch | None:
        """Match the scan of ``step`` near ``prior`` (3,) with its covariance (3, 3) against the submap; None where it is lost.

        The sweep is deskewed with the wheels' twist at its middle. ``offset`` (3,): see `ScanMatcher.match`.
        """
        self._scan = None
        found, cause = self._measure(step, prior, cov, offset)
        self._match_cov = None if found is None else found.cov
        self.lost.add(step.end_ns, cause)
        return found

    def _measure(self, step: Step, prior: Pose2, cov: Cov3, offset: Tangent2) -> tuple[ScanMatch | None, str]:
        """The match, and why the scan is lost; "" where it is not, also of the first scan."""
        scan = step.scan
        assert scan is not None
        if scan.frame_id != self._frame and not self.merged.is_aligned(scan.frame_id):  # its mount may be off against the submap
            self.begin_submap()
            self.merged.begin()
        self._frame = scan.frame_id
        if self._stale.is_stale(scan, step.is_standing):
            self.moved.add_no_scan(step)
            return None, "stale"
        self._require_mount(scan.frame_id)
        if scan.beside or self.merged.corrections:
            sweep = self.merged.sweep(scan)
        else:
            mount = self._mounts.get(scan.frame_id, Mount())
            sweep = Sweep.from_scan(scan, mount, self._config.min_range_m, self._config.max_range_m)
        deskewed = self._deskew(sweep, step.twist, prior, cov)
        if len(deskewed.planar) < MIN_POINTS:
            self.moved.add_no_scan(step)
            return None, "sparse"
        self._scan = deskewed
        if self._matcher is None:
            self._begin(deskewed)
            self.moved.begin(scan)
            return None, ""
        guess = None
        if self._kiss is not None:
            guess = self._kiss.align(deskewed.points, prior, registration.prior_error_at_points(deskewed.planar, cov))
        moved = se2.compose(self.moved.since, step.predicted.delta)
        found = self._matcher.match(deskewed.planar, prior, cov, guess, offset, moved)
        if self.moved.is_moved(step, scan, moved, self._matcher.mapped_share, is_matched=found is not None):
            self._scan, self._matcher.is_new_place = None, False
            return None, "moved"
        return found, "lost" if found is None else ""

    def add_no_scan(self, step: Step) -> None:
        """A step without a scan: none is at hand, and the LiDAR may be silent, or a check left the scan out."""
        self._scan = None
        self.moved.add_no_scan(step)
        self.lost.add(step.end_ns, "excluded") if step.is_scan_excluded else self.lost.add_no_scan(step.end_ns)

    def refine(self, match: ScanMatch, twist: Twist2) -> ScanMatch:
        """``match`` again, its sweep deskewed with ``twist`` (3,); the same where that moves no point."""
        scan = self._scan
        assert scan is not None
        assert self._matcher is not None
        if scan.sweep.displacement(twist - scan.twist) < _MIN_DISPLACEMENT_M:
            return match
        self._scan = scan = self._deskew(scan.sweep, twist, scan.prior, scan.cov)
        return self._matcher.refine(scan.planar, scan.prior, scan.cov, match) or match

    def intra_scan_slip_cov(self, match: ScanMatch, slip_rate: Cov3) -> Cov3:
        """(3, 3) of the ``match`` of the scan at hand by slip within the sweep, a random walk of ``slip_rate`` (3, 3) a second."""
        if self._scan is None or self._matcher is None or not len(self._scan.times) or not slip_rate.any():
            return np.zeros((3, 3))
        return self._matcher.intra_scan_slip_cov(self._scan.planar, self._scan.times, match.pose, slip_rate)

    def is_key(self, pose: Pose2) -> bool:
        """Whether the scan at hand, taken from ``pose`` (3,), is to enter the submap."""
        if self._scan is None or self._matcher is None:
            return False
        keys = self._matcher.submap.keys
        if not keys or self._matcher.is_new_place:
            return True
        moved, c = se2.between(keys[-1].pose, pose), self._config
        return bool(math.hypot(moved[0], moved[1]) > c.key_distance_m or abs(moved[2]) > c.key_angle_rad)

    def insert_key_scan(self, pose: Pose2, map_cov: Cov3) -> KeyScanError:
        """Draw the scan at hand from ``pose`` (3,), where the submap's error has covariance ``map_cov`` (3, 3)."""
        assert self._scan is not None
        assert self._matcher is not None
        if self._match_cov is not None:
            self.merged.measure(self._matcher, pose, (self._match_cov, map_cov), self._scan.twist)
        if self._kiss is not None:
            self._kiss.insert(self._scan.points, pose)
        return self._matcher.insert_key_scan(pose, self._scan.planar, map_cov)

    def begin_submap(self) -> None:
        """Drop the submap: the next scan begins another one."""
        self._matcher, self._kiss = None, None

    def scan_points(self) -> Points2:
        """(M, 2) the scan at hand in the body frame, or (0, 2)."""
        return np.empty((0, 2)) if self._scan is None else self._scan.planar

    def lidar_position(self) -> FloatArray:
        """(2,) where the LiDAR of the last scan is in the body frame [m]."""
        mount = self._mounts.get(self._frame, Mount())
        return np.array([mount.x, mount.y])

    def map_points(self) -> Points2:
        """(M, 2) the submap in the odometry frame [m]."""
        return np.empty((0, 2)) if self._matcher is None else self._matcher.submap.points()

    @property
    def sweep_s(self) -> float:
        """From the first to the last point of the scan at hand [s]; 0 where the points have no times."""
        return 0.0 if self._scan is None else self._scan.sweep.duration_s

    @property
    def cell(self) -> float:
        """Edge of the submap's voxels [m]."""
        return 0.0 if self._matcher is None else self._matcher.submap.cell

    def _deskew(self, sweep: Sweep, twist: Twist2, prior: Pose2, cov: Cov3) -> _Scan:
        points = sweep.deskew(twist)
        return _Scan(prior, cov, sweep, twist, points, *sweep.project_with_times(points))

    def _begin(self, scan: _Scan) -> None:
        """The first scan sets the size of the voxels."""
        c = self._config
        self._matcher = ScanMatcher(c, choose_cell(c, scan.planar))
        if c.matcher == "kiss" or not scan.sweep.is_planar:
            self._kiss = KissIcp(c.voxel_size_m or choose_voxel_size(scan.points), c.max_range_m)

    def _require_mount(self, frame: str) -> None:
        """Drop a submap that was drawn before the mount of ``frame`` was given."""
        is_known = frame in self._mounts
        if is_known and not self._is_placed:
            self.begin_submap()
        self._is_placed = is_known
