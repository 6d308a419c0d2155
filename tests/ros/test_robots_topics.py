"""Topics as robots name and type them: Clearpath's names, velocities instead of joint states, a second IMU, GNSS."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.errors import SettingError
from localization.logs import open_log
from localization.logs.reference_topics import east_north, geodetic_to_ecef
from localization.logs.topic_roles import TopicOverrides
from localization.ros.discovery import TF
from localization.ros.gnss import parse_datum, utm_pose
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import FIX, ODOMETRY
from localization.ros.settings import OnlineSettings
from localization.simulation.experiments import Experiment, OpenLoop, Rest, constant
from localization.simulation.sensors import GpsConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models import se2
from tests.helpers.online import ROBOT, LogTransport, drive_log, published, run_node

pytestmark = pytest.mark.xdist_group("robots_topics")

STORE = get_typestore(Stores.ROS2_HUMBLE)
SECONDS = 6
CLEARPATH = {
    "/joint_states": "/a200_0000/platform/joint_states",
    "/imu/data": "/a200_0000/sensors/imu_0/data",
    "/scan": "/a200_0000/sensors/lidar2d_0/scan",
    "/tf_static": "/a200_0000/tf_static",
}


def beginning(messages):
    return [m for m in messages if m.received_ns < messages[0].received_ns + SECONDS * 10**9]


def test_clearpath_namespace_names_topics_transforms_and_the_second_imu():
    run = OnlineSettings("vaultbot", node=NodeConfig(clearpath="a200_0000", wait_s=0.0, predict=False)).live_run()
    used = run.resolve_topics().robot.topics
    front, rear = used.scan.split(",")
    assert [used.joint_states, used.imu, front] == list(CLEARPATH.values())[:3]
    assert rear == "/a200_0000/sensors/lidar2d_1/scan"
    assert used.points == "/a200_0000/sensors/lidar3d_0/points"
    transport = LogTransport(drive_log(), lambda ms: [m._replace(topic=CLEARPATH.get(m.topic, m.topic)) for m in beginning(ms)])
    transport.types = {CLEARPATH.get(topic, topic): kind for topic, kind in transport.types.items()}
    transport.types["/a200_0000/sensors/imu_1/data"] = "sensor_msgs/msg/Imu"
    named = TopicOverrides(used.joint_states, scan=front, imu=used.imu)
    _, reports = run_node(transport, config=run.node, topics=named)
    assert len(transport.published["/a200_0000/skidloc/odometry"]) > 30
    assert {"/a200_0000/tf", "/a200_0000/diagnostics"} <= set(transport.published)
    assert [text for text in reports if "/sensors/imu_0/data is used and /a200_0000/sensors/imu_1/data not" in text]


def test_clearpath_namespace_that_ros_refuses_is_refused():
    with pytest.raises(SettingError, match="the namespace is '/a200-0000'"):
        OnlineSettings("vaultbot", node=NodeConfig(clearpath="a200-0000")).live_run()


@pytest.mark.parametrize("is_stamped", [True, pytest.param(False, marks=pytest.mark.extended)], ids=["stamped", "bare"])
def test_live_twist_drives_as_the_joint_states_that_it_is_made_of(is_stamped):
    kind = f"geometry_msgs/msg/TwistWithCovariance{'Stamped' * is_stamped}"

    def replaced(messages):
        return [m if m.topic != "/joint_states" else m._replace(topic="/odom", data=twist(m.data, is_stamped)) for m in beginning(messages)]

    transport = LogTransport(drive_log(), replaced, types={"/odom": kind})
    transport.types.pop("/joint_states")
    run_node(transport, topics=TopicOverrides(odometry="/odom"))
    wheels = LogTransport(drive_log(), beginning)
    run_node(wheels)
    (found, expected) = (published(t, ODOMETRY)[-1].pose.pose.position for t in (transport, wheels))
    assert expected.x > 1.0
    assert np.hypot(found.x - expected.x, found.y - expected.y) < 0.02


def twist(data, is_stamped):
    """The velocity of which the driver's odometry makes the wheels' rates in the JointState ``data``."""
    joints = STORE.deserialize_cdr(data, "sensor_msgs/msg/JointState")
    rates = dict(zip(joints.name, joints.velocity, strict=True))
    left, right = (np.mean([rates[name] for name in side]) for side in (ROBOT.joints.left, ROBOT.joints.right))
    driver = ROBOT.driver
    forward = 0.5 * driver.wheel_radius_m * (left + right)
    turn = driver.wheel_radius_m * (right - left) / (driver.wheel_separation_multiplier * driver.track_width_m)
    make = {name.rpartition("/")[2]: STORE.types[name] for name in STORE.types}
    linear, angular = make["Vector3"](float(forward), 0.0, 0.0), make["Vector3"](0.0, 0.0, float(turn))
    message = make["TwistWithCovariance"](make["Twist"](linear, angular), np.zeros(36))
    if is_stamped:
        message = make["TwistWithCovarianceStamped"](dataclasses.replace(joints.header, frame_id="base_link"), message)
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def _arc(robot, config):
    yield Rest(0.5)
    yield OpenLoop("arc", constant(0.7, 0.3), 12.0)


@pytest.fixture(scope="module")
def outdoor_log(tmp_path_factory):
    """8 m of an arc from a heading of .5 rad, without a LiDAR, with a fix of 5 cm twice a second."""
    config = SimulationConfig(sensors=SensorConfig(lidar="none", gps=GpsConfig(rate_hz=2.0, noise_m=0.05, drift_m=0.0)))
    path = tmp_path_factory.mktemp("gnss") / "arc.mcap"
    write_simulation(path, Simulation(Experiment("arc", "for tests", "hall", (0.0, 0.0, 0.5), _arc), ROBOT, 0, {}, config))
    return path


@pytest.mark.extended
def test_live_fixes_give_the_map_its_heading_and_place_in_utm(outdoor_log, monkeypatch):
    """The map begins at the start of the drive: its pose east and north of the datum is that of the start, about the antenna's arm."""
    datum = np.array([GpsConfig().latitude_deg, GpsConfig().longitude_deg])
    utm_T_enu = np.array([413080.0, 5318357.0, -0.015])
    for module in ("live_inputs", "live_outputs"):
        monkeypatch.setattr(f"localization.ros.{module}.utm_pose", lambda given: utm_T_enu if np.array_equal(given, datum) else None)
    config = NodeConfig(
        wait_s=0.0, predict=False, positions="fix", datum=",".join(map(str, datum)), utm_frame="utm", path_period_s=0.0, map_period_s=0.0
    )
    transport = LogTransport(outdoor_log)
    node, _ = run_node(transport, "graph", config=config)
    assert node.session.pipeline.estimator.counts()["positions"] > 10
    x, y, yaw = node.session.pipeline.estimator.enu_T_map
    assert abs(yaw - 0.5) < 0.06
    assert np.hypot(x, y) < 0.4
    transforms = [t.transforms[0] for t in published(transport, TF)]
    in_utm = [t for t in transforms if t.header.frame_id == "utm"]
    assert in_utm[-1].child_frame_id == "map"
    expected = se2.compose(utm_T_enu, np.array([x, y, yaw]))
    assert np.hypot(in_utm[-1].transform.translation.x - expected[0], in_utm[-1].transform.translation.y - expected[1]) < 1e-6


@pytest.mark.extended
def test_filtered_fixes_and_services_place_the_map_on_the_earth(outdoor_log):
    """The last fix is the true place within its own covariance; what is asked by fromLL is answered back by toLL."""
    transport = LogTransport(outdoor_log)
    run_node(transport, "graph", config=NodeConfig(wait_s=0.0, predict=False, positions="fix", path_period_s=0.0, map_period_s=0.0))
    last = published(transport, FIX)[-1]
    truth = list(open_log(outdoor_log, ROBOT).references("/ground_truth/odom"))[-1]
    datum, place = np.radians([GpsConfig().latitude_deg, GpsConfig().longitude_deg]), np.radians([last.latitude, last.longitude])
    off = east_north(*datum) @ (geodetic_to_ecef(*place, 0.0) - geodetic_to_ecef(*datum, 0.0)) - truth.position
    cov = last.position_covariance.reshape(3, 3)[:2, :2]
    assert off @ np.linalg.solve(cov, off) < 9.2  # 99 % of chi-squared of two
    assert np.sqrt(np.trace(cov)) < 0.3
    assert math.isnan(last.altitude)
    here = SimpleNamespace(latitude=last.latitude, longitude=last.longitude, altitude=0.0)
    in_map = transport.services["/fromLL"](here).point
    back = transport.services["/toLL"](SimpleNamespace(**in_map)).point
    assert [back["latitude"], back["longitude"]] == pytest.approx([last.latitude, last.longitude], abs=1e-9)


@pytest.mark.extended
def test_place_on_the_earth_is_no_number_without_positions():
    transport = LogTransport(drive_log())
    _, reports = run_node(transport)
    assert math.isnan(transport.services["/fromLL"](SimpleNamespace(latitude=48.0, longitude=7.8, altitude=0.0)).point["x"])
    assert any("fromLL: where the map is on the earth is not known" in text for text in reports)


@pytest.mark.parametrize(("datum", "error"), [("48.0", "LATITUDE,LONGITUDE"), ("7.8,248.0", "LATITUDE,LONGITUDE"), ("a,b", "'a,b'")])
def test_datum_that_is_no_place_is_refused(datum, error):
    with pytest.raises(SettingError, match=error):
        parse_datum(datum)


def test_positions_need_the_graph():
    with pytest.raises(SettingError, match="fused by the estimator 'graph' alone"):
        OnlineSettings("vaultbot", node=NodeConfig(positions="fix")).live_run()


@pytest.mark.parametrize(("latitude", "longitude"), [(48.0126, 7.8345), (-33.9, 151.2)])
def test_utm_pose_places_the_plane_as_pyproj_its_points(latitude, longitude):
    """200 m away, up to UTM's scale of .9996."""
    pyproj = pytest.importorskip("pyproj")
    datum, step = np.array([latitude, longitude]), np.array([0.001, 0.0015])
    origin, point = (geodetic_to_ecef(*np.radians(place), 0.0) for place in (datum, datum + step))
    offset = east_north(*np.radians(datum)) @ (point - origin)
    zone = int((longitude + 180.0) // 6.0) + 1
    expected = pyproj.Proj(proj="utm", zone=zone, ellps="WGS84", south=latitude < 0.0)(*(datum + step)[::-1])
    np.testing.assert_allclose(se2.transform(utm_pose(datum), offset[None])[0], expected, atol=0.1)
