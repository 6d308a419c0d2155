"""MuJoCo with the friction model's contact law on the wheels, by the module that is written beside the file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from localization.twin.mujoco_engine import MujocoEngine, advance, put_state, take_state
from localization.twin.skidloc_contact import ContactLaw
from motion_models.se2 import FloatArray

CREEP_M_S = 0.02
"""Speed that takes the place of a wheel's where it stands still [m/s]: on 5 degrees a robot of mu 0.6 and K 10 creeps by 0.3 mm/s."""


class LawEngine(MujocoEngine):
    """`MujocoEngine` of a file that has a contact law, which is called in each time step."""

    def law(self, model: Any) -> ContactLaw:
        """See `MujocoEngine.law`."""
        return ContactLaw(model)

    def _roll(self, models: Sequence[Any], start: FloatArray, control: FloatArray) -> tuple[FloatArray, FloatArray]:
        states = np.empty((*control.shape[:2], start.shape[1]))
        sensors = np.empty((*control.shape[:2], models[0].nsensordata))
        for i, model in enumerate(models):
            law, data = ContactLaw(model), put_state(model, start[i])
            for step, of_step in enumerate(control[i]):
                data.ctrl[:] = of_step
                advance(model, data, law)
                take_state(model, data, states[i, step])
                sensors[i, step] = data.sensordata
        return states, sensors
