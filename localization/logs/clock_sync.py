"""Several topics in order of their header stamps, within bounded memory, for clocks with offsets and jumps.

Messages come in the order of recording. Their headers hold the time of measurement, which is earlier by an unknown latency; some are
wrong. Three steps:

- Each topic's clock is monitored (`TopicClock`). A stamp is plausible if it lies within a second of the stamp before it, or if it is as
  far from the time of recording as the stamps before it were, to a second. (The first holds when the recorder stalls, the second
  when the driver pauses.) It is not if it leaves the topic's even pace by more than 0.3 s while messages are recorded evenly. One or
  two implausible stamps are outliers, and dropped; three in a row that agree are a clock that was set, and from there on the topic is
  shifted back by the jump. A burst gives no information about clocks and is held until the next message: if that is plausible and
  continues it, the burst was late.
- How far a topic's clock is from the recorder's is taken from its first eleven messages: one that lies behind them (a latched message, a
  buffer of the driver) is dropped as old. Where fewer than three are known, the clock may still be replaced by the next three.
- A topic without stamps gets the time of recording; one whose clock is far from all others is shifted by a constant.
- Plausible messages of a file are sorted: as many are held as memory allows (`_MAX_BUFFERED_WEIGHT`), however late they were recorded.
  Live they are passed on at once.
"""

from __future__ import annotations

import dataclasses
import heapq
import statistics
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from localization.logs.decode import MessageStats, Oddity
from localization.messages import phrase

_SECOND = 1_000_000_000
_MAX_STEP_NS = _SECOND
_MAX_CLOCK_OFFSET_NS = 10 * _SECOND  # more is another clock, not latency
_EQUAL_JUMP_NS = _SECOND // 4  # jumps of two topics that differ by less have one cause
_MIN_JUMPED_MESSAGES = 3
FIRST_MESSAGES = 11
"""Messages of a topic from which its latency is taken: three that agree outweigh any number of old ones."""
_MIN_JUMP_NS = 3 * _SECOND // 10
"""A stamp that deviates from the even pace of its topic by more than this [ns], while the times of recording are even, is no latency but a
clock that was set. Smaller jumps move a robot by less than 0.3 m at 1 m/s; estimators reject these."""
_PACE_MESSAGES, _MIN_PACE_MESSAGES = 20, 8
"""Messages from which the pace is computed, and the fewest: scanners of 2 Hz have 8 in 4 s."""
_MAX_PENDING_NS = 10 * _SECOND  # bounds the latency
_MAX_BURST_NS = 5 * _SECOND
_MAX_PENDING_MESSAGES = 1000  # bounds the memory
_MAX_BUFFERED_WEIGHT = 20_000  # bounds the memory: 200 scans, or 20 s of a robot with an IMU of 100 Hz
_RATE_WINDOW_NS, _MIN_RATE_WINDOWS, _MAX_RATE_WINDOWS = 5 * _SECOND, 6, 360
"""Times of recording over which the least latency is taken, and fewest and most of these windows, to compare the rates of clocks."""
_MAX_RATE, _MAX_DRIFT_S, _LINEAR = 0.002, 0.15, 0.1
"""Difference of the rates of two clocks, and of their times over a log [s], from where on it is named; largest deviation of that difference
from a straight line. Quartzes differ by 1e-4."""


class Item(NamedTuple):
    """An event to be merged, and the keys of its order."""

    log_ns: int
    stamp_ns: int
    topic: str
    rank: int
    """Order among equal stamps."""
    weight: int
    """How much memory it takes, in units of a small event."""
    payload: Any
    """An event, or a reading that becomes one; a dataclass with the field `stamp_ns`."""


class FirstMessage(NamedTuple):
    """One of the first messages of a topic."""

    log_ns: int
    stamp_ns: int
    """Header stamp; 0 where there is none."""
    frame: str = ""


@dataclass(frozen=True)
class ClockPlan:
    """How far the headers' clock is from the recorder's, and which topics have another one."""

    offset_ns: int = 0
    """Header stamp minus time of recording, where that is more than latency (a log that was recorded while another was played)."""
    shifts_ns: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Shift of the stamps of each topic whose clock is far from the others'."""
    latency_ns: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Header stamp, shifted, minus time of recording, of each topic's first messages."""
    unsure: frozenset[str] = frozenset()
    """Topics of which too few messages are known for that."""
    period_s: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Median time from message to message of a topic's first frame [s], where its first messages show it."""

    def corrected(self, late_ns: Mapping[str, int]) -> ClockPlan:
        """The plan of stamps that the robot file's clocks correct before they come, by ``late_ns`` of their topic [ns]."""
        latency_ns = {topic: latency - late_ns.get(topic, 0) for topic, latency in self.latency_ns.items()}
        return dataclasses.replace(self, latency_ns=latency_ns)

    def first_stamps(self, first: Mapping[str, Sequence[FirstMessage]]) -> Iterator[int]:
        """Shifted header stamps of those of the ``first`` messages, from which the plan was made, that are not old."""
        for topic, pairs in first.items():
            for log, stamp, _ in pairs:
                shifted = stamp + self.shifts_ns.get(topic, 0)
                if stamp and shifted - log >= self.latency_ns[topic] - _MAX_STEP_NS:
                    yield shifted


def plan_clocks(first: Mapping[str, Sequence[FirstMessage]]) -> ClockPlan:
    """Clocks by the first messages of each topic; those without a stamp are left out.

    If any topic agrees with the recorder to 10 s, that is the common clock; else the median of all.
    """
    stamped = {topic: [pair for pair in pairs if pair.stamp_ns != 0] for topic, pairs in first.items()}
    offsets = {topic: _usual_offset(pairs) for topic, pairs in stamped.items() if pairs}
    if not offsets or any(abs(offset) <= _MAX_CLOCK_OFFSET_NS for offset in offsets.values()):
        common = 0
    else:
        common = statistics.median_low(sorted(offsets.values()))
    shifts = {topic: _shift_to(common, offset) for topic, offset in offsets.items() if _shift_to(common, offset)}
    unsure = frozenset(topic for topic in offsets if len(stamped[topic]) < _MIN_JUMPED_MESSAGES)
    periods = {topic: period for topic, pairs in stamped.items() if (period := _period_s(pairs)) is not None}
    return ClockPlan(common, shifts, {topic: offset + shifts.get(topic, 0) for topic, offset in offsets.items()}, unsure, periods)


def _shift_to(common: int, offset: int) -> int:
    """Shift of a clock that is ``offset`` from the recorder's; 0 where that is the common one's and latency."""
    return common - offset if abs(offset - common) > _MAX_CLOCK_OFFSET_NS else 0


def _period_s(first: Sequence[FirstMessage]) -> float | None:
    stamps = [message.stamp_ns for message in first if message.frame == first[0].frame]
    known = sorted(set(stamps))
    every = 2 if len(known) > 2 else 1  # stamps of arrival come in pairs
    steps = [(after - before) / every for before, after in zip(known, known[every:], strict=False)]
    return statistics.median(steps) * 1e-9 if steps else None


def _usual_offset(first: Sequence[FirstMessage]) -> int:
    """Header stamp minus time of recording: the greatest on which several messages agree to a second.

    Messages come late, never early: what a buffer or a latched topic adds lies below it, and a single stamp ahead has no second.
    """
    logs, stamps, _ = zip(*first, strict=True)
    offsets = sorted((stamp - log for log, stamp, _ in first), reverse=True)
    several = min(_MIN_JUMPED_MESSAGES, 1 + len(first) // 3)
    for offset, other in zip(offsets, offsets[several - 1 :], strict=False):
        if offset - other <= _MAX_STEP_NS:
            return offset
    is_batch = 2 * (logs[-1] - logs[0]) < stamps[-1] - stamps[0]  # written at once: the times of recording show nothing
    return stamps[0] - logs[0] if is_batch else offsets[0]


class TopicClock:
    """The stamps of one topic, converted to the common clock."""

    def __init__(self, topic: str, plan: ClockPlan, jumps: list[int], stats: MessageStats) -> None:
        self._topic, self._stats = topic, stats
        self._common = plan.offset_ns
        self._shift = plan.shifts_ns.get(topic, 0)
        self._foreign = self._shift != 0
        self._jumps = jumps
        self._rebased = False
        self._is_sure, self._accepted = topic in plan.latency_ns and topic not in plan.unsure, 0
        self._last: int | None = None
        self._newest: int | None = None
        self.offset_ns = plan.latency_ns.get(topic, plan.offset_ns)
        """Stamp minus time of recording, of the last plausible message."""
        self._min_latency_offset_ns = self.offset_ns
        self._least_latency: dict[int, int] = {}
        """Greatest offset [ns] by window of the time of recording."""
        self._pending: list[Item] = []
        self._last_log = 0
        self._pace: deque[tuple[int, int]] = deque(maxlen=_PACE_MESSAGES)
        """Steps of the last plausible stamps, and by how much those of recording differed from them."""

    @property
    def shift_ns(self) -> int:
        """Shift of the stamps of this topic."""
        return self._shift

    def expire(self, log_ns: int) -> None:
        """Drop messages that have been pending for ten seconds."""
        while self._pending and log_ns - self._pending[0].log_ns > _MAX_PENDING_NS:
            del self._pending[0]
            self._stats.count(self._topic, Oddity.OUTLIER)

    def insert(self, item: Item) -> list[Item]:
        """Insert the next message; returns those that are plausible now, with their final stamps."""
        if item.stamp_ns == 0:
            self._stats.count(self._topic, Oddity.NO_STAMP)
            return [_restamped(item, item.log_ns + self._common)]
        if self._is_plausible(item):
            if not self._pending:
                return [self._accept(item)]
            if not self._is_continued_by(item):
                self.drop_pending()
            self._pending.append(item)
            return self._release()
        if self._pending and not _agree(self._pending[-1], item):
            self.drop_pending()
        self._pending.append(item)
        if len(self._pending) < _MIN_JUMPED_MESSAGES or self._is_burst():
            return []
        self._set_clock()
        return self._release()

    def flush(self) -> list[Item]:
        """Release the pending messages at the end if they are enough for a clock that was set, else drop them."""
        if len(self._pending) >= _MIN_JUMPED_MESSAGES:
            self._set_clock()
        else:
            self.drop_pending()
        return self._release()

    def drift(self) -> tuple[float, float] | None:
        """Rate of the stamps less that of the times of recording, by a line through the least latencies, and its sum over the log [s].

        None where they lie on no line.
        """
        return drift_of(self._least_latency)

    @property
    def behind_ns(self) -> int:
        """Time of recording less stamp of the message with the least latency, without the shift of all topics [ns]."""
        return self._common - self._min_latency_offset_ns

    @property
    def accepted(self) -> int:
        """Plausible messages so far."""
        return self._accepted

    def drop_pending(self) -> None:
        """Drop the pending messages as outliers, or as old where they lie behind all that follow."""
        for item in self._pending:
            is_old = self._last is None and item.stamp_ns + self._shift < item.log_ns + self.offset_ns
            self._stats.count(self._topic, Oddity.OLD if is_old else Oddity.OUTLIER)
        self._pending = []

    def _is_plausible(self, item: Item) -> bool:
        stamp = item.stamp_ns + self._shift
        offsets = (self.offset_ns, self._min_latency_offset_ns)  # after a burst, messages are no longer late
        return not self._is_sudden(item) and (
            (self._last is not None and abs(stamp - self._last) <= _MAX_STEP_NS)
            or any(abs(stamp - item.log_ns - offset) <= _MAX_STEP_NS for offset in offsets)
        )

    def _is_sudden(self, item: Item) -> bool:
        """Whether the stamp leaves its topic's even pace, though the message was recorded when it was due."""
        if self._last is None or len(self._pace) < _MIN_PACE_MESSAGES:
            return False
        stamp, step = item.stamp_ns + self._shift, item.log_ns - self._last_log
        deviation = abs(stamp - self._last - step)
        if deviation <= _MIN_JUMP_NS or abs(stamp - item.log_ns - self._min_latency_offset_ns) <= _MIN_JUMP_NS:
            return False
        due = (len(self._pending) + 1) * statistics.median(period for period, _ in self._pace)
        usual = max(abs(jitter) for _, jitter in self._pace)
        return deviation > 3 * usual and 0.3 * due <= step <= 3.0 * due

    def _release(self) -> list[Item]:
        released, self._pending = self._pending, []
        return [self._accept(i) for i in released]

    def _may_be_late(self) -> bool:
        """Whether the pending messages are stamped after the last plausible one, if there was one."""
        return bool(self._pending) and (self._last is None or self._last <= self._pending[0].stamp_ns + self._shift)

    def _is_continued_by(self, item: Item) -> bool:
        """Whether the plausible ``item`` is stamped soon after the pending messages, and these after the last plausible one."""
        return self._may_be_late() and 0 <= item.stamp_ns - self._pending[-1].stamp_ns <= _MAX_STEP_NS

    def _is_burst(self) -> bool:
        """Whether the pending messages were recorded in less than half the time over which they were measured (long: a replayed bag)."""
        first, last = self._pending[0], self._pending[-1]
        is_fast = last.log_ns - first.log_ns < min((last.stamp_ns - first.stamp_ns) / 2, _MAX_BURST_NS)
        n = len(self._pending)
        return is_fast and n < _MAX_PENDING_MESSAGES and n * last.weight < _MAX_BUFFERED_WEIGHT

    def _accept(self, item: Item) -> Item:
        stamp = item.stamp_ns + self._shift
        if self._last is not None:
            step = stamp - self._last
            self._pace.append((step, item.log_ns - self._last_log - step))
        self._last, self._last_log, self.offset_ns = stamp, item.log_ns, stamp - item.log_ns
        self._min_latency_offset_ns = max(self._min_latency_offset_ns, self.offset_ns)
        window = item.log_ns // _RATE_WINDOW_NS
        if window in self._least_latency or len(self._least_latency) < _MAX_RATE_WINDOWS:
            self._least_latency[window] = max(self._least_latency.get(window, self.offset_ns), self.offset_ns)
        self._accepted += 1
        self._is_sure |= self._accepted >= _MIN_JUMPED_MESSAGES
        if self._rebased:
            self._stats.count(self._topic, Oddity.REBASED)
        elif self._foreign:
            self._stats.count(self._topic, Oddity.FOREIGN_CLOCK)
        if self._newest is not None and stamp < self._newest:
            self._stats.count(self._topic, Oddity.OUT_OF_ORDER)
        self._newest = stamp if self._newest is None else max(stamp, self._newest)
        return _restamped(item, stamp)

    def _set_clock(self) -> None:
        """The clock was set: shift the topic so that it is as far from the time of recording as it was before."""
        first = self._pending[:_MIN_JUMPED_MESSAGES]  # in a burst, they are as late as the message before them
        if not self._is_sure:
            self._replace_clock(statistics.median_low([i.stamp_ns - i.log_ns for i in first]))
            return
        deviation = statistics.median_low([i.stamp_ns + self._shift - i.log_ns - self.offset_ns for i in first])
        shift = self._shift - deviation
        # The latency jitters. Where another topic made the same jump, or this one a jump back, the same shift keeps them aligned.
        same = [jump for jump in (0, *self._jumps) if abs(jump - shift) <= _EQUAL_JUMP_NS]
        self._shift = same[0] if same else shift
        self._rebased = self._shift != 0
        if not same:
            self._jumps.append(shift)

    def _replace_clock(self, offset: int) -> None:
        """The pending messages, at ``offset`` from the time of recording, are the first that show the topic's clock."""
        self._shift, self._is_sure = _shift_to(self._common, offset), True
        self._foreign = self._shift != 0
        self.offset_ns = self._min_latency_offset_ns = offset + self._shift


def drift_of(least_latency: Mapping[int, int]) -> tuple[float, float] | None:
    """`TopicClock.drift` by the greatest offsets [ns] of windows of the time of recording, by their number."""
    if len(least_latency) < _MIN_RATE_WINDOWS:
        return None
    t = np.array([*least_latency], dtype=float) * _RATE_WINDOW_NS * 1e-9
    offsets = np.array([*least_latency.values()], dtype=float) * 1e-9
    t, offsets = t - t[0], offsets - offsets[0]
    line = np.polynomial.Polynomial.fit(t, offsets, 1).convert()
    rate = float(line.coef[1]) if len(line.coef) > 1 else 0.0
    drift = rate * float(t[-1])
    is_straight = float(np.abs(offsets - line(t)).max()) <= max(_LINEAR * abs(drift), 0.02)
    return (rate, drift) if is_straight else None


def odd_rates(offsets: Iterable[tuple[str, int, int]]) -> dict[str, float]:
    """Rate of the stamps of each topic less that of the times of recording [s/s], where it is another than those of the other topics.

    ``offsets``: topic, time of recording and stamp less that [ns], of messages in order of recording.
    """
    least: dict[str, dict[int, int]] = {}
    for topic, log_ns, offset_ns in offsets:
        windows, window = least.setdefault(topic, {}), log_ns // _RATE_WINDOW_NS
        windows[window] = max(windows.get(window, offset_ns), offset_ns)
    return _odd_of({topic: found for topic, windows in least.items() if (found := drift_of(windows)) is not None})


def _odd_of(drifts: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Rates of the topics that drift, and whose rate no other topic's comes near."""
    found = {}
    for topic, (rate, drift) in drifts.items():
        others = [abs(other) for name, (other, _) in drifts.items() if name != topic]
        if others and max(others) < abs(rate) / 3.0 and abs(rate) > _MAX_RATE and abs(drift) > _MAX_DRIFT_S:
            found[topic] = rate
    return found


class Merger:
    """Merges items by stamp: `insert` an item, take the payloads that are due. A topic's payloads always have increasing stamps.

    The payloads of a log come in order of stamps, never decreasing. ``is_live``: each is yielded at once, in order of arrival: one that
    comes after a newer one of its own topic is dropped; those late against other topics are passed on.
    """

    def __init__(self, plan: ClockPlan, stats: MessageStats, is_live: bool = False) -> None:
        self._plan, self._stats, self._is_live = plan, stats, is_live
        self._jumps: list[int] = []
        self._clocks = {topic: TopicClock(topic, plan, self._jumps, stats) for topic in plan.latency_ns}
        self._held: list[tuple[int, int, int, Item]] = []
        self._held_weight = self._serial = self._now = 0
        self._emitted: dict[tuple[str, int], int] = {}  # two drivers may share a topic, as wheels and arms do, and a stamp
        self._frames: dict[tuple[str, int], str] = {}  # of the last payload emitted
        self._newest = -(2**63)

    def insert(self, item: Item) -> Iterator[Any]:
        """Insert the next item by time of recording; the yielded payloads must be consumed before the next."""
        clock = self._clocks.get(item.topic)
        if clock is None:  # a topic without stamps
            clock = self._clocks[item.topic] = TopicClock(item.topic, self._plan, self._jumps, self._stats)
        self._now = max(self._now, item.log_ns)
        self._hold(clock.insert(item))
        clock.expire(self._now)
        yield from self._release(0 if self._is_live else _MAX_BUFFERED_WEIGHT)

    def shift_ns(self, topic: str) -> int:
        """Shift of the stamps of ``topic``, whose clock was set or is not the common one."""
        return self._clocks[topic].shift_ns if topic in self._clocks else 0

    def behind_s(self, at_least: int) -> dict[str, float]:
        """`TopicClock.behind_ns` of topics with ``at_least`` so many plausible messages [s]."""
        return {topic: 1e-9 * clock.behind_ns for topic, clock in self._clocks.items() if clock.accepted >= at_least}

    def flush(self) -> Iterator[Any]:
        """Release everything that is held, at the end of the messages."""
        for clock in self._clocks.values():
            self._hold(clock.flush())
        yield from self._release(0)
        self._compare_rates()

    def _compare_rates(self) -> None:
        """Count the messages of a topic whose clock has another rate than those of the other topics and of the recorder."""
        drifts = {topic: found for topic, clock in self._clocks.items() if (found := clock.drift()) is not None}
        for topic in _odd_of(drifts):
            self._stats.count(topic, Oddity.RATE_OF_CLOCK, self._clocks[topic].accepted)

    def _hold(self, items: Iterable[Item]) -> None:
        for item in items:
            newest = self._newest if not self._is_live else self._emitted.get((item.topic, item.rank), item.stamp_ns)
            if item.stamp_ns < newest:
                self._stats.count(item.topic, Oddity.LATE)
                continue
            heapq.heappush(self._held, (item.stamp_ns, item.rank, self._serial, item))
            self._serial += 1
            self._held_weight += item.weight

    def _release(self, most: int) -> Iterator[Any]:
        held = self._held
        while self._held_weight > most:
            stamp, _, _, item = heapq.heappop(held)
            self._held_weight -= item.weight
            if self._emitted.get((item.topic, item.rank)) == stamp:
                self._count_repeated(item)
                continue
            self._emitted[item.topic, item.rank] = self._newest = stamp
            self._frames[item.topic, item.rank] = _frame(item)
            yield item.payload

    def _count_repeated(self, item: Item) -> None:
        """An item with the stamp of the one before: sent twice, or of a second sensor."""
        first, second = self._frames[item.topic, item.rank], _frame(item)
        if first == second:
            self._stats.count(item.topic, Oddity.REPEATED)
        else:
            frames = {"first": min(first, second), "second": max(first, second)}
            self._stats.count(phrase("odd_messages.of_frames", topic=item.topic, **frames), Oddity.SECOND_FRAME)


def merge(items: Iterable[Item], plan: ClockPlan, stats: MessageStats) -> Iterator[Any]:
    """The payloads of ``items`` (which come in order of ``log_ns``) by stamp: never decreasing, and within a topic always increasing."""
    merger = Merger(plan, stats)
    for item in items:
        yield from merger.insert(item)
    yield from merger.flush()


def _restamped(item: Item, stamp_ns: int) -> Item:
    if stamp_ns == item.stamp_ns:
        return item
    payload = object.__new__(type(item.payload))  # its arrays, which were checked, are not checked again
    vars(payload).update(vars(item.payload), stamp_ns=stamp_ns)
    return item._replace(stamp_ns=stamp_ns, payload=payload)


def _frame(item: Item) -> str:
    """Frame of its sensor; "" where it has none."""
    return str(getattr(item.payload, "frame_id", ""))


def _agree(one: Item, other: Item) -> bool:
    step = other.stamp_ns - one.stamp_ns
    return abs(step) <= _MAX_STEP_NS or abs(step - (other.log_ns - one.log_ns)) <= _MAX_STEP_NS
