"""Payloads that are set while the robot drives."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import CgSample
from localization.logs.decode import ArmReading
from localization.ros.payloads import Load, Payloads
from motion_models.center_of_gravity.files import arms_model, arms_postures
from motion_models.center_of_gravity.parts import Payload
from motion_models.errors import CgError, RobotError
from motion_models.robot import Mount
from motion_models.robot_file import load_robot

VAULTBOT = load_robot("vaultbot")
POSTURES = arms_postures(VAULTBOT.arms)


def reading(posture):
    positions = POSTURES[posture]
    return ArmReading(0, tuple(positions), np.array(list(positions.values())))


def loaded_arms(posture):
    """Payloads of a robot with arms that stands in ``posture``, and its centre of gravity without loads."""
    model = arms_model(VAULTBOT.arms)
    payloads = Payloads(VAULTBOT, model, {"laser": Mount(x=0.3)})
    payloads.insert_joints(reading(posture))
    alone = CgSample(5, model.cg(model.chain.posture(POSTURES[posture])))
    assert payloads.apply(alone) is alone
    return payloads, alone


@pytest.mark.parametrize("frame", ["left_gripper", "right_gripper", "dual_arm_bulkhead"])
def test_payload_at_a_link_gives_the_cg_of_a_urdf_with_that_mass(frame):
    """In two postures, the second by joint states alone."""
    first, second = sorted(POSTURES)[:2]
    payloads, _ = loaded_arms(first)
    payloads.set(frame, Load(3.0, (0.0, 0.0, 0.1)))
    for posture in (first, second):
        payloads.insert_joints(reading(posture))
        model = arms_model(VAULTBOT.arms, payload=Payload(frame, 3.0, (0.0, 0.0, 0.1)))
        expected = model.cg(model.chain.posture(POSTURES[posture]))
        without = arms_model(VAULTBOT.arms)
        sample = payloads.apply(CgSample(7, without.cg(without.chain.posture(POSTURES[posture]))))
        assert sample.stamp_ns == 7
        np.testing.assert_allclose(sample.position, expected, atol=1e-9)
        assert (np.linalg.eigvalsh(sample.covariance) > 0.0).all()


def test_payloads_of_two_frames_add_and_are_removed_one_by_one():
    payloads, alone = loaded_arms(sorted(POSTURES)[0])
    payloads.set("laser", Load(4.0, (0.0, 0.1, 0.0)))
    payloads.set("base_link", Load(2.0, (-0.1, 0.0, 0.0)))
    mass = arms_model(VAULTBOT.arms).mass
    expected = (mass * alone.position + 4.0 * np.array([0.3, 0.1]) + 2.0 * np.array([-0.1, 0.0])) / (mass + 6.0)
    np.testing.assert_allclose(payloads.sample(9).position, expected, atol=1e-12)
    assert payloads.summary == "4 kg at 'laser', 2 kg at 'base_link'"
    payloads.set("laser", Load(0.0, (0.0, 0.0, 0.0)))
    payloads.set("base_link", Load(0.0, (0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(payloads.sample(9).position, alone.position)


@pytest.mark.parametrize(
    ("frame", "load", "kind", "error"),
    [
        ("left_griper", Load(3.0, (0.0, 0.0, 0.0)), RobotError, "no link 'left_griper'"),
        ("base_link", Load(-3.0, (0.0, 0.0, 0.0)), CgError, "mass 0 or more"),
        ("base_link", Load(np.nan, (0.0, 0.0, 0.0)), CgError, "must be finite"),
        ("base_link", Load(3.0, (0.0, np.inf, 0.0)), CgError, "must be finite"),
        ("base_link", Load(500.0, (5.0, 0.0, 0.0)), CgError, "would tip over"),
    ],
)
def test_payload_that_cannot_be_is_refused_and_changes_nothing(frame, load, kind, error):
    payloads, _ = loaded_arms(sorted(POSTURES)[0])
    payloads.set("base_link", Load(1.0, (0.0, 0.0, 0.0)))
    before = payloads.sample(3).position
    with pytest.raises(kind, match=error):
        payloads.set(frame, load)
    np.testing.assert_array_equal(payloads.sample(3).position, before)


def test_payload_before_the_joints_positions_is_refused_by_name():
    payloads = Payloads(VAULTBOT, arms_model(VAULTBOT.arms), {})
    with pytest.raises(RobotError, match=r"no joint state has the position of left_shoulder.* yet, which the place of 'left_gripper'"):
        payloads.set("left_gripper", Load(3.0, (0.0, 0.0, 0.0)))
