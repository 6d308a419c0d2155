"""Steps of a synchronizer, event by event."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from localization.events import Event, Step
from localization.inputs.synchronizer import Synchronizer


def steps(events: Iterable[Event], synchronizer: Synchronizer) -> Iterator[Step]:
    """All steps of a stream of events."""
    for event in events:
        yield from steps_after(event, synchronizer)
    yield from last_steps(synchronizer)


def steps_after(event: Event, synchronizer: Synchronizer) -> Iterator[Step]:
    """The steps that ``event`` completes."""
    synchronizer.insert(event)
    while (interval := synchronizer.next_interval(is_last=False)) is not None:
        yield synchronizer.preintegrate(interval)


def last_steps(synchronizer: Synchronizer) -> Iterator[Step]:
    """The steps that still wait when the events end."""
    while (interval := synchronizer.next_interval(is_last=True)) is not None:
        yield synchronizer.preintegrate(interval)
