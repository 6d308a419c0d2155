"""Wheels, gyro and LiDAR in one filter, with the map that the filter itself draws.

The wheels say where to look for the scan in the map; what the scan then says of the pose, its covariance included, comes from scan and
map alone, so nothing is counted twice. The scan enters the map where the fused estimate puts it: a place seen again pulls the robot back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.estimators.base import NO_POINTS, Estimate, mean_twist
from localization.estimators.ekf import BIAS, CLOCK, PARAMS, POSE, Ekf, EkfConfig
from localization.estimators.teaching import teaching
from localization.estimators.witness import ScanWitness, Witness
from localization.lidar import LidarConfig
from localization.steps import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.corrections import Corrections
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray


class EkfFusion:
    """The filter's steps in their order, and the counts of what happened."""

    def __init__(
        self,
        model: MotionModel,
        corrected: Corrections,
        robot: Robot,
        mounts: Mapping[str, Mount],
        has_lidar: bool,
        config: EkfConfig | None = None,
        lidar: LidarConfig | None = None,
        witness: Witness | None = None,
    ) -> None:
        """``witness`` measures the motion between scans; if not given, scans are matched as ``lidar`` says."""
        config = config or EkfConfig()
        # without a LiDAR there is no second clock until a gyro is heard
        self._ekf = Ekf(robot.gyro_noise, corrected, config if has_lidar else replace(config, clock_sigma_s=0.0))
        self._clock_sigma_s = 0.0 if has_lidar else config.clock_sigma_s
        self._witness = (witness or ScanWitness(mounts, lidar)) if has_lidar else None
        self._model, self._corrected, self._track_m = model, corrected, robot.geometry.track_width_m
        self._has_gyro = False
        self._to_settle: tuple[Step, bool] | None = None  # a step with a scan, and whether that was matched
        self._counts = dict.fromkeys(("scans", "matched", "contradictions", "standing", "revisits"), 0)

    @property
    def clock_offset_s(self) -> float:
        return self._ekf.clock_offset

    @property
    def params(self) -> FloatArray:
        return np.asarray(self._model.nominal + self._corrected.directions @ self._ekf.correction)

    def step(self, step: Step) -> Estimate:
        self.settle()
        ekf, nis = self._ekf, None
        ekf.predict(teaching(step, self._track_m, self._corrected, ekf.covariance[PARAMS:, PARAMS:]))
        if step.turn is not None:
            ekf.measure_turn(step.turn)
            if not self._has_gyro:
                self._has_gyro = True
                ekf.meet_clock(self._clock_sigma_s)
        if step.is_standing:
            self._counts["standing"] += 1
            ekf.measure_standing()
        if step.scan is not None and self._witness is not None:
            nis = self._look(step, self._witness)
        twist, twist_cov = self._twist(step)
        return Estimate(step.end_ns, ekf.pose, ekf.errors[POSE, POSE], twist, twist_cov, nis)

    def _look(self, step: Step, witness: Witness) -> float | None:
        ekf, nis = self._ekf, None
        self._counts["scans"] += 1
        seen = witness.look(step, ekf.anchor, ekf.pose)
        if seen is not None:
            self._counts["matched"] += 1
            nis = ekf.measure_motion(seen.motion, seen.trust, seen.tie)
            self._counts["contradictions"] += nis > ekf.gate
        if witness.can_begin:
            self._to_settle = step, seen is not None
        return nis

    def settle(self) -> None:
        """Whether the place was seen long before; the last scan enters the map."""
        if self._to_settle is None or self._witness is None:
            return
        ekf, witness, (step, is_matched) = self._ekf, self._witness, self._to_settle
        self._to_settle = None
        if is_matched and (known := witness.recall(step, ekf.pose, ekf.covariance[POSE, POSE])) is not None:
            self._counts["revisits"] += 1
            before = ekf.pose
            ekf.measure_revisit(known)
            witness.correct(before, ekf.pose)
        ekf.set_anchor(witness.remember(step, ekf.pose))

    def _twist(self, step: Step) -> tuple[FloatArray, FloatArray | None]:
        """Mean twist of the step as all witnesses see it."""
        if step.duration <= 0:
            return step.twist, None
        delta = se2.between(self._ekf.start, self._ekf.pose)
        return mean_twist(delta, self._ekf.motion_cov(delta), step.duration)

    def finish(self, moments: Trajectory | None = None) -> None:
        self.settle()

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        found = {}
        if self._has_gyro:
            found["gyro_bias_rad_per_s"] = self._ekf.bias, math.sqrt(self._ekf.covariance[BIAS, BIAS])
        if self._witness is not None or self._has_gyro:
            found["wheel_clock_offset_s"] = self._ekf.clock_offset, math.sqrt(self._ekf.covariance[CLOCK, CLOCK])
        nominal = dict(zip(self._model.param_names, self._model.nominal, strict=True))
        for i, name in enumerate(self._corrected.names):
            mean = nominal.get(name, 0.0) + self._ekf.correction[i]
            found[name] = float(mean), math.sqrt(self._ekf.covariance[PARAMS + i, PARAMS + i])
        return found

    def counts(self) -> Mapping[str, int]:
        return self._counts if self._witness is None else {**self._counts, **self._witness.counts()}

    def map_points(self) -> FloatArray:
        return NO_POINTS if self._witness is None else self._witness.map_points()
