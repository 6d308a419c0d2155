"""A node without a LiDAR over DDS: what it publishes never jumps, though the gyro's bias, found at rest, corrects the way before; and with
a gyro as the robot file has it, poses and twists are the simulator's within the published covariance."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict

import numpy as np
import pytest

from localization.log_replay import replay
from localization.logs import open_log
from localization.logs.reader import open_source
from localization.logs.serialization import decoder
from localization.pipeline import Trial
from localization.simulation.experiments import Experiment, OpenLoop, Rest, constant
from localization.simulation.sensors import EncoderConfig, ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers.online import ROBOT

pytest.importorskip("cyclonedds")
from localization.ros.transports.dds import DdsTransport

S = 1_000_000_000
DOMAIN = 100 + (os.getpid() + 50) % 100
_DEADLINE_S = 60.0
_ODOMETRY, _PREDICTED, _TF = "/skidloc/odometry", "/skidloc/odometry_predicted", "/tf"
_TYPES = {_ODOMETRY: "nav_msgs/msg/Odometry", _PREDICTED: "nav_msgs/msg/Odometry", _TF: "tf2_msgs/msg/TFMessage"}
_CONTINUOUS = np.array([1e-3, 5e-3])
"""Largest step of a pose that its twists do not explain [m, rad]. The gyro's bias of this drive, 3.9 deg/s, turns it by 4 mrad in the step
in which a standstill is judged."""
pytestmark = [pytest.mark.xdist_group("online"), pytest.mark.extended]


def _phases(robot, config):
    """Off at once, and at rest at the end."""
    yield OpenLoop("ahead", constant(0.4, 0.2), 5.0)
    yield OpenLoop("back", constant(0.4, -0.2), 4.0)
    yield Rest(3.0)


def simulated(folder, imu):
    path = folder / "drive.mcap"
    sensors = SensorConfig(lidar="none", encoders=EncoderConfig(), imu=imu)
    experiment = Experiment("weave", "for tests", "hall", (0.0, 0.0, 0.0), _phases)
    write_simulation(path, Simulation(experiment, ROBOT, 0, {}, SimulationConfig(sensors=sensors)))
    return path


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("without_lidar"), ImuConfig(gyro_bias_sigma=0.02))


@pytest.fixture(scope="module")
def received(drive):
    return published_over_dds(drive)


@pytest.fixture(scope="module")
def usual_drive(tmp_path_factory):
    """By a gyro whose bias is as the robot file has it."""
    return simulated(tmp_path_factory.mktemp("usual"), ImuConfig(gyro_bias_sigma=ROBOT.gyro_noise.bias_sigma_rad_per_s))


@pytest.fixture(scope="module")
def usual_received(usual_drive):
    return published_over_dds(usual_drive)


def published_over_dds(drive):
    """Decoded messages that a node published, by topic, while the log's wheels and IMU were played in real time."""
    transport = DdsTransport(DOMAIN)
    source = open_source(drive)
    sent = {channel.topic: channel.type for channel in source.channels if channel.topic in ("/joint_states", "/imu/data", "/tf_static")}
    for topic, kind in sent.items():
        transport.advertise(topic, kind, is_latched=topic == "/tf_static")
    for topic, kind in _TYPES.items():
        transport.subscribe(topic, kind, is_latched=False)  # keeps 200, a burst after a pause of either side
    decoders = {topic: decoder(kind) for topic, kind in _TYPES.items()}
    command = [sys.executable, "-m", "localization.cli", "online", "--robot", "vaultbot", "--door", "dds", "--node.wait-s", "0.5"]
    node = subprocess.Popen([*command, "--domain", str(DOMAIN)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    found = defaultdict(list)
    try:
        assert "listening" in node.stdout.readline()
        assert "waiting" in node.stdout.readline()  # with everything compiled
        begin = time.monotonic()
        for message in source.messages(list(sent)):
            due = begin + (message.log_ns - source.start_ns) / S
            while (left := due - time.monotonic()) > 0.0:
                _take(transport, decoders, found, min(left, 0.01))
            transport.publish(message.topic, message.data)
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            _take(transport, decoders, found, 0.05)
    finally:
        node.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            node.communicate(timeout=_DEADLINE_S)
        node.kill()
        transport.close()
    return found


def _take(transport, decoders, found, seconds):
    for message in transport.take(seconds):
        found[message.topic].append(decoders[message.topic](message.data))


def path_of(messages):
    """Stamps (n,) [s], poses (n, 3) and twists (n, 3)."""
    rows = []
    for m in messages:
        q, p, v = m.pose.pose.orientation, m.pose.pose.position, m.twist.twist
        rows.append(
            (m.header.stamp.sec + m.header.stamp.nanosec * 1e-9, p.x, p.y, 2.0 * np.arctan2(q.z, q.w), v.linear.x, v.linear.y, v.angular.z)
        )
    table = np.array(rows)
    return table[:, 0], table[:, 1:4], table[:, 4:]


def unexplained(stamps, poses, twists):
    """(n - 1, 2) by how much each pose is off where the mean twist leads from the one before [m, rad], beyond half the twists' difference
    times the time: any speed that grows or falls in between is within that. Beside other load some messages are lost, and starts and stops
    take as long as the gap that they leave."""
    dt, change = np.diff(stamps)[:, None], np.diff(twists, axis=0)
    off = se2.local(se2.retract(poses[:-1], 0.5 * (twists[1:] + twists[:-1]) * dt), poses[1:])
    size, largest = (np.stack([np.hypot(v[:, 0], v[:, 1]), np.abs(v[:, 2])], axis=1) for v in (off, 0.5 * change * dt))
    return size - largest


@pytest.mark.parametrize("topic", [_ODOMETRY, _PREDICTED])
def test_published_pose_without_a_lidar_never_jumps(topic, received):
    stamps, poses, twists = path_of(received[topic])
    assert (np.diff(stamps) > 0.0).all()
    assert stamps[-1] - stamps[0] > 10.0
    assert np.diff(stamps).max() < 0.3
    assert (unexplained(stamps, poses, twists) < _CONTINUOUS).all()


def truth_of(drive, stamps):
    """Poses (n, 3) relative to the first, and twists (n, 3), of the simulator at ``stamps`` (n,) [s]."""
    decode, messages = decoder("nav_msgs/msg/Odometry"), open_source(drive).messages(["/ground_truth/odom"])
    at, poses, twists = path_of([decode(message.data) for message in messages])
    poses[:, 2] = np.unwrap(poses[:, 2])
    poses, twists = (np.stack([np.interp(stamps, at, column) for column in table.T], axis=1) for table in (poses, twists))
    return se2.between(poses[0], poses), twists


@pytest.mark.parametrize("topic", [_ODOMETRY, _PREDICTED])
def test_published_poses_and_twists_without_a_lidar_are_the_simulators(topic, usual_drive, usual_received):
    """Each pose within the 99.9 % of its covariance (3 degrees of freedom); NEES of the twists over the drive, by 3 degrees of freedom."""
    messages = usual_received[topic]
    stamps, poses, twists = path_of(messages)
    true_poses, true_twists = truth_of(usual_drive, stamps)
    assert np.hypot(*true_poses[-1, :2]) > 3.0
    off = se2.between(poses[0], poses) - true_poses
    off[:, 2] = se2.wrap_angle(off[:, 2])
    planar = np.ix_((0, 1, 5), (0, 1, 5))
    covs, twist_covs = (
        np.array([part.covariance.reshape(6, 6)[planar] for part in parts])
        for parts in ([m.pose for m in messages], [m.twist for m in messages])
    )
    late = stamps > stamps[0] + 1.0  # the covariance of the first pose is zero
    nees = np.einsum("ni,nij,nj->n", off[late], np.linalg.inv(covs[late]), off[late])
    assert nees.max() < 16.3
    off_twists = twists - true_twists
    assert 0.1 < np.einsum("ni,nij,nj->n", off_twists, np.linalg.inv(twist_covs), off_twists).mean() / 3.0 < 2.0


def test_transforms_without_a_lidar_are_those_of_predicted_odometry(received):
    transforms = {t.header.stamp.sec * S + t.header.stamp.nanosec: t.transform for m in received[_TF] for t in m.transforms}
    for message in received[_PREDICTED]:
        at = transforms[message.header.stamp.sec * S + message.header.stamp.nanosec]
        assert (at.translation.x, at.translation.y) == (message.pose.pose.position.x, message.pose.pose.position.y)
        assert at.rotation.z == message.pose.pose.orientation.z


def test_corrected_pose_of_the_same_drive_jumps(drive):
    """Else the other tests could not fail: the filter's own pose moves by a centimetre and more when the robot stops."""
    log = open_log(drive, ROBOT)
    run = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "ekf")], ROBOT, log.mounts, False)[0]
    moved = unexplained(run.trajectory.stamps_ns / S, run.trajectory.poses, run.twists)
    assert moved[:, 0].max() > 5.0 * _CONTINUOUS[0]
