"""Hills as a sum of waves: their height, how a robot stands on them, and how it moves over them.

A robot on the ground has the ground's normal n as its z axis, and its x axis e_1 = (t_x, t_y, grad . t) / L above its heading t.
Turning at w about n, its heading psi changes by

    psi' = L / N (w L - e_2z (d grad . t)),   N = |(-grad, 1)|

as w = e_2 . de_1/dt, with the ground's second derivatives in d grad.
"""

from __future__ import annotations

import math

import numpy as np

from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray

_WAVES, _SHORTEST_M, _LONGEST_M = 6, 8.0, 20.0
_TOUCHING_M = 1e-4
"""Height at which a ray has met the ground [m]."""
NO_WAVES = np.zeros((0, 4))
"""Level ground."""


def make_waves(seed: int, median_slope_deg: float) -> FloatArray:
    """(6, 4) wave numbers along x and y [rad/m], phase [rad] and amplitude [m] of hills whose slope has this median [deg].

    Each component of the gradient is about Gaussian, with a variance of n / 4 times the waves' squared steepness; the median of its length
    is sqrt(2 ln 2) sigma (Rayleigh).
    """
    rng = np.random.default_rng([47, seed])
    numbers = 2.0 * math.pi / rng.uniform(_SHORTEST_M, _LONGEST_M, _WAVES)
    directions, phases = rng.uniform(0.0, math.pi, _WAVES), rng.uniform(0.0, 2.0 * math.pi, _WAVES)
    steepness = math.tan(math.radians(median_slope_deg)) / math.sqrt(2.0 * math.log(2.0)) / math.sqrt(_WAVES / 4.0)
    return np.column_stack([numbers * np.cos(directions), numbers * np.sin(directions), phases, steepness / numbers])


@subroutine
def ground(x: float, y: float, waves: FloatArray) -> tuple[float, float, float, float, float, float]:
    """Height [m], slope along x and y [-] and second derivatives xx, xy, yy [1/m]."""
    z = z_x = z_y = z_xx = z_xy = z_yy = 0.0
    for i in range(waves.shape[0]):
        kx, ky, a = waves[i, 0], waves[i, 1], waves[i, 3]
        s, c = a * math.sin(kx * x + ky * y + waves[i, 2]), a * math.cos(kx * x + ky * y + waves[i, 2])
        z, z_x, z_y = z + s, z_x + kx * c, z_y + ky * c
        z_xx, z_xy, z_yy = z_xx - kx * kx * s, z_xy - kx * ky * s, z_yy - ky * ky * s
    return z, z_x, z_y, z_xx, z_xy, z_yy


@subroutine
def axes(heading: float, z_x: float, z_y: float) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """The robot's x and y axis in the world, and the z of its normal."""
    c, s = math.cos(heading), math.sin(heading)
    rise = z_x * c + z_y * s
    length, norm = math.sqrt(1.0 + rise * rise), math.sqrt(1.0 + z_x * z_x + z_y * z_y)
    e1 = (c / length, s / length, rise / length)
    n = (-z_x / norm, -z_y / norm, 1.0 / norm)
    return e1, (n[1] * e1[2] - n[2] * e1[1], n[2] * e1[0] - n[0] * e1[2], n[0] * e1[1] - n[1] * e1[0]), n[2]


@subroutine
def over_ground(vx: float, vy: float, wz: float, x: float, y: float, heading: float, waves: FloatArray) -> tuple[float, float, float]:
    """Rates of x, y and heading of a robot that moves at the twist ``vx, vy, wz`` in its own plane."""
    _, z_x, z_y, z_xx, z_xy, z_yy = ground(x, y, waves)
    e1, e2, n_z = axes(heading, z_x, z_y)
    by_x, by_y = vx * e1[0] + vy * e2[0], vx * e1[1] + vy * e2[1]
    c, s = math.cos(heading), math.sin(heading)
    rise = z_x * c + z_y * s
    length = math.sqrt(1.0 + rise * rise)
    turn = c * (z_xx * by_x + z_xy * by_y) + s * (z_xy * by_x + z_yy * by_y)
    return by_x, by_y, length * n_z * (wz * length - e2[2] * turn)


@kernel
def stand(planar: FloatArray, waves: FloatArray, positions: FloatArray, rotations: FloatArray) -> None:
    """Fill ``positions`` (n, 3) on the ground and ``rotations`` (n, 3, 3) of robots at planar poses (n, 3)."""
    for i in range(planar.shape[0]):
        z, z_x, z_y, _, _, _ = ground(planar[i, 0], planar[i, 1], waves)
        e1, e2, _ = axes(planar[i, 2], z_x, z_y)
        positions[i, 0], positions[i, 1], positions[i, 2] = planar[i, 0], planar[i, 1], z
        for j in range(3):
            rotations[i, j, 0], rotations[i, j, 1] = e1[j], e2[j]
        rotations[i, 0, 2], rotations[i, 1, 2] = e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2]
        rotations[i, 2, 2] = e1[0] * e2[1] - e1[1] * e2[0]


def poses_on(planar: FloatArray, waves: FloatArray, above_m: float) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 3) ``above_m`` over the ground along its normal [m], and rotations (n, 3, 3), of robots at planar poses (n, 3)."""
    positions, rotations = np.empty((len(planar), 3)), np.empty((len(planar), 3, 3))
    stand(np.ascontiguousarray(planar), waves, positions, rotations)
    return positions + above_m * rotations[:, :, 2], rotations


@kernel
def cast_at_ground(origins: FloatArray, directions: FloatArray, longest: float, waves: FloatArray, ranges: FloatArray) -> None:
    """Shorten ``ranges`` (n, r) of rays from ``origins`` (n, 3) along unit ``directions`` (n, r, 3) to where they intersect the ground.

    A ray goes on by no more than its height over the steepest fall of the ground below it.
    """
    steepest = 0.0
    for i in range(waves.shape[0]):
        steepest += waves[i, 3] * math.hypot(waves[i, 0], waves[i, 1])
    for n in range(directions.shape[0]):
        for r in range(directions.shape[1]):
            dx, dy, dz = directions[n, r, 0], directions[n, r, 1], directions[n, r, 2]
            closing, t, end = steepest * math.hypot(dx, dy) - dz, 0.0, min(ranges[n, r], longest)
            above = math.inf if closing > 0.0 else 0.0
            while above > _TOUCHING_M and t < end:
                above = origins[n, 2] + t * dz - ground(origins[n, 0] + t * dx, origins[n, 1] + t * dy, waves)[0]
                t += max(above, 0.0) / closing + _TOUCHING_M
            if closing > 0.0 and above <= _TOUCHING_M:
                ranges[n, r] = t
