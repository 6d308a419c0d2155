"""A motion model and a cause in one file each, written by the words of CONTRIBUTING, work in every command without any other change."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from localization.cli import main
from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import with_sizes
from localization.diagnosis.diagnose import examine
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import windows_text
from motion_models.registry import MODELS, make_model
from motion_models.robot_file import load_robot
from tests.helpers.law_drives import law_drive, measured_under

MODEL = '''
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from motion_models.base import ModelBase
from motion_models.motion import Twist
from motion_models.param import Free, Param, Scale


@dataclass(frozen=True)
class WideTrack(ModelBase):
    """A robot that turns as if its track were another one."""

    nominal: np.ndarray
    name: ClassVar[str] = "wide_track"
    params: ClassVar[tuple[Param, ...]] = (
        Param("way", "m", "way per radian of the wheels", Scale(0.3, wheel_radius=1), free=Free(logs=2)),
        Param(
            *("turning_track", "m", "track that the robot turns by", Scale(0.3, track_width=1), 0.5),
            relative_to="turning_track",
            free=Free(1, 1, 1, 1),
        ),
    )

    @classmethod
    def from_robot(cls, robot):
        g = robot.geometry
        return cls(robot.coefficients(cls.name, cls.param_names, np.array([g.wheel_radius_m, g.track_width_m])))

    def twist(self, wheels, cg, params):
        lead = np.broadcast_shapes(wheels.shape[:-1], cg.shape[:-1])
        wheels = np.broadcast_to(wheels, (*lead, 2))
        way, track = params
        mean, apart = wheels.mean(axis=-1), wheels[..., 1] - wheels[..., 0]
        value, d_wheels, d_params = np.zeros((*lead, 3)), np.zeros((*lead, 3, 2)), np.zeros((*lead, 3, 2))
        value[..., 0], value[..., 2] = way * mean, way * apart / track
        d_wheels[..., 0, :] = way / 2.0
        d_wheels[..., 2, 0], d_wheels[..., 2, 1] = -way / track, way / track
        d_params[..., 0, 0] = mean
        d_params[..., 2, 0], d_params[..., 2, 1] = apart / track, -way * apart / track**2
        return Twist(value, d_wheels, np.zeros((*lead, 3, 2)), d_params)

    def wheels(self, command, cg, params):
        way, track = params
        vx, wz = np.moveaxis(np.broadcast_arrays(command, cg)[0], -1, 0)
        return np.stack([vx - wz * track / 2.0, vx + wz * track / 2.0], axis=-1) / way
'''
CAUSE = """
import numpy as np

from localization.diagnosis.causes.cause import Cause, change_rates


def _faster(motion, size):
    return motion.rates * (1.0 + size * np.abs(motion.rates))


ENCODER_GROWTH = Cause(
    "encoder_growth",
    *("s/rad", "the encoders count more the faster they turn: q *= 1 + s |q|", 0.002, 0.0001, change_rates(_faster)),
    ("the encoders count less the faster they turn: q *= 1 + {} |q|", "the encoders count more the faster they turn: q *= 1 - {} |q|"),
    remedy="check the encoders at full speed",
)
"""
LOG = Path("tests/data/cases/base-log/log.mcap")
ROBOT = Path("tests/data/cases/H06-right-side-inverted/robot.toml")
_SIZE = 0.004  # s/rad: 6 % at the 15 rad/s of 0.5 m/s
TRUE_TRACK_M = 1.04
"""By calibration of `skid_steer` on this log: 0.57 m over k = 0.549."""


def _module(path: Path, text: str) -> ModuleType:
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> type[MotionModel]:
    """The model, registered by its one line."""
    found: type[MotionModel] = _module(tmp_path / "wide_track.py", MODEL).WideTrack
    monkeypatch.setitem(MODELS, "wide_track", found)
    return found


@pytest.fixture
def cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Id of the cause, registered by its one line."""
    monkeypatch.setitem(CAUSES, "encoder_growth", _module(tmp_path / "encoder_growth.py", CAUSE).ENCODER_GROWTH)
    return "encoder_growth"


@pytest.mark.usefixtures("model")
def test_replay_of_a_model_in_one_file_corrects_its_parameter(tmp_path: Path) -> None:
    """The gyro shows the track that the robot turns by, 1.04 m where its file has 0.57 m."""
    out = tmp_path / "out"
    options = ["--model", "wide_track", "--estimator", "odometry,ekf", "--out", str(out)]
    assert main(["replay", str(LOG), "--robot", str(ROBOT), *options]) == 0
    ekf = next(r for r in json.loads((out / "metrics.json").read_text())["results"] if r["estimator"] == "ekf")
    assert ekf["corrections"] == "constant"
    value, sigma = ekf["parameters"]["turning_track"]
    assert value == pytest.approx(TRUE_TRACK_M, abs=max(0.05, 3.0 * sigma))
    assert (out / "wide_track_odometry.tum").exists()


@pytest.mark.usefixtures("model")
def test_calibrate_of_a_model_in_one_file_fits_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fitted.toml"
    assert main(["calibrate", str(LOG), "--robot", str(ROBOT), "--model", "wide_track", "--out", str(out)]) == 0
    assert "track that the robot turns by" in capsys.readouterr().out
    assert load_robot(out).models["wide_track"]["turning_track"] == pytest.approx(TRUE_TRACK_M, abs=0.02)


def test_diagnose_names_a_cause_in_one_file_and_the_model_holds_it(
    model: type[MotionModel], cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive, rng = law_drive("turtlebot3_burger"), np.random.default_rng(5)
    robot = drive.robot
    drive = measured_under(drive, model.from_robot(robot), with_sizes({CAUSES[cause]: _SIZE}), rng)
    found = examine(drive, make_model("wide_track", robot)).diagnosis
    assert [f.cause for f in found.findings] == [cause]
    assert found.findings[0].size == pytest.approx(_SIZE, abs=4.0 * found.findings[0].sigma)
    table = tmp_path / "windows.csv"
    table.write_text(windows_text(drive.maneuvers))
    assert main(["diagnose", str(table), "--robot", robot.name, "--model", "wide_track"]) == 0
    printed = capsys.readouterr().out
    assert "the encoders count" in printed
