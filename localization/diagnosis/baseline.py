"""How a healthy robot differs from its file: estimated on a drive without faults, and taken off before later drives are diagnosed.

Floors, tyres and contacts differ from the friction model in small ways that nobody calls a fault. All lasting causes are estimated together
by `estimate_map` of `localization.diagnosis.weigh`, each with its prior; how a difference is shared among causes that turn the robot alike
does not matter, as only the motion that they predict together is used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import with_sizes
from localization.diagnosis.causes.floor import slip_stiffness_cause, stiffness_exponent_cause
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import Baseline, DrivePredictor
from localization.diagnosis.linearization import candidate_causes, make_predictor, setting_of
from localization.diagnosis.noise import Noise
from localization.diagnosis.weigh import PRIOR_SIGMAS, estimate_map
from motion_models.base import MotionModel
from motion_models.errors import CalibrationError
from motion_models.friction import FrictionModel

_MIN_WINDOWS = 16
_SLIPS: Mapping[str, float] = {
    "lateral_slip_speed": 0.05,
    "rotation_slip_speed": 0.1,
    "longitudinal_slip_turning": 0.1,
    "rotation_scale": 0.5,
}
"""Sigma of slips that grow with speed: their typical sizes, in their units; and of rotations that no friction model predicts. Another grip
than the file's slides sideways in curves, as the first one does."""
_CG_SIGMA_M = 0.01
"""Sigma of the centre of gravity by robot files [m], with batteries and cables that these do not have."""
_PASSING = frozenset({"gyro_bias", "slope"})
"""Causes of one drive alone, which the baseline does not have."""


def estimate_baseline(drive: Drive, model: MotionModel) -> Baseline:
    """Differences of the robot of ``drive`` from its file that last, and what noise they leave.

    Raises `CalibrationError` for a drive with too few windows.
    """
    if len(drive.maneuvers) < _MIN_WINDOWS:
        measured = f"only {len(drive.maneuvers)} windows of motion were measured"
        raise CalibrationError(f"{drive.name}: {measured}; a healthy drive to compare with takes {_MIN_WINDOWS}.")
    predictor = make_predictor(drive, model)
    sigmas = {**PRIOR_SIGMAS, **_SLIPS, "cg_offset_x": _CG_SIGMA_M, "cg_offset_y": _CG_SIGMA_M}
    causes = [dataclasses.replace(c, prior_sigma=sigmas[c.id]) for c in candidate_causes(predictor, moments=0) if c.id in sigmas]
    if model.name == FrictionModel.name:
        height = CAUSES["cg_height"]
        causes += [dataclasses.replace(c, prior_sigma=c.typical) for c in height.variants(height, setting_of(predictor))]
        causes += [slip_stiffness_cause(drive.robot), stiffness_exponent_cause()]
    found = estimate_map(predictor, tuple(causes))
    lasting = with_sizes({c: float(v) for c, v in zip(found.causes, found.sizes, strict=True) if c.id not in _PASSING})
    noise = found.linearization.noise
    return Baseline(lasting, _noise_over_reference(predictor, noise), noise.freedom)


def _noise_over_reference(predictor: DrivePredictor, noise: Noise) -> tuple[float, float, float]:
    """Median over the windows of the noise of x, y and yaw, over the motion reference's; 1 where that measured nothing."""
    given = np.sqrt(np.diagonal(predictor.batch.cov, axis1=1, axis2=2))
    ratios = []
    for channel in range(3):
        usable = np.isfinite(given[:, channel]) & (given[:, channel] > 0.0)
        ratios.append(float(np.median(noise.sigmas[usable, channel] / given[usable, channel])) if usable.any() else 1.0)
    return ratios[0], ratios[1], ratios[2]
