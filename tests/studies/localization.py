"""Localization in saved maps: maps of one half of a log, starts in the other half, and in maps of other buildings.

``python -m tests.studies.localization`` prints four tables. *Starts*: the robot is put down at random moments of one half, the map is of
the other half, and it drives for ``--seconds``; keyframes and truth are those of the smoothed graph of the whole log. A start is
mapped where all that the robot has measured, its scans joined at the true poses, has a score of at least 0.5 in the map: of a robot that
comes from ground that the map does not have, the last scan alone may be mapped, and most of what it has to search with is not. Right is
within 0.5 m and 0.2 rad. Times are medians of mapped starts that are localized. *Reliability*: of all
keyframes by the probability that was given, and of all searches by weights that were fitted to the other buildings. *Drives*: the second
half of each log, replayed in the map of the first, and the reverse; errors while the state is localized, where the map has most of the
walls and outside of it, where the pose is by odometry. *Carried*: the same drives with cuts; times count from where the scan
at the true pose is mapped, ten seconds or more before the next cut or the end: a place that the map does not have cannot be found. Those
of driving leave out how long the robot stands: until it has driven 1 m, its scans are one view of the place.
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

from localization.estimators import EstimatorConfig, MapFusion, PriorMap
from localization.estimators.graph_fusion import GraphConfig
from localization.lidar.submap import voxel_means
from localization.log_replay import replay
from localization.maps import KeyframeMap
from localization.maps.localizer import LIKELY, RIGHT_M, RIGHT_RAD, Localizer
from localization.maps.place_search import PlaceMap
from localization.pipeline import Pipeline, ReplayConfig, Trial
from motion_models import se2
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS, Drive
from tests.studies.localization_reliability import Moment, RecordedSearches, Search, draw, held_out
from tests.studies.localization_reliability import table as reliability_table

_DENSE = ReplayConfig(estimator=EstimatorConfig(graph=GraphConfig(keyframe_distance_m=0.3, keyframe_angle_rad=0.2)))
MAP_STRIDE = 3
"""Of dense keyframes in a map: about 1 m, as by default."""
STEP_M, STEP_RAD = 0.5, 0.3
COV = np.diag([0.01, 0.01, 0.005]) ** 2
MAPPED_SCORE, _JOINED_M = 0.5, 0.08
"""Score from which on scans are mapped at their true pose, and voxel of joined ones [m]."""
_ON_WALL_M, _MAPPED_SHARE = 0.3, 0.5
"""A keyframe is outside of a map where less than this share of its points is this near to points of the map, at the true pose."""
_CYCLE_S, _KEPT_S = 70.0, 40.0
_DRIVING, _MAX_STEP_S = 0.05, 1.0
"""The robot drives where its speed or its turn is faster [m/s, rad/s]; and a step at most [s], of what is not cut out."""
_FOUND_WITHIN_S = 10.0
"""A carried robot shall be found within this time [s]. A cut with less time on mapped ground counts only if it is found."""


@dataclass(frozen=True)
class Start:
    """One start: state and probability at its end, and whether the place is right."""

    is_mapped: bool
    is_same: bool
    state: str
    probability: float
    is_right: bool
    error_m: float
    localized_after_s: float
    cpu_s: float
    """CPU until it was localized [s], or until the end."""


def dense_map(drive: Drive) -> KeyframeMap:
    """Keyframes every 0.3 m of the smoothed graph of the whole log."""
    pair = Trial(make_model("diff_drive", drive.robot), "graph")
    keyframes = replay(drive.events, [pair], drive.robot, drive.mounts, True, _DENSE)[0].keyframes
    assert keyframes is not None
    return keyframes


def halves(keyframes: KeyframeMap) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first and of the second half."""
    n = len(keyframes.poses)
    return np.arange(n // 2), np.arange(n // 2, n)


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
    joined = np.vstack([se2.transform(se2.between(truth, keyframes.poses[k]), scans[k]) for k in measured])
    is_mapped = is_same and places.align(voxel_means(joined, _JOINED_M), truth).score >= MAPPED_SCORE
    return Start(is_mapped, is_same, localizer.state, localizer.probability, is_right, error, after, spent), moments, searches


def _best(localizer: Localizer) -> np.ndarray:
    """(3,) the pose that is given, or the best place of the last search."""
    return localizer.pose if localizer.state == "localized" or not localizer.hypotheses else localizer.hypotheses[0].pose


def off(truth: np.ndarray, pose: np.ndarray) -> tuple[float, bool]:
    """How far ``pose`` is from the ``truth`` [m], and whether that is the same place."""
    delta = se2.between(truth, pose)
    error = math.hypot(delta[0], delta[1])
    return error, error < RIGHT_M and abs(delta[2]) < RIGHT_RAD


def starts(
    maps: dict[str, KeyframeMap], map_name: str, name: str, n: int, seconds: float
) -> list[tuple[Start, list[Moment], list[Search]]]:
    """``n`` starts in each half of building ``name`` in turn, in the map of the other half of ``map_name``: the first of them do not depend
    on ``n``."""
    keyframes = maps[name]
    sides = [RecordedSearches(maps[map_name].select(half[::MAP_STRIDE]), 0.02) for half in halves(maps[map_name])]
    scans = keyframes.scans()
    return [run_start(sides[i], keyframes, scans, way, name, name == map_name) for i, way in ways(keyframes, n, seconds)]


def ways(keyframes: KeyframeMap, n: int, seconds: float) -> Iterator[tuple[int, np.ndarray]]:
    """The keyframes of ``seconds`` from ``n`` random ones of each half on, in turn, and which half is the map."""
    rng, driven = np.random.default_rng(1), halves(keyframes)[::-1]
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
    times = [s.localized_after_s for s in mapped if not math.isnan(s.localized_after_s)]
    cells = [
        title,
        f"{len(found)} / {len(mapped)}",
        f"{100 * np.mean([s.is_right for s in mapped]):.0f}" if mapped else "-",
        f"{100 * np.mean([s.state == 'localized' for s in mapped]):.0f}" if mapped else "-",
        f"{len(localized)} / {sum(not s.is_right for s in localized)}",
        str(wrong),
        f"{np.median(times):.1f}" if times else "-",
        f"{np.median([s.cpu_s for s in mapped if not math.isnan(s.localized_after_s)]):.2f}" if times else "-",
    ]
    return "| " + " | ".join(cells) + " |"


def kidnappings_row(name: str, drive: Drive, keyframes: KeyframeMap, i: int) -> str:
    """Half 1 - i of the log in the map of half i, of which every 40 s the next 30 s are cut out: the robot is carried on meanwhile."""
    places = PlaceMap(keyframes.select(halves(keyframes)[i][::MAP_STRIDE]), 0.02)
    ids = halves(keyframes)[1 - i]
    begin, end = keyframes.stamps_ns[ids[0]], keyframes.stamps_ns[ids[-1]]
    pipeline = Pipeline(Trial(make_model("diff_drive", drive.robot), "map", prior=PriorMap(places)), drive.robot, drive.mounts, True)
    estimator = pipeline.estimator
    assert isinstance(estimator, MapFusion)
    cut, mapped, found_after, wrong_s, n, cycle, scans = None, None, [], 0.0, 0, -1, keyframes.scans()
    n_above = np.zeros(2, dtype=int)  # keyframes above `LIKELY`, and those of them that are wrong
    now, last_ns, localized = np.zeros(2), 0, None  # time of the log and of driving [s], and since when the robot is localized
    for event in drive.events:
        now[0] = (event.stamp_ns - begin) * 1e-9
        if not begin <= event.stamp_ns <= end or now[0] % _CYCLE_S > _KEPT_S:
            continue
        if now[0] // _CYCLE_S != cycle:
            cycle = now[0] // _CYCLE_S
            cut, mapped, localized = now.copy() if cycle > 0 else None, None, None
        for estimate in pipeline.process(event):
            is_driving = np.abs(estimate.twist).max() > _DRIVING and (estimate.stamp_ns - begin) * 1e-9 % _CYCLE_S <= _KEPT_S
            now[1] += min((estimate.stamp_ns - last_ns) * 1e-9, _MAX_STEP_S) if is_driving else 0.0
            last_ns, is_localized = estimate.stamp_ns, estimator.localizer.state == "localized"
            localized = (now.copy() if localized is None else localized) if is_localized else None
            k = int(np.searchsorted(keyframes.stamps_ns, estimate.stamp_ns))
            if k >= len(keyframes.stamps_ns) or keyframes.stamps_ns[k] != estimate.stamp_ns:
                continue
            n_above += estimator.probability > LIKELY, estimator.probability > LIKELY and not off(keyframes.poses[k], estimate.pose)[1]
            if cut is None:
                continue
            left = min(_KEPT_S - now[0] % _CYCLE_S, (end - begin) * 1e-9 - now[0])
            if mapped is None and left >= _FOUND_WITHIN_S and places.align(scans[k], keyframes.poses[k]).score >= MAPPED_SCORE:
                mapped, n = now.copy(), n + 1
            if localized is None:
                continue
            is_right = off(keyframes.poses[k], estimate.pose)[1]
            wrong_s = max(wrong_s, 0.0 if is_right else now[0] - cut[0])
            if is_right:
                n += mapped is None
                found_after.append(np.maximum(localized - (cut if mapped is None else mapped), 0.0))
                cut = None
    after = np.array(found_after).reshape(-1, 2)
    times = [f"{np.median(column):.1f} / {np.quantile(column, 0.9):.1f}" if len(after) else "-" for column in after.T]
    soon = [str(np.sum(column <= _FOUND_WITHIN_S)) for column in after.T]
    cells = [f"{name}, map of half {i + 1}", f"{len(after)} of {n}", *times, *soon, f"{wrong_s:.1f}", f"{n_above[1]} of {n_above[0]}"]
    return "| " + " | ".join(cells) + " |"


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
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--no-drives", action="store_true")
    parser.add_argument("--figure", type=Path, help="new file for the reliability diagram, .png or .svg")
    options = parser.parse_args(words)
    drives = {name: BUILDINGS[name].open() for name in options.log.split(",")}
    maps = {name: dense_map(drive) for name, drive in drives.items()}
    columns = "starts / mapped | right [%] | localized [%] | localized / wrong | wrong above 0.9 | after [s] | CPU until then [s]"
    print(f"| map, starts | {columns} |")
    print("|---" * 8 + "|")
    moments: list[Moment] = []
    searches: list[Search] = []
    for map_name in maps:
        for name in maps:
            found = starts(maps, map_name, name, options.starts if name == map_name else options.starts // 4, options.seconds)
            moments += [moment for _, said, _ in found for moment in said]
            searches += [search for _, _, of_start in found for search in of_start]
            print(table(f"{map_name}, {name}", [start for start, _, _ in found]), flush=True)
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
        columns = "found again, of those mapped | median / p90 [s] | of driving | within 10 s | of driving"
        print(f"\n| carried | {columns} | wrong, longest [s] | wrong above 0.9 |")
        print("|---" * 8 + "|")
        for name, drive in drives.items():
            for i in (0, 1):
                print(kidnappings_row(name, drive, maps[name], i), flush=True)


if __name__ == "__main__":
    main()
