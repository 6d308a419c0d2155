"""Point-to-line registration against a map of points: where lines run through the map's points, and how far a scan is off them.

A point of the map stays where it was first seen, so that the map does not creep along with the errors of later poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.lidar.cells import ALL_AGES, POINTS_PER_CELL, Ages, ages_between, copy_cells, insert_points, keep_until
from localization.lidar.line_kernels import compare_points, fit_points
from localization.lidar.track import positive_part
from motion_models import se2
from motion_models.se2 import FloatArray

AT_ONCE = np.empty(0)
"""Offsets in time of points that were all seen at once."""
# Where the scene holds nothing, the measurement's sigma: metres, metres, radians. It decides nothing, it only keeps numbers finite.
_NOTHING = np.diag([10.0**-2, 10.0**-2, 3.0**-2])
LEVER_M = 5.0
"""By which a turn is compared with a shift."""


@dataclass(frozen=True)
class Spread:
    """How far the points are off their lines: the sums of an analysis of variance, where points in one cell of the map are a group."""

    within: float = 0.0
    """Squares of the points' distances from their group's mean [m^2]."""
    within_freedom: float = 0.0
    between: float = 0.0
    """Squares of the groups' means [m^2], here and below weighted by how well these are known; the weights' squares sum up to their sum."""
    between_freedom: float = 0.0
    """Sum of these weights: so many groups are worth as much."""
    noise: float = 0.0
    """What the noise of their points makes of those squares [m^2]."""
    place: float = 0.0
    """What the map's points would, if they scattered about their lines by chance [m^2]."""
    facing: float = 0.0
    """Sum over the points within groups of the squared cosine between beam and normal."""
    facing_squared: float = 0.0
    """Sum of its square."""
    within_facing: float = 0.0
    """Squares of the points' distances from their group's mean, times it [m^2]."""
    alike: float = 1.0
    """How many groups a line's error is shared by, in the mean."""


@dataclass(frozen=True)
class LineFit:
    """The point-to-line cost around one pose, as a quadratic in its right perturbation d: const - gradient d + d curvature d / 2."""

    pose: FloatArray
    """(3,) where the cost was expanded."""
    information: FloatArray
    """(3, 3) of the points about the pose, nothing else: without what the noise of the lines' directions feigns."""
    curvature: FloatArray
    """(3, 3) of the cost."""
    gradient: FloatArray
    """(3,) downhill direction at ``pose``."""
    n_matched: int
    """Points that lie by a line of the map."""
    n_on: int
    """Those of them that are on it, within three sigmas."""
    residual_rms: float
    """RMS distance of the matched points from their lines [m], robustly weighted."""
    spread: Spread
    old: FloatArray
    """(3, 3) the part of `information` that comes from points of the map that were not added by the last scan."""
    of_map: FloatArray
    """(3, 3) the part of `information` by which errors of the map's lines, not of the scan's points, enter the pose."""
    lateness: FloatArray
    """(3, 3) [s] how long after the pose that was seen which fixes it: the pose of the least cost moves by this times a twist by which the
    points' motion is off."""

    def measurement(self) -> tuple[FloatArray, FloatArray]:
        """Pose (3,) of the least cost and its covariance (3, 3), wide open along what the points do not hold."""
        cov = np.linalg.inv(self.information + _NOTHING).astype(np.float64, copy=False)
        return se2.compose(self.pose, se2.exp(np.linalg.solve(self.curvature + _NOTHING, self.gradient))), cov


class LineMap:
    """A bounded map of 2D points in square cells."""

    def __init__(self, cell_size: float, min_distance: float, radius: float) -> None:
        """``cell_size`` [m]; points closer than ``min_distance`` [m] to one of their cell are not added; cells farther than ``radius``
        [m] from the robot are forgotten once there are many."""
        self._cell, self._min_distance, self._radius = cell_size, min_distance, radius
        self._allocate(1 << 12)

    def _allocate(self, slots: int) -> None:
        self._used = 0
        self._cells = np.zeros((slots, 3), np.int32)
        self._points = np.zeros((slots, POINTS_PER_CELL, 2), np.float32)
        self._travels = np.zeros((slots, POINTS_PER_CELL), np.float32)
        self._hits = np.zeros(slots, np.int32)  # of one step of a fit, all zero between steps
        self._hit_sums = np.zeros((slots, 2))  # of their places

    def __getstate__(self) -> dict[str, Any]:
        """The points and their cells' places: most of the table is empty."""
        slots = np.flatnonzero(self._cells[:, 2])
        use = np.arange(POINTS_PER_CELL) < self._cells[slots, 2][:, None]
        return {
            "made": (self._cell, self._min_distance, self._radius),
            "size": (len(self._cells), self._used),
            "slots": slots,
            "cells": self._cells[slots],
            "points": self._points[slots][use],
            "travels": self._travels[slots][use],
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["made"])  # type: ignore[misc]
        slots, used = state["size"]
        self._allocate(slots)
        self._used = used
        self._cells[state["slots"]] = state["cells"]
        use = np.arange(POINTS_PER_CELL) < self._cells[:, 2][:, None]
        self._points[use], self._travels[use] = state["points"], state["travels"]

    def insert(self, points: FloatArray, pose: FloatArray, travel: float = 0.0, ages: Ages = ALL_AGES) -> None:
        """Add ``points`` (N, 2) of the body frame, seen from ``pose`` (3,) after ``travel`` [m], to what is in use."""
        self._insert(points, np.full(len(points), travel, np.float32), pose, ages)

    def _insert(self, points: FloatArray, travels: NDArray[np.float32], pose: FloatArray, ages: Ages) -> None:
        self._used, is_full = insert_points(
            self._cells, self._points, self._travels, ages, points, travels, pose, self._cell, self._min_distance, self._used
        )
        if is_full or self._used > self._cells.shape[0] // 2:
            cells = self._cells
            near = cells[:, 2] > 0
            near &= np.hypot(cells[:, 0] * self._cell - pose[0], cells[:, 1] * self._cell - pose[1]) < self._radius
            self._rebuild(near, cells.shape[0] * (2 if near.sum() > cells.shape[0] // 3 else 1))

    def move_since(self, travel: float, world_T_world: FloatArray) -> None:
        """Move the points that were inserted after ``travel`` [m] by ``world_T_world`` (3,)."""
        use = self._use & (self._travels > travel)
        points, travels = self._points[use].astype(float), self._travels[use]
        keep_until(self._cells, self._points, self._travels, travel)
        self._rebuild(self._cells[:, 2] > 0, self._cells.shape[0])
        self._insert(points, travels, world_T_world, ages_between(np.array([[travel, travel + 1.0]])))

    def _rebuild(self, kept: NDArray[np.bool_], slots: int) -> None:
        """A new table of ``slots`` with the ``kept`` (S,) slots of the old one."""
        cells, points, travels = self._cells[kept], self._points[kept], self._travels[kept]
        self._allocate(slots)
        self._used = len(cells)
        copy_cells(cells, points, travels, self._cells, self._points, self._travels)

    def fit(
        self,
        points: FloatArray,
        start: FloatArray,
        options: FitOptions,
        prior: FloatArray,
        center: FloatArray,
        ages: Ages = ALL_AGES,
        since: float = math.nan,
        offsets: FloatArray = AT_ONCE,
    ) -> LineFit:
        """Gauss-Newton from ``start`` (3,) for ``points`` (N, 2) of the body frame.

        ``prior`` (3, 3) is the information of a pull towards ``center`` (3,), which keeps directions that the scene does not hold
        where they were; it is no part of the returned quadratic. Only points of these ``ages`` count. Those added at a travelled distance
        of ``since`` [m] or later are the new ones; with NaN, none is. ``offsets``: when the points were seen, (N,) [s] after the pose, or
        `AT_ONCE`.
        """
        gradient, pose, spread = np.zeros(3), np.array(start, dtype=float), np.zeros(10)
        curvature, told, feigned, of_map, old, late = np.zeros((6, 3, 3))
        n, n_on, squares = fit_points(
            self._cells,
            self._points,
            self._travels,
            self._hits,
            self._hit_sums,
            ages,
            points,
            offsets,
            pose,
            self._cell,
            options.radius,
            options.sigma_point,
            options.sigma_beam,
            options.sigma_line,
            options.place_part,
            options.kernel,
            options.wide_kernel,
            options.iterations,
            prior,
            center,
            since,
            curvature,
            gradient,
            spread,
            told,
            feigned,
            of_map,
            old,
            late,
        )
        information = _known(told - feigned) if n else told
        shrink = np.linalg.cholesky(information + _NOTHING) @ np.linalg.inv(np.linalg.cholesky(told + _NOTHING))
        of_map, old = shrink @ np.array([of_map, old]) @ shrink.T
        # of the pose as it is found: what the lines' directions feign holds it, too
        lateness = np.linalg.solve(told + _NOTHING, late).astype(np.float64, copy=False)
        rms = math.sqrt(squares / n) if n else math.nan
        return LineFit(pose, information, curvature, gradient, n, n_on, rms, Spread(*spread.tolist()), old, of_map, lateness)

    def compare(
        self, points: FloatArray, pose: FloatArray, radius: float, ages: Ages = ALL_AGES, any_point: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """How far ``points`` (N, 2) of the body frame at ``pose`` (3,) are off the lines within ``radius`` [m] of them, and when those
        were seen: distances (N,) [m] and travelled distances (N,) [m], NaN for points without a line of these ``ages``. With ``any_point``,
        these are held against the nearest point."""
        errors, travels = np.empty(len(points)), np.empty(len(points))
        compare_points(self._cells, self._points, self._travels, ages, points, pose, self._cell, radius, any_point, errors, travels)
        return errors, travels

    def points_within(self, center: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
        """Points (M, 2) in cells whose centre is in a square of ``half`` a side [m] around ``center`` (2,), and their travelled distances
        (M,) [m]."""
        near = self._cells[:, 2] > 0
        near &= (np.abs((self._cells[:, :2] + 0.5) * self._cell - center) <= half).all(axis=1)
        slots = np.flatnonzero(near)
        use = np.arange(POINTS_PER_CELL) < self._cells[slots, 2][:, None]
        return self._points[slots][use].astype(float), self._travels[slots][use].astype(float)

    def point_cloud(self) -> FloatArray:
        """(M, 2) all points of the map."""
        return self._points[self._use].astype(float)

    def point_travels(self) -> FloatArray:
        """(M,) travelled distances [m] at which the points of `point_cloud` were added."""
        return self._travels[self._use].astype(float)

    @property
    def _use(self) -> NDArray[np.bool_]:
        return np.arange(POINTS_PER_CELL) < self._cells[:, 2][:, None]


def _known(information: FloatArray) -> FloatArray:
    """What is left of ``information`` (3, 3) where something was taken away from it: nothing along some directions, never less."""
    (a, b, c), (_, d, e), (_, _, f) = information.tolist()
    if a > 0.0 and a * d > b * b and a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) > 0.0:
        return information
    scale = np.array([1.0, 1.0, LEVER_M])
    return positive_part(information / np.outer(scale, scale)) * np.outer(scale, scale)


@dataclass(frozen=True)
class FitOptions:
    radius: float
    """Neighbours within this distance of a point make its line [m]."""
    sigma_point: float
    """Noise of one LiDAR point, whichever way its beam came [m]."""
    sigma_line: float
    """Error of a line of the map, shared by all points that meet it in one cell [m]."""
    kernel: float
    """Scale of the Geman-McClure kernel [m]."""
    wide_kernel: float
    """The same for the first step: it sees farther, and is not so easily caught by the wrong line [m]."""
    iterations: int
    """Gauss-Newton steps at most."""
    sigma_beam: float = 0.0
    """Further noise of it along its beam [m]."""
    place_part: float = 1.0
    """Part of `Spread.place` that is there: the map takes no second point beside one that it has, and so evens out its points' noise."""
