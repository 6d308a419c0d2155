"""Learned terms of a motion model: what is added to a component of its twist, read from the robot's file.

    [models.skid_steer.terms]
    vy = {"wz*abs(wz)" = [-0.12, 0.01, "m s"]}      # vy = the model's + c wz |wz| with c = -0.12 +- 0.01 m s

A term is a coefficient times a product of `VARIABLES`, each as it is, to a power (v^2), or in abs() or sign(); max(wz,0) is what acts in
left turns alone, min(wz,0) in right ones; rise(t,T) is what warms up with the time constant T [s], 1 - exp(-t/T). Factors with a memory
are lag(wz,T), swing(v,f,d) and play(wz,r) (`motion_models.term_memory`): what follows late, swings, or stays behind by r. Its sigma is that
of the coefficient, and the unit may be left out. Terms are zero at rest, but for what fades: at least one factor is a motion.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from motion_models.errors import RobotError
from motion_models.se2 import FloatArray
from motion_models.term_memory import CONSTANTS, SampleSeries, respond

COMPONENTS = ("vx", "vy", "wz")
"""Components of the twist, in the order of `Twist.value`."""
_MAX_POWER = 4
"""Largest power of a variable: higher ones of noisy rates are noise."""
_LARGEST = 1e6
"""Largest coefficient, in SI units."""
_LIMITS: Mapping[str, tuple[tuple[float, float], ...]] = {"rise": ((0.1, 1e5),), **CONSTANTS}
"""Least and largest constants by form: of a rise its time constant [s], a sample, and more than a day."""
MOST_TERMS = 32
"""Most terms of one model: each is a parameter that the filter may correct."""


class Variable(NamedTuple):
    """What a term may depend on."""

    meaning: str
    metres: int
    """Powers of metre and second in its unit; radians are 1."""
    seconds: int
    mirror: int
    """Sign that it takes on for a robot seen in a mirror along its x axis; 0 where it becomes another variable."""
    is_motion: bool
    """Whether it is zero at rest."""
    typical: float
    """Its size on an ordinary drive, in its unit."""


VARIABLES: Mapping[str, Variable] = {
    "v": Variable("speed ahead by the model without terms [m/s]", 1, -1, 1, True, 0.5),
    "wz": Variable("yaw rate by the model without terms [rad/s]", 0, -1, -1, True, 0.5),
    "left": Variable("rate of the left wheels [rad/s]", 0, -1, 0, True, 3.0),
    "right": Variable("rate of the right wheels [rad/s]", 0, -1, 0, True, 3.0),
    "dv": Variable("change of v [m/s^2]", 1, -2, 1, True, 0.5),
    "dwz": Variable("change of wz [rad/s^2]", 0, -2, -1, True, 1.0),
    "cg_x": Variable("centre of gravity ahead of the middle [m]", 1, 0, 1, False, 0.05),
    "cg_y": Variable("centre of gravity left of the middle [m]", 1, 0, -1, False, 0.05),
    "t": Variable("time since the drive began [s]", 0, 1, 1, False, 60.0),
}
"""Variables of terms. Changes and time need samples in order of time (`in_series`); without, changes and time are 0."""

_MATTERS = 0.05
"""Change of a component of the twist that matters [m/s, rad/s]: a tenth of an ordinary speed."""
_NAMES = tuple(VARIABLES)
_SYNONYMS = {
    **dict.fromkeys(("vx", "speed", "velocity", "linear"), "v"),
    **dict.fromkeys(("omega", "w", "yaw_rate", "yawrate", "rate", "angular", "vyaw"), "wz"),
    **dict.fromkeys(("ax", "a", "acceleration", "accel"), "dv"),
    **dict.fromkeys(("alpha", "angular_acceleration", "dw", "domega"), "dwz"),
    **dict.fromkeys(("wl", "omega_l", "left_wheel"), "left"),
    **dict.fromkeys(("wr", "omega_r", "right_wheel"), "right"),
    **dict.fromkeys(("x_cg", "cgx", "com_x"), "cg_x"),
    **dict.fromkeys(("y_cg", "cgy", "com_y"), "cg_y"),
    "time": "t",
}
"""Other names of the variables, for errors that name the nearest one."""
_FORMS = ("", "abs", "sign", "max", "min")
"""Forms of a variable, in the order in which expressions have them; max and min are of the variable and 0."""
_FACTOR = re.compile(r"(?:(abs|sign)\(([a-z_]+)\)|(max|min)\(([a-z_]+),0\)|([a-z_]+))(?:(?:\^|\*\*)(\d+))?")
_WITH_CONSTANTS = re.compile(r"(rise|lag|swing|play)\((.*)\)")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_CONSTANT_WORDS = {
    "rise": "a time constant of {} s",
    "lag": "a time constant of {} s",
    "swing": "a frequency of {} Hz and a damping ratio of {}",
    "play": "half the width of {} in its unit",
}
_EXAMPLES = {"rise": "rise(t,30)", "lag": "lag(wz,0.4)", "swing": "swing(v,0.8,0.2)", "play": "play(wz,0.1)"}


class Factor(NamedTuple):
    """One factor of an expression."""

    variable: str
    form: str
    """Empty, abs, sign, max, min, rise, lag, swing or play."""
    power: int
    constants: tuple[float, ...] = ()
    """Constants of a rise, or of what has a memory."""

    @property
    def has_memory(self) -> bool:
        """Whether it depends on the samples before."""
        return self.form in CONSTANTS

    @property
    def is_one_sided(self) -> bool:
        """Whether it acts on one side of 0 alone."""
        return self.form in ("max", "min")

    @property
    def mirror(self) -> int:
        """Its sign for a robot seen in a mirror; 0 where it becomes another factor."""
        sign = VARIABLES[self.variable].mirror
        if self.form == "abs" and sign:
            return 1
        return 0 if self.is_one_sided and sign != 1 else sign**self.power

    def __str__(self) -> str:
        if self.constants:
            return f"{self.form}({self.variable},{','.join(f'{c:.4g}' for c in self.constants)})"
        other = ",0" if self.is_one_sided else ""
        name = f"{self.form}({self.variable}{other})" if self.form else self.variable
        return name if self.power == 1 else f"{name}^{self.power}"

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value and derivative by the variable ``x`` (n,), in steady motion; at kinks the derivative is the mean of both sides', and what
        has a memory has none: its past is an input."""
        if self.has_memory:
            return respond(self.form, self.constants, x, None), np.zeros_like(x)
        if self.form == "rise":
            left = np.exp(-x / self.constants[0])
            return np.asarray(1.0 - left), np.asarray(left / self.constants[0])
        if self.form == "sign":
            return np.asarray(np.sign(x) ** self.power), np.zeros_like(x)
        if self.is_one_sided:
            side = 1.0 if self.form == "max" else -1.0
            base, slope = side * np.maximum(side * x, 0.0), np.heaviside(side * x, 0.5)
        else:
            base, slope = (np.abs(x), np.sign(x)) if self.form else (x, np.ones_like(x))
        return np.asarray(base**self.power), np.asarray(self.power * base ** (self.power - 1) * slope)


@dataclass(frozen=True)
class Expression:
    """A product of factors, each variable and form once, in the order of `VARIABLES`."""

    factors: tuple[Factor, ...]

    def __str__(self) -> str:
        """The product as robot files have it: ``wz*abs(vx)``."""
        return "*".join(str(f) for f in self.factors)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables in it."""
        return tuple(dict.fromkeys(f.variable for f in self.factors))

    @property
    def mirror(self) -> int:
        """Its sign for a mirrored robot: 1, -1, or 0 where a mirrored robot has another expression (one side's wheels)."""
        return math.prod(f.mirror for f in self.factors)

    def dimension(self) -> tuple[int, int]:
        """Powers of metre and second in its unit; signs and rises have none."""
        has_unit = [f for f in self.factors if f.form not in ("sign", "rise")]
        return sum(VARIABLES[f.variable].metres * f.power for f in has_unit), sum(VARIABLES[f.variable].seconds * f.power for f in has_unit)

    @property
    def typical(self) -> float:
        """Its size on an ordinary drive, where each variable has its typical size on the side on which it acts, and a swing all of it."""
        sides = ((VARIABLES[f.variable].typical * np.array([-1.0, 1.0])) for f in self.factors)
        shapes = (x if f.has_memory else f.at(x)[0] for f, x in zip(self.factors, sides, strict=True))
        return math.prod(float(np.max(np.abs(shape))) for shape in shapes)

    def evaluate(self, values: Mapping[str, FloatArray]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Value (n,) at the variables' ``values`` (n,) each, and derivatives (n,) by the variables in it. What has a memory is among the
        values by the factor's text (`with_memory`), else it is that of steady motion."""
        parts = [
            (values[str(f)], np.zeros_like(values[str(f)])) if f.has_memory and str(f) in values else f.at(values[f.variable])
            for f in self.factors
        ]
        value = np.asarray(math.prod(part for part, _ in parts))
        slopes: dict[str, FloatArray] = {}
        for i, (factor, (_, slope)) in enumerate(zip(self.factors, parts, strict=True)):
            others = math.prod((part for j, (part, _) in enumerate(parts) if j != i), start=1.0)
            slopes[factor.variable] = slopes.get(factor.variable, 0.0) + slope * others
        return value, slopes


def with_memory(expressions: Iterable[Expression], values: Mapping[str, FloatArray], series: SampleSeries | None) -> dict[str, FloatArray]:
    """``values`` (n,) of the variables with those of all factors of ``expressions`` that have a memory, along the ``series`` of samples."""
    factors = {f for e in expressions for f in e.factors if f.has_memory}
    return {**values, **{str(f): respond(f.form, f.constants, values[f.variable], series) for f in factors}}


def parse_expression(text: str, where: str = "term") -> Expression:
    """The product that ``text`` writes, as ``wz*abs(wz)`` or ``v^2*cg_y``; ``where`` begins errors. Raises `RobotError`.

    >>> str(parse_expression("abs(wz) * wz"))
    'wz*abs(wz)'
    """
    powers: dict[tuple[str, str], int] = {}
    last: list[Factor] = []
    for part in re.sub(r"\*\*", "^", text.replace(" ", "")).split("*"):
        if (found := _WITH_CONSTANTS.fullmatch(part)) is not None:
            last.append(_with_constants(found[1], found[2].split(","), text, where))
            continue
        found = _FACTOR.fullmatch(part)
        if found is None:
            raise RobotError(
                f"{where}: cannot read {part[:40]!r} in {text[:60]!r}; terms are products such as v*abs(wz), wz^2 or sign(v)*cg_y."
            )
        form, name, power = found[1] or found[3] or "", found[2] or found[4] or found[5], int(found[6] or 1)
        if name not in VARIABLES:
            near = [_SYNONYMS[name]] if name in _SYNONYMS else difflib.get_close_matches(name, _NAMES, n=1, cutoff=0.4)
            meant = f" (did you mean {near[0]}?)" if near else ""
            raise RobotError(f"{where}: unknown variable {name[:40]!r} in {text[:60]!r}{meant}; there are {', '.join(_NAMES)}.")
        powers[name, form] = powers.get((name, form), 0) + power
        if not 1 <= powers[name, form] <= _MAX_POWER:
            raise RobotError(f"{where}: power {powers[name, form]} of {name} in {text[:60]!r}; powers are 1 to {_MAX_POWER}.")
    order = sorted(powers, key=lambda key: (_NAMES.index(key[0]), _FORMS.index(key[1])))
    expression = Expression((*(Factor(name, form, powers[name, form]) for name, form in order), *last))
    if not any(VARIABLES[f.variable].is_motion for f in expression.factors):
        motions = ", ".join(name for name, v in VARIABLES.items() if v.is_motion)
        raise RobotError(f"{where}: {text[:60]!r} would move a robot that stands; multiply it by one of {motions}.")
    return expression


def _with_constants(form: str, arguments: list[str], text: str, where: str) -> Factor:
    """The factor ``form`` of these ``arguments``, as rise(t,30) or swing(v,0.8,0.2). Raises `RobotError`."""
    name, *written = arguments
    limits = _LIMITS[form]
    is_possible = name == "t" if form == "rise" else name in VARIABLES and VARIABLES[name].is_motion
    constants = tuple(float(c) for c in written if _NUMBER.fullmatch(c))
    in_limits = len(constants) == len(written) == len(limits) and all(
        low <= c <= high for c, (low, high) in zip(constants, limits, strict=True)
    )
    if not (is_possible and in_limits):
        of = "t" if form == "rise" else "a motion (v, wz, left, right, dv, dwz)"
        words = _CONSTANT_WORDS[form].format(*(f"{low:g} to {high:g}" for low, high in limits))
        raise RobotError(
            f"{where}: cannot read {form}({','.join(arguments)[:40]}) in {text[:60]!r}; a {form} is of {of}, with {words}, as "
            f"{_EXAMPLES[form]}."
        )
    return Factor(name, form, 1, constants)


@dataclass(frozen=True)
class Term:
    """A coefficient times an expression, added to one component of the twist."""

    component: str
    expression: Expression
    value: float
    sigma: float = 0.0
    """Standard deviation of ``value``; 0 for one that is not corrected online."""

    @property
    def name(self) -> str:
        """Name of its coefficient among a model's parameters, as ``vy[wz*abs(wz)]``."""
        return f"{self.component}[{self.expression}]"

    @property
    def is_symmetric(self) -> bool:
        """Whether a robot that is the same on both sides may have it: vx is even, vy and wz are odd in a mirror."""
        return self.expression.mirror == (1 if self.component == "vx" else -1)

    @property
    def scale(self) -> float:
        """Coefficient that matters: it changes the twist by `_MATTERS` on an ordinary drive."""
        return _MATTERS / self.expression.typical

    @property
    def unit(self) -> str:
        """SI unit of the coefficient; radians are 1.

        >>> Term("vy", parse_expression("wz*abs(wz)"), -0.12).unit
        'm s'
        """
        metres, seconds = self.expression.dimension()
        return _unit_text((self.component != "wz") - metres, -1 - seconds)


def _unit_text(metres: int, seconds: int) -> str:
    above = [f"{name}^{power}" if power > 1 else name for name, power in (("m", metres), ("s", seconds)) if power > 0]
    below = [f"{name}^{-power}" if power < -1 else name for name, power in (("m", metres), ("s", seconds)) if power < 0]
    return " ".join(above or ["1"]) + "".join(f"/{name}" for name in below)


def parse_terms(table: Any, where: str) -> tuple[Term, ...]:
    """Terms of a table by component, then by expression, of value, [value, sigma] or [value, sigma, unit]. Raises `RobotError`."""
    if not isinstance(table, Mapping):
        raise RobotError(f'{where}: must be a table, as vy = {{"wz*abs(wz)" = [-0.12, 0.01]}}; found {str(table)[:60]!r}.')
    found: dict[str, Term] = {}
    for component, entries in table.items():
        if component not in COMPONENTS:
            near = difflib.get_close_matches(str(component), COMPONENTS, n=1, cutoff=0.3)
            meant = f" (did you mean {near[0]}?)" if near else ""
            raise RobotError(f"{where}: unknown component {component[:40]!r}{meant}; terms are added to {', '.join(COMPONENTS)}.")
        if not isinstance(entries, Mapping):
            raise RobotError(f'{where}: {component} must be a table, as {{"wz*abs(wz)" = [-0.12, 0.01]}}; found {str(entries)[:60]!r}.')
        for text, entry in entries.items():
            term = _term(component, str(text), entry, f"{where}.{component}")
            if term.name in found:
                raise RobotError(f"{where}.{component}: {term.expression} stands there twice; add its coefficients.")
            found[term.name] = term
    if len(found) > MOST_TERMS:
        raise RobotError(f"{where}: has {len(found)} terms; at most {MOST_TERMS} make sense.")
    return tuple(sorted(found.values(), key=lambda term: COMPONENTS.index(term.component)))


def _term(component: str, text: str, entry: Any, where: str) -> Term:
    """One term of a file. Raises `RobotError`."""
    parts = entry if isinstance(entry, list) else [entry]
    numbers = parts[:2]
    is_number = [isinstance(n, int | float) and not isinstance(n, bool) and abs(n) <= _LARGEST for n in numbers]  # false for NaN
    if not 1 <= len(parts) <= 3 or not all(is_number) or (len(parts) == 2 and parts[1] < 0.0) or (len(parts) == 3 and not parts[1] >= 0.0):
        raise RobotError(
            f"{where}: {text[:60]!r} must be value, [value, sigma] or [value, sigma, unit], sigma not below 0; found {str(entry)[:60]}."
        )
    term = Term(component, parse_expression(text, where), float(numbers[0]), float(numbers[1]) if len(numbers) > 1 else 0.0)
    if len(parts) == 3 and parts[2] != term.unit:
        raise RobotError(f"{where}: the unit of {text[:60]!r} is {term.unit!r}, found {str(parts[2])[:30]!r}.")
    return term


def terms_table(terms: tuple[Term, ...]) -> list[str]:
    """Lines of a robot file for ``terms``, one for each component."""
    lines = []
    for component in COMPONENTS:
        entries = [f'"{t.expression}" = [{float(t.value)!r}, {float(t.sigma)!r}, "{t.unit}"]' for t in terms if t.component == component]
        lines += [f"{component} = {{{', '.join(entries)}}}"] if entries else []
    return lines
