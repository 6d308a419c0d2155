"""`skidloc warm-up`: compile what estimators, simulation and diagnosis need, once, where numba stores it."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from localization.commands.common import print_line
from localization.errors import OutputError

_ESTIMATORS = ("ekf", "graph")


@dataclass(frozen=True)
class WarmUpCommand:
    """Compile once what later starts load.

    It takes a minute, and seconds where all is compiled. Run it after an installation, as the user who runs skidloc: numba stores compiled
    code beside the package where that can be written, else in the user's home folder, or in NUMBA_CACHE_DIR.
    """

    def run(self, console: Console) -> None:
        """Run the command. Raises `OutputError` where compiled code cannot be stored."""
        from localization.ros import predictor
        from motion_models.compiled import NOT_STORED

        folder = stored_in(predictor._predict)
        if folder is None:
            raise OutputError(NOT_STORED)
        begin = time.monotonic()
        with ProcessPoolExecutor(len(PARTS), multiprocessing.get_context("spawn")) as pool:
            for part in [pool.submit(run_part, name) for name in PARTS]:
                part.result()
        print_line(console, f"compiled in {time.monotonic() - begin:.0f} s; stored in {folder}.")
        if not folder.is_relative_to(Path(__file__).parents[2]):
            print_line(console, "This is for one user: another one compiles anew, unless both have the same NUMBA_CACHE_DIR.")


def stored_in(kernel: object) -> Path | None:
    """Folder where numba stores ``kernel``; None where it cannot."""
    cache = getattr(getattr(kernel, "compiled", kernel), "_cache", None)
    path = getattr(cache, "cache_path", None)
    return None if path is None else Path(path)


def run_part(name: str) -> None:
    """One of `PARTS`, in silence."""
    with contextlib.redirect_stdout(io.StringIO()):
        PARTS[name]()


def _compile_fusion() -> None:
    """Filter, graph and scan matching, by short synthetic drives."""
    from localization.pipeline import Trial
    from localization.ros.jit_warm_up import WarmUp
    from localization.ros.settings import LiveRun
    from motion_models.registry import make_model
    from motion_models.robot_file import load_robot

    robot = load_robot("vaultbot")
    for estimator in _ESTIMATORS:
        trial = Trial(make_model("skid_steer", robot), estimator)

        def make_trial(has_lidar: bool, trial: Trial = trial) -> Trial:
            return trial

        WarmUp(LiveRun(robot, make_trial)).wait()


def _compile_diagnosis() -> None:
    """Simulation and the friction model's predictions, by a drive of half a minute."""
    with tempfile.TemporaryDirectory() as folder:
        log, out = str(Path(folder, "drive.mcap")), str(Path(folder, "out"))
        for command in (["simulate", "preliminary", "--out", log], ["diagnose", log, "--robot", "vaultbot", "--out", out]):
            subprocess.run([sys.executable, "-m", "localization.cli", *command], stdout=subprocess.DEVNULL, check=True)


PARTS: Mapping[str, Callable[[], None]] = {"estimators": _compile_fusion, "diagnosis": _compile_diagnosis}
