"""Systems that the user adds by ``--peer NAME=PATH``: sources that are built here, or a folder of finished trajectories.

PATH is a folder with LOG.tum for each log, or sources in C++: one folder, or several with ``:`` between (a peer's own and those of what it
needs), and a driver run_NAME.cpp in the first or beside it, as `peers/source.py` starts it. Nothing of a peer is part of this project.
"""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import numpy as np

from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import ReferenceTrack
from tests.league.peers.exchange import write
from tests.league.systems import System

_COMPILER = ("g++", "-O3", "-std=c++17", "-w")
_LIBRARIES = {"open_karto": ("-lboost_thread", "-lboost_system", "-lpthread"), "kinematic-icp": ("-ltbb", "-lpthread")}
_LEFT_OUT = ("pybind", "test", "examples", "samples")
"""Folders of sources that are no part of a library."""
_GRIDS = {
    "open_karto": {"smear": (0.03, 0.05, 0.1), "dim": (0.3, 0.5), "travel": (0.3, 0.5), "fine": (0.35, 0.45, 0.6)},
    "kinematic-icp": {"voxel": (0.1, 0.2, 0.3, 0.5, 1.0), "iterations": (10, 50)},
}
"""Settings that are tuned, and their values."""
_TIMEOUT_S = 1800.0


def parse(words: list[str]) -> list[System]:
    """The systems of ``NAME=PATH``. Raises `SystemExit` for a word that is none, or a path that is not there."""
    found = []
    for word in words:
        name, is_pair, path = word.partition("=")
        folders = tuple(Path(part) for part in path.split(":"))
        if not is_pair or not name:
            raise SystemExit(f"--peer {word}: give NAME=PATH, a folder of sources or of LOG.tum files.")
        if missing := [str(folder) for folder in folders if not folder.is_dir()]:
            raise SystemExit(f"--peer {word}: no folder {', '.join(missing)}.")
        is_finished = any(folders[0].glob("*.tum"))
        if not is_finished and name not in _GRIDS:
            raise SystemExit(f"--peer {word}: no .tum file there, and sources are known of {', '.join(_GRIDS)} alone (peers/source.py).")
        what = "trajectories of its own" if is_finished else "wheels and LiDAR; built from sources"
        found.append(System(name, what, folders=folders, tuned={} if is_finished else _GRIDS[name]))
    return found


def build(name: str, folders: tuple[Path, ...], out: Path) -> Path:
    """The program of a peer, compiled into ``out`` unless it is there. Raises `SystemExit` with the compiler's first error."""
    driver_name = f"run_{name.replace('-', '_')}.cpp"
    driver = next((at / driver_name for at in (folders[0], folders[0].parent) if (at / driver_name).exists()), None)
    if driver is None:
        raise SystemExit(f"{name}: no {driver_name} in {folders[0]} or beside it")
    sources = sorted(
        file for folder in folders for file in folder.rglob("*.cpp") if not set(_LEFT_OUT) & set(file.parts) and file != driver
    )
    roots = {
        Path("/usr/include/eigen3"),
        *folders,
        *(at for folder in folders for at in folder.rglob("*") if at.name in ("include", "cpp")),
    }
    state = hashlib.sha256(b"".join(file.read_bytes() for file in (driver, *sources))).hexdigest()[:16]
    program = (out / "programs" / f"{name}-{state}").resolve()
    if not program.exists():
        print(f"{name}: compiling {len(sources) + 1} files", flush=True)
        program.parent.mkdir(parents=True, exist_ok=True)
        command = [
            *_COMPILER,
            *(f"-I{root}" for root in sorted(roots)),
            *map(str, (*sources, driver)),
            *_LIBRARIES[name],
            "-o",
            str(program),
        ]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except FileNotFoundError:
            raise SystemExit(f"{name}: no g++ to build it; Debian: apt install g++ libboost-thread-dev libeigen3-dev libtbb-dev") from None
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line]
            raise SystemExit(f"{name} was not built: {(errors or ['the compiler ended without a word'])[0]}")
    return program


def take_trajectory(system: System, log: str, target: Path) -> str:
    """Put the finished trajectory of ``log`` beside the others' results. Returns why there is none, or an empty string."""
    path = system.folders[0] / f"{log}.tum"
    if not path.exists():
        return f"{path}: missing"
    track = read_reference_file(path)
    if not isinstance(track, ReferenceTrack) or not np.isfinite(track.poses).all():
        return f"{path}: not a trajectory with headings"
    write(str(target), track.stamps_ns, track.poses, float("nan"))
    return ""
