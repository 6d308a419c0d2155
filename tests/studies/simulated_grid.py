"""The thesis's calibration, simulated: 68 rotations in place become a log, the log goes through scan matching, arcs give centres of
rotation, and a regression gives k and CoR back as functions of the CG. The closed friction model says what they must be.

python -m tests.studies.simulated_grid

The simulator steps the dynamic model; the closed model solves the balance of forces without a notion of time. They share the law of
friction, and nothing else: masses, motors, sweeping beams, encoders, scan matching and the fit of circles lie between them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.events import CgSample, Scan, WheelSample
from localization.lidar import LidarConfig, ScanMatcher, Sweep, choose_cell
from localization.logs import open_log
from localization.simulation.experiments import grid_points
from localization.simulation.sensors import START_NS
from localization.simulation.simulator import RunRecord, simulate, write_simulation
from localization.simulation.vehicle import TWIST, Body, VehicleConfig, VehicleState, advance
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.calibration.regressions import LinearRegression, center_from_end_poses, regress
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

_REST_S = 1.2
_DRAWN_AT_REST = 6  # scans that begin the map, before the robot turns
_MAPPED_RAD = 0.3  # turn after which the next scan enters the map
_PRIOR_COV = 1e-3 * np.eye(3)  # of the motion from scan to scan, by that of the last [m^2, m^2, rad^2]
_SETTLING = 5  # scans after the start, and before the end, that are left out: the vehicle's rates follow the wheels' by and by


@dataclass(frozen=True)
class Rotation:
    """What the log tells of one rotation in place, and what the closed model says of it."""

    cg: FloatArray
    """(2,) as the arms' joints tell [m]."""
    k: float
    k_sigma: float
    cor: FloatArray
    """(2,) [m]"""
    cor_cov: FloatArray
    """(2, 2) [m^2]"""
    model: FloatArray
    """(3,) k, x_CR, y_CR of the closed model, which knows no inertia."""
    settled: FloatArray
    """(3,) the same of the simulated vehicle at constant wheel rates: what the CG's centripetal force changes is in it."""


@dataclass(frozen=True)
class _Window:
    """Events of one run."""

    wheels: list[WheelSample]
    scans: list[Scan]
    cgs: list[FloatArray]


def rotations(folder: Path, seed: int = 0) -> list[Rotation]:
    """Simulate the grid into ``folder``, read the log, and measure every rotation."""
    robot = load_robot("vaultbot")
    simulation = simulate("rotation_grid", robot, seed)
    path = folder / "grid.mcap"
    write_simulation(path, simulation)
    log = open_log(path, robot)
    mount = log.mounts["laser"]
    windows = [_Window([], [], []) for _ in simulation.runs]
    starts = np.array([START_NS + round((run.start_s - _REST_S) * 1e9) for run in simulation.runs])
    ends = np.array([START_NS + round((run.start_s + float(run.times_s[-1])) * 1e9) for run in simulation.runs])
    for event in log.events():
        i = int(np.searchsorted(starts, event.stamp_ns, side="right")) - 1
        if i < 0 or event.stamp_ns > ends[i]:
            continue
        if isinstance(event, WheelSample):
            windows[i].wheels.append(event)
        elif isinstance(event, Scan):
            windows[i].scans.append(event)
        elif isinstance(event, CgSample):
            windows[i].cgs.append(event.position)
    return [_measure(run, window, mount) for run, window in zip(simulation.runs, windows, strict=True)]


def _measure(run: RunRecord, window: _Window, mount: Mount) -> Rotation:
    robot = load_robot("vaultbot")
    begin = START_NS + round(run.start_s * 1e9)
    stamps, track, cov = _track(window.scans, mount, begin)

    yaw = np.unwrap(track[:, 2])
    turns = np.abs(np.diff(yaw, prepend=yaw[0]))
    moving = np.flatnonzero(turns > 0.85 * np.median(turns[turns > 0.5 * turns.max()]))  # while starting and stopping it turns elsewhere
    first, last = moving[0] + _SETTLING, moving[-1] - _SETTLING

    # k: turned angle over what the wheels turned
    wheels = np.array([w.position for w in window.wheels])
    times = np.array([w.stamp_ns for w in window.wheels])
    difference = np.interp([stamps[first], stamps[last]], times, wheels[:, 1] - wheels[:, 0])
    g = robot.geometry
    unit = g.wheel_radius_m * float(difference[1] - difference[0]) / g.track_width_m
    k, sigma = float(yaw[last] - yaw[first]) / unit, float(np.sqrt(cov[first, 2, 2] + cov[last, 2, 2])) / unit

    # The errors of neighbouring scans are alike, as they share the map: only the arc's ends count as independent (4.4, 4.5).
    centre = center_from_end_poses(track[first], track[last], cov[first], cov[last])
    cg = np.mean(window.cgs, axis=0)
    model = make_model("friction", robot)
    rates = make_model("diff_drive", robot).wheels(np.array([0.0, 0.3]), cg, make_model("diff_drive", robot).nominal)
    per_wheels = g.wheel_radius_m * (rates[1] - rates[0]) / g.track_width_m
    predicted = _centre(model.twist(rates, cg, model.nominal).value, per_wheels)
    settled = _centre(_settled(rates, cg), per_wheels)
    return Rotation(cg, k, sigma, centre.value, centre.cov, predicted, settled)


def _track(scans: Sequence[Scan], mount: Mount, begin_ns: int) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps (n,) from ``begin_ns`` on, poses (n, 3) and their covariances (n, 3, 3), by scan matching alone: each match starts from the
    motion of the last."""
    config = LidarConfig()
    matcher, pose, mapped, twist = None, np.zeros(3), 0.0, np.zeros(3)
    last_ns = scans[0].middle_ns
    drawn = np.zeros((3, 3))  # covariance of the map: what is drawn farther on has the errors of all scans from which it was drawn
    found = []
    for number, scan in enumerate(scans):
        sweep, gap = Sweep.from_scan(scan, mount), (scan.middle_ns - last_ns) * 1e-9
        points = sweep.project(sweep.deskew(twist))
        matcher = matcher or ScanMatcher(config, choose_cell(config, points))
        prior, match = se2.compose(pose, se2.exp(gap * twist)), None
        if number > 0:
            match = matcher.match(points, prior, _PRIOR_COV)
            assert match is not None, f"scan {number} fits nowhere"
            twist = se2.log(se2.between(pose, match.measured)) / gap if number >= _DRAWN_AT_REST else np.zeros(3)
            points = sweep.project(sweep.deskew(twist))
            match = matcher.refine(points, prior, _PRIOR_COV, match)
            assert match is not None, f"scan {number} fits nowhere"
            pose = match.measured
            if scan.stamp_ns >= begin_ns:
                found.append((scan.middle_ns, pose, match.cov + drawn))
        if number < _DRAWN_AT_REST or abs(pose[2] - mapped) > _MAPPED_RAD:
            matcher.insert_key_scan(pose, points)
            mapped = pose[2]
            if match is not None and number >= _DRAWN_AT_REST:
                drawn = drawn + match.cov
        last_ns = scan.middle_ns
    stamps, poses, covs = zip(*found, strict=True)
    return np.array(stamps), np.array(poses), np.array(covs)


def _centre(twist: FloatArray, per_wheels: float) -> FloatArray:
    vx, vy, wz = twist
    return np.array([wz / per_wheels, -vy / wz, vx / wz])


def _settled(rates: FloatArray, cg: FloatArray) -> FloatArray:
    """Twist (3,) of the simulated vehicle after three seconds at constant wheel rates."""
    at = np.zeros((600, 7))
    at[:, :2] = cg
    state, body = VehicleState.at(np.zeros(3)), Body.from_robot(load_robot("vaultbot"))
    rows = advance(state, body, VehicleConfig(), np.tile(rates, (600, 1)), at, (0.0, 0.0), np.zeros((0, 5)))
    return np.asarray(rows[-1, TWIST])


TERMS = {
    "k": ("1", "x", "x^2"),
    "x_CR": ("1", "x"),
    "y_CR": ("y", "x y", "x^2 y"),
}
"""4.21, 4.22, 4.25."""


def fits(found: Sequence[Rotation]) -> dict[str, tuple[LinearRegression, LinearRegression]]:
    """Regressions 4.21, 4.22 and 4.25 of what was measured, and of what the closed model says at the same CGs."""
    cg = np.array([r.cg for r in found])
    x, y = cg.T
    columns = {"1": np.ones_like(x), "x": x, "x^2": x**2, "y": y, "x y": x * y, "x^2 y": x**2 * y}
    measured = np.array([[r.k, *r.cor] for r in found])
    model = np.array([r.model for r in found])
    return {
        name: (regress(measured[:, i], {t: columns[t] for t in terms}), regress(model[:, i], {t: columns[t] for t in terms}))
        for i, (name, terms) in enumerate(TERMS.items())
    }


def sigmas(found: Sequence[Rotation]) -> FloatArray:
    """(n, 3) stated standard deviations of k, x_CR, y_CR."""
    return np.array([[r.k_sigma, *np.sqrt(np.diagonal(r.cor_cov))] for r in found])


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        found = rotations(Path(folder))
    assert len(found) == len(grid_points())
    measured, sigma = np.array([[r.k, *r.cor] for r in found]), sigmas(found)
    for title, predicted in (("the closed model", [r.model for r in found]), ("the vehicle at constant rates", [r.settled for r in found])):
        off = measured - np.array(predicted)
        print(f"measured against {title}\n{'':6} {'bias':>9} {'scatter':>9} {'stated sigma':>13} {'rms of z':>9} {'range':>9}")
        for i, name in enumerate(TERMS):
            z = off[:, i] / sigma[:, i]
            numbers = off[:, i].mean(), off[:, i].std(), sigma[:, i].mean(), np.sqrt(np.mean(z**2)), np.ptp(np.array(predicted)[:, i])
            print(f"{name:6} {numbers[0]:9.5f} {numbers[1]:9.5f} {numbers[2]:13.5f} {numbers[3]:9.2f} {numbers[4]:9.3f}")
    for name, (seen, predicted) in fits(found).items():
        for term, a, s, b in zip(seen.names, seen.coefficients, np.sqrt(np.diagonal(seen.cov)), predicted.coefficients, strict=True):
            print(f"{name:5} {term:6} measured {a:9.4f} +- {s:.4f}   closed model {b:9.4f}   {(a - b) / s:+.1f} sigma")


if __name__ == "__main__":
    main()
