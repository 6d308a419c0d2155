"""Real ROS 2 peers (rclpy on Fast DDS) of the package index, beside both doors, and the node as ROS 2 starts and manages it.

Run by `make test-ros2`; elsewhere skipped, for their environments take a minute to make.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from typing import NamedTuple

import numpy as np
import pytest

from localization.trajectory import read_tum
from tests.ros2.environment import HERE, PINS, ROOT, UnreachableError, clean_environment, ros2_python
from tests.ros2.peers import Process, Robot, own_domain, start_skidloc

pytest.importorskip("cyclonedds", reason="the extra 'ros2' (cyclonedds) is not installed")
pytestmark = [
    pytest.mark.skipif(not os.environ.get("SKIDLOC_TEST_ROS2"), reason="real ROS 2 peers: run `make test-ros2`"),
]
ODOMETRY_HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"  # as nav_msgs ships it
_CLOUD_BYTES = 4_000_000
_COMPILED_S = 180.0  # a first start compiles for half a minute, on a busy machine for several


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.xdist_group(name)) for name in ("kilted", "jazzy")])
def distro(request):
    try:
        ros2_python(request.param)
    except UnreachableError as error:
        pytest.skip(str(error))
    if request.param not in _waiting:
        domain = own_domain(list(PINS).index(request.param))
        _waiting[request.param] = _Waiting(start_skidloc(domain), domain, time.monotonic())
        atexit.register(_waiting[request.param].node.kill)
    return request.param


class _Waiting(NamedTuple):
    """A node that waits for a robot from the first test on, for the last one to use: so nobody waits for it."""

    node: Process
    domain: int
    begin: float


_waiting: dict[str, _Waiting] = {}


def ros2_environment(domain):
    return {**clean_environment(), "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def start_managed(distro, domain, *arguments):
    """`skidloc_node`, in the environment of ROS 2 ``distro``."""
    command = [ros2_python(distro), "-m", "localization.ros.lifecycle", "--ros-args", *arguments]
    return Process(command, {**ros2_environment(domain), "PYTHONPATH": str(ROOT)})


class Manager(Process):
    """`tests/ros2/manager.py`."""

    def __init__(self, distro, domain, node):
        super().__init__([ros2_python(distro), HERE / "manager.py", node], ros2_environment(domain))
        self.line("up")

    def __call__(self, operation, argument=None):
        self.process.stdin.write(json.dumps([operation, argument]) + "\n")
        self.process.stdin.flush()
        (answer,) = json.loads(self.line("[", timeout_s=90.0))
        return answer


def test_dds_transport_receives_all_clouds_of_4_mb_at_10_hz(distro, running):
    domain = own_domain(2)
    code = (
        "import sys, time\n"
        "from localization.ros.transports.dds import DdsTransport\n"
        "here, count, last = DdsTransport(int(sys.argv[1])), 0, time.monotonic() + 20\n"
        "here.subscribe('/points', 'sensor_msgs/msg/PointCloud2', is_latched=False)\n"
        "print('up', flush=True)\n"
        "while time.monotonic() < last:\n"
        "    for received in here.take(0.1):\n"
        "        count, last = count + (len(received.data) > int(sys.argv[2])), time.monotonic() + 3\n"
        "print('clouds', count, flush=True)\n"
    )
    command = [sys.executable, "-c", code, domain, _CLOUD_BYTES]
    receiver = running(Process(command, {**clean_environment(), "PYTHONPATH": str(ROOT)}))
    receiver.line("up")
    robot = running(Robot(distro, domain))
    robot.do(f"cloud {_CLOUD_BYTES} 40")
    assert int(receiver.line("clouds").split()[1]) == 40


def test_rclpy_transport_waits_runs_and_ends_by_sigint(distro, running, tmp_path):
    domain, out = own_domain(3), tmp_path / "run.tum"
    node = running(start_skidloc(domain, "--out", out, python=ros2_python(distro), door="rclpy", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST"))
    node.line("No topic is published", timeout_s=_COMPILED_S)
    robot = running(Robot(distro, domain))
    robot.do("spin 2")
    robot.do("play 8")
    found = robot.report()
    assert found["answered"] >= 0.95 * found["sent"] > 90
    assert node.end(signal.SIGINT) == 0, node.text
    assert len(read_tum(out)) >= found["answered"]
    for unwanted in ("Traceback", "ExternalShutdown", "another node publishes"):
        assert unwanted not in node.text


def test_rclpy_transport_without_tf2_msgs_names_its_package(distro):
    code = (
        "import sys; sys.modules['tf2_msgs'] = sys.modules['tf2_msgs.msg'] = None\n"
        "from localization.cli import main\n"
        "sys.exit(main(['online', '--robot', 'vaultbot', '--door', 'rclpy']))\n"
    )
    environment = {**ros2_environment(own_domain(4)), "PYTHONPATH": str(ROOT), "ROS_DISTRO": distro}
    done = subprocess.run([ros2_python(distro), "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == 2
    assert f"apt install ros-{distro}-tf2-msgs" in done.stderr
    assert "Traceback" not in done.stderr


def test_lifecycle_node_is_managed_from_another_process(distro, running):
    domain = own_domain(5)
    renamed = {"~/odometry": "/skidloc/odometry", "~/odometry_predicted": "/skidloc/odometry_predicted", "set_pose": "/set_pose"}
    remap = ["-r", "__node:=rover", "-r", "__ns:=/team", *(part for name in renamed for part in ("-r", f"{name}:={renamed[name]}"))]
    topics = ["-p", "topic.joint_states:=/joint_states", "-p", "topic.scan:=/scan", "-p", "topic.imu:=/imu/data"]
    node = running(start_managed(distro, domain, *remap, "-p", "autostart:=false", "-p", "robot:=vaultbot", *topics))
    manage = running(Manager(distro, domain, "/team/rover"))
    assert manage("state") == "unconfigured"
    assert manage("get", "wait_s") == 5.0
    description, constraint = manage("describe", "config.estimator.lidar.matcher")
    assert description
    assert constraint == "submap, kiss"
    for name, value, reason in (
        ("wait_s", -1.0, "must be 0 or more"),
        ("wait_s", "long", "must be a number"),
        ("config.estimator.lidar.matcher", "submaps", "Did you mean 'submap'?"),
    ):
        is_set, why = manage("set", [name, value])
        assert not is_set
        assert reason in why
    assert manage("set", ["wait_s", 2]) == [True, ""]  # whole numbers are numbers
    assert manage("change", "configure")
    assert manage("change", "activate")
    robot = running(Robot(distro, domain))
    robot.do("spin 2")
    robot.begin("play 6")
    time.sleep(4.0)
    is_set, why = manage("set", ["wait_s", 3.0])
    assert not is_set
    assert "deactivate" in why
    assert manage("set", ["publish_tf", False]) == [True, ""]
    robot.line("done")
    found = robot.report()
    assert found["answered"] >= 0.9 * found["sent"] > 60
    assert 0 < found["tf_count"] < 0.9 * len(found["predicted"])
    assert manage("tare_payload")
    robot.do("set_pose 30 -20")
    robot.do("play 2")
    assert np.hypot(*np.subtract(robot.report()["poses"][-1], [30.0, -20.0])) < 2.0
    assert manage("pause", True)
    before = len(robot.report()["poses"])
    robot.do("play 1")
    assert len(robot.report()["poses"]) == before
    assert manage("pause", False)
    before = robot.report()["poses"][-1]
    assert manage("reset")  # nothing learned is left, and odometry goes on from where it was
    robot.do("play 3")
    assert np.hypot(*np.subtract(robot.report()["poses"][-1], before)) < 3.0
    assert "/team/rover" in found["nodes"]
    assert manage("change", "deactivate")
    assert manage("state") == "inactive"
    assert manage("change", "cleanup")
    assert node.end(signal.SIGTERM, timeout_s=5.0) == 0, node.text
    assert "Traceback" not in node.text


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["-p", "robot:=vaultbot", "-p", "publish_tff:=true"], "there is no parameter 'publish_tff'. Did you mean 'publish_tf'?"),
        (["-p", "robot:=vaultbott"], "vaultbot"),
        ([], "parameter 'robot' is empty"),
        (["-p", "robot:=vaultbot", "-p", "estimator:=efk"], "efk"),
    ],
)
def test_lifecycle_node_refuses_wrong_parameters(distro, running, arguments, error):
    node = running(start_managed(distro, own_domain(6), *arguments))
    assert node.process.wait(timeout=60) == 2
    node.end()
    assert error in node.text
    assert "Traceback" not in node.text


def test_colcon_build_installs_a_package_that_ros2_finds_and_starts(distro, running, tmp_path):
    """From a copy of the sources; the node is started as launch files do, with the installed parameter file."""
    source, python = tmp_path / "src" / "skidloc", ros2_python(distro)
    source.mkdir(parents=True)
    for name in ("pyproject.toml", "setup.py", "package.xml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("localization", "motion_models", "skidloc"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**ros2_environment(own_domain(7)), "PATH": f"{python.parent}:{os.environ['PATH']}"}
    build = [python.parent / "colcon", "build", "--event-handlers", "console_direct+"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    prefix = tmp_path / "install" / "skidloc"
    index = "from ament_index_python.packages import get_package_share_directory as share; print(share('skidloc'))"
    found = subprocess.run(
        [python, "-c", index], capture_output=True, text=True, env={**environment, "AMENT_PREFIX_PATH": str(prefix)}, timeout=60
    )
    share = prefix / "share" / "skidloc"
    assert found.stdout.strip() == str(share)
    assert len(list((share / "launch").glob("*.launch.py"))) == 3
    (site,) = prefix.glob("lib/python*/site-packages")
    command = ["sh", "-c", 'exec "$@"', "sh", prefix / "lib" / "skidloc" / "skidloc_node"]
    options = ["--ros-args", "-r", "__node:=skidloc", "--params-file", share / "params.yaml", "-p", "robot:=nobot"]
    node = running(Process([*command, *options], {**environment, "PYTHONPATH": str(site)}))
    assert node.process.wait(timeout=60) == 2  # read from both: a robot that drives would have to wait for compilers
    node.end()
    assert "nobot" in node.text


def test_dds_transport_with_late_and_restarted_robots_is_served(distro, running):
    """35 s without a robot but for one that leaves; then one that drives, is killed, and is there again."""
    node, domain, begin = running(_waiting[distro].node), _waiting[distro].domain, _waiting[distro].begin
    node.line("No topic is published", timeout_s=_COMPILED_S)
    Robot(distro, domain).leave()
    time.sleep(max(begin + 35.0 - time.monotonic(), 0.0))
    assert node.process.poll() is None, node.text

    robot = running(Robot(distro, domain))
    robot.do("spin 2")
    robot.do("play 9")
    found = robot.report()
    print({name: found[name] for name in ("sent", "answered", "first_s", "tf_count")}, np.quantile(found["latencies_s"][-60:], [0.5, 0.99]))
    assert found["answered"] >= 0.95 * found["sent"] > 90
    assert found["first_s"] < 2.0 + 5.0  # 2 s without scans, then as long as the node waits for all topics
    assert found["frames"] == found["tf"] == [["odom", "base_link"]]
    steps = np.diff(found["predicted"])
    assert (steps > 0).all()
    assert np.median(steps) < 0.0201e9
    assert (steps < 0.0201e9).sum() > 50 * 4  # the wheels' 50 Hz, after what has waited
    assert found["tf_count"] == len(found["predicted"]) > found["answered"]
    assert "/skidloc" in found["nodes"]
    assert [info[0] for info in found["hashes"]] == [ODOMETRY_HASH]
    assert not {name: status for name, status in found["statuses"].items() if status["level"]}
    robot.kill()

    again = running(Robot(distro, domain))
    again.do("spin 2")
    again.do("play 4")
    found = again.report()
    assert found["answered"] >= 0.9 * found["sent"] > 40
    again.do("payload 3")
    again.do("reset")
    again.do("play 2")
    found = again.report()
    assert found["statuses"]["skidloc: payload"]["message"] == "3 kg at 'base_link'"
    assert np.hypot(*found["poses"][-1]) < 1.5
    assert node.end(signal.SIGINT) == 0, node.text
    assert "reset: begins anew" in node.text
    assert "Traceback" not in node.text
    assert "invalid type object" not in node.text
