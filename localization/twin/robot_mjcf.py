"""A robot file as MJCF: a box of its mass on four wheels with velocity servos, on a plane, with MuJoCo's default contacts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.twin.xml_file import XmlFile, parse
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_WHEEL_MASS_SHARE = 0.02
"""Mass of a wheel over that of the robot: a Husky's weighs 2.6 kg of 46 to 119."""
HALF_WIDTH = 0.3
"""Half the width of a wheel over its radius (a Husky's 0.05 m over 0.165 m)."""
_GYRATION = (0.12, 0.15, 0.18)
"""Moments of inertia of the body over its mass [m^2] on a wheelbase of 0.5 m: a Husky's with two arms."""
_REFERENCE_WHEELBASE_M = 0.5
_ARMATURE = 1.5
"""Inertia of a motor behind its gears over the wheel's mass times its radius squared."""


def mjcf_of(robot: Robot) -> XmlFile:
    """MJCF of ``robot``, whose body frame is on the ground between the wheels; as one would write it by hand, with default contacts."""
    r, mass = robot.geometry.wheel_radius_m, robot.geometry.mass_kg
    wheel, body, cg, inertia = masses(robot)
    names = wheel_names(robot)
    wheels = "".join(
        f"""
      <body name="{name}_body" pos="{as_text(px)} {as_text(py)} {as_text(r)}">
        <joint name="{name}" type="hinge" axis="0 1 0" armature="{as_text(_ARMATURE * wheel * r * r)}"/>
        <geom name="{name}_tyre" type="cylinder" size="{as_text(r)} {as_text(HALF_WIDTH * r)}" euler="90 0 0" mass="{as_text(wheel)}"/>
      </body>"""
        for name, (px, py) in zip(names, places(robot), strict=True)
    )
    servos = "".join(f'\n    <velocity name="{name}_servo" joint="{name}" kv="{as_text(mass * 9.81 * r)}"/>' for name in names)
    text = f"""<mujoco model="{robot.name}">
  <compiler angle="degree"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base_link">
      <freejoint/>
      <inertial pos="{" ".join(map(as_text, cg))}" mass="{as_text(body)}" diaginertia="{" ".join(map(as_text, inertia))}"/>{wheels}
    </body>
  </worldbody>
  <actuator>{servos}
  </actuator>
</mujoco>
"""
    return parse({f"{robot.name}.xml": text.encode()}, Path(f"{robot.name}.xml"))


def masses(robot: Robot) -> tuple[float, float, FloatArray, FloatArray]:
    """Mass of a wheel and of the body [kg]; the body's centre of mass (3,) [m] and moments of inertia (3,) [kg m^2]."""
    g = robot.geometry
    wheel = _WHEEL_MASS_SHARE * g.mass_kg
    body = g.mass_kg - 4.0 * wheel
    of_all = np.array([g.cg_x_m, g.cg_y_m, g.cg_height_m]) * g.mass_kg
    cg = (of_all - 4.0 * wheel * np.array([0.0, 0.0, g.wheel_radius_m])) / body
    return wheel, body, cg, np.array(_GYRATION) * body * (g.wheelbase_m / _REFERENCE_WHEELBASE_M) ** 2


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


def as_text(value: float) -> str:
    """A number as XML has it."""
    return f"{value:.6g}"
