"""Files between skidloc and a peer's own environment: a drive as arrays in, poses and their cost out. Imports numpy alone.

A peer is a module with ``register(drive) -> (N, 3)``: poses of the LiDAR in the frame of its first pose, one for each scan [m, m, rad].
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """Scans of one log, and the robot's wheel odometry at their stamps."""

    stamps_ns: NDArray[np.int64]
    """(N,) middle of each scan."""
    points: FloatArray
    """(M, 3) points of all scans in the LiDAR's frame [m], already freed of the robot's motion by wheels alone."""
    ends: NDArray[np.int64]
    """(N,) index behind the last point of each scan."""
    odometry: FloatArray
    """(N, 3) poses of the LiDAR by wheel odometry [m, m, rad]."""
    body_T_lidar: FloatArray
    """(3,)"""
    beams: FloatArray
    """(3,) first angle, angle between beams [rad], number of beams of the planar scanner."""
    max_range_m: float

    @classmethod
    def load(cls, path: Path) -> Drive:
        """Read the file that `save` wrote."""
        with np.load(path) as arrays:
            return cls(**{name: arrays[name] if arrays[name].ndim else arrays[name].item() for name in arrays.files})

    def save(self, path: Path) -> None:
        """Write the arrays as one .npz."""
        np.savez_compressed(path, **vars(self))

    def scans(self) -> Iterator[FloatArray]:
        """(n, 3) points of each scan."""
        return iter(np.split(self.points, self.ends[:-1]))

    def ranges(self, points: FloatArray, missing: float) -> FloatArray:
        """(B,) ranges of the beams of one scan's ``points`` (n, 3) [m]; ``missing`` where a beam has no point."""
        first, step, count = self.beams
        found = np.full(int(count), missing)
        beam = np.rint((np.arctan2(points[:, 1], points[:, 0]) - first) / step).astype(int)
        found[np.clip(beam, 0, int(count) - 1)] = np.hypot(points[:, 0], points[:, 1])
        return found

    def predictions(self) -> FloatArray:
        """(N, 4, 4) motion of the LiDAR since the scan before, by wheel odometry; the first is the identity."""
        poses = matrix(self.odometry)
        moved = np.linalg.inv(poses[:-1]) @ poses[1:]
        return np.concatenate([np.eye(4)[None], moved])


def matrix(pose: FloatArray) -> FloatArray:
    """(..., 4, 4) homogeneous transforms of planar poses (..., 3)."""
    x, y, yaw = np.moveaxis(np.asarray(pose, dtype=float), -1, 0)
    T = np.zeros((*np.shape(x), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    T[..., 0, 3], T[..., 1, 3], T[..., 2, 2], T[..., 3, 3] = x, y, 1.0, 1.0
    return T


def planar(T: FloatArray) -> FloatArray:
    """(..., 3) x, y and yaw of homogeneous transforms (..., 4, 4)."""
    return np.stack([T[..., 0, 3], T[..., 1, 3], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)


def run(register: Callable[[Drive], FloatArray]) -> None:
    """Command line of a peer: ``python peer.py drive.npz OUT`` writes OUT.npz, poses of the body, and OUT.json, CPU [s] and memory [MB]."""
    drive, out = arguments()
    begin = sum(os.times()[:4])
    lidar_poses = register(drive)
    seconds = sum(os.times()[:4]) - begin  # user and system, of this process and of programs that it ran
    body_T_lidar = matrix(drive.body_T_lidar)
    body = planar(body_T_lidar @ matrix(lidar_poses) @ np.linalg.inv(body_T_lidar))
    write(out, drive.stamps_ns, body, seconds)


def setting(name: str, default: float) -> float:
    """The value of ``NAME=VALUE`` behind the two paths of the command line, as for settings that are tuned."""
    given = dict(word.split("=", 1) for word in sys.argv[3:] if "=" in word)
    return float(given.get(name, default))


def arguments() -> tuple[Drive, str]:
    """The drive and OUT of the command line."""
    return Drive.load(Path(sys.argv[1])), sys.argv[2]


def write(out: str, stamps_ns: NDArray[np.int64], poses: FloatArray, cpu_s: float, covariances: FloatArray | None = None) -> None:
    """Write poses of the body (N, 3), in space (N, 4, 4), covariances (N, 3, 3) of right perturbations if there are any, and the cost."""
    more = {} if covariances is None else {"covariances": covariances}
    np.savez_compressed(f"{out}.npz", stamps_ns=stamps_ns, poses=poses, **more)
    Path(f"{out}.json").write_text(json.dumps({"cpu_s": cpu_s, "memory_mb": peak_memory_mb()}))


def peak_memory_mb() -> float:
    """Greatest resident memory of this process, or of a program that it ran [MB]. (`getrusage` of a process itself begins with the memory
    of the process that started it.)"""
    status = Path("/proc/self/status").read_text()
    own_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    return max(own_kb, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024
