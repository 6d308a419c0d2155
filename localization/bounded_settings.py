"""Settings: dataclasses whose numbers are checked against their bounds when they are set, on the command line or in code."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any, get_type_hints

from localization.errors import SettingError

_LARGEST = 1e9
"""Upper bound of a number in SI units or of a ratio, without a bound of its own."""
_MOST = 1_000_000
"""Upper bound of a whole number (iterations, nodes, windows): the scans of a day."""


@dataclass(frozen=True)
class Allowed:
    """Bounds of a finite number."""

    what: str
    test: Callable[[float], bool]
    most: float | None = None
    """Its upper bound; None for the common one (`_LARGEST`, of whole numbers `_MOST`)."""


@dataclass(frozen=True)
class Below:
    """A number that must be below that of another field, or, if ``or_equal``, at most that."""

    field: str
    or_equal: bool = False


def at_least(low: float) -> Allowed:
    """Bound of a setting: ``low`` or more."""
    return Allowed(f"{low:g} or more", lambda value: value >= low)


def up_to(high: float) -> Allowed:
    """Bound of a setting: 0 to ``high``."""
    return Allowed(f"above 0 and at most {high:g}", lambda value: 0.0 < value <= high)


Positive = Annotated[float, Allowed("above 0", lambda value: value > 0.0)]
Signed = Annotated[float, Allowed("a number", lambda value: True)]
Probability = Annotated[float, Allowed("between 0 and 1, and neither of them", lambda value: 0.0 < value < 1.0)]
Share = Annotated[float, Allowed("from 0 to below 1", lambda value: 0.0 <= value < 1.0)]
Seed = Annotated[int, Allowed("from 0 to 2^32 - 1", lambda value: 0 <= value < 2**32, most=2**32)]
Count = Annotated[int, at_least(1)]
_NOT_NEGATIVE = at_least(0)  # the default of a field


class Settings:
    """Base of the dataclasses of settings. Their fields have bounds by `Annotated`; without one, a number is 0 or more.

    The constructor raises `SettingError` for the first number outside its bounds.
    """

    def __post_init__(self) -> None:
        check_settings(self)


def check_settings(settings: object) -> None:
    """Raises `SettingError` naming the first number of the dataclass ``settings`` that is outside its bounds."""
    rules = rules_of(type(settings))
    numbers: dict[str, float] = {name: value for name in rules if isinstance(value := getattr(settings, name), Real)}  # type: ignore[misc]
    for name, value in numbers.items():
        allowed = next((rule for rule in rules[name] if isinstance(rule, Allowed)), _NOT_NEGATIVE)
        most = allowed.most or (_MOST if isinstance(value, int) else _LARGEST)
        if isinstance(value, float) and not math.isfinite(value):
            raise _refusal(settings, name, "a finite number")
        if not -most <= value <= most:  # whole numbers may be too large for a float
            raise _refusal(settings, name, f"at most {most:g}")
        if not allowed.test(float(value)):
            raise _refusal(settings, name, allowed.what)
    for name, value in numbers.items():
        for bound in (rule for rule in rules[name] if isinstance(rule, Below)):
            most = numbers[bound.field]
            if value > most or (value == most and not bound.or_equal):
                raise _refusal(settings, name, f"{'at most' if bound.or_equal else 'below'} {bound.field}, which is {most:g}")


def _refusal(settings: object, name: str, wanted: str) -> SettingError:
    value = getattr(settings, name)
    shown = f"{value:g}" if abs(value) < 10**18 or isinstance(value, float) else "a number of more than 18 digits"
    return SettingError(f"setting {name} of {type(settings).__name__} is {shown}; it must be {wanted}.")


def rules_of(kind: type) -> Mapping[str, tuple[Any, ...]]:
    """Annotations of each field."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
