"""Experiment design: the short maneuver in which the causes that explain a drive equally well predict most differently."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from localization.diagnosis.causes import CAUSES, WINDOW_CAUSES, Cause
from localization.diagnosis.drive import drive_of_table
from localization.diagnosis.findings import Finding
from localization.diagnosis.prediction import DrivePredictor, with_sizes
from motion_models.calibration.maneuvers import Maneuver
from motion_models.se2 import FloatArray

_SECONDS, _DT = 20.0, 0.1
_WINDOW = 20  # intervals
_SIGMA = np.array([0.004, 0.004, 0.003])
_MAX_S = 120.0
_ENOUGH = 9.0  # twice the log-likelihood that decides


def candidate_maneuvers(speed: float, radius: float, cg: FloatArray, has_arms: bool, track: float) -> list[tuple[str, list[Maneuver]]]:
    """Drives of 20 s in windows of 2 s, each with what to call it; ``speed`` [m/s] of the drive that was diagnosed."""
    rate = max(speed, 0.3) / radius
    turn = 0.35 * rate
    n = round(_SECONDS / _DT)
    t = np.arange(n) * _DT
    pace = np.where((t % 10.0) < 5.0, 0.6, 1.4)
    wave = np.sign(np.sin(2.0 * math.pi * t / 10.0 + 1e-9))
    halting = np.where((t % 4.0) < 2.0, 1.0, 0.05)
    half = np.where(np.arange(n) % (2 * _WINDOW) < _WINDOW, 1.0, -1.0)

    def table(left: FloatArray, right: FloatArray, at: FloatArray) -> list[Maneuver]:
        wheels = np.column_stack([left, right])
        ends = np.array([_WINDOW])
        parts = [wheels[i : i + _WINDOW] for i in range(0, n, _WINDOW)]
        return [Maneuver(np.full(_WINDOW, _DT), p, np.zeros((1, 3)), ends, at, np.diag(_SIGMA**2)) for p in parts]

    found = [
        ("straight driving, forwards and backwards", table(rate * wave, rate * wave, cg)),
        ("straight driving to and fro, slow and fast", table(rate * wave * pace, rate * wave * pace, cg)),
        ("turning in place, both ways", table(-turn * half, turn * half, cg)),
        ("turning in place, fast and slow", table(-turn * (1.2 + half), turn * (1.2 + half), cg)),
        ("gentle arcs to both sides", table(rate * (1.0 - 0.15 * half), rate * (1.0 + 0.15 * half), cg)),
        ("tight arcs to both sides", table(rate * (1.0 - 0.6 * half), rate * (1.0 + 0.6 * half), cg)),
        ("driving backwards in arcs to both sides", table(-rate * (1.0 - 0.3 * half), -rate * (1.0 + 0.3 * half), cg)),
        ("stop and go, straight and turning", table(rate * halting * (1.0 - 0.4 * half), rate * halting * (1.0 + 0.4 * half), cg)),
    ]
    if has_arms:
        for text, shift in (
            ("out to the front", (0.06, 0.0)),
            ("to the back", (-0.06, 0.0)),
            ("to the left", (0.0, 0.03)),
            ("to the right", (0.0, -0.03)),
        ):
            moved = table(-turn * half, turn * half, np.asarray(cg + np.array(shift)))
            found.append((f"turning in place, both ways, with the arms {text}", moved))
    return found


def separating_drive(predictor: DrivePredictor, findings: Sequence[Finding], linearization: Any, chosen: tuple[int, ...]) -> str:
    """In words; empty where nothing is left to separate."""
    rivals = [f for f in findings if f.aliases]
    if not rivals:
        return ""
    finding = rivals[0]
    drive = predictor.drive
    wheels = predictor.batch.wheels
    robot = drive.robot
    speed = robot.geometry.wheel_radius_m * float(np.quantile(np.abs(wheels.mean(axis=1)), 0.75))
    cg = predictor.batch.cg.mean(axis=0)
    others = {f.definition: f.size for f in findings if f is not finding}
    pairs = [(finding.definition, finding.size), *((_named(name), size) for name, size in finding.aliases[:4])]
    best = ("", 0.0)
    for text, maneuvers in candidate_maneuvers(
        speed, robot.geometry.wheel_radius_m, cg, robot.arms is not None, robot.geometry.track_width_m
    ):
        table = drive_of_table("next", robot, maneuvers, "windows")
        tried = DrivePredictor(table, predictor.model, predictor.has_inertia, predictor.baseline)
        base = with_sizes(others)
        start = tried.discrepancies(base)[:, :3]
        moved = [(start - tried.discrepancies(e.inject(base, s))[:, :3]) / _SIGMA for e, s in pairs if e is not None]
        informations = []
        for other in moved[1:]:
            # the rival may take whatever size it likes in the new drive, but then it no longer fits the old one
            informations.append(float(np.sum((moved[0] - other) ** 2)))
        information = min(informations) if informations else 0.0
        if information > max(1.05 * best[1], 1e-3):
            best = text, information
    names = [e.id for e, _ in pairs if e is not None]
    listed = ", ".join(names[:-1]) + " and " + names[-1]
    if not best[0]:
        return f"No short drive separates {listed}: measure one of them directly."
    seconds = max(_SECONDS, 5.0 * math.ceil(_SECONDS * _ENOUGH / best[1] / 5.0))
    if seconds > _MAX_S:
        return f"No drive of two minutes separates {listed}: measure one of them directly."
    return f"To separate {listed}, record about {seconds:.0f} s of {best[0]}."


def _named(name: str) -> Cause | None:
    return CAUSES.get(name) or WINDOW_CAUSES.get(name)


def general_advice(verdict: str, blind: Sequence[str]) -> str:
    """What to drive where the drive itself shows too little."""
    if verdict == "undecidable":
        return (
            "Record two minutes with LiDAR and IMU: 20 s straight on and back, 20 s of turning in place to each side, gentle arcs to both "
            "sides, a few stops, and the arms in two postures if there are any."
        )
    if verdict == "consistent" and blind:
        hidden = ", ".join(dict.fromkeys(blind))
        return f"This drive would not show a typical {hidden}; turns in place, arcs to both sides and other postures would."
    return ""
