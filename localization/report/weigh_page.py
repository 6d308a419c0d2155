"""Page of `skidloc weigh`: the centre of gravity with its ellipse between the wheels, the load, and what else was estimated with it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from localization.diagnosis.weigh import DrivenWeighing, Nuisance
from localization.report import page as html
from localization.report.charts import Chart, ChartSeries
from localization.report.figures import Figure as Canvas
from localization.report.figures import svg
from motion_models.robot import Geometry
from motion_models.se2 import FloatArray

_SHOWN = 0.95
_POINTS = 73
"""Points of an ellipse: one each 5 degrees."""
_WIDTH_IN = 6.0
_WHEEL_WIDTH = 0.5
"""Drawn width of a wheel over its radius."""
_TERMS = {
    "Ellipse": f"Holds the centre of gravity in {100 * _SHOWN:.0f} of 100 such drives, by the covariance of the estimate; where the "
    "friction model does not describe the drive, the errors of such models are in it.",
    "Load moment": "Mass of the unknown load times its distance from the centre of gravity of the loaded robot.",
    "Prior": "How far robots, floors and mounts differ from their files: what may be one of these is not taken for a load.",
}


@dataclass(frozen=True)
class WeighRow:
    """One quantity of the result."""

    name: str
    unit: str
    given: str
    """By the robot file."""
    found: float
    sigma: float
    digits: int

    @property
    def texts(self) -> tuple[str, ...]:
        """Cells of a table: name, unit, robot file, found, sigma, interval."""
        d, (low, high) = self.digits, (self.found - 1.96 * self.sigma, self.found + 1.96 * self.sigma)
        interval = f"{low:+.{d}f} to {high:+.{d}f}"
        return self.name, self.unit, self.given, f"{self.found:+.{d}f}", f"{self.sigma:.{d}f}", interval


def weigh_rows(found: DrivenWeighing, at: tuple[float, float] | None) -> list[WeighRow]:
    """Centre of gravity, load moment and, of a load ``at`` a known place, its mass."""
    rows = []
    for i, axis in enumerate("xy"):
        rows.append(
            WeighRow(f"centre of gravity {axis}", "m", f"{found.given[i]:+.4f}", float(found.position[i]), float(found.sigmas[i]), 4)
        )
    for i, axis in enumerate("xy"):
        rows.append(WeighRow(f"load moment {axis}", "kg m", "0", float(found.moment[i]), float(found.mass_kg * found.sigmas[i]), 2))
    if found.slope is not None:
        s = found.slope
        rows.append(WeighRow("height of the centre of gravity", "m", f"{s.given_height:.3f}", s.height, s.height_sigma, 3))
        rows.append(WeighRow("friction of this floor", "", f"{s.given_mu:.2f}", s.mu, s.mu_sigma, 2))
    return rows if at is None else [*rows, WeighRow("load", "kg", "0", *found.payload(*at), 1)]


def write_weigh_page(path: Path, sentence: str, found: DrivenWeighing, geometry: Geometry, at: tuple[float, float] | None) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    html.write_new(path, weigh_page(sentence, found, geometry, at).encode())


def weigh_page(sentence: str, found: DrivenWeighing, geometry: Geometry, at: tuple[float, float] | None) -> str:
    """HTML of the whole page; ``at``: where the load is, if that is known [m]."""
    ellipse = confidence_ellipse(found.position, found.covariance)
    caption = "The robot from above, ahead to the right. The dot is the centre of gravity that was found, the cross that of the robot file."
    body = outline(geometry)
    figure = html.Figure(_svg(found, ellipse, body, at), "Centre of gravity between the wheels", caption)
    sections = [
        html.Section("Explore", [_cg_chart(found, ellipse, body, at)]),
        html.Section("Centre of gravity", [figure], is_static=True),
        html.Section("Result", [_table(found, at)]),
        html.Section("Estimated with it", _corrections(found.corrections)),
        html.Section("Remarks", html.bullets(found.warnings)),
        html.glossary(_TERMS),
    ]
    about = f"{found.windows} windows · {found.turned_rad:.0f} rad of turning by the wheels · motion by {found.motion_reference}"
    return html.render(html.Page(f"Weighing by {found.log}", f"{found.robot} · {about}", [sentence[:1].upper() + sentence[1:]], sections))


def outline(geometry: Geometry) -> FloatArray:
    """(n, 2) lines of the robot from above [m], separated by rows of NaN: body with its nose ahead, and four wheels."""
    r, half = geometry.wheel_radius_m, _WHEEL_WIDTH * geometry.wheel_radius_m / 2.0
    box = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    ahead, beside = geometry.wheelbase_m / 2.0, geometry.track_width_m / 2.0
    nose = np.array([[ahead + r, beside - half], [ahead + 1.4 * r, 0.0], [ahead + r, half - beside]])
    parts = [np.vstack([box * [ahead + r, beside - half], np.full(2, np.nan), nose])]
    parts += [box * [r, half] + [sx * ahead, sy * beside] for sx in (1.0, -1.0) for sy in (1.0, -1.0)]
    return np.vstack([row for part in parts for row in (part, np.full(2, np.nan))])


def confidence_ellipse(centre: FloatArray, covariance: FloatArray, probability: float = _SHOWN) -> FloatArray:
    """(n, 2) points of the ellipse that holds a Gaussian of ``centre`` (2,) and ``covariance`` (2, 2) with ``probability``."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * math.pi, _POINTS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * math.sqrt(float(chi2.ppf(probability, 2)))
    return np.asarray(centre + (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _cg_chart(found: DrivenWeighing, ellipse: FloatArray, body: FloatArray, at: tuple[float, float] | None) -> Chart:
    columns = {"ellipse x": ellipse[:, 0], "ellipse y": ellipse[:, 1], "robot x": body[:, 0], "robot y": body[:, 1]}
    points: Sequence[tuple[str, FloatArray, str, str]] = [
        ("robot file", found.given, "grey", "x"),
        ("found", found.position, "blue", "circle"),
        *([] if at is None else [(f"load, {found.payload(*at)[0]:.1f} kg", np.array(at), "orange", "triangle-up")]),
    ]
    series = [ChartSeries(f"{100 * _SHOWN:.0f} % ellipse", "blue", x="ellipse x", y="ellipse y", is_line=True, is_filled=True)]
    series.append(ChartSeries("robot", "ink", x="robot x", y="robot y", is_line=True))
    for name, point, colour, symbol in points:
        columns |= {f"{name} x": point[:1], f"{name} y": point[1:]}
        series.append(ChartSeries(name, colour, x=f"{name} x", y=f"{name} y", size=10.0, symbol=symbol, texts=[name]))
    title = "Centre of gravity between the wheels"
    note = "The robot from above, ahead to the right. Scroll to zoom to the ellipse."
    return Chart(title, [("found x", "x [m]")], [("found y", "y [m]")], series, columns, is_map=True, height_px=420, note=note)


def _svg(found: DrivenWeighing, ellipse: FloatArray, body: FloatArray, at: tuple[float, float] | None) -> str:
    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        axes.fill(*ellipse.T, facecolor=html.COLOURS["sky"], edgecolor=html.COLOURS["blue"], linewidth=1.0)
        axes.plot(*body.T, color=html.COLOURS["ink"], linewidth=1.2)
        axes.plot(*found.given, "x", color=html.COLOURS["grey"], markersize=8.0)
        axes.plot(*found.position, "o", color=html.COLOURS["blue"], markersize=5.0)
        if at is not None:
            axes.plot(*at, "^", color=html.COLOURS["orange"], markersize=7.0)
            axes.annotate(f"load, {found.payload(*at)[0]:.1f} kg", at, (8.0, 4.0), textcoords="offset points")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")

    return svg("cg", _WIDTH_IN, 4.2, draw)


def _table(found: DrivenWeighing, at: tuple[float, float] | None) -> html.Table:
    titles = ("Quantity", "Unit", "Robot file", "Found", "Sigma", "95 % interval")
    return html.Table([html.Cell(title) for title in titles], [[html.Cell(text) for text in row.texts] for row in weigh_rows(found, at)])


def _corrections(corrections: Mapping[str, Nuisance]) -> list[html.Table | html.Paragraph]:
    """What else could turn the robot in the same way: size, sigma, and its share of what robots differ by."""
    rows = []
    for name, one in corrections.items():
        cells = (f"{one.size:+.3g}", f"{one.sigma:.2g}", "" if one.unit == "1" else one.unit, f"{one.size / one.prior_sigma:+.1f}")
        rows.append([html.Cell(name, is_code=True), *map(html.Cell, cells)])
    if not rows:
        return []
    titles = ("Quantity", "Size", "Sigma", "Unit", "In sigmas of its prior")
    return [html.Table([html.Cell(title) for title in titles], rows, is_sortable=True)]
