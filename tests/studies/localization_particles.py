"""Random starts in maps of real buildings, beside particle filters over the same grid: by AMCL's rules, and MRPT's pf-localization.

``python -m tests.studies.localization_particles`` takes the starts of `tests.studies.localization`: the map is of one half of a log, the
robot is put down in the other and drives for ``--seconds``. The particle filters get every keyframe (0.3 m), the localizer one each 0.5 m.

MRPT's is the program pf-localization of Debian's package mrpt-apps (2.5.8) with the settings of its example localization_demo.ini:
likelihood field, number of particles by KLD from 40,000 on; only the odometry's noise is that of the keyframes here, 0.02 m and 0.5 deg
instead of 0.1 m and 2 deg. It reads the map's exported picture by image2gridmap, and the drive by
carmen2rawlog; without these programs its rows are left out. Its place is the heaviest one, as for AMCL's: particles within 0.5 m and
0.2 rad of the best.
"""

from __future__ import annotations

import argparse
import functools
import io
import math
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from localization.maps import KeyframeMap
from localization.maps.export import UNKNOWN, exports
from localization.maps.grid import Grid
from localization.maps.place_probability import LIKELY
from motion_models import se2
from tests.studies.buildings import BUILDINGS
from tests.studies.localization import COV, run_start, ways
from tests.studies.localization_halves import MAP_STRIDE, MAPPED_SCORE, dense_map, halves, off
from tests.studies.localization_reliability import RecordedSearches
from tests.studies.localization_simulated import Guess, ParticleFilter, heaviest_place

_CONFIG = Path("/usr/share/mrpt/config_files/pf-localization/localization_demo.ini")
_PROGRAMS = "pf-localization", "image2gridmap", "carmen2rawlog"
_BEAMS, _NO_RANGE_M = 181, 82.0
"""A beam each degree of the half circle ahead; carmen2rawlog takes a range above 81 m for none."""


class Result(NamedTuple):
    """One start by one method."""

    is_mapped: bool
    is_localized: bool
    is_right: bool
    cpu_s: float


def by_particles(grid: Grid, keyframes: KeyframeMap, n: int, way: np.ndarray) -> Guess:
    """`ParticleFilter` of ``n`` over the keyframes ``way``."""
    particles, last, scans = ParticleFilter(grid, n, np.random.default_rng(int(way[0]))), way[0], keyframes.scans()
    for k in way:
        particles.add(se2.between(keyframes.poses[last], keyframes.poses[k]), COV * (k != last), scans[k])
        last = k
    return particles.guess()


class MrptMap:
    """A map's grid as MRPT reads it."""

    def __init__(self, mapped: KeyframeMap, grid: Grid, folder: Path) -> None:
        """Written into ``folder``."""
        self._folder = folder
        image = np.asarray(Image.open(io.BytesIO(exports(grid, mapped)["map.png"])))
        Image.fromarray(np.where(image == UNKNOWN, 127, image).astype(np.uint8)).save(folder / "map.png")  # grey is p = 0.5 there
        height, width = grid.cells.shape
        centre = np.array(grid.origin) + 0.5 * grid.resolution * np.array([width, height])
        at = ["--cx", f"{centre[0]:.6f}", "--cy", f"{centre[1]:.6f}"]
        _run(["image2gridmap", "-w", "-r", str(grid.resolution), "-i", "map.png", "-o", "map.gridmap", *at], folder)
        low, high = np.array(grid.origin), 2.0 * centre - np.array(grid.origin)
        bounds = zip(("min_x", "min_y", "max_x", "max_y"), (*low, *high), strict=True)
        settings = {
            **{f"init_PDF_{name}": f"{value:.3f}" for name, value in bounds},
            "map_file": "map.gridmap",
            "rawlog_file": "drive.rawlog",
            "logOutput_dir": "out",
            "minStdXY": "0.02",
            "minStdPHI": "0.5",
            "SHOW_PROGRESS_3D_REAL_TIME": "false",
            "3DSceneFrequency": "1",
        }
        text = _CONFIG.read_text()
        for key, value in settings.items():
            text = re.sub(rf"(?m)^{key}\s*=.*$", f"{key}={value}", text)
        (folder / "pf.ini").write_text(text)

    def localize(self, keyframes: KeyframeMap, way: np.ndarray) -> Guess:
        """The place after the keyframes ``way``."""
        shutil.rmtree(self._folder / "out", ignore_errors=True)
        _write_carmen(keyframes, way, self._folder / "drive.log")
        _run(["carmen2rawlog", "-w", "-i", "drive.log", "-o", "drive.rawlog"], self._folder)
        _run(["pf-localization", "pf.ini"], self._folder)
        last = sorted(self._folder.glob("out*/particles/particles_[0-9]*[0-9].txt"))[-1]
        x, y, yaw, log_weight = np.loadtxt(last, comments="%", ndmin=2).T
        weights = np.exp(log_weight - log_weight.max())
        place, share = heaviest_place(np.column_stack([x, y, yaw]), weights / weights.sum())
        return place, share, share > LIKELY


def _run(command: Sequence[str], folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=120, stdin=subprocess.DEVNULL)


def _write_carmen(keyframes: KeyframeMap, way: np.ndarray, path: Path) -> None:
    """One line ODOM and one FLASER for each keyframe of ``way``."""
    scans, turn = keyframes.scans(), math.pi / (_BEAMS - 1)
    with path.open("w") as file:
        for step, k in enumerate(way):
            ray = scans[k] - keyframes.sensors[k]
            beam, ranges = np.rint(np.arctan2(ray[:, 1], ray[:, 0]) / turn).astype(int) + _BEAMS // 2, np.full(_BEAMS, _NO_RANGE_M)
            is_ahead = (beam >= 0) & (beam < _BEAMS)
            np.minimum.at(ranges, beam[is_ahead], np.hypot(*ray[is_ahead].T))
            pose = se2.between(keyframes.poses[way[0]], keyframes.poses[k])
            sensor = se2.compose(pose, np.array([*keyframes.sensors[k], 0.0]))
            robot, laser = (" ".join(f"{value:.6f}" for value in values) for values in (pose, sensor))
            file.write(f"ODOM {robot} 0 0 0 {step} robot {step}\n")
            file.write(f"FLASER {_BEAMS} {' '.join(f'{value:.3f}' for value in ranges)} {laser} {robot} {step} robot {step}\n")


def compare(
    keyframes: KeyframeMap, sides: Sequence[KeyframeMap], starts: Iterable[tuple[int, np.ndarray]], numbers: Sequence[int], has_mrpt: bool
) -> dict[str, list[Result]]:
    """By method: what each of the ``starts`` in the maps ``sides`` came to."""
    maps = [RecordedSearches(side, 0.02) for side in sides]
    results: dict[str, list[Result]] = {}
    with tempfile.TemporaryDirectory() as name:
        folders = [Path(name) / str(i) for i in range(len(sides))]
        for folder in folders:
            folder.mkdir()
        mrpt = [MrptMap(*both) for both in zip(sides, (places.grid for places in maps), folders, strict=True)] if has_mrpt else []
        for i, way in starts:
            scan, truth = keyframes.scans()[way[-1]], keyframes.poses[way[-1]]
            is_mapped = maps[i].align(scan, truth).score >= MAPPED_SCORE
            start, _, _ = run_start(maps[i], keyframes, keyframes.scans(), way, "", True)
            results.setdefault("this", []).append(Result(is_mapped, start.state == "localized", start.is_right, start.cpu_s))
            for method, run in _rivals(maps[i].grid, keyframes, numbers, mrpt[i] if mrpt else None).items():
                begin = time.perf_counter()
                place, _, is_sure = run(way)
                results.setdefault(method, []).append(Result(is_mapped, is_sure, off(truth, place)[1], time.perf_counter() - begin))
    return results


def _rivals(grid: Grid, keyframes: KeyframeMap, numbers: Sequence[int], mrpt: MrptMap | None) -> dict[str, Callable[[np.ndarray], Guess]]:
    found: dict[str, Callable[[np.ndarray], Guess]] = {}
    for n in numbers:
        found[f"AMCL's rules, {n} particles"] = functools.partial(by_particles, grid, keyframes, n)
    if mrpt is not None:
        found["MRPT pf-localization"] = functools.partial(mrpt.localize, keyframes)
    return found


def row(title: str, results: Sequence[Result]) -> str:
    """One line of the table."""
    mapped, localized = [r for r in results if r.is_mapped], [r for r in results if r.is_localized]
    shares = [100 * np.mean([getattr(r, name) for r in mapped]) if mapped else math.nan for name in ("is_right", "is_localized")]
    wrong, cpu = sum(not r.is_right for r in localized), np.median([r.cpu_s for r in results])
    return f"| {title} | {len(results)} / {len(mapped)} | {shares[0]:.0f} | {shares[1]:.0f} | {len(localized)} / {wrong} | {cpu:.2f} |"


def main(words: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--starts", type=int, default=30, help="in each half")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--particles", default="500,5000")
    options = parser.parse_args(words)
    numbers = [int(n) for n in options.particles.split(",") if n]
    has_mrpt = all(map(shutil.which, _PROGRAMS)) and _CONFIG.exists()
    print("| method | starts / mapped | right [%] | localized [%] | localized / wrong, all | CPU or time of a start, median [s] |")
    print("|---" * 6 + "|")
    for name in options.log.split(","):
        keyframes = dense_map(BUILDINGS[name].open())
        sides = [keyframes.select(half[::MAP_STRIDE]) for half in halves(keyframes)]
        results = compare(keyframes, sides, ways(keyframes, options.starts, options.seconds), numbers, has_mrpt)
        for method, found in results.items():
            print(row(f"{name}, {method}", found), flush=True)
