"""Effects that no cause describes are unexplained, and never a confident wrong name."""

from __future__ import annotations

import numpy as np
import pytest

from localization.diagnosis.diagnose import diagnose, examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.extension import extend
from localization.diagnosis.findings import Diagnosis, confirmed_findings
from localization.logs import open_log
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.diagnosis_unknown import UNKNOWN

pytestmark = pytest.mark.xdist_group("unknown")


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    path = tmp_path_factory.mktemp("unknown") / "drive.mcap"
    return drive_of_log(open_log(bag(path, {}, 508, "husky_a200", drive("tour")), load_robot("husky_a200")))


@pytest.mark.extended
def test_diagnose_nominal_drive_is_consistent(nominal: Drive) -> None:
    assert diagnose(nominal, make_model("friction", nominal.robot)).verdict == "consistent"


@pytest.mark.extended
def test_diagnose_reference_that_scatters_is_named_in_a_note(nominal: Drive) -> None:
    """Nothing follows a cause or a trend: no cause is named, and the noise is the reference's."""
    found = diagnose(UNKNOWN["reference is longer in one quarter"](nominal), make_model("friction", nominal.robot))
    assert not found.findings
    assert found.verdict == "unexplained" or any("motion reference states" in note for note in found.warnings)


PUNCTURE = "puncture of the left tyres"
_PUNCTURE_SHARE = -0.05 / 1.05
"""Of the left radii: the left wheels turn 5 % faster for the same way."""


@pytest.mark.slow
def test_diagnose_puncture_is_two_causes_from_one_moment(nominal: Drive) -> None:
    """Tyres of one side that shrink on the way are a difference of both sides and half as much of the mean, from then on."""
    found = diagnose(UNKNOWN[PUNCTURE](nominal), make_model("friction", nominal.robot))
    by = {f.cause: f for f in found.findings}
    assert found.verdict == "explained"
    assert set(by) == {"wheel_radius_difference", "wheel_radius_scale"}
    assert len({f.definition.spell for f in found.findings}) == 1
    for cause, size in (("wheel_radius_difference", _PUNCTURE_SHARE), ("wheel_radius_scale", 0.5 * _PUNCTURE_SHARE)):
        assert by[cause].size == pytest.approx(size, abs=2.5 * by[cause].sigma)
        spell_95 = by[cause].definition.spell_95
        assert spell_95 is not None
        low, high = spell_95[0]
        assert low <= float(nominal.starts_s[np.searchsorted(nominal.starts_s, 0.5 * nominal.starts_s[-1], side="right")]) <= high
    assert found.sentence.startswith("Correct wheel_radius_difference from t = 30 s")


@pytest.mark.slow
def test_diagnose_rates_that_saturate_are_unexplained(nominal: Drive) -> None:
    """Further effects outside of the catalogue are in `tests.studies.unknown_effects`."""
    assert_unexplained(diagnose(UNKNOWN["rates saturate"](nominal), make_model("friction", nominal.robot)))


@pytest.mark.slow
def test_extend_slip_in_left_turns_is_written(nominal: Drive) -> None:
    """-0.15 max(wz, 0) is -0.075 wz, which tolerated friction takes, and -0.075 |wz|; a file with the latter alone would leave half of the
    error in left turns, and make as much in right ones, which had none."""
    drive, model = UNKNOWN["slip in left turns only"](nominal), make_model("friction", nominal.robot)
    found = examine(drive, model)
    assert_unexplained(found.diagnosis)
    extended = extend(found, drive, model)
    assert extended.extension is not None
    (term,) = extended.extension.terms
    assert term.term.name == "wz[max(wz,0)]"
    assert term.term.value == pytest.approx(-0.15, abs=3.0 * term.term.sigma)
    assert extended.robot is not None
    assert extended.found.diagnosis.verdict == "extended"


def assert_unexplained(found: Diagnosis) -> None:
    """It is said that something has no name, and no change on the way is ordered in its place."""
    assert found.verdict == "unexplained"
    assert all(f in confirmed_findings(found) or not f.is_plausible for f in found.findings)  # no other name
    is_implausible = any(not f.is_plausible for f in found.findings)
    assert is_implausible or any(row.status == "unexplained" for row in found.discrepancy.values())
    assert "without a name" in found.sentence or "not in a way that has a name" in found.sentence
    assert not [f for f in confirmed_findings(found) if f.definition.changes_on_the_way]
