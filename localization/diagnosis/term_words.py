"""Terms in words: which parameter of the robot follows what, as "k follows the speed"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from motion_models.terms import Factor, Term

_PARAMETERS: Mapping[tuple[str, str], str] = {
    ("vx", "v"): "the wheels' radius",
    ("wz", "v"): "the difference of both sides' radii",
    ("wz", "wz"): "k, how far the robot turns,",
    ("vy", "wz"): "the centre of rotation's x",
    ("vx", "wz"): "the centre of rotation's y",
    ("vy", "v"): "the slip to the side on straight ways",
    ("vx", "dv"): "the slip of a robot that accelerates",
    ("wz", "dwz"): "the slip of a robot that begins to turn",
}
"""What a term of a motion alone changes, by component and motion."""
_SPEED, _TURNING = "the speed", "the turning rate"
MODULATORS: Mapping[tuple[str, str], str] = {
    ("cg_x", ""): "the CG's x",
    ("cg_y", ""): "the CG's y",
    ("t", ""): "the time",
    ("v", "abs"): _SPEED,
    ("wz", "abs"): _TURNING,
    ("v", ""): "the speed ahead or back",
    ("wz", ""): "the side and rate of turns",
    ("v", "sign"): "the direction of driving",
    ("wz", "sign"): "the side of turns",
    ("v", "max"): "the speed ahead alone",
    ("v", "min"): "the speed back alone",
    ("wz", "max"): "turns to the left alone",
    ("wz", "min"): "turns to the right alone",
}
"""What it follows, by variable and form."""


def describe_memory(factors: Sequence[Factor]) -> str:
    """What the past is to ``factors``, as a clause; empty without a memory."""
    words = {
        "lag": "late by a time constant of {:.2g} s",
        "swing": "swinging at {:.2g} Hz, damped by {:.2g}",
        "play": "with a hysteresis of {:.2g} to each side",
    }
    return " and ".join(words[f.form].format(*f.constants) for f in factors if f.has_memory)


def describe_parameter(term: Term) -> str:
    """The parameter that ``term`` makes follow something, as a clause; empty where the library has no words for it.

    >>> from motion_models.terms import parse_expression
    >>> describe_parameter(Term("wz", parse_expression("wz*abs(v)"), -0.1))
    'k, how far the robot turns, follows the speed'
    """
    for n, factor in enumerate(term.expression.factors):
        subject = _PARAMETERS.get((term.component, factor.variable))
        if subject is None or factor.form:
            continue
        rest = [f for k, f in enumerate(term.expression.factors) if k != n]
        if factor.power > 1:
            rest.insert(0, Factor(factor.variable, "abs" if factor.power % 2 else "", factor.power - 1))
        follows = ["how long the drive lasts" if f.form == "rise" else MODULATORS.get((f.variable, f.form), "") for f in rest]
        if follows and all(follows):
            return f"{subject} follows {' and '.join(dict.fromkeys(follows))}"
    return ""
