"""Experiments by name: a world, a start, and phases that come as they are needed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from localization.errors import SimulationError
from localization.settings import Count, Positive, Settings, up_to
from localization.simulation.drives import MoveArms, OpenLoop, Phase, PickUp, Profile, Rest, Route, TurnTo, constant, sine
from localization.simulation.world import WORLDS, World
from motion_models.robot import Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class ExperimentConfig(Settings):
    """How much of an experiment is driven."""

    laps: Count = 3
    """Laps of `laps`, `corridor` (to and fro), `slippery_patch` and `payload_pickup` (before and after)."""
    hours: Positive = 10.0
    """Length of `soak` [h]."""
    payload_kg: float = 8.0
    """What `payload_pickup` takes up [kg]."""
    speed_m_s: Annotated[float, up_to(2)] = 0.6
    """Speed along routes [m/s]."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """A drive in a world."""

    name: str
    meaning: str
    world: str
    start: tuple[float, float, float]
    """Pose of the body in the world."""
    phases: Callable[[Robot, ExperimentConfig], Iterator[Phase]]
    with_gps: bool = False

    def make_world(self) -> World:
        return WORLDS[self.world]()


TRAJECTORIES: Mapping[str, tuple[Profile, float]] = {
    "arc_1": (constant(0.5, 0.1), 6.0),
    "arc_2": (constant(0.5, -0.1), 6.0),
    "arc_3": (constant(0.5, 0.5), 3.0),
    "arc_4": (constant(-0.5, 0.1), 6.0),
    "rotate": (constant(0.0, 0.3), 5.0),
    "s_curve": (sine(0.4, 0.5, 9.0), 10.0),
}
"""Ebersole 2016, sec. 5.1: commands and duration [s]."""

PRELIMINARY: Mapping[str, tuple[Profile, float]] = {
    "arc": (constant(0.5, -0.2), 6.0),
    "s_curve": (sine(0.8, -0.6, 9.0), 9.0),
    "rotate": (constant(0.0, -0.5), 3.0),
}
"""Ebersole 2016, eqs. 1.9-1.11."""

CONTROLLERS = ("skid_steer", "diff_drive")

CONFIGURATION_CGS: Mapping[str, tuple[float, float]] = {
    "ready": (0.100, 0.0),
    "stow_back": (-0.011, 0.0),
    "ready_back": (-0.060, 0.0),
    "front_left": (0.068, 0.020),
    "front_right": (0.068, -0.020),
    "back_left": (-0.028, 0.020),
    "back_right": (-0.039, -0.020),
}
"""CG [m] of the seven arm configurations of Ebersole 2016, sec. 5.1, which shows them in a figure only.

x_G is inferred from one number of Table 5-2 each: how far the robot swung on `rotate` under diff-drive is a function of its centre of
rotation, and that, by the friction model fitted to the calibration grid, of x_G. Whether it lies ahead or behind, and on which side
y_G lies, is in the names; for its size the grid's middle is taken (`tests.studies.gentle_arcs`).
"""


def grid_points() -> FloatArray:
    """(68, 2) CGs of the calibration grid [m], row by row and to and fro, so that the arms never go far."""
    points = []
    for row, y in enumerate((-0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03)):
        xs = [round(-0.06 + 0.02 * i, 2) for i in range(10)]
        line = [(x, y) for x in xs if not (x > 0.11 and abs(y) > 0.025)]
        points += line if row % 2 == 0 else line[::-1]
    return np.array(points)


def _rotation_grid(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    for x, y in grid_points():
        yield MoveArms(np.array([x, y]))
        yield Rest(1.5)
        yield OpenLoop(f"{x:.2f},{y:.2f}", constant(0.0, 0.3), 5.0)
        yield Rest(1.5)


def _home(config: ExperimentConfig) -> Iterator[Phase]:
    """Back to the origin from where a drive has ended, whichever way the robot stands."""
    yield Route(np.array([[-0.9, 0.0], [0.0, 0.0]]), config.speed_m_s)
    yield TurnTo(0.0)
    yield Rest(1.0)


def _preliminary(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    for posture in ("stow_back", "stow_front") if robot.arms is not None else ("nominal",):
        if robot.arms is not None:
            yield MoveArms(posture)
        for name, (profile, duration) in PRELIMINARY.items():
            yield OpenLoop(f"{name},{posture},diff_drive", profile, duration)
            yield from _home(config)


def _controller_evaluation(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    for posture, cg in CONFIGURATION_CGS.items():
        yield MoveArms(np.array(cg))
        for name, (profile, duration) in TRAJECTORIES.items():
            for controller in CONTROLLERS:
                yield OpenLoop(f"{name},{posture},{controller}", profile, duration, controller)
                yield from _home(config)


_LOOP = np.array([[5.5, -4.0], [5.5, 4.0], [-5.5, 4.0], [-5.5, -4.0], [0.0, -4.0]])


def _postures(robot: Robot) -> Iterator[MoveArms]:
    """The configurations, over and over; on a robot without arms nothing moves."""
    for name in itertools.cycle(CONFIGURATION_CGS):
        if robot.arms is not None:
            yield MoveArms(np.array(CONFIGURATION_CGS[name]))


def _laps(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    postures = _postures(robot) if robot.arms is not None else None
    yield Rest(3.0)
    for lap in range(config.laps):
        if postures is not None:
            yield next(postures)
        yield Rest(1.0)
        yield Route(_LOOP, config.speed_m_s, name=f"lap_{lap + 1}")
    yield Rest(2.0)


def _corridor(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(3.0)
    for lap in range(config.laps):
        yield Route(np.array([[55.0, 0.0]]), config.speed_m_s, name=f"there_{lap + 1}")
        yield TurnTo(math.pi)
        yield Route(np.array([[0.0, 0.0]]), config.speed_m_s, name=f"back_{lap + 1}")
        yield TurnTo(0.0)
    yield Rest(2.0)


_SQUARE = np.array([[5.0, -1.5], [5.0, 1.5], [-3.0, 1.5], [-3.0, -1.5]])


def _slippery_patch(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(3.0)
    for lap in range(config.laps):
        yield Route(_SQUARE, config.speed_m_s, name=f"lap_{lap + 1}")
        yield Route(np.array([[2.5, 0.0]]), config.speed_m_s, name=f"to_patch_{lap + 1}")
        yield OpenLoop(f"on_patch_{lap + 1}", constant(0.0, 0.4), 8.0)
        yield Route(np.array([[-3.0, 0.0], [-3.0, -1.5]]), config.speed_m_s)
    yield Rest(2.0)


def _payload_pickup(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(3.0)
    for mass, when in ((0.0, "empty"), (config.payload_kg, "loaded")):
        yield PickUp(mass)
        yield Rest(1.0)
        for lap in range(config.laps):
            yield Route(_SQUARE, config.speed_m_s, name=f"{when}_{lap + 1}")
            yield OpenLoop(f"rotate_{when}_{lap + 1}", constant(0.0, 0.3), 8.0)
    yield Rest(2.0)


def _soak(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    """Never ends by itself: the simulation ends it after `ExperimentConfig.hours`."""
    postures = _postures(robot) if robot.arms is not None else None
    yield Rest(5.0)
    for lap in itertools.count(1):
        if postures is not None and lap % 3 == 1:
            yield next(postures)
        yield Rest(2.0)
        yield Route(_LOOP, config.speed_m_s, name=f"lap_{lap}")


_ALL = (
    Experiment("rotation_grid", "68 rotations in place over a grid of CGs (Ebersole 2016, 4.2)", "lab", (0.0, 0.0, 0.0), _rotation_grid),
    Experiment("preliminary", "arc, s-curve and rotation of Ebersole 2016, eqs. 1.9-1.11", "hall", (0.0, 0.0, 0.0), _preliminary),
    Experiment(
        "controller_evaluation", "6 trajectories x 7 arm configurations x 2 controllers", "hall", (0.0, 0.0, 0.0), _controller_evaluation
    ),
    Experiment("laps", "laps through four rooms, the arms in another posture on each", "rooms", (0.0, -4.0, 0.0), _laps),
    Experiment("corridor", "a bare corridor of 60 m, there and back", "corridor", (0.0, 0.0, 0.0), _corridor),
    Experiment("slippery_patch", "laps over a wet patch, and turns on it", "slippery", (-3.0, -1.5, 0.0), _slippery_patch),
    Experiment("payload_pickup", "the same laps without and with a payload", "hall", (-3.0, -1.5, 0.0), _payload_pickup),
    Experiment("soak", "laps for hours, with GPS", "rooms", (0.0, -4.0, 0.0), _soak, with_gps=True),
)
EXPERIMENTS: Mapping[str, Experiment] = {experiment.name: experiment for experiment in _ALL}
"""All experiments by name."""


def find_experiment(name: str) -> Experiment:
    """The experiment ``name``, also with hyphens. Raises `SimulationError`, which lists what there is."""
    found = EXPERIMENTS.get(name.replace("-", "_"))
    if found is None:
        known = "\n".join(f"  {e.name}: {e.meaning}" for e in _ALL)
        raise SimulationError(f"no experiment '{name}'; there are\n{known}")
    return found
