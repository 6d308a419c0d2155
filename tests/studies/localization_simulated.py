"""Localization in maps of simulated office floors: starts, carried robots, changed and foreign maps, positions; and a particle filter.

``python -m tests.studies.localization_simulated`` puts the robot down at random in floors of `tests.helpers.office_floor`, by which no
constant was chosen, and drives for ``--keyframes`` of 0.5 m, in the map

- as it was drawn (*same*), with 10 % of the inner walls moved, removed or added (*changed*), and of another floor (*foreign*);
- as it was drawn, after it was carried from one place to another, with an odometry that knows of it or does not (*carried*, *unnoticed*);
- of a corridor with equal rooms (*equal rooms*); of the first and the third with positions of 3 m, as by GNSS.

Right is within 0.5 m and 0.2 rad. Every keyframe's probability is in the reliability table, beside those of single searches by weights that
were fitted to the other floors. *Tracked*: drives of 60 keyframes from a given pose, the share of them that is localized and right; of
those alone whose scan fits the map as it was before the change, for the drives come into rooms that the map does not have.
``--particles`` runs a particle filter by AMCL's rules over the same grid beside it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from localization.maps.grid import Grid
from localization.maps.localizer import Localizer
from localization.maps.place_probability import LIKELY, RIGHT_M, RIGHT_RAD
from localization.maps.place_search import PlaceMap
from localization.maps.position_plane import PositionFix
from motion_models import se2
from tests.helpers import floor_plan, office_floor
from tests.studies.localization_reliability import Moment, RecordedSearches, Search, draw, held_out, table

_COV = np.diag([0.02, 0.02, 0.01]) ** 2
_CARRIED = np.diag([3.0, 3.0, 1.5]) ** 2
_MAPPED_SCORE = 0.5
_AMCL_KINDS = ("same", "changed", "foreign")
Guess = tuple[np.ndarray, float, bool]
"""Pose (3,), probability, and whether it is said to be localized."""


class ParticleFilter:
    """Global localization as AMCL does it (nav2's defaults): likelihood field of 60 beams, KLD's bounds as the number of particles."""

    Z_HIT, Z_RANDOM, SIGMA_M, MAX_RANGE_M, BEAMS = 0.95, 0.05, 0.2, 8.0, 60

    def __init__(self, grid: Grid, n: int, rng: np.random.Generator) -> None:
        """``n`` particles, evenly over the free cells of ``grid``."""
        self._grid, self._rng = grid, rng
        self._distances = np.asarray(distance_transform_edt(grid.cells != 100)) * grid.resolution
        rows, columns = np.nonzero(grid.cells == 0)
        at = rng.integers(len(rows), size=n)
        xy = np.array(grid.origin) + grid.resolution * (np.column_stack([columns, rows])[at] + rng.random((n, 2)))
        self.poses, self._log_weights = np.column_stack([xy, rng.uniform(-math.pi, math.pi, n)]), np.zeros(n)

    def add(self, delta: np.ndarray, cov: np.ndarray, points: np.ndarray) -> None:
        """Move by ``delta`` (3,) with ``cov`` (3, 3), weigh by ``points`` (N, 2), resample where half of the particles are idle."""
        noise = self._rng.multivariate_normal(np.zeros(3), cov + 1e-12 * np.eye(3), len(self.poses))
        self.poses = se2.compose(self.poses, se2.compose(np.asarray(delta), noise))
        beams = points[np.linspace(0, len(points) - 1, min(self.BEAMS, len(points))).astype(int)]
        ends = se2.transform(self.poses[:, None, :], beams)
        index = np.floor((ends - np.array(self._grid.origin)) / self._grid.resolution).astype(int)
        height, width = self._distances.shape
        inside = (index >= 0).all(axis=-1) & (index[..., 0] < width) & (index[..., 1] < height)
        off = np.where(inside, self._distances[np.clip(index[..., 1], 0, height - 1), np.clip(index[..., 0], 0, width - 1)], 2.0)
        p = self.Z_HIT * np.exp(-0.5 * (np.minimum(off, 2.0) / self.SIGMA_M) ** 2) + self.Z_RANDOM / self.MAX_RANGE_M
        self._log_weights += np.log1p((p**3).sum(axis=-1))  # nav2's and AMCL's sum of cubes
        weights = self.weights
        if 1.0 / np.sum(weights**2) < 0.5 * len(weights):
            at = np.searchsorted(np.cumsum(weights), (np.arange(len(weights)) + self._rng.random()) / len(weights))
            self.poses, self._log_weights = self.poses[np.minimum(at, len(weights) - 1)], np.zeros(len(weights))

    @property
    def weights(self) -> np.ndarray:
        """(n,) that sum up to one."""
        weights = np.exp(self._log_weights - self._log_weights.max())
        return weights / weights.sum()

    def guess(self) -> Guess:
        """The heaviest place: particles within 0.5 m and 0.2 rad of the best one, and their share of the weight."""
        best, share = heaviest_place(self.poses, self.weights)
        return best, share, share > LIKELY


def heaviest_place(poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """The mean of the particles ``poses`` (n, 3) within 0.5 m and 0.2 rad of the best one, and their share of the ``weights`` (n,)."""
    best = poses[np.argmax(weights)]
    for _ in range(3):
        near = (np.hypot(*(poses - best)[:, :2].T) < RIGHT_M) & (np.abs(se2.wrap_angle(poses[:, 2] - best[2])) < RIGHT_RAD)
        if near.any():
            angle = np.angle(np.sum(weights[near] * np.exp(1j * poses[near, 2])))
            best = np.array([*np.average(poses[near, :2], axis=0, weights=weights[near]), angle])
    return best, float(weights[near].sum())


class Scene(NamedTuple):
    """Walls (W, 4), poses (K, 3) of the robot among them, and how the odometry and positions are."""

    kind: str
    walls: np.ndarray
    poses: np.ndarray
    carried_at: int = -1
    """Keyframe to which it was carried."""
    is_noticed: bool = True
    fix_m: float = 0.0
    """Sigma of positions; 0 for none [m]."""
    is_foreign: bool = False


class End(NamedTuple):
    """The last keyframe of a drive."""

    said: Moment
    state: str
    is_mapped: bool
    """Whether its scan at the true pose fits the map."""


def run_localizer(places: RecordedSearches, scene: Scene, floor: str, rng: np.random.Generator) -> tuple[list[Moment], list[Search], End]:
    """What is published after each keyframe, what the searches found, and the end."""
    localizer, moments, searches, covs = Localizer(places), [], [], {scene.carried_at: _CARRIED if scene.is_noticed else _COV}
    for k, (delta, points) in enumerate(measured(scene.walls, scene.poses, rng, scene.carried_at)):
        n_before, truth = len(places.found), scene.poses[k]
        localizer.add(points, delta, covs.get(k, _COV))
        if scene.fix_m:
            localizer.add_position(PositionFix(truth[:2] + rng.normal(0.0, scene.fix_m, 2), scene.fix_m**2 * np.eye(2)))
        for found, n in places.found[n_before:]:
            searches.append(Search(floor, found, n, is_right(found[0].pose, truth) and not scene.is_foreign))
        is_localized = localizer.state == "localized" or not localizer.hypotheses
        pose = localizer.pose if is_localized else localizer.hypotheses[0].pose
        moments.append(Moment(scene.kind, floor, localizer.probability, is_right(pose, truth) and not scene.is_foreign))
    is_mapped = not scene.is_foreign and places.align(points, scene.poses[-1]).score >= _MAPPED_SCORE
    return moments, searches, End(moments[-1], localizer.state, is_mapped)


def run_particles(n: int) -> Callable[[PlaceMap, np.ndarray, np.ndarray, np.random.Generator], Guess]:
    """The place after ``poses`` (K, 3) among ``walls`` by a particle filter of ``n``."""

    def run(places: PlaceMap, walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> Guess:
        particles = ParticleFilter(places.grid, n, rng)
        for delta, points in measured(walls, poses, rng):
            particles.add(delta, _COV, points)
        return particles.guess()

    return run


def measured(walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator, carried_at: int = -1) -> list[tuple[np.ndarray, np.ndarray]]:
    """Motion to and scan at each of ``poses``, with noise; none to that to which the robot was carried."""
    found = []
    for k, delta in enumerate(floor_plan.moves(poses)):
        moved = se2.compose(np.zeros(3) if k == carried_at else delta, rng.multivariate_normal(np.zeros(3), _COV)) if k else delta
        found.append((moved, floor_plan.scan(walls, poses[k], seed=int(rng.integers(1 << 31)))))
    return found


def is_right(found: np.ndarray, truth: np.ndarray) -> bool:
    """Whether a pose is that of the ``truth``."""
    off = se2.between(truth, found)
    return bool(math.hypot(off[0], off[1]) < RIGHT_M and abs(off[2]) < RIGHT_RAD)


def tracked_share(places: PlaceMap, before: np.ndarray, walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> float:
    """Share of the mapped of ``poses`` (K, 3) among ``walls`` that is localized and right, from the first one given on. Mapped are those
    whose scan had fitted the map among the walls ``before``."""
    localizer, right = Localizer(places, poses[0]), []
    for (delta, points), pose in zip(measured(walls, poses, rng), poses, strict=True):
        localizer.add(points, delta, _COV)
        if places.align(floor_plan.scan(before, pose), pose).score >= _MAPPED_SCORE:
            right.append(localizer.state == "localized" and is_right(localizer.pose, pose))
    return float(np.mean(right)) if right else math.nan


def scenes(walls: np.ndarray, other: np.ndarray, n: int, rng: np.random.Generator) -> list[Scene]:
    """One of each kind, with ``n`` keyframes after the start or the new place."""
    changed = office_floor.change(walls, rng)

    def drive(among: np.ndarray) -> np.ndarray:
        return office_floor.drive(among, rng, n)

    return [
        Scene("same", walls, drive(walls)),
        Scene("changed", changed, drive(changed)),
        Scene("foreign", other, drive(other), is_foreign=True),
        Scene("carried", walls, np.vstack([drive(walls), drive(walls)]), carried_at=n),
        Scene("carried unnoticed", walls, np.vstack([drive(walls), drive(walls)]), carried_at=n, is_noticed=False),
        Scene("same, positions of 3 m", walls, drive(walls), fix_m=3.0),
        Scene("foreign, positions of 3 m", other, drive(other), fix_m=3.0, is_foreign=True),
    ]


def equal_rooms(n: int, rng: np.random.Generator) -> tuple[RecordedSearches, Scene]:
    """A corridor with equal rooms, and a drive in one of them."""
    walls = office_floor.make_equal_rooms(rng)
    places = RecordedSearches(floor_plan.make_map(walls, office_floor.drive(walls, rng, 150)), 0.02)
    room = floor_plan.path((14.0, 1.0), (13.0, 1.0), (13.0, 1.0), (14.5, 1.0))
    return places, Scene("equal rooms", walls, room[:n])


def row(kind: str, ends: Sequence[End]) -> str:
    """Of the last keyframes: share right and localized of those mapped, and how many of all are localized and wrong."""
    mapped = [end for end in ends if end.is_mapped]
    shares = [[end.said.is_right for end in mapped], [end.state == "localized" for end in mapped]]
    cells = [f"{100 * np.mean(share):.0f}" if mapped else "-" for share in shares]
    localized = [end for end in ends if end.state == "localized"]
    return (
        f"| {kind} | {len(ends)} / {len(mapped)} | {' | '.join(cells)} | {len(localized)} / {sum(not e.said.is_right for e in localized)} |"
    )


def particle_rows(runs: Sequence[tuple[PlaceMap, Scene, np.random.Generator]]) -> list[str]:
    """The same by 500 and 5,000 particles."""
    lines = []
    for n in (500, 5000):
        for kind in dict.fromkeys(scene.kind for _, scene, _ in runs):
            guesses = [(run_particles(n)(places, s.walls, s.poses, rng), s) for places, s, rng in runs if s.kind == kind]
            ends = [
                End(Moment(kind, "", p, is_right(pose, s.poses[-1]) and not s.is_foreign), "localized" * is_sure, not s.is_foreign)
                for (pose, p, is_sure), s in guesses
            ]
            lines.append(row(f"{kind}, {n} particles", ends))
    return lines


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--floors", type=int, default=6)
    parser.add_argument("--first", type=int, default=100, help="seed of the first floor")
    parser.add_argument("--starts", type=int, default=15, help="on each floor and of each kind")
    parser.add_argument("--keyframes", type=int, default=8)
    parser.add_argument("--tracked", type=int, default=60, help="keyframes of a tracked drive; 0 for none")
    parser.add_argument("--particles", action="store_true")
    parser.add_argument("--figure", type=Path, help="new file for the reliability diagram, .png or .svg")
    options = parser.parse_args(words)
    ends: dict[str, list[End]] = {}
    moments: list[Moment] = []
    searches: list[Search] = []
    tracked: dict[str, list[float]] = {"same": [], "changed": []}
    runs: list[tuple[PlaceMap, Scene, np.random.Generator]] = []
    for seed in range(options.first, options.first + options.floors):
        rng = np.random.default_rng(seed)
        walls, other = office_floor.make_walls(rng), office_floor.make_walls(rng)
        places = RecordedSearches(floor_plan.make_map(walls, office_floor.drive(walls, rng, 200)), 0.02)
        todo = [(places, scene) for _ in range(options.starts) for scene in scenes(walls, other, options.keyframes, rng)]
        for where, scene in [*todo, equal_rooms(options.keyframes, rng)]:
            said, found, end = run_localizer(where, scene, f"floor {seed}", rng)
            moments, searches = [*moments, *said], [*searches, *found]
            ends.setdefault(scene.kind, []).append(end)
        if options.particles:
            runs += [(places, scene, np.random.default_rng([seed, i])) for i, (_, scene) in enumerate(todo) if scene.kind in _AMCL_KINDS]
        for scene in (scene for _, scene in todo[:2] if options.tracked):
            way = office_floor.drive(scene.walls, rng, options.tracked)
            tracked[scene.kind].append(tracked_share(places, walls, scene.walls, way, rng))
    print("| map | drives / mapped | right [%] | localized [%] | localized / wrong |")
    print("|---" * 5 + "|")
    for line in [*(row(kind, found) for kind, found in ends.items()), *particle_rows(runs)]:
        print(line)
    moments += held_out(searches)
    print(f"\nReliability: number of keyframes and share that is right [%]\n\n{table(moments)}")
    if options.tracked:
        print("\n| map | tracked [%], mean / least |\n|---|---|")
        for kind, shares in tracked.items():
            known = 100.0 * np.array(shares)[np.isfinite(shares)]
            print(f"| {kind} | {f'{known.mean():.1f} / {known.min():.1f}' if len(known) else '-'} |")
    if options.figure:
        draw(moments, options.figure)


if __name__ == "__main__":
    main()
