"""MuJoCo: the only module that imports it. A robot of an MJCF is compiled, set on its wheels, and driven through windows.

Each window starts from the settled robot with the steady motion of its first wheel rates, and a lead is played before it counts. Wheels
are driven by the file's own velocity servos; where it has none, by stiff servos that are added in memory and not judged.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from localization.errors import SimulationError
from localization.twin.engine import Played, Touch
from localization.twin.wheels import Hinge, Wheels, find_wheels
from localization.twin.windows import LEAD_S, Window, down_at, start_turn_rate
from localization.twin.xml_file import XmlFile
from motion_models import se2
from motion_models.calibration.maneuvers import IntArray
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

try:
    import mujoco
    import mujoco.rollout
except ImportError as error:
    raise SimulationError("MuJoCo is not installed. Install the extra: pip install 'skidloc[twin]'.") from error

mujoco.set_mju_user_warning(lambda message: None)  # else MuJoCo writes MUJOCO_LOG.TXT into the working folder; states are checked here
_SETTLE_S = 0.5
_LOST_M = 1.0
"""Change of height while the robot settles beyond which it flies or falls [m]."""
_SERVO_GAIN = 20.0
"""Torque of an added servo per rad/s of error, over m g r: half a per cent of error where all of mu N opposes a wheel at 2 rad/s."""
_TOUCH = "skidloc_touch_"
_BATCH_STEPS = 400_000
"""Time steps whose states are held in memory at once."""


@dataclass(frozen=True)
class MujocoRobot:
    """A compiled robot: where its wheels, servos and contacts are in the model's arrays."""

    file: str
    model: mujoco.MjModel
    wheels: Wheels
    base: int
    """Body that moves freely."""
    joints: tuple[int, ...]
    """Joints of the wheels, left ones first."""
    geoms: tuple[tuple[int, ...], ...]
    """Geoms of each wheel that touch."""
    radius_m: float
    """Mean radius of the wheels [m]."""
    gears: FloatArray
    """(nu, n) set point of each actuator per rate of each wheel; 0 for those that do not drive wheels."""
    has_servos: bool
    """Whether the servos are the file's own."""
    notes: tuple[str, ...] = ()


def compile_robot(mjcf: XmlFile, robot: Robot) -> MujocoRobot:
    """Compile ``mjcf``. Raises `SimulationError` with the engine's own message, and where there is no robot on wheels."""
    spec = _read(mjcf)
    notes: list[str] = []
    if not _has_ground(spec):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        notes.append(f"{mjcf.path.name} has no ground: a plane at z = 0 with the engine's default contact was added to compare with.")
    model = _compile(spec, mjcf)
    hinges, base = _hinges(model, mjcf)
    wheels = find_wheels(hinges, robot, mjcf.path.name)
    joints = (*wheels.left, *wheels.right)
    geoms = tuple(_touching(model, _below(model, int(model.jnt_bodyid[j]))) for j in joints)
    bare = [model.joint(j).name for j, g in zip(joints, geoms, strict=True) if not g]
    if bare:
        raise SimulationError(f"simulator '{mjcf.path.name}': the wheels {', '.join(bare)} have no geom that collides.")
    gears, others = _servos(model, wheels)
    has_servos = bool((gears != 0.0).any(axis=0).all())
    if not has_servos:
        _add_servos(spec, model, wheels, others)
        if others:
            names = ", ".join(model.actuator(i).name or str(i) for i in others)
            notes.append(f"the actuators {names} of the wheels are no velocity servos: stiff ones took their place, and are not judged.")
        else:
            notes.append("the wheels have no velocity servos: stiff ones were added to compare with, and are not judged.")
    _add_touch_sensors(spec, model, joints)
    model = _compile(spec, mjcf)
    gears, _ = _servos(model, wheels)
    radius = float(np.mean([max(_radius(model, g) for g in of_wheel) for of_wheel in geoms]))
    return MujocoRobot(mjcf.path.name, model, wheels, base, joints, geoms, radius, gears, has_servos, tuple(notes))


def _read(mjcf: XmlFile) -> mujoco.MjSpec:
    text = mjcf.files[mjcf.name].decode("utf-8", errors="replace")
    included = {name: data for name, data in mjcf.files.items() if name != mjcf.name}
    try:
        spec = mujoco.MjSpec.from_string(text, include=included or None)
    except ValueError as error:
        raise SimulationError(f"simulator '{mjcf.path}' does not load in MuJoCo: {_one_line(error)}") from error
    spec.modelfiledir = str(mjcf.path.resolve().parent)
    return spec


def _compile(spec: mujoco.MjSpec, mjcf: XmlFile) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise SimulationError(f"simulator '{mjcf.path}' does not load in MuJoCo: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip()).rstrip(".") + "."


def _has_ground(spec: mujoco.MjSpec) -> bool:
    ground = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH)
    return any(geom.type in ground and (geom.contype or geom.conaffinity or spec.pairs) for geom in spec.worldbody.geoms)


def _hinges(model: mujoco.MjModel, mjcf: XmlFile) -> tuple[list[Hinge], int]:
    """Hinges on the body that moves freely, in its frame, and that body."""
    free = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    turning = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    counts = [sum(int(model.body_rootid[model.jnt_bodyid[j]]) == int(model.body_rootid[b]) for j in turning) for b in free]
    if not free:
        raise SimulationError(
            f"simulator '{mjcf.path}': no body has a free joint, so that no robot can move. Add <freejoint/> to its base."
        )
    base = free[int(np.argmax(counts))]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
    hinges = []
    for j in turning:
        body = int(model.jnt_bodyid[j])
        if int(model.body_rootid[body]) != int(model.body_rootid[base]):
            continue
        below = _below(model, body)
        geoms = _touching(model, below)
        centre = data.geom_xpos[list(geoms)].mean(axis=0) if geoms else data.xanchor[j]
        position = rotation.T @ (centre - origin)
        lowest = min((float(rotation[:, 2] @ (data.geom_xpos[g] - origin)) - _radius(model, g) for g in geoms), default=math.inf)
        moves = any(model.body_jntnum[b] for b in below if b != body)
        hinges.append(Hinge(j, model.joint(j).name, position, rotation.T @ data.xaxis[j], lowest, bool(model.jnt_limited[j]), moves))
    return hinges, base


def _below(model: mujoco.MjModel, body: int) -> list[int]:
    """``body`` and all bodies that it carries."""
    found = [body]
    for b in range(body + 1, model.nbody):
        if int(model.body_parentid[b]) in found:
            found.append(b)
    return found


def _touching(model: mujoco.MjModel, bodies: Sequence[int]) -> tuple[int, ...]:
    """Geoms of ``bodies`` that collide, by masks or by pairs."""
    paired = {int(g) for pair in range(model.npair) for g in (model.pair_geom1[pair], model.pair_geom2[pair])}
    return tuple(
        g
        for g in range(model.ngeom)
        if int(model.geom_bodyid[g]) in bodies and (model.geom_contype[g] or model.geom_conaffinity[g] or g in paired)
    )


def _radius(model: mujoco.MjModel, geom: int) -> float:
    """Radius of a wheel's geom [m]; that of meshes by their box."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return float(np.sort(model.geom_aabb[geom, 3:])[1])
    return float(max(size[0], size[2])) if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else float(size[0])


def _servos(model: mujoco.MjModel, wheels: Wheels) -> tuple[FloatArray, list[int]]:
    """Gears (nu, n) of the velocity servos of the wheels, and actuators of wheels that are none."""
    joints = [*wheels.left, *wheels.right]
    gears, others = np.zeros((model.nu, len(joints))), []
    for i in range(model.nu):
        arms = _arms(model, i, joints)
        if not arms.any():
            continue
        gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
        is_servo = gain[0] > 0.0 and bias[2] < 0.0 and bias[1] == 0.0 and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        if is_servo:
            gears[i] = arms * wheels.signs * gain[0] / -bias[2]
        else:
            others.append(i)
    return gears, others


def _arms(model: mujoco.MjModel, actuator: int, joints: Sequence[int]) -> FloatArray:
    """(n,) speed of the actuator per rate of each wheel."""
    arms = np.zeros(len(joints))
    target, gear = int(model.actuator_trnid[actuator, 0]), float(model.actuator_gear[actuator, 0])
    kind = model.actuator_trntype[actuator]  # an enumerator equals it on the right alone
    if kind == mujoco.mjtTrn.mjTRN_JOINT or kind == mujoco.mjtTrn.mjTRN_JOINTINPARENT:
        arms[[i for i, j in enumerate(joints) if j == target]] = gear
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
        for w in range(first, first + count):
            if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT and int(model.wrap_objid[w]) in joints:
                arms[joints.index(int(model.wrap_objid[w]))] = gear * float(model.wrap_prm[w])
    return arms


def _add_servos(spec: mujoco.MjSpec, model: mujoco.MjModel, wheels: Wheels, others: Sequence[int]) -> None:
    """Velocity servos on all wheels in place of the actuators ``others``."""
    for i in sorted(others, reverse=True):
        spec.delete(spec.actuators[i])
    radius = np.mean([model.geom_size[g, 0] for j in wheels.left for g in _touching(model, _below(model, int(model.jnt_bodyid[j])))])
    gain = _SERVO_GAIN * float(model.body_subtreemass[0]) * 9.81 * float(radius) / (len(wheels.left) + len(wheels.right))
    for j in (*wheels.left, *wheels.right):
        name = model.joint(j).name
        servo = spec.add_actuator(name=f"skidloc_{name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.gainprm[0], servo.biastype, servo.biasprm[2] = gain, mujoco.mjtBias.mjBIAS_AFFINE, -gain
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _add_touch_sensors(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Sequence[int]) -> None:
    """A sensor of each wheel's load: the normal forces of its contacts, all of which are inside a sphere about it."""
    for i, j in enumerate(joints):
        body = spec.body(model.body(int(model.jnt_bodyid[j])).name) or spec.bodies[int(model.jnt_bodyid[j])]
        reach = max(float(model.geom_rbound[g]) for g in _touching(model, _below(model, int(model.jnt_bodyid[j]))))
        body.add_site(name=f"{_TOUCH}{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[4.0 * reach, 0.0, 0.0])
        spec.add_sensor(name=f"{_TOUCH}{i}", type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{_TOUCH}{i}")


@dataclass
class MujocoEngine:
    """`localization.twin.engine.Engine` by MuJoCo."""

    robot: MujocoRobot
    nominal_cg: FloatArray
    """(2,) centre of gravity of the robot file [m]: the file's own moves with a window's relative to it."""
    threads: int = 2
    _data: mujoco.MjData = field(init=False)

    def __post_init__(self) -> None:
        self._data = mujoco.MjData(self.robot.model)
        self._settle()

    def _settle(self) -> None:
        """Set the robot on its wheels. Raises `SimulationError` where it does not come to stand."""
        r, model, data = self.robot, self.robot.model, self._data
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        data.ctrl[(r.gears != 0.0).any(axis=1)] = 0.0
        height = float(data.xpos[r.base, 2])
        for step in range(round(_SETTLE_S / model.opt.timestep)):
            mujoco.mj_step(model, data)
            moved = float(data.xpos[r.base, 2]) - height
            if data.time == 0.0 or not np.isfinite(data.qpos).all():  # MuJoCo resets what is no longer finite
                raise SimulationError(f"simulator '{r.file}': the state is no longer finite after time step {step}.")
            if abs(moved) > _LOST_M:
                what = "flies up" if moved > 0.0 else "falls through the ground"
                raise SimulationError(f"simulator '{r.file}': the robot {what}: {moved:+.1f} m in {step} time steps. Check its contacts.")
        touching = {int(g) for c in data.contact for g in c.geom}
        hanging = [model.joint(j).name for j, geoms in zip(r.joints, r.geoms, strict=True) if not touching.intersection(geoms)]
        if len(hanging) > len(r.joints) - 3:
            raise SimulationError(f"simulator '{r.file}': {', '.join(hanging)} do not touch the ground after {_SETTLE_S:g} s.")

    def play(self, windows: Sequence[Window]) -> Played:
        """See `localization.twin.engine.Engine.play`."""
        step = self.robot.model.opt.timestep
        counts = np.array([round(float(w.dt.sum()) / step) for w in windows])
        order = np.argsort(counts, kind="stable")
        poses, rates, airborne = np.zeros((len(windows), 3)), np.zeros((len(windows), 2)), np.zeros(len(windows))
        loads: list[FloatArray] = []
        at = 0
        while at < len(order):
            batch = [int(order[at])]
            while at + len(batch) < len(order) and (len(batch) + 1) * counts[order[at + len(batch)]] <= _BATCH_STEPS:
                batch.append(int(order[at + len(batch)]))
            poses[batch], rates[batch], of_windows = self._play_batch([windows[i] for i in batch], counts[batch])
            airborne[batch] = [float(np.mean(load == 0.0)) for load in of_windows]
            loads += of_windows
            at += len(batch)
        return Played(poses, rates, _touch(airborne, np.concatenate(loads)), int(counts.sum()))

    def _play_batch(self, windows: Sequence[Window], counts: IntArray) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        model, r = self.robot.model, self.robot
        steps, lead = int(counts.max()), round(LEAD_S / model.opt.timestep)
        models = [self._on_slope(self.with_cg(w.cg, self.robot.model), w) for w in windows]
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty((len(windows), mujoco.mj_stateSize(model, spec)))
        control = np.empty((len(windows), steps, model.nu))
        for i, w in enumerate(windows):
            mujoco.mj_getState(model, self._started(w), start[i], spec)
            control[i] = self._controls(w, steps)
        states, sensors = self._roll(models, start, control)
        times = states[:, :, 0]
        bad = np.flatnonzero(~np.isfinite(states).all(axis=(1, 2)) | (np.diff(times, axis=1) <= 0.0).any(axis=1))
        if len(bad):
            step = int(np.argmax(np.diff(times[bad[0]], prepend=0.0) <= 0.0))
            raise SimulationError(f"simulator '{r.file}': the state is no longer finite after time step {step} of a window.")
        index = np.arange(len(windows))
        ends = np.array([round(float(w.dt.sum()) / model.opt.timestep) for w in windows]) - 1
        first, last = states[:, lead - 1, 1:], states[index, ends, 1:]
        climbed = np.abs(last[:, self._base_at + 2] - first[:, self._base_at + 2])
        if (climbed > _LOST_M).any():
            raise SimulationError(f"simulator '{r.file}': the robot leaves the ground by {climbed.max():.1f} m in a window of wheel rates.")
        angles = np.array([model.jnt_qposadr[j] for j in r.joints])
        durations = (ends + 1 - lead) * model.opt.timestep
        speeds = (last[:, angles] - first[:, angles]) * r.wheels.signs / durations[:, None]
        left = len(r.wheels.left)
        rates = np.column_stack([speeds[:, :left].mean(axis=1), speeds[:, left:].mean(axis=1)])
        at = [int(model.sensor_adr[model.sensor(f"{_TOUCH}{i}").id]) for i in range(len(r.joints))]
        loads = [of_window[lead : end + 1, at] for of_window, end in zip(sensors, ends, strict=True)]
        return se2.between(self._planar(first), self._planar(last)), rates, loads

    def _roll(self, models: Sequence[mujoco.MjModel], start: FloatArray, control: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and sensors (W, steps, ...) after each time step."""
        threads = [mujoco.MjData(models[0]) for _ in range(self.threads)]
        with mujoco.rollout.Rollout(nthread=self.threads) as rollout:
            return rollout.rollout(models, threads, start, control)  # type: ignore[no-any-return]

    @property
    def _base_at(self) -> int:
        model = self.robot.model
        return int(model.jnt_qposadr[model.body_jntadr[self.robot.base]])

    def law(self, model: mujoco.MjModel) -> Callable[[Any, Any], None] | None:
        """Forces to apply in each time step; None where contacts have all of them."""
        return None

    def with_cg(self, cg: FloatArray, nominal: mujoco.MjModel) -> mujoco.MjModel:
        """The ``nominal`` model with its centre of gravity moved as ``cg`` (2,) is from the robot file's."""
        moved = cg - self.nominal_cg
        if not moved.any():
            return nominal
        w, model = self.robot.wheels, copy.copy(nominal)
        shift = moved[0] * w.forward + moved[1] * np.array([-w.forward[1], w.forward[0]])
        mass = float(model.body_subtreemass[self.robot.base])
        model.body_ipos[self.robot.base, :2] += shift * mass / float(model.body_mass[self.robot.base])
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def _on_slope(self, model: mujoco.MjModel, window: Window) -> mujoco.MjModel:
        """The ``model`` with gravity as on the ground of ``window``: it lies downhill of the body where the measured motion starts."""
        if not window.downhill.any():
            return model
        tilted = copy.copy(model)
        turned = LEAD_S * start_turn_rate(window, self.robot.radius_m, self.robot.wheels.track_m)
        heading = float(self._planar(self._data.qpos[None])[0, 2]) + turned
        tilted.opt.gravity[:] = np.linalg.norm(model.opt.gravity) * down_at(window, heading)
        return tilted

    def _started(self, window: Window) -> mujoco.MjData:
        """The settled robot in the steady motion of the window's first rates."""
        r, model, data = self.robot, self.robot.model, copy.copy(self._data)
        left, right = window.rates[0]
        speed = 0.5 * r.radius_m * (left + right)
        turn = start_turn_rate(window, r.radius_m, r.wheels.track_m)
        at = int(model.jnt_dofadr[model.body_jntadr[r.base]])
        heading = self._planar(data.qpos[None])[0, 2]
        rotation = data.xmat[r.base].reshape(3, 3)
        middle = rotation[:2, :2] @ r.wheels.origin
        data.qvel[:] = 0.0
        data.qvel[at : at + 2] = speed * np.array([math.cos(heading), math.sin(heading)]) - turn * np.array([-middle[1], middle[0]])
        data.qvel[at + 5] = turn
        sides = np.array([left] * len(r.wheels.left) + [right] * len(r.wheels.right))
        data.qvel[[model.jnt_dofadr[j] for j in r.joints]] = r.wheels.signs * sides
        data.time = 0.0
        return data

    def _controls(self, window: Window, steps: int) -> FloatArray:
        """(steps, nu) set points."""
        r, model = self.robot, self.robot.model
        times = (np.arange(steps) + 0.5) * model.opt.timestep
        index = np.minimum(np.searchsorted(np.cumsum(window.dt), times, side="right"), len(window.dt) - 1)
        sides = (window.set_points if r.has_servos else window.rates)[index]
        wheels = np.repeat(sides, [len(r.wheels.left), len(r.wheels.right)], axis=1)
        driven = (r.gears != 0.0).any(axis=1)
        return np.where(driven, wheels @ r.gears.T, self._data.ctrl)

    def _planar(self, qpos: FloatArray) -> FloatArray:
        """(n, 3) poses of the body frame in the plane, of states ``qpos`` (n, nq...)."""
        at, w = self._base_at, self.robot.wheels
        position, (a, b, c, d) = qpos[:, at : at + 3], qpos[:, at + 3 : at + 7].T
        ex = np.column_stack([1 - 2 * (c * c + d * d), 2 * (b * c + a * d)])
        ey = np.column_stack([2 * (b * c - a * d), 1 - 2 * (b * b + d * d)])
        ahead = w.forward[0] * ex + w.forward[1] * ey
        origin = position[:, :2] + w.origin[0] * ex + w.origin[1] * ey
        return np.column_stack([origin, np.arctan2(ahead[:, 1], ahead[:, 0])])

    def center_of_mass_in_base(self) -> FloatArray:
        """(3,) of the whole robot in the frame of its free body [m]."""
        data, base = self._data, self.robot.base
        return np.asarray(data.xmat[base].reshape(3, 3).T @ (data.subtree_com[base] - data.xpos[base]))

    def center_of_mass(self) -> tuple[float, float, float]:
        """Centre of mass of the whole robot: ahead and left of the middle of the wheels, above their lowest points [m]."""
        mujoco.mj_kinematics(self.robot.model, self._data)
        mujoco.mj_comPos(self.robot.model, self._data)
        w, position = self.robot.wheels, self.center_of_mass_in_base()
        off = position[:2] - w.origin
        axles = np.mean([self._data.xanchor[j][2] for j in self.robot.joints])
        height = float(self._data.subtree_com[self.robot.base, 2] - axles) + self.robot.radius_m
        return float(off @ w.forward), float(off @ np.array([-w.forward[1], w.forward[0]])), height

    def wheel_inertia(self) -> float:
        """Inertia of a wheel about its axle without armature, mean over the wheels [kg m^2]."""
        model = self.robot.model
        found = []
        for j in self.robot.joints:
            body = int(model.jnt_bodyid[j])
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
            axis = rotation.reshape(3, 3).T @ model.jnt_axis[j]
            found.append(float(model.body_inertia[body] @ axis**2))
        return float(np.mean(found))

    def ground_priority(self) -> int:
        """Highest priority of geoms that do not belong to the wheels."""
        wheels = {g for geoms in self.robot.geoms for g in geoms}
        return max((int(p) for g, p in enumerate(self.robot.model.geom_priority) if g not in wheels), default=0)

    def radius_difference(self) -> float:
        """Radius of the left wheels less that of the right ones over their mean."""
        radii = [max(self.radius(geom) for geom in of_wheel) for of_wheel in self.robot.geoms]
        count = len(self.robot.wheels.left)
        left, right = np.mean(radii[:count]), np.mean(radii[count:])
        return 2.0 * float((left - right) / (left + right))

    def radius(self, geom: int) -> float:
        """Radius of a wheel's geom [m]."""
        return _radius(self.robot.model, geom)

    def geom_kind(self, geom: int) -> str:
        """Name of a geom's shape."""
        return str(mujoco.mjtGeom(int(self.robot.model.geom_type[geom])).name.removeprefix("mjGEOM_").lower())


class MujocoDrive:
    """One robot that is driven on and on, from a pose in the world."""

    def __init__(self, engine: MujocoEngine, start: FloatArray, slope: float = 0.0) -> None:
        """``start`` (3,) is the pose of the body frame [m, m, rad], ``slope`` that of the ground, up along x [rad]."""
        self._engine, self._robot = engine, engine.robot
        self._data = copy.copy(engine._data)
        self._nominal = copy.copy(engine.robot.model)
        self._nominal.opt.gravity[:] = 9.81 * np.array([-math.sin(slope), 0.0, -math.cos(slope)])
        self._model, self._cg = self._nominal, engine.nominal_cg
        self._place(start)
        self._law = engine.law(self._model)
        self._angles = [int(self._model.jnt_qposadr[j]) for j in self._robot.joints]
        self._rates = [int(self._model.jnt_dofadr[j]) for j in self._robot.joints]
        self._base_dof = int(self._model.jnt_dofadr[self._model.body_jntadr[self._robot.base]])
        self.radius_m = self._robot.radius_m

    def _place(self, start: FloatArray) -> None:
        at, data = self._engine._base_at, self._data
        turn = float(start[2]) - float(self._engine._planar(data.qpos[None])[0, 2])
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, np.array([math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)]), data.qpos[at + 3 : at + 7])
        data.qpos[at + 3 : at + 7] = turned
        data.qpos[at : at + 2] += start[:2] - self._engine._planar(data.qpos[None])[0, :2]
        data.qvel[:] = 0.0
        data.time = 0.0
        mujoco.mj_forward(self._model, data)

    def advance(self, rates: FloatArray, steps: int, cg: FloatArray) -> None:
        """So many time steps with set points ``rates`` (2,) of the left and right wheels and the centre of gravity ``cg`` (2,).

        Raises `SimulationError` where the state does not stay finite.
        """
        if not np.array_equal(cg, self._cg):
            self._cg, self._model = cg.copy(), self._engine.with_cg(cg, self._nominal)
        r, data = self._robot, self._data
        sides = np.repeat(rates, [len(r.wheels.left), len(r.wheels.right)])
        data.ctrl[:] = np.where((r.gears != 0.0).any(axis=1), r.gears @ sides, data.ctrl)
        before = data.time
        for _ in range(steps):
            if self._law is None:
                mujoco.mj_step(self._model, data)
            else:
                advance(self._model, data, self._law)
        if data.time <= before or not np.isfinite(data.qpos).all():
            raise SimulationError(f"simulator '{r.file}': the state is no longer finite {before:.2f} s into the drive.")

    def pose(self) -> FloatArray:
        """(3,) of the body frame in the world."""
        return np.asarray(self._engine._planar(self._data.qpos[None])[0])

    def twist(self) -> FloatArray:
        """(3,) of the body frame, in it [m/s, m/s, rad/s]."""
        velocity, turn = self._data.qvel[self._base_dof : self._base_dof + 2], float(self._data.qvel[self._base_dof + 5])
        arm = self._data.xmat[self._robot.base].reshape(3, 3)[:2, :2] @ self._robot.wheels.origin
        vx, vy = velocity + turn * np.array([-arm[1], arm[0]])
        heading = self.pose()[2]
        c, s = math.cos(heading), math.sin(heading)
        return np.array([c * vx + s * vy, -s * vx + c * vy, turn])

    def wheel_rates(self) -> FloatArray:
        """(2,) means of the left and the right wheels [rad/s]."""
        return self._sides(self._data.qvel[self._rates])

    def wheel_angles(self) -> FloatArray:
        """(2,) means of the left and the right wheels [rad]."""
        return self._sides(self._data.qpos[self._angles])

    def _sides(self, values: FloatArray) -> FloatArray:
        signed, left = values * self._robot.wheels.signs, len(self._robot.wheels.left)
        return np.array([signed[:left].mean(), signed[left:].mean()])


def put_state(model: mujoco.MjModel, state: FloatArray) -> mujoco.MjData:
    """A robot in ``state``."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    return data


def advance(model: mujoco.MjModel, data: mujoco.MjData, law: Callable[[Any, Any], None]) -> None:
    """One time step, with the forces of ``law``."""
    mujoco.mj_step1(model, data)
    law(model, data)
    mujoco.mj_step2(model, data)


def take_state(model: mujoco.MjModel, data: mujoco.MjData, state: FloatArray) -> None:
    """Write the state of a robot to ``state``."""
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)


def _touch(airborne: FloatArray, loads: FloatArray) -> Touch:
    """`Touch` of the wheels' ``loads`` (steps, n) [N]."""
    counts = np.bincount(np.count_nonzero(loads, axis=1), minlength=loads.shape[1] + 1)
    scatter = float(np.mean(loads.std(axis=0) / np.maximum(loads.mean(axis=0), 1e-9)))
    return Touch(airborne, counts / counts.sum(), scatter)


def contact_numbers(engine: MujocoEngine) -> Mapping[str, FloatArray]:
    """What the engine uses between wheel and ground, of the wheels' contacts at rest: friction (5,), solref (2,), solimp (5,), dim (1,)."""
    wheels = {g for geoms in engine.robot.geoms for g in geoms}
    mujoco.mj_forward(engine.robot.model, engine._data)
    for contact in engine._data.contact:
        if wheels.intersection(int(g) for g in contact.geom):
            return {
                "friction": np.array(contact.friction),
                "solref": np.array(contact.solref),
                "solimp": np.array(contact.solimp),
                "dim": np.array([float(contact.dim)]),
            }
    raise SimulationError(f"simulator '{engine.robot.file}': no wheel touches the ground.")
