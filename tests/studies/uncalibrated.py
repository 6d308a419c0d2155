"""What a motion model is worth on a robot that nobody calibrated: another robot's coefficients, geometry alone, 20 s of driving, all.

python -m tests.studies.uncalibrated

Errors at the end of maneuvers: VaultBot's 68 rotations in place (5 s each), 603 windows of 2 s of the DRIVE data set's Husky (LiDAR), and
seconds of BorealTC's Husky on three grounds (gyro: heading alone). Robots are their geometry; no coefficient of their files is used.
"Another's" are VaultBot's coefficients (Ebersole 2016), its own for itself. "20 s" are fitted to the first maneuvers that last 20 s and
scored on the others; "all" is held out in ten folds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel
from motion_models.calibration.cross_validation import cross_validate
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.plan import CLOCK, calibrate, free_of
from motion_models.calibration.regressions import read_rotation_table, rotations_as_maneuvers
from motion_models.errors import CalibrationError
from motion_models.online_calibration import CorrectedWheels
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import thesis_coefficients
from tests.studies import drive_husky, terrain_track
from tests.studies.thesis_regressions import DATA as VAULTBOT

MODELS = ("skid_steer", "icr", "friction")
FIRST_S = 20.0


@dataclass(frozen=True)
class Case:
    """A robot on a ground."""

    name: str
    robot: Robot
    """Without coefficients of any model."""
    maneuvers: list[Maneuver]
    is_rotation: bool = False

    @property
    def has_positions(self) -> bool:
        return bool(np.isfinite(self.maneuvers[0].cov[..., 0, 0]).all())


@dataclass(frozen=True)
class Errors:
    """RMS at the maneuvers' ends; NaN where it was not measured or could not be fitted."""

    heading_deg: float
    position_m: float


def cases() -> list[Case]:
    """The robots."""
    vaultbot = load_robot("vaultbot")
    rotations = rotations_as_maneuvers(read_rotation_table(VAULTBOT / "rotation_grid.csv"), vaultbot)
    found = [Case("VaultBot, 68 rotations", bare(vaultbot), rotations, is_rotation=True)]
    found.append(Case("Husky, DRIVE", drive_husky.robot(), drive_husky.maneuvers(mended=True)))
    husky = bare(load_robot("husky_a200"))
    for ground in ("FLOORING", "ASPHALT", "ICE"):
        found.append(Case(f"Husky, {ground.lower()}", husky, terrain_track.load(ground).maneuvers))
    return found


def bare(robot: Robot) -> Robot:
    """``robot`` without coefficients."""
    return dataclasses.replace(robot, models={}, options={})


def another(name: str, robot: Robot) -> MotionModel | None:
    """``name`` with VaultBot's coefficients; None for models that have none."""
    coefficients = dict(zip(make_model("skid_steer", robot).param_names, map(float, thesis_coefficients()), strict=True))
    lent = dataclasses.replace(robot, models={"skid_steer": coefficients})
    return make_model(name, lent) if name in ("skid_steer", "icr") else None


def score(residuals: FloatArray, has_positions: bool) -> Errors:
    """RMS of ``residuals`` (M, 3)."""
    position = float(np.sqrt(np.mean(np.sum(residuals[:, :2] ** 2, axis=1)))) if has_positions else float("nan")
    return Errors(float(np.degrees(np.sqrt(np.mean(residuals[:, 2] ** 2)))), position)


def predicted(model: MotionModel, maneuvers: Sequence[Maneuver], robot: Robot) -> FloatArray:
    """(M, 3) residuals of ``model`` as it is."""
    config = FitConfig(noise=robot.wheel_noise, strict=False)
    blank = fit(model, maneuvers, (model.param_names[0],), config)
    return dataclasses.replace(blank, params=model.nominal, reference_params=np.zeros(5)).residuals(maneuvers)


def first_maneuvers(maneuvers: Sequence[Maneuver]) -> int:
    """How many of them last `FIRST_S`."""
    seconds = np.cumsum([float(m.dt[m.lead : m.lead + int(m.ends[-1])].sum()) for m in maneuvers])
    return int(np.searchsorted(seconds, FIRST_S - 1e-6)) + 1


def study(case: Case, name: str) -> dict[str, Errors]:
    """Errors of the model ``name`` by what was known."""
    maneuvers, robot = case.maneuvers, case.robot
    found: dict[str, Errors] = {}
    lent = another(name, robot)
    if lent is not None:
        found["another's"] = score(predicted(lent, maneuvers, robot), case.has_positions)
    model: MotionModel = make_model(name, robot)
    found["geometry"] = score(predicted(model, maneuvers, robot), case.has_positions)
    if name == "skid_steer" and not case.is_rotation:
        model = CorrectedWheels(model)
    config = FitConfig(noise=robot.wheel_noise)

    def train(some: Sequence[Maneuver]) -> Fit:
        wanted = [n for n in free_of(model, some, case.is_rotation) if n != CLOCK]
        return calibrate(model, some, wanted, config).fit

    n = first_maneuvers(maneuvers)
    try:
        found["20 s"] = score(train(maneuvers[:n]).residuals(maneuvers[n:]), case.has_positions)
    except CalibrationError:
        found["20 s"] = Errors(float("nan"), float("nan"))
    found["all"] = score(cross_validate(train, maneuvers, 10).residuals, case.has_positions)
    return found


def table() -> str:
    """The results as Markdown: heading [deg] / position [m]."""
    columns = ("another's", "geometry", "20 s", "all")
    lines = ["| robot | model | VaultBot's coefficients | geometry | 20 s | all, held out |", "|---|---|---|---|---|---|"]
    for case in cases():
        for name in MODELS:
            found = study(case, name)
            lines.append(f"| {case.name} | {name} | {' | '.join(_cell(found.get(column)) for column in columns)} |")
    return "\n".join(lines)


def _cell(errors: Errors | None) -> str:
    if errors is None or not np.isfinite(errors.heading_deg):
        return "-"
    return f"{errors.heading_deg:.2f}" + (f" / {errors.position_m:.3f}" if np.isfinite(errors.position_m) else "")


if __name__ == "__main__":
    print("RMS at the end of maneuvers: heading [deg] / position [m]\n")
    print(table())
