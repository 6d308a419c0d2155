"""Named postures of arms (from SRDF files), and postures that bring the centre of gravity to a given place.

Ebersole 2016, sec. 4.2.1.2, moved the arms by hand until the computed CG was close enough to each point of a grid; twelve joints for two
coordinates leave the choice of posture open, and here it is the one near a given posture.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping

import numpy as np

from motion_models.center_of_gravity.model import CgModel
from motion_models.errors import CgError, RobotError
from motion_models.se2 import FloatArray

Posture = Mapping[str, float]
"""Joint positions by name [rad or m]."""

_STEPS = 200
_LONGEST_STEP = 0.2
_CLOSE_ENOUGH = 1e-9


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

    The way there is the shortest in joint positions, step by step, and within the joints' limits. Collisions are not looked at: start
    from postures with room around them. Where one start leads nowhere, the next nearest is tried. Raises `CgError` where none reaches.
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
    """(n,) positions from ``start`` (n,) by damped least-norm Newton steps; joints that stand at a limit and push against it rest."""
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
