"""A robot file as SDF, as one would write it for Gazebo by hand: a box on four wheels with gz-sim's DiffDrive and default friction."""

from __future__ import annotations

from pathlib import Path

from localization.twin.robot_mjcf import HALF_WIDTH, as_text, masses, places, wheel_names
from localization.twin.xml_file import XmlFile, parse
from motion_models.robot import Robot


def sdf_of(robot: Robot) -> XmlFile:
    """SDF of ``robot``, whose base_link is on the ground between the wheels."""
    g = robot.geometry
    r = g.wheel_radius_m
    wheel, body, cg, moments = masses(robot)
    across, along = wheel * r * r * (3.0 + 4.0 * HALF_WIDTH**2) / 12.0, 0.5 * wheel * r * r
    names = wheel_names(robot)
    wheels = "".join(
        f"""
    <link name="{name}_link">
      <pose relative_to="base_link">{as_text(x)} {as_text(y)} {as_text(r)} 0 0 0</pose>
      <inertial><mass>{as_text(wheel)}</mass>{_inertia(across, along, across)}</inertial>
      <collision name="{name}_tyre">
        <pose>0 0 0 1.570796326794897 0 0</pose>
        <geometry><cylinder><radius>{as_text(r)}</radius><length>{as_text(2.0 * HALF_WIDTH * r)}</length></cylinder></geometry>
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
      <inertial><pose>{" ".join(map(as_text, cg))} 0 0 0</pose><mass>{as_text(body)}</mass>{_inertia(*moments)}</inertial>
    </link>{wheels}
    <plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">
      {sides}<wheel_separation>{as_text(g.track_width_m)}</wheel_separation><wheel_radius>{as_text(r)}</wheel_radius>
    </plugin>
  </model>
</sdf>
"""
    return parse({f"{robot.name}.sdf": text.encode()}, Path(f"{robot.name}.sdf"), "sdf")


def _inertia(xx: float, yy: float, zz: float) -> str:
    return f"<inertia><ixx>{as_text(xx)}</ixx><iyy>{as_text(yy)}</iyy><izz>{as_text(zz)}</izz></inertia>"
