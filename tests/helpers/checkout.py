"""A folder with the data of this repository whose longest log is short, for commands and code of documents."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HUSKY = Path("tests/data/husky-outdoor-gps/test1.bag")


def beginning_of(log: Path, part: int, path: Path) -> Path:
    """Write the first ``part``-th of the bytes of a log."""
    path.write_bytes(log.read_bytes()[: log.stat().st_size // part])
    return path


def enter_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Go to a folder with the data of this repository, its longest log cut to the first fifth."""
    (tmp_path / HUSKY.parent).mkdir(parents=True)
    beginning_of(ROOT / HUSKY, 5, tmp_path / HUSKY)
    data = Path("tests/data")
    for folder in (ROOT / data).iterdir():
        if folder.name != HUSKY.parent.name:
            (tmp_path / data / folder.name).symlink_to(folder)
    monkeypatch.chdir(tmp_path)
