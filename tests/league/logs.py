"""Logs of the league: those of tests/data and of a folder of one's own, as events for skidloc and as arrays for its peers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.events import Scan
from localization.lidar.deskew import Sweep
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from tests.league.peers.exchange import Drive as Arrays
from tests.studies.buildings import BUILDINGS, Building, Drive

_REFERENCES = (".tum", ".relations", ".csv", ".txt")
_TWIST_OVER_NS = 50_000_000
"""Half of the interval over which wheel odometry gives the twist that deskews a scan."""


def find_logs(folder: Path | None) -> dict[str, Building]:
    """The league's logs by name. ``folder`` adds NAME.mcap (or .bag) with NAME.toml and a reference NAME.tum, .relations, .csv, .txt."""
    found = dict(BUILDINGS)
    for log in sorted([*folder.glob("*.mcap"), *folder.glob("*.bag")]) if folder else []:
        references = [log.with_suffix(suffix) for suffix in _REFERENCES if log.with_suffix(suffix).exists()]
        if not references or not log.with_suffix(".toml").exists():
            raise SystemExit(f"{log}: {log.stem}.toml and a reference ({', '.join(log.stem + s for s in _REFERENCES)}) must be beside it.")
        found[log.stem] = Building(log, str(log.with_suffix(".toml")), references[0])
    return found


def peer_arrays(drive: Drive) -> Arrays:
    """Scans of ``drive`` for peers: deskewed by wheel odometry, which is given at the middle of each scan as well."""
    scans = [event for event in drive.events if isinstance(event, Scan) and len(event.points)]
    wheels = drive.run("odometry").trajectory
    stamps = np.array([scan.middle_ns for scan in scans])
    is_covered = (stamps >= wheels.stamps_ns[0]) & (stamps <= wheels.stamps_ns[-1])
    scans, stamps = [scan for scan, use in zip(scans, is_covered, strict=True) if use], stamps[is_covered]
    mount = drive.mounts.get(scans[0].frame_id, Mount())
    body_T_lidar = np.array([mount.x, mount.y, mount.yaw])
    clouds = [_in_lidar_frame(scan, mount, twist) for scan, twist in zip(scans, _twists(wheels, stamps), strict=True)]
    longest = max(scans, key=lambda scan: len(scan.points))
    angles = np.sort(np.arctan2(longest.points[:, 1], longest.points[:, 0]))
    step = float(np.median(np.diff(angles)))
    ranges = np.concatenate([np.linalg.norm(cloud, axis=1) for cloud in clouds])
    return Arrays(
        stamps,
        np.concatenate(clouds),
        np.cumsum([len(cloud) for cloud in clouds]),
        se2.compose(wheels.at(stamps), body_T_lidar),
        body_T_lidar,
        np.array([angles[0], step, round((angles[-1] - angles[0]) / step) + 1]),
        float(np.ceil(ranges.max())),
    )


def _in_lidar_frame(scan: Scan, mount: Mount, twist: FloatArray) -> FloatArray:
    """(n, 3) deskewed points in the plane of the body, seen from the LiDAR's place and heading."""
    points = Sweep.from_scan(scan, mount).deskew(twist)
    c, s = np.cos(mount.yaw), np.sin(mount.yaw)
    planar = (points[:, :2] - [mount.x, mount.y]) @ np.array([[c, -s], [s, c]])
    return np.column_stack([planar, points[:, 2] - mount.z])


def _twists(wheels: Trajectory, stamps_ns: np.ndarray) -> FloatArray:
    """(N, 3) twist of the body by wheel odometry at ``stamps_ns`` (N,)."""
    before = np.maximum(stamps_ns - _TWIST_OVER_NS, wheels.stamps_ns[0])
    after = np.minimum(stamps_ns + _TWIST_OVER_NS, wheels.stamps_ns[-1])
    moved = se2.log(se2.between(wheels.at(before), wheels.at(after)))
    return np.asarray(moved / ((after - before) * 1e-9)[:, None])
