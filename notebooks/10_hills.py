# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 10. Hills: gravity is a moving centre of gravity
#
# **Claim: on a slope a robot that turns slides downhill, by half a metre and more in each turn; no planar odometry predicts that, and the
# friction model does, without a new parameter, by the tilt that the IMU measures.**
#
# A Husky turns in place and drives arcs on a ramp of 8 degrees. The simulator moves it by the forces on its four wheels, with inertia, by
# the same law of contact as the model's; odometry has its encoders and its IMU. In MuJoCo, whose contacts share nothing with that law, the
# slide of turns in place is predicted within 15 to 20 % (`python -m tests.studies.hills`).

# %%
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

import skidloc

bag = Path(tempfile.mkdtemp()) / "ramp.mcap"
options = ["--robot", "husky_a200", "--out", str(bag), "--config.experiment.laps", "1", "--config.sensors.lidar", "none"]
run = "from skidloc.start import main; raise SystemExit(main())"  # the command `skidloc`
subprocess.run([sys.executable, "-c", run, "simulate", "ramp", *options], check=True, capture_output=True)
log = skidloc.open(bag, "husky_a200")
log

# %% [markdown]
# ## What the flat model gets wrong
#
# `slopes=False` takes all ground as level. Both replays have the same wheels, gyro and model, `friction`; k is the same for both.

# %%
flat = log.replay(["friction/odometry"], config=skidloc.ReplayConfig(step=skidloc.StepConfig(slopes=False)))[0]
tilted = log.replay(["friction/odometry"])[0]
truth = skidloc.reference_track(log.log.references("/ground_truth/odom"), "the simulator")


def moved(stamps, poses):
    """(N, 3) motion since the first pose, in its frame; times [s]."""
    x, y, yaw = poses[0]
    c, s = np.cos(yaw), np.sin(yaw)
    off = poses[:, :2] - [x, y]
    turned = np.unwrap(poses[:, 2]) - yaw
    return (stamps - stamps[0]) * 1e-9, np.column_stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0], turned])


paths = {
    "true": moved(truth.stamps_ns, truth.poses),
    "flat model": moved(flat.trajectory.stamps_ns, flat.trajectory.poses),
    "with the slope": moved(tilted.trajectory.stamps_ns, tilted.trajectory.poses),
}
figure, axes = plt.subplots(figsize=(6.0, 4.0))
for (name, (_, path)), colour in zip(paths.items(), ("black", "tab:red", "tab:blue"), strict=True):
    axes.plot(path[:, 0], path[:, 1], color=colour, label=name)
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="From the first pose")
axes.legend()
plt.show()

# %% [markdown]
# ## The cause
#
# Gravity has a part along the ground, and its line through the centre of gravity (CG) meets the ground `h tan(tilt)` farther downhill: the
# slope moves the CG in the body, in another direction with each heading, and pulls. In place the robot slides by about
# `|w| (W/2) k^(-3/2) tan(tilt) / mu`, which no wheel and no gyro measures.

# %%
seconds, true_path = paths["true"]
figure, axes = plt.subplots(figsize=(6.0, 3.0))
for name, colour in (("flat model", "tab:red"), ("with the slope", "tab:blue")):
    at, path = paths[name]
    error = path[:, :2] - np.column_stack([np.interp(at, seconds, true_path[:, i]) for i in range(2)])
    axes.plot(at, np.hypot(*error.T), color=colour, label=name)
axes.set(xlabel="time [s]", ylabel="position error [m]")
axes.legend()
plt.show()

# %% [markdown]
# ## The extension, and the gain
#
# The attitude filter finds the tilt (an accelerometer bias or a mount that is off stays with the body, a slope turns against it). The
# balance of forces then has gravity's two parts. Nothing was fitted.

# %%
last = {name: path[-1] for name, (_, path) in paths.items()}
errors = {name: np.hypot(*(last[name] - last["true"])[:2]) for name in ("flat model", "with the slope")}
for name, error in errors.items():
    print(f"{name}: {error:.2f} m off at the end")
print(f"gain: {errors['flat model'] / errors['with the slope']:.0f} times")
up = tilted.result.run.in_space
print(f"height at the end by odometry: {up.positions[-1, 2]:+.2f} m")
