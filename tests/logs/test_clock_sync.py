"""Events come in order of their stamps, in bounded memory, whatever clocks and recorders do."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.events import Event, ImuSample, Scan, WheelSample
from localization.logs import Log, inspect_log, open_log
from localization.logs.clock_sync import ClockPlan, FirstMessage, Item, merge, plan_clocks
from localization.logs.decode import MessageStats, Oddity
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

ROBOT = load_robot("vaultbot")
MS = S // 1000
HOUR = 3600 * S


@dataclass(frozen=True)
class Mark:
    """A payload with its topic and its true time of measurement."""

    stamp_ns: int
    topic: str
    true_ns: int


def mark(topic: str, true_ns: int, log_ns: int, stamp_ns: int | None = None) -> Item:
    stamp = true_ns if stamp_ns is None else stamp_ns
    return Item(log_ns, stamp, topic, 0, 1, Mark(stamp, topic, true_ns))


def run(items: Iterable[Item]) -> tuple[list[Mark], MessageStats]:
    """Merge items after bringing them into the order of recording, with clocks planned by each topic's first eleven."""
    ordered = sorted(items, key=lambda item: item.log_ns)
    first: dict[str, list[FirstMessage]] = {}
    for item in ordered:
        first.setdefault(item.topic, []).append(FirstMessage(item.log_ns, item.stamp_ns))
    stats = MessageStats()
    return list(merge(ordered, plan_clocks({topic: pairs[:11] for topic, pairs in first.items()}), stats)), stats


def check_order(marks: list[Mark]) -> None:
    stamps = [m.stamp_ns for m in marks]
    assert stamps == sorted(stamps)
    for topic in {m.topic for m in marks}:
        own = [m.stamp_ns for m in marks if m.topic == topic]
        assert own == sorted(set(own))


def ticks(topic: str, seconds: float, rate: float, latency: int = 5 * MS, start: int = START) -> list[Item]:
    return [mark(topic, start + int(i * S / rate), start + int(i * S / rate) + latency) for i in range(int(seconds * rate))]


def test_clock_sync_latencies_up_to_a_second_are_sorted() -> None:
    rng = np.random.default_rng(1)
    items = [
        mark(topic, START + i * S // rate, START + i * S // rate + int(rng.uniform(0, worst) * S))
        for topic, rate, worst in (("/wheels", 50, 0.02), ("/scan", 10, 0.9), ("/imu", 100, 0.3))
        for i in range(10 * rate)
    ]
    marks, stats = run(items)
    check_order(marks)
    assert len(marks) == 1600
    assert {oddity for oddity in Oddity if any(stats.of(t, oddity) for t in ("/wheels", "/scan", "/imu"))} <= {Oddity.OUT_OF_ORDER}


def test_clock_sync_topic_always_3_s_late_is_waited_for() -> None:
    """As a slow driver on another computer may be: its usual latency is learnt."""
    marks, stats = run([*ticks("/wheels", 20, 50), *ticks("/points", 20, 10, latency=3 * S)])
    check_order(marks)
    assert len(marks) == 1200
    assert stats.describe() == []


def test_clock_sync_scans_recorded_in_bursts_are_all_sorted() -> None:
    """Every 2.5 s the network delivers what a LiDAR at 5 Hz has measured meanwhile."""
    every = 5 * S // 2
    scans = [mark("/scan", START + i * S // 5, START + (i * S // 5 // every + 1) * every + i) for i in range(200)]
    marks, stats = run([*ticks("/wheels", 40, 50), *scans])
    check_order(marks)
    assert (len(marks), stats.describe()) == (2200, [])


def test_clock_sync_stalled_recorder_loses_nothing() -> None:
    """For four seconds nothing is written; then all that waited, at once. The headers were right all the time."""
    items = [*ticks("/wheels", 20, 50), *ticks("/scan", 20, 10, latency=60 * MS)]
    stalled = [
        mark(
            i.topic,
            i.stamp_ns,
            i.log_ns if not START + 8 * S < i.log_ns < START + 12 * S else START + 12 * S + (i.log_ns - START) // 10_000,
        )
        for i in items
    ]
    marks, stats = run(stalled)
    check_order(marks)
    assert sorted(m.true_ns for m in marks) == sorted(i.stamp_ns for i in items)
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert stats.describe() == []


@pytest.mark.parametrize("rate", [50, 10, 4])
@pytest.mark.parametrize("lost_s", [(8.0, 12.0), (8.0, 10.5), (10.0, 12.5), (9.0, 15.5), (12.0, 16.0)])
def test_clock_sync_late_burst_is_no_clock_jump(rate: int, lost_s: tuple[float, float]) -> None:
    """The network holds everything for eight seconds, and of what it held a part is lost."""
    kept = [i for i in ticks("/wheels", 30, rate) if not lost_s[0] * S < i.stamp_ns - START < lost_s[1] * S]
    held = [
        i if not 8 * S < i.log_ns - START < 16 * S else mark(i.topic, i.stamp_ns, START + 16 * S + (i.log_ns - START) // 10_000)
        for i in [*kept, *ticks("/scan", 30, 10, latency=60 * MS)]
    ]
    marks, stats = run(held)
    check_order(marks)
    assert [m.true_ns for m in marks if m.topic == "/wheels"] == [i.stamp_ns for i in kept]
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert stats.describe() == []


@pytest.mark.parametrize("ends", [0, 100])
def test_clock_sync_jump_behind_a_burst_is_detected(ends: int) -> None:
    """What comes after it agrees with the last ``ends`` messages in it."""
    items = []
    for i in range(1500):
        t = START + i * S // 50
        log = t + 5 * MS if not 400 <= i < 800 else START + 16 * S + i * MS // 1000
        items.append(mark("/wheels", t, log, t + (HOUR if i >= 800 - ends else 0)))
    marks, stats = run(items)
    check_order(marks)
    assert len(marks) + stats.of("/wheels", Oddity.REPEATED) == 1500
    assert stats.of("/wheels", Oddity.REBASED) == 700 + ends
    assert stats.of("/wheels", Oddity.OUTLIER) == 0
    assert max(abs(m.stamp_ns - m.true_ns) for m in marks) <= 2 * S // 50  # what came at once may have been measured two periods apart


@pytest.mark.parametrize("batch", [S // 5, S, 4 * S, 60 * S])
def test_clock_sync_jump_in_a_log_written_in_batches_is_detected(batch: int) -> None:
    """All of a batch bears one time of recording, when it was written."""
    items = []
    for i in range(3000):
        t = START + i * S // 50
        items.append(mark("/wheels", t, t - (t - START) % batch + batch, t + (HOUR if i >= 1525 else 0)))
    marks, stats = run(items)
    check_order(marks)
    assert len(marks) + stats.of("/wheels", Oddity.REPEATED) == 3000
    assert stats.of("/wheels", Oddity.REBASED) == 1475
    assert max(abs(m.stamp_ns - m.true_ns) for m in marks) <= 2 * S // 50  # what came at once may have been measured two periods apart


def test_clock_sync_driver_pause_is_no_jump() -> None:
    items = [i for i in ticks("/scan", 60, 10) if not START + 20 * S < i.stamp_ns < START + 45 * S]
    marks, stats = run([*items, *ticks("/wheels", 60, 50)])
    assert len(marks) == len(items) + 3000
    assert stats.describe() == []


@pytest.mark.parametrize("jump", [HOUR, -HOUR, 5 * S, -5 * S, 10 * 365 * 24 * HOUR])
def test_clock_sync_jump_is_corrected(jump: int) -> None:
    """From 10 s on the scanner's clock is off; its scans stay where they were measured, to the jitter of the latency."""
    rng = np.random.default_rng(2)
    scans = [
        mark("/scan", t, t + 30 * MS + int(rng.uniform(0, 20) * MS), t + (jump if i >= 100 else 0))
        for i, t in ((i, START + i * S // 10) for i in range(300))
    ]
    marks, stats = run([*ticks("/wheels", 30, 50), *scans])
    check_order(marks)
    found = [m for m in marks if m.topic == "/scan"]
    assert len(found) == 300
    assert max(abs(m.stamp_ns - m.true_ns) for m in found) <= 25 * MS
    steps = np.diff([m.stamp_ns for m in found[100:]])
    assert (steps == S // 10).all()  # after the jump it is one shift for all
    assert stats.of("/scan", Oddity.REBASED) == 200
    assert stats.of("/scan", Oddity.OUTLIER) == 0


def test_clock_sync_topics_that_jump_together_stay_aligned() -> None:
    """A computer's clock is set: all its topics jump by the same amount, and are set back by exactly the same."""
    rng = np.random.default_rng(3)
    items = [
        mark(topic, t, t + int(rng.uniform(1, 60) * MS), t + (HOUR if t > START + 5 * S else 0))
        for topic, rate in (("/wheels", 50), ("/scan", 10))
        for t in (START + i * S // rate for i in range(20 * rate))
    ]
    marks, _ = run(items)
    check_order(marks)
    assert len(marks) == 1200
    for topic in ("/wheels", "/scan"):
        shifts = {m.stamp_ns - m.true_ns for m in marks if m.topic == topic and m.true_ns > START + 6 * S}
        assert len(shifts) == 1
    assert len({m.stamp_ns - m.true_ns for m in marks if m.true_ns > START + 6 * S}) == 1


def test_clock_sync_jump_and_return_ends_at_true_stamps() -> None:
    items = [mark("/scan", t, t + 20 * MS, t + (HOUR if 100 <= i < 200 else 0)) for i, t in ((i, START + i * S // 10) for i in range(300))]
    marks, stats = run([*ticks("/wheels", 30, 50), *items])
    check_order(marks)
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert len(marks) == 1800
    assert stats.of("/scan", Oddity.REBASED) == 100


def test_clock_sync_single_outlier_stamps_are_dropped_and_counted() -> None:
    wild = {50: HOUR, 51: -HOUR, 120: 10 * S, 121: 10 * S, 200: -7 * S}
    items = [mark("/scan", t, t + 20 * MS, t + wild.get(i, 0)) for i, t in ((i, START + i * S // 10) for i in range(300))]
    marks, stats = run([*ticks("/wheels", 30, 50), *items])
    check_order(marks)
    assert len(marks) == 1500 + 295
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert stats.of("/scan", Oddity.OUTLIER) == 5
    assert stats.describe() == ["/scan: 5 messages dropped (stamp that fits neither its neighbours nor the time of recording)."]


def test_clock_sync_outlier_first_stamp_does_not_shift_the_rest() -> None:
    items = [mark("/scan", t, t + 20 * MS, t + (HOUR if i == 0 else 0)) for i, t in ((i, START + i * S // 10) for i in range(100))]
    marks, stats = run([*ticks("/wheels", 10, 50), *items])
    check_order(marks)
    assert len(marks) == 599
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert stats.of("/scan", Oddity.OUTLIER) == 1


@pytest.mark.parametrize("old_s", [[4.0], [3600.0], [40.0, 20.0], [3.0, 2.9, 2.8]])
@pytest.mark.parametrize(("rate", "n"), [(50, 300), (2, 40), (0.2, 8), (5, 4)])
def test_clock_sync_old_first_messages_are_dropped(old_s: list[float], rate: float, n: int) -> None:
    """As those of a latched topic, which arrive at once when the recorder subscribes, or of a driver's buffer."""
    old = [mark("/pose", START - int(s * S), START + i * MS) for i, s in enumerate(old_s)]
    good = [mark("/pose", t, t + 20 * MS) for t in (START + int(i * S / rate) + S // 2 for i in range(n))]
    marks, stats = run([*old, *good, *ticks("/wheels", 40, 50)])
    check_order(marks)
    assert [m.true_ns for m in marks if m.topic == "/pose"] == [m.stamp_ns for m in good]
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert stats.of("/pose", Oddity.OLD) == len(old)
    assert stats.describe()[0].startswith(f"/pose: {len(old)} old message{'s' * (len(old) > 1)} dropped (")


@pytest.mark.parametrize("before", [3, 6, 9])
def test_clock_sync_jump_soon_after_the_start_is_corrected(before: int) -> None:
    """Several messages on both sides, at their pace: a clock that was set, not a buffer."""
    scans = [mark("/scan", t, t + 20 * MS, t - (5 * S if i < before else 0)) for i, t in ((i, START + i * S // 10) for i in range(100))]
    marks, stats = run([*ticks("/wheels", 10, 50), *scans])
    check_order(marks)
    assert len([m for m in marks if m.topic == "/scan"]) == 100
    assert len({m.stamp_ns - m.true_ns for m in marks if m.topic == "/scan"}) == 1
    assert stats.of("/scan", Oddity.OLD) == 0


def test_clock_sync_clock_of_few_messages_is_replaced() -> None:
    """Live, a topic may have sent nothing but its latched message before the start."""
    old, items = mark("/pose", START - 5 * S, START), ticks("/pose", 5, 10, start=START + S)
    stats = MessageStats()
    marks = list(merge([old, *items], plan_clocks({"/pose": [FirstMessage(START, START - 5 * S)]}), stats))
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert len(marks) == 51


def test_clock_sync_repeated_stamps_are_dropped_and_counted() -> None:
    items = ticks("/scan", 10, 10)
    again = [mark("/scan", i.stamp_ns, i.log_ns + 3 * MS) for i in items[::4]]
    marks, stats = run([*items, *again, *ticks("/wheels", 10, 50)])
    check_order(marks)
    assert len(marks) == 600
    assert stats.of("/scan", Oddity.REPEATED) == 25


def test_clock_sync_equal_stamps_of_two_frames_name_both() -> None:
    """Two LiDARs on one topic: one of two scans is dropped."""
    stats = MessageStats()
    pairs = [(START + i * S // 10, frame) for i in range(50) for frame in ("front", "rear")]
    items = [Item(stamp, stamp, "/scan", 3, 1, Scan(stamp, np.ones((1, 3)), frame_id=frame)) for stamp, frame in pairs]
    assert len(list(merge(items, ClockPlan(latency_ns={"/scan": 0}), stats))) == 50
    (sentence,) = stats.describe()
    assert sentence.startswith("/scan, frames 'front' and 'rear': 50 messages dropped (stamp repeated by another frame")


def test_clock_sync_frozen_clock_gives_one_event() -> None:
    marks, stats = run([mark("/scan", START, START + i * S // 10) for i in range(100)])
    assert len(marks) == 1
    assert stats.of("/scan", Oddity.REPEATED) == 99


def test_clock_sync_slightly_reversed_stamps_are_sorted() -> None:
    items = ticks("/scan", 10, 10)
    swapped = [mark("/scan", items[i ^ 1].stamp_ns, items[i].log_ns) for i in range(100)]
    marks, stats = run(swapped)
    check_order(marks)
    assert len(marks) == 100
    assert stats.of("/scan", Oddity.OUT_OF_ORDER) == 50


def test_clock_sync_far_too_late_message_is_dropped_and_counted() -> None:
    items = ticks("/wheels", 20, 50)
    late = mark("/wheels", START + 5 * S + 1, START + 5 * S + 950 * MS)
    # In time: within a second. Too late: trusted, for its neighbour is near, but all others are gone by.
    marks, stats = run([*items, late])
    assert len(marks) == 1001
    too_late = [mark("/slow", START + i * S // 2, START + i * S // 2 + (10 * MS if i != 20 else 3 * S)) for i in range(40)]
    marks, stats = run([*items, *too_late])
    check_order(marks)
    assert stats.of("/slow", Oddity.LATE) + stats.of("/slow", Oddity.OUTLIER) == 1
    assert len(marks) == 1039


def test_clock_sync_zero_stamps_get_the_recording_time() -> None:
    marks, stats = run([*ticks("/wheels", 5, 50), *(mark("/cg", START + i * S, START + i * S + MS, 0) for i in range(5))])
    check_order(marks)
    assert [m.stamp_ns for m in marks if m.topic == "/cg"] == [START + i * S + MS for i in range(5)]
    assert stats.of("/cg", Oddity.NO_STAMP) == 5


def test_clock_sync_zero_stamps_in_a_replayed_log_get_the_others_clock() -> None:
    """A log recorded while an old one was played: headers of years ago, and one topic without any."""
    old = START - 3 * 365 * 24 * HOUR
    wheels = [mark("/wheels", old + i * S // 50, START + i * S // 50) for i in range(250)]
    marks, _ = run([*wheels, *(mark("/cg", old + i * S, START + i * S, 0) for i in range(5))])
    check_order(marks)
    assert len(marks) == 255
    assert all(m.stamp_ns == m.true_ns for m in marks)


def test_clock_sync_topic_with_its_own_clock_is_shifted_to_the_common_one() -> None:
    """A LiDAR without time synchronisation stamps by its uptime."""
    lidar = [mark("/points", t, t + 50 * MS, t - START + 100 * S) for t in (START + i * S // 10 for i in range(100))]
    marks, stats = run([*ticks("/wheels", 10, 50), *lidar])
    check_order(marks)
    assert len(marks) == 600
    assert max(abs(m.stamp_ns - m.true_ns) for m in marks) <= 60 * MS
    assert stats.of("/points", Oddity.FOREIGN_CLOCK) == 100


def test_clock_sync_all_stamps_of_another_time_are_kept() -> None:
    old = START - 5 * HOUR
    items = [
        mark(topic, old + i * S // rate, START + i * S // rate + latency)
        for topic, rate, latency in (("/wheels", 50, MS), ("/scan", 10, 40 * MS))
        for i in range(5 * rate)
    ]
    marks, stats = run(items)
    check_order(marks)
    assert all(m.stamp_ns == m.true_ns for m in marks)
    assert len(marks) == 300
    assert stats.describe() == []


def test_clock_sync_equal_stamps_are_ordered_by_rank() -> None:
    items = [Item(START + 9 - rank, START, f"/{rank}", rank, 1, Mark(START, f"/{rank}", START)) for rank in (3, 0, 2, 1)]
    marks, _ = run(items)
    assert [m.topic for m in marks] == ["/0", "/1", "/2", "/3"]


@pytest.mark.extended
@pytest.mark.parametrize("case", ["same log time", "same stamp step of 1 ns", "random stamps", "log time runs away"])
def test_clock_sync_any_input_uses_bounded_memory(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("localization.logs.clock_sync._MAX_BUFFERED_WEIGHT", 2000)
    rng = np.random.default_rng(4)

    def items(n: int) -> Iterator[Item]:
        for i in range(n):
            t = START + i * MS
            yield {
                "same log time": lambda t=t: mark("/a", t, START),
                "same stamp step of 1 ns": lambda i=i: mark("/a", START + i, START),
                "random stamps": lambda t=t: mark("/a", t, t, int(rng.integers(1, 2 * START))),
                "log time runs away": lambda t=t, i=i: mark("/a", t, START + i * 10 * S),
            }[case]()

    def peak(n: int) -> int:
        tracemalloc.start()
        last = 0
        for event in merge(items(n), plan_clocks({"/a": [FirstMessage(START, START)]}), MessageStats()):
            assert event.stamp_ns >= last
            last = event.stamp_ns
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(12_000) < 1.5 * peak(3_000)


stamped = st.tuples(
    st.sampled_from(["/a", "/b", "/c"]),
    st.integers(0, 5 * S),
    st.one_of(st.integers(-S, S), st.integers(-2 * HOUR, 2 * HOUR), st.just(None)),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(stamped, max_size=60))
def test_clock_sync_any_stamps_are_ordered_and_counted(entries: list[tuple[str, int, int | None]]) -> None:
    """Nothing is lost silently: what goes in comes out, or is counted."""
    items = [mark(topic, START + at, START + at, 0 if late is None else START + at - late) for topic, at, late in entries]
    marks, stats = run(items)
    check_order(marks)
    dropped = sum(stats.of(t, o) for t in ("/a", "/b", "/c") for o in (Oddity.REPEATED, Oddity.LATE, Oddity.OUTLIER, Oddity.OLD))
    assert len(marks) + dropped == len(items)


# The same, through a file.


def log_of(tmp_path: Path, records: list[Record]) -> Log:
    ordered = sorted(records, key=lambda record: record[2])
    return open_log(bags.write_ros1_bag(tmp_path / "run.bag", ordered), ROBOT)


def test_clock_sync_scans_of_a_bad_log_are_ordered_and_notes_complete(tmp_path: Path) -> None:
    """Backward, repeated, wild and missing stamps in one log, of which the rest is unharmed."""
    records: list[Record] = []
    for i in range(300):
        t = START + i * S // 10
        records.append(("/joint_states", bags.joint_state(t, position=[0.1 * i] * 4, velocity=[1.0] * 4), t + MS))
        records.append(("/imu/data", bags.imu(0 if i % 100 == 5 else t), t + 2 * MS))
        stamp = t + (2 * HOUR if i >= 200 else 0)
        if i == 50:
            stamp = t - HOUR
        if i == 60:
            stamp = t - S // 10  # repeats the one before
        records.append(("/scan", bags.laser_scan(stamp), t + 40 * MS))
    log = log_of(tmp_path, records)
    events: list[Event] = list(log.events())
    stamps = [event.stamp_ns for event in events]
    assert stamps == sorted(stamps)
    assert sum(isinstance(e, WheelSample) for e in events) == 300
    assert sum(isinstance(e, ImuSample) for e in events) == 300
    scans = [e.stamp_ns for e in events if isinstance(e, Scan)]
    assert scans == [START + i * S // 10 for i in range(300) if i not in (50, 60)]
    assert [found.statement for found in log.warnings()] == [
        "/imu/data: 3 messages without a header stamp, placed by the time of recording.",
        "/scan: 1 message dropped (stamp repeated).",
        "/scan: 1 message dropped (stamp that fits neither its neighbours nor the time of recording).",
        "/scan: 100 messages stamped after a jump of the clock, moved back by it.",
    ]
    problems = " ".join(inspect_log(log).problems)
    assert "/imu/data: 3 of 300 messages have no stamp" in problems
    assert "/scan: 2 of 300 messages are stamped before the one before them" not in problems  # the wild one, and that alone
    assert "/scan: 1 of 300 messages are stamped before the one before them" in problems


def test_clock_sync_references_are_ordered_by_the_same_rules(tmp_path: Path) -> None:
    records: list[Record] = [("/scan", bags.laser_scan(START + i * S), START + i * S) for i in range(10)]
    for i in range(100):
        t = START + i * S // 10
        records.append(("/vicon", bags.pose_stamped(t if i < 50 else t + HOUR, 0.1 * i), t + 10 * MS))
    log = log_of(tmp_path, records)
    references = list(log.references("/vicon"))
    assert [r.stamp_ns for r in references] == [START + i * S // 10 for i in range(100)]
    assert any("/vicon: 50 messages stamped after a jump" in note for note in log.warnings())


def test_clock_sync_clock_of_another_rate_is_named() -> None:
    """One of three topics runs 0.5 % slow; latencies jitter."""
    rng = np.random.default_rng(3)
    items = []
    for topic, rate in (("/wheels", 0.0), ("/scan", 1e-4), ("/imu", -0.005)):
        for i in range(1200):
            true = START + i * S // 20
            stamp = true + round(rate * (true - START))
            items.append(mark(topic, true, true + int(rng.exponential(0.01) * S), stamp))
    _, stats = run(items)
    assert [topic for topic in ("/wheels", "/scan", "/imu") if stats.of(topic, Oddity.RATE_OF_CLOCK)] == ["/imu"]


def test_clock_sync_latency_that_grows_of_all_topics_names_none() -> None:
    items = [mark(topic, t, t + (t - START) // 100) for topic in ("/wheels", "/imu") for t in range(START, START + 60 * S, S // 20)]
    _, stats = run(items)
    assert not stats.of("/wheels", Oddity.RATE_OF_CLOCK) + stats.of("/imu", Oddity.RATE_OF_CLOCK)
