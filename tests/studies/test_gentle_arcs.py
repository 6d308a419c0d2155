"""Gentle arcs (tests/studies/gentle_arcs.py): predictions of the friction model and measurements of the thesis."""

import numpy as np
import pytest

from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.studies.friction_grid import fitted, friction, grid
from tests.studies.gentle_arcs import (
    GENTLE,
    TRAJECTORIES,
    compare,
    configurations,
    losses,
    path,
    share_left,
    table_5_2,
    vision_error,
)

pytestmark = pytest.mark.xdist_group("gentle_arcs")

MODEL, THESIS = friction(), friction("thesis")
FITTED, FITTED_THESIS = (fitted(model=model)[0].params for model in (MODEL, THESIS))
KINDS = pytest.mark.parametrize("kind", ["four fitted", "nothing fitted"])


@pytest.fixture(scope="module")
def rows():
    return compare(FITTED, configurations(FITTED))


@pytest.fixture(scope="module")
def thesis_rows():
    return compare(FITTED_THESIS, configurations(FITTED_THESIS, THESIS), THESIS)


@KINDS
def test_k_on_gentle_arcs_with_centred_cg_is_that_in_place(kind):
    by_arc = {(loss.vx, loss.wz): loss for loss in losses(FITTED if kind == "four fitted" else MODEL.nominal)}
    for wz in (0.5, 0.2, 0.1, 0.05):
        assert by_arc[0.5, wz].k_centred == pytest.approx(1.0, abs=0.02)
    # x_CR's slope on x_G falls from 2.2 towards 1, that of proportional tyres
    slopes = [by_arc[0.5, wz].x_cr for wz in (0.5, 0.2, 0.1, 0.05)]
    assert slopes == sorted(slopes, reverse=True)
    assert slopes[-1] == pytest.approx(0.5, abs=0.03)
    # a rotation in place does not depend on its speed
    assert by_arc[0.0, 0.1].k == pytest.approx(1.0, abs=1e-6)


@KINDS
def test_k_on_gentle_arcs_by_the_thesis_law_is_a_quarter_less(kind):
    by_arc = {(loss.vx, loss.wz): loss for loss in losses(FITTED_THESIS if kind == "four fitted" else THESIS.nominal, THESIS)}
    gentle = by_arc[0.5, 0.1]
    assert gentle.k_centred == pytest.approx(0.75, abs=0.03)
    assert gentle.x_cr == pytest.approx(0.65, abs=0.05)
    k = [by_arc[0.5, wz].k for wz in (0.5, 0.2, 0.1, 0.05)]
    assert k == sorted(k, reverse=True)


def test_table_5_2_winners_are_those_of_the_prediction(rows):
    """The heuristic must win on sharp turns, and does; on gentle arcs neither prediction nor measurement is beyond the scatter."""
    verdicts = {row.trajectory: row.verdict for row in rows}
    assert {name for name, verdict in verdicts.items() if verdict == "undecided"} == set(GENTLE)
    assert not [name for name, verdict in verdicts.items() if verdict == "must lose"]
    for row in rows:
        if row.verdict == "must win":
            assert row.measured_loss[0] < 0


def test_gentle_arcs_errors_are_a_fourth_of_the_thesis_law(rows, thesis_rows):
    def rms(found, names):
        return float(np.sqrt(np.mean([(row.predicted - row.measured) ** 2 for row in found if row.trajectory in names])))

    assert rms(thesis_rows, GENTLE) > 0.058
    assert rms(rows, GENTLE) <= 0.015
    assert rms(thesis_rows, TRAJECTORIES) > 0.049
    assert rms(rows, TRAJECTORIES) <= 0.038


def test_heuristic_by_the_thesis_law_loses_on_gentle_arcs_only(thesis_rows):
    assert {row.trajectory for row in thesis_rows if row.predicted_loss > 0} == set(GENTLE)


def test_heuristic_by_the_thesis_law_loses_there_at_any_cg():
    """Not only at the configurations' inferred CGs: as a mean over the thesis's whole grid too."""
    skid, diff = (make_model(name, load_robot("vaultbot")) for name in ("skid_steer", "diff_drive"))
    cg = grid().cg
    errors = {
        name: [vision_error(name, cg, controller, FITTED_THESIS, THESIS).mean() for controller in (skid, diff)] for name in TRAJECTORIES
    }
    assert {name for name, (by_skid, by_diff) in errors.items() if by_skid > by_diff} == set(GENTLE)


def test_heuristic_wins_and_losses_of_the_six_are_the_documented_ones(rows):
    measured = {row.trajectory: row.measured_loss for row in rows}
    assert {name for name, (loss, _) in measured.items() if loss > 0} == {"arc_1", "arc_4"}
    # On the two that it lost, it lost by less than the scatter over configurations.
    assert measured["arc_2"][0] == pytest.approx(-0.012, abs=5e-4)
    for name in ("arc_1", "arc_4"):
        assert measured[name][0] < 2 * measured[name][1]
    # Beyond doubt is this: two fifths of the error goes on sharp turns, none of it on gentle arcs.
    assert share_left(rows, gentle=False) == pytest.approx(0.59, abs=0.01)
    assert share_left(rows, gentle=True) == pytest.approx(1.0, abs=0.02)


def test_table_5_2_means_are_those_of_the_model_reference(rows):
    means = {row.trajectory: row.measured.mean(axis=0).round(3).tolist() for row in rows}
    assert means == {
        "arc_1": [0.038, 0.031],
        "arc_2": [0.028, 0.040],
        "arc_3": [0.022, 0.052],
        "arc_4": [0.042, 0.037],
        "rotate": [0.033, 0.108],
        "s_curve": [0.137, 0.163],
    }
    assert len(table_5_2()) == 84


def test_inferred_cgs_agree_with_the_one_in_the_text():
    """Sec. 5.2: under diff-drive the ready configuration turned by 133.39 degrees where 86.70 were wanted: a ratio of 1.54."""
    ready = configurations(FITTED)["ready"]
    diff = make_model("diff_drive", load_robot("vaultbot"))
    wheels = diff.wheels(np.array([0.0, 0.3]), ready, diff.nominal)
    assert friction().twist(wheels, ready, FITTED).value[2] / 0.3 == pytest.approx(133.39 / 86.70, rel=0.05)


def test_winners_in_reverse_are_predicted(rows):
    """arc_4 is driven backwards: a CG ahead, which wins forwards, loses there, and the other way round."""
    row = next(r for r in rows if r.trajectory == "arc_4")
    loss = [r[:, 0] - r[:, 1] for r in (row.predicted, row.measured)]
    assert np.corrcoef(loss[0], loss[1])[0, 1] > 0.65
    rotate = next(r for r in rows if r.trajectory == "rotate")
    assert np.corrcoef(*(r[:, 0] - r[:, 1] for r in (rotate.predicted, rotate.measured)))[0, 1] > 0.95


def test_path_is_the_composition_of_its_steps():
    twist = np.random.default_rng(0).normal(size=(40, 3))
    pose = np.zeros(3)
    for i, step in enumerate(twist):
        pose = se2.compose(pose, se2.exp(step * 0.05))
        np.testing.assert_allclose(path(twist)[i], pose[:2], atol=1e-12)


def test_odometry_of_the_robot_itself_has_no_error():
    assert float(vision_error("arc_1", np.zeros(2), friction(), friction().nominal)) < 1e-12
