"""Figures of drives in space: profile of height, tilt over time, and the way in three dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localization.report.figures import Axes, Figure, plot_run, svg
from localization.report.page import COLOURS, WIDTH_IN
from localization.report.runs import PlottedRun, thin_path, thin_series
from motion_models.se2 import FloatArray

_LEAST_TILT_DEG = 3.0
"""Greatest tilt of a drive on ground that is taken as level: figures of it would show noise."""
_LEAST_HEIGHT = 0.25
"""Height of the box of the three-dimensional view over its longer side, at least: hills are flat."""
_POSTS = 60
"""Vertical lines from the way to the lowest level."""


@dataclass(frozen=True, eq=False)
class SpaceTrack:
    """What the figures draw of one run."""

    line: PlottedRun
    seconds: FloatArray
    """(N,) since the first pose."""
    positions: FloatArray
    """(N, 3) [m]."""
    driven_m: FloatArray
    """(N,) way seen from above."""
    height_sigma_m: FloatArray
    """(N,)"""
    roll_deg: FloatArray
    """(N,) positive with the left side up."""
    pitch_deg: FloatArray
    """(N,) positive with the nose down."""


def space_tracks(lines: Sequence[PlottedRun]) -> list[SpaceTrack]:
    """Runs whose poses in space tilt by more than 3 degrees."""
    found = []
    for line in lines:
        run = line.result.run.in_space
        if run is None or len(run.stamps_ns) < 2:
            continue
        x, y, z, w = run.quaternions.T
        pitch = np.degrees(np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)))
        roll = np.degrees(np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
        if max(np.abs(roll).max(), np.abs(pitch).max()) < _LEAST_TILT_DEG:
            continue
        seconds = (run.stamps_ns - run.stamps_ns[0]) * 1e-9
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.positions[:, :2], axis=0).T))])
        found.append(SpaceTrack(line, seconds, run.positions, driven, run.sigmas[:, 2], roll, pitch))
    return found


def profile_svg(tracks: Sequence[SpaceTrack]) -> str:
    """Height over the way driven, with two sigmas, above roll and pitch over time."""

    def draw(figure: Figure) -> None:
        height, roll, pitch = figure.subplots(3, 1, height_ratios=(1.4, 1.0, 1.0))
        for track in tracks:
            _draw_height(height, track)
            for axes, values in ((roll, track.roll_deg), (pitch, track.pitch_deg)):
                kept = thin_series(values)
                plot_run(axes, track.line, track.seconds[kept], values[kept])
        for axes in (roll, pitch):
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -1.0), max(high, 1.0))
        height.set(xlabel="driven, seen from above [m]", ylabel="height [m]")
        roll.set_ylabel("roll [deg]")
        roll.sharex(pitch)
        roll.tick_params(labelbottom=False)
        pitch.set(xlabel="time since the first pose [s]", ylabel="pitch [deg]")

    return svg("profile", WIDTH_IN, 5.4, draw)


def _draw_height(axes: Axes, track: SpaceTrack) -> None:
    kept = thin_path(np.column_stack([track.driven_m, np.zeros(len(track.driven_m))]), 0.0, most=700)
    way, height, spread = track.driven_m[kept], track.positions[kept, 2], 2.0 * track.height_sigma_m[kept]
    colour = COLOURS[track.line.colour]
    axes.fill_between(way, height - spread, height + spread, color=(colour, 0.18), linewidth=0.0, gid=f"series-{track.line.number}")
    plot_run(axes, track.line, way, height)


def view_svg(tracks: Sequence[SpaceTrack]) -> str:
    """The ways in three dimensions; heights are stretched where they are small."""
    positions = np.concatenate([track.positions for track in tracks])
    extent, lowest = np.maximum(np.ptp(positions, axis=0), 1e-3), float(positions[:, 2].min())

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(projection="3d")
        for track in tracks:
            way = track.positions[thin_path(track.positions[:, :2], 0.0, most=500)]
            posts = track.positions[thin_path(track.positions[:, :2], 0.0, most=_POSTS)]
            colour, gid = COLOURS[track.line.colour], f"series-{track.line.number}"
            for x, y, z in posts:
                axes.plot([x, x], [y, y], [lowest, z], color=(colour, 0.25), linewidth=0.6, gid=gid)
            axes.plot(*way.T, color=colour, linewidth=1.6, gid=gid)
        box = extent / extent[:2].max()
        axes.set_box_aspect((*np.maximum(box[:2], 0.2), max(box[2], _LEAST_HEIGHT)), zoom=1.3)
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="height [m]")
        axes.locator_params(axis="z", nbins=4)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color((1.0, 1.0, 1.0, 0.0))

    return svg("space", WIDTH_IN, 4.2, draw)


def stretch(tracks: Sequence[SpaceTrack]) -> float:
    """How many times `view_svg` stretches heights."""
    x, y, z = np.ptp(np.concatenate([track.positions for track in tracks]), axis=0)
    return float(max(1.0, _LEAST_HEIGHT * max(x, y) / max(z, 1e-3)))
