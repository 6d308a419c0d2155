"""Claims about simulated logs: any reader opens them, one seed gives the same bytes, effects change the world and not the metadata."""

from __future__ import annotations

import dataclasses
import functools
import json
import math

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from localization.cli import main
from localization.errors import OutputError, SimulationError
from localization.events import CgSample, ImuSample, Scan, WheelSample
from localization.logs import open_log
from localization.logs.writer import write_bag
from localization.simulation.experiments import (
    CONFIGURATION_CGS,
    EXPERIMENTS,
    Experiment,
    ExperimentConfig,
    MoveArms,
    OpenLoop,
    PickUp,
    Rest,
    Route,
    TurnTo,
    constant,
    grid_points,
)
from localization.simulation.injected_faults import FAULTS, parse_faults
from localization.simulation.open_loop_scores import correction_time, score_open_loop_runs
from localization.simulation.sensors import START_NS, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, simulate, write_simulation
from localization.simulation.vehicle import VehicleConfig
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases
from tests.studies.thesis_regressions import grid

ROBOT = load_robot("vaultbot")
HUSKY = load_robot("husky_a200")
BLIND = SimulationConfig(sensors=SensorConfig(lidar="none"))


def short(*phases, world="hall", start=(0.0, 0.0, 0.0), with_gps=False):
    return Experiment("short", "for tests", world, start, lambda robot, config: iter(phases), with_gps)


ARC = short(Rest(0.5), OpenLoop("arc", constant(0.4, 0.4), 2.0))
STRAIGHT = short(Rest(0.5), OpenLoop("ahead", constant(0.5, 0.0), 4.0))
TURN = short(Rest(0.5), OpenLoop("turn", constant(0.0, 0.4), 4.0))


def driven(experiment=ARC, effects=None, robot=ROBOT, config=BLIND, seed=0):
    simulation = Simulation(experiment, robot, seed, effects or {}, config)
    return simulation, list(simulation.messages())


@pytest.mark.parametrize(("name", "lidar"), [("run.bag", "2d"), ("run.mcap", "3d"), ("run", "2d")])
def test_simulation_every_format_is_read_by_rosbags_and_reader(tmp_path, name, lidar):
    config = SimulationConfig(sensors=SensorConfig(lidar=lidar, center_of_gravity=True))
    simulation = Simulation(dataclasses.replace(ARC, with_gps=True), ROBOT, 1, {}, config)
    count = write_simulation(tmp_path / name, simulation)
    with AnyReader([tmp_path / name], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        assert reader.message_count == count
        types = {c.topic: c.msgtype.rsplit("/", 1)[1] for c in reader.connections}
        times = []
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            times.append(stamp)
            if hasattr(message, "header"):
                header = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                assert START_NS <= header <= stamp
    assert times == sorted(times)
    assert types == {
        "/joint_states": "JointState",
        "/ground_truth/odom": "Odometry",
        "/imu/data": "Imu",
        "/fix": "NavSatFix",
        "/tf_static": "TFMessage",
        "/center_of_gravity": "PointStamped",
        "/experiment": "String",
        **({"/scan": "LaserScan"} if lidar == "2d" else {"/points": "PointCloud2"}),
    }
    log = open_log(tmp_path / name, ROBOT)
    kinds = {type(event) for event in log.events()}
    assert kinds == {WheelSample, Scan, ImuSample, CgSample}
    assert log.mounts["laser" if lidar == "2d" else "velodyne"] == (Mount(x=0.4, z=0.2) if lidar == "2d" else Mount(z=0.8))
    assert log.warnings() == []
    assert log.reference_topic == "/ground_truth/odom"


def test_simulation_mcap_is_decoded_by_other_readers(tmp_path):
    simulation = Simulation(ARC, ROBOT, 1, {}, SimulationConfig())
    count = write_simulation(tmp_path / "run.mcap", simulation)
    with open(tmp_path / "run.mcap", "rb") as file:
        found = [
            (channel.topic, message)
            for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        ]
    assert len(found) == count
    scan = next(message for topic, message in found if topic == "/scan")
    assert len(scan.ranges) == 381
    assert scan.header.frame_id == "laser"


@pytest.mark.parametrize("name", ["run.bag", "run.mcap", "run"])
def test_simulation_same_seed_gives_same_bytes(tmp_path, name):
    def content(folder, seed):
        (tmp_path / folder).mkdir()
        write_simulation(tmp_path / folder / name, Simulation(ARC, ROBOT, seed, {}, SimulationConfig()))
        path = tmp_path / folder / name
        return b"".join(p.read_bytes() for p in (sorted(path.iterdir()) if path.is_dir() else [path]))

    first, again, other = content("a", 7), content("b", 7), content("c", 8)
    assert first == again
    assert first != other


def test_simulation_log_marks_begin_and_end_of_each_run():
    simulation, messages = driven(
        short(Rest(0.5), OpenLoop("a", constant(0.3, 0.0), 2.7), Rest(1.0), OpenLoop("b", constant(0.0, 0.3), 2.0))
    )
    marks = [(m.log_ns, json.loads(m.parts[0].tobytes())) for m in messages if m.layout.topic == "/experiment"]
    assert [(mark["run"], mark["what"]) for _, mark in marks] == [("a", "begins"), ("a", "ends"), ("b", "begins"), ("b", "ends")]
    assert [stamp - START_NS for stamp, _ in marks] == [500_000_000, 4_200_000_000, 5_200_000_000, 8_200_000_000]
    assert [m.log_ns for m in messages] == sorted(m.log_ns for m in messages)
    assert [run.start_s for run in simulation.runs] == pytest.approx([0.5, 5.2])


def test_simulation_additional_sensor_keeps_noise_of_others():
    _, blind = driven()
    _, seeing = driven(config=SimulationConfig(sensors=SensorConfig(lidar="3d", center_of_gravity=True)))
    for topic in ("/imu/data", "/joint_states", "/ground_truth/odom"):
        a, b = ([m for m in messages if m.layout.topic == topic] for messages in (blind, seeing))
        assert len(a) == len(b) > 20
        assert all(np.array_equal(p, q) for m, n in zip(a, b, strict=True) for p, q in zip(m.parts, n.parts, strict=True))


def test_simulation_failing_leaves_no_log(tmp_path):
    into_wall = short(OpenLoop("ahead", constant(1.0, 0.0), 30.0), world="lab")
    with pytest.raises(SimulationError, match=r"hits a wall of 'lab' at x = \d.* s into short"):
        write_simulation(tmp_path / "run.mcap", Simulation(into_wall, ROBOT, 0, {}, BLIND))
    assert list(tmp_path.iterdir()) == []


def test_simulate_existing_or_bad_output_is_refused(tmp_path):
    (tmp_path / "run.mcap").write_text("mine")
    with pytest.raises(OutputError, match=r"run.mcap' exists already"):
        write_simulation(tmp_path / "run.mcap", Simulation(ARC, ROBOT, 0, {}, BLIND))
    assert (tmp_path / "run.mcap").read_text() == "mine"
    with pytest.raises(OutputError, match="cannot be written"):
        write_bag(tmp_path / "run.mcap" / "inside.mcap", [])


def path_of(simulation):
    return simulation.runs[-1].poses


def settled(simulation):
    """Mean twist of the middle of the last run."""
    poses = path_of(simulation)[20:40]
    return se2.log(se2.between(poses[0], poses[-1])) / (19 / 20.0)


def k_of(simulation):
    run = simulation.runs[-1]
    turned = np.diff(run.wheel_angles[[20, 40]], axis=0)[0]
    return (run.poses[40, 2] - run.poses[20, 2]) * 0.56 / (0.164 * (turned[1] - turned[0]))


def distance(simulation):
    return float(np.hypot(*(path_of(simulation)[-1, :2] - path_of(simulation)[0, :2])))


def parts(messages, topic, part):
    return np.array([m.parts[part] for m in messages if m.layout.topic == topic])


ALL_SENSORS = SimulationConfig(sensors=SensorConfig(lidar="2d", center_of_gravity=True))


@functools.cache
def nominal():
    return driven(config=ALL_SENSORS)[1]


@pytest.mark.parametrize("effect", FAULTS)
def test_simulation_effects_leave_metadata_nominal(effect):
    size = {"payload": 5.0, "encoder_dropout": 0.3}.get(effect, 0.02)
    plain, (_, changed) = nominal(), driven(effects={effect: size}, config=ALL_SENSORS)
    transforms = [next(m for m in messages if m.layout.topic == "/tf_static") for messages in (plain, changed)]
    from localization.logs.message_templates import Template

    assert len({Template(m.layout, is_ros1=False).fill(m) for m in transforms}) == 1
    assert {m.layout.topic for m in plain} == {m.layout.topic for m in changed}
    np.testing.assert_array_equal(parts(plain, "/center_of_gravity", 0), parts(changed, "/center_of_gravity", 0))
    # but something that is measured did change
    topics = ("/joint_states", "/scan", "/imu/data", "/ground_truth/odom")
    now = [[(m.stamp_ns, *(p.tobytes() for p in m.parts)) for m in messages if m.layout.topic in topics] for messages in (plain, changed)]
    assert now[0] != now[1]


def test_wheel_radius_scale_larger_drives_farther():
    assert distance(driven(STRAIGHT, {"wheel_radius_scale": 0.05})[0]) / distance(driven(STRAIGHT)[0]) == pytest.approx(1.05, abs=0.002)


def test_wheel_radius_difference_turns_to_the_smaller_side():
    assert path_of(driven(STRAIGHT, {"wheel_radius_difference": 0.04})[0])[-1, 2] < -0.02  # left wheels are the larger ones


@pytest.mark.parametrize(("effect", "axis"), [("cg_offset_x", 0), ("cg_offset_y", 1)])
def test_cg_offset_moves_centre_of_rotation_as_friction_model(effect, axis):
    simulation, _ = driven(TURN, {effect: 0.04})
    vx, vy, wz = settled(simulation)
    model = make_model("friction", ROBOT)
    cg = simulation.runs[-1].nominal_cg + 0.04 * np.eye(2)[axis]
    rates = np.diff(simulation.runs[-1].wheel_angles[[20, 40]], axis=0)[0]
    expected = model.twist(rates, cg, model.nominal).value
    np.testing.assert_allclose([-vy / wz, vx / wz], [-expected[1] / expected[2], expected[0] / expected[2]], atol=5e-3)
    np.testing.assert_allclose(simulation.runs[-1].cg[0], cg, atol=1e-9)


def test_payload_adds_mass_in_the_gripper():
    simulation, _ = driven(TURN, {"payload": 10.0})
    assert np.hypot(*(simulation.runs[-1].cg[0] - simulation.runs[-1].nominal_cg)) > 0.01
    husky, _ = driven(TURN, {"payload": 10.0}, HUSKY)
    np.testing.assert_allclose(husky.runs[-1].cg[0], [10 / 56.034 * 0.256, 0.0], atol=1e-9)


def test_lidar_offset_measures_from_its_true_place():
    config = SimulationConfig()
    still = short(Rest(1.0))
    (_, a), (_, b) = driven(still, config=config), driven(still, {"lidar_offset_x": 0.1, "lidar_yaw": 0.0}, config=config)
    ahead = 190  # the middle beam, towards the hall's end or the box before it
    moved = np.median(parts(a, "/scan", 0)[:, ahead]) - np.median(parts(b, "/scan", 0)[:, ahead])
    assert moved == pytest.approx(0.1, abs=0.02)
    _, c = driven(still, {"lidar_yaw": math.radians(190 / 380 * 20)}, config=config)
    turned = np.nanmedian(parts(c, "/scan", 0)[:, 100:200], axis=0)
    np.testing.assert_allclose(turned, np.nanmedian(parts(a, "/scan", 0)[:, 120:220], axis=0), atol=0.15)


@pytest.mark.parametrize(("effect", "topic"), [("lidar_time_offset", "/scan"), ("wheel_time_offset", "/joint_states")])
def test_time_offset_delays_stamps_but_not_messages(effect, topic):
    config = SimulationConfig()
    (_, plain), (_, late) = driven(config=config), driven(effects={effect: 0.03}, config=config)
    for a, b in zip(plain, late, strict=True):
        assert (a.layout.topic, a.log_ns) == (b.layout.topic, b.log_ns)
        assert b.stamp_ns - a.stamp_ns == (30_000_000 if a.layout.topic == topic else 0)


def test_friction_anisotropy_and_change_turn_less():
    plain = k_of(driven(TURN)[0])
    assert k_of(driven(TURN, {"friction_anisotropy": 0.3})[0]) < 0.95 * plain
    twice = short(Rest(0.5), OpenLoop("first", constant(0.0, 0.4), 4.0), Rest(0.5), OpenLoop("second", constant(0.0, 0.4), 4.0))
    simulation, _ = driven(twice, {"friction_change": 0.3})
    second = k_of(simulation)
    simulation.runs.pop()
    assert k_of(simulation) == pytest.approx(plain, rel=1e-3)
    assert second < 0.95 * plain


@pytest.mark.parametrize(
    ("effect", "size", "name"),
    [
        *(("diagonal_load", 0.3, "warp"), ("tread_asymmetry", 0.3, "tread"), ("scrub", 0.02, "scrub")),
        *(("track_width", 0.05, "track_width"), ("friction_anisotropy", 0.3, "mu_ratio")),
    ],
)
def test_chassis_and_tyre_faults_turn_as_friction_model(effect, size, name):
    simulation, _ = driven(short(MoveArms("ready"), OpenLoop("turn", constant(0.0, 0.4), 4.0)), {effect: size})
    model = make_model("friction", ROBOT)
    params = model.nominal.copy()
    params[model.param_names.index(name)] += size
    rates = np.diff(simulation.runs[-1].wheel_angles[[20, 40]], axis=0)[0] / 1.0
    cg = simulation.runs[-1].nominal_cg
    vx, vy, wz = settled(simulation)
    e, plain = (model.twist(rates, cg, p).value for p in (params, model.nominal))
    np.testing.assert_allclose([-vy / wz, vx / wz], [-e[1] / e[2], e[0] / e[2]], atol=4e-3)
    assert wz == pytest.approx(e[2], rel=0.02)
    assert np.abs(e - plain).max() > 1e-3


def test_rolling_resistance_larger_makes_wheels_slip():
    (easy, _), (hard, _) = driven(STRAIGHT), driven(STRAIGHT, {"rolling_resistance": 0.2})
    assert distance(hard) < 0.99 * distance(easy)


def test_slope_moves_robot_and_tilts_imu():
    simulation, messages = driven(STRAIGHT, {"slope": 0.2})
    assert distance(simulation) < distance(driven(STRAIGHT)[0])
    assert np.median(parts(messages, "/imu/data", 1)[:10, 0]) == pytest.approx(9.81 * math.sin(0.2), abs=0.05)


def test_gyro_bias_at_rest_measures_a_rate():
    (_, plain), (_, biased) = driven(short(Rest(2.0))), driven(short(Rest(2.0)), {"gyro_bias": 0.05})
    difference = parts(biased, "/imu/data", 0) - parts(plain, "/imu/data", 0)
    np.testing.assert_allclose(difference, np.tile([0, 0, 0.05], (len(difference), 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "value"),
    [
        ("lateral_slip_speed", lambda v: (v[0], v[1] + 0.2 * v[0] * v[2], v[2])),
        ("rotation_slip_speed", lambda v: (v[0], v[1], v[2] * (1 - 0.2 * abs(v[0])))),
        ("longitudinal_slip_turning", lambda v: (v[0] * (1 - 0.2 * abs(v[2])), v[1], v[2])),
    ],
)
def test_loose_floor_is_in_truth_and_gyro(effect, value):
    (plain, _), (loose, messages) = driven(), driven(effects={effect: 0.2})
    np.testing.assert_allclose(settled(loose), value(settled(plain)), atol=2e-3)
    gyro = parts(messages, "/imu/data", 0)[75:125, 2]
    truth = parts(messages, "/ground_truth/odom", 3)[38:62, 0]
    assert gyro.mean() == pytest.approx(truth.mean(), abs=0.02)  # its bias


def test_effects_add_up_and_invalid_ones_are_refused():
    assert parse_faults(("slope=0.1", "payload=2", "slope=0.05")) == {"slope": pytest.approx(0.15), "payload": 2.0}
    for text in ("slope", "slope=", "slope=steep", "slope=nan"):
        with pytest.raises(SimulationError, match="not of the form ID=SIZE"):
            parse_faults((text,))
    for effects, said in (
        ({"gravity": 1.0}, r"no effect 'gravity'; there are\n  wheel_radius_scale \[1\]: all wheels"),
        ({"track_width": 3.0}, r"track_width of 3 m is out of reason; it may be -0.2 to 0.2"),
        ({"payload": -1.0}, "payload of -1 kg is out of reason; it may be 0 to 30"),
        ({"rolling_resistance": -0.1}, "cannot be negative"),
    ):
        with pytest.raises(SimulationError, match=said):
            Simulation(ARC, ROBOT, 0, effects, BLIND)


def test_cg_outside_wheels_is_refused_before_and_in_the_drive():
    with pytest.raises(SimulationError, match=r"0.0 s into the drive: centre of gravity \(0.3.* would tip over"):
        Simulation(ARC, HUSKY, 0, {"cg_offset_x": 0.2, "payload": 30.0}, BLIND)
    loaded = short(Rest(1.0), PickUp(900.0), OpenLoop("arc", constant(0.4, 0.4), 2.0))
    with pytest.raises(SimulationError, match=r"s into the drive: centre of gravity .* would tip over"):
        driven(loaded, {"cg_offset_x": 0.1})
    with pytest.raises(SimulationError, match="needs a CG that robot 'vaultbot' cannot have"):
        driven(short(MoveArms(np.array([0.25, 0.0]))))


def test_route_out_of_reach_is_an_error():
    with pytest.raises(SimulationError, match="does not reach its way point"):
        driven(short(Route(np.array([[3.0, 0.0]])), world="slippery"), {"slope": 0.4}, HUSKY)  # a wet patch is steeper than it grips


def test_step_not_dividing_control_period_is_refused():
    with pytest.raises(SimulationError, match=r"step_s is 0.003 s; it must divide the control period, 0.02 s"):
        Simulation(ARC, ROBOT, 0, {}, SimulationConfig(vehicle=VehicleConfig(step_s=0.003)))


def test_seed_negative_is_refused():
    with pytest.raises(SimulationError, match="seed is -1"):
        Simulation(ARC, ROBOT, -1, {}, BLIND)


def test_route_and_turn_end_at_their_goals():
    way = short(Route(np.array([[2.0, 0.0], [2.0, 2.0]]), name="way"), TurnTo(math.pi))
    simulation, messages = driven(way)
    end = simulation.runs[-1].poses[-1]
    assert np.hypot(end[0] - 2.0, end[1] - 2.0) < 0.2
    last = [m for m in messages if m.layout.topic == "/ground_truth/odom"][-1]
    assert abs(abs(2 * math.atan2(*last.parts[1])) - math.pi) < 0.05


def test_grid_points_are_the_thesis_grid_and_reachable():
    assert sorted(map(tuple, grid_points().tolist())) == sorted(map(tuple, grid().cg.tolist()))
    simulation = Simulation(ARC, ROBOT, 0, {}, BLIND)
    for cg in (*grid_points()[::7], *(np.array(c) for c in CONFIGURATION_CGS.values())):
        simulation.reach(cg)


@pytest.mark.parametrize("name", cases(sorted(set(EXPERIMENTS) - {"controller_evaluation", "rotation_grid"}), ("laps", "preliminary")))
def test_experiment_each_is_driven_to_its_end(name):
    """The shortest form of each, by the robot with arms and by one without."""
    config = dataclasses.replace(BLIND, experiment=ExperimentConfig(laps=1, hours=0.03))
    for robot in (ROBOT, HUSKY):
        simulation = simulate(name, robot, 0, {}, config)
        assert sum(1 for _ in simulation.messages()) > 1000
        assert simulation.runs
        assert simulation.time_s > 60.0
    assert simulate(name.replace("_", "-"), ROBOT, config=config).experiment.name == name


def test_open_loop_scores_ideal_robot_are_zero_but_for_motor_lag():
    """Straight on, with the model that skids least; and a hand-made correction."""
    simulation, _ = driven(STRAIGHT)
    (score,) = score_open_loop_runs(simulation)
    assert score.drive_error_m < 0.03
    assert score.vision_error_m < 0.03
    # 0.3 m to the side, same heading: a quarter turn, 0.3 m, a quarter turn back
    reached, goal = np.array([2.0, 0.3, 0.0]), np.array([2.0, 0.0, 0.0])
    assert correction_time(reached, goal, 1.0) == pytest.approx(math.pi / 0.3 + 0.3 / 0.5)
    assert correction_time(np.array([2.1, 0.0, 0.0]), goal, 1.0) == pytest.approx(0.1 / 0.5)  # it backs up
    assert correction_time(np.array([0.1, 0.0, 0.3]), np.array([0.0, 0.0, 0.6]), 2.0) == pytest.approx(0.5)


def test_simulate_command_writes_log_and_summary(tmp_path, capsys):
    arguments = ["simulate", "laps", "--out", str(tmp_path / "laps.mcap"), "--json", str(tmp_path / "laps.json"), "--effect", "slope=0.01"]
    assert main([*arguments, "--config.experiment.laps", "1", "--seed", "3"]) == 0
    story = json.loads((tmp_path / "laps.json").read_text())
    assert story["effects"] == {"slope": 0.01}
    assert [run["name"] for run in story["runs"]] == ["lap_1"]
    assert story["runs"][0]["end_ns"] > story["runs"][0]["start_ns"] > START_NS
    assert "laps with vaultbot" in capsys.readouterr().out
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["simulate", "walk", "--out", str(tmp_path / "x.mcap")]) == 2
    assert "no experiment 'walk'; there are" in capsys.readouterr().err
    assert main(["simulate", "laps", "--out", str(tmp_path / "x.mcap"), "--effect", "magic=1"]) == 2
    assert "no effect 'magic'" in capsys.readouterr().err
    assert not (tmp_path / "x.mcap").exists()
