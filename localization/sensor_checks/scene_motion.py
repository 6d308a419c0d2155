"""Points of a scan by the motion that explains them: of the still world, or of what moves in it.

A scan is compared with one of the same LiDAR from some seconds before, by bearing about where that was taken. Under the right motion of the
robot the still world lies on the same lines. What lies in front of them was free space then, and what was there and is seen through now
has left (free-space violations; Pomerleau et al. 2014, "Long-term 3D map maintenance in dynamic environments").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.sensor_checks import scan_motion
from localization.sensor_checks.scan_motion import BEARINGS, Profile, bearing_bin
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import solve
from motion_models.se2 import FloatArray, Points2, Pose2, Triple, triple

_STATIC_M, _STATIC_SHARE = 0.1, 0.01
"""Distance of a point of the still world from its line at most [m], and per metre of range: noise of ranges, bearings of 2 deg."""
_FREE_M, _FREE_SHARE = 0.2, 0.03
"""What is nearer by this [m], and per metre of range, than the surfaces about its bearing is in free space."""
_PRIOR_M, _PRIOR_RAD, _RESIDUAL_M = 0.1, 0.05, 0.05
"""How far the wheels' motion over a second may be off, and sigma of a residual [m]: wheels that slip by less are refined."""
_ITERATIONS = 4
_MAX_DISTANCE_M, _MIN_ALIGNED = 1.0, 15
"""Largest distance of a point from its associated one [m], and least number of points that have a motion of their own."""
_MAX_WHEEL_TURN_RAD = 0.1
"""Turn of a rival from the wheels', without a gyro, from where on these have slipped [rad]."""
_RIVAL_MOVED, _MIN_UNEXPLAINED = 0.5, 0.1
"""A rival leaves less than this share of what moves; and the share of a scan that it leaves unexplained counts as this much at least."""
HIDDEN, STILL, MOVED = 0, 1, -1
"""Labels of points: nothing was measured there before; of the still world; in what was free space."""

Labels = NDArray[np.int8]


class SceneMotion(NamedTuple):
    """Points of a scan under one motion of the LiDAR since the reference."""

    motion: Pose2
    """(3,) of the LiDAR."""
    labels: Labels
    """(N,) of the points."""
    moved_share: float
    """The larger one of the shares of points that appeared, and of the reference's surfaces in view that are seen through."""


def explain(reference: Profile, now: Profile, points: Points2, start: Pose2, least_moved: float = 0.0) -> SceneMotion:
    """Label ``points`` (N, 2) about the LiDAR, of which ``now`` is the profile, for a motion (3,) of the LiDAR since ``reference``.

    The motion is ``start`` (3,) where less than the share ``least_moved`` moves under it, else that refined by those points that it nearly
    explains: Gauss-Newton for the sum of the squared distances from their lines, and those from ``start`` as a prior. What ends farther
    from ``start`` than that may be off was led away by points that move: it is ``start`` itself then.
    """
    labels = np.empty(len(points), dtype=np.int8)
    motion, moved_share = _explain(reference, now, points, tuple(start.tolist()), least_moved, labels)
    return SceneMotion(np.array(motion), labels, moved_share)


def align_rest(reference: Profile, points: Points2, still: SceneMotion) -> Pose2 | None:
    """Motion (3,) of the LiDAR that explains those ``points`` (N, 2) which are not of the still world; None for too few."""
    rest = points[still.labels != STILL]
    motion, inliers = scan_motion.align_profiles(reference, rest, triple(still.motion), np.empty((2, 2)))
    return np.array(motion) if inliers >= _MIN_ALIGNED and np.isfinite(motion).all() else None


@dataclass(frozen=True, eq=False)
class SceneComparison:
    """A scan, and one from before under the motion by the wheels."""

    reference: Profile
    """Profile of the scan before."""
    profile: Profile
    points: Points2
    scene: SceneMotion
    by_estimate: Pose2
    """(3,) motion of the LiDAR meanwhile, by the estimate."""

    def unique_share(self, has_turn: bool) -> float:
        """Share, of the points that a rival motion does not explain, which the wheels' motion explains; the least of all rivals. A rival
        explains most of what moves under the wheels' motion. Unless ``has_turn``, by a gyro, rivals that turn otherwise are right.
        """
        least = math.inf
        for start in (self.by_estimate, align_rest(self.reference, self.points, self.scene)):
            other = None if start is None else explain(self.reference, self.profile, self.points, start)
            if other is None or other.moved_share >= _RIVAL_MOVED * self.scene.moved_share:
                continue
            if not has_turn and abs(float(se2.scalar_wrap(other.motion[2] - self.scene.motion[2]))) > _MAX_WHEEL_TURN_RAD:
                return 0.0
            unique = float(np.sum((self.scene.labels == STILL) & (other.labels != STILL)))
            least = min(least, unique / max(float(np.sum(other.labels != STILL)), _MIN_UNEXPLAINED * len(self.points)))
        return least


@kernel
def _explain(reference: Profile, now: Profile, points: Points2, start: Triple, least_moved: float, labels: Labels) -> tuple[Triple, float]:
    """See `explain`: fill ``labels`` (N,); the motion, and `SceneMotion.moved_share`."""
    moved_share = _label_both(reference, now, points, start, labels)
    if moved_share < least_moved:
        return start, moved_share
    motion = _refine(reference, points, start)
    off = se2.scalar_log(se2.scalar_between(start, motion))
    if not (math.hypot(off[0], off[1]) < _PRIOR_M and abs(off[2]) < _PRIOR_RAD):
        return start, moved_share
    return motion, _label_both(reference, now, points, motion, labels)


@subroutine
def _label_both(reference: Profile, now: Profile, points: Points2, motion: Triple, labels: Labels) -> float:
    """`SceneMotion.moved_share` under ``motion``; fills ``labels`` (N,)."""
    moved, _ = _label(reference, points, motion, labels)
    vanished, in_view = _label(now, reference.points, se2.scalar_inverse(motion), np.empty(BEARINGS, dtype=np.int8))
    return max(moved / max(len(points), 1), vanished / max(in_view, 1))


@subroutine
def _refine(reference: Profile, points: Points2, prior: Triple) -> Triple:
    """Motion near ``prior`` by ``points`` (N, 2); the first step takes points from twice as far."""
    A, g, x = np.empty((3, 3)), np.empty(3), prior
    for k in range(_ITERATIONS):
        off = se2.scalar_log(se2.scalar_between(prior, x))
        A[:] = 0.0
        for a in range(3):
            w = (_RESIDUAL_M / (_PRIOR_RAD if a == 2 else _PRIOR_M)) ** 2
            A[a, a], g[a] = w, w * off[a]
        _add_near(reference.points, reference.normals, points, x, 2.0 if k == 0 else 1.0, A, g)
        u, v, turn = solve(A, g)
        x = se2.scalar_compose(x, se2.scalar_exp((-u, -v, -turn)))
    return x


@subroutine
def _add_near(surface: FloatArray, normals: FloatArray, points: Points2, x: Triple, width: float, A: FloatArray, g: FloatArray) -> None:
    """Add J^T J to ``A`` (3, 3) and J^T r to ``g`` (3,) for right perturbations of ``x``, of points within ``width`` times the tolerance
    from their line."""
    c, s = math.cos(x[2]), math.sin(x[2])
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        wx, wy = x[0] + c * px - s * py, x[1] + s * px + c * py
        k = bearing_bin(wx, wy)
        nx, ny = normals[k, 0], normals[k, 1]
        dx, dy = wx - surface[k, 0], wy - surface[k, 1]
        r = nx * dx + ny * dy
        if not abs(r) < width * (_STATIC_M + _STATIC_SHARE * math.sqrt(wx * wx + wy * wy)) or abs(dx) + abs(dy) > _MAX_DISTANCE_M:
            continue
        bx, by = c * nx + s * ny, -s * nx + c * ny
        J = (bx, by, px * by - py * bx)
        for a in range(3):
            g[a] += J[a] * r
            for b in range(3):
                A[a, b] += J[a] * J[b]


@subroutine
def _label(reference: Profile, points: Points2, x: Triple, labels: Labels) -> tuple[int, int]:
    """Fill the ``labels`` (N,) of ``points`` (N, 2), moved by ``x`` into the frame of ``reference``; number of those that moved, and of
    those that are not hidden."""
    surface, normals, ranges = reference.points, reference.normals, reference.ranges
    c, s = math.cos(x[2]), math.sin(x[2])
    labels[:] = HIDDEN
    moved, in_view = 0, 0
    for i in range(points.shape[0]):
        wx, wy = x[0] + c * points[i, 0] - s * points[i, 1], x[1] + s * points[i, 0] + c * points[i, 1]
        if math.isnan(wx):
            continue
        distance, k = math.sqrt(wx * wx + wy * wy), bearing_bin(wx, wy)
        nearest, tolerance = math.inf, _STATIC_M + _STATIC_SHARE * distance
        for m in range(k - 1, k + 2):
            m = m % BEARINGS
            if math.isnan(ranges[m]):
                nearest = 0.0  # nothing is known of it
                continue
            nearest = min(nearest, ranges[m])
            dx, dy = wx - surface[m, 0], wy - surface[m, 1]
            off = abs(normals[m, 0] * dx + normals[m, 1] * dy)
            is_near = dx * dx + dy * dy < tolerance * tolerance
            if is_near or (off < tolerance and abs(dx) + abs(dy) < 3.0 * tolerance + 0.05 * distance):
                labels[i] = STILL
                break
        if labels[i] != STILL and distance < nearest - _FREE_M - _FREE_SHARE * nearest:
            labels[i] = MOVED
            moved += 1
        in_view += labels[i] != HIDDEN
    return moved, in_view
