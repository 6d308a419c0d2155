"""A robot is one TOML file: geometry, mounts, topics, joint names, noise and the coefficients of its motion models."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from motion_models.center_of_gravity.parts import Arms
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray
from motion_models.terms import Term

DIFF_DRIVE = "diff_drive"
"""`Robot.drive` of two driven wheels and casters."""
DRIVES = ("skid_steer", DIFF_DRIVE)


@dataclass(frozen=True)
class Geometry:
    """Lengths between the wheels' contacts with the floor, mass and centre of gravity."""

    wheel_radius_m: float
    """Radius of the wheels, times the gear ratio where the wheel rates are those of the motor."""
    track_width_m: float
    """Distance between the left and the right wheels' contacts."""
    wheelbase_m: float
    """Distance between the front and the rear wheels' contacts."""
    mass_kg: float
    """Mass of the whole vehicle with its arms and sensors."""
    cg_height_m: float = 0.2
    """Height of the centre of gravity above the floor."""
    cg_x_m: float = 0.0
    """Centre of gravity ahead of the wheelbase's centre, used where the log has none."""
    cg_y_m: float = 0.0
    """Centre of gravity left of the wheelbase's centre, used where the log has none."""
    cg_offset_x_m: float = 0.0
    """How much farther ahead the centre of gravity lies than by `cg_x_m`, by the arms or by its topic, whichever is used."""
    cg_offset_y_m: float = 0.0
    """How much farther left the centre of gravity lies than by `cg_y_m`, by the arms or by its topic, whichever is used."""
    left_wheel_radius_multiplier: float = 1.0
    """Rolled distance of the left wheels over `wheel_radius_m` times their angle, as in ROS's diff_drive_controller."""
    right_wheel_radius_multiplier: float = 1.0
    """Rolled distance of the right wheels over `wheel_radius_m` times their angle."""
    wheel_deflection: float = 0.01
    """How far a wheel gives way under a quarter of the weight, over its radius. A tyre of radius R and half width r carries its load by the
    pressure p on its contact, an ellipse: m g / (8 pi p R sqrt(R r)), 0.011 on a Husky and 0.015 on a Jackal at 1 bar."""

    @property
    def radius_multipliers(self) -> FloatArray:
        """(2,) left and right; wheel rates of logs and topics are multiplied by them."""
        return np.array([self.left_wheel_radius_multiplier, self.right_wheel_radius_multiplier])

    @property
    def cg_offset(self) -> FloatArray:
        """(2,) x and y that are added to the centre of gravity of every source [m]."""
        return np.array([self.cg_offset_x_m, self.cg_offset_y_m])


@dataclass(frozen=True)
class Clock:
    """Offsets of the sensors' clocks: what happened at t is stamped t + offset. Stamps are corrected by them when messages are decoded."""

    wheel_time_offset_s: float = 0.0
    """By how much the wheels' stamps are late [s]."""
    lidar_time_offset_s: float = 0.0
    """By how much the LiDAR's stamps are late [s]."""
    gyro_time_offset_s: float = 0.0
    """By how much the IMU's stamps are late [s]."""
    wheel_rate_error: float = 0.0
    """By how much faster the wheels' clock runs than the recorder's [s/s], from the start of a log on; a live node does not use it."""
    lidar_rate_error: float = 0.0
    """By how much faster the LiDAR's clock runs than the recorder's [s/s], from the start of a log on; a live node does not use it."""
    gyro_rate_error: float = 0.0
    """By how much faster the IMU's clock runs than the recorder's [s/s], from the start of a log on; a live node does not use it."""
    sigma_s: float = 0.0
    """By how much all stamps, so corrected, may be off [s]: the poses' covariance has the way in that time."""


@dataclass(frozen=True)
class Driver:
    """How the robot's own driver turns wheel rates into the odometry that it publishes (needed to invert it)."""

    wheel_radius_m: float
    """Radius by which it turns wheel rates into speed (times its own multiplier, if it has one)."""
    track_width_m: float
    """Its wheel separation."""
    wheel_separation_multiplier: float = 1.0
    """The one hand-tuned number of a diff-drive driver; 1.875 on a stock Husky."""
    length_unit_m: float = 1.0
    """Metres per unit of the positions and speeds that it publishes: 0.001 for millimetres, 0.277778 for a speed in km/h."""
    max_speed_m_s: float = 4.0
    """Fastest speed that the robot drives [m/s], as its controller's linear.x.max_velocity: rates of the wheels that are 1.5 times as fast
    have another unit."""

    @property
    def half_track_m(self) -> float:
        """Speed of the right side over the turn rate, by the driver, where the robot turns in place [m]."""
        return 0.5 * self.wheel_separation_multiplier * self.track_width_m


@dataclass(frozen=True)
class Topics:
    """Topics of the log. One that is the only one of its type is found without being named here."""

    joint_states: str = "/joint_states"
    """sensor_msgs/JointState of the wheels, and of the arms."""
    odometry: str = "/odom"
    """nav_msgs/Odometry of the robot's own driver, used where there are no joint states of wheels."""
    scan: str = "/scan"
    """sensor_msgs/LaserScan; several planar scanners with commas (/front/scan,/rear/scan)."""
    points: str = "/points"
    """sensor_msgs/PointCloud2, used where there is no planar scan."""
    imu: str = "/imu/data"
    """sensor_msgs/Imu, of which the yaw rate is used."""
    center_of_gravity: str = "/center_of_gravity"
    """geometry_msgs/PointStamped in the body frame; goes before the arms."""
    reference: str = "/ground_truth/odom"
    """Results are scored against it; estimators do not use it."""


@dataclass(frozen=True)
class Joints:
    """Names in the joint states. The rate of a side is the mean over its wheels."""

    left: tuple[str, ...] = ("front_left_wheel", "rear_left_wheel")
    """Wheels of the left side."""
    right: tuple[str, ...] = ("front_right_wheel", "rear_right_wheel")
    """Wheels of the right side."""
    reversed: tuple[str, ...] = ()
    """Wheels of both sides whose angles and rates are negative when the robot drives forward: motors mounted in mirror image."""
    angle_unit_rad: float = 1.0
    """Radians per unit of the positions: 0.0174533 for degrees, 2 pi over the counts of a turn for ticks, 1 over the radius for metres."""
    rate_unit_rad_s: float = 1.0
    """Radians per second per unit of the velocities: 0.10472 for revolutions per minute, 0.0174533 for degrees per second."""
    is_front_known: bool = True
    """False: which end of the robot is its front is not known, and the poses' covariance has twice the way from the start."""
    angle_range: float = 0.0
    """Range after which the positions wrap, in their own unit: 65536 for counters of 16 bits. 0: a full turn of the wheel."""

    def renamed(self, names: Mapping[str, str]) -> Joints:
        """Rename the wheels: ``names`` has the new name of each by the present one."""
        left, right, backwards = (tuple(names[joint] for joint in side) for side in (self.left, self.right, self.reversed))
        return replace(self, left=left, right=right, reversed=backwards)

    def of_sides(self, left: str, right: str) -> Joints:
        """One joint a side, ``left`` and ``right``, reversed where all wheels of that side are."""
        backwards = ((left, self.left), (right, self.right))
        return replace(self, left=(left,), right=(right,), reversed=tuple(name for name, side in backwards if {*side} <= {*self.reversed}))


@dataclass(frozen=True)
class Imu:
    """How the IMU's driver publishes."""

    rate_unit_rad_s: float = 1.0
    """Rad/s per unit of its angular velocities: 0.0174533 for degrees per second; negative where they have the opposite sign."""


@dataclass(frozen=True)
class Lidar:
    """How the LiDAR measures distances; ranges are corrected when scans are decoded."""

    range_scale: float = 1.0
    """Measured ranges over the true ones, less what `range_offset_m` adds."""
    range_offset_m: float = 0.0
    """By how much all ranges are too long [m]."""

    @property
    def is_exact(self) -> bool:
        """Whether ranges are taken as they are."""
        return self.range_scale == 1.0 and self.range_offset_m == 0.0


@dataclass(frozen=True)
class Tf:
    """How the transforms of logs and topics are used."""

    overridden: tuple[str, ...] = ()
    """Frames whose [mounts] go before their transforms by /tf_static."""


@dataclass(frozen=True)
class Mount:
    """Where a sensor's frame sits in the body frame: x, y, z [m], then roll, pitch, yaw [rad] (fixed axes, as in URDF)."""

    x: float = 0.0
    """Ahead of the wheelbase's centre [m]."""
    y: float = 0.0
    """Left of it [m]."""
    z: float = 0.0
    """Above it [m]."""
    roll: float = 0.0
    """[rad]"""
    pitch: float = 0.0
    """[rad]"""
    yaw: float = 0.0
    """[rad]"""

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) matrix that takes vectors of the sensor's frame into the body frame."""
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        cp, sp = math.cos(self.pitch), math.sin(self.pitch)
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


@dataclass(frozen=True)
class WheelNoise:
    """Noise of the wheels: variances of slip, which grow with the motion, and a floor for model discrepancy.

    The yaw's numbers are those of Huskies on floors, asphalt, ice and loam whose track was fitted to each ground (BorealTC's gyro and
    wheel speeds: 5e-4 to 2e-3 per metre, 2e-3 to 2e-2 per radian).
    """

    longitudinal_m2_per_m: float = 4e-4
    """Variance of the distance, per metre driven (4e-4: 2 cm after one metre)."""
    lateral_m2_per_m: float = 1e-4
    """Variance of the sideways displacement, per metre driven."""
    lateral_m2_per_rad: float = 4e-4
    """Variance of the sideways displacement, per radian turned: the unknown centre of rotation."""
    longitudinal_m2_per_rad: float = 4e-4
    """Variance of the distance, per radian turned."""
    yaw_rad2_per_rad: float = 1e-2
    """Variance of the yaw, per radian turned: scrubbing."""
    yaw_rad2_per_m: float = 1e-3
    """Variance of the yaw, per metre driven."""
    floor_m2_per_s: float = 1e-6
    """Variance of each position component, per second: the floor for model discrepancy in motion, and for pushes at rest."""
    floor_rad2_per_s: float = 1e-6
    """Variance of the yaw, per second."""


@dataclass(frozen=True)
class GyroNoise:
    """Errors of the yaw gyro."""

    white_rad_per_sqrt_s: float = 2e-3
    """Angle random walk of the yaw gyro."""
    bias_sigma_rad_per_s: float = 1e-3
    """Prior sigma of the bias, after drivers have zeroed it at switch-on; a larger one is measured at standstill."""
    bias_walk_rad_per_s_sqrt_s: float = 3e-5
    """Random walk of the bias."""
    scale_sigma: float = 5e-3
    """Relative error of the scale factor, as sigma per turned angle."""


@dataclass(frozen=True)
class Robot:
    """Everything that is particular to one robot. Frames and axes as in ROS REP-103; `base` is the wheelbase's centre."""

    name: str
    geometry: Geometry
    driver: Driver
    drive: str = "skid_steer"
    """How it turns: "skid_steer" (four or more wheels, or tracks, that slide), or "diff_drive" (two driven wheels and casters)."""
    topics: Topics = Topics()
    joints: Joints = Joints()
    imu: Imu = Imu()
    lidar: Lidar = Lidar()
    tf: Tf = Tf()
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    wheel_noise: WheelNoise = WheelNoise()
    gyro_noise: GyroNoise = GyroNoise()
    clock: Clock = Clock()
    models: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Coefficients by model name, then by parameter name; what is not named keeps the model's own default."""
    options: Mapping[str, Mapping[str, str | bool]] = field(default_factory=dict)
    """Choices by model name, then by `Traits.options`; in the file they stand among the model's coefficients."""
    terms: Mapping[str, tuple[Term, ...]] = field(default_factory=dict)
    """Learned terms by model name (`motion_models.terms`), which are added to its twist."""
    arms: Arms | None = None
    """Arms that move the centre of gravity; None where it stays at that of `Geometry`."""
    folder: Path | None = field(default=None, compare=False)
    """Where the robot's file is, from which the paths in it start; None for a robot that is shipped. Not in the file."""

    def with_mounts(self, transforms: Mapping[str, Mount]) -> dict[str, Mount]:
        """Mounts by frame: those of ``transforms`` before those of the file, but for the frames of [tf] overridden."""
        first = {frame: self.mounts[frame] for frame in self.tf.overridden if frame in self.mounts}
        return {"base_link": Mount(), **self.mounts, **transforms, **first}

    @property
    def center_of_gravity(self) -> FloatArray:
        """(2,) nominal x, y of the centre of gravity in the body frame [m]."""
        return np.array([self.geometry.cg_x_m, self.geometry.cg_y_m]) + self.geometry.cg_offset

    def coefficients(self, model: str, names: tuple[str, ...], defaults: FloatArray) -> FloatArray:
        """(k,) parameters of ``model``: the robot's coefficients where it names them, else ``defaults`` (k,).

        Raises `RobotError` for a coefficient that the model does not have.
        """
        table = self.models.get(model, {})
        unknown = sorted(set(table) - set(names))
        if unknown:
            raise RobotError(f"robot '{self.name}': models.{model} has no parameter {', '.join(unknown)}; it has {', '.join(names)}.")
        return np.array([table.get(name, default) for name, default in zip(names, defaults, strict=True)])

    def choice(self, model: str, name: str, allowed: tuple[str, ...], default: str) -> str:
        """What [models.MODEL] chooses by ``name``. Raises `RobotError` for what is not ``allowed``."""
        chosen = self.options.get(model, {}).get(name, default)
        if chosen not in allowed:
            raise RobotError(f"robot '{self.name}': models.{model}.{name} is {chosen!r}; there are {', '.join(allowed)}.")
        return str(chosen)

    def switch(self, model: str, name: str, default: bool) -> bool:
        """Whether [models.MODEL] switches ``name`` on. Raises `RobotError` for what is neither true nor false."""
        chosen = self.options.get(model, {}).get(name, default)
        if not isinstance(chosen, bool):
            raise RobotError(f"robot '{self.name}': models.{model}.{name} is {chosen!r}; it must be true or false.")
        return chosen
