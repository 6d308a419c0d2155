# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 11. The simulator: what MuJoCo's default contacts do to a skid-steer robot
#
# **Claim: with its default contacts MuJoCo turns VaultBot less than half as far as the real robot turned on the same wheels; with the
# friction model's contact law in their place, no number fitted, it turns as far as the real one at each centre of gravity.**
#
# 68 rotations in place were measured (Ebersole 2016), each at another centre of gravity (CG). Their wheel rates are played in MuJoCo, two
# seconds each: in a file that is written from the robot file as one would by hand, and in the same file with the contact law and servos
# that keep the rates, as the real ones did. It needs the extra `twin`. `skidloc twin` does this with a file and a log of your own, fits
# what is wrong, and writes the better file.

# %%
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from localization.twin.mujoco_simulator import read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.windows import windows_of
from motion_models.calibration.regressions import read_rotations, rotations_as_maneuvers
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROTATIONS = Path("../tests/data/vaultbot/rotation_grid.csv")
EVERY = 4

robot = load_robot("vaultbot")
windows = windows_of(rotations_as_maneuvers(read_rotations(ROTATIONS, robot), robot), robot)[::EVERY]
stock = read_simulator(mjcf_of(robot), robot)
friction = make_model("friction", robot)
mu, stiffness = (float(friction.nominal[friction.param_names.index(name)]) for name in ("mu", "slip_stiffness"))
lawful = stock.compiled(replace(stock.numbers, mu=mu, slip_stiffness=stiffness, servo_gain=10.0 * stock.numbers.servo_gain))
print(f"{len(windows)} rotations; contact law: mu {mu:.2f}, K {stiffness:.0f}")

# %% [markdown]
# ## How far it turns
#
# k is the turn over that of wheels which do not slide.

# %%
wheels = np.array([(w.mean_rates[1] - w.mean_rates[0]) * w.duration_s for w in windows])
ideal = wheels * robot.geometry.wheel_radius_m / robot.geometry.track_width_m
played = {"default contacts": stock.engine.play(windows), "contact law": lawful.play(windows)}
measured = np.array([w.measured for w in windows])
true = measured[:, 2] / ideal
figure, axes = plt.subplots(figsize=(5.0, 4.5))
axes.plot([0.0, 1.0], [0.0, 1.0], color="grey")
for (name, motion), colour in zip(played.items(), ("tab:red", "tab:blue"), strict=True):
    k = motion.poses[:, 2] / ideal
    axes.plot(true, k, "o", color=colour, label=name)
    print(f"{name}: k {k.mean():.3f} (measured {true.mean():.3f}), root mean square error {np.sqrt(((k - true) ** 2).mean()):.3f}")
axes.set(xlabel="k measured", ylabel="k in MuJoCo", xlim=(0.0, 1.0), ylim=(0.0, 1.0), title="One point for each centre of gravity")
axes.legend()
plt.show()

# %% [markdown]
# ## Why
#
# Wheels that scrub hop: the solver's friction is coupled to the normal force of its soft contacts, so that a wheel that slides sideways is
# pushed off the floor. The contact law takes friction from the wheel's load and its slip alone.

# %%
for name, motion in played.items():
    print(f"{name}: {motion.touch.describe()}")
figure, axes = plt.subplots(figsize=(6.0, 3.0))
count = len(stock.engine.robot.joints)
for i, (name, colour) in enumerate(zip(played, ("tab:red", "tab:blue"), strict=True)):
    axes.bar(np.arange(count + 1) + 0.4 * i, 100.0 * played[name].touch.shares, width=0.4, color=colour, label=name)
axes.set(xlabel="wheels on the floor", ylabel="share of the time steps [%]")
axes.legend()
plt.show()
