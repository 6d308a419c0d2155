"""Robots that are carried while they are localized: logs with gaps, replayed in the map of the other half.

``python -m tests.studies.localization_carried`` cuts 30 s out of every 70 s of the second half of each log, replayed in the map of the
first, and the reverse; ``--phases`` [s] shift where the cuts are. The first table splits the time after the cut: until the state is no
longer ``localized``, until the right place is the most probable of those listed and stays so, and until it is localized there. The second
one counts four ways, for a place that the map does not have cannot be found:

- *all*: every cut with ten seconds or more before the next one, from the cut on;
- *ground*: those whose first ten seconds the map has: the scans joined at their true poses have a score of at least 0.5, as of starts;
- *scan*: those with one scan of that score, ten seconds or more before the next cut, from that scan on; and by the time of driving alone,
  for until a robot has driven 1 m its scans are one view of the place;
- *outside*: those of all that are not on mapped ground. That the place is not known is the right answer there; that another one was taken,
  at any keyframe, is not.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from localization.estimators import MapFusion, PriorMap
from localization.maps import KeyframeMap
from localization.maps.place_probability import LIKELY
from localization.maps.place_search import PlaceMap
from localization.pipeline import Pipeline, Trial
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS, Drive
from tests.studies.localization_halves import MAP_STRIDE, MAPPED_SCORE, dense_map, halves, joined_score, off

CYCLE_S, KEPT_S = 70.0, 40.0
_DRIVING, _MAX_STEP_S = 0.05, 1.0
"""The robot drives where its speed or its turn is faster [m/s, rad/s]; and a step at most [s], of what is not cut out."""
FOUND_WITHIN_S = 10.0
"""A carried robot shall be found within this time [s]. A cut with less time on mapped ground counts only if it is found."""
_NEVER = np.full(2, np.nan)


@dataclass
class Carry:
    """One cut. Times (2,) are of the log and of driving [s], NaN for what did not happen."""

    cut: np.ndarray
    left_s: float
    """Until the next cut, or the end."""
    lost: np.ndarray = field(default_factory=_NEVER.copy)
    """When the state was first another one than localized."""
    mapped: np.ndarray = field(default_factory=_NEVER.copy)
    """When one scan was first mapped, with `FOUND_WITHIN_S` left."""
    listed_first: np.ndarray = field(default_factory=_NEVER.copy)
    """Since when the right place is the most probable one."""
    localized: np.ndarray = field(default_factory=_NEVER.copy)
    """Since when the robot is localized, as it is now."""
    found: np.ndarray = field(default_factory=_NEVER.copy)
    """`localized`, where that was the right place."""
    wrong_s: float = 0.0
    """Until the last wrong place."""
    first_keyframes: list[int] = field(default_factory=list)
    """Of `FOUND_WITHIN_S` after the cut."""

    @property
    def is_found(self) -> bool:
        return not math.isnan(self.found[0])

    def after(self, begin: np.ndarray) -> np.ndarray:
        """(2,) times from ``begin`` (2,) until it was found, infinite if it was not."""
        begin = self.cut if math.isnan(begin[0]) else begin
        return np.maximum(self.found - begin, 0.0) if self.is_found else np.full(2, np.inf)

    def look(self, now: np.ndarray, is_localized: bool) -> None:
        """The state at ``now`` (2,)."""
        if math.isnan(self.lost[0]) and not is_localized:
            self.lost = now.copy()
        if not is_localized or math.isnan(self.localized[0]):
            self.localized = now.copy() if is_localized else _NEVER.copy()

    def compare(self, now: np.ndarray, is_mapped: bool, is_right: bool) -> None:
        """At ``now`` (2,), whether the scan is mapped and the most probable place is right."""
        if math.isnan(self.mapped[0]) and is_mapped and self.left_s - (now[0] - self.cut[0]) >= FOUND_WITHIN_S:
            self.mapped = now.copy()
        if not is_right or math.isnan(self.listed_first[0]):
            self.listed_first = now.copy() if is_right else _NEVER.copy()
        if not math.isnan(self.localized[0]):
            self.found, self.wrong_s = (self.localized, self.wrong_s) if is_right else (self.found, now[0] - self.cut[0])


@dataclass(frozen=True)
class Carried:
    """The cuts of one drive, and its keyframes above `LIKELY`."""

    title: str
    carries: Sequence[Carry]
    has_ground: Sequence[bool]
    """Whether the map has the first ten seconds after each cut."""
    n_above: int
    n_wrong: int


def run(name: str, drive: Drive, keyframes: KeyframeMap, i: int, phase_s: float) -> Carried:
    """Half 1 - i of the log in the map of half i, with cuts that are ``phase_s`` earlier [s]."""
    places = PlaceMap(keyframes.select(halves(keyframes)[i][::MAP_STRIDE]), 0.02)
    begin, end = keyframes.stamps_ns[halves(keyframes)[1 - i][[0, -1]]]
    pipeline = Pipeline(Trial(make_model("diff_drive", drive.robot), "map", prior=PriorMap(places)), drive.robot, drive.mounts, True)
    estimator, scans = pipeline.estimator, keyframes.scans()
    assert isinstance(estimator, MapFusion)
    carries: list[Carry] = []
    now, last_ns, cycle, above = np.zeros(2), 0, None, np.zeros(2, dtype=int)
    for event in drive.events:
        now[0] = (event.stamp_ns - begin) * 1e-9
        if not begin <= event.stamp_ns <= end or (now[0] + phase_s) % CYCLE_S > KEPT_S:
            continue
        if (now[0] + phase_s) // CYCLE_S != cycle:
            left_s = min(KEPT_S - (now[0] + phase_s) % CYCLE_S, (end - begin) * 1e-9 - now[0])
            carries += [] if cycle is None else [Carry(now.copy(), left_s)]
            cycle = (now[0] + phase_s) // CYCLE_S
        for estimate in pipeline.process(event):
            is_kept = ((estimate.stamp_ns - begin) * 1e-9 + phase_s) % CYCLE_S <= KEPT_S
            is_driving = is_kept and np.abs(estimate.twist).max() > _DRIVING
            now[1] += min((estimate.stamp_ns - last_ns) * 1e-9, _MAX_STEP_S) if is_driving else 0.0
            last_ns, is_localized = estimate.stamp_ns, estimator.localizer.state == "localized"
            carry = carries[-1] if carries and not carries[-1].is_found else None
            if carry is not None:
                carry.look(now, is_localized)
            k = int(np.searchsorted(keyframes.stamps_ns, estimate.stamp_ns))
            if k >= len(keyframes.stamps_ns) or keyframes.stamps_ns[k] != estimate.stamp_ns:
                continue
            is_right = off(keyframes.poses[k], estimate.pose)[1]
            above += estimator.probability > LIKELY, estimator.probability > LIKELY and not is_right
            if carries and now[0] - carries[-1].cut[0] <= FOUND_WITHIN_S:
                carries[-1].first_keyframes.append(k)
            if carry is not None:
                is_mapped = len(scans[k]) > 0 and places.align(scans[k], keyframes.poses[k]).score >= MAPPED_SCORE
                carry.compare(now, is_mapped, is_right if is_localized else _is_first(estimator, keyframes.poses[k]))
    has_ground = [joined_score(places, keyframes, carry.first_keyframes) >= MAPPED_SCORE for carry in carries]
    return Carried(f"{name}, map of half {i + 1}, {phase_s:g} s", carries, has_ground, *above.tolist())


def _is_first(estimator: MapFusion, truth: np.ndarray) -> bool:
    """Whether the most probable place of those listed is the right one: where the robot was at the last keyframe, half a metre ago."""
    found = estimator.localizer.hypotheses
    return bool(found) and off(truth, found[0].pose)[1]


def delays_row(found: Carried) -> str:
    """How the time after the cuts is spent, of those that were found."""
    carries = [carry for carry in found.carries if carry.is_found]
    columns = [[getattr(carry, name)[0] - carry.cut[0] for carry in carries] for name in ("lost", "listed_first", "found")]
    return _row([found.title, f"{len(carries)} of {len(found.carries)}", *map(_quantiles, columns)])


def counts_row(found: Carried) -> str:
    """How many were found and within ten seconds: of all, on mapped ground and outside of it, and of those with a mapped scan."""
    pairs = list(zip(found.carries, found.has_ground, strict=True))
    every = [carry for carry, _ in pairs if carry.left_s >= FOUND_WITHIN_S]
    ground = [carry for carry, has_ground in pairs if carry.left_s >= FOUND_WITHIN_S and has_ground]
    outside = [carry for carry, has_ground in pairs if carry.left_s >= FOUND_WITHIN_S and not has_ground]
    scan = [carry for carry in found.carries if carry.is_found or not math.isnan(carry.mapped[0])]
    of_driving = sum(carry.after(carry.mapped)[1] <= FOUND_WITHIN_S for carry in scan)
    cells = [_counts(every, [carry.cut for carry in every]), _counts(ground, [carry.cut for carry in ground])]
    cells += [f"{_counts(outside, [carry.cut for carry in outside])} / {sum(carry.wrong_s > 0.0 for carry in outside)}"]
    cells += [f"{_counts(scan, [carry.mapped for carry in scan])} / {of_driving}"]
    wrong_s = max((carry.wrong_s for carry in found.carries), default=0.0)
    return _row([found.title, *cells, f"{wrong_s:.1f}", f"{found.n_wrong} of {found.n_above}"])


def _counts(carries: Sequence[Carry], begins: Iterable[np.ndarray]) -> str:
    n_soon = sum(carry.after(begin)[0] <= FOUND_WITHIN_S for carry, begin in zip(carries, begins, strict=True))
    return f"{len(carries)} / {sum(carry.is_found for carry in carries)} / {n_soon}"


def _quantiles(values: Sequence[float]) -> str:
    known = [value for value in values if not math.isnan(value)]
    return f"{np.median(known):.1f} / {np.quantile(known, 0.9):.1f}" if known else "-"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def pooled(runs: Sequence[Carried]) -> Carried:
    """All ``runs`` as one."""
    carries = [carry for found in runs for carry in found.carries]
    has_ground = [ground for found in runs for ground in found.has_ground]
    return Carried("together", carries, has_ground, sum(found.n_above for found in runs), sum(found.n_wrong for found in runs))


def print_tables(drives: dict[str, Drive], maps: dict[str, KeyframeMap], phases: Sequence[float]) -> None:
    """Both tables, of each half of each drive."""
    runs = [run(name, drives[name], maps[name], i, phase) for phase in phases for name in drives for i in (0, 1)]
    runs.append(pooled(runs))
    print("| carried | found | lost reported after [s] | right place first after | localized there after |\n" + "|---" * 5 + "|")
    print("\n".join(delays_row(found) for found in runs))
    counted = "cuts / found / within 10 s"
    columns = f"all: {counted} | ground: {counted} | outside: {counted} / wrong | scan: {counted} / of driving"
    print(f"\n| carried | {columns} | wrong, longest [s] | wrong above 0.9 |\n" + "|---" * 7 + "|")
    print("\n".join(counts_row(found) for found in runs), flush=True)


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--phases", default="0,35", help="how much earlier the cuts are [s], separated by commas")
    options = parser.parse_args(words)
    drives = {name: BUILDINGS[name].open() for name in options.log.split(",")}
    print_tables(drives, {name: dense_map(drive) for name, drive in drives.items()}, [float(word) for word in options.phases.split(",")])


if __name__ == "__main__":
    main()
