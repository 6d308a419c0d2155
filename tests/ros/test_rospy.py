"""ROS 1 as Debian installs it: a real roscore, `rosbag play` as the robot, `rosbag record` as who listens."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import xmlrpc.client

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from localization.cli import main
from localization.events import Scan
from localization.log_replay import replay
from localization.logs import open_log
from localization.logs.serialization import definition
from localization.pipeline import Trial
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from tests.helpers.online import DRIVE, ROBOT

pytestmark = pytest.mark.xdist_group("online")
_DEADLINE_S = 120.0  # only a failure waits for so long
with_ros = pytest.mark.skipif(
    not (shutil.which("roscore") and shutil.which("rosbag")), reason="no ROS 1 here: apt install python3-rospy ros-pipeline python3-rosbag"
)


@pytest.fixture(scope="module")
def ros():
    """The environment of a master of our own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1", "PYTHONUNBUFFERED": "1"}
    master = subprocess.Popen(["roscore", "-p", str(port)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until(lambda: subscribers(environment, "/rosout"))  # roscore's own node: all of it is up
    yield environment
    master.send_signal(signal.SIGINT)
    master.wait(_DEADLINE_S)


def subscribers(environment, topic):
    """Names of the nodes that subscribe to ``topic``, by the master; none while there is no master."""
    with contextlib.suppress(OSError), xmlrpc.client.ServerProxy(environment["ROS_MASTER_URI"]) as master:
        _, _, (_, subscribed, _) = master.getSystemState("/test")
        return dict(subscribed).get(topic, [])
    return []


def wait_until(condition):
    end = time.monotonic() + _DEADLINE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def start(environment, *command):
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process):
    process.send_signal(signal.SIGINT)
    return process.communicate(timeout=_DEADLINE_S)[0]


@with_ros
@pytest.mark.extended
def test_rospy_node_follows_a_played_bag(ros, tmp_path):
    bag = tmp_path / "drive.bag"
    write_simulation(bag, Simulation(DRIVE, ROBOT, 0, {}, SimulationConfig()))
    online = (sys.executable, "-m", "localization.cli", "online", "--robot", "vaultbot", "--door", "rospy", "--node.wait-s", "1")
    node = start(ros, *online, "--out", tmp_path / "live.mcap")
    waiting = node.stdout.readline() + node.stdout.readline()  # listening, then waiting for topics
    topics = ("/skidloc/odometry", "/tf", "/diagnostics", "/skidloc/corrections")
    recorder = start(ros, "rosbag", "record", "-O", tmp_path / "recorded.bag", *topics)
    wait_until(lambda: all(subscribers(ros, topic) for topic in topics))
    played = ("/joint_states", "/scan", "/imu/data", "/tf_static")
    player = start(ros, "rosbag", "play", "--wait-for-subscribers", "--delay", "1", "-q", bag, "--topics", *played)
    player.communicate(timeout=_DEADLINE_S)
    time.sleep(1.0)
    end(recorder)
    text = waiting + end(node)
    assert node.returncode == 0, text
    assert "no messages come on /joint_states" in " ".join(waiting.split())
    with AnyReader([tmp_path / "recorded.bag"], default_typestore=get_typestore(Stores.ROS1_NOETIC)) as reader:
        found = {topic: [] for topic in topics}
        for connection, _, data in reader.messages():
            found[connection.topic].append(reader.deserialize(data, connection.msgtype))
    odometry = found["/skidloc/odometry"]
    log = open_log(bag, ROBOT)
    assert len(odometry) > 0.7 * sum(isinstance(event, Scan) for event in log.events())
    assert len(found["/tf"]) >= 0.9 * len(odometry)
    run = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "ekf")], ROBOT, log.mounts, True)[0].trajectory
    poses = dict(zip(run.stamps_ns.tolist(), run.poses, strict=True))
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in odometry]
    shared = [i for i, stamp in enumerate(stamps) if stamp in poses]
    assert len(shared) > 0.9 * len(stamps)
    where = np.array([[odometry[i].pose.pose.position.x, odometry[i].pose.pose.position.y] for i in shared])
    there = np.array([poses[stamps[i]][:2] for i in shared])
    moved, expected = np.hypot(*(where - where[0]).T), np.hypot(*(there - there[0]).T)
    assert np.abs(moved - expected).max() < 0.1  # whatever it missed at its start
    assert {s.name for s in found["/diagnostics"][-1].status} >= {"skidloc: estimate", "skidloc: lidar"}
    assert "k_0" in found["/skidloc/corrections"][-1].name
    assert (tmp_path / "live.mcap").exists()


@with_ros
def test_online_without_a_ros_master_is_refused(capsys, monkeypatch):
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    assert main(["online", "--robot", "vaultbot", "--door", "rospy"]) == 2
    assert "no ROS 1 master answers at http://127.0.0.1:1. Start roscore, or set ROS_MASTER_URI." in " ".join(
        capsys.readouterr().err.split()
    )


MD5 = {  # as `rosmsg md5` prints them in every ROS 1 installation
    "sensor_msgs/msg/JointState": "3066dcd76a6cfaef579bd0f34173e9fd",
    "sensor_msgs/msg/LaserScan": "90c7ef2dc6895d81024acba2ac42f369",
    "sensor_msgs/msg/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "sensor_msgs/msg/PointCloud2": "1158d486dd51d683ce2f1be655c3c181",
    "nav_msgs/msg/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "geometry_msgs/msg/PointStamped": "c63aecb41bfdfd6b7e1fac37c7cbe7bf",
    "tf2_msgs/msg/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "diagnostic_msgs/msg/DiagnosticArray": "60810da900de1dd6ddd437c3503511da",
}


@pytest.mark.parametrize("kind", MD5)
def test_definition_has_the_md5_sum_of_ros(kind):
    assert definition(kind, is_ros1=True)[1] == MD5[kind]
