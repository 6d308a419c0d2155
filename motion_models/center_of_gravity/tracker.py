"""Centre of gravity along a log: follows the joint states of the arms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motion_models.center_of_gravity.model import CgModel
from motion_models.center_of_gravity.parts import CgEstimate
from motion_models.errors import CgError


class CgTracker:
    """Stores each joint's last position: on ROS robots wheels, left arm and right arm often publish joint states separately."""

    def __init__(self, model: CgModel) -> None:
        self.model = model
        self._positions = np.full(len(model.chain.joint_names), np.nan)
        self._columns: dict[tuple[str, ...], tuple[NDArray[np.intp], NDArray[np.intp]]] = {}

    @property
    def missing(self) -> tuple[str, ...]:
        """Joints that no message has had yet."""
        return tuple(name for name, q in zip(self.model.chain.joint_names, self._positions, strict=True) if np.isnan(q))

    def update(self, names: Sequence[str], positions: ArrayLike) -> CgEstimate | None:
        """Take one joint-state message: ``names`` and ``positions`` [rad or m] in any order, with other joints among them.

        The centre of gravity; None where the message has nothing of the arms (no joint of theirs, no positions, which ROS allows, or
        none that is finite), and as long as joints are `missing`. Raises `CgError` where names and positions differ in number.
        """
        values = np.asarray(positions, dtype=float)
        if values.size == 0:
            return None
        if values.shape != (len(names),):
            raise CgError(f"joint state with {len(names)} names ({', '.join(names)}) but positions of shape {values.shape}.")
        key = tuple(names)
        if key not in self._columns:
            known = {name: i for i, name in enumerate(self.model.chain.joint_names)}
            pairs = [(column, known[name]) for column, name in enumerate(key) if name in known]
            self._columns[key] = (np.array([p[0] for p in pairs], dtype=np.intp), np.array([p[1] for p in pairs], dtype=np.intp))
        columns, joints = self._columns[key]
        given = values[columns]
        finite = [*map(math.isfinite, given.tolist())]  # quicker than numpy's, on a handful
        if not any(finite):
            return None
        if all(finite):
            self._positions[joints] = given
        else:
            self._positions[joints[finite]] = given[finite]
        if any(map(math.isnan, self._positions.tolist())):
            return None
        return self.model.estimate(self._positions)

    def require_all(self) -> None:
        """Raises `CgError` where joints are `missing`; for the end of a log that gave no centre of gravity."""
        if self.missing:
            raise CgError(
                f"the joint states never had {', '.join(self.missing)}, which the centre of gravity needs ({self.model.chain.source}); "
                "name the arms' joints as the log does, or give the centre of gravity by topic."
            )
