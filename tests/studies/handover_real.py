"""Robot files that a diagnosis hands over, on measured logs: estimators with the file before and after, against poses that were no input.

python -m tests.studies.handover_real [--log aces,fr079,csail] [--begins 0,2,4] [--folder FOLDER]

The log is diagnosed by its scans and wheels alone (`skidloc diagnose --out`); the written file is read again, and the log replayed by
diff_drive with both files; the reference is scored against, and nothing else. Errors are ATE, for ACES the mean error of the relations, in
metres. A filter's error on one drive moves by as much as 10 % with its first scan alone, so that each replay is begun at several instants
of the log: mean over the begins, and mean and standard deviation of the relative change between replays of the same begin.

The references come from the same LiDAR by other matchers, so that they are of a point that is fixed to it. A file that corrects its mount
moves the body's origin along the robot instead: both replays are scored at the point that is the origin by the first file.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console

from localization.commands.diagnose import Diagnose
from localization.log_replay import replay
from localization.pipeline import Trial
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from tests.studies.buildings import BUILDINGS, errors_of

ESTIMATORS = ("odometry", "ekf", "graph")
_COLUMNS = ("odometry", "ekf", "graph live", "graph smoothed")
_LIDAR = "laser"
"""Frame of the LiDAR in these logs."""


def handed_over(name: str, folder: Path) -> str:
    """Diagnose log ``name`` into ``folder``; the robot file that it wrote."""
    out = folder / f"{name}-diagnosis"
    if not out.exists():
        Diagnose(BUILDINGS[name].log, BUILDINGS[name].robot, out=out, static=True).run(Console(width=200))
    return str(out / "robot.toml")


def errors(name: str, robot: str, begins_s: list[float]) -> list[list[float]]:
    """Errors [m] with the file ``robot`` of `_COLUMNS`, for each begin."""
    first, drive = (dataclasses.replace(BUILDINGS[name], robot=file).open() for file in (BUILDINGS[name].robot, robot))
    base_T_lidar, origin_T_lidar = (_planar(d.mounts[_LIDAR]) for d in (drive, first))
    point = se2.compose(base_T_lidar, se2.inverse(origin_T_lidar))
    found = []
    for begin_s in begins_s:
        start_ns = drive.events[0].stamp_ns + round(begin_s * 1e9)
        events = [event for event in drive.events if event.stamp_ns >= start_ns]
        trials = [Trial(make_model("diff_drive", drive.robot), estimator) for estimator in ESTIMATORS]
        odometry, ekf, graph = replay(events, trials, drive.robot, drive.mounts, has_lidar=True)
        tracks = odometry.trajectory, ekf.trajectory, graph.live, graph.trajectory
        found.append([errors_of(_at(track, point), drive.reference)[0] for track in tracks if track is not None])
    return found


def _at(track: Trajectory, base_T_point: FloatArray) -> Trajectory:
    """``track`` of a point that is fixed to the body, by its pose (3,) there; without covariances, which are of the origin."""
    return Trajectory(track.stamps_ns, se2.compose(track.poses, np.broadcast_to(base_T_point, track.poses.shape)))


def _planar(mount: Mount) -> FloatArray:
    return np.array([mount.x, mount.y, mount.yaw])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--begins", default="0,2,4", help="seconds after the log's first message")
    parser.add_argument("--folder", type=Path, default=None, help="keeps diagnoses, which are not made again")
    options = parser.parse_args()
    begins_s = [float(text) for text in options.begins.split(",")]
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in options.log.split(","):
            new = handed_over(name, folder)
            before, after = (np.array(errors(name, robot, begins_s)) for robot in (BUILDINGS[name].robot, new))
            change = 100.0 * (after / before - 1.0)
            spread = change.std(axis=0, ddof=1) if len(begins_s) > 1 else np.zeros(len(_COLUMNS))
            print(f"{name}, begun at {options.begins} s")
            for i, column in enumerate(_COLUMNS):
                means = f"{before[:, i].mean():.4f} -> {after[:, i].mean():.4f} m"
                print(f"  {column:15s} {means}  {change[:, i].mean():+.1f} % (sd {spread[i]:.1f})", flush=True)


if __name__ == "__main__":
    main()
