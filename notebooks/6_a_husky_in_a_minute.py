# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 6. A real Husky, calibrated in under a minute of driving
#
# **Claim: 48 s of driving, and all other minutes of this Husky are predicted to within 7 % of the error that ten minutes of driving
# leave; by its geometry alone, the error is more than twice as large.**
#
# The DRIVE data set (Université Laval) has 201 steps of 6 s of a Husky with random wheel speeds, and what LiDAR scan matching measured of
# every two seconds of them. `skidloc calibrate` does with any log what this notebook does step by step.

# %%
from dataclasses import replace

import numpy as np

from localization.calibration.calibrate import Cut, calibrated, turning
from localization.calibration.windows import driven
from localization.report.notebook import Bars, Panel, Series, picture, table
from motion_models import make_model, root_mean, se2
from motion_models.calibration.cross_validation import cross_validate, learning_curve
from motion_models.calibration.fit import FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.robot import Driver, Geometry, Robot, WheelNoise

WINDOW_S = 0.05 * np.ones(39)
SCATTER = np.diag([0.02, 0.02, 0.01]) ** 2  # of scan matching, from one sample to the next


def read_windows(path):
    """Maneuvers of two seconds, three in each step. The file's positions are in the mean heading of the first five samples, its headings
    in that of the first: the positions are turned back."""
    with np.load(path) as data:
        x, y, yaw = (data[f"icp_{name}"][:, 39] for name in ("x", "y", "yaw"))
        frame = np.column_stack([np.zeros((len(x), 2)), data["icp_yaw"][:, :5].mean(axis=1)])
        poses = se2.compose(frame, np.column_stack([x, y, yaw]))
        poses[:, 2] = se2.wrap_angle(yaw)
        rates = np.stack([data["left_wheel_vel"], data["right_wheel_vel"]], axis=-1)[:, :39]
    ends = np.array([39])
    return [Maneuver(WINDOW_S, rates[i], poses[i : i + 1], ends, cov=SCATTER, group=f"step {i // 3}") for i in range(len(poses))]


# wheel radius by the data set, the rest by the Husky's URDF
geometry = Geometry(wheel_radius_m=0.165, track_width_m=0.5708, wheelbase_m=0.512, mass_kg=46.034)
robot = Robot("drive_husky", geometry, Driver(geometry.wheel_radius_m, geometry.track_width_m, 1.0))
maneuvers = read_windows("../tests/data/drive-husky/husky_windows.npz")
steps = list(dict.fromkeys(m.group for m in maneuvers))
seconds, metres, radians = driven(maneuvers, robot.geometry.wheel_radius_m, robot.geometry.track_width_m)
f"{len(maneuvers)} windows of {len(steps)} steps: {seconds:.0f} s, {metres:.0f} m by the wheels"

# %% [markdown]
# ## The first eight steps: 48 s
#
# Four numbers of a robot that is the same left and right: how much it turns and drives for what its wheels do, about which point, and how
# much less far it goes on tight arcs. `calibrated` gives the sigma of each. (On the command line: `--model full_linear --fit` and these
# names.)

# %%
minute = [m for m in maneuvers if m.group in steps[:8]]
model = make_model("full_linear", robot)
free = ("wz_left", "vx_left", "vy_left", "longitudinal_slip_curvature")
found = calibrated(model, [Cut("the first eight steps", tuple(minute), "the data set's scan matching")], robot, free)
table(
    ["parameter", "robot file", "fitted", "sigma"],
    *(
        [name, float(model.nominal[model.param_names.index(name)]), float(value), found.sigmas[name]]
        for name, value in zip(found.fit.names, found.fit.values, strict=True)
    ),
)

# %%
calibrated_turning = turning(found, robot)
table(
    ["in words", "value", "sigma"],
    ["effective track [m] (the wheels stand 0.57 m apart)", *calibrated_turning.effective_track_m],
    ["centre of rotation ahead of the middle [m]", *calibrated_turning.x_cr_m],
    ["metres driven straight on for each metre that the wheels roll", *calibrated_turning.forward_scale],
)

# %% [markdown]
# ## Does it hold for the other nineteen minutes?
#
# Errors of position after two seconds, in windows that were not fitted.

# %%
ALIKE = WheelNoise(**dict.fromkeys(vars(WheelNoise()), 0.0))  # windows are equally long: each counts alike
SYMMETRIC = {"vx_right": ("vx_left", 1.0), "vy_right": ("vy_left", -1.0), "wz_right": ("wz_left", -1.0)}


def fitted(name, names, ties=None, start=None, prior=None):
    """Plain least squares of the parameters ``names`` of a model, as a function of maneuvers."""
    model = make_model(name, robot)
    first = model.nominal.copy()
    for parameter, value in (start or {}).items():
        first[model.param_names.index(parameter)] = value
    config = FitConfig("linear", noise=ALIKE, ties=ties or {}, prior_sigma=prior or {}, strict=False)
    return lambda maneuvers: fit(model, maneuvers, names, config, first)


def as_given(multiplier):
    """diff_drive with a multiplier of the track, not fitted."""
    other = replace(robot, driver=replace(robot.driver, wheel_separation_multiplier=multiplier))
    train, given = fitted("diff_drive", ("wheel_radius",)), make_model("diff_drive", other).nominal
    return lambda maneuvers: replace(train(maneuvers), params=given)


rest = [m for m in maneuvers if m.group not in steps[:8]]
measured = np.array([m.measured[0] for m in rest])
off = found.fit.residuals(rest)
raw = as_given(1.0)(rest).residuals(rest)
error, before = (np.hypot(*e[:, :2].T) for e in (off, raw))
order = np.linspace(0.0, 1.0, len(rest))


def rms(values):
    return np.sqrt(np.mean(values**2))


picture(
    Panel(
        "position error after 2 s [m]",
        "share of windows with less",
        [
            Series(f"diff-drive by its geometry, RMS {rms(before):.2f} m", np.sort(before), order, "red", dashes=(4, 2)),
            Series(f"after 48 s of driving, RMS {rms(error):.2f} m", np.sort(error), order, "blue"),
        ],
        "Nineteen minutes that were not used",
        x_range=(0.0, 1.5),
        legend="lower right",
    ),
    Panel(
        "turned by the LiDAR [rad]",
        "predicted [rad]",
        [
            Series("", [-2.0, 2.0], [-2.0, 2.0], "ink"),
            Series("diff-drive by its geometry", measured[:, 2], measured[:, 2] + raw[:, 2], "red", "s", None),
            Series("after 48 s of driving", measured[:, 2], measured[:, 2] + off[:, 2], "blue", "o", None),
        ],
        "Turn in 2 s",
        x_range=(-2.2, 2.2),
        y_range=(-4.0, 4.0),
        legend="upper left",
    ),
)

# %% [markdown]
# ## How many seconds does it take?
#
# Steps are drawn at random, fitted, and all others predicted; twenty times for each number of steps. With a prior around what the robot's
# driver publishes, even a few seconds do not lead astray.

# %%
DRAWS = 20
counts = (1, 2, 3, 4, 8, 16, 96)
turn = robot.driver.wheel_radius_m / (1.875 * robot.driver.track_width_m)  # by the multiplier of the Husky's driver
prior = {"vx_left": 0.01, "wz_left": 0.3 * turn, "vy_left": 0.1 * turn, "longitudinal_slip_curvature": 0.5}
trained = {
    "free": fitted("full_linear", free, SYMMETRIC),
    "with a prior": fitted("full_linear", free, SYMMETRIC, {"wz_left": -turn, "wz_right": turn}, prior),
}
curves = {name: learning_curve(train, maneuvers, counts, DRAWS, np.random.default_rng(0)) for name, train in trained.items()}
lines = []
for (name, curve), colour, marker in zip(curves.items(), ("blue", "green"), ("o", "s"), strict=True):
    low, middle, high = np.quantile([curve[n] for n in counts], [0.05, 0.5, 0.95], axis=1)
    lines.append(Series(f"{name}: median, 5 to 95 %", 6.0 * np.array(counts), middle, colour, marker, below=low, above=high))
picture(
    Panel(
        "driving that was used [s]", "position error after 2 s, RMS [m]", lines, log_x=True, y_range=(0.15, 0.6), moments={"a minute": 60.0}
    ),
    columns=1,
    row_in=3.2,
)

# %%
final = {name: float(np.median(curve[96])) for name, curve in curves.items()}
table(
    ["driving used [s]", *(f"{name}: RMS [m]" for name in curves), *(f"{name}: above its best" for name in curves)],
    *(
        [
            6 * n,
            *(float(np.median(curve[n])) for curve in curves.values()),
            *(f"{100 * (np.median(c[n]) / final[name] - 1):+.1f} %" for name, c in curves.items()),
        ]
        for n in counts
    ),
)

# %% [markdown]
# ## Which terms reduce the error
#
# All models, trained on nine tenths of the steps and scored on the rest, ten times. Slip is what matters: how much less the robot turns
# than its wheels predict, about which point, and how much less far it goes on tight arcs: four numbers are as good as twelve.

# %%
THREE = ("vx_left", "wz_left", "vy_left")
models = {
    "diff_drive, as its geometry says": as_given(1.0),
    "diff_drive, the driver's multiplier 1.875": as_given(1.875),
    "diff_drive, fitted": fitted("diff_drive", ("wheel_radius", "wheel_separation_multiplier")),
    "skid_steer: k, x_CR, y_CR; no scale": fitted("skid_steer", ("k_0", "x_cr_0", "y_cr_0")),
    "k, scale and x_CR": fitted("full_linear", THREE, SYMMETRIC),
    "icr, five parameters": fitted("icr", make_model("icr", robot).param_names),
    "friction: radius, mu_ratio, tracked_x": fitted("friction", ("wheel_radius", "mu_ratio", "tracked_x")),
    "k, scale, x_CR and longitudinal_slip_curvature": fitted("full_linear", free, SYMMETRIC),
    "full_linear, all twelve": fitted("full_linear", make_model("full_linear", robot).param_names),
}
held = {title: cross_validate(train, maneuvers) for title, train in models.items()}
intervals = {title: root_mean(h.squared_distance, h.group, np.random.default_rng(0)) for title, h in held.items()}
picture(
    Bars("held-out position error after 2 s, RMS [m]", list(intervals), {"": [i.value for i in intervals.values()]}), columns=1, row_in=3.4
)

# %%
table(["model", "RMS [m], 95 % interval"], *([title, str(i)] for title, i in intervals.items()))
