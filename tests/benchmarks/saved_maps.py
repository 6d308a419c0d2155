"""What a saved map costs: size of its file, time to load it, and CPU of a drive that is localized in it, over that of the filter alone.

``python -m tests.benchmarks.saved_maps [--log aces] [--seconds 0] [--localized 120]``: the map is of the first ``--seconds`` of each log
(0: all of it), and the drive the first ``--localized`` seconds, started where they begin. Both estimators get each event in turn, so that
other work on the machine counts for both alike. To reach: at most 50 MB, 1 s and 1.3.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localization.estimators import PriorMap
from localization.log_replay import replay
from localization.maps import SavedMap, load_map, save_map
from localization.maps.place_search import PlaceMap
from localization.pipeline import Pipeline, Trial
from motion_models.registry import make_model
from motion_models.se2 import Pose2
from tests.studies.buildings import BUILDINGS, Drive

_RANGE_NOISE_M = 0.02
_WARM_UP_S = 20.0
_LOADS = 5


def size_and_load(drive: Drive, path: Path) -> tuple[float, float, float, PlaceMap]:
    """Size [MB], median CPU to read the file [s] and to prepare the search [s], and the map of ``drive``."""
    keyframes = replay(drive.events, [Trial(make_model("diff_drive", drive.robot), "graph")], drive.robot, drive.mounts, True)[0].keyframes
    assert keyframes is not None
    save_map(path, SavedMap(keyframes, {}))
    places, clocks = PlaceMap(keyframes, _RANGE_NOISE_M), []
    for _ in range(_LOADS):
        clock = [time.process_time()]
        mapped = load_map(path).map
        clock.append(time.process_time())
        places = PlaceMap(mapped, _RANGE_NOISE_M)
        clocks.append(np.diff([*clock, time.process_time()]))
    load_s, prepare_s = np.median(clocks, axis=0)
    return path.stat().st_size / 1e6, float(load_s), float(prepare_s), places


def cost_ratio(drive: Drive, places: PlaceMap, start: Pose2) -> tuple[float, float]:
    """CPU while localized over that of `ekf`, and the share of the time that is localized, both after the first seconds, in which kernels
    compile. ``start`` (3,): where the drive begins in the map."""
    model = make_model("diff_drive", drive.robot)
    trials = Trial(model, "map", prior=PriorMap(places, start)), Trial(model, "ekf")
    located, alone = (Pipeline(trial, drive.robot, drive.mounts, True) for trial in trials)
    spent, n_localized, n = np.zeros(2), 0, 0
    for event in drive.events:
        clock = [time.process_time()]
        for pipeline in (located, alone):
            pipeline.process(event)
            pipeline.run_deferred()
            clock.append(time.process_time())
        if event.stamp_ns - drive.events[0].stamp_ns < _WARM_UP_S * 1e9:
            continue
        is_localized = located.estimator.localization()["state"] == "localized"  # type: ignore[attr-defined]
        spent += np.diff(clock) if is_localized else 0.0
        n_localized, n = n_localized + is_localized, n + 1
    return float(spent[0] / max(spent[1], 1e-9)), n_localized / max(n, 1)


def main(words: Sequence[str] | None = None) -> None:
    """Print one row for each log."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--localized", type=float, default=120.0)
    options = parser.parse_args(words)
    print("| log | file [MB] | read [s] | prepare [s] | CPU localized / ekf | localized [%] |")
    print("|---" * 6 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name in options.log.split(","):
            drive = BUILDINGS[name].open()
            mapped = drive.until(options.seconds) if options.seconds else drive
            size, load_s, prepare_s, places = size_and_load(mapped, Path(folder) / f"{name}.skidmap")
            ratio, share = cost_ratio(drive.until(options.localized), places, np.zeros(3))
            print(f"| {name} | {size:.1f} | {load_s:.2f} | {prepare_s:.2f} | {ratio:.2f} | {100 * share:.0f} |", flush=True)


if __name__ == "__main__":
    main()
