"""Page of `skidloc try`: what was found of a robot, what its CG does to k and centre of rotation, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from localization.calibration.calibrate import Cut
from localization.evaluation.metrics import evaluate
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.report import page as html
from localization.report.cg_figure import Turns, cg_blocks, describe_turns, measured_turns
from localization.report.replay_page import map_figure
from localization.report.runs import DEAD_RECKONING, map_view, plotted_runs
from localization.report.summary import metres
from motion_models.calibration.maneuvers import Maneuver
from motion_models.diff_drive import DiffDrive
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot

_DRIVE = (
    "Drive a minute: stand 3 s, 10 s straight ahead, 10 s of turning in place to each side, 10 s of arcs to each side, with a second of "
    "standing in between. With arms, do the turns in place again with them stretched ahead and drawn in."
)
_PAGES = {"check": "check/check.html", "replay": "replay/report.html", "diagnose": "diagnosis/diagnosis.html"}


@dataclass(frozen=True)
class Part:
    """One command that was run."""

    name: str
    line: str
    """The command line that runs it alone."""
    text: str
    """What it printed, or its error."""
    is_done: bool


@dataclass(frozen=True)
class Replayed:
    """Result of the replay."""

    results: Sequence[Result]
    reference: ReferenceTrack | Relations | None

    @cached_property
    def odometry_errors(self) -> tuple[dict[str, float], str]:
        """ATE of dead reckoning by model [m], and what it was measured against: the reference, else the path by the LiDAR; none without
        both."""
        reckoned = [result for result in self.results if result.run.estimator == DEAD_RECKONING]
        found = {r.run.model: r.accuracy for r in reckoned if not r.contradictions}
        source = "" if self.reference is None else self.reference.source
        if self.reference is None and (path := self._path_by_lidar()) is not None:
            found, source = {r.run.model: evaluate(r.run.trajectory, path) for r in reckoned}, path.source
        return {m: a.ate_rmse_m for m, a in found.items() if a is not None and a.ate_rmse_m is not None}, source

    def _path_by_lidar(self) -> ReferenceTrack | None:
        matched = [r.run for r in self.results if r.run.lidar is not None and len(r.run.trajectory)]
        if not matched:
            return None
        path = matched[-1].trajectory
        return ReferenceTrack(
            path.stamps_ns, path.poses[:, :2], path.poses[:, 2], source=f"the path of {matched[-1].estimator} by the LiDAR"
        )


@dataclass(frozen=True)
class TryResult:
    """All that `skidloc try` found."""

    log: str
    before: Robot
    """The robot as log, URDF and controller describe it."""
    after: Robot
    """The robot with what was calibrated."""
    model: str
    parts: tuple[Part, ...]
    cut: Cut | None
    contents: Mapping[str, Any]
    """JSON of the parts, by name."""
    replayed: Replayed | None = None

    @property
    def maneuvers(self) -> tuple[Maneuver, ...]:
        """Windows of the log with the motion that was measured."""
        return () if self.cut is None else self.cut.maneuvers

    @property
    def is_calibrated(self) -> bool:
        """Whether the calibration changed the robot."""
        return bool(self.contents.get(f"calibrate_{self.model}", {}).get("recommended", False))

    @property
    def turns(self) -> Turns:
        """Turns in place of the log."""
        return measured_turns(self.maneuvers, self.after)


def improvement(contents: Mapping[str, Any], model: str) -> str:
    """Errors of predicted windows on held-out parts of the drive: diff_drive against ``model``; empty where unknown."""
    rows = _held_out_errors(contents, model)
    if len(rows) < 3:
        return ""
    (_, fitted), (_, ours) = rows[1:]
    parts = [f"the {name} is off by {ours[name]} with {model}, by {fitted[name]} with diff_drive" for name in ours]
    return f"Over windows that the calibration did not use, {'; '.join(parts)} (RMS)." if parts else ""


def odometry_sentence(replayed: Replayed | None, model: str) -> str:
    """What dead reckoning over the whole drive is off by, with diff_drive and with ``model``; empty where unknown."""
    errors, source = ({}, "") if replayed is None else replayed.odometry_errors
    if model == DiffDrive.name or not errors.keys() >= {DiffDrive.name, model}:
        return ""
    ours, base = (metres(errors[name]) for name in (model, DiffDrive.name))
    errors_by = f"{ours} with {model}, and by {base} with diff_drive, both calibrated on it"
    return f"By wheels alone this drive is off by {errors_by} (ATE against {source})."


def _held_out_errors(contents: Mapping[str, Any], model: str) -> list[tuple[str, dict[str, str]]]:
    """Errors by quantity for diff_drive as the driver has it, diff_drive calibrated, and ``model``; none where not all are known."""
    base, ours = contents.get(f"calibrate_{DiffDrive.name}"), contents.get(f"calibrate_{model}")
    if model == DiffDrive.name or base is None or ours is None or not (base["heldout"] and ours["heldout"]):
        return []
    rows = (("diff_drive, as the driver has it", base, "before"), ("diff_drive, calibrated", base, "after"), (model, ours, "after"))
    units = (("heading", "heading_deg", "deg", 1.0), ("position", "position_m", "mm", 1e3))
    known = [unit for unit in units if unit[1] in base["errors"] and unit[1] in ours["errors"]]
    return [
        (words, {name: f"{factor * numbers['errors'][key][when][0]:.2g} {unit}" for name, key, unit, factor in known})
        for words, numbers, when in rows
    ]


def summarize(found: TryResult) -> list[str]:
    """The sentences at the top, the most important first."""
    model = make_model(found.model, found.after)
    sentences = [odometry_sentence(found.replayed, found.model), improvement(found.contents, found.model)]
    if found.after.drive != DIFF_DRIVE:
        sentences.append(describe_turns(found.turns, model, found.after))
    numbers = found.contents.get(f"calibrate_{found.model}")
    if numbers is not None:
        sentences.append(_calibrated(numbers, found))
    if "check" in found.contents:
        sentences.append(found.contents["check"]["sentence"])
    if "diagnose" in found.contents:
        sentences.append(found.contents["diagnose"]["sentence"])
    failed = [part.name for part in found.parts if not part.is_done]
    if failed:
        sentences.append(f"Without a result: {', '.join(failed)}. The reasons stand below.")
    return [sentence for sentence in sentences if sentence]


def _calibrated(numbers: Mapping[str, Any], found: TryResult) -> str:
    if not numbers["recommended"]:
        return "The calibration predicts windows that it did not use no better than the robot file does, which keeps its numbers."
    turning = numbers["turning"]
    track = found.after.geometry.track_width_m
    k = track / turning["effective_track_m"][0]
    sigma = k * turning["effective_track_m"][1] / turning["effective_track_m"][0]
    x, x_sigma = turning["x_cr_m"]
    where = f", and the centre of rotation is {x:+.3f} +- {x_sigma:.3f} m ahead" if x_sigma > 0.0 and found.model != "diff_drive" else ""
    return f"Calibrated at the nominal centre of gravity, k is {k:.3f} +- {sigma:.3f}{where}."


def _next_steps(found: TryResult) -> list[str]:
    numbers = found.contents.get(f"calibrate_{found.model}")
    steps = [f"{held['parameter']}: {held['why']}" for held in (numbers or {}).get("held", [])]
    if not found.is_calibrated or not found.maneuvers:
        steps.append(_DRIVE)
    if found.after.drive != DIFF_DRIVE and not found.turns.moves:
        steps.append(
            "The centre of gravity did not move in this drive's turns in place: turn 10 s in place with the arms or the load ahead, and "
            "10 s with them drawn in, to measure what it does to k and the centre of rotation."
        )
    steps.append("Use the robot file from now on: skidloc replay LOG --robot calibrated.toml --out results, or skidloc online.")
    return steps


def write_try_page(path: str | Path, found: TryResult) -> None:
    """Write the page. Raises `OutputError`."""
    html.write_new(path, try_page(found).encode())


def try_page(found: TryResult) -> str:
    """HTML of the whole page."""
    blocks = cg_blocks(found.turns, found.model, found.before, found.after if found.is_calibrated else found.before)
    sections = [
        html.Section("How much better the odometry is", _odometry_blocks(found)),
        html.Section("What the centre of gravity does", blocks),
        html.Section("What to do next", html.bullets(_next_steps(found))),
        html.Section("Robot", [html.Definitions(_robot(found))]),
        html.Section("Parts", [_parts_table(found)]),
        html.Section("Output of the parts", [block for part in found.parts for block in html.bullets(_lines(part.text), part.name)]),
    ]
    facts = f"{found.after.name} · {len(found.maneuvers)} windows" + (f" by {found.cut.measured_by}" if found.cut is not None else "")
    sentences = summarize(found) or ["Nothing measured the motion."]
    runs = [] if found.replayed is None else plotted_runs(found.replayed.results)
    return html.render(html.Page(f"First look at {found.log}", facts, sentences, sections, [run.number for run in runs]))


def _odometry_blocks(found: TryResult) -> list[html.Block]:
    """Errors of the models on held-out windows and over the whole drive, and the paths."""
    rows = _held_out_errors(found.contents, found.model)
    if not rows:
        return []
    errors, source = ({}, "") if found.replayed is None else found.replayed.odometry_errors
    names = list(rows[0][1])
    columns = [*(f"{name} of a window" for name in names), *(["whole drive"] if errors else [])]
    by_row = (None, errors.get(DiffDrive.name), errors.get(found.model))
    cells = [[html.Cell(words), *(html.Cell(of[name]) for name in names)] for words, of in rows]
    for row, error in zip(cells, by_row, strict=True):
        row += [html.Cell("" if error is None else metres(error))] if errors else []
    note = "Windows: RMS on parts of the drive that the calibration did not use."
    note += f" Whole drive: ATE of the wheels alone against {source}." if errors else ""
    blocks: list[html.Block] = [html.Table([html.Cell(""), *map(html.Cell, columns)], cells), html.Paragraph(note, is_small=True)]
    if found.replayed is not None:
        runs = plotted_runs(found.replayed.results)
        blocks.append(map_figure(runs, map_view(runs, found.replayed.reference)))
    return blocks


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def _robot(found: TryResult) -> dict[str, str]:
    g, arms = found.after.geometry, found.after.arms
    facts = {
        "Wheel radius": f"{g.wheel_radius_m:.4g} m",
        "Track, wheelbase": f"{g.track_width_m:.4g} m, {g.wheelbase_m:.4g} m",
        "Mass": f"{g.mass_kg:.4g} kg",
        "Centre of gravity": f"x {g.cg_x_m:+.3f} m, y {g.cg_y_m:+.3f} m from the middle of the wheels",
        "Wheels": f"left {', '.join(found.after.joints.left) or '-'}; right {', '.join(found.after.joints.right) or '-'}",
    }
    if arms is not None:
        facts["Arms"] = f"{len(arms.joints)} joints: {', '.join(arms.joints)}" if arms.joints else f"all joints of {arms.urdf}"
    return facts


def _parts_table(found: TryResult) -> html.Table:
    header = [html.Cell(title) for title in ("Part", "Alone", "Page")]
    rows = [
        [
            html.Cell(part.name, mark="green" if part.is_done else "red"),
            html.Cell(part.line, is_code=True),
            html.Cell("page", link=_PAGES[part.name]) if part.is_done and part.name in _PAGES else html.Cell(),
        ]
        for part in found.parts
    ]
    return html.Table(header, rows, is_text=True)
