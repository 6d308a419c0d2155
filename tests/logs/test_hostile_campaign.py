"""A small, deterministic part of `tests.benchmarks.faults` and of `tests.benchmarks.fuzz`."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from localization.errors import LogError
from localization.logs import inspect_log, open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags, extended, fuzz
from tests.helpers.hostile_logs import (
    BAD,
    FILE_FAULTS,
    SENSOR_FAULTS,
    SOURCES,
    Case,
    cases,
    is_affected,
    run_case,
    write_case,
)

pytestmark = pytest.mark.xdist_group("hostile_campaign")


@pytest.fixture(scope="module")
def truths(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("truths")


DECIDED_IN_LOGS = (
    "second publisher of joint states",
    "LiDAR stamps jump 0.9 s",
    "LiDAR angle_increment 0",
    "transform twice",
    "quaternion of norm 1e-6",
)


@pytest.mark.extended
@pytest.mark.parametrize("fault", extended.cases(DECIDED_IN_LOGS, ("transform twice",)))
def test_sensor_fault_decided_in_logs_is_never_silently_wrong(tmp_path: Path, truths: Path, fault: str) -> None:
    source = SOURCES[0]
    case = Case(0, source.name, "mcap", fault, "")
    log = write_case(case, tmp_path, seed=0)
    outcome = run_case(case, log, truths, tmp_path / "out")
    assert outcome.kind not in BAD, outcome
    assert outcome.message != ""


@pytest.mark.parametrize("form", extended.cases(bags.FORMATS, ("ros1", "mcap")))
@pytest.mark.parametrize("fault", FILE_FAULTS)
def test_damaged_file_of_any_format_is_read_or_refused(tmp_path: Path, form: str, fault: str) -> None:
    for number in range(2):
        (tmp_path / str(number)).mkdir()
        path = write_case(Case(number, "husky", form, "none", fault), tmp_path / str(number), seed=1)
        try:
            log = open_log(path, load_robot("husky_a200"))
            stamps = [event.stamp_ns for event in log.events()]
            inspect_log(log)
        except LogError:
            continue
        assert stamps == sorted(stamps)


@pytest.mark.extended
def test_hostile_cases_of_one_seed_repeat_and_contain_all_faults() -> None:
    chosen = cases(300, 0)
    assert chosen == cases(300, 0) != cases(300, 1)
    assert {case.sensor_fault for case in chosen} == set(SENSOR_FAULTS)
    assert {case.file_fault for case in chosen} == {"", *FILE_FAULTS}
    assert {case.form for case in chosen} == set(bags.FORMATS)
    assert {case.source for case in chosen} == {source.name for source in SOURCES}
    assert all(case.file_fault or case.sensor_fault == "none" or is_affected(case.source, case.sensor_fault) for case in chosen)


@pytest.mark.extended
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(form=st.sampled_from(sorted(bags.FORMATS)), changes=fuzz.CHANGES, of_metadata=st.booleans())
def test_changed_bytes_of_any_log_are_read_or_refused(form: str, changes: list, of_metadata: bool) -> None:
    fuzz.check(form, changes, of_metadata)
