# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # 4. The hidden effect: you pick one, the tool finds it
#
# **Claim: a cause that is written nowhere in a log can be named, with its size, from a minute of driving; and where nothing is hidden,
# nothing is found.**
#
# Change the next line, and run the notebook again. The simulator makes it true of the robot or of its sensors; the log, its transforms
# and the robot file hold nothing of it. Then `skidloc diagnose` gets the log.

# %%
HIDDEN = {"lidar_yaw": 0.03}

# %%
import sys
import tempfile
from pathlib import Path

import numpy as np

from localization.report.notebook import Bars, Panel, Series, picture, table
from localization.simulation import FAULTS

sys.path.insert(0, "..")
from tests.helpers.diagnosis_drives import TYPICAL, bag, diagnose_bag

table(
    ["you may hide", "unit", "a size that robots have", "meaning"],
    *([id_, FAULTS[id_].unit, size, FAULTS[id_].meaning] for id_, size in TYPICAL.items()),
)

# %% [markdown]
# ## The drive
#
# Ahead, arcs, turns on the spot and curves, forwards and backwards, with the arms in two postures: a minute and a half in a simulated
# hall.


# %%
def diagnosed(hidden, seed=0):
    """Drive with ``hidden`` effects, write the log, and diagnose it."""
    with tempfile.TemporaryDirectory() as folder:
        return diagnose_bag(bag(Path(folder) / "drive.mcap", hidden, seed))


found = diagnosed(HIDDEN)
d = found.diagnosis
print(f"{d.verdict}: {d.sentence}")

# %%
table(
    ["found", "size", "sigma", "hidden", "held-out errors fall by", "fits this drive as well"],
    *(
        [f.cause, f.size, f.sigma, HIDDEN.get(f.cause, 0.0), f"{100 * f.gain.relative:.0f} %", ", ".join(name for name, _ in f.aliases)]
        for f in d.findings
    ),
)

# %% [markdown]
# ## Before and after
#
# What the LiDAR measured of each two seconds, less what the wheels predicted; and the same once the finding is corrected.

# %%
count = np.arange(len(found.residuals.rows))
parts = (("forward [m]", 0), ("to the left [m]", 1), ("turn [rad]", 2))
picture(
    *(
        Panel(
            "window of 2 s",
            label,
            [
                Series("by the robot file", count, found.residuals.rows[:, column], "red", "s", (1, 1)),
                Series("corrected", count, found.residuals.left[:, column], "blue", "o"),
            ],
            level=0.0,
            legend="best" if column == 1 else None,
        )
        for label, column in parts
    ),
    columns=3,
    width_in=10.0,
)

# %% [markdown]
# ## And others
#
# Four more, one at a time, and nothing at all. Bars: the size that was found over the size that was hidden.

# %%
TRIED = ("wheel_radius_difference", "cg_offset_x", "lidar_time_offset", "friction_anisotropy")
others = {name: diagnosed({name: TYPICAL[name]}, seed=1).diagnosis for name in TRIED}
clean = diagnosed({}, seed=2).diagnosis
named = {name: {f.cause: f.size for f in other.findings} for name, other in others.items()}
picture(
    Bars("found over hidden [-]", list(TRIED), {"": [named[name].get(name, 0.0) / TYPICAL[name] for name in TRIED]}, level=1.0),
    columns=1,
    row_in=2.4,
)

# %%
table(
    ["hidden", "verdict", "found"],
    *(
        [name, other.verdict, ", ".join(f"{f.cause} {f.size:+.3g}" for f in other.findings)]
        for name, other in {**others, "nothing": clean}.items()
    ),
)
