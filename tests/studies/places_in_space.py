"""Whether probabilities of places in space are right as often as they say, over places on hills by chance.

``python -m tests.studies.places_in_space [--seeds A:B] [--starts N]``: each seed has a stretch of 13 m somewhere on the hills, with its
own trees. The map has keyframes at true poses, the drive goes beside its way, or back along it, with the odometry's noise. Starts of eight
keyframes, with a pose that is off by 0.5 m and 15 degrees (1 sigma) and without, in four maps: of the same place; with a third, and with
all of its trees elsewhere, among the same hills and walls; and its mirror image, where no pose is right. Tables: the probabilities of all
keyframes; NEES of localized ones in the maps of the same trees (6 expected); and log-odds of the best place of each search, by weights of
odd seeds on even ones and the reverse.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from localization.maps import KeyframeMap
from localization.maps.place_probability import sigmoid
from localization.maps.space_localizer import WEIGHTS, SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlace, SpacePlaces
from motion_models import se3
from motion_models.se2 import FloatArray
from tests.helpers import hill_map
from tests.helpers.hill_scans import Scene
from tests.studies.localization_reliability import Moment, table

_KEYFRAMES, _SPACING_M, _MAP_SPACING_M, _LENGTH_M = 8, 0.55, 1.0, 13.0
_ODOMETRY_COV = np.diag([2e-3, 2e-3, 2e-3, 1e-3, 1e-3, 1e-3]) ** 2
_SIGMAS = np.array([0.5, 0.5, 0.26])
_RIGHT_M, _RIGHT_RAD = 0.5, 0.2
_RANGE_NOISE_M = 0.02
_MIRRORED = "its mirror image"


class Found(NamedTuple):
    """The best place of a search."""

    seed: int
    on_surfaces: float
    off_surfaces: float
    is_right: bool


class Recorded(SpacePlaces):
    """A map that keeps the best place of each search."""

    def __init__(self, mapped: KeyframeMap) -> None:
        super().__init__(mapped, _RANGE_NOISE_M)
        self.best: list[SpacePlace] = []

    def search(self, *arguments: FloatArray) -> list[SpacePlace]:
        found = super().search(*arguments)
        self.best += found[:1]
        return found


def way(rng: np.random.Generator, begin: FloatArray, curvature: float, spacing_m: float) -> FloatArray:
    """(K, 3) along an arc from ``begin`` (3,), off by as much as a drive is from another."""
    s = np.arange(0.0, _LENGTH_M, spacing_m)
    yaw = begin[2] + curvature * s
    along = np.column_stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))]) * spacing_m
    side = rng.uniform(-0.8, 0.8) * np.column_stack([-np.sin(yaw), np.cos(yaw)])
    return np.column_stack([begin[:2] + along + side, yaw])


def changed(scene: Scene, other: Scene, share: float) -> Scene:
    """A ``share`` of the trees where those of ``other`` are."""
    n = round(share * len(scene.trees))
    return replace(scene, trees=np.vstack([scene.trees[n:], other.trees[:n]]))


def mirrored(mapped: KeyframeMap) -> KeyframeMap:
    """A place that no robot stands in."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return replace(mapped, poses=flip @ mapped.poses @ flip, points=mapped.points * np.array([1, -1, 1], dtype=np.int16))


def starts(
    places: Recorded, poses: FloatArray, clouds: Sequence[FloatArray], has_pose: bool, rng: np.random.Generator
) -> Iterator[SpaceLocalizer]:
    """The localizer after each keyframe at ``poses`` (K, 4, 4)."""
    begin = np.array([*poses[0, :2, 3], np.arctan2(poses[0, 1, 0], poses[0, 0, 0])])
    localizer = SpaceLocalizer(places, begin + _SIGMAS * rng.normal(size=3) if has_pose else None)
    for i, (pose, cloud) in enumerate(zip(poses, clouds, strict=True)):
        delta = np.eye(4) if i == 0 else se3.inverse(poses[i - 1]) @ pose
        noise = se3.exp(rng.multivariate_normal(np.zeros(6), _ODOMETRY_COV))
        localizer.add(cloud, SpaceMotion(delta @ noise, _ODOMETRY_COV), pose[:3, :3])
        yield localizer


def is_right(found: FloatArray, pose: FloatArray) -> bool:
    off = se3.local(found, pose)
    return bool(np.linalg.norm(off[:3]) < _RIGHT_M and np.linalg.norm(off[3:]) < _RIGHT_RAD)


def fit(rows: Sequence[Found]) -> FloatArray:
    """(3,) weights of the shares on and off surfaces and of 1, by logistic regression with a weak prior (Bishop 2006, 4.3.2)."""
    X, sign = _features(rows), np.array([1.0 if row.is_right else -1.0 for row in rows])
    return np.asarray(minimize(lambda w: np.logaddexp(0.0, -sign * (X @ w)).sum() + 0.5e-2 * (w @ w), np.zeros(3)).x)


def _features(rows: Sequence[Found]) -> FloatArray:
    return np.array([[row.on_surfaces, row.off_surfaces, 1.0] for row in rows])


def weights_rows(rows: Sequence[Found]) -> Iterator[str]:
    """Lines on weights of one half of the seeds, on the searches of the other."""
    for parity, name in ((0, "even"), (1, "odd")):
        fitted, held = [row for row in rows if row.seed % 2 != parity], [row for row in rows if row.seed % 2 == parity]
        right = np.array([row.is_right for row in held])
        for kind, w in (("of the others", fit(fitted)), ("of the program", np.array(WEIGHTS))):
            p = np.array([sigmoid(float(np.clip(x, -6.0, 6.0))) for x in _features(held) @ w])
            wrong = f"{int((~right & (p > 0.9)).sum())} of {int((p > 0.9).sum())}"
            yield f"| {name}, {kind} | {np.round(w, 1).tolist()} | {len(held)} | {wrong} | {np.mean((p - right) ** 2):.3f} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1:7", metavar="A:B")
    parser.add_argument("--starts", type=int, default=1, help="in each map, with a pose and without")
    given = parser.parse_args()
    moments, rows, nees = [], [], []
    for seed in range(*map(int, given.seeds.split(":"))):
        rng = np.random.default_rng(seed)
        begin, curvature = np.array([*rng.uniform(-8.0, 8.0, 2), rng.uniform(-np.pi, np.pi)]), rng.uniform(-0.25, 0.25)
        mapped_way, driven = (way(rng, begin, curvature, spacing) for spacing in (_MAP_SPACING_M, _SPACING_M))
        driven = driven[::-1] + np.array([0.0, 0.0, np.pi]) if seed % 2 else driven
        scene, other = (hill_map.scene_around(np.vstack([mapped_way[:, :2], driven[:, :2]]), s) for s in (seed, 1000 + seed))
        own = hill_map.make_map(scene, tuple(map(tuple, mapped_way)))
        maps = {"its own": own, _MIRRORED: mirrored(own)}
        for share, name in ((1.0 / 3.0, "a third of the trees elsewhere"), (1.0, "all trees elsewhere")):
            maps[name] = hill_map.make_map(changed(scene, other, share), tuple(map(tuple, mapped_way)))
        poses = np.array([hill_map.on_hills(*place) for place in driven])
        clouds = [hill_map.cloud_at(pose, scene, 500 + i) for i, pose in enumerate(poses)]
        for (name, mapped), has_pose in ((item, has_pose) for item in maps.items() for has_pose in (True, False)):
            places, kind = Recorded(mapped), f"{name}, {'pose given' if has_pose else 'no pose'}"
            for k in rng.integers(0, len(poses) - _KEYFRAMES, given.starts).tolist():
                for i, localizer in enumerate(starts(places, poses[k : k + _KEYFRAMES], clouds[k : k + _KEYFRAMES], has_pose, rng), k):
                    is_same, localized = name != _MIRRORED, localizer.state == "localized"
                    first = localizer.hypotheses[0].pose if localizer.hypotheses and not localized else localizer.pose
                    moments.append(Moment(kind, str(seed), localizer.probability, is_same and is_right(first, poses[i])))
                    rows += [Found(seed, p.on_surfaces, p.off_surfaces, is_same and is_right(p.pose, poses[i])) for p in places.best]
                    places.best.clear()
                    if localized and name == "its own":
                        off = se3.local(localizer.pose, poses[i])
                        nees.append(off @ np.linalg.solve(localizer.covariance, off))
        print(f"seed {seed}", flush=True)
    print(f"\n{table(moments)}\n\nNEES {np.mean(nees):.1f} of {len(nees)} localized keyframes\n")
    print("| searches of seeds, weights | on, off, 1 | searches | wrong above 0.9 | Brier score |\n|---|---|---|---|---|")
    print("\n".join(weights_rows(rows)))


if __name__ == "__main__":
    main()
