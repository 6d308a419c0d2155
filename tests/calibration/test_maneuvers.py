"""Frames of the positions in tables of windows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.calibration.windows import describe_foreign
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver, without_foreign_frames
from motion_models.errors import CalibrationError
from tests.studies import drive_husky

RADIUS_M = 0.165


def turned(maneuver: Maneuver, angle: float) -> Maneuver:
    """The same with its position in a frame that is turned by ``angle`` [rad]."""
    pose = se2.compose(np.array([0.0, 0.0, angle]), maneuver.measured)
    return dataclasses.replace(maneuver, measured=np.column_stack([pose[:, :2], maneuver.measured[:, 2]]))


def test_turned_frames_of_the_drive_husky_are_found() -> None:
    """The origin's parser turned the positions of 11 windows by up to pi; five of them moved far enough to show it."""
    raw = drive_husky.maneuvers(mended=False)
    kept, (note,) = without_foreign_frames(raw, RADIUS_M)
    left_out = {i for i, m in enumerate(raw) if not any(m is other for other in kept)}
    turn = np.abs(se2.wrap_angle(drive_husky.frame_turn(drive_husky.columns())))
    assert len(left_out) == 5
    assert left_out <= set(np.flatnonzero(turn > 1.0))
    assert (note.kind, note.left_out, note.compared) == ("turned", 5, 431)


def test_turned_frames_of_corrected_windows_are_none() -> None:
    corrected = drive_husky.maneuvers(mended=True)
    assert without_foreign_frames(corrected, RADIUS_M) == (corrected, [])


@pytest.mark.parametrize("angles", [np.full(603, np.pi / 2), np.random.default_rng(0).uniform(-np.pi, np.pi, 603)], ids=["axes", "world"])
def test_turned_frames_of_most_windows_are_refused(angles: np.ndarray) -> None:
    """A sensor's own axes, and positions in a world frame."""
    windows = [turned(m, float(angle)) for m, angle in zip(drive_husky.maneuvers(mended=True), angles, strict=True)]
    with pytest.raises(CalibrationError, match="must be in the frame of the body at the start of the window"):
        without_foreign_frames(windows, RADIUS_M)


def test_positions_from_the_start_of_the_drive_are_named_with_their_distance() -> None:
    """Poses of a world frame that begins with the drive: directions may fit, and lengths do not."""
    windows = drive_husky.maneuvers(mended=True)
    moved = [dataclasses.replace(m, measured=m.measured + np.array([8.0, 0.0, 0.0])) for m in windows]
    kept, (note,) = without_foreign_frames([*moved[:3], *windows[3:]], RADIUS_M)
    assert len(kept) == len(windows) - 3
    assert (note.kind, note.left_out, note.compared) == ("far", 3, 603)
    assert describe_foreign([note])[0].startswith("the measured positions of 3 of 603 windows lie up to 9.")
    with pytest.raises(CalibrationError, match="from the start of their windows, farther than their wheels rolled"):
        without_foreign_frames(moved, RADIUS_M)
