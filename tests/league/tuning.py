"""Settings of a peer that are tuned on one log and judged on others."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_SEED = 0
"""Of the draw of settings where a grid has more than the budget."""


@dataclass(frozen=True)
class Tuned:
    """The best settings of a system on one log."""

    log: str
    settings: Mapping[str, float]


def draw(grid: Mapping[str, Sequence[float]], budget: int) -> list[dict[str, float]]:
    """All settings of ``grid``, or ``budget`` of them drawn at random, the same at each call."""
    settings = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    if len(settings) <= budget:
        return settings
    return [settings[i] for i in sorted(np.random.default_rng(_SEED).choice(len(settings), budget, replace=False).tolist())]


def name_with(name: str, settings: Mapping[str, float]) -> str:
    """Name of the files of a system's result with ``settings``."""
    return "".join([name, *(f" {key}={value:g}" for key, value in settings.items())])
