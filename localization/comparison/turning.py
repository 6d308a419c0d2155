"""How a robot turned over a drive, for any motion model: rotation scaling k and centre of rotation with what was learned of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from localization.events import CgSample, Event
from motion_models.base import MotionModel
from motion_models.online_calibration import Form, add_correction_parameters, make_corrections
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_IN_PLACE = np.array([-1.0, 1.0])
"""Wheel rates [rad/s]: turning in place to the left."""


class Turning(NamedTuple):
    """Rotation scaling and centre of rotation while turning in place, with standard deviations; names as in the table's columns."""

    k: float
    """Yaw rate over that of wheels without slip [-]."""
    k_sigma: float | None
    """None where nothing of it was learned."""
    centre_x_m: float
    """Centre of rotation ahead of the body's origin, -vy / wz (Ebersole 2016, eq. 4.9)."""
    centre_x_sigma_m: float | None
    centre_y_m: float
    """To the left, vx / wz."""
    centre_y_sigma_m: float | None


def turning(
    model: MotionModel, robot: Robot, cg: FloatArray, form: Form = "none", learned: Mapping[str, tuple[float, float]] | None = None
) -> Turning:
    """Turning of ``model`` with its CG at ``cg`` (2,) [m] and corrections of ``form`` as ``learned``: mean and standard deviation by name.

    Errors of several corrections are taken as independent: their correlation is not in a run's result.
    """
    model = add_correction_parameters(model, form)
    corrections = make_corrections(model, form)
    nominal = dict(zip(model.param_names, model.nominal.tolist(), strict=True))
    found = [(learned or {}).get(name, (nominal.get(name, 0.0), 0.0)) for name in corrections.names]
    values = np.array([mean - nominal.get(name, 0.0) for name, (mean, _) in zip(corrections.names, found, strict=True)])
    twist = model.twist(_IN_PLACE, cg, model.nominal + corrections.directions @ values)
    vx, vy, wz = twist.value.tolist()
    d_vx, d_vy, d_wz = twist.d_params @ (corrections.directions * np.array([sigma for _, sigma in found]))
    no_slip = 2.0 * robot.geometry.wheel_radius_m / robot.geometry.track_width_m
    scaled = d_wz / no_slip, (vy * d_wz / wz - d_vy) / wz, (d_vx - vx * d_wz / wz) / wz
    sigmas = [float(np.linalg.norm(part)) if part.any() else None for part in scaled]
    return Turning(wz / no_slip, sigmas[0], -vy / wz, sigmas[1], vx / wz, sigmas[2])


class MeanCg:
    """Mean of the CG over time while events pass through `watch`."""

    def __init__(self, initial: FloatArray) -> None:
        """``initial`` (2,) holds where no event has one [m]."""
        self._initial = initial
        self._sum, self._count = np.zeros(2), 0

    def watch(self, events: Iterable[Event]) -> Iterator[Event]:
        """Pass the events on, and take the CG of each that has one into the mean."""
        for event in events:
            if isinstance(event, CgSample):
                self._sum += event.position
                self._count += 1
            yield event

    @property
    def value(self) -> FloatArray:
        """(2,) [m]"""
        return self._sum / self._count if self._count else self._initial
