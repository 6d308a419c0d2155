"""Filter and graph on the same steps: they agree, they are honest, and what they learn is worth having."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from localization.consistency import mean_band
from localization.estimators.ekf import EkfConfig
from localization.lidar import Revisit
from localization.lidar.track import Place, moved
from localization.logs import open_log
from localization.run import Pair, replay
from motion_models import se2
from motion_models.corrections import corrections
from motion_models.registry import MODELS, make_model
from motion_models.robot import load_robot
from tests.graph_help import BOTH, apart, make, run, squared_errors
from tests.synthetic_steps import DT, Noise, Seer, World

DATA = Path(__file__).parent / "data"
LEVELS = (0.3, 1.0, 2.0, 4.0)
SURE = np.diag([0.01, 0.01, 0.002]) ** 2


# --- they agree


@pytest.mark.parametrize(("model", "form"), [("skid_steer", "constant"), ("skid_steer", "cg_field"), ("diff_drive", "constant")])
@pytest.mark.parametrize("has_lidar", [True, False])
def test_filter_and_fixed_lag_agree_on_synthetic_drives(model, form, has_lidar):
    for seed in range(3):
        seers = [Seer(), Seer()]
        estimators = [make(kind, seer, model, form, has_lidar=has_lidar) for kind, seer in zip(BOTH, seers, strict=True)]
        ekf, graph = (run(e, seer, seed, 120, has_lidar=has_lidar)[0] for e, seer in zip(estimators, seers, strict=True))
        poses, others = (np.array([e.pose for e in part]) for part in (ekf, graph))
        covariances = np.array([e.covariance for e in ekf])
        assert apart(poses, covariances, others).max() < 1.0
        # one linearises where the wheels said, the other where it is now: that differs more where the gyro alone corrects the heading
        rtol = 0.25 if has_lidar else 0.4
        mine, theirs = (c.diagonal(axis1=1, axis2=2)[10:] for c in (covariances, np.array([e.covariance for e in graph])))
        np.testing.assert_allclose(np.hypot(*np.sqrt(theirs[:, :2].T)), np.hypot(*np.sqrt(mine[:, :2].T)), rtol=rtol)
        np.testing.assert_allclose(np.sqrt(theirs[:, 2]), np.sqrt(mine[:, 2]), rtol=0.05)
        for name, (mean, sigma) in estimators[0].parameters().items():
            other, its = estimators[1].parameters()[name]
            assert abs(mean - other) < 0.1 * sigma
            assert its == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize(
    ("log", "robot", "seconds"), [("aces/aces.mcap", "aces", 60.0), ("husky-outdoor-gps/test1.bag", "husky_a200", 60.0)]
)
def test_filter_and_fixed_lag_agree_on_real_logs(log, robot, seconds):
    """On the first part of each; the whole of both is in the benchmark."""
    robot = load_robot(robot)
    opened = open_log(DATA / log, robot)
    events = opened.events()
    first = next(events)
    until = first.stamp_ns + round(seconds * 1e9)
    part = itertools.takewhile(lambda e: e.stamp_ns < until, itertools.chain([first], events))
    model = make_model("diff_drive", robot)
    ekf, graph = replay(part, [Pair(model, kind) for kind in BOTH], robot, opened.mounts, has_lidar="aces" in log)
    assert len(ekf.trajectory) > 100
    assert apart(ekf.trajectory.poses, ekf.trajectory.covariances, graph.trajectory.poses).max() < 1.0
    for name, (mean, sigma) in ekf.parameters.items():
        other, its = graph.parameters[name]
        assert abs(mean - other) < sigma
        assert its == pytest.approx(sigma, rel=0.15)


# --- every model, every form


@pytest.mark.parametrize("form", ["constant", "cg_field"])
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("kind", BOTH)
def test_every_model_learns_in_every_form(kind, name, form):
    """What a drive both ways shows is known better than at first, and is where the truth is."""
    seer = Seer()
    estimator = make(kind, seer, name, form)
    names, sigmas = estimator._corrected.names, estimator._corrected.sigmas
    assert names
    run(estimator, seer, 3, 100)
    found = estimator.parameters()
    after = np.array([found[n][1] for n in names])
    assert (after <= 1.02 * sigmas).all()
    assert (after < 0.8 * sigmas).any()
    assert np.isfinite(estimator.params).all()


# --- they are honest: NEES at four levels of noise


@pytest.fixture(scope="module", params=BOTH)
def honesty(request):
    """Squared errors (levels, seeds, 3) of pose, slow states and all, insides (levels, seeds, m), and degrees of freedom, after 10 s."""
    found = [[squared_errors(request.param, 1000 * i + s, 100, Noise().scaled(f)) for s in range(SEEDS)] for i, f in enumerate(LEVELS)]
    return np.array([[r[0] for r in level] for level in found]), np.array([[r[1] for r in level] for level in found]), found[0][0][2]


SEEDS = 12


@pytest.mark.parametrize("level", range(len(LEVELS)))
def test_errors_are_as_large_as_is_said(honesty, level):
    """Twelve means of pose, parameters and all, for each estimator: the band holds all of them together with 95 %."""
    values, _, dof = honesty
    for part, d in enumerate(dof):
        low, high = mean_band(SEEDS, d, 1.0 - 0.05 / 24)
        assert low < values[level, :, part].mean() < high


def test_and_over_all_levels_closer_still(honesty):
    values, inside, dof = honesty
    for part, d in enumerate(dof):
        low, high = mean_band(SEEDS * len(LEVELS), d, 1.0 - 0.05 / 6)
        assert low < values[..., part].mean() < high
    # 90 % intervals, of 4 x 12 runs: all but a few
    assert 0.8 < inside[..., 2:].mean() < 0.98


# --- what is learned at one posture of the arms is remembered

POSTURES = ((0.09, 0.0), (-0.05, 0.02), (0.02, -0.02))
ON_EACH = 60  # steps


def posture(t):
    return POSTURES[int(t / (ON_EACH * DT)) % len(POSTURES)]


def round_trip(kind, form, seed):
    """A robot whose regressions are not those of its file, its arms twice in each of three postures, seen by an estimator.

    Error of the odometry on each posture (6, 3), and of the believed rotation scaling at the first and the last three steps of each (6, 2).
    """
    seer, quiet = Seer(), Noise().scaled(0.3)
    estimator = make(kind, seer, "skid_steer", form, quiet)
    model, field = estimator._model, corrections(estimator._model, "cg_field")
    world = World(model, field, quiet, np.random.default_rng(seed), True, EkfConfig(), cg=posture)
    odometry, start, drifts, scalings = np.zeros(3), np.zeros(3), [], []
    estimator.step(world.first())
    for i in range(2 * len(POSTURES) * ON_EACH):
        step, seer.next = world.step(estimator.params, estimator.clock_offset_s)
        odometry = se2.compose(odometry, step.predicted.delta)
        wheels, cg = np.array([[2.0, 4.0]]), np.array([posture(world.t - 0.5 * DT)])
        true, believed = (
            model.twist(wheels, cg, p).value[0, 2] for p in (model.nominal + field.directions @ world.correction, estimator.params)
        )
        scalings.append(abs(believed / true - 1.0))
        estimator.step(step)
        if (i + 1) % ON_EACH == 0:
            drifts.append(se2.log(se2.between(se2.between(start, world.pose), odometry)))
            odometry, start = np.zeros(3), world.pose
    each = np.array(scalings).reshape(-1, ON_EACH)
    return np.array(drifts), np.stack([each[:, :3].mean(axis=1), each[:, -3:].mean(axis=1)], axis=1)


@pytest.mark.parametrize("kind", BOTH)
def test_what_was_learned_at_a_posture_is_there_when_the_arms_return(kind):
    found = {form: [round_trip(kind, form, seed) for seed in range(5)] for form in ("constant", "cg_field")}
    drift = {form: np.array([d for d, _ in runs])[:, 3:] for form, runs in found.items()}
    metres = {form: np.hypot(d[..., 0], d[..., 1]).mean() for form, d in drift.items()}
    turns = {form: np.abs(d[..., 2]).mean() for form, d in drift.items()}
    assert metres["cg_field"] < 0.75 * metres["constant"]
    assert turns["cg_field"] < 0.75 * turns["constant"]
    k = np.array([k for _, k in found["cg_field"]]).mean(axis=0)
    # back at a posture it is at once as good as when it left it, give or take half a percent: nothing converges anew
    assert (k[3:, 0] < k[:3, 1] + 0.005).all()
    again = np.array([k for _, k in found["constant"]]).mean(axis=0)[3:, 0]
    assert (k[3:, 0] < 0.75 * again).all()


@pytest.mark.parametrize("kind", BOTH)
def test_gentle_arcs_do_not_teach_what_was_measured_on_turns(kind):
    """And an arc whose turning is not believed is as uncertain as that: what is not known counts as slip."""
    sigmas = {}
    for turning in (0.2, 2.5):
        seer = Seer()
        estimator = make(kind, seer)
        run(estimator, seer, 2, 60, wheels=lambda t: (5.0 - turning, 5.0 + turning))  # noqa: B023
        sigmas[turning] = estimator.parameters()["k_0"][1] / estimator._corrected.sigmas[0]
    assert sigmas[0.2] > 0.99
    assert sigmas[2.5] < 0.7


class Remembering(Seer):
    """A witness that says once, at its ``at``-th look, that the place is the one of the beginning, off from where it is believed to be."""

    OFF = np.array([0.3, -0.2, 0.02])

    def __init__(self, at):
        super().__init__()
        self.at, self.n, self.then, self.told, self.known, self.kept = at, 0, None, [], None, []

    def recall(self, step, pose, cov):
        self.n += 1
        if self.then is None:
            self.then = Place(step.end_ns, 0.0, pose.copy(), cov.copy())
        if self.n != self.at:
            return None
        old_cov = moved(self.then, pose)
        growth = cov - old_cov + 0.5**2 * np.eye(3)  # some more drift than the way could have: the place is to be believed
        self.known = Revisit(se2.compose(pose, se2.exp(self.OFF)), SURE, old_cov, growth, 0.5**2 * np.eye(3), self.then, 1.0)
        return self.known

    def correct(self, before, after):
        self.told.append((self.n, before.copy(), after.copy()))

    def remember(self, step, pose):
        self.kept.append((self.n, pose.copy()))


@pytest.mark.parametrize(("kind", "config"), [("ekf", {}), *(("graph", {"backend": b}) for b in ("fixed_lag", "batch", "isam2"))])
def test_a_place_seen_again_moves_the_robot_and_what_it_drew_of_late(kind, config):
    """The map is told of exactly the step that the pose made, before the scan enters it; and the pose goes where the old map has it."""
    seer = Remembering(at=25)
    estimator = make(kind, seer, **config)
    estimates, _ = run(estimator, seer, seed=3, steps=40)
    ((n, before, after),) = seer.told
    assert n == 25
    np.testing.assert_allclose(dict(seer.kept)[25], after, atol=1e-12)
    gone = se2.log(se2.between(before, after))
    if config.get("backend") == "isam2":
        # it closes the loop over the whole way, whose drift it knows to be small: it goes some of the way, and no farther
        assert gone @ Remembering.OFF > 0.0
        assert np.linalg.norm(gone) < np.linalg.norm(Remembering.OFF)
    else:
        np.testing.assert_allclose(gone, Remembering.OFF, atol=0.01)
    assert estimator.counts()["revisits"] == 1
    assert all(np.linalg.eigvalsh(e.covariance).min() > 0.0 for e in estimates)
