"""Hills in MuJoCo: a skid-steer robot on waves or an inclined plane, with wheels, IMU and its true poses in space.

Each wheel has a plane of its own, which stays tangent to the ground below it. Rigid bodies and soft contacts (see `mujoco_vehicle`) that
share nothing with the friction model. Needs the extra `mujoco`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np

from localization.events import Event, ImuSample, WheelSample
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers.hills import HILLS, Ground, HillDrive
from tests.helpers.mujoco_vehicle import ARMATURE, CONE, CONTACT, COUPLED, FLATTENING, SERVO_GAIN, WHEEL_MASS_SHARE

_STEP_S, _IMU_EVERY, _WHEELS_EVERY, _GROUND_EVERY = 0.001, 10, 20, 2
_FIELD_M = 40.0
_WHEELS = (("fl", 1.0, 1.0), ("fr", 1.0, -1.0), ("rl", -1.0, 1.0), ("rr", -1.0, -1.0))
_RAMP_RAD_PER_S2 = 8.0
_K = 0.55
_GYRO_SIGMA, _FORCE_SIGMA, _BIAS = 0.01, 0.1, (0.002, -0.003, 0.0002)
_START_S, _HELD_S = 1.0, 0.1
"""In which the robot settles, before the drive, and for how long of it the robot is held: on wheels that roll downhill it rocks."""


def robot_of(mu: float, cg_height_m: float = 0.4) -> Robot:
    """A Husky whose friction and CG's height are known."""
    robot = load_robot("husky_a200")
    models = {**robot.models, "friction": {**robot.models.get("friction", {}), "mu": mu}}
    return replace(robot, geometry=replace(robot.geometry, cg_height_m=cg_height_m), models=models)


def turn_in_place(t: float, position: FloatArray, heading: float) -> tuple[float, float]:
    """vx [m/s] and wz [rad/s]: rest, then turns."""
    return (0.0, 0.0) if t < 2.0 else (0.0, 1.0)


def steady(vx: float, wz: float):
    """Rest, then a straight line or an arc."""
    return lambda t, position, heading: (0.0, 0.0) if t < 2.0 else (vx, wz)


class Wander:
    """Straight on, arcs and turns in place by chance, towards the middle where far from it."""

    def __init__(self, seed: int) -> None:
        self._rng, self._until, self._command = np.random.default_rng(seed), 2.0, (0.0, 0.0)

    def __call__(self, t: float, position: FloatArray, heading: float) -> tuple[float, float]:
        """Command at ``t``."""
        if t >= self._until:
            self._until = t + self._rng.uniform(2.0, 6.0)
            is_turn = self._rng.random() < 0.25
            self._command = (0.0, float(self._rng.choice([-0.9, 0.9]))) if is_turn else (0.7, float(self._rng.uniform(-0.7, 0.7)))
        if math.hypot(*position[:2]) > 0.35 * _FIELD_M and self._command[0] > 0.0:
            back = math.remainder(math.atan2(-position[1], -position[0]) - heading, 2.0 * math.pi)
            return 0.6, float(np.clip(back, -0.8, 0.8))
        return self._command


def drive(
    command,
    seconds: float,
    mu: float = 0.8,
    slope_deg: float | None = None,
    robot: Robot | None = None,
    seed: int = 1,
    softness: float = 1.0,
    ground: Ground = HILLS,
) -> HillDrive:
    """Drive by ``command(t, position, heading)``: on ``ground``, or on a plane that rises by ``slope_deg`` towards +x.

    ``softness``: how much softer the wheels are than `mujoco_vehicle.CONTACT`, by which they give way by .6 mm under the robot's weight.
    Such wheels do not adapt to ground that is not plane: on the hills each is lifted off for a quarter of the time.
    """
    robot = robot or robot_of(mu)
    model = mujoco.MjModel.from_xml_string(_xml(robot, mu, softness))
    down = -9.81 * np.array([0.0, 0.0, 1.0])
    tilt = np.eye(3)
    if slope_deg is not None:
        a = math.radians(slope_deg)
        tilt = np.array([[math.cos(a), 0.0, -math.sin(a)], [0.0, 1.0, 0.0], [math.sin(a), 0.0, math.cos(a)]])  # world_R_plane
        down = tilt.T @ down
    model.opt.gravity[:] = down
    data = mujoco.MjData(model)
    uneven = ground if slope_deg is None else None
    if uneven is not None:
        data.qpos[2] += float(uneven.height(np.zeros(1), np.zeros(1))[0])
    return _record(model, data, command, seconds, robot, tilt, uneven, np.random.default_rng(seed))


def _record(
    model, data, command, seconds: float, robot: Robot, tilt: FloatArray, ground: Ground | None, rng: np.random.Generator
) -> HillDrive:
    g = robot.geometry
    hinges = [model.joint(name).id for name, _, _ in _WHEELS]
    angles_at, rates_at = [model.jnt_qposadr[j] for j in hinges], [model.jnt_dofadr[j] for j in hinges]
    gyro, force = data.sensor("gyro").data, data.sensor("force").data
    events: list[Event] = []
    stamps, positions, rotations, goal, set_points = [], [], [], np.zeros(2), np.zeros(2)
    sums, bias, start = np.zeros(6), np.array(_BIAS), round(_START_S / _STEP_S)
    held = round((_START_S - _HELD_S) / _STEP_S)
    for i in range(round((seconds + _START_S) / _STEP_S) + 1):
        t = i * _STEP_S - _START_S
        R = data.body("base").xmat.reshape(3, 3)
        if i >= start and i % _WHEELS_EVERY == 0:
            stamp = 1_000_000_000 + round(t * 1e9)
            angles, rates = data.qpos[angles_at], data.qvel[rates_at]
            events.append(WheelSample(stamp, 0.5 * (rates[:2] + rates[2:]), 0.5 * (angles[:2] + angles[2:])))
            stamps.append(stamp)
            positions.append(tilt @ (data.qpos[:3] - g.wheel_radius_m * R[:, 2]))
            rotations.append(tilt @ R)
            vx, wz = command(t, data.qpos[:3], math.atan2(R[1, 0], R[0, 0]))
            half = 0.5 * wz * g.track_width_m / _K
            goal = np.array([vx - half, vx + half]) / g.wheel_radius_m
        set_points += np.clip(goal - set_points, *(s * _RAMP_RAD_PER_S2 * _STEP_S for s in (-1.0, 1.0)))
        data.ctrl[:] = np.tile(set_points, 2)
        is_standing = i >= held and not set_points.any()
        if is_standing:  # else soft contacts let the robot creep downhill by millimetres a second
            data.qvel[:] = 0.0
            sums[3:] -= R.T @ model.opt.gravity
        else:
            sums += np.concatenate([gyro, force])
        if i % _IMU_EVERY == 0:
            if i >= start:
                noise = rng.normal(size=6) * np.repeat([_GYRO_SIGMA, _FORCE_SIGMA], 3)
                mean = sums / _IMU_EVERY + noise + np.concatenate([bias, np.zeros(3)])
                events.append(ImuSample(1_000_000_000 + round(t * 1e9), mean[:3], mean[3:], "imu_link"))
            sums[:] = 0.0
        if is_standing:
            continue
        if ground is not None and i % _GROUND_EVERY == 0:
            _move_ground(data, g.wheel_radius_m, ground)
        mujoco.mj_step(model, data)
    mounts = {"base_link": Mount(), "imu_link": Mount(0.1, 0.0, 0.2)}
    return HillDrive(robot, mounts, events, np.array(stamps), np.array(positions), np.array(rotations))


def _move_ground(data, radius_m: float, ground: Ground) -> None:
    """Put the plane of each wheel tangent to the ground below it."""
    for k, (name, _, _) in enumerate(_WHEELS):
        x, y, _ = data.body(name).xpos
        for _ in range(2):  # the wheel's foot lies below its centre along the normal
            dx, dy = ground.gradient(x, y)
            normal = np.array([-dx, -dy, 1.0]) / math.sqrt(1.0 + dx * dx + dy * dy)
            x, y = data.body(name).xpos[:2] - radius_m * normal[:2]
        data.mocap_pos[k] = (x, y, float(ground.height(np.array([x]), np.array([y]))[0]))
        half = math.sqrt(0.5 * (1.0 + normal[2]))
        data.mocap_quat[k] = (half, -normal[1] / (2.0 * half), normal[0] / (2.0 * half), 0.0)


def _xml(robot: Robot, mu: float, softness: float = 1.0) -> str:
    g = robot.geometry
    mass, radius = 50.0, g.wheel_radius_m
    wheel_mass = WHEEL_MASS_SHARE * mass
    chassis = mass - 4.0 * wheel_mass
    height = (g.cg_height_m - radius) * mass / chassis
    inertia = mass * (g.track_width_m**2 + g.wheelbase_m**2) / 12.0
    own = radius * (1.0 + softness * FLATTENING)
    floor = "".join(
        f'<body name="ground_{n}" mocap="true"><geom name="ground_{n}" type="plane" size="100 100 1" contype="0"/></body>'
        for n, _, _ in _WHEELS
    )
    wheels = "".join(
        f'<body name="{name}" pos="{x * 0.5 * g.wheelbase_m} {y * 0.5 * g.track_width_m} 0">'
        f'<joint name="{name}" type="hinge" axis="0 1 0" armature="{ARMATURE * wheel_mass * radius**2}"/>'
        f'<geom name="{name}" type="ellipsoid" size="{own} {0.25 * radius} {own}" mass="{wheel_mass}" contype="0"/></body>'
        for name, x, y in _WHEELS
    )
    contact = CONTACT.replace('solref="0.01 1"', f'solref="{0.01 * math.sqrt(softness)} 1"')
    pairs = "".join(f'<pair geom1="ground_{n}" geom2="{n}" condim="3" friction="{mu} {mu} 0 0 0" {contact}/>' for n, _, _ in _WHEELS)
    servos = "".join(f'<velocity joint="{n}" kv="{SERVO_GAIN * mass * 9.81 * radius}"/>' for n, _, _ in _WHEELS)
    return f"""
<mujoco>
 <option timestep="{_STEP_S}" integrator="Euler" {CONE}/>
 <worldbody>{floor}
  <body name="base" pos="0 0 {radius}"><freejoint/>
   <inertial pos="0 0 {height}" mass="{chassis}" diaginertia="{0.6 * inertia} {0.8 * inertia} {inertia}"/>
   <site name="imu" pos="0.1 0 {0.2 - radius}"/>{wheels}
  </body>
 </worldbody>
 {COUPLED}
 <contact>{pairs}</contact><actuator>{servos}</actuator>
 <sensor><gyro name="gyro" site="imu"/><accelerometer name="force" site="imu"/></sensor>
</mujoco>"""
