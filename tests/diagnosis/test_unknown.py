"""Effects that no cause describes are unexplained, and never a confident wrong name."""

from __future__ import annotations

import pytest

from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.drive import Drive, drive_of_log
from localization.logs import open_log
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.diagnosis_unknown import UNKNOWN


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    path = tmp_path_factory.mktemp("unknown") / "drive.mcap"
    return drive_of_log(open_log(bag(path, {}, 508, "husky_a200", drive("tour")), load_robot("husky_a200")))


def test_diagnose_nominal_drive_is_consistent(nominal: Drive) -> None:
    assert diagnose(nominal, make_model("friction", nominal.robot)).verdict == "consistent"


OF_REFERENCE = ("reference is longer in one quarter", "reference turns with its range")


@pytest.mark.parametrize("name", OF_REFERENCE)
def test_diagnose_reference_that_scatters_is_named_in_a_note(nominal: Drive, name: str) -> None:
    """Nothing follows a cause or a trend: no cause is named, and the noise is the reference's."""
    found = diagnose(UNKNOWN[name](nominal), make_model("friction", nominal.robot))
    assert not found.findings
    assert found.verdict == "unexplained" or any("motion reference states" in note for note in found.warnings)


@pytest.mark.extended
@pytest.mark.parametrize("name", sorted(set(UNKNOWN) - set(OF_REFERENCE)))
def test_diagnose_effect_outside_catalogue_is_unexplained(nominal: Drive, name: str) -> None:
    found = diagnose(UNKNOWN[name](nominal), make_model("friction", nominal.robot))
    assert found.verdict == "unexplained"
    is_implausible = any(not f.is_plausible for f in found.findings)
    assert is_implausible or any(row.status == "unexplained" for row in found.discrepancy.values())
    assert "without a name" in found.sentence or "not in a way that has a name" in found.sentence
