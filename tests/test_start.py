"""The first start: another package of the same name is detected before it is imported."""

from __future__ import annotations

from pathlib import Path

import pytest

from skidloc.start import clash, main


def test_start_beside_a_foreign_localization_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "localization-0.1.7.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: localization\nVersion: 0.1.7\n")
    (info / "RECORD").write_text("localization/__init__.py,,\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main() == 2
    assert "pip uninstall localization" in capsys.readouterr().err


def test_start_alone_finds_no_clash() -> None:
    assert clash() is None
