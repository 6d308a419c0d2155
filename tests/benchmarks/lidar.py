"""What scan matching reaches in simulated rooms, beside KISS-ICP as it comes and the wheels alone; all with the same default settings.

python -m tests.benchmarks.lidar
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from localization.evaluation.consistency import mean_band, nees
from localization.events import Scan
from localization.lidar import KissIcp, LidarConfig, ScanMatcher, choose_voxel_size
from localization.simulation import world
from motion_models import se2
from motion_models.robot import WheelNoise
from tests.helpers import rooms

ESTIMATORS = ("odometry", "lidar", "ekf")
NO_SLIP = WheelNoise(*[0.0] * 8)
TOUR = rooms.path((2, 0, 0), (12, 0.4, 0.5), (12, 0.4, -0.5), (6, 0, 0.5), (2, 0, 0))
ROOM = np.concatenate([world.box(-6, -4, 6, 4), world.box(-6, -4, -5, -3), world.pillar(4.5, 2.8)])
PLACES = {"room 12 x 8 m": ROOM, "lab": world.lab().walls, "hall": world.hall().walls}
FEW = rooms.Beams(beams=240, rate_hz=6.25)
LARGE = np.concatenate([world.box(-12, -9, 12, 9), world.box(3, 2, 5, 4), world.pillar(-5, 3), world.pillar(-6, -4)])
SMALL = np.concatenate([world.box(-4, -3, 4, 3), world.box(2, 1.5, 3, 2.5)])
_CRATES = [world.box(x, y, x + 0.6, y + 0.4) for x, y in ((3, 3), (4, -3), (-5, -3.5), (-4, 3.5), (5.5, 1), (-6, 1.5))]
CRATES = np.concatenate([world.box(-7, -5, 7, 5), *_CRATES, world.pillar(2, -3.8)])
_L = [(-7, -5, 8, -5), (8, -5, 8, 1), (8, 1, 2, 1), (2, 1, 2, 6), (2, 6, -7, 6), (-7, 6, -7, -5)]
L_SHAPED = np.concatenate([*(world.line(*ends) for ends in _L), world.pillar(-4, -3), world.box(4, -4, 5, -3.2)])
LONG = np.concatenate([world.box(-9, -3.5, 9, 3.5), world.box(3, 2, 4, 3), world.box(-6, -3, -5.2, -2.2), world.pillar(6, -2)])
# walls, scanner of the registrations, scanner and start of the poses
NEES_PLACES = {
    **{name: (walls, rooms.Beams(), FEW, (0.0, 0.0, 0.0)) for name, walls in PLACES.items()},
    "24 x 18 m": (LARGE, rooms.Beams(), FEW, (0.0, 0.0, 0.0)),
    "8 x 6 m, 6 mm": (SMALL, rooms.Beams(noise=0.006), replace(FEW, noise=0.006), (-2.0, -1.5, 0.0)),
    "crates, 360 beams, 20 mm": (CRATES, rooms.Beams(beams=360, noise=0.02), replace(FEW, noise=0.02), (0.0, 0.0, 0.0)),
    "L-shaped": (L_SHAPED, rooms.Beams(), FEW, (0.0, 0.0, 0.0)),
    "18 x 7 m, 540 beams, 8 mm": (LONG, rooms.Beams(beams=540, noise=0.008), replace(FEW, noise=0.008), (0.0, 0.0, 0.0)),
}
CORRIDOR = np.concatenate([world.line(-60, -1.2, 80, -1.2), world.line(-60, 1.2, 80, 1.2)])


def second_error(drive: rooms.Drive, poses: np.ndarray) -> tuple[float, float]:
    """RMS errors of the motion in a second [mm, deg]."""
    error = rooms.second_errors(drive, poses)
    return 1e3 * math.sqrt((error[:, :2] ** 2).sum(axis=1).mean()), math.degrees(math.sqrt((error[:, 2] ** 2).mean()))


def accuracy(walls: np.ndarray, noise: WheelNoise, seeds: int = 3) -> dict[str, np.ndarray]:
    """(seeds, 3) by estimator: error of a second [mm, deg], RMS distance from the truth [mm]."""
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in ESTIMATORS}
    for seed in range(seeds):
        drive = rooms.drive_through(walls, TOUR, seed, noise=noise)
        for name, run in rooms.results(drive, *ESTIMATORS).items():
            poses, _ = rooms.at_scans(drive, run)
            found[name].append((*second_error(drive, poses), 1e3 * rooms.ate(drive, poses)))
    return {name: np.array(rows) for name, rows in found.items()}


def matching(walls: np.ndarray, twists: np.ndarray, seed: int, start=(0.0, 0.0, 0.0), guess_m: float = 0.01, scanner=None):
    """Yield milliseconds of match and insertion, of KISS-ICP alone, match, true pose of each scan; points and map are moved by the
    true motion, so that nothing is judged but the match."""
    drive = rooms.drive_through(walls, twists, seed, start, scanner, noise=NO_SLIP)
    rng, cov, config = np.random.default_rng(seed), np.diag([1e-4, 1e-4, 1e-4]), LidarConfig()
    scans = [event for event in drive.events if isinstance(event, Scan)]
    first = rooms.true_points(drive, scans[0])
    cell = max(0.02 * float(np.median(np.linalg.norm(first, axis=1))), 0.04)
    matcher, kiss, last_key = ScanMatcher(config, cell), KissIcp(choose_voxel_size(first), config.max_range_m), None
    for scan, pose in zip(scans, drive.poses, strict=True):
        points = rooms.true_points(drive, scan)
        planar = np.ascontiguousarray(points[:, :2])
        guess = se2.compose(pose, se2.exp(guess_m * rng.normal(size=3)))
        begin = time.perf_counter()
        found = None if last_key is None else matcher.match(planar, guess, cov)
        moved = None if last_key is None else se2.between(last_key, pose)
        if moved is None or np.hypot(moved[0], moved[1]) > config.key_distance_m or abs(moved[2]) > config.key_angle_rad:
            matcher.insert_key_scan(pose, planar)
            last_key = pose
        middle = time.perf_counter()
        kiss.register_frame(points)
        yield 1e3 * (middle - begin), 1e3 * (time.perf_counter() - middle), found, pose


def costs(walls: np.ndarray) -> tuple[float, float, float]:
    """Median over scans of the fastest of three drives [ms]: ours, KISS-ICP alone; and the median of their ratio."""
    rows = np.min([[row[:2] for row in matching(walls, TOUR, 0)] for _ in range(3)], axis=0)[10:]
    return float(np.median(rows[:, 0])), float(np.median(rows[:, 1])), float(np.median(rows[:, 0] / rows[:, 1]))


def registration_nees(walls: np.ndarray, scanner: rooms.Beams | None = None, runs: int = 100) -> np.ndarray:
    """(runs,) mean over the scans of a drive, but for the first ten, which show what is to be expected of scanner and map."""
    way = rooms.path((0.5, 0.4, 0.0), (1.5, 0.3, 0.5), (1.5, 0.3, -0.4), (2.0, -0.3, 0.3), (2.0, 0.2, -0.5))
    found = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        start = (rng.uniform(-2, 0), rng.uniform(-1, 1), rng.uniform(-3, 3))
        rows = [(pose, one.measured, one.cov) for *_, one, pose in matching(walls, way, seed, start, scanner=scanner) if one is not None]
        true, poses, covs = (np.array(column[9:]) for column in zip(*rows, strict=True))
        found.append(nees(se2.log(se2.between(true, poses)), covs).mean())
    return np.array(found)


def pose_nees(walls: np.ndarray, kind: str, scanner: rooms.Beams = FEW, start=(0.0, 0.0, 0.0), runs: int = 100) -> np.ndarray:
    """(runs,) of the estimator's poses, mean over a drive of 10 s but for its first two."""
    way, found = rooms.path((1, 0, 0), (5, 0.4, 0.4), (4, 0.4, -0.5)), []
    for seed in range(runs):
        drive = rooms.drive_through(walls, way, seed, start, scanner)
        poses, covs = rooms.at_scans(drive, rooms.results(drive, kind)[kind])
        assert covs is not None
        settled = drive.stamps >= drive.stamps[0] + 2_000_000_000
        found.append(nees(se2.log(se2.between(drive.poses, poses))[settled], covs[settled]).mean())
    return np.array(found)


def corridor(seed: int) -> dict[str, float]:
    """Distance after 15 m of a bare corridor, by estimator, relative error in percent."""
    noise = WheelNoise(lateral_m2_per_m=1e-6, yaw_rad2_per_m=1e-5)
    drive = rooms.drive_through(CORRIDOR, rooms.path((1, 0, 0), (30, 0.5, 0.0), (1, 0, 0)), seed, (10.0, 0.1, 0.02), noise=noise)
    length = np.hypot(*drive.poses[-1, :2])
    runs = rooms.results(drive, *ESTIMATORS)
    return {name: float(100.0 * (np.hypot(*rooms.at_scans(drive, run)[0][-1, :2]) / length - 1.0)) for name, run in runs.items()}


def patch(walls: np.ndarray, seed: int) -> dict[str, float]:
    """RMS distance from the truth [mm], by estimator, where wheels spin for 4 s at 0.5 m/s and 2 s at 0.8 rad/s while the robot stands."""

    def wheels(t: np.ndarray, twists: np.ndarray) -> np.ndarray:
        spun = twists + np.where((t > 6) & (t < 10), 0.5, 0.0)[:, None] * [1.0, 0.0, 0.0]
        return np.asarray(spun + np.where((t > 12) & (t < 14), 0.8, 0.0)[:, None] * [0.0, 0.0, 1.0])

    way = rooms.path((1, 0, 0), (4, 0.4, 0.3), (6, 0, 0), (1, 0.3, 0.4), (3, 0, 0), (6, 0.3, 0.4), (1, 0, 0))
    drive = rooms.drive_through(walls, way, seed, wheels=wheels)
    return {name: 1e3 * rooms.ate(drive, rooms.at_scans(drive, run)[0]) for name, run in rooms.results(drive, *ESTIMATORS).items()}


def row(what: str, values: dict[str, str], wanted: str) -> None:
    print(f"{what:44}" + "".join(f"{values.get(name, ''):>22}" for name in ESTIMATORS) + f"   {wanted}", flush=True)


def main() -> None:
    row("760 beams at 12.5 Hz, 12 mm of noise", {"odometry": "wheels alone", "lidar": "KISS-ICP as it comes", "ekf": "ekf"}, "wanted")
    text: Callable[[np.ndarray], str] = lambda rows: "{:.2f} mm {:.3f} deg".format(*np.sqrt((rows[:, :2] ** 2).mean(axis=0)))  # noqa: E731
    for name, walls in PLACES.items():
        for how, noise in (("", NO_SLIP), (", slipping", WheelNoise())):
            found = accuracy(walls, noise)
            row(f"a second in {name}{how}", {k: text(v) for k, v in found.items()}, "2.5 mm 0.03 deg" if not how else "")
    for seed in range(3):
        row(f"15 m of bare corridor, seed {seed}", {k: f"{v:+.2f} %" for k, v in corridor(seed).items()}, "within 2 %")
    for name, walls in PLACES.items():
        found = {k: f"{v:.1f} mm" for k, v in patch(walls, 0).items()}
        row(f"wheels spin on the spot in {name}", found, "ekf at most 1.1 of KISS-ICP")
    for name, walls in PLACES.items():
        ours, kiss, ratio = costs(walls)
        row(f"a scan in {name}", {"lidar": f"{kiss:.2f} ms", "ekf": f"{ours:.2f} ms ({ratio:.1f} x)"}, "1.0 ms to register and insert")
    low, high = mean_band(100, 3.0)
    for name, (walls, scanner, few, start) in NEES_PLACES.items():
        ekf, graph = (pose_nees(walls, kind, few, start).mean() for kind in ("ekf", "graph"))
        said = f"{registration_nees(walls, scanner).mean():.2f} / {ekf:.2f} ({graph:.2f})"
        row(f"NEES of scan / pose (graph) in {name}", {"ekf": said}, f"{low:.2f} to {high:.2f}, 100 runs")


if __name__ == "__main__":
    main()
