"""Parameters that are fitted by default, and which of them are held when a drive does not reveal them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel, prior_sigmas, scales
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.identifiability import Weakness
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.param import Free

CLOCK = "wheel_time_offset"
CLOCK_SIGMA_S = 0.1
"""How far the wheels' stamps may be off, as the prior of `CLOCK`."""
_CG_MOVES_M = 0.01

_TEXTS_OF_REFERENCE = {
    CLOCK: "s: how late the wheels' stamps are against what measured the motion",
    "lidar_offset_x": "m: what the motion reference tracks, ahead of where it is taken to sit",
    "lidar_offset_y": "m: the same to the left",
}


def text_of(model: MotionModel, name: str) -> str:
    """Unit and meaning of the parameter ``name`` of ``model``, or of the motion reference; empty for others."""
    return _TEXTS_OF_REFERENCE.get(name) or next((p.text for p in model.params if p.name == name), "")


@dataclass(frozen=True)
class Calibration:
    """A fit of what the drive reveals, and what it does not."""

    fit: Fit
    held: tuple[tuple[str, str], ...]
    """Parameters that were to be fitted and are held, each with why, and what to drive to reveal it."""


def free_of(model: MotionModel, maneuvers: Sequence[Maneuver], of_rotations: bool = False) -> tuple[str, ...]:
    """Parameters of ``model`` to fit by default: more where the centre of gravity moves, and the clock where there is time around."""
    clock = (CLOCK,) if any(m.lead for m in maneuvers) else ()
    if of_rotations and (names := _ranked(model, lambda free: free.rotations)):
        return names
    only_turns = bool(maneuvers) and not any(np.isfinite(m.cov[..., 0, 0]).any() for m in maneuvers)
    if only_turns and (names := _ranked(model, lambda free: free.turns)):
        return (*names, *clock)
    cg = np.concatenate([np.atleast_2d(m.cg) for m in maneuvers]) if maneuvers else np.zeros((1, 2))
    moves = float(np.max(np.std(cg, axis=0))) > _CG_MOVES_M
    names = _ranked(model, lambda free: free.moving_cg) if moves else ()
    return (*(names or _ranked(model, lambda free: free.logs) or model.param_names), *clock)


def _ranked(model: MotionModel, rank: Callable[[Free], int]) -> tuple[str, ...]:
    """Names of the parameters of ``model`` that have a ``rank``, in its order."""
    return tuple(p.name for p in sorted(model.params, key=lambda p: rank(p.free)) if rank(p.free))


def calibrate(
    model: MotionModel, maneuvers: Sequence[Maneuver], wanted: Sequence[str], config: FitConfig, insist: bool = False
) -> Calibration:
    """Fit as many of the ``wanted`` parameters as these maneuvers reveal, those named first before the others.

    What an uncalibrated robot has by its geometry (`motion_models.prior`) is the prior of the fit, else the
    scale that a parameter declares, by which robots differ. With ``insist`` all of them or none.
    Raises what `fit` raises; `CalibrationError` where nothing is revealed.
    """
    free = list(wanted)
    held: list[tuple[str, str]] = []
    mirror = {p.name: p.mirror for p in model.params if p.mirror is not None}

    def ties() -> dict[str, tuple[str, float]]:
        return {name: tie for name, tie in mirror.items() if name not in free and tie[0] in free}

    if insist:
        return Calibration(fit(model, maneuvers, free, dataclasses.replace(config, ties={**ties(), **config.ties})), ())
    prior = zip(model.param_names, prior_sigmas(model), scales(model), strict=True)
    prior_sigma = {name: float(own or declared) for name, own, declared in prior if name in free}
    config = dataclasses.replace(config, prior_sigma=prior_sigma | dict(config.prior_sigma))
    if CLOCK in free:
        config = dataclasses.replace(config, prior_sigma={CLOCK: CLOCK_SIGMA_S, **config.prior_sigma})
    reasons: list[Weakness] = []
    while free:
        if any(name != CLOCK for name in free):
            found = fit(model, maneuvers, free, dataclasses.replace(config, strict=False, ties={**ties(), **config.ties}))
            if not found.weaknesses:
                return Calibration(found, tuple(held))
            weakness = found.weaknesses[0]
            reasons.append(weakness)
            last = max(weakness.combination, key=free.index)
            mirrored = mirror.get(last, ("", 0.0))[0] in free
            held.append((last, weakness.text + (" Held to the left side's, as of a symmetric robot." if mirrored else "")))
            free.remove(last)
        else:
            break
    texts = dict.fromkeys(weakness.text for weakness in reasons)
    raise CalibrationError("\n".join([f"this drive reveals nothing of {', '.join(wanted)}:", *texts]))
