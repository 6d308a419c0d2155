"""Odometry in space: wheels, gyro, gravity and a 3D LiDAR in a filter on SE(3), and the submap that its poses draw."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from localization.core.filter import Transition, clone, propagate, update
from localization.core.measurements.scan import key_scan_transition, measure_scan
from localization.core.space import (
    SpaceConfig,
    initial_space_state,
    lifted_transition,
    measure_body_turn,
    measure_gravity,
    start_at,
)
from localization.core.state import State
from localization.core.twist import twist_at_end
from localization.estimate import Estimate
from localization.estimators.estimator import Estimator
from localization.events import Gravity, Step
from localization.lidar import LidarConfig, LostScans
from localization.lidar.cloud_sensor import CloudMatchingSensor
from localization.messages import Message, message
from localization.space_pose import Pose3, aligning
from motion_models import se3
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray, Points2

_PLANAR = [0, 1, 5]
_BIAS_SIGMA = 0.01
"""Sigma of the biases of a gyro's axes that are not zeroed [rad/s]."""


class SpaceFusion(Estimator):
    """`step` after `step`: predict by the wheels, update by gyro and gravity, match the cloud, update by it; the submap grows afterwards.

    Until gravity is measured for the first time, nothing is matched.
    """

    def __init__(self, gyro: GyroNoise, mounts: Mapping[str, Mount], lidar: LidarConfig, config: SpaceConfig) -> None:
        self._gyro, self._config = gyro, config
        self.state = initial_space_state(gyro, _BIAS_SIGMA, config)
        self._has_vertical = False
        self._sensor = CloudMatchingSensor(mounts, lidar)
        self._clock_offset_s = 0.0
        self._counts = dict.fromkeys(("scans", "matched", "standing", "planar"), 0)

    @classmethod
    def continuing(
        cls, planar: Estimator, pose: Pose3, gyro: GyroNoise, mounts: Mapping[str, Mount], lidar: LidarConfig, config: SpaceConfig
    ) -> SpaceFusion:
        """In space from ``pose`` on, to which the estimator ``planar`` has come in the plane."""
        made = cls(gyro, mounts, lidar, config)
        made.state = start_at(made.state, pose.position, pose.rotation, pose.covariance)
        made._counts = {**planar.counts(), **{name: planar.counts().get(name, 0) for name in made._counts}}
        made._sensor.lost = planar.lost or made._sensor.lost
        made._clock_offset_s = planar.clock_offset_s
        return made

    @property
    def has_vertical(self) -> bool:
        """Whether gravity has been measured."""
        return self._has_vertical

    @property
    def accelerometer_sigma(self) -> float:
        """Sigma of the accelerometer's bias before any measurement [m/s^2]."""
        return self._config.accelerometer_m_s2

    @property
    def cloud(self) -> FloatArray | None:
        """(N, 3) of the last step, deskewed and thinned, in the body frame [m]; None where there is none, and after `run_deferred`."""
        return self._sensor.cloud

    @property
    def lidar_position(self) -> FloatArray:
        """(3,) of the last cloud's LiDAR in the body frame [m]."""
        return self._sensor.position

    def start_key(self) -> None:
        """Clone the pose as the last keyframe, the variable "key", which all later measurements update as well."""
        self.state = clone(self.state, "pose", "key")

    def step(self, step: Step) -> Estimate:
        """Predict, update by gyro and gravity, update by the cloud."""
        self.run_deferred()
        self._counts["standing"] += step.is_standing
        state = propagate(clone(self.state, "pose", "start"), lifted_transition(self.state, step, self._gyro, self._config))
        if step.body_turn is not None and step.turn is not None:  # a sensor check may have left the gyro out
            state, _ = update(state, measure_body_turn(state, step.body_turn), ("map",))
        if step.gravity is not None:
            if not self._has_vertical:
                state, self._has_vertical = _align(state, step.gravity), True
            state, _ = update(state, measure_gravity(state, step.gravity))
            state = self._tilt_map(state)
        self.state = state
        return self._estimate(step, self._update_cloud(step))

    def _tilt_map(self, state: State) -> State:
        """Move the submap by its estimated error, a right perturbation of the pose: it shares the pose's error of roll and pitch."""
        self._sensor.move_map(state["pose"], state["map"])
        return State(state.layout, {**state.means, "map": np.zeros(6)}, state.P)

    def run_deferred(self) -> bool:
        """The last cloud enters the submap, if it is a key cloud. Deferred until its estimate is out."""
        error = self._sensor.insert_key_cloud(self.state["pose"])
        if error is not None:
            self.state = propagate(self.state, key_scan_transition(self.state, error))
        return False

    def _update_cloud(self, step: Step) -> float | None:
        """Match the cloud of ``step`` and update by it; the NIS of x, y and yaw in the body's axes (3 degrees of freedom, as in the plane).

        None where there is no cloud or no match.
        """
        self._counts["planar"] += step.scan is not None and step.scan.is_planar
        if step.scan is None or step.scan.is_planar or not self._has_vertical:
            self._sensor.add_no_cloud(step.end_ns, is_excluded=step.is_scan_excluded)
            return None
        self._counts["scans"] += 1
        found = self._sensor.measure(step, self.state["gyro_bias"], self.state["pose"], self.state.difference_cov("pose", "map"))
        if found is None:
            return None
        self._counts["matched"] += 1
        if found.first is not None:
            self.state = propagate(self.state, key_scan_transition(self.state, found.first))
        self.state, innovation = update(self.state, measure_scan(self.state, found.measured, found.cov), ("map",))
        return innovation.nis_of(_PLANAR)

    def _estimate(self, step: Step, nis: float | None) -> Estimate:
        pose, P = self.state["pose"], self.state.cov("pose")
        world = np.zeros((6, 6))
        world[:3, :3] = world[3:, 3:] = pose[:3, :3]
        in_space = Pose3(pose[:3, 3], pose[:3, :3], world @ P @ world.T)
        planar, planar_cov = in_space.from_above()
        twist, twist_cov = step.twist, None
        if step.duration > 0.0:
            delta, cov = self.state.between("start", "pose")
            mean, mean_cov = se3.log(delta)[_PLANAR] / step.duration, cov[np.ix_(_PLANAR, _PLANAR)] / step.duration**2
            measured_over = math.inf if nis is not None or not step.has_wheels else step.duration
            twist, twist_cov = twist_at_end(mean, mean_cov, step.twist - step.mean_twist, measured_over)
        return Estimate(step.end_ns, planar, planar_cov, twist, twist_cov, nis, in_space=in_space)

    @property
    def clock_offset_s(self) -> float:
        """Offset of the wheels' stamps [s]: what the estimator in the plane has found."""
        return self._clock_offset_s

    @property
    def lost(self) -> LostScans:
        """Clouds that could not be matched."""
        return self._sensor.lost

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what the filter estimated besides the pose, by name."""
        sigmas = np.sqrt(np.diagonal(self.state.cov("gyro_bias")))
        return {
            f"gyro_bias_{axis}_rad_per_s": (float(bias), float(sigma))
            for axis, bias, sigma in zip("xyz", self.state["gyro_bias"], sigmas, strict=True)
        }

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: scans, matched, and those of lost scans by cause."""
        return {**self._counts, **self._sensor.lost.causes}

    def warnings(self) -> list[Message]:
        """Warnings about inputs that poses in space need and that are missing, with the remedy."""
        if not self._has_vertical:
            return [message("poses_in_space.no_vertical")]
        if self._counts["planar"]:
            return [message("poses_in_space.planar_scans", count=self._counts["planar"])]
        return []

    def map_points(self) -> Points2:
        """(M, 2) points of the map projected to the plane [m]."""
        return self._sensor.map_points()


def _align(state: State, gravity: Gravity) -> State:
    """The pose turned about a level axis, so that ``gravity`` is vertical; its heading, that of the body's x axis, stays.

    Errors of the vertical leave that heading: x' = R exp(e) e_x has none where e_z = e_y R_12 / R_11, for R of heading zero.
    """
    pose = state["pose"].copy()
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    upright = aligning(gravity.force / np.linalg.norm(gravity.force), np.array([0.0, 0.0, 1.0]))
    level = _turn(-math.atan2(upright[1, 0], upright[0, 0])) @ upright
    pose[:3, :3] = _turn(yaw) @ level
    keeping = np.eye(6)
    keeping[5, 4] = level[1, 2] / level[1, 1]
    return propagate(state, Transition({"pose": pose}, {("pose", "pose"): keeping}, what="the first vertical"))


def _turn(yaw: float) -> FloatArray:
    return se3.rotation(np.array([0.0, 0.0, yaw]))
