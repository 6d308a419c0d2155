"""What a robot file leaves to a prior, or has for another model: notes for the user."""

from __future__ import annotations

from collections.abc import Sequence

from localization.messages import Message, message
from motion_models.prior import CALIBRATION_TURN_S, scaling_prior
from motion_models.robot import DIFF_DRIVE, Robot


def unused_terms_notes(robot: Robot, models: Sequence[str]) -> list[Message]:
    """A note where the robot's learned terms belong to none of ``models``; else none."""
    if not robot.terms or set(robot.terms) & set(models):
        return []
    return [message("robot_file.unused_terms", robot=robot.name, terms_of=", ".join(robot.terms), models=", ".join(models))]


def robot_notes(robot: Robot, models: Sequence[str] = ("skid_steer",)) -> list[Message]:
    """A note where `scaling_prior` is not None, and one where the robot's learned terms belong to none of ``models``.

    >>> from motion_models import load_robot
    >>> robot_notes(load_robot("vaultbot"))
    []
    """
    notes = unused_terms_notes(robot, models)
    found = scaling_prior(robot, models)
    if found is None:
        return notes
    if robot.drive == DIFF_DRIVE:
        return [*notes, message("robot_file.caster", robot=robot.name)]
    numbers = {"k": found.k, "sigma": found.sigma, "sigma_after": found.sigma_after_turning, "turning_s": CALIBRATION_TURN_S}
    return [*notes, message("robot_file.k_by_prior", robot=robot.name, source=found.source, **numbers)]
