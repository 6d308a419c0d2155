"""Each file that a command reads, replaced by what is no such file: it ends with code 2 and a reason, soon, and takes no memory."""

from __future__ import annotations

import ast
import functools
import io
import os
import resource
import signal
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from localization.cli import main
from localization.logs.chunks import zstd
from motion_models.input_files import read_table, read_text
from tests.helpers import bags
from tests.helpers.extended import cases
from tests.helpers.rooms import drive

ROOT = Path(__file__).parents[2]
MOST_S, MOST_BYTES = 30, 1 << 30
"""Longest a command may take [s of the clock, on a busy machine], and how much more memory than before [B]."""
LOG = ("--robot", "vaultbot")
INPUTS: dict[str, tuple[str, ...]] = {
    "info LOG": ("info", "{bad}.mcap", *LOG),
    "info --robot": ("info", "{log}", "--robot", "{bad}.toml"),
    "replay LOG": ("replay", "{bad}.bag", *LOG, "--out", "{out}"),
    "replay --reference": ("replay", "{log}", *LOG, "--out", "{out}", "--reference", "{bad}.csv"),
    "replay --map": ("replay", "{log}", *LOG, "--out", "{out}", "--estimator", "graph", "--map", "{bad}.map"),
    "check --urdf": ("check", "{log}", "--urdf", "{bad}.urdf"),
    "check --controller": ("check", "{log}", "--controller", "{bad}.yaml"),
    "init LOG": ("init", "{bad}.mcap.zstd", "--out", "{out}.toml"),
    "init --urdf": ("init", "{log}", "--urdf", "{bad}.xacro", "--out", "{out}.toml"),
    "compare --manifest": ("compare", "--manifest", "{bad}.csv", "--out", "{out}.csv", "--processes", "1"),
    "compare --out": ("compare", "{log}", *LOG, "--out", "{bad}.csv", "--processes", "1"),
    "table": ("table", "{bad}.csv"),
    "calibrate LOG": ("calibrate", "{bad}.csv", "--out", "{out}.toml"),
    "calibrate --reference": ("calibrate", "{log}", *LOG, "--reference", "{bad}.txt", "--out", "{out}.toml"),
    "diagnose --healthy": ("diagnose", "{log}", *LOG, "--healthy", "{bad}.db3", "--model", "skid_steer", "--out", "{out}"),
    "weigh LOG": ("weigh", "{bad}.csv", *LOG),
    "cg --urdf": ("cg", "--urdf", "{bad}.urdf"),
    "cg --srdf": ("cg", "--srdf", "{bad}.srdf", "--posture", "ready"),
    "map info": ("map", "info", "{bad}.map"),
    "map export": ("map", "export", "{bad}.map", "--out", "{out}.pgm"),
    "online LOG": ("online", "{bad}.mcap", *LOG, "--rate", "max"),
    "online --state": ("online", "{log}", *LOG, "--rate", "max", "--out", "{out}.tum", "--state", "{bad}.state"),
    "simulate --robot": ("simulate", "short", "--robot", "{bad}.toml", "--out", "{out}.bag"),
    "twin --simulator": ("twin", "{log}", *LOG, "--simulator", "{bad}.xml", "--out", "{out}"),
}


@functools.cache
def _bomb(is_zstd: bool) -> bytes:
    """Less than 1 MB that unpacks to half a GB, as a map or a compressed log."""
    packed, piece = io.BytesIO(), bytes(1 << 20)
    if is_zstd:
        compressor = zstd.ZstdCompressor()
        for _ in range(512):
            packed.write(compressor.compress(piece))
        packed.write(compressor.flush())
        return packed.getvalue()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("skidmap.json", "w", force_zip64=True) as member:
        for _ in range(512):
            member.write(piece)
    return packed.getvalue()


def _make_sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 3 << 30)


KINDS: dict[str, Callable[[Path], object]] = {
    "FIFO": os.mkfifo,
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "3 GB sparse": _make_sparse,
    "bomb": lambda path: path.write_bytes(_bomb(path.suffix == ".zstd")),
    "truncated": lambda path: path.write_bytes(b"PK\x03\x04\x14\x00\x89MCAP0\r\n#ROSBAG V2"),
    "foreign": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 20),
    "not UTF-8": lambda path: path.write_bytes(b"log,robot\n\xff\xfe\xe9,\x80\n"),
    "1e300": lambda path: path.write_text("1e300 1e300 1e300 1e300 1e300 1e300 1e300 1e300\n" * 3),
    "empty": Path.touch,
}


@contextmanager
def soon(seconds: int) -> Iterator[None]:
    """Raises `TimeoutError` in what takes longer."""

    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_mcap(tmp_path_factory.mktemp("bad_files") / "run.mcap", drive(4.0))


@pytest.mark.parametrize("name", cases(INPUTS, usual=["map info", "table"]))
def test_what_is_no_such_file_ends_with_a_reason(name: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before_bytes = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for kind, make in KINDS.items():
        if (name, kind) == ("compare --out", "folder"):
            continue  # the table is written in it
        folder = tmp_path / kind.replace("/", "")
        folder.mkdir()
        arguments = [part.format(log=log, bad=folder / "bad", out=folder / "out") for part in INPUTS[name]]
        (bad,) = [part for part in arguments if part.startswith(str(folder / "bad"))]
        make(Path(bad))
        with soon(MOST_S):
            code = main(arguments)
        said = capsys.readouterr().err
        assert code == 2, (kind, code, said)
        assert said.startswith("skidloc: "), (kind, said)
        assert "Traceback" not in said, (kind, said)
    assert 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before_bytes + MOST_BYTES


def test_tables_have_a_limit_of_lines(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_bytes(b"1\n" * 2_000_001)
    with pytest.raises(OSError, match="more than 2000000"):
        read_table(path)
    path.write_bytes(b"\xef\xbb\xbf" + b"1\n" * 2_000_000)
    assert len(read_table(path)) == 4_000_000
    path.write_bytes(b"1" * ((1 << 20) + 1))
    with pytest.raises(OSError, match="a line of more than 1 MB"):
        read_table(path)
    with pytest.raises(OSError, match="larger than 1 MB"):
        read_text(path, 1 << 20)


_OWN = ("motion_models/input_files.py", "motion_models/jit.py")
"""The door, and a module of the package that reads itself."""


def test_files_are_read_through_one_door() -> None:
    """No other module opens a file to read it: a mode that writes, or a resource of the package, is no input."""
    found = []
    for path in sorted(file for name in ("localization", "motion_models", "skidloc") for file in (ROOT / name).rglob("*.py")):
        if str(path.relative_to(ROOT)) in _OWN:
            continue
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and _reads_a_file(call):
                found.append(f"{path.relative_to(ROOT)}:{call.lineno}: {ast.unparse(call)[:80]}")
    assert found == []


def _reads_a_file(call: ast.Call) -> bool:
    """Whether ``call`` opens or reads a file by its path."""
    text = ast.unparse(call.func)
    if "files(" in text or (isinstance(call.func, ast.Attribute) and "folder / name" in text):  # resources of the package
        return False
    if text.endswith((".read_text", ".read_bytes")) or text in ("ET.parse", "np.load", "np.loadtxt", "np.genfromtxt"):
        return True
    if text not in ("open", "path.open", "file.open") and not text.endswith("_path.open"):
        return False
    at = 1 if text == "open" else 0
    mode = call.args[at] if len(call.args) > at else next((k.value for k in call.keywords if k.arg == "mode"), None)
    return not (isinstance(mode, ast.Constant) and set(mode.value) & set("wxa+"))
