"""Parameters of the robot that follow something: each parameter times each modulator, as terms that one coefficient moves together.

A left tyre that is smaller under load moves the robot ahead and turns it: its law is in several terms, of which none is all of it. With the
effective track W (wheels that roll apart by W wz turn the robot by wz), a relative change e of one side's radius changes the twist by

    left:   (v - W wz / 2) (e / 2, 0, -e / W)
    right:  (v + W wz / 2) (e / 2, 0, +e / W)

and a modulator m, as the CG's y or the speed, multiplies e. One coefficient is cheaper than several that agree by chance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from localization.diagnosis.term_words import MODULATORS, describe_parameter
from motion_models.terms import Expression, Term, parse_expression


class Part(NamedTuple):
    """A term of a law, whose coefficient is ``factor`` times that of the law."""

    component: str
    expression: Expression
    factor: float


@dataclass(frozen=True)
class Law:
    """A term, with those that the same parameter moves, and their common coefficient."""

    component: str
    expression: Expression
    value: float = 0.0
    sigma: float = 0.0
    tied: tuple[Part, ...] = ()
    """Further terms of the parameter; empty for a term by itself."""
    parameter: str = ""
    """What follows what, as "left_radius x cg_y"; empty for a term by itself."""

    @property
    def term(self) -> Term:
        """The first term, with the coefficient."""
        return Term(self.component, self.expression, self.value, self.sigma)

    @property
    def terms(self) -> tuple[Term, ...]:
        """All terms, as a robot file holds them."""
        more = (Term(p.component, p.expression, p.factor * self.value, abs(p.factor) * self.sigma) for p in self.tied)
        return (self.term, *more)

    @property
    def parts(self) -> tuple[Part, ...]:
        """All terms at a coefficient of 1."""
        return (Part(self.component, self.expression, 1.0), *self.tied)

    @property
    def name(self) -> str:
        """The parameter and what it follows, or the term."""
        return self.parameter or self.term.name

    @property
    def words(self) -> str:
        """What it is to a roboticist, as a clause; empty for a term that has none."""
        if not self.parameter:
            return describe_parameter(self.term)
        name, _, modulator = self.parameter.partition(" x ")
        return f"{PARAMETERS[name].words} follows {_MODULATORS[modulator]}"

    def with_value(self, value: float, sigma: float = 0.0) -> Law:
        """The law with this coefficient."""
        return dataclasses.replace(self, value=value, sigma=sigma)


class Parameter(NamedTuple):
    """A parameter that moves several components of the twist."""

    words: str
    motions: Callable[[float], Sequence[tuple[str, str, float]]]
    """Component, motion and factor of each term for the effective track [m], the first with a factor of 1."""
    modulators: tuple[str, ...]


_POSTURE, _MOTION, _SIDES = ("cg_x", "cg_y"), ("abs(v)", "abs(wz)", "sign(v)"), ("v", "wz", "sign(wz)")
PARAMETERS: Mapping[str, Parameter] = {
    "wheel_radius": Parameter("the radius of all wheels", lambda w: (("vx", "v", 1.0), ("wz", "wz", 1.0)), (*_POSTURE, *_MOTION)),
    "radius_difference": Parameter(
        "the difference of both sides' radii",
        lambda w: (("wz", "v", 1.0), ("vx", "wz", 0.25 * w**2)),
        (*_POSTURE, *_MOTION, *_SIDES),
    ),
    "left_radius": Parameter(
        "the left wheels' radius",
        lambda w: (("wz", "v", 1.0), ("vx", "v", -0.5 * w), ("wz", "wz", -0.5 * w), ("vx", "wz", 0.25 * w**2)),
        (*_POSTURE, *_MOTION, *_SIDES),
    ),
    "right_radius": Parameter(
        "the right wheels' radius",
        lambda w: (("wz", "v", 1.0), ("vx", "v", 0.5 * w), ("wz", "wz", 0.5 * w), ("vx", "wz", 0.25 * w**2)),
        (*_POSTURE, *_MOTION, *_SIDES),
    ),
    "wheel_clock": Parameter("the wheels' clock", lambda w: (("vx", "dv", 1.0), ("wz", "dwz", 1.0)), ("abs(v)", "abs(wz)")),
}
_MODULATORS: Mapping[str, str] = {
    text: MODULATORS[factor.variable, factor.form]
    for parameter in PARAMETERS.values()
    for text in parameter.modulators
    for factor in parse_expression(f"dv*{text}").factors
    if factor.variable != "dv"
}
"""Words by text of a modulator."""


def parameter_laws(effective_track_m: float, has_posture: bool) -> list[Law]:
    """Laws of all parameters; those of the posture only where the drive ``has_posture`` that changes."""
    found = []
    for name, parameter in PARAMETERS.items():
        for modulator in parameter.modulators:
            if modulator in _POSTURE and not has_posture:
                continue
            first, *more = (
                Part(component, _product(motion, modulator), factor) for component, motion, factor in parameter.motions(effective_track_m)
            )
            found.append(Law(first.component, first.expression, tied=tuple(more), parameter=f"{name} x {modulator}"))
    return found


def _product(motion: str, modulator: str) -> Expression:
    """``motion`` times ``modulator``; its own sign makes it a magnitude."""
    return parse_expression(f"abs({motion})" if modulator == f"sign({motion})" else f"{motion}*{modulator}")
