# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 2. What the centre of gravity does to a skid-steer robot
#
# **Claim: where the centre of gravity (CG) lies decides how much, and about which point, the robot turns for the same wheel rates.
# Physics with published constants and nothing fitted already predicts it; with four numbers fitted it describes 68 measurements better
# than a polynomial's eleven do in two respects of three, and as well in the third.**
#
# VaultBot, a Husky with two arms, turned in place at 68 positions of its CG (J. Ebersole's thesis, 2016, chapter 4). This notebook
# redraws that chapter's figures 4-2 to 4-15 from its tables, and puts two models beside them: `skid_steer`, the thesis's regressions, and
# `friction`, four skidding wheels whose loads follow the CG.

# %%
import numpy as np

from localization.calibration.calibrate import Cut, calibrated
from localization.report.notebook import CYCLE, MARKERS, Panel, Series, picture, table
from localization.simulation import SensorConfig, SimulationConfig, simulate
from motion_models import SkidSteer, load_robot, make_model, read_rotation_table, rotations_as_maneuvers, se2, thesis_coefficients
from motion_models.calibration.regressions import cor_x, cor_y_full, cor_y_lines, cor_y_multivariate, rotation_ratio

robot = load_robot("vaultbot")
grid = read_rotation_table("../tests/data/vaultbot/rotation_grid.csv")
x, y = grid.cg.T
multiplier = robot.driver.wheel_separation_multiplier
f"{len(x)} rotations, x_G {x.min():+.2f} to {x.max():+.2f} m, y_G {y.min():+.2f} to {y.max():+.2f} m"

# %% [markdown]
# A model predicts a twist; what the thesis measured of it is the *rotation ratio* (measured over commanded yaw rate) and the *centre of
# rotation* (CoR), the point of the body that stands still. Every rotation was commanded at 0.3 rad/s through the robot's own driver.

# %%
driver, friction = make_model("diff_drive", robot), make_model("friction", robot)
rates = driver.wheels(np.array([0.0, 0.3]), np.zeros(2), driver.nominal)


def rotation(cg, params):
    """Rotation ratio, x_CR, y_CR of the friction model, (..., 3)."""
    vx, vy, wz = np.moveaxis(friction.twist(rates, cg, params).value, -1, 0)
    return np.stack([wz / 0.3, -vy / wz, vx / wz], axis=-1)


found = calibrated(friction, [Cut("rotation_grid.csv", tuple(rotations_as_maneuvers(grid, robot)), "the table")], robot, of_rotations=True)
fitted = found.fit.params
table(
    ["fitted", "value", "sigma"],
    *([name, value, found.sigmas[name]] for name, value in zip(found.fit.names, found.fit.values, strict=True)),
)

# %% [markdown]
# ## Figures 4-2 and 4-3: the path of the robot's middle, and how fast it turned
#
# Left: a robot that turned about its middle would not move at all. Solid: as measured (an arc about the measured CoR); dashed: the fitted
# friction model. Right: the simulated vehicle has motors and inertia; after half a second it turns as fast as was measured (dotted).

# %%
row = np.flatnonzero(np.isclose(y, 0.02))[::2]
angle = np.linspace(0.0, 1.0, 60)[:, None]


def arc(ratio, x_cr, y_cr):
    """Positions of the middle while it turns for 5 s."""
    return se2.exp(angle * np.array([y_cr, -x_cr, 1.0]) * ratio * 1.5)


paths = []
for n, i in enumerate(row):
    seen, said = arc(grid.ratio[i], *grid.cor[i]), arc(*rotation(grid.cg[i], fitted))
    paths.append(Series(f"x_G = {x[i]:+.2f} m", seen[:, 0], seen[:, 1], CYCLE[n]))
    paths.append(Series("", said[:, 0], said[:, 1], CYCLE[n], dashes=(3, 2)))

drive = simulate("rotation_grid", robot, config=SimulationConfig(sensors=SensorConfig(lidar="none")))
for _ in drive.messages():
    pass
turning = []
for n, run in enumerate(r for r in drive.runs if np.isclose(r.nominal_cg[1], -0.03) and round(100 * r.nominal_cg[0]) in (-4, 0, 6, 10)):
    wz = np.gradient(np.unwrap(run.poses[:, 2]), run.times_s)
    ratio = float(grid.ratio[np.argmin(np.linalg.norm(grid.cg - run.nominal_cg, axis=1))])
    turning.append(Series(f"x_G = {run.nominal_cg[0]:+.2f} m", run.times_s, wz, CYCLE[n]))
    turning.append(Series("", [0.0, 6.0], [0.3 * ratio] * 2, CYCLE[n], dashes=(1, 1)))
picture(
    Panel("x [m]", "y [m]", paths, "4-2: paths of the middle, y_G = 0.02 m", is_map=True),
    Panel("time [s]", "yaw rate [rad/s]", turning, "4-3: yaw rate, y_G = -0.03 m", legend="lower center"),
    row_in=3.6,
)

# %% [markdown]
# ## Figures 4-4 to 4-7: rotation ratio and x of the centre of rotation
#
# Both depend on x_G and hardly on y_G: 4-4 and 4-6 (the same data over both) are distinguished by the markers here. The least turning is
# at x_G = 0. The measured x_CR, however, is not 0 there but -6.4 cm: notebook 3 asks why.

# %%
line = np.stack([np.linspace(-0.062, 0.122, 93), np.zeros(93)], axis=-1)
skid = SkidSteer(1.0, 1.0, thesis_coefficients())
k, x_cr, _ = skid.rotation(line, skid.nominal)
plain, tuned = rotation(line, friction.nominal), rotation(line, fitted)


def by_y(values):
    """One series of markers for each y_G."""
    levels = np.unique(y)
    return [
        Series(f"measured, y_G = {at:+.2f} m" if n % 3 == 0 else "", x[y == at], values[y == at], "grey", MARKERS[n], None)
        for n, at in enumerate(levels)
    ]


def models(thesis, column):
    """The curves of all three."""
    return [
        Series("thesis", line[:, 0], thesis, "red", dashes=(4, 2)),
        Series("friction, nothing fitted", line[:, 0], plain[:, column], "sky", dashes=(1, 1)),
        Series("friction, four numbers", line[:, 0], tuned[:, column], "blue"),
    ]


picture(
    Panel("x_G [m]", "rotation ratio [-]", [*by_y(grid.ratio), *models(multiplier * k, 0)], "4-4, 4-5: measured over commanded yaw rate"),
    Panel("x_G [m]", "x_CR [m]", [*by_y(grid.cor[:, 0]), *models(x_cr, 1)], "4-6, 4-7: centre of rotation, x"),
    row_in=3.6,
)

# %%
slopes = [
    ["ratio = a x² + b x + c (4.21)", "46.902, 0.1056, 0.9541", ", ".join(f"{c:.4g}" for c in rotation_ratio(grid).coefficients[::-1])],
    ["x_CR = a x + b (4.22)", "2.1722, -0.0635", ", ".join(f"{c:.4f}" for c in cor_x(grid).coefficients[::-1])],
]
table(["regression", "printed in the thesis", "of its printed table, here"], *slopes)

# %% [markdown]
# ## Figures 4-8 to 4-10: y of the centre of rotation
#
# It is on the other side than y_G, less so towards the front, and it does not vanish at y_G = 0 (right: the lines do not meet in the
# origin).

# %%
pick = (-0.06, -0.02, 0.02, 0.06, 0.10)
levels = [-0.03, 0.0, 0.03]
over_x, over_y = [], []
for n, at in enumerate(levels):
    here, model = np.isclose(y, at), rotation(np.stack([line[:, 0], np.full(93, at)], axis=-1), fitted)
    over_x.append(Series(f"y_G = {at:+.2f} m", x[here], grid.cor[here, 1], CYCLE[n], MARKERS[n], None))
    over_x.append(Series("", line[:, 0], model[:, 2], CYCLE[n]))
ends = np.array([-0.03, 0.03])
at_x, slope, intercept = cor_y_lines(grid)
for n, at in enumerate(pick):
    here, i = np.isclose(x, at), int(np.argmin(np.abs(at_x - at)))
    over_y.append(Series(f"x_G = {at:+.2f} m", y[here], grid.cor[here, 1], CYCLE[n], MARKERS[n], None))
    over_y.append(Series("", ends, intercept[i] + slope[i] * ends, CYCLE[n], dashes=(4, 2)))
picture(
    Panel("x_G [m]", "y_CR [m]", over_x, "4-8, 4-9: measured, and the friction model"),
    Panel("y_G [m]", "y_CR [m]", over_y, "4-10: measured, and lines by least squares"),
    row_in=3.6,
)

# %% [markdown]
# ## Figures 4-12 and 4-13: the thesis's second step
#
# The lines' slopes and intercepts become parabolas in x_G (4.24). The intercepts would be zero if the robot were the same left and right.

# %%
slopes_fit, intercepts_fit = cor_y_full(at_x, slope, intercept)
powers = line[:, :1] ** np.arange(3)
step = np.array([0.0, 0.01])
up, down = rotation(line + step, fitted), rotation(line - step, fitted)
picture(
    Panel(
        "x_G [m]",
        "slope of y_CR by y_G [-]",
        [
            Series("measured", at_x, slope, "grey", "o", None),
            Series("thesis", line[:, 0], powers @ slopes_fit.coefficients, "red", dashes=(4, 2)),
            Series("friction, four numbers", line[:, 0], (up - down)[:, 2] / 0.02, "blue"),
        ],
        "4-12",
    ),
    Panel(
        "x_G [m]",
        "y_CR at y_G = 0 [m]",
        [
            Series("measured", at_x, intercept, "grey", "o", None),
            Series("thesis", line[:, 0], powers @ intercepts_fit.coefficients, "red", dashes=(4, 2)),
            Series("friction, four numbers", line[:, 0], tuned[:, 2], "blue"),
        ],
        "4-13",
    ),
)

# %% [markdown]
# ## Figures 4-11, 4-14, 4-15: predicted against measured y_CR
#
# Three regressions of the thesis, and the friction model. On the diagonal all would be right.

# %%
said = {}
for title, variant in (
    ("4-11: multivariate (4.23)", "multivariate"),
    ("4-14: full (4.24)", "full"),
    ("4-15: symmetric (4.25)", "symmetric"),
):
    said[title] = skid.rotation(grid.cg, thesis_coefficients(variant))[2]
said["friction, four numbers"] = rotation(grid.cg, fitted)[:, 2]
diagonal = Series("", [-0.07, 0.07], [-0.07, 0.07], "ink")
picture(
    *(
        Panel(
            "measured y_CR [m]",
            "predicted [m]",
            [diagonal, Series("", grid.cor[:, 1], values, colour, "o", None)],
            f"{title}, RMS {1e3 * np.sqrt(np.mean((values - grid.cor[:, 1]) ** 2)):.1f} mm",
            x_range=(-0.075, 0.075),
            y_range=(-0.075, 0.075),
        )
        for (title, values), colour in zip(said.items(), ("red", "red", "red", "blue"), strict=True)
    ),
    row_in=2.9,
)

# %% [markdown]
# ## In one table
#
# Root mean square of what is left in 68 rotations.

# %%
measured = np.column_stack([grid.ratio, grid.cor])
k, x_cr, y_cr = skid.rotation(grid.cg, thesis_coefficients("full"))
candidates = {
    "diff_drive: turns as commanded, about its middle": np.tile([1.0, 0.0, 0.0], (len(x), 1)),
    "skid_steer, the thesis's regressions (11 numbers)": np.column_stack([multiplier * k, x_cr, y_cr]),
    "friction, the thesis's constants (nothing fitted)": rotation(grid.cg, friction.nominal),
    "friction, 4 numbers fitted": rotation(grid.cg, fitted),
}
left = {name: np.sqrt(np.mean((value - measured) ** 2, axis=0)) for name, value in candidates.items()}
table(["model", "rotation ratio [-]", "x_CR [m]", "y_CR [m]"], *([name, *errors] for name, errors in left.items()))

# %%
plane = cor_y_multivariate(grid)
(
    f"Multivariate regression of y_CR: R² = {plane.r_squared:.9f}, standard error {plane.standard_error:.9f} m "
    "(thesis, Table 4-4: 0.857262088, 0.011301514)."
)
