"""Page of `skidloc twin`: what the simulator gets wrong, its causes, and both robots beside the real one, before and after."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from localization.report import page as html
from localization.report.charts import Chart, ChartSeries
from localization.report.figures import Figure as Canvas
from localization.report.figures import svg
from localization.twin.discrepancy import Row, centres, turns
from localization.twin.twin import Mended, TwinResult
from motion_models import se2
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_HEADS = ("", "Windows", "Turn", "Way", "Centre of rotation", "Position", "Heading", "Wheels", "Slide")
_SECONDS = 4.0
"""Time that the animation takes [s]."""
_FRAMES = 25
_PIXELS = 300.0
"""Side of a panel of the animation."""
_TERMS = {
    "Held out": "Windows of the other half of the drive: no number was fitted to them.",
    "Turn, way": "Relative error of the turn and of the distance in the simulator, with the measured ones as 100 %.",
    "Centre of rotation": "Where it is in the simulator less where it was measured, ahead and to the left.",
    "Position, heading": "Root mean square error at the end of a window.",
    "Wheels": "Relative error of the wheels' rates against those that they had: what the servos do not reach.",
    "Slide": "How much farther than the robot it slides downhill in a full turn, on slopes.",
    "Cause": "The number that explains most of what is wrong, by the probability of the motion with it (Laplace's approximation).",
    "Contact law": "Friction in proportion to the slip at first, by the friction model, in place of the engine's Coulomb friction.",
}


def write_twin_page(path: Path, result: TwinResult, robot: Robot, source: str) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    html.write_new(path, twin_page(result, robot, source).encode())


def twin_page(result: TwinResult, robot: Robot, source: str) -> str:
    """HTML of the whole page."""
    shown = _repair(result)
    sections = [
        html.Section("What it gets wrong", html.bullets([f"{text[:1].upper()}{text[1:]}." for text in result.words])),
        html.Section("Causes", _causes(result)),
        html.Section("Before and after", [_table(result)]),
        html.Section("Side by side", [_animation(result, shown, robot)]),
        html.Section("Explore", [_turn_chart(result, shown, robot), *_centre_chart(result, shown, robot)]),
        html.Section("Turns", [_turn_figure(result, shown, robot)], is_static=True),
        *[html.Section(f"Changed: {m.name}", [_changes(m)]) for m in result.repaired if m.is_better],
        html.Section(
            "Wheels on the ground",
            html.bullets([f"file: {result.before.touch}", *(f"{m.name}: {m.judged.touch}" for m in result.repaired)]),
        ),
        html.Section("A whole stretch", html.bullets([end.describe() for end in result.ends])),
        html.Section("Remarks", html.bullets(result.notes)),
        html.glossary(_TERMS),
    ]
    facts = f"{robot.name} · {result.fitted} windows fitted, {len(result.windows)} held out · {result.simulator.engine_name}"
    title = f"{result.simulator.file.path.name} against {source}"
    return html.render(html.Page(title, facts, [result.sentence], sections))


def _repair(result: TwinResult) -> Mended:
    return result.best


def _causes(result: TwinResult) -> list[html.Block]:
    rows = []
    for f in result.findings:
        c = f.best
        others = ", ".join(f"{r.meaning} ({r.file:.3g} → {r.value:.3g})" for r in f.rivals) or "–"  # noqa: RUF001
        unit = f" {c.unit}" if c.unit else ""
        cells = [html.Cell(c.meaning, c.attribute), html.Cell(f"{c.file:.4g}{unit}"), html.Cell(f"{c.value:.4g}{unit}")]
        rows.append([*cells, html.Cell(f"{c.evidence:.1f} nats"), html.Cell(others, is_words=True)])
    heads = ("Number", "File", "Explains the motion", "Evidence", "Cannot be separated from")
    return [html.Table([html.Cell(head) for head in heads], rows)] if rows else []


def _table(result: TwinResult) -> html.Table:
    rows = []
    for name, judged in (("file", result.before), *((m.name, m.judged) for m in result.repaired)):
        rows += [
            [html.Cell(f"{name}: {row.kind}", is_bold=row.kind == "all"), *(html.Cell(text) for text in _cells(row))] for row in judged.rows
        ]
    return html.Table([html.Cell(head) for head in _HEADS], rows)


def _cells(row: Row) -> tuple[str, ...]:
    cor = "" if math.isnan(row.cor_error[0]) else f"{1e3 * row.cor_error[0]:+.0f}, {1e3 * row.cor_error[1]:+.0f} mm"
    position = f"{row.position_rms_m:.3f} m" if math.isfinite(row.position_rms_m) else ""
    return (
        str(row.windows),
        percent(row.turn_error),
        percent(row.way_error),
        cor,
        position,
        f"{row.heading_rms_rad:.3f} rad",
        percent(row.rate_error),
        slide(row),
    )


def slide(row: Row) -> str:
    """How much farther it slides downhill in a turn as text; empty on level ground."""
    return "" if math.isnan(row.slide_error_m) else f"{row.slide_error_m:+.2f} m"


def percent(share: float) -> str:
    """A relative error as text; empty where there is none."""
    return "" if math.isnan(share) else f"{100 * share:+.1f} %"


def _changes(m: Mended) -> html.Table:
    rows = [
        [
            html.Cell(c.meaning),
            html.Cell(c.attribute, is_code=True),
            html.Cell("" if math.isnan(c.old) else f"{c.old:.4g}"),
            html.Cell(f"{c.new:.4g}"),
        ]
        for c in m.changes
    ]
    return html.Table([html.Cell(head) for head in ("Number", "Attribute", "File", "Now")], rows)


def _turns_of(result: TwinResult, shown: Mended, robot: Robot) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(W,) turns that were measured, of the file, and of the repair [rad]."""
    measured = turns(result.windows, np.array([w.measured for w in result.windows]), robot)
    before, after = (turns(result.windows, judged.played.poses, robot) for judged in (result.before, shown.judged))
    return measured, before, after


def _turn_chart(result: TwinResult, shown: Mended, robot: Robot) -> Chart:
    measured, before, after = _turns_of(result, shown, robot)
    ends = np.array([min(measured.min(), 0.0), max(measured.max(), 0.0)])
    columns = {"measured": measured, "file": before, "repaired": after, "line": ends}
    series = [
        ChartSeries("as measured", "grey", x="line", y="line", is_line=True),
        ChartSeries("file", "red", x="measured", y="file"),
        ChartSeries(shown.name, "blue", x="measured", y="repaired"),
    ]
    axes = [("measured", "measured turn [rad]")], [("file", "turn in the simulator [rad]")]
    return Chart("Turns of the windows held out", *axes, series, columns, note="One point for each window.")


def _centre_chart(result: TwinResult, shown: Mended, robot: Robot) -> list[Chart]:
    found = []
    measured = np.array([w.measured for w in result.windows])
    is_turn = np.array([abs(w.mean_rates.sum()) < 0.3 * abs(w.mean_rates[1] - w.mean_rates[0]) for w in result.windows])
    is_turn &= np.isfinite(np.array([w.cov[0, 0] for w in result.windows]))
    if is_turn.sum() < 3:
        return []
    for judged in (result.before, shown.judged):
        T = np.array([*judged.frame, 0.0])
        moved = se2.compose(se2.compose(se2.inverse(T), judged.played.poses), T)
        found.append(centres(moved, turns(result.windows, moved, robot)))
    true = centres(measured, turns(result.windows, measured, robot))
    points = {"measured": (true, "ink", "x"), "file": (found[0], "red", "circle"), shown.name: (found[1], "blue", "circle")}
    columns: dict[str, FloatArray] = {}
    series = []
    for name, (values, colour, symbol) in points.items():
        columns |= {f"{name} x": values[is_turn, 0], f"{name} y": values[is_turn, 1]}
        series.append(ChartSeries(name, colour, x=f"{name} x", y=f"{name} y", symbol=symbol))
    axes = [("measured x", "ahead [m]")], [("measured y", "to the left [m]")]
    note = "Of turns in place, in the body frame."
    return [Chart("Centres of rotation", *axes, series, columns, is_map=True, height_px=380, note=note)]


def _turn_figure(result: TwinResult, shown: Mended, robot: Robot) -> html.Figure:
    measured, before, after = _turns_of(result, shown, robot)

    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        ends = [min(measured.min(), 0.0), max(measured.max(), 0.0)]
        axes.plot(ends, ends, color=html.COLOURS["grey"], linewidth=1.0)
        axes.plot(measured, before, ".", color=html.COLOURS["red"], markersize=5.0)
        axes.plot(measured, after, ".", color=html.COLOURS["blue"], markersize=5.0)
        axes.set(xlabel="measured turn [rad]", ylabel="turn in the simulator [rad]")

    caption = "One point for each window held out. Red: the file; blue: repaired; grey: as measured."
    return html.Figure(svg("turns", 6.0, 4.2, draw), "Turns in the simulator against the measured ones", caption)


def _animation(result: TwinResult, shown: Mended, robot: Robot) -> html.Figure:
    """The window in which the file is farthest off: the real robot, that of the file, and the repaired one, one beside the other."""
    worst = int(np.argmax(result.before.errors))
    window = result.windows[worst]
    poses = [window.measured, result.before.played.poses[worst], shown.judged.played.poses[worst]]
    twists = [se2.log(np.append(pose[:2], turn)) for pose, turn in zip(poses, _unwrapped(result, shown, robot, worst), strict=True)]
    reach = max(float(np.abs(_path(t)[:, :2]).max()) for t in twists) + 0.7 * robot.geometry.wheelbase_m + 0.2
    names = ("measured", "file", shown.name)
    colours = ("ink", "red", "blue")
    panels = [
        _panel(i, name, colour, twist, robot, reach) for i, (name, colour, twist) in enumerate(zip(names, colours, twists, strict=True))
    ]
    width, height = 3 * _PIXELS, _PIXELS + 24.0
    text = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}">{"".join(panels)}</svg>'
    caption = f"The window held out ({window.duration_s:.1f} s) in which the file is farthest off, from above, by the same wheel rates."
    return html.Figure(text, "The real robot, the file's and the repaired one", caption)


def _unwrapped(result: TwinResult, shown: Mended, robot: Robot, worst: int) -> list[float]:
    return [float(values[worst]) for values in _turns_of(result, shown, robot)]


def _path(twist: FloatArray) -> FloatArray:
    """(n, 3) poses along a constant twist."""
    return se2.exp(np.linspace(0.0, 1.0, _FRAMES)[:, None] * twist)


def _panel(index: int, name: str, colour: str, twist: FloatArray, robot: Robot, reach: float) -> str:
    """One robot on its way, as SVG that moves."""
    scale = 0.5 * _PIXELS / reach
    middle = (index + 0.5) * _PIXELS, 0.5 * _PIXELS + 20.0
    path = _path(twist)
    x, y = middle[0] + scale * path[:, 0], middle[1] - scale * path[:, 1]
    length, breadth = 1.3 * robot.geometry.wheelbase_m * scale, 1.1 * robot.geometry.track_width_m * scale
    moves = ";".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    turned = ";".join(f"{-math.degrees(t):.1f}" for t in np.linspace(0.0, twist[2], _FRAMES))
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    timing = f'dur="{_SECONDS:g}s" repeatCount="indefinite"'
    stroke = html.COLOURS[colour]
    text = f"{name}: {math.degrees(twist[2]):.0f} deg"
    return (
        f'<text x="{middle[0]:.1f}" y="14" text-anchor="middle" font-size="13" fill="{html.COLOURS["ink"]}">{text}</text>'
        f'<polyline points="{line}" fill="none" stroke="{stroke}" stroke-width="1.5"/>'
        f'<g transform="translate({x[-1]:.1f},{y[-1]:.1f})">'
        f'<animateTransform attributeName="transform" type="translate" values="{moves}" {timing}/>'
        f'<g transform="rotate({-math.degrees(twist[2]):.1f})">'
        f'<animateTransform attributeName="transform" type="rotate" values="{turned}" {timing}/>'
        f'<rect x="{-length / 2:.1f}" y="{-breadth / 2:.1f}" width="{length:.1f}" height="{breadth:.1f}" rx="6" fill="none"'
        f' stroke="{stroke}" stroke-width="2"/>'
        f'<line x1="0" y1="0" x2="{length / 2:.1f}" y2="0" stroke="{stroke}" stroke-width="2"/></g></g>'
    )
