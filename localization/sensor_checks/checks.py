"""The checks, in the order in which they are applied."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.estimators import Estimate, Estimator
from localization.events import ImuSample, Scan, Step
from localization.lidar import LidarConfig
from localization.sensor_checks.clocks import ClockCheck
from localization.sensor_checks.contradictions import Contradictions, GyroRate
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.known_places import KnownPlaces
from localization.sensor_checks.lidar_tilt import LidarTilt
from localization.sensor_checks.moving_objects import MovingObjects
from localization.sensor_checks.own_body import OwnBody
from localization.sensor_checks.sensor_consistency import SensorConsistency
from localization.sensor_checks.standstill import Standstill
from localization.sensor_checks.sweep_times import SweepTimes
from localization.sensor_checks.window import Window
from localization.synchronizer import StepConfig
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import Pose2


class SensorChecks:
    """`apply` to each step before the estimator, `inflate` its estimate afterwards."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig, step_config: StepConfig, clock_sigma_s: float = 0.0) -> None:
        """``clock_sigma_s``: by how much the clock of the poses may be off [s]."""
        self._inflation = CovarianceInflation()
        self._faults = faults = FaultLog(self._inflation)
        self._window = window = Window(mounts, config)
        self._moving, self._sweep_times = MovingObjects(faults, window), SweepTimes(faults)
        self._own_body, self._contradictions, self._gyro_rate = OwnBody(faults), Contradictions(faults), GyroRate(faults)
        self._standstill = Standstill(faults, window, step_config)
        self._consistency, self._places, self._tilt = SensorConsistency(faults), KnownPlaces(faults), LidarTilt(mounts)
        self._clocks = ClockCheck(faults, clock_sigma_s)
        self._mounts, self._is_lidar_placed = mounts, True
        self._step: Step | None = None
        self._pose: Pose2 | None = None

    def insert_imu(self, sample: ImuSample) -> None:
        """Specific force shows whether the robot moves."""
        self._standstill.insert_imu(sample)

    def correct(self, scan: Scan) -> Scan:
        """``scan`` with the times of its points as they were found to be."""
        return replace(scan, offsets=-scan.offsets) if self._sweep_times.is_reversed and scan.is_planar else scan

    def apply(self, step: Step) -> Step:
        """``step`` without the sensors that are faulty, and with a wide covariance where the wheels are uncertain."""
        if not math.isfinite(step.predicted.delta.sum()):
            return step  # the estimator refuses it
        self._faults.start_step(step)
        if step.scan is not None and not step.scan.is_planar:
            self._tilt.add(step.scan)
        step = self._own_body.remove(step)
        self._inflation.add_step(step)
        was_reversed = self._sweep_times.is_reversed
        if self._window.add(step, self._faults.now_s):
            agree = self._contradictions.compare(self._window)
            if self._sweep_times.compare(self._window) and agree:
                self._inflation.restart()
        if self._sweep_times.is_reversed and not was_reversed:
            step = replace(step, restarts_map=True)  # without the scans that were distorted
        excluded = self._contradictions.excluded if self._faults.declared else ()
        step = self._gyro_rate.apply(step)
        step = replace(step, turn=None) if "gyro" in excluded else step
        step = step.without_scan() if "LiDAR" in excluded else step
        step = self._standstill.apply(step, is_contradicted="wheels" in excluded)
        step = self._moving.apply(step)
        if self._faults.has_left_scans_out:
            step = self._inflation.lead_back(step)
        self._step = step
        return step

    def compare_residuals(self, estimator: Estimator) -> None:
        """Compare the innovations of the last step, and the learned parameters, with their covariances.

        Parameters that are learned from a LiDAR without a mount, as the centre of rotation, are not those of the robot file.
        """
        residuals, step = estimator.residuals, self._step
        if step is None or residuals is None:
            return
        self._clocks.add(estimator)
        if step.scan is not None:
            self._is_lidar_placed = step.scan.frame_id in self._mounts
        self._consistency.add(step, residuals, estimator.learned_parameters if self._is_lidar_placed else tuple)

    def inflate(self, estimate: Estimate) -> Estimate:
        """``estimate`` with the covariance of what faulty sensors have done to it; unchanged without one (LiDAR alone)."""
        if estimate.covariance is None:
            return estimate
        before, self._pose = self._pose, estimate.pose if estimate.odometry is None else estimate.odometry[0]
        delta = np.zeros(3) if before is None else se2.between(before, self._pose)
        if before is not None and self._step is not None:
            if estimate.nis is not None:
                self._standstill.restart()
            self._moving.compare_estimate(delta, estimate.nis)
            self._consistency.compare_estimate(delta, estimate.nis)
        inflated = self._inflation.inflate(estimate, delta)
        scan = None if self._step is None else self._step.scan
        if scan is not None and self._places.update(lambda: self._window.profile(scan), self._pose):
            self._consistency.restart()  # a place from before the faults shows the pose: differences count from here on
        return inflated

    def inflate_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the same covariance at its end, from the first fault on."""
        return self._inflation.inflate_trajectory(smoothed)

    def counts(self) -> Mapping[str, int]:
        """Number of scans in which objects moved, if there were any."""
        scans = self._moving.report.scans
        return {"scans_with_moving_objects": scans} if scans else {}

    def warnings(self) -> list[str]:
        """Problems so far."""
        return [*self._tilt.warnings(), *self._faults.warnings()]

    @property
    def found(self) -> Mapping[SensorFault, DetectedFault]:
        """Faults so far."""
        return self._faults.found
