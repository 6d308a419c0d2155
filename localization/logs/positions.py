"""Positions by GPS as events of the estimators: from a topic of the log, merged with its other events by stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from localization.errors import LogError
from localization.events import Event, PositionSample, Reference

_UNKNOWN_SIGMA_M = 2.5
"""Of a source without covariance [m]: a GPS receiver without corrections (GPS Standard Positioning Service, 2020: 95 % within 8 m)."""
_MIN_SIGMA_M = 0.01
"""No receiver is better, whatever its covariance [m]."""


def position_samples(references: Iterable[Reference], source: str) -> list[PositionSample]:
    """Positions of a topic, by stamp; those that are not finite or repeat a stamp are left out. Raises `LogError` if none is left."""
    found: dict[int, PositionSample] = {}
    for reference in references:
        if not np.isfinite(reference.position).all():
            continue
        cov = reference.covariance[:2, :2]
        if not np.isfinite(cov).all() or (np.linalg.eigvalsh(cov) <= 0.0).any():
            cov = _UNKNOWN_SIGMA_M**2 * np.eye(2)
        found.setdefault(reference.stamp_ns, PositionSample(reference.stamp_ns, reference.position, cov + _MIN_SIGMA_M**2 * np.eye(2)))
    if not found:
        raise LogError(f"{source} has no usable position. `skidloc info` lists the topics and what is wrong with them.")
    return [found[stamp] for stamp in sorted(found)]


def merge_positions(events: Iterable[Event], positions: list[PositionSample]) -> Iterator[Event]:
    """``events``, with each position before the first event that is later."""
    waiting = iter(positions)
    sample = next(waiting, None)
    for event in events:
        while sample is not None and sample.stamp_ns <= event.stamp_ns:
            yield sample
            sample = next(waiting, None)
        yield event
