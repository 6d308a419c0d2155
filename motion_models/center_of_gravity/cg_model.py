"""Centre of gravity of a robot with arms at any joint positions, with covariance; and postures that bring it to a given place.

Ebersole 2016, sec. 4.2.1.2: the static part is a weighed total (`center_of_gravity.weighing`) minus the arms at the weighed posture, and
the total at another posture is the static part plus the arms there. Without a weighing, the static part is that of the URDF.
"Arms" are all bodies that hang on a joint that can move the centre of mass; all else, wheels included, is the static part.

For `posture_for`: the thesis moved the arms by hand until the computed CG was close enough to each point of a grid; twelve joints for two
coordinates leave the choice of posture open, and here it is the one near a given posture.
"""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motion_models.center_of_gravity.kinematics import COM, MASS, Chain, IntArray, body_moment, flatten, forward, subtree_jacobian
from motion_models.center_of_gravity.parts import TYPICAL, CgEstimate, Payload, StaticPart, Tolerances
from motion_models.center_of_gravity.urdf import Link, Urdf
from motion_models.center_of_gravity.weighing import WeighedCg
from motion_models.compiled import kernel, subroutine
from motion_models.errors import CgError, RobotError
from motion_models.se2 import FloatArray

Posture = Mapping[str, float]
"""Joint positions by name [rad or m]."""

_STEPS = 200
_LONGEST_STEP = 0.2
_CLOSE_ENOUGH = 1e-9


def static_part_from_weighing(weighed: WeighedCg, chain: Chain, posture: Mapping[str, float]) -> StaticPart:
    """What is left of a weighed robot when its arms, which stood at ``posture``, are taken away.

    The covariance is the weighing's alone; ``weighed_at`` is how the arms' errors enter. Raises `CgError` where the arms weigh
    more than all, `RobotError` for joints that are missing or unknown.
    """
    q = chain.posture(posture)
    arms_mass = chain.mass - chain.constants[0, MASS]
    mass = weighed.mass - arms_mass
    if mass <= 0.0:
        raise CgError(f"the scales show {weighed.mass:.2f} kg, but the arms in {chain.source} alone have {arms_mass:.2f} kg.")
    arms_moment = (chain.center_of_mass(q) * chain.mass - base_com(chain) * chain.constants[0, MASS])[:2]
    position = (weighed.mass * weighed.position - arms_moment) / mass
    # d(x_s) = [(x_w - x_s) d(m) + m_w d(x_w)] / m_s
    jacobian = np.zeros((3, 3))
    jacobian[0, 0] = 1.0
    jacobian[1:, 0] = (weighed.position - position) / mass
    jacobian[1:, 1:] = np.eye(2) * weighed.mass / mass
    return StaticPart(mass, position, jacobian @ weighed.covariance @ jacobian.T, dict(posture))


def base_com(chain: Chain) -> FloatArray:
    """(3,) centre of mass of the static part in the base's frame, as the URDF has it [m]."""
    rotations, translations = np.empty((len(chain.layout), 3, 3)), np.empty((len(chain.layout), 3))
    forward(chain.layout, chain.constants, np.zeros(len(chain.joint_names)), rotations, translations)
    return np.asarray(translations[0] + rotations[0] @ chain.constants[0, COM:])


@dataclass(frozen=True)
class CgModel:
    """Centre of gravity as a function of joint positions (..., n), in the order of ``chain.joint_names``. Made by `cg_model`."""

    chain: Chain
    """The whole robot: its body 0 is the static part, and the payload is in it."""
    static: StaticPart
    tolerances: Tolerances
    payload: Payload | None
    arms: FloatArray
    """(b, 18) `Chain.constants` without the payload."""
    numbers: FloatArray
    """(19,) payload: body, place (3) in the body's frame [m], mass [kg], sigma of mass [kg] and of place [m], zeros where there is none;
    then the three `Tolerances`, then the static part's covariance (9)."""
    weighed_poses: FloatArray
    """(b, 3, 4) rotations and translations of the bodies at the weighing, or (0, 3, 4)."""
    mass: float
    """Mass of the whole robot with its payload [kg]."""

    def cg(self, positions: FloatArray) -> FloatArray:
        """(..., 2) centre of gravity in the base's frame [m]."""
        return self.chain.center_of_mass(positions)[..., :2]

    def jacobian(self, positions: FloatArray) -> FloatArray:
        """(..., 2, n) derivative of `cg` by the joint positions [m/rad or 1]."""
        return self.chain.center_of_mass_jacobian(positions)[..., :2, :]

    def estimate(self, positions: FloatArray) -> CgEstimate:
        """Centre of gravity at ``positions`` (n,) with its covariance. Raises `CgError` for another number of joints."""
        chain, found = self.chain, np.zeros((3, 2))
        q = np.ascontiguousarray(positions, dtype=float)
        if q.shape != chain.lower.shape:
            raise CgError(f"{chain.source} needs positions of {', '.join(chain.joint_names)}; got an array of shape {q.shape}.")
        _estimate(chain.layout, chain.constants, self.arms, self.numbers, self.weighed_poses, q, found)
        return CgEstimate(found[0], found[1:], self.mass)


def cg_model(
    urdf: Urdf,
    base_link: str = "base_link",
    joints: tuple[str, ...] | None = None,
    static: StaticPart | None = None,
    payload: Payload | None = None,
    tolerances: Tolerances = TYPICAL,
) -> CgModel:
    """The model of ``urdf``; ``joints`` as in `flatten`. ``static`` replaces the URDF's masses of everything but the arms.

    Raises `CgError` for a payload or a static part that cannot be, and whatever `flatten` does.
    """
    chain = flatten(urdf, base_link, joints)
    base = base_com(chain)
    if static is None:
        mass = float(chain.constants[0, MASS])
        if mass <= 0.0:
            raise CgError(f"{urdf.source}: nothing but its arms has a mass; give the static part's mass and centre of gravity.")
        sigmas = np.array([mass * tolerances.mass_fraction, tolerances.com_m, tolerances.com_m])
        static = StaticPart(mass, base[:2], np.diag(sigmas**2))
    elif not (np.isfinite(static.mass) and static.mass > 0.0 and np.all(np.isfinite(static.position))):
        raise CgError(f"static part: {static.mass} kg at {static.position}; its mass must be positive, its place finite.")
    else:
        links = {name: Link(name, 0.0, np.zeros(3)) if body == 0 else urdf.links[name] for name, (body, _) in chain.links.items()}
        links[base_link] = Link(base_link, static.mass, np.array([*static.position, base[2]]))
        stiff = tuple(dataclasses.replace(j, kind="fixed", mimic=None) if chain.links[j.child][0] == 0 else j for j in urdf.joints)
        urdf = dataclasses.replace(urdf, links=links, joints=stiff)
        joints = None if joints is None else tuple(j.name for j in stiff if j.moves and j.name in joints)

    load = np.zeros(7)
    if payload is not None:
        sigmas = np.array([payload.mass_sigma, payload.position_sigma])
        if not (np.isfinite(payload.mass) and payload.mass > 0.0):
            raise CgError(f"payload at {payload.link}: mass is {payload.mass} kg; it must be positive.")
        if not (len(payload.position) == 3 and np.all(np.isfinite([*payload.position, *sigmas])) and np.all(sigmas >= 0.0)):
            raise CgError(f"payload at {payload.link}: its place must be three finite numbers and its sigmas not below 0, found {payload}.")
        urdf = urdf.with_mass(payload.link, payload.mass, np.array(payload.position))
    # Once more: a payload off the axis can make a joint matter that did not.
    chain = flatten(urdf, base_link, joints)
    if payload is not None:
        body, point = chain.point(payload.link, np.array(payload.position))
        load = np.array([body, *point, payload.mass, *sigmas])
    numbers = np.array([*load, tolerances.mass_fraction, tolerances.com_m, tolerances.joint, *static.covariance.ravel()])
    poses = _poses_at(chain, static.weighed_at)
    return CgModel(chain, static, tolerances, payload, _without(chain, load), numbers, poses, chain.mass)


def _without(chain: Chain, load: FloatArray) -> FloatArray:
    """`Chain.constants` with the payload taken out again."""
    constants, body, mass = chain.constants.copy(), int(load[0]), load[4]
    rest = constants[body, MASS] - mass
    if mass > 0.0:
        moment = constants[body, MASS] * constants[body, COM:] - mass * load[1:4]
        constants[body, MASS], constants[body, COM:] = (rest, moment / rest) if rest > 1e-9 else (0.0, 0.0)
    return constants


def _poses_at(chain: Chain, posture: Mapping[str, float] | None) -> FloatArray:
    if posture is None:
        return np.empty((0, 3, 4))
    # A joint that only the payload makes matter may have stood anywhere: it moved no mass.
    q = np.array([posture.get(name, 0.0) for name in chain.joint_names])
    rotations, translations = np.empty((len(chain.layout), 3, 3)), np.empty((len(chain.layout), 3))
    forward(chain.layout, chain.constants, q, rotations, translations)
    return np.concatenate([rotations, translations[:, :, None]], axis=2)


class _Posed(NamedTuple):
    """Poses of all bodies at one posture, with the composite CG."""

    rotations: FloatArray
    """(b, 3, 3)"""
    translations: FloatArray
    """(b, 3) [m]"""
    cg: FloatArray
    """(2,) [m]"""
    mass: float
    """Mass of all bodies [kg]."""


@kernel
def _estimate(
    layout: IntArray,
    constants: FloatArray,
    arms: FloatArray,
    numbers: FloatArray,
    weighed_poses: FloatArray,
    positions: FloatArray,
    found: FloatArray,
) -> None:
    """`CgModel.estimate` at ``positions`` (n,), into ``found`` (3, 2), which starts at zero: the CG, and its covariance below it.

    First order: the CG is a quotient of sums, and each error moves it by (its moment - the CG times its mass) / total mass.
    """
    cg, cov = found[0], found[1:]
    load, tolerances, static_cov = numbers[:7], numbers[7:10], numbers[10:].reshape(3, 3)
    bodies = layout.shape[0]
    rotations, translations = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    forward(layout, constants, positions, rotations, translations)
    total = 0.0
    for i in range(bodies):
        total += constants[i, MASS]
        for row in range(2):
            cg[row] += body_moment(constants, rotations, translations, i, row)
    cg[0] /= total
    cg[1] /= total
    at = _Posed(rotations, translations, cg, total)
    _add_static_part(at, arms, static_cov, cov)
    for i in range(1, bodies):
        _add_arm_body(at, arms, weighed_poses, i, tolerances, cov)
    by_joint = np.zeros((3, positions.shape[0]))
    subtree_jacobian(layout, constants, rotations, translations, by_joint)
    for k in range(positions.shape[0]):
        _add_outer(cov, by_joint[:2, k], tolerances[2] ** 2 / total**2)
    if load[4] > 0.0:
        _add_payload(at, load, cov)


@subroutine
def _add_outer(cov: FloatArray, vector: FloatArray, variance: float) -> None:
    """Add ``variance`` times the outer square of ``vector`` (2,) to ``cov`` (2, 2)."""
    for row in range(2):
        for column in range(2):
            cov[row, column] += variance * vector[row] * vector[column]


@subroutine
def _add_static_part(at: _Posed, arms: FloatArray, static_cov: FloatArray, cov: FloatArray) -> None:
    """The static part's place moves the CG by its share of the mass, its mass by its lever."""
    share = arms[0, MASS] / at.mass
    lever = np.empty(2)
    for row in range(2):
        lever[row] = (body_moment(arms, at.rotations, at.translations, 0, row) / arms[0, MASS] - at.cg[row]) / at.mass
    for row in range(2):
        for column in range(2):
            cov[row, column] += (
                share * share * static_cov[1 + row, 1 + column]
                + share * (static_cov[1 + row, 0] * lever[column] + lever[row] * static_cov[0, 1 + column])
                + static_cov[0, 0] * lever[row] * lever[column]
            )


@subroutine
def _add_arm_body(at: _Posed, arms: FloatArray, weighed_poses: FloatArray, body: int, tolerances: FloatArray, cov: FloatArray) -> None:
    """Errors of an arm's body in mass and centre of mass. They were in the weighed total too, and so count by what moved since."""
    weighed = weighed_poses.shape[0] > 0
    mass = arms[body, MASS]
    lever, spread = np.empty(2), np.empty((2, 3))
    for row in range(2):
        place = body_moment(arms, at.rotations, at.translations, body, row) / mass if mass > 0.0 else 0.0
        before = weighed_poses[body, row, 3] if weighed else at.cg[row]
        for column in range(3):
            spread[row, column] = at.rotations[body, row, column]
            if weighed:
                before += weighed_poses[body, row, column] * arms[body, COM + column]
                spread[row, column] -= weighed_poses[body, row, column]
        lever[row] = (place - before) * mass / at.mass
    _add_outer(cov, lever, tolerances[0] ** 2)
    for column in range(3):
        _add_outer(cov, spread[:, column], (tolerances[1] * mass / at.mass) ** 2)


@subroutine
def _add_payload(at: _Posed, load: FloatArray, cov: FloatArray) -> None:
    """Errors of the payload's mass and place; ``load`` (7,) as in `CgModel.numbers`."""
    body = int(load[0])
    lever = np.empty(2)
    for row in range(2):
        place = at.translations[body, row]
        for k in range(3):
            place += at.rotations[body, row, k] * load[1 + k]
        lever[row] = (place - at.cg[row]) * load[5] / at.mass
    _add_outer(cov, lever, 1.0)
    for row in range(2):
        cov[row, row] += (load[6] * load[4] / at.mass) ** 2


_AT_REST = 1e-4
"""Joints that move by less [rad or m] rest: noise of encoders. An arm of 1 m with a tenth of the mass moves the CG by 0.01 mm so."""


class CgTracker:
    """Stores each joint's last position: on ROS robots wheels, left arm and right arm often publish joint states separately."""

    def __init__(self, model: CgModel) -> None:
        """All joints of ``model`` are `missing` at first."""
        self.model = model
        self._positions = np.full(len(model.chain.joint_names), np.nan)
        self._columns: dict[tuple[str, ...], tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._estimate: CgEstimate | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints without a position so far."""
        return tuple(name for name, q in zip(self.model.chain.joint_names, self._positions, strict=True) if np.isnan(q))

    def update(self, names: Sequence[str], positions: ArrayLike) -> CgEstimate | None:
        """Take one joint-state message: ``names`` and ``positions`` [rad or m] in any order, with other joints among them.

        The centre of gravity, the same object as before while no joint moves by more than `_AT_REST`; None where the message has nothing of
        the arms (no joint of theirs, no positions, which ROS allows, or none that is finite), and as long as joints are `missing`. Raises
        `CgError` where names and positions differ in number.
        """
        values = np.asarray(positions, dtype=float)
        if values.size == 0:
            return None
        if values.shape != (len(names),):
            raise CgError(f"joint state with {len(names)} names ({', '.join(names)}) but positions of shape {values.shape}.")
        key = tuple(names)
        if key not in self._columns:
            known = {name: i for i, name in enumerate(self.model.chain.joint_names)}
            pairs = [(column, known[name]) for column, name in enumerate(key) if name in known]
            self._columns[key] = (np.array([p[0] for p in pairs], dtype=np.intp), np.array([p[1] for p in pairs], dtype=np.intp))
        columns, joints = self._columns[key]
        given = values[columns]
        finite = [*map(math.isfinite, given.tolist())]  # quicker than numpy's, on a handful
        if not any(finite):
            return None
        if all(finite):
            if self._estimate is not None and np.abs(given - self._positions[joints]).max() <= _AT_REST:
                return self._estimate
            self._positions[joints] = given
        else:
            self._positions[joints[finite]] = given[finite]
        if any(map(math.isnan, self._positions.tolist())):
            return None
        self._estimate = self.model.estimate(self._positions)
        return self._estimate


def parse_postures(text: str, source: str) -> dict[str, dict[str, float]]:
    """The <group_state> elements of an SRDF text, by name; states of several groups with one name are joined. Raises `RobotError`."""
    try:
        root = ET.fromstring(text.encode())
    except ET.ParseError as error:
        raise RobotError(f"{source}: not valid XML: {error}.") from error
    postures: dict[str, dict[str, float]] = {}
    for state in root.iter("group_state"):
        name = state.get("name")
        if not name:
            raise RobotError(f"{source}: a <group_state> has no name.")
        posture = postures.setdefault(name, {})
        for joint in state.findall("joint"):
            try:
                value = float(joint.get("value", ""))
            except ValueError:
                value = math.nan
            if not joint.get("name") or not math.isfinite(value):
                raise RobotError(f"{source}, posture '{name}': joint {joint.get('name')} has value {joint.get('value')!r}, not one number.")
            posture[joint.get("name", "")] = value
    if not postures:
        raise RobotError(f"{source}: no <group_state> in it; an SRDF names postures by them.")
    return postures


def posture_for(model: CgModel, cg: FloatArray, starts: Mapping[str, Posture]) -> dict[str, float]:
    """A posture whose centre of gravity is ``cg`` (2,) [m], near that of ``starts`` whose own CG is nearest to it.

    The way there is the shortest in joint positions, step by step, and within the joints' limits. Collisions are not checked: start
    from postures with room around them. Where one start fails, the next nearest is tried. Raises `CgError` where none reaches.
    """
    names = model.chain.joint_names
    if not starts or not names:
        raise CgError(f"no posture to start from, or no arms: {model.chain.source} has joints {', '.join(names) or 'none'}.")
    rows = np.array([model.chain.posture(start) for start in starts.values()])
    order = np.argsort(np.linalg.norm(model.cg(rows) - cg, axis=1), kind="stable")
    nearest, best = np.full(2, np.nan), math.inf
    for index in order:
        q = _reach(model, np.asarray(cg, dtype=float), rows[index])
        miss = float(np.linalg.norm(model.cg(q) - cg))
        if miss <= _CLOSE_ENOUGH:
            return {**list(starts.values())[index], **dict(zip(names, q.tolist(), strict=True))}
        if miss < best:
            nearest, best = model.cg(q), miss
    raise CgError(
        f"no arm posture puts the centre of gravity at ({cg[0]:.3f}, {cg[1]:.3f}) m; the nearest that was found is "
        f"({nearest[0]:.3f}, {nearest[1]:.3f}) m."
    )


def _reach(model: CgModel, cg: FloatArray, start: FloatArray) -> FloatArray:
    """(n,) positions from ``start`` (n,) by damped least-norm Newton steps; joints whose step leaves their limits stay there."""
    lower, upper = model.chain.lower, model.chain.upper
    q = np.clip(start, lower, upper)
    for _ in range(_STEPS):
        miss = cg - model.cg(q)
        if np.linalg.norm(miss) <= 0.1 * _CLOSE_ENOUGH:
            break
        jacobian = model.jacobian(q)
        for _ in range(2):
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-9 * np.eye(2), miss)
            pushing = ((q <= lower) & (step < 0.0)) | ((q >= upper) & (step > 0.0))
            jacobian[:, pushing] = 0.0
        longest = float(np.max(np.abs(step)))
        q = np.clip(q + step * min(1.0, _LONGEST_STEP / longest) if longest > 0.0 else q, lower, upper)
    return q
