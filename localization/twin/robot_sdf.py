"""A robot file as SDF, as one would write it for Gazebo by hand: a box on four wheels with gz-sim's DiffDrive and default friction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.twin.robot_mjcf import GYRATION, HALF_WIDTH, REFERENCE_WHEELBASE_M, WHEEL_MASS_SHARE, places, wheel_names
from localization.twin.xml_file import XmlFile, parse
from motion_models.robot import Robot


def sdf_of(robot: Robot) -> XmlFile:
    """SDF of ``robot``, whose base_link is on the ground between the wheels."""
    g = robot.geometry
    r, mass = g.wheel_radius_m, g.mass_kg
    wheel = WHEEL_MASS_SHARE * mass
    body = mass - 4.0 * wheel
    cg = (np.array([g.cg_x_m, g.cg_y_m, g.cg_height_m]) * mass - 4.0 * wheel * np.array([0.0, 0.0, r])) / body
    moments = np.array(GYRATION) * body * (g.wheelbase_m / REFERENCE_WHEELBASE_M) ** 2
    across, along = wheel * r * r * (3.0 + 4.0 * HALF_WIDTH**2) / 12.0, 0.5 * wheel * r * r
    names = wheel_names(robot)
    wheels = "".join(
        f"""
    <link name="{name}_link">
      <pose relative_to="base_link">{_n(x)} {_n(y)} {_n(r)} 0 0 0</pose>
      <inertial><mass>{_n(wheel)}</mass>{_inertia(across, along, across)}</inertial>
      <collision name="{name}_tyre">
        <pose>0 0 0 1.570796326794897 0 0</pose>
        <geometry><cylinder><radius>{_n(r)}</radius><length>{_n(2.0 * HALF_WIDTH * r)}</length></cylinder></geometry>
      </collision>
    </link>
    <joint name="{name}" type="revolute">
      <parent>base_link</parent><child>{name}_link</child>
      <axis><xyz>0 1 0</xyz></axis>
    </joint>"""
        for name, (x, y) in zip(names, places(robot), strict=True)
    )
    sides = "".join(f"<{side}_joint>{name}</{side}_joint>" for side, name in zip(("left", "left", "right", "right"), names, strict=True))
    text = f"""<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{robot.name}">
    <link name="base_link">
      <inertial><pose>{" ".join(map(_n, cg))} 0 0 0</pose><mass>{_n(body)}</mass>{_inertia(*moments)}</inertial>
    </link>{wheels}
    <plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">
      {sides}<wheel_separation>{_n(g.track_width_m)}</wheel_separation><wheel_radius>{_n(r)}</wheel_radius>
    </plugin>
  </model>
</sdf>
"""
    return parse({f"{robot.name}.sdf": text.encode()}, Path(f"{robot.name}.sdf"), "sdf")


def _inertia(xx: float, yy: float, zz: float) -> str:
    return f"<inertia><ixx>{_n(xx)}</ixx><iyy>{_n(yy)}</iyy><izz>{_n(zz)}</izz></inertia>"


def _n(value: float) -> str:
    return f"{value:.6g}"
