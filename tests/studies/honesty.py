"""Covariances under noise that the filter does not model: mean NEES of its poses in simulated rooms, against the 95 % band.

python -m tests.studies.honesty [--seeds 12] [--rooms 4] [--only NAME;...] [--estimator ekf] [--per-room]

In each room a robot drives the same tour with wheels, gyro and LiDAR, once for each seed. One kind of noise at a time differs from what the
filter assumes: slip that is correlated over 0.1 s or 2 s, slip and ranges with heavy tails (Student's t, 3 degrees of freedom), noise of
LiDAR, wheels or gyro of half and twice the assumed size. 3 are expected; errors of one drive are correlated, so that one drive is one
sample of the band. `--per-room` prints the mean NEES per degree of freedom of each room and noise instead (1 is expected), and which are
outside of 0.5 to 2. `make benchmark` runs 12 seeds in 4 rooms; `--seeds 100 --rooms 8` takes hours.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from localization.evaluation.consistency import mean_band, nees
from localization.events import Event, ImuSample, Scan
from localization.lidar import LidarConfig
from localization.simulation import world
from motion_models import se2
from motion_models.robot import GyroNoise, WheelNoise
from motion_models.se2 import FloatArray
from tests.helpers import rooms

_STEP_S, _GYRO_STEPS = 0.002, 10
"""Steps of the simulation, and from one sample of the gyro to the next."""
_SETTLED_S = 2.0
"""Left out at the start of each drive: covariances are nearly zero there."""
_BEAMS = 381
_HONEST = 0.5, 2.0
"""Mean NEES per degree of freedom of covariances that are neither too small nor too wide."""
_GRAVITY = np.array([0.0, 0.0, 9.81])
_NO_SLIP = WheelNoise(*[0.0] * 8)
TOUR = rooms.path((1, 0, 0), (5, 0.4, 0.5), (5, 0.4, -0.5), (2, 0, 0.5), (1, 0, 0))
"""An S and a rotation in place, within 3 m of its start."""


@dataclass(frozen=True)
class Noise:
    """What is drawn, in units of what the filter assumes."""

    wheels: float = 1.0
    gyro: float = 1.0
    lidar: float = 1.0
    slip_s: float = 0.5
    """Correlation time of slip [s], as wheels pass from one patch of floor to the next; 0 is white, as the wheels' noise model has it."""
    heavy_slip: bool = False
    heavy_ranges: bool = False
    """Student's t with 3 degrees of freedom, of the same variance, instead of a normal distribution."""


NOISES: Mapping[str, Noise] = {
    "sizes as assumed, slip correlated over 0.5 s": Noise(),
    "white slip": Noise(slip_s=0.0),
    "slip correlated over 0.1 s": Noise(slip_s=0.1),
    "slip correlated over 2 s": Noise(slip_s=2.0),
    "heavy-tailed slip": Noise(heavy_slip=True),
    "ranges with heavy tails": Noise(heavy_ranges=True),
    "LiDAR noise half": Noise(lidar=0.5),
    "LiDAR noise twice": Noise(lidar=2.0),
    "wheel noise half": Noise(wheels=0.5),
    "wheel noise twice": Noise(wheels=2.0),
    "gyro noise half": Noise(gyro=0.5),
    "gyro noise twice": Noise(gyro=2.0),
}


@dataclass(frozen=True, eq=False)
class Room:
    walls: FloatArray
    """(n, 5)"""
    start: tuple[float, float, float]


def make_rooms(count: int) -> list[Room]:
    """The simulator's own worlds first, then halls of random size and contents. The same for every call."""
    own = [Room(world.lab().walls, (-0.5, -1.5, 0.0)), Room(world.rooms().walls, (5.0, -5.0, 0.0))]
    own += [Room(world.hall().walls, (-0.5, -1.5, 0.0)), Room(world.yard().walls, (-0.5, -1.5, 0.0))]
    return [*own, *(_random_room(seed) for seed in range(count - len(own)))][:count]


def _random_room(seed: int) -> Room:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(5.0, 12.0), rng.uniform(4.0, 9.0)
    walls = [world.box(-x, -y, x, y)]
    for _ in range(6):  # beyond the tour's reach of 3.5 m
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(3.8, 8.0)
        walls.append(world.pillar(distance * math.cos(angle), distance * math.sin(angle), rng.uniform(0.1, 0.5)))
    return Room(np.concatenate(walls), (-0.5, -1.5, 0.0))


def drive_with(room: Room, noise: Noise, seed: int, tour: FloatArray = TOUR, scanner: rooms.Beams | None = None) -> rooms.Drive:
    """The ``tour`` (n, 3), see `rooms.path`, in ``room``. All noise follows from ``seed``, but for that of a given ``scanner``."""
    rng = np.random.default_rng([seed, 77])
    slips = draw_slip(tour, noise, rng)
    sigma = noise.lidar * LidarConfig().range_noise_m
    scanner = scanner or rooms.Beams(beams=_BEAMS, noise=0.0 if noise.heavy_ranges else sigma)
    drive = rooms.drive_through(room.walls, tour + slips, seed, room.start, scanner, _NO_SLIP, wheels=lambda times, twists: tour)
    events = [_with_heavy_tails(e, sigma, rng) if noise.heavy_ranges and isinstance(e, Scan) else e for e in drive.events]
    return replace(drive, events=sorted([*events, *_gyro(drive, noise.gyro, rng)], key=lambda event: event.stamp_ns))


def draw_slip(twists: FloatArray, noise: Noise, rng: np.random.Generator) -> FloatArray:
    """(n, 3) twists of slip, by the robot's `WheelNoise` times the square of the factor.

    Correlated slip has the same variance over times much longer than the correlation (Gauss-Markov, first order).
    """
    w, driven, turned = rooms.ROBOT.wheel_noise, np.abs(twists[:, 0]), np.abs(twists[:, 2])
    is_moving = (driven + turned) > 0.0
    density = np.column_stack(
        [
            w.longitudinal_m2_per_m * driven + w.longitudinal_m2_per_rad * turned + w.floor_m2_per_s * is_moving,
            w.lateral_m2_per_m * driven + w.lateral_m2_per_rad * turned + w.floor_m2_per_s * is_moving,
            w.yaw_rad2_per_m * driven + w.yaw_rad2_per_rad * turned + w.floor_rad2_per_s * is_moving,
        ]
    )
    drawn = rng.standard_t(3, twists.shape) / math.sqrt(3.0) if noise.heavy_slip else rng.normal(size=twists.shape)
    if noise.slip_s:
        if noise.heavy_slip:  # a filter would make the sum of many draws normal: one draw lasts for the correlation time
            drawn = np.repeat(drawn[:: round(noise.slip_s / _STEP_S)], round(noise.slip_s / _STEP_S), axis=0)[: len(twists)]
            return np.asarray(noise.wheels * np.sqrt(density / noise.slip_s) * drawn)
        a = math.exp(-_STEP_S / noise.slip_s)
        unit = lfilter([1.0 - a], [1.0, -a], drawn, axis=0)
        return np.asarray(noise.wheels * np.sqrt(density / _STEP_S) * unit)
    return np.asarray(noise.wheels * np.sqrt(density / _STEP_S) * drawn)


def _gyro(drive: rooms.Drive, factor: float, rng: np.random.Generator) -> list[Event]:
    """A gyro whose white noise, bias and error of scale are as `GyroNoise` has them, times ``factor``."""
    assumed: GyroNoise = rooms.ROBOT.gyro_noise
    bias, scale = factor * rng.normal(size=2) * [assumed.bias_sigma_rad_per_s, assumed.scale_sigma]
    return gyro_samples(drive, bias, scale, factor * assumed.white_rad_per_sqrt_s, rng)


def gyro_samples(drive: rooms.Drive, bias: float, scale: float, white: float, rng: np.random.Generator) -> list[Event]:
    """Mean rates from sample to sample, with a ``bias`` [rad/s], an error of ``scale``, and ``white`` noise [rad/sqrt(s)]."""
    yaw = np.unwrap(drive.track[::_GYRO_STEPS, 2])
    dt = _GYRO_STEPS * _STEP_S
    rates = (1.0 + scale) * np.gradient(yaw, dt) + bias
    rates += white / math.sqrt(dt) * rng.normal(size=len(rates))
    stamps = rooms.WALL_START_NS + np.arange(len(yaw)) * round(dt * 1e9)
    return [ImuSample(int(t), np.array([0.0, 0.0, rate]), _GRAVITY, "base_link") for t, rate in zip(stamps, rates, strict=True)]


def _with_heavy_tails(scan: Scan, sigma: float, rng: np.random.Generator) -> Scan:
    ranges = np.hypot(scan.points[:, 0], scan.points[:, 1])
    errors = sigma / math.sqrt(3.0) * rng.standard_t(3, len(ranges))
    return replace(scan, points=scan.points * (np.maximum(ranges + errors, 0.05) / ranges)[:, None])


def drive_nees(drive: rooms.Drive, estimator: str) -> float:
    """Mean NEES of the poses of one drive, after `_SETTLED_S`."""
    poses, covs = rooms.at_scans(drive, rooms.results(drive, estimator)[estimator])
    assert covs is not None
    settled = drive.stamps >= drive.stamps[0] + _SETTLED_S * 1e9
    return float(nees(se2.log(se2.between(drive.poses, poses))[settled], covs[settled]).mean())


def verdict(mean: float, band: tuple[float, float]) -> str:
    return "over-confident" if mean > band[1] else "conservative" if mean < band[0] else "holds"


def table(names: Sequence[str], seeds: int, n_rooms: int, estimator: str) -> Iterator[str]:
    """Lines of the table, as they are computed."""
    places = make_rooms(n_rooms)
    band = mean_band(seeds * n_rooms, 3.0)
    yield f"| noise | mean NEES ({seeds} seeds x {n_rooms} rooms; band {band[0]:.2f} to {band[1]:.2f}) | median | worst room | |"
    yield "|---|---|---|---|---|"
    for name in names:
        found = np.array([[drive_nees(drive_with(room, NOISES[name], seed), estimator) for seed in range(seeds)] for room in places])
        mean = float(found.mean())
        yield f"| {name} | {mean:.2f} | {np.median(found):.2f} | {found.mean(axis=1).max():.2f} | {verdict(mean, band)} |"


def table_per_room(names: Sequence[str], seeds: int, n_rooms: int, estimator: str) -> Iterator[str]:
    """Lines of the table by room, as they are computed."""
    places, means = make_rooms(n_rooms), np.empty((len(names), n_rooms))
    yield f"| noise ({seeds} seeds) | {' | '.join(f'room {k}' for k in range(n_rooms))} | all |"
    yield "|---" * (n_rooms + 2) + "|"
    for i, name in enumerate(names):
        for k, room in enumerate(places):
            means[i, k] = np.mean([drive_nees(drive_with(room, NOISES[name], seed), estimator) for seed in range(seeds)]) / 3.0
        yield f"| {name} | {' | '.join(f'{mean:.2f}' for mean in means[i])} | {means[i].mean():.2f} |"
    is_outside = (means < _HONEST[0]) | (means > _HONEST[1])
    outside = [f"{names[i]} in room {k} ({means[i, k]:.2f})" for i, k in np.argwhere(is_outside)]
    yield f"mean {means.mean():.2f}; {len(outside)} of {means.size} outside of {_HONEST[0]} to {_HONEST[1]}: {'; '.join(outside) or 'none'}"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--rooms", type=int, default=4)
    parser.add_argument("--only", default=";".join(NOISES), help="kinds of noise, separated by semicolons")
    parser.add_argument("--estimator", default="ekf", help="ekf or graph")
    parser.add_argument("--per-room", action="store_true", help="mean NEES per degree of freedom of each room and noise")
    options = parser.parse_args(words)
    chosen = options.only.split(";")
    if unknown := [name for name in chosen if name not in NOISES]:
        parser.error(f"no noise '{unknown[0]}'; there are {', '.join(NOISES)}.")
    make_table = table_per_room if options.per_room else table
    for line in make_table(chosen, options.seeds, options.rooms, options.estimator):
        print(line, flush=True)


if __name__ == "__main__":
    main()
