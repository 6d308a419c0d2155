"""Causes that show where a force acts at the centre of gravity: its height, and the floor's grip.

On a slope the vertical through the centre of gravity (CG) intersects the floor h tan(tilt) farther downhill, and the pull along the floor
counts over mu. On a level floor the centripetal force m v wz does both in curves, and a change of speed shifts loads as well.
"""

from __future__ import annotations

import dataclasses
import math

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Hypothesis, Setting, add
from motion_models.friction import FrictionModel

_LEAST_HEIGHT = 0.2
"""Least height of the CG, as a share of the file's."""
_LOG_GRIP_SIGMA = 0.4
"""Sigma of the logarithm of mu: from wet grass to dry concrete, .4 to .9 (Wong 2008, Theory of Ground Vehicles, table 1.3)."""
_MU = FrictionModel.param_names.index("mu")


def _is_seen(s: Setting) -> bool:
    """On slopes; and in curves beside a healthy drive, without which errors of the contacts look like a height: of a healthy Jackal in
    MuJoCo 0.36 m."""
    return s.is_on_slope or (s.has_baseline and s.kind == "log" and s.has_positions and s.is_friction_model)


def _height_of_robot(cause: Cause, setting: Setting) -> tuple[Cause, ...]:
    """The height of a robot's CG, which lies above the floor."""
    height = setting.robot.geometry.cg_height_m
    return (dataclasses.replace(cause, limits=(-(1.0 - _LEAST_HEIGHT) * height, math.inf)),)


def _correct_height(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    g = draft.robot.geometry
    return draft.with_robot(geometry=dataclasses.replace(g, cg_height_m=g.cg_height_m + size))


def _grip_of_robot(cause: Cause, setting: Setting) -> tuple[Cause, ...]:
    """Grip of the floor, relative to the robot file's; as a logarithm, which keeps it positive."""
    nominal = float(FrictionModel.from_robot(setting.robot).nominal[_MU])

    def inject(b: Hypothesis, size: float) -> Hypothesis:
        now = nominal + b.friction.get("mu", 0.0)
        return dataclasses.replace(b, friction={**b.friction, "mu": now * math.exp(size) - nominal})

    return (dataclasses.replace(cause, inject=inject),)


def _correct_grip(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    own = dict(draft.robot.models[FrictionModel.name])
    own["mu"] *= math.exp(size)
    return draft.with_robot(models={**draft.robot.models, FrictionModel.name: own})


CG_HEIGHT = Cause(
    "cg_height",
    *("m", "the centre of gravity lies higher than in the robot file; it shows on slopes and in fast curves", 0.1, 0.02, add("cg_height")),
    ("the centre of gravity lies {} higher than the robot file has it", "the centre of gravity lies {} lower than the robot file has it"),
    correct=_correct_height,
    remedy="weigh the robot on a slope (`skidloc weigh`), or set cg_height_m = {g.cg_height_m:.3f}",
    applies=_is_seen,
    by_skidding=True,
    variants=_height_of_robot,
)
GRIP = Cause(
    "grip",
    *(
        "1",
        "the floor grips more in all directions, by this logarithm of mu; it shows on slopes and in fast curves",
        0.3,
        0.05,
        lambda b, s: b,
    ),
    ("the floor grips {} more in all directions", "the floor grips {} less in all directions"),
    correct=_correct_grip,
    remedy="on this floor, set [models.friction] mu",
    applies=_is_seen,
    by_skidding=True,
    variants=_grip_of_robot,
    prior_sigma=_LOG_GRIP_SIGMA,
)
SHOWN_BY_FORCES = (CG_HEIGHT.id, GRIP.id)
"""Causes that level drives at usual speeds hardly show, and are not asked to."""
