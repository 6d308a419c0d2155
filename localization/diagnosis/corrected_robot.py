"""Findings as a robot: what was named goes into geometry, mounts and the coefficients of every model, ready for `replay --robot`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.diagnosis.causes import Hypothesis
from localization.diagnosis.drive import Drive
from localization.diagnosis.findings import Finding, HandoverCheck
from localization.diagnosis.linearization import Linearization, make_regression
from localization.diagnosis.prediction import CHANNELS, DrivePredictor, with_sizes
from motion_models.base import MotionModel
from motion_models.center_of_gravity.files import arms_model
from motion_models.center_of_gravity.parts import Arms
from motion_models.errors import CgError, ModelError
from motion_models.friction import FrictionModel
from motion_models.friction.contact import SATURATION
from motion_models.registry import MODELS, make_model
from motion_models.robot import Clock, Geometry, Mount, Robot
from motion_models.se2 import FloatArray

_MAX_SAMPLES = 800
_ROUNDS = 12
_ANCHOR_WEIGHT = 1e-3  # weight of the old coefficients beside one sample's twist, so that what the drive does not show stays
_TURN_M = 0.3  # one radian counts as so many metres in the match of twists
_TWIST = 1e-4
_MIN_HALF_WINDOWS = 8
_CLOCKS = ("wheel_time_offset_s", "lidar_time_offset_s", "gyro_time_offset_s")
_PASSING = ("slope", "encoder_loss", "friction_change", "friction_change_at_s", "wheel_radius_drift", "wheel_lag_s", *_CLOCKS)


_MEASURED = ("lidar_offset", "gyro_bias", "gyro_scale", "range_scale", "range_bias_m")
"""What changes measurements, not the motion."""


@dataclass(frozen=True)
class CorrectedRobot:
    """A robot with the findings in it."""

    robot: Robot
    manual_steps: tuple[str, ...]
    """What a robot file cannot hold, and where to correct it instead."""
    cg_shift: FloatArray
    """(N, 2) by which the new file moves the centre of gravity in each interval of the drive [m]."""


def correct_robot(predictor: DrivePredictor, hypothesis: Hypothesis) -> CorrectedRobot:
    """The drive's robot under ``hypothesis``; every model's coefficients are matched to the corrected motion on the drive's own wheels."""
    robot = predictor.drive.robot
    geometry, arms, note, shift = _with_cg(predictor.drive, hypothesis, _corrected_geometry(robot, hypothesis))
    mounts, frame = dict(robot.mounts), _lidar_frame(predictor)
    if any(hypothesis.lidar_offset) and frame is not None:
        old = mounts.get(frame, Mount())
        x, y, yaw = hypothesis.lidar_offset
        mounts[frame] = dataclasses.replace(old, x=old.x + x, y=old.y + y, yaw=old.yaw + yaw)
    options = robot.options
    if hypothesis.other_contact_law:
        law = _law(robot, hypothesis)
        options = {**options, FrictionModel.name: {**options.get(FrictionModel.name, {}), "contact": law}}
    new = dataclasses.replace(
        robot, geometry=geometry, arms=arms, mounts=mounts, options=options, clock=_corrected_clock(robot.clock, hypothesis, frame)
    )
    models = dict(robot.models)
    for name in MODELS:
        if name == FrictionModel.name:
            models[name] = _friction(robot, hypothesis)
            if any(hypothesis.rotation_coefficients) or any(hypothesis.slip_coefficients):
                start = dataclasses.replace(new, models={**new.models, name: models[name]})
                models[name] = _matched(predictor, _lasting(hypothesis), start, name, shift, ("track_width",))
        else:
            models[name] = _matched(predictor, _lasting(hypothesis), new, name, shift)
    steps = (*note, *_manual_steps(robot, hypothesis, frame))
    return CorrectedRobot(dataclasses.replace(new, models=models), steps, shift)


def is_held(predictor: DrivePredictor, finding: Finding) -> bool:
    """Whether a robot file holds what corrects ``finding``; else it is to be corrected in a driver, or was of this drive alone."""
    hypothesis = with_sizes({finding.definition: finding.size})
    return Hypothesis() != _of_robot(hypothesis) or Hypothesis() != _of_sensors(hypothesis, predictor.drive.is_lidar_reference)


def _lidar_frame(predictor: DrivePredictor) -> str | None:
    """Frame of the LiDAR whose mount and clock were diagnosed; None where a reference measured the motion."""
    return predictor.drive.lidar_frame or "laser" if predictor.drive.is_lidar_reference else None


def check_handover(predictor: DrivePredictor, linearization: Linearization, named: Sequence[str]) -> HandoverCheck | None:
    """Correct the robot by the first half of the drive, and predict the second half with it; ``named`` are the keys of the findings.

    What was measured is corrected by the mount and the clocks that the robot file holds, not by what is to be corrected in drivers. Errors
    of a reference are no part of the check, before or after. None for drives of a table, without motion in either half, and where the robot
    file holds none of the findings.
    """
    drive = predictor.drive
    half = len(drive.maneuvers) // 2
    if drive.kind != "log" or half < _MIN_HALF_WINDOWS or not named:
        return None
    is_first = np.arange(len(linearization.rows)) < half
    first = [np.where(is_first.reshape(-1, *(1,) * (a.ndim - 1)), a, np.nan) for a in _arrays(linearization)]
    chosen = [i for i, cause in enumerate(linearization.causes) if cause.key in named]
    causes = tuple(linearization.causes[i] for i in chosen)
    problem = make_regression(first[0], first[1][..., chosen], first[2], linearization.noise, causes, linearization.tolerance)
    sizes = problem.fit(tuple(range(len(causes))))[0]
    hypothesis = with_sizes(dict(zip(causes, (float(v) for v in sizes), strict=True)))
    if _of_robot(hypothesis) == Hypothesis() == _of_sensors(hypothesis, drive.is_lidar_reference):
        return None
    corrected = correct_robot(predictor, hypothesis)
    factors = corrected.robot.geometry.radius_multipliers / drive.robot.geometry.radius_multipliers
    shifts = np.split(corrected.cg_shift, np.cumsum([len(m.wheels) for m in drive.maneuvers])[:-1])
    maneuvers = tuple(
        dataclasses.replace(m, wheels=m.wheels * factors, cg=m.cg + shift) for m, shift in zip(drive.maneuvers, shifts, strict=True)
    )
    model = make_model(predictor.model.name, corrected.robot)
    corrected_drive = dataclasses.replace(drive, robot=corrected.robot, maneuvers=maneuvers)
    after = DrivePredictor(corrected_drive, model, has_inertia=predictor.has_inertia, baseline=predictor.baseline)
    rows = predictor.discrepancies(_of_reference(hypothesis, drive.is_lidar_reference)), after.discrepancies(_of_sensors(hypothesis))
    shown = [c for c in range(4) if all(np.isfinite(r[half:, c]).any() for r in rows)]
    if not shown:
        return None
    before_rms, after_rms = ({CHANNELS[c]: float(np.sqrt(np.nanmean(r[half:, c] ** 2))) for c in shown} for r in rows)
    return HandoverCheck(before_rms, after_rms, len(drive.maneuvers) - half)


def _arrays(linearization: Linearization) -> tuple[FloatArray, FloatArray, FloatArray]:
    return linearization.linear, linearization.signatures, linearization.nuisances


def _of_sensors(hypothesis: Hypothesis, is_lidar_reference: bool = True) -> Hypothesis:
    """The part of ``hypothesis`` by which mount and clocks change what was measured; without those of a reference, which no robot file
    holds."""
    names = ("wheel_time_offset_s", "gyro_time_offset_s", *(("lidar_offset", "lidar_time_offset_s") if is_lidar_reference else ()))
    return Hypothesis(**{name: getattr(hypothesis, name) for name in names})


def _of_reference(hypothesis: Hypothesis, is_lidar_reference: bool) -> Hypothesis:
    """The part of ``hypothesis`` that is a reference's, none where the LiDAR measured the motion."""
    if is_lidar_reference:
        return Hypothesis()
    return Hypothesis(lidar_offset=hypothesis.lidar_offset, lidar_time_offset_s=hypothesis.lidar_time_offset_s)


def _of_robot(hypothesis: Hypothesis) -> Hypothesis:
    """The part of ``hypothesis`` that changes the robot's motion."""
    nothing, lasting = Hypothesis(), _lasting(hypothesis)
    return dataclasses.replace(lasting, **{name: getattr(nothing, name) for name in _MEASURED})


def _lasting(hypothesis: Hypothesis) -> Hypothesis:
    """``hypothesis`` without what belongs to this drive, its clocks, or the wheels' radii difference, which the geometry holds."""
    nothing = Hypothesis()
    kept = {f.name: getattr(hypothesis, f.name) for f in dataclasses.fields(hypothesis)}
    return Hypothesis(**{name: getattr(nothing, name) if name in _PASSING else value for name, value in kept.items()})


def _corrected_geometry(robot: Robot, hypothesis: Hypothesis) -> Geometry:
    """Radius, its difference by multipliers whose mean is kept, track and mass."""
    g = robot.geometry
    left, right = 1.0 + hypothesis.left_radius_scale, 1.0 + hypothesis.right_radius_scale
    mean = 0.5 * (left + right)
    return dataclasses.replace(
        g,
        wheel_radius_m=g.wheel_radius_m * mean,
        left_wheel_radius_multiplier=g.left_wheel_radius_multiplier * left / mean,
        right_wheel_radius_multiplier=g.right_wheel_radius_multiplier * right / mean,
        track_width_m=g.track_width_m + hypothesis.friction.get("track_width", 0.0),
        mass_kg=g.mass_kg + hypothesis.payload_kg,
    )


def _with_cg(drive: Drive, h: Hypothesis, geometry: Geometry) -> tuple[Geometry, Arms | None, tuple[str, ...], FloatArray]:
    """Geometry and arms with the CG of ``h``, a note where neither holds it, and the shift that is held, (N, 2) in each interval [m].

    A payload in the gripper moves with the arms: it becomes ``[arms] payload_kg``. What is constant belongs to everything but the arms,
    whose CG moves by the shift times all mass over its own.
    """
    arms, mass = drive.robot.arms, drive.robot.geometry.mass_kg + h.payload_kg
    constant = np.array(h.cg, dtype=float)
    carried = drive.payload_arms * (h.payload_kg / mass) if h.payload_kg else np.zeros_like(drive.payload_arms)
    if arms is not None and drive.payload_link and arms.payload_kg + h.payload_kg > 0.0 and h.payload_kg:
        arms = dataclasses.replace(arms, payload_kg=arms.payload_kg + h.payload_kg, payload_link=drive.payload_link)
    elif h.payload_kg:
        constant, carried = constant + carried.mean(axis=0), np.zeros_like(carried)
    shift = constant + carried
    if not np.any(constant):
        return geometry, arms, (), shift
    x, y = (float(v) for v in constant)
    if arms is None:
        return dataclasses.replace(geometry, cg_x_m=geometry.cg_x_m + x, cg_y_m=geometry.cg_y_m + y), None, (), shift
    if drive.kind == "log":
        return geometry, _with_static_part(arms, drive.robot.folder, constant), (), shift
    note = (
        f"the centre of gravity is off by ({x:+.4f}, {y:+.4f}) m from that of the table; "
        "the models' coefficients hold it, and the file's arms stay."
    )
    return geometry, arms, (note,), np.zeros_like(shift)


def _with_static_part(arms: Arms, folder: Path | None, shift: FloatArray) -> Arms:
    """``arms`` with everything but the arms moved so that the whole robot's CG moves by ``shift`` (2,) [m]."""
    model = arms_model(arms, folder)
    x, y = (float(v) for v in model.static.position + shift * (model.mass / model.static.mass))
    sigmas = np.sqrt(np.diag(model.static.covariance))
    return dataclasses.replace(
        arms,
        static_mass_kg=model.static.mass,
        static_x_m=x,
        static_y_m=y,
        static_mass_sigma_kg=float(sigmas[0]),
        static_sigma_m=float(sigmas[1]),
    )


def _corrected_clock(clock: Clock, hypothesis: Hypothesis, lidar_frame: str | None) -> Clock:
    return Clock(
        clock.wheel_time_offset_s + hypothesis.wheel_time_offset_s,
        clock.lidar_time_offset_s + (0.0 if lidar_frame is None else hypothesis.lidar_time_offset_s),
        clock.gyro_time_offset_s + hypothesis.gyro_time_offset_s,
    )


def _manual_steps(robot: Robot, h: Hypothesis, lidar_frame: str | None) -> list[str]:
    """What to correct elsewhere, one sentence each; ``lidar_frame`` is None where a reference measured the motion."""
    x, y, yaw = h.lidar_offset
    off = f"({x:+.4f} m, {y:+.4f} m, {yaw:+.4f} rad)"
    lidar_s = 0.0 if lidar_frame is None else h.lidar_time_offset_s
    reference_s = h.lidar_time_offset_s - lidar_s
    clocks = ("wheels", h.wheel_time_offset_s), ("LiDAR", lidar_s), ("IMU", h.gyro_time_offset_s)
    off_clocks = ", ".join(f"{name} {1e3 * abs(s):.0f} ms {'late' if s > 0.0 else 'early'}" for name, s in clocks if s)
    law = _law(robot, h)
    steps = (
        (
            any(h.lidar_offset) and lidar_frame is not None,
            f"move {lidar_frame} by {off} where /tf_static comes from: a log's transforms go before [mounts].",
        ),
        (
            any(h.lidar_offset) and lidar_frame is None,
            f"the reference tracks a frame at {off} of the body: move the marker by the opposite, or transform its poses.",
        ),
        (reference_s, f"shift the reference's stamps by {-1e3 * reference_s:+.0f} ms, or synchronize its clock."),
        (off_clocks, f"stamps of {off_clocks}: [clock] corrects them; synchronize the clocks or correct the driver, and remove it."),
        (h.wheel_lag_s, f"the body follows the wheels {1e3 * h.wheel_lag_s:.0f} ms late."),
        (h.gyro_bias, f"the gyro's bias is {h.gyro_bias:+.5f} rad/s; let the driver zero it while the robot stands."),
        (h.gyro_scale, f"divide the gyro's rates by {1.0 + h.gyro_scale:.4f} in its driver."),
        (h.range_scale, f"divide the LiDAR's ranges by {1.0 + h.range_scale:.4f} in its driver."),
        (h.range_bias_m, f"subtract {h.range_bias_m:+.3f} m from the LiDAR's ranges in its driver."),
        (
            h.wheel_radius_drift,
            f"the wheels' radius changed by {100.0 * h.wheel_radius_drift:+.1f} % over the drive: check the tyres.",
        ),
        (h.split_friction, f"the left wheels grip {100.0 * h.split_friction:+.0f} % more than the right ones: compare the tyres' treads."),
        (any(h.slope), f"this drive's floor is not level ({h.slope[0]:+.3f}, {h.slope[1]:+.3f} rad); that is not the robot's."),
        (h.encoder_loss, f"an encoder loses counts in {100.0 * h.encoder_loss:.1f} % of the time: check its cable."),
        (h.friction_change, f"the floor's grip changed at {h.friction_change_at_s:.0f} s; one robot file cannot hold both."),
        (
            h.other_contact_law,
            f"the tyres follow the other law by {100.0 * h.other_contact_law:.0f} %; [models.friction] has contact = {law!r}.",
        ),
    )
    return [text for is_found, text in steps if is_found]


def _friction(robot: Robot, hypothesis: Hypothesis) -> dict[str, float]:
    """The friction model takes the causes of the floor as they are."""
    model = FrictionModel.from_robot(robot)
    values = dict(zip(model.param_names, (float(v) for v in model.nominal), strict=True))
    values["wheel_radius"] *= 1.0 + 0.5 * (hypothesis.left_radius_scale + hypothesis.right_radius_scale)
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


def _matched(
    predictor: DrivePredictor, hypothesis: Hypothesis, new: Robot, name: str, shift: FloatArray, free: tuple[str, ...] = ()
) -> dict[str, float]:
    """Coefficients of model ``name`` under the ``new`` robot that give the old one's twists plus what the hypothesis changes; those of
    ``free`` alone, or all."""
    batch = predictor.batch
    step = max(1, len(batch.dt) // _MAX_SAMPLES)
    rows = np.arange(0, len(batch.dt), step)
    factors = new.geometry.radius_multipliers / predictor.drive.robot.geometry.radius_multipliers
    rates, cg = batch.wheels[rows] * factors, batch.cg[rows]
    old: MotionModel = make_model(name, predictor.drive.robot)
    wanted = dataclasses.replace(predictor, model=old, has_inertia=False).corrected_twist(hypothesis)[rows]
    model: MotionModel = make_model(name, new)
    params = model.nominal.copy()
    is_free = np.array([not free or param in free for param in model.param_names])
    weight = np.array([1.0, 1.0, _TURN_M])
    size = np.maximum(np.abs(params), 0.05)
    scale = float(np.sqrt(np.mean(wanted**2))) or 1.0
    anchor = np.eye(len(params)) * _ANCHOR_WEIGHT * scale * np.sqrt(len(rows)) * _TWIST**0.5
    valid = params
    for _ in range(_ROUNDS):
        try:
            twist = model.twist(rates, cg + shift[rows], params)
        except (CgError, ModelError):  # no coefficients that a robot can have give such twists
            return dict(zip(model.param_names, (float(v) for v in valid), strict=True))
        valid = params
        off = ((wanted - twist.value) * weight).ravel()
        slopes = (twist.d_params * weight[:, None]).reshape(-1, len(params)) * size * is_free
        design = np.vstack([slopes, anchor])
        target = np.r_[off, anchor @ ((model.nominal - params) / size)]
        change = np.linalg.lstsq(design, target, rcond=None)[0]
        params = params + change * size
        if np.abs(change).max() < 1e-10:
            break
    return dict(zip(model.param_names, (float(v) for v in params), strict=True))
