"""Motion by three positions alone: the second chord relative to the first, which no heading of the reference's frame enters.

Positions p_0, p_1, p_2 of one point of the robot, without headings, have three invariants of the plane: the lengths of the chords
p_0 p_1 and p_1 p_2, and the angle between them. They are given as a pose: that of a frame at p_2 along the second chord, relative to a
frame at p_0 along the first one.
"""

from __future__ import annotations

import numpy as np

from motion_models.se2 import FloatArray


def chord_poses(first: FloatArray, both: FloatArray) -> FloatArray:
    """(M, 3) second chords relative to the first ones [m, m, rad], of ``first`` p_1 - p_0 and ``both`` p_2 - p_0, each (M, 2) [m]."""
    second = both - first
    angle, other = np.arctan2(first[:, 1], first[:, 0]), np.arctan2(second[:, 1], second[:, 0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.remainder(other - angle + np.pi, 2.0 * np.pi) - np.pi
    return np.stack([c * both[:, 0] + s * both[:, 1], -s * both[:, 0] + c * both[:, 1], turn], axis=1)


def chord_jacobians(first: FloatArray, both: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(M, 3, 2) derivatives of the poses (right perturbation) by ``first`` and by ``both``, each (M, 2) [m]; neither chord may be zero."""
    second = both - first
    by_angle = np.stack([-first[:, 1], first[:, 0]], axis=1) / np.sum(first**2, axis=1, keepdims=True)
    by_other = np.stack([-second[:, 1], second[:, 0]], axis=1) / np.sum(second**2, axis=1, keepdims=True)
    other = np.arctan2(second[:, 1], second[:, 0])
    c, s = np.cos(other), np.sin(other)
    back = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)  # R(-other)
    swept = np.stack([-both[:, 1], both[:, 0]], axis=1)  # d(R(angle) p) / d(angle)
    moved = -np.einsum("nij,nj,nk->nik", back, swept, by_angle)
    by_first = np.concatenate([moved, (-by_other - by_angle)[:, None, :]], axis=1)
    by_both = np.concatenate([back, by_other[:, None, :]], axis=1)
    return by_first, by_both


def chord_covariances(first: FloatArray, both: FloatArray, noise: FloatArray) -> FloatArray:
    """(M, 3, 3) of the poses by independent positions with covariances ``noise`` (M, 3, 2, 2) of p_0, p_1 and p_2 [m^2]."""
    by_first, by_both = chord_jacobians(first, both)
    parts = (-(by_first + by_both), by_first, by_both)
    return np.asarray(sum(g @ noise[:, i] @ np.swapaxes(g, 1, 2) for i, g in enumerate(parts)))
