"""Wheels, gyro and LiDAR in a factor graph: the sibling of `EkfFusion`, with the same residuals, witness and beliefs.

A node stands at each scan (at each step without a LiDAR). What lies between two nodes is preintegrated into one link; the LiDAR's motion is
a second factor beside it. The estimate of each moment is that of a fixed-lag window, which relinearises what it smooths; beside it, if
asked for, all factors are kept and solved as one, by iSAM2 on the way or in a batch at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2

from localization.errors import EstimatorError
from localization.estimators.base import NO_POINTS, Estimate, mean_twist
from localization.estimators.ekf import EkfConfig
from localization.estimators.graph_factors import Kernel, Pairs, Position, whitening
from localization.estimators.graph_history import History
from localization.estimators.graph_link import Link, check_covariance, check_motion, first_link
from localization.estimators.graph_window import Ahead, Node, SingularError, Window
from localization.estimators.witness import NoWitness, ScanWitness, Sight, Witness
from localization.lidar import LidarConfig
from localization.residuals import motion_residual
from localization.steps import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.corrections import Corrections
from motion_models.robot import GyroNoise, Mount, Robot
from motion_models.se2 import FloatArray

_CERTAIN = 1e-6  # m, rad: sigma of the first pose, which is the origin by definition
_STILL = 1e-4  # part of the random walk that is left while the wheels stand: zero would be infinite information


@dataclass(frozen=True)
class GraphConfig:
    """How the graph is solved. What it believes at first is the filter's (`EkfConfig`)."""

    backend: Literal["fixed_lag", "batch", "isam2"] = "fixed_lag"
    """``fixed_lag``: the estimate of each moment. ``batch``, ``isam2``: all poses as later measurements have smoothed them."""
    lag_nodes: int = 50
    """Nodes that the window smooths."""
    relinearize_at: float = 0.01
    """A node whose pose has moved this far from where it was linearised is linearised anew [m, rad]."""
    kernel: Literal["none", "huber", "cauchy"] = "huber"
    """Robust kernel of positions and loop closures; a LiDAR that contradicts the wheels is judged when it comes."""
    kernel_scale: float = 3.0
    """Where the kernel begins [sigmas]."""


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
    ) -> None:
        """``belief``: as the filter's. ``witness`` measures the motion between scans; if not given, scans are matched as ``lidar`` says."""
        self.config, self._belief = config or GraphConfig(), belief or EkfConfig()
        self._model, self._corrected, self._has_lidar = model, corrected, has_lidar
        self._witness: Witness = (witness or ScanWitness(mounts, lidar)) if has_lidar else NoWitness()
        self._slow = SlowStates(robot.gyro_noise, corrected, self._belief, has_lidar)
        self._kernel = Kernel(self.config.kernel, self.config.kernel_scale)
        n = 3 + self._slow.size
        root = np.zeros((n, n))
        root[:3, :3], root[3:, 3:] = np.eye(3) / _CERTAIN, self._slow.root
        first = Node(np.zeros(3) if pose is None else np.array(pose, dtype=float), np.zeros(self._slow.size), root)
        self._window = Window(first, self.config.lag_nodes, self.config.relinearize_at, self._kernel)
        self._history = None if self.config.backend == "fixed_lag" else History(first, self.config.backend, self._kernel)
        self._newest = first
        self._now = first
        self._pending: Link | None = None
        self._nodes_ns: list[int] = []
        self._gate = float(chi2.ppf(self._belief.gate_probability, 3))
        self._has_gyro, self._twist_now = False, np.zeros(3)
        self._counts = dict.fromkeys(("scans", "matched", "contradictions", "standing", "nodes", "rebuilt", "positions"), 0)

    @property
    def clock_offset_s(self) -> float:
        return float(self._now.slow[1]) if self._slow.has_clock else 0.0

    @property
    def params(self) -> FloatArray:
        return np.asarray(self._model.nominal + self._corrected.directions @ self._now.slow[self._slow.corrections])

    def step(self, step: Step) -> Estimate:
        """See `Estimator.step`. Raises `EstimatorError` for measurements that are not finite or have no covariance."""
        if not self._nodes_ns:
            self._nodes_ns.append(step.start_ns)
        link = self._link(step)
        pending = link if self._pending is None else self._pending.then(link)
        nis = None
        ahead = self._extend(pending)
        if step.scan is not None and self._has_lidar:
            sight = self._look(step, ahead)
            if sight is not None:
                nis, ahead = self._judge(ahead, pending, sight)
        before, self._now = self._now, ahead.node
        alone = self._pending is None
        if step.scan is not None or not self._has_lidar:
            self._commit(ahead, step.end_ns)
            self._pending = None
            if step.scan is not None and self._has_lidar:
                self._witness.remember(step, self._now.pose)
        else:
            self._pending = pending
        if self._history is not None:
            self._history.mark(step.end_ns, self._pending)
        twist, twist_cov = self._twist(step, link, ahead, before, alone)
        return Estimate(step.end_ns, self._now.pose, self._now.covariance[:3, :3], twist, twist_cov, nis)

    def add_position(self, stamp_ns: int, xy: FloatArray, cov: FloatArray, lever: FloatArray | None = None) -> bool:
        """A measured position ``xy`` (2,) with ``cov`` (2, 2) of the body's point ``lever`` (2,) at a moment, in this estimator's world.

        As by GPS. Late ones are used as long as their node is in the window; returns whether it was. Raises `EstimatorError`.
        """
        lever = np.zeros(2) if lever is None else lever
        if xy.shape != (2,) or not np.isfinite(xy).all() or lever.shape != (2,) or not np.isfinite(lever).all():
            raise EstimatorError(f"the position {xy} or its lever arm {lever} is not two finite numbers.")
        check_covariance(cov, 2, "a position")
        if not self._nodes_ns:
            return False
        node = int(np.argmin(np.abs(np.array(self._nodes_ns[self._window.oldest :]) - stamp_ns))) + self._window.oldest
        off = (stamp_ns - self._nodes_ns[node]) * 1e-9
        if abs(off) > 1.0:
            return False
        # between nodes the body moves on with its last twist, about as well known as a tenth of the way
        away = se2.exp(off * self._twist_now)
        cov = cov + (0.1 * np.linalg.norm(away[:2])) ** 2 * np.eye(2) + 1e-12 * np.eye(2)
        position = Position(xy, whitening(cov), se2.transform(away, lever))
        self._window.add_position(node, position)
        self._newest = self._now = self._window.newest
        if self._history is not None:
            self._history.add_position(node, position)
        self._counts["positions"] += 1
        return True

    def add_closure(self, from_ns: int, to_ns: int, motion: Motion) -> None:
        """A place seen again: the motion between the nodes at two moments.

        Needs the back end ``batch`` or ``isam2``, which keep old nodes. Raises `EstimatorError`.
        """
        check_motion(motion.delta, motion.cov, "the loop closure")
        if self._history is None:
            raise EstimatorError("loop closures need old nodes: use the back end 'batch' or 'isam2' instead of 'fixed_lag'.")
        if not self._nodes_ns:
            raise EstimatorError("a loop closure before the first node: there is nothing to close.")
        stamps = np.array(self._nodes_ns)
        a, b = (int(np.argmin(np.abs(stamps - t))) for t in (from_ns, to_ns))
        for t, node in ((from_ns, a), (to_ns, b)):
            if abs(t - self._nodes_ns[node]) > 50_000_000:
                raise EstimatorError(f"a loop closure at {t} ns, where there is no node; the nearest is at {self._nodes_ns[node]} ns.")
        self._history.add_closure(a, b, motion.delta, whitening(motion.cov + 1e-12 * np.eye(3)))
        found = self._history.newest()
        if found is not None:
            self._window.restart(found)
            self._newest = self._now = found

    def finish(self) -> Trajectory | None:
        """None for the fixed lag; else all poses as the whole log tells them, with covariances."""
        return None if self._history is None else self._history.trajectory()

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        found, cov = {}, self._now.covariance[3:, 3:]
        if self._has_gyro:
            found["gyro_bias_rad_per_s"] = float(self._now.slow[0]), math.sqrt(cov[0, 0])
        if self._slow.has_clock:
            found["wheel_clock_offset_s"] = float(self._now.slow[1]), math.sqrt(cov[1, 1])
        nominal = dict(zip(self._model.param_names, self._model.nominal, strict=True))
        for i, name in enumerate(self._corrected.names, start=self._slow.corrections.start):
            found[name] = float(nominal.get(name, 0.0) + self._now.slow[i]), math.sqrt(cov[i, i])
        return found

    def counts(self) -> Mapping[str, int]:
        return self._counts

    def map_points(self) -> FloatArray:
        return self._witness.map_points() if self._has_lidar else NO_POINTS

    def covariance(self) -> FloatArray:
        """(3 + m, 3 + m) joint covariance of the pose and the slow states: gyro bias, clock offset if there is a LiDAR, corrections."""
        return self._now.covariance

    def _link(self, step: Step) -> Link:
        """All that wheels and gyro say of the step."""
        b, slow = self._belief, self._slow
        cov = step.predicted.cov
        if step.is_standing:
            self._counts["standing"] += 1
            cov = cov + np.diag([b.nudge_m2_per_s, b.nudge_m2_per_s, b.nudge_rad2_per_s]) * step.duration
        d_slow = np.zeros((3, slow.size))
        if slow.has_clock:
            d_slow[:, 1] = step.d_clock
        d_slow[:, slow.corrections] = step.predicted.d_params @ self._corrected.directions
        moving = _STILL * step.duration if step.is_standing else step.duration
        link = first_link(step.predicted.delta, cov, d_slow, self._now.slow, step.duration, moving)
        if step.turn is not None:
            self._has_gyro = True
            turn = step.turn
            if not (math.isfinite(turn.angle) and turn.variance > 0.0 and math.isfinite(turn.variance)):
                raise EstimatorError(f"the gyro's turn that ends at {step.end_ns} ns is {turn.angle} rad with variance {turn.variance}.")
            error = se2.wrap_angle(turn.angle - link.delta[2] - link.at[0] * turn.duration)
            by_slow = np.zeros((1, slow.size))
            by_slow[0, 0] = turn.duration
            link = link.observe(np.array([float(error)]), _YAW, by_slow, np.array([turn.variance]))
        if step.is_standing:
            still = np.array([b.standing_sigma_m**2, b.standing_sigma_m**2, b.standing_sigma_rad**2])
            link = link.observe(-se2.log(link.delta), np.eye(3), np.zeros((3, slow.size)), still)
        return link

    def _extend(self, link: Link) -> Ahead:
        pair = Pairs.one(link, self._slow.walk(link.duration, link.moving))
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

    def _rebuild(self, error: Exception) -> None:
        """Begin the window anew from the last marginal that was sound. Raises `EstimatorError` if that is what is singular."""
        self._counts["rebuilt"] += 1
        try:
            self._window.restart(self._newest)
        except SingularError:
            raise EstimatorError(f"the graph is singular, and so is the last state known: {error}") from error

    def _look(self, step: Step, ahead: Ahead) -> Sight | None:
        self._counts["scans"] += 1
        seen = self._witness.look(step, self._newest.pose, ahead.node.pose)
        if seen is not None:
            check_motion(seen.motion.delta, seen.motion.cov, f"the LiDAR's motion that ends at {step.end_ns} ns")
            self._counts["matched"] += 1
        return seen

    def _judge(self, ahead: Ahead, pending: Link, sight: Sight) -> tuple[float, Ahead]:
        """Weigh wheels and LiDAR against each other: the normalised innovation squared, and the new node by both.

        Where they contradict, one is wrong: the covariance of the one that is not sure of itself grows until they agree.
        """
        measured = sight.motion
        error, _, d_b = motion_residual(self._newest.pose, ahead.node.pose, measured.delta)
        own = pending.cov + pending.d_slow @ ahead.node.covariance[3:, 3:] @ pending.d_slow.T
        nis = float(error @ np.linalg.solve(d_b @ (own + measured.cov) @ d_b.T, error))
        if nis > self._gate:
            self._counts["contradictions"] += 1
            if sight.is_trusted:
                ahead = self._extend(replace(pending, cov=pending.cov + (nis / self._gate) * np.outer(error, error)))
            else:
                measured = Motion(measured.delta, measured.cov * (nis / self._gate) ** 2)
        try:
            return nis, self._window.see(ahead, measured)
        except SingularError as error_:
            self._rebuild(error_)
            return nis, self._window.see(self._extend(pending), measured)

    def _twist(self, step: Step, link: Link, ahead: Ahead, before: Node, alone: bool) -> tuple[FloatArray, FloatArray | None]:
        """Mean twist of the step, by all witnesses where the step is all there is between two nodes, else without the LiDAR."""
        if step.duration <= 0:
            self._twist_now = step.twist
            return step.twist, None
        if alone:
            delta = se2.between(before.pose, ahead.node.pose)
            _, d_a, d_b = motion_residual(before.pose, ahead.node.pose, delta)
            J = np.hstack([d_a, d_b])
            cov = J @ ahead.motion_covariance() @ J.T
        else:
            delta, at = link.delta, link.d_slow
            cov = link.cov + at @ self._now.covariance[3:, 3:] @ at.T
        twist, twist_cov = mean_twist(delta, cov, step.duration)
        self._twist_now = twist
        return twist, twist_cov


_YAW = np.array([[0.0, 0.0, 1.0]])


class SlowStates:
    """Order, first beliefs and random walks of what is learned on the way: gyro bias, clock offset, corrections."""

    def __init__(self, gyro: GyroNoise, corrected: Corrections, belief: EkfConfig, has_lidar: bool) -> None:
        self.has_clock = has_lidar and belief.clock_sigma_s > 0.0  # without a LiDAR there is no second clock to compare with
        begin = 1 + self.has_clock
        self.size = begin + len(corrected.names)
        self.corrections = slice(begin, self.size)
        cov, walk = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        cov[0, 0], walk[0, 0] = gyro.bias_sigma_rad_per_s**2, gyro.bias_walk_rad_per_s_sqrt_s**2
        if self.has_clock:
            cov[1, 1], walk[1, 1] = belief.clock_sigma_s**2, belief.clock_walk_s_per_sqrt_s**2
        cov[begin:, begin:] = corrected.cov
        # what does not walk, as it is remembered, walks by a hundredth of a percent of what is not known of it per second
        walk[begin:, begin:] = corrected.walk_cov + 1e-8 * corrected.cov
        for what, matrix in (("first beliefs", cov), ("random walks", walk)):
            check_covariance(matrix, self.size, f"the slow states' {what}")
        try:
            self.root = whitening(cov)
            self._walk = whitening(walk)
        except np.linalg.LinAlgError as error:
            raise EstimatorError("a sigma of the gyro's bias, its walk or a correction is zero: the graph needs them above 0.") from error

    def walk(self, duration: float, moving: float) -> FloatArray:
        """(m, m) whitening of the random walk over ``duration`` [s], of which wheels moved for ``moving``."""
        scale = np.full(self.size, max(duration, 1e-6) ** -0.5)
        scale[self.corrections] = max(moving, 1e-6 * max(duration, 1e-3)) ** -0.5
        return np.asarray(self._walk * scale[:, None])
