"""Halves of a log: the map of one, and where the robot truly was in the other, by the smoothed graph of the whole."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from localization.estimators import EstimatorConfig
from localization.estimators.graph_fusion import GraphConfig
from localization.lidar.submap import voxel_means
from localization.log_replay import replay
from localization.maps import KeyframeMap
from localization.maps.place_probability import RIGHT_M, RIGHT_RAD
from localization.maps.place_search import PlaceMap
from localization.pipeline import ReplayConfig, Trial
from motion_models import se2
from motion_models.registry import make_model
from tests.studies.buildings import Drive

_DENSE = ReplayConfig(estimator=EstimatorConfig(graph=GraphConfig(keyframe_distance_m=0.3, keyframe_angle_rad=0.2)))
MAP_STRIDE = 3
"""Of dense keyframes in a map: about 1 m, as by default."""
MAPPED_SCORE, _JOINED_M = 0.5, 0.08
"""Score from which on scans are mapped at their true pose, and voxel of joined ones [m]."""


def dense_map(drive: Drive) -> KeyframeMap:
    """Keyframes every 0.3 m of the smoothed graph of the whole log."""
    pair = Trial(make_model("diff_drive", drive.robot), "graph")
    keyframes = replay(drive.events, [pair], drive.robot, drive.mounts, True, _DENSE)[0].keyframes
    assert keyframes is not None
    return keyframes


def halves(keyframes: KeyframeMap) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first and of the second half."""
    n = len(keyframes.poses)
    return np.arange(n // 2), np.arange(n // 2, n)


def off(truth: np.ndarray, pose: np.ndarray) -> tuple[float, bool]:
    """How far ``pose`` is from the ``truth`` [m], and whether that is the same place."""
    delta = se2.between(truth, pose)
    error = math.hypot(delta[0], delta[1])
    return error, error < RIGHT_M and abs(delta[2]) < RIGHT_RAD


def joined_score(places: PlaceMap, keyframes: KeyframeMap, ids: Sequence[int]) -> float:
    """The score in the map of the scans of keyframes ``ids``, joined at their true poses; -1 without points."""
    scans = keyframes.scans()
    if not sum(len(scans[k]) for k in ids):
        return -1.0
    truth = keyframes.poses[ids[-1]]
    joined = np.vstack([se2.transform(se2.between(truth, keyframes.poses[k]), scans[k]) for k in ids])
    return places.align(voxel_means(joined, _JOINED_M), truth).score
