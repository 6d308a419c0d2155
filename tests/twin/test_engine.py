"""A robot in MuJoCo: its wheels are found, its numbers read and written back, and its windows played."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.errors import SimulationError
from localization.twin.mujoco_engine import compile_robot
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.parameters import hypotheses_of
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.windows import LEAD_S, Window, windows_of
from localization.twin.xml_file import parse
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("husky_a200")
CHANGES = {
    "mu": 0.7,
    "time_constant_s": 0.05,
    "damping_ratio": 1.5,
    "softness": 0.3,
    "impratio": 4.0,
    "is_elliptic": 1.0,
    "servo_gain": 500.0,
    "rotor_inertia": 0.5,
    "mass_kg": 70.0,
    "cg_x_m": 0.04,
    "cg_y_m": -0.02,
    "cg_z_m": 0.3,
    "time_step_s": 0.001,
}


def window(left: float, right: float, seconds: float = 1.0, cg: tuple[float, float] = (0.0, 0.0)) -> Window:
    return Window(np.array([LEAD_S, seconds]), np.array([[left, right]] * 2), np.zeros(3), np.eye(3), np.array(cg), "")


def test_numbers_written_are_those_read_again() -> None:
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    new = replace(simulator.numbers, **CHANGES)
    again = read_simulator(simulator.with_numbers(new), ROBOT).numbers
    for name in CHANGES:
        assert getattr(again, name) == pytest.approx(getattr(new, name), rel=1e-4, abs=2e-4), name  # the robot stands a little tilted


def test_sizes_and_places_written_are_those_read_again() -> None:
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    old = simulator.numbers
    new = replace(old, radius_scale=1.05, track_scale=0.9, wheelbase_scale=1.2)
    again = read_simulator(simulator.with_numbers(new), ROBOT).numbers
    assert again.radius_m == pytest.approx(1.05 * old.radius_m, rel=1e-4)
    assert again.track_m == pytest.approx(0.9 * old.track_m, rel=1e-4)
    assert again.wheelbase_m == pytest.approx(1.2 * old.wheelbase_m, rel=1e-4)


def test_same_numbers_leave_the_file_as_it_is() -> None:
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    assert simulator.with_numbers(simulator.numbers).files == simulator.file.files


def test_straight_drive_goes_as_far_as_its_wheels_roll() -> None:
    engine = read_simulator(mjcf_of(ROBOT), ROBOT).engine
    played = engine.play([window(3.0, 3.0)])
    assert played.poses[0, 0] == pytest.approx(3.0 * ROBOT.geometry.wheel_radius_m, rel=0.02)
    assert abs(played.poses[0, 2]) < 0.02


def test_turn_to_the_left_is_positive_and_mirrored_to_the_right() -> None:
    engine = read_simulator(mjcf_of(ROBOT), ROBOT).engine
    left, right = engine.play([window(-2.0, 2.0), window(2.0, -2.0)]).poses
    assert left[2] > 0.1
    assert right[2] == pytest.approx(-left[2], rel=0.2)


def test_result_does_not_depend_on_threads_or_order() -> None:
    windows = [window(-2.0, 2.0), window(1.0, 3.0, 0.5), window(3.0, 3.0)]
    one = read_simulator(mjcf_of(ROBOT), ROBOT, threads=1).engine.play(windows)
    two = read_simulator(mjcf_of(ROBOT), ROBOT, threads=2).engine.play(windows[::-1])
    np.testing.assert_array_equal(one.poses, two.poses[::-1])


@pytest.mark.parametrize("axes", ["mirrored", "lengthwise"])
def test_wheels_with_other_axes_and_frames_drive_alike(axes: str) -> None:
    """Joints that turn about -y on the right, and a robot whose x axis points to its right."""
    text = mjcf_of(ROBOT).files["husky_a200.xml"].decode()
    if axes == "mirrored":
        parts = text.split("<body ")
        text = "<body ".join(p.replace('axis="0 1 0"', 'axis="0 -1 0"') if "right" in p else p for p in parts)
    else:
        g = ROBOT.geometry
        for sx in (1, -1):
            for sy in (1, -1):
                x, y = 0.5 * sx * g.wheelbase_m, 0.5 * sy * g.track_width_m
                text = text.replace(f'pos="{x:.6g} {y:.6g} ', f'pos="{-y:.6g} {x:.6g} ')
        text = text.replace('axis="0 1 0"', 'axis="-1 0 0"').replace('euler="90 0 0"', 'euler="0 90 0"')
    engine = read_simulator(parse({"r.xml": text.encode()}, Path("r.xml")), ROBOT).engine
    usual = read_simulator(mjcf_of(ROBOT), ROBOT).engine
    windows = [window(3.0, 3.0)]
    np.testing.assert_allclose(engine.play(windows).poses, usual.play(windows).poses, atol=0.02)
    assert engine.play([window(-2.0, 2.0)]).poses[0, 2] > 0.1


def test_contact_law_turns_as_the_friction_model_on_all_wheels() -> None:
    """The engine with the law against the model's own equilibrium, on turns and arcs that share no code with it."""
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    model = make_model("friction", ROBOT)
    mu, stiffness = (float(model.nominal[model.param_names.index(name)]) for name in ("mu", "slip_stiffness"))
    numbers = replace(simulator.numbers, mu=mu, slip_stiffness=stiffness, servo_gain=20.0 * simulator.numbers.servo_gain)
    windows = [window(-2.0, 2.0), window(1.0, 4.0), window(4.0, 4.0), window(-2.0, 2.0, cg=(0.05, 0.0))]
    played = simulator.compiled(numbers).play(windows)
    for w, pose, rates in zip(windows, played.poses, played.rates, strict=True):
        twist = model.twist(rates, w.cg, model.nominal).value
        assert pose[2] == pytest.approx(twist[2] * w.duration_s, rel=0.06, abs=0.01)
    assert played.touch.all_wheels > 0.95


def test_contact_law_is_read_again_with_its_ratio_and_turns_less_by_more_friction_across() -> None:
    stock = read_simulator(mjcf_of(ROBOT), ROBOT)
    numbers = replace(stock.numbers, mu=0.6, slip_stiffness=10.0, mu_ratio=1.5, servo_gain=20.0 * stock.numbers.servo_gain)
    lawful = read_simulator(stock.with_numbers(numbers), ROBOT)
    found = lawful.numbers
    assert (found.mu, found.slip_stiffness, found.mu_ratio) == pytest.approx((0.6, 10.0, 1.5))
    again = read_simulator(lawful.with_numbers(replace(found, mu_ratio=0.8)), ROBOT)
    assert again.numbers.mu_ratio == pytest.approx(0.8)
    more, less = (s.engine.play([window(-2.0, 2.0)]).poses[0, 2] for s in (lawful, again))
    assert more < 0.9 * less


def test_contact_law_holds_a_robot_that_stands() -> None:
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    played = simulator.compiled(replace(simulator.numbers, slip_stiffness=10.0)).play([window(0.0, 0.0)])
    assert np.abs(played.poses[0]).max() < 1e-3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<freejoint/>", "", "no body has a free joint"),
        ('type="hinge"', 'type="hinge" range="-1 1" limited="true"', None),
        ('name="floor" type="plane" size="0 0 1"', 'name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"', None),
        ('kv="', 'kw="', "does not load in MuJoCo"),
    ],
)
def test_file_that_cannot_be_driven_is_refused_in_one_sentence(old: str, new: str, message: str | None) -> None:
    text = mjcf_of(ROBOT).files["husky_a200.xml"].decode()
    assert old in text
    mjcf = parse({"r.xml": text.replace(old, new).encode()}, Path("r.xml"))
    if message is None:
        simulator = read_simulator(mjcf, ROBOT)
        assert simulator.engine.robot.notes or simulator.numbers.mu > 0.0
        return
    with pytest.raises(SimulationError, match=message):
        read_simulator(mjcf, ROBOT)


def test_file_without_wheels_names_the_joints_that_it_has() -> None:
    arm = '<body><joint name="arm" range="-1 1" limited="true"/><geom size=".1"/></body>'
    text = f'<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/>{arm}</body></worldbody></mujoco>'
    with pytest.raises(SimulationError, match=r"no wheels found.*arm"):
        compile_robot(parse({"r.xml": text.encode()}, Path("r.xml")), ROBOT)


def test_robot_that_falls_is_named_with_its_step() -> None:
    text = mjcf_of(ROBOT).files["husky_a200.xml"].decode()
    text = text.replace('<geom name="floor" type="plane"', '<geom name="floor" pos="0 0 -9" type="plane"')
    with pytest.raises(SimulationError, match=r"falls through the ground.*time steps"):
        read_simulator(parse({"r.xml": text.encode()}, Path("r.xml")), ROBOT)


def test_motors_are_replaced_by_servos_that_are_not_judged() -> None:
    text = mjcf_of(ROBOT).files["husky_a200.xml"].decode()
    gain = ROBOT.geometry.mass_kg * 9.81 * ROBOT.geometry.wheel_radius_m
    text = text.replace("<velocity", "<motor").replace(f' kv="{gain:.6g}"', "")
    simulator = read_simulator(parse({"r.xml": text.encode()}, Path("r.xml")), ROBOT)
    assert math.isnan(simulator.numbers.servo_gain)
    assert any("no velocity servos" in note for note in simulator.engine.robot.notes)
    played = simulator.engine.play([window(3.0, 3.0)])
    assert played.rates[0] == pytest.approx([3.0, 3.0], rel=0.03)


def test_drive_without_turns_is_refused() -> None:
    straight = Maneuver(np.full(10, 0.1), np.full((10, 2), 2.0), np.array([[0.6, 0.0, 0.0]]), np.array([10]))
    with pytest.raises(CalibrationError, match="never turn"):
        windows_of([straight], ROBOT)


def test_unequal_wheels_of_a_file_are_read_and_mended() -> None:
    stock = read_simulator(mjcf_of(ROBOT), ROBOT)
    unequal = read_simulator(stock.with_numbers(replace(stock.numbers, radius_difference=0.03)), ROBOT)
    assert unequal.numbers.radius_difference == pytest.approx(0.03, abs=1e-4)
    parameters = hypotheses_of(unequal, ROBOT)
    assert parameters.priors[parameters.index("radius_difference")] == pytest.approx(-0.03, abs=1e-4)
    mended = read_simulator(unequal.with_numbers(replace(unequal.numbers, radius_difference=0.0)), ROBOT)
    assert mended.numbers.radius_difference == pytest.approx(0.0, abs=1e-4)
    assert mended.numbers.radius_m == pytest.approx(stock.numbers.radius_m, rel=1e-5)
