"""A peer that is a program of its own, built from sources: ``python source.py drive.npz OUT NAME PROGRAM [KEY=VALUE ...]``.

The program reads a binary drive: int64 N; N int64 ends of the scans in the points; doubles x, y, z of all points; N x 3 poses of the LiDAR
by the wheels; 3 of its mount. It writes a line x y yaw for each scan.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from exchange import Drive, FloatArray, arguments, matrix, planar, write


def open_karto_arguments(drive: Drive, settings: Mapping[str, str]) -> list[str]:
    """slam_toolbox's offline parameters are the program's own; the beams are the scanner's, with a hundredth beam of slack at the ends."""
    first, step, count = drive.beams
    return [f"{first:.9g}", f"{step:.9g}", f"{int(count)}", f"{drive.max_range_m:g}", *(word for pair in settings.items() for word in pair)]


def kinematic_icp_arguments(drive: Drive, settings: Mapping[str, str]) -> list[str]:
    """Voxel [m], its defaults' 1 m, range [m], and iterations of the registration."""
    return [settings.get("voxel", "1.0"), f"{drive.max_range_m:g}", settings.get("iterations", "10")]


PROGRAMS: Mapping[str, tuple[Callable[[Drive, Mapping[str, str]], list[str]], bool]] = {
    "open_karto": (open_karto_arguments, False),
    "kinematic-icp": (kinematic_icp_arguments, True),
}
"""Arguments behind the paths, and whether the program gives poses of the body rather than of the LiDAR."""


def main() -> None:
    """Run the program and write what it found. Raises `SystemExit` where it fails."""
    drive, out = arguments()
    name, program, *pairs = sys.argv[3:]
    make_arguments, gives_body = PROGRAMS[name]
    settings = dict(pair.split("=", 1) for pair in pairs)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "drive.bin", Path(folder) / "poses.txt"
        write_binary(drive, source)
        begin = sum(os.times()[2:4])
        done = subprocess.run([program, source, target, *make_arguments(drive, settings)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name} ended with {done.returncode}: {(done.stderr.strip().splitlines() or ['without a word'])[-1]}")
        seconds = sum(os.times()[2:4]) - begin
        poses = np.loadtxt(target).reshape(-1, 3)
    if len(poses) != len(drive.stamps_ns):
        raise SystemExit(f"{name} wrote {len(poses)} poses for {len(drive.stamps_ns)} scans")
    body_T_lidar = matrix(drive.body_T_lidar)
    body: FloatArray = poses if gives_body else planar(body_T_lidar @ matrix(poses) @ np.linalg.inv(body_T_lidar))
    write(out, drive.stamps_ns, body, seconds)


def write_binary(drive: Drive, path: Path) -> None:
    """The drive as the program reads it."""
    with path.open("wb") as file:
        for values, kind in (
            (len(drive.stamps_ns), np.int64),
            (drive.ends, np.int64),
            (drive.points, np.float64),
            (drive.odometry, np.float64),
            (drive.body_T_lidar, np.float64),
        ):
            file.write(np.asarray(values, dtype=kind).tobytes())


if __name__ == "__main__":
    main()
