"""Estimators on synthetic steps, for the tests of the graph and for its studies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localization.estimators.ekf import BIAS, EkfConfig
from localization.estimators.fusion import EkfFusion
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from motion_models import se2
from motion_models.corrections import corrections
from motion_models.registry import make_model
from motion_models.robot import load_robot
from tests.synthetic_steps import Noise, Seer, World, drive, weave

BOTH = ("ekf", "graph")


def make(kind, seer, model="skid_steer", form="constant", noise=None, has_lidar=True, **config):
    noise = noise or Noise()
    robot = replace(load_robot("husky_a200"), wheel_noise=noise.wheels, gyro_noise=noise.gyro)
    model = make_model(model, robot)
    corrected = corrections(model, form)
    if kind == "ekf":
        return EkfFusion(model, corrected, robot, {}, has_lidar, EkfConfig(), witness=seer)
    return GraphFusion(model, corrected, robot, {}, has_lidar, GraphConfig(**config), EkfConfig(), witness=seer)


def make_world(estimator, seed, noise=None, has_lidar=True, wheels=weave, **more):
    return World(
        estimator._model, estimator._corrected, noise or Noise(), np.random.default_rng(seed), has_lidar, EkfConfig(), wheels, **more
    )


def run(estimator, seer, seed=0, steps=60, **world):
    """All estimates of a drive, and the true poses (steps, 3)."""
    found, truth = [], []
    for estimate, pose in drive(make_world(estimator, seed, **world), estimator, seer, steps):
        found.append(estimate)
        truth.append(pose)
    return found, np.array(truth)


def apart(poses, covariances, others):
    """(N,) distances of ``poses`` (N, 3) from ``others``, in sigmas of the former's marginals, by the worst coordinate; 0.1 mm and 0.1 mrad
    count as none."""
    sigmas = np.sqrt(np.maximum(covariances.diagonal(axis1=1, axis2=2), 1e-8))
    return np.abs(se2.log(se2.between(poses, others)) / sigmas).max(axis=1)


def recorded(seed=0, steps=60, model="skid_steer", form="constant", learn=("clock",), **world):
    """The steps of a drive and what the LiDAR saw, as a fixed lag was given them: for back ends that are to get the very same.

    Steps are cut by what is believed of the clock and the model, so they are right only for estimators that come to believe the same.
    """
    seer, found = Seer(), []
    estimator = make("graph", seer, model, form, learn=learn)
    inner = estimator.step
    estimator.step = lambda step: (found.append((step, seer.next)), inner(step))[1]  # type: ignore[method-assign]
    run(estimator, seer, seed, steps, **world)
    return found


def feed(estimator, seer, steps):
    """The estimates of recorded steps."""
    found = []
    for step, seer.next in steps:
        found.append(estimator.step(step))
    return found


def beliefs(estimator):
    """Mean (m,) of the slow states, and the joint covariance (3 + m, 3 + m) of pose and slow states."""
    if isinstance(estimator, GraphFusion):
        return estimator._now.slow, estimator.covariance()
    ekf = estimator._ekf
    index = [0, 1, 2, *range(BIAS, len(ekf.covariance))]
    return np.concatenate([[ekf.bias, ekf.clock_offset], ekf.correction]), ekf.covariance[np.ix_(index, index)]


def squared_errors(kind, seed, steps, noise, model="skid_steer", form="constant", has_lidar=True):
    """Normalised squared errors of the pose, of the slow states and of all, and which slow states are inside their 90 % intervals."""
    seer = Seer()
    estimator = make(kind, seer, model, form, noise, has_lidar)
    world = make_world(estimator, seed, noise, has_lidar)
    for estimate, truth in drive(world, estimator, seer, steps):  # noqa: B007
        pass
    slow, P = beliefs(estimator)
    error = np.concatenate([se2.log(se2.between(estimate.pose, truth)), world.slow - slow])
    inside = np.abs(error[3:]) < 1.6449 * np.sqrt(np.diag(P)[3:])
    parts = (slice(0, 3), slice(3, None), slice(0, None))
    return [float(error[p] @ np.linalg.solve(P[p, p], error[p])) for p in parts], inside, [len(error[p]) for p in parts]
