"""The notebooks run, and each .ipynb is its .py, executed."""

from __future__ import annotations

import re
import sys

import nbformat
import pytest

from tests.helpers.notebooks import FOLDER, read, sources

# Replacements that make a notebook shorter: the same cells, less data.
SHORTER = {
    "1": {"LOG_S = 1400.0": "LOG_S = 100.0"},
    "4": {
        '"wheel_radius_difference": 0.02, "cg_offset_x": 0.03, "lidar_time_offset": 0.05, "friction_anisotropy": 0.2': "**HIDDEN",
        "diagnosed({name: size}, seed=1).diagnosis for": "d for",
        "clean = diagnosed({}, seed=2).diagnosis": "clean = d",
    },
    "5": {
        "RUNS, LAPS = 12, 4": "RUNS, LAPS = 2, 1",
        'load_robot("aces"), 120.0': 'load_robot("aces"), 10.0',
        'load_robot("husky_a200"), 300.0': 'load_robot("husky_a200"), 30.0',
    },
    "6": {"DRAWS = 20": "DRAWS = 1"},
    "7": {"LAPS = 6": "LAPS = 3"},
    "9": {"seed=2, arcs=12": "seed=2, arcs=3"},
}
# absolute paths of Linux, macOS and Windows; but not topics
ABSOLUTE_PATH = re.compile(r"(?<![\w.])/(?:home|root|tmp|work|usr|opt|var|mnt|Users)/|[A-Z]:\\\\")


def test_notebooks_are_twelve_and_each_title_is_one_claim():
    assert [source.name.split("_")[0] for source in sources()] == [str(number) for number in range(12)]
    for source in sources():
        text = source.read_text(encoding="utf-8")
        assert len(re.findall(r"^# \*\*Claim: ", text, flags=re.MULTILINE)) == 1
        assert not re.search(r"(from|import) tests\b", text)  # what is installed is enough


SLOW = ("0", "5", "6", "7", "9")
"""Notebooks of 15 s and more."""


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(source, id=source.stem, marks=pytest.mark.slow if source.stem.split("_")[0] in SLOW else pytest.mark.extended)
        for source in sources()
    ],
)
def test_notebook_runs(source, monkeypatch):
    """As a script, in its own folder."""
    monkeypatch.chdir(FOLDER)
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    cells = read(source, SHORTER.get(source.name.split("_")[0])).cells
    code = "\n\n".join(cell.source for cell in cells if cell.cell_type == "code")
    exec(compile(code, str(source), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("source", sources(), ids=lambda source: source.stem)
def test_notebook_stored_output_matches_its_code(source):
    """Where it does not, run `python -m tests.helpers.notebooks NAME`."""
    shown = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    nbformat.validate(shown)
    assert [(c.cell_type, c.source) for c in shown.cells] == [(c.cell_type, c.source) for c in read(source).cells]
    code = [cell for cell in shown.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    for output in outputs:
        assert output.output_type in ("execute_result", "display_data", "stream")
        assert output.get("name") != "stderr"
    assert not ABSOLUTE_PATH.search(source.with_suffix(".ipynb").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["worlds.svg", "cg.png", "corrections.png"])
def test_readme_pictures_are_small(name):
    picture = (FOLDER / "figures" / name).read_bytes()
    assert 10_000 < len(picture) < 150_000
    assert picture.startswith((b"<svg", b"\x89PNG"))


def test_absolute_path_pattern_matches_paths_and_no_topics():
    assert ABSOLUTE_PATH.search("File /home/me/x.py")
    assert ABSOLUTE_PATH.search(r'"C:\\Users"')
    assert not ABSOLUTE_PATH.search("/odom /scan ../tests/data/aces")
