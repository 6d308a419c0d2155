"""Run one system with a 3D LiDAR on simulated hills in a process of its own: python -m tests.league.hills LOG SYSTEM PEERS OUT.

The drives are in MuJoCo (extra `mujoco`), 20 s with sixteen rings, by seeds that nothing was fitted to (`tests.studies.hills`). PEERS is
the folder of the peers' packages, which are searched after our own.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from motion_models.se2 import FloatArray
from tests.helpers.hill_scans import make_scene, scans
from tests.helpers.hills import HillDrive, with_accelerometer_bias
from tests.helpers.in_space import run_in_space, true_poses
from tests.league.evalio_pipelines import PIPELINES
from tests.league.peers.exchange import write
from tests.studies.hills import FRONT_ENDS, SCENES

SECONDS = 20.0
HILLS: Mapping[str, tuple[int, str]] = {"hills-trees": (83, "trees and walls"), "hills-grass": (84, "open grass")}
"""Seed and scene, by name of the log."""
_WARM_UP_S = 6.0


def _ours(made: HillDrive, clouds: list) -> tuple[FloatArray, FloatArray]:
    found, _ = run_in_space(made, clouds)
    return found.poses, found.stamps_ns


def main(log: str, system: str, peers: str, out: str) -> None:
    """Write OUT.npz (stamps_ns, poses (N, 4, 4) of the body), OUT reference.npz at the same stamps, and OUT.json with CPU and memory."""
    sys.path.append(peers)
    from tests.helpers.mujoco_hills import Wander, drive  # of the extra `mujoco`

    seed, scene = HILLS[log]
    made = with_accelerometer_bias(drive(Wander(seed), SECONDS, seed=seed), seed)
    clouds = list(scans(made, make_scene(made, seed, *SCENES[scene]), seed=seed))
    register = {**FRONT_ENDS, **PIPELINES}[system] if system else _ours
    register(made, clouds[: round(_WARM_UP_S * 10)])  # compiles
    begin = time.process_time()
    poses, stamps_ns = register(made, clouds)
    seconds = time.process_time() - begin
    np.savez_compressed(Path(f"{out} reference.npz"), stamps_ns=stamps_ns, poses=true_poses(made, stamps_ns))
    write(out, stamps_ns, poses, seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
