"""The package `skidloc`: names of both packages, and logs as objects of a notebook."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import localization
import motion_models
import skidloc
from localization.errors import EvaluationError
from motion_models.errors import SkidlocError
from tests.helpers.checkout import beginning_of
from tests.helpers.compare import logs

HUSKY = Path(__file__).parent / "data" / "husky-outdoor-gps" / "test1.bag"

pytestmark = pytest.mark.xdist_group("api")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> skidloc.RobotLog:
    return skidloc.open(beginning_of(HUSKY, 10, tmp_path_factory.mktemp("api") / "test1.bag"), "husky_a200")


@pytest.fixture(scope="module")
def runs(log: skidloc.RobotLog) -> skidloc.Runs:
    return log.replay(["diff_drive/odometry", "diff_drive/ekf"])


def test_api_has_every_public_name_of_both_packages() -> None:
    for package in (localization, motion_models):
        assert set(package.__all__) <= set(dir(skidloc))
        assert all(getattr(skidloc, name) is getattr(package, name) for name in package.__all__)
    with pytest.raises(AttributeError, match="no attribute 'replya'"):
        _ = skidloc.replya


def test_import_of_skidloc_loads_no_numerical_library() -> None:
    code = "import sys, skidloc; print([n for n in ('numpy', 'numba', 'gtsam', 'matplotlib', 'pandas') if n in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_replay_by_api_equals_the_functions_of_localization(log: skidloc.RobotLog, runs: skidloc.Runs) -> None:
    trial = skidloc.Trial(skidloc.make_model("diff_drive", log.robot), "ekf")
    (run,) = skidloc.replay(log.log.events(), [trial], log.robot, log.log.mounts, has_lidar=False)
    np.testing.assert_array_equal(runs["diff_drive/ekf"].trajectory.poses, run.trajectory.poses)
    (result,) = skidloc.score([run], skidloc.reference_track(log.log.references("/fix"), "/fix"))
    assert runs["diff_drive_ekf"].ate_m == result.accuracy.ate_rmse_m
    assert runs[1] is runs["diff_drive_ekf"]
    assert len(runs[:1]) == 1


def test_parameter_history_has_each_parameter_with_its_sigma_over_time(runs: skidloc.Runs) -> None:
    run = next(scored.result.run for scored in runs if scored.result.run.parameters)
    assert set(run.parameter_history) == set(run.parameters)
    for name, rows in run.parameter_history.items():
        assert (np.diff(rows[:, 0]) >= 2.0 - 1e-6).all()
        assert rows[-1, 2] <= rows[0, 2] * 1.5, name  # sigmas hardly grow
        assert abs(rows[-1, 1] - run.parameters[name][0]) < 3.0 * rows[-1, 2]


def test_tables_have_stamps_poses_variances_and_twists(runs: skidloc.Runs) -> None:
    run = runs["diff_drive/ekf"]
    array = run.to_numpy()
    assert array.shape == (len(run.trajectory), 10)
    np.testing.assert_array_equal(array[:, 1:4], run.trajectory.poses)
    np.testing.assert_array_equal(array[:, 4], run.trajectory.covariances[:, 0, 0])
    frame = run.to_pandas()
    np.testing.assert_array_equal(frame["wz"], run.result.run.twists[:, 2])
    np.testing.assert_array_equal(frame.index, run.trajectory.stamps_ns)
    assert np.isnan(runs["diff_drive/odometry"].to_numpy()[:, 4]).all() == (runs["diff_drive/odometry"].trajectory.covariances is None)


def test_pandas_missing_names_the_extra(runs: skidloc.Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(EvaluationError, match=r"skidloc\[pandas\]"):
        runs[0].to_pandas()


def test_representations_are_short_and_have_the_errors(log: skidloc.RobotLog, runs: skidloc.Runs) -> None:
    assert repr(log) == "<RobotLog test1.bag: husky_a200, " + repr(log).split(", ", 1)[1]
    assert f"{runs[1].ate_m:.3f}" in repr(runs)
    assert f"<td>{runs[1].ate_m:.3f}</td>" in runs._repr_html_()
    assert "ATE 1.8" in repr(runs[1])
    assert runs.plot().png.startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("pair", "text"),
    [
        ("ekf", "MODEL/ESTIMATOR"),
        ("skid/ekf", "skid_steer"),
        ("diff_drive/efk", "did you mean .ekf.. There are odometry"),
        ("diff_drive/lidar", "needs scans"),
    ],
)
def test_unknown_pair_is_refused_with_what_there_is(log: skidloc.RobotLog, pair: str, text: str) -> None:
    with pytest.raises(SkidlocError, match=text):
        log.replay([pair])


def test_unknown_reference_and_run_are_refused(log: skidloc.RobotLog, runs: skidloc.Runs) -> None:
    with pytest.raises(EvaluationError, match="neither a topic"):
        log.replay(["diff_drive/odometry"], reference="nothing.tum")
    with pytest.raises(KeyError, match="diff_drive_odometry, diff_drive_ekf"):
        runs["graph"]


def test_online_gives_the_estimates_of_a_replay(log: skidloc.RobotLog, runs: skidloc.Runs) -> None:
    online, seen = skidloc.Online("husky_a200", "diff_drive/ekf", has_lidar=False, mounts=log.log.mounts), []
    online.add_callback(seen.append)
    replayed = runs["diff_drive/ekf"].trajectory
    for event in log.events():
        online.process(event)
        if len(seen) >= 200:
            break
    assert [estimate.stamp_ns for estimate in seen] == replayed.stamps_ns[: len(seen)].tolist()
    np.testing.assert_array_equal([estimate.pose for estimate in seen], replayed.poses[: len(seen)])


def test_online_unknown_pair_is_named() -> None:
    with pytest.raises(SkidlocError, match="'skid_steer' is no pair"):
        skidloc.Online("husky_a200", "skid_steer")
    with pytest.raises(SkidlocError, match="needs"):
        skidloc.Online("husky_a200", "skid_steer/lidar", has_lidar=False)


def test_reprs_are_short(log: skidloc.RobotLog, runs: skidloc.Runs) -> None:
    run = runs["diff_drive/ekf"]
    for shown in (log, run, run.trajectory, run.result, run.result.run):
        assert len(repr(shown)) < 200
    assert "poses in" in repr(run.trajectory)
    assert run._repr_html_().startswith("<table>")


def test_analysis_prints_its_sentence_and_table() -> None:
    found = skidloc.Analysis(None, "1 of 1 quantities agree.", ({"quantity": "track", "size": 0.571234},))
    assert repr(found).splitlines() == ["1 of 1 quantities agree.", "quantity  size", "track     0.5712"]
    assert "<td>track</td>" in found._repr_html_()
    assert list(pytest.importorskip("pandas").DataFrame(found.to_pandas()).columns) == ["quantity", "size"]
    with pytest.raises(EvaluationError, match="no picture"):
        found.plot()


@pytest.mark.slow
def test_analyses_of_a_drive_are_tables_with_pictures(tmp_path_factory: pytest.TempPathFactory) -> None:
    drive = skidloc.open(logs(1)[0], "vaultbot")
    calibrated = drive.calibrate("skid_steer")
    assert {"parameter", "before", "value", "sigma"} <= set(calibrated.rows[0])
    assert calibrated.robot is not None
    assert calibrated.plot().png.startswith(b"\x89PNG")
    checked = drive.check()
    assert "quantities agree" in repr(checked)
    assert {row["verdict"] for row in checked.rows} <= {"ok", "contradiction", "cannot be seen", "note"}
    diagnosed = drive.diagnose()
    assert repr(diagnosed).startswith(diagnosed.result.verdict)
    assert diagnosed.plot().png.startswith(b"\x89PNG")
