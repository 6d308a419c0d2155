"""The dynamic form of Ebersole 2016, Ch. 3 (eqs. 3.15-3.26, signs mended): accelerations of a skidding robot, for simulation.

`model` gives the steady motion, this the transient: with mass, inertia, a CG that arms move, load that shifts under acceleration, and an
external force. Its steady state at constant wheel rates is the model's twist with the centripetal force, exactly for z_G = 0.

Mended against the thesis: (3.17, 3.24) rolling resistance opposes the wheel's rolling; (3.25) m a_y has the sign of (3.24)'s;
Appendix A's y_ddot_G_B has the signs of (3.19), and its inertia squares 0.43.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motion_models.compiled import kernel, subroutine
from motion_models.friction.contact import CREEP, contact, loads, rolling
from motion_models.friction.equilibrium import Floor
from motion_models.friction.model import FrictionModel, check_parameters, floor_of
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Triple
from motion_models.slope import GRAVITY

_THESIS_GYRATION_SQUARED = (0.43**2 + 0.27**2) / 12.0  # m^2; Appendix A's I / m
_CLOSURE_STEPS = 12
"""Most steps of Newton's method for the loads, linear but for lifting wheels: each lifts once at most."""


class _Body(NamedTuple):
    mu: float
    warp: float
    radius: float
    mass: float
    inertia: float
    height: float
    gravity: float
    creep: float
    rest_speed: float


@dataclass(frozen=True)
class Influence:
    """CG and external force: inputs besides the wheels."""

    cg: FloatArray
    """(2,) CG in the body frame [m]."""
    cg_velocity: FloatArray
    """(2,) its velocity in the body frame, by the arms [m/s]."""
    cg_acceleration: FloatArray
    """(3,) its acceleration in the body frame, by the arms; z up [m/s^2]."""
    force: FloatArray
    """(3,) external force, as on a gripper, in the body frame [N]."""
    at: FloatArray
    """(3,) where it acts, in the body frame, z above the floor [m]."""

    @classmethod
    def of_cg(cls, cg: FloatArray) -> Influence:
        """A CG that rests in the body, and no force."""
        return cls(np.asarray(cg, dtype=np.float64), np.zeros(2), np.zeros(3), np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class FrictionDynamics:
    """The robot as a rigid body on four skidding wheels whose rates are given."""

    params: FloatArray
    """(12,) as `FrictionModel.param_names`; the tracked point is not used."""
    mass: float
    """[kg]"""
    inertia: float
    """Yaw inertia about the CG [kg m^2]."""
    cg_height: float
    """z_G above the floor [m]."""
    saturation: float = 0.0
    """Contact law, as `FrictionModel.saturation`."""
    gravity: float = GRAVITY
    """[m/s^2]"""
    creep: float = CREEP
    """Slip at which friction saturates, as a fraction of the wheels' speed. Ten times the creep allows ten times as long steps."""
    rest_speed: float = 0.01
    """Speed that takes the place of the wheels' where they stand still [m/s]."""

    @classmethod
    def from_robot(cls, robot: Robot, inertia: float | None = None) -> FrictionDynamics:
        """The robot's friction parameters and mass; its inertia is the thesis's per mass unless given [kg m^2]."""
        g = robot.geometry
        inertia = g.mass_kg * _THESIS_GYRATION_SQUARED if inertia is None else inertia
        model = FrictionModel.from_robot(robot)
        return cls(model.nominal, g.mass_kg, inertia, g.cg_height_m, model.saturation)

    def longest_step(self, speed: float) -> float:
        """Step [s] beyond which Runge-Kutta may become unstable while the wheels roll at ``speed`` [m/s] or more.

        A wheel without slip resists as stiffly as mu m g / (creep speed) against motion, and with its lever arm against the turn. Under the
        isotropic law that holds only for wheels that stand still: where all roll, a step 1 / (creep slip_stiffness) as long is stable.
        """
        mu, track, wheelbase = self.params[3] * max(1.0, self.params[4]), self.params[1], self.params[2]
        lever = max(1.0, self.mass * (track**2 + wheelbase**2) / 4.0 / self.inertia)
        return float(2.0 * self.creep * max(speed, self.rest_speed) / (mu * self.gravity * lever))

    def accelerations(self, wheels: FloatArray, twist: FloatArray, influence: Influence) -> tuple[FloatArray, float]:
        """Rate of change (3,) of ``twist`` (3,), both of the wheelbase's centre in the body frame, at wheel rates ``wheels`` (2,).

        Also the tipping margin: how far the loads are from leaving all wheels of one side or axle, 1 for evenly loaded wheels. Where it
        is negative the robot tips over, and the accelerations are those of a robot held upright. Raises what `FrictionModel` does.
        """
        check_parameters(influence.cg, self.params)
        state = np.array([0.0, 0.0, 0.0, *twist])
        ax, ay, aw, margin = _accelerations(state, wheels[0], wheels[1], self._influence(influence), self._floor(), self._body())
        return np.array([ax, ay, aw]), margin

    def advance(self, state: FloatArray, dt: float, steps: int, wheels: FloatArray, influence: Influence) -> tuple[FloatArray, float]:
        """The state (6,), pose in the world and twist in the body, after ``dt`` seconds in ``steps`` Runge-Kutta steps of fourth order.

        Wheel rates and the CG's acceleration are constant meanwhile; the CG moves on by them. Also the smallest tipping margin.
        """
        check_parameters(influence.cg, self.params)
        after = np.array(state, dtype=np.float64)
        margin = _advance(after, dt, steps, wheels[0], wheels[1], self._influence(influence), self._floor(), self._body())
        return after, margin

    def _floor(self) -> Floor:
        return floor_of(self.params, self.saturation)

    def _body(self) -> _Body:
        mu, warp, radius = float(self.params[3]), float(self.params[8]), float(self.params[0])
        return _Body(mu, warp, radius, self.mass, self.inertia, self.cg_height, self.gravity, self.creep, self.rest_speed)

    def _influence(self, influence: Influence) -> FloatArray:
        return np.concatenate([influence.cg, influence.cg_velocity, influence.cg_acceleration, influence.force, influence.at]).astype(float)


class _WheelSums(NamedTuple):
    """Forces of the four wheels per mu and load, summed with the signs in which the loads depend on 1, xi, eta and the diagonal term."""

    x: tuple[float, float, float, float]
    """Along x."""
    y: tuple[float, float, float, float]
    """Along y."""
    m: tuple[float, float, float, float]
    """Yaw moment about the CG [m]."""


@subroutine
def _wheel_sums(
    vx: float, vy: float, wz: float, rolls: tuple[float, float], cg: tuple[float, float], floor: Floor, creep: float
) -> _WheelSums:
    """Contact forces at the twist and wheel speeds, both over the wheels' speed."""
    x_0 = x_xi = x_eta = x_t = y_0 = y_xi = y_eta = y_t = m_0 = m_xi = m_eta = m_t = 0.0
    for left in (True, False):
        sign_y, roll = (1.0, rolls[0]) if left else (-1.0, rolls[1])
        y = sign_y * floor.half_track
        slip = vx - y * wz - roll
        for ahead in (True, False):
            sign_x = 1.0 if ahead else -1.0
            x = sign_x * floor.half_wheelbase
            f = contact(slip, vy + x * wz, roll, floor.tyre, creep)
            fx, fy = f.x - floor.drag * rolling(roll)[0], f.y  # 3.17
            m = (x - cg[0]) * fy - (y - cg[1]) * fx
            x_0, x_xi, x_eta, x_t = x_0 + fx, x_xi + sign_x * fx, x_eta + sign_y * fx, x_t + sign_x * sign_y * fx
            y_0, y_xi, y_eta, y_t = y_0 + fy, y_xi + sign_x * fy, y_eta + sign_y * fy, y_t + sign_x * sign_y * fy
            m_0, m_xi, m_eta, m_t = m_0 + m, m_xi + sign_x * m, m_eta + sign_y * m, m_t + sign_x * sign_y * m
    return _WheelSums((x_0, x_xi, x_eta, x_t), (y_0, y_xi, y_eta, y_t), (m_0, m_xi, m_eta, m_t))


@subroutine
def _weighted(sums: tuple[float, float, float, float], xi: float, eta: float, t: float) -> float:
    """Sum of the wheels' forces at loads (1, ``xi``, ``eta``, ``t``)."""
    return sums[0] + sums[1] * xi + sums[2] * eta + sums[3] * t


@subroutine
def _shifted_loads(xi_0: float, eta_0: float, lean_x: float, lean_y: float, warp: float, sums: _WheelSums) -> tuple[float, float]:
    """xi and eta of loads that shift under the acceleration which they cause: 3.21-3.23 with 3.24 and 3.25, linear until a wheel lifts.

    ``xi_0, eta_0`` are those without friction; ``lean_x, lean_y`` are mu z_G over four half wheelbases and half tracks. Newton's method;
    where all load is on one axle or side, of the other direction alone.
    """
    xi, eta = _inside(xi_0), _inside(eta_0)
    for _ in range(_CLOSURE_STEPS):
        _, _, _, _, t, t_xi, t_eta = loads(xi, eta, warp)
        off_x = xi - xi_0 + lean_x * _weighted(sums.x, xi, eta, t)
        off_y = eta - eta_0 + lean_y * _weighted(sums.y, xi, eta, t)
        a, b = 1.0 + lean_x * (sums.x[1] + sums.x[3] * t_xi), lean_x * (sums.x[2] + sums.x[3] * t_eta)
        c, d = lean_y * (sums.y[1] + sums.y[3] * t_xi), 1.0 + lean_y * (sums.y[2] + sums.y[3] * t_eta)
        whole = 1.0 / (a * d - b * c)
        new_xi = _inside(xi - whole * (d * off_x - b * off_y))
        new_eta = _inside(eta - whole * (a * off_y - c * off_x))
        if abs(new_xi) == 1.0:
            new_eta = _inside(eta - (off_y + c * (new_xi - xi)) / d)
        elif abs(new_eta) == 1.0:
            new_xi = _inside(xi - (off_x + b * (new_eta - eta)) / a)
        moved = abs(new_xi - xi) + abs(new_eta - eta)
        xi, eta = new_xi, new_eta
        if moved < 1e-14:
            break
    return xi, eta


class Inputs(NamedTuple):
    """Numbers of an `Influence`, for compiled loops."""

    x: float
    """CG in the body frame [m]."""
    y: float
    dx: float
    """Its velocity in the body frame [m/s]."""
    dy: float
    ddx: float
    """Its acceleration in the body frame [m/s^2]."""
    ddy: float
    ddz: float
    f_x: float
    """External force in the body frame [N]."""
    f_y: float
    f_z: float
    p_x: float
    """Where it acts, in the body frame [m]."""
    p_y: float
    p_z: float


@kernel
def _accelerations(
    state: FloatArray, q_l: float, q_r: float, influence: FloatArray, floor: Floor, body: _Body
) -> tuple[float, float, float, float]:
    """Rates of vx, vy, wz and the tipping margin. ``influence`` (13,) holds the fields of `Influence` in their order."""
    i = influence
    inputs = Inputs(i[0], i[1], i[2], i[3], i[4], i[5], i[6], i[7], i[8], i[9], i[10], i[11], i[12])
    return accelerations((state[3], state[4], state[5]), (q_l, q_r), inputs, floor, body)


@subroutine
def accelerations(
    twist: Triple, wheels: tuple[float, float], inputs: Inputs, floor: Floor, body: _Body
) -> tuple[float, float, float, float]:
    """Rates of vx, vy, wz at a ``twist`` of the wheelbase's centre and rates of the left and right ``wheels``, and the tipping margin."""
    vx, vy, w = twist
    q_l, q_r = wheels
    mu, mass, inertia, height, rest, radius = body.mu, body.mass, body.inertia, body.height, body.rest_speed, body.radius
    x_g, y_g, dx_g, dy_g, ddx_g, ddy_g, ddz_g, f_x, f_y, f_z, p_x, p_y, p_z = inputs
    speed = math.sqrt(0.5 * radius * radius * (q_l * q_l + q_r * q_r) + rest * rest)
    wz = w / speed
    rolls = (radius * q_l / speed, radius * q_r / speed)
    sums = _wheel_sums(vx / speed, vy / speed, wz, rolls, (x_g, y_g), floor, body.creep)

    weight = mass * (body.gravity + ddz_g)
    load = weight - f_z  # 3.21
    xi_0 = (weight * x_g + (p_z - height) * f_x - p_x * f_z) / (load * floor.half_wheelbase)  # 3.23, a_x without friction
    eta_0 = (weight * y_g + (p_z - height) * f_y - p_y * f_z) / (load * floor.half_track)  # 3.22
    lean_x, lean_y = 0.25 * mu * height / floor.half_wheelbase, 0.25 * mu * height / floor.half_track
    xi, eta = _shifted_loads(xi_0, eta_0, lean_x, lean_y, body.warp, sums)
    _, _, _, _, t, _, _ = loads(xi, eta, body.warp)
    grip = 0.25 * mu * load
    force_x, force_y = grip * _weighted(sums.x, xi, eta, t), grip * _weighted(sums.y, xi, eta, t)
    moment = grip * _weighted(sums.m, xi, eta, t)
    spin = wz * floor.half_track
    moment -= mu * load * floor.scrub * spin / math.sqrt(spin * spin + body.creep * body.creep)
    lean = abs(xi_0 - height * force_x / (load * floor.half_wheelbase)), abs(eta_0 - height * force_y / (load * floor.half_track))

    a_x, a_y = (force_x + f_x) / mass, (force_y + f_y) / mass  # 3.24, 3.25
    alpha = (moment + (p_x - x_g) * f_y - (p_y - y_g) * f_x) / inertia  # 3.26
    base_x = a_x - ddx_g + y_g * alpha + 2.0 * dy_g * w + x_g * w * w  # 3.18
    base_y = a_y - ddy_g - x_g * alpha - 2.0 * dx_g * w + y_g * w * w  # 3.19
    return base_x + vy * w, base_y - vx * w, alpha, 1.0 - max(lean)


@subroutine
def _inside(share: float) -> float:
    """``share``, or the edge of the wheelbase where it lies beyond."""
    return min(1.0, max(-1.0, share))


@kernel
def _advance(state: FloatArray, dt: float, steps: int, q_l: float, q_r: float, influence: FloatArray, floor: Floor, body: _Body) -> float:
    """Change ``state`` (6,) in place; the smallest tipping margin."""
    h, margin = dt / steps, math.inf
    now, trial, total, rate = influence.copy(), np.empty(6), np.empty(6), np.zeros(6)
    for i in range(steps):
        total[:] = 0.0
        for stage in range(4):
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            for j in range(6):
                trial[j] = state[j] + ahead * rate[j]
            t = i * h + ahead
            for j in range(2):  # the CG moves on
                now[j] = influence[j] + t * (influence[2 + j] + 0.5 * t * influence[4 + j])
                now[2 + j] = influence[2 + j] + t * influence[4 + j]
            c, s = math.cos(trial[2]), math.sin(trial[2])
            rate[0], rate[1], rate[2] = c * trial[3] - s * trial[4], s * trial[3] + c * trial[4], trial[5]
            rate[3], rate[4], rate[5], left = _accelerations(trial, q_l, q_r, now, floor, body)
            margin = min(margin, left)
            for j in range(6):
                total[j] += rate[j] * (1.0 if stage == 0 or stage == 3 else 2.0)
        for j in range(6):
            state[j] += h / 6.0 * total[j]
    return margin
