"""From files to centres of gravity: a robot file's arms, tables of weighings, URDFs."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import numpy as np

from motion_models.center_of_gravity.cg_model import CgModel, Posture, cg_model, parse_postures
from motion_models.center_of_gravity.parts import TYPICAL, Arms, CgEstimate, Payload, StaticPart, Tolerances, require_support
from motion_models.center_of_gravity.urdf import Urdf, load_urdf, parse_urdf
from motion_models.center_of_gravity.weighing import Scales, WeighedCg, cg_from_scales, read_weighings, wheel_contacts
from motion_models.errors import CgError, RobotError, no_such
from motion_models.input_files import read_text


def arms_model(
    arms: Arms,
    folder: Path | None = None,
    payload: Payload | None = None,
    static: StaticPart | None = None,
    urdf: Urdf | None = None,
) -> CgModel:
    """The model that a robot file's ``arms`` describe. ``folder`` is where that file is; None for a robot that is shipped.

    ``static`` replaces the masses that ``arms`` give to everything else; ``payload`` comes in addition to that of ``arms``; ``urdf``
    replaces the file that ``arms`` name.

    A name that is not in the folder may be that of a file that is shipped: robots derived from one can be kept anywhere.

    Raises `RobotError` for files that are missing or malformed, `CgError` for masses that cannot be.

    >>> from motion_models import load_robot
    >>> robot = load_robot("vaultbot")
    >>> model, postures = arms_model(robot.arms), arms_postures(robot.arms)
    >>> {name: model.cg(model.chain.posture(postures[name])).round(3).tolist() for name in sorted(postures)[:2]}
    {'back_left': [-0.03, 0.02], 'back_right': [-0.03, -0.02]}
    """
    urdf = _urdf(arms, folder) if urdf is None else urdf
    if arms.payload_kg > 0.0:
        urdf = urdf.with_mass(arms.payload_link, arms.payload_kg, np.zeros(3))
    if static is None and arms.static_mass_kg > 0.0:
        sigmas = np.array([arms.static_mass_sigma_kg, arms.static_sigma_m, arms.static_sigma_m])
        weighed_at = _named(arms_postures(arms, folder), arms.weighed_posture) if arms.weighed_posture else None
        static = StaticPart(arms.static_mass_kg, np.array([arms.static_x_m, arms.static_y_m]), np.diag(sigmas**2), weighed_at)
    tolerances = Tolerances(arms.mass_sigma_fraction, arms.com_sigma_m, arms.joint_sigma)
    return cg_model(urdf, arms.base_link, arms.joints or None, static, payload, tolerances)


def arms_postures(arms: Arms, folder: Path | None = None) -> Mapping[str, Posture]:
    """Named postures of a robot file's ``arms``; empty where it has no SRDF. Raises `RobotError`."""
    return parse_postures(_text(arms.postures, folder), arms.postures) if arms.postures else {}


def weighed_cg(table: str | Path, wheelbase: float, track_width: float, scales: Scales | None = None) -> WeighedCg:
    """Centre of gravity from a CSV file of weighings (see `read_weighings`) and the wheels' distances [m]. Raises `CgError`."""
    return cg_from_scales(read_weighings(table), wheel_contacts(wheelbase, track_width), scales or Scales())


def urdf_cg(
    urdf: str | Path | Urdf,
    joints: Mapping[str, float],
    base_link: str = "base_link",
    static: StaticPart | None = None,
    payload: Payload | None = None,
    tolerances: Tolerances = TYPICAL,
    support: tuple[float, float] | None = None,
) -> CgEstimate:
    """Centre of gravity of a URDF (or its path) at ``joints`` positions by name [rad or m]; every joint that moves mass must be named.

    With ``support``, wheelbase and track width [m], a centre of gravity that does not lie between the wheels is an error. Raises
    `RobotError` and `CgError`.
    """
    model = cg_model(urdf if isinstance(urdf, Urdf) else load_urdf(urdf), base_link, None, static, payload, tolerances)
    estimate = model.estimate(model.chain.posture(joints))
    if support is not None:
        require_support(estimate.position, *support)
    return estimate


def _urdf(arms: Arms, folder: Path | None) -> Urdf:
    found = _beside(arms.urdf, folder)
    return load_urdf(found) if found is not None else parse_urdf(_text(arms.urdf, None), arms.urdf)


def _beside(name: str, folder: Path | None) -> Path | None:
    """The file that a robot file in ``folder`` means by ``name``; None for one that is shipped."""
    if folder is None or (not (folder / name).exists() and name in _shipped()):
        return None
    return folder / name


def _shipped() -> list[str]:
    return [file.name for file in (resources.files("motion_models") / "robots").iterdir()]


def _text(name: str, folder: Path | None) -> str:
    try:
        found = _beside(name, folder)
        if found is not None:
            return read_text(found)
        return (resources.files("motion_models") / "robots" / name).read_text(encoding="utf-8")
    except OSError as error:
        raise RobotError(f"'{name}', which the robot file names, cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise RobotError(f"'{name}', which the robot file names, is not text (byte {error.start} is not UTF-8).") from error


def _named(postures: Mapping[str, Posture], name: str) -> Posture:
    if name not in postures:
        raise CgError(no_such("posture", name, [*postures]))
    return postures[name]
