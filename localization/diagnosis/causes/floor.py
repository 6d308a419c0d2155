"""Causes in the contact of the wheels with the floor: the track, the friction, and the floor's slope."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

from localization.diagnosis.causes.cause import Cause, CorrectionDraft, Hypothesis, Setting, add, add_item
from motion_models.friction import FrictionModel
from motion_models.friction.contact import SATURATION
from motion_models.robot import DIFF_DRIVE, Robot

_FILE = "than the robot file has it"
_MAX_NARROWING = 0.8
"""Largest narrowing of the track of a robot with casters, as a share of it."""
_TYPICAL_TRACKS = 2.0
"""Errors of the track that are considered whatever the wheelbase, over the typical one."""
_NOT_NEGATIVE = frozenset({"rolling_resistance", "scrub"})


def _add_friction(name: str) -> Callable[[Hypothesis, float], Hypothesis]:
    return lambda b, s: dataclasses.replace(b, friction={**b.friction, name: b.friction.get(name, 0.0) + s})


def _correct_friction(name: str) -> Callable[[CorrectionDraft, float], CorrectionDraft]:
    """Writes a parameter of the friction model; a ratio of frictions is scaled, another one is added to."""

    def correct(draft: CorrectionDraft, size: float) -> CorrectionDraft:
        own = dict(draft.robot.models[FrictionModel.name])
        value = own[name] * (1.0 + size) if name == "mu_ratio" else own[name] + size
        own[name] = max(value, 0.0) if name in _NOT_NEGATIVE else value
        return draft.with_robot(models={**draft.robot.models, FrictionModel.name: own})

    return correct


def _correct_track(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    g = draft.robot.geometry
    draft = draft.with_robot(geometry=dataclasses.replace(g, track_width_m=g.track_width_m + size))
    return _correct_friction("track_width")(draft, size)


def _track_of_robot(cause: Cause, setting: Setting) -> tuple[Cause, ...]:
    """The track width of a robot, where its twin cannot be found.

    How far wheels that skid turn a robot, k r (q_r - q_l) / t with k = 1 / (1 + (W / t)^2), goes with t / (t^2 + W^2), which W^2 / t gives
    as well as t: a track has to be on the same side of the wheelbase W as the file's, and positive where wheels do not skid.
    """
    g = setting.robot.geometry
    if setting.robot.drive == DIFF_DRIVE:
        return (dataclasses.replace(cause, limits=(-_MAX_NARROWING * g.track_width_m, math.inf)),)
    middle, least = g.wheelbase_m - g.track_width_m, _TYPICAL_TRACKS * cause.typical
    limits = (min(middle, -least), math.inf) if middle < 0.0 else (-math.inf, max(middle, least))
    return (dataclasses.replace(cause, limits=limits),)


def _correct_law(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    """The contact law nearest to the mixture that was found."""
    robot = draft.robot
    saturation = FrictionModel.from_robot(robot).saturation
    share = saturation + (1.0 - 2.0 * saturation) * size
    law = min(SATURATION, key=lambda name: abs(SATURATION[name] - share))
    options = {**robot.options, FrictionModel.name: {**robot.options.get(FrictionModel.name, {}), "contact": law}}
    draft = draft.with_robot(options=options)
    return draft.with_step(f"the tyres follow the other law by {100.0 * size:.0f} %; [models.friction] has contact = {law!r}.")


_WITH_GRIP_OF_BOTH_SIDES = (-1.9, 1.9)
"""Differences by which the weaker side has a twentieth of its grip at least: at 2 it has none, which no robot file holds."""


def _correct_split(draft: CorrectionDraft, size: float) -> CorrectionDraft:
    draft = _correct_friction("split_friction")(draft, size)
    return draft.with_step(f"the left wheels grip {100.0 * size:+.0f} % more than the right ones: compare the tyres' treads.")


def _change_at(at_s: float) -> Cause:
    def inject(b: Hypothesis, s: float) -> Hypothesis:
        return dataclasses.replace(b, friction_change=b.friction_change + s, friction_change_at_s=at_s)

    from_then = f"from {at_s:.0f} s on"
    words = f"the floor grips {{}} more sideways {from_then}", f"the floor grips {{}} less sideways {from_then}"
    return Cause(
        "friction_change",
        *("1", f"sideways grip is more by this share {from_then}", 0.3, 0.04, inject, words),
        correct=lambda d, s: d.with_step(f"the floor's grip changed at {at_s:.0f} s; one robot file cannot hold both."),
        applies=_is_log_with_positions,
        by_skidding=True,
        at_s=at_s,
    )


def friction_change(at_s: float) -> Cause:
    """The sideways grip changes ``at_s`` after the drive's beginning."""
    return _change_at(at_s)


def _is_log_with_positions(s: Setting) -> bool:
    return s.kind == "log" and s.has_positions


def _level_step(draft: CorrectionDraft, along: float, across: float) -> CorrectionDraft:
    return draft.with_step(f"this drive's floor is not level ({along:+.3f}, {across:+.3f} rad); that is not the robot's.")


TRACK_WIDTH = Cause(
    "track_width",
    *("m", "the left and right contacts are farther apart by this", 0.03, 0.003, _add_friction("track_width")),
    (f"the left and right contacts are {{}} farther apart {_FILE}", f"the left and right contacts are {{}} closer together {_FILE}"),
    correct=_correct_track,
    remedy="measure the distance of the wheels, or set track_width_m = {g.track_width_m:.4f}",
    applies=lambda s: s.has_positions or not s.skids,
    is_shown_by_headings=True,
    variants=_track_of_robot,
)
FRICTION_ANISOTROPY = Cause(
    "friction_anisotropy",
    *("1", "the floor grips more sideways by this share (mu_y / mu_x)", 0.2, 0.03, _add_friction("mu_ratio")),
    (f"the floor grips {{}} more sideways {_FILE}", f"the floor grips {{}} less sideways {_FILE}"),
    correct=_correct_friction("mu_ratio"),
    by_skidding=True,
)
SPLIT_FRICTION = Cause(
    "split_friction",
    *("1", "the left wheels grip more by half of this share, the right ones less", 0.2, 0.03, add("split_friction")),
    ("the left wheels grip {} more than the right ones", "the left wheels grip {} less than the right ones"),
    correct=_correct_split,
    remedy="compare the tyres of both sides, and the floor under them",
    by_skidding=True,
    limits=_WITH_GRIP_OF_BOTH_SIDES,
)
LATERAL_FORCE_LAW = Cause(
    "lateral_force_law",
    "1",
    "the lateral force follows the other contact law by this share (isotropic: it grows with the slip; thesis: saturated at any slip)",
    *(1.0, 0.15, add("other_contact_law")),
    ("the lateral force follows the contact law that the robot file does not choose, by {}", "{} less of the other contact law"),
    correct=_correct_law,
    by_skidding=True,
    one_sided=True,
)
DIAGONAL_LOAD = Cause(
    "diagonal_load",
    *("1", "a warped chassis loads front left and rear right by this share of m g / 4", 0.15, 0.02, _add_friction("warp")),
    (
        "a warped chassis loads front left and rear right by {} of m g / 4",
        "a warped chassis loads front right and rear left by {} of m g / 4",
    ),
    correct=_correct_friction("warp"),
    remedy="check the chassis and the tyres' pressure",
    by_skidding=True,
)
TREAD_ASYMMETRY = Cause(
    "tread_asymmetry",
    *("1", "wheels that slide to the left grip more by this share", 0.15, 0.02, _add_friction("tread")),
    ("wheels that slide to the left grip {} more", "wheels that slide to the left grip {} less"),
    correct=_correct_friction("tread"),
    applies=lambda s: s.kind != "runs",
    by_skidding=True,
)
ROLLING_RESISTANCE = Cause(
    "rolling_resistance",
    *("1", "rolling resistance over load is more by this", 0.03, 0.004, _add_friction("rolling_resistance")),
    ("rolling resistance is more, by {} of the load", "rolling resistance is less, by {} of the load"),
    correct=_correct_friction("rolling_resistance"),
    by_skidding=True,
)
SCRUB = Cause(
    "scrub",
    *("m", "the contact patches oppose any turn by this moment, over mu m g", 0.02, 0.002, _add_friction("scrub")),
    ("the contact patches oppose any turn more, by {} times mu m g", "the contact patches oppose any turn less, by {} times mu m g"),
    correct=_correct_friction("scrub"),
    by_skidding=True,
)
SLOPE_ALONG = Cause(
    "slope",
    *("rad", "the floor rises along the drive's first heading", 0.05, 0.005, add_item("slope", 0)),
    ("the floor rises by {} along the drive's first heading", "the floor falls by {} along the drive's first heading"),
    correct=lambda d, s: _level_step(d, s, 0.0),
    applies=lambda s: s.is_timed,
    by_skidding=True,
    axis="along",
)
SLOPE_ACROSS = Cause(
    "slope",
    *("rad", "the floor rises to the left of the drive's first heading", 0.05, 0.005, add_item("slope", 1)),
    (
        "the floor rises by {} to the left of the drive's first heading",
        "the floor rises by {} to the right of the drive's first heading",
    ),
    correct=lambda d, s: _level_step(d, 0.0, s),
    applies=_is_log_with_positions,
    by_skidding=True,
    at_s=-1.0,
    axis="across",
)
FRICTION_CHANGE = dataclasses.replace(
    _change_at(0.0), variants=lambda _, setting: tuple(_change_at(at_s) for at_s in setting.change_times_s)
)


LOG_STIFFNESS_SIGMA = 1.0
"""Sigma of the logarithm of the slip stiffness, whatever the floor: a factor of 3 either way."""
STIFFNESS_EXPONENT_SIGMA = 0.5
"""Sigma of the power with which the stiffness grows with speed: 0 for tyres by way, 1 for contacts by rate (`friction_response`)."""


def slip_stiffness_cause(robot: Robot) -> Cause:
    """Slip stiffness of the tyres, relative to the robot file's; as a logarithm, which keeps it positive."""
    nominal = float(FrictionModel.from_robot(robot).nominal[FrictionModel.param_names.index("slip_stiffness")])

    def inject(b: Hypothesis, size: float) -> Hypothesis:
        now = nominal + b.friction.get("slip_stiffness", 0.0)
        return dataclasses.replace(b, friction={**b.friction, "slip_stiffness": now * math.exp(size) - nominal})

    words = "the tyres' slip stiffness is {} more", "the tyres' slip stiffness is {} less"
    meaning = "the slip stiffness of the tyres is more by this share"
    return Cause("slip_stiffness", "1", meaning, 0.3, 0.03, inject, words, prior_sigma=LOG_STIFFNESS_SIGMA)


def stiffness_exponent_cause() -> Cause:
    """How the slip stiffness grows with the wheels' speed."""

    def inject(b: Hypothesis, size: float) -> Hypothesis:
        return dataclasses.replace(b, stiffness_exponent=b.stiffness_exponent + size)

    words = "the tyres' slip stiffness grows with speed, by the power {}", "the tyres' slip stiffness falls with speed, by the power {}"
    meaning = "power of the wheels' speed with which the slip stiffness grows"
    return Cause("stiffness_exponent", "1", meaning, 0.5, 0.1, inject, words, prior_sigma=STIFFNESS_EXPONENT_SIGMA)
