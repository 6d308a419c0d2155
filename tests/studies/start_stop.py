"""Change of speed at starts and stops by accelerometer and by wheels: what their comparison would show of a scale of the wheels.

python -m tests.studies.start_stop

In a second after a rest, and in one before it, the sum of the specific force ahead, less its mean at rest, is the change of speed. The
turn about the pitch axis since the rest, by the gyro less its mean at rest, takes its part of gravity away.
Printed are the scatter of its difference from that by the wheels, the factor of a least squares fit through zero with its error, by how
many sigmas wheels that lose 30 % of their ticks are off in all, and how many starts and stops it takes to see them at 3 sigma.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from localization.events import Event, ImuSample, WheelSample
from localization.logs import open_log
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY
from tests.helpers import fault_drives
from tests.studies.buildings import DATA

_REST_S, _WINDOW_S = 1.0, 1.0
_LOST = 0.3
"""Share of the ticks that are lost."""


def speeds(events: Sequence[Event], robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Times (n,) [s], and speeds ahead by the wheels (n,) [m/s]."""
    wheels = [event for event in events if isinstance(event, WheelSample)]
    t = np.array([event.stamp_ns for event in wheels]) * 1e-9
    angles = np.array([event.position.mean() for event in wheels])
    if np.isfinite(angles).all():
        return 0.5 * (t[1:] + t[:-1]), robot.geometry.wheel_radius_m * np.diff(angles) / np.maximum(np.diff(t), 1e-6)
    return t, robot.geometry.wheel_radius_m * np.array([event.velocity.mean() for event in wheels])


def forces(events: Sequence[Event], mounts: Mapping[str, Mount]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,) [s], specific forces ahead (n,) [m/s^2] and turn rates about the pitch axis (n,) [rad/s], in the body."""
    samples = [event for event in events if isinstance(event, ImuSample)]
    R = mounts.get(samples[0].frame_id, Mount()).rotation
    t = np.array([event.stamp_ns for event in samples]) * 1e-9
    a, w = (np.array([getattr(e, name) for e in samples]) @ R.T for name in ("linear_acceleration", "angular_velocity"))
    return t, a[:, 0], w[:, 1]


def changes(t: FloatArray, v: FloatArray, ti: FloatArray, a: FloatArray, w: FloatArray) -> Iterator[tuple[float, float]]:
    """Changes of speed by wheels and accelerometer at each start and stop [m/s]."""
    is_rest = np.abs(v) < 1e-3
    edges = np.flatnonzero(np.diff(is_rest.astype(int)))
    for k in edges:
        is_start = bool(is_rest[k])
        rest = (t[k] - _REST_S, t[k]) if is_start else (t[k + 1], t[k + 1] + _REST_S)
        window = (t[k], t[k] + _WINDOW_S) if is_start else (t[k + 1] - _WINDOW_S, t[k + 1])
        at_rest, inside = ((ti >= begin) & (ti <= end) for begin, end in (rest, window))
        is_still = is_rest[(t >= rest[0]) & (t <= rest[1])]
        if len(is_still) < 3 or not is_still.all() or at_rest.sum() < 10 or inside.sum() < 10:
            continue
        dt = np.gradient(ti[inside])
        pitch = np.cumsum((w[inside] - w[at_rest].mean()) * dt)
        pitch -= 0.0 if is_start else pitch[-1]
        by_accelerometer = float(((a[inside] - a[at_rest].mean() + GRAVITY * np.sin(pitch)) * dt).sum())
        yield float(np.interp(window[1], t, v) - np.interp(window[0], t, v)), by_accelerometer


def of_terrain(folder: Path) -> tuple[FloatArray, ...]:
    """The same five of a run of BorealTC, as `changes` takes them."""
    wheels, imu = (np.loadtxt(next(folder.glob(f"{kind}_*.csv")), delimiter=",", skiprows=1) for kind in ("pro", "imu"))
    return wheels[:, 0], wheels[:, 3:5].mean(axis=1), imu[:, 0], imu[:, 4], imu[:, 2]


def row(name: str, *sensors: FloatArray) -> str:
    """A line of the table for a drive; ``sensors`` as `changes` takes them."""
    found = np.array(list(changes(*sensors)))
    if len(found) < 3:
        return f"| {name} | {len(found)} | | | | | |"
    wheels, force = found.T
    scatter = float(np.sqrt(np.mean((force - wheels) ** 2)))
    factor = float(wheels @ force / (wheels @ wheels))
    sigma = scatter / math.sqrt(float(wheels @ wheels))
    size = float(np.sqrt(np.mean(wheels**2)))
    needed = (3.0 * scatter / (_LOST * size)) ** 2
    cells = f"{size:.2f} | {scatter:.3f} | {factor:.2f} +- {sigma:.2f} | {_LOST / sigma:.1f} | {math.ceil(needed)}"
    return f"| {name} | {len(found)} | {cells} |"


def main() -> None:
    print("| drive | starts and stops | change of speed, rms [m/s] | scatter [m/s] | factor | 30 % lost [sigma] | needed for 3 |")
    print("|---|---|---|---|---|---|---|")
    for name in ("husky_a200", "vaultbot"):
        drive = fault_drives.without_lidar(name)
        sensors = *speeds(drive.events, drive.robot), *forces(drive.events, drive.mounts)
        print(row(f"{name}, simulated, a minute", *sensors), flush=True)
    robot = load_robot("husky_a200")
    log = open_log(DATA / "husky-outdoor-gps" / "test1.bag", robot)
    events = list(log.events())
    print(row("Husky outdoors", *speeds(events, robot), *forces(events, log.mounts)), flush=True)
    for folder in sorted(path for path in (DATA / "borealtc-husky").iterdir() if path.is_dir()):
        print(row(f"Husky, {folder.name.lower()}", *of_terrain(folder)), flush=True)


if __name__ == "__main__":
    main()
