"""Poses in space: planar motions lifted by the attitude, and the drives of MuJoCo over a slope."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from localization.events import ImuSample
from localization.lifting import AttitudeTable, Lifting, write_tum3
from localization.logs.fused_messages import FusedEstimate, odometry_message, transform_message
from localization.logs.serialization import FusedWriter
from localization.space_pose import Pose3, quaternion
from localization.trajectory import Trajectory
from motion_models import se2


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


@pytest.mark.extended
@pytest.mark.parametrize(("degrees", "mu"), [(5.0, 0.5), pytest.param(10.0, 0.8, marks=pytest.mark.extended)])
def test_slope_drive_in_mujoco_slides_as_the_odometry_has_it(degrees, mu):
    """Rigid bodies and contacts that share nothing with the friction model: of the slide of two turns in place a quarter is left."""
    pytest.importorskip("mujoco")
    from tests.helpers.mujoco_hills import drive, turn_in_place
    from tests.studies.hills import errors

    made = drive(turn_in_place, 12.0, mu, degrees)
    resting = [e.linear_acceleration for e in made.events if isinstance(e, ImuSample)][:150]
    assert np.linalg.norm(np.mean(resting, axis=0)) == pytest.approx(9.81, abs=0.02)
    flat, tilted = errors(made, "ekf", slopes=False), errors(made, "ekf", slopes=True)
    assert flat[0] > 1.0
    assert tilted[0] < 0.25 * flat[0]
    assert abs(tilted[3]) < 0.05


def test_pose_in_space_moved_in_its_plane_has_the_covariance_of_samples():
    """First order against 40,000 samples of both perturbations."""
    rng, rotation = np.random.default_rng(3), Rotation.from_euler("zyx", [0.7, -0.2, 0.1]).as_matrix()
    root = 0.01 * rng.normal(size=(6, 6))
    pose, delta, cov = Pose3(np.array([1.0, 2.0, 0.5]), rotation, root @ root.T), np.array([0.6, 0.1, 0.3]), np.diag([4e-4, 1e-4, 9e-4])
    made = pose.moved(delta, cov)
    error, slip = rng.normal(size=(40_000, 6)) @ root.T, rng.normal(size=(40_000, 3)) * np.sqrt(np.diagonal(cov))
    before = Rotation.from_rotvec(error[:, 3:]) * Rotation.from_matrix(rotation)
    after = before * Rotation.from_euler("z", delta[2]) * Rotation.from_rotvec(np.column_stack([0 * slip[:, :2], slip[:, 2]]))
    along = np.tile([delta[0], delta[1], 0.0], (40_000, 1))
    middle = (before * Rotation.from_euler("z", delta[2])).apply(np.column_stack([slip[:, :2], 0 * slip[:, 2]]))
    positions = pose.position + error[:, :3] + before.apply(along) + middle
    turns = (after * Rotation.from_matrix(made.rotation).inv()).as_rotvec()
    found = np.cov(np.column_stack([positions - made.position, turns]).T)
    np.testing.assert_allclose(found, made.covariance, atol=0.05 * np.abs(made.covariance).max())


@pytest.mark.extended
def test_pose_in_space_after_a_start_has_the_covariance_of_samples():
    """The frame in which it is given is at an uncertain planar pose."""
    rng, start, cov = np.random.default_rng(2), np.array([3.0, -2.0, 0.8]), np.diag([0.02, 0.01, 0.005]) ** 2
    turned = Rotation.from_euler("zyx", [0.4, -0.2, 0.1]).as_matrix()
    pose = Pose3(np.array([5.0, 1.0, 0.7]), turned, np.diag([0.01, 0.02, 0.01, 0.003, 0.004, 0.002]) ** 2)
    placed, rows = pose.placed(start, cov), []
    for e, s in zip(
        rng.multivariate_normal(np.zeros(6), pose.covariance, 4000), rng.multivariate_normal(np.zeros(3), cov, 4000), strict=True
    ):
        moved = Pose3(pose.position + e[:3], Rotation.from_rotvec(e[3:]).as_matrix() @ turned, pose.covariance)
        drawn = moved.placed(se2.retract(start, s), cov)
        off = Rotation.from_matrix(drawn.rotation @ placed.rotation.T).as_rotvec()
        rows.append(np.r_[drawn.position - placed.position, off])
    np.testing.assert_allclose(np.cov(np.array(rows).T), placed.covariance, atol=0.06 * placed.covariance.max())
    planar, above = placed.from_above()
    np.testing.assert_allclose(planar, se2.compose(start, pose.from_above()[0]), atol=1e-12)
    np.testing.assert_allclose(placed.position[2], 0.7)
    assert above.shape == (3, 3)


def test_fused_message_of_a_pose_in_space_has_height_tilt_and_covariance():
    rotation = Rotation.from_euler("zyx", [0.7, -0.2, 0.1])
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    pose = Pose3(np.array([1.0, 2.0, 0.5]), rotation.as_matrix(), covariance)
    estimate = FusedEstimate(5, np.array([1.0, 2.0, 0.7]), np.zeros(3), np.eye(3), np.eye(3), in_space=pose)
    message = odometry_message(estimate)
    q = message.pose.pose.orientation
    assert message.pose.pose.position.z == 0.5
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], rotation.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), covariance)
    assert transform_message(estimate).transforms[0].transform.translation.z == 0.5
    written = FusedWriter(is_ros1=False)
    store = get_typestore(Stores.ROS2_HUMBLE)
    read = store.deserialize_cdr(written.odometry(estimate), "nav_msgs/msg/Odometry")
    assert read.pose.pose == message.pose.pose
    np.testing.assert_array_equal(read.pose.covariance, message.pose.covariance)
