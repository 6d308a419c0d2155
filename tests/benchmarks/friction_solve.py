"""How long the friction model takes for one twist, beside `scipy.optimize.root` on the same equations.

python -m tests.benchmarks.friction_solve
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import root

from motion_models.compiled import kernel
from motion_models.friction import equilibrium
from motion_models.friction.contact import CREEP, loads
from motion_models.friction.equilibrium import Floor, Loads
from motion_models.friction.model import FrictionModel
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope

balance = kernel(equilibrium.balance)
THESIS_SECONDS = 70.0  # Ebersole 2016, Sec. 3.4


@dataclass(frozen=True)
class Timing:
    what: str
    microseconds: float
    """Median over the rounds, of one solution."""
    slowest: float
    """99th percentile over the cases [us]; nan where they were not timed one by one."""


def cases(rng: np.random.Generator, n: int, reach: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wheel rates (n, 2) of any direction, and CGs (n, 2) within ``reach`` (2,) of the centre."""
    return rng.uniform(-6.0, 6.0, (n, 2)), rng.uniform(-1.0, 1.0, (n, 2)) * reach


def median_time(call: Callable[[], object], n: int, rounds: int) -> float:
    """Microseconds for one of the ``n`` solutions of a ``call``."""
    call()
    taken = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        taken.append((time.perf_counter() - start) / n * 1e6)
    return float(np.median(taken))


def by_scipy(model: FrictionModel, wheels: FloatArray, cg: FloatArray, params: FloatArray, compiled: bool) -> FloatArray:
    """(3,) the twist of one case; the balance in numpy, or the model's own compiled one behind scipy's search."""
    floor = model.floor(params)
    share = loads(cg[0] / floor.half_wheelbase, cg[1] / floor.half_track, params[8])[:4]
    speed = params[0] * math.hypot(*wheels) / math.sqrt(2.0)
    roll = params[0] * wheels / speed
    start = [roll.mean(), 0.0, 0.27 * (roll[1] - roll[0]) / floor.half_track]
    if compiled:
        load = Loads(*share)
        answer = root(lambda v: balance(v[0], v[1], v[2], roll[0], roll[1], load, floor, CREEP)[:3], start)
    else:
        answer = root(_numpy_balance, start, args=(roll[[0, 1, 0, 1]], np.array(share), floor))
    return np.asarray(answer.x * speed) if answer.success else np.full(3, math.nan)


def _numpy_balance(v: FloatArray, roll: FloatArray, n: FloatArray, floor: Floor) -> list[float]:
    x = np.array([1.0, 1.0, -1.0, -1.0]) * floor.half_wheelbase
    y = np.array([1.0, -1.0, 1.0, -1.0]) * floor.half_track
    slip, drift = v[0] - y * v[2] - roll, v[1] + x * v[2]
    sliding = np.sqrt(slip**2 + drift**2 + CREEP**2)
    fastest = np.maximum(np.maximum(np.abs(slip + roll), np.abs(roll)), CREEP)
    factor = n * (1.0 - np.exp(-floor.tyre.stiffness * sliding / fastest)) / sliding
    fx, fy = -factor * slip - n * floor.drag * roll / np.hypot(roll, 0.02), -factor * drift
    return [fx.sum(), fy.sum(), (x * fy - y * fx).sum()]


def timings(rounds: int = 15) -> list[Timing]:
    robot = load_robot("vaultbot")
    model = FrictionModel.from_robot(robot)
    params = model.nominal
    rng = np.random.default_rng(0)
    found = []
    copies = np.ones((200, 1))  # one case many times over, so that the call around it does not count
    arms, anywhere = np.array([0.12, 0.05]), np.array([robot.geometry.wheelbase_m, robot.geometry.track_width_m]) / 2.0
    for where, reach in (("CG within the arms' reach", arms), ("CG anywhere on the wheelbase", anywhere)):
        wheels, cg = cases(rng, 1000, reach)
        typical = median_time(lambda w=wheels, c=cg: model.twist(w, c, params), 1000, rounds)  # type: ignore[misc]
        single = [median_time(lambda w=w, c=c: model.twist(copies * w, c, params), 200, 3) for w, c in zip(wheels, cg, strict=True)]  # type: ignore[misc]
        found.append(Timing(f"friction, twist and all derivatives, {where}", typical, float(np.percentile(single, 99))))
        command = model.twist(wheels, 0.9 * cg, params).value[:, [0, 2]]
        inverse = median_time(lambda c=command, g=0.9 * cg: model.wheels(c, g, params), 1000, rounds)  # type: ignore[misc]
        found.append(Timing(f"friction, inverse, {where}", inverse, math.nan))
    wheels, cg = cases(rng, 1000, arms)
    angle, steep = rng.uniform(-math.pi, math.pi, 1000), np.tan(np.radians(rng.uniform(0.0, 10.0, 1000)))
    slope = Slope(np.column_stack([steep * np.cos(angle), steep * np.sin(angle)]), robot.geometry.cg_height_m)
    tilted = median_time(lambda: model.twist_on_slope(wheels, cg, params, slope), 1000, rounds)
    found.insert(1, Timing("friction on slopes to 10 degrees, the same", tilted, math.nan))
    wheels, cg = cases(rng, 50, arms)
    for what, compiled in (("in numpy", False), ("compiled", True)):
        once = median_time(lambda k=compiled: [by_scipy(model, w, c, params, k) for w, c in zip(wheels, cg, strict=True)], 50, 5)  # type: ignore[misc]
        found.append(Timing(f"scipy.optimize.root, balance {what}, CG within the arms' reach", once, math.nan))
    return found


def main() -> None:
    table = timings()
    ours = table[0].microseconds
    print(f"{'one solution':66} {'median us':>10} {'p99 us':>8} {'ratio':>9}")
    for row in table:
        print(f"{row.what:66} {row.microseconds:10.2f} {row.slowest:8.1f} {row.microseconds / ours:8.1f}x")
    print(
        f"{'fsolve of the thesis, six unknowns (its Sec. 3.4)':66} {THESIS_SECONDS * 1e6:10.0f} {'':8} {THESIS_SECONDS * 1e6 / ours:8.0g}x"
    )


if __name__ == "__main__":
    main()
