"""LiDAR scan matching: scans to the submap of the last key scans, with a covariance from the scene."""

from localization.lidar.deskew import Sweep
from localization.lidar.key_scans import KeyScanError, key_scan_noise
from localization.lidar.kiss_icp import KissIcp, choose_voxel_size
from localization.lidar.lost_scans import LostScans
from localization.lidar.registration import OUTLIER_SIGMAS
from localization.lidar.scan_matcher import (
    MIN_POINTS,
    LidarConfig,
    ScanMatch,
    ScanMatcher,
    choose_cell,
)
from localization.lidar.scan_sensor import ScanMatchingSensor

__all__ = [
    "MIN_POINTS",
    "OUTLIER_SIGMAS",
    "KeyScanError",
    "KissIcp",
    "LidarConfig",
    "LostScans",
    "ScanMatch",
    "ScanMatcher",
    "ScanMatchingSensor",
    "Sweep",
    "choose_cell",
    "choose_voxel_size",
    "key_scan_noise",
]
