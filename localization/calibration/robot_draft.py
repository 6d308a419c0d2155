"""A robot file in the making: what the user gives, and what was chosen, why, and what is missing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from localization.calibration.urdf_checks import Contradiction
from localization.logs.topic_roles import TopicOverrides
from motion_models.robot import Joints, Mount, Robot

DRIVE_60_S = (
    "Drive about 60 s for the calibration: stand 3 s; 10 s straight ahead; stand 2 s; 10 s of turning in place to the left; stand 2 s; "
    "10 s of turning in place to the right; stand 2 s; 10 s of arcs to each side; stand 3 s. Use everyday speeds and floor."
)


@dataclass(frozen=True)
class Given:
    """What the user gives; None for what is to be found."""

    name: str | None = None
    drive: str | None = None
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    wheel_radius_m: float | None = None
    track_width_m: float | None = None
    wheelbase_m: float | None = None
    mass_kg: float | None = None
    wheel_separation_multiplier: float | None = None
    urdf: Path | None = None
    base_link: str = "base_link"
    like: Robot | None = None
    """A robot whose geometry, driver and joints count where neither log nor URDF has any."""
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    controller: Path | None = None
    """YAML with the parameters of the robot's drive controller."""
    urdf_text: str | None = None
    """Text of `urdf`, expanded where that is a xacro file."""


@dataclass
class Draft:
    """A robot as far as log, URDF and user give it."""

    values: dict[str, float] = field(default_factory=dict)
    """Entries of [geometry] and the driver's, by name."""
    topics: dict[str, str] = field(default_factory=dict)
    joints: Joints | None = None
    mounts: dict[str, Mount] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    """One sentence for each choice."""
    missing: list[str] = field(default_factory=list)
    """What nothing gives, as sentences."""
    is_diff_drive: bool = False
    """Whether one axle is driven: by the URDF, else by the number of joints."""
    contradictions: list[Contradiction] = field(default_factory=list)

    def choose(self, name: str, candidates: Iterable[tuple[float | None, str]]) -> None:
        """Take the first finite value of ``candidates`` (value, source) for the number ``name``."""
        for value, source in candidates:
            if value is not None and math.isfinite(value):
                self.values[name] = float(value)
                self.reasons.append(f"{name} = {value:.5g}: {source}.")
                return
