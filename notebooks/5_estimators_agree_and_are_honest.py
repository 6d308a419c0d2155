# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 5. Two estimators agree, and both know how wrong they are
#
# **Claim: the extended Kalman filter and the factor graph, which share nothing but the residuals, say the same; where the noise is what
# they are told, their errors are as large as they say; where it is not, NEES and coverage tell.**
#
# An estimator that is honest has normalised errors `e^T P^-1 e` (NEES) that average to the number of the error's components, 3 for a
# pose, and its 95 % regions hold the truth in 95 of 100 runs. One run is one sample: errors along a run are not independent.

# %%
import itertools
import sys

import numpy as np
from scipy.stats import chi2

from localization import Pair, open_log, replay
from localization.consistency import consistency, mean_over_runs, nees
from localization.estimators.witness import Sight
from localization.plots_notebook import Bars, Panel, Series, picture, table
from motion_models import Motion, load_robot, make_model, se2

sys.path.insert(0, "..")
from tests.graph_help import make, run
from tests.synthetic_steps import Seer

RUNS, STEPS = 40, 150

STYLE = {"ekf": ("blue", ()), "graph": ("green", (4, 2))}


class Boaster(Seer):
    """A LiDAR that claims sigmas ``factor`` times what they are."""

    def __init__(self, factor):
        super().__init__()
        self.factor = factor

    def look(self, step, anchor, guess):
        if self.next is None:
            return None
        return Sight(Motion(self.next.delta, self.next.cov * self.factor**2), True)


def runs(kind, factor=1.0):
    """Errors (R, N, 3) and covariances of pose estimates of ``RUNS`` drives: 15 s in bends both ways, by wheels, gyro and LiDAR.

    The robot's slip, gyro bias, clock, k and centre of rotation are drawn as the estimators are told.
    """
    errors, covariances = [], []
    for seed in range(RUNS):
        seer = Boaster(factor)
        found, truth = run(make(kind, seer), seer, seed, STEPS)
        errors.append(se2.log(se2.between(np.array([e.pose for e in found]), truth)))
        covariances.append([e.covariance for e in found])
    return np.array(errors), np.array(covariances)


honest = {kind: runs(kind) for kind in STYLE}

# %% [markdown]
# ## Honest where the noise is as told
#
# Mean NEES over the runs at each instant, and the band that it keeps to in 95 of 100 instants. Right: the share of runs whose pose lies
# in the region that was said to hold it with a probability.

# %%
time = 0.1 * np.arange(1, STEPS + 1)
lines, coverage = [], []
levels = np.linspace(0.02, 0.99, 60)
for kind, (errors, covariances) in honest.items():
    values = nees(errors.reshape(-1, 3), covariances.reshape(-1, 3, 3)).reshape(RUNS, STEPS)
    mean, band = mean_over_runs(values, 3)
    lines.append(Series(kind, time, mean, STYLE[kind][0], dashes=STYLE[kind][1]))
    share = [np.mean(values[:, -1] <= chi2.ppf(level, 3)) for level in levels]
    coverage.append(Series(kind, levels, share, STYLE[kind][0], dashes=STYLE[kind][1]))
width = 1.96 * np.sqrt(levels * (1.0 - levels) / RUNS)
ideal = Series("honest, 95 % of samples", levels, levels, "ink", below=levels - width, above=levels + width)
picture(
    Panel(
        "time [s]",
        f"mean NEES of {RUNS} runs",
        lines,
        "Pose errors, 3 expected",
        band=band,
        level=3.0,
        y_range=(0.0, 6.0),
        legend="lower right",
    ),
    Panel("said", "found", [ideal, *coverage], "Coverage at the end of the runs", legend="upper left"),
    row_in=3.4,
)

# %%
table(
    ["estimator", "mean NEES at the end", "95 % band", "inside their 95 % region", "verdict"],
    *(
        [kind, c.mean, f"{c.band[0]:.2f} to {c.band[1]:.2f}", f"{100 * c.fraction_inside:.0f} %", c.verdict]
        for kind, c in ((kind, consistency(e[:, -1], P[:, -1])) for kind, (e, P) in honest.items())
    ),
)

# %% [markdown]
# ## And where it is not
#
# The same drives with a LiDAR that claims to be three times better than it is. A test that cannot fail would prove nothing.

# %%
claims = {"LiDAR claims\na third of\nits sigmas": 1.0 / 3.0, "LiDAR\nas it is": 1.0}
ends = {}
for kind in STYLE:
    for title, factor in claims.items():
        errors, covariances = honest[kind] if factor == 1.0 else runs(kind, factor)
        ends[kind, title] = consistency(errors[:, -1], covariances[:, -1])
low, high = ends["ekf", "LiDAR\nas it is"].band
picture(
    Bars(
        f"mean NEES (honest: {low:.1f} to {high:.1f})",
        list(claims),
        {k: [ends[k, t].mean for t in claims] for k in STYLE},
        level=3.0,
        colours=("blue", "green"),
    ),
    Bars(
        "runs inside their 95 % regions [%]",
        list(claims),
        {k: [100 * ends[k, t].fraction_inside for t in claims] for k in STYLE},
        level=95.0,
        colours=("blue", "green"),
    ),
    row_in=2.8,
)

# %%
table(
    ["estimator", "drives", "mean NEES", "verdict"],
    *([kind, " ".join(title.split()), c.mean, c.verdict] for (kind, title), c in ends.items()),
)

# %% [markdown]
# ## They agree, on real logs too
#
# How far the two are apart, in sigmas of the filter: the first two minutes of ACES (wheels and LiDAR) and five of the Husky outdoors
# (wheels and gyro).

# %%
LOGS = {"ACES": ("aces/aces.mcap", "aces", 120.0), "Husky": ("husky-outdoor-gps/test1.bag", "husky_a200", 300.0)}
apart, learned = [], []
for (title, (path, robot_name, seconds)), colour in zip(LOGS.items(), ("blue", "red"), strict=True):
    robot = load_robot(robot_name)
    log = open_log(f"../tests/data/{path}", robot)
    part = itertools.takewhile(lambda e, end=log.start_ns + seconds * 1e9: e.stamp_ns < end, log.events())
    model = make_model("diff_drive", robot)
    ekf, graph = replay(part, [Pair(model, kind) for kind in STYLE], robot, log.mounts, log.sources.lidar is not None)
    sigmas = np.sqrt(np.maximum(ekf.trajectory.covariances.diagonal(axis1=1, axis2=2), 1e-8))
    distance = np.abs(se2.log(se2.between(ekf.trajectory.poses, graph.trajectory.poses)) / sigmas).max(axis=1)
    apart.append(Series(title, (ekf.trajectory.stamps_ns - ekf.trajectory.stamps_ns[0]) * 1e-9, distance, colour))
    for name, (mean, sigma) in ekf.parameters.items():
        learned.append([title, name, *(f"{m:.4g} ± {s:.2g}" for m, s in ((mean, sigma), graph.parameters[name]))])
picture(Panel("time [s]", "apart [sigmas]", apart, "Filter against graph, largest of x, y, heading", level=1.0), columns=1, row_in=2.6)

# %%
table(["log", "learned", "ekf", "graph"], *learned)
