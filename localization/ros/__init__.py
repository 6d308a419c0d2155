"""The estimator as it runs on a robot: one event in, estimates out; the state on disk; doors to logs, ROS 2 and ROS 1."""

from localization.pipeline import Pipeline, ReplayConfig, Trial

__all__ = ["Pipeline", "ReplayConfig", "Trial"]
