"""Arms that move in a log: centres of gravity from joint states, against the chain of the URDF computed by hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from localization.events import CgSample, WheelSample
from localization.logs import TopicOverrides, inspect_log, open_log
from motion_models.center_of_gravity.files import arms_postures
from motion_models.errors import RobotError
from motion_models.robot_file import load_robot
from tests.helpers import bags, urdf_reference
from tests.helpers.bags import START, WHEELS, Record, S

ROBOT = load_robot("vaultbot")
assert ROBOT.arms is not None
POSTURES = arms_postures(ROBOT.arms)
LEFT, RIGHT = ([name for name in POSTURES["ready"] if name.startswith(side)] for side in ("left", "right"))
STEP = S // 20


def posture(i: int, n: int = 40) -> dict[str, float]:
    """Between two named postures, joint by joint."""
    a, b, f = POSTURES["stow_back"], POSTURES["ready"], i / (n - 1)
    return {name: (1 - f) * a[name] + f * b[name] for name in a}


def arm(stamp: int, names: list[str], at: dict[str, float]) -> object:
    return bags.joint_state(stamp, names, [at[name] for name in names])


def wheels(stamp: int, i: int) -> object:
    return bags.joint_state(stamp, WHEELS, [0.1 * i] * 4, [2.0] * 4)


def both(stamp: int, i: int) -> object:
    """Wheels and arms in one message, as joint_state_broadcaster writes them: in an order of its own, with a gripper among them."""
    at, names = posture(i), [*LEFT, *WHEELS, "left_gripper", *RIGHT]
    position = [0.1 * i if name in WHEELS else at.get(name, 0.01) for name in names]
    return bags.joint_state(stamp, names, position, [2.0 if name in WHEELS else 0.0 for name in names])


def cgs(log) -> list[CgSample]:
    return [event for event in log.events() if isinstance(event, CgSample)]


def expected(i: int) -> np.ndarray:
    """By another implementation of the URDF's chain: homogeneous matrices, one link at a time."""
    return urdf_reference.center_of_mass(URDF, posture(i))[0][:2]


URDF = (Path(urdf_reference.__file__).parents[2] / "motion_models" / "robots" / "vaultbot.urdf").read_text()


@pytest.mark.parametrize("format_", ["ros1", "mcap"])
def test_arm_cg_moving_joints_move_the_cg(tmp_path: Path, format_: str) -> None:
    records: list[Record] = [("/joint_states", both(START + i * STEP, i), START + i * STEP) for i in range(40)]
    log = open_log(bags.FORMATS[format_](tmp_path / "run", records), ROBOT)
    events = list(log.events())
    samples = [event for event in events if isinstance(event, CgSample)]
    assert len(samples) == 40
    for i, sample in enumerate(samples):
        assert sample.stamp_ns == START + i * STEP
        np.testing.assert_allclose(sample.position, expected(i), atol=1e-12)
        assert 1e-4 < np.sqrt(sample.covariance[0, 0]) < 1e-2
    assert samples[-1].position[0] - samples[0].position[0] > 0.07  # stow_back to ready
    rates = [event for event in events if isinstance(event, WheelSample)]
    assert [rate.stamp_ns for rate in rates] == [sample.stamp_ns for sample in samples]
    np.testing.assert_allclose([rate.position[0] for rate in rates], 0.1 * np.arange(40))
    assert log.warnings() == []
    info = inspect_log(log)
    assert info.parts["center_of_gravity"] == {"topic": "/joint_states", "kind": "joint_states", "chosen_by": "arms"}


def test_arm_cg_of_resting_joints_comes_once_a_second(tmp_path: Path) -> None:
    """Encoders' noise of 10 urad is no motion; a joint that moves by 1 mrad is."""
    names, rng = list(POSTURES["ready"]), np.random.default_rng(0)
    records: list[Record] = []
    for i in range(100):  # 5 s
        at = {name: q + 1e-5 * rng.uniform(-1.0, 1.0) + 1e-3 * (i >= 50) for name, q in posture(39).items()}
        records.append(("/joint_states", wheels(START + i * STEP, i), START + i * STEP))
        records.append(("/arms", arm(START + i * STEP, names, at), START + i * STEP))
    samples = cgs(open_log(bags.FORMATS["mcap"](tmp_path / "run", records), ROBOT))
    assert [(sample.stamp_ns - START) / S for sample in samples] == [0.0, 1.0, 2.0, 2.5, 3.5, 4.5]


def test_arm_cg_joints_of_arms_and_wheels_are_separated(tmp_path: Path) -> None:
    """Left arm on its own topic, right arm on that of the wheels and even at their stamps; CGs begin once both arms were published."""
    records: list[Record] = []
    for i in range(40):
        stamp = START + i * STEP
        records += [
            ("/joint_states", wheels(stamp, i), stamp),
            ("/joint_states", arm(stamp, RIGHT, posture(i)), stamp + 1000),
            ("/left_arm/joint_states", arm(stamp + STEP // 2, LEFT, posture(i)), stamp + STEP // 2),
        ]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT)
    events = list(log.events())
    assert sum(isinstance(event, WheelSample) for event in events) == 40
    samples = [event for event in events if isinstance(event, CgSample)]
    assert [sample.stamp_ns for sample in samples] == [START + STEP // 2 * k for k in range(1, 80)]
    for i in (0, 17, 39):
        np.testing.assert_allclose(samples[2 * i].position, expected(i), atol=1e-12)
    assert log.warnings() == []
    assert {t.topic: t.used_as for t in inspect_log(log).topics} == {"/joint_states": "wheels", "/left_arm/joint_states": "arms"}


def test_arm_cg_topic_that_repeats_another_is_left_out(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(10):
        stamp = START + i * STEP
        records += [("/joint_states", both(stamp, i), stamp), ("/left_arm/joint_states", arm(stamp, LEFT, posture(0)), stamp)]
    samples = cgs(open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT))
    np.testing.assert_allclose([s.position for s in samples], [expected(i) for i in range(10)], atol=1e-12)


def test_arm_cg_topic_with_the_cg_overrides_the_arms(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(10):
        stamp = START + i * STEP
        records += [("/joint_states", both(stamp, i), stamp), ("/center_of_gravity", bags.point_stamped(stamp, 0.05, -0.01), stamp)]
    path = bags.write_mcap(tmp_path / "run.mcap", records)
    assert {tuple(s.position) for s in cgs(open_log(path, ROBOT))} == {(0.05, -0.01)}
    assert cgs(open_log(path, ROBOT, TopicOverrides(center_of_gravity=""))) == []


def test_arm_cg_unknown_joint_names_are_reported(tmp_path: Path) -> None:
    at = {f"ur5_{name}": value for name, value in posture(0).items()}
    records: list[Record] = [("/joint_states", wheels(START + i * STEP, i), START + i * STEP) for i in range(10)]
    records += [("/arms", arm(START + i * STEP, list(at), at), START + i * STEP) for i in range(10)]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda r: r[2])), ROBOT)
    assert cgs(log) == []
    (note,) = log.warnings()
    assert "has no left_shoulder_pan_joint, " in note
    assert "does not have: ur5_left_elbow_joint, " in note
    assert "[arms] joints" in note
    assert any("has arms, but no joint states have their angles" in problem for problem in inspect_log(log).problems)


def test_arm_cg_missing_joint_delays_the_cg_until_it_is_published(tmp_path: Path) -> None:
    names = [name for name in (*LEFT, *RIGHT) if name != "left_elbow_joint"]
    records: list[Record] = []
    for i in range(10):
        stamp = START + i * STEP
        records += [("/joint_states", wheels(stamp, i), stamp), ("/joint_states", arm(stamp + 1, names, posture(i)), stamp + 1)]
    path = bags.write_mcap(tmp_path / "run.mcap", records)
    log = open_log(path, ROBOT)
    assert cgs(log) == []
    assert any("has no left_elbow_joint of the arms" in note for note in log.warnings())
    assert ROBOT.arms is not None
    told = dataclasses.replace(ROBOT, arms=dataclasses.replace(ROBOT.arms, joints=tuple(names)))
    samples = cgs(open_log(path, told))
    np.testing.assert_allclose(samples[3].position, urdf_reference.center_of_mass(URDF, {**posture(3), "left_elbow_joint": 0.0})[0][:2])


def test_arm_cg_joints_in_degrees_are_reported_as_tipping(tmp_path: Path) -> None:
    """A narrow robot: CGs of arms at impossible angles are counted and dropped."""
    narrow = dataclasses.replace(ROBOT, geometry=dataclasses.replace(ROBOT.geometry, wheelbase_m=0.1))
    records: list[Record] = [("/joint_states", both(START + i * STEP, i), START + i * STEP) for i in range(40)]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), narrow)
    samples = cgs(log)
    kept = [i for i in range(40) if abs(expected(i)[0]) < 0.05]
    assert 0 < len(samples) == len(kept) < 40
    assert any(f"{40 - len(kept)} messages with arms at which the robot would tip over" in note for note in log.warnings())


def test_arm_cg_messages_without_positions_are_ignored(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(10):
        stamp = START + i * STEP
        message = both(stamp, i) if i % 2 == 0 else bags.joint_state(stamp, [*LEFT, *WHEELS, *RIGHT], [], [2.0] * 16)
        records.append(("/joint_states", message, stamp))
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT)
    events = list(log.events())
    # rates without angles count only until angles turn: these hold the motion
    assert sum(isinstance(event, WheelSample) and bool(np.isfinite(event.position).all()) for event in events) == 5
    assert sum(isinstance(event, CgSample) for event in events) == 5


def test_arm_cg_robot_file_with_missing_urdf_is_refused(tmp_path: Path) -> None:
    robot = dataclasses.replace(ROBOT, arms=dataclasses.replace(ROBOT.arms, urdf="lost.urdf"), folder=tmp_path)
    records: list[Record] = [("/joint_states", both(START + i * STEP, i), START + i * STEP) for i in range(10)]
    with pytest.raises(RobotError, match=r"lost\.urdf"):
        open_log(bags.write_mcap(tmp_path / "run.mcap", records), robot)


def test_cg_topic_not_in_metres_is_dropped_and_reported(tmp_path: Path) -> None:
    """Half the wheelbase is 0.26 m: neither millimetres nor 0.4 m can be true."""
    places = [(0.05, -0.01), (20.0, 10.0), (0.4, 0.0), (0.0, -0.3), (1e200, 0.0), (0.06, 0.01)]
    records: list[Record] = []
    for i, place in enumerate(places):
        stamp = START + i * STEP
        records += [("/joint_states", wheels(stamp, i), stamp), ("/center_of_gravity", bags.point_stamped(stamp, *place), stamp)]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT)
    assert [tuple(s.position) for s in cgs(log)] == [places[0], places[-1]]
    (note,) = log.warnings()
    assert note.startswith("/center_of_gravity: 4 messages with a centre of gravity at which the robot would tip over")
