"""A folder with the data of this repository whose long logs are short, for commands and code of documents."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HUSKY, ACES = Path("tests/data/husky-outdoor-gps/test1.bag"), Path("tests/data/aces/aces.mcap")


def beginning_of(log: Path, part: int, path: Path) -> Path:
    """Write the first ``part``-th of the bytes of a log."""
    path.write_bytes(log.read_bytes()[: log.stat().st_size // part])
    return path


def enter_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int = 10) -> None:
    """Go to a folder with the data of this repository, of the Husky's and of ACES's log the first ``part``-th."""
    data = Path("tests/data")
    (tmp_path / data).mkdir(parents=True)
    for folder in (ROOT / data).iterdir():
        (tmp_path / data / folder.name).symlink_to(folder)
    for log in (HUSKY, ACES):
        (tmp_path / log.parent).unlink()
        (tmp_path / log.parent).mkdir()
        for file in (ROOT / log.parent).iterdir():
            (tmp_path / log.parent / file.name).symlink_to(file)
        (tmp_path / log).unlink()
        beginning_of(ROOT / log, part, tmp_path / log)
    monkeypatch.chdir(tmp_path)
