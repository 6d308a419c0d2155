"""A place seen again: where a scan fits into the old part of the map, searched as far as the robot may have drifted since.

The scan matcher looks around its one-step prediction, and metres of drift are beyond that. Against an old part of the map the pose is
uncertain by the growth of its covariance since that part was seen (`Track.growth`), and this is the window, the prior and the gate here.

A wrong place is far worse than a missed one, so a place counts only if most of the scan lies on old lines, if the correction is one that
drift can explain, if no other place explains the scan about as well, and if the next keyframe finds the same correction by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from localization.lidar.correlate import correlate
from localization.lidar.lines import FitOptions, LineMap
from localization.lidar.track import Place, Track, moved
from motion_models import se2
from motion_models.se2 import FloatArray

_KNOWS_NOTHING = np.array([10.0, 10.0, 3.0])
_MOST_POINTS, _MOST_RIVALS = 180, 8


@dataclass(frozen=True)
class RevisitConfig:
    """When a place counts as seen again."""

    is_on: bool = True
    """Look for places seen before."""
    old_after_m: float = 20.0
    """What was mapped this far back on the way is old [m]."""
    keyframe_m: float = 1.0
    """Look again after this way [m]."""
    keyframe_rad: float = 0.5
    """Or after this turn [rad]."""
    max_search_m: float = 8.0
    """Never search farther than this, however uncertain the pose [m]."""
    max_search_rad: float = 0.35
    """Nor farther than this [rad]."""
    min_matched: float = 0.7
    """Part of the scan's points that must lie on old lines."""
    gate_probability: float = 0.999
    """Corrections that are less likely than one in 1 / (1 - this) are not believed."""
    rival_sigmas: float = 4.0
    """By how many sigmas the points that only the best place explains must outnumber those that only another one explains."""


@dataclass(frozen=True, eq=False)
class Revisit:
    """The scan was taken from a place that an old part of the map knows."""

    pose: FloatArray
    """(3,) ``world_T_body`` by scan and old map alone."""
    cov: FloatArray
    """(3, 3) of its right perturbation against the old map; wide open along directions that the scene does not hold."""
    old_cov: FloatArray
    """(3, 3) of the old map itself: of the pose it was drawn from, moved here."""
    growth: FloatArray
    """(3, 3) of the pose against the old map before this was seen."""
    then: Place
    """Where the robot was when it drew that part of the map."""
    matched: float
    """Part of the scan's points on old lines."""


@dataclass(frozen=True, eq=False)
class _Fit:
    pose: FloatArray
    peak: FloatArray
    cov: FloatArray
    on_map: NDArray[np.bool_]
    travels: FloatArray
    score: float


class Revisits:
    """Give it every scan in the order of time; it says when one is of a place seen before, about one in a thousand."""

    def __init__(self, config: RevisitConfig, options: FitOptions, voxel: float) -> None:
        """``options``: of the scan matcher; ``voxel`` [m]: its resolution."""
        self.config, self._options, self._voxel = config, options, voxel
        self.track = Track()
        self._gate = float(chi2.ppf(config.gate_probability, 3))
        self._pending: tuple[int, _Fit] | None = None

    def look(self, scan: FloatArray, lines: LineMap, pose: FloatArray, cov: FloatArray, travel: float, stamp_ns: int) -> Revisit | None:
        """``scan`` (N, 2) of the body frame at ``pose`` (3,) with ``cov`` (3, 3), by all that is known but for old parts of the map."""
        if not self._is_keyframe(pose, travel):
            return None
        self.track.add(Place(stamp_ns, travel, pose, cov))
        fit, then = self._find(scan, lines, pose, travel)
        last, self._pending = self._pending, None if fit is None else (len(self.track) - 1, fit)
        if fit is None or last is None or not self._agrees(last, fit):
            return None
        self._pending = None
        self.track.tie(then)
        place = self.track[then]
        matched = float(fit.on_map.mean())
        return Revisit(fit.pose, fit.cov, moved(place, pose), self.track.growth(then), place, matched)

    def _is_keyframe(self, pose: FloatArray, travel: float) -> bool:
        if not len(self.track):
            return True
        last = self.track[len(self.track) - 1]
        turn = abs(float(se2.between(last.pose, pose)[2]))
        return travel - last.travel >= self.config.keyframe_m or turn >= self.config.keyframe_rad

    def _find(self, scan: FloatArray, lines: LineMap, pose: FloatArray, travel: float) -> tuple[_Fit | None, int]:
        c, before = self.config, travel - self.config.old_after_m
        if before <= self.track[0].travel or len(scan) < 10:
            return None, -1
        limits = np.array([c.max_search_m, c.max_search_m, c.max_search_rad])
        reach = float(np.quantile(np.hypot(scan[:, 0], scan[:, 1]), 0.9))
        points, travels = lines.points_within(pose[:2], reach + c.max_search_m, before)
        if len(points) < c.min_matched * len(scan):
            return None, -1
        then = self.track.at_travel(float(np.median(travels)))
        growth = self.track.growth(then)
        if 9.0 * np.linalg.eigvalsh(growth[:2, :2])[-1] < self._voxel**2:
            return None, -1  # the scan matcher itself sees that far
        floor = np.diag([self._voxel, self._voxel, self._voxel / max(reach, 1.0)]) ** 2 / 9.0
        prior = growth + floor
        few = scan[:: math.ceil(len(scan) / _MOST_POINTS)]
        scores = correlate(few, points, pose, prior, limits, self._voxel, self._gate)
        if len(scores.poses) == 0 or scores.fractions.max() < c.min_matched:
            return None, -1
        fits = self._peaks(scan, lines, scores.poses, scores.fractions - 0.5 * scores.distances / len(few), prior, pose, before)
        fits = [f for f in fits if f.on_map.any()]
        if not fits:
            return None, -1
        best = max(fits, key=lambda f: f.score)
        if best.on_map.mean() < c.min_matched:
            return None, -1
        if any(self._rivals(best, other, scan) for other in fits if other is not best):
            return None, -1
        then = self.track.at_travel(float(np.median(best.travels[best.on_map])))
        off = se2.log(se2.between(pose, best.pose))
        if off @ np.linalg.solve(self.track.growth(then) + best.cov + floor, off) > self._gate:
            return None, -1
        return best, then

    def _peaks(
        self, scan: FloatArray, lines: LineMap, poses: FloatArray, scores: FloatArray, prior: FloatArray, pose: FloatArray, before: float
    ) -> list[_Fit]:
        """The best places and their rivals, each distinct from the others in directions that its own fit holds."""
        fits: list[_Fit] = []
        information = np.asarray(np.linalg.inv(prior), dtype=float)
        left = scores > 0.6 * scores.max()
        poses, scores = poses[left], scores[left]
        reach = max(float(np.quantile(np.hypot(scan[:, 0], scan[:, 1]), 0.8)), 1.0)
        grid = np.diag([self._voxel, self._voxel, self._voxel / reach]) ** 2
        for _ in range(4 * _MOST_RIVALS):
            if not len(poses) or len(fits) == _MOST_RIVALS:
                break
            start = poses[np.argmax(scores)]
            found = lines.fit(scan, start, self._options, information, pose, before)
            cov = np.asarray(np.linalg.inv(found.information + np.diag(_KNOWS_NOTHING**-2)), dtype=float)
            if not any(_distance(f.peak, found.pose, f.cov + cov) < self._gate for f in fits):
                errors, travels = lines.compare(scan, found.pose, self._options.radius, before)
                on_map = errors < self._options.kernel
                off = se2.log(se2.between(pose, found.pose))
                score = float(on_map.mean()) - 0.5 * float(off @ information @ off) / len(scan)
                full = se2.compose(found.pose, se2.exp(cov @ found.gradient))
                fits.append(_Fit(full, found.pose, cov, on_map, travels, score))
            # steps of the search that this start stands for
            near = _distances(start, poses, grid + cov if fits and fits[-1].peak is found.pose else grid) < 4.0
            poses, scores = poses[~near], scores[~near]
        return fits

    def _rivals(self, best: _Fit, other: _Fit, scan: FloatArray) -> bool:
        """Whether ``other`` explains the scan about as well: McNemar's test of the points that only one of them explains, where those of
        one voxel count once, for they see the same thing."""
        cells = np.floor(scan / self._voxel).astype(np.int64)
        only_best = len(np.unique(cells[best.on_map & ~other.on_map], axis=0))
        only_other = len(np.unique(cells[other.on_map & ~best.on_map], axis=0))
        return only_best - only_other <= self.config.rival_sigmas * math.sqrt(only_best + only_other)

    def _agrees(self, last: tuple[int, _Fit], fit: _Fit) -> bool:
        """The motion between two keyframes' places on the old map is that which was measured on the way."""
        index, before = last
        a, b = self.track[index], self.track[len(self.track) - 1]
        motion = se2.between(a.pose, b.pose)
        expected = se2.compose(before.pose, motion)
        A = se2.adjoint(se2.inverse(motion))
        off = se2.log(se2.between(expected, fit.pose))
        cov = A @ before.cov @ A.T + fit.cov + self.track.growth(index)
        return bool(off @ np.linalg.solve(cov, off) < self._gate)


def _distance(a: FloatArray, b: FloatArray, cov: FloatArray) -> float:
    d = se2.log(se2.between(a, b))
    return float(d @ np.linalg.solve(cov, d))


def _distances(center: FloatArray, poses: FloatArray, cov: FloatArray) -> FloatArray:
    d = se2.log(se2.between(center, poses))
    found: FloatArray = np.einsum("ki,ij,kj->k", d, np.linalg.inv(cov), d)
    return found
