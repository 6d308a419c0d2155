"""Loop detection in simulated rooms: places that are visited again are found, places that look alike are not taken for one another."""

from __future__ import annotations

import numpy as np
import pytest

from localization.lidar import LidarConfig
from localization.lidar.correlative_search import draw_image, search
from localization.lidar.loop_detection import Keyframe, LoopClosure, LoopDetector, within_reach
from localization.simulation import world
from motion_models import se2
from tests.helpers import rooms

CELL = 0.08
LAB = world.lab().walls
NEAR, WIDE = np.diag([0.1, 0.1, 0.03]) ** 2, np.diag([2.0, 2.0, 0.1]) ** 2
AWAY = np.array([100.0, 100.0, 0.0])


def visit(walls: np.ndarray, n: int, seed: int, start: tuple[float, float] = (-1.0, 0.0)) -> list[tuple[np.ndarray, np.ndarray]]:
    """``n`` poses (3,) 0.3 m apart along x, and their scans."""
    rng = np.random.default_rng(seed)
    poses = [np.array([start[0] + 0.3 * k, start[1] + 0.02 * k, 0.02 * k]) for k in range(n)]
    return [(pose, rooms.scan_from(walls, pose, rng, beams=360)) for pose in poses]


def detect(frames: list[tuple[np.ndarray, np.ndarray]], poses: np.ndarray, marginal: np.ndarray) -> list[LoopClosure]:
    """What is found on the way along keyframes that a drifting graph has at ``poses`` (n, 3)."""
    detector, found = LoopDetector(LidarConfig()), []
    for k, (pose, points) in enumerate(frames):
        detector.add(Keyframe(poses[k], points))
        found.append(detector.detect(CELL, lambda k=k: poses[: k + 1], lambda k: marginal))
        del pose
    return [loop for loop in found if loop is not None]


def there_and_back(
    first: np.ndarray, second: np.ndarray, second_start: tuple[float, float] = (-0.9, 0.1)
) -> list[tuple[np.ndarray, np.ndarray]]:
    """A visit of one room, 30 keyframes far away without points, a visit of another."""
    absent = [(AWAY, np.empty((0, 2)))] * 30
    return [*visit(first, 8, 1), *absent, *visit(second, 8, 2, second_start)]


@pytest.mark.parametrize("drift", [np.zeros(3), np.array([0.5, -0.3, 0.08])])
def test_detect_at_revisited_place_gives_its_pose(drift: np.ndarray) -> None:
    frames = there_and_back(LAB, LAB)
    truth = np.array([pose for pose, _ in frames])
    poses = truth.copy()
    poses[38:] = se2.compose(drift, truth[38:])
    found = detect(frames, poses, np.diag([0.3, 0.3, 0.05]) ** 2)
    assert [loop.b for loop in found] == [38, 43]  # each has new scans
    for loop in found:
        error = se2.log(se2.between(se2.between(truth[loop.a], truth[loop.b]), loop.delta))
        assert loop.a < 8 <= 38 <= loop.b
        assert np.abs(error / np.sqrt(np.diag(loop.cov))).max() < 4.0


def test_detect_after_closed_loop_waits_for_new_scans() -> None:
    """None shares a scan with the one before."""
    frames = there_and_back(LAB, LAB)[:38] + visit(LAB, 16, 2, (-0.9, 0.1))
    ends = [loop.b for loop in detect(frames, np.array([pose for pose, _ in frames]), NEAR)]
    assert len(ends) == 4
    assert np.diff(ends).min() >= 5


@pytest.mark.parametrize("is_unsure", [True, False])
def test_detect_in_equal_rooms_uses_the_graphs_covariance(is_unsure: bool) -> None:
    """Two equal rooms, 2.8 m apart, both visited before; a third visit is in one of them."""
    room = world.box(-1.3, -1.3, 1.3, 1.3)
    pair = np.concatenate([room, room + np.array([2.8, 0.0, 2.8, 0.0, 0.0])])
    absent = [(AWAY, np.empty((0, 2)))] * 30
    frames = [*visit(pair, 4, 1, (-0.5, 0.0)), *visit(pair, 4, 2, (2.3, 0.0)), *absent, *visit(pair, 4, 3, (-0.4, 0.1))]
    found = detect(frames, np.array([pose for pose, _ in frames]), WIDE if is_unsure else NEAR)
    assert bool(found) is not is_unsure


def test_detect_in_another_room_closes_no_loop() -> None:
    """Where the graph takes the one for the other: another furniture, another size."""
    other = np.concatenate([world.box(-3, -2.5, 3.5, 3.0), world.pillar(1.5, 2.0), world.box(-3, 1, -2, 3.0)])
    frames = there_and_back(LAB, other)
    assert detect(frames, np.array([pose for pose, _ in frames]), NEAR) == []


def test_detect_in_open_corridor_closes_no_loop() -> None:
    walls = np.concatenate([world.line(-60, -1.2, 60, -1.2), world.line(-60, 1.2, 60, 1.2)])
    frames = there_and_back(walls, walls)
    assert detect(frames, np.array([pose for pose, _ in frames]), WIDE) == []


def test_detect_among_successive_keyframes_closes_no_loop() -> None:
    frames = visit(LAB, 8, 1) * 3
    assert detect(frames, np.array([pose for pose, _ in frames]), NEAR) == []


def test_detect_with_empty_scans_closes_only_true_loops() -> None:
    frames = there_and_back(LAB, LAB)
    truth = np.array([pose for pose, _ in frames])
    for k in (2, 40, 43):
        frames[k] = (frames[k][0], np.empty((0, 2)))
    found = detect(frames, truth, NEAR)
    assert found
    assert not {2, 40, 43} & {loop.b for loop in found}


def test_detect_at_place_without_scans_closes_no_loop() -> None:
    """The scanner was covered there; of the place before it hardly anything is within reach."""
    frames = there_and_back(LAB, LAB)
    back = (AWAY, rooms.scan_from(LAB, np.zeros(3), np.random.default_rng(4)))
    frames = [*frames[:38], *[back] * 8]
    assert detect(frames, np.array([pose for pose, _ in frames]), NEAR) == []


@pytest.mark.parametrize("cov", [NEAR, WIDE])
def test_within_reach_leaves_search_result_unchanged(cov: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    place = np.vstack([rooms.scan_from(LAB, np.zeros(3), rng), rng.uniform(-60.0, 60.0, (500, 2))])
    points, prior = rooms.scan_from(LAB, np.array([0.4, 0.2, 0.1]), rng, beams=180), np.array([0.3, 0.3, 0.12])
    limit = np.array([3.2, 3.2, 0.5])
    drawn = within_reach(place, points, prior, cov, limit)
    assert len(drawn) < len(place)
    whole, part = (search(draw_image(p, CELL), points, prior, cov, limit) for p in (place, drawn))
    assert part.pose == pytest.approx(whole.pose, abs=CELL)
    assert part.score == pytest.approx(whole.score, abs=0.1)  # the cells lie elsewhere


def test_detect_with_scanner_to_one_side_closes_no_loop() -> None:
    """On the way back it sees the other wall, far from all that it saw before."""
    rng, there, back = np.random.default_rng(6), [], []
    for k in range(30):
        along = np.column_stack([rng.uniform(-3.0, 3.0, 200), np.full(200, 3.0) + rng.normal(0.0, 0.01, 200)])
        there.append((np.array([float(k), 0.0, 0.0]), along))
        back.append((np.array([29.0 - k, 0.0, np.pi]), along))
    frames = [*there, *back]
    assert detect(frames, np.array([pose for pose, _ in frames]), NEAR) == []


def test_detect_of_robot_that_turns_on_the_spot_closes_no_loop() -> None:
    """Its scans are all in the filter's own submap."""
    rng = np.random.default_rng(7)
    poses = [np.array([0.0, 0.0, 0.5 * k]) for k in range(60)]
    frames = [(pose, rooms.scan_from(LAB, pose, rng, beams=360)) for pose in poses]
    assert detect(frames, np.array(poses), NEAR) == []
