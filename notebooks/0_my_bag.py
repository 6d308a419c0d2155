# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 0. My bag
#
# **Claim: a dozen lines take a bag to poses with covariances, a table of errors, a picture and a data frame.**
#
# Replace `LOG` by a bag of your own (ROS 1 `.bag`, ROS 2 folder or `.mcap`) and `ROBOT` by the nearest shipped robot
# (`skidloc robots`) or by a
# robot file that `skidloc init` wrote for yours. This one is a Clearpath Husky outdoors, with GPS as reference and no LiDAR.

# %%
import skidloc

LOG, ROBOT = "../tests/data/husky-outdoor-gps/test1.bag", "husky_a200"
log = skidloc.open(LOG, ROBOT)
log

# %% [markdown]
# ## Replay
#
# Each pair is MODEL/ESTIMATOR. Without a reference the errors are left out, and all else is the same.

# %%
runs = log.replay(["diff_drive/odometry", "skid_steer/odometry", "diff_drive/ekf", "skid_steer/ekf"])
runs

# %%
runs.plot()

# %% [markdown]
# What is wrong with the sensors, with what to do about it:

# %%
runs.warnings or "no problem was found"

# %% [markdown]
# ## Poses with their covariances
#
# One row for each estimate: position [m], heading [rad], their variances, and the twist of the body. `to_numpy()` is
# the same without pandas.

# %%
poses = runs["skid_steer/ekf"].to_pandas()
poses.tail()

# %% [markdown]
# ## What was learned
#
# Gyro bias, clocks and the motion model's own numbers, with standard deviations. A k that is several sigma from the
# robot file's means another
# floor, tyres or load: `skidloc calibrate` writes it to the robot file.

# %%
from localization.report.notebook import Panel, Series, picture, table

learned = runs["skid_steer/ekf"].result.run.parameters
table(["parameter", "value", "sigma"], *([name, mean, sigma] for name, (mean, sigma) in learned.items()))

# %%
seconds = poses["seconds"]
picture(
    Panel("time [s]", "position sigma [m]", [Series("", seconds, (poses["var_x"] + poses["var_y"]) ** 0.5)]),
    Panel("time [s]", "turn rate [rad/s]", [Series("", seconds, poses["wz"], colour="red")]),
)

# %% [markdown]
# ## Further
#
# The same by commands, with an interactive report: `skidloc replay LOG --robot ROBOT --out results`. Is the robot wired
# and described right:
# `skidloc check`. What does the motion model get wrong: `skidloc diagnose`. Your own events instead of a bag: `skidloc.Online`.
