"""Each cause states how much of its effect a robot file holds, in every model: what is handed over moves as the sentence says."""

from __future__ import annotations

import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.corrected_robot import held_shares
from tests.helpers.extended import cases
from tests.helpers.law_drives import law_predictor

_EVERY = frozenset(("diff_drive", "skid_steer", "icr", "full_linear", "friction"))
_FRICTION, _FULL_LINEAR = frozenset(("friction",)), frozenset(("full_linear",))
_SLIPS = ("lateral_slip_speed", "rotation_slip_speed", "longitudinal_slip_turning", "rotation_slip_rate")
_FLOOR = ("track_width", "friction_anisotropy", "split_friction", "diagonal_load", "tread_asymmetry", "rolling_resistance", "scrub")
HELD: dict[str, frozenset[str]] = {
    **dict.fromkeys(("wheel_radius_scale", "wheel_radius_difference", "rotation_scale", *_SLIPS), _EVERY),
    **dict.fromkeys(("rotation_slip_curvature", "longitudinal_slip_curvature"), _FULL_LINEAR),
    **dict.fromkeys(("payload", "cg_offset_x", "cg_offset_y", *_FLOOR), _FRICTION),
    "lateral_force_law": frozenset(),
}
"""Models that have a place for a cause's effect on the motion; by `python -m tests.studies.handover_shares` others hold less of it."""
LEAST_SHARE = 0.9
_OF_MEASUREMENTS = {
    *("lidar_offset_x", "lidar_offset_y", "lidar_yaw", "wheel_time_offset", "lidar_time_offset", "gyro_time_offset"),
    *("gyro_bias", "gyro_scale", "range_scale", "range_bias"),
}
_OF_ONE_DRIVE = {"slope", "slope (across)", "encoder_dropout", "wheel_radius_drift", "friction_change", "wheel_lag"}
_ON_SLOPES = {"cg_height", "grip"}


def test_every_cause_states_which_models_hold_it() -> None:
    assert HELD.keys() | _OF_MEASUREMENTS | _OF_ONE_DRIVE | _ON_SLOPES == CAUSES.keys()


@pytest.mark.parametrize("robot", ["husky_a200", "vaultbot"], ids=["without arms", "with arms"])
@pytest.mark.parametrize("cause", cases(HELD, usual=["cg_offset_x", "lateral_slip_speed"], others=pytest.mark.slow))
def test_corrected_robot_holds_a_cause_where_a_model_has_its_place(cause: str, robot: str) -> None:
    definition = CAUSES[cause]
    size = definition.typical * (0.5 if definition.one_sided else 1.0)
    shares = held_shares(law_predictor(robot, "friction"), {definition: size})
    assert {name for name in HELD[cause] if shares[name] < LEAST_SHARE} == set()
    assert all(share > -0.05 for share in shares.values())  # no file makes it worse
