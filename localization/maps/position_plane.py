"""Pose of a map in the plane of measured positions (east and north of a GNSS receiver), from the positions that its drive fused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2


class PositionFix(NamedTuple):
    """Position of the robot's origin in a map, from one measured position."""

    position: FloatArray
    """(2,) [m]."""
    measured_cov: FloatArray
    """(2, 2) [m^2]."""
    way_m: float = 0.0
    """Way that the robot has driven since, to any side: its heading may not be known [m]."""

    @property
    def cov(self) -> FloatArray:
        """(2, 2) of where the robot is now [m^2]."""
        return self.measured_cov + 0.5 * self.way_m**2 * np.eye(2)

    def squared_mahalanobis(self, position: FloatArray, cov: FloatArray) -> float:
        """Squared Mahalanobis distance (x - p)^T (C + P)^-1 (x - p) of a ``position`` (2,) with ``cov`` (2, 2) from this one [-]."""
        off = position - self.position
        return float(off @ np.linalg.solve(self.cov + cov, off))


@dataclass(frozen=True, eq=False)
class PositionPlane:
    """The plane of the positions that a map's drive fused."""

    plane_T_map: Pose2
    """(3,) [m, m, rad]."""
    covariance: Cov3
    """(3, 3) of its right perturbation."""
    antenna: FloatArray
    """(2,) of the receiver in the body frame [m]."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude [deg] and height [m] of the plane's origin; None for positions that are in metres."""

    def to_map(self, position: FloatArray, cov: FloatArray) -> PositionFix:
        """A measured ``position`` (2,) of the plane with ``cov`` (2, 2), for a robot of unknown heading.

        With T = ``plane_T_map`` = (R, t) and q = R^T (p - t), a right perturbation (u, a) of T moves q by -u - a J q, J = (0 -1; 1 0).
        """
        R = se2.rotation(self.plane_T_map[2])
        q = np.asarray(se2.transform(se2.inverse(self.plane_T_map), position))
        by_plane = -np.array([[1.0, 0.0, -q[1]], [0.0, 1.0, q[0]]])
        return PositionFix(q, R.T @ cov @ R + by_plane @ self.covariance @ by_plane.T + 0.5 * (self.antenna @ self.antenna) * np.eye(2))

    def as_json(self) -> dict[str, Any]:
        """JSON form, as stored in map files."""
        arrays = {name: getattr(self, name).tolist() for name in _SHAPES}
        return {**arrays, "origin": None if self.origin is None else list(self.origin)}


_SHAPES: Mapping[str, tuple[int, ...]] = {"plane_T_map": (3,), "covariance": (3, 3), "antenna": (2,)}


def plane_from_json(found: Any) -> PositionPlane:
    """The inverse of `PositionPlane.as_json`. Raises `ValueError`, `TypeError` or `KeyError` for anything else."""
    arrays = {name: np.asarray(found[name], dtype=float) for name in _SHAPES}
    origin = None if found["origin"] is None else np.asarray(found["origin"], dtype=float)
    every = [*arrays.values(), *([] if origin is None else [origin])]
    is_shaped = all(arrays[name].shape == shape for name, shape in _SHAPES.items()) and (origin is None or origin.shape == (3,))
    if not is_shaped or not all(np.isfinite(array).all() for array in every):
        raise ValueError("its positions are not those of a map")
    return PositionPlane(**arrays, origin=None if origin is None else (float(origin[0]), float(origin[1]), float(origin[2])))
