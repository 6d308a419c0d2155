"""What the filter makes of the Husky outdoors, against plain reckoning by the same wheels and gyro.

Run by `python -m tests.studies.husky_reckoning`. Reckoning integrates the wheels' mean rate and the gyro's rate less a constant bias; the
bias is zero, the mean while the wheels stand, or chosen by hindsight, with the GPS positions that score it. The rows of the EKF switch off
what the filter estimates beside the pose, one at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from localization.evaluation.metrics import evaluate
from localization.evaluation.references import ReferenceTrack, reference_track
from localization.events import Event, ImuSample, WheelSample
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import Trial
from localization.trajectory import IntArray, Trajectory
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

LOG = Path(__file__).parents[1] / "data/husky-outdoor-gps/test1.bag"
_STANDING_RAD_S = 0.01


class Drive(NamedTuple):
    """The log, read once."""

    events: list[Event]
    robot: Robot
    mounts: Mapping[str, Mount]
    reference: ReferenceTrack

    @classmethod
    def read(cls) -> Drive:
        """Of the Husky outdoors."""
        robot = load_robot("husky_a200")
        log = open_log(LOG, robot)
        return cls(list(log.events()), robot, log.mounts, reference_track(log.references("/fix")))


class Signals(NamedTuple):
    """Wheels and gyro of a drive."""

    stamps_ns: IntArray
    """(n,) of the wheels."""
    way: FloatArray
    """(n,) driven by the mean of both sides [m]."""
    is_standing: FloatArray
    """(n,) 1 where no wheel turns."""
    gyro_ns: IntArray
    """(m,)"""
    rate: FloatArray
    """(m,) about the vertical of the IMU's mount [rad/s]."""


def signals(drive: Drive) -> Signals:
    """Of wheels whose odometry has no gap."""
    wheels = [event for event in drive.events if isinstance(event, WheelSample)]
    gyro = [event for event in drive.events if isinstance(event, ImuSample)]
    stamps = np.array([event.stamp_ns for event in wheels])
    angles = np.array([event.position for event in wheels])
    rates = np.gradient(angles, stamps * 1e-9, axis=0)
    up = drive.mounts[gyro[0].frame_id].rotation[2]
    return Signals(
        stamps,
        drive.robot.geometry.wheel_radius_m * angles.mean(axis=1),
        (np.abs(rates).max(axis=1) < _STANDING_RAD_S).astype(float),
        np.array([event.stamp_ns for event in gyro]),
        np.array([up @ event.angular_velocity for event in gyro]),
    )


def bias_at_rest(found: Signals) -> tuple[float, float]:
    """Mean rate of the gyro while the wheels stand [rad/s], and for how long they do [s]."""
    is_resting = np.interp(found.gyro_ns, found.stamps_ns, found.is_standing) > 0.99
    seconds = float(np.mean(is_resting)) * float(found.gyro_ns[-1] - found.gyro_ns[0]) * 1e-9
    return float(found.rate[is_resting].mean()), seconds


def reckon(found: Signals, bias: float) -> Trajectory:
    """Poses by the wheels' way and the gyro's turn, from the origin on."""
    steps = 0.5 * (found.rate[1:] + found.rate[:-1]) - bias
    yaw_of_gyro = np.concatenate([[0.0], np.cumsum(steps * np.diff(found.gyro_ns) * 1e-9)])
    yaw = np.interp(found.stamps_ns, found.gyro_ns, yaw_of_gyro)
    way, heading = np.diff(found.way), 0.5 * (yaw[1:] + yaw[:-1])
    x, y = (np.concatenate([[0.0], np.cumsum(way * turned)]) for turned in (np.cos(heading), np.sin(heading)))
    return Trajectory(found.stamps_ns, np.stack([x, y, yaw], axis=1))


def filtered(drive: Drive, robot: Robot, corrections: str = "constant") -> Trajectory:
    """The EKF's corrected poses."""
    trial = Trial(make_model("diff_drive", robot), "ekf", corrections)
    return replay(drive.events, [trial], robot, drive.mounts, has_lidar=False)[0].trajectory


def rows(drive: Drive) -> Iterator[tuple[str, Trajectory]]:
    """Title and poses of each."""
    found, gyro = signals(drive), drive.robot.gyro_noise
    bias, rest_s = bias_at_rest(found)
    yield "reckoning, no bias", reckon(found, 0.0)
    yield f"reckoning, bias at rest ({1e3 * bias:+.2f} mrad/s in {rest_s:.0f} s)", reckon(found, bias)
    sigma = gyro.white_rad_per_sqrt_s / np.sqrt(rest_s)
    for share in (-1.0, -0.5, 0.3, 0.5, 1.0):
        yield f"reckoning, {share:+.1f} sigma of that ({1e3 * share * sigma:+.2f} mrad/s)", reckon(found, bias + share * sigma)
    yield "EKF", filtered(drive, drive.robot)
    yield "EKF without corrections of the model", filtered(drive, drive.robot, "none")
    yield "EKF without scale of the gyro", filtered(drive, replace(drive.robot, gyro_noise=replace(gyro, scale_sigma=0.0)))
    fixed = replace(gyro, bias_walk_rad_per_s_sqrt_s=0.0)
    yield "EKF with a constant bias", filtered(drive, replace(drive.robot, gyro_noise=fixed))
    wide = replace(gyro, bias_sigma_rad_per_s=5.0 * gyro.bias_sigma_rad_per_s)
    yield "EKF, prior of the bias five times as wide", filtered(drive, replace(drive.robot, gyro_noise=wide))


def main() -> None:
    drive = Drive.read()
    print(f"{'':58}ATE [m]  end [m]")
    for title, trajectory in rows(drive):
        score = evaluate(trajectory, drive.reference)
        print(f"{title:58}{score.ate_rmse_m:7.2f}{score.end_error_m:9.1f}", flush=True)


if __name__ == "__main__":
    main()
