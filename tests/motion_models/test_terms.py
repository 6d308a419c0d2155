"""Learned terms: their grammar, units and files, and the places that use them as parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from localization.calibration.robot_notes import robot_notes
from localization.events import WheelSample
from localization.inputs.wheel_motion import WheelMotion
from motion_models import se2
from motion_models.calibration.fit import FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import RobotError
from motion_models.extended_model import ExtendedModel, in_series
from motion_models.online_calibration import add_correction_parameters, make_corrections
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import Robot, WheelNoise
from motion_models.robot_file import load_robot, parse_robot, robot_toml
from motion_models.term_memory import SampleSeries, respond
from motion_models.terms import Term, parse_expression
from tests.helpers.synthetic_steps import Noise, squared_errors

HUSKY = load_robot("husky_a200")
CG = np.zeros(2)


def husky(entry: str, model: str = "diff_drive") -> Robot:
    """A Husky with one line in its table of terms."""
    return parse_robot(f"{robot_toml(HUSKY)}\n[models.{model}.terms]\n{entry}\n", "husky.toml")


@pytest.mark.parametrize(
    ("component", "text", "written", "unit", "is_symmetric"),
    [
        ("vy", "abs(wz) * wz", "wz*abs(wz)", "m s", True),
        ("vx", "v**2", "v^2", "s/m", True),
        ("vx", "v*v", "v^2", "s/m", True),
        ("vx", "dv", "dv", "s", True),
        ("wz", "sign(v)*wz", "sign(v)*wz", "1", True),
        ("wz", "v", "v", "1/m", False),
        ("vy", "v*cg_y", "v*cg_y", "1/m", True),
        ("vx", "left", "left", "m", False),
        ("wz", "t*wz", "wz*t", "1/s", True),
        ("vx", "rise(t, 20.0)*v", "v*rise(t,20)", "1", True),
        ("vx", "v*rise(t,1.2e+02)", "v*rise(t,120)", "1", True),
        ("wz", "max( wz, 0 )", "max(wz,0)", "1", False),
        ("vx", "abs(wz)*min(v,0)", "min(v,0)*abs(wz)", "s", True),
        ("wz", "lag(wz, 0.40)", "lag(wz,0.4)", "1", True),
        ("vx", "swing(v,0.8,0.2)", "swing(v,0.8,0.2)", "1", True),
        ("vy", "play(wz,0.1)*abs(v)", "abs(v)*play(wz,0.1)", "s", True),
    ],
)
def test_expression_is_written_in_one_way_with_its_unit(component: str, text: str, written: str, unit: str, is_symmetric: bool) -> None:
    term = Term(component, parse_expression(text), 1.0)
    assert (str(term.expression), term.unit, term.is_symmetric) == (written, unit, is_symmetric)
    assert parse_expression(written) == term.expression


@pytest.mark.parametrize(("text", "python", "slope"), [("max(wz,0)", max, 1.0), ("min(wz,0)", min, 0.0)])
def test_one_sided_term_acts_on_its_side_alone(text: str, python: Callable[[float, float], float], slope: float) -> None:
    rates = np.array([0.4, -0.3])
    value, slopes = parse_expression(text).evaluate({"wz": rates})
    assert value.tolist() == [python(rate, 0.0) for rate in rates]
    assert slopes["wz"].tolist() == [slope, 1.0 - slope]


def test_term_value_is_that_of_python() -> None:
    v, wz, cg_y = 0.7, -0.4, 0.02
    values = {name: np.array([x]) for name, x in {"v": v, "wz": wz, "cg_y": cg_y}.items()}
    value, slopes = parse_expression("v^2*abs(wz)*cg_y").evaluate(values)
    assert value[0] == pytest.approx(v**2 * abs(wz) * cg_y)
    assert {name: s[0] for name, s in slopes.items()} == pytest.approx(
        {"v": 2 * v * abs(wz) * cg_y, "wz": v**2 * np.sign(wz) * cg_y, "cg_y": v**2 * abs(wz)}
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('vz = {"wz" = 1}', "unknown component 'vz' .did you mean wz"),
        ('vy = {"wzz" = 1}', "unknown variable 'wzz' in 'wzz' .did you mean wz"),
        ('vy = {"cg_x" = 1}', "would move a robot that stands"),
        ('vy = {"wz + v" = 1}', "cannot read"),
        ('vy = {"__import__(os)" = 1}', "cannot read"),
        ('vy = {"wz^9" = 1}', "power 9 of wz"),
        ('vx = {"v*rise(v,20)" = 1}', "a rise is of t, with a time constant of 0.1 to 100000 s"),
        ('vx = {"v*rise(t,0)" = 1}', "a rise is of t"),
        ('vx = {"lag(cg_x,0.5)" = 1}', "a lag is of a motion"),
        ('vx = {"swing(v,0.5)" = 1}', "a frequency of 0.05 to 5 Hz and a damping ratio of 0.02 to 0.95, as swing.v,0.8,0.2."),
        ('vx = {"lag(v,nan)" = 1}', "cannot read lag"),
        ('vy = {"wz" = [1, -1]}', "sigma not below 0"),
        ('vy = {"wz" = [nan, 1]}', "must be value"),
        ('vy = {"wz" = [1, 1, "m/s"]}', "the unit of 'wz' is 'm', found 'm/s'"),
        ('vy = {"wz*v" = 1, "v*wz" = 2}', "stands there twice"),
        ("vy = 3", "must be a table"),
    ],
)
def test_parse_robot_with_a_wrong_term_names_what_is_meant(entry: str, message: str) -> None:
    with pytest.raises(RobotError, match=message) as error:
        husky(entry)
    assert "husky.toml, [models.diff_drive.terms]" in str(error.value)


def test_robot_toml_with_terms_is_read_as_it_was_written() -> None:
    robot = husky('vy = {"wz*abs(wz)" = [-0.12, 0.01, "m s"]}\nvx = {"v*abs(v)" = 0.1}', "skid_steer")
    assert parse_robot(robot_toml(robot), "again.toml") == robot
    assert [t.name for t in robot.terms["skid_steer"]] == ["vx[v*abs(v)]", "vy[wz*abs(wz)]"]


def test_terms_of_another_model_are_said() -> None:
    robot = husky('vy = {"wz" = 0.1}', "icr")
    assert "are of icr, and skid_steer runs without them" in robot_notes(robot)[0]
    assert not any("terms" in note for note in robot_notes(robot, ["icr", "skid_steer"]))
    assert type(make_model("skid_steer", robot)).__name__ == "SkidSteer"


def test_acceleration_term_moves_by_the_change_of_speed() -> None:
    """The integral of c dv/dt is c times the change of speed, however it is sampled."""
    model = make_model("diff_drive", husky('vx = {"dv" = 0.2}'))
    plain = make_model("diff_drive", HUSKY)
    rates = np.array([[1.0, 1.0], [2.0, 2.0], [5.0, 5.0], [4.0, 4.0]])
    dt = np.array([0.1, 0.3, 0.2, 0.1])
    series = SampleSeries(np.r_[0.0, dt[1:]], np.zeros(4))
    moved = preintegrate(in_series(model, series), dt, rates, CG, model.nominal, WheelNoise()).delta
    alone = preintegrate(plain, dt, rates, CG, plain.nominal, WheelNoise()).delta
    assert moved[0] - alone[0] == pytest.approx(0.2 * 3.0 * HUSKY.geometry.wheel_radius_m)
    assert in_series(plain, series) is plain


_STEP_S = 0.02


def stepped(seconds: float = 12.0) -> tuple[np.ndarray, SampleSeries]:
    """0 for a second, then 1."""
    t = np.arange(0.0, seconds, _STEP_S)
    return np.where(t >= 1.0, 1.0, 0.0), SampleSeries(np.full(len(t), _STEP_S), t)


def test_lag_follows_a_step_exponentially() -> None:
    x, series = stepped()
    middle = series.t + 0.5 * _STEP_S - 1.0
    expected = np.where(middle > 0.0, 1.0 - np.exp(-np.maximum(middle, 0.0) / 0.5), 0.0)
    np.testing.assert_allclose(respond("lag", (0.5,), x, series), expected, atol=1e-12)


def test_swing_overshoots_a_step_by_its_damping_and_fades() -> None:
    x, series = stepped()
    found = respond("swing", (0.6, 0.2), x, series)
    assert found.max() == pytest.approx(np.exp(-np.pi * 0.2 / np.sqrt(1.0 - 0.2**2)), abs=1e-3)
    assert abs(found[-1]) < 1e-3


def test_play_stays_behind_by_its_width_and_keeps_its_side() -> None:
    x = np.array([0.0, 0.2, 0.5, 0.4, 0.2, -0.2])
    found = respond("play", (0.3,), x, SampleSeries(np.full(6, 0.1), 0.1 * np.arange(6)))
    np.testing.assert_allclose(found, [0.0, 0.0, 0.2, 0.2, 0.2, 0.1])


@pytest.mark.parametrize(("form", "constants"), [("lag", (0.5,)), ("swing", (0.6, 0.2))])
def test_memory_of_windows_that_overlap_is_that_of_the_drive(form: str, constants: tuple[float, ...]) -> None:
    x, series = stepped()
    cut = np.r_[0:200, 180:400, 390:600]  # each window with samples before it
    found = respond(form, constants, x[cut], SampleSeries(series.dt[cut], series.t[cut]))
    np.testing.assert_allclose(found, respond(form, constants, x, series)[cut], atol=1e-12)


def test_memory_of_a_window_without_a_time_begins_at_rest_there() -> None:
    x, t = np.array([1.0, 1.0, 2.0, 2.0]), np.array([0.0, 0.1, 0.0, 0.1])
    np.testing.assert_allclose(respond("lag", (0.5,), x, SampleSeries(np.full(4, 0.1), t)), x)


def test_memory_is_the_same_in_steps_of_the_filter_and_in_one_prediction() -> None:
    """Odometry, EKF and graph integrate from scan to scan, a diagnosis a whole window."""
    robot = husky('wz = {"lag(wz,0.4)" = 0.2}\nvx = {"swing(v,0.8,0.3)" = -0.3}')
    model = make_model("diff_drive", robot)
    wheels, whole = WheelMotion(model, robot, 0.5, np.ones(3), has_slopes=False), np.zeros(3)
    rates = np.array([[4.0 * np.sin(0.5 * i * 0.05), 3.0 if i > 30 else 0.0] for i in range(140)])
    for i, rate in enumerate(np.vstack([rates[:1], rates])):
        wheels.buffer.insert(WheelSample(round(i * 5e7), rate, np.full(2, np.nan)))
    held = wheels.buffer.window(0, round(7e9), 0.5)
    for start in range(7):
        window = wheels.buffer.window(round(start * 1e9), round((start + 1) * 1e9), 0.5)
        whole = se2.compose(whole, wheels.integrate(round(start * 1e9), window, None)[0].delta)
    series = SampleSeries(held.dt, np.cumsum(held.dt) - held.dt)
    at_once = preintegrate(in_series(model, series), held.dt, held.rates, held.cg, model.nominal, WheelNoise()).delta
    without = make_model("diff_drive", HUSKY)
    plain = preintegrate(without, held.dt, held.rates, held.cg, without.nominal, WheelNoise()).delta
    np.testing.assert_allclose(whole, at_once, atol=1e-9)
    assert np.abs(whole - plain).max() > 0.05


def test_fit_recovers_a_term_with_its_sigma() -> None:
    rng = np.random.default_rng(3)
    model = make_model("diff_drive", husky('vy = {"wz*abs(wz)" = [0.0, 0.5]}\nvx = {"v*t" = [0.0, 0.1]}'))
    true = model.nominal + np.array([*(0.0,) * (len(model.nominal) - 2), 0.002, -0.12])
    noise, n, maneuvers = 2e-3, 20, []
    for i in range(40):
        rates, start = np.tile(rng.uniform(-4.0, 4.0, 2), (n, 1)), 2.0 * i
        series = SampleSeries(np.full(n, 0.1), start + 0.1 * np.arange(n))
        delta = preintegrate(in_series(model, series), np.full(n, 0.1), rates, CG, true, WheelNoise()).delta
        measured = (delta + noise * rng.normal(size=3))[None]
        maneuvers.append(Maneuver(np.full(n, 0.1), rates, measured, np.array([n]), CG, noise**2 * np.eye(3), str(i), start_s=start))
    quiet = WheelNoise(**dict.fromkeys(WheelNoise.__dataclass_fields__, 0.0))
    found = fit(model, maneuvers, ("vx[v*t]", "vy[wz*abs(wz)]"), FitConfig(noise=quiet))
    np.testing.assert_allclose(found.values, [0.002, -0.12], atol=4.0 * max(found.sigmas.values()))
    written = found.robot(husky('vy = {"wz*abs(wz)" = [0.0, 0.5]}\nvx = {"v*t" = [0.0, 0.1]}')).terms["diff_drive"]
    assert [t.value for t in written] == list(found.values)
    assert [t.sigma for t in written] == pytest.approx(list(found.sigmas.values()))


@pytest.mark.parametrize(("model", "form"), [("diff_drive", "constant"), ("skid_steer", "cg_field"), ("friction", "constant")])
def test_corrections_hold_the_terms_that_have_a_sigma(model: str, form: str) -> None:
    made = add_correction_parameters(make_model(model, husky('vy = {"wz*abs(wz)" = [-0.1, 0.05], "v*wz" = 0.1}', model)), form)
    found = make_corrections(made, form)
    at = found.names.index("vy[wz*abs(wz)]")
    assert found.sigmas[at] == pytest.approx(0.05)
    np.testing.assert_array_equal(np.flatnonzero(found.directions[:, at]), [made.param_names.index("vy[wz*abs(wz)]")])


@pytest.mark.extended
def test_ekf_estimates_terms_with_an_honest_covariance() -> None:
    """True coefficients are drawn from the file's sigmas; the filter corrects them beside all else, with a consistent covariance."""
    robot = husky('vy = {"wz*abs(wz)" = [-0.1, 0.05]}\nwz = {"v*abs(v)" = [0.0, 0.05]}')
    model = make_model("diff_drive", robot)
    assert isinstance(model, ExtendedModel)
    nees, inside = [], []
    for seed in range(12):
        squared, within, counts = squared_errors(seed, 120, Noise(), model)
        nees.append(squared[1] / counts[1])
        inside.append(within[-2:])
    assert 0.5 < np.mean(nees) < 1.6  # 12 runs of 7 numbers: 1 +- .15, and correlated walks
    assert np.mean(inside) > 0.7  # of 90 %; 24 numbers


@pytest.mark.parametrize(("written", "meant"), [("omega", "wz"), ("speed", "v"), ("w", "wz"), ("yaw_rate", "wz"), ("acceleration", "dv")])
def test_parse_expression_other_name_of_a_variable_names_ours(written: str, meant: str) -> None:
    with pytest.raises(RobotError, match=rf"unknown variable '{written}'.*did you mean {meant}\?"):
        parse_expression(f"{written}*abs({written})")
