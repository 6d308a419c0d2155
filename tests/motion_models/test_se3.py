"""SE(3): exponential, logarithm and adjoint against matrix exponentials."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from motion_models import se3

ANGLES = [0.0, 1e-7, 1e-3, 1.0, 3.0]


def tangent(angle, seed=1):
    made = np.random.default_rng(seed).normal(size=6)
    made[3:] *= angle / np.linalg.norm(made[3:])
    return made


def matrix(t):
    made = np.zeros((4, 4))
    made[:3, :3], made[:3, 3] = se3.cross(t[3:]), t[:3]
    return made


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_exp_is_the_matrix_exponential(angle):
    np.testing.assert_allclose(se3.exp(tangent(angle)), expm(matrix(tangent(angle))), atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_log_inverts_exp(angle):
    np.testing.assert_allclose(se3.log(se3.exp(tangent(angle))), tangent(angle), atol=1e-9)


def test_se3_log_of_a_half_turn_is_a_half_turn():
    for axis in np.eye(3):
        found = se3.rotation_vector(se3.rotation(np.pi * axis))
        np.testing.assert_allclose(np.abs(found), np.pi * axis, atol=1e-7)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_adjoint_moves_a_perturbation_to_the_left(angle):
    pose, t = se3.exp(tangent(angle)), 0.1 * tangent(1.0, seed=2)
    np.testing.assert_allclose(pose @ se3.exp(t), se3.exp(se3.adjoint(pose) @ t) @ pose, atol=1e-12)


def test_se3_inverse_composes_to_the_identity():
    pose = se3.exp(tangent(2.0))
    np.testing.assert_allclose(se3.compose(pose, se3.inverse(pose)), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.transform(pose, np.ones((2, 3)))[1], (pose @ np.ones(4))[:3], atol=1e-12)
