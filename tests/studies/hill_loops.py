"""Loops in space: drives over hills that return after their LiDAR was silent, smoothed without and with loops by map-closures.

python -m tests.studies.hill_loops [--seeds A:B] [--seconds S] [--radius X] [--kiss]

Drives in MuJoCo among trees and walls (`tests.helpers.mujoco_hills`). Clouds of two thirds of the drive are taken out, and the robot file's
wheels are larger than the true ones by the given factor, so that the poses drift; nothing is fitted. Seed 31 was used for development.
Errors are those of the smoothed poses while there are clouds, after the best alignment (ATE), and of the last against the first of these.
`--kiss` adds KISS-ICP alone on all clouds of the drive. Needs the extras `mujoco` and `loops`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from localization.estimators import EstimatorConfig, GraphConfig
from localization.events import Scan
from localization.inputs.step_config import StepConfig
from localization.log_replay import Run, replay
from localization.pipeline import ReplayConfig, Trial
from motion_models import se3
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.hill_scans import MOUNT, make_scene, scans
from tests.helpers.hills import HillDrive, with_accelerometer_bias
from tests.helpers.in_space import aligned_rms, in_order, true_poses
from tests.helpers.mujoco_hills import Wander, drive
from tests.studies.hills import kiss_alone

_SILENT = (0.15, 0.8)
"""Shares of the drive between which there are no clouds."""
_SETTLED_S = 3.0
"""Until the vertical is known and settles [s]."""


def smoothed(made: HillDrive, clouds: list[Scan], has_loops: bool) -> Run:
    """The graph in space by its defaults, with skid_steer."""
    config = ReplayConfig(StepConfig(planar=False), EstimatorConfig(graph=GraphConfig(cloud_loops=has_loops)))
    trial = Trial(make_model("skid_steer", made.robot), "graph")
    (run,) = replay(in_order(made, clouds), [trial], made.robot, {**made.mounts, "lidar_link": MOUNT}, True, config)
    return run


def _errors(poses: FloatArray, true: FloatArray) -> tuple[float, FloatArray]:
    """ATE [m], and the error (6,) of the last pose from the first on."""
    last = se3.local(se3.inverse(poses[0]) @ poses[-1], se3.inverse(true[0]) @ true[-1])
    return aligned_rms(poses[:, :3, 3], true[:, :3, 3]), last


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="31:34", metavar="A:B")
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--radius", type=float, default=1.15)
    parser.add_argument("--kiss", action="store_true")
    given = parser.parse_args()
    columns = (
        "seed",
        "estimator",
        "loops",
        "ATE with clouds [m]",
        "error at the end [m]",
        "heading at the end [mrad]",
        "sigma at the end [m]",
    )
    print(f"| {' | '.join(columns)} |\n" + "|---" * len(columns) + "|")
    for seed in range(*map(int, given.seeds.split(":"))):
        made = with_accelerometer_bias(drive(Wander(seed), given.seconds, seed=seed), seed)
        clouds = list(scans(made, make_scene(made, seed), seed=seed))
        geometry = replace(made.robot.geometry, wheel_radius_m=given.radius * made.robot.geometry.wheel_radius_m)
        wrong = replace(made, robot=replace(made.robot, geometry=geometry))
        begin, length = int(made.stamps_ns[0]), 1e9 * given.seconds
        silence = tuple(begin + share * length for share in _SILENT)
        received = [cloud for cloud in clouds if not silence[0] < cloud.stamp_ns < silence[1]]
        for has_loops in (False, True):
            run = smoothed(wrong, received, has_loops)
            assert run.in_space is not None, "hills tilt"
            stamps = run.in_space.stamps_ns
            kept = (stamps > begin + 1e9 * _SETTLED_S) & ~((silence[0] < stamps) & (stamps < silence[1] + 5e8))
            poses = np.tile(np.eye(4), (int(kept.sum()), 1, 1))
            poses[:, :3, :3] = Rotation.from_quat(run.in_space.quaternions[kept]).as_matrix()
            poses[:, :3, 3] = run.in_space.positions[kept]
            ate, last = _errors(poses, true_poses(made, stamps[kept]))
            sigma = np.sqrt(np.trace(run.in_space.covariances[kept][-1, :3, :3]))
            found = f"{run.counts.get('loops', 0)} | {ate:.3f} | {np.linalg.norm(last[:3]):.3f} | {1e3 * last[5]:+.1f} | {sigma:.3f}"
            print(f"| {seed} | graph{', loops' if has_loops else ''} | {found} |", flush=True)
        if given.kiss:
            by_kiss, stamps = kiss_alone(made, clouds)
            ate, last = _errors(by_kiss, true_poses(made, stamps))
            found = f"- | {ate:.3f} | {np.linalg.norm(last[:3]):.3f} | {1e3 * last[5]:+.1f} | -"
            print(f"| {seed} | KISS-ICP, all clouds | {found} |", flush=True)


if __name__ == "__main__":
    main()
