"""`skidloc warm-up`: where compiled code goes, and what is reported where it can go nowhere."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from localization.cli import main
from localization.commands import warm_up
from localization.ros import predictor
from motion_models import compiled, jit


def test_warm_up_runs_each_part_and_names_the_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    done: list[str] = []
    monkeypatch.setattr(warm_up, "PARTS", {name: lambda name=name: done.append(name) for name in ("first", "second")})
    monkeypatch.setattr(warm_up, "ProcessPoolExecutor", lambda workers, context: ThreadPoolExecutor(1))
    assert main(["warm-up"]) == 0
    assert done == ["first", "second"]
    assert "stored in" in capsys.readouterr().out
    assert warm_up.stored_in(predictor._predict) is not None


def test_warm_up_without_a_folder_to_write_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(warm_up, "stored_in", lambda kernel: None)
    assert main(["warm-up"]) == 2
    assert "Set NUMBA_CACHE_DIR" in capsys.readouterr().err


def test_kernel_where_nothing_can_be_stored_runs_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As for a user without a home folder, of a package that another user has installed."""
    monkeypatch.setattr(jit.KernelCacheLocator, "from_function", classmethod(lambda cls, function, file: None))
    monkeypatch.setattr(jit.caching.CacheImpl, "_locator_classes", [])
    monkeypatch.setattr(jit, "_not_stored", [])
    double, triple = (compiled.kernel(lambda x, factor=factor: x * factor) for factor in (2.0, 3.0))
    assert (double(2.0), triple(2.0)) == (4.0, 6.0)
    assert capsys.readouterr().err.count("Set NUMBA_CACHE_DIR") == 1
