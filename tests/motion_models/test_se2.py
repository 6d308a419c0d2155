"""Laws of SE(2), held for any pose and tangent that hypothesis can think of.

The second way to every number is the matrix group: `scipy.linalg.expm` of the 3x3 twist matrix, matrix products and inverses.
"""

import math
import os
import shutil
import subprocess
import sys
from fractions import Fraction
from functools import partial
from math import factorial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from motion_models import se2

LENGTHS = st.floats(-50.0, 50.0, allow_subnormal=False)
# ordinary angles, those about the branch cut and those about the switch from series to closed form
ANGLES = st.one_of(
    st.floats(-math.pi, math.pi, exclude_max=True),
    st.floats(-1e-7, 1e-7).map(lambda d: math.pi + d),
    st.floats(-1e-7, 1e-7).map(lambda d: -math.pi + d),
    st.floats(-1e-3, 1e-3),
    st.sampled_from([0.0, 1e-4, -1e-4, math.pi / 2, -math.pi, math.pi]),
)
POSES = st.tuples(LENGTHS, LENGTHS, ANGLES).map(np.array)


def law(*strategies):
    """A property that holds for all of these; the same examples in every run, however slow the machine."""
    return lambda test: settings(deadline=None, derandomize=True)(given(*strategies)(test))


ROUNDING = 1e-12  # of numbers of size 50, in a few operations


def matrix(pose):
    x, y, theta = pose
    return np.array([[math.cos(theta), -math.sin(theta), x], [math.sin(theta), math.cos(theta), y], [0.0, 0.0, 1.0]])


def twist_matrix(tangent):
    x, y, theta = tangent
    return np.array([[0.0, -theta, x], [theta, 0.0, y], [0.0, 0.0, 0.0]])


def assert_same_pose(a, b, atol=ROUNDING):
    """Equal positions, and equal headings on the circle (-pi is pi)."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], rtol=1e-13, atol=atol)
    np.testing.assert_allclose(np.exp(1j * a[..., 2]), np.exp(1j * b[..., 2]), atol=atol)


@law(POSES)
def test_exp_of_tangents_is_the_matrix_exponential(tangent):
    np.testing.assert_allclose(matrix(se2.exp(tangent)), expm(twist_matrix(tangent)), atol=1e-11)


@law(POSES)
def test_exp_of_log_is_the_pose(pose):
    assert_same_pose(se2.exp(se2.log(pose)), pose)


@law(st.tuples(LENGTHS, LENGTHS, st.floats(-3.1415926, 3.1415926)).map(np.array))
def test_log_of_exp_is_the_tangent(tangent):
    np.testing.assert_allclose(se2.log(se2.exp(tangent)), tangent, atol=ROUNDING)


@law(POSES)
def test_log_of_any_pose_is_the_shortest_turn(pose):
    assert -math.pi <= se2.log(pose)[2] < math.pi


@law(POSES, POSES, POSES)
def test_compose_of_three_poses_is_associative(a, b, c):
    assert_same_pose(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))


@law(POSES)
def test_inverse_composed_with_its_pose_is_the_identity(pose):
    identity = np.zeros(3)
    assert_same_pose(se2.compose(pose, identity), pose)
    assert_same_pose(se2.compose(identity, pose), pose)
    assert_same_pose(se2.compose(pose, se2.inverse(pose)), identity)
    assert_same_pose(se2.compose(se2.inverse(pose), pose), identity)
    assert_same_pose(se2.inverse(se2.inverse(pose)), pose)


@law(POSES, POSES)
def test_compose_and_inverse_are_those_of_matrices(a, b):
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=ROUNDING)
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=ROUNDING)


@law(POSES, POSES)
def test_between_of_composed_poses_is_the_motion(a, b):
    assert_same_pose(se2.between(a, se2.compose(a, b)), b)


@law(POSES, POSES, st.tuples(LENGTHS, LENGTHS).map(np.array))
def test_transform_of_points_is_compose_of_origins(a, b, point):
    np.testing.assert_allclose(se2.transform(se2.compose(a, b), point), se2.transform(a, se2.transform(b, point)), atol=ROUNDING)
    np.testing.assert_allclose(se2.transform(a, b[:2]), se2.compose(a, b)[:2], atol=ROUNDING)


@law(POSES, POSES)
def test_adjoint_moves_a_tangent_to_the_other_side(pose, tangent):
    left = se2.compose(se2.exp(se2.adjoint(pose) @ tangent), pose)
    # the lever arm (50 m) times the rounding of a vector of 50 m * pi
    assert_same_pose(se2.compose(pose, se2.exp(tangent)), left, atol=1e-11)


@law(POSES, POSES)
def test_adjoint_of_composed_poses_is_the_product(a, b):
    np.testing.assert_allclose(se2.adjoint(se2.compose(a, b)), se2.adjoint(a) @ se2.adjoint(b), atol=1e-11)
    np.testing.assert_allclose(se2.adjoint(se2.inverse(a)), np.linalg.inv(se2.adjoint(a)), atol=1e-9)


@law(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.0, 3.0)).map(np.array))
def test_right_jacobian_is_the_central_difference(tangent):
    h = 1e-5
    step = h * np.eye(3)
    difference = se2.log(se2.between(se2.exp(tangent - step), se2.exp(tangent + step))) / (2 * h)
    # error of a central difference: h^2 times third derivatives of size |tangent|, and rounding over h
    np.testing.assert_allclose(se2.right_jacobian(tangent), difference.T, atol=2e-9)


@law(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.0, 3.0)).map(np.array))
def test_right_jacobian_inverse_is_the_derivative_of_log(tangent):
    h = 1e-5
    step = h * np.eye(3)
    pose = se2.exp(tangent)
    difference = (se2.log(se2.compose(pose, se2.exp(step))) - se2.log(se2.compose(pose, se2.exp(-step)))) / (2 * h)
    # conditioning of log grows towards pi, to third derivatives of about 1e3 at 3 rad: 1e3 * h^2
    np.testing.assert_allclose(se2.right_jacobian_inverse(tangent), difference.T, atol=1e-7)


@law(POSES, POSES)
def test_interpolate_at_both_ends_gives_the_poses(a, b):
    assert_same_pose(se2.interpolate(a, b, 0.0), a)
    assert_same_pose(se2.interpolate(a, b, 1.0), b, atol=1e-11)


@law(POSES, st.tuples(LENGTHS, LENGTHS, st.floats(-3.0, 3.0)).map(np.array), st.floats(0.0, 1.0))
def test_interpolate_between_poses_has_a_constant_twist(a, twist, fraction):
    pose = se2.interpolate(a, se2.compose(a, se2.exp(twist)), fraction)
    assert_same_pose(pose, se2.compose(a, se2.exp(fraction * twist)), atol=1e-11)


def series(t, offset, odd):
    """sum of (-1)^n t^k / (k + offset)!, over odd or even k, in exact arithmetic, rounded once."""
    return float(sum(Fraction((-1) ** (k // 2), factorial(k + offset)) * Fraction(t) ** k for k in range(int(odd), 24, 2)))


@pytest.mark.parametrize("theta", [0.0, 1e-300, 1e-9, 9.9e-5, 9.9999999e-5, 1e-4, 1.0001e-4, 2e-4, 1e-3, 1e-2, 0.1, 0.5, -1.1e-4, -1e-3])
def test_exp_and_log_at_small_angles_keep_all_digits(theta):
    sine, cosine = series(theta, 1, False), series(theta, 1, True)  # sin(t)/t, (1 - cos t)/t
    np.testing.assert_allclose(se2.exp([1.0, 0.0, theta]), [sine, cosine, theta], rtol=0, atol=1e-15)
    f, g = series(theta, 2, True), series(theta, 2, False)  # (t - sin t)/t^2, (1 - cos t)/t^2
    np.testing.assert_allclose(se2.right_jacobian([1.0, 0.0, theta])[:2, 2], [f, g], rtol=0, atol=1e-12)


@law(POSES)
def test_scalar_exp_of_tangents_is_exp(tangent):
    # not bit for bit: numpy's and the compiler's sine may differ in the last place
    np.testing.assert_allclose(se2.scalar_exp(tuple(tangent)), se2.exp(tangent), rtol=1e-15, atol=1e-13)


@law(st.floats(-100.0, 100.0))
def test_wrap_angle_of_any_angle_is_in_the_half_open_interval(angle):
    wrapped = float(se2.wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    turns = (angle - wrapped) / (2 * math.pi)
    assert abs(turns - round(turns)) < 1e-14 * 20


def test_wrap_angle_at_the_cut_stays_in_the_interval():
    just_below = np.nextafter(-math.pi, -4.0)
    assert np.all(np.abs(se2.wrap_angle([just_below, -math.pi, math.pi, np.nextafter(math.pi, 4.0)]) + math.pi) < 1e-15)


BATCHES = arrays(float, (4, 3), elements=st.floats(-3.0, 3.0))


@law(BATCHES, BATCHES)
def test_se2_functions_of_a_batch_are_a_loop(a, b):
    # vector instructions may round the last place differently
    assert_equal = partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-13)
    for function in (se2.exp, se2.log, se2.inverse, se2.adjoint, se2.right_jacobian, se2.right_jacobian_inverse):
        assert_equal(function(a), np.stack([function(row) for row in a]))
        assert_equal(function(a.reshape(2, 2, 3))[1, 0], function(a)[2])
    for function in (se2.compose, se2.between):
        assert_equal(function(a, b), np.stack([function(p, q) for p, q in zip(a, b, strict=True)]))
        assert_equal(function(a[0], b), np.stack([function(a[0], q) for q in b]))  # broadcasting
    fractions = np.linspace(0.0, 1.0, 4)
    looped = [se2.interpolate(p, q, f) for p, q, f in zip(a, b, fractions, strict=True)]
    assert_equal(se2.interpolate(a, b, fractions), np.stack(looped))


@law(POSES, POSES)
def test_se2_functions_leave_inputs_unchanged(a, b):
    before = a.copy(), b.copy()
    se2.compose(a, b), se2.interpolate(a, b, 0.3), se2.log(a), se2.exp(a), se2.right_jacobian(a), se2.transform(a, b[:2])
    assert np.array_equal(a, before[0])
    assert np.array_equal(b, before[1])


@pytest.mark.extended
def test_jit_cache_of_parallel_processes_can_be_loaded(tmp_path):
    """Without a lock, two in three such starts end with a crash, and so does every later one."""
    shutil.copy(se2.__file__, tmp_path / "se2.py")
    code = "import numpy as np, se2; print(se2.compose(np.ones(3), np.ones(3)).tolist(), se2.log(np.ones(3)).tolist())"
    command, environment = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": str(tmp_path)}
    first = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    outputs = [process.communicate(timeout=120)[0] for process in first]
    outputs.append(subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, timeout=120, check=False).stdout)
    expected = f"{se2.compose(np.ones(3), np.ones(3)).tolist()} {se2.log(np.ones(3)).tolist()}\n"
    assert outputs == [expected] * 4
