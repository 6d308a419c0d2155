"""The README's pictures that come from the notebooks and from the simulator. `python -m tests.studies.readme_figures` writes them.

aces.png is not among them: `skidloc replay` writes it.
"""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

from localization.report.notebook import Bars, Panel, Picture, Series, picture
from localization.simulation import WORLDS, ExperimentConfig, SensorConfig, SimulationConfig, simulate, world_svg
from motion_models import load_robot
from tests.helpers.notebooks import FOLDER, read, sources

FIGURES = FOLDER / "figures"
_CELL, _GAP, _TITLE = 300, 18, 26
_DRIVEN = {"rooms": "laps", "slippery": "slippery_patch", "hall": "preliminary"}


def variables(number: str) -> dict[str, Any]:
    """What a notebook's names stand for at its end."""
    (source,) = (s for s in sources() if s.name.startswith(number))
    os.chdir(FOLDER)
    code = "\n\n".join(cell.source for cell in read(source).cells if cell.cell_type == "code")
    found: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(code, str(source), "exec"), found)
    return found


def worlds() -> str:
    """All worlds side by side as one SVG; each has its own scale, with a bar of 5 m."""
    parts, bottom = [], 0.0
    rows = (("rooms", "slippery", "hall"), ("lab", "yard"), ("corridor",))
    across = 3 * _CELL + 2 * _GAP
    for row in rows:
        left, height = 0.0, 0.0
        width = {1: across, 2: (across - _GAP) / 2, 3: _CELL}[len(row)]
        if len(row) == 2:
            width = 0.8 * _CELL
        for name in row:
            world = WORLDS[name]()
            drawn = world_svg(world, _paths(name), round(width))
            head, body = drawn.split(">", 1)
            tall = float(head.split('height="')[1].split('"')[0])
            ends = world.walls[:, :4].reshape(-1, 2)
            size = np.ptp(ends, axis=0)
            bar = 5.0 * width / (size[0] + 1.0)
            parts.append(
                f'<text x="{left}" y="{bottom + 17}"><tspan font-weight="bold">{name}</tspan> {size[0]:.0f} x {size[1]:g} m</text>'
            )
            parts.append(
                f'<path d="M{left + width - bar:.1f} {bottom + 13}h{bar:.1f}" stroke="#222222" stroke-width="3"/>'
                f'<text x="{left + width - bar - 4:.1f}" y="{bottom + 17}" text-anchor="end">5 m</text>'
            )
            parts.append(
                head.replace("<svg", f'<svg x="{left}" y="{bottom + _TITLE}"').replace(' xmlns="http://www.w3.org/2000/svg"', "")
                + ">"
                + body
            )
            left, height = left + width + _GAP, max(height, tall)
        if len(row) == 2:
            parts.append(_legend(left + _GAP, bottom + _TITLE))
        bottom += _TITLE + height + _GAP
    size = f'viewBox="{-_GAP} {-_GAP / 2} {across + 2 * _GAP} {bottom + _GAP / 2:.0f}" width="{across + 2 * _GAP}"'
    style = 'font-family="DejaVu Sans, Verdana, sans-serif" font-size="14" fill="#222222"'
    paper = f'<rect x="{-_GAP}" y="{-_GAP}" width="{across + 2 * _GAP}" height="{bottom + 2 * _GAP:.0f}" fill="white"/>'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>\n{paper}\n' + "\n".join(parts) + "\n</svg>\n"


def _paths(name: str) -> list[np.ndarray]:
    """What is driven in a world, seen from above."""
    if name not in _DRIVEN:
        return []
    config = SimulationConfig(experiment=ExperimentConfig(laps=1), sensors=SensorConfig(lidar="none"))
    drive = simulate(_DRIVEN[name], load_robot("vaultbot"), 0, {}, config)
    for _ in drive.messages():
        pass
    return [run.poses[::10, :2] for run in drive.runs]


def _legend(x: float, y: float) -> str:
    lines = (
        ("#222222", "walls, pillars, furniture"),
        ("#5aa9e6", "glass"),
        ("#e07a5f", "people who walk"),
        ("#bcd8ec", "wet floor, friction x 0.35"),
        ("#3a7d44", "driven"),
    )
    rows = []
    for i, (colour, text) in enumerate(lines):
        at, thick = y + 20 + 26 * i, 10 if "floor" in text else 3
        rows.append(f'<path d="M{x} {at}h26" stroke="{colour}" stroke-width="{thick}"/>')
        rows.append(f'<text x="{x + 36}" y="{at + 5}">{text}</text>')
    return "\n".join(rows)


def center_of_gravity() -> Picture:
    """k and centre of rotation against the CG: measured, the thesis's regressions, the friction model."""
    n = variables("2")
    x, grid, line, plain, tuned, multiplier = (n[name] for name in ("x", "grid", "line", "plain", "tuned", "multiplier"))
    k, x_cr, _ = n["skid"].rotation(line, n["skid"].nominal)

    def curves(thesis: np.ndarray, column: int, scale: float = 1.0) -> list[Series]:
        return [
            Series("thesis: polynomials", line[:, 0], thesis, "red", dashes=(4, 2)),
            Series("friction, nothing fitted", line[:, 0], scale * plain[:, column], "sky", dashes=(1, 1)),
            Series("friction, four numbers", line[:, 0], scale * tuned[:, column], "blue"),
        ]

    def seen(values: np.ndarray) -> Series:
        return Series("68 rotations, measured", x, values, "grey", "o", None)

    return picture(
        Panel(
            "CG ahead of the middle [m]",
            "rotation scaling k [-]",
            [seen(grid.ratio / multiplier), *curves(k, 0, 1.0 / multiplier)],
            "How much it turns",
        ),
        Panel("CG ahead of the middle [m]", "x_CR [m]", [seen(grid.cor[:, 0]), *curves(x_cr, 1)], "Centre of rotation, ahead", legend=None),
        Panel(
            "CG ahead of the middle [m]",
            "y_CR [m]",
            n["over_x"],
            "Centre of rotation, to the left",
            y_range=(-0.065, 0.095),
            legend="upper right",
        ),
        columns=3,
        row_in=3.3,
        width_in=10.5,
    )


def corrections() -> Picture:
    """Drift of the wheels by what was learned, round by round."""
    n = variables("7")
    means = {title: n["np"].array(d.metres).reshape(-1, 3).mean(axis=1) for title, d in n["found"].items()}
    names = [f"round {i + 1}" for i in range(len(next(iter(means.values()))))]
    title = "The arms take three postures, one a lap; the floor and the CG are not as the robot file says"
    return picture(
        Bars(
            "drift of the wheels alone, mean of three laps [m per lap of 24 m]",
            names,
            means,
            title,
            "{:.1f}",
            colours=("red", "grey", "purple", "blue"),
            room=0.42,
        ),
        columns=1,
        row_in=4.2,
    )


def main() -> None:
    wanted = sys.argv[1:] or ["worlds", "cg", "corrections"]
    if "worlds" in wanted:
        (FIGURES / "worlds.svg").write_text(worlds(), encoding="utf-8")
    if "cg" in wanted:
        center_of_gravity().save(FIGURES / "cg.png")
    if "corrections" in wanted:
        corrections().save(FIGURES / "corrections.png")


if __name__ == "__main__":
    main()
