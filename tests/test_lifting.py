"""Poses in space: planar motions lifted by the attitude, and the drives of MuJoCo over a slope."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localization.lifting import AttitudeTable, Lifting, quaternion, write_tum3
from localization.trajectory import Trajectory


class Vertical:
    """An attitude that is set."""

    ground_up, tilt_variances = np.array([0.0, 0.0, 1.0]), (1e-4, 1e-4)

    def set_rotation(self, rotation):
        self.ground_up = rotation[2]


def test_lifting_up_a_ramp_gains_its_height():
    lifting, attitude = Lifting(), Vertical()
    nose_up = Rotation.from_euler("y", -10.0, degrees=True).as_matrix()
    attitude.set_rotation(nose_up)
    for x in np.linspace(0.0, 5.0, 51):
        pose = lifting.add(np.array([x, 0.0, 0.0]), np.zeros((3, 3)), attitude.ground_up, attitude.tilt_variances)
    c, s = math.cos(math.radians(10.0)), math.sin(math.radians(10.0))
    np.testing.assert_allclose(pose.position, [5.0 * c, 0.0, 5.0 * s], atol=1e-9)
    np.testing.assert_allclose(pose.rotation, nose_up, atol=1e-9)


def test_lifting_a_circle_on_a_plane_returns_to_its_start():
    """On a plane the planar motion is exact: position and rotation come back, and the path stays in the plane."""
    lifting, attitude = Lifting(), Vertical()
    plane = Rotation.from_euler("xy", [4.0, -8.0], degrees=True).as_matrix()  # world_R_plane
    first = None
    for angle in np.linspace(0.0, 2.0 * math.pi, 201):
        attitude.set_rotation(plane @ Rotation.from_euler("z", angle).as_matrix())
        planar = np.array([2.0 * math.sin(angle), 2.0 - 2.0 * math.cos(angle), angle])
        pose = lifting.add(planar, np.diag([0.01, 0.02, 0.001]), attitude.ground_up, attitude.tilt_variances)
        first = first or pose
        assert abs((first.rotation[:, 2]) @ pose.position) < 5e-3
    np.testing.assert_allclose(pose.position, 0.0, atol=5e-3)
    np.testing.assert_allclose(pose.rotation, first.rotation, atol=2e-3)
    values = np.linalg.eigvalsh(pose.covariance)
    assert values.min() > -1e-12
    np.testing.assert_allclose(pose.covariance, pose.covariance.T)


def test_quaternion_is_that_of_scipy():
    for rotation in Rotation.random(50, random_state=1):
        expected = rotation.as_quat(canonical=True)
        np.testing.assert_allclose(quaternion(rotation.as_matrix()), expected, atol=1e-9)


def test_tum_file_of_poses_in_space_has_eight_columns(tmp_path):
    table, stamps = AttitudeTable(), np.array([1_500_000_000, 1_500_000_001, 1_500_000_002])
    for stamp in stamps[1:]:
        table.add(int(stamp), Vertical())
    planar = Trajectory(stamps, np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]))
    write_tum3(tmp_path / "a.tum", table.lift(planar))
    lines = (tmp_path / "a.tum").read_text().splitlines()
    assert lines[1].split()[0] == "1.500000001"
    np.testing.assert_allclose([float(v) for v in lines[1].split()[1:]], [0.1, 0, 0, 0, 0, 0, 1], atol=1e-12)
    write_tum3(tmp_path / "none.tum", None)
    assert not (tmp_path / "none.tum").exists()


@pytest.mark.parametrize(("degrees", "mu"), [(5.0, 0.5), (10.0, 0.8)])
def test_slope_drive_in_mujoco_slides_as_the_odometry_has_it(degrees, mu):
    """Rigid bodies and contacts that share nothing with the friction model: of the slide of two turns in place a quarter is left."""
    pytest.importorskip("mujoco")
    from tests.helpers.mujoco_hills import drive, turn_in_place
    from tests.studies.hills import errors

    made = drive(turn_in_place, 12.0, mu, degrees)
    flat, tilted = errors(made, "ekf", slopes=False), errors(made, "ekf", slopes=True)
    assert flat[0] > 1.0
    assert tilted[0] < 0.25 * flat[0]
    assert abs(tilted[3]) < 0.05
