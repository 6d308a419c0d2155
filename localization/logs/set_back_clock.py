"""Times of recording after the recorder's clock was set back: sorted by these, the later part of a drive would lie among the earlier one.

A file holds its messages in the order of recording, a .db3 file as rows by number. Where the times of all topics that go on step back by
over a second, what follows is moved to later times by that step. A file that was written topic after topic, or sorted in parts, has no
topic that steps back. Chunks of large files are compared by their spans: a step is not found there that is shorter than what its chunk
holds after it.
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from localization.logs.chunks import Chunk
from localization.messages import Message, message

MIN_STEP_NS = 1_000_000_000
"""Multi-threaded recorders store messages by fractions of a second out of order."""
COMPARED = 200
"""Messages before and after a step in which topics are compared: 1 s of a robot's sensors."""
_MIN_OF_TOPIC = 3
_SMALL_BYTES = 50_000_000
"""Size of files whose chunks are all read [bytes]: 0.3 s. Chunks of larger ones hold a second or less, or hours are recorded."""
MAX_CANDIDATES = 100
"""Steps of a chunk that are compared; more are no clock that was set, but times that mean nothing."""
_SETTLED_NS = 2_000_000_000
"""A file that was written longer ago has another time of change when it is written again, whatever clock the file system has."""
_found: dict[tuple[str, int, int, int], list[SetBack]] = {}
"""By path, node, size and time of change: commands open a log several times, and all of a small one is read for these."""
Times = Sequence[tuple[int, int]]
"""Number of the topic and time of recording [ns] of the messages of a chunk, in order of the file."""


@dataclass(frozen=True)
class SetBack:
    """The recorder's clock was set back."""

    position: int
    """Where the chunk is in the file."""
    index: int
    """Number of the first message of that chunk after it."""
    at_ns: int
    """Last time of recording before it."""
    by_ns: int


def find_set_backs(path: Path, chunks: Iterable[Chunk], read: Callable[[Chunk], Times]) -> list[SetBack]:
    """Where the clock was set back, in order of the file at ``path``: once in a process for a file that stays as it is.

    Of large files only chunks are read that overlap with the next by over a second, and the last.
    """
    status = path.stat()
    key = str(path.resolve()), status.st_ino, status.st_size, status.st_mtime_ns
    if key not in _found:
        found = _find(chunks, read)
        if time.time_ns() - status.st_mtime_ns < _SETTLED_NS:
            return found
        _found[key] = found
    return _found[key]


def _find(chunks: Iterable[Chunk], read: Callable[[Chunk], Times]) -> list[SetBack]:
    kept: dict[int, Times] = {}  # of the previous chunk, this one and the following

    def read_once(chunk: Chunk) -> Times:
        if chunk.position not in kept:
            if len(kept) == 3:
                del kept[next(iter(kept))]
            kept[chunk.position] = read(chunk)
        return kept[chunk.position]

    ordered: list[Chunk | None] = [None, *sorted(chunks, key=lambda chunk: chunk.position), None]
    places = [chunk.position for chunk in ordered if chunk is not None]
    is_small = max(places, default=0) - min(places, default=0) <= _SMALL_BYTES
    found = []
    for previous, chunk, following in zip(ordered, ordered[1:], ordered[2:], strict=False):
        if chunk is None or (following is not None and not is_small and chunk.end_ns - following.start_ns <= MIN_STEP_NS):
            continue
        if is_small and chunk.end_ns - chunk.start_ns <= MIN_STEP_NS and (following is None or chunk.end_ns <= following.start_ns):
            continue
        before, inside, after = ([] if part is None else read_once(part) for part in (previous, chunk, following))
        before, after = before[-COMPARED:], after[:COMPARED]
        times, first, last = [*before, *inside, *after], max(len(before), 1), len(before) + len(inside)
        steps = [k for k in range(first, min(last + 1, len(times))) if times[k - 1][1] - times[k][1] > MIN_STEP_NS]
        for k in steps[:MAX_CANDIDATES]:
            if is_of_all(times[max(k - COMPARED, 0) : k], times[k : k + COMPARED]):
                position, index = (chunk.position, k - len(before)) if k < last or following is None else (following.position, 0)
                found.append(SetBack(position, index, times[k - 1][1], times[k - 1][1] - times[k][1]))
    return list({(step.position, step.index): step for step in found}.values())


def is_of_all(before: Times, after: Times) -> bool:
    """Whether all topics that come before and after a step are stepping back."""
    parts: list[dict[int, list[int]]] = []
    for times in (before, after):
        by_topic: dict[int, list[int]] = defaultdict(list)
        for topic, log_ns in times:
            by_topic[topic].append(log_ns)
        parts.append({topic: stamps for topic, stamps in by_topic.items() if len(stamps) >= _MIN_OF_TOPIC})
    both = parts[0].keys() & parts[1].keys()
    last, first = ({t: statistics.median(part[t][cut]) for t in both} for part, cut in zip(parts, (slice(-3, None), slice(3)), strict=True))
    return bool(both) and all(first[topic] < last[topic] - MIN_STEP_NS / 2 for topic in both)


def later_ns(set_backs: Sequence[SetBack], position: int, index: int) -> int:
    """By how much the message ``index`` of the chunk at ``position`` was recorded later than its time of recording has it [ns]."""
    return sum(step.by_ns for step in set_backs if (step.position, step.index) <= (position, index))


def move_chunks(chunks: Sequence[Chunk], set_backs: Sequence[SetBack], read: Callable[[Chunk], Times]) -> list[Chunk]:
    """Chunks with the spans of the corrected times."""
    if not set_backs:
        return list(chunks)
    moved, changed = [], {step.position for step in set_backs}
    for chunk in chunks:
        later = later_ns(set_backs, chunk.position, 0)
        span = chunk.start_ns + later, chunk.end_ns + later
        if chunk.position in changed:
            times = [log_ns + later_ns(set_backs, chunk.position, i) for i, (_, log_ns) in enumerate(read(chunk))]
            span = min(times), max(times)
        moved.append(replace(chunk, start_ns=span[0], end_ns=span[1]))
    return moved


def describe_set_backs(set_backs: Sequence[SetBack], start_ns: int) -> list[Message]:
    """A message for each time the clock was set back."""
    return [message("recorder_clock.set_back", seconds=step.by_ns * 1e-9, at_s=(step.at_ns - start_ns) * 1e-9) for step in set_backs]
