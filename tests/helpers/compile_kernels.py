"""Compile the kernels that most tests use, once, by two processes: pytest's workers would each compile all of them.

    python -m tests.helpers.compile_kernels

Numba's cache has no lock, so that processes which begin together compile the same kernels. Takes some seconds where all is compiled.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from localization.cli import main
from localization.pipeline import Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.settings import LiveRun
from motion_models.registry import make_model
from motion_models.robot_file import load_robot


def compile_fusion() -> None:
    """Filter, graph and scan matching, by short synthetic drives."""
    robot = load_robot("vaultbot")
    for estimator in ("ekf", "graph"):
        trial = Trial(make_model("skid_steer", robot), estimator)
        WarmUp(LiveRun(robot, lambda has_lidar, trial=trial: trial)).wait()


def compile_diagnosis() -> None:
    """Simulation and the friction model's predictions, by a drive of half a minute."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "drive.mcap")
        main(["simulate", "preliminary", "--out", str(log)])
        main(["diagnose", str(log), "--robot", "vaultbot", "--out", str(Path(folder, "out"))])


PARTS = {"fusion": compile_fusion, "diagnosis": compile_diagnosis}

if __name__ == "__main__":
    if len(sys.argv) > 1:
        PARTS[sys.argv[1]]()
    else:
        running = [subprocess.Popen([sys.executable, "-m", __spec__.name, part], stdout=subprocess.DEVNULL) for part in PARTS]
        sys.exit(max(process.wait() for process in running))
