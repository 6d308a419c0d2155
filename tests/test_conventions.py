"""What users of other tools expect: ros2_controllers' odometry, REP-103's axes, a straight drive whose length is known (as FusionCore's of
60 m), and the end that robot_localization's test of its Husky bag has."""

import math

import numpy as np
import pytest

from localization.events import ImuSample, WheelSample
from localization.log_replay import replay
from localization.pipeline import Trial
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.studies import robot_localization_bag

ROBOT = load_robot("husky_a200")
PERIOD_NS = 20_000_000


def drive(rates, robot=ROBOT, gyro=None):
    """Wheel samples of rates (n, 2) [rad/s], each held for 20 ms, and a gyro with ``gyro`` (n,) [rad/s]."""
    angles = np.concatenate([np.zeros((1, 2)), np.cumsum(rates * PERIOD_NS * 1e-9, axis=0)])
    events = []
    for i, angle in enumerate(angles):
        stamp = 10**9 + i * PERIOD_NS
        events.append(WheelSample(stamp, rates[min(i, len(rates) - 1)], angle))
        if gyro is not None:
            events.append(ImuSample(stamp, np.array([0.0, 0.0, gyro[min(i, len(gyro) - 1)]]), np.array([0.0, 0.0, 9.81]), "base_link"))
    return events


def end_of(rates, estimator="odometry", gyro=None):
    trial = Trial(make_model("diff_drive", ROBOT), estimator)
    return replay(drive(rates, gyro=gyro), [trial], ROBOT, {}, False)[0].trajectory


def ros2_controllers_pose(rates, radius, separation):
    """Pose after wheel rates (n, 2) by the equations of ros2_controllers' diff_drive_controller: `Odometry::update`, `integrateExact`."""
    x = y = heading = 0.0
    for left, right in rates * radius * PERIOD_NS * 1e-9:
        linear, angular = 0.5 * (left + right), (right - left) / separation
        before = heading
        heading += angular
        if abs(angular) < 1e-6:  # second-order Runge-Kutta
            x, y = x + linear * math.cos(before + 0.5 * angular), y + linear * math.sin(before + 0.5 * angular)
        else:
            x += linear / angular * (math.sin(heading) - math.sin(before))
            y -= linear / angular * (math.cos(heading) - math.cos(before))
    return np.array([x, y, heading])


@pytest.mark.parametrize("seed", range(3))
def test_diff_drive_odometry_equals_ros2_controllers(seed):
    rng = np.random.default_rng(seed)
    rates = np.repeat(rng.uniform(-6.0, 6.0, (40, 2)), 10, axis=0)
    rates[100:150] = rates[100:150, :1]  # straight on
    model = make_model("diff_drive", ROBOT)
    turn = model.twist(np.array([-1.0, 1.0]), np.zeros(2), model.nominal).value[2]
    ahead = model.twist(np.array([1.0, 1.0]), np.zeros(2), model.nominal).value[0]
    expected = ros2_controllers_pose(rates, ahead, 2.0 * ahead / turn)
    found = end_of(rates).poses[-1]
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-9)
    assert math.remainder(found[2] - expected[2], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_odometry_axes_are_those_of_rep_103():
    """x ahead, y to the left, yaw counter-clockwise."""
    assert end_of(np.full((100, 2), 3.0)).poses[-1] == pytest.approx([3.0 * 2.0 * 0.1651, 0.0, 0.0], abs=1e-9)
    left = end_of(np.tile([1.0, 3.0], (100, 1))).poses[-1]
    assert left[1] > 0.0
    assert left[2] > 0.0


def test_ekf_drives_sixty_metres_straight():
    """A minute at 1 m/s with a noisy gyro: 60.00 m, within the position's own sigma across."""
    rng = np.random.default_rng(0)
    rates = np.full((3000, 2), 1.0 / 0.1651)
    run = end_of(rates, "ekf", rng.normal(0.0, 0.01, 3001))
    assert math.hypot(*run.poses[-1][:2]) == pytest.approx(60.0, abs=0.01)
    assert abs(run.poses[-1][1]) < 3.0 * math.sqrt(run.covariances[-1][1, 1])


def test_husky_bag_as_read_here_ends_where_robot_localization_expects():
    """Their filter of speeds and orientations, as a sum: units, axes, quaternions and times of the bag are read as they read them."""
    rows = robot_localization_bag.read()
    end = robot_localization_bag.end_by_orientations(rows["odom"], rows["imu"])
    assert math.dist(end, robot_localization_bag.EXPECTED_M) < robot_localization_bag.TOLERANCE_M
