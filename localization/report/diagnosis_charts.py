"""Charts of a diagnosis: discrepancies before and after correction along time, motion and place, and odds of other causes."""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.drive_predictor import CHANNEL_UNITS, CHANNELS, DrivePredictor
from localization.diagnosis.result import DiagnosisResult
from localization.report.charts import Axis, Chart, ChartSeries
from motion_models import se2
from motion_models.se2 import FloatArray

COMPONENTS = {"x": "along", "y": "sideways", "yaw": "heading", "gyro": "gyro - motion reference"}
_SHOWN_COMPONENTS = 4
_LEAST_COVERED = 0.9
"""Share of the drive's time that must have been measured to put its windows end to end as a path."""
_RIVALS = 8
_LEAST_ODDS = 1e-12
"""Shown of less likely causes."""


def motion_in_windows(predictor: DrivePredictor) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(M,) driven [m], turned [rad] and duration [s] before each measured pose, by wheels and the nominal friction model."""
    batch, twist = predictor.batch, predictor.nominal_twist
    parts = []
    for inside in batch.intervals():
        moved = twist[inside].T @ batch.dt[inside]
        parts.append((moved[0], moved[2], batch.dt[inside].sum()))
    driven, turned, duration = np.array(parts).T
    return driven, turned, duration


def diagnosis_charts(found: DiagnosisResult) -> list[Chart]:
    """Charts of a drive of which enough was measured; none otherwise."""
    if found.predictor is None or found.residuals is None:
        return []
    columns, along = _motion_columns(found.predictor)
    shown = [c for c in range(_SHOWN_COMPONENTS) if np.isfinite(found.residuals.rows[:, c]).any()]
    for c in shown:
        for kind, rows in (("found", found.residuals.rows), ("corrected", found.residuals.left), ("sigma", found.residuals.sigmas)):
            columns[f"{kind} {CHANNELS[c]}"] = rows[:, c]
    charts = [_discrepancies(found, columns, along, shown)]
    place = _places(found.predictor)
    if place is not None:
        over_noise = (found.residuals.rows / found.residuals.sigmas) ** 2
        strongest = max(shown[:3], key=lambda c: float(np.nanmean(over_noise[:, c])))
        charts.append(_place_chart({**columns, "place x": place[:, 0], "place y": place[:, 1]}, shown, strongest))
    return [*charts, *_odds(found)]


def _motion_columns(predictor: DrivePredictor) -> tuple[dict[str, FloatArray], Axis]:
    """Columns of the motion in each window, and the axes that show them."""
    driven, turned, duration = motion_in_windows(predictor)
    seconds = predictor.drive.starts_s[predictor.batch.owner] if len(predictor.drive.starts_s) else np.arange(len(driven), dtype=float)
    cg = np.array([predictor.batch.cg[first] for first in predictor.batch.first[:-1]])[predictor.batch.owner]
    is_timed = predictor.drive.kind == "log"
    entries = {
        "time": ("time since the first window [s]" if is_timed else "window", seconds if is_timed else np.arange(len(driven), dtype=float)),
        "speed": ("speed [m/s]", driven / duration),
        "turn rate": ("turn rate [rad/s]", turned / duration),
        "driven": ("driven in the window [m]", driven),
        "turned": ("turned in the window [rad]", turned),
        "cg x": ("centre of gravity x [m]", cg[:, 0]),
        "cg y": ("centre of gravity y [m]", cg[:, 1]),
    }
    varying = {name: entry for name, entry in entries.items() if np.ptp(entry[1]) > 1e-9 or name == "time"}
    return {name: values for name, (_, values) in varying.items()}, [(name, title) for name, (title, _) in varying.items()]


def _discrepancies(found: DiagnosisResult, columns: dict[str, FloatArray], along: Axis, shown: list[int]) -> Chart:
    assert found.residuals is not None
    texts = [f"window {i + 1}" for i in range(len(found.residuals.rows))]
    series = []
    for panel, c in enumerate(shown):
        name = CHANNELS[c]
        series.append(ChartSeries("as found", "red", y=f"found {name}", panel=panel, size=6.0, texts=[f"{t}, as found" for t in texts]))
        series.append(
            ChartSeries("corrected", "blue", y=f"corrected {name}", panel=panel, size=5.0, texts=[f"{t}, corrected" for t in texts])
        )
        series.append(
            ChartSeries(
                "sigma of the noise", "grey", y=f"sigma {name}", panel=panel, size=3.0, texts=[f"{t}, sigma" for t in texts], is_hidden=True
            )
        )
    titles = [(CHANNELS[c], f"{COMPONENTS[CHANNELS[c]]} [{CHANNEL_UNITS[c]}]") for c in shown]
    note = (
        "Measured minus predicted, one mark for each window. Click a name in the legend to hide it; drag to zoom, double click to see all."
    )
    return Chart("Discrepancies before and after", along, titles, series, columns, height_px=130 * len(shown) + 110, note=note)


def _place_chart(columns: dict[str, FloatArray], shown: list[int], strongest: int) -> Chart:
    """Windows where they were driven, coloured by one component before or after, at first by the ``strongest`` before."""
    series = []
    for c in shown[:3]:
        name = CHANNELS[c]
        for kind, words in (("found", "as found"), ("corrected", "corrected")):
            label = f"{COMPONENTS[name]} [{CHANNEL_UNITS[c]}], {words}"
            texts = [f"{label}: {v:.4g}" for v in columns[f"{kind} {name}"]]
            is_hidden = kind == "corrected" or c != strongest
            series.append(
                ChartSeries(label, "red", x="place x", y="place y", size=8.0, colour_by=f"{kind} {name}", texts=texts, is_hidden=is_hidden)
            )
    note = "Windows put end to end by their measured motion: the place drifts as the motion reference does."
    return Chart(
        "Discrepancies by place", [("place x", "x [m]")], [("place y", "y [m]")], series, columns, is_map=True, height_px=420, note=note
    )


def _places(predictor: DrivePredictor) -> FloatArray | None:
    """(M, 2) where each measured pose was, by the motions before it [m]; None where too much of the drive was not measured."""
    drive = predictor.drive
    if drive.kind != "log" or not drive.has_positions or not len(drive.spans_ns):
        return None
    spans = (drive.spans_ns[:, 1] - drive.spans_ns[:, 0]).sum()
    if spans < _LEAST_COVERED * (drive.spans_ns[-1, 1] - drive.spans_ns[0, 0]):
        return None
    poses: list[FloatArray] = []
    pose = np.zeros(3)
    for maneuver in drive.maneuvers:
        poses.extend(se2.compose(pose, measured) for measured in maneuver.measured)
        pose = poses[-1]
    places = np.array(poses)[:, :2]
    return places if np.isfinite(places).all() else None


def _odds(found: DiagnosisResult) -> list[Chart]:
    """For each finding, how likely it is against every other cause in its place, by evidence on signatures."""
    linearization = found.linearization
    if linearization is None:
        return []
    causes, problem = linearization.causes, linearization.problem
    index = {cause.key: i for i, cause in enumerate(causes)}
    findings = [f for f in found.diagnosis.findings if f.definition.key in index]
    chosen = tuple(index[f.definition.key] for f in findings)
    own = problem.gain(chosen)
    charts = []
    for f, i in zip(findings, chosen, strict=True):
        others = tuple(j for j in chosen if j != i)
        groups = {causes[j].group for j in chosen}
        leads: dict[str, float] = {}
        for j, cause in enumerate(causes):
            if cause.group not in groups:
                leads[cause.label] = min(own - problem.gain((*others, j)), leads.get(cause.label, math.inf))
        ranked = sorted(leads.items(), key=lambda entry: entry[1])[:_RIVALS]
        names = [f.definition.label, *(name for name, _ in ranked)]
        odds = np.array([1.0, *(math.exp(min(-0.5 * lead, 50.0)) for _, lead in ranked)])
        rows = np.arange(len(names), dtype=float)
        texts = [f"{name}: {value:.2g} times as likely" for name, value in zip(names, odds, strict=True)]
        columns = {"odds": np.maximum(odds, _LEAST_ODDS), "row": rows}
        series = [ChartSeries("", "green", y="row", size=11.0, texts=texts, symbol="diamond")]
        charts.append(
            Chart(
                f"In place of {f.definition.label}",
                [("odds", f"odds relative to {f.definition.label}")],
                [("row", "")],
                series,
                columns,
                names=names,
                height_px=26 * len(names) + 110,
                x_type="log",
                note="By what each cause would do to first order. Causes under 'Or' above were compared by full predictions, which decide.",
            )
        )
    return charts
