"""Dead reckoning on hills by wheels and IMU, its error by parts: what attitude, heading and slip contribute to position and height.

python -m tests.studies.hill_reckoning [--seeds A:B] [--seconds S] [--softness X] [--deflection D] [--stiffness K]

Drives in MuJoCo (`tests.helpers.mujoco_hills`), replayed by the filter (estimator ekf) with defaults, nothing fitted. Each part is the
error that is left when all else is true: "heading" and "attitude" are true motions in the body turned by the estimated heading or
attitude, "slip" is the estimated motion in the body turned by the true attitude. "Flat" is the estimate without the law of slopes along
the true attitude. The softness is that of the wheels, the deflection what the robot file has of it (`wheel_deflection`; by 0.0034 of their
radius they give way at softness 1), the stiffness the friction model's slip_stiffness (10 by default). Needs the extra `mujoco`.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from localization.inputs.step_config import StepConfig
from localization.log_replay import Run, replay
from localization.pipeline import ReplayConfig, Trial
from motion_models import se3
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.hills import HillDrive
from tests.helpers.in_space import true_poses
from tests.helpers.mujoco_hills import Wander, drive

_STATION = 10
"""Samples between which way and turns are summed: .2 s, in which a robot that rocks goes nowhere."""


@dataclass(frozen=True)
class Reckoning:
    """Errors of positions (N, 3) [m]: of the estimate, and its parts."""

    whole: FloatArray
    heading: FloatArray
    attitude: FloatArray
    slip: FloatArray
    flat: FloatArray
    nees: float
    """Of the last position of the estimate (3 degrees of freedom)."""


def reckon(made: HillDrive) -> Reckoning:
    """``made`` by the filter without clouds, against its true poses."""
    run = _replayed(made, slopes=True)
    assert run.in_space is not None, "hills tilt"
    stamps = run.in_space.stamps_ns
    true, turned = true_poses(made, stamps), Rotation.from_quat(run.in_space.quaternions).as_matrix()
    start = _heading(_yaw(true[0, :3, :3]) - _yaw(turned[0]))
    positions, turned = (run.in_space.positions - run.in_space.positions[0]) @ start.T, start @ turned
    ways, R = true[:, :3, 3] - true[0, :3, 3], true[:, :3, :3]
    headed = np.array([_heading(_yaw(a) - _yaw(b)) @ b for a, b in zip(turned, R, strict=True)])
    own = in_body(ways, R)
    flat = _replayed(made, slopes=False).trajectory
    at = np.searchsorted(flat.stamps_ns, stamps).clip(0, len(flat) - 1)
    planar = np.column_stack([flat.poses[at, :2], np.zeros(len(at))])
    by_flat = in_body(planar, np.array([_heading(yaw) for yaw in flat.poses[at, 2]]))
    spread = start @ run.in_space.covariances[-1, :3, :3] @ start.T
    end = positions[-1] - ways[-1]
    return Reckoning(
        positions - ways,
        along(own, headed) - ways,
        along(own, turned) - ways,
        along(in_body(positions, turned), R) - ways,
        along(by_flat, R) - ways,
        float(end @ np.linalg.solve(spread, end)),
    )


def _replayed(made: HillDrive, slopes: bool) -> Run:
    trial = Trial(make_model("skid_steer", made.robot), "ekf")
    (run,) = replay(made.events, [trial], made.robot, made.mounts, False, ReplayConfig(step=StepConfig(slopes=slopes)))
    return run


def _yaw(rotation: FloatArray) -> float:
    return math.atan2(rotation[1, 0], rotation[0, 0])


def _heading(yaw: float) -> FloatArray:
    return se3.rotation(np.array([0.0, 0.0, yaw]))


def in_body(positions: FloatArray, rotations: FloatArray) -> FloatArray:
    """(N - 1, 3) motions in the mean axes of both ends."""
    return np.einsum("nji,nj->ni", 0.5 * (rotations[:-1] + rotations[1:]), np.diff(positions, axis=0))


def along(motions: FloatArray, rotations: FloatArray) -> FloatArray:
    """(N, 3) positions after ``motions`` (N - 1, 3) in the mean axes of both ends."""
    steps = np.einsum("nij,nj->ni", 0.5 * (rotations[:-1] + rotations[1:]), motions)
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1:5", metavar="A:B")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--softness", type=float, default=1.0)
    parser.add_argument("--deflection", type=float, default=None)
    parser.add_argument("--stiffness", type=float, default=None)
    given = parser.parse_args()
    columns = (
        "seed",
        "way [m]",
        "turned [rad]",
        "whole [m]",
        "by heading",
        "by attitude",
        "by slip",
        "flat",
        "height: end [m]",
        "RMS",
        "by attitude",
        "by slip",
        "flat",
        "NEES at the end",
    )
    print(f"| {' | '.join(columns)} |\n" + "|---" * len(columns) + "|")
    rows = []
    for seed in range(*map(int, given.seeds.split(":"))):
        made = drive(Wander(seed), given.seconds, seed=seed, softness=given.softness)
        if given.deflection is not None:
            made = replace(made, robot=replace(made.robot, geometry=replace(made.robot.geometry, wheel_deflection=given.deflection)))
        if given.stiffness is not None:
            friction = {**made.robot.models["friction"], "slip_stiffness": given.stiffness}
            made = replace(made, robot=replace(made.robot, models={**made.robot.models, "friction": friction}))
        r = reckon(made)
        rows.append(_numbers(made, r))
        print(f"| {seed} | {_cells(rows[-1])} |", flush=True)
    for name, of in (("mean", np.mean), ("median", np.median)):
        print(f"| {name} | {_cells(of(rows, axis=0))} |")


def _numbers(made: HillDrive, r: Reckoning) -> list[float]:
    """Way [m] and turns [rad] of the drive, RMS of the position by parts [m], heights [m], NEES."""
    stations, yaw = made.positions[::_STATION], np.unwrap(np.arctan2(made.rotations[::_STATION, 1, 0], made.rotations[::_STATION, 0, 0]))
    way, turned = float(np.linalg.norm(np.diff(stations, axis=0), axis=1).sum()), float(np.abs(np.diff(yaw)).sum())
    rms = [float(np.sqrt(np.mean(np.sum(e**2, axis=1)))) for e in (r.whole, r.heading, r.attitude, r.slip, r.flat)]
    height = [float(r.whole[-1, 2]), float(np.sqrt(np.mean(r.whole[:, 2] ** 2)))]
    return [way, turned, *rms, *height, *(float(e[-1, 2]) for e in (r.attitude, r.slip, r.flat)), r.nees]


def _cells(row: FloatArray | list[float]) -> str:
    way, turned, *errors, nees = row
    return f"{way:.0f} | {turned:.0f} | {' | '.join(f'{e:.2f}' for e in errors)} | {nees:.1f}"


if __name__ == "__main__":
    main()
