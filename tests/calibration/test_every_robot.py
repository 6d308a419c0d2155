"""Every shipped robot x model x free parameter x kind of drive: a shifted parameter is found, or the drive that finds it is named."""

from __future__ import annotations

import dataclasses
import re
import zlib

import numpy as np
import pytest

from motion_models import se2
from motion_models.base import MotionModel, prior_sigmas, scales
from motion_models.calibration.chords import chord_covariances, chord_poses
from motion_models.calibration.fit import FitConfig
from motion_models.calibration.identifiability import candidates
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.plan import Calibration, calibrate, free_of
from motion_models.online_calibration import CorrectedWheels
from motion_models.preintegration import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import Robot, WheelNoise
from motion_models.robot_file import load_robot
from motion_models.robot_names import robot_names
from motion_models.se2 import FloatArray
from tests.helpers.extended import cases

NOISE_M, NOISE_RAD = 0.003, 0.003
QUIET = WheelNoise(*(0.0,) * 8)
H, WINDOW = 0.05, 40  # s, intervals: windows of 2 s
KINDS = ("rotations", "windows", "moving", "gps", "heading")
ANTENNA = (0.6, 0.2)
"""Place of the antenna of positions alone in the body frame [m]."""
INTERVAL = 4.5
"""Half width of the interval in sigmas: of the matrix's about 2,000 numbers none lies outside by chance."""
NAMED = re.compile(r"drive about (\d+) s of ([^:]+?)(?:,| or|:|$)")


def minute(robot: Robot) -> list[tuple[FloatArray, FloatArray]]:
    """Wheel rates (40, 2) and CG (2,) of thirty windows: straight ahead and back, turning in place, arcs."""
    shapes = [(1, 0), (0, 1), (0.8, 0.5), (0, -1), (0.8, -0.5), (1.5, 0), (0.4, 1), (-1, 0), (0, -1.5), (0.5, 1)]
    return [(rates_of(robot, pace * v, pace * turn), robot.center_of_gravity) for pace in (1.0, 0.7, 1.3) for v, turn in shapes]


def rates_of(robot: Robot, v: float, turn: float) -> FloatArray:
    """(40, 2) wheel rates of a speed of ``v`` times 0.5 m/s, and of ``turn`` times 0.7 rad/s were there no slip [rad/s]."""
    g = robot.geometry
    return np.tile((0.5 * v + 0.35 * turn * g.track_width_m * np.array([-1.0, 1.0])) / g.wheel_radius_m, (WINDOW, 1))


def moving(robot: Robot) -> list[tuple[FloatArray, FloatArray]]:
    """The same minute with the CG at places all over a tenth of the wheelbase and a twentieth of the track."""
    g, rng = robot.geometry, np.random.default_rng(5)
    box = np.array([0.1 * g.wheelbase_m, 0.05 * g.track_width_m])
    return [(rates, cg + rng.uniform(-1.0, 1.0, 2) * box) for rates, cg in minute(robot)]


def rotations(robot: Robot) -> list[tuple[FloatArray, FloatArray]]:
    """Turning in place to one side at sixty places of the CG."""
    return [(rates_of(robot, 0.0, 1.0), cg) for _, cg in 2 * moving(robot)]


def joined(robot: Robot) -> list[tuple[FloatArray, FloatArray]]:
    """The minute, cut where every second window changes from one motion to the next: one arc's positions do not show its direction."""
    drive = minute(robot)
    found = []
    for i, (wheels, cg) in enumerate(drive):
        after = drive[(i + 1) % len(drive)][0]
        found.append((wheels if i % 2 else np.concatenate([wheels[: WINDOW // 2 - 7], after[WINDOW // 2 - 7 :]]), cg))
    return found


DRIVES = {"rotations": rotations, "windows": minute, "moving": moving, "gps": joined, "heading": minute}


def measure(model: MotionModel, params: FloatArray, wheels: FloatArray, cg: FloatArray, kind: str, rng: np.random.Generator) -> Maneuver:
    """One window as it is measured: pose, positions alone at start, middle and end, or heading alone."""
    n = len(wheels)
    dt, group = np.full(n, H), str(rng.integers(1 << 30))
    true = preintegrate(model, dt, wheels, cg, params, QUIET).delta
    if kind == "gps":
        half = preintegrate(model, dt[: n // 2], wheels[: n // 2], cg, params, QUIET).delta
        at = np.array([se2.compose(pose, np.array([*ANTENNA, 0.0]))[:2] for pose in (np.zeros(3), half, true)]) + NOISE_M * rng.normal(
            size=(3, 2)
        )
        first, both = (at[1] - at[0])[None], (at[2] - at[0])[None]
        cov = chord_covariances(first, both, np.tile(NOISE_M**2 * np.eye(2), (1, 3, 1, 1)))
        return Maneuver(dt, wheels, chord_poses(first, both), np.array([n]), cg, cov, group, middle=n // 2)
    measured = se2.compose(true, se2.exp(np.array([NOISE_M, NOISE_M, NOISE_RAD]) * rng.normal(size=3)))
    cov = np.diag([NOISE_M**2, NOISE_M**2, NOISE_RAD**2])
    if kind == "heading":
        measured, cov = np.array([0.0, 0.0, measured[2]]), np.diag([np.inf, np.inf, NOISE_RAD**2])
    return Maneuver(dt, wheels, measured[None], np.array([n]), cg, cov, group)


def with_radius(model: MotionModel, kind: str) -> MotionModel:
    """``model`` as `calibrate` fits it to logs: with the wheels' radius where it has none of its own."""
    straight = model.twist(np.ones(2), np.zeros(2), model.nominal).d_params[0]
    return model if straight.any() or kind == "rotations" else CorrectedWheels(model)


def fit_shifted(
    robot: Robot, model: MotionModel, name: str, kind: str, added: list[tuple[FloatArray, FloatArray]]
) -> tuple[Calibration, float]:
    """The calibration by a minute of ``kind`` and the windows ``added``, and the true value of the shifted parameter ``name``."""
    index, params = model.param_names.index(name), model.nominal.copy()
    sigma = prior_sigmas(model)[index]
    params[index] += min(0.4 * scales(model)[index], 2.0 * sigma if sigma else np.inf)
    for other, factor in _mirrored(model, name) if kind in ("heading", "rotations", "gps") else ():
        params[model.param_names.index(other)] = factor * params[index]  # of the sides these show the sum alone
    rng = np.random.default_rng(zlib.crc32(f"{robot.name} {model.name} {name} {kind}".encode()))
    measured = [measure(model, params, wheels, cg, kind, rng) for wheels, cg in (*DRIVES[kind](robot), *added)]
    # A chord about as short as its noise has no direction; logs are cut without such (`localization.calibration.position_reference`).
    maneuvers = [m for m in measured if not m.middle or m.cov[0, 2, 2] < 2.0 * 0.12**2]
    wanted = free_of(model, maneuvers, kind == "rotations")
    return calibrate(model, maneuvers, wanted, FitConfig(noise=QUIET, reference_at=ANTENNA if kind == "gps" else (0.0, 0.0))), float(
        params[index]
    )


def _mirrored(model: MotionModel, name: str) -> list[tuple[str, float]]:
    """The parameter of the other side and its factor; none for one without sides."""
    return [(p.mirror[0], p.mirror[1]) for p in model.params if p.name == name and p.mirror] + [
        (p.name, p.mirror[1]) for p in model.params if p.mirror and p.mirror[0] == name
    ]


def named_drive(robot: Robot, text: str) -> list[tuple[FloatArray, FloatArray]]:
    """Windows of 2 s of the maneuver that ``text`` names, for as long as it says; none where it names none."""
    found = NAMED.search(text)
    if found is None:
        return []
    g, speed = robot.geometry, 0.35 * robot.geometry.track_width_m if "turning" in found[2] else 0.5
    step = 0.1 * min(g.wheelbase_m, g.track_width_m)
    maneuver = dict(candidates(speed / g.wheel_radius_m, robot.center_of_gravity, WINDOW * H, cg_step_m=step))[found[2]]
    count = max(1, round(int(found[1]) / (WINDOW * H)))
    wheels = maneuver.wheels[np.arange(WINDOW) * 50 // WINDOW]
    return [(wheels, np.broadcast_to(maneuver.cg, (2,)))] * count


ALL = [(robot, model, kind) for robot in robot_names() for model in MODELS for kind in KINDS]
USUAL = [
    f"{robot}-{model}-{kind}"
    for robot, model, kind in ALL
    if (robot in ("warthog", "turtlebot3_burger") and model == "skid_steer") or (robot == "vaultbot" and kind in ("windows", "gps"))
]


@pytest.mark.parametrize(("robot_name", "model_name", "kind"), cases(ALL, USUAL, [f"{r}-{m}-{k}" for r, m, k in ALL]))
def test_calibrate_every_robot_finds_each_shift_or_names_the_drive(robot_name: str, model_name: str, kind: str) -> None:
    robot = load_robot(robot_name)
    model = with_radius(make_model(model_name, robot), kind)
    drive = [measure(model, model.nominal, wheels, cg, "windows", np.random.default_rng(0)) for wheels, cg in DRIVES[kind](robot)]
    if kind == "heading":
        drive = [dataclasses.replace(m, cov=np.diag([np.inf, np.inf, 1.0])) for m in drive]
    failures = []
    for name in free_of(model, drive, kind == "rotations"):
        found, true = fit_shifted(robot, model, name, kind, [])
        held = dict(found.held)
        why = next((held[n] for n in (name, *(other for other, _ in _mirrored(model, name))) if n in held), "")
        if why and (added := named_drive(robot, why)):
            found, true = fit_shifted(robot, model, name, kind, added)
        if "by headings alone: record a LiDAR or a reference with positions" in why:
            assert kind == "heading"
            continue
        if name not in found.fit.names and name not in found.fit.config.ties:
            failures.append(f"{name} is held: {why}")
            continue
        value, sigma = float(found.fit.params[model.param_names.index(name)]), found.fit.sigmas[name]
        if not abs(value - true) < INTERVAL * sigma + 1e-9:
            failures.append(f"{name} is {value:.4f} +- {sigma:.4f}, true {true:.4f}")
    assert not failures, "\n".join(failures)
