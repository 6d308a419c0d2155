"""The checks, in the order in which they are applied."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from localization.estimators import Estimate, Estimator, Residuals
from localization.events import ImuSample, Scan, Step
from localization.lidar import LidarConfig
from localization.sensor_checks.clocks import ClockCheck
from localization.sensor_checks.contradictions import Contradictions
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.gyro_rate import GyroRate, rate_off
from localization.sensor_checks.inflation import CovarianceInflation, lever_of_unknown_front
from localization.sensor_checks.known_places import KnownPlaces
from localization.sensor_checks.lidar_tilt import LidarTilt
from localization.sensor_checks.moving_objects import MAX_NIS, MovingObjects
from localization.sensor_checks.own_body import OwnBody
from localization.sensor_checks.reckoning import ESTIMATE, ReckonedStep
from localization.sensor_checks.sensor_consistency import SensorConsistency
from localization.sensor_checks.standstill import Standstill
from localization.sensor_checks.sweep_times import SweepTimes
from localization.sensor_checks.window import Window
from localization.synchronizer import StepConfig
from localization.trajectory import Trajectory
from motion_models.robot import Mount, Robot

_TOGETHER_S = 0.5
"""Steps of this time are examined together while no check acts [s]. Faults are found by windows of 2.5 s and more."""


class _Record(NamedTuple):
    """A step, and what the estimator has made of it."""

    step: Step
    estimate: Estimate
    residuals: Residuals | None
    reckoned: ReckonedStep


class SensorChecks:
    """`apply` to each step before the estimator, `inflate` its estimate, and `examine` the steps that were published.

    While the sensors agree, steps and estimates are as they came: they are recorded, and examined together afterwards. Where a check
    changes them, or the wheels stand, each step is examined as it comes.
    """

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig, step_config: StepConfig, robot: Robot | None = None) -> None:
        """``robot``: whose clocks and front may not be known for sure; None where they are."""
        self._inflation = CovarianceInflation(lever_of_unknown_front(robot, mounts))
        self._faults = faults = FaultLog(self._inflation)
        self._window = window = Window(mounts, config)
        self._moving, self._sweep_times = MovingObjects(faults, window), SweepTimes(faults)
        self._own_body, self._contradictions, self._gyro_rate = OwnBody(faults), Contradictions(faults), GyroRate(faults)
        self._standstill = Standstill(faults, window, step_config)
        self._consistency, self._places, self._tilt = SensorConsistency(faults), KnownPlaces(faults), LidarTilt(mounts)
        self._clocks = ClockCheck(faults, 0.0 if robot is None else robot.clock.sigma_s)
        self._mounts, self._is_lidar_placed = mounts, True
        self._reckoning = self._inflation.reckoning
        self._records: list[_Record] = []
        self._is_acting = True

    def insert_imu(self, sample: ImuSample) -> None:
        """Specific force shows whether the robot moves."""
        self._standstill.insert_imu(sample)

    def correct(self, scan: Scan) -> Scan:
        """``scan`` with the times of its points as they were found to be."""
        return replace(scan, offsets=-scan.offsets) if self._sweep_times.is_reversed and scan.is_planar else scan

    def apply(self, step: Step, estimator: Estimator) -> Step:
        """``step`` without the sensors that are faulty, and with a wide covariance where the wheels are uncertain; ``estimator`` has made
        the estimates so far."""
        if not math.isfinite(step.predicted.delta.sum()):
            return step  # the estimator refuses it
        step = self._own_body.remove(step)
        if not self._is_acting and not step.is_standing and (step.turn is None or not rate_off(step)):
            self._reckoning.predict(step)
            return step
        self._examine_records(estimator)
        self._is_acting = True
        step = self._compare_sensors(step, is_to_come=True)
        self._reckoning.predict(step)
        step = self._moving.apply(step, is_to_come=True)
        if self._faults.is_map_wrong:
            self._faults.is_map_wrong = False
            step = replace(step, restarts_map=True)  # without the scans that had the fault
        if self._faults.have_scans_led_away:
            self._faults.have_scans_led_away = False
            step = self._inflation.lead_back(step)
        return step

    def inflate(self, step: Step, estimate: Estimate, estimator: Estimator) -> Estimate:
        """``estimate`` of ``estimator`` after ``step`` with the covariance of what faulty sensors have done to it; unchanged without one
        (LiDAR alone)."""
        residuals = estimator.residuals
        pose = estimate.pose if estimate.odometry is None or estimate.map_T_odom is None else estimate.odometry[0]  # by sensors alone
        self._reckoning.correct(step, pose, None if residuals is None else residuals.file_delta)
        record = _Record(step, estimate, residuals, self._reckoning.step)
        if self._is_acting:
            self._add(record, estimator)
        else:
            self._records.append(record)
            self._is_acting = self._moving.is_off() or not (estimate.nis is None or estimate.nis < MAX_NIS)
            if self._is_acting:
                self._examine_records(estimator)
        if self._is_acting:
            estimate, self._is_acting = self._inflate(record, estimator), self._has_to_act()
        late_s, twist = self._inflation.late_s, estimate.twist  # the way in the time by which the clock of the poses may be off
        return estimate if not late_s or twist is None else estimate.widened(twist[:, None] * twist * late_s**2)

    def examine(self, estimator: Estimator, *, is_last: bool = False) -> None:
        """Examine the steps that ``estimator`` has published, once there are enough, or none ``is_last``."""
        records = self._records
        if records and (is_last or (records[-1].step.end_ns - records[0].step.start_ns) * 1e-9 >= _TOGETHER_S):
            last = records[-1]
            self._examine_records(estimator)
            self._inflate(last, estimator)
            self._is_acting = self._has_to_act()

    def _has_to_act(self) -> bool:
        """Whether a check changes the next step, or its estimate."""
        is_led_away = self._faults.is_map_wrong or self._faults.have_scans_led_away
        is_step_changed = self._gyro_rate.is_acting or self._contradictions.is_acting or self._moving.is_acting
        return is_led_away or is_step_changed or self._inflation.is_acting

    def _examine_records(self, estimator: Estimator) -> None:
        records, self._records = self._records, []
        for record in records:
            self._reckoning.poses = record.reckoned.before
            self._compare_sensors(record.step, is_to_come=False)
            self._reckoning.poses = record.reckoned.predicted
            self._moving.apply(record.step, is_to_come=False)
            self._reckoning.poses = record.reckoned.after
            self._add(record, estimator)
        self._own_body.report()  # of steps up to here, whose sensors are compared

    def _compare_sensors(self, step: Step, *, is_to_come: bool) -> Step:
        """``step`` without sensors that contradict the others, for the estimator, for which it ``is_to_come``, or was."""
        self._faults.start_step(step)
        if step.scan is not None and not step.scan.is_planar:
            self._tilt.add(step.scan)
        if self._window.add(step, self._faults.now_s):
            self._sweep_times.compare(self._window)
            if self._contradictions.compare(self._window) and self._sweep_times.are_likely_right:
                self._inflation.restart()
        excluded = self._contradictions.excluded if self._faults.declared and is_to_come else ()
        step = self._gyro_rate.apply(step)
        step = replace(step, turn=None) if "gyro" in excluded else step
        step = step.without_scan() if "LiDAR" in excluded else step
        return self._standstill.apply(step, is_contradicted="wheels" in excluded)

    def _add(self, record: _Record, estimator: Estimator) -> None:
        """Compare innovations and learned parameters with their covariances.

        Parameters that are learned from a LiDAR without a mount, as the centre of rotation, are not those of the robot file.
        """
        step, estimate, residuals, _ = record
        self._moving.keep_view()
        if estimate.nis is not None:
            self._standstill.restart()
        if residuals is not None:
            if step.scan is not None:
                self._is_lidar_placed = step.scan.frame_id in self._mounts
            self._consistency.add(step, residuals, estimator.learned_parameters if self._is_lidar_placed else tuple)
        if estimate.covariance is not None:
            self._moving.compare_estimate(estimate.nis)
            self._consistency.compare_estimate(estimate.nis)

    def _inflate(self, record: _Record, estimator: Estimator) -> Estimate:
        """The estimate with the covariance of the distances from dead reckonings, and of clocks that are apart."""
        scan, estimate = record.step.scan, record.estimate
        if estimate.covariance is None:
            return estimate
        self._clocks.add(estimator)
        inflated = self._inflation.inflate(estimate)
        pose = self._reckoning.poses[ESTIMATE]
        if scan is not None and self._places.update(lambda: self._window.profile(scan), pose):
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
