"""Diagnosis of a model beside the one that suits the robot: what a simpler model does not have is no cause.

Where split friction turns a robot, `skid_steer` moved its LiDAR by 60 mm, and `friction` names the grip. So where the model that suits the
robot explains the drive, names are those of that model, with their sizes by the chosen one.
"""

from __future__ import annotations

from dataclasses import dataclass

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.diagnose import DiagnosisConfig, examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import Baseline
from localization.diagnosis.findings import Diagnosis, unit_of
from localization.diagnosis.linearization import default_model
from localization.diagnosis.result import DiagnosisResult
from localization.messages import Message, message
from motion_models.base import MotionModel
from motion_models.registry import make_model


@dataclass(frozen=True)
class ModelDiagnosis:
    """A diagnosis, and what the model that suits the robot made of the drive."""

    found: DiagnosisResult
    suited: Diagnosis | None = None
    """None where the diagnosed model suits the robot, and where nothing is off."""
    names: tuple[Cause, ...] | None = None
    """Causes to which the diagnosis was limited; None without a limit."""

    @property
    def notes(self) -> tuple[Message, ...]:
        """What the model that suits the robot finds; empty without one."""
        if self.suited is None:
            return ()
        causes = ", ".join(f"{f.definition.label} {f.size:+.3g}{unit_of(f.cause)}" for f in self.suited.findings) or "no cause"
        names = {"model": self.suited.model, "robot": self.suited.robot, "verdict": self.suited.verdict, "causes": causes}
        if self.names is None:
            return (message("suited_model.all", **names),)
        diagnosed = self.found.diagnosis.model
        is_missing = bool({c.id for c in self.names} - {f.cause for f in self.found.diagnosis.findings})
        if is_missing:
            return (message("suited_model.corrects", diagnosed=diagnosed, **names),)
        return (message("suited_model.limited", diagnosed=diagnosed, **names),)


def examine_beside_suited(
    drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None, baseline: Baseline | None = None
) -> ModelDiagnosis:
    """`examine` of ``model``, with the names of the model that suits the robot where that one explains the drive."""
    found, name = examine(drive, model, config, baseline), default_model(drive.robot)
    is_off = bool(found.diagnosis.findings) or found.diagnosis.verdict == "unexplained"
    if model.name == name or not is_off or baseline is not None:
        return ModelDiagnosis(found)
    suited = examine(drive, make_model(name, drive.robot), config).diagnosis
    if suited.verdict in ("unexplained", "undecidable"):
        return ModelDiagnosis(found, suited)
    names = tuple(f.definition for f in suited.findings if not f.is_counted)
    return ModelDiagnosis(examine(drive, model, config, names=names), suited, names)
