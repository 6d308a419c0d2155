"""The estimator as it runs on a robot: one event in, estimates out; the state on disk; doors to logs, ROS 2 and ROS 1."""

from typing import TYPE_CHECKING

from motion_models import exports

if TYPE_CHECKING:
    from localization.pipeline import Pipeline, ReplayConfig, Trial

__all__ = ["Pipeline", "ReplayConfig", "Trial"]

__getattr__ = exports(__name__, dict.fromkeys(__all__, "localization.pipeline"))  # the first odometry needs no estimator
