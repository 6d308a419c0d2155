"""The LiDAR as a witness of motion: what a scan says about the motion since the last one, by scan and map alone.

Shared by all estimators that fuse. The estimator says where to look and where the last scan was taken (`anchor`), gets a relative motion
with the covariance that scan and map give it, and says afterwards where the scan belongs in the map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from localization.estimators.base import NO_POINTS
from localization.lidar import LidarConfig, LidarMatcher, MapTie, Registration, Revisit, ScanCheck, Slip, Sweep, Way
from localization.steps import Step
from motion_models import se2
from motion_models.base import Motion
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_VISIBLE_M = 0.002  # points that are moved by less need not be moved for the map


@dataclass(frozen=True)
class Sight:
    """What was seen of the motion since the last scan."""

    motion: Motion
    trust: float
    """How probable it is that the witness is right where others contradict it."""
    tie: MapTie | None = None
    """The map by which it was measured; None where there is none."""


class Witness(Protocol):
    """Something that measures the motion from scan to scan."""

    @property
    def can_begin(self) -> bool:
        """The next motion can be measured from the scan that was last looked at. If not, go on measuring from the one before."""

    def look(self, step: Step, anchor: FloatArray, guess: FloatArray) -> Sight | None:
        """The motion from ``anchor`` (3,), the pose at the last scan that could begin one, to the scan of ``step``, searched around
        ``guess`` (3,)."""

    def recall(self, step: Step, pose: FloatArray, cov: FloatArray) -> Revisit | None:
        """Whether the scan that was last looked at is of a place seen long before, where ``pose`` (3,) with ``cov`` (3, 3) is the
        estimate by all but this. Correct the pose by it, and say so, before you `remember` the scan."""

    def correct(self, before: FloatArray, after: FloatArray) -> None:
        """What was recalled made ``before`` (3,) to ``after`` (3,)."""

    def remember(self, step: Step, pose: FloatArray) -> bool:
        """The scan that was last looked at, and can begin a motion, was taken from ``pose`` (3,). Returns whether it is drawn."""

    def map_points(self, way: Way | None = None) -> FloatArray:
        """(M, 2) what was seen, in the world [m]; had the robot come another ``way``, if there is one."""

    def counts(self) -> Mapping[str, int]:
        """How many scans could not be used, or not in all directions, by what was amiss."""


class ScanWitness:
    """Scan-to-map matching (`LidarMatcher`), and what of it enters the map."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig | None = None, is_thorough: bool = False) -> None:
        self._mounts, self._matcher, self._is_thorough = mounts, LidarMatcher(config, is_thorough), is_thorough
        self._is_placed = True  # it is known where the LiDAR sits that drew the map
        self._is_begun, self._slip = False, Slip()
        self._seen_ns, self._last_ns = -1, -1  # stamp of the last scan, and of the last that was good
        self._twist, self._has_wheels = np.zeros(3), True  # of the last step with a scan
        self._late, self._late_first = 0.0, 0.0  # of the last sweep; of that which began the map, until another has met it
        self._check, self._is_good = ScanCheck(self._matcher.config), True
        self._drift = np.zeros((3, 3))  # of the wheels, since the last scan that was good

    @property
    def can_begin(self) -> bool:
        return self._is_good

    def look(self, step: Step, anchor: FloatArray, guess: FloatArray) -> Sight | None:
        assert step.scan is not None
        A = se2.adjoint(se2.inverse(step.predicted.delta))
        self._drift = A @ self._drift @ A.T + step.predicted.cov
        since_s = (step.end_ns - self._seen_ns) * 1e-9 if self._seen_ns >= 0 else 0.0
        self._seen_ns = step.end_ns
        self._is_good = not self._check.is_stale(step.scan, step.is_standing)
        if not self._is_good:
            return None
        sweep = Sweep.of(step.scan, self._mount(step.scan.frame_id))
        self._late = sweep.lateness
        slip = self._slip
        if step.has_wheels != self._has_wheels:  # the robot moves on as it did, whoever tells
            slip.rate = slip.rate + self._twist - step.twist
        slip.advance(step.duration, step.predicted.cov, step.twist_var)
        rate = slip.rate
        change, self._twist, self._has_wheels = step.twist - self._twist, step.twist, step.has_wheels
        found = self._matcher.register(sweep.at_stamp(step.twist + rate), sweep.is_planar, guess, self._drift, sweep.offsets)
        if found is None:
            self._check.miss(step.scan)
            self._is_good = not self._matcher.has_map
            return None
        self._is_good = not self._check.is_jump(se2.between(guess, found.pose), found, since_s)
        if not self._is_good:
            return None
        gain = np.zeros(3)
        if step.start_ns == self._last_ns and step.duration > 0.0:
            told = step.predicted.delta if step.has_wheels else se2.exp(step.twist * step.duration)
            off = se2.log(se2.between(se2.compose(anchor, told), found.pose))
            variance = np.diag(found.cov) / found.trust + (1.0 - found.trust) * off**2
            gain = slip.measure(off / step.duration, variance / step.duration**2)
            found = self._amended(found, sweep, step, slip.rate - rate)
        swept = self._swept(step, found.lateness, sweep.lateness, gain, change)
        bent = self._bent()
        tie = replace(found.tie, bent=bent, sweep=swept)
        return Sight(Motion(se2.between(anchor, found.pose), found.cov + bent), found.trust, tie)

    def _bent(self) -> FloatArray:
        """(3, 3) by how much a map is off that a sweep began whose slip nobody had measured yet; once, as the map keeps that error."""
        late, self._late_first = self._late_first, 0.0
        return np.diag(late**2 * (self._slip.rate**2 + self._slip.variance_in(0.0)))

    def _mount(self, frame: str) -> Mount:
        """Where ``frame`` sits. Once that is known, a map that was drawn as if from the body's origin is worth nothing."""
        mount = self._mounts.get(frame)
        if mount is not None and not self._is_placed:
            self._matcher, self._is_begun = LidarMatcher(self._matcher.config, self._is_thorough), False
        self._is_placed = mount is not None
        return mount or Mount()

    def _amended(self, found: Registration, sweep: Sweep, step: Step, missed: FloatArray) -> Registration:
        """The same, had it been known that within the sweep the twist is other by ``missed`` (3,)."""
        shift = sweep.shift(missed)
        if shift > _VISIBLE_M:
            points = sweep.at_stamp(step.twist + self._slip.rate)
            if shift > self._matcher.config.max_shift_m:
                return self._matcher.refine(points, sweep.is_planar, found.pose, sweep.offsets) or found
            self._matcher.replace_points(points, sweep.is_planar, sweep.offsets)
        return replace(found, pose=se2.compose(found.pose, se2.exp(-found.lateness @ missed)))

    def _swept(self, step: Step, B: FloatArray, late: float, gain: FloatArray, change: FloatArray) -> FloatArray:
        """(3, 3) what a motion within the sweep other than was thought does to the pose.

        A twist that is off by d moves the pose by ``B`` d (`Registration.lateness`). It is off as slip and wheels change from the mean
        over the step, which is known, to that from the stamp until points are seen, ``late`` [s]. If the wheels do as they did, by
        ``change`` from step to step, that is the time between the middles of both; slip that walks at random has walked for a third of
        both. But the slip was measured, with ``gain`` (3,), by the way to this very pose, so that d is in it already, by ``B`` over the
        step's duration.
        """
        if step.duration <= 0.0:
            return np.zeros((3, 3))
        faster = change * (step.duration + late) / (2.0 * step.duration) if step.start_ns == self._last_ns else np.zeros(3)
        unknown = B @ (np.eye(3) - gain[:, None] * B / step.duration)
        spread = self._slip.variance_in((step.duration + late) / 3.0) + faster**2
        return np.asarray((unknown * spread) @ unknown.T)

    def recall(self, step: Step, pose: FloatArray, cov: FloatArray) -> Revisit | None:
        return self._matcher.recall(pose, cov, step.end_ns)

    def correct(self, before: FloatArray, after: FloatArray) -> None:
        self._matcher.correct(before, after)

    def remember(self, step: Step, pose: FloatArray) -> bool:
        self._last_ns, self._drift = step.end_ns, np.zeros((3, 3))
        # a robot that stands sees nothing new, and would only thicken its lines
        if step.is_standing and self._is_begun:
            return False
        self._matcher.insert(pose)
        if not self._is_begun:
            self._is_begun, self._late_first = self._matcher.has_map, self._late
        return True

    def map_points(self, way: Way | None = None) -> FloatArray:
        return self._matcher.point_cloud(way)

    def counts(self) -> Mapping[str, int]:
        return self._check.counts


class NoWitness:
    """No LiDAR."""

    can_begin = True

    def look(self, step: Step, anchor: FloatArray, guess: FloatArray) -> Sight | None:
        return None

    def recall(self, step: Step, pose: FloatArray, cov: FloatArray) -> Revisit | None:
        return None

    def correct(self, before: FloatArray, after: FloatArray) -> None:
        return None

    def remember(self, step: Step, pose: FloatArray) -> bool:
        return False

    def map_points(self, way: Way | None = None) -> FloatArray:
        return NO_POINTS

    def counts(self) -> Mapping[str, int]:
        return {}
