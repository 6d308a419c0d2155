"""The yaw of a LiDAR's mount by the direction of travel."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

from localization.calibration.lidar_check import check_lidar, corrected
from localization.evaluation.references import reference_track
from localization.evaluation.scores import score
from localization.events import ImuSample, WheelSample
from localization.log_replay import replay
from localization.logs import Log, open_log
from localization.pipeline import Trial
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases
from tests.helpers.online import ROBOT, drive_log

CASE = Path(__file__).parents[1] / "data" / "cases" / "H11-lidar-yaw-180"


def opened() -> Log:
    return open_log(CASE / "log.mcap", load_robot(CASE / "robot.toml"))


def turned(log: Log, degrees: float) -> Log:
    """``log`` with its LiDAR's mount turned by ``degrees`` from the right one."""
    right = math.pi  # of the case
    mounts = {**log.mounts, "laser": dataclasses.replace(log.mounts["laser"], yaw=right + math.radians(degrees))}
    log.__dict__["mounts"] = mounts
    return log


@pytest.mark.extended
def test_lidar_yaw_of_180_deg_is_named_and_corrected() -> None:
    """Four scans of 80 beams a second."""
    log = opened()
    found = check_lidar(log)
    assert found is not None
    assert found.mount is not None
    assert found.mount.yaw == pytest.approx(math.pi)
    assert "the yaw of 'laser' is wrong by 180 deg" in found.text
    trial = Trial(make_model("skid_steer", log.robot), "ekf")
    (run,) = replay(log.events(), [trial], log.robot, corrected(log.mounts, found), has_lidar=True)
    result = score([run], reference_track(log.references("/ground_truth/odom"), "/ground_truth/odom"))[0]
    assert result.metrics(log.duration_s, with_timing=False)["ate_rmse_m"] < 0.02
    assert all("times of their points" in warning for warning in run.warnings)


@pytest.mark.parametrize("degrees", cases([90.0, -90.0, 45.0, 30.0, 178.0], ("178.0",)))
def test_lidar_yaw_of_any_size_is_corrected(degrees: float) -> None:
    found = check_lidar(turned(opened(), degrees))
    assert found is not None
    assert found.mount is not None
    assert math.remainder(found.mount.yaw - math.pi, math.tau) == pytest.approx(0.0, abs=math.radians(2.5))


@pytest.mark.parametrize("degrees", [0.0, 10.0, -10.0])
def test_lidar_yaw_that_slides_explain_is_kept(degrees: float) -> None:
    assert check_lidar(turned(opened(), degrees)) is None


def test_lidar_yaw_of_a_healthy_drive_is_kept() -> None:
    assert check_lidar(open_log(drive_log(), ROBOT)) is None


def test_lidar_yaw_without_a_turn_names_both_causes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wheels that all count backwards look alike while the robot drives straight on."""
    log, straight = opened(), []
    for event in log.events():
        if isinstance(event, WheelSample) and abs(event.velocity[0] - event.velocity[1]) > 0.05:
            break
        if not isinstance(event, ImuSample):
            straight.append(event)
    monkeypatch.setattr(log, "events", lambda: iter(straight))
    found = check_lidar(log)
    assert found is not None
    assert found.mount is None
    assert "or all wheels count backwards" in found.text
