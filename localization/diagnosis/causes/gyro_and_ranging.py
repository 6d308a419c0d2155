"""Causes in the gyro and in the LiDAR's ranging."""

from __future__ import annotations

import dataclasses

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, add, cause_of
from localization.evidence import sensor_errors
from motion_models.robot import Mount

_GYRO_BIAS_SIGMA = 0.01
"""Zero-rate offset of MEMS gyros that robots carry, after the zeroing at switch-on that drivers do: 0.5 to 1 deg/s at most by the data
sheets (BMI088: 1 deg/s; MPU-9250: 5 deg/s before zeroing; ADIS16470: 0.2 deg/s) [rad/s]."""
_RANGE_BIAS_SIGMA_M = 0.05
"""Ranging errors of time-of-flight scanners: 0.03 to 0.05 m by data sheets (SICK LMS1xx, Velodyne VLP-16). A healthy scanner has the 0.03 m
that are tolerated (SICK LMS1xx: systematic error 30 mm, 40 mm at most)."""


def _correct_gyro_scale(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    return draft.with_robot(imu=sensor_errors.GYRO_SCALE.correct(draft.robot, "", Mount(), size).imu)


def _correct_range_scale(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    return draft.with_robot(lidar=sensor_errors.RANGE_SCALE.correct(draft.robot, "", Mount(), size).lidar)


def _correct_range_bias(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    lidar = draft.robot.lidar
    return draft.with_robot(lidar=dataclasses.replace(lidar, range_offset_m=lidar.range_offset_m + size))


GYRO_BIAS = Cause(
    "gyro_bias",
    *("rad/s", "the gyro's rate at standstill", 0.02, 0.0075, add("gyro_bias")),
    ("the gyro reads {} to the left at standstill", "the gyro reads {} to the right at standstill"),
    correct=lambda d, s: d.with_step(f"the gyro's bias is {s:+.5f} rad/s; let the driver zero it while the robot stands."),
    remedy="let the driver zero the gyro while the robot stands",
    applies=lambda s: s.has_gyro and s.kind != "runs",
    is_shown_by_headings=True,
    prior_sigma=_GYRO_BIAS_SIGMA,
)
GYRO_SCALE = cause_of(
    sensor_errors.GYRO_SCALE,
    "the gyro's rates are larger than the truth by this share",
    (0.03, 0.005),
    add("gyro_scale"),
    correct=_correct_gyro_scale,
    applies=lambda s: s.has_gyro,
    is_shown_by_headings=True,
)
RANGE_SCALE = cause_of(
    sensor_errors.RANGE_SCALE,
    "the LiDAR's ranges are longer than the truth by this share",
    (0.02, 0.003),
    add("range_scale"),
    correct=_correct_range_scale,
    applies=lambda s: s.has_ranges,
)
RANGE_BIAS = Cause(
    "range_bias",
    *("m", "the LiDAR's ranges are longer than the truth by this, whatever the distance", 0.05, 0.03, add("range_bias_m")),
    ("the LiDAR's ranges are {} too long, whatever the distance", "the LiDAR's ranges are {} too short, whatever the distance"),
    correct=_correct_range_bias,
    remedy="correct the offset of the ranges in the LiDAR's driver, or set range_offset_m = {r.lidar.range_offset_m:.3f} in [lidar]",
    applies=lambda s: s.has_ranges,
    prior_sigma=_RANGE_BIAS_SIGMA_M,
)
