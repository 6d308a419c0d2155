"""Pose graph in space in GTSAM: keyframes, tied by wheels, scans, gravity and positions, with corrections of the motion model and the
accelerometer.

    x_k          keyframe poses ``odom_T_body`` on SE(3)
    c            corrections of the motion model (k, centre of rotation, ... by name)
    a            bias of the accelerometer, with what its mount is off
    t, l         ``enu_T_map`` (x, y, z, yaw) and the lever arm of the positions' antenna, if there are positions

Measurements are collected on the way and solved once, by Levenberg-Marquardt. Perturbations act on the right. Tangents are in the order of
`motion_models.se3`, those of GTSAM have the rotation first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from localization.core.measurements.position import predict_position_in_space
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.estimators.pose_graph import LEVER_SIGMA_M, check_solvable, levenberg_marquardt, robust_factor, robust_loop_noise
from localization.lidar.cloud_loops import CloudLoop
from motion_models import se2, se3
from motion_models.se2 import FloatArray
from motion_models.se3 import Transform3
from motion_models.slope import GRAVITY

_SWAP = [3, 4, 5, 0, 1, 2]
"""Rows of GTSAM's tangents in ours, and ours in GTSAM's."""
_PLANAR = [0, 1, 5]
_FIRST_POSITION_M, _FIRST_HEADING, _FIRST_TILT = 1e-3, 1e-4, 0.2
"""Sigmas of the first keyframe, which is the origin of the map [m, rad]; gravity measures its roll and pitch."""
_CORRECTIONS, _BIAS, _ALIGNMENT, _LEVER = (gtsam.symbol(name, 0) for name in "catl")
_ALIGNMENT_SIGMA, _ANTENNA_HEIGHT_SIGMA_M = 1e3, 1.0
"""Prior sigmas of ``enu_T_map`` (x, y, z, yaw) [m, rad], and of the antenna's height above base_link around its given value [m]."""


@dataclass(frozen=True)
class Between:
    """Motion from keyframe ``k`` to the next one by gyro and scans, with the information (6, 6) of its right perturbation."""

    k: int
    delta: Transform3
    information: FloatArray


@dataclass(frozen=True)
class GravityMeasurement:
    """Gravity in the axes of keyframe ``k``."""

    k: int
    force: FloatArray
    """(3,) upwards [m/s^2]."""
    turned: FloatArray
    """(3, 3) ``key_R_body`` at the measurement: the bias is constant in the body."""
    variance: float
    """[m^2/s^4]"""


@dataclass(frozen=True)
class SpacePosition:
    """A position, as by GPS, of the antenna of a body at ``offset`` (4, 4) from keyframe ``k``."""

    k: int
    offset: Transform3
    position: FloatArray
    """East and north, and up where that is measured, (2,) or (3,) [m]."""
    cov: FloatArray
    """(2, 2) or (3, 3)"""


@dataclass(frozen=True, eq=False)
class SmoothedSpace:
    """Keyframes by all measurements."""

    poses: FloatArray
    """(K, 4, 4)"""
    covs: FloatArray
    """(K, 6, 6) of their right perturbations."""
    corrections: FloatArray
    """(c,)"""
    marginals: gtsam.Marginals

    def relative_cov(self, a: int, b: int) -> FloatArray:
        """(6, 6) covariance of the right perturbation of the motion from keyframe ``a`` to ``b``."""
        keys = [gtsam.symbol("x", k) for k in (a, b)]
        joint = self.marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
        cov = np.block([[joint.at(i, j)[np.ix_(_SWAP, _SWAP)] for j in keys] for i in keys])
        J = np.hstack([-se3.adjoint(se3.inverse(self.poses[b]) @ self.poses[a]), np.eye(6)])
        return np.asarray(J @ cov @ J.T)


@dataclass
class SpaceGraph:
    """`add` keyframes with what was measured since the last one; `smooth` gives their poses by all of it."""

    prior_cov: FloatArray
    """(c, c) of the corrections, around zero."""
    accelerometer_sigma: float
    """[m/s^2]"""
    poses: list[Transform3] = field(default_factory=list)
    wheels: list[PreintegratedMotion] = field(default_factory=list)
    betweens: list[Between] = field(default_factory=list)
    gravities: list[GravityMeasurement] = field(default_factory=list)
    positions: list[SpacePosition] = field(default_factory=list)
    loops: list[CloudLoop] = field(default_factory=list)
    alignment: FloatArray | None = None
    """(4,) initial value of ``enu_T_map``, x, y, z and yaw; without it positions are left out."""
    lever: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) of the positions' antenna in the body frame [m]."""

    def smooth(self) -> SmoothedSpace:
        """The keyframes by all measurements. Raises `EstimatorError` where there is no solution."""
        graph, values = self._factors()
        with check_solvable():
            if self.loops:  # a robust loss does not feel what is hundreds of its scales away
                closed = gtsam.NonlinearFactorGraph()
                closed.push_back(graph)
                self._add_loops(closed, is_robust=False)
                values = levenberg_marquardt(closed, values)
                self._add_loops(graph, is_robust=True)
            values = levenberg_marquardt(graph, values)
            linear = graph.linearize(values)
            marginals = gtsam.Marginals(linear, linear.optimize())
            covs = [marginals.marginalCovariance(gtsam.symbol("x", k))[np.ix_(_SWAP, _SWAP)] for k in range(len(self.poses))]
        found = np.array([values.atPose3(gtsam.symbol("x", k)).matrix() for k in range(len(self.poses))])
        return SmoothedSpace(found, np.array(covs), np.asarray(values.atVector(_CORRECTIONS)), marginals)

    def _add_loops(self, graph: gtsam.NonlinearFactorGraph, is_robust: bool) -> None:
        for loop in self.loops:
            noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(loop.cov[np.ix_(_SWAP, _SWAP)])
            if is_robust:
                noise = robust_loop_noise(noise)
            ends = gtsam.symbol("x", loop.a), gtsam.symbol("x", loop.b)
            graph.add(gtsam.BetweenFactorPose3(*ends, gtsam.Pose3(loop.delta), noise))

    def _factors(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        graph, values, c = gtsam.NonlinearFactorGraph(), gtsam.Values(), len(self.prior_cov)
        for k, pose in enumerate(self.poses):
            values.insert(gtsam.symbol("x", k), gtsam.Pose3(pose))
        values.insert(_CORRECTIONS, np.zeros(c))
        values.insert(_BIAS, np.zeros(3))
        first = gtsam.noiseModel.Gaussian.Information(_first_information(self.poses[0])[np.ix_(_SWAP, _SWAP)])
        graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", 0), gtsam.Pose3(self.poses[0]), first))
        graph.add(gtsam.PriorFactorVector(_CORRECTIONS, np.zeros(c), gtsam.noiseModel.Gaussian.Covariance(self.prior_cov)))
        graph.add(gtsam.PriorFactorVector(_BIAS, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, self.accelerometer_sigma)))
        for k, wheels in enumerate(self.wheels):
            graph.add(wheel_factor(k, wheels))
        for between in self.betweens:
            noise = gtsam.noiseModel.Gaussian.Information(between.information[np.ix_(_SWAP, _SWAP)])
            ends = (gtsam.symbol("x", between.k), gtsam.symbol("x", between.k + 1))
            graph.add(gtsam.BetweenFactorPose3(*ends, gtsam.Pose3(between.delta), noise))
        for gravity in self.gravities:
            graph.add(gravity_factor(gravity))
        if self.alignment is not None:
            self._add_positions(self.alignment, graph, values)
        return graph, values

    def _add_positions(self, alignment: FloatArray, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        for key, mean, sigmas in (
            (_ALIGNMENT, alignment, np.full(4, _ALIGNMENT_SIGMA)),
            (_LEVER, self.lever, np.array([LEVER_SIGMA_M, LEVER_SIGMA_M, _ANTENNA_HEIGHT_SIGMA_M])),
        ):
            values.insert(key, mean)
            graph.add(gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        for position in self.positions:
            graph.add(position_factor(position))


def _first_information(pose: Transform3) -> FloatArray:
    """(6, 6) of the first keyframe: its position and the heading of its x axis are the map's, roll and pitch are open.

    With rotation errors e in the body's axes that heading changes by (R_yy e_z - R_yz e_y) / R_xx, for R turned to heading zero.
    """
    level = se3.rotation(np.array([0.0, 0.0, -np.arctan2(pose[1, 0], pose[0, 0])])) @ pose[:3, :3]
    heading = np.array([0.0, -level[1, 2], level[1, 1]]) / level[0, 0]
    out = np.eye(6) / _FIRST_POSITION_M**2
    out[3:, 3:] = np.eye(3) / _FIRST_TILT**2 + np.outer(heading, heading) / _FIRST_HEADING**2
    return out


def wheel_factor(k: int, wheels: PreintegratedMotion) -> gtsam.CustomFactor:
    """x, y and yaw of log(lift(delta exp(D (c - c0)))^-1 (x_k^-1 x_k+1)): the wheels' motion in the plane of the body."""
    keys = [gtsam.symbol("x", k), gtsam.symbol("x", k + 1), _CORRECTIONS]

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        D = wheels.by_corrections
        shift = D @ (values.atVector(_CORRECTIONS) - wheels.at)
        a_T_b = se3.compose(se3.inverse(values.atPose3(keys[0]).matrix()), values.atPose3(keys[1]).matrix())
        residual = se3.local(se3.lift(se2.retract(wheels.delta, shift)), a_T_b)
        if H is not None:  # to first order in the residual
            H[0] = np.asfortranarray(-se3.adjoint(se3.inverse(a_T_b))[np.ix_(_PLANAR, _SWAP)])
            H[1] = np.asfortranarray(np.eye(6)[np.ix_(_PLANAR, _SWAP)])
            H[2] = np.asfortranarray(-se2.adjoint(se2.exp(-residual[_PLANAR])) @ se2.right_jacobian(shift) @ D)
        return np.asarray(residual[_PLANAR])

    return robust_factor(keys, wheels.cov, error)


def gravity_factor(measured: GravityMeasurement) -> gtsam.CustomFactor:
    """g T^T R_k^T e_z + a - f: gravity of a keyframe's attitude in the axes of the body at the measurement.

    GTSAM's own attitude factor has no bias; one that lasts for the drive would count as often as gravity is measured.
    """
    key = gtsam.symbol("x", measured.k)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        up = values.atPose3(key).matrix()[2, :3]
        if H is not None:
            H[0] = np.asfortranarray(GRAVITY * measured.turned.T @ np.hstack([se3.cross(up), np.zeros((3, 3))]))
            H[1] = np.asfortranarray(np.eye(3))
        return np.asarray(GRAVITY * measured.turned.T @ up + values.atVector(_BIAS) - measured.force)

    return robust_factor([key, _BIAS], measured.variance * np.eye(3), error)


def position_factor(measured: SpacePosition) -> gtsam.CustomFactor:
    """t x_k (offset l) - p: where the antenna is, against its measured position."""
    keys, n = [_ALIGNMENT, gtsam.symbol("x", measured.k), _LEVER], len(measured.position)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
        alignment, lever = (np.asarray(values.atVector(key)) for key in (_ALIGNMENT, _LEVER))
        pose = values.atPose3(keys[1]).matrix()
        predicted, by_alignment, by_key, by_lever = predict_position_in_space(alignment, pose, measured.offset, lever)
        if H is not None:
            H[0], H[1], H[2] = map(np.asfortranarray, (by_alignment[:n], by_key[:n, _SWAP], by_lever[:n]))
        return np.asarray(predicted[:n] - measured.position)

    return robust_factor(keys, measured.cov, error)
