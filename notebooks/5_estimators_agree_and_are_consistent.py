# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 5. Filter and graph agree, and their covariances hold their errors
#
# **Claim: where sensors are as their files describe them, the filter's errors are not larger than its covariance; where one is not, NEES
# and coverage show it. On the simulated and real logs below the live factor graph stays within 1.4 of the filter's sigmas.**
#
# A consistent estimator has normalised errors `e^T P^-1 e` (NEES) that average to the number of the error's components, 3 for a
# pose, and its 95 % regions contain the truth in 95 of 100 runs. One run is one sample: errors along a run are not independent.

# %%
import itertools
import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import skidloc
from localization import Trajectory, Trial, open_log, replay
from localization.evaluation.consistency import consistency, nees
from localization.report.notebook import Bars, Panel, Series, picture, table
from localization.simulation import Experiment, ExperimentConfig, SensorConfig, Simulation, SimulationConfig, simulate, write_simulation
from localization.simulation.experiments import OpenLoop, Rest, constant
from localization.simulation.scanners import ScannerConfig
from motion_models import load_robot, make_model, se2

RUNS, LAPS = 12, 4
FOLDER = Path(tempfile.mkdtemp())
SENSORS = SensorConfig(scanner=ScannerConfig(rate_hz=10.0, beams=191))


def drive(robot, config):
    """Twelve seconds: a turn, an arc to the other side, and a turn back."""
    yield Rest(0.5)
    yield OpenLoop("turn", constant(0.0, 0.5), 4.0)
    yield OpenLoop("arc", constant(0.5, -0.3), 3.0)
    yield OpenLoop("turn back", constant(0.0, -0.5), 3.0)


def errors_of(run, truth):
    """Errors (N, 3) of a run from its first pose on, and their covariances (N, 3, 3)."""
    track = run.trajectory
    true = Trajectory(truth.stamps_ns, truth.poses).at(track.stamps_ns)
    inside = np.isfinite(true).all(axis=1) & (track.covariances[:, 0, 0] > 0.0)
    true = se2.compose(track.poses[inside][0], se2.between(true[inside][0], true[inside]))
    return se2.log(se2.between(track.poses[inside], true))[1:], track.covariances[inside][1:]


def ends(effects):
    """Errors (RUNS, 3) and covariances (RUNS, 3, 3) at the ends of drives, each with a noise of its own; ``effects`` are in no file."""
    experiment, found = Experiment("turns", "turns and an arc", "hall", (-4.0, 0.0, 0.0), drive), []
    for seed in range(RUNS):
        path = FOLDER / f"{'-'.join(effects)}{seed}.mcap"
        write_simulation(path, Simulation(experiment, load_robot("husky_a200"), seed, effects, SimulationConfig(sensors=SENSORS)))
        (run,) = runs = skidloc.open(path, "husky_a200").replay(["skid_steer/ekf"])
        found.append([values[-1] for values in errors_of(run, runs.reference)])
    return (np.array(values) for values in zip(*found, strict=True))


# %% [markdown]
# ## As large as the covariance, and where they are not
#
# The robot moves by the physics of its tyres, not by the filter's model. Then the same drives with a LiDAR whose ranges are 3 % too
# long, which no file has.

# %%
drives = {"as the files say": {}, "ranges 3 % too long": {"range_scale": 0.03}}
ended = {title: tuple(ends(effects)) for title, effects in drives.items()}
results = {title: consistency(*values) for title, values in ended.items()}
low, high = results["as the files say"].band
levels = np.linspace(0.02, 0.99, 60)
width = 1.96 * np.sqrt(levels * (1.0 - levels) / RUNS)
lines = [Series("consistent, 95 % of samples", levels, levels, "ink", below=levels - width, above=levels + width)]
for (title, values), colour in zip(ended.items(), ("blue", "red"), strict=True):
    lines.append(Series(title, levels, [np.mean(nees(*values) <= chi2.ppf(level, 3)) for level in levels], colour))
picture(
    Bars(
        f"mean NEES (consistent: {low:.1f} to {high:.1f})",
        list(drives),
        {"ekf": [c.mean for c in results.values()]},
        level=3.0,
        colours=("blue",),
    ),
    Panel("probability of the region", "share of runs inside", lines, "Coverage at the end of the runs", legend="upper left"),
    row_in=3.2,
)

# %%
table(
    ["drives", "mean NEES at the end", "95 % band", "inside their 95 % region", "verdict"],
    *(
        [title, c.mean, f"{c.band[0]:.2f} to {c.band[1]:.2f}", f"{100 * c.fraction_inside:.0f} %", c.verdict]
        for title, c in results.items()
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


config = SimulationConfig(experiment=ExperimentConfig(laps=LAPS))
write_simulation(FOLDER / "laps.mcap", simulate("laps", load_robot("vaultbot"), 0, {}, config))
laps = skidloc.open(FOLDER / "laps.mcap", "vaultbot").replay([f"skid_steer/{kind}" for kind in KINDS])
found = {
    "laps": [run.result.run for run in laps],
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
rows = []
for kind, run in zip(KINDS, found["laps"], strict=True):
    error, covariance = errors_of(run, laps.reference)
    rms = 1e3 * np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
    rows.append([kind, f"{rms:.1f}", nees(error, covariance).mean()])
table(["estimator", "RMS position error [mm]", "mean NEES"], *rows)
