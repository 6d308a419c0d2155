"""Compiled LiDAR odometries of evalio, each with its defaults there: poses on simulated hills, as `tests.studies.hills.FRONT_ENDS`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from localization.events import ImuSample, Scan
from motion_models import se3
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from tests.helpers.hill_scans import COLUMNS, HALF_FIELD_RAD, MOUNT, RINGS, SWEEP_NS
from tests.helpers.hills import HillDrive

_MIN_RANGE_M, _MAX_RANGE_M = 0.3, 50.0
_IMU_RATE_HZ = 100.0
_NS = 1_000_000_000
_THREADS = ("num_threads", "max_num_threads", "ls_num_threads", "numberOfCores")
"""Names of the pipelines' numbers of threads: one, as the others have."""


def _stamp(stamp_ns: int) -> Any:
    from evalio.types import Stamp  # type: ignore[import-not-found]  # of tests/league/requirements.txt

    return Stamp(sec=stamp_ns // _NS, nsec=stamp_ns % _NS)


def _measurement(cloud: Scan) -> Any:
    """The sweep ring by ring, all columns of each, as evalio's own readers give it: a beam without an echo is a point at the origin."""
    from evalio.types import Duration, LidarMeasurement, Point

    ranges = np.linalg.norm(cloud.points, axis=1)
    rows = np.rint((np.arcsin(cloud.points[:, 2] / ranges) + HALF_FIELD_RAD) / (2.0 * HALF_FIELD_RAD) * (RINGS - 1)).astype(int)
    columns = np.rint(cloud.offsets * _NS / SWEEP_NS * COLUMNS).astype(int)
    at = np.full((RINGS, COLUMNS), -1)
    at[rows, columns] = np.arange(len(rows))
    points = []
    for row, column in np.ndindex(RINGS, COLUMNS):
        t, k = Duration.from_nsec(column * SWEEP_NS // COLUMNS), at[row, column]
        x, y, z = cloud.points[k].tolist() if k >= 0 else (0.0, 0.0, 0.0)
        points.append(Point(x=x, y=y, z=z, t=t, range=round(1e3 * ranges[k]) if k >= 0 else 0, row=row, col=column))
    return LidarMeasurement(_stamp(cloud.stamp_ns), points)


def _lifted(mount: Mount) -> FloatArray:
    """(4, 4) ``body_T_sensor`` of a ``mount`` that is not turned."""
    T = np.eye(4)
    T[:3, 3] = mount.x, mount.y, mount.z
    return T


def run_pipeline(kind: str, made: HillDrive, clouds: list[Scan]) -> tuple[FloatArray, FloatArray]:
    """Poses (N, 4, 4) of the body and their stamps (N,) by evalio's pipeline ``kind``, with the IMU where it takes one."""
    from evalio import pipelines
    from evalio.types import SE3, ImuMeasurement, ImuParams, LidarParams

    pipeline = getattr(pipelines, kind)()
    body_T_imu = _lifted(made.mounts["imu_link"])
    pipeline.set_imu_params(ImuParams(gravity=np.array([0.0, 0.0, -9.81]), rate=_IMU_RATE_HZ))
    pipeline.set_lidar_params(LidarParams(num_rows=RINGS, num_columns=COLUMNS, min_range=_MIN_RANGE_M, max_range=_MAX_RANGE_M))
    pipeline.set_imu_T_lidar(SE3.from_mat(np.asfortranarray(se3.inverse(body_T_imu) @ _lifted(MOUNT))))
    defaults = type(pipeline).default_params()
    pipeline.set_params({name: 1 if name in _THREADS else value for name, value in defaults.items()})
    pipeline.initialize()
    imu, at = [event for event in made.events if isinstance(event, ImuSample)], 0
    poses: list[FloatArray] = []
    stamps_ns: list[int] = []
    for cloud in clouds:
        while at < len(imu) and imu[at].stamp_ns <= cloud.stamp_ns + SWEEP_NS:
            pipeline.add_imu(ImuMeasurement(_stamp(imu[at].stamp_ns), imu[at].angular_velocity, imu[at].linear_acceleration))
            at += 1
        pipeline.add_lidar(_measurement(cloud))
        for stamp, pose in pipeline.saved_estimates():
            stamps_ns.append(stamp.to_nsec())
            poses.append(pose.to_mat() @ se3.inverse(body_T_imu))
    return np.array(poses), np.array(stamps_ns)


PIPELINES: Mapping[str, Callable[[HillDrive, list[Scan]], tuple[FloatArray, FloatArray]]] = {
    name: functools.partial(run_pipeline, kind)
    for name, kind in {
        "CT-ICP (evalio)": "CTICP",
        "MAD-ICP (evalio)": "MadICP",
        "DLIO (evalio)": "DLIO",
        "LIO-SAM (evalio)": "LioSAM",
        "LOAM (evalio)": "LOAM",
        "FORM (evalio)": "FORM",
    }.items()
}
