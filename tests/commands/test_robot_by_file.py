"""Every command that takes a robot: by name, by file, and by file from another folder, with the same result."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

import pytest

from localization.cli import COMMANDS, main
from localization.estimators import ESTIMATORS
from localization.pipeline import Pipeline, Trial
from localization.ros.payloads import Load
from localization.ros.session import Files
from localization.ros.state_serialization import deserialize, serialize
from localization.simulation.experiments import EXPERIMENTS
from motion_models.registry import MODELS, make_model
from motion_models.robot_file import load_robot
from tests.helpers import bags, online
from tests.helpers.extended import cases
from tests.helpers.online import LogTransport, drive_events, drive_log, run_node
from tests.helpers.rooms import drive

pytestmark = pytest.mark.xdist_group("robot_by_file")

ARGUMENTS: dict[str, tuple[str, ...]] = {
    "info": ("{log}",),
    "replay": ("{log}", "--out", "{out}", "--model", "skid_steer", "--estimator", "odometry,ekf", "--json", "{out}.json"),
    "compare": ("{log}", "--out", "{out}.csv", "--model", "skid_steer", "--estimator", "odometry", "--processes", "1"),
    "table": ("{log}",),
    "calibrate": ("{log}", "--out", "{out}.toml"),
    "diagnose": ("{log}", "--out", "{out}", "--model", "skid_steer"),
    "weigh": ("{log}",),
    "init": ("{log}", "--like", "{robot}", "--out", "{out}.toml"),
    "check": ("{log}", "--out", "{out}", "--json", "{out}.json"),
    "robots": (),
    "cg": ("--posture", "ready"),
    "map": ("export", "{log}", "--out", "{out}.pgm"),
    "online": ("{log}", "--rate", "max", "--state", "{out}.state", "--out", "{out}.tum"),
    "simulate": ("short", "--out", "{out}.mcap"),
}
"""By command. Some are refused on so short a drive: then the messages must be equal."""
WITHOUT_ROBOT = ("init", "map", "robots", "table")
"""Commands without --robot."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_mcap(tmp_path_factory.mktemp("log") / "run.mcap", drive(5.0))


@pytest.fixture(scope="module")
def robot_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of vaultbot with its URDF and SRDF beside it, as a user has them."""
    folder = tmp_path_factory.mktemp("robots")
    for file in (resources.files("motion_models") / "robots").iterdir():
        if file.name.startswith("vaultbot"):
            (folder / file.name).write_bytes(file.read_bytes())
    return folder / "vaultbot.toml"


def result(command: str, robot: str, out: Path, log: Path, capsys: pytest.CaptureFixture[str]) -> tuple[object, ...]:
    """Exit code, messages without paths, and the names of all files that were written."""
    parts = [part.format(log=log, out=out, robot=robot) for part in ARGUMENTS[command]]
    code = main([command, *parts, *(() if command in WITHOUT_ROBOT else ("--robot", robot))])
    shown = capsys.readouterr().err.replace(str(out.parent), "FOLDER").replace(robot, "ROBOT")
    return code, shown, sorted(path.name for path in out.parent.rglob("*"))


@pytest.mark.parametrize("command", cases(ARGUMENTS, ("calibrate",)))
def test_command_with_a_robot_by_file_gives_the_same(
    command: str, log: Path, robot_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(EXPERIMENTS, "short", online.DRIVE)
    results, trajectories = [], set()
    beside, elsewhere = robot_file.parent, tmp_path / "elsewhere"
    elsewhere.mkdir()
    places = [(elsewhere, "vaultbot"), (beside, robot_file.name), (elsewhere, str(robot_file))]
    for number, (cwd, robot) in enumerate(places[-1:] if command == "compare" else places):  # its processes take seconds
        out = tmp_path / str(number) / "out"
        out.parent.mkdir()
        monkeypatch.chdir(cwd)
        results.append(result(command, robot, out, log, capsys))
        trajectories |= {(path.name, path.read_bytes()) for path in out.parent.rglob("*.tum")}
    assert all(found == results[0] for found in results)
    assert len(trajectories) == len({name for name, _ in trajectories})
    assert results[0][0] == 0 or command in ("map", "table", "weigh", "diagnose", "calibrate", "check"), results[0]


def test_arguments_cover_each_command_with_a_robot() -> None:
    """`try` runs the others; `twin` takes minutes, and has its own tests; `warm-up` has no robot."""
    assert set(ARGUMENTS) == set(COMMANDS) - {"try", "twin", "warm-up"}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_pipeline_of_a_robot_by_file_can_be_written_as_state(estimator: str, robot_file: Path) -> None:
    """Whatever the model: a state holds no path, so that it is the same wherever the robot's file is."""
    robot, (events, mounts) = load_robot(robot_file), drive_events()
    for model in MODELS:
        pipeline = Pipeline(Trial(make_model(model, robot), estimator), robot, mounts, has_lidar=True)
        for event in events[:40]:
            pipeline.process(event)
        text, blob = serialize(pipeline)
        assert str(robot_file.parent).encode() not in text
        assert isinstance(deserialize(text, blob), Pipeline)


@pytest.mark.extended
def test_live_node_of_a_robot_by_file_resumes_from_another_folder(
    robot_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = Files(state=tmp_path / "state")
    for folder, part in ((robot_file.parent, slice(0, 900)), (tmp_path, slice(900, 1500))):
        monkeypatch.setattr(online, "ROBOT", dataclasses.replace(load_robot(robot_file), folder=folder))
        transport = LogTransport(drive_log(), lambda messages, part=part: [messages[0], *messages[part]])  # type: ignore[misc]
        node, reports = run_node(transport, files=files)
        node.payloads.loads["gripper"] = Load(1.0, (0.1, 0.0, 0.0))
        node.finish()
        assert node.session.troubles == {}
    assert any("resumed from" in text for text in reports)
