"""Experiments by name: a world, a start, and the phases of a drive, of which two are steered by the true pose."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from localization.bounded_settings import Count, Positive, Seed, Settings, up_to
from localization.errors import SimulationError
from localization.simulation.world import WORLDS, World
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

Profile = Callable[[FloatArray], FloatArray]
"""Commands (n, 2), vx [m/s] and wz [rad/s], at times (n,) since the start of the phase [s]."""


@dataclass(frozen=True)
class Rest:
    """Stand still."""

    duration_s: float


@dataclass(frozen=True, eq=False)
class MoveArms:
    """Bring the arms to a named posture, or the nominal CG to a place, while standing."""

    target: str | FloatArray
    duration_s: float | None = None
    """None: as long as the joints take."""


@dataclass(frozen=True)
class PickUp:
    """Take a mass into the gripper; 0 puts it down."""

    mass_kg: float


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """Follow a profile open loop, as the thesis's drives did, and stop. This is a run: it is recorded under its name."""

    name: str
    profile: Profile
    duration_s: float
    controller: str = "diff_drive"
    """Motion model whose inverse makes wheel rates of the commands."""


@dataclass(frozen=True, eq=False)
class Route:
    """Drive along way points, steered by the true pose, as by a navigation stack or a person with a joystick."""

    points: FloatArray
    """(n, 2) [m]; from where the robot is to the first of them, and so on."""
    speed_m_s: float = 0.6
    name: str = ""


@dataclass(frozen=True)
class TurnTo:
    """Turn on the spot to a heading in the world [rad]."""

    heading: float


Phase = Rest | MoveArms | PickUp | OpenLoop | Route | TurnTo


def constant(vx: float, wz: float) -> Profile:
    """An arc, or a rotation in place."""
    return lambda t: np.column_stack([np.full(len(t), vx), np.full(len(t), wz)])


def sine(vx: float, wz: float, period_s: float) -> Profile:
    """An s-curve: vx, and wz sin(2 pi t / period)."""
    return lambda t: np.column_stack([np.full(len(t), vx), wz * np.sin(2.0 * math.pi * t / period_s)])


class Pursuit:
    """Pure pursuit (Coulter, 1992) of a polyline from the pose ``start`` (3,): steers to the point ``look_ahead_m`` ahead on it, and turns
    by at most ``turn_limit`` [rad/s]."""

    def __init__(self, start: FloatArray, route: Route, look_ahead_m: float = 0.8, turn_limit: float = 0.6) -> None:
        points = np.vstack([start[:2], route.points])
        keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6])
        self._points = np.ascontiguousarray(points[keep])
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(lengths)])
        self._speed, self._ahead, self._limit = route.speed_m_s, look_ahead_m, turn_limit
        self._done = 0.0

    @property
    def length(self) -> float:
        """Length of the route [m]."""
        return float(self._along[-1])

    def command(self, pose: FloatArray) -> FloatArray | None:
        """vx, wz from ``pose`` (3,); None at the end."""
        if len(self._points) < 2:
            return None
        self._done, vx, wz = _pursue(pose, self._points, self._along, self._done, self._speed, self._ahead, self._limit)
        return None if math.isnan(vx) else np.array([vx, wz])


@kernel
def _pursue(
    pose: FloatArray, points: FloatArray, along: FloatArray, done: float, speed: float, ahead: float, limit: float
) -> tuple[float, float, float]:
    """Distance driven along the route, and vx and wz; NaN at its end."""
    length = along[-1]
    reach, best, here = min(1.0, length - done), math.inf, done
    for i in range(21):  # the nearest point of the route's next metre
        x, y = _point_on_route(done + reach * i / 20.0, points, along)
        off = math.hypot(x - pose[0], y - pose[1])
        if off < best:
            best, here = off, done + reach * i / 20.0
    left = length - here
    c, s = math.cos(pose[2]), math.sin(pose[2])
    past = c * (points[-1, 0] - pose[0]) + s * (points[-1, 1] - pose[1]) < 0.02
    if left < 0.05 or (left < 0.4 and past):
        return here, math.nan, math.nan
    x, y = _point_on_route(here + ahead, points, along)
    gx, gy = c * (x - pose[0]) + s * (y - pose[1]), -s * (x - pose[0]) + c * (y - pose[1])
    bearing = math.atan2(gy, gx)
    if abs(bearing) > 1.0:  # turn first
        return here, 0.0, math.copysign(limit, bearing)
    vx = min(speed, 0.15 + 0.8 * left)
    wz = 2.0 * vx * math.sin(bearing) / max(math.hypot(gx, gy), 0.2)
    if abs(wz) > limit:
        vx, wz = vx * limit / abs(wz), math.copysign(limit, wz)
    return here, vx, wz


@subroutine
def _point_on_route(at: float, points: FloatArray, along: FloatArray) -> tuple[float, float]:
    """The point ``at`` [m] along the route; beyond its end it goes straight on."""
    k = 0
    while k < len(along) - 2 and along[k + 1] < at:
        k += 1
    f = (at - along[k]) / (along[k + 1] - along[k])
    return points[k, 0] + f * (points[k + 1, 0] - points[k, 0]), points[k, 1] + f * (points[k + 1, 1] - points[k, 1])


def turn_command(pose: FloatArray, heading: float, limit: float = 0.4) -> FloatArray | None:
    """vx, wz that turn the robot towards ``heading``; None where it is there."""
    error = float(se2.wrap_angle(heading - pose[2]))
    if abs(error) < 0.01:
        return None
    return np.array([0.0, max(-limit, min(limit, 1.5 * error + math.copysign(0.03, error)))])


@dataclass(frozen=True)
class ExperimentConfig(Settings):
    """How much of an experiment is driven."""

    laps: Count = 3
    """Laps of `laps`, `corridor` (to and fro), `slippery_patch`, `ramp`, `hills` and `payload_pickup` (before and after)."""
    hours: Positive = 10.0
    """Length of `soak` [h]."""
    hills_seed: Seed = 0
    """Seed of the ground of `hills`."""
    hills_slope_deg: Annotated[float, up_to(10)] = 6.0
    """Median slope of `hills` [deg]."""
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
    has_hills: bool = False
    """The ground has waves (`ExperimentConfig.hills_seed`)."""
    slope_deg: float = 0.0
    """By which the floor rises towards the world's +x [deg]."""

    def make_world(self) -> World:
        """The world by its name."""
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


def _ramp(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(3.0)
    for lap in range(config.laps):
        yield OpenLoop(f"turn_{lap + 1}", constant(0.0, 0.6), 20.0)
        yield OpenLoop(f"arc_{lap + 1}", constant(0.4, 0.4), 8.0)
        yield OpenLoop(f"turn_back_{lap + 1}", constant(0.0, -0.6), 20.0)
        yield Route(np.array([[3.0, 0.0]]), config.speed_m_s, name=f"up_{lap + 1}")
    yield Rest(3.0)


_HILLS = np.array([[8.0, 2.0], [10.0, 8.0], [2.0, 9.0], [-6.0, 5.0], [-8.0, -3.0], [-2.0, -9.0], [7.0, -7.0], [0.0, 0.0]])


def _hills(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(3.0)
    for lap in range(config.laps):
        yield Route(_HILLS[:4], config.speed_m_s, name=f"out_{lap + 1}")
        yield OpenLoop(f"turn_{lap + 1}", constant(0.0, 0.6), 10.0)
        yield Route(_HILLS[4:], config.speed_m_s, name=f"back_{lap + 1}")
        yield OpenLoop(f"turn_back_{lap + 1}", constant(0.0, -0.6), 10.0)
    yield Rest(3.0)


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
        "controller_evaluation",
        "6 trajectories x 7 arm configurations x 2 controllers (without arms: a ballast is moved, of which the log has nothing)",
        "hall",
        (0.0, 0.0, 0.0),
        _controller_evaluation,
    ),
    Experiment("laps", "laps through four rooms, the arms in another posture on each", "rooms", (0.0, -4.0, 0.0), _laps),
    Experiment("corridor", "a bare corridor of 60 m, there and back", "corridor", (0.0, 0.0, 0.0), _corridor),
    Experiment("slippery_patch", "laps over a wet patch, and turns on it", "slippery", (-3.0, -1.5, 0.0), _slippery_patch),
    Experiment("payload_pickup", "the same laps without and with a payload", "hall", (-3.0, -1.5, 0.0), _payload_pickup),
    Experiment(
        "ramp", "turns in place and arcs on a ramp of 8 degrees, which the IMU measures", "hall", (3.0, 0.0, 0.5), _ramp, slope_deg=8.0
    ),
    Experiment("hills", "laps and turns in place over hills with trees, for a 3D LiDAR", "hills", (0.0, 0.0, 0.0), _hills, has_hills=True),
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
