"""What each source may be, in place of what the robot file says: one module a source, one row a symptom of practice."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from localization.evidence.alternatives import driver, gyro, lidar, reference, wheels
from localization.evidence.alternatives.alternative import Alternative, Row
from localization.evidence.signals import Kind, Source
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

Maker = Callable[[Source, FloatArray, FloatArray, Robot], list[Alternative]]

MAKERS: Mapping[Kind, Maker] = {
    "wheels": wheels.alternatives,
    "driver": driver.alternatives,
    "gyro": gyro.alternatives,
    "lidar": lidar.alternatives,
    "reference": reference.alternatives,
}
"""By kind of source: all alternatives of its channels at one delay, that of the robot file first."""

__all__ = ["MAKERS", "Alternative", "Maker", "Row"]
