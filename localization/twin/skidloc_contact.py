"""The contact law of skid-steer wheels for MuJoCo, in place of its Coulomb friction. Needs mujoco and numpy alone.

    import mujoco, mujoco.viewer
    import skidloc_contact

    model = mujoco.MjModel.from_xml_path("robot.xml")  # written beside this file
    skidloc_contact.attach(model)  # an mjcb_control; without it the wheels have no friction
    mujoco.viewer.launch(model)

Law: F = -mu N (1 - exp(-K |s| / V)) s / |s| with the slip s of the patch against the ground, the wheel's load N, and
V = max(|s_x + r q|, |r q|, creep), q the wheel's rate (shear displacement, Wong & Chiang 2001, Proc. IMechE D 215(3)). The file has mu, K,
mu_y / mu_x and creep in <numeric name="skidloc_contact">, and a site and a touch sensor skidloc_wheel_I for each wheel.

The law is stiff: its slope is 1e4 N s/m a wheel at a walk. F therefore follows the law over the time in which the slip adapts to it, as
a tyre's does over its relaxation length; where the motion is steady, F is exactly the law's.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

NAME = "skidloc_contact"
SITE = "skidloc_wheel_"
_LOAD_S = 0.02
"""Time constant of the loads' low-pass [s]: that of MuJoCo's default contacts."""
_LEVER = 2.5
"""Mobility of the patch under yaw and translation over that of the wheel's share of the mass alone."""


class ContactLaw:
    """Forces of all wheels of one robot; call it between `mj_step1` and `mj_step2`, or as ``mjcb_control``."""

    def __init__(self, model: Any) -> None:
        self.mu, self.stiffness, self.mu_ratio, self.creep = (float(v) for v in model.numeric(NAME).data[:4])
        count = sum(model.site(i).name.removeprefix(SITE).isdigit() for i in range(model.nsite))
        self._sites = [int(model.site(f"{SITE}{i}").id) for i in range(count)]
        self._loads_at = [int(model.sensor_adr[model.sensor(f"{SITE}{i}").id]) for i in range(count)]
        self._bodies = [int(model.site_bodyid[s]) for s in self._sites]
        self._joints = [int(model.body_jntadr[b]) for b in self._bodies]
        self._radii = [float(model.site_size[s, 0]) for s in self._sites]
        rotors = [float(model.dof_M0[model.jnt_dofadr[j]]) for j in self._joints]
        self._wheel_mobility = [radius**2 / max(rotor, 1e-6) for radius, rotor in zip(self._radii, rotors, strict=True)]
        self._reset(-1.0)

    def _reset(self, time: float) -> None:
        self._time = time
        self._loads = np.zeros(len(self._sites))
        self._forces = np.zeros((len(self._sites), 2))

    def __call__(self, model: Any, data: Any) -> None:
        """Set ``data.xfrc_applied`` of the wheels."""
        h = float(model.opt.timestep)
        is_first = not self._time < data.time <= self._time + 1.5 * h
        if is_first:
            self._reset(data.time)
        self._time = data.time
        keep = 0.0 if is_first else math.exp(-h / _LOAD_S)
        velocity = np.zeros(6)
        for i, (site, body, radius) in enumerate(zip(self._sites, self._bodies, self._radii, strict=True)):
            load = keep * self._loads[i] + (1.0 - keep) * float(data.sensordata[self._loads_at[i]])
            self._loads[i] = load
            if load <= 0.0:
                data.xfrc_applied[body] = 0.0
                self._forces[i] = 0.0
                continue
            ax, ay, _ = data.xaxis[self._joints[i]]
            norm = math.hypot(ax, ay) or 1.0
            fx, fy = ay / norm, -ax / norm  # ahead for a wheel whose axis points to the left
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
            wx, wy, _, vx, vy, _ = velocity
            px, py = vx - wy * radius, vy + wx * radius  # of the patch: v + w x (0, 0, -r)
            slip = px * fx + py * fy, -px * fy + py * fx
            along, across = self._force(i, slip, vx * fx + vy * fy - slip[0], h)
            gx, gy = along * fx - across * fy, along * fy + across * fx
            x, y, z = data.site_xpos[site] - data.xipos[body]
            z -= radius
            data.xfrc_applied[body] = (gx, gy, 0.0, -z * gy, z * gx, x * gy - y * gx)

    def _force(self, wheel: int, slip: tuple[float, float], roll: float, h: float) -> tuple[float, float]:
        """Force of one wheel along and across it [N] at its ``slip`` and rim's speed ``roll`` [m/s], after a time step ``h``."""
        load, total = self._loads[wheel], math.hypot(*slip)
        speed = max(abs(slip[0] + roll), abs(roll), self.creep)
        slope = self.mu * load * (-math.expm1(-self.stiffness * total / speed) / total if total > 1e-9 else self.stiffness / speed)
        mobility = _LEVER * 9.81 / load
        force = self._forces[wheel]
        force[0] += (-slope * slip[0] - force[0]) / (1.0 + slope * h * (mobility + self._wheel_mobility[wheel]))
        force[1] += (-slope * self.mu_ratio * slip[1] - force[1]) / (1.0 + slope * h * mobility)
        return float(force[0]), float(force[1])


def attach(model: Any) -> ContactLaw:
    """Make the law the model's control callback. Only one callback is active at a time: call the law from your own where you have one."""
    law = ContactLaw(model)
    mujoco.set_mjcb_control(law)
    return law
