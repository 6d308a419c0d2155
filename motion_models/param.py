"""Table of a motion model's parameters: all that calibration, online corrections and robot files have to be given about each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

TURNING_SIGMA = 0.15
"""Prior sigma of the rotation scaling, relative, for robots of one type on different floors and with other loads: Clearpath's own
multipliers for one Husky range from 1.5 to 1.9; terrains differ by a quarter."""
CENTRE_X_SIGMA_M = 0.05
"""Prior sigma of the centre of rotation along the robot [m], for the same robots."""
CENTRE_Y_SIGMA_M = 0.03
"""Prior sigma of the centre of rotation across the robot [m], for the same robots."""


@dataclass(frozen=True)
class Free:
    """Where a parameter is fitted by default: its rank, 1 for the most important; 0 where it is held.

    Of parameters that a drive cannot separate, the one with the highest rank is held. Where a model ranks none, calibration takes
    those of logs, and all where it ranks none there.
    """

    logs: int = 0
    """Logs in which positions were measured."""
    moving_cg: int = 0
    """Such logs in which the centre of gravity moves."""
    turns: int = 0
    """Logs in which headings alone were measured, as by a gyro."""
    rotations: int = 0
    """Tables of rotations in place."""


class Lengths(NamedTuple):
    """Lengths of a robot, in which the scales of parameters are given [m]. The defaults are those of a robot of ordinary size."""

    wheel_radius: float = 0.1
    track_width: float = 0.4
    wheelbase: float = 0.4


class Scale(NamedTuple):
    """``value`` times powers of a robot's lengths: a parameter that grows with the robot has the same scale on each."""

    value: float
    wheel_radius: int = 0
    track_width: int = 0
    wheelbase: int = 0

    def of(self, lengths: Lengths) -> float:
        """Scale on a robot with these ``lengths``, in SI units.

        >>> round(Scale(0.1, wheelbase=1).of(Lengths(wheelbase=0.5)), 3)
        0.05
        """
        return self.value * float(
            lengths.wheel_radius**self.wheel_radius * lengths.track_width**self.track_width * lengths.wheelbase**self.wheelbase
        )


@dataclass(frozen=True)
class Param:
    """One parameter of a motion model."""

    name: str
    unit: str
    """SI unit; 1 for ratios."""
    meaning: str
    scale: Scale
    """Change that matters: by so much robots, floors and loads differ. A drive that leaves more open does not reveal the parameter. It does
    not depend on the nominal value, which may be zero."""
    sigma: float = 0.0
    """Prior standard deviation of its online correction, in its unit or as a share of `relative_to`; 0: it is not corrected. Where the
    model has `sigmas`, by the robot's geometry, these are used instead."""
    relative_to: str = ""
    """Parameter of whose nominal value ``sigma`` is a share."""
    forms: tuple[str, ...] = ("constant", "cg_field")
    """Forms of corrections (`motion_models.online_calibration`) that contain it; one of no form is corrected where it is named."""
    free: Free = Free()
    mirror: tuple[str, float] | None = None
    """Parameter of the left side and factor by which this one of the right side follows it where the robot is symmetric."""

    def __post_init__(self) -> None:
        """Raises `ValueError` for a scale that is not positive."""
        if not (math.isfinite(self.scale.value) and self.scale.value > 0.0):
            raise ValueError(f"parameter {self.name}: its scale must be positive, found {self.scale.value}.")

    @property
    def text(self) -> str:
        """Unit and meaning, as tables and robot files show them."""
        return self.meaning if self.unit == "1" else f"{self.unit}: {self.meaning}"


@dataclass(frozen=True)
class JointCorrection:
    """A correction that changes several parameters together, by a number without a parameter of its own."""

    name: str
    unit: str
    meaning: str
    sigma: float
    """Prior standard deviation in its unit."""
    along: Mapping[str, tuple[str, float]]
    """Change of each parameter per unit: a factor times the nominal value of a parameter."""
    forms: tuple[str, ...] = ("constant", "cg_field")


@dataclass(frozen=True)
class Traits:
    """What estimators and robot files have to be given about a motion model beside its parameters."""

    options: tuple[str, ...] = ()
    """Entries of [models.NAME] in robot files that choose something, where all others are numbers."""
    is_level: bool = False
    """Its coefficients are those of a skidding robot on level ground: on slopes the friction model's difference is added."""
    min_track_over_radius: float = 0.0
    """Track over turning radius below which a motion does not excite its corrections."""
    directions: tuple[JointCorrection, ...] = ()
    """Corrections that change several parameters together."""
    correction_params: tuple[Param, ...] = ()
    """Parameters that `MotionModel.with_correction_params` adds."""
