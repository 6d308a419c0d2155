"""Causes: what may differ on robot, floor or sensors. Each has a signature, the change that it makes in the predicted motions.

A `Hypothesis` holds everything that may be otherwise than the robot file says; a cause adds its size to one place of it. The predictor that
predicts motions from a hypothesis is in `localization.diagnosis.prediction`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Hypothesis:
    """Deviations from the robot file, of every kind that a cause can have; all 0 for the robot file as it is."""

    left_radius_scale: float = 0.0
    """Relative."""
    right_radius_scale: float = 0.0
    friction: Mapping[str, float] = field(default_factory=dict)
    """Additions to parameters of `FrictionModel`."""
    cg: tuple[float, float] = (0.0, 0.0)
    payload_kg: float = 0.0
    lidar_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lidar_time_offset_s: float = 0.0
    wheel_time_offset_s: float = 0.0
    gyro_bias: float = 0.0
    encoder_loss: float = 0.0
    slip_coefficients: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """vy += a vx wz; wz *= 1 - b |vx|; vx -= c vx |wz|."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Rise of the floor along the axes of the drive's first heading [rad]."""
    other_contact_law: float = 0.0
    """Share of the contact law that the robot file does not choose (`motion_models.friction.contact`)."""
    friction_change: float = 0.0
    """Sideways grip is more by this share from `friction_change_at_s` on."""
    friction_change_at_s: float = 0.0
    rotation_coefficients: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """wz *= 1 + a - b |wz| - c (1 - T), T the share of turning, see `FullLinear`."""
    longitudinal_curvature_slip: float = 0.0
    """Longitudinal slip by the share of turning, see `FullLinear.longitudinal_slip_curvature`."""
    wheel_lag_s: float = 0.0


@dataclass(frozen=True)
class Cause:
    """One cause, as a direction in which things may differ."""

    id: str
    unit: str
    meaning: str
    typical: float
    """A size that is common on robots: what a drive should be able to show, and the unit of steps in numeric differences."""
    negligible: float
    """Smaller sizes are within the accuracy of robot files, mounts and clocks."""
    inject: Callable[[Hypothesis, float], Hypothesis] = field(repr=False)
    one_sided: bool = False
    is_clock: bool = False
    """It shifts samples in time, between which rates have kinks: signatures are differenced to both sides, over a larger step."""
    at_s: float | None = None
    """For a change: when."""

    @property
    def key(self) -> str:
        """Unique also among several moments of one change."""
        return self.id if self.at_s is None else f"{self.id}@{self.at_s:g}"


def _plain(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(b, **{name: getattr(b, name) + s})


def _item(name: str, index: int) -> Callable[[Hypothesis, float], Hypothesis]:
    def inject(b: Hypothesis, s: float) -> Hypothesis:
        old = getattr(b, name)
        changed: dict[str, Any] = {name: tuple(v + s if i == index else v for i, v in enumerate(old))}
        return dataclasses.replace(b, **changed)

    return inject


def _radii(left: float, right: float) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(
        b, left_radius_scale=b.left_radius_scale + left * s, right_radius_scale=b.right_radius_scale + right * s
    )


def _friction(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(b, friction={**b.friction, name: b.friction.get(name, 0.0) + s})


_ALL = (
    Cause("wheel_radius_scale", "1", "all wheels roll farther by this share than the robot file says", 0.02, 0.002, _radii(1.0, 1.0)),
    Cause(
        "wheel_radius_difference",
        "1",
        "the left wheels are larger by half of this share, the right ones smaller",
        0.02,
        0.001,
        _radii(0.5, -0.5),
    ),
    Cause("track_width", "m", "the left and right contacts are farther apart by this", 0.03, 0.003, _friction("track_width")),
    Cause("payload", "kg", "the robot carries a mass that it does not know of", 8.0, 1.0, _plain("payload_kg"), one_sided=True),
    Cause("cg_offset_x", "m", "the centre of gravity lies farther ahead than told", 0.03, 0.003, _item("cg", 0)),
    Cause("cg_offset_y", "m", "the centre of gravity lies farther left than told", 0.02, 0.003, _item("cg", 1)),
    Cause("lidar_offset_x", "m", "the tracked sensor sits farther ahead than its transform says", 0.05, 0.005, _item("lidar_offset", 0)),
    Cause("lidar_offset_y", "m", "the tracked sensor sits farther left than its transform says", 0.05, 0.005, _item("lidar_offset", 1)),
    Cause("lidar_yaw", "rad", "the tracked sensor is turned to the left against its transform", 0.03, 0.003, _item("lidar_offset", 2)),
    Cause("lidar_time_offset", "s", "the LiDAR's stamps are late by this", 0.05, 0.008, _plain("lidar_time_offset_s"), is_clock=True),
    Cause("wheel_time_offset", "s", "the wheels' stamps are late by this", 0.05, 0.008, _plain("wheel_time_offset_s"), is_clock=True),
    Cause(
        "friction_anisotropy",
        "1",
        "the floor grips more sideways by this share (mu_y / mu_x)",
        0.2,
        0.03,
        _friction("mu_ratio"),
    ),
    Cause(
        "lateral_force_law",
        "1",
        "the lateral force follows the other contact law by this share (isotropic: it grows with the slip; thesis: saturated at any slip)",
        1.0,
        0.15,
        _plain("other_contact_law"),
        one_sided=True,
    ),
    Cause(
        "diagonal_load",
        "1",
        "a warped chassis loads front left and rear right by this share of m g / 4",
        0.15,
        0.02,
        _friction("warp"),
    ),
    Cause("tread_asymmetry", "1", "wheels that slide to the left grip more by this share", 0.15, 0.02, _friction("tread")),
    Cause(
        "rolling_resistance",
        "1",
        "rolling resistance over load is more by this",
        0.03,
        0.004,
        _friction("rolling_resistance"),
    ),
    Cause("scrub", "m", "the contact patches oppose any turn by this moment, over mu m g", 0.02, 0.002, _friction("scrub")),
    Cause("slope", "rad", "the floor rises along the drive's first heading", 0.05, 0.005, _item("slope", 0)),
    Cause(
        "encoder_dropout",
        "1",
        "share of its rolling time in which an encoder loses its counts",
        0.1,
        0.01,
        _plain("encoder_loss"),
        one_sided=True,
    ),
    Cause("gyro_bias", "rad/s", "the gyro turns while nothing does", 0.02, 0.0075, _plain("gyro_bias")),
    Cause("lateral_slip_speed", "s", "the robot slides sideways in curves: vy += s vx wz", 0.05, 0.005, _item("slip_coefficients", 0)),
    Cause(
        "rotation_slip_speed",
        "s/m",
        "the robot turns less at speed: wz *= 1 - s |vx|",
        0.1,
        0.01,
        _item("slip_coefficients", 1),
    ),
    Cause(
        "longitudinal_slip_turning",
        "s/rad",
        "the robot goes less far in turns: vx *= 1 - s |wz|",
        0.1,
        0.01,
        _item("slip_coefficients", 2),
    ),
)
CAUSES: Mapping[str, Cause] = {cause.id: cause for cause in _ALL}
"""All causes that hold for the whole of a drive, by id."""


def friction_change(at_s: float) -> Cause:
    """The sideways grip changes ``at_s`` after the drive's beginning."""

    def inject(b: Hypothesis, s: float) -> Hypothesis:
        return dataclasses.replace(b, friction_change=b.friction_change + s, friction_change_at_s=at_s)

    return Cause("friction_change", "1", f"sideways grip is more by this share from {at_s:.0f} s on", 0.3, 0.04, inject, at_s=at_s)


WINDOW_CAUSES: Mapping[str, Cause] = {
    "longitudinal_slip_curvature": Cause(
        "longitudinal_slip_curvature",
        "1",
        "the robot goes less far on tight arcs, at any speed: vx *= 1 - s T",
        0.2,
        0.02,
        _plain("longitudinal_curvature_slip"),
    ),
    "wheel_lag": Cause(
        "wheel_lag", "s", "the body follows the wheels with this time constant", 0.05, 0.008, _plain("wheel_lag_s"), one_sided=True
    ),
    "rotation_scale": Cause(
        "rotation_scale",
        "1",
        "the robot turns farther than the model says by this share, at any speed",
        0.1,
        0.01,
        _item("rotation_coefficients", 0),
    ),
    "rotation_slip_rate": Cause(
        "rotation_slip_rate",
        "s/rad",
        "the robot turns less the faster it turns: wz *= 1 - s |wz|",
        0.1,
        0.01,
        _item("rotation_coefficients", 1),
    ),
    "rotation_slip_curvature": Cause(
        "rotation_slip_curvature",
        "1",
        "the robot turns less on gentle arcs, at any speed: wz *= 1 - s (1 - T)",
        0.2,
        0.02,
        _item("rotation_coefficients", 2),
    ),
}
"""Causes that recorded data of other robots needed, beyond those of the simulator; for tables of windows."""


def slope_across() -> Cause:
    """The floor rises to the left of the drive's first heading."""
    return Cause("slope", "rad", "the floor rises to the left of the drive's first heading", 0.05, 0.005, _item("slope", 1), at_s=-1.0)
