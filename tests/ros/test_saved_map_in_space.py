"""A node on hills in a saved map in space: localized after /initialpose, poses and transforms in space; other maps and LiDARs refused."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.errors import MapError
from localization.estimators import PriorMap
from localization.logs.serialization import encode, make
from localization.maps import SavedMap, save_map
from localization.maps.space_places import SpacePlaces
from localization.pipeline import Pipeline, Trial
from localization.ros.diagnostics import OK
from localization.ros.discovery import TF
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import MAP, POSE
from localization.ros.state_serialization import deserialize, serialize
from localization.ros.transports.transport import Received
from motion_models.registry import make_model
from tests.helpers import floor_plan, hill_log, hill_map
from tests.helpers.hill_scans import MOUNT, make_scene, scans
from tests.helpers.hills import rolling_drive
from tests.helpers.in_space import in_order, true_poses
from tests.helpers.online import LogTransport, drive_log, published, run_node, stamp_of, track
from tests.ros.test_operator_commands import pose_message

pytestmark = [pytest.mark.xdist_group("among_trees"), pytest.mark.extended]

S = 1_000_000_000
_OFF = np.array([0.4, -0.3, 0.15])
"""Of the pose that is given [m, m, rad]."""


@pytest.fixture(scope="module")
def hills():
    drive = rolling_drive(9.0)
    scene = make_scene(drive, 3)
    return drive, scene, list(scans(drive, scene))


@pytest.fixture(scope="module")
def places(hills) -> SpacePlaces:
    """Of keyframes at true poses: its frame is the world's, in which the drive does not begin at height zero."""
    drive, scene, _ = hills
    every = np.arange(0, len(drive.stamps_ns), 80)
    way = [(*drive.positions[i, :2], math.atan2(drive.rotations[i, 1, 0], drive.rotations[i, 0, 0])) for i in every]
    return SpacePlaces(hill_map.make_map(scene, tuple(way)), 0.02)


def true_from_above(drive, stamp_ns: int) -> np.ndarray:
    (pose,) = true_poses(drive, np.array([stamp_ns]))
    return np.array([*pose[:2, 3], math.atan2(pose[1, 0], pose[0, 0])])


def transport_of(hills, tmp_path, topic: str, data: bytes, at_s: float) -> LogTransport:
    drive, _, clouds = hills

    def spoil(messages):
        at = messages[0].received_ns + round(at_s * S)
        return sorted([*messages, Received(topic, at, data)], key=lambda m: m.received_ns)

    return LogTransport(hill_log.write(tmp_path / "hills.mcap", drive, clouds), spoil)


def test_node_on_hills_is_localized_in_space_after_initialpose(hills, places, tmp_path) -> None:
    drive = hills[0]
    given = true_from_above(drive, int(drive.stamps_ns[0]) + 3 * S) + _OFF
    message = pose_message(given, "map", np.diag([0.25, 0.25, 0.07]))
    transport = transport_of(hills, tmp_path, "/initialpose", message, 3.0)
    node, reports = run_node(transport, "map", config=NodeConfig(wait_s=0.0), prior=PriorMap(places), robot=drive.robot)
    assert any("the place in the map is searched near" in text for text in reports)
    found = node.session.pipeline.estimator.localization()
    assert found["state"] == "localized"
    assert found["probability"] > 0.9
    assert {status.name: status.level for status in node.statuses}["map"] == OK
    last = published(transport, POSE)[-1]
    (true,) = true_poses(drive, np.array([stamp_of(last)]))
    p, q = last.pose.pose.position, last.pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], true[:3, 3], atol=0.04)
    assert abs(2.0 * math.asin(q.x)) + abs(2.0 * math.asin(q.y)) > 0.01  # tilted
    poses = np.array([pose for pose, _ in track(transport).values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.1  # odom has no jump
    store = get_typestore(Stores.ROS2_HUMBLE)
    frames = [m for data in transport.published[TF] for m in store.deserialize_cdr(data, "tf2_msgs/msg/TFMessage").transforms]
    correction = [m.transform.translation.z for m in frames if m.child_frame_id == "odom"][-1]
    assert abs(correction - drive.positions[0, 2]) < 0.05
    cells = np.asarray(published(transport, MAP)[-1].data)
    assert {-1, 0, 100} == set(cells.tolist())


def test_node_on_hills_refuses_planar_maps_and_goes_on(hills, places, tmp_path) -> None:
    save_map(tmp_path / "office.skidmap", SavedMap(floor_plan.make_map(), {}))
    save_map(tmp_path / "hill.skidmap", SavedMap(places.mapped, {}))
    transport = transport_of(hills, tmp_path, "/skidloc/relocalize", encode(make("std_msgs/msg/Empty")), 5.0)
    drive = hills[0]
    initial = true_from_above(drive, int(drive.stamps_ns[0])) + _OFF
    node, reports = run_node(transport, "map", config=NodeConfig(wait_s=0.0), prior=PriorMap(places, initial), robot=drive.robot)
    assert "relocalize: the whole map is searched." in reports
    load, estimator = transport.services["/skidloc/load_map"], node.session.pipeline.estimator
    for name, text in (("office", "it holds planar scans"), ("hill", "hill.skidmap' is searched")):
        assert load(str(tmp_path / name)).is_success
        for thread in [t for t in threading.enumerate() if t.name == "load map"]:
            thread.join()
        node.spin(is_over=iter([False, True]).__next__)
        assert any(text in report for report in reports)
        assert (estimator.localizer.places is places) == (name == "office")
    assert estimator.localization()["state"] == "searching"


def test_node_of_a_graph_in_space_says_how_its_map_is_saved(hills, tmp_path) -> None:
    drive, _, clouds = hills
    transport = LogTransport(hill_log.write(tmp_path / "hills.mcap", drive, clouds))
    run_node(transport, "graph", config=NodeConfig(wait_s=0.0), robot=drive.robot)
    reply = transport.services["/skidloc/save_map"](str(tmp_path / "hill"))
    assert not reply.is_success
    assert "skidloc replay --save-map" in reply.message
    assert not list(tmp_path.glob("*.skidmap"))


def test_node_with_a_planar_lidar_refuses_a_map_in_space(places) -> None:
    with pytest.raises(MapError, match="holds clouds in space, and the LiDAR is planar"):
        run_node(LogTransport(drive_log()), "map", prior=PriorMap(places))


def test_checkpoint_of_a_drive_on_hills_gives_the_same_estimates(hills, places) -> None:
    """The map itself is not in the state; a search that runs is begun again."""
    drive, _, clouds = hills
    trial = Trial(
        make_model("skid_steer", drive.robot), "map", prior=PriorMap(places, true_from_above(drive, int(drive.stamps_ns[0])) + _OFF)
    )
    pipeline = Pipeline(trial, drive.robot, {**drive.mounts, "lidar_link": MOUNT}, True)
    events = in_order(drive, clouds)
    half = next(i for i, event in enumerate(events) if pipeline.process(event) and pipeline.estimator.localizer._running is not None) + 1
    text, blob = serialize(pipeline, {"map": places})
    assert b"SpacePlaces" not in text
    again = deserialize(text, blob, {"map": places})
    for event in events[half : half + 960]:
        for one, other in zip(pipeline.process(event), again.process(event), strict=True):
            np.testing.assert_array_equal(one.in_map.position, other.in_map.position)
            np.testing.assert_array_equal(one.in_map.covariance, other.in_map.covariance)
    assert again.estimator.localizer.state == pipeline.estimator.localizer.state == "localized"
