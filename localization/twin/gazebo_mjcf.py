"""A robot of an SDF or URDF in MuJoCo: rigid bodies and wheels, with MuJoCo's default contacts, as its masses and shapes are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from localization.twin.gazebo_file import GazeboRobot, GazeboWheel, read_gazebo
from localization.twin.xml_file import XmlFile, parse
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_LOST = ("mu", "mu1", "mu2", "fdir1", "slip1", "slip2", "kp", "kd", "torsional", "transmission", "ros2_control", "plugin")


def mjcf_of_gazebo(file: XmlFile, robot: Robot) -> tuple[XmlFile, tuple[str, ...]]:
    """MJCF of an SDF or URDF, and what of it is not in it. Raises `SimulationError`.

    Joints that are no wheels are fixed at zero: the log's centre of gravity takes the place of the arms' postures.
    """
    source = read_gazebo(file, robot)
    lost = sorted({e.tag for e in source.model.walk()} & set(_LOST))
    notes = list(source.notes)
    if lost:
        notes.append(f"{file.path.name}: <{'>, <'.join(lost)}> are not converted: contacts are MuJoCo's defaults, servos are added.")
    touching = [s for name, link in source.links.items() if name not in {w.link.name for w in source.driven} for s in link.shapes]
    if touching:
        notes.append(f"{file.path.name}: {len(touching)} collision shapes besides the wheels' are left out.")
    name = f"{file.path.stem}.xml"
    return parse({name: _text(source).encode()}, file.path.with_name(name)), tuple(notes)


def _text(source: GazeboRobot) -> str:
    mass, com, inertia = source.rigid()
    wheels = "".join(_wheel(w) for w in source.driven)
    return f"""<mujoco model="{source.file.path.stem}">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="{source.base}" pos="0 0 {_n(-source.ground_z)}">
      <freejoint/>
      <inertial pos="{_all(com)}" mass="{_n(mass)}" fullinertia="{_moments(inertia)}"/>{wheels}
    </body>
  </worldbody>
</mujoco>
"""


def _wheel(w: GazeboWheel) -> str:
    pose = w.link.pose
    frame = pose.rotation @ w.shape.pose.rotation
    centre = pose.rotation @ w.shape.pose.translation + pose.translation
    quat = Rotation.from_matrix(frame).as_quat(scalar_first=True)
    size = w.shape.radius if w.shape.kind == "sphere" else f"{_n(w.shape.radius)} {_n(0.5 * w.shape.length)}"
    kind = w.shape.kind if w.shape.kind in ("sphere", "capsule") else "cylinder"
    com = pose.rotation @ w.link.com + pose.translation - centre
    inertia = pose.rotation @ w.link.inertia @ pose.rotation.T
    return f"""
      <body name="{w.link.name}" pos="{_all(centre)}">
        <joint name="{w.joint.name}" type="hinge" axis="{_all(w.joint.axis)}"/>
        <inertial pos="{_all(com)}" mass="{_n(w.link.mass)}" fullinertia="{_moments(inertia)}"/>
        <geom name="{w.link.name}_tyre" type="{kind}" size="{size}" quat="{_all(quat)}"/>
      </body>"""


def _moments(inertia: FloatArray) -> str:
    """Moments as MuJoCo takes them: positive, and no moment larger than the sum of the others."""
    values, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    values = np.maximum(values, 1e-6)
    values[2] = min(values[2], values[0] + values[1])
    whole = axes @ np.diag(values) @ axes.T
    return _all([*np.diag(whole), whole[0, 1], whole[0, 2], whole[1, 2]])


def _all(values: Sequence[float] | FloatArray) -> str:
    return " ".join(_n(0.0 if math.isclose(float(v), 0.0, abs_tol=1e-12) else v) for v in values)


def _n(value: float) -> str:
    return f"{float(value):.9g}"
