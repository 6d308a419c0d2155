"""Prediction between scans: in order, continuous but for corrections, and without any effect on the estimates."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.core.twist import fuse_turn, mean_twist, twist_at_end
from localization.estimators import Estimate
from localization.events import WheelSample
from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_buffer import WheelBuffer
from localization.logs.reader import open_source
from localization.ros.discovery import TF
from localization.ros.node_config import NodeConfig
from localization.ros.predictor import Predictor, predicted_motion
from localization.ros.publisher import ODOMETRY, POSE, PREDICTED_ODOMETRY
from localization.ros.session import Files
from localization.trajectory import read_tum
from motion_models import se2
from motion_models.preintegration import integrate_twists, noise_vector
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, LogTransport, drive_log, published, run_node, stamp_of, track

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A transport and a node with an output after the drive, by estimator and whether it predicts."""
    folder = tmp_path_factory.mktemp("driven")

    @functools.cache
    def drive(estimator, predict):
        transport, out = LogTransport(drive_log()), folder / f"{estimator}_{predict}.tum"
        node, _ = run_node(transport, estimator, Files(out), NodeConfig(wait_s=0.0, predict=predict))
        node.finish()
        return transport, node, out

    return drive


@pytest.mark.parametrize("estimator", ["ekf", pytest.param("graph", marks=pytest.mark.extended)])
def test_odometry_is_published_at_the_rate_of_the_wheels_in_order(estimator, driven):
    stamps = np.array([stamp_of(m) for m in published(driven(estimator, True)[0], PREDICTED_ODOMETRY)])
    assert (np.diff(stamps) > 0).all()
    stamps = stamps[stamps > stamps[0] + 3 * S]  # what came before the start is estimated, not predicted
    assert np.median(np.diff(stamps)) <= 0.0201 * S  # 50 Hz
    assert np.diff(stamps).max() <= 0.045 * S
    assert len(stamps) > 3 * len(published(driven(estimator, False)[0], ODOMETRY))


@pytest.mark.parametrize("estimator", ["ekf", pytest.param("graph", marks=pytest.mark.extended)])
def test_estimates_are_the_same_to_the_last_bit_with_prediction(estimator, driven):
    with_prediction, without = (track(driven(estimator, predict)[0]) for predict in (True, False))
    assert list(with_prediction) == list(without)
    for stamp in without:
        assert np.array_equal(with_prediction[stamp][0], without[stamp][0])
        assert np.array_equal(with_prediction[stamp][1], without[stamp][1])


def test_output_is_the_same_to_the_last_byte_with_prediction(driven):
    outputs = [driven("ekf", predict)[2] for predict in (True, False)]
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    assert len(read_tum(outputs[0])) > 200


def test_odometry_without_a_lidar_has_true_vy_at_the_wheels_rate():
    """Instead of diff_drive_controller's: joint states alone, each answered by a twist with covariance."""
    transport = LogTransport(drive_log(), lambda messages: [m for m in messages if m.topic == "/joint_states"])
    transport.types = {"/joint_states": transport.types["/joint_states"]}
    run_node(transport, "odometry", config=NodeConfig(wait_s=0.0))
    messages = published(transport, PREDICTED_ODOMETRY)
    stamps = np.array([stamp_of(m) for m in messages])
    assert np.median(np.diff(stamps)) <= 0.0201 * S
    assert len(stamps) > 0.9 * len(LogTransport(drive_log(), lambda found: [m for m in found if m.topic == "/joint_states"]).left) - 150
    turning = [m.twist.twist for m in messages if abs(m.twist.twist.angular.z) > 0.3]
    assert np.median([abs(twist.linear.y / twist.angular.z) for twist in turning]) > 0.003
    moving = [m.twist.covariance.reshape(6, 6) for m in messages if abs(m.twist.twist.linear.x) > 0.1]
    assert all(np.linalg.eigvalsh(cov[np.ix_((0, 1, 5), (0, 1, 5))])[0] > 0.0 for cov in moving)


def test_odometry_moves_by_no_more_than_motion_and_correction(driven):
    """0.5 m/s and 1 rad/s are this robot's bounds; corrections of the filter are below 5 mm and 5 mrad here."""
    messages = list(track(driven("ekf", True)[0], PREDICTED_ODOMETRY).items())
    stamps, poses = np.array([stamp for stamp, _ in messages]), np.array([pose for _, (pose, _) in messages])
    step, seconds = se2.between(poses[:-1], poses[1:]), np.diff(stamps) * 1e-9
    assert (np.hypot(step[:, 0], step[:, 1]) <= 0.6 * seconds + 0.005).all()
    assert (np.abs(step[:, 2]) <= 1.2 * seconds + 0.005).all()


def test_predicted_odometry_has_a_covariance_at_each_stamp(driven):
    sigmas = np.array([sigma for _, sigma in track(driven("ekf", True)[0], PREDICTED_ODOMETRY).values()])
    assert (sigmas[-1000:] > 0.0).all()  # the drive begins with a standstill
    assert sigmas.max() < 0.1


def test_transforms_of_a_graph_reach_the_map_at_every_stamp(driven):
    """`map` -> `odom` is repeated with each transform of the body: else tf2 must extrapolate. Its pose has a covariance of its own."""
    transport, node, _ = driven("graph", True)
    links = [(m.transforms[0].header.frame_id, stamp_of(m.transforms[0])) for m in published(transport, TF)]
    in_odom, in_map = ([stamp for frame, stamp in links if frame == name] for name in ("odom", "map"))
    assert in_map == in_odom[-len(in_map) :]
    assert len(in_map) > 0.99 * len(in_odom)
    last, estimate = published(transport, POSE)[-1], node.session.health.estimate
    assert last.header.frame_id == "map"
    assert last.pose.pose.position.x == estimate.pose[0]
    assert last.pose.covariance[35] == pytest.approx(estimate.covariance[2, 2])


@functools.cache
def true_twists() -> np.ndarray:
    """(n, 4) stamp [ns], vx, vy and wz of the simulator."""
    store, rows = get_typestore(Stores.ROS2_HUMBLE), []
    for message in open_source(drive_log()).messages(["/ground_truth/odom"]):
        odometry = store.deserialize_cdr(bytes(message.data), "nav_msgs/msg/Odometry")
        twist = odometry.twist.twist
        rows.append((stamp_of(odometry), twist.linear.x, twist.linear.y, twist.angular.z))
    return np.array(rows, dtype=float)


def twist_errors(transport, topic):
    """Stamps (n,) [s], errors (n, 3) of the published twists, their covariances (n, 3, 3), and true twists (n, 3)."""
    truth = true_twists()
    messages = [m for m in published(transport, topic) if truth[0, 0] + 3 * S < stamp_of(m) < truth[-1, 0]]
    stamps = np.array([stamp_of(m) for m in messages], dtype=float)
    twists = np.array([(m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.angular.z) for m in messages])
    true = np.column_stack([np.interp(stamps, truth[:, 0], truth[:, i]) for i in (1, 2, 3)])
    covs = np.array([m.twist.covariance.reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))] for m in messages])
    return stamps * 1e-9, twists - true, covs, true


@pytest.mark.parametrize("estimator", ["ekf", "graph"])
@pytest.mark.parametrize("topic", [ODOMETRY, PREDICTED_ODOMETRY])
def test_published_twist_is_that_of_its_stamp_with_its_covariance(estimator, topic, driven):
    """NEES over the drive and where the motion changes, by 3 degrees of freedom; the turn rate is known to 0.02 rad/s."""
    stamps, errors, covs, true = twist_errors(driven(estimator, True)[0], topic)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors) / 3.0
    is_changing = np.abs(np.gradient(true[:, 2], stamps)) + np.abs(np.gradient(true[:, 0], stamps)) > 0.5
    assert 0.1 < nees.mean() < 2.0
    assert nees[is_changing].mean() < 4.0
    assert np.median(np.sqrt(covs[:, 2, 2])) < 0.02
    assert np.sqrt(np.diagonal(covs, axis1=1, axis2=2)).min() > 1e-3
    assert np.sqrt(np.mean(errors[:, 2] ** 2)) < 0.02


@pytest.mark.extended
def test_prediction_with_the_gyro_turns_as_the_robot_does(driven):
    """Against the same node without it: the turn rates between scans."""
    without = LogTransport(drive_log(), lambda messages: [m for m in messages if m.topic != "/imu/data"])
    del without.types["/imu/data"]
    run_node(without, "ekf", config=NodeConfig(wait_s=0.0))
    rms = [np.sqrt(np.mean(twist_errors(t, PREDICTED_ODOMETRY)[1][:, 2] ** 2)) for t in (driven("ekf", True)[0], without)]
    assert rms[0] < 0.8 * rms[1]


def predictor_at(stamp_ns, clock_offset_s=0.0):
    model = make_model("skid_steer", ROBOT)
    predictor = Predictor(model, ROBOT, StepConfig())
    cov = np.diag([1e-4, 2e-4, 3e-4])
    predictor.reset(Estimate(stamp_ns, np.array([1.0, 2.0, 0.5]), cov, np.zeros(3), None), None, clock_offset_s)
    return predictor


def wheels_from(begin_ns, count, rate=5.0, period_ns=S // 50):
    wheels = WheelBuffer(ROBOT.center_of_gravity)
    for i in range(count):
        wheels.insert(WheelSample(begin_ns + i * period_ns, np.full(2, rate), np.full(2, rate * i * period_ns * 1e-9)))
    return wheels


def test_predict_straight_motion_moves_ahead_and_widens_the_covariance():
    predictor = predictor_at(S)
    found = predictor.predict(wheels_from(S, 6))
    assert found.stamp_ns == S + S // 10
    ahead = se2.between(np.array([1.0, 2.0, 0.5]), found.pose)
    speed = 5.0 * ROBOT.geometry.wheel_radius_m
    assert ahead == pytest.approx([0.1 * speed, 0.0, 0.0], abs=0.01 * speed)
    assert found.twist[0] == pytest.approx(ahead[0] / 0.1)
    assert (np.linalg.eigvalsh(found.covariance - np.diag([1e-4, 2e-4, 3e-4]))[-1]) > 0.0


def test_predict_uses_the_offset_of_the_wheels_clock():
    predictor = predictor_at(S, clock_offset_s=0.03)
    assert predictor.predict(wheels_from(S, 6)).stamp_ns == S + S // 10 - 3 * S // 100


def test_predict_without_wheels_since_the_estimate_gives_none():
    assert predictor_at(S).predict(wheels_from(0, 2)) is None


def test_predict_over_a_gap_of_the_wheels_has_the_covariance_of_an_unknown_velocity():
    """Of 3 s without angles, the rates hold for .5 s; .5 m/s is unknown otherwise."""
    wheels = WheelBuffer(ROBOT.center_of_gravity)
    for k in (0, 1, 2, 3, 4, 5, 155):
        wheels.insert(WheelSample(S + k * S // 50, np.full(2, 5.0), np.full(2, np.nan)))
    found = predictor_at(S).predict(wheels)
    assert found.stamp_ns == S + 155 * S // 50
    assert found.covariance[0, 0] == pytest.approx((2.5 * StepConfig().lost_speed_m_s) ** 2, rel=0.1)


def test_predict_over_a_gap_with_angles_on_both_sides_has_all_of_the_way():
    found = predictor_at(S).predict(wheels_from(S, 4, period_ns=S))
    assert found.stamp_ns == 4 * S
    speed = 5.0 * ROBOT.geometry.wheel_radius_m
    assert se2.between(np.array([1.0, 2.0, 0.5]), found.pose)[0] == pytest.approx(3.0 * speed)
    assert found.covariance[0, 0] < 0.1**2


def test_predict_long_after_the_last_estimate_goes_on_at_the_rate_of_the_wheels():
    """An estimator without processor time: the buffer of the wheels is shorter than that may last."""
    predictor, wheels, found = predictor_at(0), WheelBuffer(ROBOT.center_of_gravity), []
    for i in range(1500):
        wheels.insert(WheelSample(i * S // 50, np.full(2, 5.0), np.full(2, i * 0.1)))
        found.append(predictor.predict(wheels))
    assert all(found[1:])
    way = se2.between(np.array([1.0, 2.0, 0.5]), found[-1].pose)[0]
    assert way == pytest.approx(1499 / 50 * 5.0 * ROBOT.geometry.wheel_radius_m, rel=0.01)


@pytest.mark.extended
def test_predictions_that_nobody_receives_are_not_written():
    """By a transport that knows: neither predicted odometry nor more transforms than estimates; estimates are as with readers."""
    transport = LogTransport(drive_log())
    transport.has_readers = lambda topic: False
    run_node(transport, config=NodeConfig(wait_s=0.0, predict=True))
    late = 3 * S + stamp_of(published(transport, ODOMETRY)[0])
    assert not [m for m in published(transport, PREDICTED_ODOMETRY) if stamp_of(m) > late]
    transforms = [t for message in published(transport, TF) for t in message.transforms if stamp_of(t) > late]
    assert len(transforms) == len([m for m in published(transport, ODOMETRY) if stamp_of(m) > late]) > 100


@pytest.mark.extended
def test_predicted_odometry_without_readers_is_left_out_beside_transforms(driven):
    transport = LogTransport(drive_log())
    transport.has_readers = lambda topic: topic == TF
    run_node(transport, config=NodeConfig(wait_s=0.0, predict=True))
    late = 3 * S + stamp_of(published(transport, ODOMETRY)[0])
    assert not [m for m in published(transport, PREDICTED_ODOMETRY) if stamp_of(m) > late]
    assert published(transport, TF)[-1] == published(driven("ekf", True)[0], TF)[-1]
    assert len(published(transport, TF)) == len(published(driven("ekf", True)[0], TF))


@pytest.mark.parametrize(("wheels_hz", "predicted_hz"), [(500.0, 50.0), (100.0, 50.0), (50.0, 50.0), (40.0, 40.0), (120.0, 50.0)])
def test_predictions_of_fast_wheels_come_at_the_set_rate(wheels_hz, predicted_hz):
    """With stamps that jitter by 2 ms: the mean rate is that of the setting, or of slower wheels."""
    rng = np.random.default_rng(0)
    predictor = Predictor(make_model("diff_drive", ROBOT), ROBOT, StepConfig(), 50.0)
    predictor.reset(Estimate(0, np.zeros(3), np.zeros(3), None, None), None, 0.0)
    stamps = np.sort(np.arange(0.0, 10.0, 1.0 / wheels_hz) + rng.uniform(0.0, 0.002, round(10.0 * wheels_hz)))
    due = [predictor.is_due(round(t * S)) for t in stamps]
    assert sum(due) / 10.0 == pytest.approx(predicted_hz, rel=0.03)


@pytest.mark.parametrize("has_angle", [True, False])
@pytest.mark.parametrize("has_rate", [True, False])
def test_predicted_motion_is_that_of_the_estimators(has_angle, has_rate):
    """By their functions, one after the other: means to the last digits, covariances by 1e-9 of themselves."""
    rng, noise = np.random.default_rng(3), noise_vector(ROBOT.wheel_noise)
    for _ in range(20):
        n = int(rng.integers(1, 6))
        dt, wheels = rng.uniform(0.005, 0.03, n), rng.uniform(-8.0, 8.0, (n, 2))
        model = make_model("skid_steer", ROBOT)
        by_model = model.twist(wheels, np.tile([0.05, -0.02], (n, 1)), model.nominal)
        angle, rate = rng.normal(0.0, 0.1, 2)
        motion = integrate_twists(dt, by_model, noise)
        delta, cov, duration = motion.delta, motion.cov, float(dt.sum())
        mean, mean_cov = mean_twist(delta, cov, duration)
        twist, twist_cov = twist_at_end(mean, mean_cov, by_model.value[-1] - mean, duration)
        if has_angle:
            way, cov = fuse_turn(se2.log(delta), cov, angle, 1e-5, np.zeros((3, 3)))
            delta = se2.exp(way)
        if has_rate:
            twist, twist_cov = fuse_turn(twist, twist_cov, rate, 1e-4, np.zeros((3, 3)))
        turn = [*((angle, 1e-5) if has_angle else (np.nan, np.nan)), *((rate, 1e-4) if has_rate else (np.nan, np.nan))]
        found, found_twist, found_twist_cov = predicted_motion(dt, by_model.value, noise, np.array(turn))
        np.testing.assert_allclose(found.delta, delta, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found.cov, cov, rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(found_twist, twist, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found_twist_cov, twist_cov, rtol=1e-9, atol=1e-18)
