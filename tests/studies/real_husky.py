"""Every motion model on a real Husky: position error after two seconds, cross-validated by calibration step.

Run by `python -m tests.studies.real_husky`. Each row is trained on nine tenths of the 201 steps and scored on the rest, ten times;
all windows count alike, and what is chosen is chosen on the training steps alone. Intervals are 95 %, by bootstrap over steps.
What no fold can hold out: the list of terms itself was drawn up by people who had seen this data set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from motion_models.base import MotionModel
from motion_models.calibration.cross_validation import HeldOut, cross_validate, learning_curve, root_mean, root_mean_gain
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import MODELS, make_model
from motion_models.robot import Driver, WheelNoise
from motion_models.se2 import FloatArray
from tests.studies import drive_husky

# The windows are equally long and RMSE is the score: they count alike, and slip is not modelled as noise.
ALIKE = WheelNoise(**dict.fromkeys(WheelNoise.__dataclass_fields__, 0.0))
SYMMETRIC = {"vx_right": ("vx_left", 1.0), "vy_right": ("vy_left", -1.0), "wz_right": ("wz_left", -1.0)}
THREE = ("vx_left", "wz_left", "vy_left")
TERMS = (
    *("lateral_slip_speed", "longitudinal_slip_turning", "longitudinal_slip_curvature"),
    *("rotation_slip_speed", "rotation_slip_rate", "rotation_slip_curvature"),
)
CLOCKS = ("wheel_time_offset", "wheel_lag")


@dataclass(frozen=True)
class Row:
    """One line of the table: a model, what is free in it, and what is tied."""

    title: str
    model: str
    free: tuple[str, ...] = ()
    ties: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    prior: Mapping[str, float] = field(default_factory=dict)

    def make(self) -> tuple[MotionModel, FloatArray]:
        """The model of the data set's robot, and where its parameters start."""
        model = make_model(self.model, drive_husky.robot())
        start = model.nominal.copy()
        for name, value in self.start.items():
            start[model.param_names.index(name)] = value
        return model, start

    def train(self, maneuvers: Sequence[Maneuver]) -> Fit:
        """A plain least-squares fit, every window alike."""
        model, start = self.make()
        config = FitConfig("linear", noise=ALIKE, ties=self.ties, prior_sigma=self.prior, strict=False)
        return fit(model, maneuvers, self.free, config, start)


@dataclass(frozen=True)
class Unfitted:
    """A model as the robot's geometry gives it."""

    row: Row

    def residuals(self, maneuvers: Sequence[Maneuver]) -> FloatArray:
        """See `Predictor`."""
        model, start = self.row.make()
        zero = np.zeros((1, 1))
        return Fit(model, (), start, np.zeros(5), zero, False, 1.0, 0.0, (), 0.0, FitConfig(noise=ALIKE)).residuals(maneuvers)


def rows() -> list[Row]:
    """The table's rows, in order."""
    found = [
        Row("diff_drive, as its geometry says", "diff_drive"),
        Row("diff_drive, the driver's multiplier 1.875", "diff_drive", start={"wheel_separation_multiplier": 1.875}),
        Row("diff_drive, fitted", "diff_drive", ("wheel_radius", "wheel_separation_multiplier")),
        Row("skid_steer: k, x_CR, y_CR; no scale", "skid_steer", ("k_0", "x_cr_0", "y_cr_0")),
        Row("k, scale and x_CR", "full_linear", THREE, SYMMETRIC),
        Row("icr, five parameters", "icr", ("y_icr_left", "y_icr_right", "x_icr", "alpha_left", "alpha_right")),
        Row("full_linear, six parameters", "full_linear", ("vx_left", "vx_right", "vy_left", "vy_right", "wz_left", "wz_right")),
    ]
    if "friction" in MODELS:
        found.append(Row("friction: radius, mu_ratio, tracked_x", "friction", ("wheel_radius", "mu_ratio", "tracked_x")))
        soft = ("wheel_radius", "mu_ratio", "tracked_x", "slip_stiffness", "rolling_resistance", "scrub")
        found.append(Row("friction: and slip stiffness, rolling, scrub", "friction", soft, start={"slip_stiffness": 2.0}))
    found += [Row(f"k, scale, x_CR and {term}", "full_linear", (*THREE, term), SYMMETRIC) for term in (*TERMS, *CLOCKS)]
    found.append(Row("full_linear, all twelve", "full_linear", make_model("full_linear", drive_husky.robot()).param_names))
    return found


BEST = Row("k, scale, x_CR and longitudinal_slip_curvature", "full_linear", (*THREE, "longitudinal_slip_curvature"), SYMMETRIC)
# The same for a robot fresh from its box: the driver's multiplier, and how far wheels, k, x_CR and the loss may be from what it says.
_TURN = drive_husky.robot().driver.wheel_radius_m / (1.875 * drive_husky.robot().driver.track_width_m)
FROM_THE_BOX = Row(
    *("the same, from what the driver says", "full_linear", BEST.free, SYMMETRIC),
    start={"wz_left": -_TURN, "wz_right": _TURN},
    prior={"vx_left": 0.01, "wz_left": 0.3 * _TURN, "vy_left": 0.1 * _TURN, "longitudinal_slip_curvature": 0.5},
)


def score(row: Row, maneuvers: Sequence[Maneuver], folds: int = 10) -> HeldOut:
    """Held-out errors of one row."""
    return cross_validate(row.train if row.free else lambda _: Unfitted(row), maneuvers, folds)


def chosen(maneuvers: Sequence[Maneuver]) -> Fit:
    """k, scale and x_CR, and the terms that help within these (training) maneuvers.

    The term that lowers the cost most joins, as long as it lowers the position error in a cross-validation inside them by 1 %.
    """
    row = Row("chosen", "full_linear", THREE, SYMMETRIC)
    error = float(np.mean(score(row, maneuvers, 5).squared_distance) ** 0.5)
    left = [*TERMS, *CLOCKS]
    while left:
        costs = [float(np.sum(_with(row, term).train(maneuvers).residuals(maneuvers)[:, :2] ** 2)) for term in left]
        tried = _with(row, left.pop(int(np.argmin(costs))))
        tried_error = float(np.mean(score(tried, maneuvers, 5).squared_distance) ** 0.5)
        if tried_error > 0.99 * error:
            break
        row, error = tried, tried_error
    return row.train(maneuvers)


def _with(row: Row, term: str) -> Row:
    return Row(row.title, row.model, (*row.free, term), row.ties)


def main() -> None:
    """Print the table."""
    stored, mended = drive_husky.maneuvers(mended=False), drive_husky.maneuvers(mended=True)
    print("Position RMSE after 2 s [m] (95 % interval) of 603 windows of a real Husky, held out by calibration step.")
    print("'stored': ICP poses as the data set has them; 'mended': their frame turned back (see drive_husky.frame_turn).\n")
    print(f"{'model':52s} {'stored':22s} {'mended':22s} {'median':>7s} {'yaw RMSE':>9s}")
    held: dict[str, tuple[HeldOut, HeldOut]] = {}
    for row in rows():
        held[row.title] = score(row, stored), score(row, mended)
        _line(row.title, *held[row.title])
    choice = cross_validate(chosen, stored), cross_validate(chosen, mended)
    held["chosen"] = choice
    _line("k, scale, x_CR and terms chosen by each fold", *choice)
    for kind, out in zip(("stored", "mended"), choice, strict=True):
        picks = [predictor.names[len(THREE) :] for predictor in out.predictors if isinstance(predictor, Fit)]
        count = {pick: sum(p == pick for p in picks) for pick in dict.fromkeys(picks)}
        print(f"    {kind}: " + "; ".join(f"{n} folds took {', '.join(pick) or 'none'}" for pick, n in count.items()))

    print("\nGain of the curvature loss over k, scale and x_CR, same windows [m]:")
    for kind, i in (("stored", 0), ("mended", 1)):
        before, after = held["k, scale and x_CR"][i], held[BEST.title][i]
        gain = root_mean_gain(before.squared_distance, after.squared_distance, before.group, np.random.default_rng(0))
        print(f"    {kind}: {gain}")
    gt = drive_husky.maneuvers(mended=False, reference="gt")
    print("\nAgainst the stored gt_icp (taken 0 to 2 samples later, not stored which) [m]:")
    for title in ("diff_drive, as its geometry says", "k, scale and x_CR", BEST.title):
        out = score(next(row for row in rows() if row.title == title), gt)
        print(f"    {title:48s} {root_mean(out.squared_distance, out.group, np.random.default_rng(0))}")

    print(f"\n{BEST.title}, fitted to all mended windows:")
    result = BEST.train(mended)
    sigmas = result.sigmas
    for name, value in zip(result.names, result.values, strict=True):
        print(f"    {name:30s} {value:9.4f} +- {sigmas[name]:.4f}")
    _print_meaning(result)

    print("\nHow much driving the fit needs (40 random draws; median [5 %, 95 %] RMSE on all other steps, mended):")
    steps = (1, 2, 3, 4, 6, 8, 12, 16, 24, 48, 96)
    bare, prior = (learning_curve(row.train, mended, steps, 40, np.random.default_rng(0)) for row in (BEST, FROM_THE_BOX))
    print(f"    {'driven':8s} {'free fit':32s} with a prior around the driver's values")
    for n in steps:
        cells = []
        for curve in (bare, prior):
            low, middle, high = np.quantile(curve[n], [0.05, 0.5, 0.95])
            final = float(np.median(curve[steps[-1]]))
            cells.append(f"{middle:.3f} [{low:.3f}, {high:.3f}] {100 * (middle / final - 1):+5.1f} %")
        print(f"    {6 * n:4d} s   {cells[0]:32s} {cells[1]}")


def _line(title: str, stored: HeldOut, mended: HeldOut) -> None:
    intervals = [str(root_mean(h.squared_distance, h.group, np.random.default_rng(0))) for h in (stored, mended)]
    median, yaw = np.sqrt(np.median(mended.squared_distance)), np.sqrt(np.mean(mended.squared_angle))
    print(f"{title:52s} {intervals[0]:22s} {intervals[1]:22s} {median:7.3f} {yaw:9.3f}", flush=True)


def _print_meaning(result: Fit) -> None:
    robot = drive_husky.robot()
    driver: Driver = robot.driver
    value = dict(zip(result.names, result.values, strict=True))
    scale = 2.0 * value["vx_left"] / driver.wheel_radius_m
    k = -value["wz_left"] * driver.track_width_m / driver.wheel_radius_m
    x_cr = -value["vy_left"] / value["wz_left"]
    loss = value["longitudinal_slip_curvature"]
    print(
        f"  that is: straight ahead {scale:.3f} m a wheel's metre, k = {k:.3f}, centre of rotation {x_cr:+.3f} m; "
        f"with one side standing the forward speed is {100 * loss / 2:.0f} % less than the mean of both sides."
    )


if __name__ == "__main__":
    main()
