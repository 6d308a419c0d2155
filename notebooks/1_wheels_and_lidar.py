# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 1. Wheels and LiDAR measure one motion
#
# **Claim: wheels drift, LiDAR odometry diverges in a corridor, and their errors are independent. Weighed by their covariances, they are far
# better than either.**
#
# The log is real: 23 minutes through the ACES building (University of Texas at Austin, recorded by P. Beeson), with a planar laser of 5
# scans a second and the wheels' odometry. The reference was verified by hand: 1,279 relative poses (R. Kümmerle et al., 2009).

# %%
import itertools

from scipy.stats import chi2

from localization import Trial, open_log, read_reference_file, replay, score
from localization.report.notebook import Panel, Series, picture, table, trajectories
from localization.report.replay_page import verdict
from localization.report.runs import nis_means, plotted_runs, relation_bins
from motion_models import load_robot, make_model

LOG_S = 1400.0  # all of it

robot = load_robot("aces")
log = open_log("../tests/data/aces/aces.mcap", robot)
truth = read_reference_file("../tests/data/aces/aces.relations")
f"{log.duration_s:.0f} s; wheels on {log.sources.wheels.topic}, LiDAR on {log.sources.lidar.topic}"

# %% [markdown]
# Three estimators get the same events in the same order, as they would on the robot: the wheels alone, KISS-ICP alone (constant velocity
# is its only prior), and the filter, which predicts by the wheels, is corrected by scan matching, and estimates how much the wheels slip.

# %%
model = make_model("diff_drive", robot)
pairs = [Trial(model, estimator) for estimator in ("odometry", "lidar", "ekf")]
part = itertools.takewhile(lambda event: event.stamp_ns < log.start_ns + LOG_S * 1e9, log.events())
runs = replay(part, pairs, robot, log.mounts, has_lidar=True)
results = score(runs, truth)
trajectories(results, truth, "ACES: wheels, LiDAR alone, and both")

# %%
print(verdict(results, truth))

# %%
table(
    ["estimator", "mean error [m]", "mean error [deg]", "relations"],
    *(
        [
            result.run.estimator,
            result.accuracy.relations.all.translation_m,
            result.accuracy.relations.all.rotation_deg,
            result.accuracy.relations.all.n,
        ]
        for result in results
    ),
)

# %% [markdown]
# ## Errors over time
#
# Over a few seconds the wheels are as good as the filter, and the LiDAR alone is already lost in some places. Over minutes the wheels'
# heading drifts away; only the filter comes back to where it was.

# %%
lines = plotted_runs(results)
binned = [relation_bins(line, truth) for line in lines]
metres = [Series(line.label, s.seconds, s.translation_m, line.colour, "o", line.dashes) for line, s in zip(lines, binned, strict=True)]
degrees = [Series(line.label, s.seconds, s.rotation_deg, line.colour, "o", line.dashes) for line, s in zip(lines, binned, strict=True)]
picture(
    Panel("time from first to second pose [s]", "mean error [m]", metres, "Position", log_x=True, log_y=True),
    Panel("time from first to second pose [s]", "mean error [deg]", degrees, "Heading", log_x=True, log_y=True, legend=None),
)

# %% [markdown]
# ## Are the innovations consistent?
#
# A consistent filter has innovations whose normalised square (NIS) is 3 on average, and within the band as a mean of
# so many. Above it, LiDAR and prediction differ by more than their covariances allow; below, the covariances are larger than
# the errors.

# %%
shown, means = nis_means(lines, float(chi2.ppf(0.95, 3)))
nis = [Series(line.label, mean.seconds, mean.mean, line.colour) for line, mean in zip(shown, means, strict=True)]
count = means[0].group
band = tuple(chi2.ppf([0.025, 0.975], 3 * count) / count)
picture(Panel("time [s]", f"NIS, means of {count}", nis, log_y=True, band=band, level=3.0), columns=1, row_in=2.6)

# %% [markdown]
# ## What the filter estimated
#
# The wheels' clock is off against the LiDAR's, and the robot turns less than its wheels predict. Both were estimated from the innovations
# alone.

# %%
fused = results[-1].run
table(["learned", "value", "sigma"], *([name, float(mean), float(sigma)] for name, (mean, sigma) in fused.parameters.items()))
