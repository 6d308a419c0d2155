"""DART, Gazebo's default physics: the only module that imports dartpy. A robot of an SDF or URDF, driven through windows.

As gz-sim sets it up: ODE's collision detector, the smaller friction of two shapes, pyramids of friction along the axes of the world, and
joints that follow their velocity commands exactly (gz-sim's DiffDrive). dartpy has neither mu2 nor slip: with a slip compliance the wheels
have no friction of DART's, and get the forces of gz-sim's WheelSlip, F_i = -clip(N s_i / (C |r q|), mu N) along each axis of a wheel,
N its load, s_i the slip of its patch, C the compliance and q its rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from localization.errors import SimulationError
from localization.twin.engine import Played, Touch
from localization.twin.gazebo_file import GazeboRobot, wheel_centre
from localization.twin.windows import LEAD_S, Window, down_at, start_turn_rate
from motion_models.se2 import FloatArray, between
from motion_models.slope import GRAVITY

try:
    import dartpy as dart
except ImportError as error:
    raise SimulationError("DART is not installed. Install the extra: pip install 'skidloc[gazebo]'.") from error

STEP_COST = 3
"""Time steps of MuJoCo that take as long as one of DART: 65 to 95 us of a Husky's, of 30."""
_SETTLE_S = 0.3
_LOST_M = 0.5
"""Change of height beyond which a robot flies or falls [m]."""
_GROUND_MU = 100.0
"""The ground's friction: that of the wheels counts, the smaller one."""
_CREEP_M_S = 0.02
"""Rim speed that takes the place of a wheel's where it stands [m/s]: WheelSlip's forces have no limit there."""
_TOUCH_EVERY = 10
"""Time steps from one look at the contacts to the next."""
_LEVER = 2.5
"""Mobility of a patch under yaw and translation over that of the wheel's share of the mass alone."""


@dataclass(frozen=True)
class DartBody:
    """What of a `GazeboRobot` DART is given: rigid bodies, with numbers that may differ from the file's."""

    source: GazeboRobot
    mass: float
    com: FloatArray
    inertia: FloatArray
    """(3, 3) moments of inertia of all but the wheels, in the model's frame [kg m^2]."""
    radii: FloatArray
    """(n,) of the wheels [m], left ones first."""
    lengths: FloatArray
    """(n,) widths of the wheels [m]."""
    mu: float
    compliance: float
    """Slip over friction of WheelSlip, by the wheel's rim speed and load [-]; NaN for DART's own friction."""


class DartEngine:
    """`localization.twin.engine.Engine` by DART."""

    def __init__(self, body: DartBody, nominal_cg: FloatArray) -> None:
        self._body, self._nominal_cg = body, nominal_cg
        self._has_law = not math.isnan(body.compliance)
        self.name = body.source.file.path.name
        self._centres = np.array([wheel_centre(w) for w in body.source.driven])
        run = _Run(self, np.zeros(2))
        run.settle()  # raises where the robot does not stand
        self.loads = run.loads
        """(n,) of the wheels at rest [N]."""

    @property
    def body(self) -> DartBody:
        """What is simulated."""
        return self._body

    @property
    def centres(self) -> FloatArray:
        """(n, 3) of the wheels in the model's frame [m]."""
        return self._centres

    def play(self, windows: Sequence[Window]) -> Played:
        """See `localization.twin.engine.Engine.play`."""
        poses, rates, airborne = np.zeros((len(windows), 3)), np.zeros((len(windows), 2)), np.zeros(len(windows))
        touches: list[FloatArray] = []
        steps = 0
        for i, window in enumerate(windows):
            run = _Run(self, window.cg - self._nominal_cg)
            run.settle()
            poses[i], touched, n = run.play(window)
            airborne[i] = 1.0 - float(touched.mean())
            rates[i] = window.mean_rates
            touches.append(touched)
            steps += n
        counts = np.bincount(np.concatenate(touches).sum(axis=1).astype(np.int64), minlength=len(self._body.radii) + 1)
        return Played(poses, rates, Touch(airborne, counts / counts.sum(), math.nan), STEP_COST * steps)


class _Run:
    """One robot in one world."""

    def __init__(self, engine: DartEngine, moved_cg: FloatArray) -> None:
        b, source = engine.body, engine.body.source
        self._engine, self._b = engine, b
        w = source.wheels
        shift = moved_cg[0] * w.forward + moved_cg[1] * np.array([-w.forward[1], w.forward[0]])
        com = b.com + np.append(shift, 0.0) * source.mass / b.mass
        self.world = dart.simulation.World()
        self.world.setTimeStep(source.time_step_s)
        self.world.setGravity([0.0, 0.0, -GRAVITY])
        self.world.getConstraintSolver().setCollisionDetector(dart.collision.OdeCollisionDetector())
        self.world.addSkeleton(_ground())
        self._robot = dart.dynamics.Skeleton("robot")
        root, self._base = self._robot.createFreeJointAndBodyNodePair()
        self._base.setInertia(dart.dynamics.Inertia(b.mass, com, b.inertia))
        self._joints, self._wheels = [], []
        for wheel, centre, radius, length in zip(source.driven, engine.centres, b.radii, b.lengths, strict=True):
            joint, node = self._robot.createRevoluteJointAndBodyNodePair(self._base, _hinge(wheel.joint.axis, centre))
            link = wheel.link
            rotation = link.pose.rotation
            node.setInertia(dart.dynamics.Inertia(link.mass, np.zeros(3), rotation @ link.inertia @ rotation.T))
            self._touch_with(node, wheel.shape.kind, radius, length, rotation @ wheel.shape.pose.rotation)
            joint.setActuatorType(dart.dynamics.ActuatorType.VELOCITY)
            self._joints.append(joint)
            self._wheels.append(node)
        lowest = float((engine.centres[:, 2] - b.radii).min())
        root.setPositions([0.0, 0.0, 0.0, 0.0, 0.0, -lowest])
        self.world.addSkeleton(self._robot)
        self._height = -lowest
        self._commands = np.zeros(self._robot.getNumDofs())
        self._at = [joint.getDof(0).getIndexInSkeleton() if hasattr(joint, "getDof") else 6 + i for i, joint in enumerate(self._joints)]
        self._forces = np.zeros((len(self._wheels), 2))
        self._patches = [(float(x), float(y), float(z - r)) for (x, y, z), r in zip(engine.centres, b.radii, strict=True)]
        self.loads = self._static_loads(com)

    def _touch_with(self, node: Any, kind: str, radius: float, length: float, rotation: FloatArray) -> None:
        shape = dart.dynamics.SphereShape(radius) if kind == "sphere" else dart.dynamics.CylinderShape(radius, length)
        frame = node.createShapeNode(shape)
        frame.createCollisionAspect()
        frame.createDynamicsAspect()
        frame.getDynamicsAspect().setFrictionCoeff(0.0 if self._engine._has_law else self._b.mu)
        transform = np.eye(4)
        transform[:3, :3] = rotation
        frame.setRelativeTransform(transform)

    def _static_loads(self, com: FloatArray) -> FloatArray:
        """(n,) loads of the wheels at rest, the least-squares ones (those of equal springs) [N]."""
        source, b = self._b.source, self._b
        wheels = sum(w.link.mass for w in source.driven)
        xy = self._engine.centres[:, :2]
        whole = (b.mass * com[:2] + wheels * xy.mean(axis=0)) / (b.mass + wheels)
        A = np.vstack([np.ones(len(xy)), xy.T])
        loads = np.linalg.pinv(A) @ np.array([1.0, *whole]) * (b.mass + wheels) * GRAVITY
        return np.asarray(np.maximum(loads, 1e-3))

    def settle(self) -> None:
        """Let it stand. Raises `SimulationError`."""
        steps = round(_SETTLE_S / self.world.getTimeStep())
        for i in range(steps):
            self._step(i)
        self._check(steps)

    def play(self, window: Window) -> tuple[FloatArray, FloatArray, int]:
        """Pose (3,) at the end of the window from that at its start, touches (m, n), and time steps."""
        h = self.world.getTimeStep()
        steps, lead = round(float(window.dt.sum()) / h), round(LEAD_S / h)
        times = (np.arange(steps) + 0.5) * h
        sides = window.rates[np.minimum(np.searchsorted(np.cumsum(window.dt), times, side="right"), len(window.dt) - 1)]
        wheels = self._b.source.wheels
        commands = np.repeat(sides, [len(wheels.left), len(wheels.right)], axis=1) * wheels.signs
        turn = start_turn_rate(window, float(self._b.radii.mean()), wheels.track_m)
        self.world.setGravity(GRAVITY * down_at(window, float(self._planar()[2]) + LEAD_S * turn))
        self._set_off(window.rates[0], turn)
        first, touched = self._planar(), []
        for i in range(steps):
            if i == lead:
                first = self._planar()
            self._commands[self._at] = commands[i]
            self._step(i)
            if i >= lead and i % _TOUCH_EVERY == 0:
                touched.append(self._touching())
        self._check(steps)
        return np.asarray(between(first, self._planar())), np.array(touched), steps

    def _set_off(self, rates: FloatArray, turn: float) -> None:
        """Start with the steady motion of the window's first rates, at this turn rate [rad/s]."""
        wheels, speed = self._b.source.wheels, 0.5 * float(self._b.radii.mean()) * float(rates.sum())
        ahead, middle = wheels.forward, wheels.origin
        velocity = speed * ahead - turn * np.array([-middle[1], middle[0]])
        state = self._robot.getVelocities()
        state[:6] = (0.0, 0.0, turn, velocity[0], velocity[1], 0.0)
        self._robot.setVelocities(state)

    def _step(self, number: int) -> None:
        if self._engine._has_law:
            self._push()
        self._robot.setCommands(self._commands)
        self.world.step()
        if number % 200 == 0:
            self._check(number)

    def _push(self) -> None:
        """WheelSlip's forces, in the frame of the model, on the body that carries the wheels."""
        b, wheels = self._b, self._b.source.wheels
        transform = self._base.getWorldTransform().matrix()
        vx, vy, _ = transform[:3, :3].T @ self._base.getLinearVelocity()
        turn = float(self._base.getAngularVelocity()[2])
        fx, fy = (float(v) for v in wheels.forward)
        h = self.world.getTimeStep()
        force, torque = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        for i, (x, y, z) in enumerate(self._patches):
            rim = float(b.radii[i] * wheels.signs[i] * self._commands[self._at[i]])
            ux, uy = vx - turn * y, vy + turn * x
            along, across = ux * fx + uy * fy - rim, -ux * fy + uy * fx
            load = float(self.loads[i])
            slope, limit = load / (b.compliance * max(abs(rim), _CREEP_M_S)), b.mu * load
            share = 1.0 / (1.0 + slope * h * _LEVER * GRAVITY / load)
            f = self._forces[i]
            # the force that slip would have at the end of the step, by the mobility of the patch
            f[0] = min(max(f[0] + (-slope * along - f[0]) * share, -limit), limit)
            f[1] = min(max(f[1] + (-slope * across - f[1]) * share, -limit), limit)
            gx, gy = f[0] * fx - f[1] * fy, f[0] * fy + f[1] * fx
            force[0] += gx
            force[1] += gy
            torque[0] -= z * gy
            torque[1] += z * gx
            torque[2] += x * gy - y * gx
        self._base.addExtForce(force, [0.0, 0.0, 0.0], True, True)
        self._base.addExtTorque(torque, True)

    def _planar(self) -> FloatArray:
        """(3,) pose of the body frame in the plane."""
        transform, wheels = self._base.getWorldTransform().matrix(), self._b.source.wheels
        ahead = transform[:2, :2] @ wheels.forward
        origin = transform[:2, 3] + transform[:2, :2] @ wheels.origin
        return np.array([*origin, math.atan2(ahead[1], ahead[0])])

    def _touching(self) -> FloatArray:
        """(n,) 1 for each wheel that touches the ground."""
        transform = self._base.getWorldTransform().matrix()
        contacts = self.world.getLastCollisionResult().getContacts()
        points = np.array([c.point for c in contacts]).reshape(-1, 3)
        touched = np.zeros(len(self._patches))
        for point in points:
            local = transform[:3, :3].T @ (point - transform[:3, 3])
            touched[int(np.argmin([(local[0] - x) ** 2 + (local[1] - y) ** 2 for x, y, _ in self._patches]))] = 1.0
        return touched

    def _check(self, step: int) -> None:
        z = float(self._base.getWorldTransform().matrix()[2, 3])
        if not math.isfinite(z):
            raise SimulationError(f"simulator '{self._engine.name}': the state is no longer finite after time step {step}.")
        moved = z - self._height
        if abs(moved) > _LOST_M:
            what = "flies up" if moved > 0.0 else "falls through the ground"
            message = f"the robot {what}: {moved:+.1f} m in {step} time steps. Check its masses."
            raise SimulationError(f"simulator '{self._engine.name}': {message}")


def _ground() -> Any:
    ground = dart.dynamics.Skeleton("ground")
    _, node = ground.createWeldJointAndBodyNodePair()
    frame = node.createShapeNode(dart.dynamics.PlaneShape([0.0, 0.0, 1.0], 0.0))
    frame.createCollisionAspect()
    frame.createDynamicsAspect()
    frame.getDynamicsAspect().setFrictionCoeff(_GROUND_MU)
    return ground


def _hinge(axis: FloatArray, centre: FloatArray) -> Any:
    properties = dart.dynamics.RevoluteJointProperties()
    properties.mAxis = axis
    transform = np.eye(4)
    transform[:3, 3] = centre
    properties.mT_ParentBodyToJoint = dart.math.Isometry3(transform)
    return properties
