# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 5. Filter and graph agree, and their covariances are as large as their errors
#
# **Claim: where the noise is as assumed, the filter's errors are as large as its covariance; where it is not, NEES and coverage show it.
# On the simulated and real logs below the live factor graph stays within 2.1 of the filter's sigmas.**
#
# A consistent estimator has normalised errors `e^T P^-1 e` (NEES) that average to the number of the error's components, 3 for a
# pose, and its 95 % regions contain the truth in 95 of 100 runs. One run is one sample: errors along a run are not independent.

# %%
import itertools
import sys
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from localization import Trial, open_log, replay
from localization.evaluation.consistency import consistency, mean_over_runs, nees
from localization.report.notebook import Bars, Panel, Series, picture, table
from localization.trajectory import Trajectory
from motion_models import load_robot, make_model, se2

sys.path.insert(0, "..")
from tests.helpers.synthetic_steps import PoseSensor, make_filter, run
from tests.studies.graph_corrections import laps

RUNS, STEPS = 40, 150
LAPS = 7


class OptimisticSensor(PoseSensor):
    """A LiDAR that claims sigmas ``factor`` times what they are."""

    def __init__(self, factor):
        super().__init__()
        self.factor = factor

    def measure(self, step, prior, cov, offset):
        found = super().measure(step, prior, cov, offset)
        return None if found is None else replace(found, cov=found.cov * self.factor**2)


def runs(factor=1.0):
    """Errors (R, N, 3) and covariances of pose estimates of ``RUNS`` drives: 15 s in bends both ways, by wheels, gyro and LiDAR.

    The robot's slip, gyro bias, clock, k and centre of rotation are drawn from the filter's priors; the LiDAR measures poses.
    """
    errors, covariances = [], []
    for seed in range(RUNS):
        sensor = OptimisticSensor(factor)
        found, truth = run(make_filter(sensor), sensor, seed, STEPS)
        errors.append(se2.log(se2.between(np.array([e.pose for e in found]), truth)))
        covariances.append([e.covariance for e in found])
    return np.array(errors), np.array(covariances)


errors, covariances = runs()

# %% [markdown]
# ## Consistent where the noise is as assumed
#
# Mean NEES over the runs at each instant, and the band that contains it at 95 of 100 instants. Right: the share of runs whose pose lies
# in the region of each probability.

# %%
time = 0.1 * np.arange(1, STEPS + 1)
levels = np.linspace(0.02, 0.99, 60)
values = nees(errors.reshape(-1, 3), covariances.reshape(-1, 3, 3)).reshape(RUNS, STEPS)
mean, band = mean_over_runs(values, 3)
share = [np.mean(values[:, -1] <= chi2.ppf(level, 3)) for level in levels]
width = 1.96 * np.sqrt(levels * (1.0 - levels) / RUNS)
ideal = Series("consistent, 95 % of samples", levels, levels, "ink", below=levels - width, above=levels + width)
picture(
    Panel(
        "time [s]",
        f"mean NEES of {RUNS} runs",
        [Series("ekf", time, mean, "blue")],
        "Pose errors, 3 expected",
        band=band,
        level=3.0,
        y_range=(0.0, 6.0),
    ),
    Panel(
        "probability",
        "share of runs",
        [ideal, Series("ekf", levels, share, "blue")],
        "Coverage at the end of the runs",
        legend="upper left",
    ),
    row_in=3.4,
)

# %% [markdown]
# ## And where it is not
#
# The same drives with a LiDAR that claims to be three times better than it is.

# %%
claims = {"LiDAR claims\na third of\nits sigmas": 1.0 / 3.0, "LiDAR\nas it is": 1.0}
ends = {}
for title, factor in claims.items():
    e, P = (errors, covariances) if factor == 1.0 else runs(factor)
    ends[title] = consistency(e[:, -1], P[:, -1])
low, high = ends["LiDAR\nas it is"].band
picture(
    Bars(
        f"mean NEES (consistent: {low:.1f} to {high:.1f})",
        list(claims),
        {"ekf": [ends[t].mean for t in claims]},
        level=3.0,
        colours=("blue",),
    ),
    Bars(
        "runs inside their 95 % regions [%]",
        list(claims),
        {"ekf": [100 * ends[t].fraction_inside for t in claims]},
        level=95.0,
        colours=("blue",),
    ),
    row_in=2.8,
)

# %%
table(
    ["drives", "mean NEES at the end", "95 % band", "inside their 95 % region", "verdict"],
    *(
        [" ".join(title.split()), c.mean, f"{c.band[0]:.2f} to {c.band[1]:.2f}", f"{100 * c.fraction_inside:.0f} %", c.verdict]
        for title, c in ends.items()
    ),
)

# %% [markdown]
# ## Filter and graph agree, on simulated and real logs
#
# How far the two are apart, in sigmas of the filter: simulated laps (wheels, gyro and LiDAR), the first two minutes of ACES (wheels and
# LiDAR) and five of the Husky outdoors (wheels and gyro). The graph is the live one, as it drove.

# %%
KINDS = ("ekf", "graph")


def replay_log(path, robot, seconds):
    """Filter and graph over the first ``seconds`` of a log."""
    log = open_log(f"../tests/data/{path}", robot)
    part = itertools.takewhile(lambda e: e.stamp_ns < log.start_ns + seconds * 1e9, log.events())
    return replay(part, [Trial(make_model("diff_drive", robot), kind) for kind in KINDS], robot, log.mounts, log.sources.lidar is not None)


vaultbot, drive = load_robot("vaultbot"), laps(count=LAPS)
found = {
    "laps": replay(drive.events, [Trial(make_model("skid_steer", vaultbot), kind) for kind in KINDS], vaultbot, drive.mounts, True),
    "ACES": replay_log("aces/aces.mcap", load_robot("aces"), 120.0),
    "Husky": replay_log("husky-outdoor-gps/test1.bag", load_robot("husky_a200"), 300.0),
}
apart, learned = [], []
for (title, (ekf, graph)), colour in zip(found.items(), ("green", "blue", "red"), strict=True):
    track = ekf.trajectory
    other = graph.trajectory.at(track.stamps_ns)
    common = np.isfinite(other).all(axis=1)
    sigmas = np.sqrt(np.maximum(track.covariances[common].diagonal(axis1=1, axis2=2), 1e-8))
    distance = np.abs(se2.log(se2.between(track.poses[common], other[common])) / sigmas).max(axis=1)
    apart.append(Series(title, (track.stamps_ns[common] - track.stamps_ns[0]) * 1e-9, distance, colour))
    for name, (mean, sigma) in ekf.parameters.items():
        learned.append([title, name, *(f"{m:.4g} ± {s:.2g}" for m, s in ((mean, sigma), graph.parameters[name]))])
picture(Panel("time [s]", "apart [sigmas]", apart, "Filter against graph, largest of x, y, heading", level=1.0), columns=1, row_in=2.6)

# %%
table(["log", "learned", "ekf", "graph"], *learned)

# %% [markdown]
# The laps have a truth: errors of both, and their normalised squares, in the mean over the drive (3 expected; one drive is one sample).

# %%
truth, rows = Trajectory(drive.truth.stamps_ns, drive.truth.poses), []
for kind, estimate in zip(KINDS, found["laps"], strict=True):
    track = estimate.trajectory
    true = truth.at(track.stamps_ns)
    inside = np.isfinite(true).all(axis=1) & (track.covariances[:, 0, 0] > 0.0)
    true = se2.compose(track.poses[inside][0], se2.between(true[inside][0], true[inside]))
    error = se2.log(se2.between(track.poses[inside], true))
    rms = 1e3 * np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
    rows.append([kind, f"{rms:.1f}", nees(error[1:], track.covariances[inside][1:]).mean()])
table(["estimator", "RMS position error [mm]", "mean NEES"], *rows)
