"""Localization in saved maps: maps of one half of a log, starts in the other half, and in maps of other buildings.

``python -m tests.studies.localization`` prints five tables. *Starts*: the robot is put down at random moments of one half, the map is of
the other half, and it drives for ``--seconds``; keyframes and truth are those of the smoothed graph of the whole log. They are counted
three ways: all; those whose last scan has a score of at least 0.5 in the map, at the true pose; and those mapped, for which all that the
robot has measured, its scans joined at the true poses, has it. Of a robot that comes from ground that the map does not have, the last scan
alone may be mapped, and most of what it has to search with is not. Where a start is not mapped, the right answer is that the place is not
known; those localized all the same are counted apart. Right is within 0.5 m and 0.2 rad. Times are medians of mapped starts
that are localized. *Reliability*: of all keyframes by the probability that was given, and of all searches by weights that were fitted to
the other buildings. *Drives*: the second half of each log, replayed in the map of the first, and the reverse; errors while the state is
localized, where the map has most of the walls and outside of it, where the pose is by odometry. *Carried*: the same drives with cuts
(`tests.studies.localization_carried`).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from localization.estimators import MapFusion, PriorMap
from localization.maps import KeyframeMap
from localization.maps.localizer import Localizer
from localization.maps.place_probability import LIKELY
from localization.maps.place_search import PlaceMap
from localization.pipeline import Pipeline, Trial
from motion_models import se2
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS, Drive
from tests.studies.localization_carried import print_tables
from tests.studies.localization_halves import MAP_STRIDE, MAPPED_SCORE, dense_map, halves, joined_score, off
from tests.studies.localization_reliability import Moment, RecordedSearches, Search, draw, held_out
from tests.studies.localization_reliability import table as reliability_table

STEP_M, STEP_RAD = 0.5, 0.3
COV = np.diag([0.01, 0.01, 0.005]) ** 2
_ON_WALL_M, _MAPPED_SHARE = 0.3, 0.5
"""A keyframe is outside of a map where less than this share of its points is this near to points of the map, at the true pose."""


@dataclass(frozen=True)
class Start:
    """One start: state and probability at its end, and whether the place is right."""

    is_mapped: bool
    is_scan_mapped: bool
    """Whether the last scan alone is."""
    rank: int
    """Of the right place among those that are listed, from 1 on; 0 without it."""
    state: str
    probability: float
    is_right: bool
    error_m: float
    localized_after_s: float
    cpu_s: float
    """CPU until it was localized [s], or until the end."""


def run_start(
    places: RecordedSearches, keyframes: KeyframeMap, scans: Sequence[np.ndarray], ids: np.ndarray, name: str, is_same: bool
) -> tuple[Start, list[Moment], list[Search]]:
    """Keyframes ``ids`` of building ``name`` in a row, from an unknown place: its end, the probabilities, and what searches found."""
    localizer, last, after, spent = Localizer(places), None, math.nan, 0.0
    measured, moments, searches, kind = [], [], [], "starts" if is_same else "starts in maps of other buildings"
    truth = keyframes.poses[ids[0]]
    for k in ids:
        pose = keyframes.poses[k]
        delta = np.zeros(3) if last is None else se2.between(last, pose)
        if last is not None and math.hypot(delta[0], delta[1]) < STEP_M and abs(delta[2]) < STEP_RAD:
            continue
        begin, n_before = time.process_time(), len(places.found)
        localizer.add(scans[k], delta, np.zeros((3, 3)) if last is None else COV)
        spent += time.process_time() - begin if math.isnan(after) else 0.0
        last = truth = pose
        measured.append(k)
        if localizer.state == "localized" and math.isnan(after):
            after = (keyframes.stamps_ns[k] - keyframes.stamps_ns[ids[0]]) * 1e-9
        searches += [Search(name, found, n, is_same and off(truth, found[0].pose)[1]) for found, n in places.found[n_before:]]
        moments.append(Moment(kind, name, localizer.probability, is_same and off(truth, _best(localizer))[1]))
    error, is_near = off(truth, _best(localizer))
    is_right = is_same and is_near
    is_mapped, is_scan_mapped = (is_same and joined_score(places, keyframes, of) >= MAPPED_SCORE for of in (measured, measured[-1:]))
    rank = next((n for n, place in enumerate(localizer.hypotheses, 1) if is_same and off(truth, place.pose)[1]), 0)
    start = Start(is_mapped, is_scan_mapped, rank, localizer.state, localizer.probability, is_right, error, after, spent)
    return start, moments, searches


def _best(localizer: Localizer) -> np.ndarray:
    """(3,) the pose that is given, or the best place of the last search."""
    return localizer.pose if localizer.state == "localized" or not localizer.hypotheses else localizer.hypotheses[0].pose


def starts(
    maps: dict[str, KeyframeMap], map_name: str, name: str, n: int, seconds: float, seed: int = 1
) -> list[tuple[Start, list[Moment], list[Search]]]:
    """``n`` starts in each half of building ``name`` in turn, in the map of the other half of ``map_name``: the first of them do not depend
    on ``n``."""
    keyframes = maps[name]
    sides = [RecordedSearches(maps[map_name].select(half[::MAP_STRIDE]), 0.02) for half in halves(maps[map_name])]
    scans = keyframes.scans()
    return [run_start(sides[i], keyframes, scans, way, name, name == map_name) for i, way in ways(keyframes, n, seconds, seed)]


def ways(keyframes: KeyframeMap, n: int, seconds: float, seed: int = 1) -> Iterator[tuple[int, np.ndarray]]:
    """The keyframes of ``seconds`` from ``n`` random ones of each half on, in turn, and which half is the map."""
    rng, driven = np.random.default_rng(seed), halves(keyframes)[::-1]
    for _ in range(n):
        for i, ids in enumerate(driven):
            k = rng.integers(ids[0], ids[-1] - 20)
            until = keyframes.stamps_ns[k] + seconds * 1e9
            yield i, np.array([j for j in ids if j >= k and keyframes.stamps_ns[j] <= until])


def table(title: str, found: Sequence[Start]) -> str:
    """One row of the table of starts."""
    mapped = [s for s in found if s.is_mapped]
    localized = [s for s in found if s.state == "localized"]
    wrong = sum(not s.is_right and s.probability > LIKELY for s in found)
    first = [s for s in mapped if not math.isnan(s.localized_after_s)]
    cells = [
        title,
        _right([s.is_right for s in found]),
        _right([s.is_right for s in found if s.is_scan_mapped]),
        _right([s.is_right for s in mapped]),
        f"{sum(s.is_right or s.rank > 0 for s in mapped)}",
        f"{sum(s.state == 'localized' for s in mapped)}",
        " / ".join(str(n) for n in _unmapped(found)),
        f"{len(localized)} / {sum(not s.is_right for s in localized)}",
        str(wrong),
        f"{np.median([s.localized_after_s for s in first]):.1f}" if first else "-",
        f"{np.median([s.cpu_s for s in first]):.2f}" if first else "-",
    ]
    return "| " + " | ".join(cells) + " |"


def _unmapped(found: Sequence[Start]) -> tuple[int, int, int, int]:
    """Of the starts that are not mapped: how many there are, localized and right, not localized, localized and wrong."""
    rest = [s for s in found if not s.is_mapped]
    right = [s.is_right for s in rest if s.state == "localized"]
    return len(rest), sum(right), len(rest) - len(right), len(right) - sum(right)


def _right(are_right: Sequence[bool]) -> str:
    """How many of how many."""
    share = f" ({100 * np.mean(are_right):.1f} %)" if len(are_right) else ""
    return f"{sum(are_right)} of {len(are_right)}{share}"


def drive_row(name: str, drive: Drive, keyframes: KeyframeMap, i: int) -> str:
    """Half 1 - i of the log in the map of half i: errors while localized, times, and the cost against the filter's alone."""
    mapped = keyframes.select(halves(keyframes)[i][::MAP_STRIDE])
    places = PlaceMap(mapped, 0.02)
    ids = halves(keyframes)[1 - i]
    begin, end = keyframes.stamps_ns[ids[0]], keyframes.stamps_ns[ids[-1]]
    model = make_model("diff_drive", drive.robot)
    trials = Trial(model, "map", prior=PriorMap(places)), Trial(model, "ekf")
    located, alone = (Pipeline(trial, drive.robot, drive.mounts, True) for trial in trials)
    assert isinstance(located.estimator, MapFusion)
    localizer, rows, spent = located.estimator.localizer, [], np.zeros(3)  # searching; localized, and the filter alone meanwhile
    is_outside, scans = outside_of(mapped, keyframes), keyframes.scans()
    for event in drive.events:
        if not begin <= event.stamp_ns <= end:
            continue
        was_localized, clock = localizer.state == "localized", [time.process_time()]
        estimates = located.process(event)
        is_localized = localizer.state == "localized"
        located.run_deferred()
        clock.append(time.process_time())
        alone.process(event)
        alone.run_deferred()
        clock.append(time.process_time())
        spent += [0.0, *np.diff(clock)] if was_localized else [clock[1] - clock[0], 0.0, 0.0]
        for estimate in estimates:
            k = int(np.searchsorted(keyframes.stamps_ns, estimate.stamp_ns))
            if k < len(keyframes.stamps_ns) and keyframes.stamps_ns[k] == estimate.stamp_ns and len(scans[k]):
                error = math.hypot(*(estimate.pose[:2] - keyframes.poses[k, :2]))
                rows.append((estimate.stamp_ns * 1e-9, error, is_localized, is_outside(k)))
    found = located.estimator.localization()
    t, error, localized, outside = (np.array(column) for column in zip(*rows, strict=True))
    cells = [
        f"{name}, map of half {i + 1}",
        _errors(error[localized & ~outside]),
        _errors(error[localized & outside]),
        f"{100 * outside.mean():.0f}",
        " / ".join(f"{found[key]:.0f}" for key in ("localized_s", "searching_s", "lost_s")),
        "-" if found["first_localized_s"] is None else f"{found['first_localized_s']:.1f}",
        f"{longest_unknown_s(t, localized, outside):.1f}",
        f"{spent[0]:.1f}",
        f"{spent[1] / max(spent[2], 1e-9):.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def outside_of(mapped: KeyframeMap, keyframes: KeyframeMap) -> Callable[[int], bool]:
    """Whether keyframe k of ``keyframes`` is outside of the map: most of its scan, at the true pose, is where ``mapped`` has no points."""
    walls, scans = cKDTree(mapped.points_in_map()), keyframes.scans()

    def is_outside(k: int) -> bool:
        distances, _ = walls.query(se2.transform(keyframes.poses[k], scans[k]))
        return bool((distances < _ON_WALL_M).mean() < _MAPPED_SHARE)

    return is_outside


def longest_unknown_s(t: np.ndarray, localized: np.ndarray, outside: np.ndarray) -> float:
    """The longest time [s] without a place, of moments ``t`` (N,) [s] after the first place that are not outside of the map."""
    longest, since = 0.0, None
    for k in range(int(np.argmax(localized)), len(t)):
        if localized[k] or outside[k]:
            longest, since = max(longest, 0.0 if since is None else t[k] - since), None
        elif since is None:
            since = t[k]
    return longest if since is None else max(longest, t[-1] - since)


def _errors(errors: np.ndarray) -> str:
    if not len(errors):
        return "-"
    return f"{np.median(errors):.3f} / {np.quantile(errors, 0.95):.3f} / {errors.max():.2f}"


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--starts", type=int, default=100, help="in each half")
    parser.add_argument("--seed", type=int, default=1, help="of the starts")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--no-drives", action="store_true")
    parser.add_argument("--figure", type=Path, help="new file for the reliability diagram, .png or .svg")
    options = parser.parse_args(words)
    drives = {name: BUILDINGS[name].open() for name in options.log.split(",")}
    maps = {name: dense_map(drive) for name, drive in drives.items()}
    columns = "right of all | of those with a mapped last scan | of those mapped | listed, mapped | localized, mapped"
    unmapped = "not mapped: starts / localized and right / not localized / wrong"
    print(f"| map, starts | {columns} | {unmapped} | localized / wrong, all | wrong above 0.9 | driving, median [s] | CPU until then [s] |")
    print("|---" * 11 + "|")
    same: list[Start] = []
    moments: list[Moment] = []
    searches: list[Search] = []
    for map_name in maps:
        for name in maps:
            found = starts(maps, map_name, name, options.starts if name == map_name else options.starts // 4, options.seconds, options.seed)
            moments += [moment for _, said, _ in found for moment in said]
            searches += [search for _, _, of_start in found for search in of_start]
            same += [start for start, _, _ in found if name == map_name]
            print(table(f"{map_name}, {name}", [start for start, _, _ in found]), flush=True)
    print(table("together, in maps of their own building", same))
    moments += held_out(searches)
    print(f"\nReliability: number of keyframes and share that is right [%]\n\n{reliability_table(moments)}")
    if options.figure:
        draw(moments, options.figure)
    if not options.no_drives:
        columns = (
            "error inside: median / p95 / max [m] | outside of the map | outside [%] | localized / searching / lost [s] | first after [s]"
        )
        print(f"\n| drive | {columns} | longest unknown inside [s] | CPU of searches [s] | CPU localized / ekf |")
        print("|---" * 9 + "|")
        for name, drive in drives.items():
            for i in (0, 1):
                print(drive_row(name, drive, maps[name], i), flush=True)
        print()
        print_tables(drives, maps, (0.0, 35.0))


if __name__ == "__main__":
    main()
