"""Causes in the mount of the LiDAR and in the sensors' clocks; of a reference, where that measured the motion."""

from __future__ import annotations

from collections.abc import Callable

from localization.diagnosis.causes.cause import CorrectionDraft, add, add_item, cause_of
from localization.evidence import sensor_errors
from localization.evidence.sensor_errors import SensorError
from motion_models.robot import Mount


def _move_lidar(error: SensorError, name: str) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Moves the mount of the LiDAR; the file's mount then goes before the log's transforms."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        drive, robot = draft.drive, draft.robot
        if not drive.is_lidar_reference:
            return draft.with_step(
                f"the reference tracks a frame whose {name} is off by {size:+.4f} {error.unit}: move the marker, or transform its poses."
            )
        frame = drive.lidar_frame or "laser"
        new = error.correct(robot, frame, drive.lidar_mount or robot.mounts.get(frame, Mount()), size)
        draft = draft.with_robot(mounts=new.mounts, tf=new.tf)
        text = (
            f"robot.toml overrides the transform of {frame} that /tf_static has ([mounts], [tf] overridden): correct it in the URDF, and"
            " then remove both entries."
        )
        return draft if text in draft.steps else draft.with_step(text)

    return correct


def _shift_clock(error: SensorError, sensor: str) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Writes the offset of a sensor's clock."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        if error is sensor_errors.LIDAR_CLOCK and not draft.drive.is_lidar_reference:
            return draft.with_step(f"shift the reference's stamps by {-1e3 * size:+.0f} ms, or synchronize its clock.")
        draft = draft.with_robot(clock=error.correct(draft.robot, "", Mount(), size).clock)
        late = f"{1e3 * abs(size):.0f} ms {'late' if size > 0.0 else 'early'}"
        return draft.with_step(
            f"stamps of {sensor} {late}: [clock] corrects them; synchronize the clocks or correct the driver, and remove it."
        )

    return correct


LIDAR_OFFSET_X = cause_of(
    sensor_errors.LIDAR_OFFSET_X,
    "the LiDAR sits farther ahead than by its transform",
    (0.05, 0.005),
    add_item("lidar_offset", 0),
    correct=_move_lidar(sensor_errors.LIDAR_OFFSET_X, "x"),
)
LIDAR_OFFSET_Y = cause_of(
    sensor_errors.LIDAR_OFFSET_Y,
    "the LiDAR sits farther left than by its transform",
    (0.05, 0.005),
    add_item("lidar_offset", 1),
    correct=_move_lidar(sensor_errors.LIDAR_OFFSET_Y, "y"),
)
LIDAR_YAW = cause_of(
    sensor_errors.LIDAR_YAW,
    "the LiDAR is turned to the left against its transform",
    (0.03, 0.003),
    add_item("lidar_offset", 2),
    correct=_move_lidar(sensor_errors.LIDAR_YAW, "yaw"),
    applies=lambda s: s.kind != "runs" and s.has_headings,
)
WHEEL_TIME_OFFSET = cause_of(
    sensor_errors.WHEEL_CLOCK,
    "the wheels' stamps are late by this",
    (0.05, 0.008),
    add("wheel_time_offset_s"),
    correct=_shift_clock(sensor_errors.WHEEL_CLOCK, "wheels"),
    applies=lambda s: s.is_timed,
    is_shown_by_headings=True,
    is_clock=True,
)
LIDAR_TIME_OFFSET = cause_of(
    sensor_errors.LIDAR_CLOCK,
    "the LiDAR's stamps are late by this",
    (0.05, 0.008),
    add("lidar_time_offset_s"),
    correct=_shift_clock(sensor_errors.LIDAR_CLOCK, "LiDAR"),
    applies=lambda s: s.is_timed_with_positions,
    is_clock=True,
)
GYRO_TIME_OFFSET = cause_of(
    sensor_errors.GYRO_CLOCK,
    "the gyro's stamps are late by this",
    (0.05, 0.008),
    add("gyro_time_offset_s"),
    correct=_shift_clock(sensor_errors.GYRO_CLOCK, "IMU"),
    applies=lambda s: s.has_gyro,
    is_shown_by_headings=True,
    is_clock=True,
)
