"""What practice does to messages that is no fault of the set-up: the motion is in them as before, and must be read as before.

Each row changes the messages of a healthy log. `python -m tests.studies.set_ups.forms [--seed S] [--row ID ...]` reads the log before and
after, and prints what became of each source: same, changed or lost; and whether anything is accused.
"""

from __future__ import annotations

import argparse
import copy
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localization.evidence.entrance import infer, read_sources
from localization.evidence.signals import Source
from localization.logs import open_log
from motion_models.robot import Robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import with_times
from tests.helpers.set_up_drives import TOPICS, drawn_log
from tests.studies.set_ups.symptoms import Change, stamp_of

WHEELS, DRIVER, GYRO, LIDAR = (TOPICS[source] for source in ("wheels", "driver", "gyro", "lidar"))
SAME = 0.12
"""Relative difference (root mean square over bins) up to which a source is read as before: steps of encoders and interpolation."""
LOST = 0.15
"""Share of a source's bins that may be missing."""


@dataclass(frozen=True)
class Form:
    """One row."""

    id: str
    change: Change
    source: str = "wheels"
    """Wheels or driver: which of the two the log has."""
    is_in_order: bool = False
    """Whether records are written in the order of ``change`` rather than by their times."""


# changes of messages


def messages(topic: str, change: Callable[[Any, float], Any]) -> Change:
    """Messages of ``topic`` and their times [s] to a message, to a list of topics and messages, or to None."""

    def edit(records: list[Record]) -> list[Record]:
        found: list[Record] = []
        for t, m, at in records:
            new = change(copy.deepcopy(m), (stamp_of(m) - START) / S) if t == topic else m
            rows = new if isinstance(new, list) else [] if new is None else [(t, new)]
            found += [(name, one, at) for name, one in rows]
        return found

    return edit


def stamped(topics: Sequence[str], stamp: Callable[[float, int], float]) -> Change:
    """Header stamps of ``topics`` by time of measurement and number of the message [s]."""

    def edit(records: list[Record]) -> list[Record]:
        counts = dict.fromkeys(topics, 0)
        found: list[Record] = []
        for t, m, at in records:
            if t in counts:
                new = stamp((stamp_of(m) - START) / S, counts[t])
                m, counts[t] = with_times(copy.deepcopy(m), lambda ns, new=new: max(START + round(new * S), 0)), counts[t] + 1
            found.append((t, m, at))
        return found

    return edit


def recorded(topics: Sequence[str], late_s: Callable[[float], float]) -> Change:
    """Times of recording of ``topics`` later by seconds of the time."""
    return lambda records: [(t, m, at + round(late_s((at - START) / S) * S) if t in topics else at) for t, m, at in records]


def latched(topic: str, *ages_s: float) -> Change:
    """The topic begins with messages of these ages."""

    def edit(records: list[Record]) -> list[Record]:
        first = next(m for t, m, _ in records if t == topic)
        old = [(topic, with_times(copy.deepcopy(first), lambda ns, a=a: ns - round(a * S)), START + i) for i, a in enumerate(ages_s)]
        return [*old, *records]

    return edit


def joints(change: Callable[[Any, np.ndarray, np.ndarray], tuple[Any, Any, Any]]) -> Change:
    """Names, angles and rates changed."""

    def edit(m: Any, _: float) -> Any:
        return bags.joint_state(stamp_of(m), *change(list(m.name), np.array(m.position), np.array(m.velocity)))

    return messages(WHEELS, edit)


def both(*changes: Change) -> Change:
    """One after the other."""

    def edit(records: list[Record]) -> list[Record]:
        for change in changes:
            records = change(records)
        return records

    return edit


def _parts(topic_of: Callable[[str], str], sides: Sequence[slice]) -> Change:
    """Wheels in messages of their own."""

    def edit(m: Any, _: float) -> list[tuple[str, Any]]:
        found = []
        for side in sides:
            names = m.name[side]
            found.append((topic_of(names[0]), bags.joint_state(stamp_of(m), names, np.array(m.position)[side], np.array(m.velocity)[side])))
        return found

    return messages(WHEELS, edit)


def _twist(kind: str) -> Change:
    """The driver's velocity alone."""

    def edit(m: Any, _: float) -> list[tuple[str, Any]]:
        of = {"TwistStamped": m.twist.twist, "TwistWithCovarianceStamped": m.twist}[kind]
        return [("/base/velocity", bags.T[f"geometry_msgs/msg/{kind}"](header=bags.header(stamp_of(m), "base_link"), twist=of))]

    return messages(DRIVER, edit)


def _transform(m: Any, _: float) -> list[tuple[str, Any]]:
    p, q = m.pose.pose.position, m.pose.pose.orientation
    return [("/tf", bags.tf(stamp_of(m), [("odom", "base_link", (p.x, p.y, 0.0), q)]))]


def _restart(at_s: float) -> Change:
    """Angles begin at zero again."""
    origin: dict[str, np.ndarray] = {}

    def edit(m: Any, t: float) -> Any:
        if t > at_s:
            m.position = np.array(m.position) - origin.setdefault("first", np.array(m.position))
        return m

    def anew(records: list[Record]) -> list[Record]:
        origin.clear()
        return messages(WHEELS, edit)(records)

    return anew


def _zeros_beside(m: Any, _: float) -> list[tuple[str, Any]]:
    """A joint_state_publisher runs as well."""
    zeros = np.zeros(len(m.name))
    return [(WHEELS, m), (WHEELS, bags.joint_state(stamp_of(m) + S // 200, list(m.name), zeros, zeros))]


def _jitter(m: Any, t: float) -> Any:
    """A yaw rate by differences of angles over one period: H401 of a public bag."""
    m.twist.twist.angular.z += 0.4 * math.sin(997.0 * t)
    return m


def _set(name: str, value: float, when: Callable[[float], bool]) -> Callable[[Any, float], Any]:
    def edit(m: Any, t: float) -> Any:
        if when(t):
            setattr(m.angular_velocity, name, value)
        return m

    return edit


def _clockwise(m: Any, _: float) -> Any:
    """Beams in the other order."""
    m.ranges = m.ranges[::-1].copy()
    m.angle_min, m.angle_max = m.angle_max, m.angle_min
    m.angle_increment, m.time_increment = -m.angle_increment, 0.0
    return m


def _in_namespace(records: list[Record]) -> list[Record]:
    return [(t if t.startswith("/tf") else f"/robot7{t}", m, at) for t, m, at in records]


def _twice(topic: str) -> Change:
    return messages(topic, lambda m, _: [(topic, m), (topic, copy.deepcopy(m))])


DAY = 86400.0
FORMS: tuple[Form, ...] = (
    Form("first joint states an hour old", latched(WHEELS, 3600.0)),
    Form("three first scans of the last session", latched(LIDAR, 9.0, 8.8, 8.6)),
    Form("first messages of the gyro 4 s old", latched(GYRO, 4.0, 3.9)),
    Form("first odometries of yesterday", latched(DRIVER, DAY, DAY - 0.1), "driver"),
    Form("gyro without stamps", stamped([GYRO], lambda t, i: -1e18)),
    Form("gyro of another day", stamped([GYRO], lambda t, i: t - 3.0 * DAY)),
    Form("LiDAR since it was switched on", stamped([LIDAR], lambda t, i: t + 40.0 - START / S)),
    Form("wheels in GPS time of another epoch", stamped([WHEELS], lambda t, i: t - 315964782.0)),
    Form("LiDAR jumps by 1.4 s", stamped([LIDAR], lambda t, i: t - 1.4 * (t > 15.0))),
    Form("gyro jumps by .8 s and back", stamped([GYRO], lambda t, i: t + 0.8 * (14.0 < t < 22.0))),
    Form("wheels and gyro jump together", stamped([WHEELS, GYRO], lambda t, i: t + 1.1 * (t > 15.0))),
    Form("one message of wheels in 40 an hour ahead", stamped([WHEELS], lambda t, i: t + 3600.0 * (i % 40 == 39))),
    Form("scans in bursts of 2.5 s", recorded([LIDAR], lambda t: 2.5 - t % 2.5)),
    Form("all in bursts of half a second", recorded([WHEELS, GYRO, LIDAR], lambda t: 0.5 - t % 0.5)),
    Form("scans .7 s late, stamps right", recorded([LIDAR], lambda t: 0.7)),
    Form("queue that grows to 2 s", recorded([LIDAR], lambda t: min(0.05 * t, 2.0))),
    Form("a recorder that pauses for 4 s", recorded([WHEELS, GYRO, LIDAR], lambda t: max(16.0 - t, 0.0) if t > 12.0 else 0.0)),
    Form("each message of the gyro twice", _twice(GYRO)),
    Form("each message of the wheels twice", _twice(WHEELS)),
    Form("a message for each wheel", _parts(lambda name: WHEELS, [slice(i, i + 1) for i in range(4)])),
    Form("a topic for each side", _parts(lambda name: f"/{name}/joint_states", [slice(0, 2), slice(2, 4)])),
    Form("a topic for each wheel", _parts(lambda name: f"/{name}/state", [slice(i, i + 1) for i in range(4)])),
    Form("joints in another order each time", joints(lambda n, a, r: (n[::-1], a[::-1], r[::-1]))),
    Form("joints with the robot's name before them", joints(lambda n, a, r: ([f"a300_0001/{name}" for name in n], a, r))),
    Form("joints of an arm in the same messages", joints(lambda n, a, r: (["lift", *n], [0.2, *a], [0.0, *r]))),
    Form("angles that wrap at half a turn", joints(lambda n, a, r: (n, (a + math.pi) % math.tau - math.pi, r))),
    Form("angles that begin at 250,000 rad", joints(lambda n, a, r: (n, a + 250000.0, r))),
    Form("angles that never change", joints(lambda n, a, r: (n, 0.0 * a, r))),
    Form("rates that are always zero", joints(lambda n, a, r: (n, a, 0.0 * r))),
    Form("encoders restart while driving", _restart(20.0)),
    Form("encoders restart, no rates", both(_restart(20.0), joints(lambda n, a, r: (n, a, [])))),
    Form("a second publisher of zeros", messages(WHEELS, _zeros_beside)),
    Form("TwistStamped alone", _twist("TwistStamped"), "driver"),
    Form("TwistWithCovarianceStamped alone", _twist("TwistWithCovarianceStamped"), "driver"),
    Form("odometry on /tf alone", messages(DRIVER, _transform), "driver"),
    Form("yaw rate that jitters by .4 rad/s", messages(DRIVER, _jitter), "driver"),
    Form("gyro not a number now and then", messages(GYRO, _set("z", math.nan, lambda t: t % 3.0 < 0.1))),
    Form("beams clockwise", messages(LIDAR, _clockwise)),
    Form("all in a namespace", _in_namespace),
)
"""A form is one row."""


def drawn(seed: int, source: str) -> tuple[Robot, list[Record]]:
    """A healthy robot of four wheels whose joints have angles and rates, with gyro and LiDAR."""
    rng = np.random.default_rng([seed, 61])
    names = (source, "gyro", "lidar")
    while True:
        found = drawn_log(rng, names)
        if len(found.base.left) == 2 and (source == "driver" or (found.base.fields == "both" and found.base.counts > 500)):
            return found.robot, found.records


def read(records: list[Record], robot: Robot, form: Form | None, is_judged: bool = True) -> tuple[Mapping[str, Source], tuple[str, ...]]:
    """Sources by kind, and what is accused where the log ``is_judged``."""
    with tempfile.TemporaryDirectory() as folder:
        changed = records if form is None else form.change(records)
        ordered = changed if form is not None and form.is_in_order else sorted(changed, key=lambda record: record[2])
        log = open_log(bags.write_mcap(Path(folder) / "log.mcap", ordered), robot)
        sources = read_sources(log)
        return {source.kind: source for source in sources}, infer(sources, log.robot).sentences if is_judged else ()


def compare(before: Source, after: Source | None) -> str:
    """Same, lost or changed, of one source."""
    if after is None:
        return "lost"
    shift = 1e-9 * (before.first_ns - after.first_ns)
    edges = np.arange(before.t[0] + 0.5, before.t[-1] - 0.5, 0.5)
    ours, theirs = _best_field(before, edges), _best_field(after, edges + shift)
    known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    if known.sum() < (1.0 - LOST) * np.isfinite(ours).all(axis=1).sum():
        return "lost"
    error = math.sqrt(float(np.mean((ours - theirs)[known] ** 2)) / float(np.mean(ours[known] ** 2)))
    return "same" if error < SAME else f"changed by {100.0 * error:.0f} %"


def _best_field(source: Source, edges: np.ndarray) -> np.ndarray:
    """(n, c) rates by the first field, those by the second where that is unknown or does not move."""
    first = source.rates(edges)
    if source.second is None:
        return first
    second = source.rates(edges, of_second=True)
    return np.where(np.isfinite(first), first, second) if np.nanmax(np.abs(first), initial=0.0) > 1e-6 else second


def judge(form: Form, seed: int) -> dict[str, str]:
    """By source what became of it, and what was accused; empty where all is as before."""
    robot, records = drawn(seed, form.source)
    healthy, _ = read(records, robot, None, is_judged=False)
    found, accused = read(records, robot, form)
    outcomes = {kind: compare(source, found.get(kind)) for kind, source in healthy.items()}
    return {**{k: o for k, o in outcomes.items() if o != "same"}, **({"accused": " ".join(accused)} if accused else {})}


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--row", nargs="*", default=[], help="ids, or parts of them")
    given = parser.parse_args()
    forms = [form for form in FORMS if not given.row or any(part in form.id for part in given.row)]
    wrong = 0
    for form in forms:
        try:
            found = judge(form, given.seed)
        except Exception as error:  # a study goes on
            found = {"failed": f"{type(error).__name__}: {error}"}
        wrong += bool(found)
        print(f"{form.id:45s} {'; '.join(f'{k}: {v[:200]}' for k, v in found.items()) or 'same'}", flush=True)
    print(f"{len(forms) - wrong} of {len(forms)} forms are read as before")


if __name__ == "__main__":
    main()
