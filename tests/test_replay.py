"""`skidloc replay` from end to end: accuracy on the two real logs, the same bytes twice, and logs with faults."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.stats import chi2

from localization.cli import main
from localization.log_replay import warnings_of
from localization.messages import message
from localization.trajectory import read_tum
from tests.helpers import bags, rooms
from tests.helpers.checkout import beginning_of
from tests.helpers.extended import cases

DATA = Path(__file__).parent / "data"
ACES, RELATIONS = DATA / "aces" / "aces.mcap", DATA / "aces" / "aces.relations"
HUSKY = DATA / "husky-outdoor-gps" / "test1.bag"


def replay(log, out, *more):
    return main(["replay", str(log), "--out", str(out), *map(str, more)])


def results(out):
    metrics = json.loads((out / "metrics.json").read_text())
    return {(r["model"], r["estimator"]): r for r in metrics["results"]}, metrics


@pytest.fixture(scope="session")
def aces(tmp_path_factory):
    out = tmp_path_factory.mktemp("replay") / "aces"
    assert replay(ACES, out, "--robot", "aces", "--model", "diff_drive", "--estimator", "odometry,ekf,graph", "--reference", RELATIONS) == 0
    return out


@pytest.fixture(scope="session")
def husky(tmp_path_factory):
    out = tmp_path_factory.mktemp("replay") / "husky"
    assert replay(HUSKY, out, "--robot", "husky_a200") == 0
    return out


@pytest.mark.slow
@pytest.mark.xdist_group("aces")
def test_replay_aces_fused_error_is_below_each_part(aces):
    found, metrics = results(aces)
    odometry, ekf = found["diff_drive", "odometry"], found["diff_drive", "ekf"]
    assert odometry["relations_all_translation_m"] == pytest.approx(0.549, abs=0.01)  # as measured before this project
    assert odometry["relations_short_translation_m"] == pytest.approx(0.034, abs=0.001)
    assert ekf["relations_all_translation_m"] <= 0.085
    assert ekf["relations_short_translation_m"] <= 0.033
    assert metrics["duration_s"] == pytest.approx(1365.7, abs=0.2)
    assert 1.0 < ekf["nis_mean"] < 4.5
    # smoothed by all loops, and live by those closed so far: an offline SLAM reaches 0.043 m
    graph = found["diff_drive", "graph"]
    assert graph["relations_all_translation_m"] <= 0.043
    assert graph["relations_short_translation_m"] <= 0.033
    assert graph["relations_all_translation_m"] < graph["moments"]["relations_all_translation_m"] < ekf["relations_all_translation_m"]
    assert ekf["moments"] is None
    # no headings in relations and no GPS: numbers that these cannot give are null
    assert ekf["ate_rmse_m"] is None
    assert ekf["nees_mean"] is None
    assert odometry["nis_mean"] is None


@pytest.mark.slow
def test_replay_with_positions_that_are_the_reference_holds_every_second_one_out(tmp_path, capsys):
    out, log = tmp_path / "with_gps", beginning_of(HUSKY, 5, tmp_path / "begin.bag")
    options = ("--robot", "husky_a200", "--model", "diff_drive", "--estimator")
    assert replay(log, tmp_path / "whole", *options, "ekf") == 0
    assert replay(log, out, *options, "ekf,graph", "--positions", "/fix") == 0
    found, metrics = results(out)
    whole, _ = results(tmp_path / "whole")
    n = whole["diff_drive", "ekf"]["n_matched"]
    assert found["diff_drive", "graph"]["counts"]["positions"] == pytest.approx(n // 2, abs=2)
    assert found["diff_drive", "graph"]["ate_rmse_m"] < 0.9 * found["diff_drive", "ekf"]["ate_rmse_m"]
    assert found["diff_drive", "ekf"]["ate_rmse_m"] == pytest.approx(whole["diff_drive", "ekf"]["ate_rmse_m"], abs=0.02)
    (note,) = (note for note in metrics["notes"] if "every second position is fused" in note)
    assert note.startswith("/fix is fused and the reference")
    assert "every second position is fused" in capsys.readouterr().out


@pytest.mark.extended
@pytest.mark.xdist_group("husky")
def test_replay_husky_with_gyro_error_is_below_its_odometry(husky):
    found, _ = results(husky)
    assert set(found) == {(m, e) for m in ("diff_drive", "skid_steer") for e in ("odometry", "ekf")}  # no LiDAR there
    assert found["diff_drive", "odometry"]["ate_rmse_m"] == pytest.approx(6.99, abs=0.01)
    for model in ("diff_drive", "skid_steer"):
        assert found[model, "ekf"]["ate_rmse_m"] <= 0.45 * found["diff_drive", "odometry"]["ate_rmse_m"]  # a plain gyro: 3.05 m
        assert found[model, "ekf"]["end_error_m"] <= 7.0
        # the gyro measures the wheels' clock: early by about a tenth of a second, as the diagnosis finds (118 +- 6 ms)
        offset, sigma = found[model, "ekf"]["parameters"]["wheel_clock_offset_s"]
        assert -0.13 < offset < -0.07
        assert sigma < 0.03
        assert found[model, "ekf"]["parameters"]["gyro_bias_rad_per_s"][1] > 0.0
        # as a node publishes it: without the corrections of a late gyro bias
        published = found[model, "ekf"]["moments"]
        assert found[model, "ekf"]["ate_rmse_m"] < published["ate_rmse_m"] <= 0.5 * found["diff_drive", "odometry"]["ate_rmse_m"]
        assert published["distance_m"] == pytest.approx(358.0, abs=4.0)  # by GPS; of the corrected poses 380


def test_warnings_of_runs_name_all_trials_that_have_them():
    def run(estimator, *warnings):
        return SimpleNamespace(estimator=estimator, model="icr", warnings=[*warnings])

    lost, slip = message("saved_map.never"), message("stopped_gyro.repeats").at(2.0)
    late = message("scans.late", scans="2 scans").of("graph (icr)")
    runs = [run("odometry"), run("ekf", lost.of("ekf (icr)"), slip), run("graph", slip, lost.of("graph (icr)"), late)]
    assert warnings_of(runs) == [lost.of("ekf (icr), graph (icr)"), slip, late]


def test_fault_of_several_runs_whose_numbers_differ_is_given_once():
    """Numbers of the checks depend on the estimate."""

    def differ(metres, at_s=302.2):
        numbers = {"sigmas": 3.2, "difference": metres, "window": 10.0, "use": "The scans decide.", "cause": "Wheels spin."}
        return message("sensor_pairs.ways_of_lidar_and_wheels", **numbers).at(at_s)

    runs = [
        SimpleNamespace(estimator=name, model="icr", warnings=[differ(metres), differ(metres, 7.0)])
        for name, metres in (("ekf", 6.24), ("graph", 6.25))
    ]
    assert warnings_of(runs) == [differ(6.24), differ(6.24, 7.0)]


@pytest.mark.rendered
def test_replay_twice_gives_the_same_bytes(tmp_path):
    """By all estimators in a room; digests of the estimates of real logs are printed by `tests.studies.fingerprints`."""
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(3.0))
    one, two = tmp_path / "one", tmp_path / "two"
    options = ("--robot", "vaultbot", "--model", "diff_drive", "--estimator", "odometry,lidar,ekf,graph")
    assert replay(log, one, *options) == replay(log, two, *options) == 0
    names = sorted(path.name for path in one.iterdir())
    assert {"metrics.json", "report.html", "fused.mcap", "diff_drive_ekf.tum"} <= set(names)
    assert names == sorted(path.name for path in two.iterdir())
    assert [name for name in names if (one / name).read_bytes() != (two / name).read_bytes()] == []


@pytest.fixture(scope="module")
def mcap_replay(tmp_path_factory):
    folder = tmp_path_factory.mktemp("formats")
    log = bags.FORMATS["mcap"](folder / "log", rooms.drive(4.0))
    assert replay(log, folder / "out", "--robot", "vaultbot", "--estimator", "ekf") == 0
    return folder / "out"


@pytest.mark.xdist_group("formats")
def test_fused_log_is_readable_by_two_independent_readers(mcap_replay):
    with AnyReader([mcap_replay / "fused.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        topics = {c.topic: c.msgcount for c in reader.connections}
    assert topics["/skid_steer_ekf/odometry"] == topics["/tf"] == len(read_tum(mcap_replay / "skid_steer_ekf.tum"))
    assert "/diff_drive_ekf/odometry" in topics
    with (mcap_replay / "fused.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        message = next(m for _, c, _, m in reader.iter_decoded_messages(topics=["/skid_steer_ekf/odometry"]))
    assert message.header.frame_id == "odom"
    assert message.pose.covariance[0] >= 0.0


@pytest.mark.xdist_group("formats")
@pytest.mark.parametrize("form", ["ros1", "sqlite3", "mcap-folder"])
def test_replay_every_format_gives_the_same_estimate(form, tmp_path, mcap_replay):
    log = bags.FORMATS[form](tmp_path / "log", rooms.drive(4.0))
    assert replay(log, tmp_path / "out", "--robot", "vaultbot", "--model", "diff_drive", "--estimator", "ekf") == 0
    found, _ = results(tmp_path / "out")
    assert found["diff_drive", "ekf"]["ate_rmse_m"] < 0.01
    name = "diff_drive_ekf.tum"
    assert (tmp_path / "out" / name).read_bytes() == (mcap_replay / name).read_bytes()


@pytest.mark.extended
def test_replay_wheel_corrections_converge_to_the_slip(tmp_path):
    """The wheels turn 1.5 times as much as the robot; vaultbot's file has 1.875."""
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(30.0, multiplier=1.5))
    assert replay(log, tmp_path / "out", "--robot", "vaultbot", "--model", "diff_drive", "--estimator", "odometry,ekf") == 0
    found, _ = results(tmp_path / "out")
    ekf = found["diff_drive", "ekf"]
    mean, sigma = ekf["parameters"]["wheel_separation_multiplier"]
    assert abs(mean - 1.5) < 3.0 * sigma
    assert sigma < 0.1
    assert ekf["ate_rmse_m"] < 0.1 * found["diff_drive", "odometry"]["ate_rmse_m"]
    assert ekf["nees_mean"] < chi2.ppf(0.99, 3)  # errors along one run are one sample: the map that was drawn first stays


def spoiled(kind):
    """Faults of scans, by name."""

    def spoil(number, scan, log_ns):
        stamp = scan.header.stamp
        if kind == "nan" and number % 3 == 0:
            scan.ranges[::2] = np.nan
            scan.ranges[1::4] = np.inf
        elif kind == "all nan" and number % 4 == 1:
            scan.ranges[:] = np.nan
        elif kind == "empty" and number % 5 == 2:
            return bags.laser_scan(log_ns, np.empty(0), frame_id="base_link"), log_ns
        elif kind == "backwards" and number == 20:
            stamp.sec -= 3
        elif kind == "jump" and number == 20:
            stamp.sec += 7200
        elif kind == "repeated" and number % 10 == 3:
            stamp.nanosec, stamp.sec = (log_ns - bags.S // 10) % bags.S, (log_ns - bags.S // 10) // bags.S
        elif kind == "frame" and number > 15:
            scan.header.frame_id = "nobody_knows"
        elif kind == "vanishes" and 15 < number < 35:
            return None
        return scan, log_ns

    return spoil


@pytest.mark.parametrize(
    "kind",
    cases(["nan", "all nan", "empty", "backwards", "jump", "repeated", "vanishes", "frame"], ("all nan", "vanishes")),
)
def test_replay_bad_scans_are_skipped(kind, tmp_path, capsys):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(5.0, multiplier=1.875, spoil=spoiled(kind)))
    assert replay(log, tmp_path / "out", "--robot", "vaultbot", "--model", "diff_drive", "--estimator", "lidar,ekf") == 0
    found, _ = results(tmp_path / "out")
    assert found["diff_drive", "ekf"]["ate_rmse_m"] < 0.05
    assert np.isfinite(read_tum(tmp_path / "out" / "diff_drive_lidar.tum").poses).all()
    warnings = {
        "backwards": "/scan",
        "jump": "/scan",
        "repeated": "/scan",
        "empty": "without a usable point",
        "all nan": "without a usable point",
        "frame": "34 scans of it were not used",
    }
    assert warnings.get(kind, "") in capsys.readouterr().out


def test_replay_truncated_bag_ends_at_the_cut(tmp_path, capsys):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(9.0))
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    assert replay(log, tmp_path / "out", "--robot", "vaultbot", "--model", "diff_drive", "--estimator", "ekf") == 0
    trajectory = read_tum(tmp_path / "out" / "diff_drive_ekf.tum")
    assert 2.0 < trajectory.duration_s < 8.5
    assert "(its end is missing)" in capsys.readouterr().out
    assert "(its end is missing)" in " ".join(json.loads((tmp_path / "out" / "metrics.json").read_text())["notes"])


def no_such_file(tmp_path):
    return [str(tmp_path / "nothing.bag"), "--robot", "vaultbot"], "nothing.bag"


def not_a_bag(tmp_path):
    (tmp_path / "text.bag").write_text("hello" * 100)
    return [str(tmp_path / "text.bag"), "--robot", "vaultbot"], "text.bag"


def no_such_topic(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "vaultbot", "--topic.scan", "/front/scan"], "/scan"


def unknown_joints(tmp_path):
    records = [
        ("/joint_states", bags.joint_state(bags.START + i * bags.S, ("a", "b"), (0.0, 0.0)), bags.START + i * bags.S) for i in range(9)
    ]
    return [str(bags.write_mcap(tmp_path / "log.mcap", records)), "--robot", "vaultbot"], "front_left_wheel"


def one_message(tmp_path):
    return [str(bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0)[:1])), "--robot", "vaultbot"], "one message"


def other_times(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    (tmp_path / "ref.tum").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(9)))
    return [str(log), "--robot", "vaultbot", "--reference", str(tmp_path / "ref.tum")], "ref.tum"


def no_such_reference(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "vaultbot", "--reference", "/mocap/pose"], "/ground_truth/odom"


def no_such_model(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "vaultbot", "--model", "ackermann"], "skid_steer"


def no_such_estimator(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "vaultbot", "--estimator", "ukf"], "ekf"


def no_pair(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "vaultbot", "--pairs", "diff_drive/odometry,skid_steer"], "a pair is MODEL/ESTIMATOR"


def no_such_robot(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    return [str(log), "--robot", "r2d2"], "husky_a200"


def no_lidar(tmp_path):
    records = [record for record in rooms.drive(2.0) if record[0] != "/scan"]
    return [str(bags.write_mcap(tmp_path / "log.mcap", records)), "--robot", "vaultbot", "--estimator", "lidar"], "scans"


def nothing_asked(option):
    def case(tmp_path):
        return [str(bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))), "--robot", "vaultbot", option, " ,"], f"{option} is ' ,'"

    return case


def a_setting_of_no_use(tmp_path):
    return [
        str(tmp_path),
        "--robot",
        "vaultbot",
        "--config.estimator.graph.keyframe-distance-m",
        "0",
    ], "keyframe_distance_m of GraphConfig is 0; it"


@pytest.mark.parametrize(
    "case",
    [
        *(no_such_file, not_a_bag, no_such_topic, unknown_joints, one_message, other_times, no_such_reference),
        *(no_such_model, no_such_estimator, no_such_robot, no_pair, no_lidar, a_setting_of_no_use),
        *(nothing_asked(option) for option in ("--model", "--estimator", "--pairs", "--corrections")),
    ],
)
def test_replay_bad_input_is_refused_and_no_file_written(case, tmp_path, capsys):
    arguments, hint = case(tmp_path)
    assert main(["replay", *arguments, "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("skidloc: ")
    assert hint in printed
    assert not (tmp_path / "out").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.extended
def test_replay_of_pairs_runs_these_alone_as_in_the_whole_table(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(4.0))
    of_pairs = ("--pairs", "skid_steer/lidar,diff_drive/odometry,skid_steer/ekf")
    of_all = ("--model", "diff_drive,skid_steer", "--estimator", "odometry,lidar,ekf")
    found = []
    for name, options in (("pairs", of_pairs), ("all", of_all)):
        assert replay(log, tmp_path / name, "--robot", "vaultbot", *options) == 0
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        found.append({(r["model"], r["estimator"]): r for r in metrics["results"]})
    assert sorted(found[0]) == [("diff_drive", "odometry"), ("skid_steer", "ekf"), ("skid_steer", "lidar")]
    assert all(found[1][pair] == result for pair, result in found[0].items())


def test_replay_existing_output_is_refused(tmp_path, capsys):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(2.0))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").write_text("1")
    assert replay(log, tmp_path / "out", "--robot", "vaultbot") == 2
    assert "exists" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["precious"]


def test_replay_without_reference_has_null_scores(tmp_path):
    log = bags.write_mcap(tmp_path / "log.mcap", rooms.drive(3.0))
    assert replay(log, tmp_path / "out", "--robot", "vaultbot", "--model", "diff_drive", "--reference", "none") == 0
    found, metrics = results(tmp_path / "out")
    assert metrics["distance_m"] > 0.5
    for result in found.values():
        assert result["ate_rmse_m"] is None
        assert result["end_error_m"] is None
        assert result["real_time_factor"] is None
    assert not any(isinstance(v, float) and not math.isfinite(v) for r in found.values() for v in r.values())
