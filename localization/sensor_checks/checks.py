"""The checks of sensors: of each step before or after the estimator has it (`step_checks`), and of its estimate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from localization.estimators import Estimate, Estimator, Residuals
from localization.events import ImuSample, Scan, Step
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.messages import Message
from localization.sensor_checks.bias_changes import BiasChangeCheck
from localization.sensor_checks.clocks import ClockCheck
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.gyro_rate import rate_off
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.known_places import KnownPlaces
from localization.sensor_checks.moving_objects import MAX_NIS, MIN_OFF_M
from localization.sensor_checks.pairs import GYRO_WHEELS, usual_errors
from localization.sensor_checks.path_uncertainty import PathUncertainty, lever_of_unknown_front
from localization.sensor_checks.sensor_consistency import SensorConsistency
from localization.sensor_checks.step_checks import StepChecks
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Mount, Robot
from motion_models.se2 import Pose2


class Record(NamedTuple):
    """A step, and what the estimator has made of it."""

    step: Step
    estimate: Estimate
    pose: Pose2
    """(3,) of the estimate, by sensors alone: without what loops have moved it by."""
    residuals: Residuals | None
    is_compared: bool
    """Its sensors were compared before the estimator had it."""


class Records:
    """`add` each step, and `take` all that wait when they are examined."""

    def __init__(self) -> None:
        self.waiting: list[Record] = []
        """Steps that were not examined yet."""
        self._by_wheels = np.zeros(3)  # pose
        self._examined = np.zeros((2, 3)), np.zeros((2, 3))  # poses by wheels and estimate at the last examination but one, and at the last

    def add(self, record: Record) -> bool:
        """Let ``record`` wait; whether it has to be examined at once: its scan contradicts all else, or the estimate has left the motion by
        the wheels since the last examination but one."""
        self.waiting.append(record)
        self._by_wheels = se2.compose(self._by_wheels, record.step.predicted.delta)
        x, y, _ = np.subtract(*se2.between(self._examined[0], (self._by_wheels, record.pose)))
        nis = record.estimate.nis
        return math.hypot(x, y) > MIN_OFF_M or not (nis is None or nis < MAX_NIS)

    def take(self) -> list[Record]:
        """All that wait, one at least, to be examined now."""
        records, self.waiting = self.waiting, []
        self._examined = self._examined[1], np.array([self._by_wheels, records[-1].pose])
        return records


_TOGETHER_S = 0.5
"""Steps of this time are examined together while no check acts [s]. Faults are found by windows of 2.5 s and more."""


class SensorChecks:
    """`apply` to each step before the estimator, `inflate` its estimate, and `examine` the steps that were published.

    Steps are recorded with their estimates, and the records examined in their order. While the sensors agree, steps and estimates are as
    they came, and half a second of them is examined together afterwards. Where a check changes them, or the wheels stand, a step's sensors
    are compared before the estimator has it, and its record is examined before it is published.
    """

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig, step_config: StepConfig, robot: Robot) -> None:
        """``robot``: whose clocks, front and slip may not be known for sure."""
        self._inflation, usual = CovarianceInflation(), usual_errors(robot)
        self._faults = faults = FaultLog(self._inflation, PathUncertainty(lever_of_unknown_front(robot, mounts)))
        self._steps = StepChecks(faults, mounts, config, step_config, usual[GYRO_WHEELS])
        self._consistency, self._places = SensorConsistency(faults, usual), KnownPlaces(faults)
        self._clocks, self._biases = ClockCheck(faults, robot.clock.sigma_s), BiasChangeCheck(faults)
        self._mounts, self._is_lidar_placed = mounts, True
        self._records = Records()
        self._is_acting = True

    def insert_imu(self, sample: ImuSample) -> None:
        """Specific force shows whether the robot moves."""
        self._steps.standstill.insert_imu(sample)

    def correct(self, scan: Scan) -> Scan:
        """``scan`` with the times of its points as they were found to be."""
        times = self._steps.sweep_times
        return times.correct(scan) if times.is_wrong else scan

    def apply(self, step: Step, estimator: Estimator) -> Step:
        """``step`` without the sensors that are faulty, and with a wide covariance where the wheels are uncertain; ``estimator`` has made
        the estimates so far."""
        if not math.isfinite(step.predicted.delta.sum()):
            return step  # the estimator refuses it
        if self._steps.own_body.is_found:
            step = self._steps.own_body.remove(step)
        if not (self._is_acting or step.is_standing or (step.turn is not None and rate_off(step))):
            return step
        self._examine_records(estimator)
        self._is_acting = True
        step = self._steps.compare(step, is_to_come=True)
        if self._steps.moving.is_led_away:
            step = self._steps.moving.lead_back(step)
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
        pose = estimate.pose if estimate.odometry is None or estimate.map_T_odom is None else estimate.odometry[0]
        contradicts = self._records.add(Record(step, estimate, pose, estimator.residuals, self._is_acting))
        if self._is_acting or contradicts:
            estimate = self._examine_records(estimator) or estimate
        path = self._faults.path
        return path.widen(estimate, pose) if path.is_any else estimate

    def examine(self, estimator: Estimator, *, is_last: bool = False) -> None:
        """Examine the steps that ``estimator`` has published, once there are enough, or none ``is_last``."""
        records = self._records.waiting
        if records and (is_last or (records[-1].step.end_ns - records[0].step.start_ns) * 1e-9 >= _TOGETHER_S):
            self._examine_records(estimator)

    def _examine_records(self, estimator: Estimator) -> Estimate | None:
        """Examine the records, and decide whether a check has to act from here on; the last estimate with its covariance."""
        if not self._records.waiting:
            return None
        records = self._records.take()
        for record in records:
            if not record.is_compared:
                self._steps.compare(record.step, is_to_come=False)
            self._compare_estimate(record, estimator)
        self._steps.own_body.report()  # of steps up to here, whose sensors are compared
        inflated = self._inflate(records[-1], estimator)
        is_led_away = self._faults.is_map_wrong or self._faults.have_scans_led_away
        self._is_acting = is_led_away or self._steps.is_acting or self._inflation.is_acting
        return inflated

    def _compare_estimate(self, record: Record, estimator: Estimator) -> None:
        """Compare innovations and learned parameters with their covariances.

        Parameters that are learned from a LiDAR without a mount, as the centre of rotation, are not those of the robot file.
        """
        step, estimate, pose, residuals, _ = record
        self._inflation.reckoning.correct(step, pose, None if residuals is None else residuals.file_delta)
        self._steps.moving.compare_estimate(estimate)
        if estimate.nis is not None:
            self._steps.standstill.restart()
        if residuals is not None:
            if step.scan is not None:
                self._is_lidar_placed = step.scan.frame_id in self._mounts
            self._consistency.add(step, residuals, estimator.learned_parameters if self._is_lidar_placed else tuple)
        if estimate.covariance is not None:
            self._consistency.compare_estimate(estimate.nis)

    def _inflate(self, record: Record, estimator: Estimator) -> Estimate:
        """The estimate with the covariance of the distances from dead reckonings, and of clocks that are apart."""
        scan, estimate = record.step.scan, record.estimate
        if estimate.covariance is None:
            return estimate
        self._clocks.add(estimator)
        self._biases.add(estimator)
        inflated = self._inflation.inflate(estimate)
        if scan is not None and self._places.update(lambda: self._steps.window.scans.profile(scan), record.pose):
            self._consistency.restart()  # a place from before the faults shows the pose: differences count from here on
        return inflated

    def inflate_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the same covariance at its end, from the first fault on."""
        return self._inflation.inflate_trajectory(self._faults.path.widen_trajectory(smoothed))

    def counts(self) -> Mapping[str, int]:
        """Number of scans in which objects moved, if there were any."""
        scans = self._steps.moving.report.scans
        return {"scans_with_moving_objects": scans} if scans else {}

    def warnings(self) -> list[Message]:
        """Problems so far."""
        return [*self._steps.tilt.warnings(), *self._faults.warnings()]

    def inflation_reasons(self) -> list[Message]:
        """See `SensorConsistency.inflation_reasons`."""
        return self._consistency.inflation_reasons()

    @property
    def found(self) -> Mapping[SensorFault, DetectedFault]:
        """Faults so far."""
        return self._faults.found
