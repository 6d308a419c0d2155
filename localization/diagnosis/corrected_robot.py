"""Findings as a robot: what was named goes into geometry, mounts and the coefficients of every model, ready for `replay --robot`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from localization.diagnosis.causes import Hypothesis
from localization.diagnosis.prediction import DrivePredictor
from motion_models.base import MotionModel
from motion_models.friction import FrictionModel
from motion_models.friction.contact import SATURATION
from motion_models.registry import MODELS, make_model
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_MAX_SAMPLES = 800
_ROUNDS = 12
_ANCHOR_WEIGHT = 1e-3  # weight of the old coefficients beside one sample's twist, so that what the drive does not show stays
_TURN_M = 0.3  # one radian counts as so many metres in the match of twists
_TWIST = 1e-4


@dataclass(frozen=True)
class CorrectedRobot:
    """A robot with the findings in it."""

    robot: Robot
    manual_steps: tuple[str, ...]
    """What a robot file cannot say, and where to mend it instead."""


def correct_robot(
    predictor: DrivePredictor, hypothesis: Hypothesis, lidar_frame: str | None = None, changed: bool = True
) -> CorrectedRobot:
    """The drive's robot under ``hypothesis``; every model's coefficients are matched to the corrected motion on the drive's own wheels.

    ``lidar_frame`` is the mount that a LiDAR's findings move.
    """
    robot = predictor.drive.robot
    manual_steps: list[str] = []
    geometry = robot.geometry
    scale = 1.0 + 0.5 * (hypothesis.left_radius_scale + hypothesis.right_radius_scale)
    track = geometry.track_width_m + hypothesis.friction.get("track_width", 0.0)
    geometry = dataclasses.replace(geometry, wheel_radius_m=geometry.wheel_radius_m * scale, track_width_m=track)
    shift = _shift(predictor, hypothesis)
    arms = robot.arms
    if np.any(shift):
        if arms is None:
            geometry = dataclasses.replace(geometry, cg_x_m=geometry.cg_x_m + float(shift[0]), cg_y_m=geometry.cg_y_m + float(shift[1]))
        elif arms.static_mass_kg > 0.0:
            share = geometry.mass_kg / arms.static_mass_kg
            x, y = (float(v) for v in shift * share)
            arms = dataclasses.replace(arms, static_x_m=arms.static_x_m + x, static_y_m=arms.static_y_m + y)
        else:
            manual_steps.append(
                f"the centre of gravity is off by ({shift[0]:+.4f}, {shift[1]:+.4f}) m, which the arms' URDF would have to say; "
                "the models' coefficients hold it instead."
            )
            shift = np.zeros(2)
    geometry = dataclasses.replace(geometry, mass_kg=geometry.mass_kg + hypothesis.payload_kg)
    mounts = dict(robot.mounts)
    if any(hypothesis.lidar_offset):
        frame = lidar_frame or "laser"
        old = mounts.get(frame, Mount())
        x, y, yaw = hypothesis.lidar_offset
        mounts[frame] = dataclasses.replace(old, x=old.x + x, y=old.y + y, yaw=old.yaw + yaw)
        manual_steps.append(
            f"move {frame} by ({x:+.4f} m, {y:+.4f} m, {yaw:+.4f} rad) where /tf_static comes from: it goes before [mounts]."
        )
    if hypothesis.wheel_time_offset_s or hypothesis.lidar_time_offset_s:
        late = [(n, s) for n, s in (("wheels'", hypothesis.wheel_time_offset_s), ("LiDAR's", hypothesis.lidar_time_offset_s)) if s]
        manual_steps += [
            f"the {name} stamps are {1e3 * s:+.0f} ms late: mend the clock or the driver, robot files have none." for name, s in late
        ]
    if hypothesis.wheel_lag_s:
        manual_steps.append(f"the body follows the wheels {1e3 * hypothesis.wheel_lag_s:.0f} ms late.")
    if hypothesis.gyro_bias:
        manual_steps.append(f"the gyro's bias is {hypothesis.gyro_bias:+.5f} rad/s; let the driver zero it while the robot stands.")
    if any(hypothesis.slope):
        manual_steps.append(
            f"this drive's floor is not level ({hypothesis.slope[0]:+.3f}, {hypothesis.slope[1]:+.3f} rad); that is not the robot's."
        )
    if hypothesis.encoder_loss:
        manual_steps.append(f"an encoder loses counts in {100 * hypothesis.encoder_loss:.1f} % of the time: check its cable.")
    if hypothesis.friction_change:
        manual_steps.append(f"the floor grips otherwise from {hypothesis.friction_change_at_s:.0f} s on; one robot file cannot say both.")
    options = robot.options
    if hypothesis.other_contact_law:
        law = _law(robot, hypothesis)
        options = {**options, FrictionModel.name: {**options.get(FrictionModel.name, {}), "contact": law}}
        manual_steps.append(
            f"the tyres follow the other contact law by {100 * hypothesis.other_contact_law:.0f} %; "
            f"[models.friction] has contact = {law!r}."
        )
    new = dataclasses.replace(robot, geometry=geometry, arms=arms, mounts=mounts, options=options)
    if not changed:
        return CorrectedRobot(new, tuple(manual_steps))
    lasting = dataclasses.replace(
        hypothesis,
        slope=(0.0, 0.0),
        encoder_loss=0.0,
        friction_change=0.0,
        wheel_time_offset_s=0.0,
        lidar_time_offset_s=0.0,
        wheel_lag_s=0.0,
    )
    models = dict(robot.models)
    for name in MODELS:
        if name == FrictionModel.name:
            models[name] = _friction(robot, hypothesis, scale)
        else:
            models[name] = _matched(predictor, lasting, new, name, shift)
    return CorrectedRobot(dataclasses.replace(new, models=models), tuple(manual_steps))


def _shift(predictor: DrivePredictor, hypothesis: Hypothesis) -> FloatArray:
    shift = np.array(hypothesis.cg, dtype=float)
    if hypothesis.payload_kg:
        mass = predictor.drive.robot.geometry.mass_kg + hypothesis.payload_kg
        shift = shift + predictor.drive.payload_arms.mean(axis=0) * hypothesis.payload_kg / mass
    return shift


def _friction(robot: Robot, hypothesis: Hypothesis, scale: float) -> dict[str, float]:
    """The friction model takes the causes of the floor as they are."""
    model = FrictionModel.from_robot(robot)
    values = dict(zip(model.param_names, (float(v) for v in model.nominal), strict=True))
    values["wheel_radius"] *= scale
    for name, more in hypothesis.friction.items():
        values[name] = values[name] * (1.0 + more) if name == "mu_ratio" else values[name] + more
    for name in ("rolling_resistance", "scrub"):
        values[name] = max(values[name], 0.0)
    return values


def _law(robot: Robot, hypothesis: Hypothesis) -> str:
    """The contact law nearest to the hypothesis."""
    saturation = FrictionModel.from_robot(robot).saturation
    share = saturation + (1.0 - 2.0 * saturation) * hypothesis.other_contact_law
    return min(SATURATION, key=lambda name: abs(SATURATION[name] - share))


def _matched(predictor: DrivePredictor, hypothesis: Hypothesis, new: Robot, name: str, shift: FloatArray) -> dict[str, float]:
    """Coefficients of model ``name`` under the new robot that give the old one's twists plus what the hypothesis changes."""
    batch = predictor.batch
    step = max(1, len(batch.dt) // _MAX_SAMPLES)
    rows = np.arange(0, len(batch.dt), step)
    rates, cg = batch.wheels[rows], batch.cg[rows]
    old: MotionModel = make_model(name, predictor.drive.robot)
    wanted = dataclasses.replace(predictor, model=old, has_inertia=False).corrected_twist(hypothesis)[rows]
    model: MotionModel = make_model(name, new)
    params = model.nominal.copy()
    weight = np.array([1.0, 1.0, _TURN_M])
    size = np.maximum(np.abs(params), 0.05)
    scale = float(np.sqrt(np.mean(wanted**2))) or 1.0
    anchor = np.eye(len(params)) * _ANCHOR_WEIGHT * scale * np.sqrt(len(rows)) * _TWIST**0.5
    for _ in range(_ROUNDS):
        twist = model.twist(rates, cg + shift, params)
        off = ((wanted - twist.value) * weight).ravel()
        slopes = (twist.d_params * weight[:, None]).reshape(-1, len(params)) * size
        design = np.vstack([slopes, anchor])
        target = np.r_[off, anchor @ ((model.nominal - params) / size)]
        change = np.linalg.lstsq(design, target, rcond=None)[0]
        params = params + change * size
        if np.abs(change).max() < 1e-10:
            break
    return dict(zip(model.param_names, (float(v) for v in params), strict=True))
