"""A robot file as MJCF: a box of its mass on four wheels with velocity servos, on a plane, with MuJoCo's default contacts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.twin.xml_file import XmlFile, parse
from motion_models.robot import Robot

WHEEL_MASS_SHARE = 0.02
"""Mass of a wheel over that of the robot: a Husky's weighs 2.6 kg of 46 to 119."""
HALF_WIDTH = 0.3
"""Half the width of a wheel over its radius (a Husky's 0.05 m over 0.165 m)."""
GYRATION = (0.12, 0.15, 0.18)
"""Moments of inertia of the body over its mass [m^2] on a wheelbase of 0.5 m: a Husky's with two arms."""
REFERENCE_WHEELBASE_M = 0.5
_ARMATURE = 1.5
"""Inertia of a motor behind its gears over the wheel's mass times its radius squared."""


def mjcf_of(robot: Robot) -> XmlFile:
    """MJCF of ``robot``, whose body frame is on the ground between the wheels; as one would write it by hand, with default contacts."""
    g = robot.geometry
    r, mass = g.wheel_radius_m, g.mass_kg
    wheel = WHEEL_MASS_SHARE * mass
    body = mass - 4.0 * wheel
    cg = (np.array([g.cg_x_m, g.cg_y_m, g.cg_height_m]) * mass - 4.0 * wheel * np.array([0.0, 0.0, r])) / body
    inertia = np.array(GYRATION) * body * (g.wheelbase_m / REFERENCE_WHEELBASE_M) ** 2
    names = wheel_names(robot)
    wheels = "".join(
        f"""
      <body name="{name}_body" pos="{_n(px)} {_n(py)} {_n(r)}">
        <joint name="{name}" type="hinge" axis="0 1 0" armature="{_n(_ARMATURE * wheel * r * r)}"/>
        <geom name="{name}_tyre" type="cylinder" size="{_n(r)} {_n(HALF_WIDTH * r)}" euler="90 0 0" mass="{_n(wheel)}"/>
      </body>"""
        for name, (px, py) in zip(names, places(robot), strict=True)
    )
    servos = "".join(f'\n    <velocity name="{name}_servo" joint="{name}" kv="{_n(mass * 9.81 * r)}"/>' for name in names)
    text = f"""<mujoco model="{robot.name}">
  <compiler angle="degree"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base_link">
      <freejoint/>
      <inertial pos="{" ".join(map(_n, cg))}" mass="{_n(body)}" diaginertia="{" ".join(map(_n, inertia))}"/>{wheels}
    </body>
  </worldbody>
  <actuator>{servos}
  </actuator>
</mujoco>
"""
    return parse({f"{robot.name}.xml": text.encode()}, Path(f"{robot.name}.xml"))


def wheel_names(robot: Robot) -> list[str]:
    """Names of four wheels' joints: front left, rear left, front right, rear right."""
    return [*_two(robot.joints.left, "left"), *_two(robot.joints.right, "right")]


def places(robot: Robot) -> list[tuple[float, float]]:
    """Where they are, ahead and left of the middle between them [m]."""
    x, y = 0.5 * robot.geometry.wheelbase_m, 0.5 * robot.geometry.track_width_m
    return [(x, y), (-x, y), (x, -y), (-x, -y)]


def _two(joints: tuple[str, ...], side: str) -> tuple[str, str]:
    """Names of the front and the rear wheel of a side, as XML holds them."""
    usable = [name for name in joints if not set(name) & set("\"<>&'")]
    return (usable[0], usable[-1]) if len(usable) > 1 else (f"front_{side}_wheel", f"rear_{side}_wheel")


def _n(value: float) -> str:
    return f"{value:.6g}"
