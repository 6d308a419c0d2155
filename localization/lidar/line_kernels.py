"""Lines through a map's points, and how well a scan falls onto them, as compiled loops (see `lines`)."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from localization.lidar.cells import Ages, find_cell, is_used
from motion_models.se2 import FloatArray

_TOO_FEW = 3  # points make no line, from one more on they do
_MIN_GROUP = 4
_KERNEL_SIGMAS = 5.0  # of a point's distance from its line: the kernel's scale at last, beyond which a point is of something else
_MAX_SIGMAS = 3.0  # of a point's distance from its line, else it is not of it; of its noise: neighbours that scatter more are of two lines
_EDGE = 0.05  # of the neighbourhood's squared radius: from here on its points count less
_STALE = 0.02  # of the neighbourhood's radius: points that moved farther look for their lines again
_SAME = 0.05  # of the same: points that are nearer to each other look once for both
_Noise = tuple[float, float, float, float]  # sigma of a point, the same along its beam, sigma of a line, `FitOptions.place_part`
_LEAST_WIDE = 1e-4  # [m^2] variance of a line's points along it
_NOISY = 2.0  # the information that noise in the lines' directions feigns scatters about what it amounts to by expectation
_MAX_LINE_RATIO = 0.1  # smaller over larger eigenvalue of the neighbours' spread: beyond this it is a corner or clutter


@numba.njit(cache=True)
def _gather(
    cells: NDArray[np.int32], points: NDArray[np.float32], travels: NDArray[np.float32], ages: Ages, ix: int, iy: int, near: FloatArray
) -> int:  # pragma: no cover
    """Fills ``near`` (3, K) with place and travelled distance of the points of these ``ages`` in a cell and the eight around it; returns
    how many they are."""
    n = 0
    for jx in range(ix - 1, ix + 2):
        for jy in range(iy - 1, iy + 2):
            slot = find_cell(cells, jx, jy)
            if slot < 0:
                continue
            for k in range(cells[slot, 2]):
                if is_used(ages, travels[slot, k]):
                    near[0, n], near[1, n], near[2, n] = points[slot, k, 0], points[slot, k, 1], travels[slot, k]
                    n += 1
    return n


@numba.njit(cache=True, fastmath={"reassoc", "nsz", "contract"})  # sums in any order: several points at once
def _sums(
    px: FloatArray, py: FloatArray, travels: FloatArray, x: float, y: float, radius: float, since: float
) -> tuple[float, float, float, float, float, float, float, float]:  # pragma: no cover
    """Of the points within ``radius`` of (x, y): how many, how many of them since, and sums of x, y, xx, xy, yy and travelled distance.

    Those by the edge count in part, so that none comes in or goes at once where (x, y) moves."""
    m, new, sx, sy, sxx, sxy, syy, st = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    edge, ramp = radius * radius, 1.0 / (_EDGE * radius * radius)
    for k in range(px.shape[0]):
        qx, qy = px[k] - x, py[k] - y
        w = max(min((edge - (qx * qx + qy * qy)) * ramp, 1.0), 0.0)
        wx, wy = w * qx, w * qy
        m += w
        sx += wx
        sy += wy
        sxx += wx * qx
        sxy += wx * qy
        syy += wy * qy
        st += w * travels[k]
        new += w if travels[k] >= since else 0.0
    return m, new, sx, sy, sxx, sxy, syy, st


@numba.njit(cache=True)
def _line(
    near: FloatArray, n_near: int, x: float, y: float, radius: float, most_thin: float, least_wide: float, since: float
) -> tuple[float, float, float, float, float, float, float, float, float, float]:  # pragma: no cover
    """The line of the points around (x, y): how many they are, 0 where they make none; its normal, the distance of (x, y) from it along
    the normal, the variance of the points across it and along it, how far along it their mean is, their mean travelled distance, the
    part of them that came ``since``, and how far they are from making none, from 0 to 1: it is little by little that a line becomes one.
    """
    m, new, sx, sy, sxx, sxy, syy, st = _sums(near[0, :n_near], near[1, :n_near], near[2, :n_near], x, y, radius, since)
    if m <= _TOO_FEW:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mx, my = sx / m, sy / m
    cxx, cxy, cyy = sxx / m - mx * mx, sxy / m - mx * my, syy / m - my * my
    trace, split = cxx + cyy, math.hypot(cxx - cyy, 2.0 * cxy)
    wide, thin = 0.5 * (trace + split), max(0.5 * (trace - split), 0.0)
    limit = min(_MAX_LINE_RATIO * wide, most_thin)
    if wide <= least_wide or thin >= limit:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    good = min(m - _TOO_FEW, 1.0) * min(10.0 * (wide / least_wide - 1.0), 1.0) * min(2.0 * (1.0 - thin / limit), 1.0)
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    nx, ny = -math.sin(angle), math.cos(angle)
    return m, nx, ny, -(nx * mx + ny * my), thin, wide, ny * mx - nx * my, st / m, new / m, good


@numba.njit(cache=True)
def _nearest(near: FloatArray, n_near: int, x: float, y: float, radius: float) -> tuple[float, float]:  # pragma: no cover
    """Distance and travelled distance of the point that is nearest to (x, y); NaN where none is within ``radius``."""
    best, found = radius * radius, -1
    for k in range(n_near):
        d = (near[0, k] - x) ** 2 + (near[1, k] - y) ** 2
        if d < best:
            best, found = d, k
    return (math.sqrt(best), near[2, found]) if found >= 0 else (math.nan, math.nan)


@numba.njit(cache=True)
def compare_points(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    ages: Ages,
    source: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    any_point: bool,
    errors: FloatArray,
    seen: FloatArray,
) -> None:  # pragma: no cover
    near, n_near = np.empty((3, 9 * points.shape[1])), 0
    at_x, at_y = math.inf, math.inf
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(source.shape[0]):
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        ix, iy = math.floor(x / cell), math.floor(y / cell)
        if ix != at_x or iy != at_y:
            at_x, at_y, n_near = ix, iy, _gather(cells, points, travels, ages, ix, iy, near)
        m, _, _, e, _, _, _, travel, _, _ = _line(near, n_near, x, y, radius, math.inf, _LEAST_WIDE, math.inf)
        errors[i], seen[i] = (abs(e), travel) if m else _nearest(near, n_near if any_point else 0, x, y, radius)


@numba.njit(cache=True)
def _associate(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    hits: NDArray[np.int32],
    hit_sums: FloatArray,
    ages: Ages,
    source: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    noise: _Noise,
    since: float,
    home: NDArray[np.int64],
    lines: FloatArray,
) -> None:  # pragma: no cover
    """Fills ``lines`` (N, 12) for the points ``source`` (N, 2) at ``pose``: how many points make the line (0: none), its normal, a point on
    it, the variance of its place, how many of ``source`` are in its cell, ``home`` (N,), below 0 where the map has none, the part of
    the line's points that came ``since``, how many of ``source`` meet the same line's points, the squared cosine between its normal
    and the beam, the variance of its direction, and how good a line it is, from 0 to 1.

    Lines are of the map's points within ``radius``, so lines that are d apart along a wall share the part 1 - d / (2 radius) of them, and
    their errors are as much alike: the points of each neighbouring cell count for that part, from their mean."""
    scatter = noise[0] * noise[0] + noise[1] * noise[1]
    # points that a robot at rest sees on one spot are in line with the beam, not with the wall
    most_thin, least_wide = _MAX_SIGMAS**2 * scatter, max(_LEAST_WIDE, scatter / _MAX_LINE_RATIO)
    near, n_near, slot = np.empty((3, 9 * points.shape[1])), 0, -1
    at_x, at_y = math.inf, math.inf
    c, s = math.cos(pose[2]), math.sin(pose[2])
    last_x, last_y, same = math.inf, math.inf, (_SAME * radius) ** 2
    for i in range(source.shape[0]):
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        ix, iy = math.floor(x / cell), math.floor(y / cell)
        if ix != at_x or iy != at_y:  # beams that follow one another mostly end in the same cell
            at_x, at_y, n_near = ix, iy, _gather(cells, points, travels, ages, ix, iy, near)
            slot = find_cell(cells, ix, iy)
        if (x - last_x) ** 2 + (y - last_y) ** 2 < same:  # beside the point before, as beams are: it meets the same line
            lines[i] = lines[i - 1]
        else:
            last_x, last_y = x, y
            m, nx, ny, e, thin, wide, along, _, new, good = _line(near, n_near, x, y, radius, most_thin, least_wide, since)
            lines[i, 0] = m
            if m:
                lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4] = nx, ny, x - e * nx, y - e * ny
                bx, by = x - pose[0], y - pose[1]
                facing = (nx * bx + ny * by) ** 2 / max(bx * bx + by * by, 1e-12)  # a mast on the robot is at its origin
                center = thin / (m - 2.0)
                turn = center / wide  # of a regression: beside the points' centre, the line's direction counts, too
                lines[i, 5], lines[i, 7], lines[i, 9], lines[i, 10] = center + along * along * turn, new, facing, turn
                lines[i, 11] = good
        home[i] = slot
        if slot >= 0:
            hits[slot] += 1
            hit_sums[slot, 0] += x
            hit_sums[slot, 1] += y
    near_hits, n_near, last = np.empty((9, 3)), 0, -1
    for i in range(source.shape[0]):
        lines[i, 6] = lines[i, 8] = 1.0
        if home[i] < 0:
            continue
        lines[i, 6] = hits[home[i]]
        if home[i] != last:
            last, n_near = home[i], 0
            for jx in range(cells[last, 0] - 1, cells[last, 0] + 2):
                for jy in range(cells[last, 1] - 1, cells[last, 1] + 2):
                    slot = find_cell(cells, jx, jy)
                    if slot >= 0 and hits[slot] > 0:
                        n = hits[slot]
                        near_hits[n_near, 0], near_hits[n_near, 1], near_hits[n_near, 2] = hit_sums[slot, 0] / n, hit_sums[slot, 1] / n, n
                        n_near += 1
        if lines[i, 0] == 0.0:
            continue
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        shared = 0.0
        for k in range(n_near):
            dx, dy = near_hits[k, 0] - x, near_hits[k, 1] - y
            if abs(lines[i, 1] * dx + lines[i, 2] * dy) < 0.25 * radius:
                shared += near_hits[k, 2] * max(1.0 - 0.5 * abs(lines[i, 2] * dx - lines[i, 1] * dy) / radius, 0.0)
        lines[i, 8] = max(shared, 1.0)
    for i in range(source.shape[0]):
        if home[i] >= 0:
            hits[home[i]] = 0
            hit_sums[home[i]] = 0.0


@numba.njit(cache=True)
def _residual(
    source: FloatArray, lines: FloatArray, i: int, pose: FloatArray, c: float, s: float
) -> tuple[float, float, float, float]:  # pragma: no cover
    """The distance of point ``i`` from its line, and its derivatives: e changes by n . R (dx, dy) and by the lever arm of the point."""
    nx, ny = lines[i, 1], lines[i, 2]
    x = pose[0] + c * source[i, 0] - s * source[i, 1]
    y = pose[1] + s * source[i, 0] + c * source[i, 1]
    jx, jy = nx * c + ny * s, ny * c - nx * s
    return nx * (x - lines[i, 3]) + ny * (y - lines[i, 4]), jx, jy, jy * source[i, 0] - jx * source[i, 1]


@numba.njit(cache=True)
def _add(H: FloatArray, w: float, jx: float, jy: float, jt: float) -> None:  # pragma: no cover
    """One point's information to the upper triangle of ``H``."""
    H[0, 0] += w * jx * jx
    H[0, 1] += w * jx * jy
    H[0, 2] += w * jx * jt
    H[1, 1] += w * jy * jy
    H[1, 2] += w * jy * jt
    H[2, 2] += w * jt * jt


@numba.njit(cache=True)
def _of_point(lines: FloatArray, i: int, noise: _Noise) -> float:  # pragma: no cover
    """The variance of point ``i`` across its line: most of a LiDAR's noise is along the beam, and a beam that grazes a wall tells well
    where it is."""
    variance: float = noise[0] * noise[0] + lines[i, 9] * noise[1] * noise[1]
    return variance


@numba.njit(cache=True)
def _of_distance(lines: FloatArray, i: int, noise: _Noise) -> float:  # pragma: no cover
    """The variance of point ``i``'s distance from its line."""
    variance: float = _of_point(lines, i, noise) + noise[2] * noise[2] + lines[i, 5]
    return variance


@numba.njit(cache=True)
def _is_on(lines: FloatArray, i: int, e: float, noise: _Noise) -> bool:  # pragma: no cover
    """Point ``i``, ``e`` off its line, is of it: within three sigmas."""
    return e * e < _MAX_SIGMAS**2 * _of_distance(lines, i, noise)


@numba.njit(cache=True)
def _weigh(
    lines: FloatArray, i: int, e: float, noise: _Noise, kernel: float, sigmas: float
) -> tuple[float, float, float]:  # pragma: no cover
    """Of point ``i``, ``e`` off its line: its robust weight, the factor by which the kernel holds it down, and the line's part of its
    variance.

    All points in one cell meet the same line, whose error they share: together they know no more than it; and where the map's points are
    off, so are all lines that they make.
    """
    _, _, sigma_line, place_part = noise
    line, place = lines[i, 6] * sigma_line * sigma_line, lines[i, 8] * place_part * lines[i, 5]
    variance = _of_point(lines, i, noise) + line + place
    robust = 1.0 + e * e / min(kernel * kernel, sigmas * sigmas * _of_distance(lines, i, noise))
    return lines[i, 11] / (variance * robust * robust), robust, (line + place) / variance


@numba.njit(cache=True)
def _sum_up(
    source: FloatArray, lines: FloatArray, pose: FloatArray, noise: _Noise, kernel: float, sigmas: float, H: FloatArray, g: FloatArray
) -> tuple[int, int, float]:  # pragma: no cover
    """The quadratic of the cost around ``pose``, into ``H`` and ``g``; returns the matched points, those on their lines, and the weighted
    sum of squares."""
    H[:], g[:] = 0.0, 0.0
    n_matched, n_on, squares = 0, 0, 0.0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(source.shape[0]):
        if lines[i, 0] == 0.0:
            continue
        e, jx, jy, jt = _residual(source, lines, i, pose, c, s)
        w, robust, _ = _weigh(lines, i, e, noise, kernel, sigmas)
        _add(H, w, jx, jy, jt)
        g[0] -= w * jx * e
        g[1] -= w * jy * e
        g[2] -= w * jt * e
        n_matched += 1
        n_on += _is_on(lines, i, e, noise)
        squares += e * e / (robust * robust)
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return n_matched, n_on, squares


@numba.njit(cache=True)
def fit_points(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    hits: NDArray[np.int32],
    hit_sums: FloatArray,
    ages: Ages,
    source: FloatArray,
    offsets: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    sigma_point: float,
    sigma_beam: float,
    sigma_line: float,
    place_part: float,
    final_kernel: float,
    wide_kernel: float,
    iterations: int,
    prior: FloatArray,
    center: FloatArray,
    since: float,
    H: FloatArray,
    g: FloatArray,
    spread: FloatArray,
    information: FloatArray,
    feigned: FloatArray,
    of_map: FloatArray,
    old: FloatArray,
    late: FloatArray,
) -> tuple[int, int, float]:  # pragma: no cover
    """Changes ``pose``, ``H``, ``g`` and what follows them in place (see `_spread` and `_parts`); returns the matched points, those on
    their lines, and the weighted sum of squares.

    The kernel narrows: the first steps see far; once most points are on their lines, what is of none but happens to be near one is left
    out, as a wall around the corner that was not seen before. Lines are looked up again where the points have moved by a part of the
    neighbourhood since they were: near the end, they stay.
    """
    noise = sigma_point, sigma_beam, sigma_line, place_part
    home, lines = np.empty(source.shape[0], np.int64), np.zeros((source.shape[0], 12))
    reach, moved, sigmas, n_matched, n_on, squares = 0.0, math.inf, math.inf, 0, 0, 0.0
    for i in range(source.shape[0]):
        reach = max(reach, math.hypot(source[i, 0], source[i, 1]))
    for iteration in range(iterations + 1):
        if moved > _STALE * radius:
            _associate(cells, points, travels, hits, hit_sums, ages, source, pose, cell, radius, noise, since, home, lines)
            moved = 0.0
        kernel = wide_kernel if iteration == 0 else final_kernel
        n_matched, n_on, squares = _sum_up(source, lines, pose, noise, kernel, sigmas, H, g)
        if iteration >= iterations or n_matched == 0:
            break
        c, s = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = center[0] - pose[0], center[1] - pose[1]
        turn = (center[2] - pose[2] + math.pi) % (2.0 * math.pi) - math.pi
        px, py = c * dx + s * dy, c * dy - s * dx
        b0 = g[0] + prior[0, 0] * px + prior[0, 1] * py + prior[0, 2] * turn
        b1 = g[1] + prior[1, 0] * px + prior[1, 1] * py + prior[1, 2] * turn
        b2 = g[2] + prior[2, 0] * px + prior[2, 1] * py + prior[2, 2] * turn
        a00, a01, a02 = H[0, 0] + prior[0, 0], H[0, 1] + prior[0, 1], H[0, 2] + prior[0, 2]
        a11, a12, a22 = H[1, 1] + prior[1, 1], H[1, 2] + prior[1, 2], H[2, 2] + prior[2, 2]
        i00, i01, i02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
        i11, i12, i22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
        det = a00 * i00 + a01 * i01 + a02 * i02
        d0 = (i00 * b0 + i01 * b1 + i02 * b2) / det
        d1 = (i01 * b0 + i11 * b1 + i12 * b2) / det
        d2 = (i02 * b0 + i12 * b1 + i22 * b2) / det
        pose[0] += c * d0 - s * d1
        pose[1] += s * d0 + c * d1
        pose[2] += d2
        moved += math.hypot(d0, d1) + abs(d2) * reach
        if sigmas == math.inf and iteration > 0 and 2 * n_on > n_matched:
            sigmas = _KERNEL_SIGMAS
        elif iteration > 0 and abs(d0) + abs(d1) + abs(d2) < 1e-4:
            iterations = iteration + 1
    _spread(source, lines, home, pose, noise, spread)
    _parts(source, offsets, lines, pose, noise, final_kernel, sigmas, information, feigned, of_map, old, late)
    return n_matched, n_on, squares


@numba.njit(cache=True)
def _parts(
    source: FloatArray,
    offsets: FloatArray,
    lines: FloatArray,
    pose: FloatArray,
    noise: _Noise,
    kernel: float,
    sigmas: float,
    information: FloatArray,
    feigned: FloatArray,
    of_map: FloatArray,
    old: FloatArray,
    late: FloatArray,
) -> None:  # pragma: no cover
    """Fills the ``information`` (3, 3) of the points, and its parts: ``feigned`` by the noise of the lines' directions, ``of_map`` the part
    by which errors of the lines weigh, ``old`` what is not new of the lines; ``late`` is each point's part times when it was seen,
    ``offsets`` (N,), or zero if these are (0,).

    From points that follow their noise the kernel takes 7 % of the cost's curvature, but only 2 % of what they tell: they count in full.
    A line's direction is estimated. Its noise makes walls that are parallel look as if they were not quite, and in a sum of squares that
    looks like knowledge of the place along them. What it amounts to is known by expectation; it scatters, so that more of it is feigned.
    """
    information[:], feigned[:], of_map[:], old[:], late[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(source.shape[0]):
        if lines[i, 0] == 0.0:
            continue
        e, jx, jy, jt = _residual(source, lines, i, pose, c, s)
        w, robust, of_line = _weigh(lines, i, e, noise, kernel, sigmas)
        if _is_on(lines, i, e, noise):
            w *= robust * robust
        _add(information, w, jx, jy, jt)
        _add(feigned, _NOISY * w * lines[i, 10], -jy, jx, jx * source[i, 0] + jy * source[i, 1])
        _add(of_map, w * of_line, jx, jy, jt)
        _add(old, w * (1.0 - lines[i, 7]), jx, jy, jt)
        if offsets.shape[0]:
            _add(late, w * offsets[i], jx, jy, jt)
    for M in (information, feigned, of_map, old, late):
        M[1, 0], M[2, 0], M[2, 1] = M[0, 1], M[0, 2], M[1, 2]


@numba.njit(cache=True)
def _spread(
    source: FloatArray,
    lines: FloatArray,
    home: NDArray[np.int64],
    pose: FloatArray,
    noise: _Noise,
    spread: FloatArray,
) -> None:  # pragma: no cover
    """Fills ``spread`` (10,), see `Spread`, by the points that are on their lines. A group ends where the scan leaves a cell."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    line = noise[2] * noise[2]
    spread[:] = 0.0
    n, total, squares, place, facing, of_points, shared = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    weights, weights_squared = 0.0, 0.0
    for i in range(source.shape[0] + 1):
        is_end = i == source.shape[0]
        if n and (is_end or home[i] != home[i - 1]):
            if n >= _MIN_GROUP:
                within = squares - total * total / n
                spread[0] += within
                spread[1] += n - 1
                w = n / (of_points / n + n * line + noise[3] * place)
                weights += w
                weights_squared += w * w
                spread[2] += w * (total / n) ** 2
                spread[4] += w * within / (n - 1) / n
                spread[5] += w * place / n
                spread[9] += w * shared / n
                spread[6] += (n - 1) * (facing / n)
                spread[7] += (n - 1) * (facing / n) ** 2
                spread[8] += within * (facing / n)
            n, total, squares, place, facing, of_points, shared = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if is_end or lines[i, 0] == 0.0:
            continue
        e, _, _, _ = _residual(source, lines, i, pose, c, s)
        if _is_on(lines, i, e, noise):
            of_points += _of_point(lines, i, noise)
            shared += lines[i, 8] / lines[i, 6]
            n += 1
            total += e
            squares += e * e
            place += lines[i, 5]
            facing += lines[i, 9]
    if weights:
        scale = weights / weights_squared
        spread[3] = weights * scale
        spread[2] *= scale
        spread[4] *= scale
        spread[5] *= scale
        spread[9] /= weights
