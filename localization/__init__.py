"""Localization of skid-steer robots: logs, LiDAR, estimators, scores and reports. The names here are what a notebook needs."""

from localization.estimators import ESTIMATORS, EstimatorConfig
from localization.evaluate import Accuracy, evaluate
from localization.logs import Log, TopicOverrides, open_log
from localization.references import read_reference_file, reference_track
from localization.run import Pair, ReplayConfig, Run, replay
from localization.score import Result, score
from localization.trajectory import Trajectory, read_tum, write_tum

__all__ = [
    "ESTIMATORS",
    "Accuracy",
    "EstimatorConfig",
    "Log",
    "Pair",
    "ReplayConfig",
    "Result",
    "Run",
    "TopicOverrides",
    "Trajectory",
    "evaluate",
    "open_log",
    "read_reference_file",
    "read_tum",
    "reference_track",
    "replay",
    "score",
    "write_tum",
]
