"""The effective track of a real Husky on five grounds: what its wheels must differ by for it to turn.

Run by `python -m tests.studies.terrain_track`. One run a terrain is shipped (tests/data/borealtc-husky), and the gyro is the
reference. Two ways to the same number: the data set's own (least squares of the wheels' difference on the gyro, over seconds that
turn), and `calibrate` (the diff-drive's multiplier and the time between both clocks, over all seconds).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motion_models.calibration.cross_validation import Interval
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

DATA = Path(__file__).parent.parent / "data" / "borealtc-husky"
TERRAINS = {"FLOORING": 0.743, "ASPHALT": 0.791, "ICE": 0.790, "SANDY_LOAM": 0.953, "SNOW": 0.968}
"""Terrain -> effective track [m] that all 75 runs of the data set give by the first way (SOURCE.txt)."""

_WINDOW = 1.0  # s
_BLOCK = 2  # windows that share their errors
_TURN = 0.1  # rad; the data set's own way leaves out seconds that turn less


@dataclass(frozen=True)
class Run:
    """One run, cut into seconds."""

    terrain: str
    seconds: int
    distance: float
    """[m]"""
    turned: float
    """[rad], all turns added up."""
    difference: FloatArray
    """(n,) mean of right minus left ground speed in each second [m/s]."""
    yaw_rate: FloatArray
    """(n,) mean of the gyro in each second [rad/s]."""
    maneuvers: list[Maneuver]
    """The same seconds for `fit`, with a second before each to feed a time offset."""


def load(terrain: str) -> Run:
    """The run of ``terrain`` that is shipped."""
    (imu_path,), (wheel_path,) = (sorted((DATA / terrain).glob(f"{kind}_*.csv")) for kind in ("imu", "pro"))
    imu, wheel = (np.loadtxt(path, delimiter=",", skiprows=1) for path in (imu_path, wheel_path))
    radius = load_robot("husky_a200").geometry.wheel_radius_m
    step, per_second = 0.05, 20
    n = int(min(imu[-1, 0], wheel[-1, 0]))
    middle = (np.arange(n * per_second) + 0.5) * step
    speed = np.stack([np.interp(middle, wheel[:, 0], wheel[:, column]) for column in (3, 4)], axis=-1)
    yaw = np.concatenate([[0.0], np.cumsum(imu[:, 3] * np.gradient(imu[:, 0]))])
    yaw_at = np.interp(np.arange(n + 1) * _WINDOW, np.concatenate([[imu[0, 0] - 0.005], imu[:, 0] + 0.005]), yaw)
    turns = np.diff(yaw_at)
    cov = np.diag([np.inf, np.inf, 0.01**2])
    maneuvers = [
        Maneuver(
            dt=np.full(3 * per_second, step),
            wheels=speed[(i - 1) * per_second : (i + 2) * per_second] / radius,
            measured=np.array([[0.0, 0.0, turns[i]]]),
            ends=np.array([per_second]),
            cov=cov,
            group=f"block {i // _BLOCK}",
            lead=per_second,
        )
        for i in range(1, n - 1)
    ]
    by_second = speed.reshape(n, per_second, 2).mean(axis=1)
    return Run(
        terrain,
        n,
        float(np.abs(by_second.mean(axis=1)).sum()),
        float(np.abs(turns).sum()),
        by_second[:, 1] - by_second[:, 0],
        turns / _WINDOW,
        maneuvers,
    )


def by_seconds(run: Run, rng: np.random.Generator, draws: int = 2000) -> Interval | None:
    """The data set's own way, with a bootstrap over blocks of 2 s; None where fewer than five seconds turn."""
    turns = np.abs(run.yaw_rate) * _WINDOW > _TURN
    if turns.sum() < 5:
        return None
    block = np.arange(run.seconds) // _BLOCK
    top = np.bincount(block, weights=run.difference * run.yaw_rate * turns)
    bottom = np.bincount(block, weights=run.yaw_rate**2 * turns)
    weights = rng.multinomial(len(top), np.full(len(top), 1.0 / len(top)), size=draws)
    low, high = np.quantile((weights @ top) / np.maximum(weights @ bottom, 1e-9), [0.025, 0.975])
    return Interval(float(top.sum() / bottom.sum()), float(low), float(high))


def by_fit(run: Run) -> Fit:
    """The diff-drive's multiplier and the time offset. Raises `CalibrationError` where the run does not turn."""
    model = make_model("diff_drive", load_robot("husky_a200"))
    return fit(model, run.maneuvers, ("wheel_separation_multiplier", "wheel_time_offset"), FitConfig("huber"))


def fitted_track(result: Fit) -> Interval:
    """Effective track of a fit [m], with its 95 % interval."""
    track = load_robot("husky_a200").geometry.track_width_m
    value, sigma = result.params[1] * track, result.sigmas["wheel_separation_multiplier"] * track
    return Interval(float(value), float(value - 1.96 * sigma), float(value + 1.96 * sigma))


def main() -> None:
    """Print the table."""
    print("Effective track of a Husky A200 (its wheels stand 0.571 m apart), 95 % intervals [m].\n")
    print("terrain       run   drove   turned  all runs  this run              calibrated                wheels late")
    lost = []
    for terrain, published in TERRAINS.items():
        run = load(terrain)
        own = by_seconds(run, np.random.default_rng(0))
        driven = f"{run.seconds:3d} s {run.distance:5.1f} m {run.turned:5.2f} rad"
        head = f"{terrain:11s} {driven}  {published:8.2f}  {own or 'too few turns'!s:21s}"
        try:
            result = by_fit(run)
        except CalibrationError as error:
            lost.append((terrain, error))
            print(f"{head} not revealed")
            continue
        offset, sigma = result.reference_params[0], result.sigmas["wheel_time_offset"]
        print(f"{head} {fitted_track(result)!s:21s} {offset:+6.2f} +- {sigma:.2f} s")
    for terrain, error in lost:
        print(f"\n{terrain}: {error}")


if __name__ == "__main__":
    main()
