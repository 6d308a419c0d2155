"""Drives along a bare corridor whose ends are out of range most of the way: wheels that spin, a robot that is pushed."""

from __future__ import annotations

import functools
import math

import numpy as np

from localization.simulation import world
from motion_models import se2
from motion_models.robot import WheelNoise
from tests.helpers import rooms
from tests.helpers.fault_drives import FaultDrive

_WALLS = world.box(-3.0, -1.5, 63.0, 1.5)
_SLIP = WheelNoise(4e-4, 1e-6, 1e-6, 4e-4, 1e-7, 1e-7, 0.0, 0.0)
"""The heading has little: the robot stays between the walls."""
_SCANNER = rooms.Beams(beams=360, rate_hz=8.0, noise=0.02, longest=10.0)
_SPEED, _PUSH_S = 0.8, 4.0
KINDS = ("healthy", "wheels spin for 10 s", "wheels spin all along", "pushed by 4 m", "held for 4 m")


@functools.cache
def in_corridor(kind: str, seed: int = 0) -> FaultDrive:
    """56 m along a corridor of 66 m, one of `KINDS`: wheels that spin count 1.5 times the way; pushed robots stand."""
    drives, stands = (1.0, 0.0, 0.0), (6.0, 0.0, 0.0)
    twists = rooms.path(drives, (35.0, _SPEED, 0.0), stands, (35.0, _SPEED, 0.0), drives)
    times = 0.002 * np.arange(len(twists))
    spin_s = {"wheels spin for 10 s": (15.0, 25.0), "wheels spin all along": (0.0, 99.0)}.get(kind, (math.inf, math.inf))
    pushed = np.zeros_like(twists)
    pushed[(times >= 37.0) & (times < 37.0 + _PUSH_S), 0] = {"pushed by 4 m": 1.0}.get(kind, 0.0)
    held = ((times >= 20.0) & (times < 25.0))[:, None] if kind == "held for 4 m" else np.zeros((len(times), 1), dtype=bool)

    def wheels(t: np.ndarray, driven: np.ndarray) -> np.ndarray:
        return np.where(((t >= spin_s[0]) & (t < spin_s[1]))[:, None], 1.5, 1.0) * twists

    drive = rooms.drive_through(_WALLS, np.where(held, 0.0, twists) + pushed, seed, (0.0, 0.1, 0.003), _SCANNER, _SLIP, wheels)
    stamps = rooms.WALL_START_NS + np.arange(len(drive.track)) * 2_000_000
    return FaultDrive(drive.events, rooms.ROBOT, drive.mounts, True, stamps, se2.between(drive.track[0], drive.track))
