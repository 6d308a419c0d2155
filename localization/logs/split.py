"""Recordings of several files: in the order of recording, also where the recorder's clock was set back between two of them."""

from __future__ import annotations

import heapq
from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Sequence
from itertools import chain, islice, pairwise

from localization.logs.chunks import RawMessage, Source, merge_channels
from localization.logs.set_back_clock import COMPARED, MIN_STEP_NS, SetBack, describe_set_backs, is_of_all, later_ns
from localization.messages import Message


class SplitSource:
    """Several files, as a recorder splits a long log, or one for each sensor. ``notes``: warnings about files that are not among them."""

    def __init__(self, parts: list[Source], notes: list[Message]) -> None:
        self._parts = parts
        self.is_ros1 = False
        self.channels = merge_channels(chain.from_iterable(part.channels for part in parts))
        filled = [part for part in parts if any(channel.count for channel in part.channels)]
        set_backs = _find_set_backs(filled)
        later = [later_ns(set_backs, i, 0) for i in range(len(filled))]
        self._spans = [_Span(part, part.start_ns + by, part.end_ns + by, by) for part, by in zip(filled, later, strict=True)]
        self.start_ns = min((span.start_ns for span in self._spans), default=0)
        self.end_ns = max((span.end_ns for span in self._spans), default=0)
        self._warnings = [*notes, *describe_set_backs(set_backs, self.start_ns)]

    @property
    def warnings(self) -> list[Message]:
        """Warnings about what was lost so far, of all parts."""
        return [*self._warnings, *chain.from_iterable(part.warnings for part in self._parts)]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time; files that do not overlap are opened one after the other."""
        for group in _overlapping(self._spans):
            yield from heapq.merge(*(span.messages(topics) for span in group), key=lambda message: message.log_ns)


class _Span:
    """A file, and by how much later [ns] it was recorded than its times of recording have it."""

    def __init__(self, part: Source, start_ns: int, end_ns: int, later_ns: int) -> None:
        self._part, self._later_ns = part, later_ns
        self.start_ns, self.end_ns = start_ns, end_ns

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        if not self._later_ns:
            return self._part.messages(topics)
        return (message._replace(log_ns=message.log_ns + self._later_ns) for message in self._part.messages(topics))


def _overlapping(spans: Sequence[_Span]) -> Iterator[list[_Span]]:
    """Files by their begin, those together that overlap by over a second."""
    group: list[_Span] = []
    for span in sorted(spans, key=lambda span: span.start_ns):
        if group and max(other.end_ns for other in group) - span.start_ns <= MIN_STEP_NS:
            yield group
            group = []
        group.append(span)
    if group:
        yield group


def _find_set_backs(parts: Sequence[Source]) -> list[SetBack]:
    """Files, by their number, before which the clock was set back: the topics that go on from the file before step back."""
    found: list[SetBack] = []
    for i, (before, after) in enumerate(pairwise(parts), start=1):
        shared = {c.topic for c in before.channels} & {c.topic for c in after.channels}
        if before.end_ns - after.start_ns <= MIN_STEP_NS or not shared:
            continue
        numbers = {topic: k for k, topic in enumerate(sorted(shared))}
        first = [(numbers[m.topic], m.log_ns) for m in islice(after.messages(numbers), COMPARED)]
        last: dict[int, deque[int]] = defaultdict(lambda: deque(maxlen=3))
        for message in before.messages(numbers):
            last[numbers[message.topic]].append(message.log_ns)
        if is_of_all([(topic, log_ns) for topic, times in last.items() for log_ns in times], first):
            found.append(SetBack(i, 0, before.end_ns + sum(step.by_ns for step in found), before.end_ns - first[0][1]))
    return found
