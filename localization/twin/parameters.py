"""The hypotheses: each number of a simulator that may be wrong, with its prior.

A number of the engine may be anything: its prior is wide and about the file's value. A number of the robot is known from the robot file:
its prior is narrow and about that value, so that a simulator whose robot is another one is corrected also where motion shows little of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from localization.twin.other_names import GAZEBO
from localization.twin.simulator import Numbers, Simulator
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

Area = Literal["contact", "servo", "robot", "reference"]


@dataclass(frozen=True)
class Parameter:
    """A number that may be wrong. It is searched as its logarithm, or as a difference."""

    field: str
    """Field of `Numbers`; frame_x_m and frame_y_m of the reference."""
    meaning: str
    unit: str
    area: Area
    sigma: float
    """Prior sigma of its logarithm [-], or of the difference [unit]."""
    is_log: bool
    low: float
    high: float
    attribute: str
    """Where MJCF has it."""


_ENGINE = (
    Parameter("mu", "friction of the wheels' contacts", "", "contact", 0.5, True, 0.05, 3.0, "geom friction[0]"),
    Parameter("time_constant_s", "time constant of the contacts", "s", "contact", 1.0, True, 2e-3, 1.0, "geom solref[0]"),
    Parameter("damping_ratio", "damping ratio of the contacts", "", "contact", 0.5, True, 0.2, 10.0, "geom solref[1]"),
    Parameter("softness", "softness of the contacts", "", "contact", 1.0, True, 1e-4, 0.95, "geom solimp: 1 - dmax"),
    Parameter("impratio", "stiffness of friction over that of the normal force", "", "contact", 1.5, True, 0.1, 1000.0, "option impratio"),
    Parameter("torsional_m", "torsional friction", "m", "contact", 1.5, True, 1e-4, 1.0, "geom friction[1]"),
    Parameter("width_scale", "width of the wheels' cylinders", "of the file's", "contact", 0.5, True, 0.1, 3.0, "geom size[1]"),
    Parameter("servo_gain", "gain of the wheels' servos", "N m s/rad", "servo", 1.0, True, 1e-3, 1e6, "velocity kv"),
    Parameter("rotor_inertia", "inertia of a wheel with its motor", "kg m^2", "servo", 1.0, True, 1e-6, 1e3, "joint armature"),
)
"""Prior sigmas: published files of skid-steer robots have mu .3 to 1.5, solref .004 to .1 s, impratio 1 to 100, kv over m g r .1 to 20."""
SLIP = Parameter("slip_stiffness", "stiffness of the contact law", "", "contact", 0.5, True, 0.5, 100.0, "numeric skidloc_contact[1]")
"""Prior sigma: between published robots' 5 and 13 (`docs/theory/contact.md`)."""
MU_RATIO = Parameter(
    "mu_ratio", "friction across the wheels over that along them", "", "contact", 0.3, True, 0.3, 3.0, "numeric skidloc_contact[2]"
)
"""Prior sigma: that of the friction model's own (`motion_models.friction.model`)."""
LAW_FIELDS = ("mu", "slip_stiffness", "servo_gain", "cg_x_m", "cg_y_m", "radius_scale", "radius_difference", "frame_x_m", "frame_y_m")
"""What is fitted with the contact law: the engine's contacts carry loads alone."""
_ROBOT = (
    Parameter("mass_kg", "mass of the robot", "kg", "robot", 0.1, True, 0.0, math.inf, "inertial mass"),
    Parameter("inertia_scale", "moments of inertia of the body", "of the file's", "robot", 0.3, True, 0.1, 10.0, "inertial diaginertia"),
    Parameter("cg_x_m", "centre of gravity ahead", "m", "robot", 0.02, False, -1.0, 1.0, "inertial pos"),
    Parameter("cg_y_m", "centre of gravity to the left", "m", "robot", 0.01, False, -1.0, 1.0, "inertial pos"),
    Parameter("cg_z_m", "height of the centre of gravity", "m", "robot", 0.1, False, 0.0, 3.0, "inertial pos"),
    Parameter("radius_scale", "radius of the wheels", "of the file's", "robot", 0.01, True, 0.5, 2.0, "geom size[0]"),
    Parameter(
        "radius_difference", "radius of the left wheels over the right, less 1", "", "robot", 0.005, False, -0.2, 0.2, "geom size[0]"
    ),
    Parameter("track_scale", "track width", "of the file's", "robot", 0.02, True, 0.5, 2.0, "body pos"),
    Parameter("wheelbase_scale", "wheelbase", "of the file's", "robot", 0.02, True, 0.5, 2.0, "body pos"),
)
"""Prior sigmas: how far robots differ from their files (`localization.diagnosis.weigh.PRIOR_SIGMAS`, `causes`)."""
_REFERENCE = (
    Parameter("frame_x_m", "frame of the measured motion, ahead", "m", "reference", 0.03, False, -0.5, 0.5, ""),
    Parameter("frame_y_m", "frame of the measured motion, to the left", "m", "reference", 0.03, False, -0.5, 0.5, ""),
)


GROUNDED: Mapping[str, float] = {"time_constant_s": 0.1, "softness": 0.9, "impratio": 10.0}
"""Contacts at which wheels that scrub stay on the ground: of a stock VaultBot all four touch in 84 to 94 % of the time steps (21 % by
MuJoCo's defaults), and its k is .58 without a fit (.25; measured .61)."""
_TWISTING = 4.0
"""condim from which on a contact has torsional friction."""


@dataclass(frozen=True)
class Switch:
    """A choice of the file that is searched beside its numbers."""

    field: str
    value: float
    meaning: str
    attribute: str


@dataclass(frozen=True)
class Hypotheses:
    """What is searched of one simulator."""

    parameters: tuple[Parameter, ...]
    priors: FloatArray
    """(p,) value at which the prior of each is centred, as searched: 0 is the file's own."""
    switches: tuple[Switch, ...]

    def index(self, field: str) -> int:
        """Index of the parameter of ``field``."""
        return next(i for i, p in enumerate(self.parameters) if p.field == field)

    @property
    def of_reference(self) -> tuple[int, ...]:
        """Indices of the parameters of the measurement: never the simulator's fault."""
        return tuple(i for i, p in enumerate(self.parameters) if p.area == "reference")

    @property
    def sigmas(self) -> FloatArray:
        """(p,) prior sigmas, as searched."""
        return np.array([p.sigma for p in self.parameters])

    def bounds(self, numbers: Numbers) -> tuple[FloatArray, FloatArray]:
        """(p,) lowest and highest value of each, as searched."""
        low, high = [], []
        for p in self.parameters:
            base = value_of(numbers, p)
            low.append(_log_ratio(p.low, base) if p.is_log else p.low - base)
            high.append(_log_ratio(p.high, base) if p.is_log else p.high - base)
        return np.array(low), np.array(high)

    @property
    def has_grounded(self) -> bool:
        """Whether the engine has contacts that may keep wheels to the ground."""
        return any(p.field in GROUNDED for p in self.parameters)

    def grounded(self, numbers: Numbers) -> FloatArray:
        """(p,) start of a search where wheels keep to the ground, as searched."""
        x, (low, high) = np.zeros(len(self.parameters)), self.bounds(numbers)
        for i, p in enumerate(self.parameters):
            if p.field in GROUNDED:
                x[i] = _log_ratio(GROUNDED[p.field], value_of(numbers, p))
        return np.clip(x, low, high)

    def applied(self, numbers: Numbers, x: FloatArray) -> Numbers:
        """``numbers`` changed by ``x`` (p,), as searched; those of the reference are no part of them."""
        new = {}
        for p, value in zip(self.parameters, x, strict=True):
            if p.area != "reference" and value != 0.0:
                base = value_of(numbers, p)
                new[p.field] = float(base * math.exp(value) if p.is_log else base + value)
        return replace(numbers, **new)


def value_of(numbers: Numbers, parameter: Parameter) -> float:
    """The number of a parameter; 0 for those of the reference."""
    return 0.0 if parameter.area == "reference" else float(getattr(numbers, parameter.field))


def hypotheses_of(simulator: Simulator, robot: Robot) -> Hypotheses:
    """What can be wrong with ``simulator``: parameters that its file has."""
    n, g = simulator.numbers, robot.geometry
    known: Mapping[str, tuple[float, float]] = {
        "mass_kg": (n.mass_kg, g.mass_kg),
        "cg_x_m": (n.cg_x_m, g.cg_x_m),
        "cg_y_m": (n.cg_y_m, g.cg_y_m),
        "cg_z_m": (n.cg_z_m, g.cg_height_m),
        "radius_scale": (n.radius_m, g.wheel_radius_m),
        "radius_difference": (n.radius_difference, 0.0),  # rates of the drive are times the wheels' multipliers
        "track_scale": (n.track_m, g.track_width_m),
        "wheelbase_scale": (n.wheelbase_m, g.wheelbase_m),
    }
    slip = () if math.isnan(n.slip_stiffness) else (SLIP, MU_RATIO)
    parameters = tuple(p for p in (*_ENGINE, *slip, *_ROBOT, *_REFERENCE) if p.field not in simulator.absent)
    parameters = tuple(_named_for(simulator, p) for p in parameters)
    return _hypotheses(parameters, known, n)


def _named_for(simulator: Simulator, p: Parameter) -> Parameter:
    """With the place that the simulator's format has for it."""
    return replace(p, attribute=GAZEBO[p.field]) if simulator.engine_name == "DART" and p.field in GAZEBO else p


def law_hypotheses(simulator: Simulator, hypotheses: Hypotheses) -> Hypotheses:
    """Those of a simulator with friction in proportion to slip."""
    kept = [i for i, p in enumerate(hypotheses.parameters) if p.field in LAW_FIELDS]
    of_law = [_named_for(simulator, p) for p in (SLIP, MU_RATIO) if p.field not in simulator.absent]
    priors = np.concatenate([np.zeros(len(of_law)), hypotheses.priors[kept]])
    return Hypotheses((*of_law, *(hypotheses.parameters[i] for i in kept)), priors, ())


def _hypotheses(parameters: tuple[Parameter, ...], known: Mapping[str, tuple[float, float]], n: Numbers) -> Hypotheses:
    """With the priors' centres, of the pairs of the file's and the robot's value that are ``known``."""
    priors = []
    for p in parameters:
        file, true = known.get(p.field, (0.0, 0.0))
        priors.append(0.0 if p.field not in known else _log_ratio(true, file) if p.is_log else true - file)
    cone = Switch("is_elliptic", 1.0 - n.is_elliptic, f"{'pyramidal' if n.is_elliptic else 'elliptic'} cones", "option cone")
    twists = n.condim >= _TWISTING
    torsion = Switch("condim", 3.0 if twists else _TWISTING, f"contacts with{'out' if twists else ''} torsional friction", "geom condim")
    return Hypotheses(parameters, np.array(priors), tuple(s for s in (cone, torsion) if not math.isnan(getattr(n, s.field))))


def _log_ratio(value: float, base: float) -> float:
    if value <= 0.0:
        return -math.inf
    return math.log(value / base) if math.isfinite(value) else math.inf
