"""Causes in the load on the wheels: a payload, and the centre of gravity."""

from __future__ import annotations

import dataclasses

import numpy as np

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Setting, add, add_item
from motion_models.se2 import FloatArray

_TOLERATED_LOAD = 0.01
"""Share of the robot's mass that is tolerated as payload: over the front edge it moves the centre of gravity of the robots that come with
skidloc by 1 to 5 mm, and 3 mm are tolerated of `cg_offset_x` [-]."""
_WEIGH = "weigh the robot (`skidloc weigh`), or set "


def _payload_of_robot(cause: Cause, setting: Setting) -> tuple[Cause, ...]:
    return (dataclasses.replace(cause, negligible=_TOLERATED_LOAD * setting.robot.geometry.mass_kg),)


def _correct_payload(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    """The robot's mass; a payload in the gripper moves with the arms, ``[arms] payload_kg``, where the log's centre of gravity is that of
    its arms, and another is at rest on the robot."""
    drive, arms, g = draft.drive, draft.robot.arms, draft.robot.geometry
    mass = g.mass_kg + size
    draft = draft.with_robot(geometry=dataclasses.replace(g, mass_kg=mass))
    carried = drive.payload_arms * (size / mass)
    if arms is not None and drive.payload_link and drive.cg_source == "arms" and arms.payload_kg + size > 0.0:
        arms = dataclasses.replace(arms, payload_kg=arms.payload_kg + size, payload_link=drive.payload_link)
        return dataclasses.replace(draft.with_robot(arms=arms), cg_shift=draft.cg_shift + carried)
    return _move_cg(draft, carried.mean(axis=0))


def _move_cg(draft: CorrectionDraft, shift: FloatArray) -> CorrectionDraft:
    """The offset ``shift`` (2,) [m] of the centre of gravity of every source: topic, arms and constant. A table has its own, which no file
    moves, and only the models' coefficients hold it."""
    g = draft.robot.geometry
    x, y = (float(v) for v in shift)
    if draft.drive.cg_source == "table":
        return draft.with_step(
            f"the centre of gravity is off by ({x:+.4f}, {y:+.4f}) m from that of the table; the models' coefficients hold it, and the "
            "file's centre of gravity stays."
        )
    draft = draft.with_robot(geometry=dataclasses.replace(g, cg_offset_x_m=g.cg_offset_x_m + x, cg_offset_y_m=g.cg_offset_y_m + y))
    return dataclasses.replace(draft, cg_shift=draft.cg_shift + shift)


PAYLOAD = Cause(
    "payload",
    *("kg", "the robot carries a mass that its file does not have", 8.0, 1.0, add("payload_kg")),
    ("the robot carries {} that its file does not have", "the robot carries {} less than its file has"),
    correct=_correct_payload,
    remedy="weigh the robot (`skidloc weigh`), and add the load to its file",
    by_skidding=True,
    variants=_payload_of_robot,
    one_sided=True,
)
CG_OFFSET_X = Cause(
    "cg_offset_x",
    *("m", "the centre of gravity lies farther ahead than given", 0.03, 0.003, add_item("cg", 0)),
    ("the centre of gravity lies {} farther ahead than given", "the centre of gravity lies {} farther back than given"),
    correct=lambda d, s: _move_cg(d, np.array([s, 0.0])),
    remedy=_WEIGH + "cg_offset_x_m = {g.cg_offset_x_m:.4f}",
    by_skidding=True,
)
CG_OFFSET_Y = Cause(
    "cg_offset_y",
    *("m", "the centre of gravity lies farther left than given", 0.02, 0.003, add_item("cg", 1)),
    ("the centre of gravity lies {} farther left than given", "the centre of gravity lies {} farther right than given"),
    correct=lambda d, s: _move_cg(d, np.array([0.0, s])),
    remedy=_WEIGH + "cg_offset_y_m = {g.cg_offset_y_m:.4f}",
    by_skidding=True,
)
