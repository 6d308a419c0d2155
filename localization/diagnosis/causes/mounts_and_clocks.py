"""Causes in the mount of the LiDAR and in the sensors' clocks; of a reference, where that measured the motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, add, add_item
from motion_models.robot import Mount

_TRANSFORM = "than its transform has it"
_CLOCK_SIGMA_S = 0.2
"""Latency of drivers and of clocks that are not synchronized, as in the logs that come with the tests (0.04 to 0.2 s) [s]."""
_REMEDY = "measure the LiDAR's mount, and correct its transform"


def _move_lidar(name: str, unit: str) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Moves the mount of the LiDAR along or about one axis; the file's mount then goes before the log's transforms."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        drive, robot = draft.drive, draft.robot
        if not drive.is_lidar_reference:
            return draft.with_step(
                f"the reference tracks a frame whose {name} is off by {size:+.4f} {unit}: move the marker, or transform its poses."
            )
        frame = drive.lidar_frame or "laser"
        old = robot.mounts[frame] if frame in robot.tf.overridden else drive.lidar_mount or robot.mounts.get(frame, Mount())
        mounts = {**robot.mounts, frame: dataclasses.replace(old, **{name: getattr(old, name) + size})}
        overridden = tuple(dict.fromkeys([*robot.tf.overridden, frame]))
        draft = draft.with_robot(mounts=mounts, tf=dataclasses.replace(robot.tf, overridden=overridden))
        text = (
            f"robot.toml overrides the transform of {frame} that /tf_static has ([mounts], [tf] overridden): correct it in the URDF, and"
            " then remove both entries."
        )
        return draft if text in draft.steps else draft.with_step(text)

    return correct


def _shift_clock(sensor: str, entry: str) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Writes the offset of a sensor's clock."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        if entry == "lidar_time_offset_s" and not draft.drive.is_lidar_reference:
            return draft.with_step(f"shift the reference's stamps by {-1e3 * size:+.0f} ms, or synchronize its clock.")
        clock = draft.robot.clock
        draft = draft.with_robot(clock=dataclasses.replace(clock, **{entry: getattr(clock, entry) + size}))
        late = f"{1e3 * abs(size):.0f} ms {'late' if size > 0.0 else 'early'}"
        return draft.with_step(
            f"stamps of {sensor} {late}: [clock] corrects them; synchronize the clocks or correct the driver, and remove it."
        )

    return correct


LIDAR_OFFSET_X = Cause(
    "lidar_offset_x",
    *("m", "the tracked sensor sits farther ahead than by its transform", 0.05, 0.005, add_item("lidar_offset", 0)),
    (f"the tracked sensor sits {{}} farther ahead {_TRANSFORM}", f"the tracked sensor sits {{}} farther back {_TRANSFORM}"),
    correct=_move_lidar("x", "m"),
    remedy=_REMEDY,
    reference_words=(
        "the point that the reference tracks lies {} ahead of the body's",
        "the point that the reference tracks lies {} behind the body's",
    ),
)
LIDAR_OFFSET_Y = Cause(
    "lidar_offset_y",
    *("m", "the tracked sensor sits farther left than by its transform", 0.05, 0.005, add_item("lidar_offset", 1)),
    (f"the tracked sensor sits {{}} farther left {_TRANSFORM}", f"the tracked sensor sits {{}} farther right {_TRANSFORM}"),
    correct=_move_lidar("y", "m"),
    remedy=_REMEDY,
    reference_words=(
        "the point that the reference tracks lies {} left of the body's",
        "the point that the reference tracks lies {} right of the body's",
    ),
)
LIDAR_YAW = Cause(
    "lidar_yaw",
    *("rad", "the tracked sensor is turned to the left against its transform", 0.03, 0.003, add_item("lidar_offset", 2)),
    (f"the tracked sensor is turned {{}} farther left {_TRANSFORM}", f"the tracked sensor is turned {{}} farther right {_TRANSFORM}"),
    correct=_move_lidar("yaw", "rad"),
    remedy=_REMEDY,
    applies=lambda s: s.kind != "runs" and s.has_headings,
    reference_words=("the reference's heading is turned {} to the left", "the reference's heading is turned {} to the right"),
)
WHEEL_TIME_OFFSET = Cause(
    "wheel_time_offset",
    *("s", "the wheels' stamps are late by this", 0.05, 0.008, add("wheel_time_offset_s")),
    ("the wheels' stamps are {} late", "the wheels' stamps are {} early"),
    correct=_shift_clock("wheels", "wheel_time_offset_s"),
    remedy="synchronize the clocks, or set wheel_time_offset_s = {c.wheel_time_offset_s:.3f} in [clock]",
    applies=lambda s: s.is_timed,
    is_shown_by_headings=True,
    is_clock=True,
    prior_sigma=_CLOCK_SIGMA_S,
)
LIDAR_TIME_OFFSET = Cause(
    "lidar_time_offset",
    *("s", "the LiDAR's stamps are late by this", 0.05, 0.008, add("lidar_time_offset_s")),
    ("the LiDAR's stamps are {} late", "the LiDAR's stamps are {} early"),
    correct=_shift_clock("LiDAR", "lidar_time_offset_s"),
    remedy="synchronize the clocks, or set lidar_time_offset_s = {c.lidar_time_offset_s:.3f} in [clock]",
    applies=lambda s: s.is_timed_with_positions,
    reference_words=("the reference's stamps are {} late", "the reference's stamps are {} early"),
    is_clock=True,
    prior_sigma=_CLOCK_SIGMA_S,
)
GYRO_TIME_OFFSET = Cause(
    "gyro_time_offset",
    *("s", "the gyro's stamps are late by this", 0.05, 0.008, add("gyro_time_offset_s")),
    ("the gyro's stamps are {} late", "the gyro's stamps are {} early"),
    correct=_shift_clock("IMU", "gyro_time_offset_s"),
    remedy="synchronize the clocks, or set gyro_time_offset_s = {c.gyro_time_offset_s:.3f} in [clock]",
    applies=lambda s: s.has_gyro,
    is_shown_by_headings=True,
    is_clock=True,
    prior_sigma=_CLOCK_SIGMA_S,
)
