"""Faults as physical changes of the robot, its floor or its sensors, of which the log has no record.

Each fault changes a `TrueRobot`, which starts as the robot file has it. Mounts in /tf_static, joint names and all else in the log stay
nominal. Independent of the diagnosis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from localization.errors import SimulationError
from localization.simulation.vehicle import Body
from motion_models.robot import Mount


@dataclass(frozen=True)
class TrueRobot:
    """True parameters of robot, floor and sensors."""

    body: Body
    lidar: Mount
    payload_kg: float = 0.0
    """Held from the start on."""
    lidar_late_s: float = 0.0
    """By how much the LiDAR's stamps are late."""
    wheels_late_s: float = 0.0
    """By how much the joint states' stamps are late."""
    gyro_bias: float = 0.0
    """About the body's z axis [rad/s]."""
    encoder_lost: float = 0.0
    """Share of time in which the front left encoder loses its counts."""
    gyro_scale: float = 0.0
    """Share by which the gyro's rates are too large."""
    gyro_late_s: float = 0.0
    """By how much the IMU's stamps are late."""
    range_scale: float = 0.0
    """Share by which the LiDAR's ranges are too long."""
    range_bias_m: float = 0.0
    """By how much they are too long whatever the distance."""
    wheel_radius_drift: float = 0.0
    """Share by which all wheels grow from the drive's first phase to its last."""
    missing_joint_messages: float = 0.0
    """Share of the joint states that are missing."""
    friction_change_factor: float = 1.0
    """Factor of the sideways friction in the second half of the drive."""


@dataclass(frozen=True)
class Fault:
    """One fault."""

    id: str
    unit: str
    meaning: str
    largest: float
    """Greatest size, either way, that makes sense."""
    apply: Callable[[TrueRobot, float], TrueRobot]


def _body(reality: TrueRobot, body: Body) -> TrueRobot:
    return dataclasses.replace(reality, body=body)


def _param(name: str, *, scaled: bool = False) -> Callable[[TrueRobot, float], TrueRobot]:
    """A change of a friction parameter: added, or as a factor 1 + size."""

    def apply(reality: TrueRobot, size: float) -> TrueRobot:
        old = reality.body.param(name)
        return _body(reality, reality.body.with_param(name, old * (1.0 + size) if scaled else old + size))

    return apply


def _radius(left: float, right: float) -> Callable[[TrueRobot, float], TrueRobot]:
    def apply(reality: TrueRobot, size: float) -> TrueRobot:
        body = reality.body
        new = (body.radius_left * (1.0 + left * size), body.radius_right * (1.0 + right * size))
        return _body(reality, dataclasses.replace(body, radius_left=new[0], radius_right=new[1]))

    return apply


def _cg(x: float, y: float) -> Callable[[TrueRobot, float], TrueRobot]:
    def apply(reality: TrueRobot, size: float) -> TrueRobot:
        old = reality.body.cg_offset
        return _body(reality, dataclasses.replace(reality.body, cg_offset=(old[0] + x * size, old[1] + y * size)))

    return apply


def _lidar(field: str) -> Callable[[TrueRobot, float], TrueRobot]:
    return lambda reality, size: dataclasses.replace(
        reality, lidar=dataclasses.replace(reality.lidar, **{field: getattr(reality.lidar, field) + size})
    )


def _plain(field: str, *, factor: bool = False) -> Callable[[TrueRobot, float], TrueRobot]:
    return lambda reality, size: dataclasses.replace(
        reality, **{field: getattr(reality, field) * (1.0 + size) if factor else getattr(reality, field) + size}
    )


def _yield(index: int) -> Callable[[TrueRobot, float], TrueRobot]:
    def apply(reality: TrueRobot, size: float) -> TrueRobot:
        a, b, c = (old + size if i == index else old for i, old in enumerate(reality.body.yields))
        return _body(reality, dataclasses.replace(reality.body, yields=(a, b, c)))

    return apply


def _other_law(reality: TrueRobot, size: float) -> TrueRobot:
    """From the robot file's contact law towards the other: isotropic for the thesis's and the other way round."""
    old = reality.body.saturation
    return _body(reality, dataclasses.replace(reality.body, saturation=old + (1.0 - 2.0 * round(old)) * size))


def _split(reality: TrueRobot, size: float) -> TrueRobot:
    return _body(reality, dataclasses.replace(reality.body, grip_split=reality.body.grip_split + size))


def _height(reality: TrueRobot, size: float) -> TrueRobot:
    return _body(reality, dataclasses.replace(reality.body, cg_height=reality.body.cg_height + size))


def _slope(reality: TrueRobot, size: float) -> TrueRobot:
    return _body(reality, dataclasses.replace(reality.body, slope=reality.body.slope + size))


_ALL = (
    Fault("wheel_radius_scale", "1", "all wheels are larger by this share than in the robot file", 0.5, _radius(1.0, 1.0)),
    Fault("wheel_radius_difference", "1", "left wheels larger by half of this share, right ones smaller", 0.5, _radius(0.5, -0.5)),
    Fault("track_width", "m", "left and right contacts are farther apart by this", 0.2, _param("track_width")),
    Fault("payload", "kg", "a mass in the (left) gripper, or at the front edge of a robot without arms", 30.0, _plain("payload_kg")),
    Fault("cg_offset_x", "m", "the CG lies farther ahead than by arms and robot file", 0.2, _cg(1.0, 0.0)),
    Fault("cg_offset_y", "m", "the CG lies farther left than by arms and robot file", 0.2, _cg(0.0, 1.0)),
    Fault("lidar_offset_x", "m", "the LiDAR sits farther ahead than in its transform", 1.0, _lidar("x")),
    Fault("lidar_offset_y", "m", "the LiDAR sits farther left than in its transform", 1.0, _lidar("y")),
    Fault("lidar_yaw", "rad", "the LiDAR is turned to the left against its transform", math.pi, _lidar("yaw")),
    Fault("lidar_time_offset", "s", "the LiDAR's stamps are late by this", 0.5, _plain("lidar_late_s")),
    Fault("wheel_time_offset", "s", "the joint states' stamps are late by this", 0.5, _plain("wheels_late_s")),
    Fault("friction_anisotropy", "1", "the floor grips more sideways by this share", 0.9, _param("mu_ratio", scaled=True)),
    Fault(
        "friction_change",
        "1",
        "sideways grip is more by this share in the second half of the drive",
        0.9,
        _plain("friction_change_factor", factor=True),
    ),
    Fault("lateral_force_law", "1", "the tyres follow the other contact law by this share (1: wholly)", 1.0, _other_law),
    Fault("diagonal_load", "1", "a warped chassis loads front left and rear right by this share of m g / 4", 0.9, _param("warp")),
    Fault("tread_asymmetry", "1", "wheels that slide to the left grip more by this share, to the right less", 0.9, _param("tread")),
    Fault("rolling_resistance", "1", "rolling resistance over load is more by this", 0.3, _param("rolling_resistance")),
    Fault("scrub", "m", "the contact patches oppose any turn by this, over mu m g, more", 0.1, _param("scrub")),
    Fault("slope", "rad", "the floor rises towards the world's +x by this angle", 0.4, _slope),
    Fault("cg_height", "m", "the CG lies higher than in the robot file", 0.3, _height),
    Fault("grip", "1", "the floor grips more in all directions by this share", 0.9, _param("mu", scaled=True)),
    Fault("encoder_dropout", "1", "share of time in which the front left encoder loses its counts", 0.9, _plain("encoder_lost")),
    Fault("gyro_bias", "rad/s", "the gyro turns about the body's z axis while nothing does", 1.0, _plain("gyro_bias")),
    Fault("gyro_scale", "1", "the gyro's rates are too large by this share", 0.5, _plain("gyro_scale")),
    Fault("gyro_time_offset", "s", "the IMU's stamps are late by this", 0.5, _plain("gyro_late_s")),
    Fault("range_scale", "1", "the LiDAR's ranges are too long by this share", 0.5, _plain("range_scale")),
    Fault("range_bias", "m", "the LiDAR's ranges are too long by this", 0.5, _plain("range_bias_m")),
    Fault("wheel_radius_drift", "1", "all wheels grow by this share over the drive", 0.5, _plain("wheel_radius_drift")),
    Fault("split_friction", "1", "the left wheels grip more by half of this share, the right ones less", 0.9, _split),
    Fault("missing_joint_messages", "1", "share of the joint states that are missing, in bursts", 0.9, _plain("missing_joint_messages")),
    Fault("lateral_slip_speed", "s", "a loose floor shears sideways in curves: vy += s vx wz", 1.0, _yield(0)),
    Fault("rotation_slip_speed", "s/m", "a loose floor turns along at speed: wz *= 1 - s |vx|", 0.5, _yield(1)),
    Fault("longitudinal_slip_turning", "s/rad", "a loose floor gives way in turns: vx *= 1 - s |wz|", 0.5, _yield(2)),
)
FAULTS: Mapping[str, Fault] = {effect.id: effect for effect in _ALL}
"""All effects by id."""


def parse_faults(texts: tuple[str, ...]) -> dict[str, float]:
    """Effects written as ID=SIZE. Raises `SimulationError`, which lists what there is."""
    sizes: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            size = float(value)
        except ValueError:
            size = math.nan
        if not equals or not math.isfinite(size):
            raise SimulationError(f"effect '{text}' is not of the form ID=SIZE with a number, as in wheel_radius_scale=0.02.")
        sizes[name] = sizes.get(name, 0.0) + size
    return sizes


def apply_faults(reality: TrueRobot, effects: Mapping[str, float]) -> TrueRobot:
    """``reality`` with all ``effects`` (size by id). Raises `SimulationError` for one that does not exist or is out of reason."""
    for name, size in effects.items():
        if name not in FAULTS:
            known = "\n".join(f"  {e.id} [{e.unit}]: {e.meaning}" for e in _ALL)
            raise SimulationError(f"no effect '{name}'; there are\n{known}")
        effect = FAULTS[name]
        least = 0.0 if name in ("payload", "encoder_dropout", "lateral_force_law", "missing_joint_messages") else -effect.largest
        if not least <= size <= effect.largest:
            raise SimulationError(f"effect {name} of {size:g} {effect.unit} is out of reason; it may be {least:g} to {effect.largest:g}.")
        reality = effect.apply(reality, size)
    for name in ("rolling_resistance", "scrub"):
        if reality.body.param(name) < 0.0:
            raise SimulationError(f"effect {name} leaves {reality.body.param(name):g}; it cannot be negative.")
    return reality
