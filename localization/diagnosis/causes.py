"""Causes: what may differ on robot, floor or sensors. Each has a signature, the change that it makes in the predicted motions.

A `Hypothesis` holds everything that may differ from the robot file; a cause adds its size to one place of it. The predictor that
predicts motions from a hypothesis is in `localization.diagnosis.prediction`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from motion_models.robot import DIFF_DRIVE, Robot


@dataclass(frozen=True)
class Hypothesis:
    """Deviations from the robot file, of every kind that a cause can have; all 0 for the robot file as it is."""

    left_radius_scale: float = 0.0
    """Relative."""
    right_radius_scale: float = 0.0
    friction: Mapping[str, float] = field(default_factory=dict)
    """Additions to parameters of `FrictionModel`."""
    stiffness_exponent: float = 0.0
    """Power of the wheels' speed with which the slip stiffness grows (`friction_response`)."""
    cg: tuple[float, float] = (0.0, 0.0)
    payload_kg: float = 0.0
    lidar_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lidar_time_offset_s: float = 0.0
    wheel_time_offset_s: float = 0.0
    gyro_bias: float = 0.0
    gyro_scale: float = 0.0
    gyro_time_offset_s: float = 0.0
    range_scale: float = 0.0
    range_bias_m: float = 0.0
    wheel_radius_drift: float = 0.0
    """Relative growth of all wheels from the drive's start to its end."""
    split_friction: float = 0.0
    """Grip of the left wheels less that of the right ones, over their mean."""
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


_PRIOR_FACTOR = 4.0  # sigma of a size's prior, over the typical size, where no physical limit is given
_PLAUSIBLE_SIGMAS = 4.0  # of the typical size, or of a physical prior: one robot of 16,000 has more
_SHOWN_UNITS: Mapping[str, tuple[float, str]] = {"1": (100.0, "%"), "m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms")}
"""Factor and unit in sentences, by the SI unit of a size."""


@dataclass(frozen=True)
class Cause:
    """One cause, as a direction in which hypotheses may differ."""

    id: str
    unit: str
    meaning: str
    typical: float
    """A size that is common on robots: what a drive should be able to show, and the unit of steps in numeric differences."""
    negligible: float
    """Smaller sizes are within the accuracy of robot files, mounts and clocks: they are tolerated."""
    inject: Callable[[Hypothesis, float], Hypothesis] = field(repr=False)
    words: tuple[str, str]
    """What the robot does at a positive and at a negative size; {} stands for the magnitude with its unit."""
    one_sided: bool = False
    is_clock: bool = False
    """It shifts samples in time, between which rates have kinks: signatures are differenced to both sides, over a larger step."""
    at_s: float | None = None
    """For a change: when."""
    prior_sigma: float = 0.0
    """How large the size may plausibly be, as a standard deviation; 0 for four times the typical size."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Sizes beyond these are not considered, where that is not the same to both sides (see `bounds`)."""
    axis: str = ""
    """Where two causes have one id: its axis, in words."""

    @property
    def label(self) -> str:
        """The id as tables show it, with the axis where there are two."""
        return f"{self.id} ({self.axis})" if self.axis else self.id

    @property
    def key(self) -> str:
        """Unique also among several moments of one change."""
        return self.id if self.at_s is None else f"{self.id}@{self.at_s:g}"

    @property
    def plausible(self) -> float:
        """Sigma of the prior of the size."""
        return self.prior_sigma or _PRIOR_FACTOR * self.typical

    @property
    def largest(self) -> float:
        """Magnitude beyond which a size is not considered: ten times the typical size, or five sigma of a physical prior."""
        return min(10.0 * self.typical, 5.0 * self.prior_sigma or math.inf)

    @property
    def bounds(self) -> tuple[float, float]:
        """Sizes that are considered: up to `largest` to both sides, or to one, within `limits`."""
        return max(0.0 if self.one_sided else -self.largest, self.limits[0]), min(self.largest, self.limits[1])

    @property
    def largest_plausible(self) -> float:
        """Magnitude beyond which another cause is more likely that is not in the catalogue: four times the typical size, or four sigma of
        a physical prior; rotations differ from the geometry's by up to all of it on skid-steer robots."""
        return 1.0 if self.id == "rotation_scale" else _PLAUSIBLE_SIGMAS * (self.prior_sigma or self.typical)

    def describe(self, size: float, sigma: float = 0.0) -> str:
        """The effect of ``size`` in words, with its direction, and with its ``sigma`` where that is given.

        >>> CAUSES["track_width"].describe(-0.012)
        'the left and right contacts are 12 mm closer together than the robot file has it'
        """
        factor, unit = (1.0, self.unit) if self.is_coefficient else _SHOWN_UNITS.get(self.unit, (1.0, self.unit))
        amount = abs(size) * factor
        decimals = max(0, 1 - math.floor(math.log10(max(amount, 1e-12))))  # two digits at least
        spread = f" +- {sigma * factor:.{decimals}f}" if sigma else ""
        return self.words[size < 0.0].format(f"{amount:.{decimals}f}{spread}" + ("" if unit == "1" else f" {unit}"))

    @property
    def is_coefficient(self) -> bool:
        """Whether the size is a coefficient of a slip law, which has no unit that is read by itself."""
        return "= " in self.meaning


def _add(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(b, **{name: getattr(b, name) + s})


def _add_item(name: str, index: int) -> Callable[[Hypothesis, float], Hypothesis]:
    def inject(b: Hypothesis, s: float) -> Hypothesis:
        old = getattr(b, name)
        changed: dict[str, Any] = {name: tuple(v + s if i == index else v for i, v in enumerate(old))}
        return dataclasses.replace(b, **changed)

    return inject


def _add_radii(left: float, right: float) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(
        b, left_radius_scale=b.left_radius_scale + left * s, right_radius_scale=b.right_radius_scale + right * s
    )


def _add_friction(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(b, friction={**b.friction, name: b.friction.get(name, 0.0) + s})


_FILE = "than the robot file has it"
_TRANSFORM = "than its transform has it"
_GYRO_BIAS_SIGMA = 0.01
"""Zero-rate offset of MEMS gyros that robots carry, after the zeroing at switch-on that drivers do: 0.5 to 1 deg/s at most by the data
sheets (BMI088: 1 deg/s; MPU-9250: 5 deg/s before zeroing; ADIS16470: 0.2 deg/s) [rad/s]."""
_GYRO_SCALE_SIGMA = 0.03
"""Sensitivity tolerance of the same gyros: 1 to 3 % [-]."""
_CLOCK_SIGMA_S = 0.2
"""Latency of drivers and of clocks that are not synchronized, as in the logs that come with the tests (0.04 to 0.2 s) [s]."""
_RANGE_SCALE_SIGMA, _RANGE_BIAS_SIGMA_M = 0.015, 0.05
"""Ranging errors of time-of-flight scanners: 0.03 to 0.05 m by data sheets (SICK LMS1xx, Velodyne VLP-16), 1 to 2 % for triangulation. A
healthy scanner has the 0.03 m that are tolerated (SICK LMS1xx: systematic error 30 mm, 40 mm at most)."""

_CAUSES = (
    Cause(
        "wheel_radius_scale",
        *("1", "all wheels roll farther by this share than by the robot file", 0.02, 0.002, _add_radii(1.0, 1.0)),
        (f"all wheels roll {{}} farther {_FILE}", f"all wheels roll {{}} less far {_FILE}"),
    ),
    Cause(
        "wheel_radius_difference",
        *("1", "the left wheels are larger by half of this share, the right ones smaller", 0.02, 0.001, _add_radii(0.5, -0.5)),
        ("the left wheels are {} larger than the right ones", "the left wheels are {} smaller than the right ones"),
    ),
    Cause(
        "track_width",
        *("m", "the left and right contacts are farther apart by this", 0.03, 0.003, _add_friction("track_width")),
        (f"the left and right contacts are {{}} farther apart {_FILE}", f"the left and right contacts are {{}} closer together {_FILE}"),
    ),
    Cause(
        "payload",
        *("kg", "the robot carries a mass that its file does not have", 8.0, 1.0, _add("payload_kg")),
        ("the robot carries {} that its file does not have", "the robot carries {} less than its file has"),
        one_sided=True,
    ),
    Cause(
        "cg_offset_x",
        *("m", "the centre of gravity lies farther ahead than given", 0.03, 0.003, _add_item("cg", 0)),
        ("the centre of gravity lies {} farther ahead than given", "the centre of gravity lies {} farther back than given"),
    ),
    Cause(
        "cg_offset_y",
        *("m", "the centre of gravity lies farther left than given", 0.02, 0.003, _add_item("cg", 1)),
        ("the centre of gravity lies {} farther left than given", "the centre of gravity lies {} farther right than given"),
    ),
    Cause(
        "lidar_offset_x",
        *("m", "the tracked sensor sits farther ahead than by its transform", 0.05, 0.005, _add_item("lidar_offset", 0)),
        (f"the tracked sensor sits {{}} farther ahead {_TRANSFORM}", f"the tracked sensor sits {{}} farther back {_TRANSFORM}"),
    ),
    Cause(
        "lidar_offset_y",
        *("m", "the tracked sensor sits farther left than by its transform", 0.05, 0.005, _add_item("lidar_offset", 1)),
        (f"the tracked sensor sits {{}} farther left {_TRANSFORM}", f"the tracked sensor sits {{}} farther right {_TRANSFORM}"),
    ),
    Cause(
        "lidar_yaw",
        *("rad", "the tracked sensor is turned to the left against its transform", 0.03, 0.003, _add_item("lidar_offset", 2)),
        (f"the tracked sensor is turned {{}} farther left {_TRANSFORM}", f"the tracked sensor is turned {{}} farther right {_TRANSFORM}"),
    ),
    Cause(
        "wheel_time_offset",
        *("s", "the wheels' stamps are late by this", 0.05, 0.008, _add("wheel_time_offset_s")),
        ("the wheels' stamps are {} late", "the wheels' stamps are {} early"),
        is_clock=True,
        prior_sigma=_CLOCK_SIGMA_S,
    ),
    Cause(
        "lidar_time_offset",
        *("s", "the LiDAR's stamps are late by this", 0.05, 0.008, _add("lidar_time_offset_s")),
        ("the LiDAR's stamps are {} late", "the LiDAR's stamps are {} early"),
        is_clock=True,
        prior_sigma=_CLOCK_SIGMA_S,
    ),
    Cause(
        "gyro_time_offset",
        *("s", "the gyro's stamps are late by this", 0.05, 0.008, _add("gyro_time_offset_s")),
        ("the gyro's stamps are {} late", "the gyro's stamps are {} early"),
        is_clock=True,
        prior_sigma=_CLOCK_SIGMA_S,
    ),
    Cause(
        "friction_anisotropy",
        *("1", "the floor grips more sideways by this share (mu_y / mu_x)", 0.2, 0.03, _add_friction("mu_ratio")),
        (f"the floor grips {{}} more sideways {_FILE}", f"the floor grips {{}} less sideways {_FILE}"),
    ),
    Cause(
        "split_friction",
        *("1", "the left wheels grip more by half of this share, the right ones less", 0.2, 0.03, _add("split_friction")),
        ("the left wheels grip {} more than the right ones", "the left wheels grip {} less than the right ones"),
    ),
    Cause(
        "lateral_force_law",
        "1",
        "the lateral force follows the other contact law by this share (isotropic: it grows with the slip; thesis: saturated at any slip)",
        *(1.0, 0.15, _add("other_contact_law")),
        ("the lateral force follows the contact law that the robot file does not choose, by {}", "{} less of the other contact law"),
        one_sided=True,
    ),
    Cause(
        "diagonal_load",
        *("1", "a warped chassis loads front left and rear right by this share of m g / 4", 0.15, 0.02, _add_friction("warp")),
        (
            "a warped chassis loads front left and rear right by {} of m g / 4",
            "a warped chassis loads front right and rear left by {} of m g / 4",
        ),
    ),
    Cause(
        "tread_asymmetry",
        *("1", "wheels that slide to the left grip more by this share", 0.15, 0.02, _add_friction("tread")),
        ("wheels that slide to the left grip {} more", "wheels that slide to the left grip {} less"),
    ),
    Cause(
        "rolling_resistance",
        *("1", "rolling resistance over load is more by this", 0.03, 0.004, _add_friction("rolling_resistance")),
        ("rolling resistance is more, by {} of the load", "rolling resistance is less, by {} of the load"),
    ),
    Cause(
        "scrub",
        *("m", "the contact patches oppose any turn by this moment, over mu m g", 0.02, 0.002, _add_friction("scrub")),
        ("the contact patches oppose any turn more, by {} times mu m g", "the contact patches oppose any turn less, by {} times mu m g"),
    ),
    Cause(
        "slope",
        *("rad", "the floor rises along the drive's first heading", 0.05, 0.005, _add_item("slope", 0)),
        ("the floor rises by {} along the drive's first heading", "the floor falls by {} along the drive's first heading"),
        axis="along",
    ),
    Cause(
        "encoder_dropout",
        *("1", "share of its rolling time in which an encoder loses its counts", 0.1, 0.001, _add("encoder_loss")),
        ("an encoder loses its counts in {} of its rolling time", "{} fewer counts are lost"),
        one_sided=True,
    ),
    Cause(
        "gyro_bias",
        *("rad/s", "the gyro's rate at standstill", 0.02, 0.0075, _add("gyro_bias")),
        ("the gyro reads {} to the left at standstill", "the gyro reads {} to the right at standstill"),
        prior_sigma=_GYRO_BIAS_SIGMA,
    ),
    Cause(
        "gyro_scale",
        *("1", "the gyro's rates are larger than the truth by this share", 0.03, 0.005, _add("gyro_scale")),
        ("the gyro's rates are {} too large", "the gyro's rates are {} too small"),
        prior_sigma=_GYRO_SCALE_SIGMA,
    ),
    Cause(
        "range_scale",
        *("1", "the LiDAR's ranges are longer than the truth by this share", 0.02, 0.003, _add("range_scale")),
        ("the LiDAR's ranges are {} too long", "the LiDAR's ranges are {} too short"),
        prior_sigma=_RANGE_SCALE_SIGMA,
    ),
    Cause(
        "range_bias",
        *("m", "the LiDAR's ranges are longer than the truth by this, whatever the distance", 0.05, 0.03, _add("range_bias_m")),
        ("the LiDAR's ranges are {} too long, whatever the distance", "the LiDAR's ranges are {} too short, whatever the distance"),
        prior_sigma=_RANGE_BIAS_SIGMA_M,
    ),
    Cause(
        "wheel_radius_drift",
        *("1", "all wheels grow by this share from the drive's start to its end", 0.02, 0.003, _add("wheel_radius_drift")),
        ("all wheels grow by {} from the drive's start to its end", "all wheels shrink by {} from the drive's start to its end"),
    ),
    Cause(
        "lateral_slip_speed",
        *("s", "the robot slides sideways in curves: vy += s vx wz", 0.05, 0.005, _add_item("slip_coefficients", 0)),
        ("the robot slides to the inside of curves: vy += {} vx wz", "the robot slides to the outside of curves: vy -= {} vx wz"),
    ),
    Cause(
        "rotation_slip_speed",
        *("s/m", "the robot turns less at speed: wz *= 1 - s |vx|", 0.1, 0.01, _add_item("slip_coefficients", 1)),
        ("the robot turns less at speed: wz *= 1 - {} |vx|", "the robot turns more at speed: wz *= 1 + {} |vx|"),
    ),
    Cause(
        "longitudinal_slip_turning",
        *("s/rad", "the robot goes less far in turns: vx *= 1 - s |wz|", 0.1, 0.01, _add_item("slip_coefficients", 2)),
        ("the robot goes less far in turns: vx *= 1 - {} |wz|", "the robot goes farther in turns: vx *= 1 + {} |wz|"),
    ),
)
CAUSES: Mapping[str, Cause] = {cause.id: cause for cause in _CAUSES}
"""All causes that hold for the whole of a drive, by id."""
STIFFNESS_EXPONENT = "stiffness_exponent"
"""Id of the cause of a healthy drive alone (`weigh.stiffness_exponent_cause`): how slow turns differ from fast ones."""


_MAX_NARROWING = 0.8
"""Largest narrowing of the track of a robot with casters, as a share of it."""
_TOLERATED_LOAD = 0.01
"""Share of the robot's mass that is tolerated as payload: over the front edge it moves the centre of gravity of the robots that come with
skidloc by 1 to 5 mm, and 3 mm are tolerated of `cg_offset_x` [-]."""


def payload(mass_kg: float) -> Cause:
    """The payload of a robot of this mass."""
    return dataclasses.replace(CAUSES["payload"], negligible=_TOLERATED_LOAD * mass_kg)


_TYPICAL_TRACKS = 2.0
"""Errors of the track that are considered whatever the wheelbase, over the typical one."""


def track_width(robot: Robot) -> Cause:
    """The track width of ``robot``, where its twin cannot be found.

    How far wheels that skid turn a robot, k r (q_r - q_l) / t with k = 1 / (1 + (W / t)^2), goes with t / (t^2 + W^2), which W^2 / t gives
    as well as t: a track has to be on the same side of the wheelbase W as the file's, and positive where wheels do not skid.
    """
    g, cause = robot.geometry, CAUSES["track_width"]
    if robot.drive == DIFF_DRIVE:
        return dataclasses.replace(cause, limits=(-_MAX_NARROWING * g.track_width_m, math.inf))
    middle, least = g.wheelbase_m - g.track_width_m, _TYPICAL_TRACKS * cause.typical
    return dataclasses.replace(cause, limits=(min(middle, -least), math.inf) if middle < 0.0 else (-math.inf, max(middle, least)))


def friction_change(at_s: float) -> Cause:
    """The sideways grip changes ``at_s`` after the drive's beginning."""

    def inject(b: Hypothesis, s: float) -> Hypothesis:
        return dataclasses.replace(b, friction_change=b.friction_change + s, friction_change_at_s=at_s)

    from_then = f"from {at_s:.0f} s on"
    words = f"the floor grips {{}} more sideways {from_then}", f"the floor grips {{}} less sideways {from_then}"
    return Cause("friction_change", "1", f"sideways grip is more by this share {from_then}", 0.3, 0.04, inject, words, at_s=at_s)


MISSING_MESSAGES = Cause(
    "missing_joint_messages",
    *("1", "share of the wheels' messages that are missing", 0.1, 0.02, lambda b, s: b),
    ("{} of the wheels' messages are missing", "{} of the wheels' messages are missing"),
    one_sided=True,
)
"""Counted by the gaps between stamps, not estimated from the motion."""

_WINDOW_CAUSES = (
    Cause(
        "longitudinal_slip_curvature",
        *("1", "the robot goes less far on tight arcs, at any speed: vx *= 1 - s T", 0.2, 0.02, _add("longitudinal_curvature_slip")),
        ("the robot goes less far on tight arcs: vx *= 1 - {} T", "the robot goes farther on tight arcs: vx *= 1 + {} T"),
    ),
    Cause(
        "wheel_lag",
        *("s", "the body follows the wheels with this time constant", 0.05, 0.008, _add("wheel_lag_s")),
        ("the body follows the wheels with a time constant of {}", "the body leads the wheels by {}"),
        one_sided=True,
    ),
    Cause(
        "rotation_scale",
        *("1", "the robot turns farther than predicted by this share, at any speed", 0.1, 0.01, _add_item("rotation_coefficients", 0)),
        ("the robot turns {} more than the model predicts, at any speed", "the robot turns {} less than the model predicts, at any speed"),
    ),
    Cause(
        "rotation_slip_rate",
        *("s/rad", "the robot turns less the faster it turns: wz *= 1 - s |wz|", 0.1, 0.01, _add_item("rotation_coefficients", 1)),
        ("the robot turns less the faster it turns: wz *= 1 - {} |wz|", "the robot turns more the faster it turns: wz *= 1 + {} |wz|"),
    ),
    Cause(
        "rotation_slip_curvature",
        "1",
        "the robot turns less on gentle arcs, at any speed: wz *= 1 - s (1 - T)",
        *(0.2, 0.02, _add_item("rotation_coefficients", 2)),
        ("the robot turns less on gentle arcs: wz *= 1 - {} (1 - T)", "the robot turns more on gentle arcs: wz *= 1 + {} (1 - T)"),
    ),
)
WINDOW_CAUSES: Mapping[str, Cause] = {cause.id: cause for cause in _WINDOW_CAUSES}
"""Causes that recorded data of other robots needed, beyond those of the simulator; for tables of windows. T is the share of turning."""


REFERENCE_WORDS = {
    "lidar_offset_x": (
        "the point that the reference tracks lies {} ahead of the body's",
        "the point that the reference tracks lies {} behind the body's",
    ),
    "lidar_offset_y": (
        "the point that the reference tracks lies {} left of the body's",
        "the point that the reference tracks lies {} right of the body's",
    ),
    "lidar_yaw": ("the reference's heading is turned {} to the left", "the reference's heading is turned {} to the right"),
    "lidar_time_offset": ("the reference's stamps are {} late", "the reference's stamps are {} early"),
}
"""Words for causes that are the reference's, where a reference measured the motion and not the LiDAR."""


def of_reference(cause: Cause) -> Cause:
    """``cause`` where a reference measured the motion, not the LiDAR: mount and clock are then the reference's."""
    return dataclasses.replace(cause, words=REFERENCE_WORDS.get(cause.id, cause.words))


def slope_across() -> Cause:
    """The floor rises to the left of the drive's first heading."""
    words = (
        "the floor rises by {} to the left of the drive's first heading",
        "the floor rises by {} to the right of the drive's first heading",
    )
    meaning = "the floor rises to the left of the drive's first heading"
    return Cause("slope", "rad", meaning, 0.05, 0.005, _add_item("slope", 1), words, at_s=-1.0, axis="across")
