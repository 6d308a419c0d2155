"""Findings as a robot: each cause writes its own correction, and the coefficients of every model are matched to the corrected motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Hypothesis, with_sizes
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import Finding
from motion_models.base import MotionModel
from motion_models.errors import CgError, ModelError
from motion_models.friction import FrictionModel
from motion_models.registry import MODELS, make_model, params_of
from motion_models.robot import Robot
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
    """What a robot file cannot hold, and where to correct it instead."""
    cg_shift: FloatArray
    """(N, 2) by which the new file moves the centre of gravity in each interval of the drive [m]."""


def correct_robot(predictor: DrivePredictor, sizes: Mapping[Cause, float], names: Collection[str] = MODELS) -> CorrectedRobot:
    """The drive's robot where causes have these ``sizes``: what each writes into the file, and where the robot's motion changes the
    coefficients of the models ``names``, matched to the corrected motion on the drive's own wheels."""
    robot, drive = predictor.drive.robot, predictor.drive
    friction = FrictionModel.from_robot(robot)
    own = dict(zip(friction.param_names, (float(v) for v in friction.nominal), strict=True))
    start = dataclasses.replace(robot, models={**robot.models, friction.name: own})
    draft = CorrectionDraft(start, drive, np.zeros((len(predictor.batch.dt), 2)))
    for cause, size in sizes.items():
        draft = draft if cause.correct is None else cause.correct(draft, size)
    lasting = with_sizes(sizes).without_passing()
    if lasting.of_robot() == Hypothesis():
        models = robot.models
    else:
        new, models = draft.robot, dict(draft.robot.models)
        for name in names:
            if name != friction.name:
                models[name] = _matched(predictor, lasting, new, name, draft.cg_shift)
            elif any(lasting.key("twist")) or lasting.changed_rates:
                models[name] = _matched(predictor, lasting, new, name, draft.cg_shift, ("track_width",))
    return CorrectedRobot(dataclasses.replace(draft.robot, models=models), draft.steps, draft.cg_shift)


def is_held(predictor: DrivePredictor, finding: Finding) -> bool:
    """Whether a robot file holds what corrects ``finding``; else it is to be corrected in a driver, or was of this drive alone."""
    corrected = correct_robot(predictor, {finding.definition: finding.size})
    return corrected.robot != predictor.drive.robot


def predictor_after(predictor: DrivePredictor, corrected: CorrectedRobot, name: str) -> DrivePredictor:
    """The drive as model ``name`` of the ``corrected`` robot predicts it: wheels and centre of gravity are those that its file gives."""
    drive = predictor.drive
    factors = corrected.robot.geometry.radius_multipliers / drive.robot.geometry.radius_multipliers
    shifts = np.split(corrected.cg_shift, np.cumsum([len(m.wheels) for m in drive.maneuvers])[:-1])
    maneuvers = tuple(
        dataclasses.replace(m, wheels=m.wheels * factors, cg=m.cg + shift) for m, shift in zip(drive.maneuvers, shifts, strict=True)
    )
    corrected_drive = dataclasses.replace(drive, robot=corrected.robot, maneuvers=maneuvers)
    model = make_model(name, corrected.robot)
    return DrivePredictor(corrected_drive, model, has_inertia=predictor.has_inertia, baseline=predictor.baseline)


def held_shares(predictor: DrivePredictor, sizes: Mapping[Cause, float], names: Sequence[str] = ()) -> dict[str, float]:
    """Share of what causes of these ``sizes`` change in the predicted motion that the corrected robot's file holds, by model name.

    1 - |r_file - r_causes| / |r_old - r_causes| with the discrepancies r of the drive by the old file, under the causes, and by the
    corrected file, and the Euclidean norm over positions [m] and headings times 0.3 m. 1: the file moves as the causes make the robot
    move; 0: it changes nothing; below 0: it makes it worse. Empty where the causes do not change the motion.
    """
    of_robot, corrected = with_sizes(sizes).of_robot(), correct_robot(predictor, sizes)
    shares, weight = {}, np.array([1.0, 1.0, _TURN_M])
    for name in names or MODELS:
        before = dataclasses.replace(predictor.by_file, model=make_model(name, predictor.drive.robot))
        after = predictor_after(predictor, corrected, name)
        wanted, old, new = before.discrepancies(of_robot), before.discrepancies(Hypothesis()), after.discrepancies(Hypothesis())
        change, left = (float(np.linalg.norm(np.nan_to_num((rows - wanted)[:, :3]) * weight)) for rows in (old, new))
        if change > 0.0:
            shares[name] = 1.0 - left / change
    return shares


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
    own = tuple(p.name for p in params_of(name))
    is_free = np.array([param in own and (not free or param in free) for param in model.param_names])
    weight = np.array([1.0, 1.0, _TURN_M])
    size = np.maximum(np.abs(params), 0.05)
    scale = float(np.sqrt(np.mean(wanted**2))) or 1.0
    anchor = np.eye(len(params)) * _ANCHOR_WEIGHT * scale * np.sqrt(len(rows)) * _TWIST**0.5
    best, least = params, np.inf
    for _ in range(_ROUNDS):
        try:
            twist = model.twist(rates, cg + shift[rows], params)
        except (CgError, ModelError):  # no coefficients that a robot can have give such twists
            break
        off = ((wanted - twist.value) * weight).ravel()
        if off @ off < least:
            best, least = params, float(off @ off)
        slopes = (twist.d_params * weight[:, None]).reshape(-1, len(params)) * size * is_free
        design = np.vstack([slopes, anchor])
        target = np.r_[off, anchor @ ((model.nominal - params) / size)]
        change = np.linalg.lstsq(design, target, rcond=None)[0]
        params = params + change * size
        if np.abs(change).max() < 1e-10:
            break
    return dict(zip(own, (float(v) for v in best), strict=False))
