"""The friction model: wheel rates and centre of gravity in, twist out, in microseconds (Ebersole 2016, Ch. 3, forward), and its inverse.

The thesis solved for wheel rates and four loads at a wanted twist: six equations, 70 s, and underdetermined, as three equations do not
determine four loads. Here equally stiff wheels determine the loads, and the three balances of a steady motion are solved. Without the
centripetal force, twice the wheel rates are twice the twist: neither speed nor mass matters.

For the inverse the balance is solved for the wheels' speeds and the sideways motion that go with a forward speed and a turn: three
equations again, by Newton's method. Where it does not converge, a root of one unknown is bracketed: without a centripetal force the
balance does not depend on speed, so the command is an angle (turning against forward speed), and so are the wheels' speeds (difference
against sum). The first increases with the second, so a bracket always exists; the speed follows by scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motion_models.base import ModelBase, ModelWrapper, MotionModel
from motion_models.compiled import kernel, subroutine
from motion_models.errors import CgError, ModelError
from motion_models.friction.contact import CREEP, SATURATION, loads, tyre
from motion_models.friction.equilibrium import (
    COLUMNS,
    Balance,
    Floor,
    Loads,
    Steady,
    balance,
    motion,
    newton,
    reduced,
    sensitivities,
)
from motion_models.linear_equations import Matrix3, solve_3x3
from motion_models.motion import Twist
from motion_models.param import CENTRE_X_SIGMA_M, CENTRE_Y_SIGMA_M, Free, Param, Scale, Traits
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Triple
from motion_models.slope import GRAVITY, Slope, SlopeTwist

STIFFNESS: Mapping[str, float] = {"isotropic": 10.0, "thesis": 13.333}
"""slip_stiffness by contact law where a robot's file names none: Appendix A's, and 10 from `tests.studies.contact_law`."""
CENTRIPETAL = False
"""Whether the centripetal force is modelled where a robot's file does not choose."""
BoolArray = NDArray[np.bool_]
_POSITIVE = slice(0, 6)
_FLAT = np.empty((0, 3))

_MAX_EVALUATIONS = 40
"""Evaluations of the balance before the angle is enclosed instead."""
_CONVERGED = 1e-7
"""Step of Newton's method [1], after which one more changes nothing: it squares the error."""
_BALANCED = 1e-9
"""Error of the angle [rad] up to which an enclosed solution counts."""
_ENCLOSING = 40
"""Steps of up to 0.4 rad towards the goal: more than a whole turn."""
_CLOSING = 100
"""Most steps of Chandrupatla's method, at worst halves: down to rounding from any interval."""
_CLOSE_ANGLE = 1e-14
"""Rounding of an angle [rad]."""
_MIN_STEP = 1e-3
"""Least step of the centripetal force, as a share of it."""
_MU_RATIO_SIGMA = 0.3
_WARP_SIGMA = 0.15
"""VaultBot's chassis, as its rotations show it, moves 13 % of m g / 4 to two opposite wheels."""
_NOT_STRAIGHT = 0.02
"""`Traits.min_track_over_radius`: on straight motion the two sides differ by noise alone, which would be taken for information."""
_CG_OFFSETS = (
    Param("cg_offset_x", "m", "true centre of gravity ahead of the given one", Scale(0.1, wheelbase=1), CENTRE_X_SIGMA_M, forms=()),
    Param("cg_offset_y", "m", "true centre of gravity left of the given one", Scale(0.05, track_width=1), CENTRE_Y_SIGMA_M, forms=()),
)
_MIN_MU_RATIO = 0.05  # -; castors and free rollers
_MAX_CG = 0.98  # -; of half the wheelbase and half the track, where the robot tips over


class _Constants(NamedTuple):
    """What the loops read beside wheels, CG and parameters."""

    saturation: float
    centripetal: float
    """0 or 1."""
    slope: FloatArray
    """(n, 3) `Slope.downhill` and the CG's height for each sample; (0, 3) on level ground."""
    d_slope: FloatArray
    """(n, 3, 3) to be filled with the twists' derivatives by them."""


@dataclass(frozen=True)
class FrictionModel(ModelBase):
    """Quasi-static skidding on four wheels. Parameters, in the order of `param_names`:

    wheel_radius [m]; track_width, wheelbase [m]: distances between the contacts; mu [-]: friction along x; mu_ratio [-]: across / along;
    slip_stiffness [-]: K of the contact law; rolling_resistance [-]: f_r of 3.17; scrub [m]: yaw moment that the contact patches oppose to
    any turn, over mu m g; warp [-]: load that a twisted chassis moves onto the front left and rear right wheels, over m g / 4; tread [-]:
    how much more the wheels grip when they slide to the left than to the right (half the difference over the mean); tracked_x, tracked_y
    [m]: the point whose motion is reported, 0 for the wheelbase's centre; split_friction [-]: grip of the left wheels less that of the
    right ones, over their mean. Only rolling_resistance and the centripetal force depend on mu.

    The twist at exactly still wheels is exactly zero. Its derivative there is that of the rounded law (see `contact`), as no other
    exists. Where soft tyres (slip_stiffness below about 3) allow several motions for one pair of wheel rates, it is one of them.
    """

    nominal: FloatArray
    """(13,) the parameters."""
    saturation: float = 0.0
    """Contact law: 0 isotropic, 1 the thesis's, between them a mixture (see `contact`)."""
    centripetal: bool = False
    """Balance the forces with the acceleration of the CG on its circle, too. The motion then depends on speed, and a sample may have none:
    above 2 m/s with the CG almost over a wheel, for commands beyond mu g, and for some in a thousand near the reversal of a wheel."""
    name: ClassVar[str] = "friction"
    params: ClassVar[tuple[Param, ...]] = (
        Param("wheel_radius", "m", "how far the robot drives per radian of its wheels", Scale(0.3, wheel_radius=1), free=Free(logs=3)),
        Param("track_width", "m", "distance of the left and right contacts", Scale(0.3, track_width=1), free=Free(rotations=3)),
        Param("wheelbase", "m", "distance of the front and rear contacts", Scale(0.3, wheelbase=1)),
        Param("mu", "1", "friction along the wheels", Scale(0.5)),
        Param("mu_ratio", "1", "friction across the wheels over that along them", Scale(0.5), _MU_RATIO_SIGMA, free=Free(logs=1, turns=1)),
        Param("slip_stiffness", "1", "slope of the contact law at zero slip", Scale(5.0)),
        Param("rolling_resistance", "1", "rolling resistance over load", Scale(0.02)),
        Param("scrub", "m", "yaw moment of the contact patches over mu m g", Scale(0.1, track_width=1), free=Free(rotations=4)),
        Param(
            "warp",
            *("1", "load on the front left and rear right wheels by a twisted chassis, over m g / 4", Scale(0.15), _WARP_SIGMA),
            *("", ("cg_field",), Free(rotations=2)),
        ),
        Param("tread", "1", "how much more the wheels grip when they slide to the left than to the right", Scale(0.1)),
        Param(
            "tracked_x",
            "m",
            "tracked point ahead of the wheelbase's middle",
            Scale(0.1, wheelbase=1),
            CENTRE_X_SIGMA_M,
            free=Free(logs=2, rotations=1),
        ),
        Param("tracked_y", "m", "tracked point left of the wheelbase's middle", Scale(0.05, track_width=1), CENTRE_Y_SIGMA_M),
        Param("split_friction", "1", "grip of the left wheels less that of the right ones, over their mean", Scale(0.1)),
    )
    traits: ClassVar[Traits] = Traits(
        options=("contact", "centripetal"), is_level=True, min_track_over_radius=_NOT_STRAIGHT, correction_params=_CG_OFFSETS
    )

    @classmethod
    def from_robot(cls, robot: Robot) -> FrictionModel:
        """The robot's geometry with the constants of Ebersole 2016, Appendix A, and `STIFFNESS` where its [models.friction] has no other.

        Raises `RobotError` for a contact law that does not exist.
        """
        g = robot.geometry
        law = robot.choice(cls.name, "contact", tuple(SATURATION), "isotropic")
        defaults = [g.wheel_radius_m, g.track_width_m, g.wheelbase_m, 0.9, 1.0, STIFFNESS[law], 0.0263, *(0.0,) * 6]
        nominal = robot.coefficients(cls.name, cls.param_names, np.array(defaults))
        return cls(nominal, SATURATION[law], robot.switch(cls.name, "centripetal", CENTRIPETAL))

    def with_correction_params(self) -> MotionModel:
        """See `MotionModel.with_correction_params`: with the CG's offset, `CorrectedFriction`."""
        return CorrectedFriction(self)

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`.

        Raises `CgError` for a CG that is not between the wheels and `ModelError` for parameters that no robot can have.
        """
        return self._solved(_twist, wheels, cg, params).twist

    def twist_on_slope(self, wheels: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope) -> SlopeTwist:
        """`twist` on tilted ground: gravity's part along the ground acts at the CG, and the loads are those of the CG's projection along
        gravity. Without a tilt it is `twist`.

        Raises what `twist` does, `CgError` for a slope on which the robot tips over, `ModelError` for one that friction does not hold.
        """
        check_slope(cg, params, slope)
        return self._solved(_twist, wheels, cg, params, slope)

    def find_on_slope(self, wheels: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope) -> SlopeTwist:
        """`twist_on_slope` without its errors: samples at or beyond the limits of slopes are NaN."""
        beyond = np.logical_or(*slope_limits(cg, params, slope))
        down = np.where(beyond[..., None], 0.0, slope.downhill)
        found = self._solve(_twist, wheels, cg, params, Slope(down, slope.cg_height))
        found.twist.value[np.broadcast_to(beyond, found.twist.value.shape[:-1])] = math.nan
        return found

    def interpret_twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """`twist` without compiled code, for a few samples once: 0.5 ms each, where compiling takes 8 s."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._solved(_solve_samples, wheels, cg, params).twist

    def _solved(
        self, loop: Callable[..., None], wheels: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope | None = None
    ) -> SlopeTwist:
        """`_solve`. Raises `ModelError` where a sample has no solution."""
        found = self._solve(loop, wheels, cg, params, slope)
        unsolved = np.isnan(found.twist.value[..., 2]) & np.isfinite(np.asarray(wheels)).all(axis=-1)
        if np.any(unsolved):
            at = {name: float(value) for name, value in zip(self.param_names, params, strict=True)}
            raise ModelError(
                f"no balance of forces found for {np.count_nonzero(unsolved)} of {unsolved.size} samples, with parameters {at}."
                + (" The slope is at the limit of what friction holds." if slope is not None else "")
            )
        return found

    def _solve(
        self, loop: Callable[..., None], wheels: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope | None = None
    ) -> SlopeTwist:
        check_parameters(cg, params)
        lead = np.broadcast_shapes(wheels.shape[:-1], cg.shape[:-1])
        on = _FLAT if slope is None else slope.samples(lead)
        constants = _Constants(self.saturation, float(self.centripetal), on, np.zeros((len(on), 3, 3)))

        def solve(wheels: FloatArray, cg: FloatArray, params: FloatArray, _: FloatArray, *out: FloatArray) -> None:
            loop(wheels, cg, params, constants, *out)

        twist = Twist.from_kernel(solve, np.empty(0), wheels, cg, params)
        by = constants.d_slope.reshape(*lead, 3, 3) if slope is not None else np.zeros((*lead, 3, 3))
        return SlopeTwist(twist, by[..., :2], by[..., 2])

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`.

        Where friction all but holds the robot, the rates are very high. Raises what `twist` raises, and `ModelError` for a command that
        no wheel rates give.
        """
        return self._rates(command, cg, params, None)

    def wheels_on_slope(self, command: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope) -> FloatArray:
        """`wheels` on tilted ground, see `twist_on_slope`; raises what that and `wheels` do."""
        check_slope(cg, params, slope)
        return self._rates(command, cg, params, slope)

    def _rates(self, command: FloatArray, cg: FloatArray, params: FloatArray, slope: Slope | None) -> FloatArray:
        check_parameters(cg, params)
        lead = np.broadcast_shapes(command.shape[:-1], cg.shape[:-1])
        flat = [np.array(np.broadcast_to(a, (*lead, 2)), dtype=np.float64, order="C").reshape(-1, 2) for a in (command, cg)]
        rates = np.zeros((math.prod(lead), 2))
        on = _FLAT if slope is None else slope.samples(lead)
        constants = _Constants(self.saturation, float(self.centripetal), on, np.empty((0, 3, 3)))
        _wheels(flat[0], flat[1], np.array(params, dtype=np.float64), constants, rates)
        unsolved = np.isnan(rates).any(axis=-1) & np.isfinite(flat[0]).all(axis=-1)
        if np.any(unsolved):
            (vx, wz), (x, y) = flat[0][unsolved][0], flat[1][unsolved][0]
            raise ModelError(
                f"no wheel rates found for vx = {vx:.3g} m/s, wz = {wz:.3g} rad/s with the centre of gravity at ({x:.3f}, {y:.3f}) m: "
                "friction holds this robot. Check for a rolling_resistance above mu, too large mu_ratio or scrub, a CG at a side, a slope."
            )
        return rates.reshape(*lead, 2)

    def floor(self, params: FloatArray) -> Floor:
        """What the balance depends on, with ``params`` (13,)."""
        return floor_of(np.asarray(params, dtype=np.float64), self.saturation)


def check_parameters(cg: FloatArray, params: FloatArray) -> None:
    """Raises `ModelError` for parameters (13,) that no robot can have and `CgError` for a CG in ``cg`` (..., 2) outside its wheels."""
    names = FrictionModel.param_names
    if not np.isfinite(params).all() or np.any(params[_POSITIVE] <= 0) or abs(params[9]) >= 1 or abs(params[12]) >= 2:
        found = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, params, strict=True))
        raise ModelError(
            f"friction: {', '.join(names[_POSITIVE])} must be positive and tread within -1 and 1, "
            f"split_friction within -2 and 2; found {found}."
        )
    half = params[[2, 1]] / 2.0
    outside = ~(np.abs(cg) < half).all(axis=-1)  # also if it is not a number
    if np.any(outside):
        x, y = np.reshape(cg, (-1, 2))[np.reshape(outside, -1)][0]
        raise CgError(
            f"centre of gravity at x = {x:.3f}, y = {y:.3f} m, but the wheels stand at x = +-{half[0]:.3f}, y = +-{half[1]:.3f} m: "
            "this robot tips over. Check the centre of gravity, and wheelbase and track_width."
        )


@dataclass(frozen=True)
class CorrectedFriction(ModelWrapper):
    """`FrictionModel` with two more parameters, cg_offset_x and cg_offset_y [m]: the true CG less the given one.

    Values outside the valid range (CG beyond the wheels, mu_ratio < 0.05) are clipped; their derivative is zero.
    """

    inner: FrictionModel
    params: ClassVar[tuple[Param, ...]] = (*FrictionModel.params, *_CG_OFFSETS)

    @property
    def nominal(self) -> FloatArray:
        """(15,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `FrictionModel.twist`."""
        clipped, shifted, is_free = _clip_to_valid(cg, params)
        found = self.inner.twist(wheels, shifted, clipped)
        d_cg = found.d_cg * is_free[..., None, :]
        d_params = np.concatenate([found.d_params, d_cg], axis=-1)
        if clipped[4] != params[4]:  # mu_ratio
            d_params[..., 4] = 0.0
        return Twist(found.value, found.d_wheels, d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `FrictionModel.wheels`."""
        clipped, shifted, _ = _clip_to_valid(cg, params)
        return self.inner.wheels(command, shifted, clipped)


def _clip_to_valid(cg: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters (13,) and CG (..., 2) within their valid ranges, and 1 where the CG (..., 2) is not clipped, else 0."""
    clipped = params[:-2].copy()
    clipped[4] = max(clipped[4], _MIN_MU_RATIO)
    check_parameters(cg, clipped)
    edge = 0.5 * _MAX_CG * clipped[[2, 1]]
    moved = cg + params[-2:]
    return clipped, np.clip(moved, -edge, edge), (np.abs(moved) < edge).astype(float)


def check_slope(cg: FloatArray, params: FloatArray, slope: Slope) -> None:
    """Raises `CgError` where a robot with a CG in ``cg`` (..., 2) tips over on ``slope``, `ModelError` where it slides down by itself."""
    tips, slides = slope_limits(cg, params, slope)
    found = tips | slides
    if not found.any():
        return
    down = np.broadcast_to(slope.downhill, (*found.shape, 2))[found].reshape(-1, 2)[0]
    angle = f"a slope of {math.degrees(math.atan(math.hypot(*down))):.1f} deg (downhill {down[0]:+.3f} ahead, {down[1]:+.3f} to the left)"
    if not np.isfinite(down).all():
        raise ModelError(f"the slope is {down.tolist()}; it must be finite, with the vertical above the robot.")
    if tips.any():
        raise CgError(
            f"{angle} takes the line of gravity of a CG {slope.cg_height:.2f} m high beyond the wheels: this robot tips over. "
            "Check cg_height_m, the centre of gravity and the tilt."
        )
    raise ModelError(
        f"{angle} is steeper than friction holds (mu {params[3]:.2f}: {math.degrees(math.atan(params[3])):.1f} deg): this robot slides "
        "down without its wheels turning. Check mu and the tilt."
    )


def slope_limits(cg: FloatArray, params: FloatArray, slope: Slope) -> tuple[BoolArray, BoolArray]:
    """Whether the robot tips over, and whether it slides down with still wheels, for each sample (...,) of CG and slope."""
    down = np.asarray(slope.downhill, dtype=float)
    stands = (np.abs(cg + slope.cg_height * down) < params[[2, 1]] / 2.0).all(axis=-1)
    across = params[3] * params[4]
    holds = np.hypot(down[..., 0] / params[3], down[..., 1] / across) < 1.0
    tips = np.asarray(np.logical_not(stands))  # also if it is not a number
    return tips, np.broadcast_to(np.logical_not(holds), tips.shape)


def _solve_samples(
    wheels: FloatArray,
    cg: FloatArray,
    params: FloatArray,
    constants: _Constants,
    value: FloatArray,
    d_wheels: FloatArray,
    d_cg: FloatArray,
    d_params: FloatArray,
) -> None:
    """See `Twist.from_kernel`. A sample without a solution becomes NaN."""
    slope, d_slope = constants.slope, constants.d_slope
    has_slope = slope.shape[0] > 0
    radius, mu, warp, tracked_x, tracked_y = params[0], params[3], params[8], params[10], params[11]
    floor, split = floor_of(params, constants.saturation), params[12]
    by = np.empty((3, COLUMNS))
    for i in range(wheels.shape[0]):
        speed, roll_l, roll_r = unit_rolls(radius, wheels[i, 0], wheels[i, 1])
        a_x, a_y, height = (slope[i, 0], slope[i, 1], slope[i, 2]) if has_slope else (0.0, 0.0, 0.0)
        x, y, t = gripped(cg[i, 0], cg[i, 1], warp, split, floor)
        load, tilt = loads_at(x, y, t, floor, pull_of(speed, mu, constants.centripetal), (a_x, a_y, height), mu)
        vx, vy, wz, found = motion(roll_l, roll_r, load, floor)
        if not found:
            value[i] = d_wheels[i] = d_cg[i] = d_params[i] = math.nan
            continue
        sensitivities(Steady(vx, vy, wz, roll_l, roll_r), load, tilt, floor, by, has_slope)

        # The tracked point moves with the body; so do the derivatives.
        for j in range(COLUMNS):
            by[0, j] -= tracked_y * by[2, j]
            by[1, j] += tracked_x * by[2, j]
        point = (vx - wz * tracked_y, vy + wz * tracked_x, wz)
        d_params[i, 1, 10], d_params[i, 0, 11] = wz * speed, -wz * speed

        # Back from unit speed, which is radius sqrt((q_l^2 + q_r^2) / 2) and so depends on the wheels too.
        xi, eta = (x + height * a_x) / floor.half_wheelbase, (y + height * a_y) / floor.half_track
        for k in range(3):
            pulled, leaning = by[k, 12] * load.pull, by[k, 15] * load.slope_x + by[k, 16] * load.slope_y
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
            d_params[i, k, 3] = -(by[k, 9] * floor.drag + (pulled + leaning)) / mu * speed
            d_params[i, k, 4] = by[k, 8] * speed
            d_params[i, k, 5] = by[k, 7] * speed
            d_params[i, k, 6] = by[k, 9] / mu * speed
            d_params[i, k, 7] = by[k, 10] * speed
            d_params[i, k, 8] = by[k, 4] * speed
            d_params[i, k, 9] = by[k, 11] * speed
            if has_slope:
                _fill_by_slope(by[k], (by_xi, by_eta), (a_x, a_y, height), pulled * speed, (speed, mu), d_slope[i, k])
        _by_given_load(cg[i], (x, y, t), split, floor, d_cg[i], d_params[i])


_twist = kernel(_solve_samples)


@subroutine
def _fill_by_slope(
    by: FloatArray, by_load: tuple[float, float], slope: Triple, pulled: float, unit: tuple[float, float], out: FloatArray
) -> None:
    """Fill ``out`` (3,) with the derivative of one component of the twist by gravity along x and y over that across, and the CG's height.

    ``by`` (17,) of the balance at unit speed, ``by_load`` of the load's centre along x and y [m], ``unit`` speed [m/s] and friction.
    """
    (by_xi, by_eta), (a_x, a_y, height), (speed, mu) = by_load, slope, unit
    steeper = pulled / (1.0 + a_x * a_x + a_y * a_y)
    out[0] = by_xi * height + by[15] * speed / mu + steeper * a_x
    out[1] = by_eta * height + by[16] * speed / mu + steeper * a_y
    out[2] = by_xi * a_x + by_eta * a_y


@subroutine
def floor_of(params: FloatArray, saturation: float) -> Floor:
    """The parameters (13,) that the balance depends on, with the contact law of ``saturation``."""
    mu, mu_ratio, stiffness, rolling_resistance, scrub = params[3], params[4], params[5], params[6], params[7]
    return Floor(params[1] / 2.0, params[2] / 2.0, tyre(stiffness, mu_ratio, params[9], saturation), rolling_resistance / mu, scrub)


@subroutine
def gripped(x: float, y: float, warp: float, split: float, floor: Floor) -> tuple[float, float, float]:
    """Centre of the contact forces [m] and their warp where left wheels grip ``split`` more than right ones, over the mean of both.

    A contact's force goes with its load times its friction. With g = split / 2, loads (1 + sx xi + sy eta + sx sy t) / 4 as in
    `motion_models.friction.contact.loads` times (1 + sy g) have the same form: xi' = (xi + g t) / n, eta' = (eta + g) / n and
    t' = (t + g xi) / n with n = 1 + g eta.
    """
    if split == 0.0:
        return x, y, warp
    g = 0.5 * split
    n = 1.0 + g * y / floor.half_track
    return (x + g * warp * floor.half_wheelbase) / n, (y + g * floor.half_track) / n, (warp + g * x / floor.half_wheelbase) / n


@subroutine
def _by_given_load(
    cg: FloatArray, grip: tuple[float, float, float], split: float, floor: Floor, d_cg: FloatArray, d_params: FloatArray
) -> None:
    """Turn the derivatives ``d_cg`` (3, 2) and ``d_params`` (3, 13) by the centre of the forces and their warp, ``grip``, into those by
    the ``cg`` (2,) and the warp that are given; and fill that by split_friction. See `gripped`."""
    (x, y, t), g, hw, ht = grip, 0.5 * split, floor.half_wheelbase, floor.half_track
    xi, eta = cg[0] / hw, cg[1] / ht
    warp = t * (1.0 + g * eta) - g * xi
    n = 1.0 + g * eta
    for k in range(3):
        by_x, by_y, by_t = d_cg[k, 0], d_cg[k, 1], d_params[k, 8]
        by_n = -(by_x * x + by_y * y + by_t * t) / n
        d_cg[k, 0] = (by_x + by_t * g / hw) / n
        d_cg[k, 1] = by_y / n + by_n * g / ht
        d_params[k, 8] = (by_t + by_x * g * hw) / n
        d_params[k, 2] += 0.5 * (by_x * g * warp - by_t * g * xi / hw) / n
        d_params[k, 1] += 0.5 * (by_y * g / n - by_n * g * eta / ht)
        d_params[k, 12] = 0.5 * ((by_x * warp * hw + by_y * ht + by_t * xi) / n + by_n * eta)


@subroutine
def unit_rolls(radius: float, q_l: float, q_r: float) -> tuple[float, float, float]:
    """Root mean square of the wheels' speeds [m/s], and the speeds of left and right over it (0 where both stand)."""
    speed = radius * math.hypot(q_l, q_r) * math.sqrt(0.5)
    if speed == 0.0:
        return 0.0, 0.0, 0.0
    return speed, radius * q_l / speed, radius * q_r / speed


@subroutine
def pull_of(speed: float, mu: float, centripetal: float) -> float:
    """`Loads.pull` at a speed of the wheels [m/s]; ``centripetal`` is 0 or 1."""
    return centripetal * speed * speed / (mu * GRAVITY)


@subroutine
def loads_at(
    x: float, y: float, warp: float, floor: Floor, pull: float, slope: tuple[float, float, float] = (0.0, 0.0, 0.0), mu: float = 1.0
) -> tuple[Loads, tuple[float, float, float]]:
    """The loads with the CG at ``x, y`` [m], and the derivatives of their diagonal term by xi, eta and warp (see `contact.loads`).

    On a ``slope``, `Slope.downhill` and the CG's height [m], the loads are those of the CG's projection along gravity, and gravity normal
    to the ground, which friction is measured against, is less.
    """
    a_x, a_y, height = slope
    fl, fr, rl, rr, t, t_xi, t_eta = loads((x + height * a_x) / floor.half_wheelbase, (y + height * a_y) / floor.half_track, warp)
    pull *= math.sqrt(1.0 + a_x * a_x + a_y * a_y)
    return Loads(fl, fr, rl, rr, x, y, pull, a_x / mu, a_y / mu), (t_xi, t_eta, 1.0 if t == warp else 0.0)


@kernel
def _wheels(command: FloatArray, cg: FloatArray, params: FloatArray, constants: _Constants, rates: FloatArray) -> None:
    """Fill ``rates`` (n, 2) for ``command`` (n, 2) and ``cg`` (n, 2)."""
    slope = constants.slope
    radius, mu, warp, tracked_y = params[0], params[3], params[8], params[11]
    floor = floor_of(params, constants.saturation)
    unit, split = pull_of(1.0, mu, constants.centripetal), params[12]
    for i in range(command.shape[0]):
        on = (slope[i, 0], slope[i, 1], slope[i, 2]) if slope.shape[0] > 0 else (0.0, 0.0, 0.0)
        x, y, t = gripped(cg[i, 0], cg[i, 1], warp, split, floor)
        load, _ = loads_at(x, y, t, floor, unit, on, mu)
        wz = command[i, 1]
        roll_l, roll_r = rolls_for(command[i, 0] + wz * tracked_y, wz, load, floor)
        rates[i, 0], rates[i, 1] = roll_l / radius, roll_r / radius


@subroutine
def rolls_for(vx: float, wz: float, load: Loads, floor: Floor) -> tuple[float, float]:
    """Speeds [m/s] at which the left and right wheels have to roll for ``vx`` [m/s] and ``wz`` [rad/s]; NaN if there are none.

    ``load.pull`` is that of wheels at 1 m/s.
    """
    commanded = math.hypot(vx, floor.half_track * wz)
    if commanded == 0.0:
        return 0.0, 0.0
    to_x, to_w = vx / commanded, wz / commanded
    unit = load.pull * commanded * commanded
    angle, drift, share = _linear_start(to_x, to_w, load, floor)
    angle, drift, share, found = _solve(angle, drift, share, to_x, to_w, unit, load, floor)
    if not found:
        angle, drift, share, found = _enclosed(to_x, to_w, load, floor)
        if found and unit != 0.0:
            angle, drift, share, found = _pulled(angle, drift, share, to_x, to_w, unit, load, floor)
    if not found:
        return math.nan, math.nan
    speed = commanded / share
    return speed * (math.cos(angle) - math.sin(angle)), speed * (math.cos(angle) + math.sin(angle))


@subroutine
def _linear_start(to_x: float, to_w: float, load: Loads, floor: Floor) -> tuple[float, float, float]:
    """What `_solve` starts from: the inverse of `equilibrium.linear_motion`."""
    x = floor.half_wheelbase * (load.fl + load.fr - load.rl - load.rr)
    y = floor.half_track * (load.fl + load.rl - load.fr - load.rr)
    arm = floor.half_track * floor.half_track + floor.half_wheelbase * floor.half_wheelbase - x * x - y * y
    forward = to_x - to_w * y  # left + right, then left - right of the rolls weighted by load
    apart = (y * forward - arm * to_w) / floor.half_track
    heavy_l, heavy_r = max(load.fl + load.rl, 1e-3), max(load.fr + load.rr, 1e-3)
    roll_l, roll_r = 0.5 * (forward + apart) / heavy_l, 0.5 * (forward - apart) / heavy_r
    size = math.sqrt(0.5 * (roll_l * roll_l + roll_r * roll_r))
    return math.atan2(roll_r - roll_l, roll_r + roll_l), -to_w * x / size, 1.0 / size


@subroutine
def _solve(
    angle: float, drift: float, share: float, to_x: float, to_w: float, unit: float, load: Loads, floor: Floor
) -> tuple[float, float, float, bool]:
    """Newton's method for the wheels' angle (0 rolls straight on, pi/2 turns on the spot), vy and the motion's share of the wheels' speed.

    The motion is ``share`` times ``to_x, to_w``; ``unit`` is the pull at a share of 1.
    """
    d_angle = d_drift = d_share = 0.0
    fraction, left = 1.0, math.inf
    arm = floor.half_track
    for _ in range(_MAX_EVALUATIONS):
        a, v, r = angle + fraction * d_angle, drift + fraction * d_drift, share + fraction * d_share
        c, s = math.cos(a), math.sin(a)
        pulled = reduced(load, 1.0, unit / (r * r))
        b = balance(r * to_x, v, r * to_w, c - s, c + s, pulled, floor, CREEP)
        now = b.x * b.x + b.y * b.y + b.m * b.m / (arm * arm)
        if r > 0.0 and (now < (1.0 - 1e-4 * fraction) * left or now < 1e-26):
            angle, drift, share, left = a, v, r, now
            d_angle, d_drift, d_share = _step(b, c, s, v, r, to_x, to_w, pulled)
            size = max(abs(d_angle), abs(d_drift), abs(d_share))
            if size < _CONVERGED:
                return angle + d_angle, drift + d_drift, share + d_share, True
            fraction = min(1.0, 0.5 / size)
        else:
            fraction *= 0.4
            if fraction < 1e-3:
                break
    return angle, drift, share, False


@subroutine
def _step(b: Balance, c: float, s: float, v: float, r: float, to_x: float, to_w: float, load: Loads) -> tuple[float, float, float]:
    """The step in angle, vy and share that balances in first order."""
    by_l, by_r = -s - c, c - s
    x_a, y_a, m_a = b.x_left * by_l + b.x_right * by_r, b.y_left * by_l + b.y_right * by_r, b.m_left * by_l + b.m_right * by_r
    x_r, y_r, m_r = b.x_vx * to_x + b.x_wz * to_w, b.y_vx * to_x + b.y_wz * to_w, b.m_vx * to_x + b.m_wz * to_w
    if load.pull != 0.0:  # which grows with the wheels' speed, and that with 1 / share
        p, vx, w, gx, gy = -2.0 * load.pull / r, r * to_x, r * to_w, load.cg_x, load.cg_y
        x_r += p * (v + gx * w) * w
        y_r -= p * (vx - gy * w) * w
        m_r -= p * (gx * vx + gy * v) * w
    x_v, y_v, m_v = b.x_vy, b.y_vy, b.m_vy
    return solve_3x3(Matrix3(x_a, x_v, x_r, y_a, y_v, y_r, m_a, m_v, m_r), -b.x, -b.y, -b.m)


@subroutine
def _pulled(
    angle: float, drift: float, share: float, to_x: float, to_w: float, unit: float, load: Loads, floor: Floor
) -> tuple[float, float, float, bool]:
    """`_solve` by continuation, from the solution without a centripetal force."""
    reached, step = 0.0, 0.3
    while reached < 1.0:
        trial = min(reached + step, 1.0)
        a, v, r, found = _solve(angle, drift, share, to_x, to_w, trial * unit, load, floor)
        if found:
            angle, drift, share, reached = a, v, r, trial
            step *= 2.0
        else:
            step *= 0.3
            if step < _MIN_STEP:
                return angle, drift, share, False
    return angle, drift, share, True


@subroutine
def _enclosed(to_x: float, to_w: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:
    """Angle, vy and share without a centripetal force, by enclosing the angle.

    That force alone depends on the speed: friction and a slope's pull are those of any wheels at the same angle.
    """
    still = reduced(load, 1.0, 0.0)
    goal = math.atan2(floor.half_track * to_w, to_x)

    # Enclose: from a robot whose wheels slip away half of the turn, towards the goal until beyond it.
    low = math.atan2(2.0 * floor.half_track * to_w, to_x)
    error, x, y, w = _miss(low, goal, math.nan, 0.0, 0.0, still, floor)
    step = -math.copysign(min(1.5 * abs(error) + 1e-6, 0.4), error)
    high, error_high = low, error
    for _ in range(_ENCLOSING):
        if abs(error_high) < _CLOSE_ANGLE or error_high * error < 0.0:
            break
        low, error = high, error_high
        high = low + step
        error_high, x, y, w = _miss(high, goal, x, y, w, still, floor)
        step = math.copysign(min(2.0 * abs(step), 0.4), step)
    else:
        return math.nan, math.nan, math.nan, False
    if abs(error_high) < _CLOSE_ANGLE:
        low, error = high, error_high

    # Close in: secants, and halves where they are slow (Brent's method in the form of Chandrupatla, 1997).
    other, error_other = low, error
    fraction = 0.5
    for _ in range(_CLOSING):
        if abs(error) < _CLOSE_ANGLE or abs(high - low) < 4e-16 * (1.0 + abs(low)):
            break
        middle = low + fraction * (high - low)
        error_middle, x, y, w = _miss(middle, goal, x, y, w, still, floor)
        if math.isnan(error_middle):
            return math.nan, math.nan, math.nan, False
        if (error_middle > 0.0) == (error > 0.0):
            other, error_other = low, error
        else:
            other, error_other = high, error_high
            high, error_high = low, error
        low, error = middle, error_middle
        width = abs(high - low)
        xi, phi = (low - high) / (other - high), (error - error_high) / (error_other - error_high)
        if phi * phi < xi and (1.0 - phi) * (1.0 - phi) < 1.0 - xi:
            fraction = error / (error_high - error) * error_other / (error_high - error_other)
            fraction += (other - low) / (high - low) * error / (error_other - error) * error_high / (error_other - error_high)
            least = 1e-15 / width
            fraction = min(1.0 - least, max(least, fraction)) if least < 0.5 else 0.5
        else:
            fraction = 0.5
    return low, y, math.hypot(x, floor.half_track * w), abs(error) < _BALANCED


@subroutine
def _miss(angle: float, goal: float, x: float, y: float, w: float, load: Loads, floor: Floor) -> tuple[float, float, float, float]:
    """Angle of the motion of wheels at ``angle``, less ``goal``, and their twist.

    The search starts at the twist ``x, y, w`` of an angle nearby, unless it is NaN.
    """
    c, s = math.cos(angle), math.sin(angle)
    found = False
    if not math.isnan(x):
        x, y, w, found = newton(x, y, w, c - s, c + s, load, floor, CREEP)
    if not found:
        x, y, w, found = motion(c - s, c + s, load, floor)
    if not found:
        return math.nan, x, y, w
    miss = math.atan2(floor.half_track * w, x) - goal
    return miss - 2.0 * math.pi * math.floor(miss / (2.0 * math.pi) + 0.5), x, y, w
