"""A second vehicle for blind tests: four wheels in MuJoCo, whose rigid bodies and contacts share nothing with our friction model.

World, sensors and the drive are those of `skidloc simulate --engine mujoco`. The file is of its own: a chassis on a free joint, four
wheels in hinges with velocity servos, and elliptic friction cones at their soft contacts with a plane.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from localization.errors import SimulationError
from localization.simulation.experiments import Experiment
from localization.simulation.injected_faults import TrueRobot, apply_faults
from localization.simulation.simulator import SimulationConfig
from localization.simulation.vehicle import CG, Body
from localization.twin import simulated_drive as twin
from localization.twin.mujoco_engine import MujocoDrive, MujocoEngine
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.xml_file import parse
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_STEP_S = 0.00125
WHEEL_MASS_SHARE = 0.02
ARMATURE = 30.0
"""Inertia of a motor behind its gears, over the wheel's mass times its radius squared."""
SERVO_GAIN = 2.0
"""Torque of a wheel's servo per rad/s of error, over m g r: 3 ms of lag on a Jackal, which an explicit integrator resolves.

Stiffer servos take an integrator that is implicit in their damping. Contacts do not see that part of the wheels' acceleration, and robots
lead their wheels.
"""
FRICTION_TIME_S = 0.12
"""MuJoCo's time constant of friction: full from 0.03 m/s of slip on, in proportion to it."""
CONTACT = f'solref="0.01 1" solimp="0.05 0.05 0.001" solreffriction="{FRICTION_TIME_S} 1"'
"""Soft contacts whose friction stops a slip within 3 ms."""
CONE = 'cone="elliptic" impratio="200"'
"""MuJoCo's cones couple slip to the normal force: a wheel is lifted off where its slip is 1 + impratio / mu^2 times that from which on
friction is full. At the default impratio of 1 wheels hopped in all but slow turns (their loads scattered by 10 to 100 %), and slow turns
crept; heights of the centre of gravity came out 20 to 24 % too small (`tests.studies.weigh_slopes`)."""
FLATTENING = 0.0034
"""How much smaller the rolling radius is than the geometry's, by the contacts' depth: measured, the same for all robots to 0.0001."""
_COUPLING = 'solref="0.005 1" solimp="0.99 0.99 0.001"'
COUPLED = f'<equality><joint joint1="fl" joint2="rl" {_COUPLING}/><joint joint1="fr" joint2="rr" {_COUPLING}/></equality>'
"""The wheels of a side turn alike, as by a chain."""
_WHEELS = (("fl", 1.0, 1.0), ("fr", 1.0, -1.0), ("rl", -1.0, 1.0), ("rr", -1.0, -1.0))
_PHYSICAL = frozenset(
    {"wheel_radius_scale", "wheel_radius_difference", "track_width", "payload", "cg_offset_x", "cg_offset_y", "split_friction", "scrub"}
    | {"rolling_resistance", "slope", "wheel_radius_drift", "cg_height", "grip"}
)
_OF_SENSORS = frozenset(
    {"lidar_offset_x", "lidar_offset_y", "lidar_yaw", "lidar_time_offset", "wheel_time_offset", "gyro_bias", "gyro_scale"}
    | {"gyro_time_offset", "range_scale", "range_bias", "encoder_dropout", "missing_joint_messages"}
)
EFFECTS = _PHYSICAL | _OF_SENSORS
"""Ids of the faults that can be hidden in it."""


class MujocoSimulation(twin.MujocoSimulation):
    """`Simulation` of a robot without arms that MuJoCo moves, by a file of the robot as it truly is."""

    friction_time_s = FRICTION_TIME_S

    def __init__(
        self, experiment: Experiment, robot: Robot, seed: int, effects: Mapping[str, float], config: SimulationConfig | None = None
    ) -> None:
        unknown = sorted(set(effects) - EFFECTS)
        if unknown or robot.arms is not None:
            raise SimulationError(f"MuJoCo's vehicle has no {', '.join(unknown) or 'arms'}.")
        true = apply_faults(TrueRobot(Body.from_robot(robot), Mount()), effects)
        text = _xml(true, robot, self.friction_time_s)
        file = read_simulator(parse({"vehicle.xml": text.encode()}, Path("vehicle.xml")), robot)
        super().__init__(experiment, robot, seed, file, effects, config)
        self._drive_in_mujoco = _ResistedDrive(file.engine, np.array(experiment.start), self)

    def _check_body(self, name: str, effects: Mapping[str, float]) -> None:
        """The file has the body with its effects."""

    def _move(self, times: FloatArray, wheels: FloatArray) -> FloatArray:
        rows = super()._move(times, wheels)
        rows[:, CG] += self._body.cg_offset
        return rows


class _ResistedDrive(MujocoDrive):
    """`MujocoDrive` whose wheels have the radii, rolling resistance and scrub of a simulation's body."""

    def __init__(self, engine: MujocoEngine, start: FloatArray, simulation: MujocoSimulation) -> None:
        super().__init__(engine, start, simulation.reality.body.slope)
        self._simulation = simulation
        self._geoms = [geom for of_wheel in self._robot.geoms for geom in of_wheel]
        self._bodies = [int(self._model.geom_bodyid[geom]) for geom in self._geoms]

    def advance(self, rates: FloatArray, steps: int, cg: FloatArray) -> None:
        body = self._simulation._body  # changes from phase to phase
        sides = [body.radius_left, body.radius_right]
        radii = np.repeat(sides, [len(self._robot.wheels.left), len(self._robot.wheels.right)]) * (1.0 + FLATTENING)
        self._model.geom_size[self._geoms, 0] = self._model.geom_size[self._geoms, 2] = radii
        self._model.geom_rbound[self._geoms] = radii  # else a wheel that has grown loses its contact
        self._oppose_motion(body)
        super().advance(rates, steps, self._cg)  # the file has the load

    def _oppose_motion(self, body: Body) -> None:
        """Rolling resistance, a force f_r N along the wheel's rolling direction (Ebersole 2016, 3.17), and scrub, a moment of each contact.

        MuJoCo's own twisting friction is not used: a contact that slides twists with 7 to 20 % of the moment that its cone allows.
        """
        share, data = body.param("rolling_resistance"), self._data
        loads, force = np.zeros(len(self._geoms)), np.zeros(6)
        for i in range(data.ncon):
            mujoco.mj_contactForce(self._model, data, i, force)
            for geom in data.contact[i].geom:
                if geom in self._geoms:
                    loads[self._geoms.index(geom)] += force[0]
        speeds = data.qvel[self._rates] * self._model.geom_size[self._geoms, 0]
        heading = float(self.pose()[2])
        ahead = np.array([math.cos(heading), math.sin(heading)])
        data.xfrc_applied[self._bodies, :2] = -(share * loads * np.tanh(speeds / 0.02))[:, None] * ahead
        data.xfrc_applied[self._bodies, 5] = -body.param("mu") * body.param("scrub") * loads * math.tanh(data.qvel[5] / 0.02)


class CreepingMujocoSimulation(MujocoSimulation):
    """As by `MujocoSimulation`, with contacts that creep: friction is full from 0.15 m/s of slip on."""

    friction_time_s = 5.0 * FRICTION_TIME_S


def _xml(true: TrueRobot, robot: Robot, friction_time_s: float) -> str:
    """MJCF of the robot as it truly is, on a plane."""
    body, g = true.body, robot.geometry
    mass, mu = body.mass, body.param("mu")
    wheel_mass = WHEEL_MASS_SHARE * mass
    chassis_mass = mass - 4.0 * wheel_mass
    radius = 0.5 * (body.radius_left + body.radius_right)
    half_wheelbase, half_track = 0.5 * body.param("wheelbase"), 0.5 * body.param("track_width")
    x, y = ((np.array([g.cg_x_m, g.cg_y_m]) + body.cg_offset) * mass / chassis_mass).tolist()
    height = (body.cg_height - radius) * mass / chassis_mass
    inertia = body.inertia
    contact = CONTACT.replace(str(FRICTION_TIME_S), str(friction_time_s))
    wheels, servos, contacts = [], [], []
    for name, front, left in _WHEELS:
        own_radius = (body.radius_left if left > 0.0 else body.radius_right) * (1.0 + FLATTENING)
        grip = mu * (1.0 + 0.5 * body.grip_split * left)
        wheels.append(f"""
   <body name="{name}" pos="{front * half_wheelbase} {left * half_track} 0">
    <joint name="{name}" type="hinge" axis="0 1 0" armature="{ARMATURE * wheel_mass * radius**2}"/>
    <geom name="{name}" type="ellipsoid" size="{own_radius} {0.25 * radius} {own_radius}" mass="{wheel_mass}" contype="0"/>
   </body>""")
        contacts.append(f'<pair geom1="floor" geom2="{name}" condim="3" friction="{grip} {grip} 0 0 0" {contact}/>')
        servos.append(f'<velocity joint="{name}" kv="{SERVO_GAIN * mass * 9.81 * radius}"/>')
    edge = f"{0.5 * g.wheelbase_m} 0 {height}"
    load = f'<body pos="{edge}"><inertial pos="0 0 0" mass="{true.payload_kg}" diaginertia="1e-3 1e-3 1e-3"/></body>'
    return f"""
<mujoco>
 <option timestep="{_STEP_S}" integrator="Euler" {CONE}/>
 <worldbody>
  <geom name="floor" type="plane" size="100 100 1" contype="0"/>
  <body name="base" pos="0 0 {radius}">
   <freejoint/>
   <inertial pos="{x} {y} {height}" mass="{chassis_mass}" diaginertia="{0.6 * inertia} {0.8 * inertia} {inertia}"/>
   {load if true.payload_kg > 0.0 else ""}{"".join(wheels)}
  </body>
 </worldbody>
 {COUPLED}
 <contact>{"".join(contacts)}</contact>
 <actuator>{"".join(servos)}</actuator>
</mujoco>"""
