"""Claims about `regressions`: least squares with honest covariance, the thesis's numbers to every printed digit, CoR of arcs (4.2-4.5)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from motion_models.calibration.regressions import (
    COLUMNS,
    RotationTable,
    _final_point,
    center_from_end_poses,
    center_of_arc,
    polynomial,
    read_rotation_table,
    read_rotations,
    regress,
    skid_steer_fit,
)
from motion_models.errors import CalibrationError
from motion_models.robot_file import load_robot
from motion_models.se2 import compose, exp
from motion_models.skid_steer import SkidSteer, thesis_coefficients
from tests.helpers.extended import cases
from tests.studies.thesis_regressions import DATA, grid, k_deviation, printed_numbers, variant_errors

POSE_SIGMA = np.array([0.002, 0.002, 0.002])
COV = np.diag(POSE_SIGMA**2)


@pytest.mark.parametrize("number", printed_numbers(), ids=lambda n: n.what)
def test_regressions_of_the_thesis_give_every_printed_digit(number):
    assert number.agrees


def test_rotation_ratio_over_the_grid_is_that_of_the_thesis():
    assert k_deviation() < 1e-3


def test_regressions_with_a_wrong_digit_differ():
    import dataclasses

    for number in printed_numbers():
        step = 10.0**-number.digits if "E" not in number.printed else abs(number.value) * 10.0 ** (1 - number.digits) * 2
        assert not dataclasses.replace(number, value=number.value + 1.01 * step).agrees


def test_cor_y_variants_have_the_errors_of_the_thesis():
    errors = {e.variant: e for e in variant_errors()}
    for e in errors.values():
        assert (e.ratio, e.x_cr) == (pytest.approx(0.02676, abs=5e-6), pytest.approx(0.01144, abs=5e-6))
    assert [errors[v].y_cr for v in ("multivariate", "full", "symmetric")] == pytest.approx([0.01105, 0.00565, 0.01277], abs=5e-6)


def test_regression_of_a_line_is_that_of_scipy():
    rng = np.random.default_rng(0)
    x = rng.normal(size=30)
    y = 2 * x + rng.normal(size=30)
    ours, theirs = polynomial(y, x, 1), stats.linregress(x, y)
    np.testing.assert_allclose(ours.coefficients, [theirs.intercept, theirs.slope])
    np.testing.assert_allclose(ours.sigma, [theirs.intercept_stderr, theirs.stderr])
    assert ours.r_squared == pytest.approx(theirs.rvalue**2)
    assert ours.p_values[1] == pytest.approx(theirs.pvalue)
    assert ours.significance == pytest.approx(theirs.pvalue)  # F = t^2 for a line


def test_regression_intervals_cover():
    """95 % of them contain the truth; 3000 draws, three coefficients."""
    rng = np.random.default_rng(1)
    x = np.linspace(-1, 1, 12)
    truth = np.array([0.3, -1.0, 2.0])
    inside = np.zeros(3)
    for _ in range(3000):
        fit = polynomial(truth[0] + truth[1] * x + truth[2] * x**2 + rng.normal(size=12), x, 2)
        low, high = fit.interval().T
        inside += (low < truth) & (truth < high)
    assert np.all(np.abs(inside / 3000 - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 3000))


def test_regression_p_values_of_no_slope_are_uniform():
    rng, x = np.random.default_rng(2), np.linspace(-1, 1, 12)
    p = np.array([polynomial(0.3 + rng.normal(size=12), x, 2).p_values for _ in range(1000)])
    for column in p.T[1:]:
        assert stats.kstest(column, "uniform").pvalue > 1e-3


def test_skid_steer_fit_of_a_simulated_table_returns_its_model():
    table = grid()
    truth = thesis_coefficients("full")
    model = SkidSteer.from_robot(load_robot("vaultbot"))
    k, x_cr, y_cr = model.rotation(table.cg, truth)
    made = RotationTable(table.cg, 1.875 * k, np.stack([x_cr, y_cr], axis=-1))
    fit = skid_steer_fit(made)
    np.testing.assert_allclose(fit.coefficients, truth, atol=1e-9)
    np.testing.assert_allclose(fit.cov, 0.0, atol=1e-12)


def test_skid_steer_fit_of_the_grid_is_no_worse_than_the_thesis():
    """By definition of least squares, on the rows; and its covariance is that of its residuals."""
    table = grid()
    fit = skid_steer_fit(table)
    full = {e.variant: e for e in variant_errors()}["full"]
    assert fit.k.rms * 1.875 <= full.ratio
    assert fit.x_cr.rms <= full.x_cr
    assert fit.y_cr.rms <= full.y_cr
    assert np.linalg.eigvalsh(fit.cov).min() > 0


def write(path, rows, header=COLUMNS):
    path.write_text("\n".join([",".join(header), *(",".join(str(c) for c in row) for row in rows)]) + "\n")
    return path


def test_read_rotation_table_takes_columns_in_any_order(tmp_path):
    order = COLUMNS[::-1]
    table = read_rotation_table(write(tmp_path / "t.csv", [[5, 4, 3, 2, 1]], order))
    np.testing.assert_array_equal(table.cg, [[1, 2]])
    np.testing.assert_array_equal(table.cor, [[4, 5]])
    assert len(read_rotation_table(DATA / "rotation_grid.csv").ratio) == 68


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ([[0, 0, 1, 0, 0], [0, 0.01, "", 0, 0]], COLUMNS, r"line 3: rotation_ratio must be a number, found ''"),
        ([[0, 0, "fast", 0, 0]], COLUMNS, r"line 2: rotation_ratio must be a number, found 'fast'"),
        ([[0, 0, 1, 0]], COLUMNS, r"line 2: cor_y_m must be a number, found None"),
        ([[0, 0, 1, 0, "inf"]], COLUMNS, r"line 2: cor_y_m must be a number"),
        ([[0, 0, 1, 0]], COLUMNS[:4], r"no column cor_y_m; it has cg_x_m, cg_y_m, rotation_ratio, cor_x_m"),
        ([], COLUMNS, r"no rows below its header"),
    ],
)
def test_read_rotation_table_of_bad_cells_names_the_place(tmp_path, rows, header, message):
    with pytest.raises(CalibrationError, match=message):
        read_rotation_table(write(tmp_path / "bad.csv", rows, header))


@pytest.mark.parametrize(
    ("column", "change", "message"),
    [
        ("cor_x_m", lambda i, v: v + 2.0 if i in (3, 20, 40) else v, r"centres of rotation of 3 of 68 rows, from line 5 on"),
        ("cor_y_m", lambda i, v: 1000.0 * v, r"centres of rotation of 6\d of 68 rows"),
        ("cg_x_m", lambda i, v: 1000.0 * v, r"centres of gravity of .* of 68 rows"),
    ],
)
def test_read_rotations_off_the_robot_names_the_lines(tmp_path, column, change, message):
    vaultbot = load_robot("vaultbot")
    good = read_rotation_table(DATA / "rotation_grid.csv")
    assert len(read_rotations(DATA / "rotation_grid.csv", vaultbot).ratio) == 68
    rows, at = np.column_stack([good.cg, good.ratio, good.cor]), COLUMNS.index(column)
    rows[:, at] = [change(i, v) for i, v in enumerate(rows[:, at])]
    with pytest.raises(CalibrationError, match=message):
        read_rotations(write(tmp_path / "off.csv", rows.tolist()), vaultbot)


@pytest.mark.parametrize(
    "make", [lambda p: None, lambda p: p.write_bytes(b"\xff\xfe\x00\x01"), lambda p: p.write_text(""), lambda p: p.mkdir()]
)
def test_read_rotation_table_of_other_files_is_refused(tmp_path, make):
    path = tmp_path / "x.csv"
    make(path)
    with pytest.raises(CalibrationError, match=r"x\.csv"):
        read_rotation_table(path)


def test_regressions_of_too_few_rows_are_refused():
    with pytest.raises(CalibrationError, match="3 rows are too few for the 3 coefficients"):
        polynomial(np.ones(3), np.arange(3.0), 2)
    with pytest.raises(CalibrationError, match="do not separate 1 and x_G"):
        polynomial(np.ones(5), np.full(5, 0.3), 1)
    line = grid()
    on_axis = line.cg[:, 1] == 0
    with pytest.raises(CalibrationError, match="vary the centre of gravity more"):
        skid_steer_fit(RotationTable(line.cg[on_axis], line.ratio[on_axis], line.cor[on_axis]))
    with pytest.raises(CalibrationError, match="do not separate"):
        regress(np.arange(4.0), {"1": np.ones(4), "twice": 2 * np.ones(4)})


def arc(center, start, turns):
    """Poses (n, 3) of a body that has turned by ``turns`` (n,) about its own point ``center`` (2,)."""
    turns = np.asarray(turns, dtype=float)
    c, s = np.cos(turns), np.sin(turns)
    x, y = center
    about = np.stack([x - c * x + s * y, y - s * x - c * y, turns], axis=-1)
    return compose(start, about)


def noisy(poses, rng):
    return compose(poses, exp(rng.normal(size=poses.shape) * POSE_SIGMA))


coordinate = st.floats(-3, 3)
angle = st.floats(0.05, 3.0).flatmap(lambda a: st.sampled_from([a, -a]))


@given(coordinate, coordinate, coordinate, angle)
@settings(deadline=None)
def test_centers_of_a_perfect_arc_are_exact(x, y, heading, turn):
    poses = arc((x, y), [0.3, -1.2, heading], np.linspace(0, turn, 12))
    by_ends = center_from_end_poses(poses[0], poses[-1], COV, COV)
    by_all = center_of_arc(poses, COV)
    np.testing.assert_allclose(by_ends.value, [x, y], atol=1e-9)
    np.testing.assert_allclose(by_all.value, [x, y], atol=1e-7)
    assert by_all.chi_square < 1e-9
    # More poses cannot know less than two of them.
    assert np.linalg.eigvalsh(by_ends.cov - by_all.cov).min() > -1e-6 * by_ends.cov.max()


@given(coordinate, coordinate, angle)
@settings(deadline=None)
def test_center_of_arc_of_two_poses_is_that_of_end_poses(x, y, turn):
    poses = arc((x, y), [0.0, 0.0, 0.0], [0, turn])
    by_ends, by_all = center_from_end_poses(*poses, COV, COV), center_of_arc(poses, COV)
    np.testing.assert_allclose(by_all.value, by_ends.value, atol=1e-6)
    np.testing.assert_allclose(by_all.cov, by_ends.cov, rtol=1e-3, atol=1e-9 + 1e-3 * by_ends.cov.max())


def test_center_from_end_poses_is_the_formula_of_the_thesis():
    """4.4 and 4.5 with the start at the origin, typed in again."""
    x, y, t = 0.31, -0.12, 0.7
    value = center_from_end_poses([0, 0, 0], [x, y, t]).value
    c_x = ((1 - math.cos(t)) * x + math.sin(t) * -y) / (2 * (1 - math.cos(t)))
    c_y = ((1 - math.cos(t)) * y + math.sin(t) * x) / (2 * (1 - math.cos(t)))
    np.testing.assert_allclose(value, [c_x, c_y], rtol=1e-14)


@given(coordinate, coordinate, angle)
@settings(deadline=None)
def test_center_from_end_poses_derivative_is_a_difference(x, y, turn):
    delta = arc((x, y), [0, 0, 0], [turn])[0]
    _, jacobian = _final_point(delta)
    h = 1e-6
    for j in range(3):
        e = h * np.eye(3)[j]
        difference = (_final_point(compose(delta, exp(e)))[0] - _final_point(compose(delta, exp(-e)))[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[:, j], difference, rtol=1e-5, atol=1e-5 * (1 + np.abs(jacobian).max()))


@pytest.mark.parametrize("turn", [0.02, 0.1, 1.5, 4.0])
def test_center_from_end_poses_covariance_covers(turn):
    rng = np.random.default_rng(3)
    truth = np.array([-0.1, 0.4])
    poses = arc(truth, [1.0, 2.0, 0.4], [0, turn])
    inside = 0
    for _ in range(2000):
        got = center_from_end_poses(*noisy(poses, rng), COV, COV)
        error = got.value - truth
        inside += error @ np.linalg.solve(got.cov, error) < 5.991  # 95 % of chi square with two degrees of freedom
    assert 0.93 < inside / 2000 < 0.97  # five binomial sigmas are 0.024


@pytest.mark.extended
@pytest.mark.parametrize("turn", cases([0.05, 0.3, 1.5, 7.0], ("0.3",)))
def test_center_of_arc_covariance_and_chi_square_cover(turn):
    rng = np.random.default_rng(4)
    truth = np.array([-0.1, 0.4])
    poses = arc(truth, [1.0, 2.0, 0.4], np.linspace(0, turn, 25))
    inside, chi_square, errors, covs = 0, [], [], []
    for _ in range(1000):
        got = center_of_arc(noisy(poses, rng), COV)
        error = got.value - truth
        inside += error @ np.linalg.solve(got.cov, error) < 5.991
        chi_square.append(got.chi_square / got.degrees_of_freedom)
        errors.append(error)
        covs.append(got.cov)
    assert 0.925 < inside / 1000 < 0.98
    assert abs(np.mean(chi_square) - 1) < 0.03
    # and it is not biased: the mean error is within four of its own sigmas
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * np.sqrt(np.diagonal(np.mean(covs, axis=0)) / 1000))


def test_center_sigma_of_small_turns_grows_as_one_over_angle():
    turns = np.array([0.02, 0.01, 0.005, 0.0025])
    sigma = []
    for turn in turns:
        poses = arc((0.1, 0.2), [0, 0, 0], [0, turn])
        sigma.append(math.sqrt(np.trace(center_from_end_poses(*poses, COV, COV).cov)))
    slope = np.polyfit(np.log(turns), np.log(sigma), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.01)


def test_centers_without_a_turn_are_refused():
    with pytest.raises(CalibrationError, match="without a turn"):
        center_from_end_poses([0, 0, 0.3], [1, 0, 0.3])
    with pytest.raises(CalibrationError, match="without a turn"):
        center_of_arc([[0, 0, 0.3], [1, 0, 0.3], [2, 0, 0.3]], COV)


@pytest.mark.parametrize("poses", [[[0, 0, 0]], [[0, 0, 0], [np.nan, 0, 1]], [[0, 0], [1, 1]], []])
def test_center_of_arc_of_bad_poses_is_refused(poses):
    with pytest.raises(CalibrationError, match="two finite poses"):
        center_of_arc(poses, COV)


def test_center_of_arc_of_certain_poses_is_refused():
    with pytest.raises(CalibrationError, match="positive definite"):
        center_of_arc(arc((0.1, 0), [0, 0, 0], [0, 1]), np.zeros((3, 3)))


@pytest.mark.extended
@pytest.mark.parametrize("turn", [1e-3, 1e-4])
def test_center_of_arc_below_its_noise_is_refused_or_uncertain(turn):
    """Turned by half a sigma of one heading, and by a twentieth: never a centre that claims to be known to a decimetre."""
    rng = np.random.default_rng(5)
    poses = arc((0.1, 0.4), [0, 0, 0], np.linspace(0, turn, 5))
    for _ in range(200):
        try:
            got = center_of_arc(noisy(poses, rng), COV)
        except CalibrationError:
            continue
        assert math.sqrt(np.linalg.eigvalsh(got.cov).max()) > 0.1
