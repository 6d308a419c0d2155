"""The simulation: phases drive the vehicle, sensors read its track, messages come out in order of time."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from localization.errors import SimulationError
from localization.logs.message_templates import Message, text
from localization.logs.writer import write_bag
from localization.simulation.experiments import (
    Experiment,
    ExperimentConfig,
    MoveArms,
    OpenLoop,
    Phase,
    PickUp,
    Pursuit,
    Rest,
    Route,
    find_experiment,
    turn_command,
)
from localization.simulation.injected_faults import TrueRobot, apply_faults
from localization.simulation.sensors import START_NS, SensorConfig, make_sensors, nominal_mounts, transforms
from localization.simulation.terrain import make_waves
from localization.simulation.vehicle import CG, COLUMNS, POSE, Body, MassDistribution, TrueMotion, VehicleConfig, VehicleState, advance
from localization.simulation.world import clearance
from motion_models.center_of_gravity.parts import require_support
from motion_models.errors import CgError
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

MARKS_TOPIC = "/experiment"
"""std_msgs/String: JSON with the named part of the drive that begins or ends."""
_CONTROL_S = 0.02
_STEERING_PERIOD_S = 0.1
_FLUSH_S = 2.0
_KEEP_S = 1.0
_SETTLE_S = 1.0


RUN_HZ = 20.0


@dataclass(frozen=True, eq=False)
class RunRecord:
    """True motion of one named phase, 20 times a second from the body's rest before it to its rest after it."""

    name: str
    start_s: float
    """[s] since the simulation's beginning."""
    poses: FloatArray
    """(n, 3) of the body in the world."""
    wheel_angles: FloatArray
    """(n, 2) left and right, exact [rad]."""
    cg: FloatArray
    """(n, 2) true CG [m]."""
    nominal_cg: FloatArray
    """(2,) as the robot has it [m]."""
    command: OpenLoop | Route

    @property
    def times_s(self) -> FloatArray:
        """(n,) since the start of the run."""
        return np.asarray(np.arange(len(self.poses)) / RUN_HZ)


@dataclass(frozen=True)
class SimulationConfig:
    """Everything that can be set about a simulation."""

    experiment: ExperimentConfig = field(default_factory=ExperimentConfig)
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)


class Simulation:
    """One experiment with one robot; `messages` drives it, once."""

    def __init__(
        self, experiment: Experiment, robot: Robot, seed: int, effects: Mapping[str, float], config: SimulationConfig | None = None
    ) -> None:
        self.config = config or SimulationConfig()
        if seed < 0:
            raise SimulationError(f"seed is {seed}; it must be 0 or more.")
        self.experiment, self.robot = experiment, robot
        self._steps_per_control = round(_CONTROL_S / self.config.vehicle.step_s)
        if abs(self._steps_per_control * self.config.vehicle.step_s - _CONTROL_S) > 1e-9:
            raise SimulationError(f"vehicle.step_s is {self.config.vehicle.step_s:g} s; it must divide the control period, {_CONTROL_S} s.")
        self.world = experiment.make_world()
        if experiment.has_hills:
            self.world = replace(self.world, waves=make_waves(self.config.experiment.hills_seed, self.config.experiment.hills_slope_deg))
        self._marks: list[Message] = []
        self.runs: list[RunRecord] = []
        """Named phases that are over."""
        self.lidar_mount = nominal_mounts(robot)[self.config.sensors.lidar_frame]
        """The LiDAR's mount in the log's /tf_static."""
        body = replace(Body.from_robot(robot), slope=math.radians(experiment.slope_deg), waves=self.world.waves)
        self.reality = apply_faults(TrueRobot(body, self.lidar_mount), effects)
        self._body = self.reality.body
        self._masses = MassDistribution(robot)
        self._masses.pick_up(self.reality.payload_kg)
        self._state = VehicleState.at(np.array(experiment.start))
        first = np.zeros(COLUMNS)
        first[POSE], first[-1] = experiment.start, 1.0
        first[CG] = self._masses.cg(np.zeros(1))[0, :2] + np.array(self._body.cg_offset)
        self._check_support(first[CG])
        self._track = TrueMotion(first, self.config.vehicle.step_s)
        self._sensors = make_sensors(
            self.config.sensors, robot, self._masses, self.reality, self.world, np.random.SeedSequence(seed), experiment.with_gps
        )
        self._controllers = {name: make_model(name, robot) for name in ("diff_drive", "skid_steer")}
        self._half_width = 0.5 * robot.geometry.track_width_m + 0.06
        self._half_length = 0.5 * robot.geometry.wheelbase_m

    @property
    def time_s(self) -> float:
        """Simulated so far [s]."""
        return self._state.steps * self.config.vehicle.step_s

    def messages(self) -> Iterator[Message]:
        """All messages, in order of their time of recording. Raises `SimulationError` where the drive cannot go on."""
        yield transforms(self.config.sensors, self.robot)
        phases = list(self._phases()) if self.experiment.name != "soak" else self._phases()
        half = len(phases) // 2 if isinstance(phases, list) else -1
        flushed = 0.0
        for number, phase in enumerate(phases):
            if number == half or (half < 0 and self.time_s > 0.5 * self._limit_s):
                self._change_friction()
            if self.reality.wheel_radius_drift and isinstance(phases, list):
                self._body = self._body.with_radii(
                    self.reality.body, 1.0 + self.reality.wheel_radius_drift * number / max(len(phases) - 1, 1)
                )
            for _ in self._drive(phase):
                if self.time_s > flushed + _FLUSH_S:
                    flushed = self.time_s
                    yield from self._flush()
            yield from self._flush()
            if self.time_s >= self._limit_s:
                return

    @property
    def _limit_s(self) -> float:
        return 3600.0 * self.config.experiment.hours if self.experiment.name == "soak" else np.inf

    def _phases(self) -> Iterator[Phase]:
        return self.experiment.phases(self.robot, self.config.experiment)

    def _change_friction(self) -> None:
        """The second half of the drive begins."""
        if self.reality.friction_change_factor != 1.0 and self._body.params is self.reality.body.params:
            self._body = self._body.with_param("mu_ratio", self._body.param("mu_ratio") * self.reality.friction_change_factor)

    def _drive(self, phase: Phase) -> Iterator[None]:
        """Drive one phase, yielding from time to time so that messages can be written."""
        if isinstance(phase, Rest):
            yield from self._drive_open_loop(np.zeros((self._control_steps(phase.duration_s), 2)), "diff_drive")
        elif isinstance(phase, MoveArms):
            target = self._masses.posture(phase.target) if isinstance(phase.target, str) else self.reach(phase.target)
            duration = phase.duration_s or self._masses.time_to(target)
            self._masses.move(target, self.time_s, duration)
            yield from self._drive_open_loop(np.zeros((self._control_steps(duration), 2)), "diff_drive")
            self._check_support(self._track.rows[-1, CG])
        elif isinstance(phase, PickUp):
            self._masses.pick_up(phase.mass_kg + self.reality.payload_kg)
            self._check_support(self._masses.cg(np.array([self.time_s]))[0, :2] + np.array(self._body.cg_offset))
        elif isinstance(phase, OpenLoop):
            n = self._control_steps(phase.duration_s)
            commands = np.vstack(
                [phase.profile(np.asarray(_CONTROL_S * np.arange(n), dtype=np.float64)), np.zeros((self._control_steps(_SETTLE_S), 2))]
            )
            yield from self._recorded(phase, self._drive_open_loop(commands, phase.controller))
        elif isinstance(phase, Route):
            yield from self._recorded(phase, self._drive_closed_loop(Pursuit(self._state.pose, phase).command, self._route_limit(phase)))
        else:
            heading = phase.heading
            yield from self._drive_closed_loop(lambda pose: turn_command(pose, heading), 60.0)

    def _recorded(self, phase: OpenLoop | Route, drive: Iterator[None]) -> Iterator[None]:
        """Keep what happens in a phase that has a name."""
        start_s, cg = self.time_s, self._masses.nominal_cg(np.array([self.time_s]))[0]
        self._mark(phase.name, "begins")
        kept: list[FloatArray] = []
        taken = 0
        every = 1.0 / RUN_HZ

        def take() -> None:
            nonlocal taken
            last = int((self.time_s - start_s) / every + 1e-6)
            kept.append(self._track.at(np.asarray(start_s + every * np.arange(taken, last + 1), dtype=np.float64)))
            taken = last + 1

        for _ in drive:
            take()
            yield
        take()
        if phase.name:
            self._mark(phase.name, "ends")
            rows = np.concatenate(kept)
            self.runs.append(RunRecord(phase.name, start_s, rows[:, POSE], rows[:, 8:10], rows[:, CG], cg, phase))

    def _drive_open_loop(self, commands: FloatArray, controller: str) -> Iterator[None]:
        """Commands (n, 2), one for each control period."""
        chunk = max(1, round(1.0 / _CONTROL_S))
        for first in range(0, len(commands), chunk):
            self._advance(commands[first : first + chunk], controller)
            yield

    def _drive_closed_loop(self, steer: Callable[[FloatArray], FloatArray | None], limit_s: float) -> Iterator[None]:
        """Commands that depend on the true pose, ten times a second; then stop."""
        until = self.time_s + limit_s
        periods = round(_STEERING_PERIOD_S / _CONTROL_S)
        while (command := steer(self._state.pose)) is not None:
            if self.time_s > until:
                x, y, _ = self._state.pose
                raise SimulationError(
                    f"the robot does not reach its way point: after {limit_s:.0f} s it is at x = {x:.2f}, y = {y:.2f} m, "
                    f"{self.time_s:.1f} s into the drive. Its wheels may slip too much; make the effects smaller."
                )
            self._advance(command[None], "diff_drive", periods)
            yield
        yield from self._drive_open_loop(np.zeros((self._control_steps(0.6), 2)), "diff_drive")

    def _route_limit(self, route: Route) -> float:
        return 30.0 + 4.0 * Pursuit(self._state.pose, route).length / route.speed_m_s

    def _advance(self, commands: FloatArray, controller: str, periods: int = 1) -> None:
        """Drive on by so many control ``periods`` for each of ``commands`` (n, 2)."""
        config = self.config.vehicle
        steps = self._steps_per_control * periods
        times = self.time_s + np.linspace(0.0, config.step_s * (len(commands) * steps - 1), len(commands) * steps)
        model = self._controllers[controller]
        nominal = self._masses.nominal_cg(times[:1])[0]
        rows = self._move(times, model.wheels(commands, nominal, model.nominal).repeat(steps, axis=0))
        self._track.append(rows)
        self._check_walls(rows[-1, POSE])

    def _move(self, times: FloatArray, wheels: FloatArray) -> FloatArray:
        """Records (n, 13) of the vehicle at the ends of steps that begin at ``times`` (n,), with commanded rates ``wheels`` (n, 2)."""
        config = self.config.vehicle
        payload = self._masses.payload_kg, self._masses.payload_distance(float(times[0]))
        return advance(self._state, self._body, config, wheels, self._masses.cg(times, config.step_s), payload, self.world.patches)

    @staticmethod
    def _control_steps(duration_s: float) -> int:
        return max(1, round(duration_s / _CONTROL_S))

    def reach(self, cg: FloatArray) -> FloatArray:
        """Positions of the arms or loads that put the nominal CG at ``cg`` (2,) [m]. Raises `SimulationError` where none do."""
        try:
            return self._masses.reach(cg)
        except CgError as error:
            raise SimulationError(
                f"experiment {self.experiment.name} needs a CG that robot '{self.robot.name}' cannot have: {error}"
            ) from error

    def _check_support(self, cg: FloatArray) -> None:
        try:
            require_support(cg, self._body.param("wheelbase"), self._body.param("track_width"))
        except CgError as error:
            raise SimulationError(f"{self.time_s:.1f} s into the drive: {error}") from error

    def _check_walls(self, pose: FloatArray) -> None:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for ahead in (-self._half_length, 0.0, self._half_length):
            x, y = pose[0] + ahead * c, pose[1] + ahead * s
            if clearance(x, y, self.world.walls) < self._half_width:
                raise SimulationError(
                    f"the robot hits a wall of '{self.experiment.world}' at x = {x:.2f}, y = {y:.2f} m, {self.time_s:.1f} s into "
                    f"{self.experiment.name}. Drive more slowly, or make the effects smaller."
                )

    def _mark(self, name: str, what: str) -> None:
        """Note in the log that a run begins or ends."""
        if name:
            data = np.frombuffer(json.dumps({"run": name, "what": what}).encode(), dtype=np.uint8)
            now = START_NS + round(self.time_s * 1e9)
            self._marks.append(Message(text(MARKS_TOPIC, len(data)), now, now, (data,)))

    def _flush(self) -> list[Message]:
        """The messages that are ready, in order."""
        marks, self._marks = self._marks, []
        ready = marks + [message for sensor in self._sensors for message in sensor.messages(self._track)]
        ready.sort(key=lambda message: message.log_ns)
        self._track.drop_before(self._track.end_s - _KEEP_S)
        return ready


def simulate(
    experiment: str, robot: Robot, seed: int = 0, effects: Mapping[str, float] | None = None, config: SimulationConfig | None = None
) -> Simulation:
    """An experiment by name, ready to be driven. Raises `SimulationError` for names that do not exist and robots that cannot stand."""
    return Simulation(find_experiment(experiment), robot, seed, effects or {}, config)


def write_simulation(path: str | Path, simulation: Simulation, on_message: Callable[[int], None] | None = None) -> int:
    """Drive ``simulation`` and write its messages to ``path`` as they come (see `write_bag`); their number."""
    return write_bag(path, simulation.messages(), on_message)
