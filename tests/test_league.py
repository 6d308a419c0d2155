"""The league without its peers: what they are given, and the page."""

import importlib
import subprocess
import sys

import numpy as np
import pytest

from motion_models import se2
from tests.league import joined, page, tables, tuning
from tests.league.__main__ import main, run_system
from tests.league.evalio_pipelines import PIPELINES
from tests.league.logs import find_logs, peer_arrays
from tests.league.peers.exchange import Drive, matrix, peak_memory_mb, planar
from tests.league.systems import PEERS, SYSTEMS, SYSTEMS_IN_SPACE, System
from tests.studies.hills import FRONT_ENDS


def test_peer_arrays_put_walls_where_they_are(tmp_path):
    """Where MIT-CSAIL's robot turns, neighbouring scans fit better by the wheels' motion: poses, points and frames belong together."""
    drive = find_logs(None)["csail"].open().until(30.0)
    peer_arrays(drive).save(tmp_path / "drive.npz")
    arrays = Drive.load(tmp_path / "drive.npz")
    scans = list(arrays.scans())
    assert len(scans) == len(arrays.stamps_ns) == len(arrays.odometry)
    assert arrays.beams[2] == 361
    np.testing.assert_allclose(planar(matrix(arrays.odometry)), arrays.odometry, atol=1e-12)
    moved = planar(np.linalg.multi_dot(arrays.predictions()[:40]))
    np.testing.assert_allclose(moved, se2.between(arrays.odometry[0], arrays.odometry[39]), atol=1e-9)
    motions = arrays.predictions()
    turning = np.flatnonzero(np.abs(planar(motions)[:, 2]) > 0.15)
    assert len(turning) > 5
    fits = [[_distance(points, scans[i - 1]) for points in (scans[i], _moved(motions[i], scans[i]))] for i in turning]
    resting, moved = np.median(fits, axis=0)
    assert moved < 0.5 * resting


def _moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def _distance(points, others):
    """Median distance to the nearest point of ``others``."""
    return float(np.median(np.linalg.norm(points[:, None, :2] - others[None, :, :2], axis=2).min(axis=1)))


def test_log_without_reference_ends_with_what_is_missing(tmp_path):
    (tmp_path / "mine.mcap").touch()
    with pytest.raises(SystemExit, match=r"mine.toml and a reference .* must be beside it"):
        find_logs(tmp_path)


def test_page_names_the_least_error_and_what_failed(tmp_path):
    rows = [
        {"log": "a", "system": "skidloc ekf", "ate_m": 0.2, "rpe_m": 0.1, "cpu_per_s": 0.01, "memory_mb": 200.0},
        {"log": "a", "system": "<peer>", "ate_m": 0.1, "rpe_m": 0.2, "cpu_per_s": 0.01, "memory_mb": 50.0},
        {"log": "a", "system": "GenZ-ICP", "failure": "No module named 'genz_icp'"},
    ]
    page.write(rows, SYSTEMS, tmp_path)
    text = (tmp_path / "league.html").read_text()
    assert "Least error: &lt;peer&gt;, 0.100 m." in text
    assert "Ahead of every estimator of skidloc (0.200) in ATE (relations: mean error) [m]: &lt;peer&gt; 0.100." in text
    assert ") in RPE" not in text
    assert "No module named &#x27;genz_icp&#x27;" in text
    assert text.count("class=best") == 2


def test_tables_take_what_was_run_and_keep_the_rest(tmp_path):
    """A run of one peer on one log changes its cells alone, and the best peer of that log in README.md."""
    (tmp_path / "docs/lab").mkdir(parents=True)
    journal, readme = tmp_path / "docs/lab/league.md", tmp_path / "README.md"
    journal.write_text("above\n<!-- league: begin -->\n<!-- league: end -->\nbelow\n")
    readme.write_text("| best peer, by the league | | | | |\n| EKF | 1 | 2 | 3 | 4 |\n")

    def row(log, system, ate):
        return {"log": log, "system": system, "ate_m": ate, "rpe_m": 0.5, "cpu_per_s": 0.002, "memory_mb": 50.0}

    tables.write([row(log, system, ate) for log in ("fr079", "csail", "aces") for system, ate in (("A", 3.0), ("skidloc", 1.0))], tmp_path)
    tables.write([row("csail", "B", 2.0), {"log": "aces", "system": "B", "failure": "crashed"}], tmp_path)
    assert journal.read_text().startswith("above\n")
    assert journal.read_text().endswith("below\n")
    assert "| A | 3.000 / 0.500 | 3.000 / 0.500 | 3.000 / 0.500 | – | – | 2.0 | 50 |" in journal.read_text()  # noqa: RUF001
    assert "| B | – | 2.000 / 0.500 | failed | – | – | – | – |" in journal.read_text()  # noqa: RUF001
    best = "| best peer, by the league | A: 3.000 / 0.500 | B: 2.000 / 0.500 | A: 3.000 / 0.500 | |"
    assert readme.read_text() == f"{best}\n| EKF | 1 | 2 | 3 | 4 |\n"


def test_memory_of_a_process_is_its_own():
    """`getrusage` would give that of the process that started it."""
    block = np.ones(40_000_000)
    code = "from tests.league.peers.exchange import peak_memory_mb; print(peak_memory_mb())"
    child = float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert child < peak_memory_mb() - 0.5 * block.nbytes / 2**20


@pytest.mark.parametrize("system", SYSTEMS_IN_SPACE)
def test_systems_in_space_are_skidloc_front_ends_of_the_study_or_evalios(system):
    assert system.in_space == "" or system.in_space in {**FRONT_ENDS, **PIPELINES}


def test_unknown_log_ends_with_those_there_are():
    with pytest.raises(SystemExit, match="no log mars; there are fr079, csail, aces, hills-trees, hills-grass"):
        main(["--log", "mars"])


def test_robot_localization_drives_the_arc_of_its_odometry(monkeypatch):
    """A constant twist is its model's constant velocity: once that is found, the motion is that of the wheels, but for
    its steps along the heading before them (half of 0.05 s at 0.2 rad/s, over less than 5 m); the covariance grows."""
    monkeypatch.syspath_prepend(str(PEERS))
    estimate = importlib.import_module("robot_localization").estimate
    stamps = np.arange(200) * 100_000_000
    twist = np.array([0.5, 0.0, 0.2])
    poses = se2.exp(np.arange(200)[:, None] * 0.1 * twist)
    empty = np.zeros((0, 3))
    drive = Drive(stamps, empty, np.zeros(200, int), poses, np.array([0.2, 0.0, 0.3]), np.array([0.0, 0.1, 1]), 10.0)
    found, covariances = estimate(drive)
    body = se2.compose(se2.compose([0.2, 0.0, 0.3], poses), se2.inverse(np.array([0.2, 0.0, 0.3])))
    np.testing.assert_allclose(se2.between(found[100], found[-1]), se2.between(body[100], body[-1]), atol=0.5 * 0.05 * 0.2 * 5.0)
    assert covariances[-1, 0, 0] > covariances[20, 0, 0] > 0.0


def test_peer_of_finished_trajectories_joins_by_a_folder(tmp_path):
    (tmp_path / "csail.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    (system,) = joined.parse([f"mine={tmp_path}"])
    target = tmp_path / "out"
    assert not joined.take_trajectory(system, "csail", target)
    with np.load(f"{target}.npz") as arrays:
        np.testing.assert_allclose(arrays["poses"], [[0, 0, 0], [1, 0, 0]], atol=1e-12)
    assert "fr079.tum: missing" in joined.take_trajectory(system, "fr079", target)


@pytest.mark.parametrize(
    ("word", "message"), [("nothing", "give NAME=PATH"), ("a=/no/such", "no folder /no/such"), ("a=.", "no .tum file")]
)
def test_peer_that_is_none_ends_with_what_is_wrong(word, message):
    with pytest.raises(SystemExit, match=message):
        joined.parse([word])


def test_peer_that_does_not_compile_names_the_first_error(tmp_path):
    (tmp_path / "run_open_karto.cpp").write_text("int main() { return missing; }")
    with pytest.raises(SystemExit, match=r"was not built: .*missing|no g\+\+"):
        joined.build("open_karto", (tmp_path,), tmp_path)


def test_settings_of_a_large_grid_are_drawn_within_the_budget():
    grid = {"a": (1.0, 2.0, 3.0), "b": (0.0, 1.0)}
    assert len(tuning.draw(grid, 40)) == 6
    assert tuning.draw(grid, 4) == tuning.draw(grid, 4)
    assert len({tuning.name_with("x", settings) for settings in tuning.draw(grid, 4)}) == 4


def test_result_of_defaults_is_none_of_other_settings(tmp_path):
    """A peer that ran with its defaults still has to run with the settings that were tuned."""
    folder = tmp_path / "of_the_peer"
    folder.mkdir()
    system = System("mine", "", folders=(folder,), tuned={"voxel": (0.1, 0.2)})
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine.json").write_text("{}")
    assert not run_system(system, "a", tmp_path, None)
    assert "mine: no run_mine.cpp" in run_system(system, "a", tmp_path, None, {"voxel": 0.1})
