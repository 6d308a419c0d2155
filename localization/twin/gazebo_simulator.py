"""The numbers of a Gazebo robot (SDF, or URDF with <gazebo>) that move it: read, played by DART, and written back in place.

Friction in proportion to slip is gz-sim's WheelSlip plug-in, F / N = (s / |r q|) / C up to mu along each axis of a wheel: with the contact
law's K, C = 1 / (mu K).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from localization.errors import SimulationError
from localization.twin.dart_engine import DartBody, DartEngine
from localization.twin.gazebo_file import GazeboRobot, GazeboWheel, Link, read_gazebo
from localization.twin.simulator import Numbers
from localization.twin.xml_file import Change, Element, XmlFile
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_PLUGIN = "gz::sim::systems::WheelSlip"
_ABSENT = frozenset(
    {"time_constant_s", "damping_ratio", "softness", "impratio", "torsional_m", "servo_gain", "rotor_inertia"}
    | {"track_scale", "wheelbase_scale", "radius_difference", "mu_ratio", "time_step_s"}
)
"""Numbers of MuJoCo's contacts, servos and integration; places of wheels, which several elements of an SDF share."""
_WHEEL_NUMBERS = ("radius_scale", "width_scale")
_INERTIAL = ("mass_kg", "inertia_scale", "cg_x_m", "cg_y_m", "cg_z_m")
_GUESSED_STIFFNESS = 2.0
"""K of WheelSlip from which a search starts: its pyramid of friction along a wheel's axes takes less than the contact law's 8 to 13."""


@dataclass(frozen=True)
class GazeboSimulator:
    """`localization.twin.simulator.Simulator` of an SDF or URDF, by DART."""

    source: GazeboRobot
    numbers: Numbers
    engine: DartEngine = field(repr=False)
    nominal_cg: FloatArray
    engine_name = "DART"
    law_name = "wheel slip"
    law_files: Mapping[str, str] = field(default_factory=dict)

    @property
    def file(self) -> XmlFile:
        """See `localization.twin.simulator.Simulator.file`."""
        return self.source.file

    @property
    def absent(self) -> frozenset[str]:
        """See `localization.twin.simulator.Simulator.absent`."""
        shapes = [w.shape for w in self.source.driven]
        absent = set() if {s.kind for s in shapes} == {"cylinder"} else {"width_scale"}
        absent |= set() if all(s.element is not None for s in shapes) else {"width_scale", "radius_scale"}
        return _ABSENT | absent

    @property
    def notes(self) -> tuple[str, ...]:
        """See `localization.twin.simulator.Simulator.notes`."""
        name, own = self.file.path.name, []
        tags = sorted({e.tag for e in self.source.model.walk()} & {"mu2", "fdir1", "slip1", "slip2", "kp", "kd", "torsional"})
        if tags:
            own.append(f"{name}: <{'>, <'.join(tags)}> are not in dartpy: friction is that of <mu> in all directions.")
        own.append("wheels follow their rates exactly, as by gz-sim's DiffDrive: servos are not judged.")
        return (*self.source.notes, *own)

    def with_law(self, mu: float, stiffness: float) -> Numbers:
        """See `localization.twin.simulator.Simulator.with_law`."""
        return replace(self.numbers, mu=mu, slip_stiffness=min(stiffness, _GUESSED_STIFFNESS))

    def compiled(self, numbers: Numbers) -> DartEngine:
        """See `localization.twin.simulator.Simulator.compiled`."""
        return DartEngine(_body(self.source, self.numbers, numbers), self.nominal_cg)

    def with_numbers(self, numbers: Numbers) -> XmlFile:
        """See `localization.twin.simulator.Simulator.with_numbers`."""
        old, new, changes = self.numbers, numbers, []
        if new.mu != old.mu:
            changes += [c for w in self.source.driven for c in self._friction(w, new.mu)]
        if any(getattr(new, name) != getattr(old, name) for name in _WHEEL_NUMBERS):
            changes += [c for w in self.source.driven for c in self._sizes(w, new)]
        if any(getattr(new, name) != getattr(old, name) for name in _INERTIAL):
            changes += _inertial(self.file, self.source.links[self.source.base], _moved_base(self.source, old, new))
        if not math.isnan(new.slip_stiffness):
            changes += self._plugin(new)
        return self.file.changed(changes)

    def _friction(self, wheel: GazeboWheel, mu: float) -> list[Change]:
        value = _n(mu)
        if self.file.root.tag == "robot":
            return self._urdf_friction(wheel, {"mu1": value, "mu2": value})
        return self._friction_of(wheel, {"mu": value, "mu2": value})

    def _friction_of(self, wheel: GazeboWheel, values: Mapping[str, str]) -> list[Change]:
        shapes = wheel.link.element.own("collision") if wheel.shape.element is None else [wheel.shape.element]
        return [c for shape in shapes for c in _nested(shape, ("surface", "friction", "ode"), values)]

    def _urdf_friction(self, wheel: GazeboWheel, values: Mapping[str, str]) -> list[Change]:
        own = [e for e in self.file.root.own("gazebo") if e.attributes.get("reference") == wheel.link.name]
        if not own:
            text = "".join(f"<{tag}>{value}</{tag}>" for tag, value in values.items())
            return [Change(self.file.root, {}, text=f'\n  <gazebo reference="{wheel.link.name}">{text}</gazebo>')]
        return _nested(own[0], (), values)

    def _sizes(self, wheel: GazeboWheel, new: Numbers) -> list[Change]:
        assert wheel.shape.element is not None
        geometry = next(g for e in wheel.shape.element.own("geometry") for g in e.children)
        sizes = {"radius": wheel.shape.radius * new.radius_scale, "length": wheel.shape.length * new.width_scale}
        sizes = {name: size for name, size in sizes.items() if math.isfinite(size)}
        if self.file.root.tag == "robot":
            return [Change(geometry, {name: _n(size) for name, size in sizes.items()})]
        return [Change(e, {}, content=_n(sizes[e.tag])) for e in geometry.children if e.tag in sizes]

    def _plugin(self, new: Numbers) -> list[Change]:
        """WheelSlip's parameters, and the axle as the first direction of friction, as it takes it to be."""
        compliance, changes, wheels = 1.0 / (new.mu * new.slip_stiffness), [], ""
        loads = DartEngine(_body(self.source, self.numbers, new), self.nominal_cg).loads
        for w, load in zip(self.source.driven, loads, strict=True):
            frame = w.link.pose.rotation @ w.shape.pose.rotation
            axle = " ".join(_n(round(v, 6) + 0.0) for v in frame.T @ w.joint.axis)
            if self.file.root.tag == "robot":
                changes += self._urdf_friction(w, {"mu1": _n(new.mu), "mu2": _n(new.mu), "fdir1": axle})
            else:
                changes += self._friction_of(w, {"mu": _n(new.mu), "mu2": _n(new.mu), "fdir1": axle})
            wheels += f"""
      <wheel link_name="{w.link.name}">
        <slip_compliance_lateral>{_n(compliance)}</slip_compliance_lateral>
        <slip_compliance_longitudinal>{_n(compliance)}</slip_compliance_longitudinal>
        <wheel_normal_force>{_n(load)}</wheel_normal_force>
        <wheel_radius>{_n(w.shape.radius * new.radius_scale)}</wheel_radius>
      </wheel>"""
        old = _wheel_slip(self.source.model)
        if old is not None:
            return [*changes, Change(old, {}, content=wheels + "\n    ")]
        text = f'\n    <plugin filename="gz-sim-wheel-slip-system" name="{_PLUGIN}">{wheels}\n    </plugin>'
        if self.file.root.tag == "robot":
            text = f"\n  <gazebo>{text}\n  </gazebo>"
        return [*changes, Change(self.source.model, {}, text=text)]


def read_gazebo_simulator(file: XmlFile, robot: Robot) -> GazeboSimulator:
    """The simulator of an SDF or URDF. Raises `SimulationError`."""
    source = read_gazebo(file, robot)
    x, y, z = source.center_of_mass()
    mu = float(np.mean([w.shape.mu for w in source.driven]))
    plugin = _wheel_slip(source.model)
    compliances = [float(file.content(e)) for e in plugin.walk() if e.tag == "slip_compliance_lateral"] if plugin is not None else []
    numbers = Numbers(
        mu=mu,
        time_step_s=source.time_step_s,
        mass_kg=source.mass,
        cg_x_m=x,
        cg_y_m=y,
        cg_z_m=z,
        radius_m=float(np.mean([w.shape.radius for w in source.driven])),
        track_m=source.wheels.track_m,
        wheelbase_m=source.wheels.wheelbase_m,
        slip_stiffness=1.0 / (mu * compliances[0]) if compliances and min(mu * compliances[0], mu) > 0.0 else math.nan,
    )
    return GazeboSimulator(source, numbers, DartEngine(_body(source, numbers, numbers), robot.center_of_gravity), robot.center_of_gravity)


def _wheel_slip(model: Element) -> Element | None:
    return next((e for e in model.walk() if e.tag == "plugin" and e.attributes.get("name", "").endswith("WheelSlip")), None)


def _moved_base(source: GazeboRobot, old: Numbers, new: Numbers) -> Link:
    """The heaviest link, so that the whole robot has the new mass and centre of gravity."""
    base, w = source.links[source.base], source.wheels
    mass = base.mass + new.mass_kg - old.mass_kg
    if mass <= 0.0:
        raise SimulationError(f"simulator '{source.file.path}': the link {base.name} would weigh {mass:.3g} kg.")
    shift = (new.cg_x_m - old.cg_x_m) * w.forward + (new.cg_y_m - old.cg_y_m) * np.array([-w.forward[1], w.forward[0]])
    whole = source.rigid(list(source.links.values()))[1]
    own = base.pose.rotation @ base.com + base.pose.translation
    # the load that is added is where the centre of gravity is
    moved = np.append(shift, new.cg_z_m - old.cg_z_m) * new.mass_kg
    place = (own * base.mass + whole * (new.mass_kg - old.mass_kg) + moved) / mass
    inverse = base.pose.inverse()
    return replace(
        base,
        mass=mass,
        com=inverse.rotation @ place + inverse.translation,
        inertia=base.inertia * new.inertia_scale * mass / base.mass,
    )


def _body(source: GazeboRobot, old: Numbers, new: Numbers) -> DartBody:
    moved = replace(source, links={**source.links, source.base: _moved_base(source, old, new)})
    mass, com, inertia = moved.rigid()
    radii = np.array([w.shape.radius for w in source.driven]) * new.radius_scale
    lengths = np.array([w.shape.length for w in source.driven]) * new.width_scale
    compliance = 1.0 / (new.mu * new.slip_stiffness) if not math.isnan(new.slip_stiffness) else math.nan
    return DartBody(moved, mass, com, inertia, radii, lengths, new.mu, compliance)


def _inertial(file: XmlFile, old: Link, new: Link) -> list[Change]:
    """Mass, place and moments of a link's <inertial>, along the axes that it has."""
    inertial = next(iter(old.element.own("inertial")))
    is_urdf = file.root.tag == "robot"
    place = next(iter(inertial.own("origin" if is_urdf else "pose")), None)
    rotation = Rotation.identity()
    if place is not None:
        text = place.attributes.get("rpy", "0 0 0") if is_urdf else " ".join(file.content(place).split()[3:])
        degrees = place.attributes.get("degrees") == "true"
        rotation = Rotation.from_euler("xyz", [float(v) for v in text.split()], degrees=degrees)
    R = rotation.as_matrix()
    moments = R.T @ new.inertia @ R
    tags = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    values = {tag: _n(float(moments[at])) for tag, at in tags.items()}
    xyz = " ".join(_n(v) for v in new.com)
    inertia, mass = next(iter(inertial.own("inertia")), None), next(iter(inertial.own("mass")), None)
    if is_urdf:
        changes = [Change(place, {"xyz": xyz}) if place is not None else Change(inertial, {}, text=f'<origin xyz="{xyz}"/>')]
        changes += [] if mass is None else [Change(mass, {"value": _n(new.mass)})]
        return changes + ([] if inertia is None else [Change(inertia, dict(values))])
    if place is None:
        changes = [Change(inertial, {}, text=f"<pose>{xyz} 0 0 0</pose>")]
    else:
        changes = [Change(place, {}, content=" ".join([xyz, *file.content(place).split()[3:]]))]
    changes += [] if mass is None else [Change(mass, {}, content=_n(new.mass))]
    return changes + [Change(e, {}, content=values[e.tag]) for e in (inertia.children if inertia is not None else []) if e.tag in values]


def _nested(element: Element, path: Sequence[str], values: Mapping[str, str]) -> list[Change]:
    """Elements with ``values`` at the ``path`` below ``element``: changed where there are such, else added."""
    at, left = element, list(path)
    while left and at.own(left[0]):
        at = at.own(left.pop(0))[0]
    if left:
        inner = "".join(f"<{tag}>{value}</{tag}>" for tag, value in values.items())
        for tag in reversed(left):
            inner = f"<{tag}>{inner}</{tag}>"
        return [Change(at, {}, text=inner)]
    changes = [Change(e, {}, content=values[e.tag]) for tag in values for e in at.own(tag)]
    missing = "".join(f"<{tag}>{value}</{tag}>" for tag, value in values.items() if not at.own(tag))
    return changes + ([Change(at, {}, text=missing)] if missing else [])


def _n(value: float) -> str:
    return f"{float(value):.6g}"
