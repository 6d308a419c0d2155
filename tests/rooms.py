"""A drive through a rectangular room, by formulas of its own: a circle, wheels of a diff-drive, scans by intersecting four walls."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tests import bags

TRACK, RADIUS = 0.56, 0.164  # vaultbot
X, Y = (-4.0, 6.0), (-3.0, 5.0)
SPEED, TURN = 0.4, 0.2
BEAMS = 360
ANGLES = -math.pi + 2.0 * math.pi * np.arange(BEAMS) / BEAMS


def truth(t: float) -> tuple[float, float, float]:
    """Pose on a circle of 2 m radius that starts at the origin, to the east."""
    r, a = SPEED / TURN, TURN * t
    return r * math.sin(a), r * (1.0 - math.cos(a)), a


def ranges(pose: tuple[float, float, float]) -> np.ndarray:
    """Distances to the walls along `ANGLES`."""
    x, y, yaw = pose
    c, s = np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, (X[1] - x) / c, (X[0] - x) / c)
        to_y = np.where(s > 0, (Y[1] - y) / s, (Y[0] - y) / s)
    return np.minimum(np.abs(to_x), np.abs(to_y))


def drive(
    seconds: float = 20.0,
    multiplier: float = 1.5,
    noise: float = 0.01,
    seed: int = 0,
    spoil: Callable[[int, Any, int], tuple[Any, int] | None] = lambda number, scan, log_ns: (scan, log_ns),
) -> list[bags.Record]:
    """Wheels at 50 Hz, scans at 10 Hz, truth at 10 Hz. ``multiplier``: how much more the wheels differ than their track says.

    ``spoil`` gets the number of each scan, the scan and its time of recording, and gives back what is recorded instead.
    """
    rng = np.random.default_rng(seed)
    half = 0.5 * TRACK * multiplier
    rates = np.array([SPEED - TURN * half, SPEED + TURN * half]) / RADIUS
    records: list[bags.Record] = []
    for i in range(int(seconds * 50)):
        stamp = bags.START + i * (bags.S // 50)
        left, right = rates * (i / 50.0)
        records.append(("/joint_states", bags.joint_state(stamp, position=(left, right, left, right)), stamp))
        if i % 5 == 0:
            pose = truth(i / 50.0)
            measured = ranges(pose) + noise * rng.normal(size=BEAMS)
            scan = bags.laser_scan(stamp, measured, angle_min=-math.pi, angle_increment=2.0 * math.pi / BEAMS, frame_id="base_link")
            spoiled = spoil(i // 5, scan, stamp)
            if spoiled is not None:
                records.append(("/scan", *spoiled))
            records.append(("/ground_truth/odom", bags.odometry(stamp, *pose), stamp))
    return records
