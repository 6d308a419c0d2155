"""The numbers of a MuJoCo file that move a wheeled robot: read from the compiled model, and written back as attributes.

What counts at a contact is what the engine makes of both geoms (the larger friction, a mean of solref). It is read from a contact of the
resting robot; where it changes, the wheels' geoms get all of it, and `priority`, so that the ground's numbers no longer enter. Where the
file has <pair>s, those get it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np

from localization.errors import SimulationError
from localization.twin.law_engine import CREEP_M_S, LawEngine
from localization.twin.mujoco_engine import MujocoEngine, compile_robot, contact_numbers
from localization.twin.simulator import Numbers
from localization.twin.skidloc_contact import NAME, SITE
from localization.twin.xml_file import Change, Element, XmlFile
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

LAW_MODULE = "skidloc_contact.py"
"""Module that is written beside a file with the contact law."""
_CONTACT = ("mu", "torsional_m", "time_constant_s", "damping_ratio", "softness", "condim")
_INERTIAL = ("mass_kg", "inertia_scale", "cg_x_m", "cg_y_m", "cg_z_m")
_WHEELS = ("radius_scale", "radius_difference", "width_scale")
_PLACES = ("track_scale", "wheelbase_scale")
_ORIENTATIONS = ("fullinertia", "quat", "euler", "axisangle", "xyaxes", "zaxis")
_TOP_PRIORITY = 1
_OVERRIDE = 1
"""mjENBL_OVERRIDE: <option> has the parameters of all contacts."""


@dataclass(frozen=True)
class MujocoSimulator:
    """`localization.twin.simulator.Simulator` of an MJCF: the user's file, compiled, with its numbers and the elements that have them."""

    file: XmlFile
    robot: Robot
    engine: MujocoEngine
    numbers: Numbers
    contact: FloatArray
    """(13,) friction (5,), solref (2,), solimp (5,), condim of a wheel's contact."""
    geoms: tuple[tuple[tuple[Element, int], ...], ...]
    """Elements of each wheel's colliding geoms, with their indices in the model."""
    pairs: tuple[Element, ...]
    """<pair>s of wheels; empty where contacts come from the geoms."""
    joints: tuple[Element, ...]
    servos: tuple[tuple[Element, int], ...]
    """Elements of the wheels' velocity servos, with their indices in the model."""
    base: Element
    missing: tuple[str, ...] = ()
    """What of it no attribute of the file changes, and why."""
    engine_name = "MuJoCo"
    law_name = "contact law"

    @property
    def notes(self) -> tuple[str, ...]:
        """See `localization.twin.simulator.Simulator.notes`."""
        return (*self.engine.robot.notes, *self.missing)

    @property
    def absent(self) -> frozenset[str]:
        """See `localization.twin.simulator.Simulator.absent`."""
        n, kinds = self.numbers, {self.engine.geom_kind(index) for of_wheel in self.geoms for _, index in of_wheel}
        absent = {"time_constant_s", "damping_ratio"} if math.isnan(n.time_constant_s) else set()
        absent |= {"torsional_m"} if n.condim < 4 else set()
        absent |= {"servo_gain"} if math.isnan(n.servo_gain) else set()
        absent |= {"width_scale"} if kinds != {"cylinder"} else set()
        absent |= {"radius_scale", "radius_difference"} if "mesh" in kinds or "box" in kinds else set()
        absent |= {"track_scale", "wheelbase_scale"} if not has_places(self) else set()
        absent |= set() if math.isnan(n.slip_stiffness) else {p for p in _CONTACT if p != "mu"}  # contacts carry loads alone
        return frozenset(absent | ({"wheelbase_scale"} if n.wheelbase_m <= 0.0 else set()))

    @property
    def law_files(self) -> Mapping[str, str]:
        """See `localization.twin.simulator.Simulator.law_files`."""
        return {LAW_MODULE: files("localization.twin").joinpath(LAW_MODULE).read_text(encoding="utf-8")}

    def with_law(self, mu: float, stiffness: float) -> Numbers:
        """See `localization.twin.simulator.Simulator.with_law`."""
        return replace(self.numbers, mu=mu, slip_stiffness=stiffness)

    def with_numbers(self, numbers: Numbers) -> XmlFile:
        """The file with these ``numbers``; all bytes that do not hold one of them are the same."""
        return self.file.changed(_changes(self, numbers))

    def compiled(self, numbers: Numbers) -> MujocoEngine:
        """The engine with these ``numbers``. Raises `SimulationError` where the robot does not stand with them."""
        robot = compile_robot(self.with_numbers(numbers), self.robot)
        kind = MujocoEngine if math.isnan(numbers.slip_stiffness) else LawEngine
        return kind(robot, self.engine.nominal_cg, self.engine.threads)


def read_simulator(mjcf: XmlFile, robot: Robot, threads: int = 2) -> MujocoSimulator:
    """Compile the file and find its numbers. Raises `SimulationError`."""
    compiled = compile_robot(mjcf, robot)
    law = mjcf.named("numeric", NAME)
    engine = (MujocoEngine if law is None else LawEngine)(compiled, robot.center_of_gravity, threads)
    model, contact = compiled.model, contact_numbers(engine)
    missing: list[str] = []
    joints = [mjcf.named("joint", model.joint(j).name) for j in compiled.joints]
    if any(j is None or j.parent is None for j in joints):
        raise SimulationError(
            f"simulator '{mjcf.path}': the wheels' joints have no names in the file, or are made by <replicate> or <attach>."
        )
    found = [j for j in joints if j is not None]
    geoms = tuple(_geom_elements(compiled, mjcf, joint, i) for i, joint in enumerate(found))
    names = {e.attributes.get("name", "") for of_wheel in geoms for e, _ in of_wheel}
    pairs = tuple(p for p in mjcf.elements("pair") if names & {p.attributes.get("geom1"), p.attributes.get("geom2")})
    servos = _servo_elements(mjcf, engine) if compiled.has_servos else ()
    base = found[0].parent
    while base is not None and not base.own("freejoint") and not any(j.attributes.get("type") == "free" for j in base.own("joint")):
        base = base.parent
    if base is None:
        raise SimulationError(f"simulator '{mjcf.path}': the body with the free joint is not in the file's own text.")
    numbers = _read_numbers(engine, contact, servos)
    if law is not None:
        mu, stiffness, ratio = (float(v) for v in model.numeric(NAME).data[:3])
        numbers = replace(numbers, mu=mu, slip_stiffness=stiffness, mu_ratio=ratio)
    if contact["solref"][0] <= 0.0:
        missing.append("solref has stiffness and damping: time constant and damping ratio are not searched")
    if int(model.opt.enableflags) & _OVERRIDE:
        missing.append("<option> overrides all contacts (o_solref, o_friction): the wheels' own numbers have no effect")
    if not compiled.has_servos:
        missing.append("the file has no velocity servos on its wheels: servo gain is not judged")
    whole = np.concatenate([contact["friction"], contact["solref"], contact["solimp"], contact["dim"]])
    return MujocoSimulator(mjcf, robot, engine, numbers, whole, geoms, pairs, tuple(found), servos, base, tuple(missing))


def _geom_elements(compiled: Any, mjcf: XmlFile, joint: Element, wheel: int) -> tuple[tuple[Element, int], ...]:
    """Elements of the geoms of a wheel that collide: by name, or by their order below its body."""
    model, body = compiled.model, joint.parent
    assert body is not None
    below = [e for e in body.walk() if e.tag == "geom"]
    own = [
        g
        for g in range(model.ngeom)
        if int(model.body_weldid[model.geom_bodyid[g]]) == int(model.body_weldid[model.jnt_bodyid[compiled.joints[wheel]]])
    ]
    found = []
    for g in compiled.geoms[wheel]:
        named = mjcf.named("geom", model.geom(g).name) if model.geom(g).name else None
        if named is None and len(below) == len(own) and g in own:
            named = below[own.index(g)]
        if named is None:
            raise SimulationError(
                f"simulator '{mjcf.path}': a geom of the wheel {model.joint(compiled.joints[wheel]).name} is not found in the text;"
                " give it a name."
            )
        found.append((named, g))
    return tuple(found)


def _servo_elements(mjcf: XmlFile, engine: MujocoEngine) -> tuple[tuple[Element, int], ...]:
    """Elements of the velocity servos, by their order in <actuator>."""
    elements = [e for section in mjcf.root.own("actuator") for e in section.children]
    if len(elements) != engine.robot.model.nu:
        return ()
    return tuple((elements[i], int(i)) for i in np.flatnonzero((engine.robot.gears != 0.0).any(axis=1)))


def _read_numbers(engine: MujocoEngine, contact: Any, servos: Sequence[tuple[Element, int]]) -> Numbers:
    r = engine.robot
    model, (x, y, z) = r.model, engine.center_of_mass()
    tau, ratio = contact["solref"] if contact["solref"][0] > 0.0 else (np.nan, np.nan)
    dofs = [int(model.jnt_dofadr[j]) for j in r.joints]
    gains = [float(model.actuator_gainprm[i, 0]) for _, i in servos]
    return Numbers(
        mu=float(contact["friction"][0]),
        torsional_m=float(contact["friction"][2]),
        time_constant_s=float(tau),
        damping_ratio=float(ratio),
        softness=float(1.0 - contact["solimp"][1]),
        condim=float(contact["dim"][0]),
        impratio=float(model.opt.impratio),
        is_elliptic=float(model.opt.cone == 1),
        time_step_s=float(model.opt.timestep),
        servo_gain=float(np.mean(gains)) if gains else np.nan,
        rotor_inertia=float(np.mean(model.dof_armature[dofs])) + engine.wheel_inertia(),
        mass_kg=float(model.body_subtreemass[r.base]),
        cg_x_m=x,
        cg_y_m=y,
        cg_z_m=z,
        radius_m=r.radius_m,
        radius_difference=engine.radius_difference(),
        track_m=r.wheels.track_m,
        wheelbase_m=r.wheels.wheelbase_m,
    )


def _changes(simulator: MujocoSimulator, new: Numbers) -> list[Change]:
    """Attributes that hold what differs from the file's own numbers."""
    old = simulator.numbers
    differs = {name for name in old.__dataclass_fields__ if not _same(getattr(old, name), getattr(new, name))}
    changes = _option(simulator, new, differs)
    if not math.isnan(new.slip_stiffness):
        changes += _law(simulator, new)
    elif differs & set(_CONTACT):
        changes += _contact(simulator, new)
    if "servo_gain" in differs:
        changes += [_servo(element, index, simulator, new.servo_gain / old.servo_gain) for element, index in simulator.servos]
    if "rotor_inertia" in differs:
        inertia = simulator.engine.wheel_inertia()
        changes += [Change(joint, {"armature": _n(max(new.rotor_inertia - inertia, 0.0))}) for joint in simulator.joints]
    if differs & set(_INERTIAL):
        changes.append(_inertial(simulator, new))
    if differs & set(_WHEELS):
        changes += _sizes(simulator, new)
    if differs & set(_PLACES):
        changes += _positions(simulator, new)
    return changes


def _same(a: float, b: float) -> bool:
    return a == b or (a != a and b != b)


def _option(simulator: MujocoSimulator, new: Numbers, differs: set[str]) -> list[Change]:
    attributes = {}
    if "impratio" in differs:
        attributes["impratio"] = _n(new.impratio)
    if "is_elliptic" in differs:
        attributes["cone"] = "elliptic" if new.is_elliptic else "pyramidal"
    if "time_step_s" in differs:
        attributes["timestep"] = _n(new.time_step_s)
    if not attributes:
        return []
    options = simulator.file.root.own("option")
    return [Change(options[-1], attributes) if options else Change(simulator.file.root, attributes, "option")]


def _contact(simulator: MujocoSimulator, new: Numbers) -> list[Change]:
    """The whole contact, on the pairs of the wheels or their geoms."""
    c = simulator.contact
    slide, roll = new.mu, c[3]
    ratio = c[1] / c[0]
    attributes: dict[str, str | None] = {"condim": f"{new.condim:.0f}"}
    if new.time_constant_s == new.time_constant_s:
        attributes["solref"] = f"{_n(new.time_constant_s)} {_n(new.damping_ratio)}"
    # the share of the impedance at first touch stays
    top = 1.0 - new.softness
    low = min(float(c[7] / c[8]) * top, top)
    attributes["solimp"] = " ".join(map(_n, (low, top, *c[9:12])))
    if simulator.pairs:
        attributes["friction"] = " ".join(map(_n, (slide, slide * ratio, new.torsional_m, roll, roll)))
        return [Change(pair, attributes) for pair in simulator.pairs]
    attributes["friction"] = " ".join(map(_n, (slide, new.torsional_m, roll)))
    attributes["priority"] = str(simulator.engine.ground_priority() + _TOP_PRIORITY)
    return [Change(element, attributes) for of_wheel in simulator.geoms for element, _ in of_wheel]


def _law(simulator: MujocoSimulator, new: Numbers) -> list[Change]:
    """Wheels without friction of the engine's, and what the module of the contact law reads."""
    old = simulator.file.named("numeric", NAME)
    if old is not None:
        creep = float(simulator.engine.robot.model.numeric(NAME).data[3])
        return [Change(old, {"data": " ".join(map(_n, (new.mu, new.slip_stiffness, new.mu_ratio, creep)))})]
    changes = _contact(simulator, replace(new, condim=1.0))
    sensors = ""
    for i, (joint, of_wheel) in enumerate(zip(simulator.joints, simulator.geoms, strict=True)):
        radius = simulator.engine.radius(of_wheel[0][1]) * _growth(simulator, new, i)
        place = " ".join(map(_n, simulator.engine.robot.model.geom_pos[of_wheel[0][1]]))
        assert joint.parent is not None
        for suffix, size in (("", radius), ("_zone", 2.0 * radius)):  # the touch sensor's sphere reaches beyond the contact
            site = f'<site name="{SITE}{i}{suffix}" type="sphere" pos="{place}" size="{_n(size)}" group="4"/>'
            changes.append(Change(joint.parent, {}, text=site))
        sensors += f'<touch name="{SITE}{i}" site="{SITE}{i}_zone"/>'
    law = " ".join(map(_n, (new.mu, new.slip_stiffness, new.mu_ratio, CREEP_M_S)))
    text = f'<custom><numeric name="{NAME}" data="{law}"/></custom><sensor>{sensors}</sensor>'
    return [*changes, Change(simulator.file.root, {}, text=text)]


def _servo(element: Element, index: int, simulator: MujocoSimulator, scale: float) -> Change:
    model = simulator.engine.robot.model
    gain = float(model.actuator_gainprm[index, 0]) * scale
    if element.tag == "velocity":
        return Change(element, {"kv": _n(gain)})
    return Change(element, {"gainprm": _n(gain), "biasprm": f"0 0 {_n(float(model.actuator_biasprm[index, 2]) * scale)}"})


def _inertial(simulator: MujocoSimulator, new: Numbers) -> Change:
    """The body's <inertial>, so that the whole robot has the new mass and centre of gravity."""
    old, r = simulator.numbers, simulator.engine.robot
    model, w = r.model, r.wheels
    own = float(model.body_mass[r.base])
    mass = own + new.mass_kg - old.mass_kg
    if mass <= 0.0:
        raise SimulationError(f"simulator '{r.file}': its body would weigh {mass:.3g} kg.")
    shift = np.append(
        (new.cg_x_m - old.cg_x_m) * w.forward + (new.cg_y_m - old.cg_y_m) * np.array([-w.forward[1], w.forward[0]]), new.cg_z_m - old.cg_z_m
    )
    # the load that is added is where the centre of gravity is
    whole = simulator.engine.center_of_mass_in_base()
    position = (model.body_ipos[r.base] * own + whole * (new.mass_kg - old.mass_kg) + shift * new.mass_kg) / mass
    inertia = model.body_inertia[r.base] * new.inertia_scale * mass / own
    attributes: dict[str, str | None] = dict.fromkeys(_ORIENTATIONS)
    attributes |= {
        "pos": " ".join(map(_n, position)),
        "mass": _n(mass),
        "quat": " ".join(map(_n, model.body_iquat[r.base])),
        "diaginertia": " ".join(map(_n, inertia)),
    }
    inertials = simulator.base.own("inertial")
    return Change(inertials[0], attributes) if inertials else Change(simulator.base, attributes, "inertial")


def _growth(simulator: MujocoSimulator, new: Numbers, wheel: int) -> float:
    """Radius of a wheel over that in the file."""
    side = 0.5 if wheel < len(simulator.engine.robot.wheels.left) else -0.5
    return new.radius_scale * (1.0 + side * new.radius_difference) / (1.0 + side * simulator.numbers.radius_difference)


def _sizes(simulator: MujocoSimulator, new: Numbers) -> list[Change]:
    """Radii and widths of the wheels' geoms."""
    changes, model = [], simulator.engine.robot.model
    for wheel, of_wheel in enumerate(simulator.geoms):
        scale = _growth(simulator, new, wheel)
        for element, g in of_wheel:
            size = np.array(model.geom_size[g])
            kind = simulator.engine.geom_kind(g)
            if kind in ("cylinder", "capsule"):
                size[0] *= scale
                size[1] *= new.width_scale
                size = size[: 1 if "fromto" in element.attributes else 2]
            elif kind == "sphere":
                size = size[:1] * scale
            elif kind == "ellipsoid":
                size *= scale
            else:
                continue
            changes.append(Change(element, {"size": " ".join(map(_n, size))}))
    return changes


def _positions(simulator: MujocoSimulator, new: Numbers) -> list[Change]:
    """Places of the wheels' bodies, which the free body carries."""
    r = simulator.engine.robot
    model, w = r.model, r.wheels
    lateral = np.array([-w.forward[1], w.forward[0]])
    changes = []
    for joint, j in zip(simulator.joints, r.joints, strict=True):
        body = int(model.jnt_bodyid[j])
        position = np.array(model.body_pos[body])
        off = position[:2] - w.origin
        along, across = off @ w.forward, off @ lateral
        position[:2] += along * (new.wheelbase_scale - 1.0) * w.forward + across * (new.track_scale - 1.0) * lateral
        assert joint.parent is not None
        changes.append(Change(joint.parent, {"pos": " ".join(map(_n, position))}))
    return changes


def has_places(simulator: MujocoSimulator) -> bool:
    """Whether the wheels' bodies are carried by the free body itself, so that their places are in its frame."""
    model, base = simulator.engine.robot.model, simulator.engine.robot.base
    return all(int(model.body_parentid[model.jnt_bodyid[j]]) == base for j in simulator.engine.robot.joints)


def _n(value: float) -> str:
    return f"{float(value):.6g}"
