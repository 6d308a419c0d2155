"""Page of `skidloc calibrate`: k and centre of rotation against the centre of gravity, errors, and parameters, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from localization.report import page as html
from localization.report.cg_figure import cg_blocks, describe_turns, measured_turns
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import Robot


def write_calibrate_page(path: Path, before: Robot, after: Robot, maneuvers: Sequence[Maneuver], numbers: Mapping[str, Any]) -> None:
    """Write the page; ``numbers`` are those of `calibrate --json`. Raises `OutputError`."""
    html.write_new(path, calibrate_page(before, after, maneuvers, numbers).encode())


def calibrate_page(before: Robot, after: Robot, maneuvers: Sequence[Maneuver], numbers: Mapping[str, Any]) -> str:
    """HTML of the whole page."""
    model = str(numbers["model"])
    turns = measured_turns(maneuvers, after)
    sentences = [
        "The calibration predicts windows that it did not use better than the robot file does."
        if numbers["recommended"]
        else "The robot file's numbers stay: the calibration predicts windows that it did not use no better.",
        describe_turns(turns, make_model(model, after), after),
    ]
    sections = [
        html.Section("What the centre of gravity does", cg_blocks(turns, model, before, after)),
        html.Section("Errors", [_errors(numbers)]),
        html.Section("Parameters", [_parameters(numbers)]),
        html.Section("What the drive does not reveal", html.bullets([f"{held['parameter']}: {held['why']}" for held in numbers["held"]])),
    ]
    measured = ", ".join(f"{log} by {what}" for log, what in numbers["witness"].items())
    facts = f"{before.name} · {numbers['maneuvers']} windows · {measured}"
    return html.render(html.Page(f"Calibration of {model}", facts, [text for text in sentences if text], sections))


def _errors(numbers: Mapping[str, Any]) -> html.Table:
    kind = "windows not used" if numbers["heldout"] else "the same windows"
    header = [html.Cell(title) for title in ("RMS error", "Robot file", "Calibrated", "Gain, 95 %")]
    rows = []
    for name, values in numbers["errors"].items():
        quantity, unit = name.split("_")
        gain = values["gain"]
        cells = (f"{values['before'][0]:.3g}", f"{values['after'][0]:.3g}", f"{gain[1]:.3g} to {gain[2]:.3g}")
        rows.append([html.Cell(f"{quantity} [{unit}]", kind), *map(html.Cell, cells)])
    return html.Table(header, rows)


def _parameters(numbers: Mapping[str, Any]) -> html.Table:
    header = [html.Cell(title) for title in ("Parameter", "Robot file", "Calibrated", "Sigma")]
    rows = []
    for name, value in numbers["parameters"].items():
        cells = (f"{value['before']:.5g}", f"{value['value']:.5g}", f"{value['sigma']:.2g}")
        rows.append([html.Cell(name, value["meaning"], is_code=True), *map(html.Cell, cells)])
    return html.Table(header, rows)
