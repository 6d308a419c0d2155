"""MRPT's icp-slam of Debian's packages mrpt-apps and mrpt-common, with the point map of its own example, icp-slam_demo_classic.ini.

Its drives are rawlogs, which carmen2rawlog makes of CARMEN logs; all times in them are that of the conversion, and are set here.
"""

from __future__ import annotations

import gzip
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from exchange import Drive, FloatArray, run

_CONFIG = Path("/usr/share/mrpt/config_files/icp-slam/icp-slam_demo_classic.ini")
_OUT_OF_RANGE_M = 82.0
"""A range that carmen2rawlog takes for none: it sets 81 m as the most."""
_TICKS_PER_NS = 0.01
"""Times of rawlogs are counted in units of 100 ns."""
_SETTINGS = {"SHOW_PROGRESS_3D_REAL_TIME": "0", "SAVE_3D_SCENE": "0", "LOG_FREQUENCY": "1000000"}
"""Nothing is shown, and no intermediate maps are saved."""


def register(drive: Drive) -> FloatArray:
    """(N, 3) poses of the LiDAR, live. Raises `SystemExit` where MRPT's programs or its examples are not installed."""
    if shutil.which("icp-slam") is None or not _CONFIG.exists():
        raise SystemExit("icp-slam or its examples are missing: apt install mrpt-apps mrpt-common")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_carmen(drive, folder / "drive.log")
        _run(["carmen2rawlog", "-i", "drive.log", "-o", "drive.rawlog"], folder)
        _set_times(folder / "drive.rawlog", np.repeat(drive.stamps_ns, 2))
        settings = _CONFIG.read_text()
        for key, value in {**_SETTINGS, "rawlog_file": "drive.rawlog", "logOutput_dir": "out"}.items():
            settings = re.sub(rf"(?m)^{key}\s*=.*$", f"{key}={value}", settings)
        (folder / "icp-slam.ini").write_text(settings)
        _run(["icp-slam", "icp-slam.ini"], folder)
        path = np.loadtxt(folder / "out" / "log_estimated_path.txt")  # step, x, y, yaw: odometry and scan in turn
    return np.asarray(path[1::2, 1:4])


def _run(command: list[str], folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


def _write_carmen(drive: Drive, path: Path) -> None:
    """One line ODOM and one FLASER for each scan."""
    with path.open("w") as file:
        for index, (points, odometry) in enumerate(zip(drive.scans(), drive.odometry, strict=True)):
            ranges = drive.ranges(points, _OUT_OF_RANGE_M)
            pose = " ".join(f"{value:.6f}" for value in odometry)
            time = f"{index} robot {index}"
            file.write(f"ODOM {pose} 0 0 0 {time}\n")
            file.write(f"FLASER {len(ranges)} {' '.join(f'{value:.3f}' for value in ranges)} {pose} {pose} {time}\n")


def _set_times(path: Path, stamps_ns: np.ndarray) -> None:
    """Give the n-th observation of a rawlog the n-th of ``stamps_ns``, counted from the time of the conversion."""
    data = gzip.decompress(path.read_bytes())
    at = data.index(b"ODOMETRY") + len(b"ODOMETRY")  # the label of the first observation, before its time
    parts = data.split(data[at : at + 8])
    if len(parts) != len(stamps_ns) + 1:
        raise SystemExit(f"carmen2rawlog wrote {len(parts) - 1} times for {len(stamps_ns)} observations")
    start = int.from_bytes(data[at : at + 8], "little")
    ticks = start + np.rint((stamps_ns - stamps_ns[0]) * _TICKS_PER_NS).astype(np.int64)
    filled = (part + int(tick).to_bytes(8, "little") for part, tick in zip(parts, ticks, strict=False))
    path.write_bytes(gzip.compress(b"".join(filled) + parts[-1]))


if __name__ == "__main__":
    run(register)
