"""Values of a set-up's rows, measured with the others as they are: the factor of wheels by their scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from localization.evidence.alternatives import Row
from localization.evidence.alternatives.wheels import factor_text, scale_unit
from localization.evidence.likelihood import Choice, Stack, scales
from motion_models.robot import Robot

_FREE = 3.0
"""Sigma of the logarithm of a factor that is measured."""
_NAMED_SIGMA = 0.03
"""Sigma of the logarithm of a measured factor by other errors of the radius; within twice that, a factor of two is one."""


def refined_rows(stacks: Sequence[Stack], choice: Choice, robot: Robot) -> tuple[Row, ...]:
    """Rows of ``choice``, with the factor of wheels that have one as it was measured."""
    single = [stack.only(k) for stack, k in zip(stacks, choice, strict=True)]
    found = []
    for stack in single:
        for row in stack.alternatives[0].rows:
            found.append(_with_factor(row, single) if row.id == "wheels.factor" and row.since_s is None and row.until_s is None else row)
    return tuple(found)


def measured_scales(stacks: Sequence[Stack], choice: Choice) -> dict[tuple[str, str], tuple[float, float]]:
    """Logarithm of the scale of wheels or driver by the other sources, and its sigma, by source and channel."""
    single = [stack.only(k) for stack, k in zip(stacks, choice, strict=True)]
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for i, stack in enumerate(single):
        for name in ("way", "turn") if stack.kind in ("wheels", "driver") else ():
            if sum(other.channel(name) is not None for other in single) > 1:
                found[stack.kind, name] = scales(_freed(single, i), name)[i]
    return found


def _freed(single: Sequence[Stack], index: int) -> list[Stack]:
    """``single`` with the scale of one source free."""
    free = replace(single[index].alternatives[0], way_sigma=_FREE, turn_sigma=_FREE)
    return [stack.of([free]) if i == index else stack for i, stack in enumerate(single)]


def _with_factor(row: Row, single: Sequence[Stack]) -> Row:
    """The factor is that of the ways where another source has them, else that of the turns."""
    index = next(i for i, stack in enumerate(single) if stack.kind == "wheels")
    has_way = sum(stack.channel("way") is not None for stack in single) > 1
    c, sigma = scales(_freed(single, index), "way" if has_way else "turn")[index]
    nominal = row.value or 1.0
    factor = nominal if abs(c) < 2.0 * max(sigma, _NAMED_SIGMA) and row.detail == "0.05" else float(f"{nominal * math.exp(-c):.4g}")
    return replace(row, value=factor, text=factor_text(factor, f" (+- {100.0 * sigma:.0f} %)"), correct=partial(scale_unit, factor))
