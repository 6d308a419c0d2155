"""Contact laws that compete with the shipped one, in plain numpy: force laws, load transfer and stiffness ratios that robots do not need.

A second implementation of the balance in `motion_models.friction` (without tread, and for robots with all wheels on the floor), for
`tests.studies.contact_law`, and the second way to the shipped model's numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from motion_models.friction import FrictionModel
from motion_models.motion import Twist
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_STEPS = 60
_HALVINGS = 12
_DIFFERENCE = 1e-7
_SMALL = 1e-3  # slip and wheel speed are rounded over this share of the wheels' speed, as in the shipped model
_ROLLING = 0.02
_X, _Y = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1.0, -1.0, 1.0, -1.0])


def exponential(z: FloatArray) -> FloatArray:
    """Wong & Chiang 2001, and 3.15 of Ebersole 2016: 1 - exp(-z)."""
    return np.asarray(1.0 - np.exp(-z))


def brush(z: FloatArray) -> FloatArray:
    """Parabolic pressure over the contact's length (Pacejka, ch. 3): all of it slides from z = 3 on."""
    return np.asarray(np.where(z < 3.0, z - z**2 / 3.0 + z**3 / 27.0, 1.0))


def tanh(z: FloatArray) -> FloatArray:
    """A smooth law without a theory."""
    return np.asarray(np.tanh(z))


SHAPES: Mapping[str, Callable[[FloatArray], FloatArray]] = {"exponential": exponential, "brush": brush, "tanh": tanh}


@dataclass(frozen=True)
class RivalFriction:
    """`FrictionModel` by another law of the total slip."""

    nominal: FloatArray
    """(13,) as `FrictionModel.param_names`."""
    shape: str = "exponential"
    stiffness_ratio: float = 1.0
    """Lateral over longitudinal stiffness at small slip; sliding friction stays isotropic."""
    centripetal: bool = False
    cg_height: float = 0.0
    """Of the CG [m]: the centripetal force then shifts load to the outer wheels."""
    differentiated: tuple[str, ...] = ()
    """Parameters whose derivatives `twist` fills."""
    name: str = "friction"
    param_names: tuple[str, ...] = FrictionModel.param_names

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`; without derivatives by wheels and CG."""
        value = self._solve(wheels, cg, params)
        d_params = np.zeros((*value.shape, len(params)))
        for name in self.differentiated:
            step = 1e-5 * np.eye(len(params))[self.param_names.index(name)]
            above, below = (self._solve(wheels, cg, params + sign * step) for sign in (1.0, -1.0))
            d_params[..., self.param_names.index(name)] = (above - below) / 2e-5
        none = np.zeros((*value.shape, 2))
        return Twist(value, none, none, d_params)

    def _solve(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """(..., 3) twists, by Newton's method on differences with a line search."""
        lead = np.broadcast_shapes(wheels.shape[:-1], cg.shape[:-1])
        q, g = (np.broadcast_to(a, (*lead, 2)).reshape(-1, 2) for a in (wheels, cg))
        radius, track, wheelbase = params[:3]
        speed = radius * np.sqrt(np.mean(q**2, axis=1))
        moves = speed > 0.0
        out = np.zeros((len(q), 3))
        speed, g, roll = speed[moves], g[moves], radius * q[moves] / speed[moves, None]
        k = 1.0 / (track**2 + wheelbase**2) * track
        v = np.stack([roll.mean(axis=1), np.zeros(len(roll)), k * (roll[:, 1] - roll[:, 0])], axis=-1)
        left = self._balance(v, roll, g, speed, params)
        for _ in range(_STEPS):
            steps = _DIFFERENCE * np.eye(3)
            jacobian = np.stack([(self._balance(v + e, roll, g, speed, params) - left) / _DIFFERENCE for e in steps], axis=-1)
            step = -np.linalg.solve(jacobian, left[..., None])[..., 0]
            share = np.ones(len(v))
            size = np.sum(left**2, axis=1)
            for _ in range(_HALVINGS):
                trial = v + share[:, None] * step
                after = self._balance(trial, roll, g, speed, params)
                worse = ~(np.sum(after**2, axis=1) <= size)
                if not worse.any():
                    break
                share = np.where(worse, 0.4 * share, share)
            v, left = np.where(worse[:, None], v, trial), np.where(worse[:, None], left, after)
            if np.max(np.abs(share[:, None] * step)) < 1e-9 or np.all(size < 1e-22):
                break
        if np.any(np.abs(left) > 1e-6):
            raise RuntimeError(f"no balance of forces found by {self.shape}: {np.abs(left).max():.2g} is left.")
        vx, vy, wz = v.T
        out[moves] = np.stack([vx - wz * params[11], vy + wz * params[10], wz], axis=-1) * speed[:, None]
        return out.reshape(*lead, 3)

    def _balance(self, v: FloatArray, roll: FloatArray, cg: FloatArray, speed: FloatArray, p: FloatArray) -> FloatArray:
        """(n, 3) forces and yaw moment over mu m g."""
        half_track, half_base, mu, mu_ratio, stiffness = p[1] / 2.0, p[2] / 2.0, p[3], p[4], p[5]
        vx, vy, wz = (v[:, i : i + 1] for i in range(3))
        x, y, u = _X * half_base, _Y * half_track, roll[:, [0, 1, 0, 1]]
        pull = self.centripetal * (speed**2 / (mu * GRAVITY))[:, None]
        a_x, a_y = -(vy + cg[:, :1] * wz) * wz * pull, (vx - cg[:, 1:] * wz) * wz * pull  # of the CG, over mu g
        xi, eta = (cg[:, :1] - self.cg_height * mu * a_x) / half_base, (cg[:, 1:] - self.cg_height * mu * a_y) / half_track
        n = np.maximum(1.0 + _X * xi + _Y * eta + _X * _Y * p[8], 0.0) / 4.0
        s_x, s_y = vx - y * wz - u, vy + x * wz
        size = np.sqrt(s_x**2 + s_y**2 + _SMALL**2)
        fastest = np.maximum(np.maximum(np.abs(s_x + u), np.abs(u)), _SMALL)
        factor = SHAPES[self.shape](stiffness * size / fastest)
        lateral = mu_ratio * (1.0 + (self.stiffness_ratio - 1.0) * (1.0 - factor))
        f_x, f_y = -n * factor * s_x / size, -n * factor * lateral * s_y / size
        f_x = f_x - n * p[6] / mu * u / np.sqrt(u**2 + _ROLLING**2)
        spin = wz[:, 0] * half_track
        moment = (x * f_y - y * f_x).sum(axis=1) - p[7] * spin / np.sqrt(spin**2 + _SMALL**2)
        moment = moment - (cg[:, 0] * a_y[:, 0] - cg[:, 1] * a_x[:, 0])
        return np.stack([f_x.sum(axis=1) - a_x[:, 0], f_y.sum(axis=1) - a_y[:, 0], moment], axis=-1)
