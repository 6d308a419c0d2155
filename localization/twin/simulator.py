"""A simulator of the user: a file, its numbers that move a wheeled robot, and the engine that plays it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from localization.twin.engine import Engine
from localization.twin.xml_file import XmlFile


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """Numbers of an engine and of the robot in it. NaN for those that the file does not have."""

    mu: float
    """Friction of a wheel's contact [-]."""
    torsional_m: float = math.nan
    """Torsional friction, which acts from condim 4 on [m]."""
    time_constant_s: float = math.nan
    """solref's time constant [s]."""
    damping_ratio: float = math.nan
    """solref's damping ratio [-]."""
    softness: float = math.nan
    """1 - solimp's impedance under load [-]."""
    condim: float = math.nan
    impratio: float = math.nan
    is_elliptic: float = math.nan
    """Friction cones: 1 elliptic, 0 pyramidal."""
    time_step_s: float
    servo_gain: float = math.nan
    """kv, mean over the wheels' servos [N m s/rad]."""
    rotor_inertia: float = math.nan
    """Inertia of a wheel about its axle with its motor's armature, mean over the wheels [kg m^2]."""
    mass_kg: float
    """Mass of the whole robot."""
    cg_x_m: float
    """Ahead of the middle of the wheels [m]."""
    cg_y_m: float
    """Left of it [m]."""
    cg_z_m: float
    """Above the wheels' lowest points [m]."""
    radius_m: float
    track_m: float
    wheelbase_m: float
    slip_stiffness: float = math.nan
    """K of the contact law that takes the place of the engine's friction [-]; NaN where friction is the engine's own."""
    mu_ratio: float = 1.0
    """Friction across the wheels over that along them, by the contact law [-]."""
    inertia_scale: float = 1.0
    """Factor of the body's moments of inertia."""
    radius_scale: float = 1.0
    radius_difference: float = 0.0
    """Radius of the left wheels less that of the right ones over their mean."""
    width_scale: float = 1.0
    """Factor of the width of cylinders."""
    track_scale: float = 1.0
    wheelbase_scale: float = 1.0


@dataclass(frozen=True)
class NumberChange:
    """A number that a repair changes."""

    field: str
    """Field of `Numbers`."""
    meaning: str
    attribute: str
    """Where the file has it."""
    old: float
    """NaN where the file has none."""
    new: float

    def describe(self) -> str:
        """One line.

        >>> NumberChange("mu", "friction", "geom friction[0]", 1.0, 0.5).describe()
        'geom friction[0]: 1 -> 0.5 (friction)'
        """
        old = "none" if math.isnan(self.old) else f"{self.old:.4g}"
        return f"{self.attribute}: {old} -> {self.new:.4g} ({self.meaning})"

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"meaning": self.meaning, "attribute": self.attribute, "file": self.old, "value": self.new}


class Simulator(Protocol):
    """A file of an engine with its numbers."""

    @property
    def file(self) -> XmlFile:
        """The file as the user has it."""

    @property
    def numbers(self) -> Numbers:
        """The numbers that the file has."""

    @property
    def engine(self) -> Engine:
        """Plays the file."""

    @property
    def engine_name(self) -> str:
        """For pages."""

    @property
    def law_name(self) -> str:
        """What the file gets in place of the engine's friction."""

    @property
    def law_files(self) -> Mapping[str, str]:
        """Files that are written beside one with it, by name."""

    @property
    def absent(self) -> frozenset[str]:
        """Fields of `Numbers` that this file or its engine does not have."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was added, left out, or cannot be changed, a sentence each."""

    def with_numbers(self, numbers: Numbers) -> XmlFile:
        """The file with these ``numbers``; all bytes that do not hold one of them are the same."""

    def compiled(self, numbers: Numbers) -> Engine:
        """The engine with these ``numbers``. Raises `SimulationError` where the robot does not stand with them."""

    def with_law(self, mu: float, stiffness: float) -> Numbers:
        """The file's numbers with friction in proportion to slip in place of the engine's, by those of the friction model."""
