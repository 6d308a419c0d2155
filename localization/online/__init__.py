"""The estimator as it runs on a robot: one event in, estimates out; the state on disk; doors to logs, ROS 2 and ROS 1."""

from localization.online.core import Core, Pair, ReplayConfig

__all__ = ["Core", "Pair", "ReplayConfig"]
