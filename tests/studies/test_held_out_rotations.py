"""The claim of the project on real data: the CG-aware models predict rotations that they were not fitted to."""

from tests.studies.held_out_rotations import study


def test_cg_aware_models_predict_held_out_rotations_better() -> None:
    base, linear, friction = (study(name) for name in ("diff_drive", "skid_steer", "friction"))
    assert linear.heading_deg.high < base.heading_deg.low
    assert friction.heading_deg.value < 0.6 * linear.heading_deg.value
    assert friction.position_m.high < linear.position_m.low
    assert friction.position_m.high < 0.1 * base.position_m.low
