"""Localization in maps of simulated office floors, beside a particle filter by AMCL's rules over the same grid.

``python -m tests.studies.localization_simulated`` puts the robot down at random in floors of `tests.helpers.office_floor`, by which no
constant was chosen: in the map as it was drawn, after 10 % of the inner walls were moved, removed or added, and in the map of another
floor. It drives for ``--keyframes`` of 0.5 m. Right is within 0.5 m and 0.2 rad. *Tracked*: drives of 60 keyframes from a given pose, the
share of them that is localized and right.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt

from localization.maps.grid import Grid
from localization.maps.localizer import LIKELY, Localizer
from localization.maps.place_search import PlaceMap
from motion_models import se2
from tests.helpers import floor_plan, office_floor

_COV = np.diag([0.02, 0.02, 0.01]) ** 2
_RIGHT_M, _RIGHT_RAD = 0.5, 0.2
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
        weights = self.weights
        best = self.poses[np.argmax(weights)]
        for _ in range(3):
            near = (np.hypot(*(self.poses - best)[:, :2].T) < _RIGHT_M) & (np.abs(se2.wrap_angle(self.poses[:, 2] - best[2])) < _RIGHT_RAD)
            if near.any():
                angle = np.angle(np.sum(weights[near] * np.exp(1j * self.poses[near, 2])))
                best = np.array([*np.average(self.poses[near, :2], axis=0, weights=weights[near]), angle])
        share = float(weights[near].sum())
        return best, share, share > LIKELY


def run_localizer(places: PlaceMap, walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> Guess:
    """The place after ``poses`` (K, 3) among ``walls``."""
    localizer = Localizer(places)
    for odometry, delta, points in measured(walls, poses, rng):
        localizer.add(odometry, points, delta, _COV)
    found = localizer.pose if localizer.state == "localized" or not localizer.hypotheses else localizer.hypotheses[0].pose
    return found, localizer.probability, localizer.state == "localized"


def run_particles(n: int) -> Callable[[PlaceMap, np.ndarray, np.ndarray, np.random.Generator], Guess]:
    """The same by a particle filter of ``n``."""

    def run(places: PlaceMap, walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> Guess:
        particles = ParticleFilter(places.grid, n, rng)
        for _, delta, points in measured(walls, poses, rng):
            particles.add(delta, _COV, points)
        return particles.guess()

    return run


def measured(walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Odometry, motion and scan at each of ``poses``, with noise."""
    odometry, found = np.zeros(3), []
    for k, delta in enumerate(floor_plan.moves(poses)):
        moved = se2.compose(delta, rng.multivariate_normal(np.zeros(3), _COV)) if k else delta
        odometry = se2.compose(odometry, moved)
        found.append((odometry, moved, floor_plan.scan(walls, poses[k], seed=int(rng.integers(1 << 31)))))
    return found


def is_right(found: np.ndarray, truth: np.ndarray) -> bool:
    """Whether a pose is that of the ``truth``."""
    off = se2.between(truth, found)
    return bool(math.hypot(off[0], off[1]) < _RIGHT_M and abs(off[2]) < _RIGHT_RAD)


def tracked_share(places: PlaceMap, walls: np.ndarray, poses: np.ndarray, rng: np.random.Generator) -> float:
    """Share of ``poses`` (K, 3) that is localized and right, from the first one given on."""
    localizer, n = Localizer(places, poses[0]), 0
    for (odometry, delta, points), pose in zip(measured(walls, poses, rng), poses, strict=True):
        localizer.add(odometry, points, delta, _COV)
        n += localizer.state == "localized" and is_right(localizer.pose, pose)
    return n / len(poses)


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--floors", type=int, default=6)
    parser.add_argument("--starts", type=int, default=15, help="on each floor and in each kind of map")
    parser.add_argument("--keyframes", type=int, default=8)
    options = parser.parse_args(words)
    methods = {"localizer": run_localizer, "500 particles": run_particles(500), "5,000 particles": run_particles(5000)}
    kinds = ("same", "changed by 10 %", "another floor")
    found: dict[tuple[str, str], list[tuple[float, bool, bool]]] = {(kind, name): [] for kind in kinds for name in methods}
    tracked: dict[str, list[float]] = {kind: [] for kind in kinds[:2]}
    for seed in range(options.floors):
        rng = np.random.default_rng(100 + seed)
        walls, other = office_floor.make_walls(rng), office_floor.make_walls(rng)
        places = PlaceMap(floor_plan.make_map(walls, office_floor.drive(walls, rng, 200)), 0.02)
        floors = dict(zip(kinds, (walls, office_floor.change(walls, rng), other), strict=True))
        for kind, now in floors.items():
            for start in range(options.starts):
                poses = office_floor.drive(now, rng, options.keyframes)
                for name, run in methods.items():
                    pose, probability, is_localized = run(places, now, poses, np.random.default_rng([seed, start]))
                    found[kind, name].append((probability, is_right(pose, poses[-1]) and kind != kinds[2], is_localized))
            if kind in tracked:
                tracked[kind].append(tracked_share(places, now, office_floor.drive(now, rng, 60), rng))
    print("| map | method | starts | right [%] | localized [%] | localized and wrong | Brier score |")
    print("|---" * 7 + "|")
    for (kind, name), rows in found.items():
        p, right, localized = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
        wrong = int((localized * (1.0 - right)).sum())
        cells = [kind, name, str(len(p)), f"{100 * right.mean():.0f}", f"{100 * localized.mean():.0f}", str(wrong)]
        print("| " + " | ".join([*cells, f"{np.mean((p - right) ** 2):.3f}"]) + " |")
    print("\n| map | tracked [%], mean / least |\n|---|---|")
    for kind, shares in tracked.items():
        print(f"| {kind} | {100 * np.mean(shares):.1f} / {100 * np.min(shares):.1f} |")


if __name__ == "__main__":
    main()
