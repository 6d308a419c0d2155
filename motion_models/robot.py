"""A robot is one TOML file: geometry, mounts, topics, joint names, noise and the coefficients of its motion models."""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from motion_models.center_of_gravity.parts import Arms
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray
from motion_models.text_files import read_text

Section = TypeVar("Section")

_LARGEST = 1e9
"""Largest number of a robot, in SI units; the largest that robots have are stiffnesses and inertias of 1e6."""
_LONGEST_M = 100.0
"""Largest length of a robot [m]; the largest mining vehicles have 20."""
_MOST_CHARACTERS = 1 << 20
"""Most characters of a robot file; the longest that is shipped has 1,200."""
_MOST_DOTS = 200
"""In one line of a robot file: the names of a dozen wheels with their namespaces have fewer."""
_LARGEST_CLOCK_OFFSET_S = 10.0
"""Beyond it clocks are not synchronized, and no offset is constant [s]."""
_LONGEST_SHOWN = 60  # characters of what a user wrote, in a message
DIFF_DRIVE = "diff_drive"
"""`Robot.drive` of two driven wheels and casters."""
DRIVES = ("skid_steer", DIFF_DRIVE)
MODEL_OPTIONS: Mapping[str, tuple[str, ...]] = {"friction": ("contact", "centripetal")}
"""Entries of [models.NAME] that choose something, where all others are numbers."""


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
    left_wheel_radius_multiplier: float = 1.0
    """Rolled distance of the left wheels over `wheel_radius_m` times their angle, as in ROS's diff_drive_controller."""
    right_wheel_radius_multiplier: float = 1.0
    """Rolled distance of the right wheels over `wheel_radius_m` times their angle."""

    @property
    def radius_multipliers(self) -> FloatArray:
        """(2,) left and right; wheel rates of logs and topics are multiplied by them."""
        return np.array([self.left_wheel_radius_multiplier, self.right_wheel_radius_multiplier])


@dataclass(frozen=True)
class Clock:
    """Offsets of the sensors' clocks: what happened at t is stamped t + offset. Stamps are corrected by them when messages are decoded."""

    wheel_time_offset_s: float = 0.0
    """By how much the wheels' stamps are late [s]."""
    lidar_time_offset_s: float = 0.0
    """By how much the LiDAR's stamps are late [s]."""
    gyro_time_offset_s: float = 0.0
    """By how much the IMU's stamps are late [s]."""


@dataclass(frozen=True)
class Driver:
    """How the robot's own driver turns wheel rates into the odometry that it publishes (needed to invert it)."""

    wheel_radius_m: float
    """Radius by which it turns wheel rates into speed (times its own multiplier, if it has one)."""
    track_width_m: float
    """Its wheel separation."""
    wheel_separation_multiplier: float = 1.0
    """The one hand-tuned number of a diff-drive driver; 1.875 on a stock Husky."""


@dataclass(frozen=True)
class Topics:
    """Topics of the log. One that is the only one of its type is found without being named here."""

    joint_states: str = "/joint_states"
    """sensor_msgs/JointState of the wheels, and of the arms."""
    odometry: str = "/odom"
    """nav_msgs/Odometry of the robot's own driver, used where there are no joint states of wheels."""
    scan: str = "/scan"
    """sensor_msgs/LaserScan."""
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
    angle_range: float = 0.0
    """Range after which the positions wrap, in their own unit: 65536 for counters of 16 bits. 0: a full turn of the wheel."""


@dataclass(frozen=True)
class Imu:
    """How the IMU's driver publishes."""

    rate_unit_rad_s: float = 1.0
    """Rad/s per unit of its angular velocities: 0.0174533 for degrees per second; negative where they have the opposite sign."""


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
    """Variance of each position component, per second of motion: the floor for model discrepancy."""
    floor_rad2_per_s: float = 1e-6
    """Variance of the yaw, per second of motion."""


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
    mounts: Mapping[str, Mount] = field(default_factory=dict)
    wheel_noise: WheelNoise = WheelNoise()
    gyro_noise: GyroNoise = GyroNoise()
    clock: Clock = Clock()
    models: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Coefficients by model name, then by parameter name; what is not named keeps the model's own default."""
    options: Mapping[str, Mapping[str, str | bool]] = field(default_factory=dict)
    """Choices by model name, then by `MODEL_OPTIONS`; in the file they stand among the model's coefficients."""
    arms: Arms | None = None
    """Arms that move the centre of gravity; None where it stays at that of `Geometry`."""
    folder: Path | None = field(default=None, compare=False)
    """Where the robot's file is, from which the paths in it start; None for a robot that is shipped. Not in the file."""

    @property
    def center_of_gravity(self) -> FloatArray:
        """(2,) nominal x, y of the centre of gravity in the body frame [m]."""
        return np.array([self.geometry.cg_x_m, self.geometry.cg_y_m])

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


def robot_names() -> list[str]:
    """Names of the robots that are shipped."""
    return sorted(f.name.removesuffix(".toml") for f in (resources.files(__package__) / "robots").iterdir() if f.name.endswith(".toml"))


def load_robot(robot: str | Path) -> Robot:
    """The robot of a shipped name (`robot_names`) or of a path to a TOML file. Raises `RobotError`.

    >>> robot = load_robot("vaultbot")
    >>> robot.geometry.track_width_m, robot.driver.wheel_separation_multiplier
    (0.56, 1.875)
    """
    path = Path(robot)
    if path.suffix == ".toml":
        try:
            text = read_text(path)
        except OSError as error:
            raise RobotError(f"robot file '{path}' cannot be read: {error.strerror}.") from error
        except UnicodeDecodeError as error:
            raise RobotError(f"robot file '{path}' is not text (byte {error.start} is not UTF-8).") from error
        return parse_robot(text, source=str(path), folder=path.parent.absolute())
    if str(robot) not in robot_names():
        raise RobotError(f"no robot '{robot}'; shipped are {', '.join(robot_names())}. Name one of them or a path to a .toml file.")
    text = (resources.files(__package__) / "robots" / f"{robot}.toml").read_text(encoding="utf-8")
    return parse_robot(text, source=f"{robot}.toml")


def parse_robot(text: str, source: str, folder: Path | None = None) -> Robot:
    """The robot of a TOML text; ``source`` names it in errors, ``folder`` is where paths in it start. Raises `RobotError`."""
    _refuse_long_keys(text, source)
    try:
        data = tomllib.loads(text)
    except ValueError as error:  # what the parser raises, and for a number of thousands of digits
        raise RobotError(f"{source}: not valid TOML: {error}.") from error
    except RecursionError as error:
        raise RobotError(f"{source}: not valid TOML: its brackets are nested too deeply.") from error
    known = {f.name for f in dataclasses.fields(Robot)} - {"folder", "options"}
    _refuse_unknown(data, known, source)
    if not isinstance(data.get("name"), str):
        raise RobotError(f'{source}: needs a line name = "...".')
    drive = data.get("drive", DRIVES[0])
    if drive not in DRIVES:
        raise RobotError(f"{source}: drive is {drive!r}; there are {', '.join(DRIVES)}.")
    geometry = _section(Geometry, data, "geometry", source)
    for name in ("wheel_radius_m", "track_width_m", "wheelbase_m", "mass_kg"):
        if not getattr(geometry, name) > 0:
            raise RobotError(f"{source}: geometry.{name} is {getattr(geometry, name)}; it must be positive.")
    for name in ("left_wheel_radius_multiplier", "right_wheel_radius_multiplier"):
        if not 0.1 < getattr(geometry, name) < 10.0:
            raise RobotError(f"{source}: geometry.{name} is {getattr(geometry, name)}; it must be near 1.")
    for name, value in dataclasses.asdict(geometry).items():
        if name.endswith("_m") and abs(value) > _LONGEST_M:
            raise RobotError(f"{source}: geometry.{name} is {value:g}; it must be in metres, and at most {_LONGEST_M:g}.")
    driver = _section(Driver, data, "driver", source) if "driver" in data else Driver(geometry.wheel_radius_m, geometry.track_width_m)
    if min(driver.wheel_radius_m, driver.track_width_m, driver.wheel_separation_multiplier) <= 0:
        raise RobotError(f"{source}: every number of [driver] must be positive.")
    mounts = {frame: _build(Mount, table, f"mounts.{frame}", source) for frame, table in _table(data, "mounts", source).items()}
    models, options = _models(_table(data, "models", source), source)
    return Robot(
        name=data["name"],
        geometry=geometry,
        driver=driver,
        drive=drive,
        topics=_section(Topics, data, "topics", source),
        joints=_joints(data, source),
        imu=_imu(data, source),
        mounts=mounts,
        wheel_noise=_noise(WheelNoise, data, "wheel_noise", source),
        gyro_noise=_noise(GyroNoise, data, "gyro_noise", source),
        clock=_clock(data, source),
        models=models,
        options=options,
        arms=_arms(data, source) if "arms" in data else None,
        folder=folder,
    )


def _refuse_long_keys(text: str, source: str) -> None:
    """Raises `RobotError` for lines with so many dots that they can only be a key of as many parts, or a file too long for a robot's.

    The parser stores each beginning of a dotted key: a key of 20,000 parts takes 2.5 GB.
    """
    if len(text) > _MOST_CHARACTERS:
        raise RobotError(f"{source}: has {len(text)} characters; a robot file has at most {_MOST_CHARACTERS}.")
    for number, line in enumerate(text.splitlines(), 1):
        dots = line.count(".")
        if dots > _MOST_DOTS and not line.lstrip().startswith("#"):
            raise RobotError(f"{source}: line {number} has {dots} dots; names of robot files have at most three.")


def _joints(data: Mapping[str, Any], source: str) -> Joints:
    joints = _section(Joints, data, "joints", source)
    if shared := sorted(set(joints.left) & set(joints.right)):
        raise RobotError(f"{source}: joints.left and joints.right both hold {', '.join(shared)}; a wheel is on one side.")
    unknown = sorted({*joints.reversed} - {*joints.left, *joints.right})
    if unknown:
        raise RobotError(f"{source}: joints.reversed names {', '.join(unknown)}, which is neither in joints.left nor in joints.right.")
    if min(joints.angle_unit_rad, joints.rate_unit_rad_s) <= 0.0 or joints.angle_range < 0.0:
        raise RobotError(f"{source}: units of [joints] must be positive; wheels that count backwards are named in joints.reversed.")
    return joints


def _imu(data: Mapping[str, Any], source: str) -> Imu:
    imu = _section(Imu, data, "imu", source)
    if imu.rate_unit_rad_s == 0.0:
        raise RobotError(f"{source}: imu.rate_unit_rad_s is 0; it is 1 for rad/s and 0.0174533 for degrees per second.")
    return imu


def _clock(data: Mapping[str, Any], source: str) -> Clock:
    clock = _section(Clock, data, "clock", source)
    for entry, value in dataclasses.asdict(clock).items():
        if abs(value) > _LARGEST_CLOCK_OFFSET_S:
            raise RobotError(
                f"{source}: clock.{entry} is {value:g} s; it must be at most {_LARGEST_CLOCK_OFFSET_S:g}. Synchronize the clocks."
            )
    return clock


def _noise(kind: type[Section], data: Mapping[str, Any], name: str, source: str) -> Section:
    noise = _section(kind, data, name, source)
    for entry, value in dataclasses.asdict(noise).items():  # type: ignore[call-overload]
        if value < 0.0:
            raise RobotError(f"{source}: {name}.{entry} is {value:g}; it must not be below 0.")
    return noise


def _models(tables: Mapping[str, Any], source: str) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, str | bool]]]:
    """Coefficients and choices of each model."""
    from motion_models.registry import MODELS  # the models themselves are made of robots

    _refuse_unknown(tables, set(MODELS), f"{source}, [models]")
    models: dict[str, dict[str, float]] = {}
    options: dict[str, dict[str, str | bool]] = {}
    for model in tables:
        table, choices = _table(tables, model, source), MODEL_OPTIONS.get(model, ())
        _refuse_unknown(table, {*cast(tuple[str, ...], MODELS[model].param_names), *choices}, f"{source}, [models.{model}]")
        models[model] = {name: _number(value, f"models.{model}.{name}", source) for name, value in table.items() if name not in choices}
        for name in table.keys() & choices:
            if not isinstance(table[name], str | bool):
                raise RobotError(f"{source}: models.{model}.{name} must be text or true or false, found {table[name]!r}.")
            options.setdefault(model, {})[name] = table[name]
    return models, options


def _arms(data: Mapping[str, Any], source: str) -> Arms:
    arms = _section(Arms, data, "arms", source)
    for name, value in dataclasses.asdict(arms).items():
        if ("sigma" in name or name in ("static_mass_kg", "payload_kg")) and value < 0.0:
            raise RobotError(f"{source}: arms.{name} is {value:g}; it must not be below 0.")
    if arms.payload_kg > 0.0 and not arms.payload_link:
        raise RobotError(f"{source}: arms.payload_kg is {arms.payload_kg:g}, but arms.payload_link names no link that holds it.")
    if arms.weighed_posture and not arms.postures:
        raise RobotError(f"{source}: arms.weighed_posture names '{arms.weighed_posture}', but arms.postures names no SRDF that has it.")
    return arms


def _table(data: Mapping[str, Any], name: str, source: str) -> Mapping[str, Any]:
    table = data.get(name, {})
    if not isinstance(table, Mapping):
        raise RobotError(f"{source}: '{name}' must be a table ([{name}]), found {table!r}.")
    return table


def _section(kind: type[Section], data: Mapping[str, Any], name: str, source: str) -> Section:
    return _build(kind, _table(data, name, source), name, source)


def _build(kind: type[Section], table: Any, name: str, source: str) -> Section:
    if not isinstance(table, Mapping):
        raise RobotError(f"{source}: '{name}' must be a table, found {table!r}.")
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    _refuse_unknown(table, set(fields), f"{source}, [{name}]")
    values: dict[str, Any] = {}
    for key, value in table.items():
        declared = str(fields[key].type)
        if declared == "float":
            values[key] = _number(value, f"{name}.{key}", source)
        elif declared == "str":
            if not isinstance(value, str):
                raise RobotError(f"{source}: {name}.{key} must be text, found {value!r}.")
            values[key] = value
        else:
            if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
                raise RobotError(f"{source}: {name}.{key} must be a list of names, found {value!r}.")
            values[key] = tuple(value)
    missing = [
        f.name
        for f in fields.values()
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING and f.name not in values
    ]
    if missing:
        raise RobotError(f"{source}: [{name}] has no {', '.join(missing)}.")
    return kind(**values)


def _refuse_unknown(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        nearest = difflib.get_close_matches(unknown[0][:_LONGEST_SHOWN], sorted(known), n=1)
        meant = f" (did you mean {nearest[0]}?)" if nearest else ""
        named = ", ".join(name if len(name) <= _LONGEST_SHOWN else f"{name[:_LONGEST_SHOWN]}..." for name in unknown[:10])
        raise RobotError(f"{where}: unknown entry {named}{meant}; known are {', '.join(sorted(known))}.")


def _number(value: Any, name: str, source: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not -_LARGEST <= value <= _LARGEST:  # false for NaN
        found = repr(value) if not isinstance(value, int) or abs(value) < 10**20 else "an integer of more than 20 digits"
        raise RobotError(f"{source}: {name} must be a finite number of at most {_LARGEST:g}, found {found[:_LONGEST_SHOWN]}.")
    return float(value)
