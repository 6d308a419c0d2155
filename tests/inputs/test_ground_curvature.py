"""Curvature of the ground by the change of tilt along the way, and the load that it moves from one diagonal of wheels to the other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.inputs.ground_curvature import GroundCurvature
from motion_models.friction.slope_effect import SlopeEffect
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

HESSIAN = np.array([[0.03, -0.02], [-0.02, 0.05]])
STEP_M, STEP_RAD, SIGMA = 0.035, 0.02, 2e-4


def _axes(yaw):
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def _advance(found, hessians, way, turn, rng, yaw=0.0, gradient=(0.0, 0.0)):
    """Advance over ground whose curvature in the world is ``hessians`` (n, 2, 2); heading at the end."""
    gradient = np.array(gradient)
    for H in hessians:
        before, gradient = -_axes(yaw).T @ gradient, gradient + H @ _axes(yaw) @ [way, 0.0]
        yaw += turn
        noise = math.hypot(SIGMA, 2e-3 * math.sqrt(abs(way))) * rng.normal(size=2)
        found.advance(before, -_axes(yaw).T @ gradient + noise, (way, turn), SIGMA**2)
    return yaw


@pytest.mark.parametrize("way", [STEP_M, -STEP_M], ids=["ahead", "back"])
def test_ground_curvature_on_an_arc_finds_the_twist(way):
    found, rng = GroundCurvature(), np.random.default_rng(1)
    yaw = _advance(found, np.tile(HESSIAN, (150, 1, 1)), way, STEP_RAD, rng)
    twist, sigma = found.twist
    assert twist == pytest.approx((_axes(yaw).T @ HESSIAN @ _axes(yaw))[0, 1], abs=3.0 * sigma)
    yaw = _advance(found, np.tile(HESSIAN, (40, 1, 1)), 0.0, math.pi / 160.0, rng, yaw)  # in place: the axes turn, not the ground
    twist, sigma = found.twist
    assert twist == pytest.approx((_axes(yaw).T @ HESSIAN @ _axes(yaw))[0, 1], abs=3.0 * sigma)


@pytest.mark.parametrize(("amplitude", "low", "high"), [(0.0, 0.0, 0.007), (0.03, 0.024, 0.036)], ids=["plane", "hills"])
def test_root_mean_square_is_that_of_the_ground_along_the_way(amplitude, low, high):
    """Waves of 12 m of a root mean square curvature ``amplitude``, on a straight way. Bumps alone are below what counts as hills."""
    found, rng = GroundCurvature(), np.random.default_rng(4)
    assert found.root_mean_square == 0.0
    waves = math.sqrt(2.0) * amplitude * np.sin(2.0 * math.pi / 12.0 * STEP_M * np.arange(2000))
    _advance(found, waves[:, None, None] * np.diag([1.0, 0.0]), STEP_M, 0.0, rng)
    assert low <= found.root_mean_square < high


def test_ground_curvature_variance_is_that_of_its_errors():
    """Monte Carlo: curvature by its prior and its process along the way; the mean of 400 squared errors is 1 within .07 (1 sigma)."""
    rng, squares = np.random.default_rng(2), []
    a, kept = math.radians(6.0) / 3.0, math.exp(-STEP_M / 3.0)
    root = np.linalg.cholesky(a * a / 3.0 * np.array([[3.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 3.0]]))
    for _ in range(400):
        found, rows = GroundCurvature(), [root @ rng.normal(size=3)]
        for _ in range(60):
            rows.append(kept * rows[-1] + math.sqrt(1.0 - kept * kept) * root @ rng.normal(size=3))
        hessians = np.array([[[xx, xy], [xy, yy]] for xx, xy, yy in rows[1:]])
        yaw = _advance(found, hessians, STEP_M, STEP_RAD, rng)
        true = (_axes(yaw).T @ hessians[-1] @ _axes(yaw))[0, 1]
        twist, sigma = found.twist
        squares.append(((twist - true) / sigma) ** 2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.2)
    assert sigma**2 < 0.5 * a * a / 3.0


def test_slope_effect_of_twisted_ground_slides_more():
    """A diagonal of wheels that carries the robot lets it slide more than four wheels do, whichever it is."""
    robot = load_robot("husky_a200")
    effect, skid = SlopeEffect.from_robot(robot), make_model("skid_steer", robot)
    assert effect.warp_of(0.01) > 0.0
    cg, downhill = np.zeros((1, 2)), np.array([[0.0, 0.1]])

    def slide(turn, warp):
        return effect.twist(skid, np.array([[-turn, turn]]), cg, skid.nominal, downhill, (warp, 0.0)).twist.value[0, 1]

    assert min(slide(2.0, 0.8), slide(2.0, -0.8)) > 1.15 * slide(2.0, 0.0) > 0.0
    assert slide(2.0, 0.8) == pytest.approx(slide(-2.0, -0.8), rel=1e-6)  # mirrored, front and rear exchanged


@pytest.mark.extended
@pytest.mark.parametrize("mean", [0.0, 0.5])
def test_slope_effect_covariance_holds_uncertain_loads(mean):
    """Monte Carlo: loads on the diagonals drawn from their distribution, against the motion at their mean."""
    robot, sigma = load_robot("husky_a200"), 0.5
    effect, skid = SlopeEffect.from_robot(robot), make_model("skid_steer", robot)

    def motion(load, spread):
        return effect.twist(skid, np.array([[-2.0, 2.0]]), np.zeros((1, 2)), skid.nominal, np.array([[0.0, 0.1]]), (load, spread))

    drawn = np.random.default_rng(5).normal(mean, sigma, 1000)
    slides, found = np.array([motion(load, 0.0).twist.value[0, 1] for load in drawn]), motion(mean, sigma)
    off = math.sqrt(np.mean((slides - found.twist.value[0, 1]) ** 2))
    assert math.sqrt((found.by_warp[0] @ found.by_warp[0].T)[1, 1]) == pytest.approx(off, rel=0.2)
