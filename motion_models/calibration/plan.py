"""Parameters that are fitted by default, their meaning, and which of them are held when a drive does not reveal them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.identifiability import Weakness
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError

CLOCK = "wheel_time_offset"
CLOCK_SIGMA_S = 0.1
"""How far the wheels' stamps may be off, as the prior of `CLOCK`."""
_CG_MOVES_M = 0.01

FREE: Mapping[str, tuple[str, ...]] = {
    "diff_drive": ("wheel_separation_multiplier", "wheel_radius"),
    "skid_steer": ("k_0", "x_cr_0", "y_cr_0", "wheel_radius_scale"),
    "icr": ("y_icr_left", "x_icr", "alpha_left", "alpha_right", "y_icr_right"),
    "full_linear": ("wz_left", "vx_left", "vy_left", "longitudinal_slip_curvature", "wz_right", "vx_right", "vy_right"),
    "friction": ("mu_ratio", "tracked_x", "wheel_radius"),
}
"""Parameters fitted to logs, most important first: of those that cannot be separated, the last is held."""
FREE_WHERE_CG_MOVES: Mapping[str, tuple[str, ...]] = {
    "skid_steer": ("k_0", "x_cr_0", "y_cr_0", "x_cr_1", "k_2", "k_1", "y_cr_s0", "wheel_radius_scale")
}
FREE_OF_TURNS: Mapping[str, tuple[str, ...]] = {
    "diff_drive": ("wheel_separation_multiplier",),
    "skid_steer": ("k_0",),
    "icr": ("y_icr_left", "y_icr_right"),
    "full_linear": ("wz_left", "wz_right"),
    "friction": ("mu_ratio",),
}
"""Parameters fitted where only headings are measured, as by a gyro."""
FREE_OF_ROTATIONS: Mapping[str, tuple[str, ...]] = {
    "diff_drive": ("wheel_separation_multiplier",),
    "icr": ("y_icr_left", "x_icr", "y_icr_right"),
    "full_linear": ("wz_left", "vy_left", "vx_left", "wz_right", "vx_right", "vy_right"),
    "friction": ("tracked_x", "warp", "track_width", "scrub"),
}
"""Parameters fitted to a table of rotations in place."""

_SIZES = {"k_1": 1.0, "wheel_radius_scale": 0.05}
"""What counts as large where the nominal value is small only because the robot is symmetric; see `FitConfig.sizes`."""
_MIRROR: Mapping[str, tuple[str, float]] = {
    "y_icr_right": ("y_icr_left", -1.0),
    "alpha_right": ("alpha_left", 1.0),
    "wz_right": ("wz_left", -1.0),
    "vx_right": ("vx_left", 1.0),
    "vy_right": ("vy_left", -1.0),
}
"""What a robot that is symmetric has on its right: a parameter that is not fitted follows the left's, if that is."""

MEANING: Mapping[str, str] = {
    "wheel_radius": "m: how far the robot drives per radian of its wheels",
    "wheel_separation_multiplier": "track that the robot turns by, over the real one",
    "k_0": "k, yaw rate over that of wheels without slip, at CG x = 0",
    "k_1": "1/m: change of k with the CG ahead",
    "k_2": "1/m^2: how k grows when the CG leaves the middle",
    "x_cr_0": "m: centre of rotation ahead of the middle, at CG x = 0",
    "x_cr_1": "m per m that the CG moves ahead",
    "y_cr_0": "m: centre of rotation left of the middle, at CG (0, 0)",
    "y_cr_1": "m per m that the CG moves ahead",
    "y_cr_2": "1/m: the same, curved",
    "y_cr_s1": "1/m: change of y_cr_s0 with the CG ahead",
    "y_cr_s2": "1/m^2: the same, curved",
    "y_cr_s0": "m per m that the CG moves left",
    "y_icr_left": "m: where the left treads do not slip lengthwise, left of the middle",
    "y_icr_right": "m: the same of the right treads (negative)",
    "x_icr": "m: centre of rotation ahead of the middle",
    "alpha_left": "effectiveness: tread speed of the left side over that of its wheels",
    "alpha_right": "the same of the right side",
    "vx_left": "m/rad: forward motion by the left wheels",
    "vx_right": "m/rad: forward motion by the right wheels",
    "vy_left": "m/rad: sideways motion by the left wheels",
    "vy_right": "m/rad: sideways motion by the right wheels",
    "wz_left": "rad/rad: turning by the left wheels",
    "wz_right": "rad/rad: turning by the right wheels",
    "lateral_slip_speed": "s: sideways speed v wz times this",
    "longitudinal_slip_turning": "s: share of the forward speed lost per yaw rate",
    "rotation_slip_speed": "s/m: share of the yaw rate lost per speed",
    "rotation_slip_rate": "s: share of the yaw rate lost per yaw rate",
    "rotation_slip_curvature": "share of the yaw rate lost in straight driving, against turning in place",
    "wheelbase": "m: distance of the front and rear contacts",
    "mu": "friction along the wheels",
    "slip_stiffness": "slope of the contact law at zero slip",
    "rolling_resistance": "rolling resistance over load",
    "tread": "how much more the wheels grip when they slide to the left than to the right",
    "tracked_y": "m: tracked point left of the wheelbase's middle",
    "longitudinal_slip_curvature": "forward speed lost to turning, at its most",
    "mu_ratio": "friction across the wheels over that along them",
    "tracked_x": "m: tracked point ahead of the wheelbase's middle",
    "track_width": "m: distance of the left and right contacts",
    "warp": "of m g / 4: load on the front left and rear right wheels by a twisted chassis",
    "scrub": "m: yaw moment of the contact patches over mu m g",
    "wheel_radius_scale": "radius of all wheels over the robot file's, less 1",
    "wheel_radius_difference": "radius of the left wheels less the right ones', over the mean",
    CLOCK: "s: how late the wheels' stamps are against what measured the motion",
}


@dataclass(frozen=True)
class Calibration:
    """A fit of what the drive reveals, and what it does not."""

    fit: Fit
    held: tuple[tuple[str, str], ...]
    """Parameters that were to be fitted and are held, each with why, and what to drive to reveal it."""


def free_of(model: MotionModel, maneuvers: Sequence[Maneuver], of_rotations: bool = False) -> tuple[str, ...]:
    """Parameters of ``model`` to fit by default: more where the centre of gravity moves, and the clock where there is time around."""
    if of_rotations and model.name in FREE_OF_ROTATIONS:
        return FREE_OF_ROTATIONS[model.name]
    if maneuvers and not any(np.isfinite(m.cov[..., 0, 0]).any() for m in maneuvers) and model.name in FREE_OF_TURNS:
        return (*FREE_OF_TURNS[model.name], CLOCK) if any(m.lead for m in maneuvers) else FREE_OF_TURNS[model.name]
    cg = np.concatenate([np.atleast_2d(m.cg) for m in maneuvers]) if maneuvers else np.zeros((1, 2))
    plan = FREE_WHERE_CG_MOVES if float(np.max(np.std(cg, axis=0))) > _CG_MOVES_M and model.name in FREE_WHERE_CG_MOVES else FREE
    names = tuple(name for name in plan.get(model.name, model.param_names) if name in model.param_names)
    return (*names, CLOCK) if any(m.lead for m in maneuvers) else names


def calibrate(
    model: MotionModel, maneuvers: Sequence[Maneuver], wanted: Sequence[str], config: FitConfig, insist: bool = False
) -> Calibration:
    """Fit as many of the ``wanted`` parameters as these maneuvers reveal, those named first before the others.

    What an uncalibrated robot has by its geometry (`motion_models.prior`) is the prior of the fit. With ``insist`` all of them or none.
    Raises what `fit` raises; `CalibrationError` where nothing is revealed.
    """
    free = list(wanted)
    held: list[tuple[str, str]] = []

    def ties() -> dict[str, tuple[str, float]]:
        return {name: tie for name, tie in _MIRROR.items() if name not in free and tie[0] in free and name in model.param_names}

    if insist:
        return Calibration(fit(model, maneuvers, free, dataclasses.replace(config, ties={**ties(), **config.ties})), ())
    by_geometry = zip(model.param_names, getattr(model, "sigmas", ()), strict=False)
    config = dataclasses.replace(
        config, prior_sigma={n: float(s) for n, s in by_geometry if s > 0.0 and n in free} | dict(config.prior_sigma)
    )
    if CLOCK in free:
        config = dataclasses.replace(config, prior_sigma={CLOCK: CLOCK_SIGMA_S, **config.prior_sigma})
    config = dataclasses.replace(config, sizes={**{n: s for n, s in _SIZES.items() if n in model.param_names}, **config.sizes})
    reasons: list[Weakness] = []
    while free:
        if any(name != CLOCK for name in free):
            found = fit(model, maneuvers, free, dataclasses.replace(config, strict=False, ties={**ties(), **config.ties}))
            if not found.weaknesses:
                return Calibration(found, tuple(held))
            weakness = found.weaknesses[0]
            reasons.append(weakness)
            last = max(weakness.combination, key=free.index)
            mirrored = _MIRROR.get(last, ("", 0.0))[0] in free
            held.append((last, weakness.text + (" Held to the left side's, as of a symmetric robot." if mirrored else "")))
            free.remove(last)
        else:
            break
    texts = dict.fromkeys(weakness.text for weakness in reasons)
    raise CalibrationError("\n".join([f"this drive reveals nothing of {', '.join(wanted)}:", *texts]))
