"""A simulator whose engine is the friction model: searches through all its numbers take a second or two, so that many can be drawn."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from localization.twin.engine import Played, Touch
from localization.twin.parameters import hypotheses_of
from localization.twin.simulator import Numbers
from localization.twin.twin import examine
from localization.twin.windows import LEAD_S, Window
from localization.twin.xml_file import XmlFile, parse
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers.twin_drives import drive

SEARCHED = frozenset(
    {"slip_stiffness", "mu_ratio", "servo_gain", "cg_x_m", "cg_y_m", "radius_scale", "radius_difference", "track_scale", "wheelbase_scale"}
)
"""Numbers that move this robot."""
DRAWN = ("husky_a200", "jackal", "warthog")
HOPPING = (0.003, 0.003, 0.012)
"""Scatter of a window's motion by any change of a Husky's numbers in MuJoCo [m, m, rad]."""


@dataclass(frozen=True)
class QuasiStaticSimulator:
    """`localization.twin.simulator.Simulator` by the friction model. Wheels reach the share 1 - exp(-g / 10) of their set points, with g
    the servos' gain."""

    robot: Robot
    numbers: Numbers
    chaos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Scatter of each window's motion from any numbers to any others [m, m, rad], as of an engine in which wheels hop."""
    engine_name = "friction model"
    law_name = "contact law"
    notes: tuple[str, ...] = ()

    @property
    def file(self) -> XmlFile:
        """A file that has all numbers."""
        return self.with_numbers(self.numbers)

    @property
    def engine(self) -> QuasiStaticEngine:
        """Plays it."""
        return self.compiled(self.numbers)

    @property
    def law_files(self) -> Mapping[str, str]:
        """None: its friction is in proportion to slip."""
        return {}

    @property
    def absent(self) -> frozenset[str]:
        """All numbers that move nothing here."""
        return frozenset(f.name for f in fields(Numbers)) - SEARCHED

    def with_numbers(self, numbers: Numbers) -> XmlFile:
        """A file of attributes."""
        attributes = " ".join(f'{f.name}="{getattr(numbers, f.name)!r}"' for f in fields(Numbers))
        return parse({"robot.xml": f"<mujoco><numbers {attributes}/></mujoco>".encode()}, Path("robot.xml"), "mujoco")

    def compiled(self, numbers: Numbers) -> QuasiStaticEngine:
        """With these numbers."""
        return QuasiStaticEngine(self.robot, numbers, self.chaos)

    def with_law(self, mu: float, stiffness: float) -> Numbers:
        """The file has this law."""
        return replace(self.numbers, mu=mu, slip_stiffness=stiffness)


@dataclass(frozen=True)
class QuasiStaticEngine:
    """`localization.twin.engine.Engine` by the friction model."""

    robot: Robot
    numbers: Numbers
    chaos: tuple[float, float, float]

    @cached_property
    def params(self) -> FloatArray:
        """(13,) the friction model's."""
        n, model = self.numbers, make_model("friction", self.robot)
        changed = {
            "wheel_radius": n.radius_m * n.radius_scale,
            "track_width": n.track_m * n.track_scale,
            "wheelbase": n.wheelbase_m * n.wheelbase_scale,
            "mu_ratio": n.mu_ratio,
            "slip_stiffness": n.slip_stiffness,
        }
        return np.array([changed.get(name, value) for name, value in zip(model.param_names, model.nominal, strict=True)])

    def play(self, windows: Sequence[Window]) -> Played:
        """See `localization.twin.engine.Engine.play`."""
        n, model = self.numbers, make_model("friction", self.robot)
        grown = 1.0 + 0.5 * n.radius_difference * np.array([1.0, -1.0])
        rates = [w.set_points * -math.expm1(-0.1 * n.servo_gain) for w in windows]
        cgs = [np.tile(w.cg - self.robot.center_of_gravity + [n.cg_x_m, n.cg_y_m], (len(w.dt), 1)) for w in windows]
        twists = model.twist(np.concatenate(rates) * grown, np.concatenate(cgs), self.params).value
        poses, means, at = np.zeros((len(windows), 3)), np.zeros((len(windows), 2)), 0
        for i, w in enumerate(windows):
            inside = np.clip(np.cumsum(w.dt) - LEAD_S, 0.0, w.dt)
            for step in twists[at : at + len(w.dt)] * inside[:, None]:
                poses[i] = se2.compose(poses[i], se2.exp(step))
            means[i] = inside @ rates[i] / inside.sum()
            at += len(w.dt)
        rng = np.random.default_rng(zlib.crc32(repr(n).encode()))
        poses = se2.compose(poses, rng.normal(0.0, 1.0, poses.shape) * self.chaos)
        return Played(poses, means, Touch(np.zeros(len(windows)), np.array([0.0, 0.0, 0.0, 0.0, 1.0]), math.nan), at)


def spoiled_quasi_static(true: QuasiStaticSimulator, **numbers: float) -> QuasiStaticSimulator:
    """The file of ``true`` with other ``numbers``, as it is read: sizes of the robot are the file's own."""
    n = replace(true.numbers, **numbers)
    sizes = {
        "radius_m": n.radius_m * n.radius_scale,
        "track_m": n.track_m * n.track_scale,
        "wheelbase_m": n.wheelbase_m * n.wheelbase_scale,
    }
    return replace(true, numbers=replace(n, **sizes, radius_scale=1.0, track_scale=1.0, wheelbase_scale=1.0))


def true_quasi_static(robot: Robot) -> QuasiStaticSimulator:
    """The robot as its file describes it, on servos that reach their set points."""
    g = robot.geometry
    numbers = Numbers(
        mu=0.7,
        time_step_s=0.1,
        servo_gain=100.0,
        mass_kg=g.mass_kg,
        cg_x_m=g.cg_x_m,
        cg_y_m=g.cg_y_m,
        cg_z_m=g.cg_height_m,
        radius_m=g.wheel_radius_m,
        track_m=g.track_width_m,
        wheelbase_m=g.wheelbase_m,
        slip_stiffness=10.0,
    )
    return QuasiStaticSimulator(robot, numbers)


def drawn_numbers(true: QuasiStaticSimulator, rng: np.random.Generator, count: int, names: Sequence[str] = ()) -> dict[str, float]:
    """Values of ``count`` numbers (of ``names``, where given) that are wrong by two to four sigmas of their priors; servos are too
    weak, as stiffer ones do not show."""
    found = {}
    parameters = [p for p in hypotheses_of(true, true.robot).parameters if p.area != "reference" and (not names or p.field in names)]
    for i in rng.choice(len(parameters), count, replace=False):
        p = parameters[i]
        off = rng.uniform(2.0, 4.0) * (-1.0 if p.field == "servo_gain" else rng.choice([-1.0, 1.0]))
        old = float(getattr(true.numbers, p.field))
        found[p.field] = float(old * math.exp(off * p.sigma) if p.is_log else old + off * p.sigma)
    return found


def named_of_draw(number: int, chaos: tuple[float, float, float]) -> tuple[dict[str, float], list[set[str]]]:
    """Values of none, one or two wrong numbers of a drawn file, and the fields that each finding has, with its rivals."""
    true = replace(true_quasi_static(load_robot(DRAWN[number % len(DRAWN)])), chaos=chaos)
    numbers = drawn_numbers(true, np.random.default_rng(number), number // len(DRAWN) % 3)
    findings = examine(drive(true, true.robot, number, 96), true.robot, spoiled_quasi_static(true, **numbers)).findings
    return numbers, [{f.best.field, *(rival.field for rival in f.rivals)} for f in findings]
