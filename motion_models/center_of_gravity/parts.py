"""Parts of a centre of gravity: static part, payload, tolerances; and whether it lies between the wheels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from motion_models.errors import CgError
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of masses and joints. Errors of bodies are independent."""

    mass_fraction: float = 0.02
    """Relative error of the mass of each body in the URDF."""
    com_m: float = 0.005
    """Error of the centre of mass of each body in the URDF, along each axis."""
    joint: float = 0.001
    """Error of each joint's position [rad or m]."""


TYPICAL = Tolerances()


@dataclass(frozen=True)
class StaticPart:
    """Everything but the arms."""

    mass: float
    """[kg]"""
    position: FloatArray
    """(2,) its centre of gravity in the base's frame [m]."""
    covariance: FloatArray
    """(3, 3) of mass, x, y [kg, m, m]."""
    weighed_at: Mapping[str, float] | None = None
    """Joint positions at which the arms were subtracted from a weighing. Errors of the arms' masses then cancel at
    this posture; at others they count by how far the arms have moved. None: the static part was measured by itself."""


@dataclass(frozen=True)
class Payload:
    """A mass held at a link, for example a gripper."""

    link: str
    mass: float
    """[kg]"""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its centre of mass in the link's frame [m]."""
    mass_sigma: float = 0.0
    """[kg]"""
    position_sigma: float = 0.0
    """Along each axis [m]."""


@dataclass(frozen=True)
class CgEstimate:
    """Centre of gravity in the body frame, with its covariance."""

    position: FloatArray
    """(2,) centre of gravity in the base's frame [m]."""
    covariance: FloatArray
    """(2, 2) [m^2]."""
    mass: float
    """Mass of the whole robot [kg]."""

    def margin(self, wheelbase: float, track_width: float) -> float:
        """How far it lies inside the rectangle of the wheels' contacts [m]; below 0 the robot tips over."""
        return float(support_margin(self.position, wheelbase, track_width))


def support_margin(cg: FloatArray, wheelbase: float, track_width: float) -> FloatArray:
    """(...,) distance of ``cg`` (..., 2) to the nearest edge of the wheels' contacts [m], below 0 outside, where the robot tips over."""
    return np.asarray(np.minimum(wheelbase / 2.0 - np.abs(cg[..., 0]), track_width / 2.0 - np.abs(cg[..., 1])))


def require_support(cg: FloatArray, wheelbase: float, track_width: float) -> None:
    """Raises `CgError` where ``cg`` (2,) lies outside the wheels' contacts: the robot would tip over."""
    if not support_margin(cg, wheelbase, track_width) >= 0.0:
        raise CgError(
            f"centre of gravity ({cg[0]:.3f}, {cg[1]:.3f}) m lies outside the wheels' contacts (|x| <= {wheelbase / 2:.3f}, "
            f"|y| <= {track_width / 2:.3f}): the robot would tip over. Check masses, joint positions (radians) and payload."
        )


@dataclass(frozen=True)
class Arms:
    """The arms of a robot file."""

    urdf: str
    """URDF with the arms' masses: a path from the robot file's folder, or a file that is shipped. xacro must be expanded first."""
    base_link: str = "base_link"
    """Link of the URDF whose frame is the body frame: its origin below or above the wheelbase's centre, x forward, y left."""
    joints: tuple[str, ...] = ()
    """Joints whose positions are in the log; by default all that can move the centre of gravity. Others are taken to stand at 0."""
    postures: str = ""
    """SRDF with named postures, a path in the same way."""
    static_mass_kg: float = 0.0
    """Mass of everything but the arms; 0 where the URDF's masses are to be used for that too."""
    static_x_m: float = 0.0
    """Its centre of gravity ahead of the wheelbase's centre."""
    static_y_m: float = 0.0
    """Its centre of gravity left of the wheelbase's centre."""
    static_mass_sigma_kg: float = 0.2
    """Standard deviation of its mass."""
    static_sigma_m: float = 0.005
    """Standard deviation of its centre of gravity, along x and along y."""
    payload_kg: float = 0.0
    """Mass that the robot carries besides what the URDF has, fixed at the origin of `payload_link`."""
    payload_link: str = ""
    """Link of the URDF that holds it, as a gripper."""
    weighed_posture: str = ""
    """Named posture in which the robot was weighed, where the static part comes from a weighing minus the arms: errors of the arms'
    masses cancel there."""
    mass_sigma_fraction: float = TYPICAL.mass_fraction
    """Relative standard deviation of each arm body's mass."""
    com_sigma_m: float = TYPICAL.com_m
    """Standard deviation of each arm body's centre of mass."""
    joint_sigma: float = TYPICAL.joint
    """Standard deviation of each joint's position [rad or m]."""
