"""Claims about the simulated sensors: what they report is the world from where the robot truly is, at that very moment."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.logs.message_templates import STORE, Template
from localization.logs.reference_topics import reference_decoder
from localization.simulation.scanners import PlanarScanner, ScannerConfig, SpinningConfig, SpinningScanner
from localization.simulation.sensors import (
    EncoderConfig,
    EncoderSensor,
    GpsConfig,
    GpsSensor,
    ImuConfig,
    ImuSensor,
    TruthSensor,
    quaternion,
)
from localization.simulation.vehicle import COLUMNS, MassDistribution, SampleClock, TrueMotion
from localization.simulation.world import (
    GLASS,
    WORLDS,
    World,
    box,
    cast,
    cast_at_people,
    clearance,
    line,
    make_grid,
    person_at,
    pillar,
    world_svg,
)
from motion_models import se2
from motion_models.robot import Mount
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
STEP = 0.005
EXACT = ScannerConfig(noise_m=0.0, resolution_m=0.0, dropout=0.0)


def brute_force(x, y, angle, walls):
    """Distance to the nearest wall: every wall's line is solved for by itself."""
    u = np.array([math.cos(angle), math.sin(angle)])
    nearest = math.inf
    for x0, y0, x1, y1, _ in walls:
        edge = np.array([x1 - x0, y1 - y0])
        matrix = np.column_stack([u, -edge])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        t, s = np.linalg.solve(matrix, [x0 - x, y0 - y])
        if t > 0 and -1e-12 <= s <= 1 + 1e-12:
            nearest = min(nearest, t)
    return nearest


def moving_track(twist=(0.5, 0.1, 1.0), seconds=3.0, start=(0.0, 0.0, 0.3)):
    """A robot that moves with a constant twist."""
    t = STEP * np.arange(round(seconds / STEP) + 1)
    rows = np.zeros((len(t), COLUMNS))
    heading = start[2] + twist[2] * t
    moved = se2.compose(np.array(start), se2.exp(t[:, None] * np.array(twist)))
    rows[:, 0:2], rows[:, 2], rows[:, 3:6] = moved[:, :2], heading, twist
    rows[:, 8], rows[:, 9] = 2.0 * t, 3.0 * t
    rows[:, 6], rows[:, 7] = 2.0, 3.0
    track = TrueMotion(rows[0], STEP)
    track.append(rows[1:])
    return track


def read(message):
    return STORE.deserialize_cdr(Template(message.layout, is_ros1=False).fill(message), message.layout.type)


@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_cast_random_rays_match_brute_force_geometry(seed):
    rng = np.random.default_rng(seed)
    walls = np.column_stack([rng.uniform(-6, 6, (12, 4)), np.zeros(12)])
    grid = make_grid(walls, cell=float(rng.uniform(0.2, 2.0)))
    for x, y, angle in zip(rng.uniform(-8, 8, 20), rng.uniform(-8, 8, 20), rng.uniform(-10, 10, 20), strict=True):
        assert cast(x, y, angle, 1e3, grid) == pytest.approx(brute_force(x, y, angle, walls), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2, math.pi, -math.pi / 2, math.pi / 4])
def test_cast_along_grid_lines_and_corners_hits_the_wall(angle):
    walls = box(-2, -2, 2, 2)
    assert cast(0.0, 0.0, angle, 50.0, make_grid(walls, cell=0.5)) == pytest.approx(brute_force(0, 0, angle, walls), rel=1e-12)


def test_cast_beyond_longest_range_or_empty_world_is_infinite():
    grid = make_grid(box(-2, -2, 2, 2))
    assert cast(0.0, 0.0, 0.0, 1.9, grid) == math.inf
    assert cast(0.0, 0.0, 0.0, 50.0, make_grid(np.zeros((0, 5)))) == math.inf


def test_cast_at_glass_returns_only_near_its_normal():
    grid = make_grid(np.concatenate([box(-5, -5, 5, 5), line(2, -5, 2, 5, GLASS)]))
    assert cast(0.0, 0.0, 0.05, 50.0, grid) == pytest.approx(2.0 / math.cos(0.05))
    assert cast(0.0, 0.0, 0.5, 50.0, grid) == pytest.approx(5.0 / math.cos(0.5))


def test_people_over_time_walk_to_and_fro_as_cylinders():
    person = np.array([1.0, 0.0, 3.0, 0.0, 0.5, 0.25])
    assert [round(person_at(person, t)[0], 9) for t in (0.0, 2.0, 4.0, 6.0, 8.0)] == [1.0, 2.0, 3.0, 2.0, 1.0]
    people = person[None]
    assert cast_at_people(0.0, 0.0, 0.0, 2.0, people) == pytest.approx(1.75)
    assert cast_at_people(0.0, 0.0, math.asin(0.24 / 2), 2.0, people) < math.inf
    assert cast_at_people(0.0, 0.0, math.asin(0.26 / 2), 2.0, people) == math.inf
    assert cast_at_people(0.0, 0.0, math.pi, 2.0, people) == math.inf


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_are_closed_and_grids_hold_every_wall(name):
    world = WORLDS[name]()
    grid = make_grid(world.walls)
    assert set(grid.items.tolist()) == set(range(len(world.walls)))
    start = {"rooms": (0.0, -4.0)}.get(name, (0.0, 0.0))
    assert clearance(*start, world.walls) > 0.6
    assert all(cast(*start, a, 200.0, grid) < 200.0 for a in np.linspace(-3.1, 3.1, 50))


def test_planar_scanner_moving_robot_casts_each_beam_at_its_own_time():
    """While turning at 1 rad/s, points laid out with the pose of each beam's time lie on the walls; with that of the scan's start, not."""
    walls = np.concatenate([box(-4, -3, 4, 3), pillar(2, 1)])
    mount, track = Mount(x=0.4, y=-0.1, yaw=0.2), moving_track()
    scanner = PlanarScanner(EXACT, "/scan", "laser", mount, World(walls), 0.0, 10**9, np.random.default_rng(0))
    messages = scanner.messages(track)
    assert len(messages) == 37  # 3 s at 12.5 Hz, the first at once, the last sweep over by then
    off = {"own": 0.0, "start": 0.0}
    for message in messages[5:8]:
        scan = read(message)
        start = message.stamp_ns * 1e-9 - 1.0
        for i, r in enumerate(scan.ranges):
            angle = scan.angle_min + i * scan.angle_increment
            sensor_point = np.array([r * math.cos(angle), r * math.sin(angle)])
            body_point = se2.transform(np.array([mount.x, mount.y, mount.yaw]), sensor_point)
            for which, t in (("own", start + i * scan.time_increment), ("start", start)):
                x, y = se2.transform(track.at(np.array([t]))[0, :3], body_point)
                off[which] = max(off[which], clearance(x, y, walls))
    assert off["own"] < 2e-5  # ranges are float32, poses linear between steps
    assert off["start"] > 0.02


def test_planar_scanner_sweep_is_sent_once_complete():
    scanner = PlanarScanner(EXACT, "/scan", "laser", Mount(), World(box(-4, -3, 4, 3)), 0.0, 10**9, np.random.default_rng(0))
    message = scanner.messages(moving_track())[3]
    scan = read(message)
    sweep = scan.time_increment * 380
    assert sweep == pytest.approx(190 / 360 / 12.5, rel=1e-6)
    assert scan.scan_time == pytest.approx(0.08)
    assert message.log_ns - message.stamp_ns == pytest.approx(sweep * 1e9, abs=100)
    assert message.stamp_ns == 10**9 + 240_000_000
    assert scan.angle_min == pytest.approx(math.radians(-95))
    assert scan.angle_max == pytest.approx(math.radians(95))


def test_planar_scanner_ranges_have_configured_noise_and_dropouts():
    config = ScannerConfig(noise_m=0.02, resolution_m=0.005, dropout=0.05)
    still = moving_track(twist=(0.0, 0.0, 0.0), seconds=8.0)
    truth = read(
        PlanarScanner(EXACT, "/s", "l", Mount(), World(box(-4, -3, 4, 3)), 0.0, 0, np.random.default_rng(1)).messages(still)[0]
    ).ranges
    noisy = PlanarScanner(config, "/s", "l", Mount(), World(box(-4, -3, 4, 3)), 0.0, 0, np.random.default_rng(1)).messages(still)
    ranges = np.array([m.parts[0] for m in noisy], dtype=float)
    lost = np.isinf(ranges)
    n = ranges.size
    assert lost.mean() == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / n))
    error = (ranges - truth)[~lost]
    assert error.mean() == pytest.approx(0.0, abs=5 * 0.02 / math.sqrt(n))
    assert error.std() == pytest.approx(math.hypot(0.02, 0.005 / math.sqrt(12)), rel=0.02)
    np.testing.assert_allclose(np.round(ranges[~lost] / 0.005), ranges[~lost] / 0.005, atol=1e-3)


def test_spinning_scanner_measures_walls_floor_and_ceiling():
    walls, mount, track = box(-4, -3, 4, 3), Mount(x=0.1, z=0.8, yaw=0.3), moving_track()
    config = SpinningConfig(noise_m=0.0, dropout=0.0, min_range_m=0.1)
    world = World(walls, ceiling_m=1.5)
    scanner = SpinningScanner(config, "/points", "velodyne", mount, world, 0.0, 0, np.random.default_rng(0))
    message = scanner.messages(track)[4]
    layout = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("t", "f4")]
    cloud = np.frombuffer(message.parts[0].tobytes(), dtype=layout)
    assert len(cloud) == 16 * 600
    kinds = {"floor": 0, "ceiling": 0, "wall": 0}
    for p in cloud[::7]:
        assert math.isfinite(p["x"])
        if p["z"] < -0.93 + 1e-4:
            kinds["floor"] += 1
            assert p["z"] == pytest.approx(-0.93, abs=1e-4)
        elif p["z"] > 1.5 - 0.93 - 1e-4:
            kinds["ceiling"] += 1
            assert p["z"] == pytest.approx(0.57, abs=1e-4)
        else:
            kinds["wall"] += 1
            world_T_body = track.at(np.array([message.stamp_ns * 1e-9 + p["t"]]))[0, :3]
            x, y = se2.transform(se2.compose(world_T_body, [mount.x, mount.y, mount.yaw]), np.array([p["x"], p["y"]], dtype=float))
            assert clearance(x, y, walls) < 1e-4
    assert min(kinds.values()) > 20
    assert message.log_ns - message.stamp_ns == 100_000_000


def encoders(counts=4096, late=0.0, lost=0.0, rate=50.0):
    return EncoderSensor(EncoderConfig(rate, counts), ROBOT, MassDistribution(ROBOT), late, lost, 10**9, np.random.default_rng(3))


@pytest.mark.extended
@pytest.mark.parametrize(("rate", "counts"), [(50.0, 64), (100.0, 4096), (200.0, 64)])
def test_encoders_any_rate_count_the_wheel_angle(rate, counts):
    track = moving_track(seconds=10.0)
    found = [read(m) for m in encoders(counts, rate=rate).messages(track)]
    assert len(found) == 10 * rate + 1
    unit = 2 * math.pi / counts
    for i, state in enumerate(found):
        t = i / rate
        for wheel, rad_s in (("front_left_wheel", 2.0), ("rear_right_wheel", 3.0)):
            angle = state.position[state.name.index(wheel)]
            assert abs(angle - rad_s * t) <= unit * (1 + 1e-9)
            assert angle / unit == pytest.approx(round(angle / unit), abs=1e-6)
    assert set(found[0].name) >= {"left_elbow_joint", "rear_left_wheel"}
    rates = np.array([s.velocity[0] for s in found[1:]])
    assert rates.mean() == pytest.approx(2.0, rel=0.02)
    assert np.abs(rates - 2.0).max() <= unit * rate + 1e-9


def test_encoders_without_counts_are_exact_in_any_chunks():
    whole = encoders().messages(moving_track(seconds=4.0))
    pieces, device = [], encoders()
    for seconds in (1.0, 2.503, 4.0):
        pieces += device.messages(moving_track(seconds=seconds))
    assert [m.stamp_ns for m in pieces] == [m.stamp_ns for m in whole]
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(a.parts[0], b.parts[0])
    exact = encoders(counts=0).messages(moving_track(seconds=1.0))
    np.testing.assert_allclose(exact[-1].parts[0][:4], [2.0, 2.0, 3.0, 3.0], rtol=1e-12)


def test_encoders_with_dropout_lose_its_share_of_one_wheels_counts():
    found = encoders(lost=0.3).messages(moving_track(seconds=300.0))
    last = found[-1].parts[0]
    assert last[0] / 600.0 == pytest.approx(0.7, abs=0.06)  # some 1000 spells
    np.testing.assert_allclose(last[1:4], [600.0, 900.0, 900.0], atol=0.01)


def test_sample_clock_returns_each_complete_sample_once():
    ticks = SampleClock(12.5, takes_s=0.05)
    assert ticks.due(0.049).tolist() == []
    assert ticks.due(0.05).tolist() == [0]
    assert ticks.due(0.21).tolist() == [80_000_000, 160_000_000]
    assert ticks.due(0.21).tolist() == []
    assert SampleClock(30.0).due(1e5)[-1] == 100_000 * 10**9


def quiet_imu(mount=None, bias=0.0, tilt=0.0):
    config = ImuConfig(100.0, gyro_noise=0.0, gyro_bias_sigma=0.0, gyro_bias_walk=0.0, force_noise=0.0)
    return ImuSensor(config, "/imu", "imu_link", mount or Mount(), bias, tilt, 0, np.random.default_rng(0))


def test_imu_off_centre_measures_gravity_turning_and_lever_arm():
    mount = Mount(x=0.3, y=-0.2, z=0.5)
    rate, force = quiet_imu(mount).messages(moving_track(twist=(0.5, 0.1, 1.0)))[150].parts
    np.testing.assert_allclose(rate, [0, 0, 1.0], atol=1e-12)
    # a point that circles at 1 rad/s about the instant centre (-0.1, 0.5) is pulled towards it
    np.testing.assert_allclose(force, [-0.1 - 0.3, 0.5 + 0.2, 9.81], atol=1e-9)


def test_imu_mounted_on_its_side_measures_in_its_own_axes():
    mount = load_robot("husky_a200").mounts["imu_link"]
    rate, force = quiet_imu(mount).messages(moving_track(twist=(0, 0, 0.7)))[150].parts
    np.testing.assert_allclose(mount.rotation @ rate, [0, 0, 0.7], atol=1e-9)
    np.testing.assert_allclose((mount.rotation @ force)[2], 9.81, atol=1e-9)
    assert force[1] == pytest.approx(9.81, abs=1e-6)  # gravity on its +y


def test_imu_with_bias_and_slope_measures_both():
    still = moving_track(twist=(0, 0, 0), start=(0, 0, math.pi / 2))
    rate, force = quiet_imu(bias=0.03, tilt=0.1).messages(still)[10].parts
    np.testing.assert_allclose(rate, [0, 0, 0.03], atol=1e-12)
    # uphill is the world's +x, here the robot's right: the floor pushes it that way
    np.testing.assert_allclose(force, [0, -9.81 * math.sin(0.1), 9.81 * math.cos(0.1)], atol=1e-9)


def test_imu_noise_matches_its_density():
    config = ImuConfig(100.0, gyro_noise=1e-3, gyro_bias_sigma=0.0, gyro_bias_walk=0.0, force_noise=5e-3)
    still = moving_track(twist=(0, 0, 0), seconds=60.0)
    parts = [m.parts for m in ImuSensor(config, "/imu", "imu_link", Mount(), 0.0, 0.0, 0, np.random.default_rng(2)).messages(still)]
    assert np.std([p[0] for p in parts]) == pytest.approx(1e-2, rel=0.03)
    assert np.std([p[1] for p in parts], axis=0) == pytest.approx(np.full(3, 5e-2), rel=0.05)


def test_gps_fixes_convert_back_to_the_path():
    """By the library's own reading of NavSatFix, which has its own geodesy."""
    track = moving_track(twist=(3.0, 0.0, 0.1), seconds=40.0)
    config = GpsConfig(5.0, noise_m=0.0, drift_m=0.0)
    messages = GpsSensor(config, "/fix", "gps_link", 0, np.random.default_rng(0)).messages(track)
    decode = reference_decoder("sensor_msgs/msg/NavSatFix")
    found = np.array([decode(read(m), m.stamp_ns).position for m in messages])
    truth = track.at(np.array([m.stamp_ns * 1e-9 for m in messages]))[:, :2]
    np.testing.assert_allclose(found - found[0], truth - truth[0], atol=2e-3)
    assert np.ptp(truth[:, 0]) > 30.0


def test_truth_sensor_publishes_motion_and_nominal_cg():
    track, masses = moving_track(), MassDistribution(ROBOT)
    messages = TruthSensor(25.0, ROBOT, masses, True, 10**9).messages(track)
    odometry = [m for m in messages if m.layout.type.endswith("Odometry")]
    cgs = [m for m in messages if m.layout.type.endswith("PointStamped")]
    assert len(odometry) == len(cgs) == 76
    pose, twist = read(odometry[50]).pose.pose, read(odometry[50]).twist.twist
    row = track.at(np.array([2.0]))[0]
    assert (pose.position.x, pose.position.y) == pytest.approx(tuple(row[:2]))
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(row[2])
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == pytest.approx((0.5, 0.1, 1.0))
    np.testing.assert_allclose(cgs[3].parts[0][:2], masses.nominal_cg(np.array([0.0]))[0])


def test_quaternion_of_mount_matches_its_rotation():
    mount = Mount(roll=0.3, pitch=-0.7, yaw=2.0)
    x, y, z, w = quaternion(mount)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(matrix, mount.rotation, atol=1e-12)


@pytest.mark.parametrize("name", WORLDS)
def test_world_svg_draws_every_wall_person_and_patch(name):
    world = WORLDS[name]()
    root = ElementTree.fromstring(world_svg(world, [np.array([[0.0, 0.0, 0.1], [1.0, 0.5, 0.2]])]))
    count = {tag: len(root.findall(f"{{http://www.w3.org/2000/svg}}{tag}")) for tag in ("line", "circle", "rect", "polyline")}
    people = len(world.people)
    assert count == {"line": len(world.walls) + people, "circle": people, "rect": len(world.patches) + 1, "polyline": 1}
