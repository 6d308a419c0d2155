"""Claims of calibration: exact derivatives, recovery with honest sigmas, robustness, and saying what a drive does not reveal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest

from localization.calibration import calibrate
from localization.calibration.calibrate import describe_clocks, estimate_clocks
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.cross_validation import cross_validate, root_mean, root_mean_gain
from motion_models.calibration.fit import FitConfig, fit
from motion_models.calibration.identifiability import candidates
from motion_models.calibration.maneuvers import Maneuver, make_batch
from motion_models.calibration.prediction import REFERENCE_PARAM_NAMES, predict
from motion_models.errors import CalibrationError
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers.extended import cases

ROBOT = load_robot("vaultbot")
NOISE = 1e-3
WHEEL_FREE = {
    "diff_drive": ("wheel_radius", "wheel_separation_multiplier"),
    "friction": ("wheel_radius", "mu_ratio", "tracked_x"),
    "skid_steer": ("k_0", "x_cr_0", "y_cr_0"),
    "icr": ("y_icr_left", "y_icr_right", "x_icr", "alpha_left", "alpha_right"),
    "full_linear": ("vx_left", "vx_right", "vy_left", "vy_right", "wz_left", "wz_right", "longitudinal_slip_curvature"),
}


def drive(
    model: MotionModel,
    params: FloatArray,
    rng: np.random.Generator,
    count: int = 40,
    noise: float = NOISE,
    groups: int | None = None,
    wheels: Sequence[FloatArray] | None = None,
) -> list[Maneuver]:
    """Two-second maneuvers with random steady rates and a swing on top, measured with white noise."""
    n, h = 40, 0.05
    swing = np.sin(np.arange(n) * h * 2.0)[:, None] * [1.0, -0.6]
    found = []
    for i in range(count):
        rates = rng.uniform(-4.0, 4.0, 2) + swing if wheels is None else wheels[i]
        cg = np.array([0.02, -0.01])
        true = preintegrate(model, np.full(n, h), rates, cg, params, WheelNoise()).delta
        measured = se2.compose(true, se2.exp(noise * rng.normal(size=3)))
        name = str(i if groups is None else i % groups)
        found.append(Maneuver(np.full(n, h), rates, measured[None], np.array([n]), cg, noise**2 * np.eye(3), name))
    return found


QUIET = WheelNoise(**dict.fromkeys(WheelNoise.__dataclass_fields__, 0.0))


@pytest.mark.parametrize("name", sorted(WHEEL_FREE))
def test_predict_is_preintegration_with_exact_derivatives(name: str) -> None:
    rng = np.random.default_rng(1)
    model = make_model(name, ROBOT)
    params = model.nominal * (1.0 + 0.1 * rng.normal(size=len(model.nominal))) + 0.01 * rng.normal(size=len(model.nominal))
    maneuvers = []
    for lead in (0, 7):
        wheels = np.cumsum(rng.normal(size=(30, 2)), axis=0)
        ends = np.array([5, 12, 30 - lead])
        maneuvers.append(Maneuver(rng.uniform(0.02, 0.08, 30), wheels, np.zeros((3, 3)), ends, rng.normal(size=(30, 2)) * 0.03, lead=lead))
    batch = make_batch(maneuvers)
    reference_params = np.array([0.013, 0.04, 0.1, -0.05, 0.2])
    k = len(params)
    columns = np.arange(k + 5)

    poses, _, cov = predict(model, batch, params, np.zeros(5), np.empty(0, dtype=np.int64), ROBOT.wheel_noise)
    row = 0
    for m in maneuvers:
        for end in m.ends:
            part = slice(m.lead, m.lead + end)
            motion = preintegrate(model, m.dt[part], m.wheels[part], m.cg[part], params, ROBOT.wheel_noise)
            np.testing.assert_allclose(se2.between(motion.delta, poses[row]), 0.0, atol=1e-12)
            np.testing.assert_allclose(cov[row], motion.cov, rtol=1e-12)
            row += 1

    poses, d, _ = predict(model, batch, params, reference_params, columns, ROBOT.wheel_noise)
    both, step = np.concatenate([params, reference_params]), 1e-6
    for column in columns:
        moved = []
        for sign in (1.0, -1.0):
            x = both.copy()
            x[column] += sign * step
            moved.append(predict(model, batch, x[:k], x[k:], np.empty(0, dtype=np.int64), ROBOT.wheel_noise)[0])
        difference = (se2.log(se2.between(poses, moved[0])) - se2.log(se2.between(poses, moved[1]))) / (2.0 * step)
        np.testing.assert_allclose(d[:, :, column], difference, atol=2e-6 * max(1.0, float(np.abs(difference).max())))


def test_predict_with_lag_and_offset_shifts_the_rates() -> None:
    """Body rates that follow the wheels' by 60 ms, and stamps that are 30 ms late, are found as such from rates alone."""
    rng = np.random.default_rng(2)
    model = make_model("diff_drive", ROBOT)
    h, n = 0.01, 600
    t = (np.arange(n) + 0.5) * h

    def rates(at: FloatArray) -> FloatArray:
        return np.stack([3.0 * np.sin(1.7 * at) + np.sin(4.1 * at), 2.0 * np.cos(2.3 * at)], axis=-1)

    # First-order response of 60 ms, by a fine Euler loop; the log has at t what was true at t - 30 ms.
    fine = np.arange(-200, 20 * n) * (h / 20)
    body, state = np.empty((len(fine), 2)), rates(fine[:1])[0]
    for i, at in enumerate(fine):
        state = state + (h / 20) / 0.06 * (rates(np.array([at]))[0] - state)
        body[i] = state
    true = np.stack([np.interp(t, fine, body[:, j]) for j in range(2)], axis=-1)
    logged = rates(t - 0.03)
    ends = np.arange(40, n - 50, 20)
    measured = np.array([preintegrate(model, np.full(e, h), true[50 : 50 + e], np.zeros(2), model.nominal, QUIET).delta for e in ends])
    measured = se2.compose(measured, se2.exp(1e-5 * rng.normal(size=measured.shape)))
    maneuver = Maneuver(np.full(n, h), logged, measured, ends, cov=1e-10 * np.eye(3), lead=50)
    result = fit(model, [maneuver], ("wheel_time_offset", "wheel_lag"), FitConfig("linear", QUIET))
    assert result.reference_params[0] == pytest.approx(0.03, abs=0.002)
    assert result.reference_params[1] == pytest.approx(0.06, abs=0.004)


@pytest.mark.parametrize("name", cases(sorted(WHEEL_FREE), ("skid_steer",)))
def test_fit_of_simulated_drives_covers_the_truth(name: str) -> None:
    rng = np.random.default_rng(3)
    model = make_model(name, ROBOT)
    free = WHEEL_FREE[name]
    params = model.nominal.copy()
    for parameter in free:
        params[model.param_names.index(parameter)] += 0.02 * rng.uniform(0.5, 1.0)
    inside, total = 0, 0
    for _ in range(40):
        result = fit(model, drive(model, params, rng), free, FitConfig("huber", QUIET))
        true = params[[model.param_names.index(parameter) for parameter in free]]
        sigma = np.array([result.sigmas[parameter] for parameter in free])
        inside += int(np.sum(np.abs(result.values - true) < 1.96 * sigma))
        total += len(free)
        assert result.is_sandwich
    # Parameters of one fit are correlated: allow what counting 40 fits alone would.
    assert 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / 40) < inside / total <= 1.0


@pytest.mark.extended
def test_fit_of_errors_shared_in_groups_has_wider_sigmas() -> None:
    """Ten maneuvers of a group repeat one error: the sandwich over groups must know, the plain inverse cannot."""
    rng = np.random.default_rng(4)
    model = make_model("diff_drive", ROBOT)
    free = WHEEL_FREE["diff_drive"]
    z = []
    for _ in range(60):
        maneuvers = []
        for group in range(30):
            one = drive(model, model.nominal, rng, 1, 0.01)[0]
            maneuvers += [Maneuver(one.dt, one.wheels, one.measured, one.ends, one.cg, one.cov, str(group))] * 10
        result = fit(model, maneuvers, free, FitConfig("linear", QUIET))
        z.append((result.values - model.nominal) / np.array([result.sigmas[name] for name in free]))
    assert 0.7 < np.std(z) < 1.4  # without the sandwich it is sqrt(10)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_fit_with_robust_loss_withstands_outliers(loss: str) -> None:
    rng = np.random.default_rng(5)
    model = make_model("icr", ROBOT)
    maneuvers = drive(model, model.nominal, rng, 60)
    for m in maneuvers[::10]:
        m.measured[:] = se2.compose(m.measured, [0.5, -0.3, 0.8])  # ICP lost its way
    errors = {}
    for kind in ("linear", loss):
        result = fit(model, maneuvers, WHEEL_FREE["icr"], FitConfig(kind, QUIET))  # type: ignore[arg-type]
        errors[kind] = np.abs(result.params - model.nominal).max()
    assert errors[loss] < 0.005
    assert errors[loss] < 0.1 * errors["linear"]


def test_fit_with_ties_keeps_a_robot_symmetric() -> None:
    rng = np.random.default_rng(6)
    model = make_model("full_linear", ROBOT)
    ties = {"vx_right": ("vx_left", 1.0), "wz_right": ("wz_left", -1.0)}
    result = fit(model, drive(model, model.nominal, rng), ("vx_left", "wz_left"), FitConfig("linear", QUIET, ties))
    value = dict(zip(model.param_names, result.params, strict=True))
    assert value["vx_right"] == value["vx_left"]
    assert value["wz_right"] == -value["wz_left"]
    assert result.sigmas["wz_right"] == result.sigmas["wz_left"] > 0.0
    np.testing.assert_allclose(result.params, model.nominal, atol=1e-3)


def test_fit_with_a_prior_weighs_it_by_its_sigma() -> None:
    """One parameter, linear in it: the posterior mean is the weighted mean of prior and measurement."""
    model = make_model("diff_drive", ROBOT)
    n, h = 40, 0.05
    rates = np.full((n, 2), 3.0)
    driven = 3.0 * n * h
    found = []
    rng = np.random.default_rng(7)
    for _ in range(200):
        off = 0.01 * rng.normal(size=3)
        measured = np.array([[0.1644 * driven + off[0], off[1], off[2]]])
        found.append(Maneuver(np.full(n, h), rates, measured, np.array([n]), cov=1e-4 * np.eye(3), group=str(len(found))))
    start = model.nominal.copy()
    start[0] = 0.164
    sigma = 0.01 / driven / np.sqrt(200)  # of the measured radius
    config = FitConfig("linear", QUIET, prior_sigma={"wheel_radius": sigma}, strict=False)
    result = fit(model, found, ("wheel_radius",), config, start)
    plain = fit(model, found, ("wheel_radius",), FitConfig("linear", QUIET), start)
    between = (result.values[0] - 0.164) / (plain.values[0] - 0.164)
    assert between == pytest.approx(0.5, abs=0.05)  # the errors' size is itself estimated, from the median of 200


def test_fit_of_straight_drives_refuses_turning_with_advice() -> None:
    """Follow the advice of the error, and the fit works and is right."""
    rng = np.random.default_rng(8)
    model = make_model("icr", ROBOT)
    params = model.nominal + np.array([0.03, 0.02, -0.06, 0.01, 0.02])
    n = 40
    straight = [np.stack([np.full(n, rate), np.full(n, rate * 1.01 / 1.02)], axis=-1) for rate in rng.uniform(2.0, 4.0, 30)]
    maneuvers = drive(model, params, rng, 30, wheels=straight)
    with pytest.raises(CalibrationError, match=r"y_icr_left does not show|y_icr_left .*uncertain") as caught:
        fit(model, maneuvers, model.param_names, FitConfig("huber"))
    lines = str(caught.value).splitlines()[1:]
    assert any("x_icr" in line for line in lines)
    assert all("turning" in line or "arc" in line for line in lines)

    known = dict(candidates(3.0, np.zeros(2)))
    for line in lines:
        advised = next(known[text] for text in sorted(known, key=len, reverse=True) if f"s of {text}, or" in line)
        maneuvers += drive(model, params, rng, 3, wheels=[advised.wheels[:n]] * 3)
    result = fit(model, maneuvers, model.param_names, FitConfig("huber"))
    np.testing.assert_allclose(result.params, params, atol=5e-3)


def test_fit_of_lidar_offset_and_x_cr_is_refused() -> None:
    rng = np.random.default_rng(9)
    model = make_model("skid_steer", ROBOT)
    maneuvers = drive(model, model.nominal, rng)
    with pytest.raises(CalibrationError, match=r"x_cr_0 and lidar_offset_x cannot be distinguished|lidar_offset_x and x_cr_0"):
        fit(model, maneuvers, ("k_0", "x_cr_0", "lidar_offset_x"))
    loose = fit(model, maneuvers, ("k_0", "x_cr_0", "lidar_offset_x"), FitConfig(strict=False))
    assert set(loose.weaknesses[0].combination) == {"x_cr_0", "lidar_offset_x"}
    assert loose.params[0] == pytest.approx(model.nominal[0], abs=2e-3)


def test_fit_of_headings_alone_calibrates_turning() -> None:
    """Positions that are not measured (inf) count for nothing, whatever stands there."""
    rng = np.random.default_rng(10)
    model = make_model("diff_drive", ROBOT)
    maneuvers = []
    for m in drive(model, model.nominal, rng, 80):
        measured = m.measured + np.array([[rng.normal(), rng.normal(), 0.0]])
        maneuvers.append(Maneuver(m.dt, m.wheels, measured, m.ends, m.cg, np.diag([np.inf, np.inf, NOISE**2]), m.group))
    result = fit(model, maneuvers, ("wheel_separation_multiplier",), FitConfig("huber", QUIET))
    assert result.scale == pytest.approx(1.0, abs=0.3)
    assert result.params[1] == pytest.approx(model.nominal[1], abs=4.0 * result.sigmas["wheel_separation_multiplier"])
    with pytest.raises(CalibrationError, match="wheel_radius"):
        fit(model, maneuvers, ("wheel_radius", "wheel_separation_multiplier"), FitConfig("huber", QUIET))


def _one(**changes: object) -> Maneuver:
    fields: dict[str, object] = {
        "dt": np.full(4, 0.1),
        "wheels": np.ones((4, 2)),
        "measured": np.zeros((1, 3)),
        "ends": np.array([4]),
        "group": "north",
    }
    return Maneuver(**(fields | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("maneuver", "message"),
    [
        (_one(dt=np.array([0.1, 0.1, -0.1, 0.1])), "north.*interval is -0.1 s"),
        (_one(wheels=np.array([[1.0, 1.0], [np.nan, 1.0], [1.0, 1.0], [1.0, 1.0]])), "north.*wheels.*not finite"),
        (_one(wheels=np.ones((3, 2))), r"wheels has shape \(3, 2\)"),
        (_one(measured=np.full((1, 3), np.inf)), "measured.*not finite"),
        (_one(ends=np.array([5])), "'ends' must increase"),
        (_one(ends=np.array([3, 2]), measured=np.zeros((2, 3))), "'ends' must increase"),
        (_one(lead=4), "'ends' must increase"),
        (_one(cov=np.full((3, 3), np.nan)), "cov.*not finite"),
    ],
)
def test_make_batch_of_malformed_maneuvers_names_them(maneuver: Maneuver, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        make_batch([_one(), maneuver])


def test_fit_of_too_little_motion_is_refused() -> None:
    model = make_model("diff_drive", ROBOT)
    still = _one(wheels=np.zeros((4, 2)))
    with pytest.raises(CalibrationError, match=r"too little motion.*0 m and turned 0 rad"):
        fit(model, [still] * 5, ("wheel_radius",))
    with pytest.raises(CalibrationError, match="no maneuver"):
        fit(model, [], ("wheel_radius",))
    with pytest.raises(CalibrationError, match="1 measured poses do not determine 5"):
        fit(make_model("icr", ROBOT), [_one()], WHEEL_FREE["icr"])
    with pytest.raises(CalibrationError, match=r"no parameter wheel_radios; it has wheel_radius.*lidar_yaw"):
        fit(model, [_one()], ("wheel_radios",))
    with pytest.raises(CalibrationError, match="once"):
        fit(model, [_one()], ("wheel_radius", "wheel_radius"))
    with pytest.raises(CalibrationError, match="2 groups of maneuvers in 5 folds"):
        cross_validate(lambda ms: fit(model, ms, ("wheel_radius",)), [_one(), _one(group="south")], 5)


def test_cross_validate_trains_without_the_held_out_group() -> None:
    rng = np.random.default_rng(11)
    model = make_model("diff_drive", ROBOT)
    maneuvers = drive(model, model.nominal, rng, 30, groups=7)
    seen: list[tuple[set[str], set[str]]] = []

    class Spy:
        def __init__(self, training: Sequence[Maneuver]) -> None:
            self.groups = {m.group for m in training}

        def residuals(self, held: Sequence[Maneuver]) -> FloatArray:
            seen.append((self.groups, {m.group for m in held}))
            return np.array([[float(m.group), 0.0, 0.0] for m in held])

    out = cross_validate(Spy, maneuvers, 3)
    assert len(seen) == 3
    assert all(not trained & held and trained | held == set("0123456") for trained, held in seen)
    np.testing.assert_array_equal(out.residuals[:, 0], [float(m.group) for m in maneuvers])


def test_root_mean_intervals_cover() -> None:
    """Errors with a part that a group shares: true RMS is 1; a bootstrap over single errors would be too narrow."""
    rng = np.random.default_rng(12)
    group = np.repeat(np.arange(80), 3)
    inside = 0
    for _ in range(200):
        errors = np.sqrt(0.7) * rng.normal(size=80)[group] + np.sqrt(0.3) * rng.normal(size=240)
        interval = root_mean(errors**2, group, np.random.default_rng(0), 400)
        inside += interval.low <= 1.0 <= interval.high
    assert 0.89 <= inside / 200 <= 0.99
    gain = root_mean_gain(errors**2, (0.8 * errors) ** 2, group, np.random.default_rng(0), 400)
    assert gain.value == pytest.approx(0.2 * np.sqrt(np.mean(errors**2)))
    assert 0.0 < gain.low < gain.value < gain.high


def test_fit_of_the_same_data_gives_the_same_bytes() -> None:
    model = make_model("icr", ROBOT)
    results = [fit(model, drive(model, model.nominal, np.random.default_rng(13)), WHEEL_FREE["icr"]) for _ in range(2)]
    assert results[0].params.tobytes() == results[1].params.tobytes()
    assert results[0].cov.tobytes() == results[1].cov.tobytes()


def test_fit_of_reference_terms_beside_the_model_finds_both() -> None:
    rng = np.random.default_rng(14)
    model = make_model("diff_drive", ROBOT)
    mount = np.array([0.2, -0.1, 0.05])
    maneuvers = []
    for m in drive(model, model.nominal, rng, 60):
        seen = se2.compose(se2.compose(se2.inverse(mount), m.measured), mount)
        maneuvers.append(Maneuver(m.dt, m.wheels, seen, m.ends, m.cg, m.cov, m.group))
    free = (*WHEEL_FREE["diff_drive"], "lidar_offset_x", "lidar_offset_y", "lidar_yaw")
    result = fit(model, maneuvers, free, FitConfig("huber", QUIET))
    found = dict(zip(REFERENCE_PARAM_NAMES, result.reference_params, strict=True))
    assert [found["lidar_offset_x"], found["lidar_offset_y"], found["lidar_yaw"]] == pytest.approx(mount.tolist(), abs=3e-3)
    assert result.params == pytest.approx(model.nominal, abs=3e-3)


@pytest.mark.parametrize(("positions_s", "is_one_clock"), [(-0.1, True), (-0.2, False)])
def test_describe_clocks_headings_and_positions_apart_are_both_named(positions_s: float, is_one_clock: bool) -> None:
    """Windows of 2 s in which turns are 100 ms ahead of their stamps, and advances as much or twice as much."""
    model, rng = make_model("diff_drive", ROBOT), np.random.default_rng(3)
    h, lead, n = 0.05, 6, 40

    def rates(at: FloatArray) -> FloatArray:
        return np.stack([3.0 * np.sin(0.7 * at) + np.sin(2.1 * at), 3.0 * np.cos(0.9 * at) + np.sin(1.3 * at)], axis=-1)

    def moved(begin: float, offset: float) -> FloatArray:
        within = rates(begin + offset + (np.arange(n) + 0.5) * h)
        return preintegrate(model, np.full(n, h), within, np.zeros(2), model.nominal, QUIET).delta

    maneuvers = []
    for i in range(60):
        measured = np.r_[moved(2.0 * i, positions_s)[:2], moved(2.0 * i, -0.1)[2]] + NOISE * rng.normal(size=3)
        logged = rates(2.0 * i + (np.arange(n + 2 * lead) - lead + 0.5) * h)
        cov = NOISE**2 * np.eye(3)
        maneuvers.append(Maneuver(np.full(len(logged), h), logged, measured[None], np.array([n]), cov=cov, group=str(i // 3), lead=lead))
    by = {each.by: each for each in estimate_clocks(maneuvers, ROBOT)}
    assert by["headings"].offset_s == pytest.approx(-0.1, abs=0.01)
    assert by["positions"].offset_s == pytest.approx(positions_s, abs=0.03)
    text = describe_clocks(-0.1, 0.004, maneuvers, ROBOT)
    assert (text is None) == is_one_clock
    if text is not None:
        assert "by headings alone" in text
        assert "by positions alone: one offset does not describe this drive" in text


@pytest.mark.parametrize(
    ("headings", "positions", "is_one_clock"),
    [((-0.201, 0.008), (-0.223, 0.010), True), ((-0.152, 0.012), (-0.217, 0.012), False)],
    ids=["simulated, one clock of 200 ms", "MIT-CSAIL"],
)
def test_describe_clocks_of_two_sigma_are_one_clock(
    headings: tuple[float, float], positions: tuple[float, float], is_one_clock: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of 20 healthy drives has estimates that are as far apart."""
    found = [calibrate.ClockEstimate("headings", *headings), calibrate.ClockEstimate("positions", *positions)]
    monkeypatch.setattr(calibrate, "estimate_clocks", lambda *given: found)
    offset = -0.2 if is_one_clock else -0.16
    assert (describe_clocks(offset, 0.006, [], ROBOT) is None) == is_one_clock


def test_estimate_clocks_of_headings_gives_no_other() -> None:
    maneuvers = drive(make_model("diff_drive", ROBOT), make_model("diff_drive", ROBOT).nominal, np.random.default_rng(0))
    cov = np.diag([np.inf, np.inf, NOISE**2])
    assert [each.by for each in estimate_clocks([dataclasses.replace(m, cov=cov) for m in maneuvers], ROBOT)] == ["headings"]
