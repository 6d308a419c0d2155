"""Scans of scenes that move: people who walk along, vehicles, dust about the robot."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from localization.estimators import Estimate
from localization.events import Step
from localization.sensor_checks import wheel_agreement
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.moving_report import MovingReport
from localization.sensor_checks.past_views import LidarViews, PastViews, View
from localization.sensor_checks.reckoning import ESTIMATE, GYRO
from localization.sensor_checks.scan_motion import Profile
from localization.sensor_checks.scene_motion import STILL, SceneComparison, explain
from localization.sensor_checks.wheel_agreement import CALM_S, Departure, Jump, Suspicion, agree, difference
from localization.sensor_checks.window import Window
from localization.trajectory import BoolArray
from motion_models import se2
from motion_models.se2 import FloatArray, Points2, Tangent2

_MIN_MOVED = 0.12
"""Share of a scan on objects that move, from where on they are left out. Healthy drives: at most .09 (fr079), .17 once in ACES."""
_MIN_MOVED_WITHOUT_GYRO = 0.2
"""`_MIN_MOVED` for robots without a gyro."""
_MIN_UNSURE = 0.06
"""Share of a scan on objects that move, from where on it is not sure that the scene is still."""
MIN_OFF_M = 0.06
"""Distance of the estimate from the motion by the wheels, since the view that is compared, that is more than wheels slip as a rule [m]."""
_MAX_OFF_M = 0.25
"""Such a distance that is more than labels can show that wheels slip [m]: of points that move along, wheels explain as few as they do by
chance in a still scene."""
MAX_NIS = 16.3
"""NIS of a matched scan that contradicts the wheels: one of 1,000 by chance (chi^2 of 3 degrees of freedom)."""
_MIN_UNIQUE, _MIN_UNIQUE_WITHOUT_GYRO, _KEPT_UNIQUE = 0.25, 0.35, 0.2
"""Share that the wheels' motion explains, of the points that a rival does not, from where on there are two motions; and while that lasts.
Wheels that slip in a still scene explain 14 to 33 % by chance where they turn otherwise (fr079 at 168 to 185 s), else 15 to 20 %."""
_AGAIN, _AGAIN_WITHOUT_GYRO = 2, 4
"""Successive comparisons that show it."""
_MIN_POINTS = 30
"""Points of the still world with which a scan is matched."""


class _Comparison(NamedTuple):
    """The last comparison of a scan with a view."""

    since: FloatArray
    """(2, 3) poses of the view."""
    is_unsure: bool
    """Objects may move, or the wheels slip."""


class MovingObjects:
    """Where part of a scene moves and the rest agrees with wheels and gyro, the rest alone is matched.

    A scan is compared with one from before under the motion by wheels and gyro. Where one other motion explains all of it, as with wheels
    that slip, nothing is left out: the matcher finds it. Where the points that the wheels do not explain need a motion that does not
    explain those which they do, the scene has two motions, and that of the wheels is the still world's. Until that is decided, the
    covariance has the distance of the estimate from the motion by wheels and gyro since labels showed it first. Once it is, the estimate is
    led back by this distance, which the filter's covariance then has until scans of the still world show the pose. From there on, the
    distance counts from where both last agreed.
    """

    def __init__(self, faults: FaultLog, window: Window) -> None:
        self._faults, self._window, self._views = faults, window, PastViews()
        self._compared: _Comparison | None = None
        self._suspicion: Suspicion | None = None
        """Begins with labels, or a distance of estimate and wheels, that show objects that may move."""
        self._shown_s = -math.inf
        """Time of the last labels that showed moving objects [s]."""
        self._departure: Departure | None = None
        """From wheels and estimate that agree, while objects move."""
        self._jump = Jump()
        self._is_by_scans = False
        """The estimate is by scans, too: one by wheels alone is where they lead, and no object that moves has an effect on it."""
        self.report = MovingReport(faults)

    @property
    def is_acting(self) -> bool:
        """Objects move: scans have the still world alone."""
        return self._views.is_active

    @property
    def is_led_away(self) -> bool:
        """Scans of objects that move have led the estimate away from where the wheels lead."""
        return self._departure is not None and self._departure.is_led_away

    @property
    def _poses(self) -> FloatArray:
        """(2, 3) by the wheels with the gyro's turns, and by the estimate."""
        return self._faults.inflation.reckoning.poses[GYRO : ESTIMATE + 1]

    def apply(self, step: Step) -> Step:
        """``step`` whose scan has the still world alone, while more than a few objects move."""
        if self._faults.declared and self.report.is_explained():
            self._departure, self.report = None, self.report.begin_again()
            self._restart()
        scan, now = step.scan, self._poses
        if not step.has_wheels:
            self._restart()
        if scan is None or not scan.is_planar or not step.has_wheels:
            return step
        lidar = self._views.of(scan.frame_id)
        is_due = scan is self._window.scans.registered
        profile = self._window.scans.profile(scan) if is_due or lidar.is_active else None
        if profile is None:
            return step
        points, references = self._window.scans.points_about_lidar(scan), lidar.references(now)
        if references:
            is_quiet = not lidar.is_active and self._suspicion is None
            found = self._label(references[0], now, profile, points, _MIN_UNSURE if is_quiet else 0.0)
            self._update(step, lidar, references[0], now, found)
            if lidar.is_active:
                labels = [found.scene.labels, *(self._label(view, now, profile, points).scene.labels for view in references[1:])]
                step = _with_still(step, np.all(np.array(labels) == STILL, axis=0))
        elif lidar.is_active:
            step = step.without_scan()
        if is_due:
            self._views.take(lidar, profile, is_standing=step.is_standing)
        return step

    def compare_estimate(self, estimate: Estimate) -> None:
        """How far ``estimate``, of the end of the last step, is from the motion by the wheels while the scene may move."""
        now, nis = self._poses, estimate.nis
        self._views.keep(now)
        if estimate.covariance is None:
            return
        self._is_by_scans |= nis is not None
        inflation = self._faults.inflation
        inflation.ongoing_scene = None if self._departure is None else self._follow(self._departure, now, is_matched=nis is not None)
        inflation.possible = None
        compared = self._compared
        begin = self._suspicion.begin if self._suspicion is not None else None if compared is None else compared.since
        if self._departure is not None or begin is None:
            self._jump.add(now, is_off=False, is_unclear=True)
            return
        is_near, distance = wheel_agreement.compare_motions(begin, now)
        is_off = distance > MIN_OFF_M or (nis is not None and nis > MAX_NIS)
        self._jump.add(now, is_off=not is_near and distance > _MAX_OFF_M, is_unclear=self._suspicion is not None)
        is_unsure = compared is not None and compared.is_unsure
        if self._jump.begin is not None or is_unsure or (is_near and is_off):
            inflation.possible = difference(begin if self._jump.begin is None else self._jump.begin, now)

    def _follow(self, departure: Departure, now: FloatArray, *, is_matched: bool) -> Tangent2:
        """(3,) of the motion by the wheels from that by the estimate while objects move, until ``now`` (2, 3).

        Where both agree since the last comparison, what they are off by until then stays in the covariance.
        """
        compared = self._compared
        if compared is None or not is_matched:
            return difference(departure.since, now)
        if not agree(compared.since, now):
            self._departure = replace(departure, is_apart=True)
            return difference(departure.since, now)
        self._settle(departure, now)
        self._departure = replace(departure, since=now, is_apart=False)
        return difference(compared.since, now)  # within that, wheels or scans may be off

    def _settle(self, departure: Departure, now: FloatArray) -> None:
        off = departure.remainder(now)
        if off is not None:
            self._faults.inflation.add(off)

    def lead_back(self, step: Step) -> Step:
        """``step`` at whose end the estimate is where the wheels lead from the departure, with the distance to there as its covariance."""
        assert self._departure is not None
        motion, since, by_wheels = step.predicted, self._departure.since, self._poses[0]
        before = self._faults.inflation.reckoning.before[ESTIMATE]
        off = se2.local(se2.compose(se2.between(since[1], before), motion.delta), se2.between(since[0], by_wheels))
        if math.hypot(off[0], off[1]) >= MIN_OFF_M:
            motion = replace(motion, delta=se2.retract(motion.delta, off), cov=motion.cov + np.outer(off, off))
            step = replace(step, predicted=motion, turn=None)
        now = np.array([by_wheels, se2.compose(before, motion.delta)])
        self._departure = replace(self._departure, since=now, is_led_away=False)
        self._views.lead_back(now)
        return step

    @staticmethod
    def _label(view: View, now: FloatArray, profile: Profile, points: Points2, least_moved: float = 0.0) -> SceneComparison:
        """Label ``points`` (N, 2), about the LiDAR, by the motion of the wheels from ``view`` to ``now`` (2, 3); ``least_moved`` as of
        `explain`."""
        x, y = profile.center.tolist()
        motions = se2.compose(se2.between(view.poses, now), (x, y, 0.0))
        motions[:, :2] -= view.profile.center  # of the LiDAR
        scene = explain(view.profile, profile, points, motions[0], least_moved)
        return SceneComparison(view.profile, profile, points, scene, motions[1])

    def _update(self, step: Step, lidar: LidarViews, view: View, now: FloatArray, found: SceneComparison) -> None:
        """Whether objects move now."""
        moved_share, now_s, is_standing = found.scene.moved_share, self._faults.now_s, step.rested_s > 0.0
        _, distance = wheel_agreement.compare_motions(view.poses, now)
        is_moving, has_turn = moved_share >= _MIN_UNSURE and is_standing, step.turn is not None
        if not is_standing and (moved_share >= _MIN_UNSURE or distance >= _MAX_OFF_M):
            has_turn = step.turn is not None or lidar.is_active
            unique = found.unique_share(has_turn)
            if unique >= _KEPT_UNIQUE or distance >= _MAX_OFF_M:
                self._suspicion = self._suspicion or Suspicion(view.poses, now_s, now[0])
                self._suspicion = self._suspicion.add_sign(now_s, now)
                self._shown_s = now_s if unique >= _KEPT_UNIQUE else self._shown_s
            least = _KEPT_UNIQUE if lidar.is_active else _MIN_UNIQUE if has_turn else _MIN_UNIQUE_WITHOUT_GYRO
            is_moving = unique >= least and (has_turn or moved_share >= _MIN_MOVED_WITHOUT_GYRO)
        again = 1 if is_standing else _AGAIN if has_turn else _AGAIN_WITHOUT_GYRO
        lidar.add_comparison(now_s, again, is_moving=is_moving and moved_share >= _MIN_MOVED)
        if self._suspicion is not None and not agree(view.poses, now):
            self._suspicion = self._suspicion.add_sign(now_s, now)
        if self._suspicion is not None and (self._faults.inflation.are_wheels_outvoted or self._suspicion.is_over(now_s, now)):
            self._suspicion = None
        self._compared = _Comparison(view.poses, self._suspicion is not None or distance > MIN_OFF_M)
        self._window.is_scene_moving = now_s - self._shown_s < CALM_S or lidar.is_active
        if lidar.is_active:
            if self._is_by_scans:
                self.report.add(moved_share)
            if self._departure is None:
                self._departure = Departure(view.poses if self._suspicion is None else self._suspicion.begin, self._is_by_scans)
        elif self._departure is not None and not self._views.is_active:
            self._end()

    def _end(self) -> None:
        """No objects move any more."""
        if self._departure is not None:
            self._settle(self._departure, self._poses)
            self._departure = self._suspicion = None

    def _restart(self) -> None:
        """The wheels' motion is not known: scans are compared from here on."""
        self._end()
        self._views.clear()
        self._compared = self._suspicion = None


def _with_still(step: Step, is_still: BoolArray) -> Step:
    """``step`` whose scan has the points ``is_still`` (N,) alone, without those of other LiDARs; without it where these are too few."""
    scan = step.scan
    if scan is None or is_still.sum() < _MIN_POINTS:
        return step.without_scan()
    return replace(step, scan=replace(scan.select(is_still), beside=()), is_scan_partial=True)
