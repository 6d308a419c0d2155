"""The first start: another package of the same name is detected before it is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from skidloc.start import clash


@pytest.mark.parametrize("start", ["main", "node"])
def test_start_beside_a_foreign_localization_names_it(start: str, tmp_path: Path) -> None:
    info = tmp_path / "localization-0.1.7.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: localization\nVersion: 0.1.7\n")
    (info / "RECORD").write_text("localization/__init__.py,,\n")
    code = f"import sys; sys.path.append({str(tmp_path)!r}); from skidloc import start; sys.exit(start.{start}())"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "pip uninstall localization" in ended.stderr


def test_start_alone_finds_no_clash() -> None:
    assert clash() is None


def test_command_has_one_thread_of_linear_algebra_unless_the_environment_asks_for_more() -> None:
    code = "import os; from skidloc.start import main; main(); print(len(os.listdir('/proc/self/task')))"
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    counts = []
    for more in ({}, {"OPENBLAS_NUM_THREADS": "2"}):
        run = subprocess.run(
            [sys.executable, "-c", code, "robots"], capture_output=True, text=True, check=True, env={**environment, **more}
        )
        counts.append(int(run.stdout.splitlines()[-1]))
    assert counts[0] == 1
    assert counts[1] > 1 or len(os.sched_getaffinity(0)) == 1
