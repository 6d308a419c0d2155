"""A diagnosis and what it was made of: what pictures, searches for terms and robot files start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.linearization import Linearization
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class DriveDiscrepancies:
    """Discrepancies, for pictures."""

    rows: FloatArray
    """(M, 6) measured minus predicted, as `CHANNELS`."""
    left: FloatArray
    """(M, 6) once all findings are corrected."""
    sigmas: FloatArray
    """(M, 6) their noise."""


@dataclass(frozen=True)
class DiagnosisResult:
    """A diagnosis and what it was made of."""

    diagnosis: Diagnosis
    predictor: DrivePredictor | None
    """None where too little was measured."""
    residuals: DriveDiscrepancies | None
    linearization: Linearization | None = None
    """The last linearization of the drive: its signatures, and its noise."""
    names: Sequence[Cause] | None = None
    """Causes to which it was limited; None without a limit."""
