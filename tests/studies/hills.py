"""Slopes: what the flat model gets wrong and what the friction model on slopes predicts, beside measurements in MuJoCo.

python -m tests.studies.hills

The measurements are two independent sets, turning in place on inclined planes, with soft contacts (ellipsoid wheels, solref .01 to .1,
elliptic cones, steps of 1 ms or less); nothing of the law is fitted to them. The first is of a robot of a Husky's size, 10 s, about 540
degrees; the second gives k and the centre of rotation over all headings, mu 0.6 and contacts that slide (slip_stiffness 100). The third
table replays wheels and IMU of drives in MuJoCo (`tests.helpers.mujoco_hills`): turns in place, and 2 min over hills; some minutes of
computing. Needs the extra `mujoco`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from localization.pipeline import ReplayConfig, Trial, replay
from localization.synchronizer import StepConfig
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope
from tests.helpers.hills import HillDrive
from tests.helpers.mujoco_hills import Wander, drive, steady, turn_in_place

_RADIUS_M, _STEP_S = 0.165, 0.02
_MODEL = FrictionModel.from_robot(load_robot("husky_a200"))


@dataclass(frozen=True)
class Turning:
    """Turns in place for 10 s on an inclined plane, measured."""

    slope_deg: float
    mu: float
    cg_height_m: float
    slid_m: float
    """Downhill."""
    turned_more: float
    """Than on the flat, as a share."""


TURNINGS = (
    Turning(5.0, 0.8, 0.40, 0.68, 0.014),
    Turning(10.0, 0.8, 0.40, 1.24, 0.081),
    Turning(15.0, 0.8, 0.40, 1.77, 0.23),
    Turning(5.0, 0.5, 0.40, 1.07, 0.027),
    Turning(10.0, 0.5, 0.40, 2.12, 0.11),
    Turning(5.0, 0.8, 0.25, 0.71, 0.012),
)
_WHEELBASE_M, _TRACK_M = 0.512, 0.57
_TURNED_RAD, _DURATION_S = math.radians(540.0), 10.0


@dataclass(frozen=True)
class Headings:
    """k, and the ranges of the centre of rotation, over all headings."""

    robot: str
    wheelbase_m: float
    track_m: float
    cg_height_m: float
    slope_deg: float
    k: tuple[float, float]
    x_m: float
    y_m: float


HEADINGS = (
    Headings("Jackal", 0.262, 0.3756, 0.12, 5.0, (0.668, 0.739), 0.177, 0.071),
    Headings("Jackal", 0.262, 0.3756, 0.12, 10.0, (0.637, 0.824), 0.225, 0.153),
    Headings("Husky", 0.512, 0.5708, 0.20, 5.0, (0.475, 0.545), 0.292, 0.265),
    Headings("Husky", 0.512, 0.5708, 0.20, 10.0, (0.416, 0.684), 0.460, 0.539),
)


def parameters(wheelbase_m: float, track_m: float, mu: float, slip_stiffness: float, rolling_resistance: float) -> FloatArray:
    """(12,) of a symmetric robot."""
    return np.array([_RADIUS_M, track_m, wheelbase_m, mu, 1.0, slip_stiffness, rolling_resistance, 0.0, 0.0, 0.0, 0.0, 0.0])


def turn(of: Turning) -> FloatArray:
    """(3,) the pose after `Turning` by the law, on a plane that rises towards +x; the flat model stays at the start."""
    params = parameters(_WHEELBASE_M, _TRACK_M, of.mu, 10.0, 0.0)
    flat = _MODEL.twist(np.array([-1.0, 1.0]), np.zeros(2), params).value[2]
    rate = _TURNED_RAD / _DURATION_S / flat
    steep, pose = math.tan(math.radians(of.slope_deg)), np.zeros(3)
    for _ in range(round(_DURATION_S / _STEP_S)):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        slope = Slope(steep * np.array([-c, s]), of.cg_height_m)
        vx, vy, wz = _MODEL.twist_on_slope(np.array([-rate, rate]), np.zeros(2), params, slope).twist.value
        pose = pose + _STEP_S * np.array([c * vx - s * vy, s * vx + c * vy, wz])
    return np.asarray(pose)


def over_headings(of: Headings, n: int = 72) -> Headings:
    """``of`` with k and the centre of rotation by the law."""
    params, psi = parameters(of.wheelbase_m, of.track_m, 0.6, 100.0, 0.0), np.linspace(0.0, 2.0 * math.pi, n, endpoint=False)
    slope = Slope(math.tan(math.radians(of.slope_deg)) * np.column_stack([np.cos(psi), np.sin(psi)]), of.cg_height_m)
    vx, vy, wz = _MODEL.twist_on_slope(np.tile([-1.0, 1.0], (n, 1)), np.zeros(2), params, slope).twist.value.T
    k = wz * of.track_m / (2.0 * _RADIUS_M)
    found = (float(k.min()), float(k.max())), float(np.ptp(vy / wz)), float(np.ptp(vx / wz))
    return Headings(of.robot, of.wheelbase_m, of.track_m, of.cg_height_m, of.slope_deg, *found)


def errors(drive: HillDrive, estimator: str, slopes: bool, model: str = "skid_steer") -> tuple[float, float, float, float]:
    """Errors of a replay [m]: of the position at the end and RMS, of the displacement over 10 s (RMS), and of the height at the end.

    With ``slopes`` in space, else in the plane with a height that stays; both from the true first pose.
    """
    config = ReplayConfig(step=StepConfig(slopes=slopes))
    trial = Trial(make_model(model, drive.robot), estimator)
    (run,) = replay(drive.events, [trial], drive.robot, drive.mounts, False, config)
    if run.in_space is not None:
        stamps, found, yaw = run.in_space.stamps_ns, run.in_space.positions, _yaws(Rotation.from_quat(run.in_space.quaternions).as_matrix())
    else:
        stamps, yaw = run.trajectory.stamps_ns, run.trajectory.poses[:, 2]
        found = np.column_stack([run.trajectory.poses[:, :2], np.zeros(len(stamps))])
    at = np.searchsorted(drive.stamps_ns, stamps).clip(0, len(drive.stamps_ns) - 1)
    true, true_yaw = drive.positions[at], _yaws(drive.rotations[at])
    off = _level(yaw[0], found - found[0]) - _level(true_yaw[0], true - true[0])
    error = np.linalg.norm(off, axis=1)
    until = np.searchsorted(stamps, stamps + 10_000_000_000)
    starts = np.flatnonzero(until < len(stamps))[::20]
    apart = [
        np.linalg.norm(_level(yaw[i], found[until[i]] - found[i]) - _level(true_yaw[i], true[until[i]] - true[i])) for i in starts.tolist()
    ]
    return float(error[-1]), float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean(np.square(apart)))), float(off[-1, 2])


def _yaws(rotations: FloatArray) -> FloatArray:
    return np.asarray(np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])))


def _level(yaw: float, ways: FloatArray) -> FloatArray:
    """``ways`` (..., 3) in axes that point along a heading."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(ways @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def print_replays() -> None:
    """Replays of drives in MuJoCo: wheels and IMU in, poses out."""
    print("\n| MuJoCo, replayed | estimator | model | end [m] | RMS [m] | over 10 s [m] | height at the end [m] |\n" + "|---" * 7 + "|")
    drives = {
        f"in place, {deg:.0f} deg, mu {mu}": (turn_in_place, 12.0, mu, deg)
        for deg, mu in ((5.0, 0.8), (10.0, 0.8), (5.0, 0.5), (10.0, 0.5))
    }
    drives |= {
        f"{name}, 10 deg, mu 0.8": (steady(*c), 12.0, 0.8, 10.0)
        for name, c in (("up", (0.5, 0.0)), ("arc", (0.6, 0.2)), ("tight arc", (0.3, 0.6)))
    }
    drives |= {f"hills, seed {seed}": (Wander(seed), 120.0, 0.8, None) for seed in (1, 2)}
    for name, how in drives.items():
        made = drive(*how)
        for estimator in ("odometry", "ekf"):
            for slopes in (False, True):
                end, rms, apart, height = errors(made, estimator, slopes)
                kind = "slopes" if slopes else "flat"
                print(f"| {name} | {estimator} | {kind} | {end:.2f} | {rms:.2f} | {apart:.2f} | {height:+.3f} |", flush=True)


def main() -> None:
    """Print the tables."""
    print(
        "| slope | mu | CG [m] | slid downhill: MuJoCo = flat model's error | with the law | left | turned more: MuJoCo | law |\n"
        + "|---" * 8
        + "|"
    )
    for row in TURNINGS:
        x, _, yaw = turn(row)
        more = yaw / _TURNED_RAD - 1.0
        print(
            f"| {row.slope_deg:.0f} deg | {row.mu} | {row.cg_height_m:.2f} | {row.slid_m:.2f} m | {-x:.2f} m | {-x - row.slid_m:+.2f} m "
            f"| {row.turned_more:.1%} | {more:.1%} |"
        )
    print("\n| robot | slope | k: law | k: MuJoCo | x of the centre of rotation: law / MuJoCo [m] | y |\n" + "|---" * 6 + "|")
    for seen in HEADINGS:
        law = over_headings(seen)
        print(
            f"| {seen.robot} | {seen.slope_deg:.0f} deg | {law.k[0]:.3f} to {law.k[1]:.3f} | {seen.k[0]:.3f} to {seen.k[1]:.3f} "
            f"| {law.x_m:.3f} / {seen.x_m:.3f} | {law.y_m:.3f} / {seen.y_m:.3f} |"
        )
    print_replays()


if __name__ == "__main__":
    main()
