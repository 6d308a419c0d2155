"""Errors of each kind of source over half a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from localization.evidence.signals import Kind

_SLIP = 0.15
"""Noise of wheels' rates over half a second, a part of their motion."""


@dataclass(frozen=True)
class Noise:
    """Errors of one kind of source over half a second."""

    relative: float
    """Part of the motion: slip, matching."""
    turn_floor: float
    """[rad/s]; of wheels part of the largest turn that their rates may be (`Stack.sizes`): encoders are still where the robot is."""
    way_floor: float
    """[m/s]; of wheels part of the largest way."""
    turn_scale: float
    """Sigma of the logarithm of its scale: skidding, gyro."""
    way_scale: float
    """Radius, ranges."""
    bias: float = 0.0
    """Sigma of a constant yaw rate [rad/s]."""
    skid_relative: float = 0.0
    """Part of the turns where the robot turns by a changing part of what its wheels turn (`_SKID_ODDS`)."""
    turn_of_way: float = 0.0
    """Error of the turn by the way [rad/m]: sides that slip or grow; fr079, ACES, Husky: 0.03, 0.04, 0.003."""
    skid_of_way: float = 0.0
    """Error of the turn by the way where the robot skids [rad/m]."""
    way_of_turn: float = 0.0
    """Error of the way by the turn [m/rad]: a load beside the middle moves the centre of rotation to the side, .2 m of a Warthog in MuJoCo
    with a seventh of its track."""

    @property
    def floors(self) -> dict[str, float]:
        """By channel."""
        return {"way": self.way_floor, "turn": self.turn_floor}


NOISE: Mapping[Kind, Noise] = {
    "wheels": Noise(_SLIP, 0.01, 0.03, 0.25, 0.08, skid_relative=1.2, turn_of_way=0.04, skid_of_way=0.12, way_of_turn=0.1),
    "driver": Noise(_SLIP, 0.01, 0.03, 0.05, 0.08, skid_relative=1.2, turn_of_way=0.04, skid_of_way=0.12, way_of_turn=0.1),
    "gyro": Noise(0.04, 0.01, 0.0, 0.03, 0.0, bias=0.03),
    "lidar": Noise(0.06, 0.02, 0.02, 0.01, 0.04),
    "reference": Noise(0.05, 0.02, 0.02, 0.01, 0.02),
}
"""Measured on fr079, MIT-CSAIL, ACES and the Husky of `tests/data`; the level is estimated in each log (`LEVELS`)."""
