"""A place seen again: where a scan fits into the old part of the map, searched as far as the robot may have drifted since.

The scan matcher looks around its one-step prediction, and metres of drift are beyond that. Against an old part of the map the pose is
uncertain by the growth of its covariance since that part was seen (`Track.growth`), and this is the window, the prior and the gate here.

A wrong place is far worse than a missed one, so a place counts only if most of the scan lies on old lines, if the correction is one that
drift can explain, if no other place explains the scan about as well, and if the next keyframe finds the same correction by itself.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from localization.lidar.cells import ALL_AGES, Ages, ages_between, ages_until
from localization.lidar.correlate import correlate
from localization.lidar.lines import FitOptions, LineMap
from localization.lidar.track import Place, Track, moved
from localization.settings import Positive, Probability, Settings, up_to
from motion_models import se2
from motion_models.se2 import FloatArray

_MOST_RECENT = 40  # keyframes, where the robot turns and goes nowhere
_MOST_POINTS = 150  # in the search
_STARTS, _MOST_RIVALS = 4, 100
_RIVAL_SCORE = 0.8  # whose score in the coarse search is below this part of the best fit's explains far less
_OPEN = 30.0  # sigma along the way to a rival, over its distance: no guess between rivals moves the robot
_TELLS = 0.1  # part of the drift's variance that a place seen again must be below, in some direction
_MOST_PLACES = 24  # whose drift is looked at for one keyframe
_NEAR_PART = 0.9  # of a scan: it is sought around its place among what was drawn near there, not all over the map
_FEW_NEW = 0.02  # part of a place's points that may be added in passing


Way = Callable[[NDArray[np.int64]], FloatArray]
"""Poses (K, 3) at moments (K,) [ns]."""


@dataclass(frozen=True)
class RevisitConfig(Settings):
    """When a place counts as seen again."""

    is_on: bool = True
    """Look for places seen before."""
    old_after_m: Positive = 20.0
    """What was mapped this far back on the way is old [m]."""
    recent_m: Positive = 8.0
    """Scans of this last part of the way are searched together: one alone looks the same in many places of a building [m]."""
    keyframe_m: Positive = 1.0
    """Remember what is seen after this way [m]."""
    keyframe_rad: Positive = 0.5
    """Or after this turn [rad]."""
    search_m: float = 2.0
    """Search again after this way [m]."""
    max_search_m: Positive = 8.0
    """Never search farther than this, however uncertain the pose [m]."""
    max_search_rad: Positive = 0.35
    """Nor farther than this [rad]."""
    min_matched: Annotated[float, up_to(1)] = 0.7
    """Part of the scan's points that must lie on old lines."""
    gate_probability: Probability = 0.999
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
    """(3, 3) of the pose against the old map before this was seen, ``slip`` included."""
    slip: FloatArray
    """(3, 3) by which the way here was worse than believed: zero unless a verified place contradicts what was believed."""
    then: Place
    """Where the robot was when it drew that part of the map, with the pose that the map has for it now."""
    matched: float
    """Part of the scan's points on old lines."""
    is_sure: bool = True
    """Most of them are on lines, few in clutter: sure enough to move a robot by it there and then."""


@dataclass(frozen=True, eq=False)
class _Fit:
    pose: FloatArray
    peak: FloatArray
    cov: FloatArray
    on_map: NDArray[np.bool_]
    travels: FloatArray
    score: float


@dataclass
class _Watch:
    """How one of the searches goes on."""

    is_sure: bool
    pending: tuple[int, _Fit] | None = None
    searched: float = -math.inf


class Revisits:
    """Give it every scan in the order of time; it says when one is of a place seen before, about one in a thousand."""

    def __init__(self, config: RevisitConfig, options: FitOptions, voxel: float, is_thorough: bool = False) -> None:
        """``options``: of the scan matcher; ``voxel`` [m]: its resolution; ``is_thorough``: say it, too, where it is not sure enough to
        move a robot by it."""
        self.config, self._options, self._voxel = config, options, voxel
        self.track = Track()
        self._gate = float(chi2.ppf(config.gate_probability, 3))
        self._watches = [_Watch(True), _Watch(False)] if is_thorough else [_Watch(True)]
        self._recent: deque[tuple[Place, FloatArray]] = deque(maxlen=_MOST_RECENT)
        self._moves: list[tuple[float, float, FloatArray]] = []  # stretches of the way [m] whose part of the map was moved, and how
        self.ages: Ages = ALL_AGES
        """Parts of the map against which the pose is known as well as scan matching needs it: the latest way, and what it is tied to."""

    def look(self, scan: FloatArray, lines: LineMap, pose: FloatArray, cov: FloatArray, travel: float, stamp_ns: int) -> Revisit | None:
        """``scan`` (N, 2) of the body frame at ``pose`` (3,) with ``cov`` (3, 3), by all that is known but for old parts of the map."""
        if not self._is_keyframe(pose, travel):
            return None
        now = Place(stamp_ns, travel, pose, cov)
        self.track.add(now)
        reach = float(np.quantile(np.hypot(scan[:, 0], scan[:, 1]), 0.9)) if len(scan) else 0.0
        self.ages = ages_between(self._known(now, reach))
        self._recent.append((now, _thinned(scan, 0.5 * self._voxel)))
        due = [watch for watch in self._watches if watch.pending is not None or travel - watch.searched >= self.config.search_m]
        recent = self._seen_recently(now) if due else scan
        for watch in due:
            watch.searched = travel
            if (found := self._watched(watch, recent, now, lines, reach)) is not None:
                return found
        return None

    def _watched(self, watch: _Watch, scan: FloatArray, now: Place, lines: LineMap, reach: float) -> Revisit | None:
        fit, seen = self._find(scan, lines, now, reach, watch.is_sure)
        last, watch.pending = watch.pending, None if fit is None else (len(self.track) - 1, fit)
        if fit is None or last is None or not self._agrees(last, fit):
            return None
        watch.pending = None
        then = self.track.at_travel(seen)
        place, growth = self.track[then], self.track.growth(then)
        if watch.is_sure:
            self.track.tie(then)
        off = se2.log(se2.between(now.pose, fit.pose))
        slip = slip_of(off, growth + fit.cov, self._gate)
        matched = float(fit.on_map.mean())
        return Revisit(fit.pose, fit.cov, moved(place, now.pose), growth + slip, slip, self._as_drawn(place, seen), matched, watch.is_sure)

    def _as_drawn(self, place: Place, travel: float) -> Place:
        """``place`` where the map has what was drawn there at ``travel`` [m]."""
        for since, until, world_T_world in self._moves:
            if travel > since and place.travel <= until:
                place = replace(place, pose=se2.compose(world_T_world, place.pose))
        return place

    def correct(self, world_T_world: FloatArray, since: float) -> None:
        """What was drawn after ``since`` [m] of the way lies elsewhere by ``world_T_world`` (3,)."""
        self._moves.append((since, self.track[len(self.track) - 1].travel, world_T_world))
        moved_along = [(replace(place, pose=se2.compose(world_T_world, place.pose)), seen) for place, seen in self._recent]
        self._recent = deque(moved_along, maxlen=_MOST_RECENT)
        for watch in self._watches:
            watch.pending = None  # it was found from where the robot is not any more

    def mend(self, points: FloatArray, travels: FloatArray, way: Way) -> FloatArray:
        """(M, 2) ``points`` (M, 2) of the map, drawn at ``travels`` (M,) [m], had they been drawn along another ``way``."""
        places = [self.track[i] for i in range(len(self.track))]
        if not places:
            return points
        ends = np.array([place.travel for place in places])
        before = np.clip(np.searchsorted(ends, travels, side="right") - 1, 0, len(ends) - 1)
        drawn = np.array([place.pose for place in places])[before]
        for since, until, world_T_world in self._moves:  # as in `_as_drawn`
            hit = (travels > since) & (ends[before] <= until)
            drawn[hit] = se2.compose(world_T_world, drawn[hit])
        there = way(np.array([place.stamp_ns for place in places], dtype=np.int64))[before]
        return se2.transform(se2.compose(there, se2.inverse(drawn)), points)

    def _known(self, now: Place, reach: float) -> FloatArray:
        """(S, 2) stretches of the way [m] whose part of the map can be matched with as it is; ``reach`` [m] of the LiDAR."""
        old = now.travel - self.config.old_after_m
        near = self.track.near(now.pose, 2.0 * reach, old)
        stride = math.ceil(len(near) / _MOST_PLACES)
        around = 0.6 * max(stride, 1) * self.config.keyframe_m
        travels = [self.track[int(i)].travel for i in near[::stride] if self._sees(self.track.growth(int(i)))] if stride else []
        return np.array([*((t - around, t + around) for t in travels), (old, now.travel)])

    def _sees(self, growth: FloatArray) -> bool:
        """The scan matcher itself sees as far as that."""
        return 9.0 * float(np.linalg.eigvalsh(growth[:2, :2])[-1]) < self._voxel**2

    def _seen_recently(self, now: Place) -> FloatArray:
        """(N, 2) the last keyframes' points in the body frame ``now``, one per half voxel."""
        while now.travel - self._recent[0][0].travel > self.config.recent_m:
            self._recent.popleft()
        points = np.concatenate([se2.transform(se2.between(now.pose, place.pose), seen) for place, seen in self._recent])
        return _thinned(points, 0.5 * self._voxel)

    def _is_keyframe(self, pose: FloatArray, travel: float) -> bool:
        if not len(self.track):
            return True
        last = self.track[len(self.track) - 1]
        turn = abs(float(se2.between(last.pose, pose)[2]))
        return travel - last.travel >= self.config.keyframe_m or turn >= self.config.keyframe_rad

    def _find(self, scan: FloatArray, lines: LineMap, now: Place, reach: float, is_sure: bool) -> tuple[_Fit | None, float]:
        """Where the scan fits into the old map, and the travelled distance [m] at which that part of it was drawn."""
        c, pose, travel = self.config, now.pose, now.travel
        if travel - c.old_after_m <= self.track[0].travel or len(scan) < 10:
            return None, math.nan
        drift = math.sqrt(self._gate * float(np.linalg.eigvalsh(self.track.growth(0)[:2, :2])[-1]))
        ranges = np.hypot(scan[:, 0], scan[:, 1])
        whole = float(ranges.max() if is_sure else np.quantile(ranges, _NEAR_PART))
        scan = np.ascontiguousarray(scan[ranges <= whole])
        points, travels = lines.points_within(pose[:2], whole + min(drift, c.max_search_m) + self._voxel)
        before = _last_absence(travels, travel, c.old_after_m)
        points, travels = points[travels < before], travels[travels < before]
        if len(points) < c.min_matched * len(scan):
            return None, math.nan
        growth = self.track.growth(self.track.at_travel(float(np.median(travels))))
        resolution = np.diag([self._voxel, self._voxel, self._voxel / max(reach, 1.0)]) ** 2
        if is_sure and self._sees(growth):
            return None, math.nan
        few = np.ascontiguousarray(scan[:: math.ceil(len(scan) / _MOST_POINTS)])
        rough = _Search(few, lines, ages_until(before), pose, growth + resolution / 9.0, resolution, self._options, not is_sure)
        search = replace(rough, scan=scan)
        limits = np.array([c.max_search_m, c.max_search_m, c.max_search_rad])
        scores = correlate(few, points, pose, search.prior, limits, self._voxel, self._gate)
        if len(scores.poses) == 0 or scores.fractions.max() < c.min_matched:
            return None, math.nan
        left = scores.fractions - 0.5 * scores.distances / len(few)
        best = rough.best(scores.poses, left)
        if best.on_map.mean() < _RIVAL_SCORE * c.min_matched:
            return None, math.nan
        best = search.fit(best.peak)
        if best.on_map.mean() < c.min_matched:
            return None, math.nan
        cov = self._doubted(best, search, scores.poses, left, is_sure)
        if cov is None:
            return None, math.nan
        best = replace(best, cov=cov)
        seen = float(np.median(best.travels[best.on_map]))
        off = se2.log(se2.between(pose, best.pose))
        if off @ np.linalg.solve(self.track.growth(self.track.at_travel(seen)) + best.cov + resolution / 9.0, off) > self._gate:
            return None, math.nan
        return best, seen

    def _doubted(self, best: _Fit, search: _Search, poses: FloatArray, scores: FloatArray, must_tell: bool) -> FloatArray | None:
        """The covariance of ``best``, open towards every other place that explains the scan about as well; None if these are too many
        to try, or, where it ``must_tell``, leave no direction in which the scan says more than drift does."""
        cov = best.cov
        left = scores > _RIVAL_SCORE * best.score
        poses, scores = poses[left], scores[left]
        for _ in range(_MOST_RIVALS):
            far = _distances(best.peak, poses, cov + search.resolution * (4.0 / self._gate)) > self._gate
            poses, scores = poses[far], scores[far]
            if not len(poses):
                return cov if not must_tell or np.linalg.eigvals(np.linalg.solve(search.prior, cov)).real.min() < _TELLS else None
            start = poses[np.argmax(scores)]
            other = search.fit(start)
            is_distinct = _distances(best.peak, other.peak, cov + search.resolution / self._gate) > self._gate
            if is_distinct and self._rivals(best, other, search.scan):
                off = _OPEN * se2.log(se2.between(best.peak, other.peak))
                cov = cov + np.outer(off, off)
            far = np.minimum(_distances(start, poses, search.resolution), _distances(other.peak, poses, search.resolution)) > 4.0
            poses, scores = poses[far], scores[far]
        return None

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


@dataclass(frozen=True, eq=False)
class _Search:
    """One scan against the map as it was before some travelled distance."""

    scan: FloatArray
    lines: LineMap
    ages: Ages
    pose: FloatArray
    prior: FloatArray  # (3, 3) covariance of ``pose`` against that map
    resolution: FloatArray  # (3, 3) what the search cannot tell apart
    options: FitOptions
    any_point: bool  # of the map tells, not its lines alone

    def best(self, poses: FloatArray, scores: FloatArray) -> _Fit:
        """The best of fits from the best ``poses`` (K, 3), each start some way from the others."""
        fits = []
        good = scores > _RIVAL_SCORE * scores.max()
        poses, scores = poses[good], scores[good]
        for _ in range(_STARTS):
            start = poses[np.argmax(scores)]
            fits.append(self.fit(start))
            far = _distances(start, poses, self.resolution) > 4.0
            poses, scores = poses[far], scores[far]
            if not len(poses):
                break
        return max(fits, key=lambda f: f.score)

    def fit(self, start: FloatArray) -> _Fit:
        information = np.asarray(np.linalg.inv(self.prior), dtype=float)
        found = self.lines.fit(self.scan, start, self.options, information, self.pose, self.ages)
        best, cov = found.measurement()
        errors, travels = self.lines.compare(self.scan, found.pose, self.options.radius, self.ages, self.any_point)
        on_map = errors < self.options.kernel
        off = se2.log(se2.between(self.pose, found.pose))
        score = float(on_map.mean()) - 0.5 * float(off @ information @ off) / len(self.scan)
        return _Fit(best, found.pose, cov, on_map, travels, score)


def slip_of(off: FloatArray, cov: FloatArray, gate: float) -> FloatArray:
    """(3, 3) by which the way was worse than ``cov`` (3, 3) says, where a verified place is ``off`` (3,) by more than ``gate``, in squared
    sigmas; else zero."""
    nis = float(off @ np.linalg.solve(cov, off))
    return nis / gate * np.outer(off, off) if nis > gate else np.zeros((3, 3))


def _thinned(points: FloatArray, cell: float) -> FloatArray:
    """The first of ``points`` (N, 2) in each square ``cell`` [m], in their order."""
    ix, iy = np.floor(points / cell).astype(np.int64).T
    _, first = np.unique(ix * (1 << 32) + iy, return_index=True)
    return np.ascontiguousarray(points[np.sort(first)])


def _last_absence(travels: FloatArray, travel: float, length: float) -> float:
    """The travelled distance [m] at which the robot last began to see nothing new around here for ``length`` [m]; -inf if it never did.

    ``travels`` (M,): when the points around here were mapped; ``travel``: now. What was mapped before is an earlier visit's.
    """
    ordered = np.sort(travels)
    since = np.searchsorted(ordered, ordered + length) - np.arange(1, len(ordered) + 1)
    is_end = (since <= _FEW_NEW * len(ordered)) & (ordered <= travel - length)
    return float(ordered[is_end][-1]) + 1e-3 if is_end.any() else -math.inf


def _distances(center: FloatArray, poses: FloatArray, cov: FloatArray) -> FloatArray:
    d = se2.log(se2.between(center, poses))
    found: FloatArray = np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d)
    return found
