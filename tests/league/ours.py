"""Run one estimator of skidloc in a process of its own: python -m tests.league.ours LOG ESTIMATOR MATCHER OUT, and FOLDER for own logs."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np

from localization.trajectory import Trajectory
from tests.league.logs import find_logs

_WARM_UP_S = 20.0


def main(log: str, estimator: str, matcher: str, out: str, folder: str = "") -> None:
    """Write OUT.npz (stamps_ns, poses, covariances), OUT live.npz where the estimator smooths, and OUT.json with CPU and memory."""
    drive = find_logs(Path(folder) if folder else None)[log].open()
    drive.until(_WARM_UP_S).run(estimator, matcher=matcher)  # compiles
    begin = time.process_time()
    run = drive.run(estimator, matcher=matcher)
    seconds = time.process_time() - begin
    _write(Path(f"{out}.npz"), run.trajectory)
    if run.live is not None:
        _write(Path(f"{out} live.npz"), run.live)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    Path(f"{out}.json").write_text(json.dumps({"cpu_s": seconds, "memory_mb": memory}))


def _write(path: Path, trajectory: Trajectory) -> None:
    covariances = {} if trajectory.covariances is None else {"covariances": trajectory.covariances}
    np.savez_compressed(path, stamps_ns=trajectory.stamps_ns, poses=trajectory.poses, **covariances)


if __name__ == "__main__":
    main(*sys.argv[1:])
