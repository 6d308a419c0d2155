"""Run one estimator of skidloc in a process of its own: python -m tests.league.ours LOG ESTIMATOR MATCHER OUT, and FOLDER for own logs."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from tests.league.logs import find_logs
from tests.league.peers.exchange import write

_WARM_UP_S = 20.0


def main(log: str, estimator: str, matcher: str, out: str, folder: str = "") -> None:
    """Write OUT.npz (stamps_ns, poses, covariances), OUT live.npz where the estimator smooths, and OUT.json with CPU and memory."""
    drive = find_logs(Path(folder) if folder else None)[log].open()
    drive.until(_WARM_UP_S).run(estimator, matcher=matcher)  # compiles
    begin = time.process_time()
    run = drive.run(estimator, matcher=matcher)
    seconds = time.process_time() - begin
    if run.live is not None:
        write(f"{out} live", run.live.stamps_ns, run.live.poses, seconds, run.live.covariances)
    write(out, run.trajectory.stamps_ns, run.trajectory.poses, seconds, run.trajectory.covariances)


if __name__ == "__main__":
    main(*sys.argv[1:])
