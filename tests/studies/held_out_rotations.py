"""Motion models on VaultBot's 68 measured rotations in place, at centres of gravity that they were not fitted to.

python -m tests.studies.held_out_rotations

Rows of one x_G are held out in turn (10 folds); each model is fitted to the other rows and predicts the pose after 5 s of turning. Data:
Ebersole 2016, tables 4-1 to 4-3. The robot is its geometry; no coefficient of the robot file is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from motion_models.calibration.cross_validation import Interval, cross_validate, root_mean
from motion_models.calibration.fit import Fit, FitConfig
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.plan import calibrate, free_of
from motion_models.calibration.regressions import read_rotation_table, rotations_as_maneuvers
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.studies.thesis_regressions import DATA
from tests.studies.uncalibrated import bare

MODELS = ("diff_drive", "icr", "skid_steer", "friction")


@dataclass(frozen=True)
class HeldOutErrors:
    """Root mean square errors of held-out rotations, with 95 % intervals by bootstrap over rows of one x_G."""

    heading_deg: Interval
    position_m: Interval


def study(name: str) -> HeldOutErrors:
    """Held-out errors of the motion model ``name``."""
    robot = bare(load_robot("vaultbot"))
    maneuvers = rotations_as_maneuvers(read_rotation_table(DATA / "rotation_grid.csv"), robot)
    model = make_model(name, robot)
    config = FitConfig(noise=robot.wheel_noise)

    def train(some: Sequence[Maneuver]) -> Fit:
        return calibrate(model, some, free_of(model, some, of_rotations=True), config).fit

    held_out = cross_validate(train, maneuvers, 10)
    heading = root_mean(np.degrees(1.0) ** 2 * held_out.squared_angle, held_out.group, np.random.default_rng(0))
    position = root_mean(held_out.squared_distance, held_out.group, np.random.default_rng(0))
    return HeldOutErrors(heading, position)


def print_table(console: Console) -> None:
    """Print the errors of all models, and those of the models with the CG beside diff_drive's."""
    errors = {name: study(name) for name in MODELS}
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("held out, RMS [95 %]", "heading after 5 s [deg]", "position [m]"):
        table.add_column(title, no_wrap=True)
    for name, found in errors.items():
        table.add_row(name, *(f"{v.value:.3f} ({v.low:.3f} to {v.high:.3f})" for v in (found.heading_deg, found.position_m)))
    console.print("VaultBot (Husky with two arms), 68 measured rotations, each at another centre of gravity:")
    console.print(table)
    base, linear, friction = (_sizes(errors[name]) for name in ("diff_drive", "skid_steer", "friction"))
    console.print(
        f"diff_drive with its best multiplier errs by {base}. With the centre of gravity known, skid_steer errs by {linear}, and the"
        f" friction model by {friction}."
    )


def _sizes(errors: HeldOutErrors) -> str:
    return f"{errors.heading_deg.value:.1f} deg and {1e3 * errors.position_m.value:.0f} mm"


if __name__ == "__main__":
    print_table(Console(highlight=False, soft_wrap=True))
