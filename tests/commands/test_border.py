"""Every command and writer on bad days: full disk, read-only folder, other encodings, closed output, Ctrl-C at any moment."""

from __future__ import annotations

import fcntl
import io
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from localization import cli
from localization.cli import COMMANDS, main
from localization.simulation.experiments import EXPERIMENTS
from motion_models import jit_gufunc
from tests.helpers import bags, online
from tests.helpers.disks import files_of_at_most
from tests.helpers.extended import cases
from tests.helpers.rooms import drive

pytestmark = pytest.mark.xdist_group("border")

COMMON = ("--robot", "{robot}")
WRITERS: dict[str, tuple[str, ...]] = {
    "info": ("info", "{log}", *COMMON, "--json", "{out}.json"),
    "replay": ("replay", "{log}", *COMMON, "--model", "skid_steer", "--estimator", "ekf", "--out", "{out}", "--json", "{out}.json"),
    "replay --save-map": (
        "replay",
        "{log}",
        *COMMON,
        "--model",
        "skid_steer",
        "--estimator",
        "graph",
        "--out",
        "{out}",
        "--save-map",
        "{out}.map",
    ),
    "compare": ("compare", "{nothing}", *COMMON, "--out", "{out}.csv", "--processes", "1"),
    "table": ("table", "{results}", "--json", "{out}.json"),
    "calibrate": ("calibrate", "{log}", *COMMON, "--out", "{out}.toml", "--json", "{out}.json"),
    "diagnose": ("diagnose", "{log}", *COMMON, "--model", "skid_steer", "--out", "{out}"),
    "weigh": ("weigh", "{log}", *COMMON, "--out", "{out}.toml"),
    "init": ("init", "{log}", "--like", "{robot}", "--out", "{out}.toml"),
    "check": ("check", "{log}", *COMMON, "--out", "{out}", "--json", "{out}.json"),
    "robots": ("robots", "--json", "{out}.json"),
    "cg": ("cg", "--posture", "ready", *COMMON, "--json", "{out}.json"),
    "map": ("map", "info", "{map}", "--json", "{out}.json"),
    "map export": ("map", "export", "{map}", "--out", "{out}.pgm"),
    "online .tum": ("online", "{log}", *COMMON, "--rate", "max", "--out", "{out}.tum", "--state", "{out}.state"),
    "online .mcap": ("online", "{log}", *COMMON, "--rate", "max", "--out", "{out}.mcap"),
    "simulate .bag": ("simulate", "short", *COMMON, "--out", "{out}.bag"),
    "simulate .mcap": ("simulate", "short", *COMMON, "--out", "{out}.mcap", "--json", "{out}.json"),
    "simulate folder": ("simulate", "short", *COMMON, "--out", "{out}"),
}
"""Each command with each kind of file that it writes."""
RESULTS = "log,model,estimator,corrections,key,status,error,robot,k,k_sigma\na.mcap,skid_steer,ekf,constant,0,ok,,vaultbot,0.5,0.01\n"
"""A table of one run."""


class Inputs:
    """Placeholders of `WRITERS`."""

    def __init__(self, folder: Path) -> None:
        self.log = bags.write_mcap(folder / "run.mcap", drive(4.0))
        self.map, self.nothing, self.results = folder / "hall.map", folder / "nothing.mcap", folder / "results.csv"
        self.results.write_text(RESULTS)
        assert main([*self.arguments("replay --save-map", folder / "o"), "--json", str(folder / "m.json")]) == 0
        (folder / "o.map").rename(self.map)

    def arguments(self, writer: str, out: Path, robot: str = "vaultbot") -> list[str]:
        return [part.format(**vars(self), out=out, robot=robot) for part in WRITERS[writer]]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(autouse=True)
def short_experiment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXPERIMENTS, "short", online.DRIVE)  # type: ignore[arg-type]


def check(code: int, capsys: pytest.CaptureFixture[str], *allowed: int) -> str:
    """A message and an exit code, no trace."""
    shown = capsys.readouterr()
    assert code in allowed, shown.err
    assert "Traceback" not in shown.err
    assert "defect" not in shown.err
    assert (code == 0) or shown.err.startswith("skidloc: "), shown.err
    return shown.err


def test_writers_cover_each_command() -> None:
    """`try` writes by the writers of the others; `twin` takes minutes, and has its own tests; `warm-up` writes what numba does."""
    assert {arguments[0] for arguments in WRITERS.values()} == set(COMMANDS) - {"try", "twin", "warm-up"}


@pytest.mark.extended
@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("size", [0, 3000])
def test_full_disk_is_a_message_and_leaves_no_file(
    writer: str, size: int, inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_of_at_most(size):
        code = main(inputs.arguments(writer, tmp_path / "out"))
    check(code, capsys, 0, 2)
    if code and writer != "compare":  # the table is kept and completed later
        assert [path.name for path in tmp_path.rglob("*") if path.stat().st_size and path.is_file()] == []


@pytest.mark.parametrize("writer", cases(WRITERS, ("info", "replay", "check")))
def test_folder_that_cannot_be_written_is_a_message(writer: str, inputs: Inputs, capsys: pytest.CaptureFixture[str]) -> None:
    """/proc refuses new files to every user, root included."""
    check(main(inputs.arguments(writer, Path("/proc/out"))), capsys, 2)


@pytest.mark.parametrize("writer", cases(WRITERS, ("info", "replay")))
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_output_in_another_encoding_has_question_marks(
    writer: str, encoding: str, inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    code = main(inputs.arguments(writer, tmp_path / "out \N{SNOWMAN}"))
    for stream in streams.values():
        stream.flush()
    shown = streams["stderr"].buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
    assert code in (0, 2), shown
    assert code == 0 or shown.startswith("skidloc: ")


@pytest.mark.parametrize("writer", cases(WRITERS, ("info", "replay", "check")))
def test_closed_output_ends_no_command(writer: str, inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(inputs.arguments(writer, tmp_path / "out")) in (0, 2)


@pytest.mark.parametrize("writer", cases(WRITERS, ("info", "replay", "check")))
@pytest.mark.parametrize("operation", [0, 1, 4])
def test_interrupt_at_a_file_operation_leaves_no_partial_file(
    writer: str, operation: int, inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Interrupt(tmp_path, operation):
        code = main(inputs.arguments(writer, tmp_path / "out"))
    check(code, capsys, 0, 2, 130)
    hidden = [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert hidden == [] or (hidden == [".out.tum.part"] and (tmp_path / "out.state").exists())


class Interrupt:
    """Ctrl-C at the operation of this number on files in a folder: opening, renaming, making folders."""

    _present: Interrupt | None = None
    _is_hooked = False

    def __init__(self, folder: Path, operation: int) -> None:
        self._folder, self._left = str(folder), operation

    def __enter__(self) -> None:
        if not Interrupt._is_hooked:
            sys.addaudithook(Interrupt._audit)  # there is no way to remove it
        Interrupt._present, Interrupt._is_hooked = self, True

    def __exit__(self, *error: object) -> None:
        Interrupt._present = None

    @staticmethod
    def _audit(event: str, arguments: tuple[object, ...]) -> None:
        present = Interrupt._present
        is_main = threading.current_thread() is threading.main_thread()  # signals come to no other
        if present is None or not is_main or event not in ("open", "os.rename", "os.mkdir", "sqlite3.connect"):
            return
        if present._folder in str(arguments[0]):
            present._left -= 1
            if present._left < 0:
                Interrupt._present = None
                raise KeyboardInterrupt


def test_unexpected_exception_is_a_defect_with_a_trace_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("the cause")

    monkeypatch.setattr(cli, "_run", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["info", "x.bag"]) == 70
    shown = capsys.readouterr().err
    assert shown.startswith("skidloc: a defect of skidloc, please report.")
    (trace,) = tmp_path.iterdir()
    assert str(trace) in shown
    assert "the cause" in trace.read_text()
    assert "skidloc info x.bag" in trace.read_text()
    monkeypatch.setattr("tempfile.tempdir", "/proc/none")
    assert main(["info", "x.bag"]) == 70
    assert "the cause" in capsys.readouterr().err


def test_output_on_a_full_device_is_bad_input() -> None:
    command = [sys.executable, "-m", "localization.cli", "--help"]
    with open("/dev/full", "w") as full:
        found = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr == "skidloc: No space left on device.\n"


@pytest.mark.parametrize("kind", ["file", "fifo"])
def test_compilation_does_not_wait_for_a_lock_held_for_ever(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stopped process has the lock: this one compiles for itself, and stores nothing."""
    lock = tmp_path / ".skidloc.lock"
    os.mkfifo(lock) if kind == "fifo" else lock.touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(jit_gufunc, "_MAX_LOCK_WAIT_S", 0.05)
    descriptor = os.open(lock, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        double = jit_gufunc.compile_gufunc(_double, "(n)->(n)")
    finally:
        os.close(descriptor)
    assert double([3.0]).tolist() == [6.0]
    assert list((Path(__file__).parent / "__pycache__").glob("guf-test_border*")) == []


def _double(a: np.ndarray, b: np.ndarray) -> None:
    b[0] = 2.0 * a[0]
