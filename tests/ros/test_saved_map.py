"""A node in a saved map: searching until a pose is given on /initialpose, then localized; diagnostics, and the map with free space."""

from __future__ import annotations

import threading
import zipfile

import numpy as np
import pytest

from localization.estimators import PriorMap
from localization.log_replay import replay
from localization.logs import open_log
from localization.logs.serialization import STORE, encode, make
from localization.maps import SavedMap, load_map, save_map
from localization.maps.place_search import PlaceMap
from localization.pipeline import Trial
from localization.ros.diagnostics import OK, WARN
from localization.ros.discovery import TF
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import DIAGNOSTICS
from localization.ros.settings import OnlineSettings
from localization.ros.transports.transport import Received
from motion_models.registry import make_model
from tests.helpers.floor_plan import make_map
from tests.helpers.online import ROBOT, LogTransport, drive_log, published, run_node, stamp_of, track
from tests.ros.test_operator_commands import pose_message

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")


@pytest.fixture(scope="module")
def places() -> PlaceMap:
    log = open_log(drive_log(), ROBOT)
    keyframes = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "graph")], ROBOT, log.mounts, True)[0].keyframes
    assert keyframes is not None
    return PlaceMap(keyframes, 0.02)


@pytest.mark.extended
def test_node_in_a_saved_map_is_localized_after_initialpose(places: PlaceMap) -> None:

    def spoil(messages):
        at = messages[0].received_ns + 2 * S
        pose = pose_message([1.0, 0.1, 0.2], "map", np.diag([0.25, 0.25, 0.07]))
        return sorted([*messages, Received("/initialpose", at, pose)], key=lambda m: m.received_ns)

    transport = LogTransport(drive_log(), spoil)
    config = NodeConfig(wait_s=0.0, map_topic="/map", transform_tolerance=0.5)
    node, reports = run_node(transport, "map", config=config, prior=PriorMap(places))
    assert any("the place in the map is searched near x 1.000 m" in text for text in reports)
    states = [STORE.deserialize_cdr(data, "std_msgs/msg/String").data for data in transport.published["/skidloc/localization_state"]]
    assert (states[0], states[-1]) == ("searching", "localized")
    links = [t for message in published(transport, TF) for t in message.transforms]
    at = {frame: [stamp_of(t) for t in links if t.header.frame_id == frame] for frame in ("map", "odom")}
    assert {stamp - S // 2 for stamp in at["map"]} <= {*at["odom"]}
    found = node.session.pipeline.estimator.localization()
    assert found["state"] == "localized"
    assert found["probability"] > 0.95
    poses = np.array([pose for pose, _ in track(transport).values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.05  # odom has no jump
    levels = {status.name: status.level for status in node.statuses}
    assert levels["map"] == OK
    first = [status for status in published(transport, DIAGNOSTICS)[0].status if status.name == "skidloc: map"]
    assert [status.level for status in first] == [WARN]
    grid = STORE.deserialize_cdr(transport.published["/map"][-1], "nav_msgs/msg/OccupancyGrid")
    cells = np.asarray(grid.data)
    assert {-1, 0, 100} == set(cells.tolist())
    assert (cells == 0).mean() > 0.5
    assert cells.size == grid.info.width * grid.info.height


def send(topic: str, data: bytes, at_s: float):
    """A log's messages with one more."""

    def spoil(messages):
        at = messages[0].received_ns + int(at_s * S)
        return sorted([*messages, Received(topic, at, data)], key=lambda m: m.received_ns)

    return LogTransport(drive_log(), spoil)


@pytest.mark.extended
def test_node_relocalize_searches_again_and_offers_amcls_service(places: PlaceMap) -> None:
    transport = send("/skidloc/relocalize", encode(make("std_msgs/msg/Empty")), 2.0)
    node, reports = run_node(transport, "map", config=NodeConfig(wait_s=0.0), prior=PriorMap(places, np.array([1.0, 0.1, 0.2])))
    assert "relocalize: the whole map is searched." in reports
    poses = np.array([pose for pose, _ in track(transport).values()])
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.05  # odom has no jump
    assert {"/skidloc/relocalize", "/reinitialize_global_localization", "/skidloc/save_map", "/skidloc/load_map"} <= set(transport.services)
    assert transport.services["/reinitialize_global_localization"](True).is_success
    assert node.session.pipeline.estimator.localization()["state"] == "searching"
    assert not transport.services["/skidloc/save_map"]("of_a_map").is_success


@pytest.mark.extended
def test_node_save_map_writes_the_graphs_map_and_nothing_over_a_file(tmp_path) -> None:
    name = str(tmp_path / "live.2026-11-26")
    transport = send("/skidloc/save_map", encode(make("std_msgs/msg/String", data=name)), 12.0)
    node, reports = run_node(transport, "graph", config=NodeConfig(wait_s=0.0))
    for thread in [t for t in threading.enumerate() if t.name == "save map"]:
        thread.join()
    assert any("keyframes are in" in text for text in reports)
    saved = load_map(tmp_path / "live.2026-11-26.skidmap")
    assert 1 < len(saved.map.poses) <= len(node.session.pipeline.estimator.keyframe_map().poses)
    assert saved.provenance["log"] == "live topics"
    before = (tmp_path / "live.2026-11-26.skidmap").read_bytes()
    assert not transport.services["/skidloc/save_map"](name).is_success
    assert (tmp_path / "live.2026-11-26.skidmap").read_bytes() == before
    assert not transport.services["/skidloc/relocalize"](True).is_success
    assert "uses no saved map" in transport.services["/skidloc/load_map"](name).message


@pytest.mark.extended
def test_node_load_map_searches_the_new_map_and_refuses_what_is_none(places: PlaceMap, tmp_path) -> None:
    """Refused: files that are missing, truncated, foreign, of a newer version. The present map and its place stay."""
    floor = make_map()
    save_map(tmp_path / "office.skidmap", SavedMap(floor, {}))
    whole = (tmp_path / "office.skidmap").read_bytes()
    (tmp_path / "truncated.skidmap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "foreign.skidmap").write_bytes(b"image: office.pgm")
    header = zip_member(tmp_path / "office.skidmap", "skidmap.json").replace(b'"version": 1', b'"version": 3')
    write_zip(tmp_path / "newer.skidmap", {"skidmap.json": header})
    transport = send("/skidloc/load_map", encode(make("std_msgs/msg/String", data=str(tmp_path / "truncated"))), 8.0)
    node, reports = run_node(transport, "map", config=NodeConfig(wait_s=0.0), prior=PriorMap(places, np.array([1.0, 0.1, 0.2])))
    load = transport.services["/skidloc/load_map"]
    codes = [load(str(tmp_path / name)).code for name in ("none", "truncated", "foreign", "newer")]
    assert codes == [1, 2, 2, 2]
    assert load("").code == 1
    wanted = "is truncated, damaged, or no map file", "no map", "is truncated, damaged, or no map file", "has version 3 of the format"
    assert all(any(text in report and report.endswith("The present map stays.") for report in reports) for text in wanted)
    estimator = node.session.pipeline.estimator
    assert estimator.localizer.places is places
    assert estimator.localization()["state"] == "localized"
    before = estimator.odometry.state["pose"]
    assert load(f"file://{tmp_path / 'office.skidmap'}").is_success
    for thread in [t for t in threading.enumerate() if t.name == "load map"]:
        thread.join()
    node.spin(is_over=iter([False, True]).__next__)
    assert any("office.skidmap' is searched" in report for report in reports)
    assert estimator.localizer.places.fingerprint == PlaceMap(floor, 0.02).fingerprint
    assert estimator.localization()["state"] == "searching"
    assert np.array_equal(estimator.odometry.state["pose"], before)


def zip_member(path, name: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        return archive.read(name)


def write_zip(path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_online_settings_with_a_missing_map_are_refused(tmp_path) -> None:
    from localization.errors import MapError

    with pytest.raises(MapError, match="no map"):
        OnlineSettings("vaultbot", map=tmp_path / "none.skidmap").make_trial(has_lidar=True)
