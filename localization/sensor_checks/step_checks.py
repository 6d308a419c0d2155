"""The checks of a step by its sensors alone, in the order in which they are applied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from localization.events import Step
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.sensor_checks.contradictions import Contradictions
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.gyro_rate import GyroRate
from localization.sensor_checks.lidar_tilt import LidarTilt
from localization.sensor_checks.moving_objects import MovingObjects
from localization.sensor_checks.own_body import OwnBody
from localization.sensor_checks.standstill import Standstill
from localization.sensor_checks.sweep_times import SweepTimes
from localization.sensor_checks.window import Window
from motion_models.robot import Mount


class StepChecks:
    """`compare` each step, before the estimator has it or afterwards."""

    def __init__(
        self, faults: FaultLog, mounts: Mapping[str, Mount], config: LidarConfig, step_config: StepConfig, usual: Mapping[int, float]
    ) -> None:
        """``usual``: what turns by healthy wheels err by, as `pairs.usual_errors` has it."""
        self._faults, self._inflation = faults, faults.inflation
        self.window = window = Window(mounts, config)
        """Motions of the last seconds."""
        self.own_body, self.tilt, self.sweep_times = OwnBody(faults, mounts), LidarTilt(mounts), SweepTimes(faults)
        self._contradictions, self._gyro_rate = Contradictions(faults, usual), GyroRate(faults)
        self.standstill, self.moving = Standstill(faults, window, step_config), MovingObjects(faults, window)

    @property
    def is_acting(self) -> bool:
        """Whether one of them changes steps."""
        return self._gyro_rate.is_acting or self._contradictions.is_acting or self.moving.is_acting

    def compare(self, step: Step, *, is_to_come: bool) -> Step:
        """``step`` without what contradicts the other sensors, for the estimator, for which it ``is_to_come``, or was."""
        self._faults.start_step(step)
        if not self.own_body.is_found:
            step = self.own_body.remove(step)
        if step.scan is not None and not step.scan.is_planar:
            self.tilt.add(step.scan)
        if self.window.add(step, self._faults.now_s):
            self.sweep_times.compare(self.window)
            if self._contradictions.compare(self.window) and self.sweep_times.are_likely_right:
                self._inflation.restart()
        excluded = self._contradictions.excluded if self._faults.declared and is_to_come else ()
        step = self._gyro_rate.apply(step)
        step = replace(step, turn=None) if "gyro" in excluded else step
        step = step.without_scan() if "LiDAR" in excluded else step
        step = self.standstill.apply(step, is_contradicted="wheels" in excluded)
        self._inflation.reckoning.predict(step)
        return self.moving.apply(step)
