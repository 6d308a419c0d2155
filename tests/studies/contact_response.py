"""How far contact laws differ in what a load does: slopes of the centre of rotation by the centre of gravity, by law and slip stiffness.

python -m tests.studies.contact_response

A healthy drive shows how contacts turn a robot, and not how they respond to a load. Laws are the two of the friction model, with the slip
stiffnesses that were measured on robots: 5.9 to 13.3, the 95 % interval of the thesis's 84 runs and its own value, between which those of
two Warthogs and of its grid lie (`tests.studies.contact_law`). The scatter of the slope over its mean is the error of a size that the
response has (`model_error`).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from localization.diagnosis.friction_response import quasi_static_twists
from motion_models.friction import FrictionModel
from motion_models.friction.contact import SATURATION
from motion_models.robot_file import load_robot

ROBOTS = ("husky_a200", "jackal", "warthog", "scout_2")
STIFFNESSES = np.geomspace(5.9, 13.3, 5)
MOTIONS = {"in place": (-2.0, 2.0), "tight arc": (1.0, 3.0), "arc": (1.6, 2.4), "gentle arc": (2.6, 3.2)}
"""Rates of the left and right wheels [rad/s]."""
_SHIFT = 0.03
"""Of the centre of gravity, over wheelbase."""


def slopes(robot_name: str, motion: str) -> np.ndarray:
    """(laws x stiffnesses,) metres by which the centre of rotation moves ahead per metre of the centre of gravity."""
    robot, found = load_robot(robot_name), []
    shift = _SHIFT * robot.geometry.wheelbase_m
    wheels, centers = np.tile(MOTIONS[motion], (2, 1)), np.array([[0.0, 0.0], [shift, 0.0]])
    for saturation in SATURATION.values():
        law = dataclasses.replace(FrictionModel.from_robot(robot), saturation=saturation)
        for stiffness in STIFFNESSES:
            params = law.nominal.copy()
            params[law.param_names.index("slip_stiffness")] = stiffness
            twists = quasi_static_twists(law, params, wheels, centers, 0.0)
            ahead = -twists[:, 1] / twists[:, 2]
            found.append((ahead[1] - ahead[0]) / shift)
    return np.array(found)


def main() -> None:
    scatters = []
    print(f"{'robot':12s}", *(f"{motion:>20s}" for motion in MOTIONS))
    for robot in ROBOTS:
        found = [slopes(robot, motion) for motion in MOTIONS]
        scatters += [s.std(ddof=1) / s.mean() for s in found]
        print(f"{robot:12s}", *(f"{s.mean():9.2f} +- {100 * s.std(ddof=1) / s.mean():5.1f} %" for s in found))
    print(f"scatter over the mean, root mean square: {np.sqrt(np.mean(np.square(scatters))):.3f}")


if __name__ == "__main__":
    main()
