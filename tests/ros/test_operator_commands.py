"""Poses and services of an operator while the node runs; and what is latched for those who come later."""

from __future__ import annotations

import numpy as np
import pytest

from localization.logs.fused_messages import six_by_six
from localization.logs.serialization import encode, make
from localization.ros.node_config import NodeConfig
from localization.ros.operator_commands import POSE_TYPE
from localization.ros.publisher import DIAGNOSTICS, MAP, PATH, PREDICTED_ODOMETRY, occupancy_grid
from localization.ros.session import Files
from localization.ros.transports.transport import Received
from motion_models import se2
from tests.helpers.online import LogTransport, drive_log, published, run_node, stamp_of, track

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")


def pose_message(pose, frame, cov=None):
    stamp = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    position = make("geometry_msgs/msg/Point", x=pose[0], y=pose[1], z=0.0)
    orientation = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(pose[2] / 2), w=np.cos(pose[2] / 2))
    inner = make("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    covariance = np.zeros(36) if cov is None else six_by_six(cov)
    content = make("geometry_msgs/msg/PoseWithCovariance", pose=inner, covariance=covariance)
    return encode(make(POSE_TYPE, header=make("std_msgs/msg/Header", stamp=stamp, frame_id=frame), pose=content))


def commanded(estimator, topic, *data, at_s=8.0):
    """A drive with messages on ``topic``, a second apart in its middle, and what was reported."""

    def spoil(messages):
        at = messages[0].received_ns + int(at_s * S)
        sent = [Received(topic, at + i * S, content) for i, content in enumerate(data)]
        return sorted([*messages, *sent], key=lambda m: m.received_ns)

    transport = LogTransport(drive_log(), spoil)
    return transport, *run_node(transport, estimator, config=NodeConfig(wait_s=0.0))


@pytest.fixture(scope="module")
def calm():
    transport = LogTransport(drive_log())
    run_node(transport, config=NodeConfig(wait_s=0.0))
    return track(transport)


@pytest.mark.extended
def test_set_pose_in_odom_continues_from_that_pose_and_covariance(calm):
    cov = np.diag([0.04, 0.01, 0.0025])
    transport, _, reports = commanded("ekf", "/set_pose", pose_message([5.0, -3.0, 1.0], "odom", cov))
    assert any("begins anew at x 5.000 m, y -3.000 m, yaw 57.3 deg in 'odom'" in text for text in reports)
    found = track(transport)
    stamps = list(found)
    jump = next(i for i in range(1, len(stamps)) if np.hypot(*(found[stamps[i]][0] - found[stamps[i - 1]][0])[:2]) > 1.0)
    pose, sigmas = found[stamps[jump]]
    assert pose == pytest.approx([5.0, -3.0, 1.0], abs=0.05)
    assert sigmas == pytest.approx([0.2, 0.1, 0.05], rel=0.05)
    # and what is driven from there is what is driven without it
    common = [stamp for stamp in stamps[jump:] if stamp in calm]
    a, b = (se2.between(of[common[0]][0], of[common[-1]][0]) for of in (calm, found))
    assert np.abs(se2.between(a, b)).max() < 0.05


@pytest.mark.extended
def test_initialpose_moves_the_map_and_leaves_odom_without_a_jump():
    transport, node, reports = commanded("graph", "/initialpose", pose_message([5.0, -3.0, 1.0], "map"))
    assert any("in 'map'" in text for text in reports)
    poses = np.array([pose for pose, _ in track(transport).values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.05
    assert np.hypot(*(node.session.health.estimate.pose[:2] - [5.0, -3.0])) < 6.0
    assert node.session.state.start.map_T_start == pytest.approx([5.0, -3.0, 1.0])


@pytest.mark.extended
def test_set_pose_with_wrong_content_is_ignored_with_a_reason(calm):
    wrong = {
        pose_message([0.0, 0.0, 0.0], "map"): "its frame is 'map', and this estimator has odom",
        pose_message([np.nan, 0.0, 0.0], "odom"): "it holds numbers that are not finite",
        pose_message([0.0, 0.0, 0.0], "odom", -np.eye(3)): "negative eigenvalues",
        b"no message": "/set_pose: the message is ignored",
    }
    transport, _, reports = commanded("ekf", "/set_pose", *wrong)
    assert [reason for reason in wrong.values() if not any(reason in text for text in reports)] == []
    assert track(transport).keys() == calm.keys()


def serviced(name, *requests, estimator="ekf"):
    """A node that drives for 8 s, is asked, and drives on; the replies."""
    transport = LogTransport(drive_log())
    calls = {8.0 + 4.0 * i: request for i, request in enumerate(requests)}
    replies = []
    take = transport.take

    def take_and_call(timeout_s, batch_s=0.0):
        received = take(timeout_s, batch_s)
        first = transport.first_ns
        for at in [at for at in calls if received and received[-1].received_ns - first > at * S]:
            replies.append(transport.services[name](calls.pop(at)))
            transport.counts_at_calls.append(len(published(transport, PREDICTED_ODOMETRY)))
        return received

    transport.take = take_and_call
    transport.first_ns, transport.counts_at_calls = transport.left[0].received_ns, []
    node, reports = run_node(transport, estimator, config=NodeConfig(wait_s=0.0))
    return transport, node, replies, reports


@pytest.mark.extended
def test_reset_begins_anew_and_odom_goes_on_without_a_jump(calm):
    """REP-105; with nothing learned and a new map."""
    transport, node, replies, reports = serviced("/skidloc/reset", True)
    assert replies[0].is_success
    assert "reset: begins anew; odom goes on without a jump. To move it, publish /set_pose." in reports
    found = track(transport)
    poses = np.array([pose for pose, _ in found.values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.05
    last = list(calm)[-1]
    assert np.all(np.abs(found[last][0] - calm[last][0])[:2] < 5.0 * found[last][1][:2] + 0.02)
    assert np.hypot(*node.session.state.start.odom_T_start[:2]) > 0.5


@pytest.mark.extended
def test_reset_of_a_graph_sets_the_map_frame_to_the_robot():
    _, node, _, _ = serviced("/skidloc/reset", True, estimator="graph")
    start, estimate = node.session.state.start, node.session.health.estimate
    assert not start.map_T_start.any()
    np.testing.assert_allclose(se2.compose(estimate.map_T_odom, estimate.odometry[0]), estimate.pose, atol=1e-9)


@pytest.mark.extended
def test_tare_payload_discards_corrections_and_keeps_the_pose(calm):
    transport, node, replies, _ = serviced("/skidloc/tare_payload", True)
    assert replies[0].is_success
    poses = np.array([pose for pose, _ in track(transport).values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.05
    last = list(calm)[-1]
    found = track(transport)[last]
    assert np.all(np.abs(found[0] - calm[last][0])[:2] < 5.0 * found[1][:2] + 0.02)
    assert node.session.count > 2000


@pytest.mark.extended
def test_pause_publishes_nothing_until_it_is_continued():
    transport, node, replies, _ = serviced("/skidloc/pause", True, False)
    assert [reply.message for reply in replies] == ["paused", "continued"]
    assert transport.counts_at_calls[0] == transport.counts_at_calls[1] > 0
    assert len(published(transport, PREDICTED_ODOMETRY)) > transport.counts_at_calls[1] + 200
    assert not node.is_paused
    assert stamp_of(published(transport, PREDICTED_ODOMETRY)[-1]) * 1e-9 > 15.0


@pytest.mark.extended
def test_diagnostics_of_a_paused_node_name_the_service():
    transport, node, _, _ = serviced("/skidloc/pause", True)
    node.publish_status(0.0)
    (status,) = [s for s in published(transport, DIAGNOSTICS)[-1].status if s.name == "skidloc: pause"]
    assert "~/pause with data: false" in status.message


def payload_message(frame, mass, position=(0.0, 0.0, 0.0)):
    com = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", position, strict=True)))
    inertia = make("geometry_msgs/msg/Inertia", m=mass, com=com, ixx=0.0, ixy=0.0, ixz=0.0, iyy=0.0, iyz=0.0, izz=0.0)
    header = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id=frame)
    return encode(make("geometry_msgs/msg/InertiaStamped", header=header, inertia=inertia))


@pytest.mark.extended
def test_payload_on_its_topic_moves_the_cg_until_it_is_tared(tmp_path):
    """By the topic; the state on disk holds it too."""
    files = Files(state=tmp_path / "state")

    def spoil(messages):
        at = messages[0].received_ns + 8 * S
        load = Received("/skidloc/payload", at, payload_message("left_gripper", 20.0))
        return sorted([*messages[: len(messages) // 2], load], key=lambda m: m.received_ns)

    transport = LogTransport(drive_log(), spoil)
    node, reports = run_node(transport, files=files, config=NodeConfig(wait_s=0.0))
    assert "/skidloc/payload: 20 kg at 'left_gripper'" in reports
    alone, loaded = node.payloads.unloaded.position, node.payloads.sample(0).position
    assert np.hypot(*(loaded - alone)) > 0.01
    assert node.session.pipeline.synchronizer.wheels.buffer.cg == pytest.approx(loaded)
    node.publish_status(0.0)
    (status,) = [s for s in published(transport, DIAGNOSTICS)[-1].status if s.name == "skidloc: payload"]
    assert status.message == "20 kg at 'left_gripper'"
    node.finish()

    tare = Received("/skidloc/tare_payload", 0, encode(make("std_msgs/msg/Empty", structure_needs_at_least_one_member=0)))

    def rest(messages):
        later = [messages[0], *messages[len(messages) // 2 :]]
        return [*later, tare._replace(received_ns=later[-1].received_ns)]

    node, reports = run_node(LogTransport(drive_log(), rest), files=files, config=NodeConfig(wait_s=0.0))
    assert any("resumed from" in text for text in reports)
    assert any("no payload is set" in text for text in reports)
    assert node.payloads.loads == {}
    assert node.session.pipeline.synchronizer.wheels.buffer.cg == pytest.approx(node.payloads.unloaded.position)


def test_payload_with_wrong_content_is_ignored_with_a_reason():
    wrong = {
        payload_message("left_griper", 3.0): "no link 'left_griper'",
        payload_message("left_gripper", 300.0): "would tip over",
        payload_message("left_gripper", np.nan): "must be finite",
        b"no message": "/skidloc/payload: the message is ignored",
    }
    _, node, reports = commanded("odometry", "/skidloc/payload", *wrong)
    assert [reason for reason in wrong.values() if not any(reason in text for text in reports)] == []
    assert node.payloads.loads == {}


@pytest.mark.extended
def test_commands_by_topics_do_what_the_services_do():
    """Reset, pause and its end."""
    empty, (off, on) = (
        make("std_msgs/msg/Empty", structure_needs_at_least_one_member=0),
        (make("std_msgs/msg/Bool", data=d) for d in (0, 1)),
    )
    _, node, reports = commanded("odometry", "/skidloc/reset", encode(empty))
    assert any(text.startswith("reset: begins anew") for text in reports)
    _, node, reports = commanded("odometry", "/skidloc/pause", encode(on))
    assert node.is_paused
    assert node.commands.execute(Received("/skidloc/pause", 0, encode(off)))
    assert not node.is_paused


@pytest.mark.extended
def test_path_and_map_are_published_in_the_frame_of_the_estimates():
    transport = LogTransport(drive_log())
    run_node(transport, "graph", config=NodeConfig(wait_s=0.0, map_period_s=0.001))
    path, grid = published(transport, PATH)[-1], published(transport, MAP)[-1]
    assert path.header.frame_id == grid.header.frame_id == "map"
    assert 1 < len(path.poses) <= 500
    cells = np.asarray(grid.data).reshape(grid.info.height, grid.info.width)
    assert set(np.unique(cells)) == {-1, 0, 100}
    assert (cells == 0).mean() > 0.15
    assert grid.info.resolution == pytest.approx(0.1)
    begin = path.poses[0].pose.position
    assert (begin.x, begin.y) == pytest.approx((0.0, 0.0), abs=0.1)


def test_occupancy_grid_marks_the_cells_of_points():
    low, cell, grid = occupancy_grid(np.array([[1.0, 2.0], [1.55, 2.0], [1.0, 2.31]]))
    assert (low.tolist(), cell, grid.shape) == ([1.0, 2.0], 0.1, (4, 6))
    assert np.argwhere(grid == 100).tolist() == [[0, 0], [0, 5], [3, 0]]
    assert occupancy_grid(np.array([[0.0, 0.0], [3000.0, 3000.0]]))[2].size <= 4_000_000
