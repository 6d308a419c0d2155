"""The LiDAR as a sensor of the filter: scans in, poses in the submap out, and the submap grows where the filter puts its key scans."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import Step
from localization.lidar.deskew import Sweep
from localization.lidar.kiss_icp import KissIcp, choose_voxel_size
from localization.lidar.scan_checks import MAX_LOST_S, LostScans, StaleScans
from localization.lidar.scan_matcher import MIN_POINTS, KeyScanError, LidarConfig, ScanMatch, ScanMatcher, choose_cell, is_narrow
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Tangent2, Twist2

_MAPPED, _UNMAPPED, _MAX_MOTION = 0.8, 0.3, 0.3
"""The scene changed at once where the mapped share of scans fell from above the first to below the second while the wheels moved by less
than the third [m, rad]. It falls from 0.97 to 0.52 at most on fr079, MIT-CSAIL and ACES, and below 0.25 where a robot is carried."""
_MIN_DISPLACEMENT_M = 1e-3
"""Points that another twist moves by less are not deskewed again [m]."""


@dataclass(frozen=True, eq=False)
class _Scan:
    """The scan at hand, deskewed."""

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
        self._frame = ""  # of the last scan
        self._prior, self._cov = np.zeros(3), np.eye(3)
        self._last_key: FloatArray | None = None
        self._searching_since_s: float | None = None
        self._is_searching = False  # the scan at hand was not found from a wide prior: a place is still to be found
        self._stale, self.lost = StaleScans(), LostScans()
        self._mapped_shares: dict[str, float] = {}  # of the last scan of each frame
        self.moved_at_s: float | None = None
        """Time at which the robot was last moved by other than its wheels [s]."""

    def measure(self, step: Step, prior: Pose2, cov: Cov3, twist: Twist2, offset: Tangent2) -> ScanMatch | None:
        """Match the scan of ``step`` near ``prior`` (3,) with its covariance (3, 3) against the submap; None where it is lost.

        The sweep is deskewed with ``twist`` (3,), the body's at the middle of the sweep. ``offset`` (3,): see `ScanMatcher.match`.
        """
        assert step.scan is not None
        self._scan, self._prior, self._cov, self._frame = None, prior, cov, step.scan.frame_id
        if self._stale.is_stale(step.scan, step.is_standing):
            self.lost.add(step.end_ns, "stale")
            return None
        sweep = Sweep.from_scan(step.scan, self._mount(step.scan.frame_id)).within(self._config.min_range_m, self._config.max_range_m)
        self._scan = self._deskew(sweep, twist)
        if len(self._scan.planar) < MIN_POINTS:
            self._scan = None
            self.lost.add(step.end_ns, "sparse")
            return None
        if self._matcher is None:
            self._begin(self._scan)
            self._mapped_shares = {step.scan.frame_id: 1.0}
            self.lost.add_matched(step.end_ns)
            return None
        found = self._match(self._matcher, self._scan, offset)
        before = self._mapped_shares.get(step.scan.frame_id, 0.0)
        self._mapped_shares[step.scan.frame_id] = self._matcher.mapped_share
        if found is None and _is_moved(before, self._matcher.mapped_share, step):
            self._scan, self.moved_at_s = None, step.end_ns * 1e-9
            self._matcher.is_new_place = False
            self.lost.add(step.end_ns, "moved")
            return None
        self._update_search_state(found is None and not is_narrow(cov), step.end_ns * 1e-9)
        if found is None:
            self.lost.add(step.end_ns, "lost")
        else:
            self.lost.add_matched(step.end_ns)
        return found

    def add_no_scan(self, stamp_ns: int, is_excluded: bool) -> None:
        """A step without a scan: none is at hand, and the LiDAR may be silent, or a check left the scan out."""
        self._scan = None
        self.lost.add(stamp_ns, "excluded") if is_excluded else self.lost.add_no_scan(stamp_ns)

    def _update_search_state(self, is_searching: bool, now_s: float) -> None:
        """Scans that may be anywhere do not enter the submap for some seconds: drawn there, they compete with their true place."""
        if not is_searching:
            self._searching_since_s = None
        elif self._searching_since_s is None:
            self._searching_since_s = now_s
        self._is_searching = self._searching_since_s is not None and now_s - self._searching_since_s < MAX_LOST_S

    def refine(self, match: ScanMatch, twist: Twist2) -> ScanMatch:
        """``match`` again, its sweep deskewed with ``twist`` (3,); the same where that moves no point."""
        assert self._scan is not None
        assert self._matcher is not None
        if self._scan.sweep.displacement(twist - self._scan.twist) < _MIN_DISPLACEMENT_M:
            return match
        self._scan = self._deskew(self._scan.sweep, twist)
        return self._matcher.refine(self._scan.planar, self._prior, self._cov, match) or match

    def intra_scan_slip_cov(self, match: ScanMatch, slip_rate: Cov3) -> Cov3:
        """(3, 3) of the ``match`` of the scan at hand by slip within the sweep, a random walk of ``slip_rate`` (3, 3) a second."""
        if self._scan is None or self._matcher is None or not len(self._scan.times) or not slip_rate.any():
            return np.zeros((3, 3))
        return self._matcher.intra_scan_slip_cov(self._scan.planar, self._scan.times, match.pose, slip_rate)

    def is_key(self, pose: Pose2) -> bool:
        """Whether the scan at hand, taken from ``pose`` (3,), is to enter the submap."""
        if self._scan is None or self._is_searching:
            return False
        if self._last_key is None or (self._matcher is not None and self._matcher.is_new_place):
            return True
        moved = se2.between(self._last_key, pose)
        c = self._config
        return bool(math.hypot(moved[0], moved[1]) > c.key_distance_m or abs(moved[2]) > c.key_angle_rad)

    def insert_key_scan(self, pose: Pose2, map_cov: Cov3) -> KeyScanError:
        """Draw the scan at hand from ``pose`` (3,), where the submap's error has covariance ``map_cov`` (3, 3)."""
        assert self._scan is not None
        assert self._matcher is not None
        self._last_key = pose
        if self._kiss is not None:
            self._kiss.insert(self._scan.points, pose)
        return self._matcher.insert_key_scan(pose, self._scan.planar, map_cov)

    def scan_points(self) -> Points2:
        """(M, 2) the scan at hand in the body frame, or (0, 2)."""
        return np.empty((0, 2)) if self._scan is None else self._scan.planar

    def lidar_position(self) -> FloatArray:
        """(2,) where the LiDAR of the last scan is in the body frame [m]."""
        mount = self._mounts.get(self._frame, Mount())
        return np.array([mount.x, mount.y])

    def map_points(self) -> Points2:
        """(M, 2) the submap in the odometry frame [m]."""
        return np.empty((0, 2)) if self._matcher is None else self._matcher.points()

    @property
    def sweep_s(self) -> float:
        """From the first to the last point of the scan at hand [s]; 0 where the points have no times."""
        return 0.0 if self._scan is None else self._scan.sweep.duration_s

    @property
    def cell(self) -> float:
        """Edge of the submap's voxels [m]."""
        return 0.0 if self._matcher is None else self._matcher.cell

    def _deskew(self, sweep: Sweep, twist: Twist2) -> _Scan:
        points = sweep.deskew(twist)
        return _Scan(sweep, twist, points, *sweep.project_with_times(points))

    def _begin(self, scan: _Scan) -> None:
        """The first scan sets the size of the voxels."""
        c = self._config
        self._matcher = ScanMatcher(c, choose_cell(c, scan.planar))
        if c.matcher == "kiss" or not scan.sweep.is_planar:
            self._kiss = KissIcp(c.voxel_size_m or choose_voxel_size(scan.points), c.max_range_m)

    def _match(self, matcher: ScanMatcher, scan: _Scan, offset: Tangent2) -> ScanMatch | None:
        if self._kiss is None:
            return matcher.match(scan.planar, self._prior, self._cov, offset=offset)
        guess = self._kiss.align(scan.points, self._prior)
        if self._config.matcher == "kiss":
            return matcher.evaluate(scan.planar, guess)
        return matcher.match(scan.planar, self._prior, self._cov, guess, offset)

    def _mount(self, frame: str) -> Mount:
        """Where ``frame`` is mounted. A submap that was drawn before its mount was given is dropped."""
        mount = self._mounts.get(frame)
        if mount is not None and not self._is_placed:
            self._matcher, self._kiss, self._last_key = None, None, None
            self._searching_since_s, self._is_searching = None, False
        self._is_placed = mount is not None
        return mount or Mount()


def _is_moved(before: float, now: float, step: Step) -> bool:
    """Whether scans lose the map at once, from the mapped share ``before`` to that of ``now``, though the wheels hardly moved."""
    x, y, yaw = step.predicted.delta
    return before > _MAPPED and now < _UNMAPPED and math.hypot(x, y) < _MAX_MOTION and abs(yaw) < _MAX_MOTION
