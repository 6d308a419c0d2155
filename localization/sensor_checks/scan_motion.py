"""Motion from one scan to the next, by the scans alone: coarse, but independent of wheels, gyro, filter and submap.

The turn is initialized by the circular correlation of the two range profiles. Point-to-line Gauss-Newton with projective association
refines it (Censi 2008, "An ICP variant using a point-to-line metric"; Serafin & Grisetti 2015, NICP, for the association by bearing).
Sensor checks compare it with the other sensors; it is never fused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.events import Scan
from localization.lidar import LidarConfig, Sweep
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import solve
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Points2, Pose2, Triple, triple

BEARINGS = 180
"""Number of bearings of a profile, each 2 deg wide: each has a beam of any scanner in use, however its beams lie to the bins."""
_BIN_RAD = 2.0 * np.pi / BEARINGS
_MIN_BEARINGS = 30
"""Filled bearings of a profile, of `BEARINGS`; fewer leave the turn ambiguous."""
_MAX_ALONE, _MAX_GAP = 0.7, 5
"""Share of the filled bearings without a neighbour on both sides, from where on a scan is sparse; and the widest gap, in bearings (10 deg),
across which its beams are connected."""
_MAX_TURN_BINS = 30
_ITERATIONS = 8
_FIRST_SCALE_M, _LAST_SCALE_M = 0.5, 0.05
"""Scale of the robust loss (Cauchy), annealed [m]."""
_INLIER_M, _MIN_INLIERS = 0.1, 0.5
_MAX_DISTANCE_M = 1.0
"""Largest distance of a point from its associated one, along each axis [m]."""
_MIN_STRUCTURE = 0.15
"""Smallest eigenvalue of the mean of n n^T over the normals. The way along the surfaces that most normals are of has an error of .17 m in a
quarter of a second below 0.05, .09 m below 0.1, .05 m below 0.15 and .03 m beyond (ACES); across them it is .01 m in any scene."""
_DAMPING = 1e-3


class ScanMotion(NamedTuple):
    """Motion of the body from one scan to the next."""

    delta: Pose2
    """(3,) a_T_b [m, m, rad]."""
    has_translation: bool
    """The scene has structure along both axes."""
    normal: FloatArray
    """(2,) unit vector across the surfaces of which there are most: the way along it is known in any scene."""


class Profile(NamedTuple):
    """A planar scan by bearing about the sensor."""

    center: FloatArray
    """(2,) sensor in the body frame [m]."""
    points: FloatArray
    """(180, 2) nearest point by bearing, about the sensor in the body's axes [m]; NaN where none."""
    ranges: FloatArray
    """(180,) nearest range by bearing; NaN where none [m]."""
    normals: FloatArray
    """(180, 2) of the surface at each bearing; NaN where unknown."""


class ScanOdometry:
    """Scan-to-scan odometry: `register` returns the motion since the scan before, or None."""

    def __init__(self) -> None:
        self.last: Profile | None = None
        """Profile of the last scan."""

    def register(self, now: Profile | None) -> ScanMotion | None:
        """Motion since the last call; ``now`` is of any of the body's LiDARs, None of one with too few points.

        None for the first scan, for scans with too few points and where the scans do not fit onto each other.
        """
        last, self.last = self.last, now
        if last is None or now is None:
            return None
        turn = _correlate(np.log(last.ranges), np.log(now.ranges))
        if math.isnan(turn):
            return None
        x, y = (now.center - last.center).tolist()
        return _refine(last, now, (x, y, turn), _MIN_INLIERS)


def align_from(a: Profile, b: Profile, a_T_b: Pose2, min_inliers: float) -> ScanMotion | None:
    """Motion of the body from profile ``a`` to ``b``, refined from ``a_T_b`` (3,); None where fewer than the share ``min_inliers`` of the
    bearings of ``b`` fit."""
    body_T_a, body_T_b = (np.array([*profile.center, 0.0]) for profile in (a, b))
    return _refine(a, b, triple(se2.compose(se2.between(body_T_a, a_T_b), body_T_b)), min_inliers)


def profile_of(scan: Scan, mount: Mount, config: LidarConfig) -> Profile | None:
    """Profile of the surfaces of ``scan`` that are within the LiDAR's range; None for too few points."""
    center = np.array([mount.x, mount.y])
    if not scan.is_planar:
        sweep = Sweep.from_scan(scan, mount, config.min_range_m, config.max_range_m)
        return make_profile(sweep.project(sweep.points) - center, center)
    points = scan.points @ mount.rotation.T
    n = _keep_within(points, (mount.x, mount.y, mount.z), config.min_range_m**2, config.max_range_m**2)
    return make_profile(points[:n, :2], center)


@kernel
def _keep_within(points: FloatArray, sensor: Triple, least: float, most: float) -> int:
    """Move those ``points`` (N, 3) about the ``sensor`` to the front whose squared distance from the body is from ``least`` to ``most``
    [m^2]; their number. NaN is not."""
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] + sensor[0], points[i, 1] + sensor[1], points[i, 2] + sensor[2]
        if least <= x * x + y * y + z * z <= most:
            points[n, 0], points[n, 1], n = points[i, 0], points[i, 1], n + 1
    return n


def make_profile(points: Points2, center: FloatArray) -> Profile | None:
    """Profile of ``points`` (M, 2) about the sensor, which is at ``center`` (2,) in the body frame [m]; None for too few points."""
    profile = Profile(center, np.empty((BEARINGS, 2)), np.empty(BEARINGS), np.empty((BEARINGS, 2)))
    return profile if _fill_profile(points, profile) >= _MIN_BEARINGS else None


@subroutine
def bearing_bin(x: float, y: float) -> int:
    """Bearing of a point, as an index of a profile: arctan to 1e-5 rad (Abramowitz & Stegun 1964, 4.4.49), in a third of the time of
    `math.atan2`, which took half of that of all checks of scans."""
    u, v = abs(x), abs(y)
    z = min(u, v) / max(u, v)
    q = z * z
    angle = z * (0.999866 + q * (-0.3302995 + q * (0.180141 + q * (-0.085133 + q * 0.0208351))))
    angle = 0.5 * math.pi - angle if v > u else angle
    angle = math.pi - angle if x < 0.0 else angle
    return math.floor((angle if y >= 0.0 else -angle) / _BIN_RAD) % BEARINGS


@kernel
def bearing_bins(points: Points2) -> NDArray[np.int64]:
    """(N,) `bearing_bin` of each of ``points`` (N, 2); 0 where NaN."""
    bins = np.zeros(points.shape[0], dtype=np.int64)
    for i in range(points.shape[0]):
        if not math.isnan(points[i, 0] + points[i, 1]):
            bins[i] = bearing_bin(points[i, 0], points[i, 1])
    return bins


@kernel
def _fill_profile(points: Points2, profile: Profile) -> int:
    """Fill ``profile`` with the nearest of ``points`` (M, 2), their ranges and normals, NaN where there is none; number of its ranges."""
    surface, ranges, normals = profile.points, profile.ranges, profile.normals
    surface[:], ranges[:], normals[:] = np.nan, np.nan, np.nan
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        r = math.hypot(x, y)
        k = bearing_bin(x, y)
        if r > 1e-3 and not r >= ranges[k]:
            surface[k, 0], surface[k, 1], ranges[k] = x, y, r
    _connect(surface, ranges)
    for k in range(BEARINGS):
        before, after = surface[k - 1], surface[(k + 1) % BEARINGS]
        dx, dy = after[0] - before[0], after[1] - before[1]
        length = math.hypot(dx, dy)
        if length < 0.1 + 0.5 * ranges[k]:  # else from one surface to another, or unknown
            normals[k, 0], normals[k, 1] = -dy / max(length, 1e-6), dx / max(length, 1e-6)
    return _count(ranges)


@subroutine
def _count(ranges: FloatArray) -> int:
    """Number of ``ranges`` (180,) that are known."""
    n = 0
    for k in range(BEARINGS):
        n += not math.isnan(ranges[k])
    return n


@kernel
def _connect(surface: FloatArray, ranges: FloatArray) -> None:
    """Fill the bearings between the beams of a sparse scan (three degrees and more apart) where neighbours are of one surface."""
    filled, alone = 0, 0
    for k in range(BEARINGS):
        if not math.isnan(ranges[k]):
            filled += 1
            alone += math.isnan(ranges[k - 1]) or math.isnan(ranges[(k + 1) % BEARINGS])
    if alone <= _MAX_ALONE * filled:
        return
    is_beam = ~np.isnan(ranges)
    for k in range(BEARINGS):
        gap = 1
        while gap < _MAX_GAP and not is_beam[(k + gap) % BEARINGS]:
            gap += 1
        after = surface[(k + gap) % BEARINGS]
        dx, dy = after[0] - surface[k, 0], after[1] - surface[k, 1]  # NaN where one of them is no beam
        if math.hypot(dx, dy) < 0.1 + 0.5 * ranges[k]:
            for i in range(1, gap):
                middle = (k + i) % BEARINGS
                surface[middle, 0], surface[middle, 1] = surface[k, 0] + i / gap * dx, surface[k, 1] + i / gap * dy
                ranges[middle] = math.hypot(surface[middle, 0], surface[middle, 1])


@kernel
def _correlate(a: FloatArray, b: FloatArray) -> float:
    """Turn [rad] from profile ``a`` to ``b``, log-ranges (180,), at their least mean difference; NaN where they share too few bearings."""
    best, turn, most = np.inf, np.nan, min(_count(a), _count(b))
    for k in range(2 * _MAX_TURN_BINS + 1):
        shift = (k + 1) // 2 if k % 2 else -(k // 2)  # the smallest first
        n, cost, i = 0, 0.0, 0
        while i < BEARINGS and cost < most * best:  # else its mean cannot be less
            difference = abs(a[i] - b[(i - shift) % BEARINGS])
            if not math.isnan(difference):
                n += 1
                cost += difference
            i += 1
        if n >= _MIN_BEARINGS and cost / n < best:
            best, turn = cost / n, shift * _BIN_RAD
    return turn


def _refine(a: Profile, b: Profile, guess: Triple, min_inliers: float) -> ScanMotion | None:
    """a_T_b of the body by point-to-line Gauss-Newton from the sensor's ``guess``; None where the scans do not fit."""
    found, inlier_share, least_structure, angle = _align_bodies(a, b, guess)
    if inlier_share < min_inliers:
        return None
    return ScanMotion(np.array(found), least_structure >= _MIN_STRUCTURE, np.array([math.cos(angle), math.sin(angle)]))


@kernel
def _align_bodies(a: Profile, b: Profile, guess: Triple) -> tuple[Triple, float, float, float]:
    """Motion of the body from ``a`` to ``b``, where that of the sensor is near ``guess``; share of the bearings of ``b`` that fit, negative
    where there is none; and of the mean of n n^T over these the smaller eigenvalue and the bearing of the other's eigenvector [rad]."""
    S = np.empty((2, 2))
    found, inliers = align_profiles(a, b.points, guess, S)
    if inliers == 0 or not math.isfinite(found[0] + found[1] + found[2]):
        return found, -1.0, 0.0, 0.0
    body_T_a, b_T_body = (a.center[0], a.center[1], 0.0), (-b.center[0], -b.center[1], 0.0)
    moved = se2.scalar_compose(se2.scalar_compose(body_T_a, found), b_T_body)
    least = 0.5 * (S[0, 0] + S[1, 1] - math.hypot(S[0, 0] - S[1, 1], 2.0 * S[0, 1])) / inliers
    angle = 0.5 * math.atan2(2.0 * S[0, 1], S[0, 0] - S[1, 1])
    return moved, inliers / max(_count(b.ranges), 1), least, angle


@kernel
def align_profiles(a: Profile, points: FloatArray, guess: Triple, structure: FloatArray) -> tuple[Triple, int]:
    """Motion of the sensor from profile ``a`` to ``points`` (M, 2), from ``guess`` on, and the number of inliers: 0 where too few points
    are associated. ``structure`` (2, 2) becomes the sum of n n^T over the inliers."""
    A, gradient, a_T_b, inliers = np.empty((3, 3)), np.empty(3), guess, 0
    for k in range(_ITERATIONS):
        scale = _FIRST_SCALE_M * (_LAST_SCALE_M / _FIRST_SCALE_M) ** (k / (_ITERATIONS - 1))
        inliers = _fill_normal_equations(a.points, a.normals, points, a_T_b, scale, A, gradient, structure)
        if inliers < _MIN_BEARINGS // 2:
            return a_T_b, 0
        for p in range(3):
            A[p, p] += _DAMPING * inliers
        x, y, yaw = solve(A, gradient)
        a_T_b = (a_T_b[0] - x, a_T_b[1] - y, a_T_b[2] - yaw)
    return a_T_b, inliers


@subroutine
def _fill_normal_equations(
    surface: FloatArray,
    normals: FloatArray,
    points: FloatArray,
    a_T_b: Triple,
    scale: float,
    A: FloatArray,
    gradient: FloatArray,
    structure: FloatArray,
) -> int:
    """Fill ``A`` (3, 3) with J^T W J and ``gradient`` (3,) with J^T W r, for the distances r of ``points`` (M, 2), moved by ``a_T_b``, from
    the lines of a profile.

    Also ``structure`` (2, 2) with n n^T over the inliers, whose number is returned: nearer to their line than the larger of ``scale`` and
    `_INLIER_M`.
    """
    A[:], gradient[:], structure[:] = 0.0, 0.0, 0.0
    inliers = 0
    c, s = math.cos(a_T_b[2]), math.sin(a_T_b[2])
    for i in range(points.shape[0]):
        tx, ty = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        x, y = tx + a_T_b[0], ty + a_T_b[1]
        if math.isnan(x):
            continue
        k = bearing_bin(x, y)
        nx, ny = normals[k, 0], normals[k, 1]
        dx, dy = x - surface[k, 0], y - surface[k, 1]
        if math.isnan(nx) or not (abs(dx) < _MAX_DISTANCE_M and abs(dy) < _MAX_DISTANCE_M):
            continue
        r = nx * dx + ny * dy
        weight = 1.0 / (1.0 + (r / scale) ** 2)
        J = (nx, ny, ny * tx - nx * ty)
        for p in range(3):
            gradient[p] += weight * J[p] * r
            for q in range(3):
                A[p, q] += weight * J[p] * J[q]
        if abs(r) < max(scale, _INLIER_M):
            inliers += 1
            structure[0, 0] += nx * nx
            structure[0, 1] += nx * ny
            structure[1, 0] += nx * ny
            structure[1, 1] += ny * ny
    return inliers
