"""A real rclpy peer that saves a map, sets /initialpose in it, receives its grid, and loads another, over DDS and by rclpy."""

from __future__ import annotations

import os
import signal

import pytest

from tests.ros2.environment import UnreachableError, ros2_python
from tests.ros2.peers import Robot, own_domain, start_skidloc

pytest.importorskip("cyclonedds", reason="the extra 'ros2' (cyclonedds) is not installed")
pytestmark = [
    pytest.mark.skipif(not os.environ.get("SKIDLOC_TEST_ROS2"), reason="real ROS 2 peers: run `make test-ros2`"),
]
_COMPILED_S = 240.0  # a first start compiles for half a minute, on a busy machine for several


@pytest.mark.parametrize("distro", [pytest.param(name, marks=pytest.mark.xdist_group(name)) for name in ("kilted", "jazzy")])
def test_rclpy_peer_saves_a_map_and_localizes_in_it(distro, running, tmp_path) -> None:
    try:
        python = ros2_python(distro)
    except UnreachableError as error:
        pytest.skip(str(error))
    saved = save_map_over_dds(distro, running, tmp_path)
    domain = own_domain(9)
    node = running(start_skidloc(domain, "--map", saved, python=python, door="rclpy", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST"))
    node.line("No topic is published", timeout_s=_COMPILED_S)
    robot = running(Robot(distro, domain))
    robot.do("spin 2")
    robot.do("play 2")
    node.line("running skid_steer", timeout_s=_COMPILED_S)
    robot.do("initialpose 0.2 -0.1 0.1")
    node.line("the place in the map is searched near x 0.200 m")
    robot.do("play 8")
    found = robot.report()
    assert found["statuses"]["skidloc: map"]["level"] == 0, found["statuses"]["skidloc: map"]
    frame, width, height, free_share = found["grids"][-1]
    assert frame == "map"
    assert min(width, height) > 50
    assert free_share > 0.2
    (tmp_path / "cut.skidmap").write_bytes(saved.read_bytes()[:1000])
    robot.do(f"text /skidloc/load_map {tmp_path / 'cut'}")
    node.line("The present map stays.")
    robot.do(f"text /skidloc/load_map {saved}")
    node.line("is searched", timeout_s=60.0)
    robot.do("call /reinitialize_global_localization")
    node.line("relocalize: the whole map is searched.")
    robot.do("play 3")
    assert robot.report()["statuses"]["skidloc: map"]["message"]
    assert node.end(signal.SIGINT) == 0, node.text
    assert "Traceback" not in node.text


def save_map_over_dds(distro, running, folder):
    """The file that a node with the graph has saved on a peer's command, and refused to write again."""
    domain, path = own_domain(8), folder / "live.skidmap"
    node = running(start_skidloc(domain, "--estimator", "graph"))
    node.line("No topic is published", timeout_s=_COMPILED_S)
    robot = running(Robot(distro, domain))
    robot.do("spin 2")
    robot.do("play 3")
    node.line("running skid_steer", timeout_s=_COMPILED_S)
    robot.do("play 11")
    robot.do(f"text /skidloc/save_map {path}")
    node.line("keyframes are in")
    robot.do(f"text /skidloc/save_map {path}")
    node.line("exists already")
    robot.leave()
    assert node.end(signal.SIGINT) == 0, node.text
    return path
