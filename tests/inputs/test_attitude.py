"""The vertical in body axes by gyro, accelerometer and wheels: on slopes, with any mount, from rest and on the way, and with bad IMUs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localization.events import ImuSample
from localization.inputs.attitude import AttitudeFilter
from motion_models.robot import GyroNoise, Mount
from motion_models.slope import GRAVITY

RADIUS, TRACK, HZ, STEP_S = 0.165, 0.57, 100.0, 0.05
BIAS = np.array([0.003, -0.004, 0.002])
MOUNTS = {
    "upright": Mount(0.1, -0.2, 0.3),
    "on its side": Mount(0.0, -0.3, 0.5, math.pi / 2, 0.0, -math.pi / 2),
    "upside down": Mount(0.2, 0.0, 0.1, math.pi, 0.0, 0.4),
}


def speed(t):
    """Stands for a second, then drives, to and fro [m/s]."""
    return 0.5 * math.sin(0.7 * (t - 1.0)) if t > 1.0 else 0.0


def turn_rate(t):
    """Turns from the second second on [rad/s]."""
    return 0.6 if t > 2.0 else 0.0


def heading(t):
    return 0.3 + 0.6 * max(t - 2.0, 0.0)


def downhill(t, degrees):
    """(2,) in the body, on a plane that rises towards the world's +x."""
    steep = math.tan(math.radians(degrees))
    return steep * np.array([-math.cos(heading(t)), math.sin(heading(t))])


def drive(made, mount, degrees, seconds=20.0, start_s=0.0, frame="imu", unit=1.0, gravity=GRAVITY, off=None, shake=0.0):
    """Feed ``made`` with an IMU at ``mount`` that truly stands turned by the rotation ``off`` more; the tilt of each step, by time."""
    rng = np.random.default_rng(5)
    R = mount.rotation if off is None else off @ mount.rotation
    place, found, steps = np.array([mount.x, mount.y, mount.z]), {}, round(STEP_S * HZ)
    for i in range(round(start_s * HZ), round(seconds * HZ) + 1):
        t, h = i / HZ, 1e-4
        down = downhill(t, degrees)
        up = np.array([*-down, 1.0]) / math.hypot(*down, 1.0)
        w = np.array([0.0, 0.0, turn_rate(t)])
        own = np.array([(speed(t + h) - speed(t - h)) / (2 * h), speed(t) * w[2], 0.0]) + np.cross(w, np.cross(w, place))
        force = unit * (R.T @ (gravity * up + own) + shake * rng.normal(size=3))
        rates = R.T @ w + BIAS + 0.002 * rng.normal(size=3)
        made.insert(ImuSample(round(t * 1e9) + 1, rates, force, frame))
        if i % steps == 0:
            half = 0.5 * TRACK * turn_rate(t) / 0.55
            wheels = np.array([[speed(t) - half, speed(t) + half]]) / RADIUS
            found[t] = made.advance(round(t * 1e9) + 1, np.array([STEP_S]), wheels)
    return found


def filter_at(mount, frame="imu"):
    return AttitudeFilter(GyroNoise(), {frame: mount}, RADIUS)


@pytest.mark.parametrize(("name", "start_s", "degrees"), [("upright", 0.0, 10.0), ("on its side", 5.0, 10.0), ("upside down", 5.0, 5.0)])
def test_attitude_on_a_slope_is_its_downhill(name, start_s, degrees):
    """From the start on and on the way."""
    made, mount = filter_at(MOUNTS[name]), MOUNTS[name]
    found = drive(made, mount, degrees, 30.0, start_s, shake=0.3)
    late = [(t, tilt) for t, tilt in found.items() if t > start_s + 15.0]
    assert made.is_tilting
    errors = np.array([tilt.after - downhill(t, degrees) for t, tilt in late])
    assert np.degrees(np.abs(errors).max()) < 0.9
    sigmas = np.sqrt([np.diagonal(tilt.cov) for _, tilt in late])
    assert (np.abs(errors) < 3.0 * sigmas).all()


def test_attitude_finds_the_gyro_biases_across_the_vertical():
    made = filter_at(MOUNTS["upright"])
    drive(made, MOUNTS["upright"], 5.0, 60.0)
    np.testing.assert_allclose(made.gyro_bias[:2], BIAS[:2], atol=1e-3)


def test_attitude_on_level_ground_never_tilts():
    for mount in MOUNTS.values():
        made = filter_at(mount)
        assert not any(drive(made, mount, 0.0, shake=1.0).values())
        assert made.has_attitude
        assert made.warnings() == []


@pytest.mark.parametrize("degrees", [2.0, 3.0])
def test_attitude_of_a_mount_that_is_off_is_no_slope(degrees):
    """It stays with the body while the robot turns; a slope does not."""
    off = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 0.0, off=off).values())
    assert np.degrees(np.hypot(*made.mount_error)) == pytest.approx(degrees, abs=1.2)


def test_attitude_of_slope_and_mount_that_is_off_separates_both():
    off = Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    made = filter_at(MOUNTS["upright"])
    found = drive(made, MOUNTS["upright"], 8.0, 40.0, off=off)
    errors = [np.degrees(np.hypot(*(tilt.after - downhill(t, 8.0)))) for t, tilt in found.items() if t > 20.0]
    assert max(errors) < 0.8


def test_attitude_in_g_is_scaled_and_named():
    made = filter_at(MOUNTS["upright"])
    drive(made, MOUNTS["upright"], 10.0, unit=1.0 / GRAVITY)
    assert made.is_tilting
    assert "is in g, not m/s^2" in made.warnings()[0]


def test_attitude_without_gravity_is_none_and_named():
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 10.0, gravity=0.0, shake=0.1).values())
    assert not made.has_attitude
    assert "shows no gravity (0.0" in made.warnings()[0]


def test_attitude_without_an_accelerometer_is_none_without_a_warning():
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 10.0, unit=0.0).values())
    assert not made.has_attitude
    assert made.warnings() == []


def test_attitude_in_unknown_units_is_none_and_named():
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 10.0, unit=100.0).values())
    assert "neither gravity in m/s^2 nor in g" in made.warnings()[0]


def test_attitude_of_gravity_instead_of_force_turns_its_sign():
    """The gyro agrees with mount and wheels, so that only the accelerometer's sign can be wrong."""
    made = filter_at(MOUNTS["upright"])
    drive(made, MOUNTS["upright"], 10.0, 40.0, unit=-1.0)
    assert made.is_tilting
    assert "publishes gravity, not specific force" in made.warnings()[0]


def test_attitude_of_an_imu_upside_down_without_its_mount_is_named():
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 10.0, 40.0, off=np.diag([1.0, -1.0, -1.0])).values())
    assert "hangs upside down" in made.warnings()[0]


def test_attitude_of_an_imu_on_its_side_without_its_mount_is_named():
    made = filter_at(MOUNTS["upright"])
    off = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
    assert not any(drive(made, MOUNTS["upright"], 0.0, off=off).values())
    assert "contradicts the mount of IMU 'imu' by 90 deg" in made.warnings()[0]


def test_attitude_without_a_mount_is_none_and_named():
    made = filter_at(MOUNTS["upright"])
    assert not any(drive(made, MOUNTS["upright"], 10.0, frame="other").values())
    assert not made.has_attitude
    assert made.warnings() == [
        "the mount of IMU 'other' is unknown: slopes are not modelled. Give it in /tf_static or in the robot file's [mounts]."
    ]
    np.testing.assert_array_equal(made.up, [0.0, 0.0, 1.0])
