"""What a cause is: a direction in which robot, floor or sensors may differ from the robot file, with all that follows from it.

A `Hypothesis` holds everything that may differ from the robot file; a cause adds its size to one place of it. The predictor that
predicts motions from a hypothesis is in `localization.diagnosis.drive_predictor`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from localization.diagnosis.drive import Drive
from localization.evidence.sensor_errors import SensorError, describe_size
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

Stage = Literal["rates", "load", "floor", "twist", "reference", "sensor"]
"""What a part of a hypothesis changes: the wheels' rates, the load on the wheels, the friction model, the body's twist, or what was
measured, by that which measured the motion or by another sensor."""


def _part(stage: Stage, default: Any = 0.0, lasts: bool = True) -> Any:
    """A field of `Hypothesis` that changes ``stage``; one that does not ``lasts`` is of one drive, or of its clocks."""
    return field(default=default, metadata={"stage": stage, "lasts": lasts})


@dataclass(frozen=True)
class DriveMotion:
    """Motion in all intervals of a drive, as a change of rates or twists gets it."""

    rates: FloatArray
    """(N, 2) left and right wheel rates [rad/s]."""
    twist: FloatArray
    """(N, 3) vx, vy, wz that is predicted from them so far; of zeros where the rates are changed [m/s, m/s, rad/s]."""
    dt: FloatArray
    """(N,) length of the intervals [s]."""
    times_s: FloatArray
    """(N,) start of the intervals, from the drive's start [s]."""


Change = Callable[[DriveMotion, float], FloatArray]
"""New rates (N, 2) or twists (N, 3) from the motion and the cause's size; they are the old ones at size 0."""
Changes = tuple[tuple[Change, float], ...]


class Spell(NamedTuple):
    """Part of a drive, from the drive's start [s]."""

    start_s: float
    end_s: float = math.inf


@dataclass(frozen=True)
class Hypothesis:
    """Deviations from the robot file, of every kind that a cause can have; all 0 for the robot file as it is."""

    left_radius_scale: float = _part("rates")
    """Relative."""
    right_radius_scale: float = _part("rates")
    encoder_loss: float = _part("rates", lasts=False)
    wheel_radius_drift: float = _part("rates", lasts=False)
    """Relative growth of all wheels from the drive's start to its end."""
    changed_rates: tuple[tuple[Change, float], ...] = _part("rates", ())
    """By causes that change the wheels' rates in another way."""
    friction: Mapping[str, float] = field(default_factory=dict, metadata={"stage": "floor", "lasts": True})
    """Additions to parameters of `FrictionModel`."""
    stiffness_exponent: float = _part("floor")
    """Power of the wheels' speed with which the slip stiffness grows (`friction_response`)."""
    cg: tuple[float, float] = _part("load", (0.0, 0.0))
    payload_kg: float = _part("load")
    cg_height: float = _part("floor")
    """Height of the centre of gravity beyond the robot file's [m]."""
    split_friction: float = _part("load")
    """Grip of the left wheels less that of the right ones, over their mean."""
    lidar_offset: tuple[float, float, float] = _part("reference", (0.0, 0.0, 0.0))
    lidar_time_offset_s: float = _part("reference", lasts=False)
    wheel_time_offset_s: float = _part("sensor", lasts=False)
    gyro_bias: float = _part("sensor")
    gyro_scale: float = _part("sensor")
    gyro_time_offset_s: float = _part("sensor", lasts=False)
    range_scale: float = _part("reference")
    range_bias_m: float = _part("reference")
    slip_coefficients: tuple[float, float, float] = _part("twist", (0.0, 0.0, 0.0))
    """vy += a vx wz; wz *= 1 - b |vx|; vx -= c vx |wz|."""
    rotation_coefficients: tuple[float, float, float] = _part("twist", (0.0, 0.0, 0.0))
    """wz *= 1 + a - b |wz| - c (1 - T), T the share of turning, see `FullLinear`."""
    longitudinal_curvature_slip: float = _part("twist")
    """Longitudinal slip by the share of turning, see `FullLinear.longitudinal_slip_curvature`."""
    changed_twists: tuple[tuple[Change, float], ...] = _part("twist", ())
    """By causes that change the body's twist in another way."""
    slope: tuple[float, float] = _part("floor", (0.0, 0.0), lasts=False)
    """Rise of the floor along the axes of the drive's first heading [rad]."""
    other_contact_law: float = _part("floor")
    """Share of the contact law that the robot file does not choose (`motion_models.friction.contact`)."""
    friction_change: float = _part("floor", lasts=False)
    """Sideways grip is more by this share from `friction_change_at_s` on."""
    friction_change_at_s: float = _part("floor", lasts=False)
    wheel_lag_s: float = _part("rates", lasts=False)
    spells: Mapping[Spell, Hypothesis] = field(default_factory=dict, metadata={"stage": "floor", "lasts": False})
    """Further deviations, in parts of the drive."""

    def __add__(self, other: Hypothesis) -> Hypothesis:
        """Both deviations at once."""
        return Hypothesis(**{f.name: _sum(f.name, getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self)})

    def key(self, *stages: Stage) -> tuple[object, ...]:
        """What its changes of these ``stages`` depend on, hashable."""
        values = (getattr(self, f.name) for f in dataclasses.fields(self) if f.metadata["stage"] in stages)
        return tuple(tuple(sorted(v.items())) if isinstance(v, Mapping) else v for v in values)

    def of_robot(self) -> Hypothesis:
        """The part that changes the robot's motion, on this drive and on others."""
        return self._where(lambda f: f.metadata["lasts"] and f.metadata["stage"] not in ("reference", "sensor"))

    def without_passing(self) -> Hypothesis:
        """Without what belongs to one drive or to clocks."""
        return self._where(lambda f: bool(f.metadata["lasts"]))

    def _where(self, is_kept: Callable[[dataclasses.Field[Any]], bool]) -> Hypothesis:
        return Hypothesis(**{f.name: getattr(self, f.name) for f in dataclasses.fields(self) if is_kept(f)})


def _sum(name: str, one: Any, other: Any) -> Any:
    if name in ("changed_rates", "changed_twists"):
        return (*one, *other)
    if isinstance(one, tuple):
        return tuple(x + y for x, y in zip(one, other, strict=True))
    if isinstance(one, Mapping):
        return {**one, **{key: one[key] + value if key in one else value for key, value in other.items()}}
    return one + other


@dataclass(frozen=True)
class Setting:
    """What a drive can show: by its kind, its sensors and its robot."""

    robot: Robot
    kind: str
    """Kind of the drive (`Drive.kind`): log, windows, rotations or runs."""
    has_positions: bool
    """Positions were measured, and not headings alone."""
    has_headings: bool
    """Headings were measured, and not positions alone."""
    has_gyro: bool
    has_ranges: bool
    """A LiDAR measured the motion."""
    has_dropouts: bool
    """An encoder lost counts somewhere."""
    skids: bool
    """The robot's wheels skid in turns; else it turns by its geometry."""
    is_on_slope: bool
    """The drive's floor is not level."""
    is_friction_model: bool
    """The diagnosed model has the floor's friction as its parameters."""
    change_times_s: tuple[float, ...] = ()
    """When a change of the floor is tried [s]."""
    has_baseline: bool = False
    """A healthy drive shows how the robot differs from its file."""

    @property
    def is_timed(self) -> bool:
        """Whether the motion was measured along time, and not once for each row of a table."""
        return self.kind not in ("rotations", "runs")

    @property
    def is_timed_with_positions(self) -> bool:
        """Whether positions were measured along time."""
        return self.is_timed and self.has_positions

    @property
    def is_of_windows(self) -> bool:
        """A table of windows, or headings alone."""
        return self.kind == "windows" or (self.kind != "runs" and not self.has_positions)


@dataclass(frozen=True)
class CorrectionDraft:
    """A robot file while causes are written into it, one after the other."""

    robot: Robot
    drive: Drive
    """Drive on which the causes were found."""
    cg_shift: FloatArray
    """(N, 2) by which the file moves the centre of gravity in each interval of the drive [m]."""
    steps: tuple[str, ...] = ()
    """What is to be done elsewhere, one sentence each."""

    def with_step(self, text: str) -> CorrectionDraft:
        """The draft with one more thing to do elsewhere."""
        return dataclasses.replace(self, steps=(*self.steps, text))

    def with_robot(self, **sections: Any) -> CorrectionDraft:
        """The draft with other ``sections`` of the robot."""
        return dataclasses.replace(self, robot=dataclasses.replace(self.robot, **sections))


_PRIOR_FACTOR = 4.0  # sigma of a size's prior, over the typical size, where no physical limit is given
_PLAUSIBLE_SIGMAS = 4.0  # of the typical size, or of a physical prior: one robot of 16,000 has more
OTHER_REMEDY = "record this drive, and run `skidloc diagnose --out DIR`: robot.toml has the correction"


def _itself(cause: Cause, _: Setting) -> tuple[Cause, ...]:
    return (cause,)


def _always(_: Setting) -> bool:
    return True


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
    """Effect of the cause: returns the hypothesis with a size of this cause added."""
    words: tuple[str, str]
    """Effect on the robot in words, at a positive and at a negative size; {} is replaced by the magnitude with its unit."""
    correct: Callable[[CorrectionDraft, float], CorrectionDraft] | None = field(default=None, repr=False)
    """Writes a size into a robot file; None where only the models' coefficients hold it, which are matched to the motion."""
    remedy: str = OTHER_REMEDY
    """Remedy in words; ``{g}`` is replaced by the corrected robot's geometry, ``{c}`` by its clock and ``{r}`` by all of it."""
    applies: Callable[[Setting], bool] = field(default=_always, repr=False)
    """Whether a drive can show it."""
    by_skidding: bool = False
    """Whether the cause acts by friction of skidding wheels, and so not on robots with casters."""
    is_shown_by_headings: bool = False
    """Headings alone show it; how far a robot turns has many physical reasons that only positions separate."""
    variants: Callable[[Cause, Setting], tuple[Cause, ...]] = field(default=_itself, repr=False)
    """The cause as it is on a drive's robot, or at several moments."""
    reference_words: tuple[str, str] | None = None
    """Words where a reference measured the motion and not the LiDAR, for a cause that is then the reference's."""
    one_sided: bool = False
    is_clock: bool = False
    """It shifts samples in time, between which rates have kinks: signatures are differenced to both sides, over a larger step."""
    at_s: float | None = None
    """Time of the change [s]; None for causes of the whole drive."""
    prior_sigma: float = 0.0
    """Standard deviation of the prior of the size; 0 for four times the typical size."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Sizes beyond these are not considered, where that is not the same to both sides (see `bounds`)."""
    largest_share: float = 0.0
    """Magnitude beyond which another cause is more likely, where that is not by ``prior_sigma``; 0: by that."""
    axis: str = ""
    """Axis in words, where two causes share one id."""
    spell: Spell | None = None
    """Part of the drive in which it holds; None for the whole."""
    spell_95: tuple[tuple[float, float], tuple[float, float]] | None = None
    """95 % intervals of the spell's start and end [s]."""

    @property
    def label(self) -> str:
        """The id as tables show it, with the axis where there are two, and the part of the drive in which it holds."""
        text = f"{self.id} ({self.axis})" if self.axis else self.id
        return text if self.spell is None else f"{text} {describe_spell(self.spell)}"

    @property
    def key(self) -> str:
        """Unique also among several moments of one change, and parts of the drive."""
        return self._change if self.spell is None else f"{self._change}[{self.spell.start_s:g}:{self.spell.end_s:g}]"

    @property
    def _change(self) -> str:
        """The id, of a change on the way with its moment."""
        return self.id if self.at_s is None else f"{self.id}@{self.at_s:g}"

    @property
    def changes_on_the_way(self) -> bool:
        """Whether it begins or ends within the drive."""
        return self.spell is not None or (self.at_s is not None and not self.axis)

    @property
    def group(self) -> str:
        """Name of the group of causes of which only one is tried at a time."""
        return self._change if self.axis else self.id

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
        a physical prior."""
        return self.largest_share or _PLAUSIBLE_SIGMAS * (self.prior_sigma or self.typical)

    def describe(self, size: float, sigma: float = 0.0) -> str:
        """The effect of ``size`` in words, with its direction, and with its ``sigma`` where that is given.

        >>> from localization.diagnosis.causes import CAUSES
        >>> CAUSES["track_width"].describe(-0.012)
        'the left and right contacts are 12 mm closer together than the robot file has it'
        """
        return describe_size(self.words, self.unit, size, sigma, in_si=self.is_coefficient)

    @property
    def is_coefficient(self) -> bool:
        """Whether the size is a coefficient of a slip law, which has no unit that is read by itself."""
        return "= " in self.meaning


def describe_spell(spell: Spell) -> str:
    """When it is, as ``from t = 31 s``, ``until t = 20 s`` or ``from t = 12 to 25 s``."""
    if math.isinf(spell.end_s):
        return f"from t = {spell.start_s:.0f} s"
    return f"until t = {spell.end_s:.0f} s" if spell.start_s <= 0.0 else f"from t = {spell.start_s:.0f} to {spell.end_s:.0f} s"


def in_spell(cause: Cause, spell: Spell, spell_95: tuple[tuple[float, float], tuple[float, float]] | None = None) -> Cause:
    """``cause`` in one part of a drive alone, with the 95 % intervals of its moments. A robot file does not hold it."""
    when = describe_spell(spell)
    moments = () if spell_95 is None else (spell_95[0] if spell.start_s > 0.0 else (), spell_95[1] if math.isfinite(spell.end_s) else ())
    spread = " and ".join(f"{m[0]:.1f} to {m[1]:.1f} s" for m in moments if m)
    words = f"{when} ({spread})" if spread else when

    def inject(b: Hypothesis, s: float) -> Hypothesis:
        return b + Hypothesis(spells={spell: cause.inject(Hypothesis(), s)})

    return dataclasses.replace(
        cause,
        meaning=f"{cause.meaning}, {when}",
        inject=inject,
        words=(f"{words}, {cause.words[0]}", f"{words}, {cause.words[1]}"),
        correct=lambda d, s: d.with_step(f"{cause.id} of {s:+.3g} {cause.unit} holds {when}, not in the whole drive, and is not written."),
        variants=_itself,
        spell=spell,
        spell_95=spell_95,
    )


def cause_of(
    error: SensorError, meaning: str, sizes: tuple[float, float], inject: Callable[[Hypothesis, float], Hypothesis], **more: Any
) -> Cause:
    """The cause that a sensor is off by an ``error``, with its typical and its negligible ``sizes``; ``more``: as of `Cause`."""
    named = {"remedy": error.remedy, "reference_words": error.reference_words, "prior_sigma": error.sigma}
    return Cause(error.id, error.unit, meaning, *sizes, inject, error.words, **{**named, **more})


def with_sizes(sizes: Mapping[Cause, float]) -> Hypothesis:
    """The hypothesis that causes have these ``sizes``."""
    hypothesis = Hypothesis()
    for cause, size in sizes.items():
        hypothesis = cause.inject(hypothesis, size)
    return hypothesis


def add(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    """Adds a size to the number ``name`` of hypotheses."""
    return lambda b, s: dataclasses.replace(b, **{name: getattr(b, name) + s})


def add_item(name: str, index: int) -> Callable[[Hypothesis, float], Hypothesis]:
    """Adds a size to one number of the tuple ``name`` of hypotheses."""

    def inject(b: Hypothesis, s: float) -> Hypothesis:
        old = getattr(b, name)
        changed: dict[str, Any] = {name: tuple(v + s if i == index else v for i, v in enumerate(old))}
        return dataclasses.replace(b, **changed)

    return inject


def change_rates(change: Change) -> Callable[[Hypothesis, float], Hypothesis]:
    """Changes the wheels' rates by a function of the motion and the size, as a cause of another kind than those of the catalogue."""
    return lambda b, s: dataclasses.replace(b, changed_rates=(*b.changed_rates, (change, s)))


def change_twist(change: Change) -> Callable[[Hypothesis, float], Hypothesis]:
    """Changes the body's twist by a function of the motion and the size, as a cause of another kind than those of the catalogue."""
    return lambda b, s: dataclasses.replace(b, changed_twists=(*b.changed_twists, (change, s)))


def changed(changes: Changes, motion: DriveMotion, name: str) -> FloatArray:
    """``name`` of ``motion``, its rates or its twist, after ``changes`` one after the other."""
    for change, size in changes:
        motion = dataclasses.replace(motion, **{name: np.ascontiguousarray(change(motion, size))})
    return np.asarray(getattr(motion, name))
