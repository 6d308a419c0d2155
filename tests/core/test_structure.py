"""What an estimate passes: functions, calls and lines of files in a step of the EKF, by a trace over MIT-CSAIL; who writes covariances."""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path

from localization.pipeline import Pipeline, Trial
from motion_models.registry import make_model
from tests.studies.buildings import BUILDINGS

ROOT = Path(__file__).parents[2]
PACKAGES = tuple(str(ROOT / name) for name in ("localization", "motion_models"))
STEPS, WARM_UP_STEPS = 60, 30
LIMITS = {"functions": 108, "calls a step": 243, "lines of their files": 4_460}


def trace():
    """Number of steps in which each code object is called, number of all calls, and number of steps, on a drive with scans and wheels."""
    drive = BUILDINGS["csail"].open().until(30.0)
    pipeline = Pipeline(Trial(make_model("diff_drive", drive.robot), "ekf"), drive.robot, drive.mounts, True)
    steps_with, in_step, n_calls, n_steps = Counter(), set(), 0, -WARM_UP_STEPS

    def profile(frame, event, argument):
        nonlocal n_calls
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGES):
            in_step.add(frame.f_code)
            n_calls += n_steps >= 0

    for event in drive.events:
        sys.setprofile(profile)
        try:
            estimates = pipeline.process(event)
        finally:
            sys.setprofile(None)
        if estimates:
            steps_with.update(in_step if n_steps >= 0 else ())
            in_step.clear()
            n_steps += len(estimates)
        if n_steps >= STEPS:
            break
    return steps_with, n_calls, n_steps


def usual_functions(steps_with, n_steps):
    """Code of the functions that are called in at least every second step."""
    return [code for code, count in steps_with.items() if count >= n_steps / 2 and not code.co_name.startswith("<")]


def usual_files():
    """Files of these functions."""
    steps_with, _, n_steps = trace()
    return {Path(code.co_filename) for code in usual_functions(steps_with, n_steps)}


def test_step_of_ekf_passes_few_functions_calls_and_lines(capsys):
    """Functions are those called in at least every second step; comprehensions count as calls. Readers and decoding are left out. The
    sensor checks, which examine some steps together after these are published, count as calls."""
    steps_with, n_calls, n_steps = trace()
    usual = usual_functions(steps_with, n_steps)
    files = {code.co_filename for code in usual}
    found = {
        "functions": len(usual),
        "calls a step": n_calls / n_steps,
        "lines of their files": sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files),
    }
    with capsys.disabled():
        print("\n" + "\n".join(f"{name}: {value:.0f} in {len(files)} files, at most {LIMITS[name]}" for name, value in found.items()))
    assert {name: value for name, value in found.items() if value > LIMITS[name]} == {}


def test_filter_alone_writes_covariances():
    """Other modules read P, and make states by the functions of `localization.core.filter` or with other means alone."""
    written = re.compile(r"\.P\b(?:\[[^=\n]*\])? [-+*/@]?= |\bState\((?!state\.layout, \{\*\*state\.means, [^}]*\}, state\.P\))")
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in sorted((ROOT / "localization").rglob("*.py"))
        if path.name != "filter.py"
        for line in path.read_text(encoding="utf-8").splitlines()
        if written.search(line) and not line.startswith("class ")
    ]
    assert found == []
