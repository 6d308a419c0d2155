"""The friction model: wheel rates and centre of gravity in, twist out, in microseconds (Ebersole 2016, Ch. 3, solved forward).

The thesis asked for wheel rates and four loads at a wanted twist: six equations that took its solver 70 s, for three equations do not
determine four loads. Here the chassis closes that gap (equally stiff wheels), and what is solved are the three balances of a steady
motion. Without the centripetal force, twice the wheel rates are twice the twist: neither speed nor mass matters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np

from motion_models.base import Twist
from motion_models.errors import CgError, ModelError
from motion_models.friction.contact import SATURATION, loads, tyre
from motion_models.friction.equilibrium import COLUMNS, Floor, Loads, Steady, motion, sensitivities
from motion_models.friction.inverse import rolls_for
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

GRAVITY = 9.81
"""[m/s^2]"""
STIFFNESS: Mapping[str, float] = {"isotropic": 10.0, "thesis": 13.333}
"""slip_stiffness by contact law where a robot's file names none: Appendix A's, and 10 from `tests.studies.contact_law`."""
CENTRIPETAL = False
"""Whether the centripetal force is modelled where a robot's file does not choose."""
_POSITIVE = slice(0, 6)


@dataclass(frozen=True)
class FrictionModel:
    """Quasi-static skidding on four wheels. Parameters, in the order of `param_names`:

    wheel_radius [m]; track_width, wheelbase [m]: distances between the contacts; mu [-]: friction along x; mu_ratio [-]: across / along;
    slip_stiffness [-]: K of the contact law; rolling_resistance [-]: f_r of 3.17; scrub [m]: yaw moment that the contact patches oppose to
    any turn, over mu m g; warp [-]: load that a twisted chassis moves onto the front left and rear right wheels, over m g / 4; tread [-]:
    how much more the wheels grip when they slide to the left than to the right (half the difference over the mean); tracked_x, tracked_y
    [m]: the point whose motion is reported, 0 for the wheelbase's centre. Only rolling_resistance and the centripetal force depend on mu.

    The twist at exactly still wheels is exactly zero. Its derivative there is that of the rounded law (see `contact`), as no other
    exists. Where soft tyres (slip_stiffness below about 3) allow several motions for one pair of wheel rates, it is one of them.
    """

    nominal: FloatArray
    """(12,) the parameters."""
    saturation: float = 0.0
    """Contact law: 0 isotropic, 1 the thesis's, between them a mixture (see `contact`)."""
    centripetal: bool = False
    """Balance the forces with the acceleration of the CG on its circle, too. The motion then depends on speed, and a sample may have none:
    above 2 m/s with the CG almost over a wheel, for commands beyond mu g, and for some in a thousand near the reversal of a wheel."""
    name: ClassVar[str] = "friction"
    param_names: ClassVar[tuple[str, ...]] = (
        *("wheel_radius", "track_width", "wheelbase", "mu", "mu_ratio", "slip_stiffness"),
        *("rolling_resistance", "scrub", "warp", "tread", "tracked_x", "tracked_y"),
    )

    @classmethod
    def from_robot(cls, robot: Robot) -> FrictionModel:
        """The robot's geometry with the constants of Ebersole 2016, Appendix A, and `STIFFNESS` where its [models.friction] has no other.

        Raises `RobotError` for a contact law that does not exist.
        """
        g = robot.geometry
        law = robot.choice(cls.name, "contact", tuple(SATURATION), "isotropic")
        defaults = [g.wheel_radius_m, g.track_width_m, g.wheelbase_m, 0.9, 1.0, STIFFNESS[law], 0.0263, 0.0, 0.0, 0.0, 0.0, 0.0]
        nominal = robot.coefficients(cls.name, cls.param_names, np.array(defaults))
        return cls(nominal, SATURATION[law], robot.switch(cls.name, "centripetal", CENTRIPETAL))

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`.

        Raises `CgError` for a CG that is not between the wheels and `ModelError` for parameters that no robot can have.
        """
        check_parameters(cg, params)
        twist = Twist.from_kernel(_twist, self._constants(), wheels, cg, params)
        unsolved = np.isnan(twist.value[..., 2]) & np.isfinite(np.asarray(wheels)).all(axis=-1)
        if np.any(unsolved):
            at = {name: float(value) for name, value in zip(self.param_names, params, strict=True)}
            raise ModelError(
                f"no balance of forces found for {np.count_nonzero(unsolved)} of {unsolved.size} samples, with parameters {at}."
            )
        return twist

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`: what the thesis could not solve for.

        A robot that the floor holds still creeps around at absurdly high rates, and these are then returned. Raises what `twist` raises,
        and `ModelError` for a command that no wheel rates lead to.
        """
        check_parameters(cg, params)
        lead = np.broadcast_shapes(command.shape[:-1], cg.shape[:-1])
        flat = [np.array(np.broadcast_to(a, (*lead, 2)), dtype=np.float64, order="C").reshape(-1, 2) for a in (command, cg)]
        rates = np.zeros((math.prod(lead), 2))
        _wheels(flat[0], flat[1], np.array(params, dtype=np.float64), self._constants(), rates)
        unsolved = np.isnan(rates).any(axis=-1) & np.isfinite(flat[0]).all(axis=-1)
        if np.any(unsolved):
            (vx, wz), (x, y) = flat[0][unsolved][0], flat[1][unsolved][0]
            raise ModelError(
                f"no wheel rates found for vx = {vx:.3g} m/s, wz = {wz:.3g} rad/s with the centre of gravity at ({x:.3f}, {y:.3f}) m: "
                "the floor holds this robot too firmly. Is rolling_resistance above mu, mu_ratio or scrub too large, the CG over a side?"
            )
        return rates.reshape(*lead, 2)

    def floor(self, params: FloatArray) -> Floor:
        """What the balance depends on, with ``params`` (12,)."""
        return floor_of(np.asarray(params, dtype=np.float64), self.saturation)

    def _constants(self) -> FloatArray:
        return np.array([self.saturation, float(self.centripetal)])


def check_parameters(cg: FloatArray, params: FloatArray) -> None:
    """Raises `ModelError` for parameters (12,) that no robot can have and `CgError` for a CG in ``cg`` (..., 2) outside its wheels."""
    names = FrictionModel.param_names
    if not np.isfinite(params).all() or np.any(params[_POSITIVE] <= 0) or abs(params[9]) >= 1:
        found = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, params, strict=True))
        raise ModelError(f"friction: {', '.join(names[_POSITIVE])} must be positive and tread within -1 and 1; found {found}.")
    half = params[[2, 1]] / 2.0
    outside = ~(np.abs(cg) < half).all(axis=-1)  # also if it is not a number
    if np.any(outside):
        x, y = np.reshape(cg, (-1, 2))[np.reshape(outside, -1)][0]
        raise CgError(
            f"centre of gravity at x = {x:.3f}, y = {y:.3f} m, but the wheels stand at x = +-{half[0]:.3f}, y = +-{half[1]:.3f} m: "
            "this robot tips over. Check the centre of gravity, and wheelbase and track_width."
        )


@numba.njit(cache=True, error_model="numpy")
def _twist(
    wheels: FloatArray,
    cg: FloatArray,
    params: FloatArray,
    constants: FloatArray,
    value: FloatArray,
    d_wheels: FloatArray,
    d_cg: FloatArray,
    d_params: FloatArray,
) -> None:
    """See `Twist.from_kernel`; ``constants`` (2,) are saturation and centripetal. A sample without a solution becomes NaN."""
    radius, mu, warp, tracked_x, tracked_y = params[0], params[3], params[8], params[10], params[11]
    floor = floor_of(params, constants[0])
    by = np.empty((3, COLUMNS))
    for i in range(wheels.shape[0]):
        speed, roll_l, roll_r = unit_rolls(radius, wheels[i, 0], wheels[i, 1])
        load, tilt = loads_at(cg[i, 0], cg[i, 1], warp, floor, pull_of(speed, mu, constants[1]))
        vx, vy, wz, found = motion(roll_l, roll_r, load, floor)
        if not found:
            value[i] = d_wheels[i] = d_cg[i] = d_params[i] = math.nan
            continue
        sensitivities(Steady(vx, vy, wz, roll_l, roll_r), load, tilt, floor, by)

        # The tracked point moves with the body; so do the derivatives.
        for j in range(COLUMNS):
            by[0, j] -= tracked_y * by[2, j]
            by[1, j] += tracked_x * by[2, j]
        point = (vx - wz * tracked_y, vy + wz * tracked_x, wz)
        d_params[i, 1, 10], d_params[i, 0, 11] = wz * speed, -wz * speed

        # Back from unit speed, which is radius sqrt((q_l^2 + q_r^2) / 2) and so depends on the wheels too.
        xi, eta = cg[i, 0] / floor.half_wheelbase, cg[i, 1] / floor.half_track
        for k in range(3):
            pulled = by[k, 12] * load.pull
            along = 0.5 * (point[k] - by[k, 0] * roll_l - by[k, 1] * roll_r) + pulled
            value[i, k] = point[k] * speed
            d_wheels[i, k, 0] = radius * (by[k, 0] + roll_l * along)
            d_wheels[i, k, 1] = radius * (by[k, 1] + roll_r * along)
            by_xi, by_eta = by[k, 2] * speed / floor.half_wheelbase, by[k, 3] * speed / floor.half_track
            d_cg[i, k, 0] = by_xi + by[k, 13] * speed
            d_cg[i, k, 1] = by_eta + by[k, 14] * speed
            d_params[i, k, 0] = (point[k] + 2.0 * pulled) * speed / radius
            d_params[i, k, 1] = 0.5 * (by[k, 5] * speed - eta * by_eta)
            d_params[i, k, 2] = 0.5 * (by[k, 6] * speed - xi * by_xi)
            d_params[i, k, 3] = -(by[k, 9] * floor.drag + pulled) / mu * speed
            d_params[i, k, 4] = by[k, 8] * speed
            d_params[i, k, 5] = by[k, 7] * speed
            d_params[i, k, 6] = by[k, 9] / mu * speed
            d_params[i, k, 7] = by[k, 10] * speed
            d_params[i, k, 8] = by[k, 4] * speed
            d_params[i, k, 9] = by[k, 11] * speed


@numba.njit(cache=True, error_model="numpy")
def floor_of(params: FloatArray, saturation: float) -> Floor:
    """The parameters (12,) that the balance depends on, with the contact law of ``saturation``."""
    mu, mu_ratio, stiffness, rolling_resistance, scrub = params[3], params[4], params[5], params[6], params[7]
    return Floor(params[1] / 2.0, params[2] / 2.0, tyre(stiffness, mu_ratio, params[9], saturation), rolling_resistance / mu, scrub)


@numba.njit(cache=True, error_model="numpy")
def unit_rolls(radius: float, q_l: float, q_r: float) -> tuple[float, float, float]:
    """Root mean square of the wheels' speeds [m/s], and the speeds of left and right over it (0 where both stand)."""
    speed = radius * math.hypot(q_l, q_r) * math.sqrt(0.5)
    if speed == 0.0:
        return 0.0, 0.0, 0.0
    return speed, radius * q_l / speed, radius * q_r / speed


@numba.njit(cache=True, error_model="numpy")
def pull_of(speed: float, mu: float, centripetal: float) -> float:
    """`Loads.pull` at a speed of the wheels [m/s]; ``centripetal`` is 0 or 1."""
    return centripetal * speed * speed / (mu * GRAVITY)


@numba.njit(cache=True, error_model="numpy")
def loads_at(x: float, y: float, warp: float, floor: Floor, pull: float) -> tuple[Loads, tuple[float, float, float]]:
    """The loads with the CG at ``x, y`` [m], and the derivatives of their diagonal term by xi, eta and warp (see `contact.loads`)."""
    fl, fr, rl, rr, t, t_xi, t_eta = loads(x / floor.half_wheelbase, y / floor.half_track, warp)
    return Loads(fl, fr, rl, rr, x, y, pull), (t_xi, t_eta, 1.0 if t == warp else 0.0)


@numba.njit(cache=True, error_model="numpy")
def _wheels(command: FloatArray, cg: FloatArray, params: FloatArray, constants: FloatArray, rates: FloatArray) -> None:
    """Fill ``rates`` (n, 2) for ``command`` (n, 2) and ``cg`` (n, 2)."""
    radius, mu, warp, tracked_y = params[0], params[3], params[8], params[11]
    floor = floor_of(params, constants[0])
    unit = pull_of(1.0, mu, constants[1])
    for i in range(command.shape[0]):
        load, _ = loads_at(cg[i, 0], cg[i, 1], warp, floor, unit)
        wz = command[i, 1]
        roll_l, roll_r = rolls_for(command[i, 0] + wz * tracked_y, wz, load, floor)
        rates[i, 0], rates[i, 1] = roll_l / radius, roll_r / radius
