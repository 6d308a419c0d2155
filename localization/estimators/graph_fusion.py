"""Wheels, gyro and LiDAR in a factor graph: the sibling of `EkfFusion`, with the same residuals, witness and beliefs.

A node stands at each scan (at each step without a LiDAR). What lies between two nodes is preintegrated into one link; the LiDAR's motion is
a second factor beside it. The estimate of each moment is that of a fixed-lag window, which relinearises what it smooths; beside it, if
asked for, all factors are kept and solved as one, by iSAM2 on the way or in a batch at the end.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from localization.errors import EstimatorError
from localization.estimators.base import NO_POINTS, Estimate, mean_twist
from localization.estimators.contradiction import admit_doubt
from localization.estimators.ekf import EkfConfig
from localization.estimators.graph_errors import GraphErrors
from localization.estimators.graph_factors import Pairs, whitening
from localization.estimators.graph_history import History
from localization.estimators.graph_link import Link, check_covariance, check_motion
from localization.estimators.graph_node import Ahead, Node, SingularError, innovation
from localization.estimators.graph_revisit import revisited
from localization.estimators.graph_robust import Closure, Kernel, Position
from localization.estimators.graph_slow import ONE_CLOCK, Learned, SlowStates
from localization.estimators.graph_window import Window
from localization.estimators.hindsight import Hindsight
from localization.estimators.teaching import teaching
from localization.estimators.witness import NoWitness, ScanWitness, Sight, Witness
from localization.lidar import LidarConfig
from localization.settings import Positive, Settings, at_least
from localization.steps import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.corrections import Corrections
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_NOT_FINITE = "wheels and LiDAR cannot be weighed: numbers are not finite, or too large to compute with. Look at the log."
_CERTAIN = 1e-6  # m, rad: sigma of the first pose, which is the origin by definition
_COUNTED = ("scans", "matched", "contradictions", "standing", "revisits", "nodes", "rebuilt", "positions", "closures", "late")
_NEAR_NS = 50_000_000  # a loop closure is between nodes, this near
_FAR_NS = 1_000_000_000  # a position may be this far from its node: the body moves on in between


@dataclass(frozen=True)
class GraphConfig(Settings):
    """How the graph is solved. What it believes at first is the filter's (`EkfConfig`)."""

    backend: Literal["fixed_lag", "batch", "isam2"] = "fixed_lag"
    """``fixed_lag``: the estimate of each moment; a replay closes the way at its end where places were seen again (`Hindsight`).
    ``batch``, ``isam2``: all poses as later measurements have smoothed them."""
    lag_nodes: Annotated[int, at_least(2)] = 50
    """Nodes that the window smooths."""
    relinearize_at: float = 0.01
    """Where the way between two nodes has changed this far since it was linearised, it is linearised anew [m, rad]."""
    kernel: Literal["none", "huber", "cauchy"] = "cauchy"
    """Robust kernel of positions and loop closures; a LiDAR that contradicts the wheels is judged when it comes."""
    kernel_scale: Positive = 3.0
    """Where the kernel begins [sigmas]."""
    learn: tuple[Learned, ...] = ("clock",)
    """What is learned of the LiDAR: the wheels' clock against its own, and how far it sits off its transform (x, y, yaw)."""
    mount_sigma_m: Positive = 0.05
    """How far off the LiDAR's transform may be at first [m]."""
    mount_sigma_rad: Positive = 0.03
    """How far its yaw [rad]."""


class GraphFusion:
    """Nodes and factors in the order of time, and the counts of what happened."""

    def __init__(
        self,
        model: MotionModel,
        corrected: Corrections,
        robot: Robot,
        mounts: Mapping[str, Mount],
        has_lidar: bool,
        config: GraphConfig | None = None,
        belief: EkfConfig | None = None,
        lidar: LidarConfig | None = None,
        witness: Witness | None = None,
        pose: FloatArray | None = None,
        hindsight: bool = False,
    ) -> None:
        """``belief``: as the filter's. ``witness`` measures the motion between scans; if not given, scans are matched as ``lidar`` says.
        ``hindsight``: at the end of the log, `finish` will be asked what the whole of it tells."""
        self.config, self._belief = config or GraphConfig(), belief or EkfConfig()
        self._model, self._corrected, self._has_lidar = model, corrected, has_lidar
        self._track_m = robot.geometry.track_width_m
        c = self.config
        self._slow = SlowStates(robot.gyro_noise, corrected, self._belief, c.learn, c.mount_sigma_m, c.mount_sigma_rad, has_lidar)
        # where scans share a map, and nothing is known besides that the filter does not know
        shares = has_lidar and witness is None and not self._slow.mount_names and c.backend != "isam2"
        self._hindsight = Hindsight() if hindsight and shares and c.backend == "fixed_lag" else None
        self._whole: Trajectory | None = None  # the way as the whole log tells it
        self._witness: Witness = (witness or ScanWitness(mounts, lidar, self._hindsight is not None)) if has_lidar else NoWitness()
        self._clock_walk = None if has_lidar else ONE_CLOCK
        self._mounts, self._mount = mounts, Mount()
        self._kernel = Kernel(self.config.kernel, self.config.kernel_scale)
        cov = block_diag(_CERTAIN**2 * np.eye(3), self._slow.cov)
        first = Node.known(np.zeros(3) if pose is None else np.array(pose, dtype=float), np.zeros(self._slow.size), cov)
        self._window = Window(first, self.config.lag_nodes, self.config.relinearize_at, self._kernel)
        self._history = None if self.config.backend == "fixed_lag" else History(first, self.config.backend, self._kernel)
        self._newest = first
        self._now = first
        self._errors = GraphErrors(robot.gyro_noise, corrected, self._belief, first.pose, self._hindsight is not None) if shares else None
        self._pending: Link | None = None
        self._to_settle: tuple[Step, bool] | None = None  # a step with a scan, and whether that was matched
        self._nodes_ns: list[int] = []
        self._first_node = 0  # number of the node whose stamp is the first in that list: a fixed lag forgets the others
        self._gate = float(chi2.ppf(self._belief.gate_probability, 3))
        self._has_gyro, self._twist_now = False, np.zeros(3)
        self._counts = dict.fromkeys(_COUNTED, 0)

    @property
    def clock_offset_s(self) -> float:
        return float(self._now.slow[1]) if self._slow.has_clock else 0.0

    @property
    def params(self) -> FloatArray:
        return np.asarray(self._model.nominal + self._corrected.directions @ self._now.slow[self._slow.corrections])

    def step(self, step: Step) -> Estimate:
        """See `Estimator.step`. Raises `EstimatorError` for measurements that are not finite or have no covariance."""
        self.settle()
        if not self._nodes_ns:
            self._nodes_ns.append(step.start_ns)
        known = self._now.covariance[3:, 3:][self._slow.corrections, self._slow.corrections]
        taught = teaching(step, self._track_m, self._corrected, known)
        link = self._slow.link(taught, self._now.slow)
        if self._errors is not None:
            self._errors.step(taught)
        if not self._has_lidar:
            has_turn = step.turn is not None
            self._clock_walk = None if self._has_gyro else self._belief.clock_sigma_s**2 if has_turn else ONE_CLOCK
        self._has_gyro |= step.turn is not None
        self._counts["standing"] += step.is_standing
        pending = link if self._pending is None else self._pending.then(link)
        nis, sight = None, None
        ahead = self._extend(pending)
        if step.scan is not None and self._has_lidar:
            self._mount = self._mounts.get(step.scan.frame_id, self._mount)
            sight = self._look(step, ahead)
            if sight is not None:
                nis, ahead = self._judge(ahead, pending, sight)
                if self._errors is not None:
                    self._errors.see(sight)
        before, self._now = self._now, ahead.node
        alone = self._pending is None
        if not self._has_lidar or (step.scan is not None and self._witness.can_begin):
            self._commit(ahead, step.end_ns)
            self._pending = None
            if self._has_lidar:
                self._to_settle = step, sight is not None
        else:
            self._pending = pending
        if self._history is not None:
            self._history.mark(step.end_ns, self._pending)
        twist, twist_cov = self._twist(step, link, ahead, before, alone)
        cov = self._now.covariance[:3, :3] if self._errors is None else self._errors.pose
        return Estimate(step.end_ns, self._now.pose, cov, twist, twist_cov, nis)

    def settle(self) -> None:
        """Whether the place was seen long before; the last scan enters the map."""
        if self._to_settle is None:
            return
        (step, is_matched), self._to_settle = self._to_settle, None
        if is_matched:
            self._recall(step)
        is_drawn = self._witness.remember(step, self._believed(self._now))
        if self._errors is not None:
            self._errors.draw(self._now.pose, is_drawn)
        if self._hindsight is not None and self._hindsight.is_due(self._now.pose):
            self._mark(step.end_ns)

    def add_position(self, stamp_ns: int, xy: FloatArray, cov: FloatArray, lever: FloatArray | None = None) -> bool:
        """A measured position ``xy`` (2,) with ``cov`` (2, 2) of the body's point ``lever`` (2,) at a moment, in this estimator's world.

        As by GPS. Late ones are used as long as their node is kept: in the window, or, by ``batch`` and ``isam2``, anywhere. Returns
        whether it was; the others are counted as late. Raises `EstimatorError`.
        """
        self.settle()
        xy, cov, lever = (np.asarray(value, dtype=float) for value in (xy, cov, np.zeros(2) if lever is None else lever))
        if xy.shape != (2,) or not np.isfinite(xy).all() or lever.shape != (2,) or not np.isfinite(lever).all():
            raise EstimatorError(f"the position {xy} or its lever arm {lever} is not two finite numbers.")
        check_covariance(cov, 2, "a position")
        node = self._node_at(stamp_ns, _FAR_NS)
        if node is None or (node < self._window.oldest and self._history is None):
            self._counts["late"] += 1
            return False
        # between nodes the body moves on with its last twist, about as well known as a tenth of the way
        away = se2.exp((stamp_ns - self._nodes_ns[node - self._first_node]) * 1e-9 * self._twist_now)
        cov = cov + (0.1 * np.linalg.norm(away[:2])) ** 2 * np.eye(2) + 1e-12 * np.eye(2)
        position = Position(xy, whitening(cov), se2.transform(away, lever))
        if node >= self._window.oldest:
            self._window.add_position(node, position)
            self._newest = self._now = self._window.newest
            self._errors = self._hindsight = None
        if self._history is not None:
            self._counts["rebuilt"] += self._history.add_position(node, position)
        self._counts["positions"] += 1
        return True

    def add_closure(self, from_ns: int, to_ns: int, motion: Motion) -> bool:
        """A place seen again: the motion between the nodes at two moments.

        Used if both nodes are kept: in the window, or, by ``batch`` and ``isam2``, anywhere. Returns whether it was; the others are counted
        as late. Raises `EstimatorError` for what is no motion, or where there is no node.
        """
        self.settle()
        check_motion(motion.delta, motion.cov, "the loop closure")
        a, b = self._node_at(from_ns, _NEAR_NS), self._node_at(to_ns, _NEAR_NS)
        if self._first_node and from_ns < self._nodes_ns[0] and b is not None:
            self._counts["late"] += 1
            return False
        if a is None or b is None or a == b:
            raise EstimatorError(f"a loop closure from {from_ns} to {to_ns} ns, where there are no two nodes to close.")
        closure = Closure(a, b, motion.delta, whitening(motion.cov + 1e-12 * np.eye(3)))
        is_used = self._close(closure)
        if is_used:
            self._errors = self._hindsight = None  # which know nothing of it
        return is_used

    def _close(self, closure: Closure) -> bool:
        in_window = min(closure.a, closure.b) >= self._window.oldest
        if not in_window and self._history is None:
            self._counts["late"] += 1
            return False
        if in_window:
            self._window.close(closure)
        if self._history is not None:
            self._counts["rebuilt"] += self._history.add_closure(closure)
            found = self._history.newest()
            if found is not None:
                self._window.restart(found)
        self._newest = self._now = self._window.newest
        self._counts["closures"] += 1
        return True

    def _node_at(self, stamp_ns: int, within_ns: int) -> int | None:
        """Number of the node that is nearest to a moment, if it is near."""
        if not self._nodes_ns:
            return None
        i = bisect.bisect_left(self._nodes_ns, stamp_ns)
        near = min((k for k in (i - 1, i) if 0 <= k < len(self._nodes_ns)), key=lambda k: abs(self._nodes_ns[k] - stamp_ns))
        return near + self._first_node if abs(self._nodes_ns[near] - stamp_ns) <= within_ns else None

    def finish(self, moments: Trajectory | None = None) -> Trajectory | None:
        """All poses as the whole log tells them, with covariances; None for a fixed lag without hindsight."""
        self.settle()
        if self._hindsight is not None and moments is not None:
            self._mark(int(moments.stamps_ns[-1]))
            try:
                self._whole = self._hindsight.smooth(moments)
            except EstimatorError:  # the estimates of each moment stay as they are
                self._counts["loops_unsolved"] = len(self._hindsight.loops)
            return self._whole
        return None if self._history is None else self._history.trajectory()

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        found, cov = {}, self._now.covariance[3:, 3:]
        if self._has_gyro:
            found["gyro_bias_rad_per_s"] = float(self._now.slow[0]), math.sqrt(cov[0, 0])
        if self._slow.has_clock and (self._has_lidar or self._has_gyro):
            found["wheel_clock_offset_s"] = float(self._now.slow[1]), math.sqrt(cov[1, 1])
        for i, name in enumerate(self._slow.mount_names, start=1 + self._slow.has_clock):
            row = ("lidar_x", "lidar_y", "lidar_yaw").index(name)
            sits = se2.compose(se2.exp(self._slow.mount @ self._now.slow), np.array([self._mount.x, self._mount.y, self._mount.yaw]))
            found[f"{name}_{'rad' if row == 2 else 'm'}"] = float(sits[row]), math.sqrt(cov[i, i])
        nominal = dict(zip(self._model.param_names, self._model.nominal, strict=True))
        for i, name in enumerate(self._corrected.names, start=self._slow.corrections.start):
            found[name] = float(nominal.get(name, 0.0) + self._now.slow[i]), math.sqrt(cov[i, i])
        return found

    def counts(self) -> Mapping[str, int]:
        loops = {} if self._hindsight is None else {"loops": len(self._hindsight.loops)}
        return {**self._counts, **loops, **self._witness.counts()}

    def map_points(self) -> FloatArray:
        return self._witness.map_points(self._whole.at if self._whole is not None else None) if self._has_lidar else NO_POINTS

    def covariance(self) -> FloatArray:
        """(3 + m, 3 + m) joint covariance of the pose and the slow states: gyro bias, clock offset if there is a LiDAR, corrections."""
        return self._now.covariance

    def _extend(self, link: Link) -> Ahead:
        pair = Pairs.one(link, self._slow.walk(link.duration, link.moving, self._clock_walk))
        try:
            return self._window.extend(pair)
        except SingularError as error:
            self._rebuild(error)
            return self._window.extend(pair)

    def _commit(self, ahead: Ahead, stamp_ns: int) -> None:
        self._counts["nodes"] += 1
        try:
            self._window.commit(ahead)
        except SingularError:
            self._window.restart(ahead.node)
            self._counts["rebuilt"] += 1
        self._newest = self._now = self._window.newest
        self._nodes_ns.append(stamp_ns)
        if self._history is not None:
            self._counts["rebuilt"] += self._history.add(ahead.pair, self._now)
        elif len(self._nodes_ns) > 4 * self.config.lag_nodes:
            forgotten = self._window.oldest - self._first_node
            del self._nodes_ns[:forgotten]
            self._first_node += forgotten

    def _rebuild(self, error: Exception) -> None:
        """Begin the window anew from the last marginal that was sound. Raises `EstimatorError` if that is what is singular."""
        self._counts["rebuilt"] += 1
        try:
            self._window.restart(self._newest)
        except SingularError:
            raise EstimatorError(f"the graph is singular, and so is the last state known: {error}") from error

    def _look(self, step: Step, ahead: Ahead) -> Sight | None:
        self._counts["scans"] += 1
        seen = self._witness.look(step, self._believed(self._newest), self._believed(ahead.node))
        if seen is not None:
            check_motion(seen.motion.delta, seen.motion.cov, f"the LiDAR's motion that ends at {step.end_ns} ns")
            self._counts["matched"] += 1
        return seen

    def _believed(self, node: Node) -> FloatArray:
        """(3,) where the LiDAR's points say that the body is: they are brought into it by the mount that the log or robot file tells."""
        return se2.compose(node.pose, se2.exp(self._slow.mount @ node.slow)) if self._slow.mount_names else node.pose

    def _judge(self, ahead: Ahead, pending: Link, sight: Sight) -> tuple[float, Ahead]:
        """Weigh wheels and LiDAR against each other: the normalised innovation squared, and the new node by both.

        Where they contradict, one is wrong: see `admit_doubt`.
        """
        measured, mount = sight.motion, self._slow.shown(sight.motion)
        error, error_cov, nis = innovation(self._newest, ahead, pending, measured, mount)
        if math.isnan(nis):
            raise EstimatorError(_NOT_FINITE)
        if nis > self._gate:
            self._counts["contradictions"] += 1
            slip, cov = admit_doubt(error, nis, self._gate, sight.trust, error_cov, measured.cov)
            ahead, measured = self._extend(replace(pending, cov=pending.cov + slip)), Motion(measured.delta, cov)
        try:
            return nis, self._window.see(ahead, measured, mount)
        except SingularError as error_:
            self._rebuild(error_)
            return nis, self._window.see(self._extend(pending), measured, mount)

    def _recall(self, step: Step) -> None:
        """A place seen long before pulls the newest node there, as `Ekf.measure_revisit` does; a history gets the motion since then.

        The window keeps no node of that time, only the covariance of the old map: see there for what follows from it.
        """
        node, believed = self._now, self._believed(self._now)
        known = self._witness.recall(step, believed, node.covariance[:3, :3])
        if known is None:
            return
        if self._hindsight is not None:
            self._mark(step.end_ns)
            self._hindsight.see(known, step.end_ns)
        if not known.is_sure:
            return
        self._counts["revisits"] += 1
        if self._errors is not None:
            self._errors.revisit(known)
        if self._history is not None:
            a, b = self._node_at(known.then.stamp_ns, _NEAR_NS), self._node_at(step.end_ns, _NEAR_NS)
            if a is not None and b is not None and a != b:
                motion = se2.between(known.then.pose, known.pose)
                self._close(Closure(a, b, motion, whitening(known.cov + 1e-12 * np.eye(3))))
        if self.config.backend != "isam2":  # which has taken the closure in already
            self._window.restart(revisited(node, known, believed))
            self._newest = self._now = self._window.newest
        self._witness.correct(believed, self._believed(self._now))
        if self._hindsight is not None and self._errors is not None:
            self._errors.mark()
            self._hindsight.jump(step.end_ns, self._now.pose)

    def _mark(self, stamp_ns: int) -> None:
        """What the motion since the last mark is worth, for later."""
        growth = None if self._errors is None else self._errors.mark()
        if self._hindsight is not None and growth is not None:
            self._hindsight.add(stamp_ns, self._now.pose, growth)

    def _twist(self, step: Step, link: Link, ahead: Ahead, before: Node, alone: bool) -> tuple[FloatArray, FloatArray | None]:
        """Mean twist of the step, by all witnesses where the step is all there is between two nodes, else without the LiDAR."""
        if step.duration <= 0:
            self._twist_now = step.twist
            return step.twist, None
        if alone:
            delta = se2.between(before.pose, ahead.node.pose)
            cov = ahead.motion_covariance(before) if self._errors is None else self._errors.motion(before.pose, self._now.pose)
        else:
            delta, at = link.delta, link.d_slow
            cov = link.cov + at @ self._now.covariance[3:, 3:] @ at.T
        twist, twist_cov = mean_twist(delta, cov, step.duration)
        self._twist_now = twist
        return twist, twist_cov
