"""Localization of skid-steer robots: logs, LiDAR, estimators, scores and reports. The names here are what a notebook needs."""

from localization.estimators import ESTIMATORS, EstimatorConfig
from localization.evaluation.metrics import Accuracy, evaluate
from localization.evaluation.references import read_reference_file, reference_track
from localization.evaluation.scores import Result, score
from localization.logs import Log, TopicOverrides, open_log
from localization.pipeline import ReplayConfig, Run, Trial, replay
from localization.trajectory import Trajectory, read_tum, write_tum

__all__ = [
    "ESTIMATORS",
    "Accuracy",
    "EstimatorConfig",
    "Log",
    "ReplayConfig",
    "Result",
    "Run",
    "TopicOverrides",
    "Trajectory",
    "Trial",
    "evaluate",
    "open_log",
    "read_reference_file",
    "read_tum",
    "reference_track",
    "replay",
    "score",
    "write_tum",
]
