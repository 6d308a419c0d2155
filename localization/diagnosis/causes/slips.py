"""Causes that grow with speed or with turning beyond what a model has, without a physical part of the robot that they are of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Setting, add, add_item
from motion_models.friction import FrictionModel
from motion_models.registry import MODELS, params_of
from motion_models.terms import Term, parse_expression


def _shows_rotation(s: Setting) -> bool:
    return s.skids and s.kind != "runs" and (s.is_of_windows or not s.is_friction_model)


def _add_term(cause: str, component: str, expression: str, sign: float) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Adds the slip as a term to every model that has no parameter of its name; those with one are matched to the motion."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        models = [name for name in MODELS if cause not in {p.name for p in params_of(name)}]
        return _with_term(draft, models, Term(component, parse_expression(expression), sign * size))

    return correct


def _with_term(draft: CorrectionDraft, models: list[str], term: Term) -> CorrectionDraft:
    """The draft with ``term`` in each of the ``models``, on top of the same term of the file."""
    terms = dict(draft.robot.terms)
    for model in models:
        same = {t.name: t for t in terms.get(model, ())}
        old = same.get(term.name)
        same[term.name] = term if old is None else dataclasses.replace(old, value=old.value + term.value)
        terms[model] = tuple(same.values())
    return draft.with_robot(terms=terms)


LATERAL_SLIP_SPEED = Cause(
    "lateral_slip_speed",
    *("s", "the robot slides sideways in curves: vy += s vx wz", 0.05, 0.005, add_item("slip_coefficients", 0)),
    ("the robot slides to the inside of curves: vy += {} vx wz", "the robot slides to the outside of curves: vy -= {} vx wz"),
    correct=_add_term("lateral_slip_speed", "vy", "v*wz", 1.0),
    applies=lambda s: s.is_timed_with_positions,
)
ROTATION_SLIP_SPEED = Cause(
    "rotation_slip_speed",
    *("s/m", "the robot turns less at speed: wz *= 1 - s |vx|", 0.1, 0.01, add_item("slip_coefficients", 1)),
    ("the robot turns less at speed: wz *= 1 - {} |vx|", "the robot turns more at speed: wz *= 1 + {} |vx|"),
    correct=_add_term("rotation_slip_speed", "wz", "abs(v)*wz", -1.0),
    applies=lambda s: s.is_timed,
    by_skidding=True,
    is_shown_by_headings=True,
)
LONGITUDINAL_SLIP_TURNING = Cause(
    "longitudinal_slip_turning",
    *("s/rad", "the robot goes less far in turns: vx *= 1 - s |wz|", 0.1, 0.01, add_item("slip_coefficients", 2)),
    ("the robot goes less far in turns: vx *= 1 - {} |wz|", "the robot goes farther in turns: vx *= 1 + {} |wz|"),
    correct=_add_term("longitudinal_slip_turning", "vx", "v*abs(wz)", -1.0),
    applies=lambda s: s.is_timed_with_positions,
)
LONGITUDINAL_SLIP_CURVATURE = Cause(
    "longitudinal_slip_curvature",
    *("1", "the robot goes less far on tight arcs, at any speed: vx *= 1 - s T", 0.2, 0.02, add("longitudinal_curvature_slip")),
    ("the robot goes less far on tight arcs: vx *= 1 - {} T", "the robot goes farther on tight arcs: vx *= 1 + {} T"),
    applies=lambda s: s.is_of_windows,
)
ROTATION_SCALE = Cause(
    "rotation_scale",
    *("1", "the robot turns farther than predicted by this share, at any speed", 0.1, 0.01, add_item("rotation_coefficients", 0)),
    ("the robot turns {} more than the model predicts, at any speed", "the robot turns {} less than the model predicts, at any speed"),
    correct=lambda d, s: _with_term(d, [FrictionModel.name], Term("wz", parse_expression("wz"), s)),  # others turn by a coefficient
    applies=_shows_rotation,
    is_shown_by_headings=True,
    largest_share=1.0,  # rotations differ from the geometry's by up to all of it on skid-steer robots
)
ROTATION_SLIP_RATE = Cause(
    "rotation_slip_rate",
    *("s/rad", "the robot turns less the faster it turns: wz *= 1 - s |wz|", 0.1, 0.01, add_item("rotation_coefficients", 1)),
    ("the robot turns less the faster it turns: wz *= 1 - {} |wz|", "the robot turns more the faster it turns: wz *= 1 + {} |wz|"),
    correct=_add_term("rotation_slip_rate", "wz", "wz*abs(wz)", -1.0),
    applies=lambda s: s.is_of_windows,
    is_shown_by_headings=True,
)
ROTATION_SLIP_CURVATURE = Cause(
    "rotation_slip_curvature",
    "1",
    "the robot turns less on gentle arcs, at any speed: wz *= 1 - s (1 - T)",
    *(0.2, 0.02, add_item("rotation_coefficients", 2)),
    ("the robot turns less on gentle arcs: wz *= 1 - {} (1 - T)", "the robot turns more on gentle arcs: wz *= 1 + {} (1 - T)"),
    applies=lambda s: s.is_of_windows,
    is_shown_by_headings=True,
)
