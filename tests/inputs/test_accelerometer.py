"""Unit, sign and mount of an accelerometer, by its first samples and by the turns of the wheels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.events import ImuSample
from localization.inputs.accelerometer import Accelerometer, scale_of_force
from motion_models.robot import Mount
from motion_models.slope import GRAVITY

MOUNT = Mount(0.1, -0.2, 0.3, math.pi / 2, 0.0, 0.0)


def feed(force, frame="imu", n=20, mounts=None):
    """An accelerometer after ``n`` samples of ``force`` (3,), and how many of these it accepted."""
    made = Accelerometer({"imu": MOUNT} if mounts is None else mounts)
    accepted = sum(made.accept(ImuSample(k, np.zeros(3), np.array(force), frame)) for k in range(n))
    return made, accepted


@pytest.mark.parametrize(("size", "scale"), [(9.81, 1.0), (8.5, 1.0), (1.0, GRAVITY), (0.0, 0.0), (2.0, 0.0), (981.0, 0.0)])
def test_scale_of_force_is_the_factor_to_m_per_s2(size, scale):
    found, problem = scale_of_force(size, "it")
    assert found == scale
    assert bool(problem) == (scale == 0.0 and size > 0.0)


def test_accelerometer_has_its_unit_and_place_after_twenty_samples():
    made, accepted = feed([0.0, 1.0, 0.0], n=19)
    assert made.imu.scale == 0.0
    assert accepted == 19
    made.accept(ImuSample(19, np.zeros(3), np.array([0.0, 1.0, 0.0]), "imu"))
    assert made.imu.scale == GRAVITY
    np.testing.assert_array_equal(made.imu.place, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(made.imu.rotation @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-12)
    assert "is in g, not m/s^2" in made.warnings()[0]


def test_accelerometer_without_gravity_accepts_no_more_samples():
    made, accepted = feed([0.1, 0.0, 0.0], n=40)
    assert accepted == 19
    assert not made.is_usable
    assert "shows no gravity (0.10 m/s^2 on average)" in made.warnings()[0]


def test_accelerometer_of_zeros_is_none_without_a_warning():
    made, _ = feed([0.0, 0.0, 0.0])
    assert not made.is_usable
    assert made.warnings() == []


def test_accelerometer_takes_the_first_imu_that_has_a_mount():
    made, accepted = feed([0.0, 9.8, 0.0], frame="other")
    assert accepted == 0
    assert "mount of IMU 'other' is unknown" in made.warnings()[0]
    assert made.accept(ImuSample(30, np.zeros(3), np.array([0.0, 9.8, 0.0]), "imu"))
    assert not made.accept(ImuSample(31, np.zeros(3), np.array([0.0, 9.8, 0.0]), "other"))
    assert made.warnings() == []


@pytest.mark.parametrize(
    ("up_z", "turned", "agreement", "is_above", "scale", "warning"),
    [
        (0.95, 0.0, 0.0, True, 1.0, ""),
        (-0.95, 1.0, 1.0, False, 1.0, ""),  # not turned enough to tell
        (-0.95, 4.0, 1.0, False, -1.0, "publishes gravity, not specific force"),
        (-0.95, 4.0, -1.0, False, 1.0, "hangs upside down"),
        (0.0, 0.0, 0.0, False, 1.0, "contradicts the mount of IMU 'imu' by 90 deg"),
    ],
)
def test_vertical_below_the_robot_is_sign_or_mount(up_z, turned, agreement, is_above, scale, warning):
    made, _ = feed([0.0, 9.81, 0.0])
    assert made.is_above(up_z, turned, agreement) is is_above
    assert made.imu.scale == scale
    assert warning in "".join(made.warnings())
    assert bool(made.warnings()) == bool(warning)
