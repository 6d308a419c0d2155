"""Causes in the wheels: their radii, their encoders, and what the body does of their motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Hypothesis, add
from motion_models.friction import FrictionModel

_FILE = "than the robot file has it"


def _add_radii(left: float, right: float) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(
        b, left_radius_scale=b.left_radius_scale + left * s, right_radius_scale=b.right_radius_scale + right * s
    )


def _correct_radius(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    """Radius of all wheels."""
    g, models = draft.robot.geometry, draft.robot.models
    own = {name: v * (1.0 + size) if name == "wheel_radius" else v for name, v in models.get(FrictionModel.name, {}).items()}
    models = {**models, **({FrictionModel.name: own} if own else {})}
    return draft.with_robot(geometry=dataclasses.replace(g, wheel_radius_m=g.wheel_radius_m * (1.0 + size)), models=models)


def _correct_difference(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    """Multipliers of both sides, whose mean is kept."""
    g = draft.robot.geometry
    left, right = g.left_wheel_radius_multiplier * (1.0 + 0.5 * size), g.right_wheel_radius_multiplier * (1.0 - 0.5 * size)
    return draft.with_robot(geometry=dataclasses.replace(g, left_wheel_radius_multiplier=left, right_wheel_radius_multiplier=right))


WHEEL_RADIUS_SCALE = Cause(
    "wheel_radius_scale",
    *("1", "all wheels roll farther by this share than by the robot file", 0.02, 0.002, _add_radii(1.0, 1.0)),
    (f"all wheels roll {{}} farther {_FILE}", f"all wheels roll {{}} less far {_FILE}"),
    correct=_correct_radius,
    remedy="check the tyres' pressure, or set wheel_radius_m = {g.wheel_radius_m:.4f}",
)
WHEEL_RADIUS_DIFFERENCE = Cause(
    "wheel_radius_difference",
    *("1", "the left wheels are larger by half of this share, the right ones smaller", 0.02, 0.001, _add_radii(0.5, -0.5)),
    ("the left wheels are {} larger than the right ones", "the left wheels are {} smaller than the right ones"),
    correct=_correct_difference,
    remedy="inflate the smaller tyres, or set left_wheel_radius_multiplier = {g.left_wheel_radius_multiplier:.4f} and "
    "right_wheel_radius_multiplier = {g.right_wheel_radius_multiplier:.4f}",
    applies=lambda s: s.kind != "runs",
    is_shown_by_headings=True,
)
WHEEL_RADIUS_DRIFT = Cause(
    "wheel_radius_drift",
    *("1", "all wheels grow by this share from the drive's start to its end", 0.02, 0.003, add("wheel_radius_drift")),
    ("all wheels grow by {} from the drive's start to its end", "all wheels shrink by {} from the drive's start to its end"),
    correct=lambda d, s: d.with_step(f"the wheels' radius changed by {100.0 * s:+.1f} % over the drive: check the tyres."),
    remedy="check the tyres' pressure: one of them may lose air",
    applies=lambda s: s.kind == "log",
)
ENCODER_DROPOUT = Cause(
    "encoder_dropout",
    *("1", "share of its rolling time in which an encoder loses its counts", 0.1, 0.001, add("encoder_loss")),
    ("an encoder loses its counts in {} of its rolling time", "{} fewer counts are lost"),
    correct=lambda d, s: d.with_step(f"an encoder loses counts in {100.0 * s:.1f} % of the time: check its cable."),
    remedy="check the cables of the wheels' encoders",
    applies=lambda s: s.has_dropouts and s.kind != "runs",
    is_shown_by_headings=True,
    one_sided=True,
)
FROZEN_ENCODER = dataclasses.replace(ENCODER_DROPOUT, inject=lambda b, s: b)
"""An encoder whose loss was counted, and replaced, where the log was read."""
WHEEL_LAG = Cause(
    "wheel_lag",
    *("s", "the body follows the wheels with this time constant", 0.05, 0.008, add("wheel_lag_s")),
    ("the body follows the wheels with a time constant of {}", "the body leads the wheels by {}"),
    correct=lambda d, s: d.with_step(f"the body follows the wheels {1e3 * s:.0f} ms late."),
    applies=lambda s: s.is_of_windows,
    one_sided=True,
)
MISSING_MESSAGES = Cause(
    "missing_joint_messages",
    *("1", "share of the wheels' messages that are missing", 0.1, 0.02, lambda b, s: b),
    ("{} of the wheels' messages are missing", "{} of the wheels' messages are missing"),
    remedy="check the driver of the wheels and the network",
    one_sided=True,
)
"""Counted by the gaps between stamps, not estimated from the motion."""
