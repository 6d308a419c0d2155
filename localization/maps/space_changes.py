"""What a drive has found gone from a saved map in space: points that stood where its beams pass, and near which it has measured nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from localization.maps.height_slice import HEIGHTS_M, find_ground
from localization.maps.keyframe_map import KeyframeMap
from motion_models.se2 import FloatArray

_BEAM_M = 0.1
"""A beam passes through a point that is nearer to it than this [m]: twice the p95 of positions in a saved map (seed 6 of the study)."""
_LEAST_PASSES = 4
"""Keyframes of the drive that look through a column, from which on what stood there is gone: free for certain, as in the plane."""


def find_gone(mapped: KeyframeMap, drive: KeyframeMap, cell: float) -> NDArray[np.bool_]:
    """(M,) which points of ``mapped`` are gone by the clouds of ``drive``, whose poses are in its frame.

    Candidates stand above the ground, with no point of the drive within ``cell`` [m]. Beams that pass one and end a cell behind it look
    through its column of that width, and what has no points of the drive there goes with it: above, beams end nowhere. The ground stays:
    it is passed at glancing angles.
    """
    points, seen = mapped.points_in_map(), drive.points_in_map()
    gone = np.zeros(len(points), dtype=bool)
    if not len(points) or not len(seen):
        return gone
    distances, _ = cKDTree(seen).query(points, distance_upper_bound=cell)
    stands = find_ground(np.vstack([points, seen])).above(points) >= HEIGHTS_M[0]
    candidates = np.flatnonzero(np.isinf(distances) & stands)
    _, column = np.unique(np.floor(points[candidates, :2] / cell), axis=0, return_inverse=True)
    column = column.ravel()
    passes = np.zeros(len(candidates), dtype=np.int64)
    for sensor, cloud in zip(drive.sensors_in_map(), np.split(seen, np.cumsum(drive.counts)[:-1]), strict=True):
        if len(cloud):
            is_passed = _is_passed(points[candidates] - sensor, cloud - sensor, cell)
            passes[np.unique(column[is_passed])] += 1
    gone[candidates] = passes[column] >= _LEAST_PASSES
    return gone


def _is_passed(points: FloatArray, ends: FloatArray, behind_m: float) -> NDArray[np.bool_]:
    """(N,) whether the beam nearest to each of ``points`` (N, 3) passes it, of beams from the origin to ``ends`` (B, 3), and ends
    ``behind_m`` behind it or farther."""
    ranges, lengths = np.linalg.norm(points, axis=1), np.linalg.norm(ends, axis=1)
    is_beam = lengths > 0.0
    off, nearest = cKDTree(ends[is_beam] / lengths[is_beam, None]).query(points / np.maximum(ranges, 1e-9)[:, None])
    return np.asarray((off * ranges < _BEAM_M) & (lengths[is_beam][nearest] > ranges + behind_m))
