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
import tempfile
from pathlib import Path

import numpy as np

from localization import open_log
from localization.diagnosis.causes import CAUSES
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_log
from localization.report.notebook import Bars, Panel, Series, picture, table
from localization.simulation import FAULTS, Experiment, SensorConfig, Simulation, SimulationConfig, write_simulation
from localization.simulation.experiments import MoveArms, OpenLoop, Rest, constant, sine
from localization.simulation.scanners import ScannerConfig
from motion_models import load_robot, make_model

table(
    ["you may hide", "unit", "a size that robots have", "meaning"],
    *([id_, fault.unit, CAUSES[id_].typical, fault.meaning] for id_, fault in FAULTS.items() if id_ in CAUSES),
)

# %% [markdown]
# ## The drive
#
# Ahead, arcs, turns on the spot and curves, forwards and backwards, with the arms in two postures: a minute and a half in a simulated
# hall.

# %%
ROBOT = load_robot("vaultbot")
SENSORS = SensorConfig(scanner=ScannerConfig(beams=191))


def tour(robot, config):
    """What is driven: each kind of motion, with each posture of the arms."""
    yield Rest(2.0)
    for cg, sign in (((0.06, -0.01), 1.0), ((-0.02, 0.02), -1.0)):
        yield MoveArms(np.array(cg))
        yield OpenLoop("ahead", constant(0.5, 0.0), 3.0)
        yield OpenLoop("arc", constant(0.5, 0.35 * sign), 4.0)
        yield OpenLoop("turn", constant(0.0, 0.4 * sign), 5.0)
        yield OpenLoop("curves", sine(0.45, 0.5, 4.0), 4.0)
        yield OpenLoop("turn back", constant(0.0, -0.4 * sign), 5.0)
        yield OpenLoop("back", constant(-0.5, -0.1 * sign), 4.0)


def diagnosed(hidden, seed=0):
    """Drive with ``hidden`` effects, write the log, and diagnose it."""
    experiment = Experiment("tour", "all kinds of motion", "hall", (-4.0, 0.0, 0.0), tour)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_simulation(log, Simulation(experiment, ROBOT, seed, hidden, SimulationConfig(sensors=SENSORS)))
        return examine(drive_of_log(open_log(log, ROBOT)), make_model("friction", ROBOT))


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
TRIED = {"wheel_radius_difference": 0.02, "cg_offset_x": 0.03, "lidar_time_offset": 0.05, "friction_anisotropy": 0.2}
others = {name: diagnosed({name: size}, seed=1).diagnosis for name, size in TRIED.items()}
clean = diagnosed({}, seed=2).diagnosis
named = {name: {f.cause: f.size for f in other.findings} for name, other in others.items()}
picture(
    Bars("found over hidden [-]", list(TRIED), {"": [named[name].get(name, 0.0) / size for name, size in TRIED.items()]}, level=1.0),
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
