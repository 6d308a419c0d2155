"""Causes: what may differ on robot, floor or sensors. Each has a signature, the change that it makes in the predicted motions.

A cause is one object: what it changes, in which drives it shows, how it is written into a robot file, and what to do about it. A new one
is one file here, or an object in the file of its family, and one line in `CAUSES`.
"""

from __future__ import annotations

from collections.abc import MutableMapping

from localization.diagnosis.causes import floor, gyro_and_ranging, load, mounts_and_clocks, slips, slopes, wheels
from localization.diagnosis.causes.cause import Cause

CAUSES: MutableMapping[str, Cause] = {
    "wheel_radius_scale": wheels.WHEEL_RADIUS_SCALE,
    "wheel_radius_difference": wheels.WHEEL_RADIUS_DIFFERENCE,
    "track_width": floor.TRACK_WIDTH,
    "payload": load.PAYLOAD,
    "cg_offset_x": load.CG_OFFSET_X,
    "cg_offset_y": load.CG_OFFSET_Y,
    "lidar_offset_x": mounts_and_clocks.LIDAR_OFFSET_X,
    "lidar_offset_y": mounts_and_clocks.LIDAR_OFFSET_Y,
    "lidar_yaw": mounts_and_clocks.LIDAR_YAW,
    "wheel_time_offset": mounts_and_clocks.WHEEL_TIME_OFFSET,
    "lidar_time_offset": mounts_and_clocks.LIDAR_TIME_OFFSET,
    "gyro_time_offset": mounts_and_clocks.GYRO_TIME_OFFSET,
    "friction_anisotropy": floor.FRICTION_ANISOTROPY,
    "split_friction": floor.SPLIT_FRICTION,
    "lateral_force_law": floor.LATERAL_FORCE_LAW,
    "diagonal_load": floor.DIAGONAL_LOAD,
    "tread_asymmetry": floor.TREAD_ASYMMETRY,
    "rolling_resistance": floor.ROLLING_RESISTANCE,
    "scrub": floor.SCRUB,
    "slope": floor.SLOPE_ALONG,
    "encoder_dropout": wheels.ENCODER_DROPOUT,
    "gyro_bias": gyro_and_ranging.GYRO_BIAS,
    "gyro_scale": gyro_and_ranging.GYRO_SCALE,
    "range_scale": gyro_and_ranging.RANGE_SCALE,
    "range_bias": gyro_and_ranging.RANGE_BIAS,
    "wheel_radius_drift": wheels.WHEEL_RADIUS_DRIFT,
    "lateral_slip_speed": slips.LATERAL_SLIP_SPEED,
    "rotation_slip_speed": slips.ROTATION_SLIP_SPEED,
    "longitudinal_slip_turning": slips.LONGITUDINAL_SLIP_TURNING,
    "slope (across)": floor.SLOPE_ACROSS,
    "friction_change": floor.FRICTION_CHANGE,
    "longitudinal_slip_curvature": slips.LONGITUDINAL_SLIP_CURVATURE,
    "wheel_lag": wheels.WHEEL_LAG,
    "rotation_scale": slips.ROTATION_SCALE,
    "rotation_slip_rate": slips.ROTATION_SLIP_RATE,
    "rotation_slip_curvature": slips.ROTATION_SLIP_CURVATURE,
    "cg_height": slopes.CG_HEIGHT,
    "grip": slopes.GRIP,
}
"""All causes by id, in the order in which ties are decided."""
MISSING_MESSAGES, FROZEN_ENCODER = wheels.MISSING_MESSAGES, wheels.FROZEN_ENCODER
COUNTED = (MISSING_MESSAGES, FROZEN_ENCODER)
"""Causes that are counted where the log is read, and not estimated from the motion."""
STIFFNESS_EXPONENT = "stiffness_exponent"
"""Id of the cause of a healthy drive alone (`weigh.stiffness_exponent_cause`): how slow turns differ from fast ones."""
