"""Systems of the league: what each is, how it is run, and by which Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

PEERS = Path(__file__).parent / "peers"


@dataclass(frozen=True)
class System:
    """One system with its default settings."""

    name: str
    what: str
    """Sensors that it uses, and settings that are not its defaults."""
    peer: str = ""
    """Script in `peers/`, of a peer."""
    estimator: str = ""
    """Of skidloc."""
    matcher: str = "submap"
    in_space: str | None = None
    """With a 3D LiDAR on hills: its name in `tests.studies.hills`, empty for skidloc."""
    folders: tuple[Path, ...] = ()
    """Of a system that the user has added (`joined`)."""
    tuned: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Settings that are tuned on one log, with their values."""


EVALIO: Mapping[str, str] = {
    "CT-ICP (evalio)": "3D LiDAR alone",
    "MAD-ICP (evalio)": "3D LiDAR alone",
    "FORM (evalio)": "3D LiDAR alone",
    "LOAM (evalio)": "3D LiDAR alone",
    "DLIO (evalio)": "3D LiDAR and IMU",
    "LIO-SAM (evalio)": "3D LiDAR and IMU",
}
"""Sensors of the pipelines that evalio has compiled, by name."""

_KISS: Mapping[str, Sequence[float]] = {"voxel": (0.05, 0.1, 0.2, 0.4, 0.8), "threshold": (0.25, 0.5, 1.0, 2.0), "range": (20.0, 80.0)}
"""Voxel and first threshold [m], and the longest range that is used [m]."""
_GICP: Mapping[str, Sequence[float]] = {"downsampling": (0.05, 0.1, 0.25), "voxel": (0.25, 0.5, 1.0, 2.0), "keys": (0.0, 10.0, 40.0)}
"""Voxels of the scan and of the model [m], and frames after which the model's voxels are dropped (0: never)."""

SYSTEMS: Sequence[System] = (
    System("wheels", "wheel odometry, diff_drive", estimator="odometry"),
    System(
        "robot_localization (equations)",
        "wheels: vx, vy, vyaw; its EKF and default settings written in numpy, as the package is not on the index",
        peer="robot_localization",
    ),
    System("skidloc ekf", "wheels and LiDAR, live", estimator="ekf"),
    System("skidloc graph", "wheels and LiDAR, live and smoothed", estimator="graph"),
    System("skidloc ekf with KISS-ICP", "wheels and LiDAR, live, KISS-ICP as matcher", estimator="ekf", matcher="kiss"),
    System("KISS-ICP", "LiDAR alone; its own defaults, 3D pipeline on planar scans", peer="kiss", tuned=_KISS),
    System("KISS-SLAM", "LiDAR alone; its own defaults, final poses", peer="kiss_graph"),
    System("KISS-ICP + wheels", "LiDAR, each registration started from wheel odometry", peer="kiss_wheels", tuned=_KISS),
    System("GenZ-ICP", "LiDAR alone; its interface takes no initial guess", peer="genz"),
    System("small_gicp + wheels", "LiDAR, scan to model as in its examples, started from wheel odometry", peer="gicp", tuned=_GICP),
    System("Karto (yag_slam)", "wheels and LiDAR, slam_toolbox's matcher and graph: final poses", peer="karto"),
    System("MRPT icp-slam", "wheels and LiDAR, point map of its example icp-slam_demo_classic.ini: live poses", peer="mrpt"),
)

SYSTEMS_IN_SPACE: Sequence[System] = (
    System("skidloc ekf in space", "wheels, IMU and 3D LiDAR, live", in_space=""),
    System("KISS-ICP in space", "3D LiDAR alone, its defaults", in_space="KISS-ICP"),
    System("KISS-ICP + our prediction", "started and deskewed by wheels, gyro and gravity of skidloc", in_space="KISS-ICP, our prediction"),
    System("GenZ-ICP in space", "3D LiDAR alone, its defaults", in_space="GenZ-ICP"),
    System("small_gicp + our prediction", "as KISS-ICP + our prediction; scan to model", in_space="small_gicp, our prediction"),
    System("RKO-LIO", "3D LiDAR and IMU, its defaults", in_space="RKO-LIO"),
    *(System(name, f"{sensors}, evalio's defaults, one thread", in_space=name) for name, sensors in EVALIO.items()),
)
