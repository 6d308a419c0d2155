"""LiDAR scan matching: KISS-ICP finds the pose, point-to-line steps refine it and say how sure it is."""

from localization.lidar.check import ScanCheck
from localization.lidar.matcher import LidarConfig, LidarMatcher, MapTie, Registration
from localization.lidar.odometry import LidarOdometry
from localization.lidar.revisit import Revisit, RevisitConfig, Way
from localization.lidar.slip import Slip
from localization.lidar.sweep import Sweep, body_points

__all__ = [
    "LidarConfig",
    "LidarMatcher",
    "LidarOdometry",
    "MapTie",
    "Registration",
    "Revisit",
    "RevisitConfig",
    "ScanCheck",
    "Slip",
    "Sweep",
    "Way",
    "body_points",
]
