"""Localization of skid-steer robots: logs, LiDAR, estimators, scores and reports. The names here are what a notebook needs."""

from typing import TYPE_CHECKING

from motion_models import exports

if TYPE_CHECKING:
    from localization.estimators import ESTIMATORS, EstimatorConfig
    from localization.evaluation.metrics import Accuracy, evaluate
    from localization.evaluation.reference_files import read_reference_file
    from localization.evaluation.references import reference_track
    from localization.evaluation.scores import Result, score
    from localization.inputs.step_config import StepConfig
    from localization.log_replay import Run, replay
    from localization.logs import Log, TopicOverrides, open_log
    from localization.pipeline import ReplayConfig, Trial
    from localization.trajectory import Trajectory, read_tum, write_tum

__all__ = [
    "ESTIMATORS",
    "Accuracy",
    "EstimatorConfig",
    "Log",
    "ReplayConfig",
    "Result",
    "Run",
    "StepConfig",
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

_MODULES = {
    "localization.estimators": "ESTIMATORS EstimatorConfig",
    "localization.evaluation.metrics": "Accuracy evaluate",
    "localization.evaluation.reference_files": "read_reference_file",
    "localization.evaluation.references": "reference_track",
    "localization.evaluation.scores": "Result score",
    "localization.logs": "Log TopicOverrides open_log",
    "localization.pipeline": "ReplayConfig Trial",
    "localization.log_replay": "Run replay",
    "localization.inputs.step_config": "StepConfig",
    "localization.trajectory": "Trajectory read_tum write_tum",
}
__getattr__ = exports(__name__, {name: module for module, names in _MODULES.items() for name in names.split()})
