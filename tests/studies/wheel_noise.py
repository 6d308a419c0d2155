"""Wheel noise learned by `calibrate` on the first half of real logs: consistency (NIS, NEES) and accuracy of ekf with it and without.

python -m tests.studies.wheel_noise [--log csail,aces,fr079] [--model diff_drive]

The factors are those that `skidloc calibrate` writes (`motion_models.calibration.cross_validation`), learned on the first half; NIS is of
the second half, with 3 degrees of freedom. ATE and NEES are of the whole log, NEES with a reference noise of 2 cm and 0.5 deg; for ACES,
which has relations alone, ATE is their mean translation error.
"""

from __future__ import annotations

import argparse
import dataclasses
import math

import numpy as np

from localization.calibration.calibrate import Cut, calibrated
from localization.calibration.motion_references import LidarMotionReference
from localization.calibration.windows import WindowConfig, cut
from localization.evaluation.references import ReferenceTrack, with_noise
from localization.evaluation.scores import score
from motion_models.calibration.cross_validation import LearnedNoise
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS, Drive, errors_of

_REFERENCE_SIGMA = (0.02, math.radians(0.5))


def learned_noise(drive: Drive, model: str) -> LearnedNoise:
    """Factors by the first half of ``drive``."""
    config = WindowConfig()
    half = drive.until(0.5e-9 * (drive.events[-1].stamp_ns - drive.events[0].stamp_ns))
    reference = LidarMotionReference(drive.mounts, config.window_s)
    windows = cut(half.events, reference, make_model("diff_drive", drive.robot), drive.robot, config)
    maneuvers = Cut("first half", windows.maneuvers, "scan matching")
    return calibrated(make_model(model, drive.robot), [maneuvers], drive.robot).noise


def measure(drive: Drive, model: str) -> str:
    """NIS of the second half, ATE [m] and NEES."""
    run = drive.run("ekf", model)
    middle = (run.trajectory.stamps_ns[0] + run.trajectory.stamps_ns[-1]) // 2
    nis = run.nis[run.trajectory.stamps_ns > middle]
    nees = "–"  # noqa: RUF001
    if isinstance(drive.reference, ReferenceTrack):
        nees = f"{score([run], with_noise(drive.reference, *_REFERENCE_SIGMA))[0].nees_mean:.2f}"
    return f"{np.nanmean(nis):.2f} | {errors_of(run.trajectory, drive.reference)[0]:.4f} | {nees}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", default="csail,aces,fr079")
    parser.add_argument("--model", default="diff_drive")
    options = parser.parse_args()
    print("| log | wheel noise | yaw | position | NIS | ATE [m] | NEES |\n|---|---|---|---|---|---|---|")
    for name in options.log.split(","):
        drive = BUILDINGS[name].open()
        for kind, noise in (("robot file", LearnedNoise(1.0, 1.0)), ("calibrate", learned_noise(drive, options.model))):
            scaled = dataclasses.replace(drive.robot, wheel_noise=noise.scaled(drive.robot.wheel_noise))
            numbers = measure(dataclasses.replace(drive, robot=scaled), options.model)
            print(f"| {name} | {kind} | {noise.yaw:.2g} | {noise.position:.2g} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
