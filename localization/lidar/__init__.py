"""LiDAR scan matching: KISS-ICP finds the pose, point-to-line steps refine it and say how sure it is."""

from localization.lidar.matcher import LidarConfig, LidarMatcher, Registration

__all__ = ["LidarConfig", "LidarMatcher", "Registration"]
