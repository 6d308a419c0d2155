"""Scans of scenes that move: people who walk along, vehicles, dust about the robot."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from localization.events import Step
from localization.sensor_checks.contradictions import LIDAR_DIRECTION, LIDAR_OPPOSITE, WHEELS_OPPOSITE
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.moving_report import MOVING_OBJECTS, MovingReport
from localization.sensor_checks.own_body import LIDAR_OWN_BODY
from localization.sensor_checks.reckoning import ESTIMATE, GYRO
from localization.sensor_checks.scan_motion import Profile
from localization.sensor_checks.scene_motion import STILL, SceneComparison, explain
from localization.sensor_checks.standstill import WHEELS_STANDING
from localization.sensor_checks.window import Window
from localization.trajectory import BoolArray
from motion_models import se2
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray, Points2, triple

_EXPLAINING = (LIDAR_OWN_BODY, LIDAR_DIRECTION, LIDAR_OPPOSITE, WHEELS_OPPOSITE, WHEELS_STANDING)
"""Named faults of which parts of a scan, or the wheels, move otherwise."""
_MAX_VIEWS = 17
"""Views of the last four seconds, one for each bin of the window, after which at .05 m/s an object has moved by more than its tolerance."""
_MAX_WAY_M, _MAX_TURN_RAD = 0.6, 0.6
"""Largest motion since the view that is compared: farther away, surfaces are hidden by others [m, rad]."""
_MIN_MOVED = 0.12
"""Share of a scan on objects that move, from where on they are left out. Healthy drives: at most .09 (fr079), .17 once in ACES."""
_MIN_MOVED_WITHOUT_GYRO = 0.2
"""`_MIN_MOVED` for robots without a gyro."""
_MIN_UNSURE = 0.06
"""Share of a scan on objects that move, from where on it is not sure that the scene is still."""
MIN_OFF_M, _MAX_OFF_M = 0.06, 0.25
"""Distance of the estimate from the motion by the wheels since the view that is compared, which is more than wheels slip as a rule, and
more than labels can show that they do [m]: of points that move along, wheels explain as few as they do by chance in a still scene."""
_MAX_SLIP_M, _MAX_TURN_SLIP_RAD = 0.15, 0.2
"""Distance of the estimate from the motion by the wheels since that view, up to which the wheels slip as they do without moving objects
[m, rad]: a way of .6 m, along which fr079's robot slides by up to 14 deg."""
_STILL_M, _SLIP_SHARE, _SLIP_M_PER_RAD = 0.03, 0.25, 0.1
"""Distance from the motion by the wheels up to which they slip as usual on short ways: noise of two scans [m], share of the way, and of
turns, in which the centre of rotation is elsewhere by 10 cm [m/rad]."""
MAX_NIS = 16.3
"""NIS of a matched scan that contradicts the wheels: one of 1,000 by chance (chi^2 of 3 degrees of freedom)."""
_MIN_UNIQUE, _MIN_UNIQUE_WITHOUT_GYRO, _KEPT_UNIQUE = 0.25, 0.35, 0.2
"""Share that the wheels' motion explains, of the points that a rival does not, from where on there are two motions; and while that lasts.
Wheels that slip in a still scene explain 14 to 33 % by chance where they turn otherwise (fr079 at 168 to 185 s), else 15 to 20 %."""
_AGAIN, _AGAIN_WITHOUT_GYRO = 2, 4
"""Successive comparisons that show it."""
_CALM_S = 1.0
"""Time without moving objects after which all beams are matched again [s]."""
_CALM_M = 0.3
"""Distance of the wheels' pose from where wheels and estimate last disagreed, from which on what they differed by is slip that has ended
[m]: a LiDAR that travels elsewhere by its scans agrees with wheels that stand, or turn in place."""
_MIN_POINTS = 30
"""Points of the still world with which a scan is matched."""


class _View(NamedTuple):
    """A scan, and where it was taken by two odometries."""

    at_s: float
    poses: FloatArray
    """(2, 3) by the wheels, and by the estimate."""
    profile: Profile


@dataclass
class _Lidar:
    """Past views of one LiDAR, and evidence of moving objects in them."""

    views: deque[_View] = field(default_factory=lambda: deque(maxlen=_MAX_VIEWS))
    standing: _View | None = None
    """First view since the wheels stopped; None while they turn."""
    shown: int = 0
    """Successive comparisons that showed moving objects."""
    last_s: float = -math.inf
    """Time of the last one that did [s]."""
    is_active: bool = False


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
        self._faults, self._window = faults, window
        self._lidars: dict[str, _Lidar] = {}
        self._next_view: tuple[_Lidar, float, Profile, bool] | None = None
        """LiDAR, time [s] and profile of the last scan, and whether the robot stood: a view once the pose at its step's end is known."""
        self._compared: _View | None = None
        """View that the last scan was compared with."""
        self._is_unsure = False
        """Objects may move, or the wheels slip."""
        self._suspected: FloatArray | None = None
        """(2, 3) poses before labels, or the distance of estimate and wheels, began to show that either happens."""
        self._suspected_s = self._shown_s = -math.inf
        """Time of the last ones that showed it, and of the last labels that showed moving objects [s]."""
        self._suspected_at = np.zeros(3)
        """(3,) pose by the wheels at the last one that showed it, or after which both did not agree."""
        self._since: FloatArray | None = None
        """(2, 3) poses at which wheels and estimate last agreed, while objects move."""
        self._is_apart = False
        """They have been apart by more than wheels slip since then."""
        self._last = np.zeros((2, 3))
        """Poses at the end of the last step."""
        self._jumped: FloatArray | None = None
        """(2, 3) poses before the estimate went elsewhere at once."""
        self._is_by_scans = False
        """The estimate is by scans, too: one by wheels alone is where they lead."""
        self.is_led_away = False
        """Scans have led the estimate away from where wheels lead since `_since`."""
        self._explained: tuple[SensorFault, ...] = ()
        """Named faults so far that explain what was taken for moving objects."""
        self.report = MovingReport(faults)

    @property
    def is_acting(self) -> bool:
        """Objects move: scans have the still world alone."""
        return any(lidar.is_active for lidar in self._lidars.values())

    def apply(self, step: Step) -> Step:
        """``step`` whose scan has the still world alone, while more than a few objects move."""
        declared = self._faults.declared
        if declared and any(fault in declared for fault in _EXPLAINING if fault not in self._explained):
            self._explained = tuple(fault for fault in _EXPLAINING if fault in declared)
            self._faults.retract(MOVING_OBJECTS)
            self._since, self.report = None, MovingReport(self._faults)
            self._restart()
        scan, now_s = step.scan, self._faults.now_s
        if not step.has_wheels:
            self._restart()
        if scan is None or not scan.is_planar or not step.has_wheels:
            return step
        lidar = self._lidars[scan.frame_id] = self._lidars.get(scan.frame_id) or _Lidar()
        if lidar.standing is not None and not _compare_motions(lidar.standing.poses, self._poses)[0]:
            lidar.standing = None
        is_due = scan is self._window.registered
        if not (is_due or lidar.is_active):
            return step
        profile = self._window.profile(scan)
        if profile is None:
            return step
        points = self._window.points_about_lidar(scan)
        references = self._references(lidar)
        if references:
            is_quiet = not lidar.is_active and self._suspected is None
            found = self._label(references[0], profile, points, _MIN_UNSURE if is_quiet else 0.0)
            self._update(step, lidar, references[0], found)
            if lidar.is_active:
                labels = [found.scene.labels, *(self._label(view, profile, points).scene.labels for view in references[1:])]
                step = _with_still(step, np.all(np.array(labels) == STILL, axis=0))
        elif lidar.is_active:
            step = step.without_scan()
        if is_due:
            self._next_view = lidar, now_s, profile, step.is_standing
        return step

    def keep_view(self) -> None:
        """The pose is known at which the last scan was taken: compare later ones with it."""
        if self._next_view is not None:
            lidar, at_s, profile, was_standing = self._next_view
            view, self._next_view = _View(at_s, self._poses, profile), None
            lidar.views.append(view)
            lidar.standing = view if was_standing and lidar.standing is None else lidar.standing

    @property
    def _poses(self) -> FloatArray:
        """(2, 3) by the wheels with the gyro's turns, and by the estimate."""
        return self._faults.inflation.reckoning.poses[GYRO : ESTIMATE + 1]

    def compare_estimate(self, nis: float | None) -> None:
        """How far the estimate is from the motion by the wheels while the scene may move; ``nis`` of the last scan, if one was matched."""
        self._is_by_scans |= nis is not None
        inflation, view = self._faults.inflation, self._compared
        before, self._last = self._last, self._poses
        since = self._since
        if since is not None and view is not None and nis is not None:
            if self._agree(view.poses):
                self._settle(since)
                self._since, since = self._last, view.poses  # within that, wheels or scans may be off
            else:
                self._is_apart = True
        inflation.ongoing_scene = None if since is None else self._distance(since)
        inflation.possible = None
        begin = self._suspected if view is None or self._suspected is not None else view.poses
        if self._since is not None or begin is None:
            return
        is_near, distance = _compare_motions(begin, self._last)
        is_off = distance > MIN_OFF_M or (nis is not None and nis > MAX_NIS)
        if self._jumped is not None or (not is_near and distance > _MAX_OFF_M):
            self._update_jump(before)
        if self._jumped is not None or self._is_unsure or (is_near and is_off):
            inflation.possible = self._distance(begin if self._jumped is None else self._jumped)

    def _update_jump(self, before: FloatArray) -> None:
        """Keep the poses ``before`` the step (2, 3) in which the estimate went elsewhere at once: the robot was carried, or the LiDAR was
        turned. Once the robot has driven on by the wheels, and scans agree, it was carried."""
        if self._jumped is None:
            self._jumped = None if _compare_motions(before, self._last)[0] else before
        elif self._suspected is None:
            x, y, yaw = se2.between(self._jumped[0], self._last[0])
            if math.hypot(x, y) >= _MAX_WAY_M or abs(yaw) >= _MAX_TURN_RAD:
                self._jumped = None

    def _distance(self, since: FloatArray) -> FloatArray:
        """(3,) of the motion by the wheels since the poses ``since`` (2, 3) from that by the estimate."""
        by_wheels, by_estimate = se2.between(since, self._poses)
        return se2.local(by_estimate, by_wheels)

    def _agree(self, poses: FloatArray) -> bool:
        """Whether wheels and estimate have moved alike since ``poses`` (2, 3), but for slip."""
        off, (x, y, yaw) = self._distance(poses), se2.between(poses[0], self._last[0]).tolist()
        slip = min(_MAX_SLIP_M, _STILL_M + _SLIP_SHARE * math.hypot(x, y) + _SLIP_M_PER_RAD * abs(yaw))
        return bool(math.hypot(off[0], off[1]) < slip and abs(off[2]) < _MAX_TURN_SLIP_RAD)

    def _settle(self, poses: FloatArray) -> None:
        """What the estimate is off by since ``poses`` (2, 3) stays, if it was more than wheels slip."""
        if self._is_apart or not self._agree(poses):
            self._faults.inflation.add(self._distance(poses))
        self._is_apart = False

    def lead_back(self, step: Step) -> Step:
        """``step`` at whose end the estimate is where the wheels lead from `_since`, with the distance to there as its covariance."""
        assert self._since is not None
        self.is_led_away = False
        motion, by_wheels = step.predicted, se2.between(self._since[0], self._poses[0])
        before = self._faults.inflation.reckoning.before[ESTIMATE]
        off = se2.local(se2.compose(se2.between(self._since[1], before), motion.delta), by_wheels)
        if math.hypot(off[0], off[1]) >= MIN_OFF_M:
            motion = replace(motion, delta=se2.retract(motion.delta, off), cov=motion.cov + np.outer(off, off))
            step = replace(step, predicted=motion, turn=None)
        self._since = np.array([self._poses[0], se2.compose(before, motion.delta)])
        for lidar in self._lidars.values():
            lidar.views = deque((self._led_back(view, self._since) for view in lidar.views), maxlen=_MAX_VIEWS)
        return step

    @staticmethod
    def _led_back(view: _View, now: FloatArray) -> _View:
        """``view`` from which the estimate has moved as the wheels have, to the poses ``now`` (2, 3)."""
        by_wheels = se2.between(now[0], view.poses[0])
        return view._replace(poses=np.array([view.poses[0], se2.compose(now[1], by_wheels)]))

    def _references(self, lidar: _Lidar) -> list[_View]:
        """The oldest view from which wheels and estimate have hardly moved, and the middle one of those after it."""
        views, now = lidar.views, self._poses
        if lidar.standing is not None and not lidar.is_active and _compare_motions(lidar.standing.poses, now)[0]:
            return [lidar.standing]
        while views and not _compare_motions(views[0].poses, now)[0]:
            views.popleft()
        return [views[0], views[len(views) // 2]] if len(views) > 2 else list(views)[:1]

    def _label(self, view: _View, profile: Profile, points: Points2, least_moved: float = 0.0) -> SceneComparison:
        """Label ``points`` (N, 2), about the LiDAR, by the motion of the wheels since ``view``; ``least_moved`` as of `explain`."""
        x, y = profile.center.tolist()
        motions = se2.compose(se2.between(view.poses, self._poses), (x, y, 0.0))
        motions[:, :2] -= view.profile.center  # of the LiDAR
        scene = explain(view.profile, profile, points, motions[0], least_moved)
        return SceneComparison(view.profile, profile, points, scene, motions[1])

    def _update(self, step: Step, lidar: _Lidar, view: _View, found: SceneComparison) -> None:
        """Whether objects move now."""
        self._compared = view
        moved_share, now_s, is_standing = found.scene.moved_share, self._faults.now_s, step.rested_s > 0.0
        poses = self._poses
        _, distance = _compare_motions(view.poses, poses)
        is_moving, has_turn = moved_share >= _MIN_UNSURE and is_standing, step.turn is not None
        if not is_standing and (moved_share >= _MIN_UNSURE or distance >= _MAX_OFF_M):
            has_turn = step.turn is not None or lidar.is_active
            unique = found.unique_share(has_turn)
            if unique >= _KEPT_UNIQUE or distance >= _MAX_OFF_M:
                self._suspected = view.poses if self._suspected is None else self._suspected
                self._suspected_s, self._suspected_at = now_s, poses[0]
                self._shown_s = now_s if unique >= _KEPT_UNIQUE else self._shown_s
            least = _KEPT_UNIQUE if lidar.is_active else _MIN_UNIQUE if has_turn else _MIN_UNIQUE_WITHOUT_GYRO
            is_moving = unique >= least and (has_turn or moved_share >= _MIN_MOVED_WITHOUT_GYRO)
        is_moving &= moved_share >= _MIN_MOVED
        lidar.shown = lidar.shown + 1 if is_moving else 0
        if is_moving:
            lidar.last_s = now_s
        again = 1 if is_standing else _AGAIN if has_turn else _AGAIN_WITHOUT_GYRO
        lidar.is_active = lidar.shown >= again or (lidar.is_active and now_s - lidar.last_s < _CALM_S)
        if self._suspected is not None and not self._agree(view.poses):
            self._suspected_s, self._suspected_at = now_s, poses[0]
        has_driven = math.dist(self._suspected_at[:2], poses[0, :2]) >= _CALM_M
        if self._faults.inflation.are_wheels_outvoted or (now_s - self._suspected_s >= _CALM_S and has_driven):
            self._suspected = None
        self._is_unsure = self._suspected is not None or distance > MIN_OFF_M
        self._window.is_scene_moving = now_s - self._shown_s < _CALM_S or lidar.is_active
        if lidar.is_active:
            self.report.add(moved_share)
            if self._since is None:
                self._since = view.poses if self._suspected is None else self._suspected
                self.is_led_away = self._is_by_scans
        elif self._since is not None and not any(other.is_active for other in self._lidars.values()):
            self._end()

    def _end(self) -> None:
        """No objects move any more."""
        if self._since is not None:
            self._settle(self._since)
            self._since = self._suspected = None
        self.is_led_away = False

    def _restart(self) -> None:
        """The wheels' motion is not known: scans are compared from here on."""
        self._end()
        self._lidars.clear()
        self._compared = self._suspected = None


@kernel
def _compare_motions(since: FloatArray, now: FloatArray) -> tuple[bool, float]:
    """Whether a scan at the poses ``now`` by wheels and estimate, (2, 3), is compared with one at ``since``, for both are near; and the
    distance of the motion by the estimate from that by the wheels [m]."""
    by_wheels = se2.scalar_between(triple(since[0]), triple(now[0]))
    by_estimate = se2.scalar_between(triple(since[1]), triple(now[1]))
    off = se2.scalar_log(se2.scalar_between(by_estimate, by_wheels))
    way = max(math.hypot(by_wheels[0], by_wheels[1]), math.hypot(by_estimate[0], by_estimate[1]))
    turn = max(abs(by_wheels[2]), abs(by_estimate[2]))
    return way < _MAX_WAY_M and turn < _MAX_TURN_RAD, math.hypot(off[0], off[1])


def _with_still(step: Step, is_still: BoolArray) -> Step:
    """``step`` whose scan has the points ``is_still`` (N,) alone; without it where these are too few."""
    scan = step.scan
    if scan is None or is_still.sum() < _MIN_POINTS:
        return step.without_scan()
    return replace(step, scan=scan.select(is_still), is_scan_partial=True)
