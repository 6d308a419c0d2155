"""What the numbers are called in other formats: Gazebo's SDF and URDF, and USD as Isaac Sim reads it.

USD: UsdPhysics and PhysxSchema, https://openusd.org/release/api/usd_physics_page_front.html. Angles of its drives are degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from localization.twin.simulator import NumberChange

GAZEBO: Mapping[str, str] = {
    "mu": "<mu>, <mu2>; URDF: <mu1>, <mu2>",
    "width_scale": "<cylinder><length>",
    "slip_stiffness": "WheelSlip: 1 / (mu <slip_compliance_lateral>), and longitudinal",
    "mass_kg": "<inertial><mass>",
    "inertia_scale": "<inertial><inertia>",
    "cg_x_m": "<inertial><pose>",
    "cg_y_m": "<inertial><pose>",
    "cg_z_m": "<inertial><pose>",
    "radius_scale": "<cylinder><radius>",
}
"""Elements of SDF by fields of `Numbers`."""
USD: Mapping[str, tuple[str, float]] = {
    "mu": ("physics:staticFriction, physics:dynamicFriction of the wheels' material", 1.0),
    "torsional_m": ("physxCollision:torsionalPatchRadius of the wheels' colliders", 1.0),
    "width_scale": ("height of the wheels' cylinders", 1.0),
    "slip_stiffness": ("physxVehicleTire:longitudinalStiffness over mu and load", 1.0),
    "servo_gain": ("drive:angular:physics:damping of the wheels' joints [N m s/deg]", math.pi / 180.0),
    "rotor_inertia": ("physxJoint:armature of the wheels' joints, with the wheel's own inertia", 1.0),
    "mass_kg": ("physics:mass", 1.0),
    "inertia_scale": ("physics:diagonalInertia", 1.0),
    "cg_x_m": ("physics:centerOfMass, x", 1.0),
    "cg_y_m": ("physics:centerOfMass, y", 1.0),
    "cg_z_m": ("physics:centerOfMass, z", 1.0),
    "radius_scale": ("radius of the wheels' cylinders", 1.0),
    "track_scale": ("physics:localPos0 of the wheels' joints, y", 1.0),
    "wheelbase_scale": ("physics:localPos0 of the wheels' joints, x", 1.0),
}
"""Attributes of USD and the factor of their unit; MuJoCo's solref, solimp, impratio and cones have no counterpart in PhysX."""


def usd_table(changes: Sequence[NumberChange]) -> str:
    """CSV of ``changes`` with USD's attributes and units."""
    lines = ["number,usd,old,new"]
    for change in changes:
        attribute, factor = USD.get(change.field, ("none in PhysX", 1.0))
        values = ["" if math.isnan(v) else f"{v * factor:.6g}" for v in (change.old, change.new)]
        lines.append(f'"{change.meaning}","{attribute}",{",".join(values)}')
    return "\n".join(lines) + "\n"
