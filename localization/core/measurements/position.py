"""The position of an antenna, as by GPS."""

from __future__ import annotations

import numpy as np

from motion_models import se2, se3
from motion_models.se2 import FloatArray, Pose2
from motion_models.se3 import Transform3


def transform_point(a_T_b: Pose2, point: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``point`` (2,) of frame b in frame a, with its Jacobians by the pose (2, 3) and by the point (2, 2)."""
    R = se2.rotation(a_T_b[2])
    return se2.transform(a_T_b, point), np.column_stack([R, R @ [-point[1], point[0]]]), R


def predict_position(
    enu_T_map: Pose2, map_T_key: Pose2, offset: Pose2, lever: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position (2,) of an antenna at ``lever`` l (2,) of a body at ``offset`` (3,) from a keyframe: enu_T_map map_T_key (offset l).

    Returns it with its Jacobians by ``enu_T_map`` (2, 3), ``map_T_key`` (2, 3) and ``lever`` (2, 2).
    """
    in_key, _, by_lever = transform_point(offset, lever)
    in_map, by_key, in_map_by_point = transform_point(map_T_key, in_key)
    in_enu, by_alignment, in_enu_by_point = transform_point(enu_T_map, in_map)
    return in_enu, by_alignment, in_enu_by_point @ by_key, in_enu_by_point @ in_map_by_point @ by_lever


def predict_position_in_space(
    enu_T_map: FloatArray, map_T_key: Transform3, offset: Transform3, lever: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """`predict_position` in space, (3,). ``enu_T_map`` (4,) is x, y, z and yaw: gravity levels both frames.

    Jacobians by ``enu_T_map`` (3, 4), the right perturbation of ``map_T_key`` (3, 6), translation first, and ``lever`` (3, 3).
    """
    in_key = se3.transform(offset, lever[None])[0]
    in_map = se3.transform(map_T_key, in_key[None])[0]
    enu_R_map = se3.rotation(np.array([0.0, 0.0, enu_T_map[3]]))
    turned = enu_R_map @ in_map
    enu_R_key = enu_R_map @ map_T_key[:3, :3]
    by_alignment = np.column_stack([np.eye(3), [-turned[1], turned[0], 0.0]])
    by_key = enu_R_key @ np.hstack([np.eye(3), -se3.cross(in_key)])
    return turned + enu_T_map[:3], by_alignment, by_key, enu_R_key @ offset[:3, :3]
